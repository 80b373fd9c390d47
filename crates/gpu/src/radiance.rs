//! A radiance field on the device. Twin: [`RadianceField`].

use mb_job::Result;
use mb_neural::radiance_field::{ADAM, RadianceField, RadianceParameters};
use mb_neural::sdf_field::DirectionEncoding;
use rayon::prelude::*;

use crate::context::{Buffer, Context, Work};
use crate::encoding::{Encoding, Points};
use crate::kernels::Kernels;
use crate::network::Network;
use crate::ray_gradients::{self, ByColor, ByPosition, Coordinates};
use crate::rays::Samples;
use crate::trained::AdamStep;

/// The field, and what its passes over the samples of a step leave for each other; the shapes are those of the kernels.
pub struct Radiance {
    /// Encoding of the position.
    pub encoding: Encoding,
    /// The density network.
    pub density: Network,
    /// The colour network.
    pub color: Network,
    /// Density of each sample.
    pub sigma: Buffer,
    /// To be filled before [`Self::backward`]: derivative of the density network's output 0, and of the colours before their
    /// sigmoid.
    pub d_density: Buffer,
    /// See `d_density`.
    pub d_color: Buffer,
    features: Buffer,
    color_in: Buffer,
    d_geometry: Buffer,
    d_positions: Buffer,
    /// Largest density found in each cell of the occupancy grid since [`Self::seen`].
    seen: Buffer,
    resolution: usize,
}

/// Points that are asked for their density at once.
const POINTS: usize = 1 << 18;

impl Radiance {
    /// From its twin; its samples lie in an occupancy grid with `resolution` cells a side.
    pub fn new(context: &Context, field: &RadianceField, p: &RadianceParameters, resolution: usize) -> Self {
        let (grid, density, color) = field.parts();
        let none = || context.zeros(0);
        Self {
            encoding: Encoding::new(context, grid, &p.table, 0),
            density: Network::new(context, density, &p.density, false),
            color: Network::new(context, color, &p.color, false),
            sigma: none(),
            d_density: none(),
            d_color: none(),
            features: none(),
            color_in: none(),
            d_geometry: none(),
            d_positions: none(),
            seen: context.zeros(resolution.pow(3)),
            resolution,
        }
    }

    /// Makes room for so many samples.
    pub fn reserve(&mut self, context: &Context, n: usize) {
        for (buffer, width) in [
            (&mut self.features, self.encoding.stride()),
            (&mut self.sigma, 1),
            (&mut self.color_in, 32),
            (&mut self.d_density, 1),
            (&mut self.d_color, 8),
            (&mut self.d_geometry, 16),
        ] {
            context.reserve(buffer, n * width);
        }
        self.density.reserve(context, n);
        self.color.reserve(context, n);
    }

    /// Makes room for what [`Self::ray_gradients`] leaves of so many samples.
    pub fn reserve_gradients(&mut self, context: &Context, n: usize) {
        context.reserve(&mut self.d_positions, 3 * n);
    }

    fn density_of(&self, work: &mut Work<'_>, k: &Kernels, points: Points<'_>) {
        let n = points.count;
        self.encoding.forward(work, k, points, &self.features);
        self.density.forward(work, k, &self.features, n);
        work.run(&k.density, &self.sizes(n), &[(4, self.density.out()), (6, &self.sigma)], n);
    }

    /// The rest of the sizes is the other fields'.
    fn sizes(&self, n: usize) -> [u32; 10] {
        [n as u32, self.resolution as u32, 0, 0, 0, 0, 0, 0, 0, 0]
    }

    /// Densities and colours of samples, whose cells hear of them.
    pub fn forward(&self, work: &mut Work<'_>, k: &Kernels, rays: &Buffer, s: &Samples) {
        let n = s.len;
        self.density_of(work, k, s.points(n));
        work.run(&k.note, &self.sizes(n), &[(3, &s.positions), (6, &self.sigma), (7, &self.seen)], n);
        let split = [(1, rays), (2, &s.ray_of), (4, self.density.out()), (5, &self.color_in)];
        work.run(&k.split, &self.sizes(n), &split, 8 * n);
        self.color.forward(work, k, &self.color_in, n);
    }

    /// Sends `d_density` and `d_color` back to the networks and, in this unit, to the table.
    pub fn backward(&self, work: &mut Work<'_>, k: &Kernels, s: &Samples, unit: f32) {
        let n = s.len;
        self.color.backward(work, k, &self.color_in, &self.d_color, n);
        let join = [(4, &self.d_geometry), (5, self.color.d_input()), (6, &self.d_density)];
        work.run(&k.join, &self.sizes(n), &join, 16 * n);
        self.density.backward(work, k, &self.features, &self.d_geometry, n);
        self.encoding.scatter(work, k, s.points(n), self.density.d_input(), unit);
    }

    /// After [`Self::backward`]: adds to `[rays, 8]` numbers, which begin at number `4 first` of a buffer, what the losses ask
    /// of the rays.
    pub fn ray_gradients(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        rays: (&Buffer, usize),
        s: &Samples,
        to: (&Buffer, usize),
    ) {
        self.encoding.normals(work, k, s.points(s.len), self.density.d_input(), &self.d_positions);
        // In -1..1 contracted space is half as long.
        let position = ByPosition { d: &self.d_positions, of: Coordinates::Contracted, scale: [0.5; 3] };
        let direction = Some(DirectionEncoding::Harmonics);
        let color = ByColor { d: self.color.d_input(), stride: 32, with_position: false, first: 16, direction };
        ray_gradients::add(work, k, rays, s, (position, color), to);
    }

    /// One Adam step.
    pub fn step(&self, work: &mut Work<'_>, k: &Kernels, unit: f32, lr: f32, t: u64) {
        let step = AdamStep { options: ADAM, lr, t };
        self.encoding.step(work, k, unit, &step);
        self.density.step(work, k, &step);
        self.color.step(work, k, &step);
    }

    /// Densities of points of the unit cube.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn densities(&mut self, context: &Context, k: &Kernels, points: &[[f32; 3]]) -> Result<Vec<f32>> {
        let mut found: Vec<f32> = Vec::with_capacity(points.len());
        for points in points.chunks(POINTS) {
            let n = points.len();
            self.reserve(context, n);
            let positions = context.upload(points.as_flattened());
            let mut work = context.work();
            self.density_of(&mut work, k, Points { positions: &positions, count: n });
            work.submit();
            found.extend(context.read::<f32>(&self.sigma, n)?);
        }
        Ok(found)
    }

    /// The cells that samples lay in since the last call, and the largest density found in each.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn seen(&self, context: &Context) -> Result<Vec<(u32, f32)>> {
        let seen = context.read_with(&self.seen, self.resolution.pow(3), |seen: &[f32]| {
            let seen = (0..seen.len() as u32).into_par_iter().zip(seen);
            seen.filter(|(_, v)| **v > 0.0).map(|(cell, v)| (cell, *v)).collect()
        })?;
        let mut work = context.work();
        work.clear(&self.seen);
        work.submit();
        Ok(seen)
    }

    /// Brings what was learned to the twin.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn fetch(&self, context: &Context, p: &mut RadianceParameters) -> Result<()> {
        self.encoding.table.fetch(context, &mut p.table)?;
        self.density.parameters.fetch(context, &mut p.density)?;
        self.color.parameters.fetch(context, &mut p.color)
    }
}
