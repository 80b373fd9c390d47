//! `neus --preset paper` on a device. Rays, the even starts of their sections and those behind the ball are drawn on the
//! processor, as the twin draws them, and the sharpness is kept there, one number; the rounds of sampling and all else run on
//! the device.

use std::sync::Arc;

use mb_job::{Result, rng};
use mb_neural::cameras::CameraResiduals;
use mb_neural::dataset::{RayDataset, TargetRay};
use mb_neural::model::{GROUPS, StepReport};
use mb_neural::neus_original::{ADAM, NeusOriginal, RELAXED, TILE_RAYS, round_sharpness};

use crate::context::{Buffer, Context};
use crate::encoding::{Points, unit_of};
use crate::frequency_field::FrequencyNetworks;
use crate::kernels::Kernels;
use crate::on_device::Learner;
use crate::ray_gradients::{Coordinates, RAY_GRADIENT, correct};
use crate::rays::{RAY, Samples, pack, starts};
use crate::surface::Surface;
use crate::trained::AdamStep;

/// Starts of the sections of all rays, while rounds add to them; see `sections.wgsl`.
pub struct Sections {
    /// `[rays, starts]`, ascending.
    pub depths: Buffer,
    sdf: Buffer,
    weights: Buffer,
    added: Buffer,
    merged: Buffer,
    merged_sdf: Buffer,
    positions: Buffer,
    /// Sections inside and outside of each ray, and within reach of the eikonal loss.
    places: Buffer,
}

/// An original NeuS whose twin holds all that is not of the device, and, after a fetch, all that the device has learned.
pub struct GpuNeusOriginal {
    twin: NeusOriginal,
    context: Arc<Context>,
    kernels: Kernels,
    surface: Surface,
    outside: FrequencyNetworks,
    /// By [`Self::rounds`].
    pub sections: Sections,
    inner: Samples,
    /// Their positions have four coordinates.
    outer: Samples,
    losses: Buffer,
}

/// What a step is given: rays, where it moves the cameras also as they were drawn, and of each the even starts of sections and
/// those behind the ball.
#[derive(Default)]
struct Drawn {
    rays: Vec<[f32; RAY]>,
    targets: Vec<TargetRay>,
    depths: Vec<f32>,
    outside: Vec<f32>,
}

impl Sections {
    fn new(context: &Context) -> Self {
        let none = || context.zeros(0);
        Self {
            depths: none(),
            sdf: none(),
            weights: none(),
            added: none(),
            merged: none(),
            merged_sdf: none(),
            positions: none(),
            places: none(),
        }
    }

    /// Makes room for so many rays, and for so many starts of each.
    fn reserve(&mut self, context: &Context, rays: usize, starts: usize) {
        let Self { depths, sdf, weights, added, merged, merged_sdf, positions, places } = self;
        for buffer in [depths, sdf, weights, added, merged, merged_sdf] {
            context.reserve(buffer, rays * starts);
        }
        context.reserve(positions, 3 * rays * starts);
        context.reserve(places, 4 * (rays + 1));
    }
}

impl GpuNeusOriginal {
    /// From its twin, which may have been trained.
    pub fn new(twin: NeusOriginal, context: Arc<Context>) -> Self {
        let c = &*context;
        let kernels = Kernels::new(c);
        Self {
            surface: Surface::new(c, &kernels, &twin.field),
            outside: FrequencyNetworks::new(c, &twin.outside, &twin.outside_parameters),
            sections: Sections::new(c),
            inner: Samples::new(c),
            outer: Samples::new(c),
            losses: c.zeros(0),
            kernels,
            twin,
            context,
        }
    }

    /// Rays and starts of a step, as the twin draws them.
    fn draw(&self, data: &RayDataset, cameras: &CameraResiduals, step: u64) -> Drawn {
        let (twin, mut drawn, mut rays) = (&self.twin, Drawn::default(), Vec::new());
        for group in 0..GROUPS as u64 {
            let mut rng = rng(twin.options.seed, step * GROUPS as u64 + group);
            data.draw(&mut rng, twin.rays_of_group(), cameras, &mut rays);
            for target in &rays {
                drawn.depths.extend(twin.even_depths(&target.ray, Some(&mut rng)));
                drawn.outside.extend(twin.outside_depths(&target.ray, Some(&mut rng)));
                let mut ray = pack(target, 0.0, [0.0; 3], target.rgb, 0.0);
                ray[16] = target.mask.filter(|_| twin.with_masks).unwrap_or(-1.0);
                drawn.rays.push(ray);
            }
            if cameras.wants_gradients(step) {
                drawn.targets.extend_from_slice(&rays);
            }
        }
        drawn
    }

    /// What the entry points of sections.wgsl are told.
    fn sizes(&self, rays: usize, starts: usize, more: usize, sharpness: f32) -> [u32; 8] {
        let stride = self.surface.geometry.out_stride();
        let floats = [sharpness, 2.0 / self.twin.options.samples as f32, RELAXED].map(f32::to_bits);
        let masks = u32::from(self.twin.with_masks);
        [rays as u32, starts as u32, more as u32, floats[0], stride as u32, masks, floats[1], floats[2]]
    }

    /// The rounds: starts of sections in the ball, in `sections.depths`; how many a ray has.
    pub fn rounds(&mut self, rays: &Buffer, count: usize, even: &[f32]) -> usize {
        let context = &*self.context;
        let o = &self.twin.options;
        let (mut n, more) = (o.samples, o.importance / o.rounds.max(1));
        self.sections.reserve(context, count, n + more * o.rounds);
        self.surface.reserve(context, count * n.max(more));
        context.write(&self.sections.depths, 0, even);
        let k = &self.kernels;
        let mut work = context.work();
        let c = &self.sections;
        let sizes = self.sizes(count, n, 0, 0.0);
        work.run(&k.points_of_rays, &sizes, &[(1, rays), (2, &c.depths), (9, &c.positions)], count * n);
        self.surface.distance(&mut work, k, Points { positions: &c.positions, count: count * n });
        work.run(&k.first_distances, &sizes, &[(3, &c.sdf), (6, self.surface.geometry.out())], count * n);
        for round in 0..o.rounds {
            let c = &self.sections;
            let sizes = self.sizes(count, n, more, round_sharpness(round));
            let drawn = [(1, rays), (2, &c.depths), (3, &c.sdf), (4, &c.weights), (5, &c.added)];
            work.run(&k.draw_round, &sizes, &drawn, count);
            // Nobody asks for the distances of the last round.
            if round + 1 < o.rounds {
                let placed = [(1, rays), (2, &c.added), (9, &c.positions)];
                work.run(&k.points_of_rays, &self.sizes(count, more, 0, 0.0), &placed, count * more);
                self.surface.distance(&mut work, k, Points { positions: &c.positions, count: count * more });
            }
            let merged = [
                (2, &c.depths),
                (3, &c.sdf),
                (5, &c.added),
                (6, self.surface.geometry.out()),
                (7, &c.merged),
                (8, &c.merged_sdf),
            ];
            work.run(&k.merge_round, &sizes, &merged, count);
            let c = &mut self.sections;
            std::mem::swap(&mut c.depths, &mut c.merged);
            std::mem::swap(&mut c.sdf, &mut c.merged_sdf);
            n += more;
        }
        work.submit();
        n
    }

    /// Samples of the surface and of the background, from `n` starts of each ray in the ball. Tells each ray the weight of its
    /// eikonal loss.
    fn place(&mut self, rays: &mut Drawn, n: usize, uploaded: &Buffer) -> Result<()> {
        let (context, k, count) = (&*self.context, &self.kernels, rays.rays.len());
        let outside = context.upload(&rays.outside);
        let sizes = self.sizes(count, n, rays.outside.len() / count, 0.0);
        let c = &self.sections;
        let counted = [(1, uploaded), (2, &c.depths), (5, &outside), (10, &c.places)];
        let mut work = context.work();
        work.run(&k.count_sections, &sizes, &counted, count);
        work.submit();
        let found: Vec<[u32; 4]> = context.read(&c.places, count)?;
        let [inner, outer] = [0, 1].map(|i| starts(&found.iter().map(|p| p[i]).collect::<Vec<_>>()));
        let places: Vec<[u32; 4]> = inner.iter().zip(&outer).map(|(a, b)| [*a, *b, 0, 0]).collect();
        let places = context.upload(&places);
        for (samples, begins, width) in [(&mut self.inner, inner, 3), (&mut self.outer, outer, 4)] {
            samples.len = begins[count] as usize;
            samples.starts = context.upload(&begins);
            samples.reserve(context, samples.len);
            context.reserve(&mut samples.positions, width * samples.len);
        }
        let (inner, outer) = (&self.inner, &self.outer);
        let placed = [
            (1, uploaded),
            (2, &c.depths),
            (5, &outside),
            (9, &inner.positions),
            (10, &places),
            (11, &inner.steps),
            (12, &inner.ray_of),
            (13, &outer.positions),
            (14, &outer.steps),
            (15, &outer.ray_of),
        ];
        let mut work = context.work();
        work.run(&k.place_sections, &sizes, &placed, count);
        work.submit();
        // The rays of a tile share the weight: the mean over their sections stands for the mean over all.
        let group = self.twin.rays_of_group();
        let tiles = rays.rays.chunks_mut(group).zip(found.chunks(group));
        let tiles = tiles.flat_map(|(rays, found)| rays.chunks_mut(TILE_RAYS).zip(found.chunks(TILE_RAYS)));
        for (rays, found) in tiles {
            let relaxed: u32 = found.iter().map(|p| p[2]).sum();
            let weight = self.twin.options.eikonal / count as f32 * rays.len() as f32 / (relaxed as f32 + 1e-5);
            rays.iter_mut().for_each(|ray| ray[17] = weight);
        }
        Ok(())
    }

    /// Forward, loss, backward and Adam; the losses stay in `self.losses`, behind them, where the step moves the cameras, what
    /// they ask of the rays.
    fn learn(&mut self, rays: &Buffer, count: usize, step: u64, moves: bool) {
        let context = &*self.context;
        let n = self.inner.len;
        self.surface.reserve(context, n);
        self.outside.reserve(context, self.outer.len);
        if moves {
            self.surface.reserve_gradients(context, n);
            self.outside.reserve_gradients(context, self.outer.len);
        }
        context.reserve(&mut self.losses, (4 + RAY_GRADIENT) * count);
        let (k, twin, f, out) = (&self.kernels, &self.twin, &self.surface, &self.outside);
        let o = &twin.options;
        let mut work = context.work();
        f.forward(&mut work, k, rays, &self.inner, n);
        if !twin.with_masks {
            out.forward(&mut work, k, rays, &self.outer);
        }
        let mut sizes = vec![count as u32];
        sizes
            .extend([1.0 / count as f32, twin.sharpness(), twin.anneal(step), o.mask, 0.0, 0.0, 0.0].map(f32::to_bits));
        sizes.extend([f.geometry.out_stride(), usize::from(!twin.with_masks), n, 0].map(|n| n as u32));
        sizes.push((RELAXED * RELAXED).to_bits());
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
            (13, out.color()),
            (14, &out.d_density),
            (15, &out.d_color),
        ];
        work.run(&k.section_losses, &sizes, &losses, count);
        let unit = unit_of(1.0 / count as f32);
        let lr = o.learning_rate * o.schedule.factor(step);
        let adam = AdamStep { options: ADAM, lr, t: step + 1 };
        f.backward(&mut work, k, &self.inner, n, unit);
        let rays = (rays, count);
        let asked = (&self.losses, count);
        if moves {
            f.ray_gradients(&mut work, k, rays, &self.inner, asked);
        }
        f.step(&mut work, k, unit, [adam, adam]);
        if !twin.with_masks {
            out.backward(&mut work, k, &self.outer);
            if moves {
                out.ray_gradients(&mut work, k, rays, &self.outer, Coordinates::Inverted, asked);
            }
            out.step(&mut work, k, &adam);
        }
        work.submit();
    }
}

impl Learner for GpuNeusOriginal {
    type Twin = NeusOriginal;

    fn twin(&self) -> &NeusOriginal {
        &self.twin
    }

    fn twin_mut(&mut self) -> &mut NeusOriginal {
        &mut self.twin
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        let mut drawn = self.draw(data, cameras, step);
        let count = drawn.rays.len();
        let rays = self.context.upload(drawn.rays.as_flattened());
        let n = self.rounds(&rays, count, &drawn.depths);
        self.place(&mut drawn, n, &rays)?;
        let rays = self.context.upload(drawn.rays.as_flattened());
        let targets = &drawn.targets;
        self.learn(&rays, count, step, !targets.is_empty());
        let found: Vec<f32> = self.context.read(&self.losses, 4 * count + RAY_GRADIENT * targets.len())?;
        let (losses, asked) = found.split_at(4 * count);
        let losses = losses.as_chunks::<4>().0;
        let sum = |i: usize| losses.iter().map(|l| f64::from(l[i])).sum::<f64>();
        let (mse, loss) = (sum(0) / (3 * count) as f64, sum(1) / count as f64);
        let o = &self.twin.options;
        let factor = o.schedule.factor(step);
        let lr = o.learning_rate * factor;
        correct(cameras, data, targets, asked.as_chunks().0, (factor, step));
        self.twin.step_sharpness(sum(2) as f32, lr, step + 1);
        let samples = count * n + drawn.outside.len();
        Ok(StepReport { loss, mse, rays: count, samples, lit: samples })
    }

    fn fetch(&mut self) -> Result<()> {
        self.surface.fetch(&self.context, &mut self.twin.field)?;
        self.outside.fetch(&self.context, &mut self.twin.outside_parameters)
    }

    fn send(&mut self) {
        let (context, twin) = (&*self.context, &self.twin);
        self.surface = Surface::new(context, &self.kernels, &twin.field);
        self.outside = FrequencyNetworks::new(context, &twin.outside, &twin.outside_parameters);
    }
}
