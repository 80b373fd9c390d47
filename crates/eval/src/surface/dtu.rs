//! Protocol `dtu-style-1`: mean distances without outliers, as the DTU benchmark scores (Jensen et al. 2014, "Large scale
//! multi-view stereopsis evaluation"; Aanæs et al. 2016).

use std::path::Path;

use mb_job::{Progress, Result, Steps};
use mb_mesh::TriangleMesh;
use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use super::clip::Clipper;
use super::curve::Curve;
use super::distance::Target;
use super::rigid;
use super::samples::{compared, judged_samples, truth_samples};
use super::score::{Chamfer, Distances, mean};
use super::{SurfaceOptions, SurfaceProtocol, SurfaceScores, SurfaceTruth, nothing_visible};

/// Points farther away do not count, metres: DTU's `MaxDist`.
const MAX_DISTANCE_M: f64 = 0.02;

/// The figures of the DTU benchmark.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DtuScores {
    /// Mean distance from the prediction to the ground truth without outliers, millimetres.
    pub accuracy_mm: f64,
    /// Mean distance from the ground truth to the prediction without outliers, millimetres.
    pub completeness_mm: f64,
    /// Mean of the two, the benchmark's headline.
    pub overall_mm: f64,
    /// Median distance from the prediction to the ground truth without outliers, millimetres.
    pub accuracy_median_mm: f64,
    /// Median distance from the ground truth to the prediction without outliers, millimetres.
    pub completeness_median_mm: f64,
    /// Share of the prediction's points that are 20 mm or more away, and so left out.
    pub accuracy_outliers: f64,
    /// Share of the ground truth's points that are 20 mm or more away, and so left out.
    pub completeness_outliers: f64,
}

pub(super) fn score(
    truth: &SurfaceTruth,
    prediction: &TriangleMesh,
    name: &Path,
    options: &SurfaceOptions,
    progress: &dyn Progress,
) -> Result<SurfaceScores> {
    let steps = Steps::new(progress, "scoring the surface", 3);
    let clipper = Clipper::new(&truth.visibility);
    let gt_samples = truth_samples(truth, &clipper, |_| options.points, options)?;
    let pred_samples =
        judged_samples(prediction, &clipper, |_| options.points, options).ok_or_else(|| nothing_visible(name))?;
    steps.step()?;
    let (gt_target, pred_target) = (Target::new(&truth.mesh), Target::new(prediction));
    let of = |judged: Vec<super::breakdown::Judged>| judged.into_iter().map(|j| j.distance_m).collect::<Vec<f64>>();
    let distances = Distances {
        pred_to_gt_m: of(compared(&pred_samples, &gt_target)),
        gt_to_pred_m: of(compared(&gt_samples, &pred_target)),
    };
    steps.step()?;
    let gt_points: Vec<Point3<f64>> = gt_samples.iter().map(|s| s.point).collect();
    let alignment = rigid::align(&gt_points, prediction, &pred_target);
    let dtu = DtuScores::of(&distances);
    let mut warnings = Vec::new();
    if prediction.triangles.is_empty() {
        warnings.push("the prediction is a point cloud; distances to it are distances to its points".to_owned());
    }
    if dtu.accuracy_outliers == 1.0 || dtu.completeness_outliers == 1.0 {
        warnings.push("every point of one side is an outlier; its mean counts as the limit of 20 mm".to_owned());
    }
    steps.step()?;
    Ok(SurfaceScores {
        protocol: SurfaceProtocol::DtuStyle1,
        sequence: truth.sequence.clone(),
        icp: alignment.describe(truth, false),
        chamfer: Chamfer::new(dtu.accuracy_mm, dtu.completeness_mm),
        thresholds: distances.thresholds(&options.thresholds_mm()),
        curve: Curve::of(&distances),
        exact: None,
        dtu: Some(dtu),
        points: [distances.gt_to_pred_m.len(), distances.pred_to_gt_m.len()],
        seed: options.seed,
        ground_truth: truth.relative_mesh_path(),
        provenance: None,
        warnings,
        seconds: 0.0,
    })
}

impl DtuScores {
    fn of(distances: &Distances) -> Self {
        let [accuracy, completeness] = [&distances.pred_to_gt_m, &distances.gt_to_pred_m].map(|d| Side::of(d));
        Self {
            accuracy_mm: accuracy.mean_mm,
            completeness_mm: completeness.mean_mm,
            overall_mm: 0.5 * (accuracy.mean_mm + completeness.mean_mm),
            accuracy_median_mm: accuracy.median_mm,
            completeness_median_mm: completeness.median_mm,
            accuracy_outliers: accuracy.outliers,
            completeness_outliers: completeness.outliers,
        }
    }
}

struct Side {
    mean_mm: f64,
    median_mm: f64,
    outliers: f64,
}

impl Side {
    fn of(distances_m: &[f64]) -> Self {
        let near: Vec<f64> = distances_m.iter().copied().filter(|d| *d < MAX_DISTANCE_M).collect();
        let outliers = 1.0 - near.len() as f64 / distances_m.len() as f64;
        if near.is_empty() {
            let limit_mm = 1000.0 * MAX_DISTANCE_M;
            return Self { mean_mm: limit_mm, median_mm: limit_mm, outliers };
        }
        let mut sorted = near.clone();
        sorted.sort_by(f64::total_cmp);
        let middle = sorted.len() / 2;
        let median = if sorted.len() % 2 == 1 { sorted[middle] } else { 0.5 * (sorted[middle - 1] + sorted[middle]) };
        Self { mean_mm: 1000.0 * mean(&near), median_mm: 1000.0 * median, outliers }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outliers_are_left_out_and_counted() {
        let distances = Distances { pred_to_gt_m: vec![0.001, 0.003, 0.02, 1.0], gt_to_pred_m: vec![0.5; 3] };
        let scores = DtuScores::of(&distances);
        assert!((scores.accuracy_mm - 2.0).abs() < 1e-12);
        assert!((scores.accuracy_median_mm - 2.0).abs() < 1e-12);
        assert_eq!((scores.accuracy_outliers, scores.completeness_outliers), (0.5, 1.0));
        assert_eq!((scores.completeness_mm, scores.overall_mm), (20.0, 11.0));
    }
}
