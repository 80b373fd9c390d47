//! The check of a capture on a real RGB-D recording, and on the same recording spoilt.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_capture::{
    CheckOptions, CheckSummary, FrameId, Sequence, check, read_pose_txt, write_intrinsics_txt, write_pose_txt,
};
use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_job::Silent;
use nalgebra::{Matrix4, Vector4};

/// The first eight frames of the recording as a sequence, with poses as `spoil` leaves them.
fn lay_out(source: &Path, out: &Path, spoil: impl Fn(Matrix4<f64>) -> Matrix4<f64>) -> Sequence {
    for i in 0..8u32 {
        let (from, id) = (i * 25, FrameId(i));
        let mut depth = mb_image::read_depth_png(source.join(format!("frame-{from:06}.depth.png"))).unwrap();
        depth.data_mut().iter_mut().filter(|z| **z > 60.0).for_each(|z| *z = 0.0);
        mb_image::write_depth_png(out.join(format!("arkit_depth/{id}.png")), &depth).unwrap();
        std::fs::create_dir_all(out.join("image")).unwrap();
        std::fs::copy(source.join(format!("frame-{from:06}.color.jpg")), out.join(format!("image/{id}.jpg"))).unwrap();
        let (pose, _) = read_pose_txt(source.join(format!("frame-{from:06}.pose.txt"))).unwrap();
        let (pose, _) = Rigid3::<World, Camera>::from_matrix(&spoil(pose.to_matrix())).unwrap();
        write_pose_txt(out.join(format!("pose/{id}.txt")), &pose).unwrap();
        let k = Intrinsics { fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0 };
        write_intrinsics_txt(out.join(format!("intrinsic/{id}.txt")), &k).unwrap();
    }
    Sequence::open(out).unwrap()
}

fn checked(spoil: impl Fn(Matrix4<f64>) -> Matrix4<f64>) -> Option<CheckSummary> {
    let source = mb_testdata::find("seven_scenes_tsdf")?;
    let dir = tempfile::tempdir().unwrap();
    let sequence = lay_out(&source, &dir.path().join("seq"), spoil);
    assert_eq!(sequence.image_size(), ImageSize::new(640, 480));
    Some(check(&sequence, &CheckOptions::default(), &Silent).unwrap())
}

fn conventions(summary: &CheckSummary) -> Vec<&str> {
    summary.problems.iter().filter(|p| p.kind == "convention").map(|p| p.message.as_str()).collect()
}

#[test]
fn a_real_recording_agrees_with_itself() {
    let Some(summary) = checked(|pose| pose) else { return };
    // Its README states medians of 6 to 28 mm between single pairs.
    let found = summary.depth_disagreement_mm.unwrap();
    assert!((3.0..30.0).contains(&found), "{found} mm");
    assert!(conventions(&summary).is_empty(), "{:?}", summary.problems);
}

#[test]
fn mixed_up_conventions_are_named() {
    let flip = Matrix4::from_diagonal(&Vector4::new(1.0, -1.0, -1.0, 1.0));
    let scaled = |factor: f64| {
        move |mut pose: Matrix4<f64>| {
            pose.fixed_view_mut::<3, 1>(0, 3).scale_mut(factor);
            pose
        }
    };
    let transposed = |pose: Matrix4<f64>| {
        let mut spoilt = pose;
        spoilt.fixed_view_mut::<3, 3>(0, 0).copy_from(&pose.fixed_view::<3, 3>(0, 0).transpose());
        spoilt
    };
    type Spoil<'a> = &'a dyn Fn(Matrix4<f64>) -> Matrix4<f64>;
    let cases: [(Spoil<'_>, &str); 7] = [
        (&|pose| pose * flip, "the poses have OpenGL camera axes"),
        (&|pose| pose.try_inverse().unwrap(), "the poses are world-to-camera;"),
        (&|pose| (pose * flip).try_inverse().unwrap(), "the poses are world-to-camera with OpenGL"),
        (&transposed, "the rotations are transposed, while"),
        (&|pose| transposed(pose * flip), "the rotations are transposed and the camera axes are OpenGL's"),
        (&scaled(1000.0), "the translations are in millimetres"),
        (&scaled(0.001), "the translations are too small by 1000"),
    ];
    for (spoil, expected) in cases {
        let Some(summary) = checked(spoil) else { return };
        assert!(!summary.ok);
        let found = conventions(&summary);
        assert!(found.len() == 1 && found[0].contains(expected), "{expected}: {:?}", summary.problems);
    }
}

#[test]
fn depth_in_the_wrong_unit_is_named() {
    let Some(source) = mb_testdata::find("seven_scenes_tsdf") else { return };
    for (factor, expected) in [(0.1f32, "the depth is too small by 10 "), (10.0, "the depth is too large by 10 ")] {
        let dir = tempfile::tempdir().unwrap();
        let sequence = lay_out(&source, &dir.path().join("seq"), |pose| pose);
        for frame in sequence.frames() {
            let (depth, _) = sequence.read_arkit_depth(frame).unwrap();
            mb_image::write_depth_png(frame.arkit_depth.as_ref().unwrap(), &depth.map(|z| z * factor)).unwrap();
        }
        let summary = check(&sequence, &CheckOptions::default(), &Silent).unwrap();
        let found = conventions(&summary);
        assert!(found.len() == 1 && found[0].contains(expected), "{:?}", summary.problems);
    }
}

/// A camera that goes round a point half a metre away, `count` frames, every `step_deg`.
fn orbit(root: &Path, count: u32, step_deg: f64, scale: f64) {
    for i in 0..count {
        let id = FrameId(i);
        let angle = (f64::from(i) * step_deg).to_radians();
        let turn = Rigid3::<World, World>::exp(&nalgebra::Vector6::new(0.0, angle, 0.0, 0.0, 0.0, 0.0));
        let pose = turn * Rigid3::<World, Camera>::from_translation(nalgebra::Vector3::new(0.0, 0.0, -0.5 * scale));
        write_pose_txt(root.join(format!("pose/{id}.txt")), &pose).unwrap();
        let k = Intrinsics { fx: 100.0, fy: 100.0, cx: 63.5, cy: 47.5 };
        write_intrinsics_txt(root.join(format!("intrinsic/{id}.txt")), &k).unwrap();
        let photo = mb_image::RgbImage::from_fn(ImageSize::new(128, 96), |x, y| [(40 + x + y) as u8; 3]);
        mb_image::write_rgb_png(root.join(format!("image/{id}.png")), &photo).unwrap();
    }
}

#[test]
fn a_path_of_the_wrong_size_is_named_without_depth() {
    for (scale, expected) in [(1.0, None), (1000.0, Some("in millimetres")), (0.001, Some("too small by 1000"))] {
        let dir = tempfile::tempdir().unwrap();
        orbit(dir.path(), 24, 15.0, scale);
        let summary = check(&Sequence::open(dir.path()).unwrap(), &CheckOptions::default(), &Silent).unwrap();
        let found = conventions(&summary);
        assert_eq!(found.len(), usize::from(expected.is_some()), "{scale}: {:?}", summary.problems);
        assert!(expected.is_none_or(|expected| found[0].contains(expected)), "{found:?}");
        assert_eq!(summary.orbit_coverage, 24.0 / 36.0);
    }
}

#[test]
fn files_that_change_after_the_import_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let (source, out) = (dir.path().join("source"), dir.path().join("seq"));
    orbit(&source, 6, 10.0, 1.0);
    mb_capture::import(&source, None, &out, &mb_capture::ImportOptions::default(), &Silent).unwrap();
    let summary = |out: &Path| check(&Sequence::open(out).unwrap(), &CheckOptions::default(), &Silent).unwrap();
    let whole = summary(&out);
    assert!(whole.ok, "{:?}", whole.problems);
    let hashes = whole.hashes.unwrap();
    assert_eq!((hashes.files, hashes.changed, hashes.missing, hashes.unknown), (18, 0, 0, 0));
    // Poses that bundle adjustment replaced are no damage: the phone's own are kept beside them.
    std::fs::create_dir(out.join("pose_arkit")).unwrap();
    std::fs::rename(out.join("pose/000001.txt"), out.join("pose_arkit/000001.txt")).unwrap();
    std::fs::copy(out.join("pose/000002.txt"), out.join("pose/000001.txt")).unwrap();
    assert_eq!(summary(&out).hashes.unwrap().changed, 0);
    let photo = out.join("image/000003.png");
    let other = mb_image::RgbImage::from_fn(ImageSize::new(128, 96), |x, y| [(41 + x + y) as u8; 3]);
    mb_image::write_rgb_png(&photo, &other).unwrap();
    std::fs::remove_file(out.join("image/000004.png")).unwrap();
    let spoilt = summary(&out);
    let messages: Vec<_> = spoilt.problems.iter().filter(|p| p.kind == "hash").map(|p| p.message.as_str()).collect();
    assert_eq!(
        messages,
        ["image/000003.png has changed since the import", "image/000004.png is gone since the import"]
    );
}

#[test]
fn rotations_that_are_none_are_named() {
    let dir = tempfile::tempdir().unwrap();
    orbit(dir.path(), 6, 10.0, 1.0);
    let (pose, _) = read_pose_txt(dir.path().join("pose/000002.txt")).unwrap();
    let mut matrix = pose.to_matrix();
    matrix.fixed_view_mut::<3, 3>(0, 0).scale_mut(1.02);
    let rows: Vec<String> =
        matrix.row_iter().map(|r| r.iter().map(ToString::to_string).collect::<Vec<_>>().join(" ")).collect();
    std::fs::write(dir.path().join("pose/000002.txt"), rows.join("\n")).unwrap();
    let summary = check(&Sequence::open(dir.path()).unwrap(), &CheckOptions::default(), &Silent).unwrap();
    let found: Vec<_> = summary.problems.iter().filter(|p| p.kind == "rotation").collect();
    assert!(found.len() == 1 && found[0].frame == Some(FrameId(2)), "{:?}", summary.problems);
    assert!((summary.rotation.worst_determinant - 1.02f64.powi(3)).abs() < 1e-9);
}

#[test]
fn blurred_dark_and_jumping_frames_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("seq");
    for i in 0..12u32 {
        let id = FrameId(i);
        let angle = f64::from(i) * 0.05 + if i >= 9 { 1.5 } else { 0.0 };
        let pose = Rigid3::<World, Camera>::exp(&nalgebra::Vector6::new(0.0, angle, 0.0, 0.4 * angle, 0.0, 0.0));
        write_pose_txt(root.join(format!("pose/{id}.txt")), &pose).unwrap();
        let k = Intrinsics { fx: 100.0, fy: 100.0, cx: 63.5, cy: 47.5 };
        write_intrinsics_txt(root.join(format!("intrinsic/{id}.txt")), &k).unwrap();
        let photo = mb_image::RgbImage::from_fn(ImageSize::new(128, 96), |x, y| match i {
            4 => [(100 + x / 4) as u8; 3],
            6 => [if (x + y) % 2 == 0 { 0 } else { 2 }; 3],
            _ => [if (x / 2 + y / 2) % 2 == 0 { 90 } else { 150 }; 3],
        });
        mb_image::write_rgb_png(root.join(format!("image/{id}.png")), &photo).unwrap();
    }
    let summary = check(&Sequence::open(&root).unwrap(), &CheckOptions::default(), &Silent).unwrap();
    let found =
        |kind: &str| summary.problems.iter().filter(|p| p.kind == kind).map(|p| p.frame.unwrap().0).collect::<Vec<_>>();
    assert_eq!((found("blur"), found("exposure"), found("jump")), (vec![4, 6], vec![6], vec![9]));
    assert!(!summary.ok);
}
