//! Foreign captures become sequences.
//!
//! Each format has a file of its own that turns a folder or archive into a [`Recording`]: a list of frames with cameras
//! in our convention (OpenCV axes, pixel centres at integers), and where their pixels are. What is left (which
//! frames, undistortion, writing) is common to all and lies in `write`. Nothing is dropped in silence: frames that
//! cannot be used are listed with the reason.

pub(crate) mod archive;
mod arkit_json;
mod arkit_scenes;
mod axes;
mod colmap;
mod json;
mod mobilebrick;
mod mvsnet;
mod neus;
mod npy;
mod opensfm;
mod photos;
mod record3d;
mod recording;
mod seven_scenes;
mod staging;
mod stray;
mod transforms;
mod video;
mod write;

use std::path::Path;

use mb_geometry::ImageSize;
use mb_job::{InputError, Progress, Result};
use serde::{Deserialize, Serialize};

use recording::Recording;
pub use recording::SkippedFrame;

/// A kind of capture that can be imported.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CaptureFormat {
    /// The published MobileBrick layout, or a sequence of ours.
    Mobilebrick,
    /// ARKit JSON, as the 3D Scanner App exports it: `frame_NNNNN.json` beside `frame_NNNNN.jpg`.
    ArkitJson,
    /// Stray Scanner: `rgb.mp4`, `odometry.csv`, `depth/`, `confidence/`.
    Stray,
    /// Record3D: an `.r3d` archive, or the folder it unpacks to.
    Record3d,
    /// ARKitScenes: `lowres_wide/`, `lowres_wide.traj`, `lowres_depth/`.
    Arkitscenes,
    /// nerfstudio or instant-ngp: `transforms.json`.
    Nerfstudio,
    /// A COLMAP model, text or binary, with its photographs.
    Colmap,
    /// 7-Scenes and tsdf-fusion-python: `frame-NNNNNN.color.jpg`, `.depth.png`, `.pose.txt`.
    SevenScenes,
    /// NeuS: `cameras_sphere.npz` with photographs and masks by number.
    Neus,
    /// MVSNet: `cams/NNNNNNNN_cam.txt` with photographs by number.
    Mvsnet,
    /// OpenSfM: `reconstruction.json` with its photographs.
    Opensfm,
    /// A folder of photographs, without cameras.
    Photos,
}

impl CaptureFormat {
    /// Every format, in the order in which a source is tried.
    pub const ALL: [Self; 12] = [
        Self::Mobilebrick,
        Self::Record3d,
        Self::Stray,
        Self::ArkitJson,
        Self::Arkitscenes,
        Self::SevenScenes,
        Self::Nerfstudio,
        Self::Colmap,
        Self::Neus,
        Self::Mvsnet,
        Self::Opensfm,
        Self::Photos,
    ];

    /// The name that the command takes.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mobilebrick => "mobilebrick",
            Self::ArkitJson => "arkit-json",
            Self::Stray => "stray",
            Self::Record3d => "record3d",
            Self::Arkitscenes => "arkitscenes",
            Self::Nerfstudio => "nerfstudio",
            Self::Colmap => "colmap",
            Self::SevenScenes => "seven-scenes",
            Self::Neus => "neus",
            Self::Mvsnet => "mvsnet",
            Self::Opensfm => "opensfm",
            Self::Photos => "photos",
        }
    }

    /// The format that a source looks like.
    pub fn detect(source: &Path) -> Option<Self> {
        Self::ALL.into_iter().find(|format| match format {
            Self::Mobilebrick => mobilebrick::looks_like(source),
            Self::ArkitJson => arkit_json::looks_like(source),
            Self::Stray => stray::looks_like(source),
            Self::Record3d => record3d::looks_like(source),
            Self::Arkitscenes => arkit_scenes::looks_like(source),
            Self::Nerfstudio => transforms::looks_like(source),
            Self::Colmap => colmap::looks_like(source),
            Self::SevenScenes => seven_scenes::looks_like(source),
            Self::Neus => neus::looks_like(source),
            Self::Mvsnet => mvsnet::looks_like(source),
            Self::Opensfm => opensfm::looks_like(source),
            Self::Photos => photos::looks_like(source),
        })
    }

    fn read(self, source: &Path) -> Result<Recording> {
        match self {
            Self::Mobilebrick => mobilebrick::read(source),
            Self::ArkitJson => arkit_json::read(source),
            Self::Stray => stray::read(source),
            Self::Record3d => record3d::read(source),
            Self::Arkitscenes => arkit_scenes::read(source),
            Self::Nerfstudio => transforms::read(source),
            Self::Colmap => colmap::read(source),
            Self::SevenScenes => seven_scenes::read(source),
            Self::Neus => neus::read(source),
            Self::Mvsnet => mvsnet::read(source),
            Self::Opensfm => opensfm::read(source),
            Self::Photos => photos::read(source),
        }
    }
}

/// Which frames to import.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ImportOptions {
    /// First and last frame number to take, both included; `None` takes all.
    pub range: Option<(u32, u32)>,
    /// Take every n-th frame of those.
    pub every: usize,
    /// Of those, keep this many: they are divided into that many runs of equal length, and the sharpest photograph of each
    /// is taken. `None` keeps all.
    pub sharpest: Option<usize>,
}

impl Default for ImportOptions {
    fn default() -> Self {
        Self { range: None, every: 1, sharpest: None }
    }
}

/// What an import read, left out and changed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ImportSummary {
    /// The format that was read.
    pub format: CaptureFormat,
    /// Frames that the source names, selected or not.
    pub frames_found: usize,
    /// Frames in the sequence.
    pub frames_imported: usize,
    /// Frames that the options left out; found = imported + not selected + skipped.
    pub frames_not_selected: usize,
    /// Of these, how many have the phone's depth.
    pub frames_with_depth: usize,
    /// Of these, how many have a camera pose.
    pub frames_with_pose: usize,
    /// Of these, how many have a mask of the object.
    pub frames_with_mask: usize,
    /// Frames that cannot be used, with the reason.
    pub frames_skipped: Vec<SkippedFrame>,
    /// Size of the photographs.
    pub image_size: ImageSize,
    /// Photographs whose lens distortion was removed.
    pub undistorted: usize,
    /// Whether lengths are metres; otherwise the scale is arbitrary.
    pub metric: bool,
    /// What was mended or guessed.
    pub warnings: Vec<String>,
}

/// Imports a capture as a sequence folder. `format` is detected where it is `None`.
///
/// # Errors
/// The source is of no known format or damaged (file and place are named), no frame of it can be used, `out` is not
/// empty or cannot be written, or the person asked for a stop.
pub fn import(
    source: &Path,
    format: Option<CaptureFormat>,
    out: &Path,
    options: &ImportOptions,
    progress: &dyn Progress,
) -> Result<ImportSummary> {
    if !source.exists() {
        return Err(InputError::new(source, "no such file or folder").into());
    }
    let format = format.or_else(|| CaptureFormat::detect(source)).ok_or_else(|| {
        let names: Vec<&str> = CaptureFormat::ALL.iter().map(|f| f.name()).collect();
        InputError::new(source, "looks like no capture that can be imported")
            .help(format!("Known formats: {}", names.join(", ")))
    })?;
    let recording = format.read(source)?;
    write::write(recording, source, format, out, options, progress)
}
