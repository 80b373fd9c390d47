//! Small drawings: how to turn the model.

use std::f64::consts::{FRAC_PI_2, TAU};

use crate::page::{Align, Element, Page, Rgb, Segment};
use crate::text::Weight;
use crate::views::Turn;

const SIGN: Rgb = [0, 98, 168];

/// Two arrows that chase each other, about the vertical or over the top, with words. `at` is the middle of the sign.
pub(crate) fn turn(page: &mut Page, at: [f64; 2], turn: Turn) {
    // A circle seen from the side for a turn about the vertical, upright for a turn over.
    let (radii, words) = match turn {
        Turn::Round => ([4.4, 2.6], "Turn around"),
        Turn::Over => ([2.6, 4.4], "Turn over"),
    };
    for start in [0.15, 0.15 + 0.5] {
        arrow(page, at, radii, start * TAU, (start + 0.36) * TAU);
    }
    page.text([at[0] + radii[0] + 2.0, at[1] + 1.2], 3.4, Weight::Bold, SIGN, Align::Left, words);
}

/// An arc of an ellipse with a head.
fn arrow(page: &mut Page, [x, y]: [f64; 2], [rx, ry]: [f64; 2], from: f64, to: f64) {
    let point = |angle: f64| [x + rx * angle.cos(), y + ry * angle.sin()];
    let tangent = |angle: f64| [-rx * angle.sin(), ry * angle.cos()];
    let mut segments = vec![Segment::Move(point(from))];
    let pieces = ((to - from) / FRAC_PI_2).ceil().max(1.0) as usize;
    let step = (to - from) / pieces as f64;
    // A cubic follows an arc of `step` with this share of the tangent.
    let share = 4.0 / 3.0 * (step / 4.0).tan();
    for piece in 0..pieces {
        let (a, b) = (from + step * piece as f64, from + step * (piece + 1) as f64);
        let ([ax, ay], [bx, by]) = (point(a), point(b));
        let ([ta, tb], [sa, sb]) = (tangent(a), tangent(b));
        segments.push(Segment::Curve([ax + share * ta, ay + share * tb], [bx - share * sa, by - share * sb], [bx, by]));
    }
    page.elements.push(Element::Path { segments, fill: None, line: Some((SIGN, 0.9)) });
    let [px, py] = point(to);
    let [dx, dy] = tangent(to);
    let length = dx.hypot(dy).max(1e-9);
    let (dx, dy) = (dx / length, dy / length);
    let head = vec![
        Segment::Move([px + 1.9 * dx, py + 1.9 * dy]),
        Segment::Line([px - 1.2 * dy, py + 1.2 * dx]),
        Segment::Line([px + 1.2 * dy, py - 1.2 * dx]),
        Segment::Close,
    ];
    page.elements.push(Element::Path { segments: head, fill: Some(SIGN), line: None });
}
