//! What pose errors alone do to a reconstruction: exact depth fused once with true and once with perturbed cameras.

use mb_geometry::{Camera, Rigid3, World};
use mb_job::{Error, Progress, Result, Steps};
use mb_mesh::{Bvh, TriangleMesh, sample_uniform};
use mb_recon::TsdfVolume;
use nalgebra::Vector6;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::ExactScene;

/// Options of [`perturbed_pose_study`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseStudyOptions {
    /// Voxel of both reconstructions, millimetres.
    pub voxel_size_mm: f64,
    /// Truncation of both reconstructions, millimetres, from 1.5 to 64 voxels. It must exceed the pose errors, or
    /// surfaces from different frames do not average.
    pub truncation_mm: f64,
    /// Distance below which a point counts as right, millimetres.
    pub threshold_mm: f64,
    /// Samples on each surface.
    pub samples: usize,
    /// Seed of the samples.
    pub seed: u64,
}

impl Default for PoseStudyOptions {
    fn default() -> Self {
        Self { voxel_size_mm: 1.0, truncation_mm: 8.0, threshold_mm: 1.0, samples: 100_000, seed: 0 }
    }
}

/// How the reconstruction with perturbed cameras differs from the one with true cameras.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PoseStudy {
    /// Frames that were fused.
    pub frames: usize,
    /// Share of the perturbed reconstruction within the threshold of the true one.
    pub accuracy: f64,
    /// Share of the true reconstruction within the threshold of the perturbed one.
    pub recall: f64,
    /// Mean distance from the perturbed to the true reconstruction, millimetres.
    pub perturbed_to_true_mm: f64,
    /// Mean distance from the true to the perturbed reconstruction, millimetres.
    pub true_to_perturbed_mm: f64,
    /// Root mean square distance of the camera centres, after the common motion was taken out, millimetres.
    pub camera_rmse_mm: f64,
    /// Mean angle between the camera axes, after the common motion was taken out, degrees.
    pub camera_mean_deg: f64,
    /// The options as used.
    pub options: PoseStudyOptions,
}

/// Renders exact depth from the true cameras of `scene`, fuses it with those cameras and with `perturbed`
/// (`world_from_cam`, one for each frame of the scene), and compares the two meshes.
///
/// A motion that all perturbed cameras share is taken out first, as aligning the object would: only errors of frames
/// against each other remain.
///
/// # Errors
/// The number of poses is not that of the frames, an option is out of range, nothing could be reconstructed, or the
/// person asked for a stop.
pub fn perturbed_pose_study(
    scene: &ExactScene,
    perturbed: &[Rigid3<World, Camera>],
    options: &PoseStudyOptions,
    progress: &dyn Progress,
) -> Result<PoseStudy> {
    let truth: Vec<Rigid3<World, Camera>> = scene.frames.iter().map(|f| f.world_from_cam).collect();
    if truth.len() != perturbed.len() || options.samples == 0 || options.threshold_mm.is_nan() {
        return Err(Error::Failed(format!(
            "the study needs a pose for each of {} frames ({} given), and at least one sample ({} asked)",
            truth.len(),
            perturbed.len(),
            options.samples
        )));
    }
    let common = common_motion(&truth, perturbed);
    let perturbed: Vec<Rigid3<World, Camera>> = perturbed.iter().map(|pose| common * *pose).collect();

    let volume = || TsdfVolume::new(options.voxel_size_mm * 1e-3, options.truncation_mm * 1e-3);
    let (mut with_truth, mut with_perturbed) = (volume()?, volume()?);
    let steps = Steps::new(progress, "fuse exact depth", truth.len());
    for (i, frame) in scene.frames.iter().enumerate() {
        let depth = scene.render(frame).depth;
        with_truth.integrate(&depth, None, &frame.intrinsics, &truth[i].inverse())?;
        with_perturbed.integrate(&depth, None, &frame.intrinsics, &perturbed[i].inverse())?;
        steps.step()?;
    }
    let (with_truth, with_perturbed) = (with_truth.extract_mesh(1.0), with_perturbed.extract_mesh(1.0));
    if with_truth.triangles.is_empty() || with_perturbed.triangles.is_empty() {
        return Err(Error::Failed("no frame shows the model, so there is nothing to compare".to_owned()));
    }
    let (accuracy, perturbed_to_true_mm) = compare(&with_perturbed, &with_truth, options);
    let (recall, true_to_perturbed_mm) = compare(&with_truth, &with_perturbed, options);
    let count = truth.len() as f64;
    let errors = || truth.iter().zip(&perturbed);
    let squares: f64 = errors().map(|(t, p)| (t.translation() - p.translation()).norm_squared()).sum();
    let angles: f64 = errors().map(|(t, p)| (t.inverse() * *p).angle_rad()).sum();
    Ok(PoseStudy {
        frames: truth.len(),
        accuracy,
        recall,
        perturbed_to_true_mm,
        true_to_perturbed_mm,
        camera_rmse_mm: (squares / count).sqrt() * 1e3,
        camera_mean_deg: (angles / count).to_degrees(),
        options: options.clone(),
    })
}

/// The rigid motion of the world that brings the perturbed cameras nearest to the true ones: the mean of the frames'
/// corrections on SE(3), by Karcher's iteration.
pub fn common_motion(truth: &[Rigid3<World, Camera>], perturbed: &[Rigid3<World, Camera>]) -> Rigid3<World, World> {
    let mut mean = Rigid3::identity();
    // Corrections of a few degrees converge to rounding in three or four steps.
    for _ in 0..10 {
        let inverse = mean.inverse();
        let sum: Vector6<f64> = truth.iter().zip(perturbed).map(|(t, p)| (*t * p.inverse() * inverse).log()).sum();
        mean = Rigid3::exp(&(sum / truth.len().max(1) as f64)) * mean;
    }
    mean
}

/// Share of samples of `from` within the threshold of `to`, and their mean distance in millimetres.
fn compare(from: &TriangleMesh, to: &TriangleMesh, options: &PoseStudyOptions) -> (f64, f64) {
    let bvh = Bvh::new(to);
    let distances_mm: Vec<f64> = sample_uniform(from, options.samples, options.seed)
        .par_iter()
        .map(|s| bvh.closest(&s.point).map_or(f64::INFINITY, |c| c.distance * 1e3))
        .collect();
    let count = distances_mm.len() as f64;
    let right = distances_mm.iter().filter(|&&d| d < options.threshold_mm).count();
    (right as f64 / count, distances_mm.iter().sum::<f64>() / count)
}
