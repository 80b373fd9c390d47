//! `reconstruct`: a sequence's surface, by one of the methods.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use mb_job::{Error, Result};
use mb_neural::FieldOptions;
use mb_recon::{PoseSource, TsdfOptions, reconstruct_tsdf};

use super::{Seed, SequenceArgument};
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Reconstruct a sequence's surface with one of the methods
#[derive(Debug, Subcommand)]
pub enum Reconstruct {
    /// Fuse the phone's depth maps into a truncated signed distance (Curless and Levoy 1996)
    Tsdf(Tsdf),
    /// A density field on a hash grid, trained on the photographs (Mildenhall et al. 2020; Mueller et al. 2022)
    Nerf(Field),
    /// A signed distance field on a hash grid, trained on the photographs (Wang et al. 2021)
    Neus(Field),
}

impl Reconstruct {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Tsdf(c) => c.run(terminal),
            Self::Nerf(c) => c.run("nerf", terminal),
            Self::Neus(c) => c.run("neus", terminal),
        }
    }
}

/// Which poses a method believes.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Poses {
    /// Those of the alignment, where there is one
    Aligned,
    /// Those of pose/, as the phone gave them
    Phone,
}

/// Fuse the phone's depth maps into a truncated signed distance (Curless and Levoy 1996)
#[derive(Debug, Args)]
pub struct Tsdf {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// Mesh to write: .ply, .obj, .glb or .stl; metres, the sequence's world frame
    #[arg(short, long, value_name = "MESH")]
    out: PathBuf,

    /// Edge of a voxel, millimetres
    #[arg(long, value_name = "MM", default_value_t = TsdfOptions::default().voxel_size_mm)]
    voxel: f64,

    /// Largest signed distance, millimetres
    #[arg(long, value_name = "MM", default_value_t = TsdfOptions::default().truncation_mm)]
    truncation: f64,

    /// Depth further than this is ignored, metres
    #[arg(long, value_name = "M", default_value_t = TsdfOptions::default().max_depth_m)]
    max_depth: f64,

    /// Lowest confidence that counts: 0, 1 or 2
    #[arg(long, value_name = "C", default_value_t = TsdfOptions::default().min_confidence)]
    confidence: u8,

    /// Leave out depth outside the object's mask, which `truth` writes
    #[arg(long)]
    masks: bool,

    /// Which poses to believe
    #[arg(long, value_enum, default_value = "aligned")]
    poses: Poses,
}

impl Tsdf {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let options = TsdfOptions {
            voxel_size_mm: self.voxel,
            truncation_mm: self.truncation,
            max_depth_m: self.max_depth,
            min_confidence: self.confidence,
            use_masks: self.masks,
            poses: match self.poses {
                Poses::Aligned => PoseSource::Aligned,
                Poses::Phone => PoseSource::Phone,
            },
            ..TsdfOptions::default()
        };
        let (mesh, summary) = reconstruct_tsdf(&self.sequence.open()?, &options, terminal)?;
        mb_mesh::write_mesh(&self.out, &mesh)?;
        let text = format!(
            "wrote {}: {} triangles from {} frames in {:.1} s",
            self.out.display(),
            summary.triangles,
            summary.frames,
            summary.seconds
        );
        Outcome::new(&summary, text)
    }
}

/// What all trained fields share.
#[derive(Debug, Args)]
pub struct FieldTraining {
    /// Steps of training; schedules follow. The default is the preset's
    #[arg(long, value_name = "N")]
    iterations: Option<u64>,

    /// Longer side to which photographs are reduced
    #[arg(long, value_name = "PX")]
    max_side: Option<usize>,

    /// File to keep the state of training in; a run that finds one goes on from it
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,

    #[command(flatten)]
    seed: Seed,
}

impl FieldTraining {
    /// The options of `method` (`nerf`, `neus`).
    pub fn options(&self, method: &str) -> Result<FieldOptions> {
        let mut options = FieldOptions::preset(method, "fast", self.seed.seed)
            .ok_or_else(|| Error::Failed(format!("there is no method {method} with a preset `fast`")))?;
        if let Some(iterations) = self.iterations {
            options = options.with_iterations(iterations);
        }
        if let Some(max_side_px) = self.max_side {
            options.data.max_side_px = max_side_px;
        }
        options.run.checkpoint.clone_from(&self.checkpoint);
        Ok(options)
    }
}

/// A field, trained on every photograph of the sequence
#[derive(Debug, Args)]
pub struct Field {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// Mesh to write: .ply, .obj, .glb or .stl; metres, the sequence's world frame
    #[arg(short, long, value_name = "MESH")]
    out: PathBuf,

    #[command(flatten)]
    training: FieldTraining,
}

impl Field {
    fn run(&self, method: &str, terminal: &Terminal) -> Result<Outcome> {
        let options = self.training.options(method)?;
        let (mesh, summary) = mb_neural::reconstruct(&self.sequence.open()?, &options, terminal)?;
        mb_mesh::write_mesh(&self.out, &mesh)?;
        let text = format!(
            "wrote {}: {} triangles from {} photographs",
            self.out.display(),
            summary.triangles,
            summary.images
        );
        Outcome::new(&summary, text)
    }
}
