//! A page per sequence: what each method made of it, and where it is wrong.

use std::path::Path;

use maud::{Markup, html};
use mb_eval::{Group, GroupThreshold, OfAngle, OfViews, Region, SurfaceProtocol, SurfaceScores};

use super::LeaderboardOptions;
use super::board::{Board, SurfaceBoard, file_name};
use super::gallery::Gallery;
use super::index::why;
use super::shell::{explained, heat_scale, missing, page as shell, percent, tinted};
use crate::report::chart::{Line, fraction_chart};

pub(super) fn page(
    board: &Board,
    sequence: &str,
    gallery: &Gallery,
    [before, after]: [Option<&String>; 2],
    options: &LeaderboardOptions,
) -> Markup {
    let link = |name: &String| format!("{}.html", file_name(name));
    let body = html! {
        nav.crumbs {
            a href="../index.html" { (options.title) }
            span {
                @if let Some(name) = before { a href=(link(name)) { "← " (name) } }
                @if let Some(name) = after { a href=(link(name)) { (name) " →" } }
            }
        }
        header { h1 { (sequence) } p.lead { "What each method made of it, and where it is wrong." } }
        @for surfaces in &board.surfaces { (scores(surfaces, sequence)) }
        (pictures(gallery))
        @if let Some(surfaces) = board.surfaces.iter().find(|b| b.protocol == SurfaceProtocol::Exact1).or(board.surfaces.first()) {
            (curves(surfaces, sequence))
        }
        @if let Some(surfaces) = board.surfaces.iter().find(|b| b.protocol == SurfaceProtocol::Exact1) {
            (breakdowns(surfaces, sequence))
        }
        (provenance(board, sequence))
    };
    shell(&format!("{sequence} · {}", options.title), "../", &body)
}

/// The methods that have a score, in the order of their rank.
fn scored<'a>(surfaces: &'a SurfaceBoard, sequence: &str) -> Vec<(&'a str, &'a SurfaceScores)> {
    surfaces.methods.iter().filter_map(|m| Some((m.name.as_str(), m.sequences.get(sequence)?))).collect()
}

fn scores(surfaces: &SurfaceBoard, sequence: &str) -> Markup {
    let scored = scored(surfaces, sequence);
    let Some((_, first)) = scored.first() else { return html! {} };
    let exact = surfaces.protocol == SurfaceProtocol::Exact1;
    let best = scored.iter().map(|(_, s)| s.chamfer.chamfer_mm).fold(f64::INFINITY, f64::min);
    html! {
        h2 { "Scores " span.tag { (surfaces.protocol) } }
        p { (explained(surfaces.protocol)) }
        div.scroll { table.sortable {
            thead { tr {
                th { "method" }
                @for t in &first.thresholds { @for what in ["acc", "rec", "F1"] { th { (what) " " (t.threshold_mm) " mm %" } } }
                th { "Chamfer mm" }
                @if exact { th { "95 % interval" } th { "aligned" } } @else { th { "ICP" } }
            } }
            tbody { @for method in &surfaces.methods { tr {
                td { (method.name) }
                @match method.sequences.get(sequence) {
                    Some(s) => {
                        @for t in &s.thresholds {
                            td { (percent(t.accuracy)) } td { (percent(t.recall)) } (tinted(t.f1, None))
                        }
                        td.best[s.chamfer.chamfer_mm == best] { (format!("{:.3}", s.chamfer.chamfer_mm)) }
                        @match &s.exact {
                            Some(e) => {
                                td { (format!("{:.2} to {:.2}", e.confidence_95.chamfer_mm.0, e.confidence_95.chamfer_mm.1)) }
                                td data-value=(e.aligned.chamfer.chamfer_mm) { (format!("{:.3}", e.aligned.chamfer.chamfer_mm)) " " small { (format!("{:+.3}", e.aligned.effect.chamfer_mm)) } }
                            }
                            None => td data-value=(s.icp.fitness) { (if s.icp.applied { "moved, " } else { "not moved, " }) (format!("{:.4}", s.icp.fitness)) },
                        }
                    }
                    None => {
                        @for _ in 0..3 * first.thresholds.len() + 2 + usize::from(exact) { (missing(why(method, sequence))) }
                    }
                }
            } } }
        } }
    }
}

fn pictures(gallery: &Gallery) -> Markup {
    html! {
        @if let Some(truth) = &gallery.truth {
            h2 { "Surfaces and errors" }
            p { "Each method's surface, its distance to the truth (what is wrong), and the truth's distance to it (what is lacking)." }
            (heat_scale())
            div.filmstrip {
                (figure(truth, "ground truth"))
                @for method in &gallery.methods {
                    h3 { (method.method) }
                    div.triple {
                        (figure(&method.surface, "surface"))
                        (figure(&method.wrong, "wrong: distance to the truth"))
                        (figure(&method.lacking, "lacking: the truth's distance to it"))
                    }
                }
            }
        }
        @for note in &gallery.notes { div.warning { (note) } }
    }
}

fn figure(path: &Path, caption: &str) -> Markup {
    let path = format!("../{}", path.display());
    html! { figure { a href=(path) { img src=(path) alt=(caption) loading="lazy"; } figcaption { (caption) } } }
}

fn curves(surfaces: &SurfaceBoard, sequence: &str) -> Markup {
    let scored = scored(surfaces, sequence);
    let lines = |value: fn(&mb_eval::CurvePoint) -> f64| -> Vec<Line<'_>> {
        let points = |s: &SurfaceScores| s.curve.points.iter().map(|p| (p.threshold_mm, value(p))).collect();
        scored.iter().map(|&(name, s)| Line { name, points: points(s) }).collect()
    };
    html! {
        h2 { "Over the threshold " span.tag { (surfaces.protocol) } }
        p { "Share of the surface within a distance, as the distance grows. Dashed lines are the thresholds of the tables." }
        div.charts.three {
            (fraction_chart("F1", "threshold, mm", &[2.5, 5.0], &lines(|p| p.f1)))
            (fraction_chart("Accuracy", "threshold, mm", &[2.5, 5.0], &lines(|p| p.accuracy)))
            (fraction_chart("Recall", "threshold, mm", &[2.5, 5.0], &lines(|p| p.recall)))
        }
    }
}

/// One method's row in a table of pieces: name of the piece and its shares at 2.5 mm.
type Pieces<'a> = Vec<(&'a str, Vec<(String, GroupThreshold)>)>;

fn pieces<'a, K>(
    scored: &[(&'a str, &'a SurfaceScores)],
    groups: impl Fn(&'a mb_eval::Breakdown) -> Option<&'a Vec<Group<K>>>,
    name: impl Fn(&K) -> String,
) -> Pieces<'a>
where
    K: 'a,
{
    let of = |s: &'a SurfaceScores| -> Option<Vec<(String, GroupThreshold)>> {
        let groups = groups(&s.exact.as_ref()?.breakdown)?;
        let piece = |g: &Group<K>| Some((name(&g.of), *g.thresholds.iter().find(|t| t.threshold_mm == 2.5)?));
        Some(groups.iter().filter_map(piece).collect())
    };
    scored.iter().filter_map(|(method, s)| Some((*method, of(s)?))).collect()
}

fn breakdowns(surfaces: &SurfaceBoard, sequence: &str) -> Markup {
    let scored = scored(surfaces, sequence);
    let regions = pieces(&scored, |b| b.by_region.as_ref(), |of| format!("{:?}", of.region).to_lowercase());
    let angles =
        pieces(&scored, |b| b.by_viewing_angle.as_ref(), |of: &OfAngle| format!("{}-{}°", of.from_deg, of.to_deg));
    let views = pieces(
        &scored,
        |b| b.by_views.as_ref(),
        |of: &OfViews| match of.to_views {
            Some(to) if to == of.from_views => to.to_string(),
            Some(to) => format!("{}-{to}", of.from_views),
            None => format!("{}+", of.from_views),
        },
    );
    let kinds = [Region::Studs, Region::Holes, Region::Tops, Region::Undersides, Region::Walls];
    let kinds: Vec<String> = kinds.iter().map(|k| format!("{k:?}").to_lowercase()).collect();
    html! {
        @if [&regions, &angles, &views].iter().any(|p| !p.is_empty()) {
            h2 { "Where it goes wrong " span.tag { (surfaces.protocol) } }
        }
        (piece_table("By kind of surface: F1 at 2.5 mm, %", "", &regions, Some(&kinds), |t| t.f1))
        (piece_table("By the best viewing angle: recall at 2.5 mm, %", "0° is a camera straight in front of the surface.", &angles, None, |t| t.recall))
        (piece_table("By the number of cameras that see the place: recall at 2.5 mm, %", "", &views, None, |t| t.recall))
        (more(&scored))
    }
}

fn piece_table(
    title: &str,
    note: &str,
    rows: &Pieces<'_>,
    order: Option<&[String]>,
    value: fn(&GroupThreshold) -> Option<f64>,
) -> Markup {
    let mut heads: Vec<String> = Vec::new();
    for (name, _) in rows.iter().flat_map(|(_, pieces)| pieces) {
        if !heads.contains(name) {
            heads.push(name.clone());
        }
    }
    match order {
        Some(order) => heads.sort_by_key(|h| order.iter().position(|o| o == h)),
        // Ranges begin with their lower bound.
        None => heads.sort_by_key(|h| {
            h.chars().take_while(char::is_ascii_digit).collect::<String>().parse::<u32>().unwrap_or(0)
        }),
    }
    html! {
        @if !rows.is_empty() {
            h3 { (title) }
            @if !note.is_empty() { p { (note) } }
            div.scroll { table.sortable.matrix {
                thead { tr { th { "method" } @for head in &heads { th { (head) } } } }
                tbody { @for (method, pieces) in rows { tr {
                    td { (method) }
                    @for head in &heads {
                        @match pieces.iter().find(|(name, _)| name == head).and_then(|(_, t)| value(t)) {
                            Some(share) => (tinted(share, None)),
                            None => (missing("no points there")),
                        }
                    }
                } } }
            } }
        }
    }
}

/// Normals, floaters, coverage and bricks that were missed.
fn more(scored: &[(&str, &SurfaceScores)]) -> Markup {
    let breakdown = |s: &SurfaceScores| s.exact.as_ref().map(|e| e.breakdown.clone());
    html! {
        @if scored.iter().any(|(_, s)| s.exact.is_some()) {
            h3 { "Normals, floaters, coverage" }
            div.scroll { table.sortable {
                thead { tr { th { "method" } th { "normals agree" } th { "floating, %" } th { "floating pieces" } th { "covered, %" } th { "bricks missed" } th { "worst bricks, F1 at 2.5 mm" } } }
                tbody { @for (name, s) in scored { @if let Some(b) = breakdown(s) { tr {
                    td { (name) }
                    td { (b.normals.map(|n| format!("{:.3}", n.consistency)).unwrap_or_default()) }
                    td { (percent(b.floaters.share)) }
                    td { (b.floaters.pieces.map(|p| p.to_string()).unwrap_or_default()) }
                    td { (percent(b.coverage.share)) }
                    td { @if let Some(missed) = &b.coverage.missed_parts { (missed.len()) } }
                    td { (worst(&b)) }
                } } } }
            } }
        }
    }
}

/// The three bricks with the lowest F1, of those with at least a hundred points.
fn worst(breakdown: &mb_eval::Breakdown) -> String {
    let f1 = |g: &Group<mb_eval::OfPart>| g.thresholds.iter().find(|t| t.threshold_mm == 2.5).and_then(|t| t.f1);
    let bricks = breakdown.by_part.iter().flatten().filter(|g| g.gt_points >= 100);
    let mut bricks: Vec<(u32, f64)> = bricks.filter_map(|g| Some((g.of.part, f1(g)?))).collect();
    bricks.sort_by(|a, b| a.1.total_cmp(&b.1));
    let words: Vec<String> = bricks.iter().take(3).map(|(part, f1)| format!("{part} ({} %)", percent(*f1))).collect();
    words.join(", ")
}

fn provenance(board: &Board, sequence: &str) -> Markup {
    html! {
        h2 { "Where the numbers come from" }
        @for surfaces in &board.surfaces { @for (name, s) in scored(surfaces, sequence) {
            details {
                summary { (name) ", " (surfaces.protocol) }
                @for warning in &s.warnings { div.warning { (warning) } }
                table.facts { tbody {
                    tr { td { "points" } td { (s.points[0]) " on the truth, " (s.points[1]) " on the prediction" } }
                    tr { td { "seed" } td { (s.seed) } }
                    @if let Some(p) = &s.provenance {
                        tr { td { "program" } td { (p.program) } }
                        @for (what, file) in [("prediction", &p.prediction), ("ground truth", &p.ground_truth), ("visibility", &p.visibility)] {
                            tr { td { (what) } td { code { (file.path.display()) } ", " (file.bytes) " bytes" br; code.hash { (file.sha256) } } }
                        }
                    }
                } }
            }
        } }
    }
}
