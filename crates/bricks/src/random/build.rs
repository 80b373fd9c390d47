//! A model under construction on the grid: bricks come from above (or hang from below), so two height maps say it all.

use std::collections::BTreeSet;

use super::grid_part::{GridPart, PartSet};
use crate::connections::Sets;
use crate::convex_hull::convex_hull;
use crate::sketch::Sketch;

/// A placed brick.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Placed {
    /// Index into [`PartSet::parts`].
    pub part: usize,
    /// Its low corner: studs, plates, studs.
    pub corner: [i32; 3],
    /// LDraw colour code.
    pub color: u32,
}

/// What stands over one square of the ground.
#[derive(Debug, Clone, Copy)]
struct Column {
    /// Height of the first free cell above everything, plates.
    top: i32,
    /// Whether a stud stands there.
    stud: bool,
    /// The brick that ends there.
    top_brick: usize,
    /// Height of the lowest filled cell, plates.
    bottom: i32,
    /// Whether the brick there grips a stud from below.
    socket: bool,
}

const NOTHING: Column = Column { top: 0, stud: false, top_brick: usize::MAX, bottom: i32::MAX, socket: false };

/// A model that grows within its room.
#[derive(Clone)]
pub(crate) struct Build<'a> {
    pub parts: &'a PartSet,
    /// Studs, plates, studs.
    pub room: [i32; 3],
    columns: Vec<Column>,
    pub placed: Vec<Placed>,
}

impl<'a> Build<'a> {
    pub fn new(parts: &'a PartSet, room: [i32; 3]) -> Self {
        Self { parts, room, columns: vec![NOTHING; (room[0] * room[2]) as usize], placed: vec![] }
    }

    pub fn contains(&self, [x, z]: [i32; 2]) -> bool {
        (0..self.room[0]).contains(&x) && (0..self.room[2]).contains(&z)
    }

    fn column(&self, [x, z]: [i32; 2]) -> &Column {
        &self.columns[(x * self.room[2] + z) as usize]
    }

    /// The first free height over a square of the room.
    pub fn top(&self, square: [i32; 2]) -> i32 {
        self.column(square).top
    }

    /// Whether a brick at height `y` finds a stud on this square.
    pub fn has_stud(&self, square: [i32; 2], y: i32) -> bool {
        let column = self.column(square);
        column.stud && column.top == y
    }

    /// Squares with a free stud, and its height.
    pub fn free_studs(&self) -> Vec<[i32; 3]> {
        let squares = (0..self.room[0]).flat_map(|x| (0..self.room[2]).map(move |z| [x, z]));
        squares.filter(|&s| self.column(s).stud).map(|s| [s[0], self.top(s), s[1]]).collect()
    }

    /// Squares above the ground from which a brick can hang, and the height of what it would hang from.
    pub fn free_sockets(&self) -> Vec<[i32; 3]> {
        let squares = (0..self.room[0]).flat_map(|x| (0..self.room[2]).map(move |z| [x, z]));
        let hangs = |s: &[i32; 2]| self.column(*s).socket && self.column(*s).bottom > 0;
        squares.filter(hangs).map(|s| [s[0], self.column(s).bottom, s[1]]).collect()
    }

    /// Whether the brick is within the room and nothing is in its place or above it.
    pub fn fits(&self, part: &GridPart, corner: [i32; 3]) -> bool {
        let inside = (0..3).all(|i| corner[i] >= 0 && corner[i] + part.size[i] <= self.room[i]);
        inside && part.squares(corner).all(|square| self.top(square) <= corner[1])
    }

    /// Whether the brick is within the room and nothing is in its place or below it.
    pub fn fits_below(&self, part: &GridPart, corner: [i32; 3]) -> bool {
        let inside = (0..3).all(|i| corner[i] >= 0 && corner[i] + part.size[i] <= self.room[i]);
        inside && part.squares(corner).all(|square| self.column(square).bottom >= corner[1] + part.size[1])
    }

    /// The squares on which a brick at `corner` is held by studs.
    pub fn held(&self, part: &GridPart, corner: [i32; 3]) -> Vec<[i32; 2]> {
        let squares = part.sockets.iter().map(|s| [corner[0] + s[0], corner[2] + s[1]]);
        squares.filter(|&s| self.contains(s) && self.has_stud(s, corner[1])).collect()
    }

    /// How many of its studs would hold a brick that hangs from others.
    pub fn held_below(&self, part: &GridPart, corner: [i32; 3]) -> usize {
        let at = |s: &&[i32; 3]| {
            let square = [corner[0] + s[0], corner[2] + s[2]];
            self.contains(square) && self.column(square).socket && self.column(square).bottom == corner[1] + s[1]
        };
        part.studs.iter().filter(at).count()
    }

    /// Whether the middle of the brick lies over what holds it.
    pub fn is_balanced(&self, part: &GridPart, corner: [i32; 3], held: &[[i32; 2]]) -> bool {
        let middle = [2 * corner[0] + part.size[0], 2 * corner[2] + part.size[2]];
        !held.is_empty()
            && (0..2).all(|i| {
                let low = held.iter().map(|s| s[i]).min().unwrap_or(0);
                let high = held.iter().map(|s| s[i]).max().unwrap_or(0) + 1;
                (2 * low..=2 * high).contains(&middle[i])
            })
    }

    /// How many different bricks are directly below.
    pub fn bricks_below(&self, part: &GridPart, corner: [i32; 3]) -> usize {
        let below: BTreeSet<usize> = part
            .squares(corner)
            .filter(|&s| self.has_stud(s, corner[1]))
            .map(|square| self.column(square).top_brick)
            .collect();
        below.len()
    }

    /// Puts the brick in; the caller has seen to it that it fits and holds.
    pub fn place(&mut self, part: usize, corner: [i32; 3], color: u32) {
        let set = self.parts;
        let shape = &set.parts[part].0;
        let brick = self.placed.len();
        for [x, z] in shape.squares(corner) {
            let column = &mut self.columns[(x * self.room[2] + z) as usize];
            if corner[1] >= column.top {
                (column.top, column.stud, column.top_brick) = (corner[1] + shape.size[1], false, brick);
            }
            if corner[1] < column.bottom {
                (column.bottom, column.socket) = (corner[1], false);
            }
        }
        for s in &shape.studs {
            let column = &mut self.columns[((corner[0] + s[0]) * self.room[2] + corner[2] + s[2]) as usize];
            if column.top_brick == brick && column.top == corner[1] + s[1] {
                column.stud = true;
            }
        }
        for s in &shape.sockets {
            let column = &mut self.columns[((corner[0] + s[0]) * self.room[2] + corner[2] + s[1]) as usize];
            if column.bottom == corner[1] {
                column.socket = true;
            }
        }
        self.placed.push(Placed { part, corner, color });
    }

    /// The largest piece that holds together by the studs of the grid, as a model of its own: what is left out carries
    /// nothing of it.
    #[must_use]
    pub fn largest_piece(&self) -> Self {
        let mut stud_of_cell = std::collections::HashMap::new();
        for (brick, placed) in self.placed.iter().enumerate() {
            for s in &self.parts.parts[placed.part].0.studs {
                stud_of_cell.insert(std::array::from_fn::<i32, 3, _>(|i| placed.corner[i] + s[i]), brick);
            }
        }
        let mut pieces = Sets::new(self.placed.len());
        for (brick, placed) in self.placed.iter().enumerate() {
            let corner = placed.corner;
            for s in &self.parts.parts[placed.part].0.sockets {
                if let Some(&other) = stud_of_cell.get(&[corner[0] + s[0], corner[1], corner[2] + s[1]]) {
                    pieces.join(brick, other);
                }
            }
        }
        let mut piece = Self::new(self.parts, self.room);
        for &brick in pieces.groups().first().map_or(&[][..], Vec::as_slice) {
            let Placed { part, corner, color } = self.placed[brick];
            piece.place(part, corner, color);
        }
        piece
    }

    /// Edges of the box around all cells: studs, plates, studs.
    pub fn extent(&self) -> [i32; 3] {
        let (mut low, mut high) = ([i32::MAX; 3], [i32::MIN; 3]);
        for Placed { part, corner, .. } in &self.placed {
            for i in 0..3 {
                low[i] = low[i].min(corner[i]);
                high[i] = high[i].max(corner[i] + self.parts.parts[*part].0.size[i]);
            }
        }
        std::array::from_fn(|i| (high[i] - low[i]).max(0))
    }

    /// Share of the columns of studs whose lowest cell is above the ground.
    pub fn overhang(&self) -> f64 {
        let filled = || self.columns.iter().filter(|c| c.bottom < i32::MAX);
        filled().filter(|c| c.bottom > 0).count() as f64 / filled().count().max(1) as f64
    }

    /// How far the model can be tilted before it falls over, degrees, were every cell equally heavy: the angle between
    /// the vertical and the line from its centre of mass to the nearest edge of its foot.
    pub fn tilt_deg(&self) -> f64 {
        let (mut mass, mut moment) = (0.0, [0.0; 3]);
        for Placed { part, corner, .. } in &self.placed {
            let size = self.parts.parts[*part].0.size;
            let volume = f64::from(size[0] * size[1] * size[2]);
            mass += volume;
            for i in 0..3 {
                moment[i] += volume * (f64::from(corner[i]) + 0.5 * f64::from(size[i]));
            }
        }
        let [x, y, z] = moment.map(|m| m / f64::max(mass, 1.0));
        let grounded = self.placed.iter().filter(|placed| placed.corner[1] == 0);
        let corners = grounded.flat_map(|placed| {
            let size = self.parts.parts[placed.part].0.size;
            let [cx, _, cz] = placed.corner.map(f64::from);
            let [width, _, depth] = size.map(f64::from);
            [[cx, cz], [cx + width, cz], [cx, cz + depth], [cx + width, cz + depth]]
        });
        let hull = convex_hull(corners.collect());
        // Studs are 20 units long, plates 8 high.
        let height = y * 8.0 / 20.0;
        let inwards = hull.iter().enumerate().map(|(index, a)| {
            let b = hull[(index + 1) % hull.len()];
            let along = [b[0] - a[0], b[1] - a[1]];
            (along[0] * (z - a[1]) - along[1] * (x - a[0])) / along[0].hypot(along[1]).max(1e-9)
        });
        let margin = inwards.fold(f64::INFINITY, f64::min);
        if hull.len() < 3 { 0.0 } else { margin.atan2(height).to_degrees() }
    }

    /// The filled cells, from the low corner of them all.
    pub fn cells(&self) -> BTreeSet<[i32; 3]> {
        let low: [i32; 3] =
            std::array::from_fn(|i| self.placed.iter().map(|placed| placed.corner[i]).min().unwrap_or(0));
        let cells = self.placed.iter().flat_map(|placed| {
            let (part, corner) = (&self.parts.parts[placed.part].0, placed.corner);
            let rise = part.size[1];
            part.squares(corner).flat_map(move |[x, z]| (0..rise).map(move |y| [x, corner[1] + y, z]))
        });
        cells.map(|[x, y, z]| [x - low[0], y - low[1], z - low[2]]).collect()
    }

    /// What the model looks like whatever its colours, its place and the side from which it is seen: its bricks as
    /// numbers and corners, in the smallest of four orders.
    pub fn signature(&self) -> Vec<(&str, [i32; 6])> {
        (0..4).map(|turns| self.signature_turned(turns)).min().unwrap_or_default()
    }

    fn signature_turned(&self, turns: usize) -> Vec<(&str, [i32; 6])> {
        let boxes = self.placed.iter().map(|placed| {
            let part = &self.parts.parts[placed.part].0;
            let mut low = placed.corner;
            let mut high: [i32; 3] = std::array::from_fn(|i| low[i] + part.size[i]);
            for _ in 0..turns {
                (low, high) = ([low[2], low[1], -high[0]], [high[2], high[1], -low[0]]);
            }
            (part.number.as_str(), low, high)
        });
        let boxes: Vec<_> = boxes.collect();
        let origin: [i32; 3] = std::array::from_fn(|i| boxes.iter().map(|(_, low, _)| low[i]).min().unwrap_or(0));
        let mut signature: Vec<_> = boxes
            .into_iter()
            .map(|(number, low, high)| {
                let place =
                    std::array::from_fn(|i| if i < 3 { low[i] - origin[i] } else { high[i - 3] - origin[i - 3] });
                (number, place)
            })
            .collect();
        signature.sort_unstable();
        signature
    }

    /// The model as LDraw text, its bricks in the given order, with steps of up to four bricks of one level.
    pub fn sketch(&self, description: &str, order: &[usize]) -> String {
        let mut sketch = Sketch::new(description);
        let (mut in_step, mut level) = (0, 0);
        for &brick in order {
            let Placed { part, corner, color } = self.placed[brick];
            if in_step == 4 || (in_step > 0 && corner[1] != level) {
                sketch.step();
                in_step = 0;
            }
            level = corner[1];
            in_step += 1;
            let part = &self.parts.parts[part].0;
            let at = [f64::from(corner[0]) + part.origin[0], f64::from(corner[2]) + part.origin[1]];
            sketch.put(&part.number, color, at, corner[1] + part.origin_height, part.quarter_turns);
        }
        sketch.step();
        sketch.finish()
    }
}
