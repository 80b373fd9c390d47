//! Dark four-sided regions of a photograph, with corners finer than a pixel.

use mb_image::Image;
use nalgebra::{Point2, Vector2};

use crate::regions::{Region, dark_regions};
use crate::sample::bilinear;

/// Corners of a dark quadrilateral, clockwise as seen (y down).
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Quad {
    pub corners: [Point2<f64>; 4],
}

/// Shortest side that a marker can be read from, pixels.
const SHORTEST_SIDE_PX: f64 = 8.0;
/// Half sides of the windows whose mean a dark pixel stays below: for small, middling and large markers.
const WINDOWS: [usize; 3] = [4, 12, 36];

impl Quad {
    pub fn center(&self) -> Point2<f64> {
        Point2::from(self.corners.iter().fold(Vector2::zeros(), |sum, c| sum + c.coords) / 4.0)
    }

    pub fn shortest_side(&self) -> f64 {
        (0..4).map(|i| (self.corners[(i + 1) % 4] - self.corners[i]).norm()).fold(f64::INFINITY, f64::min)
    }

    fn longest_side(&self) -> f64 {
        (0..4).map(|i| (self.corners[(i + 1) % 4] - self.corners[i]).norm()).fold(0.0, f64::max)
    }

    /// Twice the area; positive where the corners are clockwise as seen.
    fn doubled_area(&self) -> f64 {
        (0..4).map(|i| self.corners[i].coords.perp(&self.corners[(i + 1) % 4].coords)).sum()
    }

    /// Whether it is convex, clockwise, and of a shape in which a marker can be read.
    fn is_plausible(&self) -> bool {
        let turns = |i: usize| {
            let (a, b, c) = (self.corners[i], self.corners[(i + 1) % 4], self.corners[(i + 2) % 4]);
            (b - a).normalize().perp(&(c - b).normalize())
        };
        let shortest = self.shortest_side();
        shortest >= SHORTEST_SIDE_PX && shortest >= 0.15 * self.longest_side() && (0..4).all(|i| turns(i) > 0.17)
    }

    fn is_like(&self, other: &Self) -> bool {
        let tolerance = 0.15 * self.shortest_side();
        let ratio = self.doubled_area() / other.doubled_area();
        (self.center() - other.center()).norm() < tolerance && (0.8..1.25).contains(&ratio)
    }
}

/// All dark quadrilaterals, each once.
pub(crate) fn find_quads(image: &Image<u8>) -> Vec<Quad> {
    let mut rough: Vec<Quad> = Vec::new();
    let mut quads: Vec<Quad> = Vec::new();
    for window in WINDOWS {
        if 2 * window + 1 > image.width().min(image.height()) {
            continue;
        }
        for region in dark_regions(image, window) {
            let Some(quad) = rough_quad(&region) else { continue };
            if rough.iter().any(|known| known.is_like(&quad)) {
                continue;
            }
            if let Some(fine) = refined(image, &quad) {
                rough.push(quad);
                if !quads.iter().any(|known| known.is_like(&fine)) {
                    quads.push(fine);
                }
            }
        }
    }
    quads
}

/// The four-sided shape of a region, if it has one.
fn rough_quad(region: &Region) -> Option<Quad> {
    let hull = convex_hull(&region.outline);
    if hull.len() < 4 {
        return None;
    }
    let area = |polygon: &[Point2<f64>]| -> f64 {
        let n = polygon.len();
        0.5 * (0..n).map(|i| polygon[i].coords.perp(&polygon[(i + 1) % n].coords)).sum::<f64>()
    };
    let whole = area(&hull);
    // Corners go one by one, the one that spans the least area first (Visvalingam and Whyatt 1993).
    let mut corners = hull;
    while corners.len() > 4 {
        let n = corners.len();
        let spanned = |i: usize| {
            let (before, here, after) = (corners[(i + n - 1) % n], corners[i], corners[(i + 1) % n]);
            (here - before).perp(&(after - here)).abs()
        };
        let least = (0..n).min_by(|&a, &b| spanned(a).total_cmp(&spanned(b)))?;
        corners.remove(least);
    }
    let quad = Quad { corners: [corners[0], corners[1], corners[2], corners[3]] };
    (quad.is_plausible() && area(&corners) > 0.8 * whole).then_some(quad)
}

/// Convex hull, clockwise as seen with y down (Andrew's monotone chain).
fn convex_hull(points: &[Point2<f64>]) -> Vec<Point2<f64>> {
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
    sorted.dedup();
    let half = |points: &mut dyn Iterator<Item = Point2<f64>>| {
        let mut chain: Vec<Point2<f64>> = Vec::new();
        for p in points {
            while let [.., a, b] = chain[..]
                && (b - a).perp(&(p - b)) <= 0.0
            {
                chain.pop();
            }
            chain.push(p);
        }
        chain.pop();
        chain
    };
    let mut hull = half(&mut sorted.iter().copied());
    hull.extend(half(&mut sorted.iter().rev().copied()));
    hull
}

/// Moves the sides onto the photograph's edges from dark inside to bright outside; `None` where a side has none.
pub(crate) fn refined(image: &Image<u8>, quad: &Quad) -> Option<Quad> {
    let mut current = *quad;
    // The first pass starts from whole pixels and looks further.
    for reach in [0.12, 0.06] {
        let mut lines = [(Point2::origin(), Vector2::zeros()); 4];
        for (i, line) in lines.iter_mut().enumerate() {
            *line = edge_line(image, &current.corners[i], &current.corners[(i + 1) % 4], reach)?;
        }
        let mut corners = [Point2::origin(); 4];
        for (i, corner) in corners.iter_mut().enumerate() {
            *corner = crossing(&lines[(i + 3) % 4], &lines[i])?;
        }
        let moved = (0..4).map(|i| (corners[i] - current.corners[i]).norm()).fold(0.0, f64::max);
        if moved > (0.25 * current.shortest_side()).max(3.0) {
            return None;
        }
        current = Quad { corners };
        if !current.is_plausible() {
            return None;
        }
    }
    Some(current)
}

/// The line (point, direction) along the edge from `a` to `b`, dark on the right as seen with y down, that is inside a
/// clockwise quadrilateral.
fn edge_line(image: &Image<u8>, a: &Point2<f64>, b: &Point2<f64>, reach: f64) -> Option<(Point2<f64>, Vector2<f64>)> {
    const MOST: usize = 48;
    let length = (b - a).norm();
    let along = (b - a) / length;
    let outward = Vector2::new(along.y, -along.x);
    let reach = (reach * length).clamp(2.0, 8.0);
    let samples = ((0.76 * length) as usize).clamp(6, MOST);
    let steps = (4.0 * reach) as usize + 3;
    let mut points = Vec::with_capacity(samples);
    let mut profile = Vec::with_capacity(steps);
    for k in 0..samples {
        let t = 0.12 + 0.76 * (k as f64 + 0.5) / samples as f64;
        let middle = a + (b - a) * t;
        let offset = |i: usize| (i as f64 - (steps - 1) as f64 / 2.0) * 0.5;
        profile.clear();
        profile.extend((0..steps).map_while(|i| bilinear(image, &(middle + outward * offset(i)))));
        if profile.len() < steps {
            continue;
        }
        // The steepest rise over one pixel, between samples by a parabola.
        let rise = |i: usize| profile[i + 1] - profile[i - 1];
        let Some(best) = (1..steps - 1).max_by(|&i, &j| rise(i).total_cmp(&rise(j))) else { continue };
        if rise(best) < 3.0 || best == 1 || best == steps - 2 {
            continue;
        }
        let (before, here, after) = (rise(best - 1), rise(best), rise(best + 1));
        let curvature = before - 2.0 * here + after;
        let shift = if curvature < 0.0 { (0.5 * (before - after) / curvature).clamp(-0.5, 0.5) } else { 0.0 };
        points.push(middle + outward * (offset(best) + 0.5 * f64::from(shift)));
    }
    if points.len() * 10 < samples * 6 {
        return None;
    }
    let mut line = line_through(&points)?;
    for limit in [1.5, 0.75] {
        let off = |p: &Point2<f64>| (p - line.0).perp(&line.1).abs();
        let kept: Vec<Point2<f64>> = points.iter().copied().filter(|p| off(p) < limit).collect();
        if kept.len() * 2 < samples {
            return None;
        }
        line = line_through(&kept)?;
    }
    Some(line)
}

/// The line of least squared distances.
fn line_through(points: &[Point2<f64>]) -> Option<(Point2<f64>, Vector2<f64>)> {
    let n = points.len() as f64;
    let mean = points.iter().fold(Vector2::zeros(), |sum, p| sum + p.coords) / n;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for p in points {
        let d = p.coords - mean;
        (xx, xy, yy) = (xx + d.x * d.x, xy + d.x * d.y, yy + d.y * d.y);
    }
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    (xx + yy > 0.0).then(|| (Point2::from(mean), Vector2::new(angle.cos(), angle.sin())))
}

fn crossing(a: &(Point2<f64>, Vector2<f64>), b: &(Point2<f64>, Vector2<f64>)) -> Option<Point2<f64>> {
    let det = a.1.perp(&b.1);
    (det.abs() > 0.1).then(|| a.0 + a.1 * ((b.0 - a.0).perp(&b.1) / det))
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::ImageSize;

    /// A dark quadrilateral with soft edges: the share of each pixel outside of it.
    fn drawn(corners: &[Point2<f64>; 4]) -> Image<u8> {
        Image::from_fn(ImageSize::new(120, 100), |x, y| {
            let p = Point2::new(x as f64, y as f64);
            let outside = (0..4)
                .map(|i| {
                    let along = (corners[(i + 1) % 4] - corners[i]).normalize();
                    -along.perp(&(p - corners[i]))
                })
                .fold(f64::NEG_INFINITY, f64::max);
            (120.0 + 80.0 * (outside / 0.8).tanh()) as u8
        })
    }

    #[test]
    fn corners_are_found_to_a_tenth_of_a_pixel_at_any_angle() {
        for k in 0..12 {
            let turn = f64::from(k) * 0.31;
            let (c, s) = (turn.cos(), turn.sin());
            let truth = [(-20.0, -18.0), (22.0, -21.0), (19.0, 23.0), (-24.0, 17.0)]
                .map(|(x, y)| Point2::new(60.3 + c * x - s * y, 50.2 + s * x + c * y));
            let found = find_quads(&drawn(&truth));
            assert_eq!(found.len(), 1, "turned by {turn}");
            for corner in &truth {
                let error = found[0].corners.iter().map(|f| (f - corner).norm()).fold(f64::INFINITY, f64::min);
                assert!(error < 0.1, "turned by {turn}: {error}");
            }
        }
    }

    #[test]
    fn an_empty_or_tiny_image_has_none() {
        assert!(find_quads(&Image::filled(ImageSize::new(200, 100), 90)).is_empty());
        assert!(find_quads(&Image::filled(ImageSize::new(1, 1), 0)).is_empty());
        assert!(find_quads(&Image::from_fn(ImageSize::new(64, 64), |x, y| ((x * 7 + y * 13) % 251) as u8)).len() < 5);
    }
}
