//! `truth`: exact ground truth of an aligned sequence.

use clap::Args;
use mb_job::Result;

use super::SequenceArgument;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Exact depth, masks, visible surface and visibility volume of an aligned sequence
#[derive(Debug, Args)]
pub struct Truth {
    #[command(flatten)]
    sequence: SequenceArgument,
}

impl Truth {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        let sequence = self.sequence.open()?;
        let summary = mb_truth::truth(&sequence, &Default::default(), terminal)?;
        let text = format!("wrote the ground truth of {}", sequence.root().display());
        Outcome::new(&summary, text)
    }
}
