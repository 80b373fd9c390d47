//! Protocol `mobilebrick-2023`: the published script `evaluate_3d.py`, as it behaves with Open3D 0.19.

use std::path::Path;

use mb_capture::VisibilityVolume;
use mb_job::{InputError, Progress, Result, Steps};
use mb_mesh::{KdTree, TriangleMesh, sample_poisson_disk};
use nalgebra::{Point3, Vector3};
use rand::RngExt;
use rayon::prelude::*;

use super::curve::Curve;
use super::icp::{self, Registration};
use super::score::Distances;
use super::{Icp, SurfaceOptions, SurfaceProtocol, SurfaceScores, SurfaceTruth, nothing_visible};

pub(super) fn score(
    truth: &SurfaceTruth,
    prediction: TriangleMesh,
    name: &Path,
    options: &SurfaceOptions,
    progress: &dyn Progress,
) -> Result<SurfaceScores> {
    let steps = Steps::new(progress, "scoring the surface", 4);
    // Choosing points is work for one thread: the two surfaces get theirs side by side.
    let (gt_points, pred) = rayon::join(
        || sample_poisson_disk(&truth.mesh, options.points, options.truth_seed()),
        || PredictionPoints::of(prediction, truth, name, options, &steps),
    );
    if gt_points.is_empty() {
        return Err(InputError::new(&truth.mesh_path, "the ground truth has no surface").into());
    }
    let PredictionPoints { icp, points: pred_points, warnings } = pred?;
    steps.step()?;

    let distances = Distances {
        pred_to_gt_m: nearest_m(&pred_points, &gt_points),
        gt_to_pred_m: nearest_m(&gt_points, &pred_points),
    };
    steps.step()?;
    Ok(SurfaceScores {
        protocol: SurfaceProtocol::MobileBrick2023,
        sequence: truth.sequence.clone(),
        icp,
        chamfer: distances.chamfer(),
        thresholds: distances.thresholds(&options.thresholds_mm()),
        curve: Curve::of(&distances),
        exact: None,
        dtu: None,
        points: [gt_points.len(), pred_points.len()],
        seed: options.seed,
        ground_truth: truth.relative_mesh_path(),
        provenance: None,
        warnings,
        seconds: 0.0,
    })
}

/// Points of a prediction in its place, and how they came about.
struct PredictionPoints {
    icp: Icp,
    points: Vec<Point3<f64>>,
    warnings: Vec<String>,
}

impl PredictionPoints {
    fn of(
        prediction: TriangleMesh,
        truth: &SurfaceTruth,
        name: &Path,
        options: &SurfaceOptions,
        steps: &Steps,
    ) -> Result<Self> {
        let registration = icp::register(&truth.mesh.vertices, &prediction.vertices);
        let applied = registration.fitness > icp::APPLY_ABOVE;
        let prediction =
            if applied { prediction.transformed(&registration.pred_from_gt.inverse()) } else { prediction };
        let icp = describe(&registration, applied, truth);
        steps.step()?;

        let had_triangles = !prediction.triangles.is_empty();
        let cropped = crop(prediction, &truth.visibility);
        if cropped.vertices.is_empty() {
            return Err(nothing_visible(name).into());
        }
        steps.step()?;

        let mut warnings = Vec::new();
        let points = if cropped.triangles.is_empty() {
            if had_triangles {
                warnings.push("no triangle lies wholly inside the visible volume; its vertices are scored".to_owned());
            } else {
                warnings.push("the prediction is a point cloud; its points are scored".to_owned());
            }
            shuffled(cropped.vertices, options.points, options.prediction_seed())
        } else {
            sample_poisson_disk(&cropped, options.points, options.prediction_seed())
        };
        if points.is_empty() {
            return Err(InputError::new(name, "the triangles inside the visible volume have no area").into());
        }
        Ok(Self { icp, points, warnings })
    }
}

/// What the alignment found, in numbers for people.
fn describe(registration: &Registration, applied: bool, truth: &SurfaceTruth) -> Icp {
    let middle = truth.mesh.bounds().center();
    let moved = registration.pred_from_gt * middle;
    Icp {
        fitness: registration.fitness,
        applied,
        rotation_deg: registration.pred_from_gt.angle_rad().to_degrees(),
        translation_mm: 1000.0 * (moved - middle).norm(),
    }
}

/// Removes vertices outside the visible volume and every triangle that loses one.
fn crop(mesh: TriangleMesh, volume: &VisibilityVolume) -> TriangleMesh {
    let kept: Vec<bool> = mesh.vertices.par_iter().map(|v| is_kept(volume, v)).collect();
    let mut new_index = Vec::with_capacity(kept.len());
    let mut count = 0u32;
    for &kept in &kept {
        new_index.push(count);
        count += u32::from(kept);
    }
    let triangles = mesh
        .triangles
        .into_iter()
        .filter(|t| t.iter().all(|&v| kept[v as usize]))
        .map(|t| t.map(|v| new_index[v as usize]))
        .collect();
    let vertices = mesh.vertices.into_iter().zip(kept).filter(|(_, kept)| *kept).map(|(v, _)| v).collect();
    TriangleMesh::new(vertices, triangles)
}

/// PyTorch's `grid_sample(mode="nearest", padding_mode="zeros", align_corners=True)` of the mask, in single precision
/// as the script calls it.
fn is_kept(volume: &VisibilityVolume, p: &Point3<f64>) -> bool {
    let voxel: Vector3<f64> = (p - volume.min_pt_in_world) / volume.voxel_size_m;
    let nearest = std::array::from_fn(|axis| {
        let last = volume.resolutions[axis] as f64 - 1.0;
        let normalised = (voxel[axis] / last * 2.0 - 1.0) as f32;
        f64::from(((normalised + 1.0) / 2.0 * last as f32).round_ties_even())
    });
    volume.is_visible(nearest)
}

/// Up to `count` of the points in random order.
pub(super) fn shuffled(mut points: Vec<Point3<f64>>, count: usize, seed: u64) -> Vec<Point3<f64>> {
    let mut rng = mb_job::rng(seed, 0);
    let count = count.min(points.len());
    for i in 0..count {
        let j = rng.random_range(i..points.len());
        points.swap(i, j);
    }
    points.truncate(count);
    points
}

/// The distance of each query from the nearest of the points.
pub(super) fn nearest_m(queries: &[Point3<f64>], points: &[Point3<f64>]) -> Vec<f64> {
    let tree = KdTree::new(points);
    let distance = |p| tree.nearest(p).map_or(f64::INFINITY, |(_, d)| d);
    queries.par_iter().with_min_len(256).map(distance).collect()
}
