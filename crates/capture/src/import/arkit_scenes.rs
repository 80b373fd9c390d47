//! ARKitScenes: `lowres_wide/ID_TIME.png`, `lowres_wide_intrinsics/ID_TIME.pincam`, `lowres_depth/`, `confidence/`, and the camera
//! path `lowres_wide.traj`.
//!
//! A line of the path is a time, a rotation vector and a translation, world-to-camera. Its times match no photograph's, so
//! poses are interpolated between the two nearest, at most 0.2 s apart.

use std::path::{Path, PathBuf};

use mb_geometry::{Camera, Intrinsics, Rigid3, World};
use mb_job::{InputError, Result};
use nalgebra::{UnitQuaternion, Vector3};

use crate::FrameId;
use crate::lens::{Distortion, Lens};

use super::photos::photographs;
use super::recording::{Depth, Photo, RecordedFrame, Recording};

/// Poses further apart than this say nothing about the moments between them.
const MAX_GAP_S: f64 = 0.2;

fn trajectory(source: &Path) -> PathBuf {
    source.join("lowres_wide.traj")
}

pub(super) fn looks_like(source: &Path) -> bool {
    trajectory(source).is_file() && source.join("lowres_wide").is_dir()
}

/// The numbers of a line, all finite, exactly `count`.
fn numbers(path: &Path, line: &str, number: usize, count: usize) -> Result<Vec<f64>> {
    let found: Option<Vec<f64>> =
        line.split_whitespace().map(|w| w.parse::<f64>().ok().filter(|v| v.is_finite())).collect();
    Ok(found
        .filter(|found| found.len() == count)
        .ok_or_else(|| InputError::new(path, format!("not {count} numbers")).at_line(number))?)
}

fn read_text(path: &Path) -> Result<String> {
    Ok(std::fs::read_to_string(path).map_err(|e| InputError::unreadable(path, &e))?)
}

/// Times and poses, ascending.
fn read_path(path: &Path) -> Result<Vec<(f64, Rigid3<World, Camera>)>> {
    let mut poses = Vec::new();
    for (i, line) in read_text(path)?.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let n = numbers(path, line, i + 1, 7)?;
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(n[1], n[2], n[3]));
        let cam_from_world = Rigid3::<Camera, World>::from_parts(rotation, Vector3::new(n[4], n[5], n[6]));
        poses.push((n[0], cam_from_world.inverse()));
    }
    poses.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(poses)
}

/// The pose at a time, or `None` where the path has a gap.
fn pose_at(path: &[(f64, Rigid3<World, Camera>)], time_s: f64) -> Option<Rigid3<World, Camera>> {
    let after = path.partition_point(|(t, _)| *t < time_s);
    if let Some((t, pose)) = path.get(after)
        && (t - time_s).abs() < 1e-6
    {
        return Some(*pose);
    }
    let ((t0, before), (t1, after)) = (path.get(after.checked_sub(1)?)?, path.get(after)?);
    if t1 - t0 > MAX_GAP_S {
        return None;
    }
    let share = (time_s - t0) / (t1 - t0);
    let rotation = before.rotation().try_slerp(&after.rotation(), share, 1e-12)?;
    Some(Rigid3::from_parts(rotation, before.translation().lerp(&after.translation(), share)))
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let path = read_path(&trajectory(source))?;
    let mut recording = Recording::new("iPad (ARKitScenes)", true);
    for (i, photo) in photographs(&source.join("lowres_wide")).into_iter().enumerate() {
        let stem = photo.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let Some(time_s) = stem.rsplit('_').next().and_then(|t| t.parse::<f64>().ok()) else {
            recording.skip(stem, "its name does not end with a time");
            continue;
        };
        let Some(world_from_cam) = pose_at(&path, time_s) else {
            recording.skip(stem, "the camera path has a gap at its time");
            continue;
        };
        // The intrinsics of some photographs carry a time that is off by a millisecond.
        let id = stem.rsplit_once('_').map_or("", |(id, _)| id);
        let near = [0.0, -0.001, 0.001].map(|dt| format!("{id}_{:.3}", time_s + dt));
        let camera = near
            .iter()
            .map(|name| source.join("lowres_wide_intrinsics").join(format!("{name}.pincam")))
            .find(|p| p.is_file());
        let Some(camera) = camera else {
            recording.skip(stem, "it has no intrinsics (.pincam)");
            continue;
        };
        let k = numbers(&camera, read_text(&camera)?.trim(), 1, 6)?;
        if !(k[2] > 0.0 && k[3] > 0.0) {
            return Err(InputError::new(&camera, "a focal length is not above 0").into());
        }
        let intrinsics = Intrinsics { fx: k[2], fy: k[3], cx: k[4], cy: k[5] };
        let beside = |folder: &str| Some(source.join(folder).join(format!("{stem}.png"))).filter(|p| p.is_file());
        recording.frames.push(RecordedFrame {
            id: FrameId(i as u32),
            photo: Some(Photo::File(photo)),
            lens: Some(Lens { intrinsics, distortion: Distortion::None }),
            lens_size: None,
            world_from_cam: Some(world_from_cam),
            depth: beside("lowres_depth").map(|depth| Depth::Png(depth, beside("confidence"))),
            mask: None,
            time_s: Some(time_s),
        });
    }
    Ok(recording)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_between_two_times_are_interpolated_and_gaps_are_not() {
        let pose = |x: f64, angle: f64| {
            Rigid3::from_parts(UnitQuaternion::from_scaled_axis(Vector3::y() * angle), Vector3::new(x, 0.0, 0.0))
        };
        let path = vec![(1.0, pose(0.0, 0.0)), (1.1, pose(1.0, 0.2)), (3.0, pose(2.0, 0.0))];
        let found = pose_at(&path, 1.025).unwrap();
        assert!((found.translation().x - 0.25).abs() < 1e-9 && (found.angle_rad() - 0.05).abs() < 1e-9);
        assert_eq!(pose_at(&path, 1.1), Some(path[1].1));
        for lost in [0.9, 2.0, 3.1] {
            assert!(pose_at(&path, lost).is_none());
        }
    }
}
