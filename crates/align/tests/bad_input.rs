//! Captures that something is wrong with: each frame's fate is told, and the rest is solved all the same.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

mod capture;

use std::path::Path;

use capture::{Truth, boxes, capture, errors, photograph};
use mb_align::{BundleOptions, FrameOutcome, RefineOptions, RefineSummary, align_bundle, align_refine};
use mb_capture::{FrameId, Sequence, read_pose_txt};
use mb_geometry::{Object, Rigid3};
use mb_image::{Image, RgbImage, read_rgb, write_rgb_png};
use mb_job::{Error, Silent};
use mb_mesh::write_mesh;
use nalgebra::{Point3, Vector6};

fn refine(root: &Path, options: &RefineOptions) -> Result<RefineSummary, Error> {
    align_refine(&Sequence::open(root).unwrap(), options, &Silent)
}

fn image_path(root: &Path, frame: u32) -> std::path::PathBuf {
    root.join(format!("image/{frame:06}.png"))
}

/// How far the object is from where camera `frame` truly sees it, millimetres.
fn error_mm(root: &Path, truth: &Truth, frame: usize) -> f64 {
    let sequence = Sequence::open(root).unwrap();
    let alignment = sequence.read_alignment().unwrap();
    let found = sequence.aligned_frames(&alignment)[frame].world_from_cam.inverse() * alignment.world_from_object;
    let right = truth.cameras[frame].inverse() * truth.world_from_object;
    let middle = Point3::new(0.0, 0.02, 0.0);
    (found * middle - right * middle).norm() * 1e3
}

#[test]
fn without_a_model_or_an_alignment_the_missing_file_is_named() {
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path(), 1.0, 0.5);
    std::fs::remove_file(dir.path().join("model/mesh.ply")).unwrap();
    let sequence = Sequence::open(dir.path()).unwrap();
    for error in [
        align_refine(&sequence, &RefineOptions::default(), &Silent).map(|_| ()),
        align_bundle(&sequence, &BundleOptions::default(), &Silent).map(|_| ()),
    ] {
        let Err(Error::Input(error)) = error else { panic!("accepted: {error:?}") };
        assert!(error.to_string().contains("mesh.ply"), "{error}");
    }
}

#[test]
fn black_and_blurred_frames_are_listed_and_the_others_solved() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let truth = capture(root, 5.0, 2.0);
    let sharp = read_rgb(image_path(root, 2)).unwrap();
    write_rgb_png(image_path(root, 2), &Image::filled(sharp.size(), [0u8; 3])).unwrap();
    let blurred = blur(&read_rgb(image_path(root, 5)).unwrap(), 12);
    write_rgb_png(image_path(root, 5), &blurred).unwrap();

    let summary = refine(root, &RefineOptions::default()).unwrap();
    assert_eq!(summary.frames[2].outcome, FrameOutcome::Unseen, "{summary:?}");
    assert_ne!(summary.frames[5].outcome, FrameOutcome::Solved, "{summary:?}");
    for frame in ["000002", "000005"] {
        assert!(summary.warnings.iter().any(|w| w.contains(frame)), "{:?}", summary.warnings);
    }
    let bundled = align_bundle(&Sequence::open(root).unwrap(), &BundleOptions::default(), &Silent).unwrap();
    assert_eq!(bundled.frames[2].outcome, FrameOutcome::Unseen, "{bundled:?}");
    assert!(bundled.warnings.iter().any(|w| w.contains("000002")), "{:?}", bundled.warnings);
    for frame in [0, 1, 3, 4, 6, 7] {
        assert_eq!(bundled.frames[frame].outcome, FrameOutcome::Solved, "{bundled:?}");
        let mm = error_mm(root, &truth, frame);
        assert!(mm < 0.8, "frame {frame} is {mm} mm off");
    }
    // The black frame lies where its neighbours' drift puts it: no worse than the phone had it.
    assert!(error_mm(root, &truth, 2) < 8.0);
}

/// Box blur.
fn blur(image: &RgbImage, radius: isize) -> RgbImage {
    let (width, height) = (image.width() as isize, image.height() as isize);
    let pass = |from: &RgbImage, dx: isize, dy: isize| {
        Image::from_fn(from.size(), |x, y| {
            std::array::from_fn(|c| {
                let sum: u32 = (-radius..=radius)
                    .map(|i| {
                        let u = (x as isize + i * dx).clamp(0, width - 1) as usize;
                        let v = (y as isize + i * dy).clamp(0, height - 1) as usize;
                        u32::from(from[(u, v)][c])
                    })
                    .sum();
                (sum / (2 * radius as u32 + 1)) as u8
            })
        })
    };
    pass(&pass(image, 1, 0), 0, 1)
}

#[test]
fn an_object_that_was_pushed_is_found_and_named() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let truth = capture(root, 3.0, 1.0);
    // From frame 4 on it stands 18 mm further and turned by 3 degrees.
    let pushed = Rigid3::<Object, Object>::exp(&Vector6::new(0.0, 0.05, 0.0, 0.015, 0.0, 0.01));
    for frame in 4..8 {
        let cam_from_object = truth.cameras[frame].inverse() * truth.world_from_object * pushed;
        write_rgb_png(image_path(root, frame as u32), &photograph(&boxes(), &cam_from_object)).unwrap();
    }
    let summary = refine(root, &RefineOptions::default()).unwrap();
    let told = |w: &String| w.contains("between frames 000003 and 000004") && w.contains("moved");
    let lost = (4..8).all(|i| summary.frames[i].outcome != FrameOutcome::Solved);
    assert!(lost || summary.warnings.iter().any(told), "{summary:?}");
}

#[test]
fn a_model_of_another_size_is_found_out() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let truth = capture(root, 3.0, 1.0);
    let mut larger = boxes();
    larger.vertices.iter_mut().for_each(|v| *v = Point3::from(v.coords * 1.05));
    write_mesh(root.join("model/mesh.ply"), &larger).unwrap();
    let summary = refine(root, &RefineOptions { scale: true, ..RefineOptions::default() }).unwrap();
    assert!((summary.scale - 1.0 / 1.05).abs() < 0.01, "{summary:?}");
    assert!(summary.warnings.iter().any(|w| w.contains("smaller than the model")), "{:?}", summary.warnings);

    // With the right model, freeing its size changes nothing but a little play.
    write_mesh(root.join("model/mesh.ply"), &boxes()).unwrap();
    let summary = refine(root, &RefineOptions { scale: true, ..RefineOptions::default() }).unwrap();
    assert!((summary.scale - 1.0).abs() < 0.01, "{summary:?}");
    assert!(!summary.warnings.iter().any(|w| w.contains("than the model")), "{:?}", summary.warnings);
    assert!(errors(root, &truth).0 < 0.6, "{:?}", errors(root, &truth));
}

#[test]
fn a_frame_that_looks_away_and_one_without_photograph_hang_by_their_neighbours() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let truth = capture(root, 3.0, 1.0);
    std::fs::remove_file(image_path(root, 6)).unwrap();
    let away = Image::filled(capture::SIZE, [150, 140, 125]);
    write_rgb_png(image_path(root, 1), &away).unwrap();
    let before = read_pose_txt(root.join("pose/000006.txt")).unwrap().0;
    let summary = refine(root, &RefineOptions::default()).unwrap();
    assert_eq!(summary.frames[1].outcome, FrameOutcome::Unseen);
    assert!(!summary.frames.iter().any(|f| f.frame == FrameId(6)));
    let bundled = align_bundle(&Sequence::open(root).unwrap(), &BundleOptions::default(), &Silent).unwrap();
    for frame in [1, 6] {
        assert_eq!(bundled.frames[frame].outcome, FrameOutcome::Unseen, "{bundled:?}");
        assert!(error_mm(root, &truth, frame) < 8.0);
    }
    let after = read_pose_txt(root.join("pose/000006.txt")).unwrap().0;
    assert!((after.inverse() * before).log().norm() < 0.05, "the frame without a photograph ran away");
}

#[test]
fn too_few_matches_leave_the_edges_to_decide() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let truth = capture(root, 4.0, 1.0);
    refine(root, &RefineOptions::default()).unwrap();
    let options = BundleOptions { features: 5, ..BundleOptions::default() };
    let bundled = align_bundle(&Sequence::open(root).unwrap(), &options, &Silent).unwrap();
    assert!(bundled.observations < 100);
    assert!(bundled.warnings.iter().any(|w| w.contains("features in common")), "{:?}", bundled.warnings);
    assert!(errors(root, &truth).0 < 0.8, "{:?}", errors(root, &truth));
}
