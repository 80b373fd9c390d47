//! What all styles build with: foundations, storeys, roofs, battlements, columns, and small things on top.

use mb_job::Rng;
use rand::RngExt;

use super::build::Build;
use super::draw;
use super::grid_part::Role;
use super::masonry::{Mask, Rect};

/// Courses of brick are three plates high.
pub(crate) const BRICK: i32 = 3;

/// The colours of one model.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Colors {
    pub base: u32,
    pub wall: u32,
    pub trim: u32,
    pub roof: u32,
    pub detail: u32,
}

/// How walls are coloured.
#[derive(Debug, Clone, Copy)]
enum Pattern {
    Plain,
    /// The trim on every n-th course.
    Bands(i32),
    /// Here and there a brick of the trim.
    Speckled,
    /// The trim above this course.
    Above(i32),
}

/// A building site.
pub(crate) struct Site<'a, 'r> {
    pub build: Build<'a>,
    pub rng: &'r mut Rng,
    pub colors: Colors,
    pattern: Pattern,
    /// How large to build, about 0 to 1.
    pub scale: f64,
}

impl<'a, 'r> Site<'a, 'r> {
    pub fn new(build: Build<'a>, palette: &[u32], scale: f64, rng: &'r mut Rng) -> Self {
        let color = |index: usize| palette[index % palette.len()];
        let colors = Colors { base: color(1), wall: color(0), trim: color(2), roof: color(3), detail: color(4) };
        let pattern = match rng.random_range(0..5) {
            0 => Pattern::Bands(rng.random_range(2..=4)),
            1 => Pattern::Speckled,
            2 => Pattern::Above(rng.random_range(2..=6)),
            _ => Pattern::Plain,
        };
        Self { build, rng, colors, pattern, scale }
    }

    /// A whole number from `low` to `high`.
    pub fn between(&mut self, low: i32, high: i32) -> i32 {
        self.rng.random_range(low..=high.max(low))
    }

    /// A whole number that grows with the scale, from `low` to `high`, give or take.
    pub fn scaled(&mut self, low: i32, high: i32) -> i32 {
        let at = f64::from(low) + f64::from(high - low) * self.scale * self.rng.random_range(0.75..1.25);
        (at.round() as i32).clamp(low, high)
    }

    pub fn chance(&mut self, probability: f64) -> bool {
        self.rng.random_range(0.0..1.0) < probability
    }

    /// A rectangle of that size about the middle of the room.
    pub fn middle(&self, width: i32, depth: i32) -> Rect {
        let [x, _, z] = self.build.room;
        Rect::new((x - width) / 2, (z - depth) / 2, width, depth)
    }

    /// Layers of plates in bond; returns the height on top of them.
    pub fn foundation(&mut self, rect: Rect, layers: i32) -> i32 {
        let mask = Mask::rectangle(self.build.room, rect);
        let color = self.colors.base;
        for y in 0..layers {
            self.build.course(&mask, y, 1, &|_, _, _| color, self.rng);
        }
        layers
    }

    /// Courses of brick from height `y` wherever `solid(square, course)` says so; returns the height on top of them.
    pub fn raise(&mut self, y: i32, courses: i32, solid: impl Fn([i32; 2], i32) -> bool) -> i32 {
        let [width, _, depth] = self.build.room;
        let (Colors { wall, trim, .. }, pattern) = (self.colors, self.pattern);
        let paint = move |_: [i32; 2], height: i32, rng: &mut Rng| match pattern {
            Pattern::Plain => wall,
            Pattern::Bands(every) => {
                if (height - y) / BRICK % every == every - 1 {
                    trim
                } else {
                    wall
                }
            }
            Pattern::Above(course) => {
                if (height - y) / BRICK >= course {
                    trim
                } else {
                    wall
                }
            }
            Pattern::Speckled => {
                if rng.random_range(0.0..1.0) < 0.2 {
                    trim
                } else {
                    wall
                }
            }
        };
        for course in 0..courses {
            let mut mask = Mask::none(self.build.room);
            for square in (0..width).flat_map(|x| (0..depth).map(move |z| [x, z])) {
                if solid(square, course) {
                    mask.add(Rect::new(square[0], square[1], 1, 1));
                }
            }
            self.build.course(&mask, y + BRICK * course, BRICK, &paint, self.rng);
        }
        y + BRICK * courses
    }

    /// A lid of plates; returns the height on top of it.
    pub fn lid(&mut self, rect: Rect, y: i32, color: u32) -> i32 {
        self.build.course(&Mask::rectangle(self.build.room, rect), y, 1, &|_, _, _| color, self.rng);
        y + 1
    }

    /// Teeth along the rim of a rectangle.
    pub fn battlements(&mut self, rect: Rect, y: i32, color: u32) {
        let rim = Mask::rim(self.build.room, rect, 1);
        let mut teeth = Mask::none(self.build.room);
        let pitch = self.between(2, 3);
        for [x, z] in rim.squares() {
            let along = (x - rect.x).min(rect.x + rect.width - 1 - x) + (z - rect.z).min(rect.z + rect.depth - 1 - z);
            if along % pitch == 0 {
                teeth.add(Rect::new(x, z, 1, 1));
            }
        }
        self.build.course(&teeth, y, BRICK, &|_, _, _| color, self.rng);
    }

    /// A pitched roof over walls that end at `y`, its ridge along the longer side; where the profile has no slopes, a
    /// lid.
    pub fn gable(&mut self, rect: Rect, y: i32) {
        let color = self.colors.roof;
        let along_x = rect.width >= rect.depth;
        let (length, span) = if along_x { (rect.width, rect.depth) } else { (rect.depth, rect.width) };
        let (start, near) = if along_x { (rect.x, rect.z) } else { (rect.z, rect.x) };
        let square = |along: i32, across: i32| if along_x { [along, across] } else { [across, along] };
        // The rows of studs on both sides, after each course of slopes.
        let eaves = i32::from(self.chance(0.5) && near > 0);
        let (mut low, mut high, mut y) = (near + 1 - eaves, near + span - 2 + eaves, y);
        if span < 4 || !self.has_slopes() {
            self.lid(rect, y, color);
            return;
        }
        loop {
            self.slopes(start, length, low, square(0, 1), along_x, y, color);
            self.slopes(start, length, high, square(0, -1), along_x, y, color);
            // The triangles at both ends.
            let wall = self.colors.wall;
            let mut ends = Mask::none(self.build.room);
            for across in low + 1..high {
                for along in [start, start + length - 1] {
                    let [x, z] = square(along, across);
                    ends.add(Rect::new(x, z, 1, 1));
                }
            }
            self.build.course(&ends, y, BRICK, &|_, _, _| wall, self.rng);
            y += BRICK;
            if high - low < 3 {
                break;
            }
            (low, high) = (low + 1, high - 1);
        }
        let [x, z] = square(start, low);
        let [width, depth] = square(length, high - low + 1);
        let color = self.colors.trim;
        self.lid(Rect::new(x, z, width, depth), y, color);
    }

    fn has_slopes(&self) -> bool {
        let set = self.build.parts;
        let fits = |&index: &usize| set.parts[index].0.size[1] == BRICK && set.parts[index].0.size[2] == 2;
        set.with_role(Role::Slope([0, 1])).iter().any(fits)
    }

    /// A row of slopes whose studs stand in row `studs_at` and rise towards `uphill`.
    #[allow(clippy::too_many_arguments, reason = "a place in space")]
    fn slopes(&mut self, start: i32, length: i32, studs_at: i32, uphill: [i32; 2], along_x: bool, y: i32, color: u32) {
        let set = self.build.parts;
        let mut at = start;
        let rises = uphill[0] + uphill[1];
        while at < start + length {
            let mut choices = vec![];
            for &index in set.with_role(Role::Slope(uphill)) {
                let (part, weight) = &set.parts[index];
                let (wide, deep) = if along_x { (part.size[0], part.size[2]) } else { (part.size[2], part.size[0]) };
                let across = if rises > 0 { studs_at - deep + 1 } else { studs_at };
                let corner = if along_x { [at, y, across] } else { [across, y, at] };
                let holds = part.size[1] == BRICK && deep == 2 && at + wide <= start + length;
                if holds && self.build.fits(part, corner) && !self.build.held(part, corner).is_empty() {
                    let bond = if self.build.bricks_below(part, corner) > 1 { 3.0 } else { 1.0 };
                    choices.push(((index, corner, wide), weight * f64::from(wide) * bond));
                }
            }
            if choices.is_empty() {
                at += 1;
                continue;
            }
            let (index, corner, wide) = draw(self.rng, choices.into_iter());
            self.build.place(index, corner, color);
            at += wide;
        }
    }

    /// A column of equal bricks on a square foot; returns the height on top of it.
    pub fn column(&mut self, x: i32, z: i32, side: i32, y: i32, courses: i32, color: u32) -> i32 {
        let set = self.build.parts;
        let fitting = |role: Role| -> Vec<(usize, f64)> {
            let of_role = set.with_role(role).iter().map(|&index| (index, set.parts[index].1));
            of_role.filter(|&(index, _)| set.parts[index].0.size == [side, BRICK, side]).collect()
        };
        let round = fitting(Role::Round);
        let choices = if round.is_empty() { fitting(Role::Block) } else { round };
        if choices.is_empty() {
            return y;
        }
        let index = draw(self.rng, choices.into_iter());
        for course in 0..courses {
            let (part, corner) = (&set.parts[index].0, [x, y + BRICK * course, z]);
            if !self.build.fits(part, corner) || (corner[1] > 0 && self.build.held(part, corner).is_empty()) {
                return corner[1];
            }
            self.build.place(index, corner, color);
        }
        y + BRICK * courses
    }

    /// Small things on free studs: slopes that lean on what is higher, tiles, cones, bricks. Stops after `count`.
    pub fn adorn(&mut self, count: usize) {
        let until = self.build.placed.len() + count;
        let mut tries = 30 * count + 60;
        while self.build.placed.len() < until && tries > 0 {
            tries -= 1;
            let studs = self.build.free_studs();
            if studs.is_empty() {
                return;
            }
            let stud = studs[self.rng.random_range(0..studs.len())];
            self.adorn_stud(stud);
        }
    }

    fn adorn_stud(&mut self, [x, y, z]: [i32; 3]) {
        let set = self.build.parts;
        let higher = |[dx, dz]: [i32; 2], depth: i32| {
            let beside = [x + dx * depth, z + dz * depth];
            self.build.contains(beside) && self.build.top(beside) > y
        };
        let mut choices = vec![];
        for (index, (part, weight)) in set.parts.iter().enumerate() {
            if part.area() > 4 {
                continue;
            }
            let fondness = match part.role {
                Role::Slope(uphill) => {
                    if higher(uphill, 1) {
                        6.0
                    } else {
                        0.3
                    }
                }
                Role::Cap => 2.0,
                Role::Round => 1.5,
                Role::Block => 0.7,
                Role::Corbel(_) | Role::Other => 0.2,
            };
            let socket = part.sockets[self.rng.random_range(0..part.sockets.len())];
            let corner = [x - socket[0], y, z - socket[1]];
            if self.build.fits(part, corner) && self.build.held(part, corner).len() == part.sockets.len() {
                choices.push(((index, corner), weight * fondness));
            }
        }
        if choices.is_empty() {
            return;
        }
        let (index, corner) = draw(self.rng, choices.into_iter());
        let color = if self.chance(0.5) { self.colors.detail } else { self.colors.trim };
        self.build.place(index, corner, color);
    }

    /// Grows in all directions, up and down, by bricks of all kinds; stops at `wanted` bricks in all.
    pub fn grow(&mut self, wanted: usize) {
        let set = self.build.parts;
        let mut tries = 60 * wanted;
        while self.build.placed.len() < wanted && tries > 0 {
            tries -= 1;
            let index = draw(self.rng, set.parts.iter().enumerate().map(|(i, (_, weight))| (i, *weight)));
            let part = &set.parts[index].0;
            let color = [self.colors.wall, self.colors.trim, self.colors.roof, self.colors.detail];
            let color = color[self.rng.random_range(0..color.len())];
            let hang = self.chance(0.12) && part.role == Role::Block && part.area() <= 8;
            if hang {
                let sockets = self.build.free_sockets();
                if sockets.is_empty() {
                    continue;
                }
                let [x, y, z] = sockets[self.rng.random_range(0..sockets.len())];
                let stud = part.studs[self.rng.random_range(0..part.studs.len())];
                let corner = [x - stud[0], y - part.size[1], z - stud[2]];
                let held = self.build.held_below(part, corner);
                if corner[1] > 0 && self.build.fits_below(part, corner) && held >= part.area().div_ceil(2).min(4) {
                    self.build.place(index, corner, color);
                }
                continue;
            }
            let studs = self.build.free_studs();
            if studs.is_empty() {
                return;
            }
            let [x, y, z] = studs[self.rng.random_range(0..studs.len())];
            let socket = part.sockets[self.rng.random_range(0..part.sockets.len())];
            let corner = [x - socket[0], y, z - socket[1]];
            if !self.build.fits(part, corner) {
                continue;
            }
            let held = self.build.held(part, corner);
            if held.len() * 3 >= part.sockets.len() && self.build.is_balanced(part, corner, &held) {
                self.build.place(index, corner, color);
            }
        }
    }
}
