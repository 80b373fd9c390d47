//! `bench leaderboard`: a static site of scores.

use std::path::PathBuf;

use clap::Args;
use mb_job::Result;
use mb_pipeline::{LeaderboardOptions, leaderboard};

use super::name_and_path;
use crate::commands::Seed;
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// A static site of scores: rankings, a page per sequence with renders, heat maps and curves, provenance
///
/// Scores come from the documents of `mobilebrick eval`, as for `bench table`. Meshes are drawn from where they were
/// scored; pictures of files that have not changed are kept from an earlier run.
#[derive(Debug, Args)]
pub struct Leaderboard {
    /// Documents of `mobilebrick eval`, or folders of them; NAME= names a method that the document does not name
    #[arg(value_name = "[NAME=]PATH", required = true)]
    results: Vec<String>,

    /// Folder for the site; open its index.html
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,

    /// Heading of the site
    #[arg(long, default_value_t = LeaderboardOptions::default().title)]
    title: String,

    /// Leave out the pictures of surfaces, which take seconds a prediction
    #[arg(long)]
    no_pictures: bool,

    #[command(flatten)]
    seed: Seed,
}

impl Leaderboard {
    /// Writes the site.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        let results: Vec<(Option<String>, PathBuf)> = self
            .results
            .iter()
            .map(|r| name_and_path(r))
            .map(|(name, path)| (name.map(str::to_owned), path.to_owned()))
            .collect();
        let options = LeaderboardOptions { title: self.title, pictures: !self.no_pictures, seed: self.seed.seed };
        let summary = leaderboard(&results, &self.out, &options, terminal)?;
        let sequences = match summary.sequences.len() {
            1 => "1 sequence".to_owned(),
            n => format!("{n} sequences"),
        };
        let text = format!("{sequences}, {} pictures drawn; open {}", summary.pictures_drawn, summary.index.display());
        Outcome::new(&summary, text)
    }
}
