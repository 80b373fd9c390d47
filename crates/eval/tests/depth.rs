//! Scores of depth maps: reference values, laws, and input that is not as it should be.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::PathBuf;

use mb_eval::{DepthOptions, DepthScores, MetricDepth, evaluate_depth, score_depth};
use mb_geometry::ImageSize;
use mb_image::{Confidence, DepthImage, Image, write_confidence_png, write_depth_png, write_rgb_png};
use mb_job::Silent;
use proptest::prelude::*;
use serde_json::Value;

const SIZE: ImageSize = ImageSize::new(12, 9);

fn score(gt: MetricDepth, pred: MetricDepth) -> Option<DepthScores> {
    score_depth(&[(gt, pred)], &DepthOptions::default())
}

fn depth() -> impl Strategy<Value = MetricDepth> {
    // A quarter of the pixels without depth.
    prop::collection::vec(prop_oneof![1 => Just(0.0), 3 => 0.05..8.0f64], SIZE.pixels())
        .prop_map(|data| Image::from_data(SIZE, data).unwrap())
}

#[test]
fn the_reference_values_agree() {
    let Some(folder) = mb_testdata::find("official_scorer/depth") else { return };
    let expected: Value = serde_json::from_slice(&std::fs::read(folder.join("expected_depth.json")).unwrap()).unwrap();
    let expected = &expected["pairs"][0];
    let scores = evaluate_depth(&folder, &folder, &DepthOptions::default(), &Silent).unwrap();
    let document = serde_json::to_value(&scores).unwrap();
    for (ours, theirs) in [
        ("abs_rel", "abs_rel"),
        ("sq_rel", "sq_rel"),
        ("rmse_m", "rmse"),
        ("rmse_log", "rmse_log"),
        ("silog", "silog"),
        ("delta1", "delta1"),
        ("delta2", "delta2"),
        ("delta3", "delta3"),
        ("delta_105", "delta_105"),
        ("delta_1025", "delta_1025"),
        ("valid_pixels", "n_valid"),
        ("gt_pixels", "n_gt"),
    ] {
        let (found, expected) = (document[ours].as_f64().unwrap(), expected[theirs].as_f64().unwrap());
        assert!((found - expected).abs() < 1e-10, "{ours} is {found}, not {expected}");
        assert_eq!(document["per_image"][0][ours], document[ours], "one image is its own mean");
    }
}

proptest! {
    #[test]
    fn a_map_is_like_itself(depth in depth()) {
        prop_assume!(depth.data().iter().any(|&z| z > 0.0));
        let mean = score(depth.clone(), depth).unwrap().mean;
        prop_assert_eq!((mean.abs_rel, mean.sq_rel, mean.rmse_m, mean.rmse_log, mean.silog), (0.0, 0.0, 0.0, 0.0, 0.0));
        prop_assert_eq!((mean.delta1, mean.delta_1025), (1.0, 1.0));
    }

    #[test]
    fn ratios_do_not_depend_on_the_unit(gt in depth(), pred in depth(), scale in 0.1..10.0f64) {
        let Some(scores) = score(gt.clone(), pred.clone()) else { return Ok(()) };
        let scaled = score(gt.map(|z| z * scale), pred.map(|z| z * scale)).unwrap();
        for (a, b, power) in [
            (scores.mean.abs_rel, scaled.mean.abs_rel, 0),
            (scores.mean.rmse_log, scaled.mean.rmse_log, 0),
            (scores.mean.silog, scaled.mean.silog, 0),
            (scores.mean.sq_rel, scaled.mean.sq_rel, 1),
            (scores.mean.rmse_m, scaled.mean.rmse_m, 1),
        ] {
            prop_assert!((a * scale.powi(power) - b).abs() <= 1e-6 * (1.0 + b.abs()), "{} {}", a, b);
        }
    }

    #[test]
    fn the_logarithmic_metrics_treat_both_sides_alike(gt in depth(), pred in depth()) {
        let (Some(one), Some(other)) = (score(gt.clone(), pred.clone()), score(pred, gt)) else { return Ok(()) };
        prop_assert!((one.mean.rmse_log - other.mean.rmse_log).abs() < 1e-12);
        prop_assert!((one.mean.silog - other.mean.silog).abs() < 1e-6);
        prop_assert_eq!(one.mean.delta1, other.mean.delta1);
        prop_assert_eq!(one.mean.rmse_m, other.mean.rmse_m);
    }

    #[test]
    fn a_scale_alone_has_no_scale_invariant_error(gt in depth(), scale in 0.5..2.0f64) {
        prop_assume!(gt.data().iter().any(|&z| z > 0.0));
        let mean = score(gt.clone(), gt.map(|z| z * scale)).unwrap().mean;
        prop_assert!(mean.silog < 1e-4, "{}", mean.silog);
        prop_assert!((mean.abs_rel - (scale - 1.0).abs()).abs() < 1e-12);
        prop_assert!((mean.rmse_log - scale.ln().abs()).abs() < 1e-12);
    }

    #[test]
    fn splits_share_out_every_pixel(gt in depth(), pred in depth()) {
        let Some(scores) = score(gt, pred) else { return Ok(()) };
        let pixels = |m: Option<mb_eval::DepthMetrics>| m.map_or(0, |m| m.valid_pixels);
        prop_assert_eq!(pixels(scores.by_region.edge) + pixels(scores.by_region.interior), scores.pooled.valid_pixels);
    }
}

#[test]
fn thresholds_are_strict_and_see_whole_millimetres() {
    let folders = Folders::new();
    // 500 / 400 is 1.25 exactly, which is not below 1.25; 499 / 400 is.
    folders.write("gt/a.png", &DepthImage::filled(SIZE, 0.4));
    folders.write("pred/a.png", &Image::from_fn(SIZE, |x, _| if x < 6 { 0.5 } else { 0.499 }));
    assert_eq!(folders.score().unwrap().mean.delta1, 0.5);
}

#[test]
fn values_that_are_no_depth_are_left_out() {
    let gt = MetricDepth::from_data(ImageSize::new(5, 1), vec![1.0, 1.0, 1.0, f64::NAN, -1.0]).unwrap();
    let pred = MetricDepth::from_data(ImageSize::new(5, 1), vec![1.1, f64::NAN, f64::INFINITY, 1.0, 1.0]).unwrap();
    let scores = score(gt.clone(), pred).unwrap();
    assert_eq!((scores.mean.valid_pixels, scores.gt_pixels), (1, 3));
    assert!((scores.mean.abs_rel - 0.1).abs() < 1e-12);
    assert!(score(gt.clone(), gt.map(|_| 0.0)).is_none());
    assert!(score(gt, MetricDepth::filled(ImageSize::new(4, 1), 1.0)).is_none());
}

#[test]
fn edges_are_where_the_truth_steps_or_ends() {
    let size = ImageSize::new(40, 20);
    // A step in the middle, and no truth in the last 10 columns.
    let gt = Image::from_fn(size, |x, _| [1.0, 1.5, 1.5, 0.0][x / 10]);
    let pred =
        Image::from_fn(size, |x, _| if (7..=12).contains(&x) || x >= 27 { 3.0 } else { [1.0, 1.5, 1.5, 1.5][x / 10] });
    let regions = score(gt, pred).unwrap().by_region;
    assert_eq!(regions.interior.unwrap().abs_rel, 0.0);
    let edge = regions.edge.unwrap();
    // Columns 9 and 10 make the step and 29 the end; with 3 more on each side.
    assert_eq!(edge.valid_pixels, (8 + 4) * 20);
    assert!(edge.abs_rel > 0.5);
}

#[test]
fn confidence_of_another_size_splits_the_pixels() {
    let folders = Folders::new();
    let size = ImageSize::new(40, 20);
    folders.write("gt/000007.png", &DepthImage::filled(size, 1.0));
    folders.write("pred/000007.png", &Image::from_fn(size, |x, _| 1.0 + 0.1 * (x / 20) as f32));
    let confidence = folders.path("arkit_depth");
    write_confidence_png(
        confidence.join("000007_conf.png"),
        &Confidence::from_fn(ImageSize::new(4, 2), |x, _| if x < 2 { 2 } else { 0 }),
    )
    .unwrap();
    let options = DepthOptions { confidence: Some(confidence), ..Default::default() };
    let split = folders.score_with(&options).unwrap().by_confidence.unwrap();
    assert_eq!(split.high.unwrap().abs_rel, 0.0);
    assert!((split.low.unwrap().abs_rel - 0.1).abs() < 1e-9);
    assert_eq!(split.medium, None);
}

#[test]
fn the_mean_is_over_images_and_the_pool_over_pixels() {
    let folders = Folders::new();
    folders.write("gt/a.png", &DepthImage::filled(ImageSize::new(10, 10), 1.0));
    folders.write("pred/a.png", &DepthImage::filled(ImageSize::new(10, 10), 1.1));
    folders.write("gt/b.png", &DepthImage::filled(ImageSize::new(10, 30), 1.0));
    folders.write("pred/b.png", &DepthImage::filled(ImageSize::new(10, 30), 1.3));
    // The phone's confidence maps lie among its depth maps and are none.
    write_confidence_png(folders.path("pred/b_conf.png"), &Confidence::filled(SIZE, 2)).unwrap();
    folders.write("gt/c.png", &DepthImage::filled(SIZE, 1.0));
    folders.write("gt/d.png", &DepthImage::filled(SIZE, 1.0));
    folders.write("pred/d.png", &DepthImage::filled(SIZE, 0.0));
    let scores = folders.score().unwrap();
    assert!((scores.mean.abs_rel - 0.2).abs() < 1e-9);
    assert!((scores.pooled.abs_rel - 0.25).abs() < 1e-9);
    assert_eq!((scores.images, scores.mean.valid_pixels, scores.per_image.len()), (2, 400, 3));
    assert_eq!(scores.missing, ["c"]);
    assert!(scores.warnings.iter().any(|w| w.starts_with("d:")), "an empty prediction is named: {:?}", scores.warnings);
}

#[test]
fn a_prediction_in_another_unit_is_named() {
    let gt = Image::from_fn(SIZE, |x, y| 0.5 + 0.01 * (x + y) as f64);
    let scores = score(gt.clone(), gt.map(|z| z * 10.0)).unwrap();
    assert!(scores.warnings[0].contains("10.0000 times"), "{:?}", scores.warnings);
    assert!(score(gt.clone(), gt.map(|z| z * 1.2)).unwrap().warnings.is_empty());
}

#[test]
fn bad_input_is_named() {
    let folders = Folders::new();
    folders.write("gt/a.png", &DepthImage::filled(SIZE, 1.0));
    folders.write("pred/a.png", &DepthImage::filled(ImageSize::new(6, 9), 1.0));
    let refusal = || folders.score().unwrap_err().to_string();
    assert!(refusal().contains("6x9") && refusal().contains("12x9"), "{}", refusal());
    folders.write("pred/a.png", &DepthImage::filled(SIZE, 0.0));
    assert!(refusal().contains("no pixel has depth both here and in the ground truth"), "{}", refusal());
    write_rgb_png(folders.path("pred/a.png"), &Image::filled(SIZE, [1, 2, 3])).unwrap();
    assert!(refusal().contains("16-bit"), "{}", refusal());
}

struct Folders(tempfile::TempDir);

impl Folders {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, relative: &str) -> PathBuf {
        self.0.path().join(relative)
    }

    fn write(&self, relative: &str, depth: &DepthImage) {
        write_depth_png(self.path(relative), depth).unwrap();
    }

    fn score(&self) -> mb_job::Result<DepthScores> {
        self.score_with(&DepthOptions::default())
    }

    fn score_with(&self, options: &DepthOptions) -> mb_job::Result<DepthScores> {
        evaluate_depth(&self.path("gt"), &self.path("pred"), options, &Silent)
    }
}
