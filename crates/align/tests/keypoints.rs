//! `align keypoints` on sequence folders, good and bad.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_align::{KeypointOptions, KeypointSummary, align_keypoints};
use mb_capture::{
    Alignment, AlignmentStage, FrameId, Keypoint, Keypoints, Sequence, write_intrinsics_txt, write_pose_txt,
};
use mb_geometry::{Intrinsics, Object, Rigid3, World};
use mb_job::{Error, Silent};
use nalgebra::{Point2, Point3, UnitQuaternion, Vector2, Vector3, Vector6};

const PHONE: Intrinsics = Intrinsics { fx: 1458.5, fy: 1458.5, cx: 962.0, cy: 724.5 };

fn truth() -> Rigid3<World, Object> {
    Rigid3::exp(&Vector6::new(0.1, 0.8, -0.05, 0.02, -0.4, -0.1))
}

/// Three frames 35 cm from the object, and twelve points clicked to within half a pixel.
fn capture(root: &Path) -> Keypoints {
    capture_of(root, 3)
}

fn capture_of(root: &Path, frames: u32) -> Keypoints {
    let mut keypoints = Vec::new();
    for frame in 0..frames {
        let angle = f64::from(frame);
        let target = truth().translation();
        let center = target + Vector3::new(0.3 * angle.cos(), 0.2, 0.3 * angle.sin());
        let world_from_cam =
            Rigid3::from_parts(UnitQuaternion::face_towards(&(target - center), &-Vector3::y()), center);
        write_pose_txt(root.join(format!("pose/{frame:06}.txt")), &world_from_cam).unwrap();
        write_intrinsics_txt(root.join(format!("intrinsic/{frame:06}.txt")), &PHONE).unwrap();
        for i in 0..4u32 {
            let p = Point3::new(0.02 * f64::from(i) - 0.03, 0.0096 * f64::from((i + frame) % 3), 0.024 * angle - 0.02);
            let pixel = PHONE.img_from_cam(&(world_from_cam.inverse() * (truth() * p))).unwrap();
            let pixel = Point2::new(pixel.x.round(), pixel.y.round());
            keypoints.push(Keypoint { frame: FrameId(frame), pixel, point_in_object_m: p, name: format!("stud {i}") });
        }
    }
    let keypoints = Keypoints { version: 1, author: "test".to_owned(), time: String::new(), keypoints };
    keypoints.write(root.join(Keypoints::FILE)).unwrap();
    keypoints
}

fn run(root: &Path) -> Result<KeypointSummary, Error> {
    align_keypoints(&Sequence::open(root).unwrap(), &KeypointOptions::default(), &Silent)
}

/// The message of the failure, which must be bad input, and must leave no alignment behind.
fn refusal(root: &Path, keypoints: &Keypoints) -> String {
    keypoints.write(root.join(Keypoints::FILE)).unwrap();
    let error = match run(root) {
        Err(Error::Input(error)) => error,
        other => panic!("not refused as bad input: {other:#?}"),
    };
    assert!(!root.join(Alignment::FILE).exists());
    error.to_string()
}

#[test]
fn the_pose_and_its_evidence_are_written() {
    let dir = tempfile::tempdir().unwrap();
    capture(dir.path());
    std::fs::create_dir_all(dir.path().join("alignment/overlays")).unwrap();
    std::fs::write(dir.path().join("alignment/bundle.json"), "{}").unwrap();
    let summary = run(dir.path()).unwrap();
    assert_eq!((summary.points, summary.frames, summary.inliers), (12, 3, 12));
    assert!(summary.rms_px < 1.0, "{}", summary.rms_px);
    assert!(summary.warnings.is_empty(), "{:?}", summary.warnings);

    let alignment = Sequence::open(dir.path()).unwrap().read_alignment().unwrap();
    assert_eq!(alignment.stage, AlignmentStage::Keypoints);
    let error = alignment.world_from_object.inverse() * truth();
    assert!(error.angle_rad().to_degrees() < 0.5 && error.translation().norm() < 1e-3, "{error:?}");
    assert!(alignment.object_covariance.unwrap().iter().enumerate().all(|(i, row)| row[i] > 0.0));
    for stale in ["overlays", "bundle.json"] {
        assert!(!dir.path().join("alignment").join(stale).exists(), "{stale} speaks of an older pose");
    }
    let json = serde_json::to_value(&summary).unwrap();
    for key in ["world_from_object", "rms_px", "residuals", "inliers", "condition", "covariance", "warnings"] {
        assert!(json.get(key).is_some(), "{key} is missing");
    }
}

#[test]
fn a_wrong_click_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let mut keypoints = capture(dir.path());
    keypoints.keypoints[7].pixel += Vector2::new(70.0, 20.0);
    keypoints.write(dir.path().join(Keypoints::FILE)).unwrap();
    let summary = run(dir.path()).unwrap();
    assert_eq!(summary.inliers, 11);
    assert!(!summary.residuals[7].inlier);
    assert!(summary.warnings[0].contains("keypoint 7 'stud 3' in frame 000001"), "{:?}", summary.warnings);
}

/// Sixteen of twenty clicks agree with exact cameras; the four of the frame that moved are right too.
#[test]
fn a_frame_that_drifted_keeps_its_clicks() {
    let dir = tempfile::tempdir().unwrap();
    capture_of(dir.path(), 5);
    let path = dir.path().join("pose/000004.txt");
    let pose = Sequence::open(dir.path()).unwrap().frames()[4].world_from_cam;
    let moved =
        Rigid3::from_parts(pose.rotation(), pose.translation() + pose.rotation() * Vector3::new(0.006, 0.0, 0.0));
    write_pose_txt(path, &moved).unwrap();
    let summary = run(dir.path()).unwrap();
    assert!(summary.poses_drifted && summary.inliers == 20, "{:?}", summary.warnings);
}

#[test]
fn bad_keypoints_are_explained_and_leave_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let good = capture(root);
    let with = |change: &dyn Fn(&mut Keypoints)| {
        let mut bad = good.clone();
        change(&mut bad);
        refusal(root, &bad)
    };
    let expect = |message: String, words: &[&str]| {
        assert!(message.contains("keypoints.json"), "{message}");
        assert!(words.iter().all(|word| message.contains(word)), "{message}");
    };
    expect(with(&|k| k.keypoints.truncate(3)), &["3 keypoints", "at least 4"]);
    expect(with(&|k| k.keypoints.clear()), &["0 keypoints"]);
    expect(with(&|k| k.keypoints[2].frame = FrameId(77)), &["keypoint 2", "000077", "no such frame"]);
    expect(with(&|k| k.keypoints[5].pixel.x = 1921.0), &["keypoint 5", "outside"]);
    expect(with(&|k| k.keypoints[5].point_in_object_m.y = 24.0), &["keypoint 5", "metres"]);
    expect(with(&|k| k.version = 2), &["version 2"]);
    let mirrored = with(&|k| k.keypoints.iter_mut().for_each(|k| k.point_in_object_m.z *= -1.0));
    expect(mirrored, &["mirror image", "wrong sign"]);
    let line =
        with(&|k| k.keypoints.iter_mut().for_each(|k| k.point_in_object_m = Point3::new(0.0, k.pixel.x * 1e-5, 0.0)));
    expect(line, &["one line"]);

    // LDraw units taken for half a millimetre, and inches for centimetres.
    for factor in [1.25, 1.0 / 2.54] {
        let scaled = with(&|k| k.keypoints.iter_mut().for_each(|k| k.point_in_object_m *= factor));
        expect(scaled, &["a model", "times as large", "metres"]);
    }

    std::fs::remove_file(root.join(Keypoints::FILE)).unwrap();
    let Err(Error::Input(error)) = run(root) else { panic!("accepted") };
    assert!(error.to_string().contains("no clicked points"), "{error}");
}
