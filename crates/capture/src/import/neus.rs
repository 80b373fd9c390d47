//! NeuS, IDR and their descendants: `cameras_sphere.npz` or `cameras.npz` with `world_mat_i`, and photographs (and masks) whose
//! order by name is that of the cameras.
//!
//! `world_mat_i` is `K * cam_from_world`; pixel centres are at integers. The scale is arbitrary.

use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};
use nalgebra::Matrix4;

use crate::FrameId;
use crate::lens::{Distortion, Lens};
use crate::neus_cameras::{read_matrix, split_projection};

use super::archive::Archive;
use super::photos::photographs;
use super::recording::{Photo, RecordedFrame, Recording};

fn cameras(source: &Path) -> Option<PathBuf> {
    ["cameras_sphere.npz", "cameras.npz"].map(|name| source.join(name)).into_iter().find(|p| p.is_file())
}

/// Photographs of the first of these folders that has some.
fn pictures(source: &Path, folders: &[&str]) -> Vec<PathBuf> {
    folders.iter().map(|folder| photographs(&source.join(folder))).find(|files| !files.is_empty()).unwrap_or_default()
}

pub(super) fn looks_like(source: &Path) -> bool {
    source.is_dir() && cameras(source).is_some()
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let path = cameras(source).ok_or_else(|| InputError::new(source, "no cameras_sphere.npz or cameras.npz found"))?;
    let npz = Archive::open(&path)?;
    let photos = pictures(source, &["image", "rgb", "images"]);
    let masks = pictures(source, &["mask", "masks"]);
    let mut recording = Recording::new("photographs with NeuS cameras", false);
    // Masks belong to photographs by order, which says nothing where some are missing.
    let with_masks = masks.len() == photos.len();
    if !with_masks && !masks.is_empty() {
        let found = format!("{} masks for {} photographs; none was taken", masks.len(), photos.len());
        recording.warnings.push(found);
    }
    for (i, photo) in photos.iter().enumerate() {
        let name = format!("world_mat_{i}.npy");
        if !npz.contains(&name) {
            recording.skip(i.to_string(), format!("cameras have no world_mat_{i}"));
            continue;
        }
        let matrix: Matrix4<f64> = read_matrix(&npz.read(&name)?)
            .map_err(|found| InputError::new(&path, found).at(format!("frame {i}, world_mat_{i}")))?;
        let projection: nalgebra::Matrix3x4<f64> = matrix.fixed_view::<3, 4>(0, 0).into();
        let (intrinsics, cam_from_world) = split_projection(&projection).ok_or_else(|| {
            InputError::new(&path, "is no product of pinhole intrinsics and a rigid transform")
                .at(format!("frame {i}, world_mat_{i}"))
        })?;
        recording.frames.push(RecordedFrame {
            id: FrameId(i as u32),
            photo: Some(Photo::File(photo.clone())),
            lens: Some(Lens { intrinsics, distortion: Distortion::None }),
            lens_size: None,
            world_from_cam: Some(cam_from_world.inverse()),
            depth: None,
            mask: with_masks.then(|| masks[i].clone()),
            time_s: None,
        });
    }
    let beyond = (photos.len()..).take_while(|i| npz.contains(&format!("world_mat_{i}.npy")));
    for i in beyond {
        recording.skip(i.to_string(), "the photograph does not exist");
    }
    Ok(recording)
}
