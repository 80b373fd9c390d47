//! Which features of two photographs show the same place.

use nalgebra::{Point2, Vector2};
use rayon::prelude::*;

use crate::features::Feature;

/// How features are matched.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MatchOptions {
    /// The best match's descriptor distance must be below this share of the second best's (Lowe 2004, section 7.1).
    pub ratio: f64,
    /// Whether each must be the other's best.
    pub mutual: bool,
}

impl Default for MatchOptions {
    fn default() -> Self {
        Self { ratio: 0.8, mutual: true }
    }
}

/// Pairs of indices (into `a`, into `b`), in order of the first; every feature of one against every of the other.
pub fn match_features(a: &[Feature], b: &[Feature], options: &MatchOptions) -> Vec<(usize, usize)> {
    let all_a: Vec<usize> = (0..a.len()).collect();
    let all_b: Vec<usize> = (0..b.len()).collect();
    let forward: Vec<Option<usize>> = a.par_iter().map(|f| best_of(f, b, &all_b, options.ratio)).collect();
    let backward: Vec<Option<usize>> =
        if options.mutual { b.par_iter().map(|f| best_of(f, a, &all_a, 1.0)).collect() } else { Vec::new() };
    let pairs = forward.into_iter().enumerate().filter_map(|(i, j)| j.map(|j| (i, j)));
    pairs.filter(|&(i, j)| !options.mutual || backward[j] == Some(i)).collect()
}

/// The candidate whose descriptor is nearest, if it is clearly nearer than any other one's elsewhere.
pub(crate) fn best_of(feature: &Feature, others: &[Feature], candidates: &[usize], ratio: f64) -> Option<usize> {
    let (mut best, mut best_sq, mut second_sq) = (None, u32::MAX, u32::MAX);
    for &i in candidates {
        let other = &others[i];
        let sq = distance_sq(&feature.descriptor, &other.descriptor);
        if sq < best_sq {
            // A feature with two directions occurs twice at one place: its twin is no competitor.
            let same_place = best.is_some_and(|b: usize| (others[b].pixel - other.pixel).norm() < 1.0);
            if !same_place {
                second_sq = best_sq;
            }
            (best, best_sq) = (Some(i), sq);
        } else if sq < second_sq && best.is_some_and(|b: usize| (others[b].pixel - other.pixel).norm() >= 1.0) {
            second_sq = sq;
        }
    }
    best.filter(|_| f64::from(best_sq) <= ratio * ratio * f64::from(second_sq))
}

fn distance_sq(a: &[u8; 128], b: &[u8; 128]) -> u32 {
    let mut sum = 0i32;
    for (a, b) in a.iter().zip(b) {
        let d = i32::from(i16::from(*a) - i16::from(*b));
        sum += d * d;
    }
    sum as u32
}

/// Features by place, for searches along a line.
pub(crate) struct FeatureGrid {
    cell_px: f64,
    columns: usize,
    rows: usize,
    cells: Vec<Vec<usize>>,
}

impl FeatureGrid {
    pub fn new(features: &[Feature], size: mb_geometry::ImageSize) -> Self {
        let cell_px = 24.0;
        let columns = (size.width as f64 / cell_px).ceil() as usize + 1;
        let rows = (size.height as f64 / cell_px).ceil() as usize + 1;
        let mut cells = vec![Vec::new(); columns * rows];
        for (i, f) in features.iter().enumerate() {
            let column = ((f.pixel.x / cell_px) as usize).min(columns - 1);
            let row = ((f.pixel.y / cell_px) as usize).min(rows - 1);
            cells[row * columns + column].push(i);
        }
        Self { cell_px, columns, rows, cells }
    }

    /// Features within `radius_px` of the segment from `from` to `to`, in ascending order.
    pub fn near_segment(
        &self,
        features: &[Feature],
        from: &Point2<f64>,
        to: &Point2<f64>,
        radius_px: f64,
    ) -> Vec<usize> {
        let cell = |v: f64, count: usize| ((v / self.cell_px).floor().max(0.0) as usize).min(count - 1);
        let (min, max) = (from.coords.inf(&to.coords), from.coords.sup(&to.coords));
        let columns = cell(min.x - radius_px, self.columns)..=cell(max.x + radius_px, self.columns);
        let rows = cell(min.y - radius_px, self.rows)..=cell(max.y + radius_px, self.rows);
        let reach = radius_px + self.cell_px;
        let mut found = Vec::new();
        for row in rows {
            for column in columns.clone() {
                let middle = Point2::new((column as f64 + 0.5) * self.cell_px, (row as f64 + 0.5) * self.cell_px);
                if distance_to_segment(&middle, from, to) > reach {
                    continue;
                }
                let near = |i: &&usize| distance_to_segment(&features[**i].pixel, from, to) <= radius_px;
                found.extend(self.cells[row * self.columns + column].iter().filter(near));
            }
        }
        found.sort_unstable();
        found
    }
}

fn distance_to_segment(p: &Point2<f64>, from: &Point2<f64>, to: &Point2<f64>) -> f64 {
    let along: Vector2<f64> = to - from;
    let length_sq = along.norm_squared();
    let share = if length_sq > 0.0 { ((p - from).dot(&along) / length_sq).clamp(0.0, 1.0) } else { 0.0 };
    (p - (from + along * share)).norm()
}
