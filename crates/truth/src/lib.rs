//! Exact ground truth of an aligned sequence.
//!
//! The model's triangles (`model/mesh.ply`) and the alignment (`alignment/alignment.json`) come in; exact depth, masks,
//! the surface that the cameras saw, the volume that they could judge, and the published layout's own mesh go out.
//! [`truth`] does all of it for a sequence; [`ExactScene`] gives the depth of one frame without the rounding of files;
//! [`perturbed_pose_study`] says what errors of the cameras alone would do to a reconstruction.
//!
//! Everything is as exact as the alignment: this crate reads the file and does not know how it was found. Limits: the
//! scene is the model alone, so a table or a hand that hides part of it is not in the truth.

mod exact_scene;
mod pose_study;
mod truth;
pub mod visibility;
mod visible_surface;

pub use exact_scene::ExactScene;
pub use pose_study::{PoseStudy, PoseStudyOptions, common_motion, perturbed_pose_study};
pub use truth::{TruthOptions, TruthSummary, truth};
