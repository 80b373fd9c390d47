//! Fully connected networks, their derivatives, and the derivatives of their gradients.
//!
//! A network has layers `z_k = h_k W_k + b_k`, `h_{k+1} = act(z_k)`; `h_0 = x` is the input and the last `z` the output.
//! A skip layer's input is `h_k = scale * [act(z_{k-1}), x]`. Everything is derived by hand.
//!
//! *Backward.* With `dz` at a layer's output: `dW = h^T dz`, `db = sum dz`, `dh = dz W^T`, `dz_{k-1} = dh * act'(z_{k-1})`.
//!
//! *Gradient of output 0 with respect to x* (the normal of a distance field, before the encoding's Jacobian):
//! `r_last = e_0`, `p_k = r_{k+1} W_{k+1}^T`, `r_k = p_k * act'(z_k)`, `g = r_0 W_0^T`.
//!
//! *Double backward.* A loss may use g. Given `dg = dL/dg`, run dg forward as a tangent, `q_0 = dg`,
//! `u_k = q_k W_k`, `q_{k+1} = u_k * act'(z_k)`; then `dW_k += q_k^T r_k`, and `dz_k += u_k * p_k * act''(z_k)` joins the
//! ordinary backward pass. ReLU has `act'' = 0`; softplus has `act' = s = sigmoid(beta z)` and `act'' = beta s (1 - s)`.
//!
//! Buffers are row-major `[samples, padded(width)]` f32. Parameters are one flat buffer: for each layer the weights
//! `[inputs, padded(outputs)]`, then the bias `[padded(outputs)]`. Padding is zero and stays zero.

use mb_job::Rng;
use rand::RngExt;
use serde::{Deserialize, Serialize};

use crate::simd::{Dims, Init, Left, dispatched, exp, gemm, ln_1p_unit, padded};

/// The function between two layers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Activation {
    /// max(z, 0).
    Relu,
    /// ln(1 + exp(beta z)) / beta.
    Softplus {
        /// Sharpness; 100 in NeuS.
        beta: f32,
    },
}

/// A layer that sees the network's input again.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Skip {
    /// Which layer, from 0.
    pub layer: usize,
    /// NeuS: the layer before gives `width - inputs` numbers, so that the sum is `width` wide, and both parts are
    /// divided by sqrt(2). Otherwise (NeRF) the layer's input is `width + inputs` wide and not scaled.
    pub narrow: bool,
}

/// Sizes of a network.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MlpShape {
    /// Numbers per sample going in.
    pub inputs: usize,
    /// Width of the hidden layers.
    pub width: usize,
    /// How many hidden layers, at least one.
    pub hidden: usize,
    /// Numbers per sample coming out.
    pub outputs: usize,
    /// The function after each hidden layer.
    pub activation: Activation,
    /// A layer (1 to `hidden`) that sees the input again.
    pub skip: Option<Skip>,
}

#[derive(Debug, Clone, Copy)]
struct Layer {
    inputs: usize,
    outputs: usize,
    /// Row length of the layer's input buffer; unused for layer 0, whose input is the caller's.
    in_stride: usize,
    out_stride: usize,
    weights: usize,
    bias: usize,
    transposed: usize,
    /// Number of the previous layer's outputs where x follows them, and the scale of both.
    skip: Option<(usize, f32)>,
}

/// A network's sizes, worked out.
#[derive(Debug, Clone)]
pub struct Mlp {
    shape: MlpShape,
    layers: Vec<Layer>,
    parameters: usize,
    transposed: usize,
}

/// A network's parameters with the transposed weights that the backward passes read; made once a step.
#[derive(Debug, Clone, Copy)]
pub struct Weights<'a> {
    /// As [`Mlp`] lays them out.
    pub parameters: &'a [f32],
    /// From [`Mlp::transpose`].
    pub transposed: &'a [f32],
}

/// What the passes over one batch leave for each other. Reused between batches, so that nothing is allocated anew.
#[derive(Debug, Default)]
pub struct MlpCache {
    rows: usize,
    /// Input of layer k + 1.
    hidden: Vec<Vec<f32>>,
    /// act'(z_k); softplus only.
    slopes: Vec<Vec<f32>>,
    /// p_k and r_k of the gradient, and the term that joins dz_k.
    p: Vec<Vec<f32>>,
    r: Vec<Vec<f32>>,
    joins: Vec<Vec<f32>>,
    a: Vec<f32>,
    b: Vec<f32>,
    /// `[rows, padded(outputs)]`, by [`Mlp::forward`].
    pub out: Vec<f32>,
    /// `[rows, padded(inputs)]`, by [`Mlp::gradient`].
    pub gradient: Vec<f32>,
    /// `[rows, padded(inputs)]`, by [`Mlp::backward`] where it is asked for.
    pub d_input: Vec<f32>,
}

impl Mlp {
    /// Works out the layers.
    ///
    /// # Panics
    /// A size is zero, or the skip layer is not 1 to `hidden`, or leaves nothing of the width.
    pub fn new(shape: MlpShape) -> Self {
        assert!(shape.inputs > 0 && shape.width > 0 && shape.hidden > 0 && shape.outputs > 0, "{shape:?}");
        let (mut layers, mut parameters, mut transposed) = (Vec::new(), 0, 0);
        let mut previous = shape.inputs;
        for k in 0..=shape.hidden {
            let skip_here = shape.skip.filter(|s| s.layer == k);
            let narrow_next = shape.skip.is_some_and(|s| s.narrow && s.layer == k + 1);
            let inputs = previous + if skip_here.is_some() { shape.inputs } else { 0 };
            let outputs = match k {
                _ if k == shape.hidden => shape.outputs,
                _ if narrow_next => {
                    assert!(shape.width > shape.inputs, "the skip leaves nothing of the width");
                    shape.width - shape.inputs
                }
                _ => shape.width,
            };
            layers.push(Layer {
                inputs,
                outputs,
                in_stride: padded(inputs).max(padded(previous)),
                out_stride: padded(outputs),
                weights: parameters,
                bias: parameters + inputs * padded(outputs),
                transposed,
                skip: skip_here.map(|s| (previous, if s.narrow { std::f32::consts::FRAC_1_SQRT_2 } else { 1.0 })),
            });
            parameters += (inputs + 1) * padded(outputs);
            transposed += outputs * padded(inputs);
            previous = outputs;
        }
        assert!(shape.skip.is_none_or(|s| (1..=shape.hidden).contains(&s.layer)), "{shape:?}");
        Self { shape, layers, parameters, transposed }
    }

    /// The sizes it was made from.
    pub fn shape(&self) -> &MlpShape {
        &self.shape
    }

    /// Length of the flat parameter buffer, padding included.
    pub fn buffer_len(&self) -> usize {
        self.parameters
    }

    /// Number of parameters proper: the sum of (inputs + 1) * outputs over the layers.
    pub fn parameter_count(&self) -> usize {
        self.layers.iter().map(|l| (l.inputs + 1) * l.outputs).sum()
    }

    /// Row length of the output buffer.
    pub fn out_stride(&self) -> usize {
        padded(self.shape.outputs)
    }

    /// Row length of the gradient and of the input's derivative.
    pub fn in_stride(&self) -> usize {
        padded(self.shape.inputs)
    }

    /// Sizes and offsets of each layer: (inputs, outputs, row length, offset of the weights, offset of the bias).
    pub fn layout(&self) -> impl Iterator<Item = (usize, usize, usize, usize, usize)> + '_ {
        self.layers.iter().map(|l| (l.inputs, l.outputs, l.out_stride, l.weights, l.bias))
    }

    /// PyTorch's default: weights and biases uniform in +-1/sqrt(inputs).
    pub fn init_uniform(&self, rng: &mut Rng) -> Vec<f32> {
        let mut parameters = vec![0.0; self.parameters];
        for layer in &self.layers {
            let bound = 1.0 / (layer.inputs as f32).sqrt();
            for row in 0..=layer.inputs {
                for column in 0..layer.outputs {
                    parameters[layer.weights + row * layer.out_stride + column] = rng.random_range(-bound..bound);
                }
            }
        }
        parameters
    }

    /// Geometric initialisation (Atzmon and Lipman 2020, as NeuS has it): output 0 starts near `|x| - radius`, where
    /// the first three inputs are the position; the other inputs start without effect.
    pub fn init_geometric(&self, radius: f32, rng: &mut Rng) -> Vec<f32> {
        let mut normal = move |mean: f32, sigma: f32| {
            let (u, v): (f32, f32) = (rng.random_range(f32::MIN_POSITIVE..1.0), rng.random());
            mean + sigma * (-2.0 * u.ln()).sqrt() * (std::f32::consts::TAU * v).cos()
        };
        let mut parameters = vec![0.0; self.parameters];
        for (k, layer) in self.layers.iter().enumerate() {
            let last = k == self.shape.hidden;
            for row in 0..layer.inputs {
                let muted = match layer.skip {
                    _ if k == 0 => row >= 3,
                    Some((previous, _)) => row >= previous + 3,
                    None => false,
                };
                for column in 0..layer.outputs {
                    let value = if last {
                        normal((std::f32::consts::PI / layer.inputs as f32).sqrt(), 1e-4)
                    } else {
                        normal(0.0, (2.0 / layer.outputs as f32).sqrt())
                    };
                    if !muted {
                        parameters[layer.weights + row * layer.out_stride + column] = value;
                    }
                }
            }
            if last {
                parameters[layer.bias..layer.bias + layer.outputs].fill(-radius);
            }
        }
        parameters
    }

    /// The transposed weights, each `[outputs, padded(inputs)]`.
    pub fn transpose(&self, parameters: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; self.transposed];
        for layer in &self.layers {
            for row in 0..layer.inputs {
                for column in 0..layer.outputs {
                    out[layer.transposed + column * padded(layer.inputs) + row] =
                        parameters[layer.weights + row * layer.out_stride + column];
                }
            }
        }
        out
    }

    fn prepare(&self, cache: &mut MlpCache, rows: usize) {
        cache.rows = rows;
        let hidden = self.shape.hidden;
        for buffers in [&mut cache.hidden, &mut cache.slopes, &mut cache.p, &mut cache.r, &mut cache.joins] {
            buffers.resize_with(hidden, Vec::new);
        }
    }

    fn multiply(
        &self,
        layer: &Layer,
        w: &[f32],
        x: (&[f32], usize),
        rows: usize,
        out: (&mut Vec<f32>, usize),
        bias: bool,
    ) {
        let (out, out_stride) = out;
        out.resize(rows * out_stride, 0.0);
        let init = if bias { Init::Row(&w[layer.bias..][..layer.out_stride]) } else { Init::Zero };
        gemm(
            Dims { m: rows, n: layer.out_stride, k: layer.inputs },
            Left { data: x.0, row_stride: x.1, col_stride: 1 },
            &w[layer.weights..layer.bias],
            layer.out_stride,
            out,
            out_stride,
            init,
        );
    }

    fn multiply_transposed(&self, layer: &Layer, w: &Weights<'_>, dz: &[f32], rows: usize, out: &mut Vec<f32>) {
        let stride = padded(layer.inputs);
        out.resize(rows * stride, 0.0);
        gemm(
            Dims { m: rows, n: stride, k: layer.outputs },
            Left { data: dz, row_stride: layer.out_stride, col_stride: 1 },
            &w.transposed[layer.transposed..],
            stride,
            out,
            stride,
            Init::Zero,
        );
    }

    fn add_weight_gradient(&self, layer: &Layer, h: (&[f32], usize), dz: &[f32], rows: usize, grads: &mut [f32]) {
        gemm(
            Dims { m: layer.inputs, n: layer.out_stride, k: rows },
            Left { data: h.0, row_stride: 1, col_stride: h.1 },
            dz,
            layer.out_stride,
            &mut grads[layer.weights..layer.bias],
            layer.out_stride,
            Init::Accumulate,
        );
    }

    /// Computes `cache.out` from `x`: `[rows, x_stride]`, of which the first `inputs` columns count.
    ///
    /// # Panics
    /// A buffer is too short.
    pub fn forward(&self, parameters: &[f32], x: &[f32], x_stride: usize, rows: usize, cache: &mut MlpCache) {
        self.prepare(cache, rows);
        for (k, layer) in self.layers.iter().enumerate() {
            let last = k == self.shape.hidden;
            let next_stride = if last { layer.out_stride } else { self.layers[k + 1].in_stride };
            let mut out = std::mem::take(if last { &mut cache.out } else { &mut cache.hidden[k] });
            let input = if k == 0 { (x, x_stride) } else { (cache.hidden[k - 1].as_slice(), layer.in_stride) };
            self.multiply(layer, parameters, input, rows, (&mut out, next_stride), true);
            if last {
                cache.out = out;
                return;
            }
            match self.shape.activation {
                Activation::Relu => relu(&mut out, next_stride, layer.outputs),
                Activation::Softplus { beta } => {
                    let slopes = &mut cache.slopes[k];
                    slopes.resize(rows * layer.out_stride, 0.0);
                    softplus(&mut out, next_stride, slopes, layer.out_stride, layer.outputs, beta);
                }
            }
            if let Some((previous, scale)) = self.layers[k + 1].skip {
                append(&mut out, next_stride, previous, x, x_stride, self.shape.inputs, scale);
            }
            cache.hidden[k] = out;
        }
    }

    /// `out = factor * act'(z_k) * from`, for the first `outputs` columns; the padding of `out` is cleared.
    fn times_slope(&self, k: usize, cache: &MlpCache, from: (&[f32], usize), factor: f32, out: &mut Vec<f32>) {
        let layer = &self.layers[k];
        out.resize(cache.rows * layer.out_stride, 0.0);
        match self.shape.activation {
            Activation::Relu => {
                let stride = self.layers[k + 1].in_stride;
                times_step(out, layer.out_stride, from.0, from.1, &cache.hidden[k], stride, layer.outputs, factor);
            }
            Activation::Softplus { .. } => {
                let slopes = &cache.slopes[k];
                times(out, layer.out_stride, from.0, from.1, slopes, layer.out_stride, layer.outputs, factor);
            }
        }
    }

    /// Computes `cache.gradient`, the derivative of output 0 with respect to the input, after [`Mlp::forward`].
    pub fn gradient(&self, weights: &Weights<'_>, cache: &mut MlpCache) {
        let (rows, last, in_stride) = (cache.rows, self.shape.hidden, self.in_stride());
        let mut gradient = std::mem::take(&mut cache.gradient);
        gradient.clear();
        gradient.resize(rows * in_stride, 0.0);
        let mut dh = std::mem::take(&mut cache.a);
        for k in (0..=last).rev() {
            let layer = &self.layers[k];
            let stride = padded(layer.inputs);
            if k == last {
                let row = &weights.transposed[layer.transposed..][..stride];
                dh.resize(rows * stride, 0.0);
                dh.chunks_exact_mut(stride).for_each(|to| to.copy_from_slice(row));
            } else {
                let r = std::mem::take(&mut cache.r[k]);
                self.multiply_transposed(layer, weights, &r, rows, &mut dh);
                cache.r[k] = r;
            }
            if k == 0 {
                add(&mut gradient, in_stride, &dh, stride, 0, self.shape.inputs, 1.0);
                break;
            }
            let mut factor = 1.0;
            if let Some((previous, scale)) = layer.skip {
                add(&mut gradient, in_stride, &dh, stride, previous, self.shape.inputs, scale);
                factor = scale;
            }
            let mut r = std::mem::take(&mut cache.r[k - 1]);
            self.times_slope(k - 1, cache, (&dh, stride), factor, &mut r);
            cache.r[k - 1] = r;
            if matches!(self.shape.activation, Activation::Softplus { .. }) {
                let (p, before) = (&mut cache.p[k - 1], &self.layers[k - 1]);
                p.resize(rows * before.out_stride, 0.0);
                copy(p, before.out_stride, &dh, stride, before.outputs, factor);
            }
        }
        cache.a = dh;
        cache.gradient = gradient;
    }

    /// Adds the derivatives of a loss to `grads`, after [`Mlp::forward`] on the same `x`.
    ///
    /// - `d_out`: `[rows, padded(outputs)]`, the loss's derivative with respect to the output; padding zero.
    /// - `d_gradient`: the same with respect to `cache.gradient`, after [`Mlp::gradient`]; padding zero.
    /// - `want_d_input`: also compute `cache.d_input`. The part of it that goes through the gradient's own dependence
    ///   on x is included.
    #[allow(clippy::too_many_arguments)]
    pub fn backward(
        &self,
        weights: &Weights<'_>,
        x: &[f32],
        x_stride: usize,
        cache: &mut MlpCache,
        d_out: &[f32],
        d_gradient: Option<&[f32]>,
        grads: &mut [f32],
        want_d_input: bool,
    ) {
        let (rows, last, in_stride) = (cache.rows, self.shape.hidden, self.in_stride());
        if let Some(d_gradient) = d_gradient {
            self.tangent(weights, cache, d_gradient, grads);
        }
        let second_order = d_gradient.is_some() && matches!(self.shape.activation, Activation::Softplus { .. });
        let (mut dh, mut dz) = (std::mem::take(&mut cache.a), std::mem::take(&mut cache.b));
        let mut d_input = std::mem::take(&mut cache.d_input);
        if want_d_input {
            d_input.clear();
            d_input.resize(rows * in_stride, 0.0);
        }
        for k in (0..=last).rev() {
            let layer = &self.layers[k];
            let dz_here: &[f32] = if k == last { d_out } else { &dz };
            let h = if k == 0 { (x, x_stride) } else { (cache.hidden[k - 1].as_slice(), layer.in_stride) };
            self.add_weight_gradient(layer, h, dz_here, rows, grads);
            column_sums(&mut grads[layer.bias..][..layer.out_stride], dz_here);
            if k == 0 && !want_d_input {
                break;
            }
            self.multiply_transposed(layer, weights, dz_here, rows, &mut dh);
            let stride = padded(layer.inputs);
            if k == 0 {
                add(&mut d_input, in_stride, &dh, stride, 0, self.shape.inputs, 1.0);
                break;
            }
            let mut factor = 1.0;
            if let Some((previous, scale)) = layer.skip {
                factor = scale;
                if want_d_input {
                    add(&mut d_input, in_stride, &dh, stride, previous, self.shape.inputs, scale);
                }
            }
            self.times_slope(k - 1, cache, (&dh, stride), factor, &mut dz);
            if second_order {
                let stride = self.layers[k - 1].out_stride;
                add(&mut dz, stride, &cache.joins[k - 1], stride, 0, self.layers[k - 1].outputs, 1.0);
            }
        }
        (cache.a, cache.b, cache.d_input) = (dh, dz, d_input);
    }

    /// The tangent pass of the double backward: adds `q^T r` to `grads` and fills `cache.joins`.
    fn tangent(&self, weights: &Weights<'_>, cache: &mut MlpCache, d_gradient: &[f32], grads: &mut [f32]) {
        let (rows, last, in_stride) = (cache.rows, self.shape.hidden, self.in_stride());
        let (mut q, mut u) = (std::mem::take(&mut cache.a), std::mem::take(&mut cache.b));
        for (k, layer) in self.layers.iter().enumerate() {
            let q_here = if k == 0 { (d_gradient, in_stride) } else { (q.as_slice(), layer.in_stride) };
            if k == last {
                // r is the unit vector of output 0: only the first column of the weights hears of it.
                for row in q_here.0.chunks_exact(q_here.1).take(rows) {
                    for (j, value) in row[..layer.inputs].iter().enumerate() {
                        grads[layer.weights + j * layer.out_stride] += value;
                    }
                }
                break;
            }
            let r = std::mem::take(&mut cache.r[k]);
            self.add_weight_gradient(layer, q_here, &r, rows, grads);
            cache.r[k] = r;
            self.multiply(layer, weights.parameters, q_here, rows, (&mut u, layer.out_stride), false);
            if let Activation::Softplus { beta } = self.shape.activation {
                let join = &mut cache.joins[k];
                join.resize(rows * layer.out_stride, 0.0);
                curvature(join, &u, &cache.p[k], &cache.slopes[k], beta);
            }
            let next = &self.layers[k + 1];
            let mut slope_times_u = std::mem::take(&mut cache.d_input);
            self.times_slope(k, cache, (&u, layer.out_stride), 1.0, &mut slope_times_u);
            q.resize(rows * next.in_stride, 0.0);
            copy(&mut q, next.in_stride, &slope_times_u, layer.out_stride, layer.outputs, 1.0);
            cache.d_input = slope_times_u;
            if let Some((previous, scale)) = next.skip {
                append(&mut q, next.in_stride, previous, d_gradient, in_stride, self.shape.inputs, scale);
            }
        }
        (cache.a, cache.b) = (q, u);
    }
}

#[inline(always)]
fn relu_body(h: &mut [f32], stride: usize, width: usize) {
    for row in h.chunks_exact_mut(stride) {
        for v in &mut row[..width] {
            *v = v.max(0.0);
        }
    }
}
dispatched! { fn relu(h: &mut [f32], stride: usize, width: usize) = relu_body }

#[inline(always)]
fn softplus_body(h: &mut [f32], stride: usize, slopes: &mut [f32], slope_stride: usize, width: usize, beta: f32) {
    let inverse = 1.0 / beta;
    for (row, slope) in h.chunks_exact_mut(stride).zip(slopes.chunks_exact_mut(slope_stride)) {
        for (v, s) in row[..width].iter_mut().zip(slope) {
            let t = exp(-beta * v.abs());
            let big = 1.0 / (1.0 + t);
            *s = if *v >= 0.0 { big } else { 1.0 - big };
            *v = v.max(0.0) + ln_1p_unit(t) * inverse;
        }
    }
}
dispatched! {
    fn softplus(h: &mut [f32], stride: usize, slopes: &mut [f32], slope_stride: usize, width: usize, beta: f32)
    = softplus_body
}

/// Scales the first `width` columns and writes `scale * x` behind them.
fn append(h: &mut [f32], stride: usize, width: usize, x: &[f32], x_stride: usize, inputs: usize, scale: f32) {
    for (row, x) in h.chunks_exact_mut(stride).zip(x.chunks_exact(x_stride)) {
        row[..width].iter_mut().for_each(|v| *v *= scale);
        for (to, from) in row[width..width + inputs].iter_mut().zip(x) {
            *to = scale * from;
        }
    }
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn times_body(
    out: &mut [f32],
    stride: usize,
    from: &[f32],
    from_stride: usize,
    slope: &[f32],
    slope_stride: usize,
    width: usize,
    factor: f32,
) {
    let rows = out.chunks_exact_mut(stride).zip(from.chunks_exact(from_stride)).zip(slope.chunks_exact(slope_stride));
    for ((out, from), slope) in rows {
        for ((o, f), s) in out[..width].iter_mut().zip(from).zip(slope) {
            *o = factor * f * s;
        }
        out[width..].fill(0.0);
    }
}
dispatched! {
    fn times(out: &mut [f32], stride: usize, from: &[f32], from_stride: usize, slope: &[f32], slope_stride: usize,
             width: usize, factor: f32) = times_body
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn times_step_body(
    out: &mut [f32],
    stride: usize,
    from: &[f32],
    from_stride: usize,
    h: &[f32],
    h_stride: usize,
    width: usize,
    factor: f32,
) {
    let rows = out.chunks_exact_mut(stride).zip(from.chunks_exact(from_stride)).zip(h.chunks_exact(h_stride));
    for ((out, from), h) in rows {
        for ((o, f), h) in out[..width].iter_mut().zip(from).zip(h) {
            *o = if *h > 0.0 { factor * f } else { 0.0 };
        }
        out[width..].fill(0.0);
    }
}
dispatched! {
    fn times_step(out: &mut [f32], stride: usize, from: &[f32], from_stride: usize, h: &[f32], h_stride: usize,
                  width: usize, factor: f32) = times_step_body
}

#[inline(always)]
fn curvature_body(join: &mut [f32], u: &[f32], p: &[f32], slope: &[f32], beta: f32) {
    for (((j, u), p), s) in join.iter_mut().zip(u).zip(p).zip(slope) {
        *j = u * p * beta * s * (1.0 - s);
    }
}
dispatched! { fn curvature(join: &mut [f32], u: &[f32], p: &[f32], slope: &[f32], beta: f32) = curvature_body }

#[inline(always)]
fn column_sums_body(sums: &mut [f32], rows: &[f32]) {
    for row in rows.chunks_exact(sums.len()) {
        for (sum, v) in sums.iter_mut().zip(row) {
            *sum += v;
        }
    }
}
dispatched! { fn column_sums(sums: &mut [f32], rows: &[f32]) = column_sums_body }

/// `to[.., ..width] = factor * from[.., ..width]`.
fn copy(to: &mut [f32], stride: usize, from: &[f32], from_stride: usize, width: usize, factor: f32) {
    for (to, from) in to.chunks_exact_mut(stride).zip(from.chunks_exact(from_stride)) {
        for (t, f) in to[..width].iter_mut().zip(from) {
            *t = factor * f;
        }
    }
}

/// `to[.., ..width] += factor * from[.., first..first + width]`.
fn add(to: &mut [f32], stride: usize, from: &[f32], from_stride: usize, first: usize, width: usize, factor: f32) {
    for (to, from) in to.chunks_exact_mut(stride).zip(from.chunks_exact(from_stride)) {
        for (t, f) in to[..width].iter_mut().zip(&from[first..]) {
            *t += factor * f;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHAPES: [MlpShape; 4] = [
        MlpShape { inputs: 5, width: 16, hidden: 1, outputs: 3, activation: Activation::Relu, skip: None },
        MlpShape {
            inputs: 6,
            width: 24,
            hidden: 3,
            outputs: 9,
            activation: Activation::Softplus { beta: 3.0 },
            skip: Some(Skip { layer: 2, narrow: true }),
        },
        MlpShape {
            inputs: 7,
            width: 16,
            hidden: 3,
            outputs: 1,
            activation: Activation::Softplus { beta: 2.0 },
            skip: Some(Skip { layer: 3, narrow: false }),
        },
        MlpShape {
            inputs: 4,
            width: 12,
            hidden: 2,
            outputs: 2,
            activation: Activation::Relu,
            skip: Some(Skip { layer: 1, narrow: false }),
        },
    ];

    /// The network in f64, one sample, straight from the definition: the oracle.
    fn oracle(mlp: &Mlp, w: &[f64], x: &[f64]) -> Vec<f64> {
        let mut h = x.to_vec();
        for (k, l) in mlp.layers.iter().enumerate() {
            if let Some((_, scale)) = l.skip {
                h.extend_from_slice(x);
                h.iter_mut().for_each(|v| *v *= f64::from(scale));
            }
            let z = |o: usize| {
                w[l.bias + o] + (0..l.inputs).map(|i| h[i] * w[l.weights + i * l.out_stride + o]).sum::<f64>()
            };
            h = (0..l.outputs).map(z).collect();
            if k < mlp.shape.hidden {
                h.iter_mut().for_each(|v| {
                    *v = match mlp.shape.activation {
                        Activation::Relu => v.max(0.0),
                        Activation::Softplus { beta } => (f64::from(beta) * *v).exp().ln_1p() / f64::from(beta),
                    }
                });
            }
        }
        h
    }

    fn oracle_gradient(mlp: &Mlp, w: &[f64], x: &[f64]) -> Vec<f64> {
        (0..x.len())
            .map(|i| {
                let at = |d: f64| {
                    let mut x = x.to_vec();
                    x[i] += d;
                    oracle(mlp, w, &x)[0]
                };
                (at(1e-5) - at(-1e-5)) / 2e-5
            })
            .collect()
    }

    /// A loss of outputs and gradients with fixed coefficients, so that its derivatives are known.
    fn loss(mlp: &Mlp, w: &[f64], x: &[Vec<f64>], d_out: &[Vec<f64>], d_g: &[Vec<f64>]) -> f64 {
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        x.iter()
            .zip(d_out)
            .zip(d_g)
            .map(|((x, o), g)| dot(&oracle(mlp, w, x), o) + dot(&oracle_gradient(mlp, w, x), g))
            .sum()
    }

    fn pad(rows: &[Vec<f64>], stride: usize) -> Vec<f32> {
        rows.iter().flat_map(|r| (0..stride).map(|i| r.get(i).map_or(0.0, |v| *v as f32))).collect()
    }

    #[test]
    fn values_gradients_and_double_backward_agree_with_finite_differences() {
        for (number, shape) in SHAPES.into_iter().enumerate() {
            let mlp = Mlp::new(shape);
            let mut rng = mb_job::rng(number as u64, 7);
            let parameters = mlp.init_uniform(&mut rng);
            let transposed = mlp.transpose(&parameters);
            let weights = Weights { parameters: &parameters, transposed: &transposed };
            let mut rows = |n: usize| {
                (0..5).map(|_| (0..n).map(|_| rng.random_range(-1.0..1.0)).collect()).collect::<Vec<Vec<f64>>>()
            };
            let (x, d_out, d_g) = (rows(shape.inputs), rows(shape.outputs), rows(shape.inputs));
            let (x32, d_out32, d_g32) =
                (pad(&x, mlp.in_stride()), pad(&d_out, mlp.out_stride()), pad(&d_g, mlp.in_stride()));
            let w: Vec<f64> = parameters.iter().map(|v| f64::from(*v)).collect();

            let mut cache = MlpCache::default();
            mlp.forward(&parameters, &x32, mlp.in_stride(), 5, &mut cache);
            mlp.gradient(&weights, &mut cache);
            for (row, x) in x.iter().enumerate() {
                for (o, expected) in oracle(&mlp, &w, x).iter().enumerate() {
                    let found = f64::from(cache.out[row * mlp.out_stride() + o]);
                    assert!((found - expected).abs() < 1e-5, "{shape:?}: output {found} is not {expected}");
                }
                for (i, expected) in oracle_gradient(&mlp, &w, x).iter().enumerate() {
                    let found = f64::from(cache.gradient[row * mlp.in_stride() + i]);
                    assert!((found - expected).abs() < 1e-4, "{shape:?}: gradient {found} is not {expected}");
                }
            }

            let mut grads = vec![0.0; mlp.buffer_len()];
            mlp.backward(&weights, &x32, mlp.in_stride(), &mut cache, &d_out32, Some(&d_g32), &mut grads, true);
            let mut checked = 0;
            for l in &mlp.layers {
                for i in (0..(l.inputs + 1) * l.out_stride).filter(|i| i % l.out_stride < l.outputs).step_by(3) {
                    let i = l.weights + i;
                    let at = |d: f64| {
                        let mut w = w.clone();
                        w[i] += d;
                        loss(&mlp, &w, &x, &d_out, &d_g)
                    };
                    let expected = (at(1e-4) - at(-1e-4)) / 2e-4;
                    assert!(
                        (f64::from(grads[i]) - expected).abs() < 2e-3,
                        "{shape:?} {i}: {} is not {expected}",
                        grads[i]
                    );
                    checked += 1;
                }
                for i in (0..(l.inputs + 1) * l.out_stride).filter(|i| i % l.out_stride >= l.outputs) {
                    assert_eq!(grads[l.weights + i], 0.0, "padding must stay zero");
                }
            }
            assert!(checked > 20);
            for row in 0..5 {
                for i in 0..shape.inputs {
                    let at = |d: f64| {
                        let mut x = x.clone();
                        x[row][i] += d;
                        loss(&mlp, &w, &x, &d_out, &d_g)
                    };
                    let expected = (at(1e-4) - at(-1e-4)) / 2e-4;
                    let found = f64::from(cache.d_input[row * mlp.in_stride() + i]);
                    assert!((found - expected).abs() < 5e-3, "{shape:?}: d_input {found} is not {expected}");
                }
            }
        }
    }

    #[test]
    fn geometric_initialisation_is_a_sphere() {
        let mlp = Mlp::new(MlpShape {
            inputs: 39,
            width: 256,
            hidden: 8,
            outputs: 257,
            activation: Activation::Softplus { beta: 100.0 },
            skip: Some(Skip { layer: 4, narrow: true }),
        });
        let parameters = mlp.init_geometric(0.5, &mut mb_job::rng(3, 0));
        let mut rng = mb_job::rng(3, 1);
        // Softplus lifts small inputs, so the inner value is less deep than the distance (in NeuS too).
        for (radius, expected) in [(0.15f32, -0.2), (0.75, 0.25), (1.0, 0.5)] {
            let mut x = vec![0.0; mlp.in_stride()];
            let v: [f32; 3] = std::array::from_fn(|_| rng.random_range(-1.0..1.0));
            let norm = v.iter().map(|v| v * v).sum::<f32>().sqrt();
            (0..3).for_each(|i| x[i] = v[i] / norm * radius);
            let mut cache = MlpCache::default();
            mlp.forward(&parameters, &x, mlp.in_stride(), 1, &mut cache);
            assert!((cache.out[0] - expected).abs() < 0.2, "{} at {radius}", cache.out[0]);
        }
    }
}
