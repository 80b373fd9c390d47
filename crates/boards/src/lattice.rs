//! The inner corners of a chessboard, followed from a few outwards.

use mb_image::Image;
use nalgebra::{Matrix2, Point2};

use crate::corner::{Expected, find_corner};
use crate::homography::Homography;
use crate::{BoardPattern, BoardSpec};

/// The corners found so far.
pub(crate) struct Lattice {
    columns: usize,
    square_m: f64,
    corners_m: Vec<Point2<f64>>,
    pixels: Vec<Option<Point2<f64>>>,
    /// Corners of markers: board, photograph.
    seeds: Vec<(Point2<f64>, Point2<f64>)>,
}

/// Corners that a map around a place is made from at most: the lens bends the board over longer distances.
const MOST_SUPPORT: usize = 16;
/// Times that a corner is looked for, as more of its neighbours are known.
const TRIES: u8 = 3;

impl Lattice {
    /// Corners found: their places in [`BoardSpec::corners`] and their pixels.
    pub fn corners(&self) -> impl Iterator<Item = (usize, Point2<f64>)> {
        self.pixels.iter().enumerate().filter_map(|(id, pixel)| Some((id, (*pixel)?)))
    }

    pub fn count(&self) -> usize {
        self.corners().count()
    }

    /// The map from the board to the photograph around a point of the board, from corners within `radius` squares.
    pub fn around(&self, middle_m: &Point2<f64>, radius: f64) -> Option<Homography> {
        self.map(middle_m, radius, usize::MAX, false)
    }

    fn map(&self, middle_m: &Point2<f64>, radius: f64, except: usize, with_seeds: bool) -> Option<Homography> {
        let limit = radius * self.square_m;
        let mut near: Vec<(f64, _)> = self
            .corners()
            .filter(|(id, _)| *id != except)
            .map(|(id, pixel)| ((self.corners_m[id] - middle_m).norm(), (self.corners_m[id], pixel)))
            .filter(|(distance, _)| *distance <= limit)
            .collect();
        if with_seeds && near.len() < 6 {
            let seeds = self.seeds.iter().map(|pair| ((pair.0 - middle_m).norm(), *pair));
            near.extend(seeds.filter(|(distance, _)| *distance <= limit));
        }
        near.sort_by(|a, b| a.0.total_cmp(&b.0));
        near.truncate(MOST_SUPPORT);
        let pairs: Vec<_> = near.into_iter().map(|(_, pair)| pair).collect();
        Homography::fit(&pairs)
    }

    /// How many of the eight corners around this one are known.
    fn known_neighbours(&self, id: usize) -> usize {
        let (x, y) = (id % self.columns, id / self.columns);
        let rows = self.pixels.len() / self.columns;
        let around = (y.saturating_sub(1)..(y + 2).min(rows))
            .flat_map(|y| (x.saturating_sub(1)..(x + 2).min(self.columns)).map(move |x| (x, y)));
        around.filter(|&(x, y)| self.pixels[y * self.columns + x].is_some()).count()
    }

    fn is_beside_seed(&self, id: usize) -> bool {
        self.seeds.iter().any(|(m, _)| (m - self.corners_m[id]).norm() < 0.75 * self.square_m)
    }

    /// Forgets corners that are not where their neighbours say.
    fn prune(&mut self) {
        for _ in 0..3 {
            let misplaced: Vec<usize> = self
                .corners()
                .filter(|(id, pixel)| {
                    let here = self.corners_m[*id];
                    let Some(map) = self.map(&here, 2.3, *id, true) else { return true };
                    let shortest =
                        axes(&map, &here, self.square_m).column_iter().map(|c| c.norm()).fold(f64::MAX, f64::min);
                    (map.apply(&here) - pixel).norm() > (0.06 * shortest).max(1.0)
                })
                .map(|(id, _)| id)
                .collect();
            if misplaced.is_empty() {
                break;
            }
            misplaced.into_iter().for_each(|id| self.pixels[id] = None);
        }
    }
}

/// Pixels a square along x and y of the board.
fn axes(map: &Homography, at_m: &Point2<f64>, square_m: f64) -> Matrix2<f64> {
    map.jacobian(at_m) * square_m
}

/// Finds the corners of a chessboard from corners of its markers (board, photograph), going from known ones outwards.
pub(crate) fn grow(image: &Image<u8>, board: &BoardSpec, seeds: &[(Point2<f64>, Point2<f64>)]) -> Lattice {
    let (square_m, margin) = match board.pattern() {
        BoardPattern::Charuco { square_m, marker_m, .. } => (square_m, 0.5 * (1.0 - marker_m / square_m)),
        BoardPattern::Grid { marker_m, .. } => (marker_m, 0.0),
    };
    let corners_m = board.corners();
    let count = corners_m.len();
    let columns = board.columns() - 1;
    let mut lattice = Lattice { columns, square_m, corners_m, pixels: vec![None; count], seeds: seeds.to_vec() };
    let mut tries = vec![0u8; count];
    let mut known_before = vec![usize::MAX; count];
    loop {
        let mut found: Vec<(usize, Point2<f64>)> = Vec::new();
        let mut tried = false;
        for id in 0..count {
            if lattice.pixels[id].is_some() || tries[id] >= TRIES {
                continue;
            }
            let known = lattice.known_neighbours(id);
            if known == known_before[id] || (known < 2 && !lattice.is_beside_seed(id)) {
                continue;
            }
            let here = lattice.corners_m[id];
            let Some(map) = lattice.map(&here, 2.6, id, true) else { continue };
            (tries[id], known_before[id], tried) = (tries[id] + 1, known, true);
            let expected = Expected {
                pixel: map.apply(&here),
                axes: axes(&map, &here, square_m),
                margin,
                is_black_first: board.is_black_square(id % columns, id / columns),
            };
            if let Some(corner) = find_corner(image, &expected, 0.15) {
                found.push((id, corner.pixel));
            }
        }
        found.iter().for_each(|(id, pixel)| lattice.pixels[*id] = Some(*pixel));
        if !tried {
            break;
        }
    }
    lattice.prune();
    lattice
}
