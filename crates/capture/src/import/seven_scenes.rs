//! The layout of 7-Scenes and of tsdf-fusion-python: `frame-NNNNNN.color.jpg` or `.png`, `frame-NNNNNN.depth.png`,
//! `frame-NNNNNN.pose.txt`, and one `camera-intrinsics.txt`, there or a folder above.
//!
//! Poses are camera-to-world with OpenCV axes, metres; depth is in millimetres with 65535 for none. Frames whose tracking
//! was lost have poses that are not finite.

use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};

use crate::lens::{Distortion, Lens};
use crate::matrix_txt::read_matrix_txt;
use crate::{FrameId, read_intrinsics_txt, read_pose_txt};

use super::recording::{Depth, Photo, RecordedFrame, Recording};

const INTRINSICS: &str = "camera-intrinsics.txt";

/// Numbers of the frames that have a pose, a photograph or depth, ascending.
fn numbers(source: &Path) -> Vec<String> {
    let Ok(entries) = std::fs::read_dir(source) else { return Vec::new() };
    let mut found: Vec<String> = entries
        .flatten()
        .filter_map(|entry| {
            let name = entry.file_name().to_string_lossy().into_owned();
            let (digits, kind) = name.strip_prefix("frame-")?.split_once('.')?;
            let known = ["color.jpg", "color.png", "depth.png", "pose.txt"].contains(&kind);
            (known && digits.bytes().all(|b| b.is_ascii_digit())).then(|| digits.to_owned())
        })
        .collect();
    found.sort();
    found.dedup();
    found
}

pub(super) fn looks_like(source: &Path) -> bool {
    numbers(source).iter().take(8).any(|n| source.join(format!("frame-{n}.pose.txt")).is_file())
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let numbers = numbers(source);
    if numbers.is_empty() {
        return Err(InputError::new(source, "no frame-NNNNNN.color.jpg, .depth.png or .pose.txt found").into());
    }
    let above = source.parent().map(|parent| parent.join(INTRINSICS)).filter(|p| p.is_file());
    let path: PathBuf = Some(source.join(INTRINSICS)).filter(|p| p.is_file()).or(above).ok_or_else(|| {
        InputError::new(source.join(INTRINSICS), "no such file")
            .help("Write the 3x3 matrix of the camera there (7-Scenes uses fx = fy = 585, cx = 320, cy = 240)")
    })?;
    let lens = Lens { intrinsics: read_intrinsics_txt(&path)?, distortion: Distortion::None };
    let mut recording = Recording::new("RGB-D camera (7-Scenes layout)", true);
    let mut mended = 0;
    for number in numbers {
        let file = |kind: &str| Some(source.join(format!("frame-{number}.{kind}"))).filter(|p| p.is_file());
        let Some(pose) = file("pose.txt") else {
            recording.skip(number, "has no pose");
            continue;
        };
        if read_matrix_txt(&pose, 4)?.iter().any(|v| !v.is_finite()) {
            recording.skip(number, "its pose is not finite: tracking was lost");
            continue;
        }
        let (world_from_cam, defect) = read_pose_txt(&pose)?;
        mended += usize::from(!defect.is_within(1e-5));
        let id = number.parse().map_err(|_| InputError::new(&pose, "the frame's number is too large"))?;
        recording.frames.push(RecordedFrame {
            id: FrameId(id),
            photo: file("color.jpg").or_else(|| file("color.png")).map(Photo::File),
            lens: Some(lens),
            lens_size: None,
            world_from_cam: Some(world_from_cam),
            depth: file("depth.png").map(|depth| Depth::Png(depth, None)),
            mask: None,
            time_s: None,
        });
    }
    recording.warnings.push(
        "the intrinsics are those of the depth camera; 7-Scenes' colour is not registered exactly to its depth"
            .to_owned(),
    );
    if mended > 0 {
        recording.warnings.push(format!("{mended} poses had rotations that are not exactly orthonormal; mended"));
    }
    Ok(recording)
}
