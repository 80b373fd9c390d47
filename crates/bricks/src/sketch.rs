//! LDraw models written by code, on the grid of studs and plates.

use std::fmt::Write as _;

/// Stud pitch, LDraw units.
pub(crate) const PITCH_LDU: f64 = 20.0;
/// Height of a plate, LDraw units.
pub(crate) const PLATE_LDU: f64 = 8.0;

/// An LDraw model under construction.
pub(crate) struct Sketch {
    text: String,
}

impl Sketch {
    /// An empty model with its description.
    pub fn new(description: &str) -> Self {
        Self { text: format!("0 {description}\n0 !LDRAW_ORG Unofficial_Model\n") }
    }

    /// Places a part: its origin at `[x, z]` studs, its top `top` plates above the ground, turned by quarter turns
    /// about the vertical (one turn takes its front, -z, to -x).
    pub fn put(&mut self, part: &str, color: u32, [x, z]: [f64; 2], top: i32, quarter_turns: i32) -> &mut Self {
        let (x, y, z) = (x * PITCH_LDU, -f64::from(top) * PLATE_LDU, z * PITCH_LDU);
        let (cos, sin) = match quarter_turns.rem_euclid(4) {
            0 => (1, 0),
            1 => (0, 1),
            2 => (-1, 0),
            _ => (0, -1),
        };
        let _ = writeln!(self.text, "1 {color} {x} {y} {z} {cos} 0 {sin} 0 1 0 {} 0 {cos} {part}.dat", -sin);
        self
    }

    /// Ends a building step.
    pub fn step(&mut self) -> &mut Self {
        self.text.push_str("0 STEP\n");
        self
    }

    /// The model as text.
    pub fn finish(self) -> String {
        self.text
    }
}
