//! Scale-invariant features of photographs: Lowe's detector and descriptor.

use mb_image::RgbImage;
use nalgebra::{Matrix3, Point2, Vector3};

use crate::scale_space::{Octave, Plane, base_plane, next_octave};

/// How [`detect_features`] works. The defaults are Lowe's.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureOptions {
    /// Whether to start from the photograph at twice its size, which finds features as small as two pixels.
    pub upsample: bool,
    /// Least difference of Gaussians at a feature, as a share of full brightness.
    pub contrast: f32,
    /// Largest ratio of the principal curvatures; beyond it a feature is an edge.
    pub edge_ratio: f32,
    /// Features kept, the most contrasted ones; 0 keeps all.
    pub most: usize,
}

impl Default for FeatureOptions {
    fn default() -> Self {
        Self { upsample: true, contrast: 0.04 / 3.0, edge_ratio: 10.0, most: 0 }
    }
}

/// One feature.
#[derive(Debug, Clone, PartialEq)]
pub struct Feature {
    /// Where: pixel (x, y), pixel centres at integers.
    pub pixel: Point2<f64>,
    /// Standard deviation of the Gaussian that the feature is brightest under, pixels.
    pub scale_px: f64,
    /// Direction of the strongest gradient, radians from x towards y, in [0, 2 pi).
    pub angle_rad: f64,
    /// Difference of Gaussians, as a share of full brightness.
    pub contrast: f64,
    /// 4 x 4 places of 8 directions, row by row, square-rooted (Arandjelovic and Zisserman 2012) so that Euclidean
    /// distance compares histograms; length about 255.
    pub descriptor: [u8; 128],
}

/// Finds features (Lowe, "Distinctive Image Features from Scale-Invariant Keypoints", IJCV 2004), strongest first.
pub fn detect_features(photograph: &RgbImage, options: &FeatureOptions) -> Vec<Feature> {
    let grey = Plane::from_rgb(photograph);
    if grey.width < 8 || grey.height < 8 {
        return Vec::new();
    }
    let mut octave = Some(base_plane(&grey, options.upsample));
    // Pixels of the photograph per pixel of the octave.
    let mut pixel_size = if options.upsample { 0.5 } else { 1.0 };
    let mut features = Vec::new();
    while let Some(base) = octave {
        let scales = Octave::new(base);
        let mut found = extrema(&scales, options);
        if options.most > 0 {
            // Those that enough others of their own octave outdo are not kept anyway, and need no description.
            found.sort_by(|a, b| b.contrast.total_cmp(&a.contrast));
            found.truncate(options.most);
        }
        for extremum in found {
            for angle in orientations(&scales, &extremum) {
                features.push(describe(&scales, &extremum, angle, pixel_size));
            }
        }
        octave = next_octave(&scales);
        pixel_size *= 2.0;
    }
    features.sort_by(|a, b| {
        let place = |f: &Feature| (f.pixel.y, f.pixel.x, f.angle_rad);
        let (a_at, b_at) = (place(a), place(b));
        b.contrast
            .total_cmp(&a.contrast)
            .then(a_at.0.total_cmp(&b_at.0))
            .then(a_at.1.total_cmp(&b_at.1))
            .then(a_at.2.total_cmp(&b_at.2))
    });
    if options.most > 0 {
        features.truncate(options.most);
    }
    features
}

/// A place in scale space, in the octave's pixels.
struct Extremum {
    x: f32,
    y: f32,
    /// Index of the Gaussian plane, with its fraction.
    scale: f32,
    contrast: f32,
}

/// Pixels at the border where no neighbourhood is complete.
const BORDER: usize = 5;

fn extrema(octave: &Octave, options: &FeatureOptions) -> Vec<Extremum> {
    let mut found = Vec::new();
    let (width, height) = (octave.planes[0].width, octave.planes[0].height);
    if width <= 2 * BORDER || height <= 2 * BORDER {
        return found;
    }
    let threshold = 0.5 * options.contrast;
    for s in 1..=Octave::SCALES {
        for y in BORDER..height - BORDER {
            let (lower, upper) = (octave.planes[s].row(y), octave.planes[s + 1].row(y));
            for x in BORDER..width - BORDER {
                let value = upper[x] - lower[x];
                if value.abs() > threshold
                    && is_extremum(octave, s, x, y, value)
                    && let Some(extremum) = locate(octave, s, x, y, options)
                {
                    found.push(extremum);
                }
            }
        }
    }
    found
}

fn is_extremum(octave: &Octave, s: usize, x: usize, y: usize, value: f32) -> bool {
    let sign = value.signum();
    // Its own plane first: most candidates fail there.
    [s, s - 1, s + 1].into_iter().all(|layer| {
        (y - 1..=y + 1).all(|v| {
            (x - 1..=x + 1).all(|u| (layer, v, u) == (s, y, x) || sign * octave.dog(layer, u, v) <= sign * value)
        })
    })
}

/// The extremum of the quadratic through the neighbourhood (Brown and Lowe 2002), moved to a neighbour while it lies
/// beyond half a pixel.
fn locate(octave: &Octave, s: usize, x: usize, y: usize, options: &FeatureOptions) -> Option<Extremum> {
    let (width, height) = (octave.planes[0].width, octave.planes[0].height);
    let (mut s, mut x, mut y) = (s, x, y);
    for _ in 0..5 {
        let d = |ds: isize, dx: isize, dy: isize| {
            octave.dog(s.wrapping_add_signed(ds), x.wrapping_add_signed(dx), y.wrapping_add_signed(dy))
        };
        let gradient = Vector3::new(
            0.5 * (d(0, 1, 0) - d(0, -1, 0)),
            0.5 * (d(0, 0, 1) - d(0, 0, -1)),
            0.5 * (d(1, 0, 0) - d(-1, 0, 0)),
        );
        let here = d(0, 0, 0);
        let xx = d(0, 1, 0) + d(0, -1, 0) - 2.0 * here;
        let yy = d(0, 0, 1) + d(0, 0, -1) - 2.0 * here;
        let ss = d(1, 0, 0) + d(-1, 0, 0) - 2.0 * here;
        let xy = 0.25 * (d(0, 1, 1) - d(0, -1, 1) - d(0, 1, -1) + d(0, -1, -1));
        let xs = 0.25 * (d(1, 1, 0) - d(1, -1, 0) - d(-1, 1, 0) + d(-1, -1, 0));
        let ys = 0.25 * (d(1, 0, 1) - d(1, 0, -1) - d(-1, 0, 1) + d(-1, 0, -1));
        let hessian = Matrix3::new(xx, xy, xs, xy, yy, ys, xs, ys, ss);
        let offset = -(hessian.try_inverse()? * gradient);
        if !offset.iter().all(|v| v.abs() < 1e3) {
            return None;
        }
        if offset.amax() < 0.5 {
            let contrast = here + 0.5 * gradient.dot(&offset);
            let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
            let r = options.edge_ratio;
            if contrast.abs() < options.contrast
                || determinant <= 0.0
                || trace * trace * r >= (r + 1.0).powi(2) * determinant
            {
                return None;
            }
            return Some(Extremum {
                x: x as f32 + offset.x,
                y: y as f32 + offset.y,
                scale: s as f32 + offset.z,
                contrast: contrast.abs(),
            });
        }
        let moved = |v: usize, by: f32| v.saturating_add_signed(by.round() as isize);
        (x, y, s) = (moved(x, offset.x), moved(y, offset.y), moved(s, offset.z));
        let inside = |v: usize, count: usize| v >= BORDER && v < count - BORDER;
        if !inside(x, width) || !inside(y, height) || !(1..=Octave::SCALES).contains(&s) {
            return None;
        }
    }
    None
}

/// Peaks of the histogram of gradient directions round the extremum that reach 80 % of the highest.
fn orientations(octave: &Octave, e: &Extremum) -> Vec<f32> {
    const BINS: usize = 36;
    let sigma = 1.5 * octave.sigma(e.scale);
    let radius = (3.0 * sigma).round() as isize;
    let plane = octave.nearest_plane(e.scale);
    let mut histogram = [0.0f32; BINS];
    let window = window(radius, 0.0, sigma);
    for (dy, down) in (-radius..=radius).zip(&window) {
        for (dx, across) in (-radius..=radius).zip(&window) {
            let Some((gx, gy)) = plane.gradient(e.x.round() as isize + dx, e.y.round() as isize + dy) else { continue };
            let weight = across * down;
            let angle = direction(gx, gy);
            let bin = (angle / std::f32::consts::TAU * BINS as f32).round() as usize % BINS;
            histogram[bin] += weight * (gx * gx + gy * gy).sqrt();
        }
    }
    let at = |i: isize| histogram[i.rem_euclid(BINS as isize) as usize];
    let smooth: [f32; BINS] = std::array::from_fn(|i| {
        let i = i as isize;
        (at(i - 2) + at(i + 2)) / 16.0 + (at(i - 1) + at(i + 1)) * 4.0 / 16.0 + at(i) * 6.0 / 16.0
    });
    let highest = smooth.iter().copied().fold(0.0, f32::max);
    let mut angles = Vec::new();
    for i in 0..BINS {
        let (before, here, after) = (smooth[(i + BINS - 1) % BINS], smooth[i], smooth[(i + 1) % BINS]);
        if here > before && here > after && here >= 0.8 * highest {
            let shift = 0.5 * (before - after) / (before - 2.0 * here + after);
            let turn = (i as f32 + shift) / BINS as f32 * std::f32::consts::TAU;
            angles.push(turn.rem_euclid(std::f32::consts::TAU));
        }
    }
    angles
}

/// A Gaussian about `-offset` at the integers from `-radius` to `radius`: two of them make one of the plane.
fn window(radius: isize, offset: f32, sigma: f32) -> Vec<f32> {
    (-radius..=radius).map(|d| (-((d as f32 + offset) / sigma).powi(2) / 2.0).exp()).collect()
}

/// The direction of a gradient, radians from x towards y, in [0, 2 pi]; within 1e-5 of `atan2` (a minimax
/// polynomial of the arc tangent up to 45 degrees, and reflections).
fn direction(x: f32, y: f32) -> f32 {
    use std::f32::consts::{FRAC_PI_2, PI, TAU};
    const ODD: [f32; 6] = [0.999_977_26, -0.332_623_47, 0.193_543_46, -0.116_432_87, 0.052_653_32, -0.011_721_2];
    let (ax, ay) = (x.abs(), y.abs());
    let t = ax.min(ay) / ax.max(ay).max(f32::MIN_POSITIVE);
    let angle = t * ODD.iter().rev().fold(0.0, |sum, c| sum * t * t + c);
    let angle = if ay > ax { FRAC_PI_2 - angle } else { angle };
    let angle = if x < 0.0 { PI - angle } else { angle };
    if y < 0.0 { TAU - angle } else { angle }
}

fn describe(octave: &Octave, e: &Extremum, angle: f32, pixel_size: f64) -> Feature {
    const CELLS: usize = 4;
    const DIRECTIONS: usize = 8;
    let plane = octave.nearest_plane(e.scale);
    let cell_px = 3.0 * octave.sigma(e.scale);
    let radius = (cell_px * std::f32::consts::SQRT_2 * (CELLS as f32 + 1.0) * 0.5).round() as isize;
    let (sin, cos) = angle.sin_cos();
    let (column, row) = (e.x.round() as isize, e.y.round() as isize);
    // One cell of margin on every side takes what falls outside.
    let mut cells = [[[0.0f32; DIRECTIONS]; CELLS + 2]; CELLS + 2];
    // A Gaussian as wide as half of all cells (turning does not change it).
    let sigma = 0.5 * CELLS as f32 * cell_px;
    let (left, above) = (column as f32 - e.x, row as f32 - e.y);
    let (window_x, window_y) = (window(radius, left, sigma), window(radius, above, sigma));
    for (dy, weight_y) in (-radius..=radius).zip(&window_y) {
        for (dx, weight_x) in (-radius..=radius).zip(&window_x) {
            let (px, py) = (dx as f32 + left, dy as f32 + above);
            let u = (cos * px + sin * py) / cell_px;
            let v = (cos * py - sin * px) / cell_px;
            let (across, down) = (u + CELLS as f32 / 2.0 - 0.5, v + CELLS as f32 / 2.0 - 0.5);
            let limit = CELLS as f32;
            if across <= -1.0 || across >= limit || down <= -1.0 || down >= limit {
                continue;
            }
            let Some((gx, gy)) = plane.gradient(column + dx, row + dy) else { continue };
            let weight = weight_x * weight_y * (gx * gx + gy * gy).sqrt();
            let turn = direction(gx, gy) - angle;
            let turn = if turn < 0.0 { turn + std::f32::consts::TAU } else { turn };
            let turn = turn / std::f32::consts::TAU * DIRECTIONS as f32;
            let (c, r, o) = (across.floor(), down.floor(), turn.floor());
            let (fc, fr, fo) = (across - c, down - r, turn - o);
            for (i, row_share) in [(0, 1.0 - fr), (1, fr)] {
                for (j, column_share) in [(0, 1.0 - fc), (1, fc)] {
                    let cell = &mut cells[(r as isize + 1) as usize + i][(c as isize + 1) as usize + j];
                    let share = weight * row_share * column_share;
                    cell[o as usize % DIRECTIONS] += share * (1.0 - fo);
                    cell[(o as usize + 1) % DIRECTIONS] += share * fo;
                }
            }
        }
    }
    let mut values = [0.0f32; 128];
    for (i, value) in values.iter_mut().enumerate() {
        *value = cells[i / 32 + 1][i / 8 % 4 + 1][i % 8];
    }
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt().max(f32::MIN_POSITIVE);
    // No gradient counts for more than a fifth, so that changes of light do not dominate.
    values.iter_mut().for_each(|v| *v = (*v / norm).min(0.2));
    let sum = values.iter().sum::<f32>().max(f32::MIN_POSITIVE);
    let to_photograph = |v: f32| {
        // Halving keeps every second pixel, so pixel centres stay aligned; doubling puts them half a pixel apart.
        f64::from(v) * pixel_size
    };
    Feature {
        pixel: Point2::new(to_photograph(e.x), to_photograph(e.y)),
        scale_px: f64::from(octave.sigma(e.scale)) * pixel_size,
        angle_rad: f64::from(angle),
        contrast: f64::from(e.contrast),
        descriptor: values.map(|v| (255.0 * (v / sum).sqrt()).round().min(255.0) as u8),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_are_those_of_the_arc_tangent() {
        for i in 0..3600 {
            let angle = (i as f32 / 3600.0) * std::f32::consts::TAU;
            let length = 10f32.powi(i % 9 - 6);
            let (x, y) = (length * angle.cos(), length * angle.sin());
            let expected = y.atan2(x).rem_euclid(std::f32::consts::TAU);
            let off = (direction(x, y) - expected).abs();
            assert!(off.min(std::f32::consts::TAU - off) < 1e-5, "{i}: {} is not {expected}", direction(x, y));
        }
        assert_eq!(direction(0.0, 0.0), 0.0);
    }
}
