//! What stands on a page, in millimetres from its top left corner. The PDF and the HTML draw the same pages.

use crate::plan::PieceKind;
use crate::text::Weight;

/// Page width and height: A4, landscape.
pub(crate) const PAGE_MM: [f64; 2] = [297.0, 210.0];

/// A rectangle: left, top, width, height.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Rect {
    pub x: f64,
    pub y: f64,
    pub w: f64,
    pub h: f64,
}

impl Rect {
    pub fn new(x: f64, y: f64, w: f64, h: f64) -> Self {
        Self { x, y, w, h }
    }

    pub fn right(&self) -> f64 {
        self.x + self.w
    }

    pub fn bottom(&self) -> f64 {
        self.y + self.h
    }
}

/// 8-bit sRGB.
pub(crate) type Rgb = [u8; 3];

/// A picture that is drawn once, however often it is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum PictureId {
    /// A brick or a finished submodel, in parts lists.
    Piece(PieceKind),
    /// The state after a step: section and step.
    Step(usize, usize),
    /// The model on the cover.
    Cover,
    /// The finished model from its other side.
    Back,
}

/// Where text stands in relation to its point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Align {
    Left,
    Center,
    Right,
}

/// A piece of a path, in millimetres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Segment {
    Move([f64; 2]),
    Line([f64; 2]),
    Curve([f64; 2], [f64; 2], [f64; 2]),
    Close,
}

/// Something on a page.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Element {
    /// A rectangle with round corners.
    Box { rect: Rect, radius: f64, fill: Option<Rgb>, line: Option<(Rgb, f64)> },
    /// A line of text on its base line.
    Text { x: f64, y: f64, size: f64, weight: Weight, color: Rgb, align: Align, text: String },
    /// A picture, filling the rectangle.
    Picture { rect: Rect, id: PictureId },
    /// A shape.
    Path { segments: Vec<Segment>, fill: Option<Rgb>, line: Option<(Rgb, f64)> },
}

/// A page.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Page {
    /// From back to front.
    pub elements: Vec<Element>,
    /// What it is, for outlines and headings.
    pub title: String,
}

impl Page {
    pub fn text(
        &mut self,
        [x, y]: [f64; 2],
        size: f64,
        weight: Weight,
        color: Rgb,
        align: Align,
        text: impl Into<String>,
    ) {
        self.elements.push(Element::Text { x, y, size, weight, color, align, text: text.into() });
    }

    pub fn filled(&mut self, rect: Rect, radius: f64, fill: Rgb) {
        self.elements.push(Element::Box { rect, radius, fill: Some(fill), line: None });
    }

    pub fn picture(&mut self, rect: Rect, id: PictureId) {
        self.elements.push(Element::Picture { rect, id });
    }
}

/// A round-cornered rectangle as a path.
pub(crate) fn rounded(rect: &Rect, radius: f64) -> Vec<Segment> {
    let r = radius.min(0.5 * rect.w).min(0.5 * rect.h).max(0.0);
    let (l, t, ri, b) = (rect.x, rect.y, rect.right(), rect.bottom());
    if r == 0.0 {
        return vec![
            Segment::Move([l, t]),
            Segment::Line([ri, t]),
            Segment::Line([ri, b]),
            Segment::Line([l, b]),
            Segment::Close,
        ];
    }
    // A quarter circle as a cubic.
    let k = r * (1.0 - 0.552_284_75);
    vec![
        Segment::Move([l + r, t]),
        Segment::Line([ri - r, t]),
        Segment::Curve([ri - k, t], [ri, t + k], [ri, t + r]),
        Segment::Line([ri, b - r]),
        Segment::Curve([ri, b - k], [ri - k, b], [ri - r, b]),
        Segment::Line([l + r, b]),
        Segment::Curve([l + k, b], [l, b - k], [l, b - r]),
        Segment::Line([l, t + r]),
        Segment::Curve([l, t + k], [l + k, t], [l + r, t]),
        Segment::Close,
    ]
}
