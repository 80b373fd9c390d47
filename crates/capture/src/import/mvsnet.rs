//! MVSNet: `cams/NNNNNNNN_cam.txt` (`extrinsic`, 4x4 world-to-camera; `intrinsic`, 3x3) and `images/NNNNNNNN.jpg`.
//!
//! Pixel centres are at integers. The scale is arbitrary.

use std::path::{Path, PathBuf};

use mb_geometry::{Camera, Intrinsics, Rigid3, World};
use mb_job::{InputError, Result};
use nalgebra::{Matrix3, Matrix4};

use crate::FrameId;
use crate::lens::{Distortion, Lens};

use super::recording::{Photo, RecordedFrame, Recording};

/// `cams/NNNNNNNN_cam.txt` with their digits, ascending.
fn camera_files(source: &Path) -> Vec<(u32, String, PathBuf)> {
    let Ok(entries) = std::fs::read_dir(source.join("cams")) else { return Vec::new() };
    let mut files: Vec<_> = entries
        .flatten()
        .filter_map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            let digits = name.strip_suffix("_cam.txt")?;
            Some((digits.parse().ok()?, digits.to_owned(), entry.path()))
        })
        .collect();
    files.sort();
    files
}

pub(super) fn looks_like(source: &Path) -> bool {
    !camera_files(source).is_empty()
}

/// World-to-camera and intrinsics of one file.
fn read_camera(path: &Path) -> Result<(Rigid3<Camera, World>, Intrinsics)> {
    let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
    let text = String::from_utf8(bytes).map_err(|_| InputError::new(path, "not a text file"))?;
    let after = |key: &str, count: usize| -> Result<Vec<f64>> {
        let mut words = text.split_whitespace().skip_while(|w| *w != key).skip(1);
        let values: Option<Vec<f64>> = (0..count).map(|_| words.next()?.parse().ok()).collect();
        Ok(values.ok_or_else(|| InputError::new(path, format!("'{key}' is not followed by {count} numbers")))?)
    };
    let matrix = Matrix4::from_row_slice(&after("extrinsic", 16)?);
    let (cam_from_world, _) =
        Rigid3::from_matrix(&matrix).ok_or_else(|| InputError::new(path, "'extrinsic' is no rigid transform"))?;
    let k = Intrinsics::from_matrix(&Matrix3::from_row_slice(&after("intrinsic", 9)?))
        .map_err(|e| InputError::new(path, e.to_string()).at("'intrinsic'"))?;
    Ok((cam_from_world, k))
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let files = camera_files(source);
    if files.is_empty() {
        return Err(InputError::new(source, "no cams/NNNNNNNN_cam.txt found").into());
    }
    let mut recording = Recording::new("photographs with MVSNet cameras", false);
    for (number, digits, path) in files {
        let file = |folder: &str, extensions: &[&str]| {
            extensions.iter().map(|e| source.join(folder).join(format!("{digits}.{e}"))).find(|p| p.is_file())
        };
        let Some(photo) = file("images", &["jpg", "jpeg", "png"]) else {
            recording.skip(digits.clone(), "the photograph does not exist");
            continue;
        };
        let (cam_from_world, intrinsics) = read_camera(&path)?;
        recording.frames.push(RecordedFrame {
            id: FrameId(number),
            photo: Some(Photo::File(photo)),
            lens: Some(Lens { intrinsics, distortion: Distortion::None }),
            lens_size: None,
            world_from_cam: Some(cam_from_world.inverse()),
            depth: None,
            mask: file("masks", &["png"]),
            time_s: None,
        });
    }
    Ok(recording)
}
