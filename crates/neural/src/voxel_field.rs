//! A field of density and colour on dense voxel grids (Sun, Sun and Chen, CVPR 2022, "Direct Voxel Grid Optimization").
//!
//! The density grid holds raw numbers that are interpolated first and activated afterwards ("post-activation", eq. 5 to
//! 8), so that one cell can hold a sharp border: with interpolated raw number r, shift b and step h (in voxels of the
//! base resolution), `alpha = 1 - exp(-h ln(1 + exp(r + b))) = 1 - (1 + exp(r + b))^-h`,
//! `d alpha / d r = h (1 - alpha) sigmoid(r + b)`. With `b = ln((1 - alpha_0)^(-1/h) - 1)` a grid of zeros has the
//! opacity alpha_0 at each step.
//!
//! Colour comes from a second grid: directly, through a sigmoid (the coarse stage), or as features that a small network
//! reads together with frequencies of position and direction.

use mb_job::Rng;
use serde::{Deserialize, Serialize};

use crate::adam::{AdamOptions, Parameters};
use crate::dense_grid::DenseGrid;
use crate::encoding::Frequencies;
use crate::mlp::{Activation, Mlp, MlpCache, MlpShape, Weights};
use crate::radiance_field::{add, sigmoid_all};
use crate::simd::{exp, sigmoid};

/// The network that turns features into colours.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ColorNetworkOptions {
    /// Channels of the feature grid (DVGO: 12).
    pub channels: usize,
    /// Width of the network (DVGO: 128).
    pub width: usize,
    /// Its hidden layers (DVGO: 2, which its code calls depth 3).
    pub hidden: usize,
    /// Octaves of the position (DVGO: 5).
    pub position_octaves: usize,
    /// Octaves of the direction (DVGO: 4).
    pub direction_octaves: usize,
}

/// The field's sizes, worked out.
#[derive(Debug, Clone)]
pub struct VoxelField {
    density: DenseGrid,
    features: DenseGrid,
    network: Option<(Mlp, Frequencies, Frequencies)>,
    /// b.
    shift: f32,
}

/// The field's parts, for a twin on a device.
#[derive(Debug, Clone, Copy)]
pub struct VoxelParts<'a> {
    /// Grid of raw densities.
    pub density: &'a DenseGrid,
    /// Grid of colours (before the sigmoid) or features.
    pub features: &'a DenseGrid,
    /// The colour network, which takes the features, frequencies of the position (in -1..1) and of the direction.
    pub network: Option<(&'a Mlp, Frequencies, Frequencies)>,
    /// b.
    pub shift: f32,
}

/// The field's parameters.
#[derive(Debug, Clone, Default)]
pub struct VoxelParameters {
    /// Raw densities.
    pub density: Parameters,
    /// Colours (before the sigmoid) or features.
    pub features: Parameters,
    /// The colour network; empty without.
    pub network: Parameters,
}

/// Learning rates of one step.
#[derive(Debug, Clone, Copy)]
pub struct VoxelRates {
    /// Raw densities.
    pub density: f32,
    /// Colours or features.
    pub features: f32,
    /// The network.
    pub network: f32,
}

/// Buffers for one worker: a tile in flight, and what it has gathered since the last [`VoxelField::collect`].
#[derive(Debug, Default)]
pub struct VoxelWorker {
    raw: Vec<f32>,
    step: f32,
    /// Opacity of each sample of the tile.
    pub alphas: Vec<f32>,
    /// Colour of each sample of the tile.
    pub rgb: Vec<[f32; 3]>,
    /// To be filled before [`VoxelField::backward`].
    pub d_alphas: Vec<f32>,
    /// To be filled before [`VoxelField::backward`].
    pub d_rgb: Vec<[f32; 3]>,
    /// By [`VoxelField::ray_gradients`].
    pub d_positions: Vec<[f32; 3]>,
    /// By [`VoxelField::ray_gradients`].
    pub d_directions: Vec<[f32; 3]>,
    inputs: Vec<f32>,
    network: MlpCache,
    d_out: Vec<f32>,
    network_grads: Vec<f32>,
    positions: Vec<[f32; 3]>,
    d_raw: Vec<f32>,
    d_features: Vec<f32>,
    first: usize,
}

impl VoxelField {
    /// Works out the sizes. `start_alpha` is the opacity of a grid of zeros at a step of `start_step` base voxels.
    pub fn new(size: [usize; 3], network: Option<&ColorNetworkOptions>, start_alpha: f32, start_step: f32) -> Self {
        let channels = network.map_or(3, |n| n.channels);
        let network = network.map(|n| {
            let (position, direction) = (Frequencies(n.position_octaves), Frequencies(n.direction_octaves));
            let shape = MlpShape {
                inputs: n.channels + position.width() + direction.width(),
                width: n.width,
                hidden: n.hidden,
                outputs: 3,
                activation: Activation::Relu,
                skip: None,
            };
            (Mlp::new(shape), position, direction)
        });
        Self {
            density: DenseGrid { size, channels: 1 },
            features: DenseGrid { size, channels },
            network,
            shift: ((1.0 - f64::from(start_alpha)).powf(-1.0 / f64::from(start_step)) - 1.0).ln() as f32,
        }
    }

    /// What it is made of.
    pub fn parts(&self) -> VoxelParts<'_> {
        let network = self.network.as_ref().map(|(mlp, position, direction)| (mlp, *position, *direction));
        VoxelParts { density: &self.density, features: &self.features, network, shift: self.shift }
    }

    /// Voxels along x, y and z.
    pub fn size(&self) -> [usize; 3] {
        self.density.size
    }

    /// Parameters at their start: grids of zeros.
    pub fn init(&self, rng: &mut Rng) -> VoxelParameters {
        let zeros = |grid: &DenseGrid| Parameters::new(vec![0.0; grid.len()]);
        let network = match &self.network {
            Some((mlp, ..)) => {
                let mut values = mlp.init_uniform(rng);
                // DVGO starts the last bias at zero: grey.
                if let Some((_, outputs, .., bias)) = mlp.layout().last() {
                    values[bias..bias + outputs].fill(0.0);
                }
                Parameters::new(values)
            }
            None => Parameters::default(),
        };
        VoxelParameters { density: zeros(&self.density), features: zeros(&self.features), network }
    }

    /// Number of parameters, padding not counted.
    pub fn parameter_count(&self) -> usize {
        self.density.len() + self.features.len() + self.network.as_ref().map_or(0, |(mlp, ..)| mlp.parameter_count())
    }

    /// Lengths of the parameter buffers.
    pub fn lengths(&self) -> [usize; 3] {
        [self.density.len(), self.features.len(), self.network.as_ref().map_or(0, |(mlp, ..)| mlp.buffer_len())]
    }

    /// The transposed weights for a step.
    pub fn transpose(&self, p: &VoxelParameters) -> Vec<f32> {
        self.network.as_ref().map_or_else(Vec::new, |(mlp, ..)| mlp.transpose(&p.network.values))
    }

    /// The same field on other grids, resampled (progressive growing); moments start anew.
    pub fn grown(&self, p: &VoxelParameters, size: [usize; 3]) -> (Self, VoxelParameters) {
        let mut to = self.clone();
        (to.density.size, to.features.size) = (size, size);
        let parameters = VoxelParameters {
            density: Parameters::new(self.density.resampled(&p.density.values, &to.density)),
            features: Parameters::new(self.features.resampled(&p.features.values, &to.features)),
            network: p.network.clone(),
        };
        (to, parameters)
    }

    /// Opacities at positions of the unit cube for steps of `step` base voxels.
    pub fn opacities(&self, p: &VoxelParameters, positions: &[[f32; 3]], step: f32, out: &mut Vec<f32>) {
        out.resize(positions.len(), 0.0);
        self.density.forward(&p.density.values, positions, out, 1, 0);
        out.iter_mut().for_each(|raw| *raw = self.alpha(*raw, step));
    }

    fn alpha(&self, raw: f32, step: f32) -> f32 {
        let x = raw + self.shift;
        // softplus(x) = max(x, 0) + ln(1 + exp(-|x|)).
        let softplus = x.max(0.0) + exp(-x.abs()).ln_1p();
        -(-step * softplus).exp_m1()
    }

    /// Computes `worker.alphas` of the tile for steps of `step` base voxels.
    pub fn alphas(&self, p: &VoxelParameters, positions: &[[f32; 3]], step: f32, worker: &mut VoxelWorker) {
        worker.step = step;
        worker.raw.resize(positions.len(), 0.0);
        self.density.forward(&p.density.values, positions, &mut worker.raw, 1, 0);
        worker.alphas.clear();
        worker.alphas.extend(worker.raw.iter().map(|raw| self.alpha(*raw, step)));
    }

    /// Keeps the samples that `keep` names (ascending) of a tile whose opacities have been computed.
    pub fn compact(keep: &[u32], worker: &mut VoxelWorker) {
        for buffer in [&mut worker.raw, &mut worker.alphas] {
            for (to, from) in keep.iter().enumerate() {
                buffer[to] = buffer[*from as usize];
            }
            buffer.truncate(keep.len());
        }
    }

    fn in_stride(&self) -> usize {
        self.network.as_ref().map_or(3, |(mlp, ..)| mlp.in_stride())
    }

    /// Computes the colours of the tile's samples. `rays` are runs of samples: how many, in which (unit) direction.
    pub fn color(
        &self,
        p: &VoxelParameters,
        positions: &[[f32; 3]],
        rays: &[(u32, [f32; 3])],
        worker: &mut VoxelWorker,
    ) {
        let stride = self.in_stride();
        worker.inputs.resize(positions.len() * stride, 0.0);
        self.features.forward(&p.features.values, positions, &mut worker.inputs, stride, 0);
        worker.rgb.clear();
        let Some((mlp, position, direction)) = &self.network else {
            let colors = worker.inputs.chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(sigmoid));
            worker.rgb.extend(colors);
            return;
        };
        let first = self.features.channels;
        // Positions as the original has them: in -1..1.
        let centred: Vec<[f32; 3]> = positions.iter().map(|p| p.map(|c| 2.0 * c - 1.0)).collect();
        position.forward(&centred, &mut worker.inputs, stride, first);
        let mut encoded = vec![0.0; direction.width()];
        let mut rows = worker.inputs.chunks_exact_mut(stride);
        for (count, d) in rays {
            direction.forward(&[*d], &mut encoded, direction.width(), 0);
            for row in rows.by_ref().take(*count as usize) {
                row[first + position.width()..][..encoded.len()].copy_from_slice(&encoded);
            }
        }
        mlp.forward(&p.network.values, &worker.inputs, stride, positions.len(), &mut worker.network);
        sigmoid_all(&mut worker.network.out);
        worker.rgb.extend(worker.network.out.chunks_exact(mlp.out_stride()).map(|o| [o[0], o[1], o[2]]));
    }

    /// Sends `worker.d_alphas` and `worker.d_rgb` back: gathers the network's gradient in the worker, and what the grids
    /// will scatter.
    pub fn backward(&self, p: &VoxelParameters, transposed: &[f32], positions: &[[f32; 3]], worker: &mut VoxelWorker) {
        worker.first = worker.positions.len();
        worker.positions.extend_from_slice(positions);
        let raw = worker.raw.iter().zip(&worker.alphas).zip(&worker.d_alphas);
        worker.d_raw.extend(raw.map(|((raw, a), d)| d * worker.step * (1.0 - a) * sigmoid(raw + self.shift)));
        let d_logits = worker.d_rgb.iter().zip(&worker.rgb);
        let d_logits = d_logits.map(|(d, c)| -> [f32; 3] { std::array::from_fn(|i| d[i] * c[i] * (1.0 - c[i])) });
        let Some((mlp, ..)) = &self.network else {
            worker.d_features.extend(d_logits.flatten());
            return;
        };
        let stride = mlp.out_stride();
        worker.d_out.clear();
        worker.d_out.resize(positions.len() * stride, 0.0);
        for (to, d) in worker.d_out.chunks_exact_mut(stride).zip(d_logits) {
            to[..3].copy_from_slice(&d);
        }
        worker.network_grads.resize(mlp.buffer_len(), 0.0);
        mlp.backward(
            &Weights { parameters: &p.network.values, transposed },
            &worker.inputs,
            self.in_stride(),
            &mut worker.network,
            &worker.d_out,
            None,
            &mut worker.network_grads,
            true,
        );
        let rows = worker.network.d_input.chunks_exact(self.in_stride()).take(positions.len());
        worker.d_features.extend(rows.flat_map(|row| &row[..self.features.channels]));
    }

    /// After [`Self::backward`]: the derivatives with respect to the tile's positions (unit cube) and the directions of
    /// its rays.
    pub fn ray_gradients(&self, p: &VoxelParameters, rays: &[(u32, [f32; 3])], worker: &mut VoxelWorker) {
        let (first, channels) = (worker.first, self.features.channels);
        let positions = &worker.positions[first..];
        let mut to = vec![[0.0; 3]; positions.len()];
        self.density.input_gradient(&p.density.values, positions, &worker.d_raw[first..], &mut to);
        self.features.input_gradient(&p.features.values, positions, &worker.d_features[first * channels..], &mut to);
        worker.d_directions.clear();
        match &self.network {
            None => worker.d_directions.resize(rays.len(), [0.0; 3]),
            Some((_, position, direction)) => {
                let stride = self.in_stride();
                let mut halves = vec![[0.0; 3]; to.len()];
                position.input_gradient(&worker.inputs, &worker.network.d_input, stride, channels, &mut halves);
                for (to, half) in to.iter_mut().zip(&halves) {
                    (0..3).for_each(|d| to[d] += 2.0 * half[d]);
                }
                let columns = channels + position.width();
                let mut row = 0;
                for (count, _) in rays {
                    let mut d = [[0.0; 3]];
                    for _ in 0..*count {
                        let at = row * stride..(row + 1) * stride;
                        let (e, g) = (&worker.inputs[at.clone()], &worker.network.d_input[at]);
                        direction.input_gradient(e, g, stride, columns, &mut d);
                        row += 1;
                    }
                    worker.d_directions.push(d[0]);
                }
            }
        }
        worker.d_positions = to;
    }

    /// Adds everything that the workers gathered to the parameters' gradients, in the workers' order, and clears it.
    pub fn collect<'a>(&self, p: &mut VoxelParameters, workers: impl Iterator<Item = &'a mut VoxelWorker>) {
        let workers: Vec<&mut VoxelWorker> = workers.collect();
        let batches = |pick: fn(&VoxelWorker) -> &[f32]| -> Vec<(&[[f32; 3]], &[f32])> {
            workers.iter().map(|w| (w.positions.as_slice(), pick(w))).collect()
        };
        self.density.scatter(&batches(|w| &w.d_raw), 1, 0, &mut p.density.grads);
        let channels = self.features.channels;
        self.features.scatter(&batches(|w| &w.d_features), channels, 0, &mut p.features.grads);
        for worker in workers {
            add(&mut p.network.grads, &worker.network_grads);
            worker.network_grads.fill(0.0);
            worker.positions.clear();
            worker.d_raw.clear();
            worker.d_features.clear();
        }
    }
}

/// Adam's constants (DVGO: beta2 = 0.99).
pub const ADAM: AdamOptions = AdamOptions { beta1: 0.9, beta2: 0.99, epsilon: 1e-8, skip_untouched: false };

impl VoxelParameters {
    /// One Adam step, number `t` from 1. Voxels that no sample touched keep their value. With
    /// `per_voxel`, the density's and the features' rates are scaled voxel by voxel.
    pub fn step(&mut self, rates: VoxelRates, per_voxel: Option<&[f32]>, t: u64) {
        let grids = AdamOptions { skip_untouched: true, ..ADAM };
        self.density.step_scaled(&grids, rates.density, t, per_voxel.map(|s| (s, 1)));
        let channels = self.features.values.len() / self.density.values.len().max(1);
        self.features.step_scaled(&grids, rates.features, t, per_voxel.map(|s| (s, channels)));
        self.network.step(&ADAM, rates.network, t);
    }

    /// All buffers that a checkpoint holds.
    pub fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        [&mut self.density, &mut self.features, &mut self.network]
            .into_iter()
            .flat_map(|p| [&mut p.values, &mut p.m, &mut p.v])
            .collect()
    }

    /// After a checkpoint has been read: gradients of the right length.
    pub fn restored(&mut self) {
        for p in [&mut self.density, &mut self.features, &mut self.network] {
            p.grads.clear();
            p.grads.resize(p.values.len(), 0.0);
        }
    }

    /// Whether every parameter is a finite number.
    pub fn is_finite(&self) -> bool {
        [&self.density, &self.features, &self.network].into_iter().all(Parameters::is_finite)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    const NETWORK: ColorNetworkOptions =
        ColorNetworkOptions { channels: 5, width: 16, hidden: 2, position_octaves: 2, direction_octaves: 1 };

    #[test]
    fn a_grid_of_zeros_has_the_opacity_that_it_was_given() {
        for (alpha, step) in [(1e-6, 0.5), (1e-2, 0.5), (1e-2, 2.0)] {
            let field = VoxelField::new([4; 3], None, alpha, step);
            let p = field.init(&mut mb_job::rng(0, 0));
            let mut out = Vec::new();
            field.opacities(&p, &[[0.3, 0.6, 0.9]], step, &mut out);
            assert!((out[0] / alpha - 1.0).abs() < 0.02, "{} is not {alpha}", out[0]);
        }
    }

    #[test]
    fn derivatives_of_the_whole_field_agree_with_finite_differences() {
        for network in [None, Some(&NETWORK)] {
            let field = VoxelField::new([4, 5, 6], network, 1e-2, 0.5);
            let mut rng = mb_job::rng(3, 0);
            let mut p = field.init(&mut rng);
            for values in [&mut p.density.values, &mut p.features.values] {
                values.iter_mut().for_each(|v| *v = rng.random_range(2.0..6.0));
            }
            let positions: Vec<[f32; 3]> =
                (0..6).map(|_| std::array::from_fn(|_| rng.random_range(0.05..0.95f32))).collect();
            let rays = [(2, [0.0, 0.6, 0.8]), (4, [1.0, 0.0, 0.0])];
            let d_alphas: Vec<f32> = (0..6).map(|_| rng.random_range(-1.0..1.0)).collect();
            let d_rgb: Vec<[f32; 3]> =
                (0..6).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0f32))).collect();
            let run = |p: &VoxelParameters, positions: &[[f32; 3]], rays: &[(u32, [f32; 3])]| {
                let mut w = VoxelWorker::default();
                field.alphas(p, positions, 0.7, &mut w);
                field.color(p, positions, rays, &mut w);
                w
            };
            let loss = |p: &VoxelParameters, positions: &[[f32; 3]], rays: &[(u32, [f32; 3])]| {
                let w = run(p, positions, rays);
                let alphas = w.alphas.iter().zip(&d_alphas).map(|(a, b)| f64::from(a * b)).sum::<f64>();
                let colors = w.rgb.iter().flatten().zip(d_rgb.iter().flatten());
                alphas + colors.map(|(a, b)| f64::from(a * b)).sum::<f64>()
            };
            let mut worker = run(&p, &positions, &rays);
            (worker.d_alphas, worker.d_rgb) = (d_alphas.clone(), d_rgb.clone());
            field.backward(&p, &field.transpose(&p), &positions, &mut worker);
            field.ray_gradients(&p, &rays, &mut worker);
            let close = |found: f32, expected: f64, what: &str| {
                assert!((f64::from(found) - expected).abs() < 4e-3, "{what}: {found} is not {expected}");
            };
            for (s, d) in [(0, 1), (3, 0), (5, 2)] {
                let at = |h: f32| {
                    let mut positions = positions.clone();
                    positions[s][d] += h;
                    loss(&p, &positions, &rays)
                };
                close(worker.d_positions[s][d], (at(1e-3) - at(-1e-3)) / 2e-3, "position");
                let at = |h: f32| {
                    let mut rays = rays;
                    rays[s / 3].1[d] += h;
                    loss(&p, &positions, &rays)
                };
                close(worker.d_directions[s / 3][d], (at(1e-2) - at(-1e-2)) / 2e-2, "direction");
            }
            field.collect(&mut p, std::iter::once(&mut worker));
            let buffers: [fn(&mut VoxelParameters) -> &mut Parameters; 3] =
                [|p| &mut p.density, |p| &mut p.features, |p| &mut p.network];
            for (b, buffer) in buffers.into_iter().enumerate() {
                let grads = buffer(&mut p).grads.clone();
                let mut misses = 0;
                for i in (0..grads.len()).step_by(5) {
                    let at = |h: f32| {
                        let mut p = p.clone();
                        buffer(&mut p).values[i] += h;
                        loss(&p, &positions, &rays)
                    };
                    misses += usize::from((f64::from(grads[i]) - (at(5e-3) - at(-5e-3)) / 1e-2).abs() > 2e-3);
                }
                // A step may cross a kink of ReLU; that is rare, and a wrong formula is not.
                assert!(misses * 100 <= grads.len(), "buffer {b}: {misses} derivatives are wrong");
            }
        }
    }

    #[test]
    fn a_grown_field_is_the_same_field() {
        let field = VoxelField::new([3, 4, 5], None, 1e-2, 0.5);
        let mut rng = mb_job::rng(4, 0);
        let mut p = field.init(&mut rng);
        // Linear in position, so that every grid holds it exactly.
        p.density.values.iter_mut().enumerate().for_each(|(i, v)| *v = (i % 3) as f32);
        let (grown, q) = field.grown(&p, [9, 7, 6]);
        let (mut a, mut b) = (Vec::new(), Vec::new());
        field.opacities(&p, &[[0.2, 0.4, 0.9], [0.77, 0.1, 0.5]], 0.5, &mut a);
        grown.opacities(&q, &[[0.2, 0.4, 0.9], [0.77, 0.1, 0.5]], 0.5, &mut b);
        assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-5), "{a:?} is not {b:?}");
    }
}
