//! A grid of cells that may hold something, so that samples are spent where matter is.
//!
//! The grid covers the unit cube. Each cell keeps a running maximum of what its owner asks a field for (a density, the
//! optical thickness of a step, a nearness), `v = max(decay v, found)` at a random point of the cell (instant-ngp has
//! 0.95). A sixteenth of the cells is refreshed at a time, in turn.

use mb_job::rng;
use rand::RngExt;
use rayon::prelude::*;

/// The cells, x fastest.
#[derive(Debug, Clone)]
pub struct OccupancyGrid {
    resolution: usize,
    /// Running maximum; infinite before the first look.
    pub values: Vec<f32>,
    /// What the last decision compared with (one number). [`Self::raise`] touches only cells above it, so values and
    /// threshold give the same decision again.
    pub threshold: Vec<f32>,
    occupied: Vec<bool>,
    /// Cells that no camera can say anything about: never occupied, never looked at.
    closed: Vec<bool>,
}

/// A cell is refreshed in every sixteenth update.
pub const TURNS: u64 = 16;
/// Whether the `turn`-th refresh looks at all cells: turns 1, 3, 7 and 15, so that empty space is left early.
pub fn looks_everywhere(turn: u64) -> bool {
    turn < TURNS && (turn + 1).is_power_of_two()
}

/// What the running maximum of a density keeps at each refresh. instant-ngp has 0.95, but looks at a cell every 16 to 64
/// steps; here 256 steps lie between two looks, and a haze that has gone must not be marched through for thousands.
pub const CELL_MEMORY: f32 = 0.4;
/// Positions that the field is asked for at once.
const PIECE: usize = 4096;

impl OccupancyGrid {
    /// `resolution`^3 cells, all occupied.
    pub fn new(resolution: usize) -> Self {
        let cells = resolution.pow(3);
        Self {
            resolution,
            values: vec![f32::INFINITY; cells],
            threshold: vec![f32::NEG_INFINITY],
            occupied: vec![true; cells],
            closed: vec![false; cells],
        }
    }

    /// Closes for good the cells that `keep` refuses, given centre and half edge in the unit cube: matter there would
    /// only explain single photographs.
    pub fn close(&mut self, keep: impl Fn([f32; 3], f32) -> bool + Sync) {
        let r = self.resolution;
        let half = 0.5 / r as f32;
        let cells = self.closed.par_iter_mut().zip(&mut self.occupied).zip(&mut self.values).enumerate();
        cells.for_each(|(i, ((closed, occupied), value))| {
            let center = [i % r, i / r % r, i / (r * r)].map(|c| (c as f32 + 0.5) / r as f32);
            if !keep(center, half) {
                (*closed, *occupied, *value) = (true, false, 0.0);
            }
        });
    }

    /// Cells a side.
    pub fn resolution(&self) -> usize {
        self.resolution
    }

    /// The cell around a point of the unit cube.
    #[inline(always)]
    pub fn cell(&self, p: [f32; 3]) -> usize {
        let r = self.resolution;
        let index = |v: f32| ((v * r as f32).max(0.0) as usize).min(r - 1);
        (index(p[2]) * r + index(p[1])) * r + index(p[0])
    }

    /// Whether the cell around a point of the unit cube may hold something.
    #[inline(always)]
    pub fn is_occupied(&self, p: [f32; 3]) -> bool {
        self.occupied[self.cell(p)]
    }

    /// Raises cells to what a step's samples found there (samples lie in occupied cells only): between two looks at a cell,
    /// which each ask for one point,
    /// training itself has asked for hundreds, and a thin sheet is not forgotten.
    pub fn raise(&mut self, seen: &[(u32, f32)]) {
        for (cell, found) in seen {
            let value = &mut self.values[*cell as usize];
            *value = value.max(*found);
        }
    }

    /// Whether a cell that touches a box of the unit cube may hold something.
    pub fn any_occupied(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        let r = self.resolution;
        let index = |v: f32| ((v * r as f32).max(0.0) as usize).min(r - 1);
        let [x, y, z]: [std::ops::RangeInclusive<usize>; 3] = std::array::from_fn(|d| index(low[d])..=index(high[d]));
        z.into_iter().any(|z| y.clone().any(|y| x.clone().any(|x| self.occupied[(z * r + y) * r + x])))
    }

    /// The occupied cells, and the value of each.
    pub fn occupied_cells(&self) -> impl Iterator<Item = (usize, f32)> + '_ {
        self.values.iter().copied().enumerate().filter(|(i, _)| self.occupied[*i])
    }

    /// Share of the cells that are occupied.
    pub fn share(&self) -> f64 {
        self.occupied.iter().filter(|o| **o).count() as f64 / self.occupied.len() as f64
    }

    /// Refreshes one sixteenth of the cells (all of them where `all`), the `turn`-th, by asking `density` for points of
    /// the unit cube. A running maximum keeps the share `decay` at each refresh. Call [`Self::decide`] afterwards.
    pub fn update(
        &mut self,
        seed: u64,
        turn: u64,
        all: bool,
        decay: f32,
        density: impl Fn(&[[f32; 3]], &mut Vec<f32>) + Sync,
    ) {
        let (cells, positions) = self.points_of_turn(seed, turn, all);
        let found: Vec<Vec<f32>> = positions
            .par_chunks(PIECE)
            .map(|positions| {
                let mut found = Vec::with_capacity(positions.len());
                density(positions, &mut found);
                found
            })
            .collect();
        self.remember(&cells, &found.concat(), decay);
    }

    /// The first half of [`Self::update`]: the cells that the turn looks at, and a random point of each.
    pub fn points_of_turn(&self, seed: u64, turn: u64, all: bool) -> (Vec<u32>, Vec<[f32; 3]>) {
        let r = self.resolution;
        let offset = (turn % TURNS) as usize;
        let pieces: Vec<(Vec<u32>, Vec<[f32; 3]>)> = self
            .closed
            .par_chunks(PIECE)
            .enumerate()
            .map(|(piece, closed)| {
                let mut rng = rng(seed, turn.wrapping_mul(1 << 20) + piece as u64);
                (0..closed.len())
                    .filter(|i| !closed[*i] && (all || (piece * PIECE + i) % TURNS as usize == offset))
                    .map(|i| {
                        let i = piece * PIECE + i;
                        let cell = [i % r, i / r % r, i / (r * r)];
                        (i as u32, cell.map(|c| (c as f32 + rng.random::<f32>()) / r as f32))
                    })
                    .unzip()
            })
            .collect();
        let mut all = (Vec::new(), Vec::new());
        for (cells, points) in pieces {
            all.0.extend(cells);
            all.1.extend(points);
        }
        all
    }

    /// The second half of [`Self::update`]: what was found at the points.
    pub fn remember(&mut self, cells: &[u32], found: &[f32], decay: f32) {
        for (cell, found) in cells.iter().zip(found) {
            let value = &mut self.values[*cell as usize];
            let kept = if value.is_finite() { decay * *value } else { 0.0 };
            *value = kept.max(*found);
        }
    }

    /// Which cells are occupied, x fastest.
    pub fn occupied(&self) -> &[bool] {
        &self.occupied
    }

    /// Mean of the open cells that have been looked at; infinite before the first look.
    pub fn mean(&self) -> f32 {
        let pieces = self.values.par_chunks(PIECE).zip(self.closed.par_chunks(PIECE));
        let sums: Vec<(f64, u32)> = pieces
            .map(|(values, closed)| {
                let open = values.iter().zip(closed).filter(|(v, closed)| v.is_finite() && !**closed);
                open.fold((0.0, 0), |(s, n), (v, _)| (s + f64::from(*v), n + 1))
            })
            .collect();
        // In one order, whatever the threads do.
        let (sum, n) = sums.iter().fold((0.0, 0), |(s, n), (sum, count)| (s + sum, n + count));
        if n == 0 { f32::INFINITY } else { (sum / f64::from(n)) as f32 }
    }

    /// Everything that a checkpoint holds; call [`Self::restored`] after reading it.
    pub fn buffers(&mut self) -> [&mut Vec<f32>; 2] {
        [&mut self.values, &mut self.threshold]
    }

    /// Lengths of the buffers.
    pub fn lengths(&self) -> [usize; 2] {
        [self.occupied.len(), 1]
    }

    /// Decides again as the checkpoint's run had decided last.
    pub fn restored(&mut self) {
        self.decide(self.threshold[0]);
    }

    /// Marks the cells whose value exceeds the threshold.
    pub fn decide(&mut self, threshold: f32) {
        self.threshold[0] = threshold;
        let cells = self.occupied.par_iter_mut().zip(&self.values).zip(&self.closed);
        cells.for_each(|((o, v), closed)| *o = *v > threshold && !closed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ball_is_found_and_forgotten() {
        let ball = |positions: &[[f32; 3]], out: &mut Vec<f32>| {
            out.extend(positions.iter().map(|p| {
                let d: f32 = p.iter().map(|c| (c - 0.5).powi(2)).sum();
                if d < 0.09 { 10.0 } else { 0.0 }
            }));
        };
        let mut grid = OccupancyGrid::new(32);
        assert_eq!(grid.share(), 1.0);
        for turn in 0..16 {
            grid.update(0, turn, false, 0.95, ball);
            grid.decide(1.0);
        }
        assert!(grid.is_occupied([0.5; 3]) && !grid.is_occupied([0.05; 3]) && !grid.is_occupied([1.5; 3]));
        assert!((grid.share() - 4.0 / 3.0 * std::f64::consts::PI * 0.027).abs() < 0.02, "{}", grid.share());
        for turn in 0..60 {
            grid.update(0, turn, true, 0.95, |p, out| out.resize(p.len(), 0.0));
            grid.decide(1.0);
        }
        assert_eq!(grid.share(), 0.0);
        let mut half = OccupancyGrid::new(8);
        half.close(|center, _| center[0] > 0.5);
        half.update(0, 0, true, 0.0, |p, out| out.resize(p.len(), 1.0));
        half.decide(0.5);
        assert_eq!((half.share(), half.mean()), (0.5, 1.0));
    }
}
