//! Pose from 15 points with 1 px of noise, 1,000 random problems: median errors and CPU time per problem.
//!
//! `cargo bench -p mb-align --bench pnp -- FILE` also writes the problems to FILE, from which `benches/opencv_pnp.py`
//! computes what OpenCV finds.

use std::fmt::Write as _;

use cpu_time::ProcessTime;
use mb_align::{Correspondence, PnpOptions, PosedCamera, estimate_pose};
use mb_geometry::{Intrinsics, Object, Rigid3, World};
use nalgebra::{Point3, UnitQuaternion, Vector2, Vector3};
use rand::RngExt;

const PROBLEMS: u64 = 1000;

fn main() {
    let intrinsics = Intrinsics { fx: 1460.0, fy: 1460.0, cx: 959.5, cy: 719.5 };
    let camera = PosedCamera { intrinsics, world_from_cam: Rigid3::identity() };
    let problems: Vec<(Rigid3<World, Object>, Vec<Correspondence>)> =
        (0..PROBLEMS).map(|seed| problem(seed, &camera)).collect();

    let start = ProcessTime::now();
    let estimates: Vec<_> =
        problems.iter().map(|(_, points)| estimate_pose(&[camera], points, &PnpOptions::default())).collect();
    let seconds = start.elapsed().as_secs_f64();

    let (mut rotation_deg, mut translation_mm, mut failed) = (Vec::new(), Vec::new(), 0);
    for ((truth, _), estimate) in problems.iter().zip(&estimates) {
        match estimate {
            Ok(found) => {
                let found = found.world_from_object;
                rotation_deg.push(truth.rotation().angle_to(&found.rotation()).to_degrees());
                translation_mm.push((truth.translation() - found.translation()).norm() * 1e3);
            }
            Err(_) => failed += 1,
        }
    }
    println!(
        "median rotation {:.4} deg, median translation {:.4} mm, {failed} failed, {:.1} us CPU a problem",
        median(&mut rotation_deg),
        median(&mut translation_mm),
        seconds * 1e6 / PROBLEMS as f64
    );

    if let Some(path) = std::env::args().skip(1).find(|a| !a.starts_with('-')) {
        let mut text = String::new();
        for (truth, points) in &problems {
            let w = truth.rotation().scaled_axis();
            let t = truth.translation();
            let _ = write!(text, "{} {} {} {} {} {}", w.x, w.y, w.z, t.x, t.y, t.z);
            for c in points {
                let (p, q) = (c.point_in_object, c.pixel);
                let _ = write!(text, " {} {} {} {} {}", p.x, p.y, p.z, q.x, q.y);
            }
            text.push('\n');
        }
        mb_job::write_atomic(path, text.as_bytes()).expect("the problem file can be written");
    }
}

/// Points in a box of 12 cm, 30 to 50 cm from the camera.
fn problem(seed: u64, camera: &PosedCamera) -> (Rigid3<World, Object>, Vec<Correspondence>) {
    let mut rng = mb_job::rng(seed, 0);
    let mut uniform = |low: f64, high: f64| rng.random_range(low..high);
    let axis = Vector3::new(uniform(-1.0, 1.0), uniform(-1.0, 1.0), uniform(-1.0, 1.0)).normalize();
    let turn = UnitQuaternion::from_scaled_axis(axis * uniform(0.0, std::f64::consts::PI));
    let shift = Vector3::new(uniform(-0.05, 0.05), uniform(-0.05, 0.05), uniform(0.3, 0.5));
    let world_from_object = Rigid3::from_parts(turn, shift);
    let points = (0..15)
        .map(|_| {
            let p = Point3::new(uniform(-0.06, 0.06), uniform(-0.06, 0.06), uniform(-0.06, 0.06));
            let pixel = camera.intrinsics.img_from_cam(&Point3::from((world_from_object * p).coords));
            let pixel = pixel.expect("the box lies in front of the camera");
            // Box and Muller's normal deviates.
            let (radius, angle) = ((-2.0 * uniform(1e-300, 1.0).ln()).sqrt(), uniform(0.0, std::f64::consts::TAU));
            let noise = Vector2::new(angle.cos(), angle.sin()) * radius;
            Correspondence { camera_idx: 0, pixel: pixel + noise, point_in_object: p }
        })
        .collect();
    (world_from_object, points)
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    let middle = values.len() / 2;
    (values[middle] + values[values.len() - 1 - middle]) / 2.0
}
