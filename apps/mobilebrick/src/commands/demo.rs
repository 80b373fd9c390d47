//! `demo`: the whole system on the built-in model.

use std::path::PathBuf;

use clap::Args;
use mb_job::Result;
use mb_pipeline::{DemoOptions, demo};

use super::Seed;
use super::parts::PartsArgument;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Everything below on a built-in model; ends with a report page
#[derive(Debug, Args)]
pub struct Demo {
    /// Folder to write
    #[arg(long, value_name = "DIR", default_value = "out/demo")]
    out: PathBuf,

    /// Another model than the built-in one
    #[arg(long, value_name = "MODEL")]
    model: Option<PathBuf>,

    #[command(flatten)]
    parts: PartsArgument,

    /// Photographs
    #[arg(long, value_name = "N", default_value_t = DemoOptions::default().frames)]
    frames: usize,

    #[command(flatten)]
    seed: Seed,
}

impl Demo {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        let model = match &self.model {
            Some(path) => mb_bricks::Model::read(path, self.parts.open()?.as_ref())?,
            None => mb_bricks::demo_model(),
        };
        let options = DemoOptions { frames: self.frames, seed: self.seed.seed, ..DemoOptions::default() };
        let summary = demo(&model, &options, &self.out, terminal)?;
        let mut text = format!("done in {:.0} s\n", summary.seconds);
        if let Some(object) = &summary.poses.object {
            text += &format!(
                "cameras in the object's frame: {:.2} mm rms, {:.3} deg mean\n",
                object.translation_rmse_mm, object.rotation_mean_deg
            );
        }
        for scores in &summary.scores {
            text += &format!("TSDF-Fusion, {}: Chamfer {:.2} mm", scores.protocol, scores.chamfer.chamfer_mm);
            for t in &scores.thresholds {
                text += &format!(", F1 at {} mm {:.1} %", t.threshold_mm, t.f1 * 100.0);
            }
            text.push('\n');
        }
        text += &format!("sequence {}\nreport   {}", summary.sequence.display(), summary.report.display());
        Outcome::new(&summary, text)
    }
}
