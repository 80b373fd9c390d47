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
    let Some(summary) = checked(|pose| pose * flip) else { return };
    assert!(conventions(&summary)[0].contains("OpenGL"), "{:?}", summary.problems);
    let Some(summary) = checked(|pose| pose.try_inverse().unwrap()) else { return };
    assert!(conventions(&summary)[0].contains("world-to-camera"), "{:?}", summary.problems);
    let millimetres = |mut pose: Matrix4<f64>| {
        for row in 0..3 {
            pose[(row, 3)] *= 1000.0;
        }
        pose
    };
    let Some(summary) = checked(millimetres) else { return };
    assert!(conventions(&summary)[0].contains("millimetres"), "{:?}", summary.problems);
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
