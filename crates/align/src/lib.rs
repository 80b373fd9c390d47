//! Where the object is and where the cameras are.
//!
//! A sequence arrives with the phone's poses, which drift by millimetres, and knows nothing of the object. Each stage
//! here reads the sequence and what the stage before wrote, and writes `alignment/alignment.json`
//! ([`mb_capture::Alignment`]):
//!
//! - [`align_keypoints`]: the object's pose from a few clicked points ([`estimate_pose`] for use without files).
//! - [`align_refine`]: the object's pose and each photograph's drift, from the model's edges in the photographs.
//! - [`align_bundle`]: every camera, from features on the model and beside it, the model's edges, and the phone's poses.
//!
//! [`align_board`] gives reference cameras from a calibration board in view, to measure all of these against.
//!
//! [`detect_features`] and [`match_features`] are of use on their own. Every estimate comes with the evidence for it: residuals, which input was left out and why, and a covariance. Input
//! that determines no answer is told apart and explained, never answered with a guess.

mod adjust;
mod board;
mod bundle;
mod contour;
mod features;
mod keypoints;
mod matching;
mod model_edges;
mod model_scale;
mod outcome;
mod output;
mod pnp;
mod pnp_problem;
mod profile;
mod refine;
mod scale_space;
mod sqpnp;
mod tracks;

pub use adjust::{AdjustedCamera, AdjustedPoint, Adjustment, CameraTerm, PointObservation};
pub use board::{
    BoardFrame, BoardOptions, BoardOutcome, BoardSummary, CalibratedPhoto, CalibrationSummary, PhotoCalibration,
    align_board, calibrate_photos,
};
pub use bundle::{BundleOptions, BundleSummary, BundledFrame, Dropped, align_bundle};
pub use features::{Feature, FeatureOptions, detect_features};
pub use keypoints::{KeypointOptions, KeypointResidual, KeypointSummary, align_keypoints};
pub use matching::{MatchOptions, match_features};
pub use outcome::FrameOutcome;
pub use pnp::{Correspondence, PnpError, PnpOptions, PointLayout, PoseEstimate, PosedCamera, estimate_pose};
pub use refine::{RefineOptions, RefineSummary, RefinedFrame, align_refine};
pub use sqpnp::{Sighting, Solution, solve as sqpnp};
