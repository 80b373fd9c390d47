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

    /// Records a step. `gradient` has its binding; `pieces` are the sums of a network's, `unit` is that of a table's.
    pub fn step(
        &self,
        work: &mut Work<'_>,
        kernel: &Kernel,
        step: &AdamStep,
        gradient: (u32, &Buffer),
        (pieces, unit): (usize, f32),
        threads: usize,
    ) {
        let AdamOptions { beta1, beta2, epsilon, .. } = step.options;
        let left = |beta: f32| (1.0 - f64::from(beta).powf(step.t as f64)) as f32;
        let floats = [beta1, beta2, step.lr / left(beta1), 1.0 / left(beta2).sqrt(), epsilon, unit].map(f32::to_bits);
        let mut sizes = vec![self.len as u32, pieces as u32];
        sizes.extend(floats);
        work.run(kernel, &sizes, &[(1, &self.values), (2, &self.m), (3, &self.v), gradient], threads);
    }
}
