//! Where two black and two white squares meet, to a few hundredths of a pixel.

use mb_image::Image;
use nalgebra::{Matrix2, Point2, SMatrix, SVector, Vector2};

use crate::sample::bilinear;

/// What a corner is expected to look like.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Expected {
    /// Where it should be.
    pub pixel: Point2<f64>,
    /// Pixels a square along the board's x (first column) and y (second column).
    pub axes: Matrix2<f64>,
    /// White between a marker and the side of its square, in squares.
    pub margin: f64,
    /// Whether the square towards -x -y is black.
    pub is_black_first: bool,
}

/// A corner that was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Found {
    pub pixel: Point2<f64>,
    /// Width of the edges (of `tanh(distance / width)`), pixels.
    pub width_px: f64,
    /// Standard deviation along an axis from the fit's residuals, pixels.
    pub std_px: f64,
}

/// Half of the window in squares; beyond it lies the next corner.
const REACH: f64 = 0.45;
/// Half of the window in pixels at most: edges bend with the lens.
const MOST_PX: f64 = 14.0;
/// Pixels further from an edge than this many widths say nothing of where it is.
const NEAR_WIDTHS: f64 = 2.2;
/// Least contrast of black and white, of 255: below it there is no corner.
const FAINTEST: f64 = 4.0;

/// Brightness around a corner: two edges that cross, each a smooth step, on a slope of light.
///
/// `I = level + step tanh(d1 / width) tanh(d2 / width) + slope . (p - center)`, `d_i` the distance from line `i` through
/// the center with normal `(cos angle_i, sin angle_i)`.
#[derive(Debug, Clone, Copy)]
struct Model {
    /// center x, y; angles 1, 2; width; level; step; slope x, y.
    p: SVector<f64, 9>,
}

impl Model {
    /// Brightness at a pixel, and its derivative by the parameters.
    fn at(&self, pixel: &Vector2<f64>) -> (f64, SVector<f64, 9>) {
        let [x, y, angle1, angle2, width, level, step, slope_x, slope_y] = self.p.data.0[0];
        let (dx, dy) = (pixel.x - x, pixel.y - y);
        let side = |angle: f64| {
            let (sin, cos) = angle.sin_cos();
            let distance = cos * dx + sin * dy;
            let t = (distance / width).tanh();
            // Value, slope by distance, distance, its derivative by the angle, normal.
            (t, (1.0 - t * t) / width, distance, cos * dy - sin * dx, cos, sin)
        };
        let (t1, s1, d1, turn1, c1, n1) = side(angle1);
        let (t2, s2, d2, turn2, c2, n2) = side(angle2);
        let value = level + step * t1 * t2 + slope_x * dx + slope_y * dy;
        let slope = SVector::<f64, 9>::from([
            -step * (s1 * c1 * t2 + t1 * s2 * c2) - slope_x,
            -step * (s1 * n1 * t2 + t1 * s2 * n2) - slope_y,
            step * s1 * turn1 * t2,
            step * t1 * s2 * turn2,
            -step * (s1 * d1 * t2 + t1 * s2 * d2) / width,
            1.0,
            t1 * t2,
            dx,
            dy,
        ]);
        (value, slope)
    }
}

impl Model {
    /// The pixels that lie within a few widths of either edge.
    fn near_edges(&self, pixels: &[(Vector2<f64>, f64)], shortest: f64) -> Vec<(Vector2<f64>, f64)> {
        let [x, y, angle1, angle2, width, ..] = self.p.data.0[0];
        let reach = (NEAR_WIDTHS * width).clamp(1.5, 0.2 * shortest.max(8.0));
        let off = |p: &Vector2<f64>, angle: f64| (angle.cos() * (p.x - x) + angle.sin() * (p.y - y)).abs();
        pixels.iter().copied().filter(|(p, _)| off(p, angle1).min(off(p, angle2)) < reach).collect()
    }
}

/// Finds the corner that is expected, or tells that it is not there (hidden, outside, too blurred).
pub(crate) fn find_corner(image: &Image<u8>, expected: &Expected, search: f64) -> Option<Found> {
    let (along_x, along_y) = (expected.axes.column(0).into_owned(), expected.axes.column(1).into_owned());
    let shortest = along_x.norm().min(along_y.norm());
    if shortest < 5.0 || along_x.perp(&along_y).abs() < 0.15 * along_x.norm() * along_y.norm() {
        return None;
    }
    let start = coarse(image, expected, search)?;
    let from_pixel = expected.axes.try_inverse()?;
    // Pixels near the two edges, out of reach of markers and of the next corners.
    let reach = MOST_PX.min(REACH * along_x.norm().max(along_y.norm())).ceil() as i64;
    let band = (0.85 * expected.margin).max(1.3 / shortest);
    let (x0, y0) = (start.x.round() as i64, start.y.round() as i64);
    let mut pixels: Vec<(Vector2<f64>, f64)> = Vec::new();
    for y in y0 - reach..=y0 + reach {
        for x in x0 - reach..=x0 + reach {
            let Some(&value) = usize::try_from(x).ok().zip(usize::try_from(y).ok()).and_then(|(x, y)| image.get(x, y))
            else {
                continue;
            };
            let p = Vector2::new(x as f64, y as f64);
            let uv = from_pixel * (p - start.coords);
            if uv.amax() <= REACH && uv.x.abs().min(uv.y.abs()) <= band {
                pixels.push((p, f64::from(value)));
            }
        }
    }
    if pixels.len() < 20 {
        return None;
    }
    let mean = pixels.iter().map(|(_, v)| v).sum::<f64>() / pixels.len() as f64;
    let spread = (pixels.iter().map(|(_, v)| (v - mean).powi(2)).sum::<f64>() / pixels.len() as f64).sqrt();
    let sign = if expected.is_black_first { -1.0 } else { 1.0 };
    // Normals that point to +x and +y of the board.
    let orient = |along: Vector2<f64>, towards: Vector2<f64>| {
        let normal = Vector2::new(along.y, -along.x);
        let normal = if normal.dot(&towards) < 0.0 { -normal } else { normal };
        normal.y.atan2(normal.x)
    };
    let angles = [orient(along_y, along_x), orient(along_x, along_y)];
    let width = 1.2f64.min(0.15 * shortest);
    let p = SVector::from([start.x, start.y, angles[0], angles[1], width, mean, sign * spread, 0.0, 0.0]);
    let (rough, ..) = fit(Model { p }, &pixels)?;
    // Once more with the pixels that the edges pass through: what lies beyond them (a marker, a frame, uneven ink) is no
    // matter of the corner.
    let near = rough.near_edges(&pixels, shortest);
    if near.len() < 20 {
        return None;
    }
    let (model, cost, covariance) = fit(rough, &near)?;
    let pixels = near;

    let [x, y, angle1, angle2, width, _, step, ..] = model.p.data.0[0];
    let pixel = Point2::new(x, y);
    let turned = (angle1 - angles[0]).abs().max((angle2 - angles[1]).abs());
    let variance = cost / pixels.len() as f64;
    let moved = from_pixel * (pixel - expected.pixel);
    let is_there = step * sign > FAINTEST
        && turned < 0.25
        && width < 0.35 * shortest
        && variance.sqrt() < 0.45 * step.abs()
        && moved.amax() < search + 0.05;
    let std_px = (variance * 0.5 * (covariance[(0, 0)] + covariance[(1, 1)])).sqrt();
    (is_there && std_px < 0.5).then_some(Found { pixel, width_px: width, std_px })
}

/// The pixel near the expected place around which opposite squares are most alike and neighbouring ones most different.
fn coarse(image: &Image<u8>, expected: &Expected, search: f64) -> Option<Point2<f64>> {
    let sign = if expected.is_black_first { -1.0 } else { 1.0 };
    let (e1, e2) = (expected.axes.column(0).into_owned(), expected.axes.column(1).into_owned());
    let shortest = e1.norm().min(e2.norm());
    // In the squares' corners, clear of the markers where they leave room, and at least over a pixel from the edges.
    let steps = [0.5, 1.0].map(|share: f64| (share * expected.margin.max(0.08)).max(1.2 * share.max(0.7) / shortest));
    let response = |p: &Point2<f64>| -> Option<f32> {
        let mut sum = 0.0;
        for step in steps {
            let (with, across) = ((e1 + e2) * step, (e1 - e2) * step);
            sum += bilinear(image, &(p + with))? + bilinear(image, &(p - with))?;
            sum -= bilinear(image, &(p + across))? + bilinear(image, &(p - across))?;
        }
        Some(sum * sign as f32)
    };
    let radius = (search * e1.norm().max(e2.norm())).ceil().max(2.0) as i64;
    let from_pixel = expected.axes.try_inverse()?;
    let mut best: Option<(f32, Point2<f64>)> = None;
    for dy in -radius..=radius {
        for dx in -radius..=radius {
            let offset = Vector2::new(dx as f64, dy as f64);
            let away = (from_pixel * offset).amax();
            if away > search && offset.amax() > 1.0 {
                continue;
            }
            let p = expected.pixel + offset;
            let Some(strength) = response(&p) else { continue };
            // Of a plateau the middle: further off counts a little less.
            let strength = strength * (1.0 - 0.5 * away as f32);
            if best.is_none_or(|(most, _)| strength > most) {
                best = Some((strength, p));
            }
        }
    }
    best.filter(|(strength, _)| f64::from(*strength) > 4.0 * FAINTEST).map(|(_, p)| p)
}

/// Levenberg-Marquardt. Returns the model, its squared residuals, and the inverse of the normal equations.
fn fit(mut model: Model, pixels: &[(Vector2<f64>, f64)]) -> Option<(Model, f64, SMatrix<f64, 9, 9>)> {
    let cost = |model: &Model| pixels.iter().map(|(p, v)| (v - model.at(p).0).powi(2)).sum::<f64>();
    let mut current = cost(&model);
    let mut damping = 1e-3;
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for _ in 0..30 {
        normal = SMatrix::zeros();
        let mut right = SVector::<f64, 9>::zeros();
        for (p, v) in pixels {
            let (value, slope) = model.at(p);
            normal += slope * slope.transpose();
            right += slope * (v - value);
        }
        let mut improved = None;
        for _ in 0..6 {
            let mut damped = normal;
            for i in 0..9 {
                damped[(i, i)] *= 1.0 + damping;
            }
            let step = damped.cholesky()?.solve(&right);
            let mut next = Model { p: model.p + step };
            next.p[4] = next.p[4].clamp(0.3, 30.0);
            let after = cost(&next);
            if after < current {
                improved = Some((next, after, step));
                damping = (damping * 0.2).max(1e-9);
                break;
            }
            damping *= 10.0;
        }
        let Some((next, after, step)) = improved else { break };
        model = next;
        let gain = current - after;
        current = after;
        if step.fixed_rows::<2>(0).norm() < 1e-4 || gain < 1e-9 * current {
            break;
        }
    }
    Some((model, current, normal.try_inverse()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::ImageSize;

    fn drawn(model: &Model) -> Image<u8> {
        Image::from_fn(ImageSize::new(60, 60), |x, y| {
            model.at(&Vector2::new(x as f64, y as f64)).0.round().clamp(0.0, 255.0) as u8
        })
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        let model = Model { p: SVector::from([30.2, 29.7, 0.2, 1.5, 1.4, 120.0, -70.0, 0.5, -0.3]) };
        for pixel in [Vector2::new(31.0, 28.0), Vector2::new(25.0, 36.0), Vector2::new(30.0, 30.0)] {
            let (_, slope) = model.at(&pixel);
            for i in 0..9 {
                let step = 1e-6 * model.p[i].abs().max(1.0);
                let moved = |by: f64| {
                    let mut p = model.p;
                    p[i] += by;
                    Model { p }.at(&pixel).0
                };
                let difference = (moved(step) - moved(-step)) / (2.0 * step);
                assert!(
                    (difference - slope[i]).abs() < 1e-4 * slope[i].abs().max(1.0),
                    "parameter {i}: {difference} {}",
                    slope[i]
                );
            }
        }
    }

    #[test]
    fn a_corner_is_found_to_a_hundredth_of_a_pixel_under_slopes_of_light() {
        for (x, y, a1, a2) in [(30.2, 29.7, 0.2, 1.5), (29.5, 30.5, -0.6, 1.2), (30.0, 30.0, 2.5, -2.3)] {
            let truth = Model { p: SVector::from([x, y, a1, a2, 1.3, 120.0, -60.0, 0.8, -0.5]) };
            let (e1, e2) = {
                // Board axes along the lines, oriented so that the normals point along them.
                let (n1, n2) = (Vector2::new(f64::cos(a1), f64::sin(a1)), Vector2::new(f64::cos(a2), f64::sin(a2)));
                let (along1, along2) = (Vector2::new(-n2.y, n2.x), Vector2::new(-n1.y, n1.x));
                (along1 * along1.dot(&n1).signum() * 24.0, along2 * along2.dot(&n2).signum() * 24.0)
            };
            let expected = Expected {
                pixel: Point2::new(x + 1.7, y - 1.2),
                axes: Matrix2::from_columns(&[e1, e2]),
                margin: 0.2,
                is_black_first: true,
            };
            let found = find_corner(&drawn(&truth), &expected, 0.2).expect("the corner is there");
            assert!((found.pixel - Point2::new(x, y)).norm() < 0.01, "{found:?}");
            assert!((found.width_px - 1.3).abs() < 0.05, "{found:?}");
            let inverted = Expected { is_black_first: false, ..expected };
            assert_eq!(find_corner(&drawn(&truth), &inverted, 0.1), None, "of the other colour");
        }
    }

    #[test]
    fn an_edge_and_an_even_surface_have_no_corner() {
        let expected = Expected {
            pixel: Point2::new(30.0, 30.0),
            axes: Matrix2::new(20.0, 0.0, 0.0, 20.0),
            margin: 0.2,
            is_black_first: true,
        };
        for image in [
            Image::filled(ImageSize::new(60, 60), 100),
            Image::from_fn(ImageSize::new(60, 60), |x, _| if x < 30 { 40 } else { 200 }),
            Image::from_fn(ImageSize::new(60, 60), |x, y| if x < 30 && y < 30 { 40 } else { 200 }),
        ] {
            assert_eq!(find_corner(&image, &expected, 0.2), None);
        }
    }
}
