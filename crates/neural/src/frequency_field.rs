//! The radiance field of the original NeRF (Mildenhall et al. 2020): one network on frequencies of the position gives
//! density and features, a second one turns features and direction into a colour.
//!
//! `(o, f) = trunk(gamma(x))`, `sigma = relu(o)` (NeRF) or `softplus(o)` (NeRF++ behind NeuS), `c = sigmoid(head(f,
//! gamma(d)))`. The trunk's last layer is linear; its output 0 is `alpha_linear` of the authors' code and the rest
//! `feature_linear`. Positions have three coordinates, or four (NeRF++: a unit direction and an inverse distance).

use mb_job::Rng;
use serde::{Deserialize, Serialize};

use crate::adam::{AdamOptions, Parameters};
use crate::encoding::Frequencies;
use crate::mlp::{Activation, Mlp, MlpCache, MlpShape, Skip, Weights};
use crate::radiance_field::{add, sigmoid_all};
use crate::simd::{exp, sigmoid};

/// How a density follows from the network's number.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DensityActivation {
    /// max(o, 0).
    Relu,
    /// ln(1 + exp(o)).
    Softplus,
}

/// Sizes of the field.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrequencyFieldOptions {
    /// Octaves of the position (NeRF: 10).
    pub position_octaves: usize,
    /// Octaves of the direction (NeRF: 4).
    pub direction_octaves: usize,
    /// Width of the trunk, and number of features (NeRF: 256).
    pub width: usize,
    /// Hidden layers of the trunk (NeRF: 8).
    pub hidden: usize,
    /// Layer of the trunk that sees the position again, counted from 0 (NeRF: 5).
    pub skip: usize,
    /// Width of the head's one hidden layer (NeRF: 128).
    pub head_width: usize,
    /// From number to density.
    pub activation: DensityActivation,
}

impl FrequencyFieldOptions {
    /// The paper's.
    pub const PAPER: Self = Self {
        position_octaves: 10,
        direction_octaves: 4,
        width: 256,
        hidden: 8,
        skip: 5,
        head_width: 128,
        activation: DensityActivation::Relu,
    };
}

/// The field's sizes, worked out, for positions of D coordinates.
#[derive(Debug, Clone)]
pub struct FrequencyField<const D: usize> {
    /// Octaves of the position.
    pub position: Frequencies,
    /// Octaves of the direction.
    pub direction: Frequencies,
    /// From frequencies of the position to a number and features.
    pub trunk: Mlp,
    /// From features and frequencies of the direction to a colour, before the sigmoid.
    pub head: Mlp,
    /// From the trunk's number to density.
    pub activation: DensityActivation,
}

/// The field's parameters.
#[derive(Debug, Clone)]
pub struct FrequencyParameters {
    /// The trunk's.
    pub trunk: Parameters,
    /// The head's.
    pub head: Parameters,
}

/// Transposed weights of both networks, made once a step.
#[derive(Debug, Default)]
pub struct FrequencyTransposed {
    trunk: Vec<f32>,
    head: Vec<f32>,
}

/// Buffers for one worker.
#[derive(Debug)]
pub struct FrequencyWorker<const D: usize> {
    encoded: Vec<f32>,
    trunk: MlpCache,
    head_in: Vec<f32>,
    head: MlpCache,
    /// Density of each sample of the tile.
    pub sigma: Vec<f32>,
    /// Colour of each sample of the tile.
    pub rgb: Vec<[f32; 3]>,
    /// To be filled before [`FrequencyField::backward`].
    pub d_sigma: Vec<f32>,
    /// To be filled before [`FrequencyField::backward`].
    pub d_rgb: Vec<[f32; 3]>,
    /// By [`FrequencyField::ray_gradients`].
    pub d_positions: Vec<[f32; D]>,
    /// By [`FrequencyField::ray_gradients`].
    pub d_directions: Vec<[f32; 3]>,
    d_out: Vec<f32>,
    trunk_grads: Vec<f32>,
    head_grads: Vec<f32>,
}

impl<const D: usize> Default for FrequencyWorker<D> {
    fn default() -> Self {
        Self {
            encoded: Vec::new(),
            trunk: MlpCache::default(),
            head_in: Vec::new(),
            head: MlpCache::default(),
            sigma: Vec::new(),
            rgb: Vec::new(),
            d_sigma: Vec::new(),
            d_rgb: Vec::new(),
            d_positions: Vec::new(),
            d_directions: Vec::new(),
            d_out: Vec::new(),
            trunk_grads: Vec::new(),
            head_grads: Vec::new(),
        }
    }
}

impl<const D: usize> FrequencyField<D> {
    /// Works out the sizes.
    pub fn new(o: &FrequencyFieldOptions) -> Self {
        let (position, direction) = (Frequencies(o.position_octaves), Frequencies(o.direction_octaves));
        let trunk = Mlp::new(MlpShape {
            inputs: position.width_of(D),
            width: o.width,
            hidden: o.hidden,
            outputs: 1 + o.width,
            activation: Activation::Relu,
            skip: Some(Skip { layer: o.skip, narrow: false }),
        });
        let head = Mlp::new(MlpShape {
            inputs: o.width + direction.width(),
            width: o.head_width,
            hidden: 1,
            outputs: 3,
            activation: Activation::Relu,
            skip: None,
        });
        Self { position, direction, trunk, head, activation: o.activation }
    }

    /// Parameters at their start.
    pub fn init(&self, rng: &mut Rng) -> FrequencyParameters {
        FrequencyParameters {
            trunk: Parameters::new(self.trunk.init_uniform(rng)),
            head: Parameters::new(self.head.init_uniform(rng)),
        }
    }

    /// Number of parameters, padding not counted.
    pub fn parameter_count(&self) -> usize {
        self.trunk.parameter_count() + self.head.parameter_count()
    }

    /// The transposed weights for a step.
    pub fn transpose(&self, p: &FrequencyParameters) -> FrequencyTransposed {
        FrequencyTransposed { trunk: self.trunk.transpose(&p.trunk.values), head: self.head.transpose(&p.head.values) }
    }

    /// Computes the density of a tile of positions: `worker.sigma`.
    pub fn density(&self, p: &FrequencyParameters, positions: &[[f32; D]], worker: &mut FrequencyWorker<D>) {
        let stride = self.trunk.in_stride();
        worker.encoded.resize(positions.len() * stride, 0.0);
        self.position.forward(positions, &mut worker.encoded, stride, 0);
        self.trunk.forward(&p.trunk.values, &worker.encoded, stride, positions.len(), &mut worker.trunk);
        worker.sigma.clear();
        let numbers = worker.trunk.out.chunks_exact(self.trunk.out_stride()).map(|o| o[0]);
        worker.sigma.extend(numbers.map(|o| match self.activation {
            DensityActivation::Relu => o.max(0.0),
            DensityActivation::Softplus => o.max(0.0) + exp(-o.abs()).ln_1p(),
        }));
    }

    /// Computes the colours of a tile whose density has been computed. `rays` are runs of samples: how many, and in
    /// which (unit) direction.
    pub fn color(&self, p: &FrequencyParameters, rays: &[(u32, [f32; 3])], worker: &mut FrequencyWorker<D>) {
        let (stride, from_stride) = (self.head.in_stride(), self.trunk.out_stride());
        let features = self.head.shape().inputs - self.direction.width();
        let rows = worker.sigma.len();
        worker.head_in.resize(rows * stride, 0.0);
        let mut encoded = vec![0.0; self.direction.width()];
        let mut row = 0;
        for (count, direction) in rays {
            self.direction.forward(&[*direction], &mut encoded, self.direction.width(), 0);
            for _ in 0..*count {
                let to = &mut worker.head_in[row * stride..(row + 1) * stride];
                to[..features].copy_from_slice(&worker.trunk.out[row * from_stride + 1..][..features]);
                to[features..][..encoded.len()].copy_from_slice(&encoded);
                row += 1;
            }
        }
        debug_assert_eq!(row, rows);
        self.head.forward(&p.head.values, &worker.head_in, stride, rows, &mut worker.head);
        sigmoid_all(&mut worker.head.out);
        worker.rgb.clear();
        worker.rgb.extend(worker.head.out.chunks_exact(self.head.out_stride()).map(|o| [o[0], o[1], o[2]]));
    }

    /// Sends `worker.d_sigma` and `worker.d_rgb` back into the worker's gradients.
    pub fn backward(&self, p: &FrequencyParameters, transposed: &FrequencyTransposed, worker: &mut FrequencyWorker<D>) {
        let rows = worker.sigma.len();
        worker.trunk_grads.resize(self.trunk.buffer_len(), 0.0);
        worker.head_grads.resize(self.head.buffer_len(), 0.0);
        let stride = self.head.out_stride();
        worker.d_out.clear();
        worker.d_out.resize(rows * stride, 0.0);
        for ((to, d), c) in worker.d_out.chunks_exact_mut(stride).zip(&worker.d_rgb).zip(&worker.rgb) {
            for i in 0..3 {
                to[i] = d[i] * c[i] * (1.0 - c[i]);
            }
        }
        self.head.backward(
            &Weights { parameters: &p.head.values, transposed: &transposed.head },
            &worker.head_in,
            self.head.in_stride(),
            &mut worker.head,
            &worker.d_out,
            None,
            &mut worker.head_grads,
            true,
        );
        let (stride, features) = (self.trunk.out_stride(), self.head.shape().inputs - self.direction.width());
        worker.d_out.clear();
        worker.d_out.resize(rows * stride, 0.0);
        let from = worker.head.d_input.chunks_exact(self.head.in_stride());
        let numbers = worker.trunk.out.chunks_exact(stride).map(|o| o[0]);
        for (((to, from), o), d) in worker.d_out.chunks_exact_mut(stride).zip(from).zip(numbers).zip(&worker.d_sigma) {
            to[0] = d * match self.activation {
                DensityActivation::Relu => f32::from(o > 0.0),
                DensityActivation::Softplus => sigmoid(o),
            };
            to[1..=features].copy_from_slice(&from[..features]);
        }
        self.trunk.backward(
            &Weights { parameters: &p.trunk.values, transposed: &transposed.trunk },
            &worker.encoded,
            self.trunk.in_stride(),
            &mut worker.trunk,
            &worker.d_out,
            None,
            &mut worker.trunk_grads,
            true,
        );
    }

    /// After [`Self::backward`]: the derivatives with respect to the tile's positions and the directions of its rays.
    pub fn ray_gradients(&self, rays: &[(u32, [f32; 3])], worker: &mut FrequencyWorker<D>) {
        worker.d_positions.clear();
        worker.d_positions.resize(worker.sigma.len(), [0.0; D]);
        let (stride, d_input) = (self.trunk.in_stride(), &worker.trunk.d_input);
        self.position.input_gradient(&worker.encoded, d_input, stride, 0, &mut worker.d_positions);
        let (stride, features) = (self.head.in_stride(), self.head.shape().inputs - self.direction.width());
        worker.d_directions.clear();
        let mut rows = worker.head_in.chunks_exact(stride).zip(worker.head.d_input.chunks_exact(stride));
        for (count, _) in rays {
            let mut d = [[0.0; 3]];
            for (e, g) in rows.by_ref().take(*count as usize) {
                self.direction.input_gradient(e, g, stride, features, &mut d);
            }
            worker.d_directions.push(d[0]);
        }
    }

    /// Adds everything that the workers gathered to the parameters' gradients, in the workers' order, and clears it.
    pub fn collect<'a>(&self, p: &mut FrequencyParameters, workers: impl Iterator<Item = &'a mut FrequencyWorker<D>>) {
        for worker in workers {
            add(&mut p.trunk.grads, &worker.trunk_grads);
            add(&mut p.head.grads, &worker.head_grads);
            worker.trunk_grads.fill(0.0);
            worker.head_grads.fill(0.0);
        }
    }

    /// Bytes that a step's workers need beside the parameters.
    pub fn worker_bytes(&self, workers: usize) -> usize {
        4 * workers * (self.trunk.buffer_len() + self.head.buffer_len())
    }
}

impl FrequencyParameters {
    /// One Adam step, number `t` from 1.
    pub fn step(&mut self, options: &AdamOptions, lr: f32, t: u64) {
        self.trunk.step(options, lr, t);
        self.head.step(options, lr, t);
    }

    /// All buffers that a checkpoint holds.
    pub fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        [&mut self.trunk, &mut self.head].into_iter().flat_map(|p| [&mut p.values, &mut p.m, &mut p.v]).collect()
    }

    /// Lengths of the buffers.
    pub fn lengths(&self) -> Vec<usize> {
        [&self.trunk, &self.head].into_iter().flat_map(|p| [p.grads.len(); 3]).collect()
    }

    /// Whether every parameter is a finite number.
    pub fn is_finite(&self) -> bool {
        self.trunk.is_finite() && self.head.is_finite()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    #[test]
    fn the_papers_field_has_the_papers_size() {
        // PyTorch's count of the authors' network: 8 x 256 with the position again at the sixth layer.
        let count = |layers: &[(usize, usize)]| layers.iter().map(|(i, o)| (i + 1) * o).sum::<usize>();
        let wide = (256, 256);
        let trunk = |inputs| [(inputs, 256), wide, wide, wide, wide, (256 + inputs, 256), wide, wide];
        let rest = [(256, 1), wide, (256 + 27, 128), (128, 3)];
        let field = FrequencyField::<3>::new(&FrequencyFieldOptions::PAPER);
        assert_eq!(field.parameter_count(), count(&trunk(63)) + count(&rest));
        assert_eq!(field.parameter_count(), 595_844);
        let outside = FrequencyField::<4>::new(&FrequencyFieldOptions::PAPER);
        assert_eq!(outside.parameter_count(), count(&trunk(84)) + count(&rest));
    }

    #[test]
    fn derivatives_of_the_whole_field_agree_with_finite_differences() {
        for activation in [DensityActivation::Relu, DensityActivation::Softplus] {
            let field = FrequencyField::<4>::new(&FrequencyFieldOptions {
                position_octaves: 2,
                direction_octaves: 1,
                width: 24,
                hidden: 3,
                skip: 2,
                head_width: 16,
                activation,
            });
            let mut rng = mb_job::rng(8, 0);
            let p = field.init(&mut rng);
            let positions: Vec<[f32; 4]> =
                (0..6).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0f32))).collect();
            let rays = [(2, [0.0, 0.6, 0.8]), (4, [1.0, 0.0, 0.0])];
            let d_sigma: Vec<f32> = (0..6).map(|_| rng.random_range(-1.0..1.0)).collect();
            let d_rgb: Vec<[f32; 3]> =
                (0..6).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0f32))).collect();
            let run = |p: &FrequencyParameters, positions: &[[f32; 4]], rays: &[(u32, [f32; 3])]| {
                let mut w = FrequencyWorker::default();
                field.density(p, positions, &mut w);
                field.color(p, rays, &mut w);
                w
            };
            let loss = |p: &FrequencyParameters, positions: &[[f32; 4]], rays: &[(u32, [f32; 3])]| {
                let w = run(p, positions, rays);
                let sigma = w.sigma.iter().zip(&d_sigma).map(|(a, b)| f64::from(a * b)).sum::<f64>();
                let colors = w.rgb.iter().flatten().zip(d_rgb.iter().flatten());
                sigma + colors.map(|(a, b)| f64::from(a * b)).sum::<f64>()
            };
            let mut worker = run(&p, &positions, &rays);
            (worker.d_sigma, worker.d_rgb) = (d_sigma.clone(), d_rgb.clone());
            field.backward(&p, &field.transpose(&p), &mut worker);
            field.ray_gradients(&rays, &mut worker);
            // Central differences may cross a kink of ReLU; that is rare, and a wrong formula is not.
            let (mut misses, mut checked) = (0, 0);
            let mut check = |found: f32, at: &dyn Fn(f32) -> f64| {
                let expected = (at(1e-3) - at(-1e-3)) / 2e-3;
                checked += 1;
                misses += usize::from((f64::from(found) - expected).abs() > 2e-3);
            };
            for s in 0..6 {
                for d in 0..4 {
                    check(worker.d_positions[s][d], &|h| {
                        let mut positions = positions.clone();
                        positions[s][d] += h;
                        loss(&p, &positions, &rays)
                    });
                }
            }
            for r in 0..2 {
                for d in 0..3 {
                    check(worker.d_directions[r][d], &|h| {
                        let mut rays = rays;
                        rays[r].1[d] += h;
                        loss(&p, &positions, &rays)
                    });
                }
            }
            let mut q = p.clone();
            field.collect(&mut q, std::iter::once(&mut worker));
            for i in (0..q.trunk.grads.len()).step_by(17) {
                check(q.trunk.grads[i], &|h| {
                    let mut p = p.clone();
                    p.trunk.values[i] += h;
                    loss(&p, &positions, &rays)
                });
            }
            for i in (0..q.head.grads.len()).step_by(7) {
                check(q.head.grads[i], &|h| {
                    let mut p = p.clone();
                    p.head.values[i] += h;
                    loss(&p, &positions, &rays)
                });
            }
            assert!(misses * 40 <= checked, "{misses} of {checked} derivatives are wrong");
        }
    }
}
