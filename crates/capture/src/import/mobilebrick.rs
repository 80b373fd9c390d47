//! The published MobileBrick layout, and sequences of our own: `pose/`, `intrinsic/`, `image/`, `arkit_depth/`.
//!
//! Frames that lack their pose or intrinsics are left out, where opening the folder as a sequence would fail.

use std::collections::BTreeSet;
use std::path::Path;

use mb_job::{InputError, Result};

use crate::lens::{Distortion, Lens};
use crate::sequence::numbered_files;
use crate::{FrameId, read_intrinsics_txt, read_pose_txt};

use super::recording::{Depth, Photo, RecordedFrame, Recording};

pub(super) fn looks_like(source: &Path) -> bool {
    source.join("pose").is_dir() && source.join("intrinsic").is_dir()
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let files = |folder: &str, extensions: &[&str]| numbered_files(&source.join(folder), extensions);
    let (poses, intrinsics) = (files("pose", &["txt"])?, files("intrinsic", &["txt"])?);
    let (images, depths) = (files("image", &["jpg", "jpeg", "png"])?, files("arkit_depth", &["png"])?);
    let find = |list: &[(FrameId, std::path::PathBuf)], id| {
        list.binary_search_by_key(&id, |(id, _)| *id).ok().map(|i| list[i].1.clone())
    };
    let ids: BTreeSet<FrameId> =
        [&poses, &intrinsics, &images, &depths].iter().flat_map(|l| l.iter().map(|(id, _)| *id)).collect();
    if ids.is_empty() {
        return Err(InputError::new(source, "no frames found")
            .help("Expected pose/NNNNNN.txt, intrinsic/NNNNNN.txt and image/NNNNNN.jpg or .png")
            .into());
    }
    let mut recording = Recording::new("phone (MobileBrick layout)", true);
    let mut mended = 0;
    for id in ids {
        let (Some(pose), Some(intrinsic)) = (find(&poses, id), find(&intrinsics, id)) else {
            let missing = if find(&poses, id).is_none() { "pose" } else { "intrinsics" };
            recording.skip(id.to_string(), format!("has no {missing}"));
            continue;
        };
        let (world_from_cam, defect) = read_pose_txt(&pose)?;
        mended += usize::from(!defect.is_within(1e-5));
        let confidence = source.join("arkit_depth").join(format!("{id}_conf.png"));
        recording.frames.push(RecordedFrame {
            id,
            photo: find(&images, id).map(Photo::File),
            lens: Some(Lens { intrinsics: read_intrinsics_txt(&intrinsic)?, distortion: Distortion::None }),
            lens_size: None,
            world_from_cam: Some(world_from_cam),
            depth: find(&depths, id).map(|depth| Depth::Png(depth, confidence.exists().then_some(confidence))),
            mask: Some(source.join("mask").join(format!("{id}.png"))).filter(|p| p.is_file()),
            time_s: None,
        });
    }
    if mended > 0 {
        recording.warnings.push(format!("{mended} poses had rotations that are not exactly orthonormal; mended"));
    }
    Ok(recording)
}
