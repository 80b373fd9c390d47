//! A folder of photographs without cameras.

use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};

use crate::FrameId;

use super::recording::{Photo, RecordedFrame, Recording};

/// JPEG and PNG files of a folder, by name.
pub(super) fn photographs(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut files: Vec<PathBuf> = entries
        .flatten()
        .map(|entry| entry.path())
        .filter(|path| {
            let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
            ["jpg", "jpeg", "png"].contains(&extension.as_str())
        })
        .collect();
    files.sort();
    files
}

pub(super) fn looks_like(source: &Path) -> bool {
    !photographs(source).is_empty()
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let files = photographs(source);
    if files.is_empty() {
        return Err(InputError::new(source, "no JPEG or PNG photographs found").into());
    }
    let mut recording = Recording::new("photographs", false);
    recording.frames = files
        .into_iter()
        .enumerate()
        .map(|(i, file)| RecordedFrame {
            id: FrameId(i as u32),
            photo: Some(Photo::File(file)),
            lens: None,
            lens_size: None,
            world_from_cam: None,
            depth: None,
            time_s: None,
        })
        .collect();
    recording.warnings.push(
        "photographs alone have no cameras: the sequence has images, but no poses and intrinsics. Run a structure-from-motion \
         program on them and import its result"
            .to_owned(),
    );
    Ok(recording)
}
