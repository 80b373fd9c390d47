//! Colours that a person may mistake for each other.

use std::collections::BTreeMap;

use mb_bricks::{ColorCode, Model};

use crate::page::Rgb;
use crate::plan::Plan;

/// Two colours closer than this are named where they are used (CIE 1976 difference; 2.3 is just noticeable).
const SIMILAR_COLORS: f64 = 26.0;

/// The colours of a plan that look like another one of it.
pub(crate) fn similar_colors(model: &Model, plan: &Plan) -> Vec<ColorCode> {
    let mut used: Vec<ColorCode> = plan.totals().iter().map(|((_, color), _)| *color).collect();
    used.sort_unstable();
    used.dedup();
    let looks: BTreeMap<ColorCode, ([f64; 3], u8)> = used
        .iter()
        .map(|&code| {
            let look = model.colors().look(code);
            (code, (lab(look.rgb), look.alpha))
        })
        .collect();
    let similar = |a: &ColorCode, b: &ColorCode| {
        let ((x, x_alpha), (y, y_alpha)) = (looks[a], looks[b]);
        let difference = (0..3).map(|i| (x[i] - y[i]).powi(2)).sum::<f64>().sqrt();
        a != b && (x_alpha < 255) == (y_alpha < 255) && difference < SIMILAR_COLORS
    };
    used.iter().filter(|a| used.iter().any(|b| similar(a, b))).copied().collect()
}

/// CIE L*a*b* of an sRGB colour under D65.
fn lab(rgb: Rgb) -> [f64; 3] {
    let linear = rgb.map(|v| {
        let v = f64::from(v) / 255.0;
        if v <= 0.040_45 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    });
    let dot = |row: [f64; 3]| row.iter().zip(linear).map(|(a, b)| a * b).sum::<f64>();
    let x = dot([0.4124, 0.3576, 0.1805]) / 0.950_47;
    let y = dot([0.2126, 0.7152, 0.0722]);
    let z = dot([0.0193, 0.1192, 0.9505]) / 1.088_83;
    let f = |t: f64| if t > 0.008_856 { t.cbrt() } else { 7.787 * t + 16.0 / 116.0 };
    [116.0 * f(y) - 16.0, 500.0 * (f(x) - f(y)), 200.0 * (f(y) - f(z))]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn similar_greys_are_named_and_red_is_not() {
        let text = "1 71 0 0 0 1 0 0 0 1 0 0 0 1 3005.dat\n1 7 40 0 0 1 0 0 0 1 0 0 0 1 3005.dat\n\
                    1 4 80 0 0 1 0 0 0 1 0 0 0 1 3005.dat\n";
        let model = Model::from_text(text, "greys.ldr", None).unwrap();
        assert_eq!(similar_colors(&model, &Plan::of(&model)), [ColorCode(7), ColorCode(71)]);
    }
}
