//! Sequences on disk: the published MobileBrick layout and what this project adds beside it.
//!
//! [`Sequence::open`] reads the index of a sequence folder (frames, poses, intrinsics) and checks it; images and depth
//! are read frame by frame through its methods, so memory stays bounded whatever the frame count. All cameras that
//! leave this crate are OpenCV-style and metric (`docs/formats.md` has the layout file by file).

mod alignment;
mod check;
mod colmap_model;
mod export;
mod import;
mod keypoints;
mod lens;
mod manifest;
mod matrix_txt;
mod neus_cameras;
mod photo_quality;
pub mod pickle;
mod pose_folder;
mod sequence;
mod visibility;

pub use alignment::{Alignment, AlignmentStage, FrameAlignment};
pub use check::{
    CheckOptions, CheckSummary, HashCheck, Misreading, PhotoCheck, Problem, RotationCheck, check, check_pairs,
};
pub use export::{ExportFormat, ExportSummary, export};
pub use import::{CaptureFormat, ImportOptions, ImportSummary, SkippedFrame, import};
pub use keypoints::{Keypoint, Keypoints};
pub use lens::{Distortion, Lens};
pub use matrix_txt::{read_intrinsics_txt, read_pose_txt, write_intrinsics_txt, write_pose_txt};
pub use neus_cameras::{ObjectSphere, read_neus_sphere, write_neus_cameras};
pub use pose_folder::PoseFolder;
pub use sequence::{Frame, FrameId, Sequence, SequenceMeta};
pub use visibility::VisibilityVolume;
