//! `bench poses`: the phone's and the aligned cameras against those of a board in view.

use std::path::PathBuf;

use clap::Args;
use mb_geometry::ImageSize;
use mb_job::Result;
use mb_pipeline::{BoardSequences, BoardStudyOptions, StudiedPoses, board_study, simulate_board_sequences};

use crate::commands::Seed;
use crate::commands::board::BoardArgument;
use crate::commands::capture::parse_size;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// The paper's study of camera poses: the phone's and the aligned ones against those of a board in view
///
/// Sequences that are not aligned yet are aligned from their clicked points; a sequence whose result lies in the output
/// folder is not done again.
#[derive(Debug, Args)]
pub struct Poses {
    /// Sequences that show the board, with model and clicked points
    #[arg(value_name = "SEQ", required_unless_present = "simulate")]
    sequences: Vec<PathBuf>,

    /// Sequences to simulate besides: random models standing on the printed board
    #[arg(long, value_name = "N")]
    simulate: Option<usize>,

    /// Photographs of each simulated sequence
    #[arg(long, value_name = "N", default_value_t = 24)]
    frames: usize,

    /// Size of the simulated photographs
    #[arg(long, value_name = "WxH", default_value = "960x720", value_parser = parse_size)]
    size: ImageSize,

    #[command(flatten)]
    board: BoardArgument,

    /// Folder for the results: poses.json, poses.md, a file for each sequence, and sequences/ with the simulated ones
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,

    #[command(flatten)]
    seed: Seed,
}

impl Poses {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        let options = BoardStudyOptions { seed: self.seed.seed, ..BoardStudyOptions::default() };
        let board = self.board.parse()?;
        let mut sequences = self.sequences;
        if let Some(count) = self.simulate {
            let plan = BoardSequences { count, frames: self.frames, size: self.size, seed: self.seed.seed };
            sequences.extend(simulate_board_sequences(&board, &plan, &self.output.join("sequences"), terminal)?);
        }
        let study = board_study(&sequences, &board, &options, &self.output, terminal)?;
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
