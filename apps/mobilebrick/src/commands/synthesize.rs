//! `synthesize`: the held-out views of a sequence, by one of the methods.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use mb_job::Result;

use super::SequenceArgument;
use super::reconstruct::FieldTraining;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Train on all but every 8th photograph, and render those
#[derive(Debug, Subcommand)]
pub enum Synthesize {
    /// A density field on a hash grid (Mildenhall et al. 2020; Mueller et al. 2022)
    Nerf(Views),
    /// A signed distance field on a hash grid (Wang et al. 2021)
    Neus(Views),
}

impl Synthesize {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Nerf(c) => c.run("nerf", terminal),
            Self::Neus(c) => c.run("neus", terminal),
        }
    }
}

/// Held-out views of a trained field
#[derive(Debug, Args)]
pub struct Views {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// Folder for the views, and for the photographs at the same size in reference/
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,

    #[command(flatten)]
    training: FieldTraining,
}

impl Views {
    fn run(&self, method: &str, terminal: &Terminal) -> Result<Outcome> {
        let options = self.training.options(method)?;
        let summary = mb_neural::synthesize(&self.sequence.open()?, &options, &self.out, terminal)?;
        let text = format!(
            "wrote {}: {} held-out views, PSNR {:.2} dB\nscore them with: mobilebrick eval views --gt {} --pred {}",
            self.out.display(),
            summary.images,
            summary.psnr_db,
            self.out.join("reference").display(),
            self.out.display()
        );
        Outcome::new(&summary, text)
    }
}
