//! A phone in software: a brick model goes in, and a capture of it comes out, as a phone would have made it.
//!
//! [`simulate`] sets the model on a textured table, walks round it with a hand-held phone, and writes a sequence
//! folder with photographs, LiDAR-like depth with confidence, intrinsics that breathe, poses that drift, and the
//! points that an annotator would have clicked. What only a simulator knows (the true poses and the object's pose)
//! lies apart, in `simulation/`, so that methods and alignments can be measured against it.
//!
//! - Sizes of errors are the phone's: poses as in the paper's table ([`DriftOptions`]), depth from a few hundred laser
//!   dots that no stud survives, 2 px clicks.
//! - Photographs come in three efforts ([`Quality`]); geometry is the same in all.
//! - The same options and model give the same bytes, whatever the number of threads. One frame is in memory at a
//!   time, and a stopped run is taken up where it ended.
//!
//! Limits: one static, opaque, plastic model. Lens distortion and rolling shutter are off unless asked for: the phone's
//! software removes the first, and the paper's captures are slow enough for the second.

mod board;
mod clicks;
mod develop;
mod drift;
mod lens;
mod lidar;
mod light;
mod options;
mod orbit;
mod photo;
mod plastic;
mod probes;
mod random;
mod sequence;
mod stage;
mod statistics;
mod texture;
mod walk;

pub use options::{DriftOptions, LensOptions, Quality, SimulateOptions, Table};
pub use sequence::{SimulateSummary, simulate};
pub use statistics::PhotoStatistics;
pub use walk::Walk;

/// Streams of random numbers, one for each thing that is random. Those of frames begin at multiples of 2^32.
mod streams {
    pub const ORBIT: u64 = 1;
    pub const DRIFT: u64 = 2;
    pub const STAGE: u64 = 3;
    pub const LIGHT: u64 = 4;
    pub const TABLE: u64 = 5;
    pub const PLACE: u64 = 6;
    pub const EXPOSURE: u64 = 7;
    pub const PHOTO: u64 = 8;
    pub const BOARD: u64 = 10;
    /// Under seeds of its own: the draws that the drift is calibrated on are the same for every sequence.
    pub const CALIBRATION: u64 = 9;
    pub const CLICKS: u64 = 1 << 32;
    pub const LIDAR: u64 = 2 << 32;
}
