//! `bench perturbed-poses`: what the phone's pose errors alone do to a reconstruction.

use std::path::{Path, PathBuf};

use clap::Args;
use mb_bricks::{Model, RandomOptions, random_models};
use mb_job::Result;
use mb_pipeline::{PerturbedPosesOptions, perturbed_poses};
use mb_simulate::DriftOptions;

use crate::commands::Seed;
use crate::commands::parts::PartsArgument;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// The paper's study of perturbed poses: exact depth fused with true and with perturbed cameras
///
/// Over the built-in model, random models, and the models given: how much of each reconstruction lies within 1 mm of the
/// other, beside the figures that the paper prints.
#[derive(Debug, Args)]
pub struct PerturbedPoses {
    /// More models: LDraw (.ldr, .mpd, .dat) or Studio files (.io)
    #[arg(value_name = "MODEL")]
    models: Vec<PathBuf>,

    #[command(flatten)]
    parts: PartsArgument,

    /// Random models beside the built-in one
    #[arg(long, value_name = "N", default_value_t = 5)]
    random: usize,

    /// Depth maps of each model
    #[arg(long, value_name = "N", default_value_t = PerturbedPosesOptions::default().frames)]
    frames: usize,

    /// Expected error of relative translations, millimetres
    #[arg(long, value_name = "MM", default_value_t = DriftOptions::default().translation_rmse_mm)]
    translation: f64,

    /// Expected error of relative rotations, degrees
    #[arg(long, value_name = "DEG", default_value_t = DriftOptions::default().rotation_mean_deg)]
    rotation: f64,

    #[command(flatten)]
    seed: Seed,
}

impl PerturbedPoses {
    /// Runs the study.
    pub fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let mut models = vec![("demo".to_owned(), mb_bricks::demo_model())];
        let random = RandomOptions { seed: self.seed.seed, ..RandomOptions::default() };
        for model in random_models(&random, self.random, terminal)? {
            models.push((format!("random_{:03}", model.summary.index), model.model));
        }
        let library = self.parts.open()?;
        for path in &self.models {
            let name = path.file_stem().unwrap_or(Path::new("model").as_os_str()).to_string_lossy().into_owned();
            models.push((name, Model::read(path, library.as_ref())?));
        }
        let options = PerturbedPosesOptions {
            frames: self.frames,
            seed: self.seed.seed,
            drift: DriftOptions {
                translation_rmse_mm: self.translation,
                rotation_mean_deg: self.rotation,
                ..DriftOptions::default()
            },
            ..PerturbedPosesOptions::default()
        };
        let summary = perturbed_poses(&models, &options, terminal)?;
        let mut text = format!("{:<24}{:>10}{:>10}{:>22}\n", "model", "accuracy", "recall", "cameras off by");
        for m in &summary.models {
            text += &format!(
                "{:<24}{:>8.1} %{:>8.1} %{:>10.2} mm{:>8.3} deg\n",
                m.model,
                100.0 * m.study.accuracy,
                100.0 * m.study.recall,
                m.study.camera_rmse_mm,
                m.study.camera_mean_deg
            );
        }
        for (name, accuracy, recall) in [
            ("mean", summary.accuracy, summary.recall),
            ("the paper's models", summary.paper_accuracy, summary.paper_recall),
        ] {
            text += &format!("{name:<24}{:>8.1} %{:>8.1} %\n", 100.0 * accuracy, 100.0 * recall);
        }
        Outcome::new(&summary, text)
    }
}
