//! The original NeRF (Mildenhall et al. 2020; `nerf --preset paper`): two networks of frequencies, a coarse one that says
//! where to look and a fine one that looks.
//!
//! A ray has `coarse_samples` stratified samples for the coarse network. Its weights, as a piecewise constant density,
//! give `fine_samples` more, and the fine network sees all of them. The loss is the squared error of both pictures.
//! Nothing is sent back through the places of the samples.
//!
//! With masks the samples lie in the unit ball, before a random background. Without, they lie evenly in inverse distance
//! (`--lindisp` of the authors' code), and the networks see contracted positions ([`crate::contraction`]), because
//! frequencies of far positions carry no information.

use mb_job::{Result, Rng, rng};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::adam::{AdamOptions, Schedule};
use crate::cameras::{CameraResiduals, RayGradient};
use crate::composite::{Composite, CompositeGradient, composite, composite_backward, opacity};
use crate::contraction::{contract, contract_gradient};
use crate::dataset::{RayDataset, SceneRay, TargetRay};
use crate::frequency_field::{
    FrequencyField, FrequencyFieldOptions, FrequencyParameters, FrequencyTransposed, FrequencyWorker,
};
use crate::model::{GROUPS, Level, Model, StepReport, same_lengths};
use crate::sampling::{importance, stratified};

/// How an original NeRF is trained. "NeRF" names the paper, section 5.3 and appendix A. Lengths are in radii of the region.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NerfOriginalOptions {
    /// Steps (NeRF: 100,000 to 300,000; the MobileBrick paper trains 200,000).
    pub iterations: u64,
    /// Rays of a step (NeRF: 4096).
    pub rays: usize,
    /// Samples for the coarse network (NeRF: 64).
    pub coarse_samples: usize,
    /// Further samples for the fine network (NeRF: 128).
    pub fine_samples: usize,
    /// Both networks.
    pub field: FrequencyFieldOptions,
    /// Learning rate (NeRF: 5e-4).
    pub learning_rate: f32,
    /// Its course (the authors' code: tenfold down every 250,000 steps).
    pub schedule: Schedule,
    /// Nearest sample where there are no masks.
    pub near: f32,
    /// Farthest sample where there are no masks.
    pub far: f32,
    /// Learn only what the masks show, where there are masks.
    pub use_masks: bool,
    /// Density of the extracted surface, per radius.
    pub surface_density: f32,
    /// Random numbers.
    pub seed: u64,
}

impl NerfOriginalOptions {
    /// The paper's numbers.
    pub fn paper() -> Self {
        Self {
            iterations: 200_000,
            rays: 4096,
            coarse_samples: 64,
            fine_samples: 128,
            field: FrequencyFieldOptions::PAPER,
            learning_rate: 5e-4,
            schedule: Schedule::Exponential { factor: 0.1, every: 250_000 },
            near: 0.5,
            far: 64.0,
            use_masks: true,
            surface_density: 50.0,
            seed: 0,
        }
    }

    /// The same with another number of steps: the schedule follows.
    #[must_use]
    pub fn with_iterations(mut self, iterations: u64) -> Self {
        if let Schedule::Exponential { factor, every } = self.schedule {
            let every = (every as f64 * iterations as f64 / self.iterations.max(1) as f64).round().max(1.0) as u64;
            self.schedule = Schedule::Exponential { factor, every };
        }
        self.iterations = iterations;
        self
    }
}

/// Samples of a tile, every ray with equally many.
#[derive(Debug, Default)]
struct Samples {
    positions: Vec<[f32; 3]>,
    depths: Vec<f32>,
    lengths: Vec<f32>,
    alphas: Vec<f32>,
    weights: Vec<f32>,
    composites: Vec<Composite>,
}

#[derive(Debug, Default)]
struct Group {
    coarse: FrequencyWorker<3>,
    fine: FrequencyWorker<3>,
    coarse_samples: Samples,
    fine_samples: Samples,
    rays: Vec<TargetRay>,
    gradients: Vec<RayGradient>,
    loss: f64,
    squared: f64,
}

/// An original NeRF in training. Its state is open, for a device that trains it elsewhere.
pub struct NerfOriginal {
    /// How it is trained.
    pub options: NerfOriginalOptions,
    /// The sizes of both networks.
    pub field: FrequencyField<3>,
    /// What the coarse network has learned.
    pub coarse: FrequencyParameters,
    /// What the fine network has learned.
    pub fine: FrequencyParameters,
    groups: Vec<Group>,
    /// Only the object, before a random background; else all of contracted space.
    pub with_masks: bool,
}

/// Rays that go through the networks at once, and draw their random numbers together.
pub const TILE_RAYS: usize = 8;
/// Adam's constants: the authors' code; the paper has 1e-7 for the last.
pub const ADAM: AdamOptions = AdamOptions { beta1: 0.9, beta2: 0.999, epsilon: 1e-8, skip_untouched: false };

impl NerfOriginal {
    /// A NeRF at its start.
    pub fn new(options: NerfOriginalOptions, data: &RayDataset) -> Self {
        let field = FrequencyField::new(&options.field);
        let mut rng = rng(options.seed, u64::MAX);
        Self {
            coarse: field.init(&mut rng),
            fine: field.init(&mut rng),
            groups: (0..GROUPS).map(|_| Group::default()).collect(),
            with_masks: options.use_masks && data.has_masks(),
            field,
            options,
        }
    }

    /// Rays of each group of a step.
    pub fn rays_of_group(&self) -> usize {
        self.options.rays.div_ceil(GROUPS)
    }

    /// What the networks see of a scene point.
    fn seen(&self, p: [f32; 3]) -> [f32; 3] {
        if self.with_masks { p } else { contract(p).map(|c| 4.0 * c - 2.0) }
    }

    /// First and last distance of a ray's samples; a ray that misses the ball has none of it.
    pub fn range(&self, ray: &SceneRay) -> (f32, f32) {
        match self.with_masks {
            true => ray.ball(1.0).map_or((0.0, 0.0), |(near, far)| (near.max(0.05), far.max(0.06))),
            false => (self.options.near, self.options.far),
        }
    }

    /// Distances of the coarse samples: even in distance, or in its inverse.
    pub fn coarse_depths(&self, ray: &SceneRay, rng: Option<&mut Rng>) -> Vec<f32> {
        let (near, far) = self.range(ray);
        let mut depths = Vec::new();
        if self.with_masks {
            stratified(near, far, self.options.coarse_samples, rng, &mut depths);
        } else {
            stratified(0.0, 1.0, self.options.coarse_samples, rng, &mut depths);
            depths.iter_mut().for_each(|u| *u = 1.0 / ((1.0 - *u) / near + *u / far));
        }
        depths
    }

    fn place(&self, rays: &[SceneRay], depths: impl Iterator<Item = Vec<f32>>, to: &mut Samples) {
        to.positions.clear();
        to.depths.clear();
        to.lengths.clear();
        for (ray, depths) in rays.iter().zip(depths) {
            let end = self.range(ray).1;
            for (i, t) in depths.iter().enumerate() {
                to.positions.push(self.seen(ray.at(*t)));
                to.lengths.push((depths.get(i + 1).copied().unwrap_or(end) - t).max(0.0));
            }
            to.depths.extend(depths);
        }
    }

    fn shade(
        &self,
        p: &FrequencyParameters,
        rays: &[SceneRay],
        backgrounds: &[[f32; 3]],
        samples: &mut Samples,
        worker: &mut FrequencyWorker<3>,
    ) {
        let n = samples.positions.len() / rays.len().max(1);
        let runs: Vec<_> = rays.iter().map(|r| (n as u32, r.direction)).collect();
        self.field.density(p, &samples.positions, worker);
        self.field.color(p, &runs, worker);
        samples.alphas.clear();
        samples.alphas.extend(worker.sigma.iter().zip(&samples.lengths).map(|(sigma, dt)| opacity(*sigma, *dt)));
        samples.weights.resize(samples.alphas.len(), 0.0);
        samples.composites.clear();
        for (i, background) in backgrounds.iter().enumerate() {
            let run = i * n..(i + 1) * n;
            let (alphas, rgb) = (&samples.alphas[run.clone()], &worker.rgb[run.clone()]);
            samples.composites.push(composite(alphas, rgb, *background, &mut samples.weights[run]));
        }
    }

    /// Both passes of some rays.
    fn render_rays(
        &self,
        rays: &[SceneRay],
        backgrounds: &[[f32; 3]],
        mut rng: Option<&mut Rng>,
        (coarse, coarse_worker): (&mut Samples, &mut FrequencyWorker<3>),
        (fine, fine_worker): (&mut Samples, &mut FrequencyWorker<3>),
    ) {
        let depths: Vec<_> = rays.iter().map(|ray| self.coarse_depths(ray, rng.as_deref_mut())).collect();
        self.place(rays, depths.into_iter(), coarse);
        self.shade(&self.coarse, rays, backgrounds, coarse, coarse_worker);
        let n = self.options.coarse_samples;
        let places = coarse.depths.chunks_exact(n).zip(coarse.weights.chunks_exact(n));
        let both: Vec<Vec<f32>> = places
            .map(|(depths, weights)| {
                // Between the middles of neighbours, weighted by the sample inside; the two at the ends are left out.
                let middles: Vec<f32> = depths.windows(2).map(|w| 0.5 * (w[0] + w[1])).collect();
                let mut all = Vec::new();
                importance(&middles, &weights[1..n - 1], self.options.fine_samples, rng.as_deref_mut(), &mut all);
                all.extend_from_slice(depths);
                all.sort_by(f32::total_cmp);
                all
            })
            .collect();
        self.place(rays, both.into_iter(), fine);
        self.shade(&self.fine, rays, backgrounds, fine, fine_worker);
    }

    fn run_group(
        &self,
        data: &RayDataset,
        cameras: &CameraResiduals,
        move_cameras: bool,
        transposed: [&FrequencyTransposed; 2],
        rng: &mut Rng,
        group: &mut Group,
    ) {
        let rays = self.rays_of_group();
        data.draw(rng, rays, cameras, &mut group.rays);
        (group.loss, group.squared) = (0.0, 0.0);
        group.gradients.clear();
        let scale = 1.0 / (3 * rays * GROUPS) as f32;
        let Group { coarse, fine, coarse_samples, fine_samples, rays, gradients, loss, squared } = group;
        for targets in rays.chunks(TILE_RAYS) {
            let tile: Vec<SceneRay> = targets.iter().map(|t| t.ray).collect();
            let backgrounds: Vec<[f32; 3]> = targets.iter().map(|_| std::array::from_fn(|_| rng.random())).collect();
            self.render_rays(
                &tile,
                &backgrounds,
                Some(rng),
                (&mut *coarse_samples, coarse),
                (&mut *fine_samples, fine),
            );
            let start = gradients.len();
            gradients.resize(start + targets.len(), RayGradient::default());
            for (pass, (samples, worker)) in
                [(&mut *coarse_samples, &mut *coarse), (&mut *fine_samples, &mut *fine)].into_iter().enumerate()
            {
                let error = self.losses(targets, &backgrounds, samples, worker, scale);
                *loss += error;
                if pass == 1 {
                    *squared += error;
                }
                let p = if pass == 0 { &self.coarse } else { &self.fine };
                self.field.backward(p, transposed[pass], worker);
                if move_cameras {
                    self.ray_gradients(targets, samples, worker, &mut gradients[start..]);
                }
            }
        }
    }

    /// The squared error of a pass, and its derivatives with respect to densities and colours.
    fn losses(
        &self,
        targets: &[TargetRay],
        backgrounds: &[[f32; 3]],
        samples: &Samples,
        worker: &mut FrequencyWorker<3>,
        scale: f32,
    ) -> f64 {
        let n = samples.positions.len() / targets.len().max(1);
        worker.d_sigma.clear();
        worker.d_sigma.resize(samples.alphas.len(), 0.0);
        worker.d_rgb.clear();
        worker.d_rgb.resize(samples.alphas.len(), [0.0; 3]);
        let mut sum = 0.0;
        for (i, target) in targets.iter().enumerate() {
            let run = i * n..(i + 1) * n;
            let wanted = target.before(backgrounds[i], self.with_masks);
            let error: [f32; 3] = std::array::from_fn(|c| samples.composites[i].rgb[c] - wanted[c]);
            sum += error.iter().map(|e| f64::from(e * e)).sum::<f64>();
            composite_backward(
                &samples.alphas[run.clone()],
                &worker.rgb[run.clone()],
                backgrounds[i],
                &samples.weights[run.clone()],
                &CompositeGradient { d_rgb: error.map(|e| 2.0 * scale * e), d_transmittance: 0.0 },
                &mut worker.d_sigma[run.clone()],
                &mut worker.d_rgb[run],
            );
        }
        for ((d, alpha), dt) in worker.d_sigma.iter_mut().zip(&samples.alphas).zip(&samples.lengths) {
            *d *= dt * (1.0 - alpha);
        }
        sum
    }

    fn ray_gradients(
        &self,
        targets: &[TargetRay],
        samples: &Samples,
        worker: &mut FrequencyWorker<3>,
        to: &mut [RayGradient],
    ) {
        let n = samples.positions.len() / targets.len().max(1);
        let runs: Vec<_> = targets.iter().map(|t| (n as u32, t.ray.direction)).collect();
        self.field.ray_gradients(&runs, worker);
        for (i, (target, to)) in targets.iter().zip(to).enumerate() {
            for d in 0..3 {
                to.direction[d] += worker.d_directions[i][d];
            }
            for s in i * n..(i + 1) * n {
                let (t, g) = (samples.depths[s], worker.d_positions[s]);
                let g = match self.with_masks {
                    true => g,
                    false => contract_gradient(target.ray.at(t), g.map(|c| 4.0 * c)),
                };
                to.add_point(t, g);
            }
        }
    }
}

impl Model for NerfOriginal {
    fn name(&self) -> &'static str {
        "nerf"
    }

    fn only_object(&self) -> bool {
        self.with_masks
    }

    fn iterations(&self) -> u64 {
        self.options.iterations
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        let transposed = [self.field.transpose(&self.coarse), self.field.transpose(&self.fine)];
        let transposed = [&transposed[0], &transposed[1]];
        let move_cameras = cameras.wants_gradients(step);
        let mut groups = std::mem::take(&mut self.groups);
        groups.par_iter_mut().enumerate().for_each(|(i, group)| {
            let mut rng = rng(self.options.seed, step * GROUPS as u64 + i as u64);
            self.run_group(data, cameras, move_cameras, transposed, &mut rng, group);
        });
        self.field.collect(&mut self.coarse, groups.iter_mut().map(|g| &mut g.coarse));
        self.field.collect(&mut self.fine, groups.iter_mut().map(|g| &mut g.fine));
        let factor = self.options.schedule.factor(step);
        if move_cameras {
            cameras.add(data, groups.iter().flat_map(|g| g.rays.iter().zip(&g.gradients)));
            cameras.step(data, factor, step);
        }
        for p in [&mut self.coarse, &mut self.fine] {
            p.step(&ADAM, self.options.learning_rate * factor, step + 1);
        }
        let rays = groups.iter().map(|g| g.rays.len()).sum::<usize>();
        let mean = |pick: fn(&Group) -> f64| groups.iter().map(pick).sum::<f64>() / (3 * rays) as f64;
        let (loss, mse) = (mean(|g| g.loss), mean(|g| g.squared));
        self.groups = groups;
        let samples = rays * (2 * self.options.coarse_samples + self.options.fine_samples);
        Ok(StepReport { loss, mse, rays, samples, lit: samples })
    }

    fn render(&self, rays: &[SceneRay]) -> Vec<[f32; 3]> {
        let parts: Vec<Vec<[f32; 3]>> = rays
            .par_chunks(TILE_RAYS)
            .map(|rays| {
                let mut group = Group::default();
                let Group { coarse, fine, coarse_samples, fine_samples, .. } = &mut group;
                let black = vec![[0.0; 3]; rays.len()];
                self.render_rays(rays, &black, None, (coarse_samples, coarse), (fine_samples, fine));
                group.fine_samples.composites.iter().map(|c| c.rgb).collect()
            })
            .collect();
        parts.concat()
    }

    fn level(&self) -> Level {
        Level { value: self.options.surface_density, larger_inside: true }
    }

    fn surface(&self, positions: &[[f32; 3]]) -> Vec<f32> {
        let mut worker = FrequencyWorker::default();
        let mut out = Vec::with_capacity(positions.len());
        for tile in positions.chunks(512) {
            let tile: Vec<[f32; 3]> = tile.iter().map(|p| self.seen(*p)).collect();
            self.field.density(&self.fine, &tile, &mut worker);
            out.extend_from_slice(&worker.sigma);
        }
        out
    }

    fn may_cross(&self, _low: [f32; 3], _high: [f32; 3]) -> bool {
        true
    }

    fn color_at(&self, positions: &[[f32; 3]], directions: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let mut worker = FrequencyWorker::default();
        let mut out = Vec::with_capacity(positions.len());
        for (positions, directions) in positions.chunks(512).zip(directions.chunks(512)) {
            let tile: Vec<[f32; 3]> = positions.iter().map(|p| self.seen(*p)).collect();
            let runs: Vec<_> = directions.iter().map(|d| (1, *d)).collect();
            self.field.density(&self.fine, &tile, &mut worker);
            self.field.color(&self.fine, &runs, &mut worker);
            out.extend_from_slice(&worker.rgb);
        }
        out
    }

    fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        let mut all = self.coarse.buffers();
        all.extend(self.fine.buffers());
        all
    }

    fn restored(&mut self, _step: u64) -> std::result::Result<(), String> {
        let mut lengths = self.coarse.lengths();
        lengths.extend(self.fine.lengths());
        same_lengths(&self.buffers(), &lengths)
    }

    fn is_finite(&self) -> bool {
        self.coarse.is_finite() && self.fine.is_finite()
    }

    fn parameter_count(&self) -> usize {
        2 * self.field.parameter_count()
    }

    fn bytes(&self) -> usize {
        16 * self.parameter_count() + 2 * self.field.worker_bytes(GROUPS)
    }
}
