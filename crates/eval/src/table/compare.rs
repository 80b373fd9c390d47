//! Methods beside the published rows: what `bench table` shows.

use std::collections::BTreeMap;

use mb_job::{InputError, Result};
use serde::Serialize;

use super::documents::{MethodScores, SequenceValues};
use crate::PUBLISHED_TEST_SEQUENCES;

use super::{ImpossibleRow, PairedDifference, PaperTable, Row, SOURCE, Table, lint, paired_bootstrap};

/// A table with what a reader should know about it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Comparison {
    /// Which of the paper's tables.
    pub table: PaperTable,
    /// The protocol of the rows that are not published.
    pub protocol: String,
    /// The rows. The published ones are there where the protocol is that of the paper.
    #[serde(flatten)]
    pub rows: Table,
    /// Rows that cannot be true.
    pub impossible: Vec<ImpossibleRow>,
    /// Every pair of scored methods with at least two sequences in common.
    pub differences: Vec<Difference>,
    /// What a row leaves out.
    pub notes: Vec<String>,
    /// Where published rows come from.
    pub source: Option<&'static str>,
}

/// Two methods in the table's headline column.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// The one method.
    pub first: String,
    /// The other.
    pub second: String,
    /// The column.
    pub column: String,
    /// First minus second, over the sequences that both have.
    #[serde(flatten)]
    pub difference: PairedDifference,
}

impl Difference {
    /// As a sentence.
    pub fn sentence(&self) -> String {
        let d = &self.difference;
        let verdict = if d.is_significant() { "differs" } else { "could be chance" };
        format!(
            "{} - {}, {}: {:+.4} [{:+.4}, {:+.4}], p = {:.4} over {} sequences: {verdict}",
            self.first,
            self.second,
            self.column,
            d.mean,
            d.confidence_95.0,
            d.confidence_95.1,
            d.p_two_sided,
            d.sequences
        )
    }
}

/// Sets the scores beside the published rows: for each of `tables` one comparison by the paper's protocol, and one for
/// every other protocol that occurs, without published rows, as numbers of two protocols do not compare. Documents of
/// one method and protocol are joined. `seed` is that of the bootstrap.
///
/// # Errors
/// A method has two scores for one sequence.
pub fn compare(documents: Vec<MethodScores>, tables: &[PaperTable], seed: u64) -> Result<Vec<Comparison>> {
    let mut groups: BTreeMap<(PaperTable, bool, String), Vec<MethodScores>> = BTreeMap::new();
    for &table in tables {
        groups.insert((table, false, table.protocol().to_owned()), Vec::new());
    }
    for document in documents.into_iter().filter(|d| tables.contains(&d.table)) {
        let other = document.protocol != document.table.protocol();
        let group = groups.entry((document.table, other, document.protocol.clone())).or_default();
        match group.iter_mut().find(|m| m.method == document.method) {
            Some(method) => join(method, document)?,
            None => group.push(document),
        }
    }
    Ok(groups.into_iter().map(|((table, _, protocol), methods)| comparison(table, protocol, &methods, seed)).collect())
}

fn join(method: &mut MethodScores, document: MethodScores) -> Result<()> {
    for values in document.sequences {
        if let Some(twice) = method.sequences.iter().find(|s| s.sequence == values.sequence) {
            let found =
                format!("{} has a score for {:?} in {} too", method.method, values.sequence, twice.file.display());
            return Err(InputError::new(&values.file, found).help("Leave one of the two documents out").into());
        }
        method.sequences.push(values);
    }
    method.missing.extend(document.missing);
    method.missing.retain(|name| !method.sequences.iter().any(|s| s.sequence == *name));
    Ok(())
}

fn comparison(table: PaperTable, protocol: String, methods: &[MethodScores], seed: u64) -> Comparison {
    let as_published = protocol == table.protocol();
    let mut rows = table.published();
    if !as_published {
        rows.rows.clear();
        rows.title = format!("{}, {protocol}", rows.title);
    }
    let mut notes = Vec::new();
    for method in methods {
        let (scored, listed) = (method.sequences.len(), method.sequences.len() + method.missing.len());
        rows.push(Row {
            method: method.method.clone(),
            input: String::new(),
            origin: if scored == listed { count(scored) } else { format!("{scored} of {listed} sequences") },
            values: method.means(),
        });
        if !method.missing.is_empty() {
            notes.push(format!(
                "{}: no score for {}; the row is the mean of the other {scored}",
                method.method,
                method.missing.join(", ")
            ));
        }
    }
    if as_published && table == PaperTable::Surfaces {
        let others: Vec<&str> = methods.iter().filter(|m| !is_over_the_test_sequences(m)).map(|m| &*m.method).collect();
        if !others.is_empty() {
            notes.push(format!(
                "{}: not over the {} test sequences of the published rows, and not comparable with them",
                others.join(", "),
                PUBLISHED_TEST_SEQUENCES.len()
            ));
        }
    }
    let column = rows.columns[table.headline()].name.clone();
    let mut differences = Vec::new();
    for (i, first) in methods.iter().enumerate() {
        for second in &methods[i + 1..] {
            let pairs = pairs(&first.sequences, &second.sequences, table.headline());
            differences.extend(paired_bootstrap(&pairs, seed).map(|difference| Difference {
                first: first.method.clone(),
                second: second.method.clone(),
                column: column.clone(),
                difference,
            }));
        }
    }
    Comparison {
        table,
        protocol,
        impossible: lint(&rows),
        rows,
        differences,
        notes,
        source: as_published.then_some(SOURCE),
    }
}

fn is_over_the_test_sequences(method: &MethodScores) -> bool {
    let scored = |name: &&str| method.sequences.iter().any(|s| s.sequence == *name);
    method.sequences.len() == PUBLISHED_TEST_SEQUENCES.len() && PUBLISHED_TEST_SEQUENCES.iter().all(scored)
}

fn count(sequences: usize) -> String {
    if sequences == 1 { "1 sequence".to_owned() } else { format!("{sequences} sequences") }
}

/// Both values of every sequence that both have.
fn pairs(first: &[SequenceValues], second: &[SequenceValues], column: usize) -> Vec<(f64, f64)> {
    let partner = |a: &SequenceValues| {
        let b = second.iter().find(|b| b.sequence == a.sequence)?;
        Some((a.values[column]?, b.values[column]?))
    };
    first.iter().filter_map(partner).collect()
}
