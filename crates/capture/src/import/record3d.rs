//! Record3D: an `.r3d` archive (a zip) with `metadata` and `rgbd/N.jpg`, `rgbd/N.depth`, `rgbd/N.conf`.
//!
//! `K` is column-major; newer files have `perFrameIntrinsicCoeffs` (fx fy cx cy). Poses are qx qy qz qw tx ty tz,
//! camera-to-world with OpenGL camera axes of the portrait photograph. Depth is LZFSE-compressed f32 metres.

use std::path::Path;
use std::sync::Arc;

use mb_geometry::{ImageSize, Intrinsics};
use mb_job::{InputError, Result};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use serde_json::Value;

use crate::FrameId;
use crate::lens::{Distortion, Lens};

use super::archive::Archive;
use super::recording::{Depth, Photo, RecordedFrame, Recording};
use super::{axes, json};

pub(super) fn looks_like(source: &Path) -> bool {
    source.is_file() && Archive::open(source).is_ok_and(|archive| archive.contains("metadata"))
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let archive = Arc::new(Archive::open(source)?);
    if !archive.contains("metadata") {
        return Err(InputError::new(source, "the archive has no entry 'metadata'")
            .help("Share the recording from Record3D as '.r3d'")
            .into());
    }
    let metadata: Value = serde_json::from_slice(&archive.read("metadata")?)
        .map_err(|e| InputError::new(source, e.to_string()).at("metadata"))?;
    let bad = |found: String| InputError::new(source, found).at("metadata");
    let dimension =
        |key: &str| json::number(&metadata, key).filter(|v| *v >= 1.0 && *v <= 20_000.0).map(|v| v as usize);
    let size = match (dimension("w"), dimension("h")) {
        (Some(w), Some(h)) => ImageSize::new(w, h),
        _ => return Err(bad("'w' and 'h' must be the photograph's size".to_owned()).into()),
    };
    let k = json::numbers(&metadata, "K", 9, source)?;
    let shared = Intrinsics { fx: k[0], fy: k[4], cx: k[6], cy: k[7] };
    let per_frame = metadata.get("perFrameIntrinsicCoeffs").and_then(Value::as_array);
    let times = metadata.get("frameTimestamps").and_then(Value::as_array);
    let fps = json::number(&metadata, "fps").filter(|v| *v > 0.0);
    let poses = metadata
        .get("poses")
        .and_then(Value::as_array)
        .ok_or_else(|| bad("'poses' is missing; this recording has no camera path".to_owned()))?;
    // Older files do not state the size of their depth maps, which was 192x256.
    let depth_size = match (dimension("dw"), dimension("dh")) {
        (Some(w), Some(h)) => ImageSize::new(w, h),
        _ => ImageSize::new(192, 256),
    };

    let mut recording = Recording::new("iPhone (Record3D)", true);
    for (i, pose) in poses.iter().enumerate() {
        let numbers: Option<Vec<f64>> = pose.as_array().and_then(|p| p.iter().map(Value::as_f64).collect());
        let Some([qx, qy, qz, qw, tx, ty, tz]) = numbers.as_deref().and_then(|n| <[f64; 7]>::try_from(n).ok()) else {
            return Err(bad(format!("pose {i} is not 7 numbers")).into());
        };
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        if (quaternion.norm() - 1.0).abs() > 0.01 {
            recording.skip(i.to_string(), format!("its quaternion has norm {:.4}, not 1", quaternion.norm()));
            continue;
        }
        let matrix = (Translation3::new(tx, ty, tz) * UnitQuaternion::from_quaternion(quaternion)).to_homogeneous();
        let Some((world_from_cam, _)) = axes::from_opengl(&matrix) else {
            recording.skip(i.to_string(), "its pose is not finite");
            continue;
        };
        let own: Option<Vec<f64>> =
            per_frame.and_then(|list| list.get(i)?.as_array()?.iter().map(Value::as_f64).collect());
        let intrinsics = match own.as_deref() {
            Some(&[fx, fy, cx, cy]) => Intrinsics { fx, fy, cx, cy },
            _ => shared,
        };
        if !(intrinsics.fx > 0.0 && intrinsics.fy > 0.0) {
            return Err(bad(format!("frame {i}: a focal length is not above 0")).into());
        }
        let photo = ["jpg", "png"].map(|e| format!("rgbd/{i}.{e}")).into_iter().find(|name| archive.contains(name));
        let Some(photo) = photo else {
            recording.skip(i.to_string(), "rgbd/ has no photograph of it");
            continue;
        };
        let (depth, confidence) = (format!("rgbd/{i}.depth"), format!("rgbd/{i}.conf"));
        recording.frames.push(RecordedFrame {
            id: FrameId(i as u32),
            photo: Some(Photo::Entry(archive.clone(), photo)),
            lens: Some(Lens { intrinsics, distortion: Distortion::None }),
            lens_size: Some(size),
            world_from_cam: Some(world_from_cam),
            depth: archive.contains(&depth).then(|| Depth::Lzfse {
                archive: archive.clone(),
                confidence: archive.contains(&confidence).then_some(confidence),
                depth,
                size: depth_size,
            }),
            time_s: times.and_then(|t| t.get(i)?.as_f64()).or(fps.map(|fps| i as f64 / fps)),
        });
    }
    Ok(recording)
}
