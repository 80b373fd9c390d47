//! `nerf --preset paper` on a device. Rays, the distances of the coarse samples and all random numbers are drawn on the
//! processor, as the twin draws them; all else runs on the device, some rays at a time, so that it need not hold the
//! activations of all of them.

use std::sync::Arc;

use mb_job::{Result, rng};
use mb_neural::cameras::CameraResiduals;
use mb_neural::dataset::{RayDataset, TargetRay};
use mb_neural::model::{GROUPS, StepReport};
use mb_neural::nerf_original::{ADAM, NerfOriginal, TILE_RAYS};
use rand::RngExt as _;

use crate::context::{Buffer, Context, WORKGROUP};
use crate::frequency_field::FrequencyNetworks;
use crate::kernels::Kernels;
use crate::on_device::Learner;
use crate::ray_gradients::{Coordinates, RAY_GRADIENT, correct};
use crate::rays::{RAY, Samples, pack};
use crate::trained::AdamStep;

/// Samples that go through a network at once, at most: two gigabytes of activations and their derivatives, as published.
const SAMPLES: usize = 1 << 16;

/// One of the two networks with its samples.
struct Pass {
    field: FrequencyNetworks,
    samples: Samples,
    weights: Buffer,
    losses: Buffer,
}

/// An original NeRF whose twin holds all that is not of the device, and, after a fetch, all that the device has learned.
pub struct GpuNerfOriginal {
    twin: NerfOriginal,
    context: Arc<Context>,
    kernels: Kernels,
    coarse: Pass,
    fine: Pass,
    /// What the losses of some rays ask of them, where a step moves the cameras.
    asked: Buffer,
    /// Samples that go through a network at once, at most.
    pub most_samples: usize,
}

/// What a step is given: rays, where it moves the cameras also as they were drawn, and for each the distances of its coarse
/// samples and the random numbers of its fine ones.
#[derive(Default)]
struct Drawn {
    rays: Vec<[f32; RAY]>,
    targets: Vec<TargetRay>,
    depths: Vec<f32>,
    random: Vec<f32>,
}

impl Pass {
    fn new(context: &Context, field: FrequencyNetworks) -> Self {
        Self { field, samples: Samples::new(context), weights: context.zeros(0), losses: context.zeros(0) }
    }

    /// Makes room for so many rays, and says where the samples of each begin.
    fn reserve(&mut self, context: &Context, rays: usize, samples_per_ray: usize) {
        let n = rays * samples_per_ray;
        self.field.reserve(context, n);
        self.samples.reserve(context, n);
        context.reserve(&mut self.weights, n);
        context.reserve(&mut self.losses, 2 * rays);
        let starts: Vec<u32> = (0..=rays).map(|ray| (ray * samples_per_ray) as u32).collect();
        self.samples.starts = context.upload(&starts);
    }

    /// Colours and losses of the samples, and their derivatives; `scale` is 1 / (3 rays of the step). Adds what the losses ask
    /// of the rays, where somebody asks, given of what the samples' positions are coordinates.
    fn learn(
        &self,
        context: &Context,
        k: &Kernels,
        (rays, count): (&Buffer, usize),
        scale: f32,
        asked: Option<(&Buffer, Coordinates)>,
    ) {
        let (f, s) = (&self.field, &self.samples);
        let mut work = context.work();
        f.forward(&mut work, k, rays, s);
        // No distortion loss, and no ray is cut short.
        let sizes = [count as u32, scale.to_bits(), 0, 0, f.activation()];
        let losses = [
            (1, rays),
            (2, &s.starts),
            (3, &s.steps),
            (4, &f.sigma),
            (5, f.color()),
            (6, &self.weights),
            (7, &f.d_density),
            (8, &f.d_color),
            (9, &self.losses),
        ];
        work.run(&k.losses, &sizes, &losses, count * WORKGROUP);
        f.backward(&mut work, k, s);
        if let Some((asked, of)) = asked {
            f.ray_gradients(&mut work, k, (rays, count), s, of, (asked, 0));
        }
        work.submit();
    }
}

impl GpuNerfOriginal {
    /// From its twin, which may have been trained.
    pub fn new(twin: NerfOriginal, context: Arc<Context>) -> Self {
        let pass = |p| Pass::new(&context, FrequencyNetworks::new(&context, &twin.field, p));
        let (coarse, fine) = (pass(&twin.coarse), pass(&twin.fine));
        let (kernels, asked) = (Kernels::new(&context), context.zeros(0));
        Self { kernels, coarse, fine, asked, most_samples: SAMPLES, twin, context }
    }

    /// The rays and random numbers of a step, as the twin draws them.
    fn draw(&self, data: &RayDataset, cameras: &CameraResiduals, step: u64) -> Drawn {
        let (twin, mut drawn, mut rays) = (&self.twin, Drawn::default(), Vec::new());
        for group in 0..GROUPS as u64 {
            let mut rng = rng(twin.options.seed, step * GROUPS as u64 + group);
            data.draw(&mut rng, twin.rays_of_group(), cameras, &mut rays);
            for tile in rays.chunks(TILE_RAYS) {
                drawn.rays.extend(tile.iter().map(|target| {
                    let background: [f32; 3] = std::array::from_fn(|_| rng.random());
                    let wanted = target.before(background, twin.with_masks);
                    let (near, far) = twin.range(&target.ray);
                    let mut ray = pack(target, 0.0, background, wanted, near);
                    ray[15] = far;
                    ray
                }));
                for target in tile {
                    drawn.depths.extend(twin.coarse_depths(&target.ray, Some(&mut rng)));
                }
                let random = tile.len() * twin.options.fine_samples;
                drawn.random.extend((0..random).map(|_| rng.random::<f32>()));
            }
            if cameras.wants_gradients(step) {
                drawn.targets.extend_from_slice(&rays);
            }
        }
        drawn
    }

    /// Both passes of some rays; the squared errors of all, by the coarse and the fine network, and, where the step moves the
    /// cameras, what the losses ask of each ray.
    fn learn(
        &mut self,
        rays: &[[f32; RAY]],
        depths: &[f32],
        random: &[f32],
        (scale, moves): (f32, bool),
    ) -> Result<([f64; 2], Vec<u32>)> {
        let (context, k, o, count) = (&*self.context, &self.kernels, &self.twin.options, rays.len());
        let sizes = [count, o.coarse_samples, o.fine_samples, usize::from(self.twin.with_masks)].map(|n| n as u32);
        let rays = context.upload(rays.as_flattened());
        let (depths, random) = (context.upload(depths), context.upload(random));
        let (coarse, fine) = (&mut self.coarse.samples, &mut self.fine.samples);
        coarse.len = count * o.coarse_samples;
        fine.len = count * (o.coarse_samples + o.fine_samples);
        let of = if self.twin.with_masks { Coordinates::Scene } else { Coordinates::Contracted };
        let asked = moves.then_some((&self.asked, of));
        let mut work = context.work();
        if moves {
            work.clear(&self.asked);
        }
        let placed = [(1, &rays), (2, &depths), (5, &coarse.positions), (6, &coarse.steps), (7, &coarse.ray_of)];
        work.run(&k.place_samples, &sizes, &placed, count);
        work.submit();
        self.coarse.learn(context, k, (&rays, count), scale, asked);
        let (coarse, fine) = (&self.coarse, &self.fine.samples);
        let mut work = context.work();
        let drawn = [
            (1, &rays),
            (2, &random),
            (3, &coarse.samples.steps),
            (4, &coarse.weights),
            (5, &fine.positions),
            (6, &fine.steps),
            (7, &fine.ray_of),
        ];
        work.run(&k.draw_samples, &sizes, &drawn, count);
        work.submit();
        self.fine.learn(context, k, (&rays, count), scale, asked);
        let losses = [&self.coarse, &self.fine].map(|pass| (&pass.losses, 2 * count));
        let asked = (&self.asked, if moves { RAY_GRADIENT * count } else { 0 });
        let mut found = context.read_all(&[losses[0], losses[1], asked])?;
        let asked = found.pop().unwrap_or_default();
        let squared = |losses: &[u32]| losses.iter().step_by(2).map(|l| f64::from(f32::from_bits(*l))).sum();
        Ok(([squared(&found[0]), squared(&found[1])], asked))
    }
}

impl Learner for GpuNerfOriginal {
    type Twin = NerfOriginal;

    fn twin(&self) -> &NerfOriginal {
        &self.twin
    }

    fn twin_mut(&mut self) -> &mut NerfOriginal {
        &mut self.twin
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        let drawn = self.draw(data, cameras, step);
        let (count, moves, o) = (drawn.rays.len(), !drawn.targets.is_empty(), &self.twin.options);
        let (coarse, fine) = (o.coarse_samples, o.fine_samples);
        let factor = o.schedule.factor(step);
        let lr = o.learning_rate * factor;
        let parts = count.div_ceil((self.most_samples / (coarse + fine)).max(1));
        let at_once = count.div_ceil(parts);
        self.coarse.reserve(&self.context, at_once, coarse);
        self.fine.reserve(&self.context, at_once, coarse + fine);
        if moves {
            self.coarse.field.reserve_gradients(&self.context, at_once * coarse);
            self.fine.field.reserve_gradients(&self.context, at_once * (coarse + fine));
            self.context.reserve(&mut self.asked, RAY_GRADIENT * at_once);
        }
        let (mut sums, mut asked) = ([0.0; 2], Vec::new());
        let parts = drawn.rays.chunks(at_once).zip(drawn.depths.chunks(at_once * coarse));
        for ((rays, depths), random) in parts.zip(drawn.random.chunks(at_once * fine)) {
            let (found, of_rays) = self.learn(rays, depths, random, (1.0 / (3 * count) as f32, moves))?;
            (0..2).for_each(|pass| sums[pass] += found[pass]);
            asked.extend(of_rays);
        }
        correct(cameras, data, &drawn.targets, bytemuck::cast_slice(&asked), (factor, step));
        let mut work = self.context.work();
        for pass in [&self.coarse, &self.fine] {
            pass.field.step(&mut work, &self.kernels, &AdamStep { options: ADAM, lr, t: step + 1 });
        }
        work.submit();
        let [coarse_mse, mse] = sums.map(|sum| sum / (3 * count) as f64);
        let samples = count * (2 * coarse + fine);
        Ok(StepReport { loss: coarse_mse + mse, mse, rays: count, samples, lit: samples })
    }

    fn fetch(&mut self) -> Result<()> {
        self.coarse.field.fetch(&self.context, &mut self.twin.coarse)?;
        self.fine.field.fetch(&self.context, &mut self.twin.fine)
    }

    fn send(&mut self) {
        let (context, twin) = (&*self.context, &self.twin);
        self.coarse.field = FrequencyNetworks::new(context, &twin.field, &twin.coarse);
        self.fine.field = FrequencyNetworks::new(context, &twin.field, &twin.fine);
    }
}
