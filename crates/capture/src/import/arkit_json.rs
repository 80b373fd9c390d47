//! ARKit JSON, as the 3D Scanner App exports it: `frame_NNNNN.json` beside `frame_NNNNN.jpg`, and for some frames
//! `depth_NNNNN.png` and `conf_NNNNN.png`.
//!
//! `cameraPoseARFrame` is the row-major camera-to-world matrix with ARKit's camera axes; `intrinsics` the row-major 3x3
//! matrix of the landscape photograph. More frames have JSON than photographs.

use std::path::{Path, PathBuf};

use mb_geometry::Intrinsics;
use mb_job::{InputError, Result};
use nalgebra::{Matrix3, Matrix4};

use crate::FrameId;
use crate::lens::{Distortion, Lens};

use super::recording::{Depth, Photo, RecordedFrame, Recording};
use super::{axes, json};

/// `frame_NNNNN.json` of the folder with their numbers, ascending.
fn frame_files(source: &Path) -> Vec<(u32, String, PathBuf)> {
    let Ok(entries) = std::fs::read_dir(source) else { return Vec::new() };
    let mut files: Vec<_> = entries
        .flatten()
        .filter_map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            let digits = name.strip_prefix("frame_")?.strip_suffix(".json")?.to_owned();
            Some((digits.parse().ok()?, digits, entry.path()))
        })
        .collect();
    files.sort();
    files
}

pub(super) fn looks_like(source: &Path) -> bool {
    frame_files(source)
        .iter()
        .take(8)
        .any(|(_, _, path)| json::read(path).is_ok_and(|value| value.get("cameraPoseARFrame").is_some()))
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let files = frame_files(source);
    if files.is_empty() {
        return Err(InputError::new(source, "no frame_NNNNN.json found")
            .help("Export from the 3D Scanner App as 'All data'")
            .into());
    }
    let mut recording = Recording::new("iPhone (ARKit JSON)", true);
    let mut without_photo = 0;
    for (number, digits, path) in files {
        let photo = ["jpg", "jpeg", "png"]
            .map(|extension| source.join(format!("frame_{digits}.{extension}")))
            .into_iter()
            .find(|p| p.exists());
        let Some(photo) = photo else {
            without_photo += 1;
            continue;
        };
        let value = json::read(&path)?;
        let pose = json::numbers(&value, "cameraPoseARFrame", 16, &path)?;
        let k = json::numbers(&value, "intrinsics", 9, &path)?;
        let (world_from_cam, _) = axes::from_opengl(&Matrix4::from_row_slice(&pose)).ok_or_else(|| {
            InputError::new(&path, "is not a rigid transform, row-major with the translation in the last column")
                .at("key 'cameraPoseARFrame'")
        })?;
        let intrinsics = Intrinsics::from_matrix(&Matrix3::from_row_slice(&k))
            .map_err(|e| InputError::new(&path, e.to_string()).at("key 'intrinsics'"))?;
        let (depth, confidence) =
            (source.join(format!("depth_{digits}.png")), source.join(format!("conf_{digits}.png")));
        recording.frames.push(RecordedFrame {
            id: FrameId(number),
            photo: Some(Photo::File(photo)),
            lens: Some(Lens { intrinsics, distortion: Distortion::None }),
            lens_size: None,
            world_from_cam: Some(world_from_cam),
            depth: depth.exists().then(|| Depth::Png(depth, confidence.exists().then_some(confidence))),
            mask: None,
            time_s: json::number(&value, "time"),
        });
    }
    if without_photo > 0 {
        recording.warnings.push(format!("{without_photo} frames have a pose but no photograph; left out"));
    }
    Ok(recording)
}
