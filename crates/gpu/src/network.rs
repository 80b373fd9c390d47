//! A fully connected network on the device: its layers, their derivatives, and the derivatives of its gradient.

use mb_neural::adam::Parameters;
use mb_neural::mlp::{Activation, Mlp};

use crate::context::{Buffer, Context, Kernel, WORKGROUP, Work};
use crate::kernels::Kernels;
use crate::trained::{AdamStep, Trained};

struct Layer {
    inputs: usize,
    in_stride: usize,
    outputs: usize,
    out_stride: usize,
    weights: usize,
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

/// A network.
pub struct Network {
    layers: Vec<Layer>,
    activation: Activation,
    /// Laid out as the twin's.
    pub parameters: Trained,
    /// `[pieces, parameters]`: sums of the gradient.
    pub partial_sums: Buffer,
    pieces: usize,
    /// `[samples, padded(inputs)]`, by [`Self::gradient`].
    pub gradient: Buffer,
}

/// Partial sums of the weights' gradient, at most, and their rows, at least.
const PIECES: usize = 128;
const PIECE: usize = 256;

/// Rows of one partial sum.
fn piece_of(rows: usize) -> usize {
    rows.div_ceil(PIECES).max(PIECE)
}

/// Threads for a product of this size: a workgroup for each tile of 32 x 32.
fn threads_of(height: usize, width: usize) -> usize {
    height.div_ceil(32) * width.div_ceil(32) * WORKGROUP
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
    threads: usize,
}

impl Network {
    /// From its twin. `second_order` networks give a gradient that losses may use.
    ///
    /// # Panics
    /// The twin has a skip layer, or is of second order and has no softplus.
    pub fn new(context: &Context, mlp: &Mlp, parameters: &Parameters, second_order: bool) -> Self {
        let shape = mlp.shape();
        assert!(shape.skip.is_none(), "{shape:?}");
        assert!(!second_order || matches!(shape.activation, Activation::Softplus { .. }), "{shape:?}");
        let mut in_stride = mlp.in_stride();
        let none = || context.zeros(0);
        let layers = mlp
            .layout()
            .enumerate()
            .map(|(k, (inputs, outputs, out_stride, weights, _))| {
                let second = (second_order && k < shape.hidden).then(|| Second { r: none(), q: none(), joins: none() });
                let layer =
                    Layer { inputs, in_stride, outputs, out_stride, weights, out: none(), d_input: none(), second };
                in_stride = out_stride;
                layer
            })
            .collect();
        Self {
            layers,
            activation: shape.activation,
            parameters: Trained::new(context, parameters),
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
        self.pieces = samples.div_ceil(piece_of(samples));
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
            layer.out_stride as u32,
            layer.weights as u32,
            activation,
            self.parameters.len as u32,
            piece_of(rows) as u32,
            self.beta().to_bits(),
            u32::from(p.tangent),
            u32::from(p.unit),
        ];
        let buffers = [(1, &self.parameters.values), (2, p.x), (3, p.z), (4, p.dx), (5, &self.partial_sums)];
        work.run(p.kernel, &sizes, &buffers, p.threads);
    }

    /// `x W` of a layer, with bias and activation, or, of tangents, without.
    fn layer(&self, work: &mut Work<'_>, k: &Kernels, i: usize, [x, z]: [&Buffer; 2], rows: usize, tangent: bool) {
        let layer = &self.layers[i];
        let p = Product {
            kernel: &k.layer,
            x,
            z,
            dx: &layer.d_input,
            activated: !tangent && i + 1 < self.layers.len(),
            tangent,
            unit: false,
            threads: threads_of(rows, layer.out_stride),
        };
        self.product(work, layer, rows, &p);
    }

    /// `dz W^T` of a layer, times the slope of what came in.
    fn input_gradient(&self, work: &mut Work<'_>, k: &Kernels, i: usize, [x, z, dx]: [&Buffer; 3], rows: usize) {
        let layer = &self.layers[i];
        let threads = threads_of(rows, layer.inputs);
        let p = Product { kernel: &k.input_gradient, x, z, dx, activated: i > 0, tangent: false, unit: false, threads };
        self.product(work, layer, rows, &p);
    }

    /// `x^T dz` of a layer; tangents add to what is there.
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
        let height = layer.inputs + usize::from(!tangent);
        let p = Product {
            kernel: &k.weight_gradient,
            x,
            z,
            dx: &layer.d_input,
            activated: false,
            tangent,
            unit: tangent && i + 1 == self.layers.len(),
            threads: rows.div_ceil(piece_of(rows)) * threads_of(height, layer.out_stride),
        };
        self.product(work, layer, rows, &p);
    }

    /// Computes [`Self::out`] of `[samples, padded(inputs)]` numbers.
    pub fn forward(&self, work: &mut Work<'_>, k: &Kernels, input: &Buffer, rows: usize) {
        let mut x = input;
        for (i, layer) in self.layers.iter().enumerate() {
            self.layer(work, k, i, [x, &layer.out], rows, false);
            x = &layer.out;
        }
    }

    /// Computes [`Self::d_input`] and the partial sums of the parameters' gradient, after [`Self::forward`].
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
        let (width, outputs) = (layer.out_stride as u32, layer.outputs as u32);
        let sizes = [rows as u32, width, self.beta().to_bits(), next.weights as u32, next.out_stride as u32, outputs];
        work.run(kernel, &sizes, &buffers(layer, second), rows * layer.out_stride);
    }

    /// Computes [`Self::gradient`], the derivative of output 0, after [`Self::forward`].
    pub fn gradient(&self, work: &mut Work<'_>, k: &Kernels, input: &Buffer, rows: usize) {
        let last = self.layers.len() - 1;
        self.between(work, &k.first_gradient, last - 1, rows, |layer, second| {
            vec![(1, &self.parameters.values), (2, &layer.out), (3, &second.r)]
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

    /// One Adam step.
    pub fn step(&self, work: &mut Work<'_>, k: &Kernels, step: &AdamStep) {
        let pieces = (self.pieces, 0.0);
        self.parameters.step(work, &k.adam_network, step, (5, &self.partial_sums), pieces, self.parameters.len);
    }
}
