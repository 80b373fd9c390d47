//! `nerf --preset fast` on a device. Rays are drawn and the occupancy grid is kept on the processor, with the twin's random
//! numbers; marching, the field, the loss, the derivatives and Adam run on the device.

use std::sync::Arc;

use mb_job::{Result, rng};
use mb_neural::cameras::CameraResiduals;
use mb_neural::dataset::{RayDataset, TargetRay};
use mb_neural::model::{GROUPS, StepReport};
use mb_neural::nerf::{DARK, Nerf};
use mb_neural::occupancy::{CELL_MEMORY, looks_everywhere};
use rand::RngExt as _;
use rayon::prelude::*;

use crate::context::{Buffer, Context, WORKGROUP};
use crate::encoding::unit_of;
use crate::kernels::Kernels;
use crate::on_device::Learner;
use crate::radiance::Radiance;
use crate::ray_gradients::{RAY_GRADIENT, correct};
use crate::rays::{Ahead, Rays, Samples, Space, occupied, pack};

/// A NeRF whose twin holds all that is not of the device, and, after a fetch, all that the device has learned.
pub struct GpuNerf {
    twin: Nerf,
    context: Arc<Context>,
    kernels: Kernels,
    field: Radiance,
    occupied: Buffer,
    rays: Buffer,
    samples: Samples,
    weights: Buffer,
    losses: Buffer,
    /// What the losses ask of the rays, where a step moves the cameras.
    asked: Buffer,
    next: Ahead<Counted>,
}

/// Rays that the device has, and how many samples each has.
struct Counted {
    drawn: Drawn,
    counts: Vec<u32>,
}

/// Rays of a step, where it moves the cameras also as they were drawn.
#[derive(Default)]
struct Drawn {
    rays: usize,
    targets: Vec<TargetRay>,
}

impl GpuNerf {
    /// From its twin, which may have been trained.
    pub fn new(twin: Nerf, context: Arc<Context>) -> Self {
        let c = &*context;
        Self {
            kernels: Kernels::new(c),
            field: Radiance::new(c, &twin.field, &twin.parameters, twin.options.occupancy),
            occupied: occupied(c, &twin.occupancy),
            rays: c.zeros(0),
            samples: Samples::new(c),
            weights: c.zeros(0),
            losses: c.zeros(0),
            asked: c.zeros(0),
            next: Ahead::none(),
            twin,
            context,
        }
    }

    /// Draws the rays of a step, as the twin does, and counts their samples.
    fn begin(&mut self, data: &RayDataset, cameras: &CameraResiduals, step: u64) -> Drawn {
        let (options, rays, moves) = (&self.twin.options, self.twin.rays_of_group(), cameras.wants_gradients(step));
        let drawn = (0..GROUPS as u64).into_par_iter().map(|group| {
            let (mut rng, mut targets) = (rng(options.seed, step * GROUPS as u64 + group), Vec::new());
            data.draw(&mut rng, rays, cameras, &mut targets);
            let packed = targets.iter().map(|target| {
                let background: [f32; 3] = std::array::from_fn(|_| rng.random());
                let wanted = target.before(background, options.object_only);
                pack(target, rng.random(), background, wanted, options.near)
            });
            let packed = packed.collect::<Vec<_>>();
            (packed, if moves { targets } else { Vec::new() })
        });
        let (drawn, targets): (Vec<_>, Vec<_>) = drawn.unzip();
        let drawn = drawn.concat();
        let (context, space) = (&*self.context, self.space());
        context.replace(&mut self.rays, drawn.as_flattened());
        let rays = Rays { rays: &self.rays, count: drawn.len(), occupied: &self.occupied };
        self.samples.count(context, &self.kernels, &space, rays);
        Drawn { rays: drawn.len(), targets: targets.concat() }
    }

    fn space(&self) -> Space {
        let o = &self.twin.options;
        Space { resolution: o.occupancy, far: o.far, step: o.step, cone: o.cone, inside_ball: false, voxels: None }
    }

    /// Forward, loss, backward and Adam; the losses stay in `self.losses`, and, where the step moves the cameras, what they ask
    /// of the rays in `self.asked`.
    fn learn(&mut self, count: usize, lr: f32, t: u64, moves: bool) {
        let context = &*self.context;
        let n = self.samples.len;
        self.field.reserve(context, n);
        context.reserve(&mut self.weights, n);
        context.reserve(&mut self.losses, 2 * count);
        if moves {
            self.field.reserve_gradients(context, n);
            context.reserve(&mut self.asked, RAY_GRADIENT * count);
        }
        let (k, f, s, rays) = (&self.kernels, &self.field, &self.samples, &self.rays);
        let mut work = context.work();
        f.forward(&mut work, k, rays, s);
        let scale = 1.0 / (3 * count) as f32;
        let floats = [scale, self.twin.options.distortion, DARK].map(f32::to_bits);
        let losses = [
            (1, rays),
            (2, &s.starts),
            (3, &s.steps),
            (4, &f.sigma),
            (5, f.color.out()),
            (6, &self.weights),
            (7, &f.d_density),
            (8, &f.d_color),
            (9, &self.losses),
        ];
        work.run(&k.losses, &[count as u32, floats[0], floats[1], floats[2], 0], &losses, count * WORKGROUP);
        let unit = unit_of(scale);
        f.backward(&mut work, k, s, unit);
        if moves {
            work.clear(&self.asked);
            f.ray_gradients(&mut work, k, (rays, count), s, (&self.asked, 0));
        }
        f.step(&mut work, k, unit, lr, t);
        work.submit();
    }

    /// The `turn`-th refresh of the occupancy grid.
    fn refresh_occupancy(&mut self, turn: u64) -> Result<()> {
        let twin = &mut self.twin;
        twin.occupancy.raise(&self.field.seen(&self.context)?);
        let all = looks_everywhere(turn);
        let (cells, points) = twin.occupancy.points_of_turn(twin.occupancy_seed(), turn, all);
        let found = self.field.densities(&self.context, &self.kernels, &points)?;
        twin.occupancy.remember(&cells, &found, CELL_MEMORY);
        twin.occupancy.decide(twin.occupancy_threshold(turn));
        self.occupied = occupied(&self.context, &twin.occupancy);
        Ok(())
    }
}

impl Learner for GpuNerf {
    type Twin = Nerf;

    fn twin(&self) -> &Nerf {
        &self.twin
    }

    fn twin_mut(&mut self) -> &mut Nerf {
        &mut self.twin
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        let counted = match self.next.take(step) {
            Some(counted) => counted,
            None => {
                let drawn = self.begin(data, cameras, step);
                let counts = self.context.read(&self.samples.counts, drawn.rays)?;
                Counted { drawn, counts }
            }
        };
        let Drawn { rays: count, targets } = counted.drawn;
        let (moves, space) = (!targets.is_empty(), self.space());
        let rays = Rays { rays: &self.rays, count, occupied: &self.occupied };
        self.samples.place(&self.context, &self.kernels, &space, rays, &counted.counts);
        let options = &self.twin.options;
        let (factor, every) = (options.schedule.factor(step + 1), options.occupancy_every);
        let (lr, samples) = (options.learning_rate * factor, self.samples.len);
        self.learn(count, lr, step + 1, moves);
        self.twin.count_samples(samples, count);
        // While the device learns, the next rays are drawn, where their cameras stay; what is refreshed first counts their samples
        // itself.
        let refreshed = (step + 1).is_multiple_of(every);
        let next = if refreshed || moves { Drawn::default() } else { self.begin(data, cameras, step + 1) };
        let asked = RAY_GRADIENT * targets.len();
        let parts = [(&self.losses, 2 * count), (&self.asked, asked), (&self.samples.counts, next.rays)];
        let mut found = self.context.read_all(&parts)?;
        let counts = found.pop().unwrap_or_default();
        correct(cameras, data, &targets, bytemuck::cast_slice(&found[1]), (factor, step));
        let sum = |i: usize| found[0].iter().skip(i).step_by(2).map(|l| f64::from(f32::from_bits(*l))).sum::<f64>();
        let mse = sum(0) / (3 * count) as f64;
        let loss = mse + f64::from(self.twin.options.distortion) * sum(1) / count as f64;
        if refreshed {
            self.refresh_occupancy((step + 1) / every)?;
        } else if !moves {
            self.next.keep(step + 1, Counted { drawn: next, counts });
        }
        Ok(StepReport { loss, mse, rays: count, samples, lit: samples })
    }

    fn fetch(&mut self) -> Result<()> {
        self.twin.occupancy.raise(&self.field.seen(&self.context)?);
        self.field.fetch(&self.context, &mut self.twin.parameters)
    }

    fn send(&mut self) {
        self.next = Ahead::none();
        let (context, twin) = (&*self.context, &self.twin);
        self.field = Radiance::new(context, &twin.field, &twin.parameters, twin.options.occupancy);
        self.occupied = occupied(context, &twin.occupancy);
    }
}
