//! `align board` on a sequence made of real photographs of a board.

use std::path::Path;

use mb_align::{BoardOptions, BoardOutcome, align_board, calibrate_photos};
use mb_boards::BoardSpec;
use mb_capture::{PoseFolder, Sequence, write_intrinsics_txt, write_pose_txt};
use mb_geometry::{ImageSize, Intrinsics, Rigid3};
use mb_image::{RgbImage, write_rgb_png};
use mb_job::Silent;

const BOARD: &str = "charuco:5x7:0.04:0.02:DICT_6X6_250";
/// Of OpenCV's calibration of these photographs.
const CAMERA: Intrinsics = Intrinsics { fx: 457.29, fy: 461.32, cx: 317.22, cy: 275.61 };

/// Four photographs of the board, a black one, and a frame without a photograph; `None` where the data is absent.
fn sequence(root: &Path) -> Option<Sequence> {
    for i in 0..6 {
        write_pose_txt(root.join(format!("pose/{i:06}.txt")), &Rigid3::identity()).expect("written");
        write_intrinsics_txt(root.join(format!("intrinsic/{i:06}.txt")), &CAMERA).expect("written");
    }
    for i in 0..4 {
        let photo = mb_testdata::find(&format!("charuco_opencv/img_0{i}.jpg"))?;
        std::fs::create_dir_all(root.join("image")).expect("a folder");
        std::fs::copy(photo, root.join(format!("image/{i:06}.jpg"))).expect("copied");
    }
    let black = RgbImage::filled(ImageSize::new(640, 480), [0; 3]);
    write_rgb_png(root.join("image/000004.png"), &black).expect("written");
    Some(Sequence::open(root).expect("a sequence"))
}

fn board(text: &str) -> BoardSpec {
    text.parse().expect("a board")
}

#[test]
fn every_frame_has_its_outcome_and_the_poses_can_be_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(sequence) = sequence(folder.path()) else { return };
    let summary = align_board(&sequence, &board(BOARD), &BoardOptions { calibrate: true }, &Silent).expect("posed");
    let outcomes: Vec<BoardOutcome> = summary.frames.iter().map(|f| f.outcome).collect();
    use BoardOutcome::{NoBoard, NoPhotograph, Posed};
    assert_eq!(outcomes, [Posed, Posed, Posed, Posed, NoBoard, NoPhotograph]);
    assert!(summary.rms_px <= 0.19 && summary.corners == 96, "{} px over {}", summary.rms_px, summary.corners);
    for frame in summary.frames.iter().take(4) {
        let covariance = frame.covariance.expect("a covariance");
        // The board is 20 cm wide, the camera half a metre away: a fraction of a millimetre.
        let std_mm = 1e3 * (covariance[3][3] + covariance[4][4] + covariance[5][5]).sqrt();
        assert!((0.01..2.0).contains(&std_mm), "{std_mm} mm");
        // z points into the board, so the camera is where z is negative.
        assert!(frame.world_from_cam.expect("a pose").translation().z < -0.2);
    }
    let read = PoseFolder::open(folder.path().join("board")).expect("poses");
    assert_eq!(read.frames().len(), 4);
    let written = std::fs::read_to_string(folder.path().join("board/board.json")).expect("a document");
    assert!(written.contains("\"no_board\"") && written.contains("\"distortion\""));
    // OpenCV's camera without its lens is close.
    let plain = align_board(&sequence, &board(BOARD), &BoardOptions::default(), &Silent).expect("posed");
    assert!(plain.calibration.is_none() && plain.rms_px < 1.5, "{} px", plain.rms_px);
    for (a, b) in summary.frames.iter().zip(&plain.frames).take(4) {
        let (a, b) = (a.world_from_cam.expect("a pose"), b.world_from_cam.expect("a pose"));
        assert!((a.translation() - b.translation()).norm() < 0.02);
    }
}

#[test]
fn a_wrong_board_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let Some(sequence) = sequence(folder.path()) else { return };
    let message = |text: &str| {
        align_board(&sequence, &board(text), &BoardOptions::default(), &Silent).expect_err("no such board").to_string()
    };
    let other = message("charuco:5x7:0.04:0.02:DICT_4X4_50");
    assert!(
        other.contains("none of the 5 photographs") && other.contains("17 different markers of DICT_6X6_50"),
        "{other}"
    );
    let swapped = message("charuco:7x5:0.04:0.02:DICT_6X6_250");
    assert!(swapped.contains(&format!("arranged as on {BOARD}")), "{swapped}");
    assert!(!folder.path().join("board").exists(), "nothing is written");
}

#[test]
fn loose_photographs_calibrate_their_camera() {
    let paths: Option<Vec<_>> = (0..4).map(|i| mb_testdata::find(&format!("charuco_opencv/img_0{i}.jpg"))).collect();
    let Some(paths) = paths else { return };
    let found = calibrate_photos(&paths, &board(BOARD), &Silent).expect("a camera");
    assert!(found.calibration.rms_px <= 0.19 && found.calibration.views == 4, "{:?}", found.calibration);
    assert!(found.photos.iter().all(|p| p.corners.len() == 24 && p.left_out == 0));
    let too_few = calibrate_photos(&paths[..2], &board(BOARD), &Silent).expect_err("two views").to_string();
    assert!(too_few.contains("2 views") && too_few.contains("Take more photographs"), "{too_few}");
}
