//! `reconstruct`: a sequence's surface, by one of the methods.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use mb_job::Result;
use mb_recon::{PoseSource, TsdfOptions, reconstruct_tsdf};

use super::SequenceArgument;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Reconstruct a sequence's surface with one of the methods
#[derive(Debug, Subcommand)]
pub enum Reconstruct {
    /// Fuse the phone's depth maps into a truncated signed distance (Curless and Levoy 1996)
    Tsdf(Tsdf),
}

impl Reconstruct {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Tsdf(c) => c.run(terminal),
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
