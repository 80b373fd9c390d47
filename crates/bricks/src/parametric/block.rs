//! Bricks, plates and tiles on a rectangular footprint.
//!
//! Dimensions are LDraw's nominal ones: pitch 20 units (8 mm), walls 4 units, studs 12 across and 4 high (4.8 and
//! 1.6 mm), tubes 16 and 12 across, pins 8 across.

use nalgebra::{Point3, Vector3};

use super::columns::{Columns, circle, rectangle};
use crate::ldraw::file::StudSite;

/// Stud pitch.
pub(crate) const PITCH: f64 = 20.0;
/// Height of a brick's body.
pub(crate) const BRICK: f64 = 24.0;
/// Height of a plate's body.
pub(crate) const PLATE: f64 = 8.0;
/// Thickness of side walls and of the top.
pub(crate) const WALL: f64 = 4.0;
/// Radius of a stud.
pub(crate) const STUD_RADIUS: f64 = 6.0;
/// Height of a stud.
pub(crate) const STUD_HEIGHT: f64 = 4.0;
/// Outer radius of a tube.
pub(crate) const TUBE_RADIUS: f64 = 8.0;
/// Radius of a pin, and of the hole in a hollow stud.
pub(crate) const PIN_RADIUS: f64 = 4.0;
/// How far solids that are to become one reach into each other.
pub(crate) const OVERLAP: f64 = 1.0;

/// A rectangular footprint of `length` (along x) by `width` (along z) studs, centred on the origin.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Footprint {
    pub length: usize,
    pub width: usize,
}

impl Footprint {
    pub fn half_x(&self) -> f64 {
        0.5 * PITCH * self.length as f64
    }

    pub fn half_z(&self) -> f64 {
        0.5 * PITCH * self.width as f64
    }

    /// The footprint as a rectangle whose sides stand back by `inset`.
    pub fn outline(&self, inset: f64) -> Vec<[f64; 2]> {
        let (x, z) = (self.half_x() - inset, self.half_z() - inset);
        rectangle([-x, x], [-z, z])
    }

    /// Centres of the grid's squares: where studs stand.
    pub fn squares(&self) -> Vec<[f64; 2]> {
        let at = |i: usize, half: f64| (i as f64 + 0.5) * PITCH - half;
        (0..self.width)
            .flat_map(|j| (0..self.length).map(move |i| (i, j)))
            .map(|(i, j)| [at(i, self.half_x()), at(j, self.half_z())])
            .collect()
    }

    /// Corners between four squares, or sides between two where the footprint is one wide: where tubes or pins stand.
    pub fn between(&self) -> Vec<[f64; 2]> {
        let line = |n: usize, half: f64| -> Vec<f64> {
            if n == 1 { vec![0.0] } else { (1..n).map(|i| i as f64 * PITCH - half).collect() }
        };
        if self.length == 1 && self.width == 1 {
            return vec![];
        }
        let xs = line(self.length, self.half_x());
        line(self.width, self.half_z()).into_iter().flat_map(|z| xs.iter().map(move |&x| [x, z])).collect()
    }

    fn is_narrow(&self) -> bool {
        self.length == 1 || self.width == 1
    }
}

/// Fills the body and hollows it from below, with tubes or pins.
pub(crate) fn hollow_body(solid: &mut Columns, footprint: Footprint, height: f64) {
    solid.fill(footprint.outline(0.0), [0.0, height]);
    hollow(solid, footprint, height);
}

/// Hollows a body from below, and sets tubes or pins into the hollow.
pub(crate) fn hollow(solid: &mut Columns, footprint: Footprint, height: f64) {
    solid.empty(footprint.outline(WALL), [WALL, height + OVERLAP]);
    for center in footprint.between() {
        if footprint.is_narrow() {
            solid.post(circle(center, PIN_RADIUS), height);
        } else {
            tube(solid, center, height);
        }
    }
}

/// A tube from the ceiling of a hollow down to `bottom`.
pub(crate) fn tube(solid: &mut Columns, center: [f64; 2], bottom: f64) {
    solid.tube(circle(center, TUBE_RADIUS), circle(center, STUD_RADIUS), bottom);
}

/// A stud with a round hole from its top down to the height `floor`.
pub(crate) fn hollow_stud(solid: &mut Columns, center: [f64; 2], y: f64, floor: f64) {
    stud(solid, center, y);
    solid.empty(circle(center, PIN_RADIUS), [y - STUD_HEIGHT - OVERLAP, floor]);
}

/// A stud on the top at height `y`.
pub(crate) fn stud(solid: &mut Columns, center: [f64; 2], y: f64) {
    solid.fill(circle(center, STUD_RADIUS), [y - STUD_HEIGHT, y + OVERLAP]);
    let foot = Point3::new(center[0], y, center[1]);
    solid.studs.push(StudSite { foot, axis: -Vector3::y() });
}

/// A brick or plate with a stud on every square.
pub(crate) fn studded(footprint: Footprint, height: f64) -> Columns {
    let mut solid = Columns::default();
    hollow_body(&mut solid, footprint, height);
    footprint.squares().into_iter().for_each(|center| stud(&mut solid, center, 0.0));
    solid
}

/// A smooth plate; with `groove`, its bottom unit stands back by one on all sides, so that a nail can lift it.
pub(crate) fn tile(footprint: Footprint, groove: bool) -> Columns {
    let mut solid = Columns::default();
    let groove_height = if groove { 1.0 } else { 0.0 };
    solid.fill(footprint.outline(0.0), [0.0, PLATE - groove_height]);
    if groove {
        solid.fill(footprint.outline(1.0), [PLATE - groove_height - OVERLAP, PLATE]);
    }
    if groove && footprint.length * footprint.width == 2 {
        // The official 1 x 2 tile has no pin.
        solid.empty(footprint.outline(WALL), [WALL, PLATE + OVERLAP]);
    } else {
        hollow(&mut solid, footprint, PLATE);
    }
    solid
}
