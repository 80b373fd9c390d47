//! The multi-resolution hash encoding (Mueller et al. 2022, "Instant Neural Graphics Primitives").
//!
//! Level l is a grid of `N_l = floor(N_min * b^l)` cells a side over the unit cube. A corner with integer coordinates
//! (i, j, k) owns `F` features at `(i * 1) ^ (j * 2654435761) ^ (k * 805459861) mod T`, or at its own index where the
//! whole level fits into T entries. A level's value is trilinear in the corners: with cell coordinates t in 0..1,
//!
//! `e_f(x) = sum_c w_c(t) theta_cf`, `w_c = prod_d (c_d ? t_d : 1 - t_d)`.
//!
//! The gradient of `s = g . e(x)` for given g is `n_d = N_l sum_c (dw_c/dt_d) (g . theta_c)`. A loss that uses both e
//! and n sends back, per corner,
//!
//! `dtheta_c = w_c de + (sum_d N_l dw_c/dt_d dn_d) g`, `dg = sum_c (sum_d N_l dw_c/dt_d dn_d) theta_c`,
//!
//! which is what an exact eikonal or colour loss on normals needs: [`HashGrid::tangent`] computes dg, and
//! [`HashGrid::scatter`] dtheta. The scatter runs level by level, samples in their order, so that the sums do not
//! depend on the thread count and no atomics are needed.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::simd::dispatched;

/// Sizes of the encoding.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct HashGridOptions {
    /// Number of levels.
    pub levels: usize,
    /// Features of a level: 1, 2, 4 or 8.
    pub features: usize,
    /// Base-2 logarithm of the largest number of entries of a level.
    pub log2_entries: u32,
    /// Cells a side of the coarsest level.
    pub coarsest: usize,
    /// Cells a side of the finest level.
    pub finest: usize,
}

/// One level of an encoding.
#[derive(Debug, Clone, Copy)]
pub struct Level {
    /// Cells a side.
    pub cells: u32,
    /// Offset of the first feature.
    pub offset: usize,
    /// Entries, `features` numbers each.
    pub entries: u32,
    /// Whether each corner has an entry of its own.
    pub dense: bool,
}

/// The levels of an encoding, worked out.
#[derive(Debug, Clone)]
pub struct HashGrid {
    options: HashGridOptions,
    levels: Vec<Level>,
    len: usize,
}

/// What a batch sends back to the table; see [`HashGrid::scatter`].
#[derive(Debug, Clone, Copy)]
pub struct Scatter<'a> {
    /// Positions in the unit cube.
    pub positions: &'a [[f32; 3]],
    /// `[samples, stride]`: derivative with respect to the features, from column `first`.
    pub d_features: &'a [f32],
    /// Where a loss uses the gradient n: g, laid out like `d_features`, and dn.
    pub gradient: Option<(&'a [f32], &'a [[f32; 3]])>,
    /// Row length.
    pub stride: usize,
    /// First column of the encoding.
    pub first: usize,
}

/// The eight corners of a cell: table index, and where it lies between them. Corner c is the far one along dimension d
/// where bit d of c is set.
#[derive(Clone, Copy)]
struct Cell {
    corners: [u32; 8],
    t: [f32; 3],
}

impl Cell {
    const ZERO: Self = Self { corners: [0; 8], t: [0.0; 3] };

    /// Along dimension d, for each corner: the weight, and its derivative (-1 or 1).
    #[inline(always)]
    fn along(&self, d: usize) -> ([f32; 8], [f32; 8]) {
        let far = |c: usize| c >> d & 1 == 1;
        (
            std::array::from_fn(|c| if far(c) { self.t[d] } else { 1.0 - self.t[d] }),
            std::array::from_fn(|c| if far(c) { 1.0 } else { -1.0 }),
        )
    }

    /// `w_c`.
    #[inline(always)]
    fn weights(&self) -> [f32; 8] {
        let ((x, _), (y, _), (z, _)) = (self.along(0), self.along(1), self.along(2));
        std::array::from_fn(|c| x[c] * y[c] * z[c])
    }

    /// `dw_c/dt_d` for each d.
    #[inline(always)]
    fn weight_gradients(&self) -> [[f32; 8]; 3] {
        let ((x, dx), (y, dy), (z, dz)) = (self.along(0), self.along(1), self.along(2));
        [
            std::array::from_fn(|c| dx[c] * y[c] * z[c]),
            std::array::from_fn(|c| x[c] * dy[c] * z[c]),
            std::array::from_fn(|c| x[c] * y[c] * dz[c]),
        ]
    }

    /// `scale sum_d dw_c/dt_d v_d`.
    #[inline(always)]
    fn weight_tangents(&self, v: [f32; 3], scale: f32) -> [f32; 8] {
        let [dx, dy, dz] = self.weight_gradients();
        std::array::from_fn(|c| scale * (dx[c] * v[0] + dy[c] * v[1] + dz[c] * v[2]))
    }

    /// `sum_d v_d d/dt_k dw_c/dt_d` for each k; trilinear weights have no pure second derivatives.
    #[inline(always)]
    fn weight_seconds(&self, v: [f32; 3]) -> [[f32; 8]; 3] {
        let ((x, dx), (y, dy), (z, dz)) = (self.along(0), self.along(1), self.along(2));
        [
            std::array::from_fn(|c| dx[c] * (dy[c] * z[c] * v[1] + y[c] * dz[c] * v[2])),
            std::array::from_fn(|c| dy[c] * (dx[c] * z[c] * v[0] + x[c] * dz[c] * v[2])),
            std::array::from_fn(|c| dz[c] * (dx[c] * y[c] * v[0] + x[c] * dy[c] * v[1])),
        ]
    }

    /// `sum_c factor_c theta_c`.
    #[inline(always)]
    fn blend<const F: usize>(&self, table: &[f32], factors: &[f32; 8]) -> [f32; F] {
        let mut sum = [0.0; F];
        for c in 0..8 {
            let theta = entry::<F>(table, self.corners[c]);
            for f in 0..F {
                sum[f] += factors[c] * theta[f];
            }
        }
        sum
    }

    /// `g . theta_c`.
    #[inline(always)]
    fn dots<const F: usize>(&self, table: &[f32], g: &[f32]) -> [f32; 8] {
        let mut dots = [0.0; 8];
        for c in 0..8 {
            let theta = entry::<F>(table, self.corners[c]);
            for f in 0..F {
                dots[c] += g[f] * theta[f];
            }
        }
        dots
    }
}

#[inline(always)]
fn dot8(a: &[f32; 8], b: &[f32; 8]) -> f32 {
    let mut sum = 0.0;
    for c in 0..8 {
        sum += a[c] * b[c];
    }
    sum
}

#[inline(always)]
fn entry<const F: usize>(table: &[f32], corner: u32) -> &[f32; F] {
    let at = corner as usize * F;
    table[at..at + F].try_into().expect("the slice has this length")
}

impl Level {
    #[inline(always)]
    fn cell(&self, p: [f32; 3]) -> Cell {
        let cells = self.cells as f32;
        let mut base = [0u32; 3];
        let mut t = [0.0; 3];
        for d in 0..3 {
            let at = (p[d] * cells).clamp(0.0, cells);
            let floor = (at as u32).min(self.cells - 1);
            base[d] = floor;
            t[d] = at - floor as f32;
        }
        let corners = if self.dense {
            let side = self.cells + 1;
            let first = (base[2] * side + base[1]) * side + base[0];
            std::array::from_fn(|c| first + (c as u32 & 1) + (c as u32 >> 1 & 1) * side + (c as u32 >> 2) * side * side)
        } else {
            let mask = self.entries - 1;
            let x = [base[0], base[0] + 1];
            let y = [base[1].wrapping_mul(2_654_435_761), (base[1] + 1).wrapping_mul(2_654_435_761)];
            let z = [base[2].wrapping_mul(805_459_861), (base[2] + 1).wrapping_mul(805_459_861)];
            std::array::from_fn(|c| (x[c & 1] ^ y[c >> 1 & 1] ^ z[c >> 2]) & mask)
        };
        Cell { corners, t }
    }
}

/// Calls a kernel with the constant `F` equal to the number of features.
macro_rules! with_features {
    ($features:expr, $kernel:ident ( $($arg:expr),* $(,)? )) => {
        match $features {
            1 => $kernel::<1>($($arg),*),
            2 => $kernel::<2>($($arg),*),
            4 => $kernel::<4>($($arg),*),
            _ => $kernel::<8>($($arg),*),
        }
    };
}

/// The columns of a level in rows of all levels' features.
#[derive(Debug, Clone, Copy)]
struct Columns {
    stride: usize,
    first: usize,
}

impl Columns {
    #[inline(always)]
    fn of<'a, const F: usize>(&self, rows: &'a [f32], row: usize) -> &'a [f32] {
        &rows[row * self.stride + self.first..][..F]
    }

    #[inline(always)]
    fn of_mut<'a, const F: usize>(&self, rows: &'a mut [f32], row: usize) -> &'a mut [f32] {
        &mut rows[row * self.stride + self.first..][..F]
    }
}

/// Positions whose cells are found before any of their corners is read: the reads, which are slow, then overlap.
const AHEAD: usize = 16;

/// Runs a block for the number and the cell of every position. A function with a closure would have the closure compiled
/// once, without the instruction set that the kernel around it is compiled for.
macro_rules! for_each_cell {
    ($level:expr, $positions:expr, |$i:ident, $cell:ident| $block:block) => {
        let mut cells = [Cell::ZERO; AHEAD];
        for (ahead, positions) in $positions.chunks(AHEAD).enumerate() {
            for (cell, p) in cells.iter_mut().zip(positions) {
                *cell = $level.cell(*p);
            }
            for (j, $cell) in cells[..positions.len()].iter().enumerate() {
                let $i = ahead * AHEAD + j;
                $block
            }
        }
    };
}

// Each kernel works on one level for all positions, so that its part of the table stays in the cache.

#[inline(always)]
fn encode_level_body<const F: usize>(
    level: Level,
    table: &[f32],
    positions: &[[f32; 3]],
    out: &mut [f32],
    at: Columns,
) {
    for_each_cell!(level, positions, |i, cell| {
        at.of_mut::<F>(out, i).copy_from_slice(&cell.blend::<F>(table, &cell.weights()));
    });
}
dispatched! {
    fn encode_level<const F: usize>(level: Level, table: &[f32], positions: &[[f32; 3]], out: &mut [f32], at: Columns)
    = encode_level_body
}

#[inline(always)]
fn tangent_level_body<const F: usize>(
    level: Level,
    table: &[f32],
    positions: &[[f32; 3]],
    d_n: &[[f32; 3]],
    out: &mut [f32],
    at: Columns,
) {
    let scale = level.cells as f32;
    for_each_cell!(level, positions, |i, cell| {
        let factors = cell.weight_tangents(d_n[i], scale);
        at.of_mut::<F>(out, i).copy_from_slice(&cell.blend::<F>(table, &factors));
    });
}
dispatched! {
    fn tangent_level<const F: usize>(level: Level, table: &[f32], positions: &[[f32; 3]], d_n: &[[f32; 3]],
                                     out: &mut [f32], at: Columns) = tangent_level_body
}

#[inline(always)]
fn gradient_level_body<const F: usize>(
    level: Level,
    table: &[f32],
    positions: &[[f32; 3]],
    g: &[f32],
    normals: &mut [[f32; 3]],
    at: Columns,
) {
    let scale = level.cells as f32;
    for_each_cell!(level, positions, |i, cell| {
        let dots = cell.dots::<F>(table, at.of::<F>(g, i));
        let gradients = cell.weight_gradients();
        for d in 0..3 {
            normals[i][d] += scale * dot8(&gradients[d], &dots);
        }
    });
}
dispatched! {
    fn gradient_level<const F: usize>(level: Level, table: &[f32], positions: &[[f32; 3]], g: &[f32],
                                      normals: &mut [[f32; 3]], at: Columns) = gradient_level_body
}

#[inline(always)]
fn second_level_body<const F: usize>(
    level: Level,
    table: &[f32],
    positions: &[[f32; 3]],
    g: &[f32],
    d_n: &[[f32; 3]],
    to: &mut [[f32; 3]],
    at: Columns,
) {
    let scale = (level.cells as f32) * (level.cells as f32);
    for_each_cell!(level, positions, |i, cell| {
        let dots = cell.dots::<F>(table, at.of::<F>(g, i));
        let seconds = cell.weight_seconds(d_n[i]);
        for d in 0..3 {
            to[i][d] += scale * dot8(&seconds[d], &dots);
        }
    });
}
dispatched! {
    fn second_level<const F: usize>(level: Level, table: &[f32], positions: &[[f32; 3]], g: &[f32], d_n: &[[f32; 3]],
                                    to: &mut [[f32; 3]], at: Columns) = second_level_body
}

#[inline(always)]
fn scatter_level_body<const F: usize>(level: Level, batch: &Scatter<'_>, grads: &mut [f32], at: Columns) {
    let scale = level.cells as f32;
    for_each_cell!(level, batch.positions, |i, cell| {
        let d_e = at.of::<F>(batch.d_features, i);
        let weights = cell.weights();
        match batch.gradient {
            None => {
                for c in 0..8 {
                    let to = &mut grads[cell.corners[c] as usize * F..][..F];
                    for f in 0..F {
                        to[f] += weights[c] * d_e[f];
                    }
                }
            }
            Some((g, d_n)) => {
                let g = at.of::<F>(g, i);
                let tangents = cell.weight_tangents(d_n[i], scale);
                for c in 0..8 {
                    let to = &mut grads[cell.corners[c] as usize * F..][..F];
                    for f in 0..F {
                        to[f] += weights[c] * d_e[f] + tangents[c] * g[f];
                    }
                }
            }
        }
    });
}
dispatched! {
    fn scatter_level<const F: usize>(level: Level, batch: &Scatter<'_>, grads: &mut [f32], at: Columns) = scatter_level_body
}

impl HashGrid {
    /// Works out the levels.
    ///
    /// # Panics
    /// A size is zero or beyond sense: features other than 1, 2, 4, 8; more than 2^28 entries; cells not rising.
    pub fn new(options: HashGridOptions) -> Self {
        assert!(matches!(options.features, 1 | 2 | 4 | 8) && options.levels > 0, "{options:?}");
        assert!(
            options.log2_entries <= 28 && 0 < options.coarsest && options.coarsest <= options.finest,
            "{options:?}"
        );
        let growth = if options.levels > 1 {
            (options.finest as f64 / options.coarsest as f64).powf(1.0 / (options.levels - 1) as f64)
        } else {
            1.0
        };
        let mut len = 0;
        let levels = (0..options.levels)
            .map(|l| {
                let cells = (options.coarsest as f64 * growth.powi(l as i32) + 1e-6).floor();
                let corners = (cells + 1.0).powi(3);
                let largest = 1u32 << options.log2_entries;
                let dense = corners <= f64::from(largest);
                let entries = if dense { corners as u32 } else { largest };
                let level = Level { cells: cells as u32, offset: len, entries, dense };
                len += entries as usize * options.features;
                level
            })
            .collect();
        Self { options, levels, len }
    }

    /// Length of the table: all features of all levels.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Never: a grid has at least one level.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Features of all levels together.
    pub fn width(&self) -> usize {
        self.options.levels * self.options.features
    }

    /// The sizes it was made from.
    pub fn options(&self) -> &HashGridOptions {
        &self.options
    }

    /// The levels, coarsest first.
    pub fn layout(&self) -> &[Level] {
        &self.levels
    }

    /// Number of levels.
    pub fn levels(&self) -> usize {
        self.options.levels
    }

    /// Cells a side of `level`.
    pub fn cells(&self, level: usize) -> usize {
        self.levels[level].cells as usize
    }

    /// A table of small random features, uniform in +-1e-4 as in the original.
    pub fn init(&self, rng: &mut mb_job::Rng) -> Vec<f32> {
        use rand::RngExt;
        (0..self.len).map(|_| rng.random_range(-1e-4..1e-4)).collect()
    }

    /// The first `active` levels, with their parts of a table and their columns in rows of features.
    fn active<'a>(
        &'a self,
        active: usize,
        table: &'a [f32],
        stride: usize,
        first: usize,
    ) -> impl Iterator<Item = (Level, &'a [f32], Columns)> {
        let features = self.options.features;
        self.levels.iter().take(active).enumerate().map(move |(l, level)| {
            let part = &table[level.offset..level.offset + level.entries as usize * features];
            (*level, part, Columns { stride, first: first + l * features })
        })
    }

    /// Clears the columns of the levels from `active` on.
    fn clear_inactive(&self, active: usize, out: &mut [f32], stride: usize, first: usize) {
        let columns = first + active.min(self.options.levels) * self.options.features..first + self.width();
        if !columns.is_empty() {
            out.chunks_exact_mut(stride).for_each(|row| row[columns.clone()].fill(0.0));
        }
    }

    /// Writes the features of `positions` to `out`: `[samples, stride]`, from column `first`. Levels from `active` on
    /// give zeros.
    pub fn forward(
        &self,
        table: &[f32],
        positions: &[[f32; 3]],
        active: usize,
        out: &mut [f32],
        stride: usize,
        first: usize,
    ) {
        for (level, table, at) in self.active(active, table, stride, first) {
            with_features!(self.options.features, encode_level(level, table, positions, out, at));
        }
        self.clear_inactive(active, out, stride, first);
    }

    /// Adds the gradient with respect to position of `g . e(x)` to `normals`; `g` is laid out like the features.
    pub fn input_gradient(
        &self,
        table: &[f32],
        positions: &[[f32; 3]],
        active: usize,
        g: &[f32],
        stride: usize,
        first: usize,
        normals: &mut [[f32; 3]],
    ) {
        for (level, table, at) in self.active(active, table, stride, first) {
            with_features!(self.options.features, gradient_level(level, table, positions, g, normals, at));
        }
    }

    /// Writes dg, the derivative with respect to g of a loss whose derivative with respect to the gradient n is `d_n`,
    /// to `d_g`, laid out like the features. Inactive levels give zeros.
    pub fn tangent(
        &self,
        table: &[f32],
        positions: &[[f32; 3]],
        active: usize,
        d_n: &[[f32; 3]],
        d_g: &mut [f32],
        stride: usize,
        first: usize,
    ) {
        for (level, table, at) in self.active(active, table, stride, first) {
            with_features!(self.options.features, tangent_level(level, table, positions, d_n, d_g, at));
        }
        self.clear_inactive(active, d_g, stride, first);
    }

    /// Adds to `to` what a loss with derivative `d_n` on the gradient n of `g . e(x)` sends back to the position:
    /// `sum_d dn_d d/dx n_d`.
    pub fn second_gradient(
        &self,
        table: &[f32],
        positions: &[[f32; 3]],
        active: usize,
        g: &[f32],
        d_n: &[[f32; 3]],
        stride: usize,
        first: usize,
        to: &mut [[f32; 3]],
    ) {
        for (level, table, at) in self.active(active, table, stride, first) {
            with_features!(self.options.features, second_level(level, table, positions, g, d_n, to, at));
        }
    }

    /// Adds what the batches send back to `grads`, laid out like the table. Levels run in parallel; inside a level the
    /// batches and their samples are added in order.
    pub fn scatter(&self, batches: &[Scatter<'_>], active: usize, grads: &mut [f32]) {
        let mut parts = Vec::with_capacity(self.levels.len());
        let mut rest = grads;
        for level in &self.levels {
            let (part, tail) = rest.split_at_mut(level.entries as usize * self.options.features);
            parts.push(part);
            rest = tail;
        }
        let features = self.options.features;
        parts.into_par_iter().zip(&self.levels).enumerate().take(active).for_each(|(l, (part, level))| {
            for batch in batches {
                let at = Columns { stride: batch.stride, first: batch.first + l * features };
                with_features!(features, scatter_level(*level, batch, part, at));
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    fn grid(features: usize) -> HashGrid {
        HashGrid::new(HashGridOptions { levels: 3, features, log2_entries: 7, coarsest: 3, finest: 11 })
    }

    /// Positions away from cell walls, where the encoding has a kink.
    fn positions(rng: &mut mb_job::Rng) -> Vec<[f32; 3]> {
        let away =
            |p: &[f32; 3]| (0..3).all(|l| p.iter().all(|v| ((v * grid(2).cells(l) as f32).fract() - 0.5).abs() < 0.45));
        std::iter::repeat_with(|| std::array::from_fn(|_| rng.random_range(0.0..1.0f32))).filter(away).take(9).collect()
    }

    /// `sum_s d_e . e(x) + d_n . n(x)`, with n by finite differences of the encoding.
    fn loss(grid: &HashGrid, table: &[f32], x: &[[f32; 3]], g: &[f32], d_e: &[f32], d_n: &[[f32; 3]]) -> f64 {
        let width = grid.width();
        let dot = |x: &[f32; 3], with: &[f32]| {
            let mut e = vec![0.0; width];
            grid.forward(table, &[*x], 3, &mut e, width, 0);
            e.iter().zip(with).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>()
        };
        x.iter()
            .enumerate()
            .map(|(s, x)| {
                let rows = s * width..(s + 1) * width;
                let mut sum = dot(x, &d_e[rows.clone()]);
                for d in 0..3 {
                    let at = |h: f32| {
                        let mut y = *x;
                        y[d] += h;
                        dot(&y, &g[rows.clone()])
                    };
                    sum += f64::from(d_n[s][d]) * (at(2e-3) - at(-2e-3)) / 4e-3;
                }
                sum
            })
            .sum()
    }

    #[test]
    fn derivatives_of_both_orders_agree_with_finite_differences() {
        for features in [1, 2, 4, 8] {
            let grid = grid(features);
            let width = grid.width();
            let mut rng = mb_job::rng(features as u64, 0);
            let x = positions(&mut rng);
            let mut numbers = |n: usize| (0..n).map(|_| rng.random_range(-1.0..1.0f32)).collect::<Vec<_>>();
            let (table, g, d_e) = (numbers(grid.len()), numbers(9 * width), numbers(9 * width));
            let d_n: Vec<[f32; 3]> = numbers(27).chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();

            let mut normals = vec![[0.0; 3]; 9];
            grid.input_gradient(&table, &x, 3, &g, width, 0, &mut normals);
            let mut grads = vec![0.0; grid.len()];
            let batch =
                Scatter { positions: &x, d_features: &d_e, gradient: Some((&g, &d_n)), stride: width, first: 0 };
            grid.scatter(&[batch], 3, &mut grads);
            let mut d_g = vec![0.0; 9 * width];
            grid.tangent(&table, &x, 3, &d_n, &mut d_g, width, 0);

            let zero = vec![0.0; 9 * width];
            for (s, n) in normals.iter().enumerate() {
                for d in 0..3 {
                    let mut unit = vec![[0.0; 3]; 9];
                    unit[s][d] = 1.0;
                    let expected = loss(&grid, &table, &x, &g, &zero, &unit);
                    assert!((f64::from(n[d]) - expected).abs() < 2e-3, "normal {} is not {expected}", n[d]);
                }
            }
            let mut to = vec![[0.0; 3]; 9];
            grid.second_gradient(&table, &x, 3, &g, &d_n, width, 0, &mut to);
            for s in 0..9 {
                for d in 0..3 {
                    let at = |h: f32| {
                        let mut p = x[s];
                        p[d] += h;
                        let mut n = [[0.0; 3]];
                        grid.input_gradient(&table, &[p], 3, &g[s * width..(s + 1) * width], width, 0, &mut n);
                        (0..3).map(|i| f64::from(n[0][i] * d_n[s][i])).sum::<f64>()
                    };
                    let expected = (at(1e-3) - at(-1e-3)) / 2e-3;
                    assert!((f64::from(to[s][d]) - expected).abs() < 0.05, "{} is not {expected}", to[s][d]);
                }
            }
            // The loss is linear in the table and in g, so any step is exact.
            for i in (0..grid.len()).step_by(5) {
                let at = |h: f32| {
                    let mut t = table.clone();
                    t[i] += h;
                    loss(&grid, &t, &x, &g, &d_e, &d_n)
                };
                let expected = at(0.5) - at(-0.5);
                assert!((f64::from(grads[i]) - expected).abs() < 5e-3, "{i}: {} is not {expected}", grads[i]);
            }
            for i in 0..d_g.len() {
                let at = |h: f32| {
                    let mut g = g.clone();
                    g[i] += h;
                    loss(&grid, &table, &x, &g, &d_e, &d_n)
                };
                let expected = at(0.5) - at(-0.5);
                assert!((f64::from(d_g[i]) - expected).abs() < 5e-3, "{i}: {} is not {expected}", d_g[i]);
            }
        }
    }

    #[test]
    fn a_dense_level_is_continuous_over_the_whole_cube_and_inactive_levels_are_zero() {
        let grid = HashGrid::new(HashGridOptions { levels: 1, features: 1, log2_entries: 12, coarsest: 4, finest: 4 });
        // theta = x + 10 y + 100 z at the corners must come back everywhere, also on the border and outside.
        let table: Vec<f32> =
            (0..125).map(|i| (i % 5) as f32 + 10.0 * (i / 5 % 5) as f32 + 100.0 * (i / 25) as f32).collect();
        for (p, expected) in [([0.0; 3], 0.0), ([1.0; 3], 444.0), ([0.5, 0.25, 0.8], 332.0), ([2.0, -1.0, 0.0], 4.0)] {
            let mut out = [0.0];
            grid.forward(&table, &[p], 1, &mut out, 1, 0);
            assert!((out[0] - expected).abs() < 1e-3, "{} is not {expected}", out[0]);
            grid.forward(&table, &[p], 0, &mut out, 1, 0);
            assert_eq!(out[0], 0.0);
        }
    }
}
