//! Features: closed-form blobs, turned photographs, real photographs.

use mb_align::{Feature, FeatureOptions, MatchOptions, detect_features, match_features};
use mb_geometry::ImageSize;
use mb_image::{Image, RgbImage};
use nalgebra::{Point2, Vector2};
use rand::RngExt;

/// Soft round blobs at known places.
fn blobs(places: &[(f64, f64, f64)], size: ImageSize) -> RgbImage {
    Image::from_fn(size, |x, y| {
        let sum: f64 = places
            .iter()
            .map(|(cx, cy, sigma)| {
                let d_sq = (x as f64 - cx).powi(2) + (y as f64 - cy).powi(2);
                150.0 * (-d_sq / (2.0 * sigma * sigma)).exp()
            })
            .sum();
        [(60.0 + sum).min(255.0) as u8; 3]
    })
}

#[test]
fn blobs_are_found_where_they_are_and_as_wide_as_they_are() {
    let places = [(40.3, 50.7, 3.0), (120.0, 60.25, 5.0), (80.6, 130.4, 9.0)];
    let image = blobs(&places, ImageSize::new(200, 180));
    for upsample in [true, false] {
        let found = detect_features(&image, &FeatureOptions { upsample, ..FeatureOptions::default() });
        for (x, y, sigma) in places {
            let nearest = found
                .iter()
                .min_by(|a, b| {
                    let d = |f: &Feature| (f.pixel - Point2::new(x, y)).norm();
                    d(a).total_cmp(&d(b))
                })
                .expect("there are features");
            assert!((nearest.pixel - Point2::new(x, y)).norm() < 0.15, "({x}, {y}): {:?}", nearest.pixel);
            // The difference of Gaussians answers most to a blob of its own width (within a step of the scale).
            assert!((nearest.scale_px / sigma).log2().abs() < 0.4, "{sigma}: {}", nearest.scale_px);
        }
    }
}

#[test]
fn an_even_or_tiny_image_has_no_features() {
    let even = Image::filled(ImageSize::new(100, 80), [120, 120, 120]);
    assert!(detect_features(&even, &FeatureOptions::default()).is_empty());
    for (width, height) in [(1, 1), (3, 200), (12, 9)] {
        let tiny = Image::from_fn(ImageSize::new(width, height), |x, y| [(x * 37 + y * 91) as u8; 3]);
        detect_features(&tiny, &FeatureOptions::default());
    }
}

#[test]
fn a_turned_and_shrunk_photograph_keeps_its_matches() {
    let mut rng = mb_job::rng(3, 0);
    let places: Vec<(f64, f64, f64)> = (0..160)
        .map(|_| (rng.random_range(0.0..300.0), rng.random_range(0.0..300.0), rng.random_range(1.5..6.0)))
        .collect();
    let size = ImageSize::new(300, 300);
    let (turn, scale) = (0.6f64, 0.8);
    let there = |p: &Point2<f64>| {
        let d = Vector2::new(p.x - 150.0, p.y - 150.0) * scale;
        Point2::new(150.0 + turn.cos() * d.x - turn.sin() * d.y, 150.0 + turn.sin() * d.x + turn.cos() * d.y)
    };
    let moved: Vec<_> = places
        .iter()
        .map(|(x, y, sigma)| {
            let p = there(&Point2::new(*x, *y));
            (p.x, p.y, sigma * scale)
        })
        .collect();
    let a = detect_features(&blobs(&places, size), &FeatureOptions::default());
    let b = detect_features(&blobs(&moved, size), &FeatureOptions::default());
    let matches = match_features(&a, &b, &MatchOptions::default());
    // Large features are placed less finely than small ones.
    let right = matches
        .iter()
        .filter(|(i, j)| (there(&a[*i].pixel) - b[*j].pixel).norm() < (0.3 * b[*j].scale_px).max(1.0))
        .count();
    assert!(matches.len() > 60, "{} matches of {} and {}", matches.len(), a.len(), b.len());
    assert!(right * 100 >= matches.len() * 90, "{right} of {} are right", matches.len());
}

/// Median distance of matches from the epipolar lines of published poses, symmetric, in pixels.
#[test]
fn matches_between_published_frames_agree_with_their_poses() {
    let Some(root) = mb_testdata::find("mobilebrick_5frames") else { return };
    let read = |kind: &str, frame: u32| root.join(kind).join(format!("{frame:06}.txt"));
    let features = |frame: u32| {
        let image = mb_image::read_rgb(root.join("image").join(format!("{frame:06}.jpg"))).unwrap();
        detect_features(&image, &FeatureOptions { upsample: false, most: 2500, ..FeatureOptions::default() })
    };
    let camera = |frame: u32| {
        let k = mb_capture::read_intrinsics_txt(read("intrinsic", frame)).unwrap();
        (k, mb_capture::read_pose_txt(read("pose", frame)).unwrap().0)
    };
    let (a, b) = (features(0), features(2));
    let matches = match_features(&a, &b, &MatchOptions { ratio: 0.7, mutual: true });
    let ((k_a, world_from_a), (k_b, world_from_b)) = (camera(0), camera(2));
    let b_from_a = world_from_b.inverse() * world_from_a;
    let essential = b_from_a.translation().cross_matrix() * b_from_a.rotation_matrix();
    let f = k_b.to_matrix().try_inverse().unwrap().transpose() * essential * k_a.to_matrix().try_inverse().unwrap();
    let mut distances: Vec<f64> = matches
        .iter()
        .map(|(i, j)| {
            let (p, q) = (a[*i].pixel.to_homogeneous(), b[*j].pixel.to_homogeneous());
            let (line_b, line_a) = (f * p, f.transpose() * q);
            let value = q.dot(&line_b).abs();
            0.5 * value * (1.0 / line_b.xy().norm() + 1.0 / line_a.xy().norm())
        })
        .collect();
    distances.sort_by(f64::total_cmp);
    let median = distances[distances.len() / 2];
    assert!(matches.len() > 150, "{} matches", matches.len());
    assert!(median < 0.6, "median epipolar distance {median} px over {} matches", matches.len());
}
