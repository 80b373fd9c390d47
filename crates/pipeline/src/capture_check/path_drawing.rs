//! The cameras of a sequence from above and from the side, with what the depth maps show.

use std::collections::BTreeSet;

use maud::{Markup, html};
use mb_capture::{Frame, FrameId};
use mb_geometry::ImageSize;
use mb_render::heat_colors;
use nalgebra::{Point2, Point3, Vector3};

use crate::report::chart::nice_step;

/// What is drawn.
pub(super) struct PathDrawing<'a> {
    pub frames: &'a [Frame],
    /// Size of the photographs.
    pub size: ImageSize,
    /// Frames that something is wrong with.
    pub flagged: &'a BTreeSet<FrameId>,
    /// Points that the depth maps show, with their colours.
    pub cloud: &'a [(Point3<f64>, [u8; 3])],
    /// The world's up, of unit length.
    pub up: Vector3<f64>,
    /// Whether lengths are metres.
    pub metric: bool,
}

const WIDTH: f64 = 520.0;
const HEIGHT: f64 = 440.0;
const MARGIN: f64 = 30.0;

/// Axes of a drawing: what points right and what points up, both across the line of sight.
struct View {
    title: &'static str,
    right: Vector3<f64>,
    upward: Vector3<f64>,
}

impl PathDrawing<'_> {
    /// The two drawings.
    pub fn draw(&self) -> Vec<Markup> {
        let aside = if self.up.x.abs() < 0.9 { Vector3::x() } else { Vector3::z() };
        let right = (aside - self.up * self.up.dot(&aside)).normalize();
        let ahead = self.up.cross(&right);
        [View { title: "From above", right, upward: ahead }, View { title: "From the side", right, upward: self.up }]
            .iter()
            .map(|view| self.drawing(view))
            .collect()
    }

    /// How far the corners of a frustum are drawn from its camera: a fifth of the median distance to the middle of all.
    fn reach(&self) -> f64 {
        let count = self.frames.len().max(1) as f64;
        let middle = self.frames.iter().map(|f| f.world_from_cam.translation()).sum::<Vector3<f64>>() / count;
        let mut distances: Vec<f64> =
            self.frames.iter().map(|f| (f.world_from_cam.translation() - middle).norm()).collect();
        distances.sort_by(f64::total_cmp);
        0.2 * distances.get(distances.len() / 2).copied().unwrap_or(1.0).max(1e-6)
    }

    fn drawing(&self, view: &View) -> Markup {
        let flat = |p: &Point3<f64>| Point2::new(p.coords.dot(&view.right), p.coords.dot(&view.upward));
        let reach = self.reach();
        let frusta: Vec<(FrameId, [Point2<f64>; 5])> = self
            .frames
            .iter()
            .map(|frame| {
                let (w, h) = (self.size.width as f64 - 0.5, self.size.height as f64 - 0.5);
                let corner = |x: f64, y: f64| {
                    let p_in_cam = frame.intrinsics.cam_from_img(&Point2::new(x, y), reach);
                    flat(&(frame.world_from_cam * p_in_cam))
                };
                let apex = flat(&frame.world_from_cam.translation().into());
                (frame.id, [apex, corner(-0.5, -0.5), corner(w, -0.5), corner(w, h), corner(-0.5, h)])
            })
            .collect();
        let cloud: Vec<(Point2<f64>, [u8; 3])> = self.cloud.iter().map(|(p, color)| (flat(p), *color)).collect();
        let all = frusta.iter().flat_map(|f| f.1).chain(cloud.iter().map(|c| c.0));
        let (mut low, mut high) = (Point2::new(f64::MAX, f64::MAX), Point2::new(f64::MIN, f64::MIN));
        for p in all {
            (low, high) = (low.inf(&p), high.sup(&p));
        }
        let extent = high - low;
        let scale = ((WIDTH - 2.0 * MARGIN) / extent.x.max(1e-9)).min((HEIGHT - 2.0 * MARGIN) / extent.y.max(1e-9));
        let middle = nalgebra::center(&low, &high);
        let place = |p: &Point2<f64>| (0.5 * WIDTH + (p.x - middle.x) * scale, 0.5 * HEIGHT - (p.y - middle.y) * scale);
        let colors = heat_colors(&(0..frusta.len()).map(|i| i as f64).collect::<Vec<_>>(), 0.0, frusta.len() as f64);
        let path: String = frusta
            .iter()
            .enumerate()
            .map(|(i, (_, corners))| {
                let (x, y) = place(&corners[0]);
                format!("{}{x:.1} {y:.1}", if i == 0 { "M" } else { "L" })
            })
            .collect();
        let ruler = nice_step(1.5 * (WIDTH / scale));
        let length = if self.metric { metres(ruler) } else { format!("{ruler} (arbitrary scale)") };
        html! {
            figure.chart {
                svg viewBox=(format!("0 0 {WIDTH} {HEIGHT}")) role="img" aria-label=(view.title) {
                    @for (p, [r, g, b]) in &cloud {
                        @let (x, y) = place(p);
                        path.cloud d=(format!("M{x:.1} {y:.1}h0")) stroke=(format!("#{r:02x}{g:02x}{b:02x}")) {}
                    }
                    path.path d=(path) {}
                    @for ((id, corners), [r, g, b]) in frusta.iter().zip(&colors) {
                        @let flagged = self.flagged.contains(id);
                        path class=(if flagged { "frustum flagged" } else { "frustum" })
                            d=(frustum(&corners.map(|c| place(&c)))) stroke=(format!("rgb({r},{g},{b})")) {
                            title { (format!("frame {id}")) }
                        }
                    }
                    line.ruler x1=(MARGIN) x2=(format!("{:.1}", MARGIN + ruler * scale)) y1=(HEIGHT - 14.0) y2=(HEIGHT - 14.0) {}
                    text.label x=(format!("{:.1}", MARGIN + ruler * scale + 8.0)) y=(HEIGHT - 10.0) { (length) }
                }
                figcaption { strong { (view.title) } }
            }
        }
    }
}

/// Four edges from the apex and the rectangle of the photograph.
fn frustum([apex, a, b, c, d]: &[(f64, f64); 5]) -> String {
    let mut path = format!("M{:.1} {:.1}L{:.1} {:.1}", a.0, a.1, b.0, b.1);
    for p in [c, d, a] {
        path += &format!("L{:.1} {:.1}", p.0, p.1);
    }
    for p in [a, b, c, d] {
        path += &format!("M{:.1} {:.1}L{:.1} {:.1}", apex.0, apex.1, p.0, p.1);
    }
    path
}

/// A length in the unit that suits it.
fn metres(length: f64) -> String {
    match length {
        l if l < 0.01 => format!("{:.1} mm", l * 1e3),
        l if l < 1.0 => format!("{:.0} cm", l * 1e2),
        l => format!("{l:.0} m"),
    }
}
