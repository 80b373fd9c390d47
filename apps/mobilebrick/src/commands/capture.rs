//! `capture`: sequences in, out, checked and simulated.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use mb_geometry::ImageSize;
use mb_job::Result;
use mb_pipeline::{ModelCapture, simulate_model};
use mb_simulate::{Quality, SimulateOptions};

use super::Seed;
use super::model::ModelArgument;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Sequences: photographs, depth and poses of a phone, or of one in software
#[derive(Debug, Subcommand)]
pub enum Capture {
    /// Film a model with a phone in software; the truth is kept beside what the phone says
    Simulate(Simulate),
}

impl Capture {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Simulate(c) => c.run(terminal),
        }
    }
}

/// Effort per photograph.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum QualityArgument {
    /// For demos and tests
    Draft,
    /// Soft shadows, reflections
    Standard,
    /// Everything traced finely
    Photo,
}

/// Film a model with a phone in software; the truth is kept beside what the phone says
#[derive(Debug, Args)]
pub struct Simulate {
    #[command(flatten)]
    model: ModelArgument,

    /// Sequence folder to write; a stopped run is taken up again
    #[arg(short, long, value_name = "SEQ")]
    out: PathBuf,

    /// Photographs
    #[arg(long, value_name = "N", default_value_t = SimulateOptions::default().frames)]
    frames: usize,

    /// Size of the photographs, sensor orientation
    #[arg(long, value_name = "WxH", default_value = "1920x1440", value_parser = parse_size)]
    size: ImageSize,

    /// Effort per photograph
    #[arg(long, value_enum, default_value = "standard")]
    quality: QualityArgument,

    /// Mean distance of the camera, millimetres; chosen to fit the model where absent
    #[arg(long, value_name = "MM")]
    radius: Option<f64>,

    /// Play of outer side walls, millimetres; real bricks have about 0.1
    #[arg(long, value_name = "MM", default_value_t = 0.0)]
    clearance: f64,

    #[command(flatten)]
    seed: Seed,
}

impl Simulate {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let capture = ModelCapture {
            clearance_mm: self.clearance,
            simulate: SimulateOptions {
                frames: self.frames,
                size: self.size,
                quality: match self.quality {
                    QualityArgument::Draft => Quality::Draft,
                    QualityArgument::Standard => Quality::Standard,
                    QualityArgument::Photo => Quality::Photo,
                },
                seed: self.seed.seed,
                radius_m: self.radius.map(|mm| mm * 1e-3),
                ..SimulateOptions::default()
            },
        };
        let summary = simulate_model(&self.model.read()?, &capture, &self.out, terminal)?;
        let text = format!(
            "wrote {}: {} photographs of {}, {:.0} mm away; reported poses off by {:.2} mm and {:.2} deg",
            self.out.display(),
            summary.frames,
            summary.image_size,
            summary.radius_m * 1e3,
            summary.pose_translation_rmse_mm,
            summary.pose_rotation_mean_deg
        );
        Outcome::new(&summary, text)
    }
}

fn parse_size(text: &str) -> Result<ImageSize, String> {
    let sides = text.split_once(['x', 'X']).and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let (width, height) = sides.ok_or("must look like 1920x1440")?;
    Ok(ImageSize::new(width, height))
}
