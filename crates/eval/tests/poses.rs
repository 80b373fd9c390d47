//! Scores of camera poses: closed forms, laws, the `evo` program's figures, and input that is not as it should be.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::{Path, PathBuf};

use mb_capture::{Alignment, AlignmentStage, FrameAlignment, FrameId, write_pose_txt};
use mb_eval::{ObjectPair, PosePair, PosesScores, evaluate_poses, score_poses};
use mb_geometry::{Camera, Object, Rigid3, World};
use nalgebra::{Point3, Vector3, Vector6};
use proptest::prelude::*;
use serde_json::Value;

type Pose = Rigid3<World, Camera>;

fn pose() -> impl Strategy<Value = Pose> {
    prop::array::uniform6(-1.5..1.5f64).prop_map(|xi| Pose::exp(&Vector6::from(xi)))
}

fn trajectory() -> impl Strategy<Value = Vec<PosePair>> {
    prop::collection::vec((pose(), prop::array::uniform6(-0.05..0.05f64)), 2..12).prop_map(|poses| {
        let pair = |(i, (gt, noise)): (usize, (Pose, [f64; 6]))| PosePair {
            frame: FrameId(i as u32),
            gt_world_from_cam: gt,
            pred_world_from_cam: Rigid3::<World, World>::exp(&Vector6::from(noise)) * gt,
        };
        poses.into_iter().enumerate().map(pair).collect()
    })
}

/// The prediction with each pose replaced.
fn predicted(pairs: &[PosePair], change: impl Fn(usize, Pose) -> Pose) -> Vec<PosePair> {
    let replace = |(i, p): (usize, &PosePair)| PosePair { pred_world_from_cam: change(i, p.pred_world_from_cam), ..*p };
    pairs.iter().enumerate().map(replace).collect()
}

fn score(pairs: &[PosePair]) -> PosesScores {
    score_poses(pairs, None).unwrap()
}

#[test]
fn evo_agrees() {
    let text = include_str!("../testdata/poses_evo.json");
    let expected: Value = serde_json::from_str(text).unwrap();
    let poses = |key: &str| -> Vec<Pose> {
        let matrix = |m: &Value| {
            let entries: Vec<f64> = m.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
            Pose::from_matrix(&nalgebra::Matrix4::from_row_slice(&entries)).unwrap().0
        };
        expected[key].as_array().unwrap().iter().map(matrix).collect()
    };
    let pairs: Vec<PosePair> = poses("gt_world_from_cam")
        .into_iter()
        .zip(poses("pred_world_from_cam"))
        .zip(0..)
        .map(|((gt_world_from_cam, pred_world_from_cam), i)| PosePair {
            frame: FrameId(i),
            gt_world_from_cam,
            pred_world_from_cam,
        })
        .collect();
    let scores = score(&pairs);
    for (name, found) in [
        ("pairwise_translation_rmse_mm", scores.pairwise.translation_rmse_mm),
        ("pairwise_rotation_mean_deg", scores.pairwise.rotation_mean_deg),
        ("rpe_translation_rmse_mm", scores.rpe.translation_rmse_mm),
        ("rpe_rotation_mean_deg", scores.rpe.rotation_mean_deg),
        ("ate_rmse_mm", scores.ate_rmse_mm),
        ("ate_rotation_mean_deg", scores.ate_rotation_mean_deg),
        ("ate_unaligned_translation_rmse_mm", scores.ate_unaligned.translation_rmse_mm),
        ("ate_unaligned_rotation_mean_deg", scores.ate_unaligned.rotation_mean_deg),
        ("ate_similarity_translation_rmse_mm", scores.ate_similarity.unwrap().translation_rmse_mm),
        ("ate_similarity_rotation_mean_deg", scores.ate_similarity.unwrap().rotation_mean_deg),
        ("scale", scores.scale.unwrap()),
    ] {
        let expected = expected[name].as_f64().unwrap();
        assert!((found - expected).abs() < 1e-9 * expected, "{name} is {found}, not {expected}");
    }
}

proptest! {
    #[test]
    fn equal_poses_are_without_error(pairs in trajectory()) {
        let pairs: Vec<PosePair> =
            pairs.iter().map(|p| PosePair { pred_world_from_cam: p.gt_world_from_cam, ..*p }).collect();
        let object = ObjectPair { gt_world_from_object: Rigid3::identity(), pred_world_from_object: Rigid3::identity() };
        let scores = score_poses(&pairs, Some(&object)).unwrap();
        for errors in [scores.pairwise, scores.rpe, scores.object.unwrap()] {
            prop_assert!(errors.translation_max_mm == 0.0 && errors.rotation_max_deg < 1e-6, "{:?}", errors);
        }
        // Two cameras lie on a line, and the decomposition of a rank-one matrix keeps half of the digits.
        prop_assert!(scores.ate_rmse_mm < 1e-3 && scores.ate_rotation_mean_deg < 180.0);
    }

    #[test]
    fn moving_either_world_changes_nothing(pairs in trajectory(), gt_move in pose(), pred_move in pose()) {
        let object = ObjectPair {
            gt_world_from_object: Rigid3::exp(&Vector6::new(0.1, 0.2, 0.3, 1.0, 2.0, 3.0)),
            pred_world_from_object: Rigid3::exp(&Vector6::new(0.1, 0.21, 0.3, 1.0, 2.01, 3.0)),
        };
        let (gt_move, pred_move) = (moving(gt_move), moving(pred_move));
        let moved: Vec<PosePair> = pairs.iter().map(|p| PosePair {
            gt_world_from_cam: gt_move * p.gt_world_from_cam,
            pred_world_from_cam: pred_move * p.pred_world_from_cam,
            ..*p
        }).collect();
        let moved_object = ObjectPair {
            gt_world_from_object: gt_move * object.gt_world_from_object,
            pred_world_from_object: pred_move * object.pred_world_from_object,
        };
        let (before, after) =
            (score_poses(&pairs, Some(&object)).unwrap(), score_poses(&moved, Some(&moved_object)).unwrap());
        prop_assert!((before.ate_rmse_mm - after.ate_rmse_mm).abs() < 1e-7);
        let both = [(before.pairwise, after.pairwise), (before.rpe, after.rpe), (before.object.unwrap(), after.object.unwrap())];
        for (before, after) in both {
            prop_assert!((before.translation_rmse_mm - after.translation_rmse_mm).abs() < 1e-7);
            prop_assert!((before.rotation_mean_deg - after.rotation_mean_deg).abs() < 1e-6);
        }
    }

    #[test]
    fn reference_and_prediction_may_change_places(pairs in trajectory()) {
        let swapped: Vec<PosePair> = pairs.iter().map(|p| PosePair {
            gt_world_from_cam: p.pred_world_from_cam, pred_world_from_cam: p.gt_world_from_cam, ..*p
        }).collect();
        let (one, other) = (score(&pairs), score(&swapped));
        prop_assert!((one.pairwise.translation_rmse_mm - other.pairwise.translation_rmse_mm).abs() < 1e-9);
        prop_assert!((one.pairwise.rotation_mean_deg - other.pairwise.rotation_mean_deg).abs() < 1e-7);
        prop_assert!((one.ate_rmse_mm - other.ate_rmse_mm).abs() < 1e-9);
    }

    #[test]
    fn no_rigid_move_fits_better_than_the_aligned_one(pairs in trajectory(), nudge in prop::array::uniform6(-0.1..0.1f64)) {
        let ate = score(&pairs).ate_rmse_mm;
        let nudge = Rigid3::<World, World>::exp(&Vector6::from(nudge));
        let squares = pairs.iter().map(|p| {
            let moved = nudge * Point3::from(p.pred_world_from_cam.translation());
            (moved.coords - p.gt_world_from_cam.translation()).norm_squared()
        }).sum::<f64>();
        prop_assert!(ate <= 1e3 * (squares / pairs.len() as f64).sqrt() + 1e-9);
    }
}

/// A pose taken as a move of a world in itself.
fn moving(pose: Pose) -> Rigid3<World, World> {
    Rigid3::from_parts(pose.rotation(), pose.translation())
}

/// `count` cameras on a line, 10 cm apart, looking the same way.
fn line(count: u32) -> Vec<PosePair> {
    let at = |i: u32| Pose::from_translation(Vector3::new(0.1 * f64::from(i), 0.0, 0.0));
    (0..count).map(|i| PosePair { frame: FrameId(i), gt_world_from_cam: at(i), pred_world_from_cam: at(i) }).collect()
}

#[test]
fn a_stretched_line_has_its_closed_form() {
    // Every step 1 mm too long: pair (i, j) is off by (j - i) mm.
    let pairs =
        predicted(&line(4), |i, p| Rigid3::<World, World>::from_translation(Vector3::new(i as f64 * 1e-3, 0., 0.)) * p);
    let scores = score(&pairs);
    let squares = [1.0, 1.0, 1.0, 4.0, 4.0, 9.0f64];
    assert!((scores.pairwise.translation_rmse_mm - (squares.iter().sum::<f64>() / 6.0).sqrt()).abs() < 1e-9);
    assert!((scores.pairwise.translation_mean_mm - 10.0 / 6.0).abs() < 1e-9);
    assert!((scores.pairwise.translation_max_mm - 3.0).abs() < 1e-9);
    assert_eq!(scores.pairwise.count, 6);
    assert!((scores.rpe.translation_rmse_mm - 1.0).abs() < 1e-9);
    // The best move centres the errors: -1.5, -0.5, 0.5, 1.5 mm.
    assert!((scores.ate_rmse_mm - 1.25f64.sqrt()).abs() < 1e-9, "{}", scores.ate_rmse_mm);
    assert!((scores.scale.unwrap() - 1.0 / 1.01).abs() < 1e-9);
}

#[test]
fn one_turned_camera_shows_in_its_pairs_alone() {
    let turn = Pose::exp(&Vector6::new(0.0, 3f64.to_radians(), 0.0, 0.0, 0.0, 0.0));
    let scores = score(&predicted(&line(4), |i, p| if i == 3 { moving(p) * turn } else { p }));
    // Three of six pairs see the turned camera, each from a straight one: no translation error.
    assert!((scores.pairwise.rotation_mean_deg - 1.5).abs() < 1e-9);
    assert!((scores.pairwise.rotation_rmse_deg - (4.5f64).sqrt()).abs() < 1e-9);
    assert!(scores.pairwise.translation_max_mm < 1e-9);
    assert!(scores.ate_rmse_mm < 1e-9);
}

#[test]
fn a_displaced_object_shows_only_in_its_own_frame() {
    let object = ObjectPair {
        gt_world_from_object: Rigid3::identity(),
        pred_world_from_object: Rigid3::from_translation(Vector3::new(0.0, 2e-3, 0.0)),
    };
    let scores = score_poses(&line(5), Some(&object)).unwrap();
    let errors = scores.object.unwrap();
    assert!((errors.translation_rmse_mm - 2.0).abs() < 1e-9 && errors.rotation_max_deg < 1e-9);
    assert_eq!((scores.pairwise.translation_rmse_mm, scores.ate_rmse_mm < 1e-9), (0.0, true));
}

#[test]
fn a_prediction_in_another_unit_is_named() {
    let pairs = predicted(&line(4), |_, p| Pose::from_parts(p.rotation(), p.translation() * 1000.0));
    let warnings = score(&pairs).warnings;
    assert!(warnings[0].contains("0.0010 reference metres"), "{warnings:?}");
}

/// Writes `pose/` of a folder.
fn write_poses(folder: &Path, poses: impl IntoIterator<Item = (u32, Pose)>) -> PathBuf {
    for (id, pose) in poses {
        write_pose_txt(folder.join(format!("pose/{}.txt", FrameId(id))), &pose).unwrap();
    }
    folder.to_owned()
}

fn alignment(world_from_object: Rigid3<World, Object>, frames: Vec<FrameAlignment>) -> Alignment {
    let stage = AlignmentStage::Bundle;
    Alignment { version: 1, stage, world_from_object, object_covariance: None, rms_px: None, frames }
}

#[test]
fn folders_are_joined_by_frame_number_and_alignments_count() {
    let dir = tempfile::tempdir().unwrap();
    let at = |i: u32| Pose::from_translation(Vector3::new(0.1 * f64::from(i), 0.05 * f64::from(i * i), 0.0));
    let gt = write_poses(&dir.path().join("simulation"), (0..6).map(|i| (i * 5, at(i))));
    let drift = |i: u32| Rigid3::<World, World>::from_translation(Vector3::new(0.0, 0.0, 0.01 * f64::from(i))) * at(i);
    let pred = write_poses(&dir.path().join("sequence"), (1..8).map(|i| (i * 5, drift(i))));
    let drifting = evaluate_poses(&gt, &pred).unwrap();
    assert_eq!(drifting.frames, 5);
    assert_eq!((drifting.missing, drifting.unpaired), (vec![FrameId(0)], vec![FrameId(30), FrameId(35)]));
    assert!((drifting.rpe.translation_rmse_mm - 10.0).abs() < 1e-9);
    assert_eq!(drifting.object, None);
    assert!(drifting.warnings.iter().any(|w| w.contains("object is empty")), "{:?}", drifting.warnings);

    alignment(Rigid3::identity(), Vec::new()).write(gt.join("alignment.json")).unwrap();
    let cameras =
        (1..8).map(|i| FrameAlignment { frame: FrameId(i * 5), world_from_cam: at(i), covariance: None, rms_px: None });
    let object = Rigid3::from_translation(Vector3::new(1e-3, 0.0, 0.0));
    alignment(object, cameras.collect()).write(pred.join(Alignment::FILE)).unwrap();
    let aligned = evaluate_poses(&gt, &pred).unwrap();
    assert!(aligned.pairwise.translation_max_mm < 1e-9);
    assert!((aligned.object.unwrap().translation_rmse_mm - 1.0).abs() < 1e-9);
    let document = serde_json::to_value(&aligned).unwrap();
    for key in [
        "/frames",
        "/pairwise/translation_rmse_mm",
        "/pairwise/rotation_mean_deg",
        "/object/translation_rmse_mm",
        "/ate_rmse_mm",
    ] {
        assert!(document.pointer(key).unwrap().is_number(), "{key}");
    }
}

#[test]
fn bad_input_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let good = write_poses(&dir.path().join("good"), line(3).iter().map(|p| (p.frame.0, p.gt_world_from_cam)));
    let refusal = |pred: &Path| {
        let error = evaluate_poses(&good, pred).unwrap_err();
        assert!(matches!(error, mb_job::Error::Input(_)), "{error:?}");
        error.to_string()
    };
    assert!(refusal(&dir.path().join("none")).contains("no such folder"));
    assert!(refusal(&good.join("pose")).contains("folder that holds pose/"));
    let one = write_poses(&dir.path().join("one"), [(2, Pose::identity()), (77, Pose::identity())]);
    assert!(refusal(&one).contains("1 frames in common"));
    std::fs::write(one.join("pose/000001.txt"), "1 0 0 0\n0 1 0 0\n0 0 1 nan\n0 0 0 1\n").unwrap();
    assert!(refusal(&one).contains("000001.txt"));
    std::fs::remove_file(one.join("pose/000001.txt")).unwrap();
    let stray = FrameAlignment { frame: FrameId(5), world_from_cam: Pose::identity(), covariance: None, rms_px: None };
    alignment(Rigid3::identity(), vec![stray]).write(one.join("alignment.json")).unwrap();
    assert!(refusal(&one).contains("frame 000005"));
    std::fs::write(one.join("alignment.json"), "{").unwrap();
    assert!(refusal(&one).contains("alignment.json"));
}
