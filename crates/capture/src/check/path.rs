//! The camera's path: jumps, rotations, coverage, and whether its size is that of a hand's movement.

use mb_geometry::{Camera, Rigid3};
use nalgebra::{Matrix3, Vector3};
use serde::Serialize;

use crate::{Frame, Sequence, read_pose_txt};

use super::{CheckOptions, Problem, median};

/// Rotations that are further from orthonormal than this were not merely rounded: the largest entry of `R^T R - I`.
const MAX_DEFECT: f64 = 5e-3;
/// A hand does not move further between two frames, metres; read in the wrong unit it does by far.
const MAX_STEP_M: f64 = 2.0;
/// Cameras that turn round something do not all lie within this distance, metres.
const MIN_EXTENT_M: f64 = 2e-3;

/// How far the rotations as they are in the files are from orthonormal.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RotationCheck {
    /// Frames whose rotation is off by more than 1e-5.
    pub frames_mended: usize,
    /// Largest entry of `R^T R - I` of all frames.
    pub worst_orthogonality: f64,
    /// The determinant that is furthest from 1.
    pub worst_determinant: f64,
}

/// What is known of the path.
pub(super) struct PathCheck {
    pub step_m: f64,
    pub turn_rad: f64,
    pub orbit_coverage: f64,
    pub elevation_deg: [f64; 2],
    pub rotation: RotationCheck,
    pub problems: Vec<Problem>,
}

pub(super) fn check_path(sequence: &Sequence, options: &CheckOptions) -> PathCheck {
    let frames = sequence.frames();
    let moves = moves(frames);
    let step_m = median(moves.iter().map(|m| m.translation().norm()));
    let turn_rad = median(moves.iter().map(|m| m.angle_rad()));
    let mut problems = Vec::new();
    for (pair, relative) in frames.windows(2).zip(&moves) {
        let (step, turn) = (relative.translation().norm(), relative.angle_rad());
        if step > options.jump_ratio * step_m.max(1e-3) || turn > (options.jump_ratio * turn_rad).max(0.1) {
            let message = format!(
                "jumps by {:.1} mm and {:.1} degrees from frame {}; the medians are {:.1} and {:.1}",
                step * 1e3,
                turn.to_degrees(),
                pair[0].id,
                step_m * 1e3,
                turn_rad.to_degrees()
            );
            problems.push(Problem::of_frame("jump", pair[1].id, message));
        }
    }
    let mut rotation = RotationCheck { frames_mended: 0, worst_orthogonality: 0.0, worst_determinant: 1.0 };
    for frame in frames {
        let path = sequence.root().join("pose").join(format!("{}.txt", frame.id));
        let Ok((_, defect)) = read_pose_txt(path) else { continue };
        rotation.frames_mended += usize::from(!defect.is_within(1e-5));
        rotation.worst_orthogonality = rotation.worst_orthogonality.max(defect.orthogonality);
        if (defect.determinant - 1.0).abs() > (rotation.worst_determinant - 1.0).abs() {
            rotation.worst_determinant = defect.determinant;
        }
        if defect.orthogonality > MAX_DEFECT {
            let message = format!(
                "its rotation is not orthonormal: R^T R differs from the identity by {:.4}, its determinant is {:.4}",
                defect.orthogonality, defect.determinant
            );
            problems.push(Problem::of_frame("rotation", frame.id, message));
        }
    }
    let (orbit_coverage, elevation_deg) = coverage(frames);
    PathCheck { step_m, turn_rad, orbit_coverage, elevation_deg, rotation, problems }
}

/// Each frame's camera in that of the frame before.
fn moves(frames: &[Frame]) -> Vec<Rigid3<Camera, Camera>> {
    frames.windows(2).map(|pair| pair[0].world_from_cam.inverse() * pair[1].world_from_cam).collect()
}

/// Whether the path is as large as a hand's, where lengths are said to be metres. Only for captures without depth, which says
/// it better.
pub(super) fn check_scale(sequence: &Sequence) -> Option<Problem> {
    let metric = sequence.meta().and_then(|meta| meta.provenance.get("metric")?.as_bool()).unwrap_or(true);
    let frames = sequence.frames();
    if !metric || frames.len() < 2 {
        return None;
    }
    let step_m = median(moves(frames).iter().map(|m| m.translation().norm()));
    if step_m > MAX_STEP_M {
        let message = format!(
            "the translations are in millimetres; divide them by 1000 (as metres, the camera would move {step_m:.0} m from \
             frame to frame)"
        );
        return Some(Problem::of_all("convention", message));
    }
    let first = frames[0].world_from_cam;
    let extent =
        frames.iter().map(|f| (f.world_from_cam.translation() - first.translation()).norm()).fold(0.0, f64::max);
    let turn = frames.iter().map(|f| (first.inverse() * f.world_from_cam).angle_rad()).fold(0.0, f64::max);
    (extent < MIN_EXTENT_M && turn > 0.3).then(|| {
        let message = format!(
            "the translations are too small by 1000 (the camera turns by {:.0} degrees, but moves only {:.3} mm); multiply \
             them by 1000",
            turn.to_degrees(),
            extent * 1e3
        );
        Problem::of_all("convention", message)
    })
}

/// Share of the circle round the watched point, and lowest and highest elevation.
fn coverage(frames: &[Frame]) -> (f64, [f64; 2]) {
    let (mut matrix, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for frame in frames {
        let axis = frame.world_from_cam.rotate(&Vector3::z());
        let across = Matrix3::identity() - axis * axis.transpose();
        matrix += across;
        right += across * frame.world_from_cam.translation();
    }
    let Some(watched) = matrix.try_inverse().map(|inverse| inverse * right) else { return (0.0, [0.0; 2]) };
    let mut sectors = [false; 36];
    let mut elevations = [f64::INFINITY, f64::NEG_INFINITY];
    for frame in frames {
        let d = frame.world_from_cam.translation() - watched;
        let azimuth = d.z.atan2(d.x).to_degrees().rem_euclid(360.0);
        sectors[(azimuth / 10.0) as usize % 36] = true;
        let elevation = d.y.atan2(d.x.hypot(d.z)).to_degrees();
        elevations = [elevations[0].min(elevation), elevations[1].max(elevation)];
    }
    (sectors.iter().filter(|s| **s).count() as f64 / 36.0, elevations)
}
