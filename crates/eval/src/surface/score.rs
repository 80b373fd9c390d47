//! From distances to scores.

use serde::{Deserialize, Serialize};

/// Mean distances in both directions.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Chamfer {
    /// Sum of both means, millimetres.
    pub chamfer_mm: f64,
    /// Mean distance from the prediction to the ground truth, millimetres.
    pub pred_to_gt_mm: f64,
    /// Mean distance from the ground truth to the prediction, millimetres.
    pub gt_to_pred_mm: f64,
}

impl Chamfer {
    /// From the two means, millimetres.
    pub(super) fn new(pred_to_gt_mm: f64, gt_to_pred_mm: f64) -> Self {
        Self { chamfer_mm: pred_to_gt_mm + gt_to_pred_mm, pred_to_gt_mm, gt_to_pred_mm }
    }
}

/// Shares of points within a threshold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ThresholdScore {
    /// The threshold, millimetres.
    pub threshold_mm: f64,
    /// Share of the prediction's points nearer than the threshold to the ground truth (precision).
    pub accuracy: f64,
    /// Share of the ground truth's points nearer than the threshold to the prediction (completeness).
    pub recall: f64,
    /// Harmonic mean of both, 0 where both are 0.
    pub f1: f64,
}

impl ThresholdScore {
    /// From the two shares.
    pub(super) fn new(threshold_mm: f64, accuracy: f64, recall: f64) -> Self {
        Self { threshold_mm, accuracy, recall, f1: f1(accuracy, recall) }
    }
}

/// Harmonic mean of accuracy and recall; 0 where both are 0.
pub(crate) fn f1(accuracy: f64, recall: f64) -> f64 {
    if accuracy + recall > 0.0 { 2.0 * accuracy * recall / (accuracy + recall) } else { 0.0 }
}

/// Distances of sampled points in both directions, metres, each at least one.
pub(super) struct Distances {
    pub pred_to_gt_m: Vec<f64>,
    pub gt_to_pred_m: Vec<f64>,
}

impl Distances {
    pub fn chamfer(&self) -> Chamfer {
        Chamfer::new(1000.0 * mean(&self.pred_to_gt_m), 1000.0 * mean(&self.gt_to_pred_m))
    }

    pub fn thresholds(&self, thresholds_mm: &[f64]) -> Vec<ThresholdScore> {
        let score =
            |&t: &f64| ThresholdScore::new(t, share_below(&self.pred_to_gt_m, t), share_below(&self.gt_to_pred_m, t));
        thresholds_mm.iter().map(score).collect()
    }
}

/// Mean, summed in order.
pub(super) fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// Share of distances (metres) strictly below a threshold (millimetres).
fn share_below(distances_m: &[f64], threshold_mm: f64) -> f64 {
    let threshold_m = threshold_mm / 1000.0;
    distances_m.iter().filter(|&&d| d < threshold_m).count() as f64 / distances_m.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_of_known_distances() {
        let distances =
            Distances { pred_to_gt_m: vec![0.0, 0.001, 0.003, 0.02], gt_to_pred_m: vec![0.0025, 0.001, 0.001, 0.001] };
        let chamfer = distances.chamfer();
        assert!((chamfer.pred_to_gt_mm - 6.0).abs() < 1e-12);
        assert!((chamfer.gt_to_pred_mm - 1.375).abs() < 1e-12);
        assert!((chamfer.chamfer_mm - 7.375).abs() < 1e-12);
        let at = distances.thresholds(&[2.5, 5.0]);
        // A distance of exactly the threshold is not within it.
        assert_eq!((at[0].accuracy, at[0].recall), (0.5, 0.75));
        assert!((at[0].f1 - 0.6).abs() < 1e-12);
        assert_eq!((at[1].accuracy, at[1].recall), (0.75, 1.0));
    }

    #[test]
    fn nothing_found_is_zero_not_nan() {
        assert_eq!(f1(0.0, 0.0), 0.0);
        assert_eq!(f1(1.0, 0.0), 0.0);
    }
}
