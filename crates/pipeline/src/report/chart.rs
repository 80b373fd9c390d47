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
