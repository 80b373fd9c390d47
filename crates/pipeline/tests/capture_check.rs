//! The check of a capture by matched features, on published frames and on the same frames spoilt; and its page.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_capture::{ImportOptions, Misreading, Sequence, import, write_pose_txt};
use mb_geometry::{Camera, Rigid3, World};
use mb_job::Silent;
use mb_pipeline::{CaptureCheck, CaptureCheckOptions, check_capture, check_report};

fn imported(source: &Path, out: &Path, options: &ImportOptions) -> Sequence {
    import(source, None, out, options, &Silent).unwrap();
    Sequence::open(out).unwrap()
}

fn checked(sequence: &Sequence) -> CaptureCheck {
    check_capture(sequence, &CaptureCheckOptions::default(), &Silent).unwrap()
}

/// The sequence with poses as a reader would have them who mixed something up.
fn respell(sequence: &Sequence, spoil: impl Fn(&Rigid3<World, Camera>) -> Rigid3<World, Camera>) -> Sequence {
    for frame in sequence.frames() {
        let path = sequence.root().join(format!("pose/{}.txt", frame.id));
        write_pose_txt(path, &spoil(&frame.world_from_cam)).unwrap();
    }
    Sequence::open(sequence.root()).unwrap()
}

#[test]
fn published_frames_match_where_their_poses_put_them_and_mix_ups_are_named() {
    let Some(source) = mb_testdata::find("mobilebrick_5frames") else { return };
    let dir = tempfile::tempdir().unwrap();
    let sequence = imported(&source, &dir.path().join("seq"), &ImportOptions::default());
    let check = checked(&sequence);
    let epipolar = check.epipolar.as_ref().unwrap();
    // OpenCV's SIFT finds 0.28 to 0.54 px between these frames; frame 3 has no pose.
    assert_eq!(epipolar.pairs.len(), 3);
    for pair in &epipolar.pairs {
        assert!(pair.median_px < 0.6 && pair.matches > 150, "{pair:?}");
    }
    assert!(check.capture.problems.iter().all(|p| p.kind != "convention" && p.kind != "pose"), "{check:?}");
    // Undoing each mix-up is an involution but for the transposed rotations in OpenGL axes.
    for misreading in [Misreading::OpenGlAxes, Misreading::Inverted, Misreading::TransposedRotation] {
        let spoilt = respell(&sequence, |pose| misreading.mend(pose));
        let check = checked(&spoilt);
        assert!(check.epipolar.unwrap().median_px > 5.0);
        let named: Vec<_> = check.capture.problems.iter().filter(|p| p.kind == "convention").collect();
        assert!(named.len() == 1 && named[0].message.starts_with(misreading.advice()), "{misreading:?}: {named:?}");
    }
}

#[test]
fn colmap_captures_agree_with_their_own_models() {
    // A video (its README: mean reprojection error 0.58 px), and all photographs of a door.
    for (name, frames) in [("mobilebrick-video", 1), ("gtsfm_lund_door", 12)] {
        let Some(source) = mb_testdata::find(name) else { continue };
        let dir = tempfile::tempdir().unwrap();
        let options = ImportOptions { range: Some((0, 12)), ..ImportOptions::default() };
        let sequence = imported(&source, &dir.path().join("seq"), &options);
        let check = checked(&sequence);
        let px = check.epipolar.unwrap().median_px;
        assert!(sequence.frames().len() >= frames && px < 0.6, "{name}: {px}");
    }
}

#[test]
fn the_page_shows_the_path_and_reaches_for_nothing() {
    let Some(source) = mb_testdata::find("seven_scenes_tsdf") else { return };
    let dir = tempfile::tempdir().unwrap();
    let options = ImportOptions { every: 8, ..ImportOptions::default() };
    let sequence = imported(&source, &dir.path().join("seq"), &options);
    let check = checked(&sequence);
    let path = dir.path().join("check.html");
    check_report(&sequence, &check, &Silent).unwrap().write(&path).unwrap();
    let page = std::fs::read_to_string(path).unwrap();
    assert!(page.contains("From above") && page.contains("From the side"));
    assert!(page.matches("class=\"frustum").count() == 2 * sequence.frames().len());
    assert!(page.contains("Contact sheet") && page.contains("Depth on the photographs"));
    assert!(!page.contains("http"), "the page must not reach for the network");
}
