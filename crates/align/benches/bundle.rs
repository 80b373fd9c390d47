//! The Schur solver on 60 cameras, 20,000 points and 200,000 observations with half a pixel of noise.
//!
//! `cargo bench -p mb-align --bench bundle -- FILE` also writes the problem to FILE, which `benches/pycolmap_bundle.py`
//! solves with pycolmap (Ceres): the root mean square residuals must agree.

use std::fmt::Write as _;

use cpu_time::ProcessTime;
use mb_align::{AdjustedCamera, AdjustedPoint, Adjustment, PointObservation};
use mb_geometry::{Camera, Intrinsics, Rigid3, World};
use nalgebra::{Matrix6, Point3, UnitQuaternion, Vector2, Vector3, Vector6};
use rand::RngExt;
use rand::seq::SliceRandom;

const CAMERAS: usize = 60;
const POINTS: usize = 20_000;
const VIEWS: usize = 10;

fn main() {
    let mut problem = problem();
    if let Some(path) = std::env::args().skip(1).find(|a| !a.starts_with('-')) {
        write(&problem, &path);
    }
    println!("start: rms {:.6} px", rms(&problem));
    let start = ProcessTime::now();
    problem.solve(&[], 50).expect("the problem has a solution");
    println!("end: rms {:.6} px, {:.2} CPU s", rms(&problem), start.elapsed().as_secs_f64());
}

/// Cameras on a circle round a cloud of points, both wrong by some millimetres.
fn problem() -> Adjustment {
    let mut rng = mb_job::rng(1, 0);
    let intrinsics = Intrinsics { fx: 1460.0, fy: 1460.0, cx: 959.5, cy: 719.5 };
    let mut cameras = Vec::with_capacity(CAMERAS);
    for i in 0..CAMERAS {
        let angle = i as f64 / CAMERAS as f64 * std::f64::consts::TAU;
        let eye = Vector3::new(0.35 * angle.cos(), 0.2 + 0.05 * (3.0 * angle).sin(), 0.35 * angle.sin());
        let pose = Rigid3::<World, Camera>::from_parts(UnitQuaternion::face_towards(&-eye, &-Vector3::y()), eye);
        let cam_from_world = pose.inverse();
        cameras.push(AdjustedCamera { intrinsics, cam_from_world, drift: Rigid3::identity(), log_focal: 0.0 });
    }
    let mut adjustment = Adjustment {
        cameras,
        points: Vec::with_capacity(POINTS),
        center: Vector3::zeros(),
        feature_px: 1.0,
        surface_m: 1.0,
        drift_information: Matrix6::identity() * 1e-3,
        step_information: Matrix6::zeros(),
        focal_information: f64::INFINITY,
    };
    let mut normal = || {
        let (radius, angle) =
            ((-2.0 * rng.random_range(1e-300..1.0f64).ln()).sqrt(), rng.random_range(0.0..std::f64::consts::TAU));
        radius * f64::cos(angle)
    };
    let mut order: Vec<usize> = (0..CAMERAS).collect();
    let mut shuffle = mb_job::rng(1, 1);
    for _ in 0..POINTS {
        let in_world = Point3::from(Vector3::from_fn(|_, _| 0.03 * normal()));
        order.shuffle(&mut shuffle);
        let mut point = AdjustedPoint { in_world, surface: None, observations: Vec::with_capacity(VIEWS) };
        for &camera_idx in &order[..VIEWS] {
            let p = adjustment.cameras[camera_idx].cam_from_world * in_world;
            let pixel = intrinsics.img_from_cam(&p).expect("points lie before the cameras");
            let pixel = pixel + Vector2::new(normal(), normal()) * 0.5;
            point.observations.push(PointObservation { camera_idx, pixel, is_inlier: true });
        }
        point.in_world += Vector3::from_fn(|_, _| 0.002 * normal());
        adjustment.points.push(point);
    }
    for camera in &mut adjustment.cameras {
        let error = Rigid3::exp(&Vector6::from_fn(|k, _| normal() * if k < 3 { 0.005 } else { 0.003 }));
        camera.cam_from_world = camera.cam_from_world * error;
    }
    adjustment
}

/// Root mean square residual per coordinate.
fn rms(problem: &Adjustment) -> f64 {
    let (mut sum, mut n) = (0.0, 0.0);
    for point in &problem.points {
        for o in &point.observations {
            sum += problem.residual(point, o).map_or(0.0, |r| r.norm_squared());
            n += 2.0;
        }
    }
    f64::sqrt(sum / n)
}

/// Cameras (x, y, z, w of the rotation and the translation of `cam_from_world`), points, observations; one a line.
fn write(problem: &Adjustment, path: &str) {
    let mut text = format!("{CAMERAS} {POINTS} {}\n", POINTS * VIEWS);
    for camera in &problem.cameras {
        let (q, t) = (camera.cam_from_world.rotation().coords, camera.cam_from_world.translation());
        let _ = writeln!(text, "{} {} {} {} {} {} {}", q.x, q.y, q.z, q.w, t.x, t.y, t.z);
    }
    for p in problem.points.iter().map(|p| p.in_world) {
        let _ = writeln!(text, "{} {} {}", p.x, p.y, p.z);
    }
    for (i, point) in problem.points.iter().enumerate() {
        for o in &point.observations {
            let _ = writeln!(text, "{} {i} {} {}", o.camera_idx, o.pixel.x, o.pixel.y);
        }
    }
    mb_job::write_atomic(path, text.as_bytes()).expect("the problem file can be written");
}
