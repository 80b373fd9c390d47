//! An order in which bricks can be put in, one after the other, and what decides it.

use mb_geometry::Aabb;
use nalgebra::Vector3;

use crate::connections::{Connection, Connections, connections_with};
use crate::flat::Shapes;
use crate::model::Model;
use crate::neighbors::{Neighbors, overlap};

/// Boxes that share less than this do not bar each other's way, LDraw units: studs reach 4 into the brick above.
const SLACK_LDU: f64 = 4.5;

/// Boxes that are no further apart touch, LDraw units.
const TOUCH_LDU: f64 = 1.0;

/// What decides when a brick can be put in: where the bricks are, and which holds which. For planners of building steps.
#[derive(Debug, Clone, PartialEq)]
pub struct BuildSite {
    /// The box of each brick of [`Model::instances`], LDraw units and axes (-y up); empty for a brick without surface.
    pub boxes: Vec<Aabb>,
    /// Which brick holds which.
    pub connections: Connections,
}

impl Model {
    /// What decides when each brick can be put in.
    pub fn build_site(&self) -> BuildSite {
        let shapes = Shapes::of(self);
        let neighbors = Neighbors::of(self, &shapes);
        let connections = connections_with(self, &shapes, &neighbors);
        BuildSite { boxes: neighbors.boxes, connections }
    }
}

impl BuildSite {
    /// Whether the boxes of two bricks touch or overlap.
    pub fn touch(&self, a: usize, b: usize) -> bool {
        overlap(&self.boxes[a], &self.boxes[b]) > -TOUCH_LDU
    }

    /// Whether a brick that travels `way` (LDraw axes, unit length) reaches its place past the bricks of `placed`, as
    /// far as boxes tell; along a way that is no axis they tell nothing, and it does.
    pub fn is_free(&self, brick: usize, way: &Vector3<f64>, placed: &[usize]) -> bool {
        is_free(&self.boxes, placed, brick, way)
    }
}

/// The bricks in building order, and whether every one of them could be put in: along its studs, from a side on which
/// no box of an earlier brick bars the way, and holding to an earlier brick unless it stands on the ground or begins a
/// group. Low bricks go first. Where no brick is free, the lowest one is taken all the same.
pub(crate) fn build_order(boxes: &[Aabb], connections: &[Connection], ground: f64) -> (Vec<usize>, bool) {
    let mut touching: Vec<Vec<(usize, Vector3<f64>)>> = vec![vec![]; boxes.len()];
    for c in connections {
        // The brick that grips travels against the stud; the one with the stud travels along it.
        touching[c.grip_brick].push((c.stud_brick, -c.axis_in_ldraw));
        touching[c.stud_brick].push((c.grip_brick, c.axis_in_ldraw));
    }
    let mut waiting: Vec<usize> = (0..boxes.len()).collect();
    // Low bottoms (large y) first.
    waiting.sort_by(|&a, &b| boxes[b].max.y.total_cmp(&boxes[a].max.y).then(a.cmp(&b)));
    let (mut order, mut placed, mut buildable) = (vec![], vec![false; boxes.len()], true);
    while !waiting.is_empty() {
        let mut later = vec![];
        let before = order.len();
        for &brick in &waiting {
            let ways: Vec<Vector3<f64>> =
                touching[brick].iter().filter(|(other, _)| placed[*other]).map(|(_, way)| *way).collect();
            let starts = boxes[brick].max.y >= ground || touching[brick].is_empty();
            let way = ways.first().copied().unwrap_or_else(Vector3::y);
            let agreed = ways.iter().all(|other| other.dot(&way) > 0.99);
            let may = (starts || !ways.is_empty()) && agreed && is_free(boxes, &order, brick, &way);
            if may {
                order.push(brick);
                placed[brick] = true;
            } else {
                later.push(brick);
            }
        }
        if order.len() == before {
            // A floating group begins somewhere; anything else here is barred.
            let start = later.iter().position(|&brick| touching[brick].iter().all(|(other, _)| !placed[*other]));
            let free = start.is_some_and(|at| is_free(boxes, &order, later[at], &Vector3::y()));
            buildable &= free;
            let brick = later.remove(start.unwrap_or(0));
            order.push(brick);
            placed[brick] = true;
        }
        waiting = later;
    }
    (order, buildable)
}

/// Whether a brick that travels `way` comes from a side on which no box bars its path.
fn is_free(boxes: &[Aabb], placed: &[usize], brick: usize, way: &Vector3<f64>) -> bool {
    let axis = way.iamax();
    if way[axis].abs() < 0.99 {
        // Tilted studs: boxes say nothing.
        return true;
    }
    let own = &boxes[brick];
    placed.iter().all(|&other| {
        let other = &boxes[other];
        let beside = (0..3).any(|i| i != axis && own.max[i].min(other.max[i]) - own.min[i].max(other.min[i]) < 0.5);
        // Coming along +axis it arrives from the low side.
        let behind = if way[axis] > 0.0 {
            other.min[axis] > own.min[axis] - SLACK_LDU && other.max[axis] > own.min[axis] + SLACK_LDU
        } else {
            other.max[axis] < own.max[axis] + SLACK_LDU && other.min[axis] < own.max[axis] - SLACK_LDU
        };
        beside || behind
    })
}
