//! A whole simulated capture, held to what it claims.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

use mb_capture::{Alignment, AlignmentStage, Keypoints, Sequence};
use mb_geometry::ImageSize;
use mb_job::{Error, Progress, Silent};
use mb_mesh::TriangleMesh;
use mb_render::{Scene, View};
use mb_simulate::{Quality, SimulateOptions, simulate};
use nalgebra::Point3;

/// A box of 16 x 6 x 8 cm with a 4 x 4 x 4 cm box on top, each a part of its own colour, and a stud.
fn model() -> TriangleMesh {
    let mut mesh =
        TriangleMesh { triangle_colors: Some(vec![]), triangle_parts: Some(vec![]), ..TriangleMesh::default() };
    let boxes = [
        ([-0.08, 0.0, -0.04], [0.08, 0.06, 0.04], [200, 30, 20]),
        ([-0.07, 0.06, -0.02], [-0.03, 0.10, 0.02], [30, 60, 190]),
        ([0.0376, 0.06, -0.0024], [0.0424, 0.0618, 0.0024], [200, 30, 20]),
    ];
    for (part, (min, max, color)) in boxes.into_iter().enumerate() {
        let first = mesh.vertices.len() as u32;
        for i in 0..8 {
            let pick = |axis: usize| if i >> axis & 1 == 0 { min[axis] } else { max[axis] };
            mesh.vertices.push(Point3::new(pick(0), pick(1), pick(2)));
        }
        for [a, b, c, d] in [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]] {
            mesh.triangles.extend([[a, b, c], [a, c, d]].map(|t: [u32; 3]| t.map(|v| v + first)));
            mesh.triangle_colors.get_or_insert_default().extend([color; 2]);
            mesh.triangle_parts.get_or_insert_default().extend([part as u32; 2]);
        }
    }
    mesh
}

fn small() -> SimulateOptions {
    SimulateOptions { frames: 4, size: ImageSize::new(160, 120), quality: Quality::Draft, ..SimulateOptions::default() }
}

/// Every file of a folder with its bytes.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            let inner = contents(&path);
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            files.extend(inner.into_iter().map(|(file, bytes)| (format!("{name}/{file}"), bytes)));
        } else {
            files.insert(path.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(&path).unwrap());
        }
    }
    files
}

#[test]
fn same_seed_same_bytes_on_one_thread_and_on_three() {
    let dir = tempfile::tempdir().unwrap();
    let run = |threads: usize, name: &str| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| simulate(&model(), &small(), &dir.path().join(name), &Silent).unwrap());
        contents(&dir.path().join(name))
    };
    let (one, three) = (run(1, "one"), run(3, "three"));
    assert_eq!(one.keys().collect::<Vec<_>>(), three.keys().collect::<Vec<_>>());
    for (name, bytes) in &one {
        assert!(bytes == &three[name], "{name} differs");
    }
}

#[test]
fn a_stopped_run_is_taken_up_and_ends_like_an_unbroken_one() {
    struct StopAfter(AtomicUsize);
    impl Progress for StopAfter {
        fn report(&self, what: &str, done: usize, _total: usize) {
            if what == "frames" && done > 0 {
                self.0.fetch_add(1, Ordering::Relaxed);
            }
        }
        fn stop_requested(&self) -> bool {
            self.0.load(Ordering::Relaxed) >= 2
        }
    }
    let dir = tempfile::tempdir().unwrap();
    let (broken, whole) = (dir.path().join("broken"), dir.path().join("whole"));
    let stopped = simulate(&model(), &small(), &broken, &StopAfter(AtomicUsize::new(0)));
    assert!(matches!(stopped, Err(Error::Stopped)));
    assert!(!broken.join("sequence.json").exists());
    let summary = simulate(&model(), &small(), &broken, &Silent).unwrap();
    assert_eq!(summary.frames_kept, 2);
    simulate(&model(), &small(), &whole, &Silent).unwrap();
    assert!(contents(&broken) == contents(&whole));
    // Other options must not mix with what is there.
    let other = SimulateOptions { seed: 1, ..small() };
    assert!(matches!(simulate(&model(), &other, &whole, &Silent), Err(Error::Input(_))));
    std::fs::create_dir(dir.path().join("mine")).unwrap();
    std::fs::write(dir.path().join("mine/letter.txt"), "dear").unwrap();
    assert!(matches!(simulate(&model(), &small(), &dir.path().join("mine"), &Silent), Err(Error::Input(_))));
}

#[test]
fn clicks_are_where_the_truth_puts_visible_corners() {
    let dir = tempfile::tempdir().unwrap();
    let options = SimulateOptions { size: ImageSize::new(960, 720), ..small() };
    simulate(&model(), &options, dir.path(), &Silent).unwrap();
    let sequence = Sequence::open(dir.path()).unwrap();
    let truth = Alignment::read(dir.path().join("simulation/alignment.json")).unwrap();
    assert_eq!(truth.stage, AlignmentStage::Truth);
    let frames = sequence.aligned_frames(&truth);
    let clicks = Keypoints::read(dir.path().join(Keypoints::FILE)).unwrap().keypoints;
    assert!((10..=20).contains(&clicks.len()), "{}", clicks.len());
    let mesh = mb_mesh::read_mesh(sequence.model_mesh_path()).unwrap();
    assert_eq!(mesh.triangle_parts, model().triangle_parts);
    let scene = Scene::new(&mesh);
    let mut squares = 0.0;
    for click in &clicks {
        let frame = frames.iter().find(|f| f.id == click.frame).unwrap();
        let cam_from_object = frame.world_from_cam.inverse() * truth.world_from_object;
        let p = cam_from_object * click.point_in_object_m;
        let pixel = frame.intrinsics.img_from_cam(&p).unwrap();
        squares += (pixel - click.pixel).norm_squared();
        let view = View { intrinsics: frame.intrinsics, size: sequence.image_size(), cam_from_frame: cam_from_object };
        let depth = scene.depth(&view);
        let seen = depth.get(pixel.x.round() as usize, pixel.y.round() as usize).copied().unwrap();
        assert!(seen == 0.0 || f64::from(seen) > p.z - 1e-3, "{} is hidden", click.name);
    }
    // 2 px at 1920 is 1 px here, along each axis.
    let rms = (squares / (2.0 * clicks.len() as f64)).sqrt();
    assert!((0.6..1.5).contains(&rms), "clicks are off by {rms} px");
    let frames_clicked: std::collections::BTreeSet<_> = clicks.iter().map(|c| c.frame).collect();
    assert_eq!(frames_clicked.len(), 4);
}

#[test]
fn depth_errs_like_a_phones_and_studs_vanish() {
    let dir = tempfile::tempdir().unwrap();
    let options = SimulateOptions { frames: 8, ..small() };
    simulate(&model(), &options, dir.path(), &Silent).unwrap();
    let sequence = Sequence::open(dir.path()).unwrap();
    let truth = Alignment::read(dir.path().join("simulation/alignment.json")).unwrap();
    let scene = Scene::new(&model());
    // Mean errors on the stud and on the surface that it stands on, near it.
    let (mut sure, mut on_stud, mut beside) = (Vec::new(), (0.0, 0usize), (0.0, 0usize));
    for frame in sequence.aligned_frames(&truth) {
        let (depth, confidence) = sequence.read_arkit_depth(&frame).unwrap();
        assert_eq!(depth.size(), ImageSize::new(256, 192));
        let intrinsics = frame.intrinsics.resized(sequence.image_size(), depth.size());
        let cam_from_object = frame.world_from_cam.inverse() * truth.world_from_object;
        let exact = scene.render(&View { intrinsics, size: depth.size(), cam_from_frame: cam_from_object });
        let stud = intrinsics.img_from_cam(&(cam_from_object * Point3::new(0.04, 0.0618, 0.0))).unwrap();
        for y in 0..192 {
            for x in 0..256 {
                let (triangle, z) = (exact.triangle[(x, y)], f64::from(depth[(x, y)]));
                if triangle == u32::MAX || z == 0.0 {
                    continue;
                }
                let error = z - f64::from(exact.depth[(x, y)]);
                if confidence[(x, y)] == 2 {
                    sure.push(error.abs());
                }
                let near = (stud.x - x as f64).hypot(stud.y - y as f64) < 8.0;
                let group = if triangle >= 24 { &mut on_stud } else { &mut beside };
                if near {
                    *group = (group.0 + error, group.1 + 1);
                }
            }
        }
    }
    sure.sort_by(f64::total_cmp);
    let median_mm = 1e3 * sure[sure.len() / 2];
    assert!((1.5..9.0).contains(&median_mm), "median error {median_mm} mm");
    assert!(sure.len() > 1000);
    // Seen from 28 to 50 degrees above, the stud is about 1.2 mm nearer than what it stands on; the phone sees no step.
    let mean_mm = |(sum, count): (f64, usize)| 1e3 * sum / count as f64;
    let missing_mm = mean_mm(on_stud) - mean_mm(beside);
    assert!(on_stud.1 > 50 && missing_mm > 0.6, "{missing_mm} mm of the stud are missing, over {} pixels", on_stud.1);
}

#[test]
fn bad_options_and_models_are_refused_in_words() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |model: &TriangleMesh, options: &SimulateOptions| {
        let out = dir.path().join("out");
        let message = simulate(model, options, &out, &Silent).unwrap_err().to_string();
        assert!(!out.exists(), "{message}");
        message
    };
    assert!(refused(&model(), &SimulateOptions { frames: 0, ..small() }).contains("frames is 0"));
    assert!(
        refused(&model(), &SimulateOptions { elevations_deg: vec![f64::NAN], ..small() }).contains("elevations_deg")
    );
    assert!(refused(&TriangleMesh::default(), &small()).contains("no triangles"));
    let mut millimetres = model();
    millimetres.vertices.iter_mut().for_each(|v| v.coords *= 1000.0);
    assert!(refused(&millimetres, &small()).contains("in metres"));
}
