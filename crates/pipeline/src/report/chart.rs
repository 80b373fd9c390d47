//! Line charts as inline SVG that follow the page's colours.

use maud::{Markup, html};

/// One line of a chart.
pub(crate) struct Line<'a> {
    /// Its name in the legend.
    pub name: &'a str,
    /// (x, y) in ascending x.
    pub points: Vec<(f64, f64)>,
}

/// A chart of fractions (y from 0 to 1, shown in percent) over a length in millimetres.
pub(crate) fn fraction_chart(title: &str, x_label: &str, marks_x: &[f64], lines: &[Line<'_>]) -> Markup {
    const WIDTH: f64 = 520.0;
    const HEIGHT: f64 = 300.0;
    const LEFT: f64 = 46.0;
    const RIGHT: f64 = 16.0;
    const TOP: f64 = 16.0;
    const BOTTOM: f64 = 42.0;
    let x_max = lines.iter().flat_map(|l| &l.points).map(|p| p.0).fold(f64::MIN_POSITIVE, f64::max);
    let px = |x: f64| LEFT + x / x_max * (WIDTH - LEFT - RIGHT);
    let py = |y: f64| TOP + (1.0 - y.clamp(0.0, 1.0)) * (HEIGHT - TOP - BOTTOM);
    let path = |points: &[(f64, f64)]| {
        let words: Vec<String> = points
            .iter()
            .enumerate()
            .map(|(i, &(x, y))| format!("{}{:.1} {:.1}", if i == 0 { "M" } else { "L" }, px(x), py(y)))
            .collect();
        words.join("")
    };
    let x_step = [0.5, 1.0, 2.0, 2.5, 5.0, 10.0, 20.0, 50.0].into_iter().find(|s| x_max / s <= 8.5).unwrap_or(100.0);
    let x_ticks = (0..=(x_max / x_step + 1e-9) as usize).map(|i| i as f64 * x_step);
    html! {
        figure.chart {
            svg viewBox=(format!("0 0 {WIDTH} {HEIGHT}")) role="img" aria-label=(title) {
                @for i in 0..=5 {
                    @let y = f64::from(i) * 0.2;
                    line.grid x1=(LEFT) x2=(WIDTH - RIGHT) y1=(py(y)) y2=(py(y)) {}
                    text.tick x=(LEFT - 8.0) y=(py(y) + 4.0) text-anchor="end" { (format!("{:.0}", y * 100.0)) }
                }
                @for x in x_ticks {
                    text.tick x=(px(x)) y=(HEIGHT - BOTTOM + 18.0) text-anchor="middle" { (format!("{x}")) }
                }
                @for &x in marks_x.iter().filter(|x| **x <= x_max) {
                    line.mark x1=(px(x)) x2=(px(x)) y1=(TOP) y2=(HEIGHT - BOTTOM) {}
                }
                text.label x=((LEFT + WIDTH - RIGHT) / 2.0) y=(HEIGHT - 6.0) text-anchor="middle" { (x_label) }
                text.label x=(LEFT - 38.0) y=(TOP - 4.0) { "%" }
                @for (i, line) in lines.iter().enumerate() {
                    path class=(format!("line series{}", i % 6)) d=(path(&line.points)) {}
                }
            }
            figcaption {
                strong { (title) }
                @for (i, line) in lines.iter().enumerate() {
                    span.legend { span class=(format!("swatch series{}", i % 6)) {} (line.name) }
                }
            }
        }
    }
}

/// One bar for each frame, tall as its value; frames that are flagged stand out.
pub(crate) fn frame_chart(title: &str, unit: &str, bars: &[(u32, f64, bool)]) -> Markup {
    const WIDTH: f64 = 520.0;
    const HEIGHT: f64 = 200.0;
    const LEFT: f64 = 46.0;
    const RIGHT: f64 = 16.0;
    const TOP: f64 = 20.0;
    const BOTTOM: f64 = 40.0;
    let largest = bars.iter().map(|b| b.1).fold(0.0, f64::max);
    let step = nice_step(largest);
    let top = step * (largest / step).ceil().max(1.0);
    let first = bars.first().map_or(0, |b| b.0);
    let span = f64::from(bars.last().map_or(0, |b| b.0) - first + 1);
    let px = |frame: f64| LEFT + (frame - f64::from(first)) / span * (WIDTH - LEFT - RIGHT);
    let py = |value: f64| HEIGHT - BOTTOM - value / top * (HEIGHT - TOP - BOTTOM);
    let width = (0.8 * (WIDTH - LEFT - RIGHT) / span).max(0.7);
    html! {
        figure.chart {
            svg viewBox=(format!("0 0 {WIDTH} {HEIGHT}")) role="img" aria-label=(title) {
                @for i in 0..=(top / step).round() as usize {
                    @let y = i as f64 * step;
                    line.grid x1=(LEFT) x2=(WIDTH - RIGHT) y1=(format!("{:.1}", py(y))) y2=(format!("{:.1}", py(y))) {}
                    text.tick x=(LEFT - 8.0) y=(format!("{:.1}", py(y) + 4.0)) text-anchor="end" { (short(y)) }
                }
                @for &(frame, value, flagged) in bars {
                    rect class=(if flagged { "bars flagged" } else { "bars" })
                        x=(format!("{:.1}", px(f64::from(frame)))) y=(format!("{:.1}", py(value)))
                        width=(format!("{width:.1}")) height=(format!("{:.1}", py(0.0) - py(value))) {}
                }
                @if let (Some(first), Some(last)) = (bars.first(), bars.last()) {
                    text.tick x=(LEFT) y=(HEIGHT - BOTTOM + 18.0) { (first.0) }
                    text.tick x=(WIDTH - RIGHT) y=(HEIGHT - BOTTOM + 18.0) text-anchor="end" { (last.0) }
                }
                text.label x=((LEFT + WIDTH - RIGHT) / 2.0) y=(HEIGHT - 8.0) text-anchor="middle" { "frame" }
                text.label x=(LEFT - 38.0) y=(TOP - 8.0) { (unit) }
            }
            figcaption { strong { (title) } }
        }
    }
}

/// A number without needless digits.
fn short(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// A step of 1, 2 or 5 times a power of ten that divides a range into two to five.
pub(crate) fn nice_step(range: f64) -> f64 {
    if !(range > 0.0 && range.is_finite()) {
        return 1.0;
    }
    let decade = 10f64.powf((range / 5.0).log10().floor());
    [1.0, 2.0, 5.0, 10.0].into_iter().map(|s| s * decade).find(|s| range / s <= 5.0).unwrap_or(10.0 * decade)
}
