//! Can it be built, and does it stand?

use std::collections::{BTreeMap, BTreeSet};

use mb_job::Result;
use serde::{Deserialize, Serialize};

use crate::bodies::{GROUND_LDU, body_of};
use crate::build_order::{build_order, locked};
use crate::collisions::{Collision, collisions};
use crate::connections::{Connection, connections_with};
use crate::contact::Touching;
use crate::flat::Shapes;
use crate::joints::joints;
use crate::links::{Links, NEAR_LDU};
use crate::model::Model;
use crate::neighbors::{Neighbors, overlap};
use crate::statics::{Body, Contact, Equilibrium, equilibrium};

/// What hangs no higher than this over the ground may have been placed by eye, LDraw units (half a plate).
const BY_EYE_LDU: f64 = 4.0;
/// Boxes that share more than this may be a joint, LDraw units: a stud below a brick reaches 4 into its box.
const REACH_LDU: f64 = 4.5;

/// What bricks are like.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CheckOptions {
    /// Force with which one stud is held, newtons. 0.98 is what Liu et al. (2024) measured and use.
    pub clutch_n: f64,
    /// Density of the plastic, kilograms per cubic metre (ABS: 1050).
    pub density_kg_m3: f64,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self { clutch_n: 0.98, density_kg_m3: 1050.0 }
    }
}

/// The pair of bricks whose studs bear most.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WeakestConnection {
    /// The brick with the studs: index into [`Model::instances`].
    pub stud_brick: usize,
    /// The brick that grips them.
    pub grip_brick: usize,
    /// How many studs join the two.
    pub studs: usize,
    /// Share of the clutch force that the hardest pulled of them bears; above 1 it comes off.
    pub load: f64,
}

/// How many joints of each kind a model has.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct JointCounts {
    /// Bars in clips and hollow studs, fingers of hinges: round, about 3.2 mm across.
    pub bars: usize,
    /// Pins and axles in holes: round, about 4.8 mm across.
    pub pins: usize,
    /// Balls in sockets.
    pub balls: usize,
    /// Other round pegs in round holes: wheels, turntables, necks.
    pub others: usize,
}

/// Parts about whose joints nothing is known.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct UncoveredPart {
    /// The part's file name.
    pub part: String,
    /// What it is.
    pub description: String,
    /// How many of the model's bricks.
    pub count: usize,
}

/// The document of `model check`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CheckReport {
    /// Bricks of the model.
    pub parts: usize,
    /// Bricks with studs, with an underside for studs, or joined by a bar, pin, axle, hinge or ball.
    pub covered_parts: usize,
    /// Whether all bricks hold together; those that are not covered count as held by what they touch.
    pub connected: bool,
    /// Whether everything is in equilibrium within the clutch force and nothing hangs in the air. `None` (JSON `null`)
    /// where that cannot be said: see [`undecided_parts`](Self::undecided_parts).
    pub stable: Option<bool>,
    /// Pairs of covered bricks in the same place. What a joint intends is none.
    pub collisions: Vec<Collision>,
    /// Pairs in the same place that may be a joint that is not understood, or a collision: one brick is not covered, or
    /// nothing else holds it.
    pub unclear_overlaps: Vec<Collision>,
    /// Where it would break first; `null` where no stud is pulled or nothing balances.
    pub weakest: Option<WeakestConnection>,
    /// Indices of the bricks in an order in which each can be put in.
    pub build_order: Vec<usize>,
    /// True where in that order each brick can be put in along its studs from a free side, as far as boxes tell; false
    /// where studs that point different ways lock bricks into each other, so that no order can exist. `None` (JSON
    /// `null`) where neither is known: parts of models that are put together by themselves are not tried, nor is how
    /// joints and bricks without known joints go in.
    pub buildable: Option<bool>,
    /// Gripped studs.
    pub connections: usize,
    /// Joints other than studs.
    pub joints: JointCounts,
    /// How many groups of bricks hold together, single covered bricks included.
    pub groups: usize,
    /// Bricks that only lie on others, held by their weight.
    pub resting_parts: Vec<usize>,
    /// Bricks in groups that nothing carries; a submodel beside the rest is undecided instead.
    pub loose_parts: Vec<usize>,
    /// Bricks of groups that stand on the ground but tip over or pull a stud off.
    pub falling_parts: Vec<usize>,
    /// Bricks for which no balance was found, but which have or touch what holds in ways that are not modelled (joints,
    /// bricks without known joints, overlaps that may be joints): they may stand all the same. Also those whose
    /// equilibrium the solver could not find.
    pub undecided_parts: Vec<usize>,
    /// Kinds of parts that are not covered.
    pub uncovered: Vec<UncoveredPart>,
    /// What the figures leave out, and why it does not stand, for people.
    pub notes: Vec<String>,
}

impl Model {
    /// Collisions, connections, equilibrium and a build order. Indices are those of [`Model::instances`].
    ///
    /// Studs are judged by force. Joints (bars, pins, axles, hinges, balls) are taken to hold by friction: what they
    /// join moves as one body. A brick about whose joints nothing is known counts as held by all that it touches, and
    /// is reported as uncovered. Studs alone prove that a model falls: where anything else may hold it, its bricks are
    /// undecided.
    ///
    /// # Errors
    /// `Error::Input` for a model that lacks parts.
    pub fn check(&self, options: &CheckOptions) -> Result<CheckReport> {
        self.require_complete()?;
        let shapes = Shapes::of(self);
        let neighbors = Neighbors::of(self, &shapes);
        let ground = neighbors.boxes.iter().map(|b| b.max.y).fold(f64::NEG_INFINITY, f64::max);
        let on_ground = |brick: usize| neighbors.boxes[brick].max.y > ground - GROUND_LDU;
        let joints = joints(self, &neighbors);
        let studs = connections_with(self, &shapes, &neighbors);
        let overlaps = collisions(self, &shapes, &neighbors, &studs.studs, &joints.joints);
        let links = Links::of(self, &shapes, &neighbors, studs, joints, &overlaps, on_ground);
        let is_clear = |c: &Collision| links.covered[c.a] && links.covered[c.b] && !links.unclear.contains(&(c.a, c.b));
        let (collisions, unclear_overlaps) = overlaps.into_iter().partition(is_clear);
        let rigid = links.rigid_bodies();
        let standing =
            Standing { model: self, shapes: &shapes, neighbors: &neighbors, links: &links, rigid, ground, options };
        let outcome = standing.judge(&on_ground);
        let carried = |group: &&Vec<usize>| group.iter().any(|&brick| on_ground(brick));
        let resting: BTreeSet<usize> = links.groups.iter().filter(|g| !carried(g)).flatten().copied().collect();
        let resting_parts: Vec<usize> = resting.into_iter().filter(|brick| !outcome.hangs(brick)).collect();
        let groups = links.groups.iter().filter(|group| group.iter().any(|&brick| links.covered[brick])).count();
        let (build_order, in_order) = build_order(&neighbors.boxes, &links.studs.studs, ground - GROUND_LDU);
        let only_studs = links.joints.is_empty() && links.assumed.is_empty() && links.covered.iter().all(|&c| c);
        let doubtful: BTreeSet<usize> = links.doubtful.iter().flat_map(|&(a, b)| [a, b]).collect();
        let is_locked = || {
            let sets = locked(self.instances().len(), &links.studs.studs);
            sets.iter().any(|set| set.iter().all(|brick| links.covered[*brick] && !doubtful.contains(brick)))
        };
        let buildable = match in_order && only_studs {
            true => Some(true),
            false => is_locked().then_some(false),
        };
        let parts = self.instances().len();
        let covered_parts = links.covered.iter().filter(|&&c| c).count();
        let mut notes = outcome.notes;
        if covered_parts < parts {
            notes.push(format!(
                "{} of {parts} parts have no known joint; {} contacts of theirs are taken to hold",
                parts - covered_parts,
                links.assumed.len()
            ));
        }
        if !outcome.undecided.is_empty() {
            notes.push(format!(
                "whether {} parts stand cannot be said: by their studs alone they do not, but joints may hold them",
                outcome.undecided.len()
            ));
        }
        if !outcome.loose.is_empty() {
            notes.push(format!("{} parts hang in the air: nothing joins or carries them", outcome.loose.len()));
        }
        if !resting_parts.is_empty() {
            notes.push(format!("{} parts only lie on others", resting_parts.len()));
        }
        Ok(CheckReport {
            parts,
            covered_parts,
            connected: groups <= 1,
            stable: match outcome.falling.is_empty() && outcome.loose.is_empty() {
                true if outcome.undecided.is_empty() => Some(true),
                true => None,
                false => Some(false),
            },
            collisions,
            unclear_overlaps,
            weakest: outcome.weakest,
            build_order,
            buildable,
            connections: links.studs.studs.len(),
            joints: joint_counts(&links),
            groups,
            resting_parts,
            loose_parts: outcome.loose,
            falling_parts: outcome.falling,
            undecided_parts: outcome.undecided,
            uncovered: uncovered(self, &links),
            notes,
        })
    }
}

fn joint_counts(links: &Links) -> JointCounts {
    let mut counts = JointCounts::default();
    for joint in &links.joints {
        let count = match joint.radius {
            _ if joint.axis_in_ldraw.norm() == 0.0 => &mut counts.balls,
            r if (3.4..4.7).contains(&r) => &mut counts.bars,
            r if (5.2..6.7).contains(&r) => &mut counts.pins,
            _ => &mut counts.others,
        };
        *count += 1;
    }
    counts
}

/// The kinds of parts that are not covered, most frequent first.
fn uncovered(model: &Model, links: &Links) -> Vec<UncoveredPart> {
    let mut counts = BTreeMap::new();
    for (brick, _) in model.instances().iter().zip(&links.covered).filter(|(_, covered)| !**covered) {
        *counts.entry(brick.part).or_insert(0) += 1;
    }
    let mut kinds: Vec<UncoveredPart> = counts
        .into_iter()
        .map(|(part, count)| {
            let file = model.file(part);
            UncoveredPart { part: file.name.clone(), description: file.description.clone(), count }
        })
        .collect();
    kinds.sort_by(|a, b| b.count.cmp(&a.count).then(a.part.cmp(&b.part)));
    kinds
}

/// What equilibrium needs.
struct Standing<'a> {
    model: &'a Model,
    shapes: &'a Shapes,
    neighbors: &'a Neighbors,
    links: &'a Links,
    /// Bricks that move as one.
    rigid: Vec<Vec<usize>>,
    /// Height of the lowest feet, LDraw's y.
    ground: f64,
    options: &'a CheckOptions,
}

#[derive(Default)]
struct Outcome {
    /// Bricks of groups that nothing carries, ascending.
    loose: Vec<usize>,
    /// Bricks of piles that do not balance, ascending.
    falling: Vec<usize>,
    /// Bricks that do not balance by what is known, but may by what is not, ascending.
    undecided: Vec<usize>,
    weakest: Option<WeakestConnection>,
    notes: Vec<String>,
}

impl Outcome {
    /// Whether nothing is known to carry a brick, or it is not known what does.
    fn hangs(&self, brick: &usize) -> bool {
        self.loose.binary_search(brick).is_ok() || self.undecided.binary_search(brick).is_ok()
    }
}

impl Standing<'_> {
    /// Judges pile after pile: what stands on its own feet does not depend on its neighbours.
    fn judge(&self, on_ground: &impl Fn(usize) -> bool) -> Outcome {
        let mut outcome = Outcome::default();
        for pile in self.links.piles() {
            let bricks_of = |groups: &[usize]| -> BTreeSet<usize> {
                groups.iter().flat_map(|&group| &self.links.groups[group]).copied().collect()
            };
            let bricks = bricks_of(&pile);
            let hangs = !bricks.iter().any(|&brick| on_ground(brick));
            let balance = if hangs { Some(false) } else { self.balances(&bricks, &mut outcome) };
            if balance == Some(true) {
                continue;
            }
            if balance.is_none() || self.is_doubtful(&bricks) || self.leans(&bricks, hangs, on_ground) {
                outcome.undecided.extend(bricks);
                continue;
            }
            if hangs && self.stands_apart(&bricks) {
                outcome.notes.push(format!(
                    "{} parts stand apart, higher than the lowest point of the rest: they may have another ground",
                    bricks.len()
                ));
                outcome.undecided.extend(bricks);
                continue;
            }
            if hangs {
                outcome.loose.extend(bricks);
                continue;
            }
            // Who is to blame: those that stand, each by itself, or those that lie on them.
            let stands = |group: &usize| self.links.groups[*group].iter().any(|&brick| on_ground(brick));
            let (standing, lying): (Vec<usize>, Vec<usize>) = pile.iter().partition(|group| stands(group));
            let mut falling = BTreeSet::new();
            for group in &standing {
                let bricks = bricks_of(&[*group]);
                if lying.is_empty() || self.balances(&bricks, &mut outcome) == Some(false) {
                    falling.extend(bricks);
                }
            }
            if falling.is_empty() {
                falling = bricks_of(&lying);
            }
            let first = falling.first().map_or(0, |&brick| brick);
            let name = &self.model.file(self.model.instances()[first].part).description;
            outcome.notes.push(format!(
                "{} parts ({}{}) do not keep their balance: they tip over or pull a stud off",
                falling.len(),
                name.trim(),
                if falling.len() > 1 { " and others" } else { "" }
            ));
            outcome.falling.extend(falling);
        }
        outcome.loose.sort_unstable();
        outcome.falling.sort_unstable();
        outcome.undecided.sort_unstable();
        outcome
    }

    /// Whether these bricks may stand on a ground of their own beside the rest: nothing is below them, and either they
    /// are all of a submodel, as plaques and figures are, or they hang so little that they were placed by eye.
    fn stands_apart(&self, bricks: &BTreeSet<usize>) -> bool {
        let (instances, occurrences) = (self.model.instances(), self.model.occurrences());
        let submodels_of = |brick: usize| {
            let parent = |&at: &usize| occurrences[at].parent.map(|(parent, _)| parent);
            // The model itself, occurrence 0, is none.
            std::iter::successors(Some(instances[brick].occurrence), parent).take_while(|&at| at != 0)
        };
        let is_whole = |submodel: usize| {
            let lies_under = |brick: usize| submodels_of(brick).any(|at| at == submodel);
            (0..instances.len()).all(|brick| lies_under(brick) == bricks.contains(&brick))
        };
        let boxes = &self.neighbors.boxes;
        let is_below = |lower: usize, upper: usize| {
            let (lower, upper) = (&boxes[lower], &boxes[upper]);
            let shares = |axis: usize| lower.min[axis] < upper.max[axis] && upper.min[axis] < lower.max[axis];
            // LDraw's y points down.
            lower.max.y > upper.max.y && shares(0) && shares(2)
        };
        let others = || (0..instances.len()).filter(|brick| !bricks.contains(brick));
        let bottom = bricks.iter().map(|&brick| boxes[brick].max.y).fold(f64::NEG_INFINITY, f64::max);
        let placed_by_eye = bottom > self.ground - BY_EYE_LDU;
        (placed_by_eye || bricks.first().is_some_and(|&first| submodels_of(first).any(is_whole)))
            && others().all(|other| bricks.iter().all(|&brick| !is_below(other, brick)))
    }

    /// Whether others may keep these bricks from falling in ways that are not modelled: what hangs may be held by round
    /// parts near it, or by what it reaches into (its corners do not tell), and what tips may lean on what stands.
    fn leans(&self, bricks: &BTreeSet<usize>, hangs: bool, on_ground: &impl Fn(usize) -> bool) -> bool {
        let mut touching = Touching::new(self.model, self.shapes, self.neighbors);
        let boxes = &self.neighbors.boxes;
        let apart = |&(a, b): &(usize, usize)| bricks.contains(&a) != bricks.contains(&b);
        let other = |a: usize, b: usize| if bricks.contains(&a) { b } else { a };
        let is_round = |brick: usize| self.links.is_round[brick];
        self.neighbors.overlapping_pairs(-NEAR_LDU).into_iter().filter(apart).any(|(a, b)| match hangs {
            true => is_round(a) || is_round(b) || overlap(&boxes[a], &boxes[b]) > REACH_LDU,
            false => on_ground(other(a, b)) && touching.touch(a, b),
        })
    }

    /// Whether anything but studs may hold some of these bricks.
    fn is_doubtful(&self, bricks: &BTreeSet<usize>) -> bool {
        let uncovered = bricks.iter().any(|&brick| !self.links.covered[brick]);
        uncovered || self.links.doubtful.iter().any(|(a, b)| bricks.contains(a) || bricks.contains(b))
    }

    /// Whether bricks that touch nothing else keep their balance within the clutch force; `None` where the solver does
    /// not find out.
    fn balances(&self, bricks: &BTreeSet<usize>, outcome: &mut Outcome) -> Option<bool> {
        let rigid: Vec<&Vec<usize>> = self.rigid.iter().filter(|body| bricks.contains(&body[0])).collect();
        let mut body_of_brick = BTreeMap::new();
        for (body, members) in rigid.iter().enumerate() {
            body_of_brick.extend(members.iter().map(|&brick| (brick, body)));
        }
        let density = self.options.density_kg_m3;
        let bodies: Vec<Body> = rigid
            .iter()
            .map(|members| body_of(self.model, self.shapes, self.neighbors, members, self.ground, density))
            .collect();
        // The studs between different bodies, as they are in the model and as the programme wants them.
        let all = self.links.studs.studs.iter();
        let (of_model, of_bodies): (Vec<&Connection>, Vec<Connection>) = all
            .filter_map(|c| {
                let (stud, grip) = (*body_of_brick.get(&c.stud_brick)?, *body_of_brick.get(&c.grip_brick)?);
                (stud != grip).then_some((c, Connection { stud_brick: stud, grip_brick: grip, ..*c }))
            })
            .unzip();
        let rests = self.links.rests.iter();
        let contacts: Vec<Contact> = rests
            .filter_map(|rest| {
                let (upper, lower) = (*body_of_brick.get(&rest.upper)?, *body_of_brick.get(&rest.lower)?);
                (upper != lower).then(|| Contact { upper, lower, corners: rest.corners.clone() })
            })
            .collect();
        match equilibrium(&bodies, &of_bodies, &contacts, self.options.clutch_n) {
            Equilibrium::Balanced { load, load_of_stud } => {
                let weakest = weakest(&of_model, &load_of_stud);
                let known = outcome.weakest.as_ref().map_or(0.0, |known| known.load);
                if weakest.as_ref().is_some_and(|found| found.load > known) {
                    outcome.weakest = weakest;
                }
                Some(load <= 1.0)
            }
            Equilibrium::Tips => Some(false),
            Equilibrium::Unknown => None,
        }
    }
}

fn weakest(connections: &[&Connection], loads: &[f64]) -> Option<WeakestConnection> {
    let (hardest, load) = connections.iter().zip(loads).max_by(|a, b| a.1.total_cmp(b.1))?;
    let same = |c: &&&Connection| (c.stud_brick, c.grip_brick) == (hardest.stud_brick, hardest.grip_brick);
    (*load > 1e-6).then(|| WeakestConnection {
        stud_brick: hardest.stud_brick,
        grip_brick: hardest.grip_brick,
        studs: connections.iter().filter(same).count(),
        load: *load,
    })
}
