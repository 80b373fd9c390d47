//! `bench poses`: the phone's and the aligned cameras against those of a board in view.

use std::path::PathBuf;

use clap::Args;
use mb_job::Result;
use mb_pipeline::{BoardStudyOptions, StudiedPoses, board_study};

use crate::commands::Seed;
use crate::commands::board::BoardArgument;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// The paper's study of camera poses: the phone's and the aligned ones against those of a board in view
///
/// Sequences that are not aligned yet are aligned from their clicked points; a sequence whose result lies in the output
/// folder is not done again.
#[derive(Debug, Args)]
pub struct Poses {
    /// Sequences that show the board, with model and clicked points
    #[arg(value_name = "SEQ", required = true)]
    sequences: Vec<PathBuf>,

    #[command(flatten)]
    board: BoardArgument,

    /// Folder for the results: poses.json, poses.md and a file for each sequence
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,

    #[command(flatten)]
    seed: Seed,
}

impl Poses {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        let options = BoardStudyOptions { seed: self.seed.seed, ..BoardStudyOptions::default() };
        let study = board_study(&self.sequences, &self.board.parse()?, &options, &self.output, terminal)?;
        let mut text = format!(
            "{} sequences, {} simulated; relative poses over all pairs, shares of the reconstruction within {} mm\n",
            study.sequences.len(),
            study.simulated,
            options.study.threshold_mm
        );
        let mut line = |label: &str, r: &StudiedPoses| {
            text += &format!(
                "{label:<16} {:7.3} mm {:7.3} deg  {:5.1} % {:5.1} %\n",
                r.pairwise_translation_rmse_mm,
                r.pairwise_rotation_mean_deg,
                r.accuracy * 100.0,
                r.recall * 100.0
            );
        };
        study.paper.iter().for_each(|r| line(&format!("paper: {}", r.poses), r));
        study.mean.iter().for_each(|r| line(&r.poses, r));
        text += &format!("wrote {}", self.output.join("poses.md").display());
        Outcome::new(&study, text)
    }
}
