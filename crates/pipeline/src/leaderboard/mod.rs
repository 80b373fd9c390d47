//! A static site of scores: a page with the rankings, a page per sequence with pictures, curves and breakdowns, and the
//! documents themselves. No page reaches for the network; a folder on any web server, or on a disk, will do.

mod board;
mod gallery;
mod index;
mod sequence_page;
mod shell;

use std::path::{Path, PathBuf};

use mb_eval::SurfaceProtocol;
use mb_job::{Error, InputError, Progress, Result, Steps, write_atomic};
use serde::{Deserialize, Serialize};

use self::board::{Board, file_name, page_of};
use self::gallery::Gallery;

/// Options of [`leaderboard`].
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LeaderboardOptions {
    /// Heading of the site.
    pub title: String,
    /// Whether surfaces are drawn, which takes seconds a prediction.
    pub pictures: bool,
    /// Seed of the bootstrap that compares methods.
    pub seed: u64,
}

impl Default for LeaderboardOptions {
    fn default() -> Self {
        Self { title: "MobileBrick leaderboard".to_owned(), pictures: true, seed: 0 }
    }
}

/// What [`leaderboard`] wrote.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LeaderboardSummary {
    /// The page to open.
    pub index: PathBuf,
    /// Methods with surface scores, best first, by protocol.
    pub ranking: Vec<Ranking>,
    /// Sequences with a page.
    pub sequences: Vec<String>,
    /// Pictures drawn in this run; those of unchanged files stay.
    pub pictures_drawn: usize,
    /// What a reader should know.
    pub warnings: Vec<String>,
}

/// The order of methods by one protocol.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Ranking {
    /// The protocol.
    pub protocol: SurfaceProtocol,
    /// Methods, best mean F1 at 2.5 mm first.
    pub methods: Vec<String>,
}

/// Writes the site into `out`. `results` are documents of `mobilebrick eval` or folders of them, each with the name of its
/// method where the document has none. Pictures of files that have not changed since an earlier run are kept.
///
/// # Errors
/// A document is missing or malformed, or a method has two scores for one sequence; a file cannot be written; the person
/// asked for a stop.
pub fn leaderboard(
    results: &[(Option<String>, PathBuf)],
    out: &Path,
    options: &LeaderboardOptions,
    progress: &dyn Progress,
) -> Result<LeaderboardSummary> {
    let board = Board::read(results, options.seed)?;
    if board.documents.is_empty() {
        let path = results.first().map(|(_, path)| path.clone()).unwrap_or_default();
        return Err(InputError::new(path, "there is not one score in the documents").into());
    }
    write_atomic(out.join("style.css"), shell::stylesheet().as_bytes())?;
    write_atomic(out.join("sort.js"), include_bytes!("sort.js"))?;
    let mut downloads = Vec::new();
    for (at, (method, path)) in board.documents.iter().enumerate() {
        let bytes = std::fs::read(path).map_err(|e| Error::from(InputError::unreadable(path, &e)))?;
        let name = format!("data/{:02}-{}.json", at + 1, file_name(method));
        write_atomic(out.join(&name), &bytes)?;
        downloads.push(name);
    }
    let sequences = board.sequences();
    let steps = Steps::new(progress, "pages of sequences", sequences.len());
    let mut warnings = Vec::new();
    let mut pictures_drawn = 0;
    let mut thumbnails = Vec::new();
    for (at, sequence) in sequences.iter().enumerate() {
        let gallery = match (options.pictures, board.surfaces.first()) {
            (true, Some(surfaces)) => gallery::draw(surfaces, sequence, out)?,
            _ => Gallery::default(),
        };
        warnings.extend(gallery.notes.iter().map(|note| format!("{sequence}: {note}")));
        pictures_drawn += gallery.drawn;
        let neighbours = [at.checked_sub(1).map(|i| &sequences[i]), sequences.get(at + 1)];
        let page = sequence_page::page(&board, sequence, &gallery, neighbours, options);
        write_atomic(out.join(page_of(sequence)), page.into_string().as_bytes())?;
        thumbnails.push(gallery.truth);
        steps.step()?;
    }
    let index = out.join("index.html");
    let page = index::page(&board, &sequences, &thumbnails, &downloads, options);
    write_atomic(&index, page.into_string().as_bytes())?;
    let ranking = |b: &board::SurfaceBoard| Ranking {
        protocol: b.protocol,
        methods: b.methods.iter().map(|m| m.name.clone()).collect(),
    };
    Ok(LeaderboardSummary {
        index,
        ranking: board.surfaces.iter().map(ranking).collect(),
        sequences,
        pictures_drawn,
        warnings,
    })
}
