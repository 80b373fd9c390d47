//! `neus --preset fast` on a device. As in [`crate::nerf`] rays are drawn and both occupancy grids are kept on the processor,
//! and so is the sharpness, one number; all else runs on the device.

use std::sync::Arc;

use mb_job::{Result, rng};
use mb_neural::cameras::CameraResiduals;
use mb_neural::dataset::RayDataset;
use mb_neural::model::{GROUPS, StepReport};
use mb_neural::neus::{DARK, FREE_POINTS, Neus, SHORTEST_OUTER_STEP, nearness};
use mb_neural::occupancy::{CELL_MEMORY, looks_everywhere};
use mb_neural::radiance_field::ADAM;
use mb_neural::sdf_field::{SdfField, SdfParts};
use rand::RngExt as _;

use crate::context::{Buffer, Context, Work};
use crate::encoding::{Encoding, Points, unit_of};
use crate::kernels::Kernels;
use crate::network::Network;
use crate::on_device::Learner;
use crate::radiance::Radiance;
use crate::rays::{RAY, Samples, Space, occupied, pack, starts};
use crate::trained::AdamStep;

/// Points that are asked for their distance at once.
const POINTS: usize = 1 << 18;

/// A distance field on the device. Twin: [`SdfField`].
struct Surface {
    encoding: Encoding,
    geometry: Network,
    color: Network,
    /// Features that the colour network gets, and the row length of its input.
    features: usize,
    color_stride: usize,
    encoded: Buffer,
    color_in: Buffer,
    normals: Buffer,
    d_sdf: Buffer,
    d_color: Buffer,
    d_out: Buffer,
    d_gradient: Buffer,
}

impl Surface {
    fn new(context: &Context, parts: &SdfParts<'_>) -> Self {
        let none = || context.zeros(0);
        let ((geometry, geometry_parameters), (color, color_parameters)) = (parts.geometry, parts.color);
        Self {
            encoding: Encoding::new(context, parts.grid, parts.table, 3),
            geometry: Network::new(context, geometry, geometry_parameters, true),
            color: Network::new(context, color, color_parameters, false),
            features: geometry.shape().outputs - 1,
            color_stride: color.in_stride(),
            encoded: none(),
            color_in: none(),
            normals: none(),
            d_sdf: none(),
            d_color: none(),
            d_out: none(),
            d_gradient: none(),
        }
    }

    fn reserve(&mut self, context: &Context, n: usize) {
        let (stride, out_stride) = (self.encoding.stride(), self.geometry.out_stride());
        for (buffer, width) in [
            (&mut self.encoded, stride),
            (&mut self.color_in, self.color_stride),
            (&mut self.normals, 3),
            (&mut self.d_sdf, 1),
            (&mut self.d_color, 8),
            (&mut self.d_out, out_stride),
            (&mut self.d_gradient, stride),
        ] {
            context.reserve(buffer, n * width);
        }
        self.geometry.reserve(context, n);
        self.color.reserve(context, n);
    }

    /// The geometry network's output, whose first number is the distance.
    fn distance(&self, work: &mut Work<'_>, k: &Kernels, points: Points<'_>) {
        self.encoding.forward(work, k, points, &self.encoded);
        self.geometry.forward(work, k, &self.encoded, points.count);
    }

    /// Distances of points of the unit cube.
    fn distances(&mut self, context: &Context, k: &Kernels, points: &[[f32; 3]]) -> Result<Vec<f32>> {
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
    fn sizes(&self, rows: usize, colored: usize) -> [u32; 7] {
        [rows, 0, colored, self.features, self.geometry.out_stride(), self.encoding.stride(), self.color_stride]
            .map(|n| n as u32)
    }

    /// Distances and normals of all rows, colours of the first ones, which belong to rays.
    fn forward(&self, work: &mut Work<'_>, k: &Kernels, rays: &Buffer, s: &Samples, rows: usize) {
        let points = s.points(rows);
        self.distance(work, k, points);
        self.geometry.gradient(work, k, &self.encoded, rows);
        self.encoding.normals(work, k, points, &self.geometry.gradient, &self.normals);
        let split = [
            (1, rays),
            (2, &s.ray_of),
            (4, self.geometry.out()),
            (5, &self.color_in),
            (8, &self.encoded),
            (9, &self.normals),
        ];
        work.run(&k.split_sdf, &self.sizes(rows, s.len), &split, s.len);
        self.color.forward(work, k, &self.color_in, s.len);
    }

    /// Sends `d_sdf`, `d_color` and what the normals have become, their derivatives, back.
    fn backward(&self, work: &mut Work<'_>, k: &Kernels, s: &Samples, rows: usize, unit: f32) {
        self.color.backward(work, k, &self.color_in, &self.d_color, s.len);
        let join = [(4, &self.d_out), (5, self.color.d_input()), (6, &self.d_sdf), (9, &self.normals)];
        work.run(&k.join_sdf, &self.sizes(rows, s.len), &join, rows);
        let points = s.points(rows);
        self.encoding.tangent(work, k, points, &self.normals, &self.d_gradient);
        self.geometry.double_backward(work, k, &self.encoded, [&self.d_out, &self.d_gradient], rows);
        let second = (&self.geometry.gradient, &self.normals);
        self.encoding.scatter_both(work, k, points, self.geometry.d_input(), second, unit);
    }

    fn fetch(&self, context: &Context, field: &mut SdfField) -> Result<()> {
        let [table, geometry, color] = field.parts_mut();
        self.encoding.table.fetch(context, table)?;
        self.geometry.parameters.fetch(context, geometry)?;
        self.color.parameters.fetch(context, color)?;
        field.refresh();
        Ok(())
    }
}

/// A NeuS whose twin holds all that is not of the device, and, after a fetch, all that the device has learned.
pub struct GpuNeus {
    twin: Neus,
    context: Arc<Context>,
    kernels: Kernels,
    surface: Surface,
    outside: Radiance,
    inner_cells: Buffer,
    outer_cells: Buffer,
    /// Inside the ball, as marched and as far as light reaches; behind it.
    marched: Samples,
    inner: Samples,
    outer: Samples,
    losses: Buffer,
}

/// What a step is given: the rays, and the points of the ball that belong to none.
struct Drawn {
    rays: Vec<[f32; RAY]>,
    free: Vec<[f32; 3]>,
}

fn plain_parts(twin: &Neus) -> SdfParts<'_> {
    twin.field.parts().expect("only plain fields come here")
}

impl GpuNeus {
    /// From its twin, which may have been trained.
    ///
    /// # Panics
    /// Its field is not plain: see [`mb_neural::sdf_field::SdfFieldOptions::is_plain`].
    pub fn new(twin: Neus, context: Arc<Context>) -> Self {
        let c = &*context;
        let surface = Surface::new(c, &plain_parts(&twin));
        let outside = Radiance::new(c, &twin.outside, &twin.outside_parameters, twin.options.occupancy);
        Self {
            kernels: Kernels::new(c),
            surface,
            outside,
            inner_cells: occupied(c, &twin.inner_cells),
            outer_cells: occupied(c, &twin.outer_cells),
            marched: Samples::new(c),
            inner: Samples::new(c),
            outer: Samples::new(c),
            losses: c.zeros(0),
            twin,
            context,
        }
    }

    /// Rays and free points of a step, as the twin draws them.
    fn draw(&self, data: &RayDataset, cameras: &CameraResiduals, step: u64) -> Drawn {
        let (twin, mut rays) = (&self.twin, Vec::new());
        let mut drawn = Drawn { rays: Vec::new(), free: Vec::new() };
        for group in 0..GROUPS as u64 {
            let mut rng = rng(twin.options.seed, step * GROUPS as u64 + group);
            data.draw(&mut rng, twin.rays_of_group(), cameras, &mut rays);
            drawn.rays.extend(rays.iter().map(|target| {
                let background = if twin.with_masks { [0.0; 3] } else { std::array::from_fn(|_| rng.random::<f32>()) };
                let mask = target.mask.filter(|_| twin.with_masks);
                let wanted = target.rgb.map(|c| c * mask.unwrap_or(1.0));
                let ball = target.ray.ball(1.0);
                let mut ray = pack(target, rng.random(), background, wanted, Neus::outer_start(ball));
                [ray[14], ray[15]] = ball.map_or([0.0, -1.0], |(near, far)| [near, far]);
                ray[16] = mask.unwrap_or(-1.0);
                ray
            }));
            let points = (0..FREE_POINTS).map(|_| std::array::from_fn(|_| 0.5 * rng.random_range(-1.0..1.0f32) + 0.5));
            drawn.free.extend(points);
        }
        drawn
    }

    fn march(&mut self, rays: &Buffer, count: usize) -> Result<()> {
        let o = &self.twin.options;
        let inside =
            Space { resolution: o.occupancy, far: o.far, step: self.twin.inner_step(), cone: 0.0, inside_ball: true };
        let (context, k) = (&*self.context, &self.kernels);
        self.marched.march(context, k, &inside, (rays, count), &self.inner_cells)?;
        if !self.twin.with_masks {
            let behind = Space { step: SHORTEST_OUTER_STEP, cone: o.background_cone, inside_ball: false, ..inside };
            self.outer.march(context, k, &behind, (rays, count), &self.outer_cells)?;
        }
        Ok(())
    }

    /// Keeps what light reaches of the marched samples, and puts the free points behind them.
    fn keep(&mut self, count: usize, free: &[[f32; 3]]) -> Result<()> {
        let (context, k, m) = (&*self.context, &self.kernels, &self.marched);
        self.surface.reserve(context, m.len);
        context.reserve(&mut self.inner.starts, count + 1);
        let stride = self.surface.geometry.out_stride() as u32;
        let sizes = [count as u32, self.twin.sharpness().to_bits(), DARK.to_bits(), stride];
        let mut work = context.work();
        self.surface.distance(&mut work, k, m.points(m.len));
        let judged = [(1, &m.starts), (2, self.surface.geometry.out()), (3, &self.inner.starts)];
        work.run(&k.count_kept, &sizes, &judged, count);
        work.submit();
        let begins = starts(&context.read(&self.inner.starts, count)?);
        self.inner.len = begins[count] as usize;
        self.inner.starts = context.upload(&begins);
        self.inner.reserve(context, self.inner.len + free.len());
        let mut work = context.work();
        let moved = [
            (1, &m.starts),
            (3, &self.inner.starts),
            (4, &m.positions),
            (5, &m.steps),
            (6, &self.inner.positions),
            (7, &self.inner.steps),
            (8, &self.inner.ray_of),
        ];
        work.run(&k.compact, &sizes, &moved, count);
        work.submit();
        context.write(&self.inner.positions, 3 * self.inner.len, free.as_flattened());
        Ok(())
    }

    /// Forward, loss, backward and Adam; the losses stay in `self.losses`.
    fn learn(&mut self, rays: &Buffer, count: usize, free: usize, step: u64) {
        let context = &*self.context;
        let (n, rows) = (self.inner.len, self.inner.len + free);
        self.surface.reserve(context, rows);
        self.outside.reserve(context, self.outer.len);
        context.reserve(&mut self.losses, 4 * count);
        let (k, twin, f, out) = (&self.kernels, &self.twin, &self.surface, &self.outside);
        let o = &twin.options;
        let mut work = context.work();
        f.forward(&mut work, k, rays, &self.inner, rows);
        if !twin.with_masks {
            out.forward(&mut work, k, rays, &self.outer);
        }
        let samples = count as f32 * twin.samples_per_ray[0].max(1.0);
        let mut sizes = vec![count as u32];
        sizes.extend(
            [
                1.0 / count as f32,
                twin.sharpness(),
                twin.anneal(step),
                o.mask,
                o.eikonal / samples,
                o.eikonal / free as f32,
                DARK,
            ]
            .map(f32::to_bits),
        );
        sizes.extend([f.geometry.out_stride(), usize::from(!twin.with_masks), n, free].map(|n| n as u32));
        let losses = [
            (1, rays),
            (2, &self.inner.starts),
            (3, &self.inner.steps),
            (4, f.geometry.out()),
            (5, &f.normals),
            (6, f.color.out()),
            (7, &f.d_sdf),
            (8, &f.d_color),
            (9, &self.losses),
            (10, &self.outer.starts),
            (11, &self.outer.steps),
            (12, &out.sigma),
            (13, out.color.out()),
            (14, &out.d_density),
            (15, &out.d_color),
        ];
        work.run(&k.surface_losses, &sizes, &losses, count);
        work.run(&k.free_points, &sizes, &[(5, &f.normals)], free);
        let unit = unit_of(1.0 / count as f32);
        f.backward(&mut work, k, &self.inner, rows, unit);
        let (factor, t) = (o.schedule.factor(step + 1), step + 1);
        let table = o.table_learning_rate * factor;
        f.encoding.step(&mut work, k, unit, &AdamStep { options: ADAM, lr: table, t });
        for network in [&f.geometry, &f.color] {
            network.step(&mut work, k, &AdamStep { options: ADAM, lr: o.learning_rate * factor, t });
        }
        if !twin.with_masks {
            out.backward(&mut work, k, &self.outer, unit);
            out.step(&mut work, k, unit, table, t);
        }
        work.submit();
    }

    /// The `turn`-th refresh of the occupancy grids.
    fn refresh_cells(&mut self, turn: u64) -> Result<()> {
        let (context, k, twin, all) = (&*self.context, &self.kernels, &mut self.twin, looks_everywhere(turn));
        let [inner_seed, outer_seed] = twin.cell_seeds();
        let (cells, points) = twin.inner_cells.points_of_turn(inner_seed, turn, all);
        let distances = self.surface.distances(context, k, &points)?;
        let found: Vec<f32> = distances.into_iter().map(nearness).collect();
        twin.inner_cells.remember(&cells, &found, 0.0);
        if !twin.with_masks {
            twin.outer_cells.raise(&self.outside.seen(context)?);
            let (cells, points) = twin.outer_cells.points_of_turn(outer_seed, turn, all);
            let found = self.outside.densities(context, k, &points)?;
            twin.outer_cells.remember(&cells, &found, CELL_MEMORY);
        }
        twin.decide();
        self.inner_cells = occupied(context, &twin.inner_cells);
        self.outer_cells = occupied(context, &twin.outer_cells);
        Ok(())
    }
}

impl Learner for GpuNeus {
    type Twin = Neus;

    fn twin(&self) -> &Neus {
        &self.twin
    }

    fn twin_mut(&mut self) -> &mut Neus {
        &mut self.twin
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        self.twin.set_levels(step);
        self.surface.encoding.active_levels = self.twin.field.active_levels;
        let Drawn { rays: packed, free } = self.draw(data, cameras, step);
        let count = packed.len();
        let rays = self.context.upload(packed.as_flattened());
        self.march(&rays, count)?;
        self.keep(count, &free)?;
        self.learn(&rays, count, free.len(), step);
        let losses: Vec<[f32; 4]> = self.context.read(&self.losses, count)?;
        let sum = |i: usize| losses.iter().map(|l| f64::from(l[i])).sum::<f64>();
        let (mse, loss) = (sum(0) / (3 * count) as f64, sum(1) / count as f64);
        self.twin.step_sharpness(sum(2) as f32, step + 1);
        self.twin.count_samples(self.marched.len, count);
        let every = self.twin.options.occupancy_every;
        if (step + 1).is_multiple_of(every) {
            self.refresh_cells((step + 1) / every)?;
        }
        Ok(StepReport { loss, mse, rays: count, samples: self.marched.len })
    }

    fn fetch(&mut self) -> Result<()> {
        self.surface.fetch(&self.context, &mut self.twin.field)?;
        if !self.twin.with_masks {
            self.twin.outer_cells.raise(&self.outside.seen(&self.context)?);
        }
        self.outside.fetch(&self.context, &mut self.twin.outside_parameters)
    }

    fn send(&mut self) {
        let (context, twin) = (&*self.context, &self.twin);
        self.surface = Surface::new(context, &plain_parts(twin));
        self.outside = Radiance::new(context, &twin.outside, &twin.outside_parameters, twin.options.occupancy);
        self.inner_cells = occupied(context, &twin.inner_cells);
        self.outer_cells = occupied(context, &twin.outer_cells);
    }
}
