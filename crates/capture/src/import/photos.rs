//! A folder of photographs without cameras, and depth maps beside them.
//!
//! A PNG of 16-bit grey is a depth map in millimetres, never a photograph. It belongs to the photograph `S` where it is called
//! `S_depth.png` or `depth/S.png`; where there is just one of each they belong together, whatever their names.

use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};

use crate::FrameId;

use super::recording::{Depth, Photo, RecordedFrame, Recording};

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

/// Photographs and depth maps of a folder. Files that cannot be read are left to whoever reads them as photographs.
fn sorted_out(folder: &Path) -> (Vec<PathBuf>, Vec<PathBuf>) {
    photographs(folder).into_iter().partition(|path| !mb_image::is_grey16(path))
}

pub(super) fn looks_like(source: &Path) -> bool {
    !photographs(source).is_empty()
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let (files, depths) = sorted_out(source);
    if files.is_empty() {
        return Err(InputError::new(source, "no JPEG or PNG photographs found").into());
    }
    let only = if let ([_], [depth]) = (&files[..], &depths[..]) { Some(depth.clone()) } else { None };
    let mut recording = Recording::new("photographs", false);
    let mut unpaired = depths;
    for (i, file) in files.into_iter().enumerate() {
        let stem = file.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let beside = [source.join(format!("{stem}_depth.png")), source.join("depth").join(format!("{stem}.png"))];
        let depth = beside.into_iter().find(|p| p.is_file()).or_else(|| only.clone());
        if let Some(depth) = &depth {
            unpaired.retain(|d| d != depth);
        }
        recording.frames.push(RecordedFrame {
            id: FrameId(i as u32),
            photo: Some(Photo::File(file)),
            lens: None,
            lens_size: None,
            world_from_cam: None,
            depth: depth.map(|depth| Depth::Png(depth, None)),
            mask: None,
            time_s: None,
        });
    }
    for depth in unpaired {
        let name = depth.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
        recording.skip(name, "a depth map (16-bit grey) that belongs to no photograph");
    }
    recording.warnings.push(
        "photographs alone have no cameras: the sequence has images, but no poses and intrinsics. Run a structure-from-motion \
         program on them and import its result"
            .to_owned(),
    );
    Ok(recording)
}
