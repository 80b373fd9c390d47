//! Where a photograph has edges along a line across a predicted one.

use mb_geometry::ImageSize;
use mb_image::{Image, RgbImage};
use nalgebra::{Point2, Vector2};

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
/// Change of colour per pixel (Euclidean over the 8-bit channels) below which there is no edge.
const FAINTEST: f32 = 3.0;

/// Looks for edges within `range_px` (at most [`MAX_RANGE_PX`]) of `pixel` along `normal`.
///
/// The profile is the average of three lines beside each other; an edge is a local maximum of its derivative's length,
/// at least a quarter as strong as the strongest, placed by a parabola through the maximum and its neighbours.
pub(crate) fn candidates(image: &RgbImage, pixel: &Point2<f64>, normal: &Vector2<f64>, range_px: usize) -> Candidates {
    const LONGEST: usize = 2 * MAX_RANGE_PX + 5;
    let range = range_px.min(MAX_RANGE_PX);
    let count = 2 * range + 5;
    let start = -(range as f64) - 2.0;
    let tangent = Vector2::new(-normal.y, normal.x);
    let mut colors = [[0.0f32; 3]; LONGEST];
    for (i, color) in colors[..count].iter_mut().enumerate() {
        for beside in [-1.0, 0.0, 1.0] {
            let q = pixel + normal * (start + i as f64) + tangent * beside;
            let Some(sampled) = bilinear(image, &q) else { return Candidates::default() };
            for c in 0..3 {
                color[c] += sampled[c] / 3.0;
            }
        }
    }
    let mut strength = [0.0f32; LONGEST];
    let mut strongest = 0.0f32;
    for i in 1..count - 1 {
        let d: [f32; 3] = std::array::from_fn(|c| 0.5 * (colors[i + 1][c] - colors[i - 1][c]));
        strength[i] = (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
        strongest = strongest.max(strength[i]);
    }
    let faintest = FAINTEST.max(0.25 * strongest);
    let mut found: Vec<(f32, f64)> = Vec::new();
    for i in 2..count - 2 {
        let (before, here, after) = (strength[i - 1], strength[i], strength[i + 1]);
        if here >= faintest && here > before && here >= after {
            let curvature = before - 2.0 * here + after;
            let shift = if curvature < 0.0 { 0.5 * (before - after) / curvature } else { 0.0 };
            found.push((here, start + i as f64 + f64::from(shift)));
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut candidates = Candidates::default();
    for (slot, (_, offset)) in candidates.offsets_px.iter_mut().zip(&found) {
        *slot = *offset;
        candidates.count += 1;
    }
    candidates
}

/// The colour between pixels; `None` outside.
fn bilinear(image: &RgbImage, q: &Point2<f64>) -> Option<[f32; 3]> {
    let (x, y) = (q.x.floor(), q.y.floor());
    if x < 0.0 || y < 0.0 || x + 1.0 >= image.width() as f64 || y + 1.0 >= image.height() as f64 {
        return None;
    }
    let (u, v) = ((q.x - x) as f32, (q.y - y) as f32);
    let (x, y) = (x as usize, y as usize);
    let (top, bottom) = (&image.row(y)[x..x + 2], &image.row(y + 1)[x..x + 2]);
    Some(std::array::from_fn(|c| {
        let mix = |a: u8, b: u8| f32::from(a) + u * (f32::from(b) - f32::from(a));
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
            let v = 120.0 + 60.0 * (d / 1.2).tanh();
            [v as u8, 80, (200.0 - v / 2.0) as u8]
        })
    }

    #[test]
    fn an_edge_is_found_to_a_twentieth_of_a_pixel() {
        for angle in [0.0, 0.4, 1.2, 2.0] {
            let n = Vector2::new(f64::cos(angle), f64::sin(angle));
            let middle = Point2::new(32.0, 32.0);
            for shift in [-3.3, -0.6, 0.0, 0.25, 4.1] {
                let image = edge(n, n.dot(&middle.coords) + shift);
                let found = candidates(&image, &middle, &n, 6);
                assert_eq!(found.as_slice().len(), 1, "angle {angle}, shift {shift}: {found:?}");
                assert!((found.as_slice()[0] - shift).abs() < 0.05, "{found:?} is not {shift}");
            }
        }
    }

    #[test]
    fn an_even_surface_has_no_edge_and_the_border_is_not_one() {
        let even = Image::filled(ImageSize::new(64, 64), [90, 90, 90]);
        assert!(candidates(&even, &Point2::new(32.0, 32.0), &Vector2::x(), 8).as_slice().is_empty());
        let sharp = edge(Vector2::x(), 3.0);
        assert!(candidates(&sharp, &Point2::new(3.0, 32.0), &Vector2::x(), 8).as_slice().is_empty());
    }

    #[test]
    fn halving_averages_and_keeps_an_even_image() {
        let pyramid = Pyramid::new(Image::filled(ImageSize::new(9, 6), [7, 100, 255]), 2);
        assert_eq!(pyramid.level(1).size(), ImageSize::new(4, 3));
        assert!(pyramid.level(2).data().iter().all(|p| *p == [7, 100, 255]));
    }
}
