//! Protocol `exact-1`: exact distances between exact surfaces, with what chance and alignment do shown beside them.

use std::path::Path;

use mb_job::{Progress, Result, Steps};
use mb_mesh::TriangleMesh;
use nalgebra::Point3;
use rand::RngExt;
use serde::{Deserialize, Serialize};

use super::breakdown::{self, Breakdown};
use super::clip::Clipper;
use super::curve::Curve;
use super::distance::Target;
use super::rigid;
use super::samples::{bare, compared, judged_samples, truth_samples};
use super::score::{Chamfer, Distances, ThresholdScore, f1, mean};
use super::{SurfaceOptions, SurfaceProtocol, SurfaceScores, SurfaceTruth, nothing_visible};

/// What `exact-1` measures beyond the common scores.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ExactScores {
    /// 95 % confidence intervals of the scores.
    pub confidence_95: Confidence95,
    /// The same scores after the prediction was moved rigidly onto the ground truth.
    pub aligned: Aligned,
    /// Where the score comes from.
    pub breakdown: Breakdown,
}

/// Scores after rigid alignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Aligned {
    /// Rotation of the alignment, degrees.
    pub rotation_deg: f64,
    /// How far the alignment moves the middle of the ground truth, millimetres.
    pub translation_mm: f64,
    /// Mean distances.
    #[serde(flatten)]
    pub chamfer: Chamfer,
    /// One entry per threshold, ascending.
    pub thresholds: Vec<ThresholdScore>,
    /// What the alignment changed.
    pub effect: AlignmentEffect,
}

/// Aligned less unaligned: how much of a score is owed to the poses rather than to the surface.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlignmentEffect {
    /// Change of the Chamfer distance, millimetres; below 0 the alignment helps.
    pub chamfer_mm: f64,
    /// Change of F1 at each threshold; above 0 the alignment helps.
    pub f1: Vec<F1Change>,
}

/// Change of F1 at one threshold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct F1Change {
    /// The threshold, millimetres.
    pub threshold_mm: f64,
    /// Aligned less unaligned.
    pub change: f64,
}

impl AlignmentEffect {
    fn of(before: &Distances, after: &Distances, thresholds_mm: &[f64]) -> Self {
        let (before_f1, after_f1) = (before.thresholds(thresholds_mm), after.thresholds(thresholds_mm));
        let change =
            |(a, b): (&ThresholdScore, &ThresholdScore)| F1Change { threshold_mm: a.threshold_mm, change: b.f1 - a.f1 };
        Self {
            chamfer_mm: after.chamfer().chamfer_mm - before.chamfer().chamfer_mm,
            f1: before_f1.iter().zip(&after_f1).map(change).collect(),
        }
    }
}

/// Intervals by a block bootstrap: each surface's samples, in the order of its triangles, are cut into
/// [`Confidence95::BLOCKS`] patches, and patches are drawn with replacement [`Confidence95::RESAMPLES`] times. They tell
/// how far a score hangs on a few places of the surface.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Confidence95 {
    /// Chamfer distance, millimetres.
    pub chamfer_mm: Interval,
    /// Mean distance from the prediction to the ground truth, millimetres.
    pub pred_to_gt_mm: Interval,
    /// Mean distance from the ground truth to the prediction, millimetres.
    pub gt_to_pred_mm: Interval,
    /// Accuracy, recall and F1 for each threshold.
    pub thresholds: Vec<ThresholdIntervals>,
}

/// Intervals at one threshold.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ThresholdIntervals {
    /// The threshold, millimetres.
    pub threshold_mm: f64,
    /// Share of the prediction's points within it.
    pub accuracy: Interval,
    /// Share of the ground truth's points within it.
    pub recall: Interval,
    /// Harmonic mean.
    pub f1: Interval,
}

/// Lower and upper bound: the 2.5 and 97.5 % quantiles.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval(pub f64, pub f64);

/// Rays start this far from an exact surface, metres: touching walls of two bricks coincide.
const EXACT_LIFT_M: f64 = 1e-5;
/// Rays start this far from a fused surface, metres: its error is below half a voxel.
const FUSED_LIFT_M: f64 = 1e-3;

pub(super) fn score(
    truth: &SurfaceTruth,
    prediction: &TriangleMesh,
    name: &Path,
    options: &SurfaceOptions,
    progress: &dyn Progress,
) -> Result<SurfaceScores> {
    let steps = Steps::new(progress, "scoring the surface", 4);
    let mut warnings = Vec::new();
    let clipper = Clipper::new(&truth.visibility);
    let gt_samples = truth_samples(truth, &clipper, |_| options.points, options)?;
    if prediction.triangles.is_empty() {
        warnings.push("the prediction is a point cloud; distances to it are distances to its points".to_owned());
    }
    warnings.extend(truth.setting.notes.iter().cloned());
    let gt_points: Vec<Point3<f64>> = gt_samples.iter().map(|s| s.point).collect();
    let gt_target = Target::new(&truth.mesh);
    let pred_target = Target::new(prediction);
    steps.step()?;

    // The clip decides which points are judged, not what they are compared with: surfaces are whole on the other side.
    let pred_samples =
        judged_samples(prediction, &clipper, |_| options.points, options).ok_or_else(|| nothing_visible(name))?;
    let pred_judged = compared(&pred_samples, &gt_target);
    let gt_judged = compared(&gt_samples, &pred_target);
    let as_it_is = Distances {
        pred_to_gt_m: pred_judged.iter().map(|j| j.distance_m).collect(),
        gt_to_pred_m: gt_judged.iter().map(|j| j.distance_m).collect(),
    };
    steps.step()?;

    let alignment = rigid::align(&gt_points, prediction, &pred_target);
    let middle = truth.mesh.bounds().center();
    let moved = if alignment.is_rest(&middle) {
        None
    } else {
        let moved_prediction = bare(prediction).transformed(&alignment.pred_from_gt.inverse());
        judged_samples(&moved_prediction, &clipper, |_| options.points, options)
    };
    steps.step()?;
    let aligned = moved.map(|pred_samples| {
        let pred_points: Vec<Point3<f64>> = pred_samples.iter().map(|s| s.point).collect();
        let gt_in_pred: Vec<Point3<f64>> = gt_points.iter().map(|p| alignment.pred_from_gt * *p).collect();
        Distances {
            pred_to_gt_m: gt_target.distances_m(&pred_points),
            gt_to_pred_m: pred_target.distances_m(&gt_in_pred),
        }
    });
    steps.step()?;

    let thresholds_mm = options.thresholds_mm();
    let breakdown = Breakdown::of(&breakdown::Parts {
        gt: &truth.mesh,
        gt_bvh: gt_target.bvh(),
        lift_m: if truth.is_exact() { EXACT_LIFT_M } else { FUSED_LIFT_M },
        prediction,
        setting: &truth.setting,
        gt_points: &gt_judged,
        pred_points: &pred_judged,
        thresholds_mm: &thresholds_mm,
    });
    let best = aligned.as_ref().unwrap_or(&as_it_is);
    let icp = alignment.describe(truth, false);
    Ok(SurfaceScores {
        protocol: SurfaceProtocol::Exact1,
        sequence: truth.sequence.clone(),
        icp,
        chamfer: as_it_is.chamfer(),
        thresholds: as_it_is.thresholds(&thresholds_mm),
        curve: Curve::of(&as_it_is),
        points: [as_it_is.gt_to_pred_m.len(), as_it_is.pred_to_gt_m.len()],
        exact: Some(ExactScores {
            confidence_95: Confidence95::of(&as_it_is, &thresholds_mm, options.seed),
            aligned: Aligned {
                rotation_deg: icp.rotation_deg,
                translation_mm: icp.translation_mm,
                chamfer: best.chamfer(),
                thresholds: best.thresholds(&thresholds_mm),
                effect: AlignmentEffect::of(&as_it_is, best, &thresholds_mm),
            },
            breakdown,
        }),
        dtu: None,
        seed: options.seed,
        ground_truth: truth.relative_mesh_path(),
        provenance: None,
        warnings,
        seconds: 0.0,
    })
}

impl Confidence95 {
    /// Patches per surface.
    pub const BLOCKS: usize = 500;
    /// Bootstrap resamples.
    pub const RESAMPLES: usize = 1000;

    /// The seed's stream: the sampling of surfaces uses low numbers.
    const STREAM: u64 = 1 << 40;

    fn of(distances: &Distances, thresholds_mm: &[f64], seed: u64) -> Self {
        let mut rng = mb_job::rng(seed, Self::STREAM);
        let mut resample = |distances_m: &[f64]| {
            let blocks = Block::cut(distances_m, thresholds_mm);
            let draw = |_| {
                let mut sum = Block::empty(thresholds_mm.len());
                for _ in 0..blocks.len() {
                    sum.add(&blocks[rng.random_range(0..blocks.len())]);
                }
                sum
            };
            (0..Self::RESAMPLES).map(draw).collect::<Vec<Block>>()
        };
        let pred = resample(&distances.pred_to_gt_m);
        let gt = resample(&distances.gt_to_pred_m);
        let interval = |value: &dyn Fn(&Block, &Block) -> f64| {
            Interval::of(pred.iter().zip(&gt).map(|(pred, gt)| value(pred, gt)).collect())
        };
        let threshold = |(i, &threshold_mm): (usize, &f64)| ThresholdIntervals {
            threshold_mm,
            accuracy: interval(&|pred, _| pred.share(i)),
            recall: interval(&|_, gt| gt.share(i)),
            f1: interval(&|pred, gt| f1(pred.share(i), gt.share(i))),
        };
        Self {
            chamfer_mm: interval(&|pred, gt| pred.mean_mm() + gt.mean_mm()),
            pred_to_gt_mm: interval(&|pred, _| pred.mean_mm()),
            gt_to_pred_mm: interval(&|_, gt| gt.mean_mm()),
            thresholds: thresholds_mm.iter().enumerate().map(threshold).collect(),
        }
    }
}

/// Sums over some samples.
struct Block {
    count: usize,
    distance_m: f64,
    below: Vec<usize>,
}

impl Block {
    fn empty(thresholds: usize) -> Self {
        Self { count: 0, distance_m: 0.0, below: vec![0; thresholds] }
    }

    fn cut(distances_m: &[f64], thresholds_mm: &[f64]) -> Vec<Self> {
        let size = distances_m.len().div_ceil(Confidence95::BLOCKS).max(1);
        let block = |samples: &[f64]| Self {
            count: samples.len(),
            distance_m: mean(samples) * samples.len() as f64,
            below: thresholds_mm.iter().map(|t| samples.iter().filter(|d| **d < t / 1000.0).count()).collect(),
        };
        distances_m.chunks(size).map(block).collect()
    }

    fn add(&mut self, other: &Self) {
        self.count += other.count;
        self.distance_m += other.distance_m;
        self.below.iter_mut().zip(&other.below).for_each(|(a, b)| *a += b);
    }

    fn mean_mm(&self) -> f64 {
        1000.0 * self.distance_m / self.count as f64
    }

    fn share(&self, threshold: usize) -> f64 {
        self.below[threshold] as f64 / self.count as f64
    }
}

impl Interval {
    /// The central 95 % of the values, at least one.
    pub(crate) fn of(mut values: Vec<f64>) -> Self {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values[((values.len() - 1) as f64 * share).round() as usize];
        Self(at(0.025), at(0.975))
    }
}
