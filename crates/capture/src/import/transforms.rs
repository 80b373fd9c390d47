//! nerfstudio and instant-ngp: `transforms.json`.
//!
//! `transform_matrix` is camera-to-world with OpenGL camera axes; the scale is arbitrary. Pixel coordinates have the
//! corner of the image at (0, 0). Intrinsics and distortion stand at the top, and each frame may override them. Files list frames
//! that do not exist; those are left out.

use std::path::{Path, PathBuf};

use mb_geometry::{ImageSize, Intrinsics};
use mb_job::{InputError, Result};
use serde_json::Value;

use crate::lens::{Distortion, Lens};

use super::recording::{Depth, Photo, RecordedFrame, Recording, frame_ids};
use super::{axes, json};

fn find(source: &Path) -> Option<PathBuf> {
    let path = if source.is_dir() { source.join("transforms.json") } else { source.to_owned() };
    (path.is_file() && path.extension().is_some_and(|e| e == "json")).then_some(path)
}

pub(super) fn looks_like(source: &Path) -> bool {
    find(source).is_some_and(|path| json::read(&path).is_ok_and(|value| value.get("frames").is_some()))
}

/// The file that a frame names; Blender's files leave the extension out.
fn photo_path(folder: &Path, file_path: &str) -> Option<PathBuf> {
    let path = folder.join(file_path);
    let with = |extension: &str| folder.join(format!("{file_path}.{extension}"));
    [path, with("png"), with("jpg"), with("jpeg")].into_iter().find(|p| p.is_file())
}

/// The lens of a frame, its own keys before those at the top of the file.
fn lens(top: &Value, frame: &Value, size: ImageSize) -> std::result::Result<Lens, String> {
    let key = |name: &str| json::number(frame, name).or_else(|| json::number(top, name));
    let (width, height) = (size.width as f64, size.height as f64);
    let from_angle = |angle: Option<f64>, extent: f64| angle.map(|a| 0.5 * extent / (0.5 * a).tan());
    let fx = key("fl_x").or_else(|| from_angle(key("camera_angle_x"), width));
    let fy = key("fl_y").or_else(|| from_angle(key("camera_angle_y"), height)).or(fx);
    let (Some(fx), Some(fy)) = (fx, fy) else {
        return Err("neither 'fl_x' nor 'camera_angle_x' is given".to_owned());
    };
    if !(fx > 0.0 && fy > 0.0 && fx.is_finite() && fy.is_finite()) {
        return Err(format!("the focal lengths are {fx} and {fy}, both must be above 0"));
    }
    let (cx, cy) = (key("cx").unwrap_or(width / 2.0) - 0.5, key("cy").unwrap_or(height / 2.0) - 0.5);
    let model =
        frame.get("camera_model").or_else(|| top.get("camera_model")).and_then(Value::as_str).unwrap_or("OPENCV");
    let coefficient = |name: &str| key(name).unwrap_or(0.0);
    let [k1, k2, k3, k4] = ["k1", "k2", "k3", "k4"].map(coefficient);
    let [p1, p2] = ["p1", "p2"].map(coefficient);
    let distortion = match model {
        "OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" => {
            if k4 != 0.0 {
                return Err("'k4' of a camera model that is no fisheye is not known here".to_owned());
            }
            Distortion::Radial { k: [k1, k2, k3, 0.0, 0.0, 0.0], p: [p1, p2] }
        }
        "OPENCV_FISHEYE" => Distortion::Fisheye { k: [k1, k2, k3, k4], p: [0.0; 2], s: [0.0; 2] },
        other => return Err(format!("camera_model '{other}' cannot be undistorted to a pinhole here")),
    };
    Ok(Lens { intrinsics: Intrinsics { fx, fy, cx, cy }, distortion })
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let path = find(source).ok_or_else(|| InputError::new(source, "no transforms.json found"))?;
    let top = json::read(&path)?;
    let folder = path.parent().unwrap_or_else(|| Path::new("."));
    let frames = top
        .get("frames")
        .and_then(Value::as_array)
        .ok_or_else(|| InputError::new(&path, "missing, or no array").at("key 'frames'"))?;
    let names: Vec<String> = frames
        .iter()
        .map(|frame| frame.get("file_path").and_then(Value::as_str).unwrap_or_default().to_owned())
        .collect();
    let ids = frame_ids(&names);
    let mut recording = Recording::new("photographs with transforms.json", false);
    for ((frame, name), id) in frames.iter().zip(&names).zip(ids) {
        let place = || format!("frame '{name}'");
        let matrix = frame.get("transform_matrix").and_then(json::matrix4);
        let Some((world_from_cam, defect)) = matrix.as_ref().and_then(axes::from_opengl) else {
            return Err(InputError::new(
                &path,
                "transform_matrix is missing, or not a rigid 4x4 camera-to-world transform",
            )
            .at(place())
            .into());
        };
        if !defect.is_within(1e-4) {
            recording
                .warnings
                .push(format!("{name}: rotation re-orthonormalised (determinant {:.5})", defect.determinant));
        }
        let Some(photo) = photo_path(folder, name) else {
            recording.skip(name.clone(), "the photograph does not exist");
            continue;
        };
        let number = |key: &str| json::number(frame, key).or_else(|| json::number(&top, key));
        let size = match (number("w"), number("h")) {
            (Some(w), Some(h)) if w >= 1.0 && h >= 1.0 && w < 1e5 && h < 1e5 => ImageSize::new(w as usize, h as usize),
            _ => mb_image::read_size(&photo)?,
        };
        let lens = lens(&top, frame, size).map_err(|found| InputError::new(&path, found).at(place()))?;
        let png = |key: &str| {
            let path = folder.join(frame.get(key).and_then(Value::as_str)?);
            (path.extension().is_some_and(|e| e == "png") && path.is_file()).then_some(path)
        };
        recording.frames.push(RecordedFrame {
            id,
            photo: Some(Photo::File(photo)),
            lens: Some(lens),
            lens_size: Some(size),
            world_from_cam: Some(world_from_cam),
            depth: png("depth_file_path").map(|depth| Depth::Png(depth, None)),
            mask: png("mask_path"),
            time_s: None,
        });
    }
    recording.frames.sort_by_key(|f| f.id);
    Ok(recording)
}
