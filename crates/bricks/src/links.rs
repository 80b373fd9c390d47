//! What holds a model together: studs, joints, contacts that must be joints, and bricks that lie on others.

use std::collections::BTreeSet;

use nalgebra::Point3;

use crate::collisions::Collision;
use crate::connections::{Connections, Sets};
use crate::contact::{Touching, resting_patch};
use crate::flat::Shapes;
use crate::joints::{Joint, Joints};
use crate::model::Model;
use crate::neighbors::Neighbors;

/// Bricks whose boxes come this close may touch, LDraw units.
pub(crate) const NEAR_LDU: f64 = 0.4;

/// A brick that lies on another.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Rest {
    pub upper: usize,
    pub lower: usize,
    /// Corners of the common patch, LDraw frame.
    pub corners: Vec<Point3<f64>>,
}

/// All that is known about what holds what.
pub(crate) struct Links {
    pub studs: Connections,
    pub joints: Vec<Joint>,
    /// Bricks about whose joints nothing is known, with bricks that they touch: taken as joined.
    pub assumed: Vec<(usize, usize)>,
    /// Those of them that reach into each other although both bricks have known joints elsewhere.
    pub unclear: BTreeSet<(usize, usize)>,
    /// For each brick, whether it has studs, is or could be held by one, or has a joint.
    pub covered: Vec<bool>,
    /// For each brick, whether its part has round surfaces, joined or not.
    pub is_round: Vec<bool>,
    /// Pairs of bricks whose hold on each other is not known: joints, what is taken for one, overlaps between groups,
    /// and bricks with a round part or without known joints that touch another without a stud between them.
    pub doubtful: BTreeSet<(usize, usize)>,
    /// Between bricks of different groups, at least one of them without foot on the ground.
    pub rests: Vec<Rest>,
    /// Groups of bricks that hold together, largest first.
    pub groups: Vec<Vec<usize>>,
}

impl Links {
    /// Finds them; `overlaps` are the pairs that reach into each other, `on_ground` says which bricks stand on the ground.
    pub fn of(
        model: &Model,
        shapes: &Shapes,
        neighbors: &Neighbors,
        studs: Connections,
        Joints { joints, is_round }: Joints,
        overlaps: &[Collision],
        on_ground: impl Fn(usize) -> bool,
    ) -> Self {
        let mut covered = studs.covered.clone();
        for joint in &joints {
            (covered[joint.peg_brick], covered[joint.hole_brick]) = (true, true);
        }
        let near = neighbors.overlapping_pairs(-NEAR_LDU);
        let mut touching = Touching::new(model, shapes, neighbors);
        let unknown = |&(a, b): &(usize, usize)| !covered[a] || !covered[b];
        let mut assumed: Vec<(usize, usize)> =
            near.iter().copied().filter(unknown).filter(|&(a, b)| touching.touch(a, b)).collect();
        let grouped = |assumed: &[(usize, usize)]| {
            let mut sets = Sets::new(covered.len());
            studs.studs.iter().for_each(|c| sets.join(c.stud_brick, c.grip_brick));
            joints.iter().for_each(|joint| sets.join(joint.peg_brick, joint.hole_brick));
            assumed.iter().for_each(|&(a, b)| sets.join(a, b));
            let groups = sets.groups();
            let mut group_of = vec![0; covered.len()];
            let mut stands = vec![false; groups.len()];
            for (index, group) in groups.iter().enumerate() {
                for &brick in group {
                    group_of[brick] = index;
                    stands[index] |= on_ground(brick);
                }
            }
            (groups, group_of, stands)
        };
        // What has no foot on the ground and reaches into something with a round part is held by a joint that we do
        // not understand.
        let (_, group_of, stands) = grouped(&assumed);
        let held = |c: &&Collision| {
            let apart = group_of[c.a] != group_of[c.b] && !(stands[group_of[c.a]] && stands[group_of[c.b]]);
            apart && (is_round[c.a] || is_round[c.b])
        };
        let unclear: BTreeSet<(usize, usize)> = overlaps.iter().filter(held).map(|c| (c.a, c.b)).collect();
        assumed.extend(&unclear);
        let (groups, group_of, stands) = grouped(&assumed);
        let mut rests = vec![];
        for &(a, b) in &near {
            let (first, second) = (group_of[a], group_of[b]);
            if first == second || (stands[first] && stands[second]) {
                continue;
            }
            for (upper, lower) in [(a, b), (b, a)] {
                let corners = resting_patch(model, shapes, upper, lower);
                if !corners.is_empty() {
                    rests.push(Rest { upper, lower, corners });
                }
            }
        }
        // What not even lies on something is held where a round part of it, or of another, touches.
        let mut carried = stands;
        for pile in piles(&groups, &group_of, &rests) {
            let any = pile.iter().any(|&group| carried[group]);
            pile.into_iter().for_each(|group| carried[group] = any);
        }
        let hangs = |&(a, b): &(usize, usize)| {
            let apart = group_of[a] != group_of[b] && !(carried[group_of[a]] && carried[group_of[b]]);
            apart && (is_round[a] || is_round[b]) && touching.touch(a, b)
        };
        assumed.extend(near.iter().copied().filter(hangs));
        let (groups, group_of, _) = grouped(&assumed);
        let pair = |a: usize, b: usize| (a.min(b), a.max(b));
        let by_stud: BTreeSet<(usize, usize)> = studs.studs.iter().map(|c| pair(c.stud_brick, c.grip_brick)).collect();
        let mut doubtful: BTreeSet<(usize, usize)> = assumed.iter().map(|&(a, b)| pair(a, b)).collect();
        doubtful.extend(joints.iter().map(|joint| pair(joint.peg_brick, joint.hole_brick)));
        doubtful.extend(overlaps.iter().filter(|c| group_of[c.a] != group_of[c.b]).map(|c| pair(c.a, c.b)));
        for &(a, b) in near.iter().filter(|&&(a, b)| is_round[a] || is_round[b]) {
            if !by_stud.contains(&pair(a, b)) && !doubtful.contains(&pair(a, b)) && touching.touch(a, b) {
                doubtful.insert(pair(a, b));
            }
        }
        Self { studs, joints, assumed, unclear, covered, is_round, doubtful, rests, groups }
    }

    /// The bodies that move as one: bricks with joints between them, whose friction is taken to hold, and those that
    /// are assumed to be joined.
    pub fn rigid_bodies(&self) -> Vec<Vec<usize>> {
        let mut sets = Sets::new(self.covered.len());
        self.joints.iter().for_each(|joint| sets.join(joint.peg_brick, joint.hole_brick));
        self.assumed.iter().for_each(|&(a, b)| sets.join(a, b));
        sets.groups()
    }

    /// What stands together: groups, with those that lie on them; each with the indices of its groups.
    pub fn piles(&self) -> Vec<Vec<usize>> {
        let mut group_of = vec![0; self.covered.len()];
        for (index, group) in self.groups.iter().enumerate() {
            group.iter().for_each(|&brick| group_of[brick] = index);
        }
        piles(&self.groups, &group_of, &self.rests)
    }
}

fn piles(groups: &[Vec<usize>], group_of: &[usize], rests: &[Rest]) -> Vec<Vec<usize>> {
    let mut sets = Sets::new(groups.len());
    rests.iter().for_each(|rest| sets.join(group_of[rest.upper], group_of[rest.lower]));
    sets.groups()
}
