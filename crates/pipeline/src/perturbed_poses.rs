//! The paper's study of perturbed poses: exact depth of brick models, fused with the true cameras and with cameras that
//! stray as a phone's do.

use mb_bricks::{MeshOptions, Model};
use mb_capture::{Frame, FrameId};
use mb_geometry::ImageSize;
use mb_job::{Error, Progress, Result};
use mb_simulate::{DriftOptions, SimulateOptions, Walk};
use mb_truth::{ExactScene, PoseStudy, PoseStudyOptions, perturbed_pose_study};
use serde::{Deserialize, Serialize};

/// How the study is done.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PerturbedPosesOptions {
    /// Depth maps of each model.
    pub frames: usize,
    /// Their size.
    pub size: ImageSize,
    /// How the perturbed cameras stray.
    pub drift: DriftOptions,
    /// The two reconstructions and their comparison.
    pub study: PoseStudyOptions,
    /// Seed of walks, perturbations and samples; each model has its own stream.
    pub seed: u64,
}

impl Default for PerturbedPosesOptions {
    /// The phone's own poses, a frame every few degrees, the phone's size of photographs halved.
    fn default() -> Self {
        Self {
            frames: 60,
            size: ImageSize::new(960, 720),
            drift: DriftOptions::default(),
            study: PoseStudyOptions::default(),
            seed: 0,
        }
    }
}

/// The study of one model.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PerturbedModel {
    /// Its name.
    pub model: String,
    /// Mean distance of the cameras from its middle, metres.
    pub radius_m: f64,
    /// What the perturbed cameras do to it.
    #[serde(flatten)]
    pub study: PoseStudy,
}

/// The study of all models.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PerturbedPoses {
    /// Model by model.
    pub models: Vec<PerturbedModel>,
    /// Mean over the models of the share of the perturbed reconstruction within the threshold of the true one.
    pub accuracy: f64,
    /// Mean over the models of the share of the true reconstruction within the threshold of the perturbed one.
    pub recall: f64,
    /// What the paper prints for accuracy, at 1 mm.
    pub paper_accuracy: f64,
    /// What the paper prints for recall, at 1 mm.
    pub paper_recall: f64,
    /// The options as used.
    pub options: PerturbedPosesOptions,
}

/// Renders exact depth of each model from a hand-held walk round it, and fuses it with the true and with the perturbed
/// cameras.
///
/// # Errors
/// No model is given, a model lacks parts or is empty, an option is out of range, or the person asked for a stop.
pub fn perturbed_poses(
    models: &[(String, Model)],
    options: &PerturbedPosesOptions,
    progress: &dyn Progress,
) -> Result<PerturbedPoses> {
    if models.is_empty() {
        return Err(Error::Failed("no model to study".to_owned()));
    }
    let studies = models
        .iter()
        .zip(options.seed..)
        .map(|((name, model), seed)| study(name, model, seed, options, progress))
        .collect::<Result<Vec<_>>>()?;
    let mean =
        |value: fn(&PoseStudy) -> f64| studies.iter().map(|m| value(&m.study)).sum::<f64>() / studies.len() as f64;
    Ok(PerturbedPoses {
        accuracy: mean(|s| s.accuracy),
        recall: mean(|s| s.recall),
        paper_accuracy: 0.859,
        paper_recall: 0.840,
        models: studies,
        options: options.clone(),
    })
}

fn study(
    name: &str,
    model: &Model,
    seed: u64,
    options: &PerturbedPosesOptions,
    progress: &dyn Progress,
) -> Result<PerturbedModel> {
    model.require_complete()?;
    let mesh = model.mesh(&MeshOptions::default());
    if mesh.triangles.is_empty() {
        return Err(Error::Failed(format!("the model {name} has no triangles")));
    }
    let walk_options = SimulateOptions {
        frames: options.frames,
        size: options.size,
        seed,
        drift: options.drift,
        ..SimulateOptions::default()
    };
    let walk = Walk::new(&mesh.bounds(), &walk_options)?;
    let frames = (0..options.frames)
        .map(|i| Frame {
            id: FrameId(i as u32),
            intrinsics: walk.intrinsics[i],
            world_from_cam: walk.true_world_from_cam[i],
            image: None,
            arkit_depth: None,
        })
        .collect();
    let middle = walk.world_from_object * mesh.bounds().center();
    let distances: f64 = walk.true_world_from_cam.iter().map(|c| (c.translation() - middle.coords).norm()).sum();
    let scene = ExactScene::new(mesh.transformed(&walk.world_from_object), frames, options.size);
    let study = perturbed_pose_study(&scene, &walk.reported_world_from_cam, &options.study, progress)?;
    Ok(PerturbedModel { model: name.to_owned(), radius_m: distances / options.frames as f64, study })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]
mod tests {
    use super::*;
    use mb_job::Silent;

    #[test]
    fn larger_pose_errors_cost_more_and_none_cost_nothing() {
        let models = [("demo".to_owned(), mb_bricks::demo_model())];
        let study = |size: f64| {
            let drift = DriftOptions {
                translation_rmse_mm: 4.454 * size,
                rotation_mean_deg: 0.581 * size,
                ..DriftOptions::default()
            };
            let options = PerturbedPosesOptions {
                frames: 12,
                size: ImageSize::new(240, 180),
                drift,
                study: PoseStudyOptions { voxel_size_mm: 3.0, samples: 4000, ..PoseStudyOptions::default() },
                ..PerturbedPosesOptions::default()
            };
            perturbed_poses(&models, &options, &Silent).unwrap()
        };
        let (none, some, twice) = (study(0.0), study(1.0), study(2.0));
        assert!(none.accuracy > 0.9999 && none.recall > 0.9999, "{none:?}");
        assert!(some.accuracy < none.accuracy && twice.accuracy < some.accuracy, "{some:?} {twice:?}");
        assert!(perturbed_poses(&[], &PerturbedPosesOptions::default(), &Silent).is_err());
    }
}
