//! How exact alignment is, stage by stage, on simulated captures whose truth is known.
//!
//! `cargo bench -p mb-align --bench accuracy -- SEQUENCE...` aligns simulated captures from their clicks on. For each stage:
//! the error of the object as the cameras see it (`object`: what all cameras have in common, in the object's frame, shift
//! of its middle and turn; `own`: root mean square over the cameras whose own photograph determines them; `frames`: over
//! all; `toward`: mean along the cameras' axes), the cameras in the object's frame (as `eval poses` has it), and the share
//! of the model's pixels whose rendered depth is within 0.5 mm of the truth. `ABLATION=1` adds the bundle adjustment
//! without each of its terms.

use std::path::Path;

use cpu_time::ProcessTime;
use mb_align::{BundleOptions, KeypointOptions, RefineOptions, align_bundle, align_keypoints, align_refine};
use mb_capture::{Alignment, Sequence};
use mb_geometry::{Camera, Object, Rigid3};
use mb_job::{Result, Silent};
use mb_mesh::read_mesh;
use mb_render::{Scene, View};
use nalgebra::Vector3;

fn main() {
    println!(
        "{:<16} {:<15} {:>15} {:>15} {:>15} {:>23} {:>15} {:>6} {:>6}  expected",
        "sequence",
        "stage",
        "object mm deg",
        "own mm deg",
        "frames mm deg",
        "toward x y z mm",
        "cameras mm deg",
        "depth%",
        "CPU s"
    );
    for folder in std::env::args().skip(1).filter(|a| !a.starts_with("--")) {
        measure(Path::new(&folder));
    }
}

fn bundle(options: BundleOptions) -> impl Fn(&Sequence) -> Result<String> {
    move |s| {
        align_bundle(s, &options, &Silent).map(|r| {
            let n = r.frames.len() as f64;
            let mean_sq = r.frames.iter().map(|f| f.position_std_mm.powi(2)).sum::<f64>() / n;
            let points = (r.surface_points, r.free_points);
            format!("{:.2} mm; points {} {}, {:.2} px", mean_sq.sqrt(), points.0, points.1, r.rms_px)
        })
    }
}

/// Aligns a sequence further and says what error it expects.
type Stage = Box<dyn Fn(&Sequence) -> Result<String>>;

fn measure(folder: &Path) {
    let all = BundleOptions::default;
    let keypoints = |s: &Sequence| {
        align_keypoints(s, &KeypointOptions::default(), &Silent)
            .map(|r| format!("{:.2} mm {:.2} deg", r.translation_std_mm, r.rotation_std_deg))
    };
    let refine = |s: &Sequence| {
        align_refine(s, &RefineOptions::default(), &Silent).map(|r| {
            let (mm, deg) = (r.expected_error_mm, r.expected_error_deg);
            format!(
                "{mm:.2} mm {deg:.2} deg, confidence {:.2}, scale {:.4} +- {:.4}",
                r.confidence, r.scale, r.scale_std
            )
        })
    };
    let mut stages: Vec<(&str, Stage)> =
        vec![("keypoints", Box::new(keypoints)), ("refine", Box::new(refine)), ("bundle", Box::new(bundle(all())))];
    if std::env::var_os("ABLATION").is_some() {
        let mut without = |name, options| stages.push((name, Box::new(bundle(options))));
        without("- free points", BundleOptions { free_points: false, ..all() });
        without("- surface", BundleOptions { surface_points: false, ..all() });
        without("- contours", BundleOptions { contours: false, ..all() });
        without("- phone steps", BundleOptions { relative_poses: false, ..all() });
        without("- rounds", BundleOptions { rounds: 1, ..all() });
        without("+ focal", BundleOptions { focal: true, ..all() });
        let paper = BundleOptions { free_points: false, contours: false, relative_poses: false, ..all() };
        without("as published", paper);
    }
    for (stage, run) in stages {
        // Each bundle adjustment starts from the refined alignment.
        let refined = folder.join("refined.json");
        let file = folder.join(Alignment::FILE);
        if stage != "keypoints" && stage != "refine" && stage != "bundle" {
            std::fs::copy(&refined, &file).expect("the refined alignment is kept");
        }
        let sequence = Sequence::open(folder).expect("the capture can be read");
        let start = ProcessTime::now();
        match run(&sequence) {
            Ok(expected) => report(folder, stage, start.elapsed().as_secs_f64(), &expected),
            Err(e) => println!("{:<16} {stage:<15} failed: {e}", sequence.name()),
        }
        if stage == "refine" {
            std::fs::copy(&file, &refined).expect("the refined alignment can be kept");
        }
    }
}

fn report(folder: &Path, stage: &str, cpu_s: f64, expected: &str) {
    let sequence = Sequence::open(folder).expect("the capture can be read");
    let alignment = sequence.read_alignment().expect("the stage wrote an alignment");
    let truth = Alignment::read(folder.join("simulation/alignment.json")).expect("the truth is known");
    let mesh = read_mesh(sequence.model_mesh_path()).expect("the model is there");
    let middle = mesh.bounds().center();
    let scene = Scene::new(&mesh);

    let frames = sequence.aligned_frames(&alignment);
    let n = frames.len() as f64;
    let (mut shift, mut turn) = (Vector3::zeros(), Vector3::zeros());
    // Count, and sums of squares of shifts and turns: of frames that have a covariance, and of all.
    let mut own = (0usize, 0.0, 0.0);
    let mut whole = own;
    let (mut close, mut pixels) = (0usize, 0usize);
    let mut toward = Vector3::zeros();
    let (mut center_sq, mut angle) = (0.0, 0.0);
    for (i, (frame, right)) in frames.iter().zip(&truth.frames).enumerate() {
        let found: Rigid3<Camera, Object> = frame.world_from_cam.inverse() * alignment.world_from_object;
        let right: Rigid3<Camera, Object> = right.world_from_cam.inverse() * truth.world_from_object;
        // Where the object is found to stand, as a motion of the true one.
        let error = right.inverse() * found;
        let by = error * middle - middle;
        toward += right.rotate(&by) / n;
        (shift, turn) = (shift + by / n, turn + error.rotation().scaled_axis() / n);
        let has_own = alignment.frames.iter().any(|f| f.frame == frame.id && f.covariance.is_some());
        for sums in [&mut whole].into_iter().chain(has_own.then_some(&mut own)) {
            *sums = (sums.0 + 1, sums.1 + by.norm_squared(), sums.2 + error.angle_rad().powi(2));
        }
        center_sq += (found.inverse().translation() - right.inverse().translation()).norm_squared() / n;
        angle += found.rotation().angle_to(&right.rotation()).to_degrees() / n;
        if i % 4 == 0 {
            let depth = |cam_from_frame| {
                scene.depth(&View { intrinsics: frame.intrinsics, size: sequence.image_size(), cam_from_frame })
            };
            for (a, b) in depth(found).data().iter().zip(depth(right).data()).filter(|(_, b)| **b > 0.0) {
                pixels += 1;
                close += usize::from((a - b).abs() < 5e-4);
            }
        }
    }
    let rms = |count: usize, sum_sq: f64| f64::sqrt(sum_sq / count as f64);
    println!(
        "{:<16} {stage:<15} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>7.3} {:>6.1} \
         {cpu_s:>6.1}  {expected}",
        sequence.name(),
        shift.norm() * 1e3,
        turn.norm().to_degrees(),
        rms(own.0, own.1) * 1e3,
        rms(own.0, own.2).to_degrees(),
        rms(whole.0, whole.1) * 1e3,
        rms(whole.0, whole.2).to_degrees(),
        toward.x * 1e3,
        toward.y * 1e3,
        toward.z * 1e3,
        f64::sqrt(center_sq) * 1e3,
        angle,
        100.0 * close as f64 / pixels.max(1) as f64
    );
}
