//! Tables of methods: the paper's four, with rows of one's own beside the published ones.

mod compare;
mod documents;
mod lint;
mod paper;
mod render;
mod significance;

use serde::Serialize;

pub use compare::{Comparison, Difference, compare};
pub use documents::{MethodScores, SequenceValues};
pub use lint::{ImpossibleRow, lint};
pub use paper::{PaperTable, SOURCE};
pub use significance::{PairedDifference, paired_bootstrap};

/// A table: one row per method, one column per number. A missing number is `None`, never zero.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Table {
    /// What the table shows.
    pub title: String,
    /// The columns after the method's name.
    pub columns: Vec<Column>,
    /// The rows, in order.
    pub rows: Vec<Row>,
}

/// A column.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Column {
    /// Heading, with its unit.
    pub name: String,
    /// Which values are good.
    pub better: Better,
    /// Digits after the point.
    pub digits: usize,
}

/// Which of two numbers is the better score.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Better {
    /// Shares, PSNR, SSIM.
    Higher,
    /// Distances and errors.
    Lower,
}

/// A row.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// The method.
    pub method: String,
    /// What it sees: `RGB`, `depth`, `RGBD`; empty where that says nothing.
    pub input: String,
    /// Where the numbers come from: `paper`, a later publication, or this program.
    pub origin: String,
    /// One entry per column.
    pub values: Vec<Option<f64>>,
}

/// How a table is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TableFormat {
    /// Aligned columns for a terminal; the best of a column is marked with `*`.
    Text,
    /// RFC 4180, numbers unrounded, no marks.
    Csv,
    /// A Markdown table; the best in bold.
    Markdown,
    /// A LaTeX `tabular` with `booktabs` rules; the best in bold.
    Latex,
    /// An HTML `table`; the best in `strong`.
    Html,
}

/// From the lower-case name: `text`, `csv`, `markdown`, `latex`, `html`.
impl std::str::FromStr for TableFormat {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        Ok(match name {
            "text" => Self::Text,
            "csv" => Self::Csv,
            "markdown" | "md" => Self::Markdown,
            "latex" | "tex" => Self::Latex,
            "html" => Self::Html,
            _ => return Err(format!("no table format {name:?}; there are text, csv, markdown, latex and html")),
        })
    }
}

impl TableFormat {
    /// Every format.
    pub const ALL: [Self; 5] = [Self::Text, Self::Csv, Self::Markdown, Self::Latex, Self::Html];

    /// The extension of its files.
    pub fn extension(self) -> &'static str {
        match self {
            Self::Text => "txt",
            Self::Csv => "csv",
            Self::Markdown => "md",
            Self::Latex => "tex",
            Self::Html => "html",
        }
    }
}

impl Table {
    /// Adds a row.
    ///
    /// # Panics
    /// The row has not one value per column.
    pub fn push(&mut self, row: Row) {
        assert_eq!(row.values.len(), self.columns.len(), "one value per column");
        self.rows.push(row);
    }

    /// Rows that hold the best value of a column, as it is printed: equal digits share the honour.
    pub fn best(&self, column: usize) -> Vec<usize> {
        let printed = |row: &Row| row.values[column].map(|v| rounded(v, self.columns[column].digits));
        let values = self.rows.iter().filter_map(printed).filter(|v| v.is_finite());
        let best = match self.columns[column].better {
            Better::Higher => values.max_by(f64::total_cmp),
            Better::Lower => values.min_by(f64::total_cmp),
        };
        let Some(best) = best else { return Vec::new() };
        (0..self.rows.len()).filter(|&row| printed(&self.rows[row]) == Some(best)).collect()
    }
}

fn rounded(value: f64, digits: usize) -> f64 {
    let scale = 10f64.powi(digits as i32);
    (value * scale).round() / scale
}
