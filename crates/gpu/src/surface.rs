//! A distance field on the device. Twin: [`SdfField`].

use mb_job::Result;
use mb_neural::encoding::{Frequencies, HARMONICS};
use mb_neural::sdf_field::{DirectionEncoding, SdfField};

use crate::context::{Buffer, Context, Work};
use crate::encoding::{Encoding, Points};
use crate::frequencies::{self, Columns, encode_directions, encode_positions};
use crate::kernels::Kernels;
use crate::network::Network;
use crate::ray_gradients::{self, ByColor, ByPosition, Coordinates};
use crate::rays::Samples;
use crate::trained::AdamStep;

/// Points that are asked for their distance at once.
const POINTS: usize = 1 << 18;

/// How a position is encoded.
enum Position {
    /// Of the unit cube.
    Hash(Box<Encoding>),
    /// Of the ball.
    Frequencies(Frequencies),
}

/// The field, and what its passes over the samples of a step leave for each other; the shapes are those of the kernels.
pub struct Surface {
    position: Position,
    direction: DirectionEncoding,
    /// Distance, in output 0, and features.
    pub geometry: Network,
    /// Colour, before the sigmoid.
    pub color: Network,
    /// Features that the colour network gets, and the row lengths of both networks' input.
    features: usize,
    stride: usize,
    color_stride: usize,
    /// `[samples, 3]`, by [`Self::forward`]; their derivatives before [`Self::backward`].
    pub normals: Buffer,
    /// To be filled before [`Self::backward`]: derivatives of the distance, and of the colours before the sigmoid.
    pub d_sdf: Buffer,
    /// See `d_sdf`.
    pub d_color: Buffer,
    encoded: Buffer,
    color_in: Buffer,
    d_out: Buffer,
    d_gradient: Buffer,
    d_positions: Buffer,
}

impl Surface {
    /// From its twin.
    pub fn new(context: &Context, k: &Kernels, twin: &SdfField) -> Self {
        let (parts, none) = (twin.parts(), || context.zeros(0));
        Self {
            position: match parts.grid {
                Some((grid, table)) => Position::Hash(Box::new(Encoding::new(context, grid, table, 3))),
                None => Position::Frequencies(parts.frequencies),
            },
            direction: parts.direction,
            geometry: Network::of_twin(context, k, parts.geometry, true),
            color: Network::of_twin(context, k, parts.color, false),
            features: parts.geometry.mlp().shape().outputs - 1,
            stride: parts.geometry.mlp().in_stride(),
            color_stride: parts.color.mlp().in_stride(),
            normals: none(),
            d_sdf: none(),
            d_color: none(),
            encoded: none(),
            color_in: none(),
            d_out: none(),
            d_gradient: none(),
            d_positions: none(),
        }
    }

    /// Levels of a hash encoding that are in use; the rest give zero.
    pub fn set_levels(&mut self, active: usize) {
        if let Position::Hash(encoding) = &mut self.position {
            encoding.active_levels = active;
        }
    }

    /// Makes room for so many samples.
    pub fn reserve(&mut self, context: &Context, n: usize) {
        for (buffer, width) in [
            (&mut self.encoded, self.stride),
            (&mut self.color_in, self.color_stride),
            (&mut self.normals, 3),
            (&mut self.d_sdf, 1),
            (&mut self.d_color, 8),
            (&mut self.d_out, self.geometry.out_stride()),
            (&mut self.d_gradient, self.stride),
        ] {
            context.reserve(buffer, n * width);
        }
        self.geometry.reserve(context, n);
        self.color.reserve(context, n);
    }

    /// Makes room for what [`Self::ray_gradients`] leaves of so many samples.
    pub fn reserve_gradients(&mut self, context: &Context, n: usize) {
        context.reserve(&mut self.d_positions, 3 * n);
    }

    /// The columns of the encoded position.
    fn columns(&self) -> Columns<'_> {
        Columns { to: &self.encoded, stride: self.stride, first: 0 }
    }

    /// The geometry network's output.
    pub fn distance(&self, work: &mut Work<'_>, k: &Kernels, points: Points<'_>) {
        match &self.position {
            Position::Hash(encoding) => encoding.forward(work, k, points, &self.encoded),
            Position::Frequencies(octaves) => {
                encode_positions(work, k, *octaves, (points, 3), [1.0, 0.0], self.columns());
            }
        }
        self.geometry.forward(work, k, &self.encoded, points.count);
    }

    /// Distances of points, which lie where the encoding of the position wants them.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn distances(&mut self, context: &Context, k: &Kernels, points: &[[f32; 3]]) -> Result<Vec<f32>> {
        let mut found = Vec::with_capacity(points.len());
        for points in points.chunks(POINTS) {
            let (n, stride) = (points.len(), self.geometry.out_stride());
            self.reserve(context, n);
            let positions = context.upload(points.as_flattened());
            let mut work = context.work();
            self.distance(&mut work, k, Points { positions: &positions, count: n });
            work.submit();
            let rows: Vec<f32> = context.read(self.geometry.out(), n * stride)?;
            found.extend(rows.chunks_exact(stride).map(|row| row[0]));
        }
        Ok(found)
    }

    /// Sizes of `split_sdf` and `join_sdf`: `rows` samples, of which the first `colored` have a colour.
    fn sizes(&self, rows: usize, colored: usize) -> [u32; 10] {
        let (directions, harmonics) = match self.direction {
            DirectionEncoding::Harmonics => (HARMONICS, 1),
            DirectionEncoding::Frequencies(octaves) => (Frequencies(octaves).width(), 0),
        };
        let [geometry, encoded, color] = [self.geometry.out_stride(), self.stride, self.color_stride];
        [rows, 0, colored, self.features, geometry, encoded, color, directions, harmonics, 0].map(|n| n as u32)
    }

    /// Distances and normals of all rows, colours of the first ones, which belong to rays.
    pub fn forward(&self, work: &mut Work<'_>, k: &Kernels, rays: &Buffer, s: &Samples, rows: usize) {
        let points = s.points(rows);
        self.distance(work, k, points);
        self.geometry.gradient(work, k, &self.encoded, rows);
        let gradient = &self.geometry.gradient;
        match &self.position {
            Position::Hash(encoding) => encoding.normals(work, k, points, gradient, &self.normals),
            Position::Frequencies(octaves) => {
                frequencies::normals(work, k, *octaves, (rows, 3), self.columns(), [gradient, &self.normals]);
            }
        }
        let split = [
            (1, rays),
            (2, &s.ray_of),
            (4, self.geometry.out()),
            (5, &self.color_in),
            (8, &self.encoded),
            (9, &self.normals),
        ];
        work.run(&k.split_sdf, &self.sizes(rows, s.len), &split, s.len);
        if let DirectionEncoding::Frequencies(octaves) = self.direction {
            let columns = Columns { to: &self.color_in, stride: self.color_stride, first: 6 };
            encode_directions(work, k, Frequencies(octaves), (rays, s), columns);
        }
        self.color.forward(work, k, &self.color_in, s.len);
    }

    /// Sends `d_sdf`, `d_color` and what the normals have become, their derivatives, back to the networks and, in this unit,
    /// to the table.
    pub fn backward(&self, work: &mut Work<'_>, k: &Kernels, s: &Samples, rows: usize, unit: f32) {
        self.color.backward(work, k, &self.color_in, &self.d_color, s.len);
        let join = [(4, &self.d_out), (5, self.color.d_input()), (6, &self.d_sdf), (9, &self.normals)];
        work.run(&k.join_sdf, &self.sizes(rows, s.len), &join, rows);
        let points = s.points(rows);
        match &self.position {
            Position::Hash(encoding) => encoding.tangent(work, k, points, &self.normals, &self.d_gradient),
            Position::Frequencies(octaves) => {
                let along = [&self.normals, &self.d_gradient];
                frequencies::tangent(work, k, *octaves, rows, self.columns(), along);
            }
        }
        self.geometry.double_backward(work, k, &self.encoded, [&self.d_out, &self.d_gradient], rows);
        if let Position::Hash(encoding) = &self.position {
            let second = (&self.geometry.gradient, &self.normals);
            encoding.scatter_both(work, k, points, self.geometry.d_input(), second, unit);
        }
    }

    /// After [`Self::backward`]: adds to `[rays, 8]` numbers, which begin at number `4 first` of a buffer, what the losses ask
    /// of the rays through their samples' positions and the encoded direction.
    pub fn ray_gradients(
        &self,
        work: &mut Work<'_>,
        k: &Kernels,
        rays: (&Buffer, usize),
        s: &Samples,
        to: (&Buffer, usize),
    ) {
        let (points, d_input, g) = (s.points(s.len), self.geometry.d_input(), &self.geometry.gradient);
        match &self.position {
            Position::Hash(encoding) => {
                encoding.position_gradient(work, k, points, d_input, (g, &self.normals), &self.d_positions);
            }
            Position::Frequencies(octaves) => {
                let buffers = [d_input, g, &self.normals, &self.d_positions];
                frequencies::position_gradient(work, k, *octaves, s.len, self.columns(), buffers);
            }
        }
        let position = ByPosition { d: &self.d_positions, of: Coordinates::Scene, scale: [1.0; 3] };
        let color = ByColor {
            d: self.color.d_input(),
            stride: self.color_stride,
            with_position: true,
            first: 6,
            direction: Some(self.direction),
        };
        ray_gradients::add(work, k, rays, s, (position, color), to);
    }

    /// One Adam step, of the table, whose gradient has this unit, and of the networks.
    pub fn step(&self, work: &mut Work<'_>, k: &Kernels, unit: f32, [table, networks]: [AdamStep; 2]) {
        if let Position::Hash(encoding) = &self.position {
            encoding.step(work, k, unit, &table);
        }
        self.geometry.step(work, k, &networks);
        self.color.step(work, k, &networks);
    }

    /// Brings what was learned to the twin.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn fetch(&self, context: &Context, twin: &mut SdfField) -> Result<()> {
        let (table, [geometry, color]) = twin.parts_mut();
        if let Position::Hash(encoding) = &self.position {
            encoding.table.fetch(context, table)?;
        }
        self.geometry.fetch(context, geometry)?;
        self.color.fetch(context, color)
    }
}
