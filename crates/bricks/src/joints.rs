//! Round joints: bars in clips, pins and axles in holes, fingers of hinges, balls in sockets.
//!
//! Parts of the library are made of primitives, and those say what is round: a cylinder primitive placed as it is
//! bulges (a bar, a pin, an axle's knuckle), one placed after `INVERTNEXT` is hollow (a clip, a hole, a socket). A
//! joint is where a bulging surface of one brick lies in a hollow one of another: same axis, nearly the same radius,
//! common length; for balls, the same middle; for hinges, fingers of one radius that meet on one axis. That needs no
//! table of parts, and no two bricks that merely touch pass for joined.

use std::collections::HashMap;

use nalgebra::{Point3, Vector3};

use crate::ldraw::file::{Affine, FileId, LdrawFile};
use crate::model::Model;
use crate::neighbors::Neighbors;

/// Radii of bars, pins and balls, LDraw units: smaller ones are ornaments, larger ones outlines.
const RADII_LDU: std::ops::RangeInclusive<f64> = 1.4..=45.0;
/// How much wider than its peg a hole may be, and how much narrower, LDraw units. Pins have play, clips grip.
const PLAY_LDU: std::ops::RangeInclusive<f64> = -0.65..=1.1;
/// Axes this far apart are one, LDraw units.
const SAME_AXIS_LDU: f64 = 0.6;
/// Sine of the angle up to which axes are parallel.
const PARALLEL: f64 = 0.03;
/// The least common length, LDraw units.
const SHARED_LDU: f64 = 0.8;
/// Radii of the fingers of hinges, LDraw units.
const FINGER_LDU: std::ops::Range<f64> = 3.4..4.7;
/// The share of a full turn that a surface must go round to hold or to be held: clips go round a little more than half.
const TURN: f64 = 0.45;

/// Length of the primitives of pins for wheels, LDraw units.
const WHEEL_PIN_LDU: f64 = 11.0;

/// What a round surface is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    Cylinder,
    Ball,
}

/// A round surface of a part, in the part's frame, LDraw units.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Round {
    form: Form,
    hollow: bool,
    radius: f64,
    /// One end of a cylinder's axis, or the middle of a ball.
    start: Point3<f64>,
    /// Unit vector towards the cylinder's other end.
    axis: Vector3<f64>,
    /// Zero for a ball.
    length: f64,
    /// Share of a full turn.
    turn: f64,
}

/// Two bricks joined by a round peg in a round hole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Joint {
    /// The brick with the bar, pin, axle or ball: index into [`Model::instances`](crate::Model::instances).
    pub peg_brick: usize,
    /// The brick with the clip, hole or socket.
    pub hole_brick: usize,
    /// Middle of what they share, LDraw units.
    pub center_in_ldraw: Point3<f64>,
    /// Unit vector along the common axis; zero for a ball.
    pub axis_in_ldraw: Vector3<f64>,
    /// Radius of the hole, LDraw units: 4 for bars and fingers, 6 for pins and axles.
    pub radius: f64,
    /// Common length, LDraw units; the diameter for a ball.
    pub length: f64,
}

/// What is round in a model.
pub(crate) struct Joints {
    /// All joints, by pair of bricks.
    pub joints: Vec<Joint>,
    /// For each brick, whether its part has round surfaces, joined or not.
    pub is_round: Vec<bool>,
}

/// Finds all joints of a model.
pub(crate) fn joints(model: &Model, neighbors: &Neighbors) -> Joints {
    let mut rounds_of_part: HashMap<FileId, Vec<Round>> = HashMap::new();
    for brick in model.instances() {
        rounds_of_part.entry(brick.part).or_insert_with(|| rounds(model.files(), brick.part));
    }
    let placed: Vec<Vec<Round>> = model
        .instances()
        .iter()
        .map(|brick| {
            let to_model = |round: &Round| round.placed(&brick.ldraw_from_part);
            rounds_of_part[&brick.part].iter().filter_map(to_model).collect()
        })
        .collect();
    let mut joints = vec![];
    for (a, b) in neighbors.overlapping_pairs(-SAME_AXIS_LDU) {
        for (peg_brick, hole_brick) in [(a, b), (b, a)] {
            let pegs = placed[peg_brick].iter().filter(|round| !round.hollow);
            for peg in
                pegs.filter(|peg| neighbors.boxes[hole_brick].grown(peg.length + peg.radius).contains(&peg.start))
            {
                for hole in &placed[hole_brick] {
                    let found = match hole.hollow {
                        true => peg.fits(hole),
                        // Fingers are alike: each pair of bricks is looked at once.
                        false if peg_brick < hole_brick => peg.is_finger_beside(hole),
                        false => None,
                    };
                    if let Some((center_in_ldraw, length)) = found {
                        let (axis_in_ldraw, radius) = (peg.axis, hole.radius);
                        joints.push(Joint { peg_brick, hole_brick, center_in_ldraw, axis_in_ldraw, radius, length });
                    }
                }
            }
        }
    }
    let is_round = placed.iter().map(|rounds| !rounds.is_empty()).collect();
    Joints { joints, is_round }
}

impl Round {
    /// The surface in the model; `None` where the brick is distorted.
    fn placed(&self, ldraw_from_part: &Affine) -> Option<Self> {
        let axis = ldraw_from_part.linear * self.axis;
        let stretch = ldraw_from_part.linear.determinant().abs().cbrt();
        let start = ldraw_from_part.apply(&self.start);
        let axis = if self.form == Form::Ball { Vector3::zeros() } else { axis.try_normalize(1e-9)? };
        ((stretch - 1.0).abs() < 0.02).then_some(Self { start, axis, ..*self })
    }

    /// The middle and the length of two fingers of a hinge side by side: round ends of one radius on one axis that meet.
    fn is_finger_beside(&self, other: &Self) -> Option<(Point3<f64>, f64)> {
        let cylinders = self.form == Form::Cylinder && other.form == Form::Cylinder;
        let alike = FINGER_LDU.contains(&self.radius) && (self.radius - other.radius).abs() < 0.1;
        if !cylinders || !alike || self.axis.cross(&other.axis).norm() > PARALLEL {
            return None;
        }
        let between = other.start - self.start;
        let along = between.dot(&self.axis);
        let far = along + other.length * other.axis.dot(&self.axis);
        let aside = (between - self.axis * along).norm();
        let (low, high) = (along.min(far), along.max(far));
        let meets = [low - self.length, -high].into_iter().any(|gap| gap.abs() < SAME_AXIS_LDU);
        let at = if (low - self.length).abs() < SAME_AXIS_LDU { self.length } else { 0.0 };
        (aside < SAME_AXIS_LDU && meets).then(|| (self.start + self.axis * at, self.length.min(other.length)))
    }

    /// The middle and the length of what a peg and a hole share.
    fn fits(&self, hole: &Self) -> Option<(Point3<f64>, f64)> {
        if self.form != hole.form || !PLAY_LDU.contains(&(hole.radius - self.radius)) {
            return None;
        }
        let between = hole.start - self.start;
        if self.form == Form::Ball {
            return (between.norm() < SAME_AXIS_LDU).then_some((hole.start, 2.0 * hole.radius));
        }
        if self.axis.cross(&hole.axis).norm() > PARALLEL {
            return None;
        }
        let along = between.dot(&self.axis);
        let far = along + hole.length * hole.axis.dot(&self.axis);
        let (low, high) = (along.min(far).max(0.0), along.max(far).min(self.length));
        let middle = self.start + self.axis * (0.5 * (low + high));
        let from_hole = middle - hole.start;
        let aside = (from_hole - hole.axis * from_hole.dot(&hole.axis)).norm();
        (high - low > SHARED_LDU && aside < SAME_AXIS_LDU).then_some((middle, high - low))
    }
}

/// The round surfaces of a part.
fn rounds(files: &[LdrawFile], part: FileId) -> Vec<Round> {
    let mut pieces = vec![];
    collect(files, part, &Affine::identity(), false, false, &mut pieces);
    merged(pieces)
}

/// The depth of references was bounded when the model was loaded.
fn collect(
    files: &[LdrawFile],
    id: FileId,
    part_from_file: &Affine,
    inverted: bool,
    in_stud: bool,
    rounds: &mut Vec<Round>,
) {
    let file = &files[id.index()];
    if let Some(round) = round_primitive(file, part_from_file, inverted) {
        // Studs and tubes are another matter, but a bar goes into a hollow stud.
        if !in_stud || (round.hollow && round.radius < 5.0) {
            rounds.push(round);
        }
        return;
    }
    let in_stud = in_stud || file.name.rsplit('/').next().is_some_and(|name| name.starts_with("stu"));
    for reference in &file.references {
        if let Some(target) = reference.target {
            let placed = part_from_file.then_inner(&reference.parent_from_child);
            collect(files, target, &placed, inverted ^ reference.inverted, in_stud, rounds);
        }
    }
}

/// What a primitive of the library stands for: cylinders (`4-4cyli` and their kin with edges), spheres (`8-8sphe`),
/// the cross sections of axles, which turn in round holes and hold in their own, and pins for wheels, which are made of
/// flat pieces.
fn round_primitive(file: &LdrawFile, part_from_file: &Affine, inverted: bool) -> Option<Round> {
    let name = file.name.rsplit('/').next().unwrap_or(&file.name).strip_suffix(".dat")?;
    let linear = &part_from_file.linear;
    let [x, y, z] = [0, 1, 2].map(|column| linear.column(column).into_owned());
    let equal = |a: f64, b: f64| (a - b).abs() <= 0.03 * a.max(b);
    let start = part_from_file.apply(&Point3::origin());
    let digits = name.find(|c: char| c.is_ascii_alphabetic()).map(|at| name.split_at(at));
    let (fraction, kind) = digits.unwrap_or(("", name));
    let turn = fraction.split_once('-').and_then(|(a, b)| Some(a.parse::<f64>().ok()? / b.parse::<f64>().ok()?));
    if let (Some(turn), true) = (turn, kind.starts_with("sphe")) {
        let round = equal(x.norm(), y.norm()) && equal(x.norm(), z.norm()) && RADII_LDU.contains(&x.norm());
        let (form, radius) = (Form::Ball, x.norm());
        return round.then_some(Round { form, hollow: inverted, radius, start, axis: y, length: 0.0, turn });
    }
    let cylinder = ["cyli", "cylc", "cylo"].iter().any(|prefix| kind.starts_with(prefix));
    let axle_hole = name.starts_with("axl") && (name.contains("hol") || name.contains("ho1"));
    let axle = name.starts_with("axle") && !axle_hole && file.description.starts_with("Technic Axle");
    let wheel_pin = name.starts_with("wpin") && !name.starts_with("wpinhol");
    let (turn, unit_radius, hollow, unit_length) = match turn {
        Some(turn) if cylinder => (turn, 1.0, inverted, 1.0),
        _ if axle => (1.0, 6.0, false, 1.0),
        _ if axle_hole => (1.0, 6.0, true, 1.0),
        _ if wheel_pin => (1.0, 4.0, false, -WHEEL_PIN_LDU),
        _ => return None,
    };
    let y = y * unit_length;
    let axis = y.try_normalize(1e-9)?;
    let upright = x.dot(&axis).abs() < 0.02 * x.norm() && z.dot(&axis).abs() < 0.02 * z.norm();
    let radius = x.norm() * unit_radius;
    let round = equal(x.norm(), z.norm()) && x.dot(&z).abs() < 0.02 * x.norm() * z.norm();
    (upright && round && RADII_LDU.contains(&radius)).then_some(Round {
        form: Form::Cylinder,
        hollow,
        radius,
        start,
        axis,
        length: y.norm(),
        turn,
    })
}

/// Pieces of one surface as one: sectors add up, and lengths on one axis join. What does not go round far enough to
/// hold is left out.
fn merged(pieces: Vec<Round>) -> Vec<Round> {
    let mut surfaces: Vec<(Round, f64)> = vec![];
    'pieces: for piece in pieces {
        // The area, in radii, that a full turn would need is 1 for each unit of length.
        let area = piece.turn * piece.length.max(1e-9);
        for (surface, sum) in &mut surfaces {
            if surface.absorb(&piece) {
                *sum += area;
                continue 'pieces;
            }
        }
        surfaces.push((piece, area));
    }
    let whole = |(round, area): &(Round, f64)| match round.form {
        Form::Cylinder => area / round.length.max(1e-9) >= TURN && round.length > SHARED_LDU,
        Form::Ball => round.turn >= 0.2,
    };
    surfaces.into_iter().filter(whole).map(|(round, _)| round).collect()
}

impl Round {
    /// Grows by a piece of the same surface; false where it is none.
    fn absorb(&mut self, piece: &Self) -> bool {
        let between = piece.start - self.start;
        if self.form != piece.form || self.hollow != piece.hollow || (self.radius - piece.radius).abs() > 0.05 {
            return false;
        }
        if self.form == Form::Ball {
            let same = between.norm() < 0.05;
            self.turn += if same { piece.turn } else { 0.0 };
            return same;
        }
        let along = between.dot(&self.axis);
        let parallel = self.axis.cross(&piece.axis).norm() < 0.01;
        let (near, far) = (along, along + piece.length * piece.axis.dot(&self.axis));
        let (low, high) = (near.min(far), near.max(far));
        if !parallel || (between - self.axis * along).norm() > 0.05 || low > self.length + 0.5 || high < -0.5 {
            return false;
        }
        let (start, end) = (low.min(0.0), high.max(self.length));
        self.start += self.axis * start;
        self.length = end - start;
        true
    }
}
