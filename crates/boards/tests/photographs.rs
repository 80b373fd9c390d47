//! Real photographs of boards, against what OpenCV 5.0.0 finds in them.

use mb_boards::{BoardDetector, BoardSpec, Detection, LensModel, SeenCorner, calibrate, fitting_dictionaries, luma};
use mb_geometry::ImageSize;
use mb_image::{Image, read_rgb};
use nalgebra::Point2;
use serde_json::Value;

fn json(path: &str) -> Option<Value> {
    let bytes = std::fs::read(mb_testdata::find(path)?).expect("readable");
    Some(serde_json::from_slice(&bytes).expect("JSON"))
}

fn photograph(path: &str) -> Option<Image<u8>> {
    Some(luma(&read_rgb(mb_testdata::find(path)?).expect("an image")))
}

fn board(text: &str) -> BoardSpec {
    text.parse().expect("a board")
}

/// Corner ids and pixels of a reference document's image.
fn reference(image: &Value) -> Vec<SeenCorner> {
    let ids = image["charuco_ids"].as_array().expect("ids");
    let corners = image["charuco_corners"].as_array().expect("corners");
    let number = |v: &Value| v.as_f64().expect("a number");
    ids.iter()
        .zip(corners)
        .map(|(id, c)| SeenCorner { id: number(id) as usize, pixel: Point2::new(number(&c[0]), number(&c[1])) })
        .collect()
}

/// Distances from the reference's corners, all of which must be there, ascending.
fn distances(found: &Detection, reference: &[SeenCorner]) -> Vec<f64> {
    let off = |r: &SeenCorner| {
        let corner = found.corners.iter().find(|c| c.id == r.id).expect("every corner of the reference is found");
        (corner.pixel - r.pixel).norm()
    };
    let mut distances: Vec<f64> = reference.iter().map(off).collect();
    distances.sort_by(f64::total_cmp);
    distances
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[test]
fn four_photographs_and_their_camera() {
    let Some(document) = json("charuco_opencv/reference_opencv.json") else { return };
    let board = board("charuco:5x7:0.04:0.02:DICT_6X6_250");
    let detector = BoardDetector::new(&board);
    let (mut views, mut all) = (Vec::new(), Vec::new());
    for i in 0..4 {
        let name = format!("img_0{i}.jpg");
        let Some(image) = photograph(&format!("charuco_opencv/{name}")) else { return };
        let found = detector.detect(&image);
        assert_eq!((found.corners.len(), found.markers.len()), (24, 17), "{name}");
        all.extend(distances(&found, &reference(&document["images"][&name])));
        views.push(found.corners);
    }
    assert!(all.iter().all(|d| *d < 0.4), "{all:?}");
    assert!(median(all.clone()) < 0.1, "{}", median(all));
    let camera = calibrate(&board, &views, ImageSize::new(640, 480), LensModel::Full).expect("a camera");
    // OpenCV's own corners leave 0.188 px.
    assert!(camera.rms_px < 0.15, "{}", camera.rms_px);
    assert!((camera.camera.intrinsics.fx / 457.29 - 1.0).abs() < 0.03, "{:?}", camera.camera);
}

#[test]
fn blurred_parts_of_a_large_board() {
    let Some(document) = json("charuco_calib_targets/reference_opencv.json") else { return };
    // The board's unit is unknown; its ratio is 0.75. What OpenCV finds is the least.
    let mut all = Vec::new();
    for (name, dictionary, corners, markers) in [
        ("large.png", "DICT_4X4_1000", 283, 165),
        ("small.png", "DICT_4X4_250", 63, 43),
        ("small2.png", "DICT_4X4_250", 55, 38),
        ("small4.png", "DICT_4X4_250", 46, 32),
    ] {
        let Some(image) = photograph(&format!("charuco_calib_targets/{name}")) else { return };
        let board = board(&format!("charuco:22x22:0.0052:0.0039:{dictionary}"));
        let found = BoardDetector::new(&board).detect(&image);
        assert!(found.corners.len() >= corners && found.markers.len() >= markers, "{name}: {:?}", found.warnings);
        let distances = distances(&found, &reference(&document["images"][name]));
        // A wrong id would be off by a square, that is by 25 px and more. OpenCV's corners of the blurred squares stray by
        // half a pixel (median) from what a homography of their neighbours says, ours by a quarter.
        assert!(distances.iter().all(|d| *d < 6.0), "{name}: {distances:?}");
        assert!(median(distances.clone()) < 0.5, "{name}: {}", median(distances));
        all.extend(distances);
    }
    assert!(median(all.clone()) < 0.1, "{}", median(all));
}

#[test]
fn loose_markers_are_read() {
    let Some(gold) = json("charuco_opencv/gold_markers.json") else { return };
    let Some(image) = photograph("charuco_opencv/singlemarkersoriginal.jpg") else { return };
    let gold = &gold["singlemarkersoriginal.jpg"];
    let mut ids: Vec<u64> = gold["ids"].as_array().expect("ids").iter().filter_map(Value::as_u64).collect();
    ids.sort_unstable();
    let fits = fitting_dictionaries(std::slice::from_ref(&image));
    assert_eq!(fits[0].dictionary, "DICT_6X6_250");
    assert_eq!(fits[0].ids.iter().map(|id| *id as u64).collect::<Vec<_>>(), ids);
    // They lie on no board: none is found.
    let found = BoardDetector::new(&board("charuco:5x7:0.04:0.02:DICT_6X6_250")).detect(&image);
    assert!(found.corners.is_empty());
    // A board of one marker is that marker, with its corners as OpenCV has them, up to a pixel.
    for (i, id) in gold["ids"].as_array().expect("ids").iter().enumerate() {
        let one = board(&format!("grid:1x1:0.04:0.01:DICT_6X6_250:{id}"));
        let found = BoardDetector::new(&one).detect(&image);
        assert_eq!(found.markers.len(), 1, "marker {id}");
        let corners = gold["corners_xyxyxyxy"][i].as_array().expect("corners");
        for (k, corner) in found.corners.iter().enumerate() {
            let at = |j: usize| corners[j].as_f64().expect("a number");
            let off = (corner.pixel - Point2::new(at(2 * k), at(2 * k + 1))).norm();
            assert!(off < 1.5, "marker {id}, corner {k}: {off}");
        }
    }
}

#[test]
fn a_chessboard_without_markers_is_no_board() {
    let Some(image) = photograph("charuco_calib_targets/mid.png") else { return };
    let found = BoardDetector::new(&board("charuco:12x8:0.02:0.015:DICT_4X4_50")).detect(&image);
    assert_eq!(found, Detection::default());
}
