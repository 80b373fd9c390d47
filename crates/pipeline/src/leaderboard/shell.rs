//! What all pages share: the frame, cells and charts.

use maud::{DOCTYPE, Markup, html};
use mb_eval::SurfaceProtocol;
use mb_render::heat_colors;

use crate::pictures::HEAT_LIMIT_MM;
use crate::report::gradient;

/// The site's style: that of the reports, and what only a leaderboard has.
pub(super) fn stylesheet() -> String {
    [include_str!("../report/style.css"), include_str!("site.css")].concat()
}

/// A page; `up` leads from its folder to the site's root (empty or `../`).
pub(super) fn page(title: &str, up: &str, body: &Markup) -> Markup {
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                link rel="stylesheet" href=(format!("{up}style.css"));
                script defer src=(format!("{up}sort.js")) {}
            }
            body { main.site {
                (body)
                footer { "Made by mobilebrick " (env!("CARGO_PKG_VERSION")) ". Every number is defined in docs/metrics.md." }
            } }
        }
    }
}

/// A fraction in percent.
pub(super) fn percent(fraction: f64) -> String {
    format!("{:.2}", fraction * 100.0)
}

/// A cell with a fraction in percent over a tint of its strength.
pub(super) fn tinted(fraction: f64, link: Option<&str>) -> Markup {
    let text = percent(fraction);
    html! {
        td.tint style=(format!("--v:{:.3}", fraction.clamp(0.0, 1.0))) data-value=(fraction) {
            @if let Some(link) = link { a href=(link) { (text) } } @else { (text) }
        }
    }
}

/// An empty cell that says why.
pub(super) fn missing(reason: &str) -> Markup {
    html! { td.missing data-value="" title=(reason) { span { "missing" } } }
}

/// The scale of all heat maps.
pub(super) fn heat_scale() -> Markup {
    let values: Vec<f64> = (0..=16).map(|i| f64::from(i) / 16.0).collect();
    html! {
        div.scale { "0" div.bar style=(gradient(&heat_colors(&values, 0.0, 1.0))) {} (HEAT_LIMIT_MM) " mm and more" }
    }
}

/// What a protocol is, in one sentence.
pub(super) fn explained(protocol: SurfaceProtocol) -> &'static str {
    match protocol {
        SurfaceProtocol::MobileBrick2023 => {
            "The published protocol as its script behaves, hidden alignment included: numbers that stand beside the paper's."
        }
        SurfaceProtocol::Exact1 => {
            "Exact distances to the exact visible surface, nothing aligned; what alignment would change stands beside it."
        }
        SurfaceProtocol::DtuStyle1 => "Mean distances without outliers, as the DTU benchmark scores.",
        SurfaceProtocol::TntStyle1 => "Registered and evenly thinned clouds, as Tanks and Temples scores.",
    }
}
