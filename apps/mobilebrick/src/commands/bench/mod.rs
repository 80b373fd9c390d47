//! `bench`: methods beside each other, one file a subcommand.

mod leaderboard;
mod perturbed_poses;
mod poses;
mod table;

use std::path::Path;

use clap::Subcommand;
use mb_job::Result;

use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Methods beside each other: tables, leaderboards, studies
#[derive(Debug, Subcommand)]
pub enum Bench {
    /// The paper's tables with your rows beside the published ones
    Table(table::Table),
    /// A static site of scores: rankings, a page per sequence with renders, heat maps and curves, provenance
    Leaderboard(leaderboard::Leaderboard),
    /// The paper's study of camera poses: the phone's and the aligned ones against those of a board in view
    Poses(poses::Poses),
    /// The paper's study of perturbed poses: exact depth fused with true and with perturbed cameras
    PerturbedPoses(perturbed_poses::PerturbedPoses),
}

impl Bench {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Table(c) => c.run(),
            Self::Leaderboard(c) => c.run(terminal),
            Self::Poses(c) => c.run(terminal),
            Self::PerturbedPoses(c) => c.run(terminal),
        }
    }
}

/// `NAME=PATH`, unless a file is called that.
fn name_and_path(argument: &str) -> (Option<&str>, &Path) {
    match argument.split_once('=') {
        Some((name, path)) if !name.is_empty() && !Path::new(argument).exists() => (Some(name), Path::new(path)),
        _ => (None, Path::new(argument)),
    }
}
