//! The first page: rankings, curves, methods by sequence, significance, provenance.

use std::collections::BTreeMap;
use std::path::PathBuf;

use maud::{Markup, PreEscaped, html};
use mb_eval::{Comparison, OfRegion, PaperTable, Region, SurfaceProtocol, TableFormat, ThresholdScore};

use super::LeaderboardOptions;
use super::board::{Board, Method, SurfaceBoard, f1_at, page_of};
use super::shell::{explained, missing, page as shell, percent, tinted};
use crate::report::chart::{Line, fraction_chart};

pub(super) fn page(
    board: &Board,
    sequences: &[String],
    thumbnails: &[Option<PathBuf>],
    downloads: &[String],
    options: &LeaderboardOptions,
) -> Markup {
    let body = html! {
        header { h1 { (options.title) } p.lead { (lead(board, sequences.len())) } }
        @if board.surfaces.len() + board.tables.len() > 2 { (contents(board)) }
        @for surfaces in &board.surfaces { (section(board, surfaces, sequences)) }
        @for table in board.tables.iter().filter(|t| t.table != PaperTable::Surfaces) { (other_table(table)) }
        @if thumbnails.iter().any(Option::is_some) { (sequence_cards(board, sequences, thumbnails)) }
        (provenance(board, downloads))
    };
    shell(&options.title, "", &body)
}

fn lead(board: &Board, sequences: usize) -> String {
    let mut methods: Vec<&str> = board.documents.iter().map(|(name, _)| name.as_str()).collect();
    methods.sort_unstable();
    methods.dedup();
    let count = |n: usize, one: &str, many: &str| if n == 1 { format!("1 {one}") } else { format!("{n} {many}") };
    format!(
        "{} on {}, against exact ground truth from brick models. A sequence without a score is missing and in no mean.",
        count(methods.len(), "method", "methods"),
        count(sequences, "sequence", "sequences"),
    )
}

fn anchor(table: &Comparison) -> String {
    format!("{}-{}", table.table.name(), table.protocol)
}

fn contents(board: &Board) -> Markup {
    html! {
        nav.contents {
            @for table in &board.tables {
                a href=(format!("#{}", anchor(table))) { (table.rows.title.split(',').next().unwrap_or_default()) " " small { (table.protocol) } }
            }
        }
    }
}

fn section(board: &Board, surfaces: &SurfaceBoard, sequences: &[String]) -> Markup {
    let comparison = board.comparison(surfaces.protocol);
    let curves: Vec<Line<'_>> =
        surfaces.methods.iter().map(|m| Line { name: &m.name, points: m.curve(|p| p.f1) }).collect();
    let accuracy: Vec<Line<'_>> =
        surfaces.methods.iter().map(|m| Line { name: &m.name, points: m.curve(|p| p.accuracy) }).collect();
    let recall: Vec<Line<'_>> =
        surfaces.methods.iter().map(|m| Line { name: &m.name, points: m.curve(|p| p.recall) }).collect();
    html! {
        section id=(format!("surfaces-{}", surfaces.protocol)) {
            h2 { "Surfaces " span.tag { (surfaces.protocol) } }
            p { (explained(surfaces.protocol)) }
            (ranking(surfaces, comparison))
            @if let Some(comparison) = comparison { (notes(comparison)) }
            div.charts.three {
                (fraction_chart("F1", "threshold, mm", &[2.5, 5.0], &curves))
                (fraction_chart("Accuracy", "threshold, mm", &[2.5, 5.0], &accuracy))
                (fraction_chart("Recall", "threshold, mm", &[2.5, 5.0], &recall))
            }
            h3 { "By sequence: F1 at 2.5 mm, %" }
            (matrix(surfaces, sequences))
            @if surfaces.protocol == SurfaceProtocol::Exact1 { (regions(surfaces)) }
            @if let Some(comparison) = comparison.filter(|c| !c.differences.is_empty()) { (differences(comparison)) }
        }
    }
}

/// A row of the ranking: a method here, or a published one.
struct Ranked<'a> {
    name: &'a str,
    origin: &'a str,
    values: &'a [Option<f64>],
    method: Option<&'a Method>,
}

fn ranking(surfaces: &SurfaceBoard, comparison: Option<&Comparison>) -> Markup {
    let Some(comparison) = comparison else { return html! {} };
    let mut rows: Vec<Ranked<'_>> = comparison
        .rows
        .rows
        .iter()
        .map(|row| Ranked {
            name: &row.method,
            origin: &row.origin,
            values: &row.values,
            method: surfaces
                .methods
                .iter()
                .find(|m| m.name == row.method)
                .filter(|_| row.origin != "paper" && row.origin != "later"),
        })
        .collect();
    rows.sort_by(|a, b| b.values[2].unwrap_or(-1.0).total_cmp(&a.values[2].unwrap_or(-1.0)));
    let best: Vec<Vec<&str>> = (0..comparison.rows.columns.len())
        .map(|c| comparison.rows.best(c).into_iter().map(|r| comparison.rows.rows[r].method.as_str()).collect())
        .collect();
    let exact = surfaces.protocol == SurfaceProtocol::Exact1;
    html! {
        div.scroll { table.sortable.ranking {
            thead { tr {
                th { "method" } th { "from" }
                @for column in &comparison.rows.columns { th { (column.name) } }
                @if exact { th title="F1 at 2.5 mm after rigid alignment, and what it changed" { "aligned F1" } th title="mean cosine of normals" { "normals" } }
            } }
            tbody { @for (place, row) in rows.iter().enumerate() {
                tr.published[row.method.is_none()] {
                    td data-value=(row.name) { span.place { (place + 1) } (row.name) }
                    td { (row.origin) }
                    @for (c, value) in row.values.iter().enumerate() {
                        @match value {
                            Some(value) => td.best[best[c].contains(&row.name)].bar[c == 2] data-value=(value)
                                style=[(c == 2).then(|| format!("--v:{:.3}", value / 100.0))]
                                { (format!("{value:.*}", comparison.rows.columns[c].digits)) },
                            None => td.missing data-value="" {},
                        }
                    }
                    @if exact { (aligned_cells(row.method)) }
                }
            } }
        } }
    }
}

fn aligned_cells(method: Option<&Method>) -> Markup {
    let exact = |m: &Method| m.sequences.values().all(|s| s.exact.is_some());
    let Some(method) = method.filter(|m| exact(m)) else { return html! { td {} td {} } };
    let at =
        |thresholds: &[ThresholdScore]| thresholds.iter().find(|t| t.threshold_mm == 2.5).map_or(f64::NAN, |t| t.f1);
    let aligned = method.mean(|s| s.exact.as_ref().map_or(f64::NAN, |e| at(&e.aligned.thresholds)));
    let normals: Option<Vec<f64>> = method
        .sequences
        .values()
        .map(|s| s.exact.as_ref().and_then(|e| e.breakdown.normals).map(|n| n.consistency))
        .collect();
    html! {
        td data-value=(aligned) { (percent(aligned)) " " small { (format!("{:+.2}", 100.0 * (aligned - method.f1()))) } }
        @match normals {
            Some(normals) => td { (format!("{:.3}", normals.iter().sum::<f64>() / normals.len() as f64)) },
            None => td.missing data-value="" {},
        }
    }
}

fn notes(comparison: &Comparison) -> Markup {
    html! {
        @for row in &comparison.impossible {
            div.warning { strong { (row.method) ", " (row.column) ": impossible. " } (row.reason) }
        }
        @for note in &comparison.notes { div.warning { (note) } }
        @if let Some(source) = comparison.source { p.source { "Grey rows are published: " (source) "." } }
    }
}

fn matrix(surfaces: &SurfaceBoard, sequences: &[String]) -> Markup {
    html! {
        div.scroll { table.sortable.matrix {
            thead { tr { th { "sequence" } @for method in &surfaces.methods { th { (method.name) } } } }
            tbody { @for sequence in sequences { tr {
                td { a href=(page_of(sequence)) { (sequence) } }
                @for method in &surfaces.methods {
                    @match method.sequences.get(sequence) {
                        Some(scores) => (tinted(f1_at(scores, 2.5), Some(&page_of(sequence)))),
                        None => (missing(why(method, sequence))),
                    }
                }
            } } }
        } }
    }
}

/// Why a method has no score for a sequence.
pub(super) fn why<'a>(method: &'a Method, sequence: &str) -> &'a str {
    method.missing.iter().find(|m| m.sequence == sequence).map_or("not asked for", |m| &m.reason)
}

/// Means over sequences of F1 at 2.5 mm by kind of surface.
fn regions(surfaces: &SurfaceBoard) -> Markup {
    let mut rows: Vec<(&str, BTreeMap<Region, f64>)> = Vec::new();
    for method in &surfaces.methods {
        let mut sums: BTreeMap<Region, (f64, usize)> = BTreeMap::new();
        let groups = method.sequences.values().filter_map(|s| s.exact.as_ref()?.breakdown.by_region.as_ref()).flatten();
        for group in groups {
            let OfRegion { region } = group.of;
            if let Some(f1) = group.thresholds.iter().find(|t| t.threshold_mm == 2.5).and_then(|t| t.f1) {
                let sum = sums.entry(region).or_default();
                *sum = (sum.0 + f1, sum.1 + 1);
            }
        }
        let means = sums.into_iter().map(|(region, (sum, count))| (region, sum / count as f64));
        rows.push((&method.name, means.collect()));
    }
    if rows.iter().all(|(_, means)| means.is_empty()) {
        return html! {};
    }
    let kinds = [Region::Studs, Region::Tops, Region::Walls, Region::Undersides, Region::Holes];
    html! {
        h3 { "By kind of surface: F1 at 2.5 mm, %" }
        div.scroll { table.sortable.matrix {
            thead { tr { th { "method" } @for kind in kinds { th { (format!("{kind:?}").to_lowercase()) } } } }
            tbody { @for (name, means) in &rows { tr {
                td { (name) }
                @for kind in kinds {
                    @match means.get(&kind) { Some(f1) => (tinted(*f1, None)), None => (missing("no such surface, or not known")) }
                }
            } } }
        } }
    }
}

fn differences(comparison: &Comparison) -> Markup {
    html! {
        h3 { "Is the difference chance?" }
        p { "Paired bootstrap over the sequences that both methods have: the mean of first minus second, its 95 % interval, and how often chance would do as much; green where that is below 0.05, which needs six sequences or more." }
        div.scroll { table.sortable {
            thead { tr { th { "first" } th { "second" } th { "difference" } th { "95 % interval" } th { "p" } th { "sequences" } } }
            tbody { @for d in &comparison.differences {
                tr {
                    td { (d.first) } td { (d.second) }
                    td.best[d.difference.is_significant()] data-value=(d.difference.mean) { (format!("{:+.3}", d.difference.mean)) }
                    td { (format!("{:+.3} to {:+.3}", d.difference.confidence_95.0, d.difference.confidence_95.1)) }
                    td { (format!("{:.4}", d.difference.p_two_sided)) }
                    td { (d.difference.sequences) }
                }
            } }
        } }
    }
}

fn other_table(table: &Comparison) -> Markup {
    html! {
        section id=(anchor(table)) {
            h2 { (table.rows.title) " " span.tag { (table.protocol) } }
            div.scroll { (PreEscaped(table.rows.render(TableFormat::Html))) }
            (notes(table))
            @if !table.differences.is_empty() { (differences(table)) }
        }
    }
}

fn sequence_cards(board: &Board, sequences: &[String], thumbnails: &[Option<PathBuf>]) -> Markup {
    html! {
        h2 { "Sequences" }
        div.sequences { @for (sequence, picture) in sequences.iter().zip(thumbnails) {
            a.sequence href=(page_of(sequence)) {
                @match picture {
                    Some(picture) => img src=(picture.display()) alt=(sequence) loading="lazy";,
                    None => div.nothing {},
                }
                span { strong { (sequence) } @if let Some((name, f1)) = best(board, sequence) { small { "best: " (name) " " (percent(f1)) " %" } } }
            }
        } }
    }
}

fn best<'a>(board: &'a Board, sequence: &str) -> Option<(&'a str, f64)> {
    let methods = &board.surfaces.first()?.methods;
    let scores = methods.iter().filter_map(|m| Some((m.name.as_str(), f1_at(m.sequences.get(sequence)?, 2.5))));
    scores.max_by(|a, b| a.1.total_cmp(&b.1))
}

fn provenance(board: &Board, downloads: &[String]) -> Markup {
    html! {
        h2 { "Where the numbers come from" }
        p { "Each document holds every score with the options, the seed, the program's version and the hashes of the files that it was computed from." }
        div.scroll { table {
            thead { tr { th { "method" } th { "protocol" } th { "points" } th { "seed" } th { "program" } th { "document" } } }
            tbody {
                @for surfaces in &board.surfaces { @for method in &surfaces.methods {
                    @let first = method.sequences.values().next();
                    @let download = board.documents.iter().zip(downloads).find(|((name, path), _)| *name == method.name && is_of(path, surfaces.protocol));
                    tr {
                        td { (method.name) }
                        td { (surfaces.protocol) }
                        td { @if let Some(s) = first { (s.points[0]) " + " (s.points[1]) } }
                        td { @if let Some(s) = first { (s.seed) } }
                        td { @if let Some(p) = first.and_then(|s| s.provenance.as_ref()) { (p.program) } }
                        td { @if let Some((_, name)) = download { a href=(name) { (name) } } }
                    }
                } }
                @for table in board.tables.iter().filter(|t| t.table != PaperTable::Surfaces) {
                    @for row in table.rows.rows.iter().filter(|r| r.origin != "paper" && r.origin != "later") {
                        tr { td { (row.method) } td { (table.protocol) } td {} td {} td {} td {} }
                    }
                }
            }
        } }
    }
}

/// Whether a document is by a protocol: each holds one.
fn is_of(path: &std::path::Path, protocol: SurfaceProtocol) -> bool {
    std::fs::read_to_string(path).is_ok_and(|text| text.contains(&format!("\"{}\"", protocol.name())))
}
