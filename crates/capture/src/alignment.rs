//! `alignment/alignment.json`: where the object and the cameras are, as some stage of alignment found them.
//!
//! The same document lies in `simulation/` of a simulated sequence, with the truth.

use mb_geometry::{Camera, Object, Rigid3, World};
use mb_job::Result;
use serde::{Deserialize, Serialize};

use crate::FrameId;
use crate::sequence::{read_json, write_json};

/// Which computation an alignment comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlignmentStage {
    /// PnP on clicked keypoints: the object's pose; cameras as the phone gave them.
    Keypoints,
    /// Contour refinement: the object's pose, and the drift of every camera as far as the edges show it.
    Refine,
    /// Bundle adjustment: the object's pose and every camera.
    Bundle,
    /// The simulator's truth.
    Truth,
}

/// The result of alignment: the object's pose in the sequence's world, and the cameras that go with it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Alignment {
    /// Version of this document, 1.
    pub version: u32,
    /// Where it comes from.
    pub stage: AlignmentStage,
    /// Pose of the object.
    pub world_from_object: Rigid3<World, Object>,
    /// Covariance of the object's pose, left perturbation in the world frame, order `[rotation; translation]`
    /// (rad, m), row-major; `None` where unknown.
    #[serde(default)]
    pub object_covariance: Option<[[f64; 6]; 6]>,
    /// Root mean square residual of the stage, in pixels; `None` where there is none.
    #[serde(default)]
    pub rms_px: Option<f64>,
    /// Cameras, in frame order. Frames that are absent keep the pose in `pose/`.
    #[serde(default)]
    pub frames: Vec<FrameAlignment>,
}

/// One camera of an [`Alignment`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameAlignment {
    /// Which frame.
    pub frame: FrameId,
    /// Its pose.
    pub world_from_cam: Rigid3<World, Camera>,
    /// Covariance of the pose, left perturbation in the world frame, `[rotation; translation]` (rad, m), row-major.
    #[serde(default)]
    pub covariance: Option<[[f64; 6]; 6]>,
    /// Root mean square residual in this frame, pixels.
    #[serde(default)]
    pub rms_px: Option<f64>,
}

impl Alignment {
    /// Where the alignment lies inside a sequence folder.
    pub const FILE: &'static str = "alignment/alignment.json";

    /// Reads an alignment file.
    ///
    /// # Errors
    /// The file is missing or malformed; line and column are named.
    pub fn read(path: impl AsRef<std::path::Path>) -> Result<Self> {
        read_json(path.as_ref())
    }

    /// Writes an alignment file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, path: impl AsRef<std::path::Path>) -> Result<()> {
        write_json(path.as_ref(), self)
    }
}
