//! Protocol `tnt-style-1`: precision, recall and F-score of registered, evenly thinned clouds, as Tanks and Temples scores
//! (Knapitsch et al. 2017, "Tanks and Temples: benchmarking large-scale scene reconstruction", section 5).

use std::path::Path;

use mb_job::{Progress, Result, Steps};
use mb_mesh::TriangleMesh;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

use super::clip::Clipper;
use super::curve::Curve;
use super::distance::Target;
use super::published::nearest_m;
use super::rigid;
use super::samples::{Sample, bare, judged_samples, truth_samples};
use super::score::{Distances, ThresholdScore};
use super::{SurfaceOptions, SurfaceProtocol, SurfaceScores, SurfaceTruth, nothing_visible};

/// Samples per voxel of the finest grid, so that few voxels on the surface stay empty.
const SAMPLES_PER_VOXEL: f64 = 4.0;
/// Samples on a surface, at most.
const MAX_SAMPLES: usize = 10_000_000;

pub(super) fn score(
    truth: &SurfaceTruth,
    prediction: &TriangleMesh,
    name: &Path,
    options: &SurfaceOptions,
    progress: &dyn Progress,
) -> Result<SurfaceScores> {
    let thresholds_mm = options.thresholds_mm();
    let steps = Steps::new(progress, "scoring the surface", 2 + thresholds_mm.len());
    let clipper = Clipper::new(&truth.visibility);
    let finest_m = voxel_m(thresholds_mm[0]);
    let enough = |area_m2: f64| {
        let wanted = SAMPLES_PER_VOXEL * area_m2 / (finest_m * finest_m);
        (wanted as usize).clamp(options.points, MAX_SAMPLES)
    };
    let gt = points(truth_samples(truth, &clipper, enough, options)?);
    steps.step()?;

    let alignment = rigid::align(&gt, prediction, &Target::new(prediction));
    let moved = bare(prediction).transformed(&alignment.pred_from_gt.inverse());
    let pred = judged_samples(&moved, &clipper, enough, options).ok_or_else(|| nothing_visible(name))?;
    let pred = points(pred);
    drop(moved);
    steps.step()?;

    let mut finest = None;
    let mut thresholds = Vec::new();
    for &threshold_mm in &thresholds_mm {
        let (gt, pred) = (thinned(&gt, voxel_m(threshold_mm)), thinned(&pred, voxel_m(threshold_mm)));
        let distances = Distances { pred_to_gt_m: nearest_m(&pred, &gt), gt_to_pred_m: nearest_m(&gt, &pred) };
        thresholds.extend(distances.thresholds(&[threshold_mm]));
        finest.get_or_insert(distances);
        steps.step()?;
    }
    let distances = finest.expect("2.5 and 5 mm are always among the thresholds");
    let mut warnings = Vec::new();
    if prediction.triangles.is_empty() {
        warnings.push("the prediction is a point cloud; its points are scored".to_owned());
    }
    Ok(SurfaceScores {
        protocol: SurfaceProtocol::TntStyle1,
        sequence: truth.sequence.clone(),
        icp: alignment.describe(truth, true),
        chamfer: distances.chamfer(),
        thresholds: thresholds.into_iter().collect::<Vec<ThresholdScore>>(),
        curve: Curve::of(&distances),
        exact: None,
        dtu: None,
        points: [distances.gt_to_pred_m.len(), distances.pred_to_gt_m.len()],
        seed: options.seed,
        ground_truth: truth.relative_mesh_path(),
        provenance: None,
        warnings,
        seconds: 0.0,
    })
}

/// Both clouds are thinned to half of the threshold, as the benchmark's script does.
fn voxel_m(threshold_mm: f64) -> f64 {
    threshold_mm / 1000.0 / 2.0
}

fn points(samples: Vec<Sample>) -> Vec<Point3<f64>> {
    samples.into_iter().map(|s| s.point).collect()
}

/// One point per occupied voxel, the mean of those in it (Open3D's `voxel_down_sample`), in the order of the voxels.
fn thinned(points: &[Point3<f64>], voxel_m: f64) -> Vec<Point3<f64>> {
    let voxel = |p: &Point3<f64>| [p.x, p.y, p.z].map(|v| (v / voxel_m).floor() as i64);
    let mut order: Vec<([i64; 3], u32)> = points.iter().enumerate().map(|(i, p)| (voxel(p), i as u32)).collect();
    order.par_sort_unstable();
    let mean = |voxel: &[([i64; 3], u32)]| {
        let sum: Vector3<f64> = voxel.iter().map(|(_, i)| points[*i as usize].coords).sum();
        Point3::from(sum / voxel.len() as f64)
    };
    order.chunk_by(|a, b| a.0 == b.0).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_voxel_keeps_the_mean_of_its_points() {
        let cloud = [[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [1.5, 0.0, 0.0], [-0.1, 0.0, 0.0]].map(Point3::from);
        let thin = thinned(&cloud, 1.0);
        assert_eq!(thin.len(), 3);
        assert!((thin[1] - Point3::new(0.2, 0.1, 0.1)).norm() < 1e-15, "{thin:?}");
    }
}
