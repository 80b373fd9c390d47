//! `neus --preset fast` on a device. As in [`crate::nerf`] rays are drawn and both occupancy grids are kept on the processor,
//! and so is the sharpness, one number; all else runs on the device.

use std::sync::Arc;

use mb_job::{Result, rng};
use mb_neural::cameras::CameraResiduals;
use mb_neural::dataset::{RayDataset, TargetRay};
use mb_neural::model::{GROUPS, StepReport};
use mb_neural::neus::{DARK, FREE_POINTS, Neus, SHORTEST_OUTER_STEP, nearness};
use mb_neural::occupancy::{CELL_MEMORY, looks_everywhere};
use mb_neural::radiance_field::ADAM;
use rand::RngExt as _;
use rayon::prelude::*;

use crate::context::{Buffer, Context};
use crate::encoding::unit_of;
use crate::kernels::Kernels;
use crate::on_device::Learner;
use crate::radiance::Radiance;
use crate::ray_gradients::{RAY_GRADIENT, correct};
use crate::rays::{Ahead, RAY, Rays, Samples, Space, occupied, pack};
use crate::surface::Surface;
use crate::trained::AdamStep;

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
    rays: Buffer,
    losses: Buffer,
    next: Ahead<Drawn>,
}

/// What a step is given: the rays, where it moves the cameras also as they were drawn, and the points of the ball that belong to
/// none.
#[derive(Default)]
struct Drawn {
    rays: Vec<[f32; RAY]>,
    targets: Vec<TargetRay>,
    free: Vec<[f32; 3]>,
}

impl GpuNeus {
    /// From its twin, which may have been trained.
    pub fn new(twin: Neus, context: Arc<Context>) -> Self {
        let c = &*context;
        let kernels = Kernels::new(c);
        let surface = Surface::new(c, &kernels, &twin.field);
        let outside = Radiance::new(c, &twin.outside, &twin.outside_parameters, twin.options.occupancy);
        Self {
            kernels,
            surface,
            outside,
            inner_cells: occupied(c, &twin.inner_cells),
            outer_cells: occupied(c, &twin.outer_cells),
            marched: Samples::new(c),
            inner: Samples::new(c),
            outer: Samples::new(c),
            rays: c.zeros(0),
            losses: c.zeros(0),
            next: Ahead::none(),
            twin,
            context,
        }
    }

    /// Rays and free points of a step, as the twin draws them.
    fn draw(&self, data: &RayDataset, cameras: &CameraResiduals, step: u64) -> Drawn {
        let (twin, moves) = (&self.twin, cameras.wants_gradients(step));
        let groups: Vec<Drawn> = (0..GROUPS as u64)
            .into_par_iter()
            .map(|group| {
                let (mut rng, mut targets) = (rng(twin.options.seed, step * GROUPS as u64 + group), Vec::new());
                data.draw(&mut rng, twin.rays_of_group(), cameras, &mut targets);
                let pack = |target: &TargetRay| {
                    let background =
                        if twin.with_masks { [0.0; 3] } else { std::array::from_fn(|_| rng.random::<f32>()) };
                    let mask = target.mask.filter(|_| twin.with_masks);
                    let wanted = target.rgb.map(|c| c * mask.unwrap_or(1.0));
                    let ball = target.ray.ball(1.0);
                    let mut ray = pack(target, rng.random(), background, wanted, Neus::outer_start(ball));
                    [ray[14], ray[15]] = ball.map_or([0.0, -1.0], |(near, far)| [near, far]);
                    ray[16] = mask.unwrap_or(-1.0);
                    ray
                };
                let rays = targets.iter().map(pack).collect();
                let point = |_| std::array::from_fn(|_| 0.5 * rng.random_range(-1.0..1.0f32) + 0.5);
                let free = (0..FREE_POINTS).map(point).collect();
                Drawn { rays, targets: if moves { targets } else { Vec::new() }, free }
            })
            .collect();
        let mut drawn = Drawn::default();
        for group in groups {
            drawn.rays.extend(group.rays);
            drawn.targets.extend(group.targets);
            drawn.free.extend(group.free);
        }
        drawn
    }

    fn march(&mut self, count: usize) -> Result<()> {
        let o = &self.twin.options;
        let inside = Space {
            resolution: o.occupancy,
            far: o.far,
            step: self.twin.inner_step(),
            cone: 0.0,
            inside_ball: true,
            voxels: None,
        };
        let (context, k, rays) = (&*self.context, &self.kernels, &self.rays);
        let passing = |occupied| Rays { rays, count, occupied };
        self.marched.march(context, k, &inside, passing(&self.inner_cells))?;
        if !self.twin.with_masks {
            let behind = Space { step: SHORTEST_OUTER_STEP, cone: o.background_cone, inside_ball: false, ..inside };
            self.outer.march(context, k, &behind, passing(&self.outer_cells))?;
        }
        Ok(())
    }

    /// Keeps what light reaches of the marched samples, and puts the free points behind them.
    fn keep(&mut self, count: usize, free: &[[f32; 3]]) -> Result<()> {
        let (context, k, m) = (&*self.context, &self.kernels, &self.marched);
        self.surface.reserve(context, m.len);
        context.reserve(&mut self.inner.counts, count);
        let stride = self.surface.geometry.out_stride() as u32;
        let sizes = [count as u32, self.twin.sharpness().to_bits(), DARK.to_bits(), stride];
        let mut work = context.work();
        self.surface.distance(&mut work, k, m.points(m.len));
        let judged = [(1, &m.starts), (2, self.surface.geometry.out()), (3, &self.inner.counts), (9, &m.stays)];
        work.run(&k.count_kept, &sizes, &judged, count);
        work.submit();
        self.inner.keep(context, k, m, count, free.len())?;
        context.write(&self.inner.positions, 3 * self.inner.len, free.as_flattened());
        Ok(())
    }

    /// Forward, loss, backward and Adam; the losses stay in `self.losses`, behind them, where the step moves the cameras, what
    /// they ask of the rays.
    fn learn(&mut self, count: usize, free: usize, step: u64, moves: bool) {
        let (context, rays) = (&*self.context, &self.rays);
        let (n, rows) = (self.inner.len, self.inner.len + free);
        self.surface.reserve(context, rows);
        self.outside.reserve(context, self.outer.len);
        if moves {
            self.surface.reserve_gradients(context, n);
            self.outside.reserve_gradients(context, self.outer.len);
        }
        context.reserve(&mut self.losses, (4 + RAY_GRADIENT) * count);
        let (k, twin, f, out) = (&self.kernels, &self.twin, &self.surface, &self.outside);
        let o = &twin.options;
        let mut work = context.work();
        f.forward(&mut work, k, rays, &self.inner, rows);
        if !twin.with_masks {
            out.forward(&mut work, k, rays, &self.outer);
        }
        let samples = count as f32 * twin.samples_per_ray[0].max(1.0);
        let eikonal = twin.eikonal_weight(step);
        let mut sizes = vec![count as u32];
        sizes.extend(
            [
                1.0 / count as f32,
                twin.sharpness(),
                twin.anneal(step),
                o.mask,
                eikonal / samples,
                eikonal / free as f32,
                DARK,
            ]
            .map(f32::to_bits),
        );
        sizes.extend([f.geometry.out_stride(), usize::from(!twin.with_masks), n, free, 0].map(|n| n as u32));
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
        let rays = (rays, count);
        let asked = (&self.losses, count);
        if moves {
            f.ray_gradients(&mut work, k, rays, &self.inner, asked);
        }
        let (factor, t) = (o.schedule.factor(step + 1), step + 1);
        let table = o.table_learning_rate * factor;
        let step = |lr| AdamStep { options: ADAM, lr, t };
        f.step(&mut work, k, unit, [step(table), step(o.learning_rate * factor)]);
        if !twin.with_masks {
            out.backward(&mut work, k, &self.outer, unit);
            if moves {
                out.ray_gradients(&mut work, k, rays, &self.outer, asked);
            }
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
        self.surface.set_levels(self.twin.field.active_levels);
        let Drawn { rays, targets, free } = self.next.take(step).unwrap_or_else(|| self.draw(data, cameras, step));
        let moves = !targets.is_empty();
        let count = rays.len();
        self.context.replace(&mut self.rays, rays.as_flattened());
        self.march(count)?;
        self.keep(count, &free)?;
        self.learn(count, free.len(), step, moves);
        self.twin.count_samples(self.marched.len, count);
        // While the device learns, the next rays are drawn, where their cameras stay.
        if !moves {
            self.next.keep(step + 1, self.draw(data, cameras, step + 1));
        }
        let found: Vec<f32> = self.context.read(&self.losses, 4 * count + RAY_GRADIENT * targets.len())?;
        let (losses, asked) = found.split_at(4 * count);
        let losses = losses.as_chunks::<4>().0;
        let factor = self.twin.options.schedule.factor(step + 1);
        correct(cameras, data, &targets, asked.as_chunks().0, (factor, step));
        let sum = |i: usize| losses.iter().map(|l| f64::from(l[i])).sum::<f64>();
        let (mse, loss) = (sum(0) / (3 * count) as f64, sum(1) / count as f64);
        self.twin.step_sharpness(sum(2) as f32, step + 1);
        let every = self.twin.options.occupancy_every;
        if (step + 1).is_multiple_of(every) {
            self.refresh_cells((step + 1) / every)?;
        }
        Ok(StepReport { loss, mse, rays: count, samples: self.marched.len, lit: self.inner.len })
    }

    fn fetch(&mut self) -> Result<()> {
        self.surface.fetch(&self.context, &mut self.twin.field)?;
        if !self.twin.with_masks {
            self.twin.outer_cells.raise(&self.outside.seen(&self.context)?);
        }
        self.outside.fetch(&self.context, &mut self.twin.outside_parameters)
    }

    fn send(&mut self) {
        self.next = Ahead::none();
        let (context, twin) = (&*self.context, &self.twin);
        self.surface = Surface::new(context, &self.kernels, &twin.field);
        self.outside = Radiance::new(context, &twin.outside, &twin.outside_parameters, twin.options.occupancy);
        self.inner_cells = occupied(context, &twin.inner_cells);
        self.outer_cells = occupied(context, &twin.outer_cells);
    }
}
