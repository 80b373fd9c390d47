//! OpenSfM: `reconstruction.json`, `images/`, and masks in `masks/NAME.png`.
//!
//! A shot is an axis-angle rotation and a translation, world-to-camera, OpenCV axes. Cameras are in normalised coordinates: the
//! origin is the middle of the image, the unit its longer side. The scale comes from GPS, with errors of metres.

use std::path::Path;

use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_job::{InputError, Result};
use nalgebra::{UnitQuaternion, Vector3};
use serde_json::Value;

use crate::lens::{Distortion, Lens};

use super::json;
use super::recording::{Photo, RecordedFrame, Recording, frame_ids};

const FILE: &str = "reconstruction.json";

pub(super) fn looks_like(source: &Path) -> bool {
    source.join(FILE).is_file()
}

/// A camera's lens and the size that it is for.
fn lens(camera: &Value) -> std::result::Result<(Lens, ImageSize), String> {
    let key = |name: &str| json::number(camera, name);
    let or_zero = |name: &str| key(name).unwrap_or(0.0);
    let side = |name: &str| key(name).filter(|v| *v >= 1.0 && *v <= 100_000.0).map(|v| v as usize);
    let (Some(width), Some(height)) = (side("width"), side("height")) else {
        return Err("'width' and 'height' must be the photograph's size".to_owned());
    };
    let unit = width.max(height) as f64;
    let focal = key("focal").or_else(|| key("focal_x")).filter(|f| *f > 0.0).ok_or("no focal length above 0")?;
    let fx = unit * focal;
    let fy = unit * key("focal_y").unwrap_or(focal);
    let intrinsics = Intrinsics {
        fx,
        fy,
        cx: 0.5 * width as f64 - 0.5 + unit * or_zero("c_x"),
        cy: 0.5 * height as f64 - 0.5 + unit * or_zero("c_y"),
    };
    let [k1, k2, k3, k4] = ["k1", "k2", "k3", "k4"].map(or_zero);
    let distortion = match camera.get("projection_type").and_then(Value::as_str).unwrap_or("perspective") {
        "perspective" | "simple_radial" | "radial" => {
            Distortion::Radial { k: [k1, k2, 0.0, 0.0, 0.0, 0.0], p: [0.0; 2] }
        }
        "brown" => Distortion::Radial { k: [k1, k2, k3, 0.0, 0.0, 0.0], p: [or_zero("p1"), or_zero("p2")] },
        "fisheye" => Distortion::Fisheye { k: [k1, k2, 0.0, 0.0], p: [0.0; 2], s: [0.0; 2] },
        "fisheye_opencv" => Distortion::Fisheye { k: [k1, k2, k3, k4], p: [0.0; 2], s: [0.0; 2] },
        other => return Err(format!("projection_type '{other}' is not known here")),
    };
    if !(fx.is_finite() && fy > 0.0 && fy.is_finite()) {
        return Err(format!("the focal lengths are {fx} and {fy}, both must be above 0"));
    }
    Ok((Lens { intrinsics, distortion }, ImageSize::new(width, height)))
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let path = source.join(FILE);
    let document = json::read(&path)?;
    let bad = |found: &str, place: String| InputError::new(&path, found.to_owned()).at(place);
    let parts = document.as_array().ok_or_else(|| InputError::new(&path, "not a list of reconstructions"))?;
    // Parts of a reconstruction have worlds of their own: the largest is taken.
    let shots_of = |part: &Value| part.get("shots").and_then(Value::as_object).map_or(0, serde_json::Map::len);
    let part = parts.iter().max_by_key(|part| shots_of(part));
    let (Some(shots), Some(cameras)) = (
        part.and_then(|part| part.get("shots")).and_then(Value::as_object),
        part.and_then(|part| part.get("cameras")).and_then(Value::as_object),
    ) else {
        return Err(InputError::new(&path, "holds no reconstruction with 'shots' and 'cameras'").into());
    };
    let mut recording = Recording::new("photographs with an OpenSfM reconstruction", false);
    for other in parts.iter().filter(|other| !part.is_some_and(|part| std::ptr::eq(*other, part))) {
        for name in other.get("shots").and_then(Value::as_object).into_iter().flat_map(|shots| shots.keys()) {
            recording.skip(name.clone(), "it belongs to a smaller part of the reconstruction");
        }
    }
    let names: Vec<String> = shots.keys().cloned().collect();
    for ((name, shot), id) in shots.iter().zip(frame_ids(&names)) {
        let place = || format!("shot '{name}'");
        let camera = shot.get("camera").and_then(Value::as_str).and_then(|camera| cameras.get(camera));
        let camera = camera.ok_or_else(|| bad("names a camera that is not there", place()))?;
        let (lens, size) = lens(camera).map_err(|found| bad(&found, place()))?;
        let vector = |key: &str| json::numbers(shot, key, 3, &path).map(|v| Vector3::new(v[0], v[1], v[2]));
        let (rotation, translation) = (vector("rotation")?, vector("translation")?);
        let Some(photo) =
            [source.join("images").join(name), source.join(name)].into_iter().find(|candidate| candidate.is_file())
        else {
            recording.skip(name.clone(), "the photograph does not exist");
            continue;
        };
        let cam_from_world =
            Rigid3::<Camera, World>::from_parts(UnitQuaternion::from_scaled_axis(rotation), translation);
        recording.frames.push(RecordedFrame {
            id,
            photo: Some(Photo::File(photo)),
            lens: Some(lens),
            lens_size: Some(size),
            world_from_cam: Some(cam_from_world.inverse()),
            depth: None,
            mask: Some(source.join("masks").join(format!("{name}.png"))).filter(|p| p.is_file()),
            time_s: json::number(shot, "capture_time"),
        });
    }
    recording.frames.sort_by_key(|f| f.id);
    Ok(recording)
}
