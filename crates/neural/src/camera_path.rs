//! New views: cameras that no photograph was taken from.

use std::path::{Path, PathBuf};

use mb_capture::{FrameId, PoseFolder, read_intrinsics_txt};
use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_job::{Error, InputError, Result};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::dataset::{RayDataset, View};

/// Which views to render.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum CameraPath {
    /// Those that were kept from training, each beside its photograph.
    #[default]
    HeldOut,
    /// So many around the object, at the cameras' mean distance and height.
    Orbit(usize),
    /// Those of a folder with `pose/NNNNNN.txt`, and `intrinsic/NNNNNN.txt` for the photographs' full size where it has
    /// them.
    Folder(PathBuf),
}

/// The views of an orbit or a folder, without photographs.
///
/// # Errors
/// An orbit of no views; a folder without poses, or with malformed files.
pub(crate) fn new_views(path: &CameraPath, data: &RayDataset, full_size: ImageSize) -> Result<Vec<View>> {
    match path {
        CameraPath::HeldOut => Ok(data.held_out().cloned().collect()),
        CameraPath::Orbit(n) => orbit(data, *n),
        CameraPath::Folder(root) => folder(root, data, full_size),
    }
}

fn folder(root: &Path, data: &RayDataset, full_size: ImageSize) -> Result<Vec<View>> {
    let poses = PoseFolder::open(root)?;
    let like = &data.views()[0];
    let mut views = Vec::with_capacity(poses.frames().len());
    for (frame, world_from_cam) in poses.frames() {
        let file = root.join(format!("intrinsic/{frame}.txt"));
        let intrinsics = match file.exists() {
            true => read_intrinsics_txt(&file)?.resized(full_size, like.size()),
            false => like.intrinsics,
        };
        if !world_from_cam.to_matrix().iter().all(|v| v.is_finite()) {
            return Err(InputError::new(root, "the pose has a number that is not finite")
                .at(format!("frame {frame}"))
                .into());
        }
        views.push(data.new_view(*frame, intrinsics, like.size(), *world_from_cam));
    }
    Ok(views)
}

/// Cameras on a circle around the axis that the photographs were taken around: the normal of the plane that fits their
/// centres best, on their side of the object. The horizon is level for that axis, whichever way the phone was held.
fn orbit(data: &RayDataset, n: usize) -> Result<Vec<View>> {
    if n == 0 {
        return Err(Error::Failed("an orbit of no views shows nothing; ask for at least one".to_owned()));
    }
    let middle = data.region().center;
    let offsets: Vec<Vector3<f64>> =
        data.views().iter().map(|v| v.world_from_cam.translation() - middle.coords).collect();
    let mean = offsets.iter().sum::<Vector3<f64>>() / offsets.len() as f64;
    let scatter: Matrix3<f64> = offsets.iter().map(|o| (o - mean) * (o - mean).transpose()).sum();
    let eigen = scatter.symmetric_eigen();
    let mut axis: Vector3<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    if axis.dot(&mean) < 0.0 {
        axis = -axis;
    }
    let height = mean.dot(&axis);
    let radius = offsets.iter().map(|o| (o - axis * o.dot(&axis)).norm()).sum::<f64>() / offsets.len() as f64;
    let start = (offsets[0] - axis * offsets[0].dot(&axis)).try_normalize(1e-9).unwrap_or_else(|| any_across(&axis));
    let side = axis.cross(&start);
    // A phone held upright turns its sensor's long side upwards: the picture is turned back.
    let first = &data.views()[0];
    let up_in_cam = first.world_from_cam.inverse().rotation_matrix() * axis;
    let (mut size, mut k) = (first.size(), first.intrinsics);
    if up_in_cam.x.abs() > up_in_cam.y.abs() {
        size = ImageSize::new(size.height, size.width);
        k = Intrinsics { fx: k.fy, fy: k.fx, cx: k.cy, cy: k.cx };
    }
    Ok((0..n)
        .map(|i| {
            let (sin, cos) = (i as f64 / n as f64 * std::f64::consts::TAU).sin_cos();
            let offset = axis * height + (start * cos + side * sin) * radius;
            let pose = looking_at(offset, &axis, middle.coords);
            data.new_view(FrameId(i as u32), k, size, pose)
        })
        .collect())
}

fn any_across(axis: &Vector3<f64>) -> Vector3<f64> {
    let other = if axis.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
    axis.cross(&other).normalize()
}

/// A camera at `center + offset` that looks at `center`, with `up` upwards in its picture.
fn looking_at(offset: Vector3<f64>, up: &Vector3<f64>, center: Vector3<f64>) -> Rigid3<World, Camera> {
    let forward = -offset.try_normalize(1e-12).unwrap_or_else(|| -up);
    let right = forward.cross(up).try_normalize(1e-6).unwrap_or_else(|| any_across(&forward));
    let down = forward.cross(&right);
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[right, down, forward]));
    Rigid3::from_parts(UnitQuaternion::from_rotation_matrix(&rotation), center + offset)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_looks_at_its_target_the_right_way_up() {
        let center = Vector3::new(0.3, -1.0, 2.0);
        let pose = looking_at(Vector3::new(1.0, 0.5, 0.7), &Vector3::z(), center);
        let cam_from_world = pose.inverse();
        let target = cam_from_world * nalgebra::Point3::from(center);
        assert!(target.x.abs() < 1e-9 && target.y.abs() < 1e-9 && target.z > 1.0);
        assert!((cam_from_world * nalgebra::Point3::from(center + Vector3::z() * 0.1)).y < 0.0, "up is not up");
        assert!((pose.rotation_matrix().determinant() - 1.0).abs() < 1e-9);
    }
}
