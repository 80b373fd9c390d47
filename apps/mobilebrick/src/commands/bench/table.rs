//! `bench table`: the paper's tables, with rows of one's own.

use std::path::PathBuf;

use clap::Args;
use mb_eval::{Comparison, MethodScores, PaperTable, TableFormat, compare};
use mb_job::{Result, write_atomic};
use serde::Serialize;

use super::name_and_path;
use crate::commands::Seed;
use crate::outcome::Outcome;

/// The paper's tables with your rows beside the published ones
///
/// Rows come from the documents of `mobilebrick eval`: `scores.json` of a method, or what `--json` printed for one
/// sequence. The best of each column is marked; a cell that was not measured is empty. Rows that cannot be true are named,
/// and methods are compared by a paired bootstrap over the sequences that both have. Without documents the published
/// tables are printed.
#[derive(Debug, Args)]
pub struct Table {
    /// Documents of `mobilebrick eval`, or folders of them; NAME= names a method that the document does not name
    #[arg(value_name = "[NAME=]PATH")]
    results: Vec<String>,

    /// Table to print: surfaces, views, depth or poses; may be repeated. All that have a row of yours, else all four
    #[arg(long = "table", value_name = "TABLE")]
    tables: Vec<PaperTable>,

    /// Format on the terminal: text, csv, markdown, latex or html
    #[arg(long, value_name = "FORMAT", default_value = "text")]
    format: TableFormat,

    /// Folder for every table in every format
    #[arg(short, long, value_name = "DIR")]
    out: Option<PathBuf>,

    #[command(flatten)]
    seed: Seed,
}

#[derive(Serialize)]
struct Document {
    tables: Vec<Comparison>,
    written: Vec<PathBuf>,
    seed: u64,
}

impl Table {
    /// Reads the documents, and prints or writes the tables.
    pub fn run(self) -> Result<Outcome> {
        let mut documents = Vec::new();
        for result in &self.results {
            let (method, path) = name_and_path(result);
            documents.extend(MethodScores::read(path, method)?);
        }
        let with_rows = || PaperTable::ALL.into_iter().filter(|t| documents.iter().any(|d| d.table == *t)).collect();
        let tables = match (self.tables.is_empty(), documents.is_empty()) {
            (false, _) => self.tables,
            (true, true) => PaperTable::ALL.to_vec(),
            (true, false) => with_rows(),
        };
        let tables = compare(documents, &tables, self.seed.seed)?;
        let mut written = Vec::new();
        if let Some(out) = &self.out {
            for comparison in &tables {
                let published = comparison.protocol == comparison.table.protocol();
                let stem = match published {
                    true => comparison.table.name().to_owned(),
                    false => format!("{}-{}", comparison.table.name(), comparison.protocol),
                };
                for format in TableFormat::ALL {
                    let path = out.join(format!("{stem}.{}", format.extension()));
                    write_atomic(&path, comparison.render(format).as_bytes())?;
                    written.push(path);
                }
            }
        }
        let mut text = tables.iter().map(|t| t.render(self.format)).collect::<Vec<_>>().join("\n");
        if let Some(out) = &self.out {
            text += &format!("wrote {} files to {}", written.len(), out.display());
        }
        Outcome::new(&Document { tables, written, seed: self.seed.seed }, text)
    }
}
