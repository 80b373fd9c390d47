//! Record3D: an `.r3d` archive (a zip) with `metadata` and `rgbd/N.jpg`, `rgbd/N.depth`, `rgbd/N.conf`; the folder that it
//! unpacks to; or the "EXR + JPG" export, a folder with `metadata.json`, `rgb/N.jpg` and `depth/N.exr`.
//!
//! `K` is column-major; newer files have `perFrameIntrinsicCoeffs` (fx fy cx cy). Poses are qx qy qz qw tx ty tz,
//! camera-to-world with OpenGL camera axes of the photograph, which is portrait. Depth is LZFSE-compressed f32 metres, or
//! half or single floats in an OpenEXR channel.

use std::path::Path;
use std::sync::Arc;

use mb_geometry::{ImageSize, Intrinsics};
use mb_job::{InputError, Result};
use nalgebra::{Quaternion, Translation3, UnitQuaternion};
use serde_json::Value;

use crate::FrameId;
use crate::lens::{Distortion, Lens};

use super::archive::Archive;
use super::recording::{Depth, DepthSize, Photo, RecordedFrame, Recording};
use super::{axes, json};

/// Where the app puts its description: in `.r3d`, and in the EXR export.
const DESCRIPTIONS: [&str; 2] = ["metadata", "metadata.json"];

/// The source itself, or the folder `EXR_RGBD` that the export makes in it.
fn root(source: &Path) -> std::path::PathBuf {
    let inner = source.join("EXR_RGBD");
    if inner.is_dir() { inner } else { source.to_owned() }
}

fn description(archive: &Archive) -> Option<&'static str> {
    DESCRIPTIONS.into_iter().find(|name| archive.contains(name))
}

pub(super) fn looks_like(source: &Path) -> bool {
    let Ok(archive) = Archive::open(&root(source)) else { return false };
    let Some(name) = description(&archive) else { return false };
    // Many programs write a metadata.json.
    let has_keys = |value: Value| value.get("poses").is_some() && value.get("K").is_some();
    name == "metadata" || archive.read(name).is_ok_and(|b| serde_json::from_slice(&b).is_ok_and(has_keys))
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let source = &root(source);
    let archive = Arc::new(Archive::open(source)?);
    let Some(place) = description(&archive) else {
        return Err(InputError::new(source, "has no 'metadata'")
            .help("Share the recording from Record3D as '.r3d', or export it as 'EXR + JPG sequence'")
            .into());
    };
    let metadata: Value =
        serde_json::from_slice(&archive.read(place)?).map_err(|e| InputError::new(source, e.to_string()).at(place))?;
    let bad = |found: String| InputError::new(source, found).at(place);
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
    // Older files do not state the size of their depth maps (LiDAR 192x256, front camera 480x640).
    let depth_size = match (dimension("dw"), dimension("dh")) {
        (Some(w), Some(h)) => DepthSize::Stated(ImageSize::new(w, h)),
        _ => DepthSize::LikePhoto(size),
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
        let photo = [("rgbd", "jpg"), ("rgbd", "png"), ("rgb", "jpg"), ("rgb", "png")]
            .map(|(folder, extension)| format!("{folder}/{i}.{extension}"))
            .into_iter()
            .find(|name| archive.contains(name));
        let Some(photo) = photo else {
            recording.skip(i.to_string(), "there is no photograph of it in rgbd/ or rgb/");
            continue;
        };
        let (depth, confidence, exr) = (format!("rgbd/{i}.depth"), format!("rgbd/{i}.conf"), format!("depth/{i}.exr"));
        let depth = if archive.contains(&depth) {
            let confidence = archive.contains(&confidence).then_some(confidence);
            Some(Depth::Lzfse { archive: archive.clone(), depth, confidence, size: depth_size })
        } else {
            archive.contains(&exr).then(|| Depth::Exr(archive.clone(), exr))
        };
        recording.frames.push(RecordedFrame {
            id: FrameId(i as u32),
            photo: Some(Photo::Entry(archive.clone(), photo)),
            lens: Some(Lens { intrinsics, distortion: Distortion::None }),
            lens_size: Some(size),
            world_from_cam: Some(world_from_cam),
            depth,
            mask: None,
            time_s: times.and_then(|t| t.get(i)?.as_f64()).or(fps.map(|fps| i as f64 / fps)),
        });
    }
    Ok(recording)
}
