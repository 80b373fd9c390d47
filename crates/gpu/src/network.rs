//! A fully connected network on the device: its layers, their derivatives, and the derivatives of its gradient; with or
//! without weight normalisation.

use mb_job::Result;
use mb_neural::adam::Parameters;
use mb_neural::mlp::{Activation, Mlp};
use mb_neural::network::Network as Twin;

use crate::context::{Buffer, Context, Kernel, WORKGROUP, Work};
use crate::kernels::Kernels;
use crate::trained::{AdamStep, Gradient, Trained};

struct Layer {
    inputs: usize,
    in_stride: usize,
    outputs: usize,
    /// Row length of the weights, and of `out`.
    weight_stride: usize,
    out_stride: usize,
    weights: usize,
    /// Inputs that the layer before gives; behind them a skip layer has the network's. The scale of both.
    own: usize,
    scale: f32,
    /// The layer's output and the derivative of its input, for each sample.
    out: Buffer,
    d_input: Buffer,
    second: Option<Second>,
}

/// What a hidden layer keeps of the gradient and its derivative; see `mlp.rs`.
struct Second {
    r: Buffer,
    q: Buffer,
    joins: Buffer,
}

/// Weight normalisation: the lengths of the weights, and what follows from them; see `gains.wgsl`.
struct Gains {
    lengths: Trained,
    columns: Buffer,
    /// The weights in use, and the gradient of the lengths.
    weights: Buffer,
    d_lengths: Buffer,
}

/// A network.
pub struct Network {
    layers: Vec<Layer>,
    activation: Activation,
    /// Laid out as the twin's; directions of the weights, where they are normalised.
    pub parameters: Trained,
    gains: Option<Gains>,
    /// `[pieces, parameters]`: sums of the gradient.
    pub partial_sums: Buffer,
    pieces: usize,
    /// `[parameters]`: all of them.
    d_weights: Buffer,
    /// `[samples, padded(inputs)]`, by [`Self::gradient`].
    pub gradient: Buffer,
}

/// Partial sums of the weights' gradient, at most, and numbers in all of them together; their rows, at least.
const PIECES: usize = 1024;
const PARTIAL_SUMS: usize = 1 << 25;
const PIECE: usize = 256;

/// Threads for a product of this size: a workgroup for each tile of 64 x 64, or of 128 x 16.
fn threads_of(height: usize, width: usize, narrow: bool) -> usize {
    let [tall, wide] = if narrow { [128, 16] } else { [64, 64] };
    height.div_ceil(tall) * width.div_ceil(wide) * WORKGROUP
}

/// The kernel for a product with this many columns: tall tiles where few would be used of wide ones.
fn product_of(kernels: &[Kernel; 2], width: usize) -> (&Kernel, bool) {
    let narrow = width <= 16;
    (&kernels[usize::from(narrow)], narrow)
}

/// One product of a layer: see `dense.wgsl`.
struct Product<'a> {
    kernel: &'a Kernel,
    x: &'a Buffer,
    z: &'a Buffer,
    dx: &'a Buffer,
    /// Whether the hidden layers' activation takes part.
    activated: bool,
    tangent: bool,
    unit: bool,
    /// What the layer's output is scaled by, which is a skip layer's part of its input.
    out_scale: f32,
    threads: usize,
}

impl Network {
    /// From its twin. `second_order` networks give a gradient that losses may use.
    pub fn of_twin(context: &Context, k: &Kernels, twin: &Twin, second_order: bool) -> Self {
        let mut network = Self::new(context, twin.mlp(), twin.direct(), second_order);
        let lengths = twin.gains();
        if lengths.values.is_empty() {
            return network;
        }
        let columns: Vec<[u32; 4]> = twin
            .mlp()
            .layout()
            .flat_map(|(inputs, outputs, stride, weights, _)| {
                (0..outputs).map(move |o| [weights + o, stride, inputs, 0].map(|n| n as u32))
            })
            .collect();
        network.gains = Some(Gains {
            lengths: Trained::new(context, lengths),
            columns: context.upload(&columns),
            weights: context.zeros(twin.direct().values.len()),
            d_lengths: context.zeros(lengths.values.len()),
        });
        let mut work = context.work();
        network.normalise(&mut work, k);
        work.submit();
        network
    }

    /// From its twin, whose weights are not normalised.
    ///
    /// # Panics
    /// The twin is of second order and has no softplus.
    pub fn new(context: &Context, mlp: &Mlp, parameters: &Parameters, second_order: bool) -> Self {
        let shape = mlp.shape();
        assert!(!second_order || matches!(shape.activation, Activation::Softplus { .. }), "{shape:?}");
        let none = || context.zeros(0);
        let mut own = shape.inputs;
        let mut layers: Vec<Layer> = Vec::new();
        for (k, (inputs, outputs, weight_stride, weights, _)) in mlp.layout().enumerate() {
            let second = (second_order && k < shape.hidden).then(|| Second { r: none(), q: none(), joins: none() });
            let skip = shape.skip.filter(|skip| skip.layer == k);
            let in_stride = inputs.next_multiple_of(8);
            if let Some(before) = layers.last_mut() {
                before.out_stride = in_stride;
            }
            layers.push(Layer {
                inputs,
                in_stride,
                outputs,
                weight_stride,
                out_stride: weight_stride,
                weights,
                own,
                scale: if skip.is_some_and(|skip| skip.narrow) { std::f32::consts::FRAC_1_SQRT_2 } else { 1.0 },
                out: none(),
                d_input: none(),
                second,
            });
            own = outputs;
        }
        Self {
            layers,
            activation: shape.activation,
            parameters: Trained::new(context, parameters),
            gains: None,
            d_weights: context.zeros(parameters.values.len()),
            partial_sums: none(),
            pieces: 0,
            gradient: none(),
        }
    }

    /// Makes room for so many samples.
    pub fn reserve(&mut self, context: &Context, samples: usize) {
        let second_order = self.layers[0].second.is_some();
        for layer in &mut self.layers {
            context.reserve(&mut layer.out, samples * layer.out_stride);
            context.reserve(&mut layer.d_input, samples * layer.in_stride);
            if let Some(Second { r, q, joins }) = &mut layer.second {
                for buffer in [r, q, joins] {
                    context.reserve(buffer, samples * layer.out_stride);
                }
            }
        }
        if second_order {
            context.reserve(&mut self.gradient, samples * self.layers[0].in_stride);
        }
        self.pieces = samples.div_ceil(self.piece_of(samples));
        context.reserve(&mut self.partial_sums, self.pieces * self.parameters.len);
    }

    /// `[samples, padded(outputs)]`, by [`Self::forward`].
    pub fn out(&self) -> &Buffer {
        &self.layers[self.layers.len() - 1].out
    }

    /// Numbers in a row of the output.
    pub fn out_stride(&self) -> usize {
        self.layers[self.layers.len() - 1].out_stride
    }

    /// `[samples, padded(inputs)]`, by [`Self::backward`].
    pub fn d_input(&self) -> &Buffer {
        &self.layers[0].d_input
    }

    /// The weights in use.
    fn weights(&self) -> &Buffer {
        self.gains.as_ref().map_or(&self.parameters.values, |gains| &gains.weights)
    }

    /// Rows of one partial sum.
    fn piece_of(&self, rows: usize) -> usize {
        let pieces = (PARTIAL_SUMS / self.parameters.len.max(1)).clamp(1, PIECES);
        rows.div_ceil(pieces).max(PIECE)
    }

    fn beta(&self) -> f32 {
        match self.activation {
            Activation::Relu => 0.0,
            Activation::Softplus { beta } => beta,
        }
    }

    fn product(&self, work: &mut Work<'_>, layer: &Layer, rows: usize, p: &Product<'_>) {
        let activation = match self.activation {
            _ if !p.activated => 0,
            Activation::Relu => 1,
            Activation::Softplus { .. } => 2,
        };
        let sizes = [
            rows as u32,
            layer.inputs as u32,
            layer.in_stride as u32,
            layer.outputs as u32,
            layer.weight_stride as u32,
            layer.weights as u32,
            activation,
            self.parameters.len as u32,
            self.piece_of(rows) as u32,
            self.beta().to_bits(),
            u32::from(p.tangent),
            u32::from(p.unit),
            layer.out_stride as u32,
            layer.own as u32,
            layer.scale.to_bits(),
            p.out_scale.to_bits(),
        ];
        let buffers = [(1, self.weights()), (2, p.x), (3, p.z), (4, p.dx), (5, &self.partial_sums)];
        work.run(p.kernel, &sizes, &buffers, p.threads);
    }

    /// `x W` of a layer, with bias and activation, or, of tangents, without.
    fn layer(&self, work: &mut Work<'_>, k: &Kernels, i: usize, [x, z]: [&Buffer; 2], rows: usize, tangent: bool) {
        let layer = &self.layers[i];
        let (kernel, narrow) = product_of(&k.layer, layer.weight_stride);
        let p = Product {
            kernel,
            x,
            z,
            dx: &layer.d_input,
            activated: !tangent && i + 1 < self.layers.len(),
            tangent,
            unit: false,
            out_scale: self.layers.get(i + 1).map_or(1.0, |next| next.scale),
            threads: threads_of(rows, layer.weight_stride, narrow),
        };
        self.product(work, layer, rows, &p);
    }

    /// `dz W^T` of a layer, times the slope of what came in.
    fn input_gradient(&self, work: &mut Work<'_>, k: &Kernels, i: usize, [x, z, dx]: [&Buffer; 3], rows: usize) {
        let layer = &self.layers[i];
        let (kernel, narrow) = product_of(&k.input_gradient, layer.inputs);
        let threads = threads_of(rows, layer.inputs, narrow);
        let p = Product { kernel, x, z, dx, activated: i > 0, tangent: false, unit: false, out_scale: 1.0, threads };
        self.product(work, layer, rows, &p);
    }

    /// Adds `x^T dz` of a layer to the partial sums.
    fn weight_gradient(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        i: usize,
        [x, z]: [&Buffer; 2],
        rows: usize,
        tangent: bool,
    ) {
        let layer = &self.layers[i];
        let p = Product {
            kernel: &k.weight_gradient,
            x,
            z,
            dx: &layer.d_input,
            activated: false,
            tangent,
            unit: tangent && i + 1 == self.layers.len(),
            out_scale: 1.0,
            threads: rows.div_ceil(self.piece_of(rows)) * threads_of(layer.inputs, layer.weight_stride, false),
        };
        self.product(work, layer, rows, &p);
    }

    /// Computes [`Self::out`] of `[samples, padded(inputs)]` numbers.
    pub fn forward(&self, work: &mut Work<'_>, k: &Kernels, input: &Buffer, rows: usize) {
        let mut x = input;
        for (i, layer) in self.layers.iter().enumerate() {
            self.layer(work, k, i, [x, &layer.out], rows, false);
            self.skip(work, &k.append, i + 1, [input, &layer.out], rows);
            x = &layer.out;
        }
    }

    /// Where layer `i` is a skip layer: copies the network's input behind its own, or adds that part of its derivative to
    /// the input's.
    fn skip(&self, work: &mut Work<'_>, kernel: &Kernel, i: usize, [input, here]: [&Buffer; 2], rows: usize) {
        let Some(layer) = self.layers.get(i).filter(|layer| layer.own < layer.inputs) else { return };
        let inputs = layer.inputs - layer.own;
        let sizes = [rows, inputs, self.layers[0].in_stride, layer.own, layer.in_stride].map(|n| n as u32);
        let sizes: Vec<u32> = sizes.into_iter().chain([layer.scale.to_bits()]).collect();
        work.run(kernel, &sizes, &[(1, input), (2, here)], rows * inputs);
    }

    /// Computes [`Self::d_input`] and adds to the partial sums of the parameters' gradient, which [`Self::step`] clears,
    /// after [`Self::forward`].
    pub fn backward(&self, work: &mut Work<'_>, k: &Kernels, input: &Buffer, d_out: &Buffer, rows: usize) {
        let mut dz = d_out;
        for (i, layer) in self.layers.iter().enumerate().rev() {
            let x = if i == 0 { input } else { &self.layers[i - 1].out };
            self.weight_gradient(work, k, i, [x, dz], rows, false);
            self.input_gradient(work, k, i, [x, dz, &layer.d_input], rows);
            if i > 0 && self.layers[i - 1].second.is_some() {
                self.between(work, &k.join_tangent, i - 1, rows, |_, second| {
                    vec![(5, &second.joins), (6, &layer.d_input)]
                });
            }
            dz = &layer.d_input;
        }
        for (i, layer) in self.layers.iter().enumerate() {
            self.skip(work, &k.add_skipped, i, [self.d_input(), &layer.d_input], rows);
        }
    }

    /// A pass between two products, over the numbers of hidden layer `i`; `buffers` names those that it binds.
    fn between<'a>(
        &'a self,
        work: &mut Work<'_>,
        kernel: &Kernel,
        i: usize,
        rows: usize,
        buffers: impl Fn(&'a Layer, &'a Second) -> Vec<(u32, &'a Buffer)>,
    ) {
        let (layer, next) = (&self.layers[i], &self.layers[i + 1]);
        let Some(second) = &layer.second else { return };
        let [rows_, width, weights, stride, own, inputs] =
            [rows, layer.out_stride, next.weights, next.weight_stride, next.own, next.inputs].map(|n| n as u32);
        let sizes = [rows_, width, self.beta().to_bits(), weights, stride, own, inputs, next.scale.to_bits()];
        work.run(kernel, &sizes, &buffers(layer, second), rows * layer.out_stride);
    }

    /// Computes [`Self::gradient`], the derivative of output 0, after [`Self::forward`].
    pub fn gradient(&self, work: &mut Work<'_>, k: &Kernels, input: &Buffer, rows: usize) {
        let last = self.layers.len() - 1;
        self.between(work, &k.first_gradient, last - 1, rows, |layer, second| {
            vec![(1, self.weights()), (2, &layer.out), (3, &second.r)]
        });
        for i in (0..last).rev() {
            let Some(Second { r, .. }) = &self.layers[i].second else { return };
            let (x, dx) = match i.checked_sub(1) {
                None => (input, &self.gradient),
                Some(before) => match &self.layers[before].second {
                    Some(second) => (&self.layers[before].out, &second.r),
                    None => return,
                },
            };
            self.input_gradient(work, k, i, [x, r, dx], rows);
        }
        for (i, layer) in self.layers.iter().enumerate() {
            if let Some(Second { r, .. }) = &layer.second {
                self.skip(work, &k.add_skipped, i + 1, [&self.gradient, r], rows);
            }
        }
    }

    /// The double backward pass: [`Self::backward`] where a loss also has the derivative `d_gradient`
    /// (`[samples, padded(inputs)]`) by [`Self::gradient`].
    pub fn double_backward(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        input: &Buffer,
        [d_out, d_gradient]: [&Buffer; 2],
        rows: usize,
    ) {
        let mut q_here = d_gradient;
        for i in 0..self.layers.len() - 1 {
            let Some(Second { q, .. }) = &self.layers[i].second else { return };
            self.layer(work, k, i, [q_here, q], rows, true);
            self.between(work, &k.turn, i, rows, |layer, second| {
                vec![(2, &layer.out), (3, &second.r), (4, &second.q), (5, &second.joins)]
            });
            self.skip(work, &k.append, i + 1, [d_gradient, q], rows);
            q_here = q;
        }
        self.backward(work, k, input, d_out, rows);
        let mut q_here = d_gradient;
        for (i, layer) in self.layers.iter().enumerate() {
            // The last layer's r is the unit vector of output 0; a buffer has to be bound all the same.
            let z = layer.second.as_ref().map_or(&layer.out, |second| &second.r);
            self.weight_gradient(work, k, i, [q_here, z], rows, true);
            if let Some(Second { q, .. }) = &layer.second {
                q_here = q;
            }
        }
    }

    /// One Adam step, with all that was added since the last one, and the weights that follow from it.
    pub fn step(&self, work: &mut Work<'_>, k: &Kernels, step: &AdamStep) {
        let gradient = |sums| Gradient { kernel: &k.adam_network, from: (5, sums), scales: None, unit: 0.0 };
        let len = self.parameters.len;
        let summed = [(4, &self.partial_sums), (5, &self.d_weights)];
        // Eight threads for each parameter.
        work.run(&k.sum_up, &[0, len as u32, self.pieces as u32], &summed, 8 * len);
        let Some(gains) = &self.gains else {
            self.parameters.step(work, step, &gradient(&self.d_weights), len);
            return;
        };
        let lengths = &gains.lengths;
        let sent = [
            (1, &gains.columns),
            (2, &self.parameters.values),
            (3, &lengths.values),
            (5, &self.d_weights),
            (6, &gains.d_lengths),
        ];
        work.run(&k.send_to_lengths, &[lengths.len as u32, 0, 0], &sent, lengths.len);
        self.parameters.step(work, step, &gradient(&self.d_weights), len);
        lengths.step(work, step, &gradient(&gains.d_lengths), lengths.len);
        self.normalise(work, k);
    }

    /// Works out the weights in use, where they are normalised.
    fn normalise(&self, work: &mut Work<'_>, k: &Kernels) {
        let Some(gains) = &self.gains else { return };
        let (values, lengths) = (&self.parameters.values, &gains.lengths);
        let buffers = [(1, &gains.columns), (2, values), (3, &lengths.values), (7, &gains.weights)];
        work.run(&k.normalise, &[lengths.len as u32, 0, 0], &buffers, lengths.len);
    }

    /// Brings what was learned to the twin.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn fetch(&self, context: &Context, twin: &mut Twin) -> Result<()> {
        let [direct, lengths] = twin.parts_mut();
        self.parameters.fetch(context, direct)?;
        self.gains.as_ref().map_or(Ok(()), |gains| gains.lengths.fetch(context, lengths))?;
        twin.refresh();
        Ok(())
    }
}
