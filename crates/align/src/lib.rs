//! Where the object is and where the cameras are.
//!
//! A sequence arrives with the phone's poses, which drift by millimetres, and knows nothing of the object. Each stage
//! here reads the sequence and what the stage before wrote, and writes `alignment/alignment.json`
//! ([`mb_capture::Alignment`]):
//!
//! - [`align_keypoints`]: the object's pose from a few clicked points ([`estimate_pose`] for use without files).
//!
//! Every estimate comes with the evidence for it: residuals, which input was left out and why, and a covariance. Input
//! that determines no answer is told apart and explained, never answered with a guess.

mod keypoints;
mod output;
mod pnp;
mod sqpnp;

pub use keypoints::{KeypointOptions, KeypointResidual, KeypointSummary, align_keypoints};
pub use pnp::{Correspondence, PnpError, PnpOptions, PointLayout, PoseEstimate, PosedCamera, estimate_pose};
pub use sqpnp::{Sighting, Solution, solve as sqpnp};
