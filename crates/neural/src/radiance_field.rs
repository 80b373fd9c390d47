//! A field of density and colour: hash encoding, a small density network, a small colour network (instant-ngp).
//!
//! `e = hash(u)`, `(o_0, ..., o_15) = density network(e)`, `sigma = exp(o_0 - 1)`,
//! `c = sigmoid(colour network(o_0, ..., o_15, harmonics(d)))`. Backward: `d o_0 += sigma d sigma` (with the exponent
//! held to +-15), the colour network's derivative with respect to its input gives the other `d o`, and the density
//! network's gives `d e`, which the hash grid scatters once the whole batch is through.

use mb_job::Rng;
use serde::{Deserialize, Serialize};

use crate::adam::{AdamOptions, Parameters};
use crate::encoding::{HARMONICS, harmonics_gradient, spherical_harmonics};
use crate::hash_grid::{HashGrid, HashGridOptions, Scatter};
use crate::mlp::{Activation, Mlp, MlpCache, MlpShape, Weights};
use crate::simd::{dispatched, exp, padded, sigmoid};

/// Numbers that the density network hands to the colour network.
pub const GEOMETRY: usize = 16;
/// Row length of the colour network's input.
const COLOR_IN: usize = GEOMETRY + HARMONICS;

/// Sizes of the field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RadianceFieldOptions {
    /// The encoding.
    pub grid: HashGridOptions,
    /// Width of both networks.
    pub width: usize,
    /// Hidden layers of the colour network; the density network has one.
    pub color_hidden: usize,
}

/// Of all parameters (instant-ngp, appendix). The table also skips what no sample touched.
pub const ADAM: AdamOptions = AdamOptions { beta1: 0.9, beta2: 0.99, epsilon: 1e-15, skip_untouched: false };

/// The field's sizes, worked out.
#[derive(Debug, Clone)]
pub struct RadianceField {
    grid: HashGrid,
    density: Mlp,
    color: Mlp,
}

/// The field's parameters.
#[derive(Debug, Clone)]
pub struct RadianceParameters {
    /// The hash table.
    pub table: Parameters,
    /// The density network.
    pub density: Parameters,
    /// The colour network.
    pub color: Parameters,
}

/// Transposed weights of both networks, made once a step.
#[derive(Debug)]
pub struct Transposed {
    density: Vec<f32>,
    color: Vec<f32>,
}

/// Buffers for one worker: a tile in flight, and the gradients that it has gathered since the last
/// [`RadianceField::collect`].
#[derive(Debug, Default)]
pub struct RadianceWorker {
    features: Vec<f32>,
    density: MlpCache,
    color_in: Vec<f32>,
    color: MlpCache,
    /// Density of each sample of the tile.
    pub sigma: Vec<f32>,
    /// Colour of each sample of the tile.
    pub rgb: Vec<[f32; 3]>,
    /// To be filled before [`RadianceField::backward`].
    pub d_sigma: Vec<f32>,
    /// To be filled before [`RadianceField::backward`].
    pub d_rgb: Vec<[f32; 3]>,
    /// By [`RadianceField::ray_gradients`].
    pub d_positions: Vec<[f32; 3]>,
    /// By [`RadianceField::ray_gradients`].
    pub d_directions: Vec<[f32; 3]>,
    d_out: Vec<f32>,
    density_grads: Vec<f32>,
    color_grads: Vec<f32>,
    positions: Vec<[f32; 3]>,
    d_features: Vec<f32>,
}

impl RadianceField {
    /// Works out the sizes.
    pub fn new(options: &RadianceFieldOptions) -> Self {
        let grid = HashGrid::new(options.grid);
        let shape = |inputs, hidden, outputs| {
            Mlp::new(MlpShape {
                inputs,
                width: options.width,
                hidden,
                outputs,
                activation: Activation::Relu,
                skip: None,
            })
        };
        let density = shape(grid.width(), 1, GEOMETRY);
        let color = shape(COLOR_IN, options.color_hidden, 3);
        Self { grid, density, color }
    }

    /// The encoding, the density network and the colour network.
    pub fn parts(&self) -> (&HashGrid, &Mlp, &Mlp) {
        (&self.grid, &self.density, &self.color)
    }

    /// Parameters at their start.
    pub fn init(&self, rng: &mut Rng) -> RadianceParameters {
        RadianceParameters {
            table: Parameters::new(self.grid.init(rng)),
            density: Parameters::new(self.density.init_uniform(rng)),
            color: Parameters::new(self.color.init_uniform(rng)),
        }
    }

    /// Number of parameters, padding not counted.
    pub fn parameter_count(&self) -> usize {
        self.grid.len() + self.density.parameter_count() + self.color.parameter_count()
    }

    /// Bytes that a step keeps of each sample until its scatter.
    pub fn bytes_per_sample(&self) -> usize {
        4 * self.stride() + 12
    }

    /// The transposed weights for a step.
    pub fn transpose(&self, p: &RadianceParameters) -> Transposed {
        Transposed { density: self.density.transpose(&p.density.values), color: self.color.transpose(&p.color.values) }
    }

    fn stride(&self) -> usize {
        padded(self.grid.width())
    }

    /// Encodes the tile's positions (unit cube) and computes the density alone: `worker.sigma`.
    pub fn density(&self, p: &RadianceParameters, positions: &[[f32; 3]], worker: &mut RadianceWorker) {
        let stride = self.stride();
        worker.features.resize(positions.len() * stride, 0.0);
        self.grid.forward(&p.table.values, positions, self.grid.levels(), &mut worker.features, stride, 0);
        self.density_of_features(p, positions.len(), worker);
    }

    fn density_of_features(&self, p: &RadianceParameters, rows: usize, worker: &mut RadianceWorker) {
        self.density.forward(&p.density.values, &worker.features, self.stride(), rows, &mut worker.density);
        worker.sigma.clear();
        worker.sigma.extend(worker.density.out.chunks_exact(GEOMETRY).map(|o| exp((o[0] - 1.0).clamp(-15.0, 15.0))));
    }

    /// Keeps the samples that `keep` names (ascending) of a tile whose density has been computed.
    pub fn compact(&self, p: &RadianceParameters, keep: &[u32], worker: &mut RadianceWorker) {
        let stride = self.stride();
        for (to, from) in keep.iter().enumerate() {
            let from = *from as usize * stride;
            worker.features.copy_within(from..from + stride, to * stride);
        }
        worker.features.truncate(keep.len() * stride);
        self.density_of_features(p, keep.len(), worker);
    }

    /// Computes the colours of a tile whose density has been computed. `rays` are runs of samples: how many, and in
    /// which (unit) direction.
    pub fn color(&self, p: &RadianceParameters, rays: &[(u32, [f32; 3])], worker: &mut RadianceWorker) {
        let rows = worker.sigma.len();
        worker.color_in.resize(rows * COLOR_IN, 0.0);
        let mut row = 0;
        for (count, direction) in rays {
            let harmonics = spherical_harmonics(*direction);
            for _ in 0..*count {
                let to = &mut worker.color_in[row * COLOR_IN..(row + 1) * COLOR_IN];
                to[..GEOMETRY].copy_from_slice(&worker.density.out[row * GEOMETRY..(row + 1) * GEOMETRY]);
                to[GEOMETRY..].copy_from_slice(&harmonics);
                row += 1;
            }
        }
        debug_assert_eq!(row, rows);
        self.color.forward(&p.color.values, &worker.color_in, COLOR_IN, rows, &mut worker.color);
        sigmoid_all(&mut worker.color.out);
        worker.rgb.clear();
        worker.rgb.extend(worker.color.out.chunks_exact(self.color.out_stride()).map(|o| [o[0], o[1], o[2]]));
    }

    /// Sends `worker.d_sigma` and `worker.d_rgb` back: gathers the networks' gradients in the worker, and what the hash
    /// grid will scatter. `positions` are those of the (compacted) tile.
    pub fn backward(
        &self,
        p: &RadianceParameters,
        transposed: &Transposed,
        positions: &[[f32; 3]],
        worker: &mut RadianceWorker,
    ) {
        let (rows, stride) = (positions.len(), self.color.out_stride());
        worker.density_grads.resize(self.density.buffer_len(), 0.0);
        worker.color_grads.resize(self.color.buffer_len(), 0.0);
        worker.d_out.clear();
        worker.d_out.resize(rows * stride, 0.0);
        for ((to, d), c) in worker.d_out.chunks_exact_mut(stride).zip(&worker.d_rgb).zip(&worker.rgb) {
            for i in 0..3 {
                to[i] = d[i] * c[i] * (1.0 - c[i]);
            }
        }
        let color = Weights { parameters: &p.color.values, transposed: &transposed.color };
        self.color.backward(
            &color,
            &worker.color_in,
            COLOR_IN,
            &mut worker.color,
            &worker.d_out,
            None,
            &mut worker.color_grads,
            true,
        );
        worker.d_out.resize(rows * GEOMETRY, 0.0);
        let sources =
            worker.color.d_input.chunks_exact(self.color.in_stride()).zip(worker.sigma.iter().zip(&worker.d_sigma));
        for (to, (from, (sigma, d_sigma))) in worker.d_out.chunks_exact_mut(GEOMETRY).zip(sources) {
            to.copy_from_slice(&from[..GEOMETRY]);
            to[0] += sigma * d_sigma;
        }
        let density = Weights { parameters: &p.density.values, transposed: &transposed.density };
        self.density.backward(
            &density,
            &worker.features,
            self.stride(),
            &mut worker.density,
            &worker.d_out,
            None,
            &mut worker.density_grads,
            true,
        );
        worker.positions.extend_from_slice(positions);
        worker.d_features.extend_from_slice(&worker.density.d_input[..rows * self.stride()]);
    }

    /// After [`Self::backward`]: the derivatives with respect to the tile's positions (unit cube) and to the directions
    /// of its rays, in `worker.d_positions` and `worker.d_directions`.
    pub fn ray_gradients(
        &self,
        p: &RadianceParameters,
        positions: &[[f32; 3]],
        rays: &[(u32, [f32; 3])],
        worker: &mut RadianceWorker,
    ) {
        worker.d_positions.clear();
        worker.d_positions.resize(positions.len(), [0.0; 3]);
        let (stride, d_features) = (self.stride(), &worker.density.d_input);
        let levels = self.grid.levels();
        self.grid.input_gradient(&p.table.values, positions, levels, d_features, stride, 0, &mut worker.d_positions);
        worker.d_directions.clear();
        let mut rows = worker.color.d_input.chunks_exact(self.color.in_stride());
        for (count, direction) in rays {
            let mut d = [0.0; 3];
            for row in rows.by_ref().take(*count as usize) {
                harmonics_gradient(*direction, &row[GEOMETRY..GEOMETRY + HARMONICS], &mut d);
            }
            worker.d_directions.push(d);
        }
    }

    /// Adds everything that the workers gathered to the parameters' gradients, in the workers' order, and clears it.
    pub fn collect<'a>(&self, p: &mut RadianceParameters, workers: impl Iterator<Item = &'a mut RadianceWorker>) {
        let workers: Vec<&mut RadianceWorker> = workers.collect();
        let stride = self.stride();
        let batches: Vec<Scatter<'_>> = workers
            .iter()
            .map(|w| Scatter { positions: &w.positions, d_features: &w.d_features, gradient: None, stride, first: 0 })
            .collect();
        self.grid.scatter(&batches, self.grid.levels(), &mut p.table.grads);
        for worker in workers {
            add(&mut p.density.grads, &worker.density_grads);
            add(&mut p.color.grads, &worker.color_grads);
            worker.density_grads.fill(0.0);
            worker.color_grads.fill(0.0);
            worker.positions.clear();
            worker.d_features.clear();
        }
    }
}

impl RadianceParameters {
    /// One Adam step, number `t` from 1. The table skips what no sample touched.
    pub fn step(&mut self, lr: f32, t: u64) {
        self.table.step(&AdamOptions { skip_untouched: true, ..ADAM }, lr, t);
        self.density.step(&ADAM, lr, t);
        self.color.step(&ADAM, lr, t);
    }

    /// All buffers that a checkpoint holds.
    pub fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        [&mut self.table, &mut self.density, &mut self.color]
            .into_iter()
            .flat_map(|p| [&mut p.values, &mut p.m, &mut p.v])
            .collect()
    }

    /// Lengths of the buffers.
    pub fn lengths(&self) -> Vec<usize> {
        [&self.table, &self.density, &self.color].into_iter().flat_map(|p| [p.grads.len(); 3]).collect()
    }

    /// Whether every parameter is a finite number.
    pub fn is_finite(&self) -> bool {
        [&self.table, &self.density, &self.color].into_iter().all(Parameters::is_finite)
    }
}

/// `to += from`; an empty `from` (a worker that had nothing to do) adds nothing.
pub(crate) fn add(to: &mut [f32], from: &[f32]) {
    for (to, from) in to.iter_mut().zip(from) {
        *to += from;
    }
}

#[inline(always)]
fn sigmoid_body(values: &mut [f32]) {
    for v in values {
        *v = sigmoid(*v);
    }
}
dispatched! { pub(crate) fn sigmoid_all(values: &mut [f32]) = sigmoid_body }

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn derivatives_of_the_whole_field_agree_with_finite_differences() {
        let field = RadianceField::new(&RadianceFieldOptions {
            grid: HashGridOptions { levels: 2, features: 4, log2_entries: 8, coarsest: 3, finest: 7 },
            width: 16,
            color_hidden: 1,
        });
        let mut rng = mb_job::rng(5, 0);
        let mut p = field.init(&mut rng);
        p.table.values.iter_mut().for_each(|v| *v = rng.random_range(-1.0..1.0));
        let positions: Vec<[f32; 3]> = (0..6).map(|_| std::array::from_fn(|_| rng.random_range(0.1..0.9f32))).collect();
        let rays = [(2, [0.0, 0.6, 0.8]), (4, [1.0, 0.0, 0.0])];
        let d_sigma: Vec<f32> = (0..6).map(|_| rng.random_range(-1.0..1.0)).collect();
        let d_rgb: Vec<[f32; 3]> = (0..6).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0f32))).collect();
        let loss = |p: &RadianceParameters, positions: &[[f32; 3]], rays: &[(u32, [f32; 3])]| {
            let mut w = RadianceWorker::default();
            field.density(p, positions, &mut w);
            field.color(p, rays, &mut w);
            let sigma: f64 = w.sigma.iter().zip(&d_sigma).map(|(a, b)| f64::from(a * b)).sum();
            sigma
                + w.rgb
                    .iter()
                    .zip(&d_rgb)
                    .map(|(a, b)| (0..3).map(|i| f64::from(a[i] * b[i])).sum::<f64>())
                    .sum::<f64>()
        };
        let mut worker = RadianceWorker::default();
        field.density(&p, &positions, &mut worker);
        field.color(&p, &rays, &mut worker);
        (worker.d_sigma, worker.d_rgb) = (d_sigma.clone(), d_rgb.clone());
        field.backward(&p, &field.transpose(&p), &positions, &mut worker);
        field.collect(&mut p, std::iter::once(&mut worker));
        field.ray_gradients(&p, &positions, &rays, &mut worker);
        for (s, d) in [(0, 1), (3, 0), (5, 2)] {
            let at = |h: f32| {
                let mut positions = positions.clone();
                positions[s][d] += h;
                loss(&p, &positions, &rays)
            };
            let expected = (at(1e-3) - at(-1e-3)) / 2e-3;
            let found = f64::from(worker.d_positions[s][d]);
            assert!((found - expected).abs() < 0.02 * expected.abs().max(0.5), "{found} is not {expected}");
            let at = |h: f32| {
                let mut rays = rays;
                rays[s / 3].1[d] += h;
                loss(&p, &positions, &rays)
            };
            let (found, expected) = (f64::from(worker.d_directions[s / 3][d]), (at(1e-2) - at(-1e-2)) / 2e-2);
            assert!((found - expected).abs() < 0.02 * expected.abs().max(0.5), "{found} is not {expected}");
        }
        let buffers: [fn(&mut RadianceParameters) -> &mut Parameters; 3] =
            [|p| &mut p.table, |p| &mut p.density, |p| &mut p.color];
        for (b, buffer) in buffers.into_iter().enumerate() {
            let grads = buffer(&mut p).grads.clone();
            let mut misses = 0;
            let largest = grads.iter().fold(0.0f32, |a, g| a.max(g.abs()));
            for i in (0..grads.len()).step_by(7) {
                let at = |h: f32| {
                    let mut p = p.clone();
                    buffer(&mut p).values[i] += h;
                    loss(&p, &positions, &rays)
                };
                let expected = (at(2e-3) - at(-2e-3)) / 4e-3;
                // A step may cross a kink of ReLU; that is rare, and a wrong formula is not.
                misses += usize::from((f64::from(grads[i]) - expected).abs() > 0.01 * f64::from(largest));
            }
            assert!(
                misses * 50 <= grads.len() / 7,
                "buffer {b}: {misses} of {} derivatives are wrong",
                grads.len() / 7
            );
        }
    }
}
