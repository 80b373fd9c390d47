//! Growth of one random model on the grid.

use std::collections::{BTreeMap, BTreeSet};

use mb_job::Rng;
use rand::RngExt;

use super::grid_part::GridPart;
use super::{RandomOptions, Style};
use crate::sketch::Sketch;

/// Millimetres of a stud and of a plate.
const STUD_MM: f64 = 8.0;
const PLATE_MM: f64 = 3.2;
/// Tries to place a brick before the model is as large as it gets.
const MAX_TRIES: usize = 20_000;

/// A placed brick: which part, where its low corner is, which colour.
struct Placed {
    part: usize,
    corner: [i32; 3],
    color: u32,
}

/// A model that grows.
pub(crate) struct Growth<'a> {
    parts: &'a [(GridPart, f64)],
    pub style: Style,
    /// Room on the ground in studs, and upwards in plates.
    room: [i32; 3],
    wanted: usize,
    palette: Vec<u32>,
    placed: Vec<Placed>,
    filled: BTreeSet<[i32; 3]>,
    /// Lowest and highest filled cell over each square of the ground.
    columns: BTreeMap<[i32; 2], [i32; 2]>,
    /// Cells above which a stud stands free.
    studs: Vec<[i32; 3]>,
    /// Cells on whose underside a brick may hang.
    sockets: Vec<[i32; 3]>,
}

impl<'a> Growth<'a> {
    pub fn new(options: &RandomOptions, parts: &'a [(GridPart, f64)], rng: &mut Rng) -> Self {
        let profile = &options.profile;
        let style = *draw(rng, profile.styles.iter().map(|(style, &weight)| (style, weight)));
        let wanted = if options.bricks == 0 { rng.random_range(25..=150) } else { options.bricks };
        let mut palette = vec![];
        for _ in 0..rng.random_range(1..=profile.max_colors) {
            let code = draw(rng, profile.colors.iter().map(|(code, &weight)| (code, weight)));
            palette.push(code.parse().unwrap_or(15));
        }
        let most = [(profile.max_size_mm / STUD_MM) as i32, (profile.max_size_mm / PLATE_MM) as i32 - 2];
        let mut side = |low: i32, high: i32| rng.random_range(low..=high).clamp(2, most[0]);
        let room = match style {
            Style::Tower => [side(4, 7), most[1], side(4, 7)],
            Style::Wall => [side(12, 24), most[1] / 2, side(2, 4)],
            Style::Cluster => [side(10, 18), most[1] / 2, side(10, 18)],
            Style::Bridge => [side(12, 22), most[1] / 2, side(4, 8)],
            Style::Tree => [side(10, 16), most[1] * 2 / 3, side(10, 16)],
        };
        Self {
            parts,
            style,
            room,
            wanted,
            palette,
            placed: vec![],
            filled: BTreeSet::new(),
            columns: BTreeMap::new(),
            studs: vec![],
            sockets: vec![],
        }
    }

    /// Grows until the wanted number of bricks is there or no room is found.
    pub fn run(mut self, rng: &mut Rng) -> Self {
        self.found(rng);
        let mut tries = 0;
        while self.placed.len() < self.wanted && tries < MAX_TRIES {
            tries += 1;
            if !self.studs.is_empty() && (self.sockets.is_empty() || rng.random_range(0.0..1.0) < 0.93) {
                self.try_above(rng);
            } else if !self.sockets.is_empty() {
                self.try_below(rng);
            }
        }
        self
    }

    /// The first bricks, on the ground.
    fn found(&mut self, rng: &mut Rng) {
        let [x, _, z] = self.room;
        if self.style == Style::Bridge {
            // Two pillars of equal courses, and a deck from one to the other.
            let courses = rng.random_range(2..=5);
            let Some(deck) = self.pick(rng, |part| is_deck(part) && part.size[0] >= 8 && part.size[2] <= 2) else {
                return;
            };
            let span = self.parts[deck].0.size[0].min(x);
            let Some(pillar) = self.pick(rng, |part| is_block(part) && part.size == [2, 3, 2]) else { return };
            for course in 0..courses {
                for corner in [0, span - 2] {
                    let color = self.color(rng, 3 * course);
                    self.place(pillar, [corner, 3 * course, 0], color);
                }
            }
            let color = self.color(rng, 3 * courses);
            self.place(deck, [0, 3 * courses, 0], color);
            return;
        }
        let first = self.pick(rng, |part| {
            !part.studs.is_empty()
                && part.size[0] <= x
                && part.size[2] <= z
                && part.size[0] * part.size[2] >= 4
                && is_full(part)
        });
        if let Some(part) = first {
            let size = self.parts[part].0.size;
            let color = self.color(rng, 0);
            self.place(part, [(x - size[0]) / 2, 0, (z - size[2]) / 2], color);
        }
    }

    fn pick(&self, rng: &mut Rng, fits: impl Fn(&GridPart) -> bool) -> Option<usize> {
        let fitting: Vec<(usize, f64)> = self
            .parts
            .iter()
            .enumerate()
            .filter(|(_, (part, _))| fits(part))
            .map(|(i, (_, weight))| (i, *weight))
            .collect();
        (!fitting.is_empty()).then(|| draw(rng, fitting.into_iter()))
    }

    /// A colour of the palette; neighbours in height tend to share it.
    fn color(&self, rng: &mut Rng, height: i32) -> u32 {
        let band = (height / 6) as usize;
        let index = if rng.random_range(0.0..1.0) < 0.6 { band } else { rng.random_range(0..self.palette.len()) };
        self.palette[index % self.palette.len()]
    }

    fn try_above(&mut self, rng: &mut Rng) {
        let mut stud = self.studs[rng.random_range(0..self.studs.len())];
        // Towers look for the highest of a few studs, walls and clusters for the lowest.
        for _ in 0..2 {
            let other = self.studs[rng.random_range(0..self.studs.len())];
            let prefer = match self.style {
                Style::Tower => other[1] > stud[1],
                Style::Wall | Style::Bridge => other[1] < stud[1],
                Style::Cluster | Style::Tree => false,
            };
            if prefer {
                stud = other;
            }
        }
        let index = draw(rng, self.parts.iter().enumerate().map(|(i, (_, weight))| (i, *weight)));
        let part = &self.parts[index].0;
        let socket = part.sockets[rng.random_range(0..part.sockets.len())];
        let corner = [stud[0] - socket[0], stud[1], stud[2] - socket[1]];
        let held =
            part.sockets.iter().filter(|s| self.has_stud([corner[0] + s[0], corner[1], corner[2] + s[1]])).count();
        if held >= self.needed(part) && self.is_in_room(part, corner) && self.is_free(part, corner, 1) {
            let color = self.color(rng, corner[1]);
            self.place(index, corner, color);
        }
    }

    fn try_below(&mut self, rng: &mut Rng) {
        let socket = self.sockets[rng.random_range(0..self.sockets.len())];
        let index = draw(rng, self.parts.iter().enumerate().map(|(i, (_, weight))| (i, *weight)));
        let part = &self.parts[index].0;
        // Only bricks with an even top hang well.
        if !is_full(part) || part.size[0] * part.size[2] > 8 {
            return;
        }
        let stud = part.studs[rng.random_range(0..part.studs.len())];
        let corner = [socket[0] - stud[0], socket[1] - part.size[1], socket[2] - stud[2]];
        let held = part
            .studs
            .iter()
            .filter(|s| self.sockets.contains(&[corner[0] + s[0], socket[1], corner[2] + s[2]]))
            .count();
        if corner[1] > 0
            && held >= self.needed(part).max(2)
            && self.is_in_room(part, corner)
            && self.is_free(part, corner, -1)
        {
            let color = self.color(rng, corner[1]);
            self.place(index, corner, color);
        }
    }

    /// How many studs a brick must be held by.
    fn needed(&self, part: &GridPart) -> usize {
        let cells = part.sockets.len();
        match self.style {
            Style::Tree => cells.div_ceil(4),
            _ => cells.div_ceil(3),
        }
        .max(usize::from(cells > 1) + 1)
        .min(cells)
    }

    fn has_stud(&self, cell: [i32; 3]) -> bool {
        self.studs.contains(&cell)
    }

    fn is_in_room(&self, part: &GridPart, corner: [i32; 3]) -> bool {
        let inside = (0..3).all(|i| corner[i] >= 0 && corner[i] + part.size[i] <= self.room[i]);
        // Trees keep a narrow trunk below.
        let trunk = self.style != Style::Tree
            || corner[1] >= 12
            || (0..3).step_by(2).all(|i| {
                let (low, high) = (self.room[i] / 2 - 3, self.room[i] / 2 + 3);
                corner[i] >= low && corner[i] + part.size[i] <= high
            });
        inside && trunk
    }

    /// Whether its cells and those on its way (upwards or downwards) are free.
    fn is_free(&self, part: &GridPart, corner: [i32; 3], way: i32) -> bool {
        cells(part, corner).all(|[x, y, z]| match self.columns.get(&[x, z]) {
            Some(&[_, highest]) if way > 0 => highest < y,
            Some(&[lowest, _]) => lowest > y,
            None => true,
        })
    }

    fn place(&mut self, index: usize, corner: [i32; 3], color: u32) {
        let part = &self.parts[index].0;
        for [x, y, z] in cells(part, corner) {
            self.filled.insert([x, y, z]);
            let column = self.columns.entry([x, z]).or_insert([y, y]);
            *column = [column[0].min(y), column[1].max(y)];
        }
        let top = |s: &[i32; 3]| [corner[0] + s[0], corner[1] + s[1], corner[2] + s[2]];
        self.studs.extend(part.studs.iter().map(top));
        self.sockets.extend(part.sockets.iter().map(|s| [corner[0] + s[0], corner[1], corner[2] + s[1]]));
        let filled = &self.filled;
        self.studs.retain(|stud| !filled.contains(stud));
        self.sockets.retain(|&[x, y, z]| y > 0 && !filled.contains(&[x, y - 1, z]));
        self.placed.push(Placed { part: index, corner, color });
    }

    /// The model as LDraw text with steps; `None` where it did not become as large as wanted.
    pub fn sketch(&self, description: &str) -> Option<String> {
        if self.placed.len() < self.wanted {
            return None;
        }
        let mut sketch = Sketch::new(description);
        // A step takes what lies on one level, up to four bricks.
        let (mut in_step, mut level) = (0, 0);
        for Placed { part, corner, color } in &self.placed {
            if in_step == 4 || (in_step > 0 && corner[1] != level) {
                sketch.step();
                in_step = 0;
            }
            level = corner[1];
            in_step += 1;
            let part = &self.parts[*part].0;
            let at = [f64::from(corner[0]) + part.origin[0], f64::from(corner[2]) + part.origin[1]];
            sketch.put(&part.number, *color, at, corner[1] + part.origin_height, part.quarter_turns);
        }
        sketch.step();
        Some(sketch.finish())
    }

    /// Share of the columns of studs whose lowest cell is above the ground.
    pub fn overhang(&self) -> f64 {
        let hanging = self.columns.values().filter(|[lowest, _]| *lowest > 0).count();
        hanging as f64 / self.columns.len().max(1) as f64
    }
}

fn cells(part: &GridPart, corner: [i32; 3]) -> impl Iterator<Item = [i32; 3]> {
    let [a, b, c] = part.size;
    (0..a)
        .flat_map(move |i| (0..b).flat_map(move |j| (0..c).map(move |k| [corner[0] + i, corner[1] + j, corner[2] + k])))
}

/// A stud on every cell of the footprint, all on top.
fn is_full(part: &GridPart) -> bool {
    part.studs.len() as i32 == part.size[0] * part.size[2] && part.studs.iter().all(|s| s[1] == part.size[1])
}

fn is_block(part: &GridPart) -> bool {
    is_full(part) && part.sockets.len() == part.studs.len()
}

fn is_deck(part: &GridPart) -> bool {
    is_block(part) && part.size[1] <= 3
}

/// Draws from weighted choices; the weights are not negative and not all zero.
fn draw<T>(rng: &mut Rng, choices: impl Iterator<Item = (T, f64)>) -> T {
    let choices: Vec<(T, f64)> = choices.collect();
    let sum: f64 = choices.iter().map(|(_, weight)| weight).sum();
    let mut left = rng.random_range(0.0..1.0) * sum;
    let last = choices.len() - 1;
    for (index, (choice, weight)) in choices.into_iter().enumerate() {
        left -= weight;
        if left < 0.0 || index == last {
            return choice;
        }
    }
    unreachable!("the last choice is taken")
}
