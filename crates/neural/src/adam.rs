//! Adam (Kingma and Ba 2015) and learning-rate schedules.
//!
//! `m = b1 m + (1 - b1) g`, `v = b2 v + (1 - b2) g^2`, `theta -= lr (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)`.

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::simd::dispatched;

/// Adam's constants.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdamOptions {
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Keeps the division finite.
    pub epsilon: f32,
    /// Skip parameters in runs of sixteen whose gradients are all zero: entries of a table that no sample touched keep
    /// their value and moments (as in instant-ngp).
    pub skip_untouched: bool,
}

impl Default for AdamOptions {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.999, epsilon: 1e-8, skip_untouched: false }
    }
}

/// A parameter buffer with its gradient and moments.
#[derive(Debug, Clone, Default)]
pub struct Parameters {
    /// The parameters.
    pub values: Vec<f32>,
    /// Derivative of the loss; cleared by [`Parameters::step`].
    pub grads: Vec<f32>,
    /// First moment.
    pub m: Vec<f32>,
    /// Second moment.
    pub v: Vec<f32>,
}

/// Numbers per parallel piece.
const PIECE: usize = 1 << 14;

impl Parameters {
    /// Parameters at their start.
    pub fn new(values: Vec<f32>) -> Self {
        let zeros = vec![0.0; values.len()];
        Self { grads: zeros.clone(), m: zeros.clone(), v: zeros, values }
    }

    /// One step, number `t` counted from 1, with learning rate `lr`; clears the gradient.
    pub fn step(&mut self, options: &AdamOptions, lr: f32, t: u64) {
        let t = t as f64;
        let correction1 = (1.0 - f64::from(options.beta1).powf(t)) as f32;
        let correction2 = (1.0 - f64::from(options.beta2).powf(t)) as f32;
        let constants = [
            options.beta1,
            options.beta2,
            lr / correction1,
            1.0 / correction2.sqrt(),
            options.epsilon,
            f32::from(options.skip_untouched),
        ];
        (self.values.par_chunks_mut(PIECE), self.grads.par_chunks_mut(PIECE))
            .into_par_iter()
            .zip((self.m.par_chunks_mut(PIECE), self.v.par_chunks_mut(PIECE)).into_par_iter())
            .for_each(|((values, grads), (m, v))| step(values, grads, m, v, constants));
    }

    /// As [`Parameters::step`], with the rate of each run of `width` numbers scaled by its own factor.
    pub fn step_scaled(&mut self, options: &AdamOptions, lr: f32, t: u64, scales: Option<(&[f32], usize)>) {
        let Some((scales, width)) = scales else {
            return self.step(options, lr, t);
        };
        let before = self.values.clone();
        self.step(options, lr, t);
        self.values.par_chunks_mut(width).zip(before.par_chunks(width)).zip(scales).for_each(
            |((now, before), scale)| {
                for (now, before) in now.iter_mut().zip(before) {
                    *now = before + scale * (*now - before);
                }
            },
        );
    }

    /// Whether every parameter is a finite number.
    pub fn is_finite(&self) -> bool {
        self.values.par_chunks(PIECE).all(|piece| piece.iter().all(|v| v.is_finite()))
    }
}

#[inline(always)]
fn step_body(values: &mut [f32], grads: &mut [f32], m: &mut [f32], v: &mut [f32], constants: [f32; 6]) {
    let [beta1, beta2, lr, correction2, epsilon, skip] = constants;
    let runs = values.chunks_mut(16).zip(grads.chunks_mut(16)).zip(m.chunks_mut(16)).zip(v.chunks_mut(16));
    for (((values, grads), m), v) in runs {
        if skip > 0.0 && grads.iter().fold(0, |bits, g| bits | g.to_bits()) == 0 {
            continue;
        }
        for (((value, g), m), v) in values.iter_mut().zip(grads).zip(m).zip(v) {
            *m = beta1 * *m + (1.0 - beta1) * *g;
            *v = beta2 * *v + (1.0 - beta2) * *g * *g;
            *value -= lr * *m / (v.sqrt() * correction2 + epsilon);
            *g = 0.0;
        }
    }
}
dispatched! { fn step(values: &mut [f32], grads: &mut [f32], m: &mut [f32], v: &mut [f32], constants: [f32; 6]) = step_body }

/// How a learning rate changes over a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Schedule {
    /// `factor^(step / every)`: NeRF falls tenfold every 250k steps, DVGO every 20k.
    Exponential {
        /// What is left after `every` steps.
        factor: f64,
        /// Steps.
        every: u64,
    },
    /// Linear warm-up from zero, then half a cosine from 1 down to `floor` at the last step (NeuS).
    WarmCosine {
        /// Steps of the warm-up.
        warm_up: u64,
        /// The last step.
        end: u64,
        /// What is left at the end.
        floor: f64,
    },
    /// Linear warm-up from zero, then exponentially down to `floor` at the last step.
    WarmExponential {
        /// Steps of the warm-up.
        warm_up: u64,
        /// The last step.
        end: u64,
        /// What is left at the end.
        floor: f64,
    },
}

impl Schedule {
    /// The factor of the learning rate at `step`, counted from 0.
    pub fn factor(&self, step: u64) -> f32 {
        let warm = |warm_up: u64| (warm_up > 0 && step < warm_up).then(|| step as f64 / warm_up as f64);
        let part = |warm_up: u64, end: u64| {
            (step.saturating_sub(warm_up) as f64 / end.saturating_sub(warm_up).max(1) as f64).min(1.0)
        };
        let factor = match *self {
            Self::Exponential { factor, every } => factor.powf(step as f64 / every.max(1) as f64),
            Self::WarmCosine { warm_up, end, floor } => warm(warm_up).unwrap_or_else(|| {
                ((part(warm_up, end) * std::f64::consts::PI).cos() + 1.0) * 0.5 * (1.0 - floor) + floor
            }),
            Self::WarmExponential { warm_up, end, floor } => {
                warm(warm_up).unwrap_or_else(|| floor.max(1e-12).powf(part(warm_up, end)))
            }
        };
        factor as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_follow_the_definition_and_find_the_bottom_of_a_bowl() {
        let options = AdamOptions::default();
        let mut p = Parameters::new(vec![3.0, -2.0]);
        p.grads = vec![0.5, -4.0];
        p.step(&options, 0.1, 1);
        // The first step is lr * sign(g), whatever the size of g.
        assert!((p.values[0] - 2.9).abs() < 1e-6 && (p.values[1] + 1.9).abs() < 1e-6);
        assert_eq!(p.grads, [0.0, 0.0]);
        for t in 2..600 {
            p.grads = p.values.iter().map(|x| x - 1.0).collect();
            p.step(&options, 0.05, t);
        }
        assert!(p.values.iter().all(|x| (x - 1.0).abs() < 1e-2), "{:?}", p.values);
    }

    #[test]
    fn untouched_runs_keep_their_moments_where_asked() {
        for skip_untouched in [true, false] {
            let mut p = Parameters::new(vec![1.0; 32]);
            let options = AdamOptions { skip_untouched, ..AdamOptions::default() };
            p.grads[0] = 1.0;
            p.grads[20] = 1.0;
            p.step(&options, 0.1, 1);
            p.grads[0] = 1.0;
            let before = p.values[20];
            p.step(&options, 0.1, 2);
            assert_eq!(p.values[20] == before, skip_untouched);
        }
    }

    #[test]
    fn schedules_have_their_published_values() {
        let nerf = Schedule::Exponential { factor: 0.1, every: 250_000 };
        assert!((nerf.factor(0) - 1.0).abs() < 1e-6 && (nerf.factor(250_000) - 0.1).abs() < 1e-6);
        let neus = Schedule::WarmCosine { warm_up: 5000, end: 300_000, floor: 0.05 };
        assert!((neus.factor(2500) - 0.5).abs() < 1e-6 && (neus.factor(5000) - 1.0).abs() < 1e-6);
        assert!((neus.factor(300_000) - 0.05).abs() < 1e-6 && (neus.factor(152_500) - 0.525).abs() < 1e-3);
    }
}
