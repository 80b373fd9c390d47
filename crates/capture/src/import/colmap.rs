//! A COLMAP model, text or binary, with its photographs.
//!
//! The model lies in the source itself or in one of the places where COLMAP and its users put it; photographs in
//! `images/` or `image/` beside or above it, masks in `masks/NAME.png` beside the photographs' folder. Every camera model
//! that COLMAP has is undistorted to a pinhole. The scale is arbitrary.

use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};

use crate::colmap_model::{ColmapModel, is_model};

use super::recording::{Photo, RecordedFrame, Recording, frame_ids};

const MODEL_FOLDERS: [&str; 7] =
    ["", "sparse/0", "sparse", "colmap", "colmap/sparse/0", "colmap/sparse", "dense/sparse"];

fn find_model(source: &Path) -> Option<PathBuf> {
    MODEL_FOLDERS.iter().map(|folder| source.join(folder)).find(|folder| is_model(folder))
}

pub(super) fn looks_like(source: &Path) -> bool {
    source.is_dir() && find_model(source).is_some()
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let folder = find_model(source).ok_or_else(|| {
        InputError::new(source, "no COLMAP model found")
            .help("Expected cameras and images, as .txt or .bin, there or in sparse/0, sparse or colmap")
    })?;
    let model = ColmapModel::read(&folder)?;
    let places: Vec<PathBuf> =
        folder.ancestors().take(4).flat_map(|above| ["images", "image", ""].map(|name| above.join(name))).collect();
    let mut recording = Recording::new("photographs with a COLMAP model", false);
    let names: Vec<String> = model.images.iter().map(|i| i.name.clone()).collect();
    for (image, id) in model.images.iter().zip(frame_ids(&names)) {
        let Some(photo) = places.iter().map(|place| place.join(&image.name)).find(|p| p.is_file()) else {
            recording.skip(image.name.clone(), "the photograph does not exist");
            continue;
        };
        let camera = &model.cameras[&image.camera];
        recording.frames.push(RecordedFrame {
            id,
            photo: Some(Photo::File(photo)),
            lens: Some(camera.lens),
            lens_size: Some(camera.size),
            world_from_cam: Some(image.cam_from_world.inverse()),
            depth: None,
            // As COLMAP's feature extractor names them.
            mask: places
                .iter()
                .map(|place| place.with_file_name("masks").join(format!("{}.png", image.name)))
                .find(|p| p.is_file()),
            time_s: None,
        });
    }
    recording.frames.sort_by_key(|f| f.id);
    Ok(recording)
}
