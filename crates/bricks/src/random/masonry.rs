//! Courses of bricks: an area is covered with blocks in bond, gaps below are spanned, edges may stand out.

use mb_job::Rng;
use rand::RngExt;

use super::build::Build;
use super::draw;
use super::grid_part::Role;

/// How often a brick that is made to stand out does so, where one fits.
const CORBELS: f64 = 0.7;

/// Squares of the ground.
#[derive(Debug, Clone)]
pub(crate) struct Mask {
    depth: i32,
    cells: Vec<bool>,
}

impl Mask {
    /// No square of the room.
    pub fn none(room: [i32; 3]) -> Self {
        Self { depth: room[2], cells: vec![false; (room[0] * room[2]) as usize] }
    }

    /// The squares of a rectangle, as far as they lie in the room.
    pub fn rectangle(room: [i32; 3], rect: Rect) -> Self {
        let mut mask = Self::none(room);
        mask.add(rect);
        mask
    }

    /// The squares of a rectangle's rim, `thickness` wide.
    pub fn rim(room: [i32; 3], rect: Rect, thickness: i32) -> Self {
        let mut mask = Self::rectangle(room, rect);
        mask.remove(rect.grown(-thickness));
        mask
    }

    pub fn add(&mut self, rect: Rect) {
        self.set(rect, true);
    }

    pub fn remove(&mut self, rect: Rect) {
        self.set(rect, false);
    }

    fn set(&mut self, rect: Rect, value: bool) {
        let width = self.cells.len() as i32 / self.depth;
        for x in rect.x.max(0)..(rect.x + rect.width).min(width) {
            for z in rect.z.max(0)..(rect.z + rect.depth).min(self.depth) {
                self.cells[(x * self.depth + z) as usize] = value;
            }
        }
    }

    pub fn holds(&self, [x, z]: [i32; 2]) -> bool {
        let inside = x >= 0 && (0..self.depth).contains(&z) && x * self.depth + z < self.cells.len() as i32;
        inside && self.cells[(x * self.depth + z) as usize]
    }

    /// All squares that are in, ascending.
    pub fn squares(&self) -> impl Iterator<Item = [i32; 2]> {
        let depth = self.depth;
        let marked = self.cells.iter().enumerate().filter(|(_, held)| **held);
        marked.map(move |(index, _)| [index as i32 / depth, index as i32 % depth])
    }
}

/// A rectangle of squares.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Rect {
    pub x: i32,
    pub z: i32,
    pub width: i32,
    pub depth: i32,
}

impl Rect {
    pub const fn new(x: i32, z: i32, width: i32, depth: i32) -> Self {
        Self { x, z, width, depth }
    }

    pub const fn holds(self, [x, z]: [i32; 2]) -> bool {
        x >= self.x && x < self.x + self.width && z >= self.z && z < self.z + self.depth
    }

    /// Larger by `by` on all sides.
    #[must_use]
    pub const fn grown(self, by: i32) -> Self {
        Self { x: self.x - by, z: self.z - by, width: self.width + 2 * by, depth: self.depth + 2 * by }
    }
}

/// The colour of a brick with this square at this height (plates).
pub(crate) type Paint<'p> = &'p dyn Fn([i32; 2], i32, &mut Rng) -> u32;

impl Build<'_> {
    /// Covers the squares of `mask` at height `y` with blocks `height` plates high. What finds nothing below is held
    /// by blocks that reach over to a neighbour; squares that nothing can cover stay free.
    pub fn course(&mut self, mask: &Mask, y: i32, height: i32, paint: Paint<'_>, rng: &mut Rng) {
        let mut open = mask.clone();
        let mut squares: Vec<[i32; 2]> = open.squares().filter(|&s| self.top(s) <= y).collect();
        for square in mask.squares().filter(|&s| self.top(s) > y) {
            open.remove(Rect::new(square[0], square[1], 1, 1));
        }
        // Courses run along x and along z in turn, from either end: that makes the bond.
        let along_x = ((y / height) % 2 == 0) ^ (rng.random_range(0.0..1.0) < 0.15);
        let reversed = [rng.random_range(0..2) == 1, rng.random_range(0..2) == 1];
        squares.sort_by_key(|&[x, z]| {
            let (x, z) = (if reversed[0] { -x } else { x }, if reversed[1] { -z } else { z });
            if along_x { [z, x] } else { [x, z] }
        });
        if y > 0 {
            for &square in &squares {
                if open.holds(square) && !self.has_stud(square, y) {
                    if rng.random_range(0.0..1.0) < CORBELS {
                        self.corbel(square, &mut open, y, height, paint, rng);
                    }
                    if !open.holds(square) {
                        continue;
                    }
                    self.cover(square, &mut open, y, height, paint, None, rng);
                }
            }
        }
        for &square in &squares {
            if open.holds(square) {
                self.cover(square, &mut open, y, height, paint, Some(reversed), rng);
            }
        }
    }

    /// Covers a square over nothing with a brick that is made to stand out, where one fits.
    fn corbel(&mut self, square: [i32; 2], open: &mut Mask, y: i32, height: i32, paint: Paint<'_>, rng: &mut Rng) {
        let set = self.parts;
        let mut choices: Vec<((usize, [i32; 3]), f64)> = vec![];
        for way in [[1, 0], [-1, 0], [0, 1], [0, -1]] {
            for &index in set.with_role(Role::Corbel(way)) {
                let (part, weight) = &set.parts[index];
                let [width, tall, depth] = part.size;
                for corner in (0..width).flat_map(|i| (0..depth).map(move |j| [square[0] - i, y, square[1] - j])) {
                    let covers = tall == height && part.squares(corner).all(|square| open.holds(square));
                    if covers && self.fits(part, corner) && self.held(part, corner).len() == part.sockets.len() {
                        choices.push(((index, corner), weight * part.area() as f64));
                    }
                }
            }
        }
        if choices.is_empty() {
            return;
        }
        let (index, corner) = draw(rng, choices.into_iter());
        let [width, _, depth] = set.parts[index].0.size;
        open.remove(Rect::new(corner[0], corner[2], width, depth));
        let color = paint([corner[0], corner[2]], y, rng);
        self.place(index, corner, color);
    }

    /// Covers one square with a block that lies within `open` and is held; where `ends` is given, the square is its
    /// low (or, where reversed, its high) corner. A square that nothing covers is taken out of `open`.
    #[allow(clippy::too_many_arguments, reason = "the state of one course")]
    fn cover(
        &mut self,
        [x, z]: [i32; 2],
        open: &mut Mask,
        y: i32,
        height: i32,
        paint: Paint<'_>,
        ends: Option<[bool; 2]>,
        rng: &mut Rng,
    ) {
        let set = self.parts;
        let mut choices: Vec<((usize, [i32; 3]), f64)> = vec![];
        for &index in set.with_role(Role::Block) {
            let (part, weight) = &set.parts[index];
            if part.size[1] != height {
                continue;
            }
            let [width, _, depth] = part.size;
            let offsets = |length: i32, reversed: Option<bool>| match reversed {
                Some(false) => 0..=0,
                Some(true) => length - 1..=length - 1,
                None => 0..=length - 1,
            };
            for i in offsets(width, ends.map(|e| e[0])) {
                for j in offsets(depth, ends.map(|e| e[1])) {
                    let corner = [x - i, y, z - j];
                    let covers = part.squares(corner).all(|square| open.holds(square));
                    if !covers || !self.fits(part, corner) {
                        continue;
                    }
                    let (mut bond, mut size) = (1.0, f64::from(width * depth));
                    if y > 0 {
                        let held = self.held(part, corner);
                        if !self.is_balanced(part, corner, &held) {
                            continue;
                        }
                        size = held.len() as f64;
                        bond = if self.bricks_below(part, corner) > 1 { 6.0 } else { 1.0 };
                    }
                    choices.push(((index, corner), weight * bond * size.sqrt()));
                }
            }
        }
        if choices.is_empty() {
            open.remove(Rect::new(x, z, 1, 1));
            return;
        }
        let (index, corner) = draw(rng, choices.into_iter());
        let [width, _, depth] = set.parts[index].0.size;
        open.remove(Rect::new(corner[0], corner[2], width, depth));
        let color = paint([corner[0], corner[2]], y, rng);
        self.place(index, corner, color);
    }
}
