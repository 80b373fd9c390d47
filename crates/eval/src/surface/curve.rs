//! Threshold curves.

use serde::{Deserialize, Serialize};

use super::score::{Distances, f1};

/// Accuracy, recall and F1 over all thresholds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// Area under accuracy over thresholds from 0 to [`Curve::LIMIT_MM`], as a share of the whole: 1 is perfect.
    pub accuracy_auc: f64,
    /// The same of recall.
    pub recall_auc: f64,
    /// The same of F1, by the trapezoid rule over `points`.
    pub f1_auc: f64,
    /// The curve in steps of [`Curve::STEP_MM`], from 0.
    pub points: Vec<CurvePoint>,
}

/// One threshold of a curve.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// The threshold, millimetres.
    pub threshold_mm: f64,
    /// Share of the prediction's points within it.
    pub accuracy: f64,
    /// Share of the ground truth's points within it.
    pub recall: f64,
    /// Harmonic mean.
    pub f1: f64,
}

impl Curve {
    /// Largest threshold, millimetres: a brick is 9.6 mm high, and errors of two bricks are no longer accuracy.
    pub const LIMIT_MM: f64 = 20.0;
    /// Distance between thresholds, millimetres.
    pub const STEP_MM: f64 = 0.25;

    pub(super) fn of(distances: &Distances) -> Self {
        let accuracy = cumulative(&distances.pred_to_gt_m);
        let recall = cumulative(&distances.gt_to_pred_m);
        let points: Vec<CurvePoint> = accuracy
            .into_iter()
            .zip(recall)
            .enumerate()
            .map(|(i, (accuracy, recall))| {
                let threshold_mm = i as f64 * Self::STEP_MM;
                CurvePoint { threshold_mm, accuracy, recall, f1: f1(accuracy, recall) }
            })
            .collect();
        let f1_auc = points.windows(2).map(|p| 0.5 * (p[0].f1 + p[1].f1)).sum::<f64>() / (points.len() - 1) as f64;
        Self { accuracy_auc: area(&distances.pred_to_gt_m), recall_auc: area(&distances.gt_to_pred_m), f1_auc, points }
    }
}

/// Share of distances within each threshold; within means strictly below, but at threshold 0 exactly 0.
fn cumulative(distances_m: &[f64]) -> Vec<f64> {
    let steps = (Curve::LIMIT_MM / Curve::STEP_MM) as usize;
    let mut counts = vec![0usize; steps + 1];
    for d in distances_m {
        // The first threshold that is above the distance.
        let step = if *d == 0.0 { 0 } else { ((1000.0 * d / Curve::STEP_MM).floor() as usize).saturating_add(1) };
        if let Some(count) = counts.get_mut(step) {
            *count += 1;
        }
    }
    let mut sum = 0;
    let share = |count: usize| {
        sum += count;
        sum as f64 / distances_m.len() as f64
    };
    counts.into_iter().map(share).collect()
}

/// Exact area under the cumulative curve: the mean of how much of the range lies above a distance.
fn area(distances_m: &[f64]) -> f64 {
    let above = |d: &f64| (1.0 - 1000.0 * d / Curve::LIMIT_MM).max(0.0);
    distances_m.iter().map(above).sum::<f64>() / distances_m.len() as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curve_of_known_distances() {
        let distances = Distances { pred_to_gt_m: vec![0.0, 0.005, 0.01, 1.0], gt_to_pred_m: vec![0.0; 3] };
        let curve = Curve::of(&distances);
        assert!((curve.accuracy_auc - (1.0 + 0.75 + 0.5) / 4.0).abs() < 1e-12);
        assert_eq!(curve.recall_auc, 1.0);
        assert_eq!(curve.points.len(), 81);
        assert_eq!(curve.points[0].accuracy, 0.25);
        assert_eq!(curve.points[20].threshold_mm, 5.0);
        assert_eq!(curve.points[20].accuracy, 0.25);
        assert_eq!(curve.points[21].accuracy, 0.5);
        assert_eq!(curve.points[80].accuracy, 0.75);
        assert!(curve.points.windows(2).all(|p| p[0].f1 <= p[1].f1));
    }

    #[test]
    fn the_truth_has_the_whole_area() {
        let curve = Curve::of(&Distances { pred_to_gt_m: vec![0.0; 2], gt_to_pred_m: vec![0.0; 2] });
        assert_eq!((curve.accuracy_auc, curve.recall_auc, curve.f1_auc), (1.0, 1.0, 1.0));
    }
}
