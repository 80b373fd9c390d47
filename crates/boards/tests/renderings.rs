//! Drawn photographs of boards, where every corner is known.

use mb_boards::{BoardDetector, BoardSpec, LensCamera, estimate_board_pose, fitting_dictionaries};
use mb_geometry::{Board, Camera, ImageSize, Intrinsics, Rigid3};
use mb_image::Image;
use nalgebra::{Point2, Point3, UnitQuaternion, Vector3};
use rand::RngExt;

const SIZE: ImageSize = ImageSize::new(640, 480);
const LENS: LensCamera = LensCamera {
    intrinsics: Intrinsics { fx: 520.0, fy: 522.0, cx: 318.0, cy: 241.0 },
    distortion: [0.05, -0.1, 0.001, -0.001, 0.0],
};

/// A grey photograph of boards: each pixel is the mean of 5 x 5 rays, with blur and noise.
fn photograph(boards: &[(&BoardSpec, Rigid3<Camera, Board>)], blur_px: usize, noise: f64, seed: u64) -> Image<u8> {
    const MARGIN_M: f64 = 0.01;
    const DPI: f64 = 400.0;
    let prints: Vec<_> = boards.iter().map(|(board, pose)| (board.texture(DPI, MARGIN_M), pose.inverse())).collect();
    let shade = |p: &Point2<f64>| -> f64 {
        let Some(ray) = LENS.plane_from_img(p) else { return 90.0 };
        for (print, board_from_cam) in &prints {
            let direction = board_from_cam.rotate(&Vector3::new(ray.x, ray.y, 1.0));
            let origin = board_from_cam.translation();
            let hit = origin - direction * (origin.z / direction.z);
            let at = |v: f64| ((v + MARGIN_M) * DPI / 0.0254 - 0.5).round();
            let (x, y) = (at(hit.x), at(hit.y));
            if x >= 0.0
                && y >= 0.0
                && let Some(value) = print.get(x as usize, y as usize)
            {
                return 40.0 + 170.0 * f64::from(*value) / 255.0;
            }
        }
        90.0
    };
    let sharp = Image::from_fn(SIZE, |x, y| {
        let mut sum = 0.0;
        for dy in [-2.0, -1.0, 0.0, 1.0, 2.0] {
            for dx in [-2.0, -1.0, 0.0, 1.0, 2.0] {
                sum += shade(&Point2::new(x as f64 + dx / 5.0, y as f64 + dy / 5.0));
            }
        }
        sum / 25.0
    });
    let mut rng = mb_job::rng(seed, 0);
    let r = blur_px as i64;
    Image::from_fn(SIZE, |x, y| {
        let clamp = |v: i64, n: usize| v.clamp(0, n as i64 - 1) as usize;
        let (mut sum, mut weights) = (0.0, 0.0);
        for dy in -r..=r {
            for dx in -r..=r {
                let weight = ((r + 1 - dx.abs()) * (r + 1 - dy.abs())) as f64;
                sum += weight * sharp[(clamp(x as i64 + dx, SIZE.width), clamp(y as i64 + dy, SIZE.height))];
                weights += weight;
            }
        }
        let grain = noise * (0..4).map(|_| rng.random_range(-0.87..0.87)).sum::<f64>();
        // Light falls off across the picture.
        (sum / weights * (1.0 - 0.0006 * x as f64) + grain).round().clamp(0.0, 255.0) as u8
    })
}

/// The board turned about its middle (rotation vector), which lies at the last three numbers before the camera.
fn pose(twist: [f64; 6], middle: [f64; 2]) -> Rigid3<Camera, Board> {
    let center = Rigid3::<Board, Board>::from_translation(Vector3::new(-middle[0], -middle[1], 0.0));
    let [x, y, z, at @ ..] = twist;
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(x, y, z));
    Rigid3::<Camera, Board>::from_parts(rotation, Vector3::from(at)) * center
}

fn board(text: &str) -> BoardSpec {
    text.parse().expect("a board")
}

/// Root mean square error of the corners found, pixels; every one must be the right one.
fn error_px(board: &BoardSpec, pose: &Rigid3<Camera, Board>, image: &Image<u8>, fewest: usize) -> f64 {
    let found = BoardDetector::new(board).detect(image);
    assert!(found.corners.len() >= fewest, "{} corners of {fewest}: {:?}", found.corners.len(), found.warnings);
    let corners = board.corners();
    let squares: f64 = found
        .corners
        .iter()
        .map(|c| {
            let p = corners[c.id];
            let truth = LENS.img_from_cam(&(*pose * Point3::new(p.x, p.y, 0.0))).expect("in front");
            let error = (c.pixel - truth).norm();
            assert!(error < 1.0, "corner {} is {error} px off", c.id);
            error * error
        })
        .sum();
    (squares / found.corners.len() as f64).sqrt()
}

#[test]
fn corners_are_exact_to_a_few_hundredths_of_a_pixel() {
    let board = board("charuco:5x7:0.04:0.02:DICT_6X6_250");
    for (i, twist) in
        [[0.1, 0.1, 0.0, 0.0, 0.0, 0.4], [0.6, -0.4, 0.4, 0.01, -0.02, 0.45], [-0.5, 0.6, 2.0, 0.0, 0.0, 0.45]]
            .into_iter()
            .enumerate()
    {
        let pose = pose(twist, [0.1, 0.14]);
        let image = photograph(&[(&board, pose)], 1, 2.0, i as u64);
        let error = error_px(&board, &pose, &image, 24);
        println!("view {i}: {error:.4} px");
        assert!(error < 0.05, "view {i}: {error}");
        let found = BoardDetector::new(&board).detect(&image);
        let estimate = estimate_board_pose(&board, &found.corners, &LENS).expect("a pose");
        let off = estimate.cam_from_board.inverse() * pose;
        assert!(off.translation().norm() < 5e-4 && off.angle_rad().to_degrees() < 0.1, "{off:?}");
    }
}

#[test]
fn markers_of_a_grid_have_their_corners() {
    let board = board("grid:4x3:0.05:0.012:DICT_4X4_50:5");
    let pose = pose([0.4, -0.3, 0.5, 0.0, 0.0, 0.42], [0.118, 0.087]);
    let error = error_px(&board, &pose, &photograph(&[(&board, pose)], 1, 2.0, 3), 48);
    println!("{error:.4} px");
    assert!(error < 0.15, "{error}");
}

#[test]
fn blur_and_a_board_half_outside_leave_what_is_seen() {
    let board = board("charuco:8x6:0.03:0.0225:DICT_5X5_100:legacy");
    let blurred = pose([0.3, 0.3, 0.1, 0.0, 0.0, 0.4], [0.12, 0.09]);
    let error = error_px(&board, &blurred, &photograph(&[(&board, blurred)], 3, 2.0, 4), 30);
    println!("blurred {error:.4} px");
    assert!(error < 0.15, "{error}");
    let outside = pose([0.2, -0.3, 0.2, 0.16, 0.05, 0.35], [0.12, 0.09]);
    let error = error_px(&board, &outside, &photograph(&[(&board, outside)], 1, 2.0, 5), 8);
    assert!(error < 0.08, "{error}");
}

#[test]
fn of_two_prints_one_is_taken_and_the_other_told() {
    let board = board("charuco:5x4:0.03:0.02:DICT_5X5_50");
    let near = pose([0.1, 0.2, 0.0, -0.08, 0.0, 0.36], [0.075, 0.06]);
    let far = pose([0.1, -0.2, 0.3, 0.11, 0.0, 0.45], [0.075, 0.06]);
    let image = photograph(&[(&board, near), (&board, far)], 1, 2.0, 6);
    let found = BoardDetector::new(&board).detect(&image);
    assert_eq!(found.corners.len(), 12);
    assert!(found.warnings.iter().any(|w| w.contains("second print")), "{:?}", found.warnings);
    let estimate = estimate_board_pose(&board, &found.corners, &LENS).expect("a pose");
    assert!(estimate.rms_px < 0.1, "all corners are of one print: {}", estimate.rms_px);
}

#[test]
fn a_wrong_board_is_not_found_and_the_right_dictionary_is() {
    let printed = board("charuco:5x7:0.04:0.02:DICT_6X6_250");
    let pose = pose([0.1, 0.1, 0.0, 0.0, 0.0, 0.4], [0.1, 0.14]);
    let image = photograph(&[(&printed, pose)], 1, 2.0, 7);
    for wrong in [
        "charuco:5x7:0.04:0.02:DICT_5X5_100",
        "charuco:7x5:0.04:0.02:DICT_6X6_250",
        "charuco:12x9:0.04:0.02:DICT_6X6_250",
        "grid:5x7:0.04:0.02:DICT_4X4_50",
    ] {
        let board = board(wrong);
        let found = BoardDetector::new(&board).detect(&image);
        // Rows of a board that is as wide in markers may agree for a while; what is posed must then fit.
        let fits = estimate_board_pose(&board, &found.corners, &LENS).is_some_and(|p| p.rms_px < 1.0);
        assert!(found.corners.is_empty() || !fits, "{wrong}: {} corners", found.corners.len());
    }
    let fits = fitting_dictionaries(&[image]);
    assert_eq!((fits[0].dictionary.as_str(), fits[0].markers), ("DICT_6X6_50", 17));
}

#[test]
fn nothing_is_found_where_nothing_is() {
    let board = board("charuco:5x7:0.04:0.02:DICT_4X4_50");
    let mut rng = mb_job::rng(8, 0);
    let detector = BoardDetector::new(&board);
    for image in [
        Image::filled(SIZE, 0),
        Image::filled(ImageSize::new(3, 2), 200),
        Image::from_fn(SIZE, |_, _| rng.random_range(0..=255u32) as u8),
        Image::from_fn(SIZE, |x, y| if (x / 16 + y / 16) % 2 == 0 { 30 } else { 220 }),
    ] {
        assert!(detector.detect(&image).corners.is_empty());
    }
}
