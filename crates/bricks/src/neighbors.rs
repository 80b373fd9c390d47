//! Which bricks are near a place: a grid over their boxes.

use std::collections::HashMap;

use mb_geometry::Aabb;
use nalgebra::Point3;

use crate::flat::Shapes;
use crate::model::Model;

/// Edge of the grid's cells, LDraw units: about a brick.
const CELL_LDU: f64 = 60.0;
/// A brick that covers more cells than this (a baseplate) is kept in a list of its own.
const MAX_CELLS: usize = 512;

/// The boxes of a model's bricks, LDraw frame.
pub(crate) struct Neighbors {
    pub boxes: Vec<Aabb>,
    cells: HashMap<[i64; 3], Vec<usize>>,
    large: Vec<usize>,
}

impl Neighbors {
    pub fn of(model: &Model, shapes: &Shapes) -> Self {
        let boxes: Vec<Aabb> = model
            .instances()
            .iter()
            .map(|brick| {
                let mut aabb = Aabb::empty();
                shapes.get(brick.part).vertices.iter().for_each(|p| aabb.add(&brick.ldraw_from_part.apply(p)));
                aabb
            })
            .collect();
        let mut neighbors = Self { boxes, cells: HashMap::new(), large: vec![] };
        for (index, aabb) in neighbors.boxes.iter().enumerate().filter(|(_, aabb)| !aabb.is_empty()) {
            let (low, high) = (cell(&aabb.min), cell(&aabb.max));
            let count = (0..3).fold(1_usize, |n, i| n.saturating_mul((high[i] - low[i]) as usize + 1));
            if count > MAX_CELLS {
                neighbors.large.push(index);
                continue;
            }
            for x in low[0]..=high[0] {
                for y in low[1]..=high[1] {
                    for z in low[2]..=high[2] {
                        neighbors.cells.entry([x, y, z]).or_default().push(index);
                    }
                }
            }
        }
        neighbors
    }

    /// The bricks whose box, grown by `margin` (less than a cell), holds a point; ascending.
    pub fn around(&self, p: &Point3<f64>, margin: f64) -> Vec<usize> {
        let grown = Aabb { min: *p, max: *p }.grown(margin);
        self.candidates(&grown).into_iter().filter(|&index| self.boxes[index].grown(margin).contains(p)).collect()
    }

    /// Pairs of bricks whose boxes overlap by more than `depth` in every direction (where that is negative: are not
    /// further apart); ascending.
    pub fn overlapping_pairs(&self, depth: f64) -> Vec<(usize, usize)> {
        let mut pairs = vec![];
        for (a, aabb) in self.boxes.iter().enumerate().filter(|(_, aabb)| !aabb.is_empty()) {
            for b in self.candidates(&aabb.grown((-depth).max(0.0))) {
                if a < b && overlap(aabb, &self.boxes[b]) > depth {
                    pairs.push((a, b));
                }
            }
        }
        pairs
    }

    fn candidates(&self, aabb: &Aabb) -> Vec<usize> {
        let (low, high) = (cell(&aabb.min), cell(&aabb.max));
        let count = (0..3).fold(1_usize, |n, i| n.saturating_mul((high[i] - low[i]) as usize + 1));
        let mut found = self.large.clone();
        if count > MAX_CELLS {
            return (0..self.boxes.len()).collect();
        }
        for x in low[0]..=high[0] {
            for y in low[1]..=high[1] {
                for z in low[2]..=high[2] {
                    found.extend(self.cells.get(&[x, y, z]).into_iter().flatten());
                }
            }
        }
        found.sort_unstable();
        found.dedup();
        found
    }
}

fn cell(p: &Point3<f64>) -> [i64; 3] {
    [p.x, p.y, p.z].map(|v| (v / CELL_LDU).floor() as i64)
}

/// By how much two boxes overlap in the direction in which they overlap least; negative where they are apart.
pub(crate) fn overlap(a: &Aabb, b: &Aabb) -> f64 {
    (0..3).map(|i| a.max[i].min(b.max[i]) - a.min[i].max(b.min[i])).fold(f64::INFINITY, f64::min)
}
