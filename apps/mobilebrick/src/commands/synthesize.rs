//! `synthesize`: new views of a sequence, by one of the methods.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use mb_job::Result;
use mb_neural::camera_path::CameraPath;
use mb_neural::results::write_beside;

use super::SequenceArgument;
use super::reconstruct::FieldTraining;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Train on all but every 8th photograph, and render those
#[derive(Debug, Subcommand)]
pub enum Synthesize {
    /// A density field on a hash grid (Mildenhall et al. 2020; Mueller et al. 2022)
    Nerf(Views),
    /// A density field on voxels (Sun et al. 2022)
    Dvgo(Views),
    /// A signed distance field on a hash grid (Wang et al. 2021)
    Neus(Views),
}

impl Synthesize {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Nerf(c) => c.run("nerf", terminal),
            Self::Dvgo(c) => c.run("dvgo", terminal),
            Self::Neus(c) => c.run("neus", terminal),
        }
    }
}

/// Views of a trained field
#[derive(Debug, Args)]
pub struct Views {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// Folder for the views, and for the photographs at the same size in reference/; run.json holds options and figures,
    /// run.curve.csv the loss curve
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,

    /// Render this many views around the object instead of the held-out ones
    #[arg(long, value_name = "N", conflicts_with = "path")]
    orbit: Option<usize>,

    /// Render the cameras of this folder instead (pose/NNNNNN.txt, and intrinsic/ where it has one)
    #[arg(long, value_name = "DIR")]
    path: Option<PathBuf>,

    /// Also write the views as a film (.mp4), with the command ffmpeg
    #[arg(long, value_name = "FILE")]
    film: Option<PathBuf>,

    /// Pictures of the film in a second
    #[arg(long, value_name = "N", default_value_t = 30.0)]
    fps: f64,

    #[command(flatten)]
    training: FieldTraining,
}

impl Views {
    fn run(&self, method: &str, terminal: &Terminal) -> Result<Outcome> {
        let run = self.out.join("run");
        let options = self.training.options(method, &run)?;
        let views = mb_neural::Views {
            path: match (self.orbit, &self.path) {
                (Some(n), _) => CameraPath::Orbit(n),
                (None, Some(folder)) => CameraPath::Folder(folder.clone()),
                (None, None) => CameraPath::HeldOut,
            },
            out: self.out.clone(),
            film: self.film.clone(),
            frames_per_second: self.fps,
        };
        let device = self.training.device(&options)?;
        let summary = mb_neural::synthesize(&self.sequence.open()?, &options, device.as_ref(), &views, terminal)?;
        write_beside(&run, &summary, &summary.training.curve)?;
        self.training.finish(&run);
        let mut text = format!("wrote {}: {} views", self.out.display(), summary.images);
        if let Some(psnr) = summary.psnr_db {
            text += &format!(
                ", held out, PSNR {psnr:.2} dB\nscore them with: mobilebrick eval views --gt {} --pred {}",
                self.out.join("reference").display(),
                self.out.display()
            );
        }
        Outcome::new(&summary, text)
    }
}
