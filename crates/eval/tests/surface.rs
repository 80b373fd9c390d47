//! Surface scores against the published script's own numbers, and against closed forms.

use std::path::Path;

use mb_eval::{SurfaceOptions, SurfaceProtocol, SurfaceScores, evaluate_surface};
use mb_job::Silent;

fn score(gt: &Path, pred: &Path, protocol: SurfaceProtocol) -> SurfaceScores {
    let options = SurfaceOptions { protocol, ..SurfaceOptions::default() };
    evaluate_surface(gt, pred, &options, &Silent).unwrap()
}

/// The published script on four predictions with known defects. Its sampling is unseeded; the tolerances are above what
/// two of its own runs differ by.
#[test]
fn the_published_script_is_reproduced() {
    let Some(folder) = mb_testdata::find("official_scorer") else { return };
    let text = std::fs::read_to_string(folder.join("expected_surface.json")).unwrap();
    let expected: serde_json::Value = serde_json::from_str(&text).unwrap();
    let predictions = expected["predictions"].as_object().unwrap();
    assert_eq!(predictions.len(), 4);
    for (name, expected) in predictions {
        let pred = folder.join("preds").join(name).with_extension("ply");
        let found = score(&folder.join("wedge"), &pred, SurfaceProtocol::MobileBrick2023);
        let close = |what: &str, found: f64, expected: &serde_json::Value, tolerance: f64| {
            let expected = expected.as_f64().unwrap();
            assert!((found - expected).abs() <= tolerance, "{name}: {what} is {found}, expected {expected}");
        };
        close("fitness", found.icp.fitness, &expected["fitness"], 1e-4);
        assert_eq!(found.icp.applied, found.icp.fitness > 0.99);
        close("Chamfer in m", found.chamfer.chamfer_mm / 1000.0, &expected["chamfer"], 2e-5);
        for (threshold, key) in found.thresholds.iter().zip(["2.5mm", "5mm"]) {
            close("accuracy", threshold.accuracy, &expected[format!("accuracy_{key}")], 0.003);
            close("recall", threshold.recall, &expected[format!("recall_{key}")], 0.003);
            close("F1", threshold.f1, &expected[format!("F1_{key}")], 0.003);
        }
    }
}

#[test]
fn the_truth_scores_perfectly_in_the_exact_protocol() {
    let Some(folder) = mb_testdata::find("official_scorer") else { return };
    let gt = folder.join("wedge");
    let found = score(&gt, &gt.join("mesh/gt_mesh.ply"), SurfaceProtocol::Exact1);
    assert_eq!((found.chamfer.chamfer_mm, found.chamfer.pred_to_gt_mm, found.chamfer.gt_to_pred_mm), (0.0, 0.0, 0.0));
    let aligned = &found.exact.as_ref().unwrap().aligned;
    assert_eq!(aligned.chamfer.chamfer_mm, 0.0);
    for threshold in found.thresholds.iter().chain(&aligned.thresholds) {
        assert_eq!((threshold.accuracy, threshold.recall, threshold.f1), (1.0, 1.0, 1.0));
    }
    assert_eq!(found.curve.f1_auc, 1.0);
    assert!(found.warnings.is_empty(), "{:?}", found.warnings);
}
