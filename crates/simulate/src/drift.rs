//! What the phone believes its poses were: the truth, and a drift on top.
//!
//! Visual-inertial tracking holds on to the surfaces it sees: it errs by small motions of the whole scene, slow at
//! first and adding up, and now and then takes part of them back when it recognises a place. Accordingly
//! `reported world_from_cam = D * true world_from_cam`, where `D` turns about the middle of the object and shifts.
//!
//! A turn by 0.58 degrees about a point 45 cm away already moves the camera by more than 4 mm. So the figure for
//! translations can be met up to about that distance; from further away the turns alone exceed it, nothing is shifted,
//! and the error grows with the distance.

use mb_geometry::{Camera, Rigid3, World};
use mb_job::{Rng, rng};
use nalgebra::{Point3, Vector3, Vector6};
use rand::RngExt;

use crate::streams;
use crate::{DriftOptions, random};

/// Errors of relative poses over all pairs of frames, nothing aligned (the paper's figures).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct PairwiseError {
    pub translation_rmse_m: f64,
    pub rotation_mean_rad: f64,
}

type Pose = Rigid3<World, Camera>;

/// The pairwise errors of `reported` against `truth`. Of long sequences every n-th frame is taken, so that the work stays
/// bounded.
pub(crate) fn pairwise_error(truth: &[Pose], reported: &[Pose]) -> PairwiseError {
    let stride = truth.len().div_ceil(200).max(1);
    let frames: Vec<usize> = (0..truth.len()).step_by(stride).collect();
    let (mut squares, mut angles, mut pairs) = (0.0, 0.0, 0.0);
    for (n, &i) in frames.iter().enumerate() {
        for &j in &frames[n + 1..] {
            let relative_truth = truth[i].inverse() * truth[j];
            let relative = reported[i].inverse() * reported[j];
            let error = relative_truth.inverse() * relative;
            squares += error.translation().norm_squared();
            angles += error.angle_rad();
            pairs += 1.0;
        }
    }
    if pairs == 0.0 {
        return PairwiseError { translation_rmse_m: 0.0, rotation_mean_rad: 0.0 };
    }
    PairwiseError { translation_rmse_m: (squares / pairs).sqrt(), rotation_mean_rad: angles / pairs }
}

/// The unscaled drift: `[rotation; translation]` for each frame, a mean-reverting random walk and a slow swing per
/// coordinate, with relocalisations that take half of it back.
fn shape(frames: usize, options: &DriftOptions, rng: &mut Rng) -> Vec<Vector6<f64>> {
    let jump_share = (options.relocalisations / frames as f64).min(1.0);
    let jumps: Vec<bool> = (0..frames).map(|_| rng.random_bool(jump_share)).collect();
    let mut twists = vec![Vector6::zeros(); frames];
    for axis in 0..6 {
        let swings = 0.5 + 2.0 * rng.random::<f64>();
        let phase = rng.random_range(0.0..std::f64::consts::TAU);
        let mut walk = 0.0;
        for (i, twist) in twists.iter_mut().enumerate() {
            if jumps[i] {
                walk *= 0.5;
            }
            let along = i as f64 / frames as f64;
            twist[axis] = walk + 0.7 * (std::f64::consts::TAU * swings * along + phase).sin();
            walk = walk * (1.0 - 0.5 / frames as f64) + random::normal(rng) * (2.0 / frames as f64).sqrt();
        }
    }
    twists
}

/// Sizes that make a drift out of its shape.
#[derive(Clone, Copy)]
struct Scale {
    rotation: f64,
    translation: f64,
}

fn apply(truth: &[Pose], object_in_world: &Point3<f64>, shape: &[Vector6<f64>], scale: Scale) -> Vec<Pose> {
    let to_pivot = Rigid3::<World, World>::from_translation(object_in_world.coords);
    truth
        .iter()
        .zip(shape)
        .map(|(pose, twist)| {
            let turn: Vector3<f64> = twist.fixed_rows::<3>(0) * scale.rotation;
            let shift: Vector3<f64> = twist.fixed_rows::<3>(3) * scale.translation;
            let turn = Rigid3::<World, World>::exp(&Vector6::new(turn.x, turn.y, turn.z, 0.0, 0.0, 0.0));
            Rigid3::<World, World>::from_translation(shift) * to_pivot * turn * to_pivot.inverse() * *pose
        })
        .collect()
}

/// The value in `[low, high]` where the growing function `f` reaches `goal`, or the end it stays below or above at.
fn solve(low: f64, high: f64, goal: f64, f: impl Fn(f64) -> f64) -> f64 {
    let (mut low, mut high) = (low, high);
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        if f(middle) < goal { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// The poses that the phone reports for a true path.
pub(crate) fn drift(truth: &[Pose], object_in_world: &Point3<f64>, options: &DriftOptions, seed: u64) -> Vec<Pose> {
    let shape = shape(truth.len(), options, &mut rng(seed, streams::DRIFT));
    let error = |scale| pairwise_error(truth, &apply(truth, object_in_world, &shape, scale));
    let goal_rad = options.rotation_mean_deg.to_radians();
    let goal_m = options.translation_rmse_mm * 1e-3;
    // The error of a rotation grows in proportion to it up to half a turn.
    let mut scale = Scale { rotation: 0.0, translation: 0.0 };
    if goal_rad > 0.0 {
        scale.rotation = solve(0.0, 2.0, goal_rad, |rotation| error(Scale { rotation, ..scale }).rotation_mean_rad);
    }
    if error(scale).translation_rmse_m < goal_m {
        let goal = |translation| error(Scale { translation, ..scale }).translation_rmse_m;
        scale.translation = solve(0.0, 2.0 * goal_m, goal_m, goal);
    }
    apply(truth, object_in_world, &shape, scale)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::SimulateOptions;
    use crate::orbit::Orbit;
    use mb_geometry::{Aabb, Object};

    fn path(seed: u64, radius_m: Option<f64>) -> Vec<Pose> {
        let bounds = Aabb { min: Point3::new(-0.08, 0.0, -0.06), max: Point3::new(0.08, 0.1, 0.06) };
        let orbit = Orbit::new(&SimulateOptions { seed, radius_m, ..SimulateOptions::default() }, &bounds);
        let world_from_object = Rigid3::<World, Object>::from_translation(Vector3::new(0.3, -0.4, -0.2));
        (0..60).map(|i| world_from_object * orbit.object_from_cam(orbit.time_s(i))).collect()
    }

    const CENTER: Point3<f64> = Point3::new(0.3, -0.35, -0.2);

    #[test]
    fn every_seed_has_the_errors_of_the_papers_pose_table() {
        for seed in 0..8 {
            for radius_m in [None, Some(0.4)] {
                let truth = path(seed, radius_m);
                let found = pairwise_error(&truth, &drift(&truth, &CENTER, &DriftOptions::default(), seed));
                assert!((found.translation_rmse_m * 1e3 - 4.454).abs() < 0.02, "{found:?}");
                assert!((found.rotation_mean_rad.to_degrees() - 0.581).abs() < 0.003, "{found:?}");
            }
        }
    }

    #[test]
    fn from_far_away_the_turns_alone_move_the_camera_more() {
        let truth = path(3, Some(1.0));
        let found = pairwise_error(&truth, &drift(&truth, &CENTER, &DriftOptions::default(), 3));
        assert!((found.rotation_mean_rad.to_degrees() - 0.581).abs() < 0.003, "{found:?}");
        assert!((0.006..0.011).contains(&found.translation_rmse_m), "{found:?}");
    }

    #[test]
    fn drift_is_slow_between_neighbours_and_large_across_the_sequence() {
        let (mut near, mut far) = (0.0, 0.0);
        for seed in 0..8 {
            let truth = path(seed, None);
            let options = DriftOptions { relocalisations: 0.0, ..DriftOptions::default() };
            let reported = drift(&truth, &CENTER, &options, seed);
            let error = |i: usize, j: usize| {
                let relative = (truth[i].inverse() * truth[j]).inverse() * reported[i].inverse() * reported[j];
                relative.translation().norm_squared()
            };
            near += (0..50).map(|i| error(i, i + 1)).sum::<f64>();
            far += (0..30).map(|i| error(i, i + 30)).sum::<f64>();
        }
        assert!(near / 50.0 < 0.2 * far / 30.0, "{near} against {far}");
    }

    #[test]
    fn no_drift_is_the_truth() {
        let truth = path(1, None);
        let none = DriftOptions { translation_rmse_mm: 0.0, rotation_mean_deg: 0.0, relocalisations: 0.0 };
        let found = pairwise_error(&truth, &drift(&truth, &CENTER, &none, 1));
        assert!(found.translation_rmse_m < 1e-12 && found.rotation_mean_rad < 1e-7);
    }
}
