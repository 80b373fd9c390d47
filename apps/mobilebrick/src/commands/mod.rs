//! The subcommands, one file a stage. Each turns arguments into one call of a library and the result into an
//! [`Outcome`].

mod align;
mod bench;
mod board;
mod capture;
mod demo;
mod eval;
mod model;
mod parts;
mod reconstruct;
mod synthesize;
mod truth;

use std::path::PathBuf;

use clap::{Args, Subcommand};
use mb_capture::Sequence;
use mb_job::Result;

use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// The stages, in the order in which they are run.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Everything below on a built-in model; ends with a report page
    Demo(demo::Demo),
    /// Brick models: LDraw and Studio files, built-in bricks
    #[command(subcommand)]
    Model(model::Model),
    /// Sequences: photographs, depth and poses of a phone, or of one in software
    #[command(subcommand)]
    Capture(capture::Capture),
    /// Where the object and the cameras are
    #[command(subcommand)]
    Align(align::Align),
    /// Calibration boards: print one, or calibrate a camera with it
    #[command(subcommand)]
    Board(board::Board),
    /// Exact depth, masks, visible surface and visibility volume of an aligned sequence
    Truth(truth::Truth),
    /// Reconstruct a sequence's surface with one of the methods
    #[command(subcommand)]
    Reconstruct(reconstruct::Reconstruct),
    /// Render a sequence's held-out views with one of the methods
    #[command(subcommand)]
    Synthesize(synthesize::Synthesize),
    /// Score surfaces, views, depth maps and poses
    #[command(subcommand)]
    Eval(eval::Eval),
    /// Methods beside each other: tables, leaderboards, studies
    #[command(subcommand)]
    Bench(bench::Bench),
}

impl Command {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Demo(c) => c.run(terminal),
            Self::Model(c) => c.run(terminal),
            Self::Capture(c) => c.run(terminal),
            Self::Align(c) => c.run(terminal),
            Self::Board(c) => c.run(terminal),
            Self::Truth(c) => c.run(terminal),
            Self::Reconstruct(c) => c.run(terminal),
            Self::Synthesize(c) => c.run(terminal),
            Self::Eval(c) => c.run(terminal),
            Self::Bench(c) => c.run(terminal),
        }
    }
}

/// The sequence that a stage works on.
#[derive(Debug, Args)]
struct SequenceArgument {
    /// Sequence folder (pose/, intrinsic/, image/ ...)
    #[arg(value_name = "SEQ")]
    sequence: PathBuf,
}

impl SequenceArgument {
    /// Opens it, and logs what had to be mended.
    fn open(&self) -> Result<Sequence> {
        let sequence = Sequence::open(&self.sequence)?;
        for warning in sequence.warnings() {
            tracing::warn!("{warning}");
        }
        Ok(sequence)
    }
}

/// The seed of everything random.
#[derive(Debug, Clone, Copy, Args)]
struct Seed {
    /// Seed; the same seed gives the same bytes, whatever the thread count
    #[arg(long, value_name = "N", default_value_t = 0)]
    seed: u64,
}
