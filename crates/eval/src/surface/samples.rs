//! The points of a surface that are judged, and what they are compared with.

use mb_job::{InputError, Result};
use mb_mesh::{Closest, SurfaceSample, TriangleMesh, sample_uniform};
use nalgebra::Point3;

use super::breakdown::Judged;
use super::clip::{Clipped, Clipper};
use super::distance::{Target, distance_m};
use super::{SurfaceOptions, SurfaceTruth};

/// A point to judge.
#[derive(Clone, Copy)]
pub(super) struct Sample {
    pub point: Point3<f64>,
    /// Its triangle in the uncut mesh; `None` in a cloud.
    pub triangle: Option<u32>,
}

/// Uniform points of a cut mesh; `points` says how many from its area in square metres.
fn samples_of(clipped: &Clipped, points: impl FnOnce(f64) -> usize, seed: u64) -> Vec<Sample> {
    let points = points(clipped.mesh.area());
    let sample = |s: SurfaceSample| Sample { point: s.point, triangle: Some(clipped.source[s.triangle as usize]) };
    sample_uniform(&clipped.mesh, points, seed).into_iter().map(sample).collect()
}

/// Uniform points of the ground truth inside the visible volume; `points` says how many from the area there.
pub(super) fn truth_samples(
    truth: &SurfaceTruth,
    clipper: &Clipper,
    points: impl FnOnce(f64) -> usize,
    options: &SurfaceOptions,
) -> Result<Vec<Sample>> {
    let samples = samples_of(&clipper.clip(&truth.mesh), points, options.truth_seed());
    if samples.is_empty() {
        let help = "mesh/ and visibility_mask.npy do not belong together; make both with `mobilebrick truth`";
        let found = "no part of the ground truth lies inside the visible volume";
        return Err(InputError::new(&truth.mesh_path, found).help(help).into());
    }
    Ok(samples)
}

/// Random points of the prediction inside the visible volume; `points` says how many from the area there (of a cloud up to
/// `options.points`). `None` where there is none.
pub(super) fn judged_samples(
    prediction: &TriangleMesh,
    clipper: &Clipper,
    points: impl FnOnce(f64) -> usize,
    options: &SurfaceOptions,
) -> Option<Vec<Sample>> {
    let seed = options.prediction_seed();
    let found = if prediction.triangles.is_empty() {
        let visible: Vec<Point3<f64>> = prediction.vertices.iter().filter(|v| clipper.contains(v)).copied().collect();
        let chosen = super::published::shuffled(visible, options.points, seed);
        chosen.into_iter().map(|point| Sample { point, triangle: None }).collect()
    } else {
        samples_of(&clipper.clip(prediction), points, seed)
    };
    (!found.is_empty()).then_some(found)
}

/// The closest point of the other surface to each sample.
pub(super) fn compared(samples: &[Sample], other: &Target) -> Vec<Judged> {
    let points: Vec<Point3<f64>> = samples.iter().map(|s| s.point).collect();
    let is_cloud = matches!(other, Target::Points { .. });
    let judged = |(sample, closest): (&Sample, Option<Closest>)| Judged {
        point: sample.point,
        triangle: sample.triangle,
        partner: closest.map_or(sample.point, |c| c.point),
        partner_triangle: closest.filter(|_| !is_cloud).map(|c| c.triangle),
        distance_m: distance_m(closest.as_ref()),
    };
    samples.iter().zip(other.closest(&points, f64::INFINITY)).map(judged).collect()
}

/// Positions and triangles alone: colours need no second copy.
pub(super) fn bare(mesh: &TriangleMesh) -> TriangleMesh {
    TriangleMesh::new(mesh.vertices.clone(), mesh.triangles.clone())
}
