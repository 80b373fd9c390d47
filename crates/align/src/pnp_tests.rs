//! What the pose estimate must recover, and which degenerate inputs it must tell apart.

use super::*;
use crate::pnp_problem::{moved, project};
use nalgebra::UnitQuaternion;

const PHONE: Intrinsics = Intrinsics { fx: 1460.0, fy: 1460.0, cx: 962.0, cy: 724.5 };

/// A camera at `center` that looks at the world's origin.
fn camera_at(center: [f64; 3]) -> PosedCamera {
    let center = Vector3::from(center);
    let rotation = UnitQuaternion::face_towards(&-center, &-Vector3::y());
    PosedCamera { intrinsics: PHONE, world_from_cam: Rigid3::from_parts(rotation, center) }
}

fn orbit(n: usize) -> Vec<PosedCamera> {
    (0..n)
        .map(|i| {
            let a = i as f64 * 0.7;
            camera_at([0.35 * a.cos(), 0.2, 0.35 * a.sin()])
        })
        .collect()
}

struct Clicked {
    truth: Rigid3<World, Object>,
    cameras: Vec<PosedCamera>,
    correspondences: Vec<Correspondence>,
}

/// `points` clicked in turn in each camera, with Gaussian noise (Irwin-Hall of 12) on the pixels.
fn clicked(seed: u64, cameras: &[PosedCamera], points: &[Point3<f64>], noise_px: f64) -> Clicked {
    let mut rng = rng(seed, 7);
    let mut gauss = || (0..12).map(|_| rng.random::<f64>()).sum::<f64>() - 6.0;
    let truth = Rigid3::exp(&Vector6::new(0.3 * gauss(), 0.5 * gauss(), 0.3 * gauss(), 0.01, 0.0, -0.01));
    let correspondences = points
        .iter()
        .enumerate()
        .map(|(i, p)| {
            let camera_idx = i % cameras.len();
            let camera = &cameras[camera_idx];
            let pixel = camera.intrinsics.img_from_cam(&(camera.world_from_cam.inverse() * (truth * *p))).unwrap();
            let pixel = pixel + Vector2::new(gauss(), gauss()) * noise_px;
            Correspondence { camera_idx, pixel, point_in_object: *p }
        })
        .collect();
    Clicked { truth, cameras: cameras.to_vec(), correspondences }
}

fn solid(seed: u64, n: usize) -> Vec<Point3<f64>> {
    let mut rng = rng(seed, 3);
    (0..n).map(|_| Point3::from(std::array::from_fn(|_| rng.random_range(-0.06..0.06)))).collect()
}

fn estimate(w: &Clicked) -> Result<PoseEstimate, PnpError> {
    estimate_pose(&w.cameras, &w.correspondences, &PnpOptions::default())
}

/// Rotation in degrees, and the shift of the object's origin in millimetres.
fn error(w: &Clicked, found: &Rigid3<World, Object>) -> (f64, f64) {
    let rotation = w.truth.rotation().angle_to(&found.rotation()).to_degrees();
    (rotation, (w.truth.translation() - found.translation()).norm() * 1e3)
}

#[test]
fn clean_clicks_give_the_exact_pose() {
    for cameras in [1, 3] {
        for n in [4, 6, 15] {
            let w = clicked(n as u64, &orbit(cameras), &solid(n as u64, n), 0.0);
            let found = estimate(&w).unwrap();
            let (deg, mm) = error(&w, &found.world_from_object);
            assert!(deg < 1e-5 && mm < 1e-5, "{cameras} cameras, {n} points: {deg} deg, {mm} mm");
            assert_eq!(found.layout, PointLayout::Solid);
        }
    }
}

#[test]
fn wrong_clicks_are_found_and_no_other() {
    let (mut missed, mut accused) = (0, 0);
    for seed in 0..40 {
        let cameras = orbit(1 + seed as usize % 3);
        let mut w = clicked(seed, &cameras, &solid(seed, 14), 1.5);
        for i in [2, 5, 11] {
            w.correspondences[i].pixel += Vector2::new(60.0 + 5.0 * i as f64, -45.0);
        }
        let found = estimate(&w).unwrap();
        for (i, inlier) in found.inliers.iter().enumerate() {
            match (*inlier, [2, 5, 11].contains(&i)) {
                (true, true) => missed += 1,
                (false, false) => accused += 1,
                _ => {}
            }
        }
        let (deg, mm) = error(&w, &found.world_from_object);
        assert!(deg < 2.0 && mm < 4.0, "seed {seed}: {deg} deg, {mm} mm");
    }
    assert_eq!((missed, accused), (0, 0));
}

#[test]
fn the_covariance_predicts_the_error() {
    let mut normalised = 0.0;
    let runs = 200;
    for seed in 0..runs {
        let w = clicked(seed, &orbit(2), &solid(1, 16), 1.0);
        let found = estimate(&w).unwrap();
        let error = (w.truth * found.world_from_object.inverse()).log();
        normalised += error.dot(&(found.covariance.try_inverse().unwrap() * error)) / runs as f64;
    }
    // With 6 of 32 residuals spent on the pose, the statistic is 6 F(6, 26), whose mean is 6 * 26 / 24 = 6.5 and whose
    // mean over 200 runs has a standard deviation of 0.33.
    assert!((5.4..7.6).contains(&normalised), "{normalised}");
}

#[test]
fn analytic_derivatives_match_finite_differences() {
    let camera = camera_at([0.3, 0.25, -0.2]);
    let cam_from_world = camera.world_from_cam.inverse();
    let (r, t) = (cam_from_world.rotation_matrix(), cam_from_world.translation());
    let pose = Rigid3::<World, Object>::exp(&Vector6::new(0.2, 0.1, -0.4, 0.01, 0.02, 0.03));
    let (p, center) = (Point3::new(0.03, -0.02, 0.05), Vector3::new(0.01, 0.0, 0.02));
    let (_, jacobian) = project(&PHONE, &r, &t, &(pose * p).coords, &center).unwrap();
    for i in 0..6 {
        let pixel = |h: f64| {
            let mut step = Vector6::zeros();
            step[i] = h;
            project(&PHONE, &r, &t, &(moved(&pose, &step, &center) * p).coords, &center).unwrap().0
        };
        let numeric = (pixel(1e-6) - pixel(-1e-6)) / 2e-6;
        assert!((numeric - jacobian.column(i)).norm() < 1e-4 * jacobian.column(i).norm().max(1.0));
    }
}

#[test]
fn too_few_and_collinear_points_are_told_apart() {
    let w = clicked(0, &orbit(1), &solid(0, 3), 0.0);
    assert_eq!(estimate(&w), Err(PnpError::TooFew { found: 3 }));
    let line: Vec<_> = (0..8).map(|i| Point3::new(0.01 * f64::from(i), 0.02, -0.005 * f64::from(i))).collect();
    assert!(matches!(estimate(&clicked(0, &orbit(2), &line, 1.0)), Err(PnpError::Collinear { .. })));
    let same = vec![Point3::new(0.01, 0.02, 0.0); 6];
    assert!(matches!(estimate(&clicked(0, &orbit(3), &same, 1.0)), Err(PnpError::Collinear { .. })));
}

#[test]
fn a_plane_seen_close_up_is_solved_and_one_seen_from_afar_is_called_ambiguous() {
    let plane: Vec<Point3<f64>> = solid(4, 10).iter().map(|p| Point3::new(p.x, 0.0, p.z)).collect();
    let near = clicked(4, &[camera_at([0.1, 0.25, 0.1])], &plane, 0.5);
    let found = estimate(&near).unwrap();
    assert_eq!(found.layout, PointLayout::Coplanar);
    let (deg, mm) = error(&near, &found.world_from_object);
    assert!(deg < 2.0 && mm < 4.0, "{deg} deg, {mm} mm");

    let far = clicked(4, &[camera_at([0.8, 4.0, 0.8])], &plane, 0.5);
    assert!(matches!(estimate(&far), Err(PnpError::Ambiguous { .. })), "{:?}", estimate(&far));
}

#[test]
fn a_second_camera_ends_the_ambiguity_of_a_plane() {
    let plane: Vec<Point3<f64>> = solid(4, 12).iter().map(|p| Point3::new(p.x, 0.0, p.z)).collect();
    let cameras = [camera_at([0.8, 4.0, 0.8]), camera_at([-2.0, 3.0, 0.8])];
    let w = clicked(4, &cameras, &plane, 0.5);
    let found = estimate(&w).unwrap();
    let (deg, _) = error(&w, &found.world_from_object);
    assert!(deg < 3.0 * found.rotation_std_rad.to_degrees(), "{deg}");
}

#[test]
fn mirrored_points_are_recognised() {
    for seed in 0..10 {
        let mut w = clicked(seed, &orbit(1 + seed as usize % 2), &solid(seed, 12), 1.0);
        for c in &mut w.correspondences {
            c.point_in_object.y *= -1.0;
        }
        assert!(matches!(estimate(&w), Err(PnpError::Mirrored { .. })), "seed {seed}: {:?}", estimate(&w));
    }
}

#[test]
fn cameras_that_look_away_are_recognised() {
    let mut w = clicked(1, &orbit(3), &solid(1, 12), 0.5);
    let about_face = Rigid3::<Camera, Camera>::from_parts(
        UnitQuaternion::from_scaled_axis(Vector3::y() * std::f64::consts::PI),
        Vector3::zeros(),
    );
    for c in &mut w.cameras {
        c.world_from_cam = c.world_from_cam * about_face;
    }
    for c in &mut w.correspondences {
        c.pixel.x = 2.0 * PHONE.cx - c.pixel.x;
        c.pixel.y = 2.0 * PHONE.cy - c.pixel.y;
    }
    let found = estimate(&w);
    assert!(matches!(found, Err(PnpError::Behind { .. } | PnpError::NoAgreement { .. })), "{found:?}");
}

#[test]
fn clicks_at_random_agree_with_nothing() {
    let mut w = clicked(1, &orbit(2), &solid(1, 14), 0.0);
    let mut rng = rng(5, 5);
    for c in &mut w.correspondences {
        c.pixel = Point2::new(rng.random_range(0.0..1920.0), rng.random_range(0.0..1440.0));
    }
    let found = estimate(&w);
    assert!(matches!(found, Err(PnpError::NoAgreement { .. } | PnpError::Behind { .. })), "{found:?}");
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let mut w = clicked(3, &orbit(2), &solid(3, 12), 2.0);
    w.correspondences[4].pixel.x += 90.0;
    assert_eq!(estimate(&w), estimate(&w));
}

/// A phone's drift moves all clicks of a camera by tens of pixels; one wrong click must not take the others with it.
#[test]
fn a_wrong_click_in_a_drifted_camera_is_found_and_no_other() {
    let options = PnpOptions { drift_deg: 0.6, drift_mm: 4.5, ..PnpOptions::default() };
    for seed in 0..40 {
        let mut w = clicked(seed, &orbit(4), &solid(seed, 20), 1.0);
        // The phone believes its cameras elsewhere than they were.
        let mut rng = rng(seed, 11);
        for camera in &mut w.cameras {
            let shift = Vector3::from_fn(|_, _| rng.random_range(-6.0..6.0f64) * 1e-3);
            camera.world_from_cam = Rigid3::from_parts(
                UnitQuaternion::new(Vector3::from_fn(|_, _| rng.random_range(-0.8..0.8f64).to_radians()))
                    * camera.world_from_cam.rotation(),
                camera.world_from_cam.translation() + shift,
            );
        }
        let wrong = 4 * (seed as usize % 5) + seed as usize % 4;
        w.correspondences[wrong].pixel.x += 90.0;
        let found = estimate_pose(&w.cameras, &w.correspondences, &options).unwrap();
        let left_out: Vec<usize> = (0..20).filter(|i| !found.inliers[*i]).collect();
        assert_eq!(left_out, [wrong], "seed {seed}");
    }
}
