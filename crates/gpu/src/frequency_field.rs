//! A field of frequencies on the device. Twin: [`FrequencyField`].

use mb_job::Result;
use mb_neural::encoding::Frequencies;
use mb_neural::frequency_field::{DensityActivation, FrequencyField, FrequencyParameters};
use mb_neural::sdf_field::DirectionEncoding;

use crate::context::{Buffer, Context, Work};
use crate::frequencies::{self, Columns, encode_directions, encode_positions};
use crate::kernels::Kernels;
use crate::network::Network;
use crate::ray_gradients::{self, ByColor, ByPosition, Coordinates};
use crate::rays::Samples;
use crate::trained::AdamStep;

/// The field, and what its passes over some samples leave for each other; the shapes are those of the kernels.
pub struct FrequencyNetworks {
    coordinates: usize,
    position: Frequencies,
    direction: Frequencies,
    trunk: Network,
    head: Network,
    features: usize,
    trunk_stride: usize,
    head_stride: usize,
    activation: DensityActivation,
    encoded: Buffer,
    head_in: Buffer,
    d_trunk: Buffer,
    d_positions: Buffer,
    /// Density of each sample.
    pub sigma: Buffer,
    /// To be filled before [`Self::backward`]: derivatives of the trunk's output 0, and of the colours before their sigmoid.
    pub d_density: Buffer,
    /// See `d_density`.
    pub d_color: Buffer,
}

impl FrequencyNetworks {
    /// From its twin.
    pub fn new<const D: usize>(context: &Context, field: &FrequencyField<D>, p: &FrequencyParameters) -> Self {
        let none = || context.zeros(0);
        Self {
            coordinates: D,
            position: field.position,
            direction: field.direction,
            trunk: Network::new(context, &field.trunk, &p.trunk, false),
            head: Network::new(context, &field.head, &p.head, false),
            features: field.trunk.shape().outputs - 1,
            trunk_stride: field.trunk.in_stride(),
            head_stride: field.head.in_stride(),
            activation: field.activation,
            encoded: none(),
            head_in: none(),
            d_trunk: none(),
            d_positions: none(),
            sigma: none(),
            d_density: none(),
            d_color: none(),
        }
    }

    /// Makes room for so many samples.
    pub fn reserve(&mut self, context: &Context, n: usize) {
        for (buffer, width) in [
            (&mut self.encoded, self.trunk_stride),
            (&mut self.head_in, self.head_stride),
            (&mut self.d_trunk, self.trunk.out_stride()),
            (&mut self.sigma, 1),
            (&mut self.d_density, 1),
            (&mut self.d_color, 8),
        ] {
            context.reserve(buffer, n * width);
        }
        self.trunk.reserve(context, n);
        self.head.reserve(context, n);
    }

    /// Makes room for what [`Self::ray_gradients`] leaves of so many samples.
    pub fn reserve_gradients(&mut self, context: &Context, n: usize) {
        context.reserve(&mut self.d_positions, n * self.coordinates);
    }

    /// How density follows from the trunk's output 0, as composite.wgsl numbers it.
    pub fn activation(&self) -> u32 {
        match self.activation {
            DensityActivation::Relu => 1,
            DensityActivation::Softplus => 2,
        }
    }

    /// Colours before the sigmoid, `[samples, 8]`.
    pub fn color(&self) -> &Buffer {
        self.head.out()
    }

    /// As field.wgsl reads them.
    fn sizes(&self, n: usize) -> [u32; 10] {
        let strides = [self.trunk.out_stride(), self.trunk_stride, self.head_stride].map(|n| n as u32);
        [n as u32, 0, 0, self.features as u32, strides[0], strides[1], strides[2], 0, 0, self.activation()]
    }

    /// Densities and colours of samples, whose positions have the field's number of coordinates.
    pub fn forward(&self, work: &mut Work<'_>, k: &Kernels, rays: &Buffer, s: &Samples) {
        let (n, sizes) = (s.len, self.sizes(s.len));
        let columns = Columns { to: &self.encoded, stride: self.trunk_stride, first: 0 };
        encode_positions(work, k, self.position, (s.points(n), self.coordinates), [1.0, 0.0], columns);
        self.trunk.forward(work, k, &self.encoded, n);
        work.run(&k.density_of_frequencies, &sizes, &[(4, self.trunk.out()), (6, &self.sigma)], n);
        let split = [(4, self.trunk.out()), (5, &self.head_in)];
        work.run(&k.split_frequencies, &sizes, &split, n * self.features);
        let columns = Columns { to: &self.head_in, stride: self.head_stride, first: self.features };
        encode_directions(work, k, self.direction, (rays, s), columns);
        self.head.forward(work, k, &self.head_in, n);
    }

    /// Sends `d_density` and `d_color` back to the networks' sums, which [`Self::step`] clears.
    pub fn backward(&self, work: &mut Work<'_>, k: &Kernels, s: &Samples) {
        let n = s.len;
        self.head.backward(work, k, &self.head_in, &self.d_color, n);
        let join = [(4, &self.d_trunk), (5, self.head.d_input()), (6, &self.d_density)];
        work.run(&k.join_frequencies, &self.sizes(n), &join, n * self.trunk.out_stride());
        self.trunk.backward(work, k, &self.encoded, &self.d_trunk, n);
    }

    /// After [`Self::backward`]: adds to `[rays, 8]` numbers, which begin at number `4 first` of a buffer, what the losses ask
    /// of the rays.
    pub fn ray_gradients(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        rays: (&Buffer, usize),
        s: &Samples,
        of: Coordinates,
        to: (&Buffer, usize),
    ) {
        let (d, columns) = (&self.d_positions, Columns { to: &self.encoded, stride: self.trunk_stride, first: 0 });
        let size = (s.len, self.coordinates);
        frequencies::normals(work, k, self.position, size, columns, [self.trunk.d_input(), d]);
        let color = ByColor {
            d: self.head.d_input(),
            stride: self.head_stride,
            with_position: false,
            first: self.features,
            direction: Some(DirectionEncoding::Frequencies(self.direction.0)),
        };
        ray_gradients::add(work, k, rays, s, (ByPosition { d, of, scale: [1.0; 3] }, color), to);
    }

    /// One Adam step.
    pub fn step(&self, work: &mut Work<'_>, k: &Kernels, step: &AdamStep) {
        self.trunk.step(work, k, step);
        self.head.step(work, k, step);
    }

    /// Brings what was learned to the twin.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn fetch(&self, context: &Context, p: &mut FrequencyParameters) -> Result<()> {
        self.trunk.parameters.fetch(context, &mut p.trunk)?;
        self.head.parameters.fetch(context, &mut p.head)
    }
}
