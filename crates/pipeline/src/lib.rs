//! Whole jobs over the crates below: a model becomes a capture, a sequence becomes a report, and the demo runs every
//! stage after the other.
//!
//! Each stage reads and writes documented files, so any of them can be rerun or replaced alone; this crate only
//! puts them in order.

mod board_sequences;
mod board_study;
mod capture_check;
mod contact_sheet;
mod demo;
mod frame_pictures;
mod leaderboard;
mod model_capture;
mod perturbed_poses;
mod pictures;
mod report;
mod scene_report;

pub use board_sequences::{BoardSequences, simulate_board_sequences};
pub use board_study::{BoardStudy, BoardStudyOptions, StudiedPoses, StudiedSequence, board_study};
pub use capture_check::{
    CaptureCheck, CaptureCheckOptions, EpipolarCheck, EpipolarOptions, EpipolarPair, check_capture, check_report,
};
pub use contact_sheet::contact_sheet;
pub use demo::{DemoOptions, DemoSummary, demo};
pub use leaderboard::{LeaderboardOptions, LeaderboardSummary, leaderboard};
pub use model_capture::{ModelCapture, simulate_model};
pub use perturbed_poses::{PerturbedModel, PerturbedPoses, PerturbedPosesOptions, perturbed_poses};
pub use report::{ColorScale, Curves, Drawings, Gallery, Picture, Report, Stage, Table};
pub use scene_report::{Scored, scene_report};
