//! Where a photograph has edges along a line across a predicted one.

use std::sync::LazyLock;

use mb_geometry::ImageSize;
use mb_image::{Image, RgbImage};
use nalgebra::{Point2, Vector2};

use crate::model_edges::EdgeKind;

/// The photograph, and its halvings by averages of 2x2 pixels.
pub(crate) struct Pyramid {
    levels: Vec<RgbImage>,
}

impl Pyramid {
    /// With levels 0 (the photograph) to `coarsest`.
    pub fn new(photograph: RgbImage, coarsest: usize) -> Self {
        let mut levels = vec![photograph];
        for _ in 0..coarsest {
            let Some(finer) = levels.last() else { break };
            let size = ImageSize::new(finer.width() / 2, finer.height() / 2);
            levels.push(Image::from_fn(size, |x, y| {
                let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| finer[(2 * x + dx, 2 * y + dy)]);
                std::array::from_fn(|c| ((four.iter().map(|p| u16::from(p[c])).sum::<u16>() + 2) / 4) as u8)
            }));
        }
        Self { levels }
    }

    pub fn level(&self, level: usize) -> &RgbImage {
        &self.levels[level]
    }
}

/// Edges found across a predicted one: signed distances along the normal, pixels, strongest first.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Candidates {
    offsets_px: [f64; Candidates::MOST],
    count: usize,
}

impl Candidates {
    /// How many edges are kept.
    const MOST: usize = 4;

    pub fn as_slice(&self) -> &[f64] {
        &self.offsets_px[..self.count]
    }
}

/// Longest search on either side, pixels.
pub(crate) const MAX_RANGE_PX: usize = 12;
/// Change of encoded colour per pixel (Euclidean over the 8-bit channels) below which there is no edge.
const FAINTEST: f32 = 3.0;

/// Looks for edges within `range_px` (at most [`MAX_RANGE_PX`]) of `pixel` along `normal`.
///
/// The profile is the average of three lines beside each other; an edge is a local maximum of its derivative's length,
/// placed by a parabola through the maximum and its neighbours. It is placed in linear light, because that is what a
/// lens blurs: in encoded colours the steepest place of an edge lies up to a quarter of a pixel on its dark side, which
/// shrinks bright objects and moves them away. Whether it is an edge at all is judged in encoded colours, where a step
/// is as visible in the shade as in the sun: at least a quarter as strong as the strongest.
pub(crate) fn candidates(
    image: &RgbImage,
    pixel: &Point2<f64>,
    normal: &Vector2<f64>,
    range_px: usize,
    kind: EdgeKind,
) -> Candidates {
    const LONGEST: usize = 2 * MAX_RANGE_PX + 5;
    let range = range_px.min(MAX_RANGE_PX);
    let count = 2 * range + 5;
    let start = -(range as f64) - 2.0;
    let tangent = Vector2::new(-normal.y, normal.x);
    let mut light = [[0.0f32; 3]; LONGEST];
    for (i, light) in light[..count].iter_mut().enumerate() {
        for beside in [-1.0, 0.0, 1.0] {
            let q = pixel + normal * (start + i as f64) + tangent * beside;
            let Some(sampled) = bilinear_light(image, &q) else { return Candidates::default() };
            for c in 0..3 {
                light[c] += sampled[c] / 3.0;
            }
        }
    }
    let encoded = light.map(|l| l.map(|v| 255.0 * v.sqrt()));
    let slope = |profile: &[[f32; 3]; LONGEST], i: usize| -> [f32; 3] {
        std::array::from_fn(|c| 0.5 * (profile[i + 1][c] - profile[i - 1][c]))
    };
    let steepness = |d: [f32; 3]| (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
    let (mut strength, mut visible) = ([0.0f32; LONGEST], [0.0f32; LONGEST]);
    let mut strongest = 0.0f32;
    for i in 1..count - 1 {
        (strength[i], visible[i]) = (steepness(slope(&light, i)), steepness(slope(&encoded, i)));
        strongest = strongest.max(visible[i]);
    }
    let faintest = FAINTEST.max(0.25 * strongest);
    let mut steps: Vec<Step> = Vec::new();
    for i in 2..count - 2 {
        let (before, here, after) = (strength[i - 1], strength[i], strength[i + 1]);
        if visible[i] >= faintest && here > before && here >= after {
            let curvature = before - 2.0 * here + after;
            let shift = if curvature < 0.0 { 0.5 * (before - after) / curvature } else { 0.0 };
            let brighter = slope(&light, i).iter().sum::<f32>() > 0.0;
            steps.push(Step { at: start + i as f64 + f64::from(shift), visible: visible[i], brighter });
        }
    }
    // A line is the middle between a step and the one back.
    let lines = |dark: bool| {
        steps
            .windows(2)
            .filter(move |w| {
                w[0].brighter != w[1].brighter && w[1].brighter == dark && w[1].at - w[0].at < WIDEST_LINE_PX
            })
            .map(|w| (w[0].visible.min(w[1].visible), 0.5 * (w[0].at + w[1].at)))
    };
    let as_steps = || steps.iter().map(|s| (s.visible, s.at));
    let mut found: Vec<(f32, f64)> = match kind {
        EdgeKind::Silhouette | EdgeKind::Contour => as_steps().collect(),
        EdgeKind::Seam => {
            let dark: Vec<_> = lines(true).collect();
            if dark.is_empty() { as_steps().collect() } else { dark }
        }
        EdgeKind::Crease => lines(false).chain(as_steps()).collect(),
    };
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut candidates = Candidates::default();
    for (slot, (_, offset)) in candidates.offsets_px.iter_mut().zip(&found) {
        *slot = *offset;
        candidates.count += 1;
    }
    candidates
}

/// A place where the profile is steepest.
struct Step {
    at: f64,
    /// How steep, in encoded colours.
    visible: f32,
    /// Whether the profile gets brighter there.
    brighter: bool,
}

/// Farthest apart that the two sides of a line are, pixels.
const WIDEST_LINE_PX: f64 = 4.0;

/// Light, 1 = white, of an sRGB byte (IEC 61966-2-1).
static LIGHT: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|byte| {
        let v = byte as f32 / 255.0;
        if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    })
});

/// The light between pixels; `None` outside.
fn bilinear_light(image: &RgbImage, q: &Point2<f64>) -> Option<[f32; 3]> {
    let (x, y) = (q.x.floor(), q.y.floor());
    if x < 0.0 || y < 0.0 || x + 1.0 >= image.width() as f64 || y + 1.0 >= image.height() as f64 {
        return None;
    }
    let (u, v) = ((q.x - x) as f32, (q.y - y) as f32);
    let (x, y) = (x as usize, y as usize);
    let (top, bottom) = (&image.row(y)[x..x + 2], &image.row(y + 1)[x..x + 2]);
    let light = &*LIGHT;
    Some(std::array::from_fn(|c| {
        let mix = |a: u8, b: u8| light[a as usize] + u * (light[b as usize] - light[a as usize]);
        let (above, below) = (mix(top[0][c], top[1][c]), mix(bottom[0][c], bottom[1][c]));
        above + v * (below - above)
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A soft edge whose middle lies on the line `n . q = at`.
    fn edge(n: Vector2<f64>, at: f64) -> RgbImage {
        Image::from_fn(ImageSize::new(64, 64), |x, y| {
            let d = n.dot(&Vector2::new(x as f64, y as f64)) - at;
            // Soft in light, stored as sRGB: dark green to bright orange.
            let share = 0.5 + 0.5 * (d / 0.8).tanh();
            let encode = |light: f64| (255.0 * (1.055 * light.powf(1.0 / 2.4) - 0.055)).round() as u8;
            [encode(0.02 + 0.6 * share), encode(0.1 + 0.2 * share), encode(0.03)]
        })
    }

    #[test]
    fn an_edge_is_found_to_a_twentieth_of_a_pixel() {
        for angle in [0.0, 0.4, 1.2, 2.0] {
            let n = Vector2::new(f64::cos(angle), f64::sin(angle));
            let middle = Point2::new(32.0, 32.0);
            for shift in [-3.3, -0.6, 0.0, 0.25, 4.1] {
                let image = edge(n, n.dot(&middle.coords) + shift);
                let found = candidates(&image, &middle, &n, 6, EdgeKind::Contour);
                assert_eq!(found.as_slice().len(), 1, "angle {angle}, shift {shift}: {found:?}");
                assert!((found.as_slice()[0] - shift).abs() < 0.05, "{found:?} is not {shift}");
            }
        }
    }

    #[test]
    fn an_even_surface_has_no_edge_and_the_border_is_not_one() {
        let even = Image::filled(ImageSize::new(64, 64), [90, 90, 90]);
        assert!(candidates(&even, &Point2::new(32.0, 32.0), &Vector2::x(), 8, EdgeKind::Contour).as_slice().is_empty());
        let sharp = edge(Vector2::x(), 3.0);
        assert!(candidates(&sharp, &Point2::new(3.0, 32.0), &Vector2::x(), 8, EdgeKind::Contour).as_slice().is_empty());
    }

    #[test]
    fn halving_averages_and_keeps_an_even_image() {
        let pyramid = Pyramid::new(Image::filled(ImageSize::new(9, 6), [7, 100, 255]), 2);
        assert_eq!(pyramid.level(1).size(), ImageSize::new(4, 3));
        assert!(pyramid.level(2).data().iter().all(|p| *p == [7, 100, 255]));
    }
}
