//! The coordinate frames of the system, as types that exist only at compile time.

/// One camera at one moment: x right, y down, z forward (OpenCV), origin at the centre of projection, metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Camera {}

/// The frame of a sequence's poses (for a phone: the ARKit session's frame, y up), metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum World {}

/// The brick model: y up, `object_from_ldraw = 0.0004 * diag(1, -1, -1)`, metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Object {}

/// LDraw's own frame: -y up, LDraw units (1 LDU = 0.4 mm).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Ldraw {}

/// A calibration board: x to the right, y down along the print, z into the board, metres.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Board {}
