//! Trilinear sampling of a dense voxel grid with one to sixteen channels.
//!
//! The grid spans the unit cube with its outermost entries on the faces. Data are `[z][y][x][channel]` f32, so that the
//! eight corners of a sample are eight short contiguous reads. `v(x) = sum_c w_c(t) theta_c`, and a loss sends
//! `w_c dv` back to each corner. Outside the cube the value is that of the nearest face.

use mb_geometry::ImageSize;
use rayon::prelude::*;

/// Sizes of a grid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DenseGrid {
    /// Entries along x, y and z, each at least two.
    pub size: [usize; 3],
    /// Numbers per entry.
    pub channels: usize,
}

/// Parts of a scatter that run in parallel; fixed, so that the order of each sum is.
const SLABS: usize = 16;

impl DenseGrid {
    /// Length of the data.
    pub fn len(&self) -> usize {
        let [x, y, z] = self.size;
        ImageSize::new(x, y).pixels() * z * self.channels
    }

    /// Whether there is nothing in it.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    #[inline(always)]
    fn cell(&self, p: [f32; 3]) -> ([usize; 3], [f32; 3]) {
        let mut base = [0; 3];
        let mut t = [0.0; 3];
        for d in 0..3 {
            let last = (self.size[d] - 1) as f32;
            let at = (p[d] * last).clamp(0.0, last);
            base[d] = (at as usize).min(self.size[d] - 2);
            t[d] = at - base[d] as f32;
        }
        (base, t)
    }

    #[inline(always)]
    fn corner(&self, base: [usize; 3], c: usize) -> usize {
        let [x, y, z] = [base[0] + (c & 1), base[1] + (c >> 1 & 1), base[2] + (c >> 2)];
        ((z * self.size[1] + y) * self.size[0] + x) * self.channels
    }

    /// Writes the values at `positions` to `out`: `[samples, stride]`, from column `first`.
    pub fn forward(&self, data: &[f32], positions: &[[f32; 3]], out: &mut [f32], stride: usize, first: usize) {
        for (p, row) in positions.iter().zip(out.chunks_exact_mut(stride)) {
            let (base, t) = self.cell(*p);
            let row = &mut row[first..first + self.channels];
            row.fill(0.0);
            for c in 0..8 {
                let w = weight(t, c);
                let at = self.corner(base, c);
                for (to, from) in row.iter_mut().zip(&data[at..at + self.channels]) {
                    *to += w * from;
                }
            }
        }
    }

    /// Adds to `to` the gradient with respect to position of `g . v(x)`; `g` is `[samples, channels]`.
    pub fn input_gradient(&self, data: &[f32], positions: &[[f32; 3]], g: &[f32], to: &mut [[f32; 3]]) {
        for ((p, g), to) in positions.iter().zip(g.chunks_exact(self.channels)).zip(to) {
            let (base, t) = self.cell(*p);
            for c in 0..8 {
                let at = self.corner(base, c);
                let value: f32 = data[at..at + self.channels].iter().zip(g).map(|(a, b)| a * b).sum();
                let pick = |d: usize| if c >> d & 1 == 1 { t[d] } else { 1.0 - t[d] };
                for d in 0..3 {
                    let others = pick((d + 1) % 3) * pick((d + 2) % 3);
                    let sign = if c >> d & 1 == 1 { 1.0 } else { -1.0 };
                    to[d] += value * others * sign * (self.size[d] - 1) as f32;
                }
            }
        }
    }

    /// Adds what each batch (positions; `[samples, stride]` derivatives from column `first`) sends back to `grads`.
    /// Slabs of the grid run in parallel, samples in their order inside each.
    pub fn scatter(&self, batches: &[(&[[f32; 3]], &[f32])], stride: usize, first: usize, grads: &mut [f32]) {
        let plane = self.size[0] * self.size[1] * self.channels;
        let planes = self.size[2].div_ceil(SLABS);
        grads.par_chunks_mut(planes * plane).enumerate().for_each(|(slab, part)| {
            let (z0, z1) = (slab * planes, ((slab + 1) * planes).min(self.size[2]));
            for (positions, d_out) in batches {
                for (p, row) in positions.iter().zip(d_out.chunks_exact(stride)) {
                    let (base, t) = self.cell(*p);
                    if base[2] + 1 < z0 || base[2] >= z1 {
                        continue;
                    }
                    let row = &row[first..first + self.channels];
                    for c in 0..8 {
                        let z = base[2] + (c >> 2);
                        if z < z0 || z >= z1 {
                            continue;
                        }
                        let w = weight(t, c);
                        let at = self.corner(base, c) - z0 * plane;
                        for (to, from) in part[at..at + self.channels].iter_mut().zip(row) {
                            *to += w * from;
                        }
                    }
                }
            }
        });
    }

    /// The same field on another grid, trilinearly resampled (progressive growing).
    pub fn resampled(&self, data: &[f32], to: &DenseGrid) -> Vec<f32> {
        let [nx, ny, nz] = to.size;
        let unit = |i: usize, n: usize| i as f32 / (n - 1) as f32;
        let mut out = vec![0.0; to.len()];
        out.par_chunks_mut(nx * to.channels).enumerate().for_each(|(row, part)| {
            let (y, z) = (unit(row % ny, ny), unit(row / ny, nz));
            let positions: Vec<[f32; 3]> = (0..nx).map(|x| [unit(x, nx), y, z]).collect();
            self.forward(data, &positions, part, to.channels, 0);
        });
        out
    }
}

#[inline(always)]
fn weight(t: [f32; 3], c: usize) -> f32 {
    let pick = |d: usize| if c >> d & 1 == 1 { t[d] } else { 1.0 - t[d] };
    pick(0) * pick(1) * pick(2)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn a_linear_field_comes_back_exactly_and_survives_growing() {
        let field = |x: f32, y: f32, z: f32| [x + 2.0 * y - z, 3.0 - y];
        let grid = DenseGrid { size: [5, 4, 3], channels: 2 };
        let data: Vec<f32> = (0..60)
            .flat_map(|i| field((i % 5) as f32 / 4.0, (i / 5 % 4) as f32 / 3.0, (i / 20) as f32 / 2.0))
            .collect();
        let grown = DenseGrid { size: [9, 11, 7], channels: 2 };
        for (grid, data) in [(grid, data.clone()), (grown, grid.resampled(&data, &grown))] {
            for p in [[0.0; 3], [1.0; 3], [0.3, 0.7, 0.45], [0.99, 0.01, 0.5]] {
                let mut out = [0.0; 4];
                grid.forward(&data, &[p], &mut out, 4, 1);
                let expected = field(p[0], p[1], p[2]);
                assert!((out[1] - expected[0]).abs() < 1e-5 && (out[2] - expected[1]).abs() < 1e-5, "{out:?}");
            }
        }
    }

    #[test]
    fn the_scatter_is_the_transpose_of_the_sampling_for_any_channel_count() {
        for channels in [1, 3, 12, 16] {
            let grid = DenseGrid { size: [6, 5, 19], channels };
            let mut rng = mb_job::rng(channels as u64, 0);
            let positions: Vec<[f32; 3]> =
                (0..40).map(|_| std::array::from_fn(|_| rng.random_range(-0.1..1.1f32))).collect();
            let data: Vec<f32> = (0..grid.len()).map(|_| rng.random_range(-1.0..1.0)).collect();
            let d_out: Vec<f32> = (0..40 * channels).map(|_| rng.random_range(-1.0..1.0)).collect();
            let mut out = vec![0.0; 40 * channels];
            grid.forward(&data, &positions, &mut out, channels, 0);
            let mut grads = vec![0.0; grid.len()];
            grid.scatter(&[(&positions, &d_out)], channels, 0, &mut grads);
            let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum::<f64>();
            assert!((dot(&out, &d_out) - dot(&data, &grads)).abs() < 1e-3);
        }
    }
}
