//! An order in which bricks can be put in, one after the other, and what decides it.

use mb_geometry::Aabb;
use nalgebra::Vector3;

use crate::connections::{Connection, Connections, Sets, connections_with};
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

/// Sets of bricks that no order puts together: whatever studs of one direction are left open, the studs of the other
/// directions still join all of the set, so that it cannot be taken apart anywhere. Each is ascending.
///
/// Bricks are rigid, and what goes on a stud travels along it. The last step of any assembly, of single bricks or of
/// parts built by themselves, joins two sets of bricks by studs of one direction alone; sets that split at some
/// direction are looked at further, in pieces.
pub(crate) fn locked(bricks: usize, connections: &[Connection]) -> Vec<Vec<usize>> {
    let mut found = vec![];
    let mut sets = vec![((0..bricks).collect::<Vec<usize>>(), connections.iter().collect::<Vec<_>>())];
    let mut place = vec![usize::MAX; bricks];
    while let Some((members, studs)) = sets.pop() {
        let mut directions: Vec<Vector3<f64>> = vec![];
        for stud in &studs {
            if directions.iter().all(|way| !along(stud, way)) {
                directions.push(stud.axis_in_ldraw);
            }
        }
        if directions.len() < 2 {
            continue;
        }
        members.iter().enumerate().for_each(|(at, &brick)| place[brick] = at);
        let split = directions.iter().find_map(|way| {
            let mut pieces = Sets::new(members.len());
            for stud in studs.iter().filter(|stud| !along(stud, way)) {
                pieces.join(place[stud.stud_brick], place[stud.grip_brick]);
            }
            let pieces = pieces.groups();
            (pieces.len() > 1).then_some(pieces)
        });
        let Some(pieces) = split else {
            found.push(members);
            continue;
        };
        let mut piece_of = vec![0; members.len()];
        for (index, piece) in pieces.iter().enumerate() {
            piece.iter().for_each(|&at| piece_of[at] = index);
        }
        let mut studs_of = vec![vec![]; pieces.len()];
        for stud in studs {
            let piece = piece_of[place[stud.stud_brick]];
            if piece == piece_of[place[stud.grip_brick]] {
                studs_of[piece].push(stud);
            }
        }
        let bricks_of = |piece: Vec<usize>| piece.into_iter().map(|at| members[at]).collect();
        sets.extend(pieces.into_iter().map(bricks_of).zip(studs_of));
    }
    found
}

/// Whether a stud points along a direction, to either side.
fn along(stud: &Connection, way: &Vector3<f64>) -> bool {
    stud.axis_in_ldraw.dot(way).abs() > 0.99
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

#[cfg(test)]
mod tests {
    use super::*;

    fn studs(joined: &[(usize, usize, Vector3<f64>)]) -> Vec<Connection> {
        let stud = |&(stud_brick, grip_brick, axis_in_ldraw): &_| Connection {
            stud_brick,
            grip_brick,
            foot_in_ldraw: nalgebra::Point3::origin(),
            axis_in_ldraw,
        };
        joined.iter().map(stud).collect()
    }

    #[test]
    fn bricks_are_locked_where_no_direction_takes_them_apart() {
        let (up, side) = (-Vector3::y(), Vector3::x());
        let found = |joined: &[(usize, usize, Vector3<f64>)]| locked(6, &studs(joined));
        // A tower, and two bricks that hold each other in two directions.
        assert!(found(&[(0, 1, up), (1, 2, up), (2, 3, up)]).is_empty());
        assert_eq!(found(&[(0, 1, up), (0, 1, side), (1, 2, up)]), [[0, 1]]);
        // Two towers of two, side on side: built by themselves, then pushed together.
        assert!(found(&[(0, 1, up), (2, 3, up), (0, 2, side), (1, 3, side)]).is_empty());
        // One more stud across holds them in both directions.
        assert_eq!(
            found(&[(0, 1, up), (2, 3, up), (0, 2, side), (1, 3, side), (1, 2, up), (0, 3, side)]),
            [[0, 1, 2, 3]]
        );
        // Studs of opposite senses are one direction.
        assert!(found(&[(0, 1, up), (1, 2, -up), (2, 0, up)]).is_empty());
    }
}
