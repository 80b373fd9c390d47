//! A network with its parameters, with or without weight normalisation.
//!
//! Weight normalisation (Salimans and Kingma 2016): column o of a layer's weights is `w_o = g_o v_o / |v_o|`. A loss with
//! derivative `dw_o` has `dg_o = dw_o . v_o / |v_o|` and `dv_o = g_o / |v_o| (dw_o - dg_o v_o / |v_o|)`.

use crate::adam::{AdamOptions, Parameters};
use crate::mlp::{Mlp, Weights};
use crate::radiance_field::add;

/// A network and all that a training step needs of it.
#[derive(Debug, Clone)]
pub struct Network {
    mlp: Mlp,
    /// Weights (directions v, where normalised) and biases, laid out as the network wants them.
    direct: Parameters,
    /// Lengths g, layer after layer; empty without normalisation.
    gains: Parameters,
    effective: Vec<f32>,
    transposed: Vec<f32>,
}

impl Network {
    /// From initial weights, which normalisation keeps: `g_o = |v_o|`.
    pub fn new(mlp: Mlp, values: Vec<f32>, normalised: bool) -> Self {
        let mut gains = Vec::new();
        if normalised {
            for (inputs, outputs, stride, weights, _) in mlp.layout() {
                gains.extend((0..outputs).map(|o| length(&values, weights, stride, inputs, o)));
            }
        }
        let transposed = mlp.transpose(&values);
        Self {
            mlp,
            effective: values.clone(),
            transposed,
            direct: Parameters::new(values),
            gains: Parameters::new(gains),
        }
    }

    /// Its sizes.
    pub fn mlp(&self) -> &Mlp {
        &self.mlp
    }

    /// Weights and biases; directions of the weights, where they are normalised.
    pub fn direct(&self) -> &Parameters {
        &self.direct
    }

    /// Lengths of the weights, layer after layer; empty where they are not normalised.
    pub fn gains(&self) -> &Parameters {
        &self.gains
    }

    /// [`Self::direct`] and [`Self::gains`], to be replaced; call [`Self::refresh`] afterwards.
    pub fn parts_mut(&mut self) -> [&mut Parameters; 2] {
        [&mut self.direct, &mut self.gains]
    }

    /// Number of parameters, lengths of weight normalisation included as PyTorch counts them, padding not.
    pub fn parameter_count(&self) -> usize {
        self.mlp.parameter_count() + self.gains.values.len()
    }

    /// The weights that the passes use.
    pub fn weights(&self) -> Weights<'_> {
        Weights { parameters: &self.effective, transposed: &self.transposed }
    }

    /// Adds the derivative with respect to the weights in use.
    pub fn add_gradient(&mut self, grads: &[f32]) {
        if self.gains.values.is_empty() || grads.is_empty() {
            add(&mut self.direct.grads, grads);
            return;
        }
        let mut gain = 0;
        for (inputs, outputs, stride, weights, bias) in self.mlp.layout() {
            add(&mut self.direct.grads[bias..bias + stride], &grads[bias..bias + stride]);
            for o in 0..outputs {
                let norm = length(&self.direct.values, weights, stride, inputs, o).max(1e-12);
                let at = |i: usize| weights + i * stride + o;
                let dg: f32 = (0..inputs).map(|i| grads[at(i)] * self.direct.values[at(i)]).sum::<f32>() / norm;
                let g = self.gains.values[gain];
                for i in 0..inputs {
                    self.direct.grads[at(i)] += g / norm * (grads[at(i)] - dg * self.direct.values[at(i)] / norm);
                }
                self.gains.grads[gain] += dg;
                gain += 1;
            }
        }
    }

    /// One Adam step, and the weights that follow from it.
    pub fn step(&mut self, options: &AdamOptions, lr: f32, t: u64) {
        self.direct.step(options, lr, t);
        self.gains.step(options, lr, t);
        self.refresh();
    }

    /// Works out the weights in use from the parameters.
    pub fn refresh(&mut self) {
        self.effective.copy_from_slice(&self.direct.values);
        if !self.gains.values.is_empty() {
            let mut gain = 0;
            for (inputs, outputs, stride, weights, _) in self.mlp.layout() {
                for o in 0..outputs {
                    let norm = length(&self.direct.values, weights, stride, inputs, o).max(1e-12);
                    for i in 0..inputs {
                        self.effective[weights + i * stride + o] *= self.gains.values[gain] / norm;
                    }
                    gain += 1;
                }
            }
        }
        self.transposed = self.mlp.transpose(&self.effective);
    }

    /// All buffers that a checkpoint holds; call [`Network::refresh`] after reading them.
    pub fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        [&mut self.direct, &mut self.gains].into_iter().flat_map(|p| [&mut p.values, &mut p.m, &mut p.v]).collect()
    }

    /// Lengths of the buffers.
    pub fn lengths(&self) -> Vec<usize> {
        [&self.direct, &self.gains].into_iter().flat_map(|p| [p.grads.len(); 3]).collect()
    }

    /// Whether every parameter is a finite number.
    pub fn is_finite(&self) -> bool {
        self.direct.is_finite() && self.gains.is_finite()
    }
}

/// |v_o| of column `o`.
fn length(values: &[f32], weights: usize, stride: usize, inputs: usize, o: usize) -> f32 {
    (0..inputs).map(|i| values[weights + i * stride + o].powi(2)).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mlp::{Activation, MlpShape};
    use rand::RngExt;

    #[test]
    fn normalisation_keeps_the_initial_weights_and_has_the_derivative_of_finite_differences() {
        let mlp =
            Mlp::new(MlpShape { inputs: 3, width: 8, hidden: 2, outputs: 2, activation: Activation::Relu, skip: None });
        let mut rng = mb_job::rng(1, 0);
        let values = mlp.init_uniform(&mut rng);
        let mut network = Network::new(mlp, values.clone(), true);
        network.refresh();
        assert!(network.effective.iter().zip(&values).all(|(a, b)| (a - b).abs() < 1e-6));
        assert_eq!(network.parameter_count(), (4 * 8 + 9 * 8 + 9 * 2) + 8 + 8 + 2);
        // A linear loss in the weights in use.
        let coefficients: Vec<f32> = (0..values.len()).map(|_| rng.random_range(-1.0..1.0)).collect();
        let loss = |n: &Network| n.effective.iter().zip(&coefficients).map(|(a, b)| f64::from(a * b)).sum::<f64>();
        network.add_gradient(&coefficients);
        let check = |found: f32, change: &dyn Fn(&mut Network, f32)| {
            let at = |h: f32| {
                let mut n = network.clone();
                change(&mut n, h);
                n.refresh();
                loss(&n)
            };
            let expected = (at(1e-2) - at(-1e-2)) / 2e-2;
            assert!((f64::from(found) - expected).abs() < 2e-3, "{found} is not {expected}");
        };
        for i in [0, 1, 9, 25, 33] {
            check(network.direct.grads[i], &|n, h| n.direct.values[i] += h);
        }
        for i in 0..network.gains.values.len() {
            check(network.gains.grads[i], &|n, h| n.gains.values[i] += h);
        }
    }
}
