//! Parameters on the device, and Adam.

use mb_job::Result;
use mb_neural::adam::{AdamOptions, Parameters};

use crate::context::{Buffer, Context, Kernel, Work};

/// Parameters on the device, beside their moments.
pub struct Trained {
    /// The parameters.
    pub values: Buffer,
    /// First moment.
    pub m: Buffer,
    /// Second moment.
    pub v: Buffer,
    /// How many.
    pub len: usize,
}

/// One Adam step: number `t` counted from 1, with learning rate `lr`.
#[derive(Debug, Clone, Copy)]
pub struct AdamStep {
    /// The constants.
    pub options: AdamOptions,
    /// Learning rate.
    pub lr: f32,
    /// Number of the step.
    pub t: u64,
}

/// A gradient, in the form that an entry point of `adam.wgsl` reads.
pub struct Gradient<'a> {
    /// The entry point.
    pub kernel: &'a Kernel,
    /// The gradient, with its binding.
    pub from: (u32, &'a Buffer),
    /// Factors of the rate, each for so many numbers.
    pub scales: Option<(&'a Buffer, u32)>,
    /// Unit of a table's.
    pub unit: f32,
}

impl Trained {
    /// From their twin.
    pub fn new(context: &Context, p: &Parameters) -> Self {
        let [values, m, v] = [&p.values, &p.m, &p.v].map(|content| context.upload(content));
        Self { values, m, v, len: p.values.len() }
    }

    /// Brings them to their twin.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn fetch(&self, context: &Context, p: &mut Parameters) -> Result<()> {
        p.values = context.read(&self.values, self.len)?;
        p.m = context.read(&self.m, self.len)?;
        p.v = context.read(&self.v, self.len)?;
        Ok(())
    }

    /// Records a step.
    pub fn step(&self, work: &mut Work<'_>, step: &AdamStep, gradient: &Gradient<'_>, threads: usize) {
        let AdamOptions { beta1, beta2, epsilon, .. } = step.options;
        let left = |beta: f32| (1.0 - f64::from(beta).powf(step.t as f64)) as f32;
        let rate = step.lr / left(beta1);
        let floats = [beta1, beta2, rate, 1.0 / left(beta2).sqrt(), epsilon, gradient.unit].map(f32::to_bits);
        let mut sizes = vec![self.len as u32];
        sizes.extend(floats);
        sizes.push(gradient.scales.map_or(0, |(_, width)| width));
        let mut buffers = vec![(1, &self.values), (2, &self.m), (3, &self.v), gradient.from];
        buffers.extend(gradient.scales.map(|(scales, _)| (6, scales)));
        work.run(gradient.kernel, &sizes, &buffers, threads);
    }
}
