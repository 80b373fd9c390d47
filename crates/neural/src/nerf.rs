//! NeRF on a hash grid with occupancy marching (`nerf --preset fast`).
//!
//! A ray is marched through contracted space ([`crate::contraction`]): steps of `step` inside the region, growing with
//! distance, wherever the occupancy grid has matter. Densities become opacities `1 - exp(-sigma dt)`, samples behind
//! the point where less than a thousandth of the light is left are dropped, colours are composited
//! ([`crate::composite`]), and the squared error is sent back.

use mb_job::{Result, Rng, rng};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::adam::Schedule;
use crate::cameras::{CameraResiduals, RayGradient};
use crate::composite::{Composite, CompositeGradient, composite, composite_backward, distortion, opacity};
use crate::contraction::{contract, contract_gradient};
use crate::dataset::{RayDataset, SceneRay, TargetRay};
use crate::hash_grid::HashGridOptions;
use crate::model::{GROUPS, Level, Model, StepReport, TILE, same_lengths};
use crate::occupancy::{CELL_MEMORY, OccupancyGrid, TURNS, looks_everywhere};
use crate::radiance_field::{RadianceField, RadianceFieldOptions, RadianceParameters, RadianceWorker, Transposed};
use crate::ray_samples::RaySamples;

/// How a fast NeRF is trained. Lengths are in radii of the region of interest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NerfOptions {
    /// Steps.
    pub iterations: u64,
    /// Samples that a step aims at; the number of rays follows (instant-ngp: 2^18 on a GPU).
    pub samples_per_step: usize,
    /// The field.
    pub field: RadianceFieldOptions,
    /// Learning rate of everything (instant-ngp: 1e-2).
    pub learning_rate: f32,
    /// Its course.
    pub schedule: Schedule,
    /// Nearest sample.
    pub near: f32,
    /// Farthest sample.
    pub far: f32,
    /// Shortest step.
    pub step: f32,
    /// A step's length as a share of the distance, where that is longer.
    pub cone: f32,
    /// Cells a side of the occupancy grid, which covers all of contracted space.
    pub occupancy: usize,
    /// Steps between refreshes of a sixteenth of the grid.
    pub occupancy_every: u64,
    /// Weight of the distortion loss, which gathers the light of a ray in one place (mip-NeRF 360: 0.01).
    pub distortion: f32,
    /// Learn only what the masks show, before a random background.
    pub object_only: bool,
    /// Density of the extracted surface, per radius.
    pub surface_density: f32,
    /// Random numbers.
    pub seed: u64,
}

impl Default for NerfOptions {
    /// The preset `fast`.
    fn default() -> Self {
        Self {
            iterations: 6_000,
            samples_per_step: 1 << 16,
            field: RadianceFieldOptions {
                grid: HashGridOptions { levels: 8, features: 4, log2_entries: 17, coarsest: 16, finest: 1024 },
                width: 64,
                color_hidden: 1,
            },
            learning_rate: 1e-2,
            schedule: Schedule::WarmExponential { warm_up: 100, end: 6_000, floor: 0.03 },
            near: 0.2,
            far: 64.0,
            step: 0.02,
            cone: 1.0 / 96.0,
            occupancy: 128,
            occupancy_every: 16,
            distortion: 0.005,
            object_only: false,
            surface_density: 40.0,
            seed: 0,
        }
    }
}

impl NerfOptions {
    /// The same with another number of steps: the schedule follows.
    #[must_use]
    pub fn with_iterations(mut self, iterations: u64) -> Self {
        self.iterations = iterations;
        self.schedule = Schedule::WarmExponential { warm_up: 100.min(iterations / 10), end: iterations, floor: 0.03 };
        self
    }
}

/// A tile: its samples, and what they became.
#[derive(Debug, Default)]
struct Tile {
    samples: RaySamples<3>,
    alphas: Vec<f32>,
    weights: Vec<f32>,
    composites: Vec<Composite>,
}

/// One of the pieces of a step.
#[derive(Debug, Default)]
struct Group {
    field: RadianceWorker,
    tile: Tile,
    rays: Vec<TargetRay>,
    backgrounds: Vec<[f32; 3]>,
    gradients: Vec<RayGradient>,
    /// Cells that were sampled, and the density found.
    seen: Vec<(u32, f32)>,
    loss: f64,
    distortion: f64,
    marched: usize,
    lit: usize,
}

/// What a step asks of its groups.
#[derive(Clone, Copy)]
struct Task<'a> {
    data: &'a RayDataset,
    cameras: &'a CameraResiduals,
    transposed: &'a Transposed,
    rays: usize,
    move_cameras: bool,
}

/// A NeRF in training. Its state is open, for a device that trains it elsewhere.
pub struct Nerf {
    /// How it is trained.
    pub options: NerfOptions,
    /// Its sizes.
    pub field: RadianceField,
    /// What it has learned.
    pub parameters: RadianceParameters,
    /// Where matter may be.
    pub occupancy: OccupancyGrid,
    /// Running mean of the samples of a ray (one number).
    pub samples_per_ray: Vec<f32>,
    groups: Vec<Group>,
}

/// Light below which the rest of a ray is dropped.
pub const DARK: f32 = 1e-3;

impl Nerf {
    /// A NeRF at its start. Where fewer than two cameras look, nothing can be known and nothing is kept.
    pub fn new(options: NerfOptions, data: &RayDataset) -> Self {
        let field = RadianceField::new(&options.field);
        let parameters = field.init(&mut rng(options.seed, u64::MAX));
        let mut occupancy = OccupancyGrid::new(options.occupancy);
        occupancy.close(|center, half| data.seen_by(center, half, options.near) >= 2);
        Self {
            occupancy,
            samples_per_ray: vec![128.0],
            groups: (0..GROUPS).map(|_| Group::default()).collect(),
            options,
            field,
            parameters,
        }
    }

    /// Rays of each group of the next step.
    pub fn rays_of_group(&self) -> usize {
        let wanted = self.options.samples_per_step as f32 / self.samples_per_ray[0].max(1.0);
        (wanted as usize / GROUPS).clamp(8, 1024)
    }

    /// Notes how many samples a step took on so many rays.
    pub fn count_samples(&mut self, samples: usize, rays: usize) {
        self.samples_per_ray[0] += 0.1 * (samples as f32 / rays as f32 - self.samples_per_ray[0]);
    }

    /// The random numbers of a refresh.
    pub fn occupancy_seed(&self) -> u64 {
        self.options.seed ^ 0x6f63
    }

    /// Adds a ray's samples to the tile; `jitter` in 0..1 shifts them by a part of a step.
    pub fn march(&self, ray: &SceneRay, jitter: f32, samples: &mut RaySamples<3>) {
        let o = &self.options;
        let step = |t: f32| (t * o.cone).max(o.step);
        let mut t = o.near + jitter * step(o.near);
        while t < o.far {
            let dt = step(t);
            let u = contract(ray.at(t));
            if self.occupancy.is_occupied(u) {
                samples.push(u, t, dt);
            }
            t += dt;
        }
        samples.end_ray(ray.direction);
    }

    /// Drops samples that no light reaches, then computes densities, opacities, colours and composites of the tile.
    /// With `seen`, notes the density of every sampled cell.
    fn shade(
        &self,
        tile: &mut Tile,
        worker: &mut RadianceWorker,
        backgrounds: &[[f32; 3]],
        seen: Option<&mut Vec<(u32, f32)>>,
    ) {
        let p = &self.parameters;
        let samples = &mut tile.samples;
        self.field.density(p, &samples.positions, worker);
        if let Some(seen) = seen {
            let cells = samples.positions.iter().map(|p| self.occupancy.cell(*p) as u32);
            seen.extend(cells.zip(worker.sigma.iter().copied()));
        }
        tile.alphas.clear();
        tile.alphas.extend(worker.sigma.iter().zip(&samples.lengths).map(|(sigma, dt)| opacity(*sigma, *dt)));
        if let Some(keep) = samples.drop_dark(DARK, |i, _| 1.0 - tile.alphas[i]) {
            self.field.compact(p, keep, worker);
            for (to, from) in keep.iter().enumerate() {
                tile.alphas[to] = tile.alphas[*from as usize];
            }
            tile.alphas.truncate(keep.len());
        }
        self.field.color(p, &samples.runs, worker);
        tile.weights.resize(tile.alphas.len(), 0.0);
        tile.composites.clear();
        for (run, background) in samples.ranges().zip(backgrounds) {
            let (alphas, rgb) = (&tile.alphas[run.clone()], &worker.rgb[run.clone()]);
            tile.composites.push(composite(alphas, rgb, *background, &mut tile.weights[run]));
        }
    }

    fn run_group(&self, task: &Task<'_>, rng: &mut Rng, group: &mut Group) {
        let scale = 1.0 / (3 * task.rays * GROUPS) as f32;
        task.data.draw(rng, task.rays, task.cameras, &mut group.rays);
        (group.loss, group.distortion) = (0.0, 0.0);
        (group.marched, group.lit) = (0, 0);
        group.gradients.clear();
        let mut next = 0;
        while next < group.rays.len() {
            let first = next;
            group.tile.samples.clear();
            group.backgrounds.clear();
            while next < group.rays.len() && group.tile.samples.len() < TILE {
                // A random background, so that nothing can hide behind a transparent foreground.
                group.backgrounds.push(std::array::from_fn(|_| rng.random()));
                self.march(&group.rays[next].ray, rng.random(), &mut group.tile.samples);
                next += 1;
            }
            group.marched += group.tile.samples.len();
            self.shade(&mut group.tile, &mut group.field, &group.backgrounds, Some(&mut group.seen));
            group.lit += group.tile.samples.len();
            self.losses(group, first..next, scale);
            let Group { field: worker, tile: Tile { samples, .. }, rays, gradients, .. } = &mut *group;
            self.field.backward(&self.parameters, task.transposed, &samples.positions, worker);
            if task.move_cameras {
                self.field.ray_gradients(&self.parameters, &samples.positions, &samples.runs, worker);
                for ((target, run), d) in rays[first..next].iter().zip(samples.ranges()).zip(&worker.d_directions) {
                    let mut gradient = RayGradient { origin: [0.0; 3], direction: *d };
                    for i in run {
                        let t = samples.depths[i];
                        gradient.add_point(t, contract_gradient(target.ray.at(t), worker.d_positions[i]));
                    }
                    gradients.push(gradient);
                }
            }
        }
    }

    /// The losses of a tile's rays and their derivatives with respect to densities and colours.
    fn losses(&self, group: &mut Group, range: std::ops::Range<usize>, scale: f32) {
        let Group { field: worker, tile, rays, backgrounds, loss, distortion: distorted, .. } = group;
        worker.d_sigma.clear();
        worker.d_sigma.resize(tile.alphas.len(), 0.0);
        worker.d_rgb.clear();
        worker.d_rgb.resize(tile.alphas.len(), [0.0; 3]);
        let samples = &tile.samples;
        let (mut places, mut lengths) = (Vec::new(), Vec::new());
        for (i, (target, run)) in rays[range].iter().zip(samples.ranges()).enumerate() {
            let wanted = target.before(backgrounds[i], self.options.object_only);
            let error: [f32; 3] = std::array::from_fn(|c| tile.composites[i].rgb[c] - wanted[c]);
            *loss += error.iter().map(|e| f64::from(e * e)).sum::<f64>();
            let d_weights = &mut worker.d_sigma[run.clone()];
            if self.options.distortion > 0.0 {
                // Distances in units that shrink like disparity: s = t / (1 + t).
                places.clear();
                places.extend(samples.depths[run.clone()].iter().map(|t| t / (1.0 + t)));
                lengths.clear();
                let stretches = samples.depths[run.clone()].iter().zip(&samples.lengths[run.clone()]);
                lengths.extend(stretches.map(|(t, dt)| dt / ((1.0 + t) * (1.0 + t))));
                let weight = 3.0 * scale * self.options.distortion;
                *distorted += f64::from(distortion(&tile.weights[run.clone()], &places, &lengths, weight, d_weights));
            }
            let gradient = CompositeGradient { d_rgb: error.map(|e| 2.0 * scale * e), d_transmittance: 0.0 };
            composite_backward(
                &tile.alphas[run.clone()],
                &worker.rgb[run.clone()],
                backgrounds[i],
                &tile.weights[run.clone()],
                &gradient,
                d_weights,
                &mut worker.d_rgb[run],
            );
        }
        // d alpha / d sigma = dt (1 - alpha).
        for ((d, alpha), dt) in worker.d_sigma.iter_mut().zip(&tile.alphas).zip(&samples.lengths) {
            *d *= dt * (1.0 - alpha);
        }
    }

    /// A cell counts where a shortest step through it stops a hundredth of the light, or, while everything is thin,
    /// where it is denser than the mean (as in instant-ngp). After the first round a haze below four times the mean
    /// has to go, or a processor would spend most of its samples on it.
    pub fn occupancy_threshold(&self, turn: u64) -> f32 {
        let thin = self.occupancy.mean() * if turn < TURNS { 1.0 } else { 4.0 };
        thin.min(0.01 / self.options.step)
    }

    /// The `turn`-th refresh.
    fn refresh_occupancy(&mut self, turn: u64) {
        let (seed, all) = (self.occupancy_seed(), looks_everywhere(turn));
        let (field, parameters) = (&self.field, &self.parameters);
        self.occupancy.update(seed, turn, all, CELL_MEMORY, |positions, out| {
            let mut worker = RadianceWorker::default();
            for tile in positions.chunks(TILE) {
                field.density(parameters, tile, &mut worker);
                out.extend_from_slice(&worker.sigma);
            }
        });
        self.occupancy.decide(self.occupancy_threshold(turn));
    }
}

impl Model for Nerf {
    fn name(&self) -> &'static str {
        "nerf"
    }

    fn only_object(&self) -> bool {
        self.options.object_only
    }

    fn iterations(&self) -> u64 {
        self.options.iterations
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        let rays = self.rays_of_group();
        let transposed = self.field.transpose(&self.parameters);
        let move_cameras = cameras.wants_gradients(step);
        let task = Task { data, cameras, transposed: &transposed, rays, move_cameras };
        let mut groups = std::mem::take(&mut self.groups);
        groups.par_iter_mut().enumerate().for_each(|(i, group)| {
            let mut rng = rng(self.options.seed, step * GROUPS as u64 + i as u64);
            self.run_group(&task, &mut rng, group);
        });
        self.field.collect(&mut self.parameters, groups.iter_mut().map(|g| &mut g.field));
        let factor = self.options.schedule.factor(step + 1);
        if move_cameras {
            cameras.add(data, groups.iter().flat_map(|g| g.rays.iter().zip(&g.gradients)));
            cameras.step(data, factor, step);
        }
        let n = (rays * GROUPS) as f64;
        let mse = groups.iter().map(|g| g.loss).sum::<f64>() / (3.0 * n);
        let distortion = groups.iter().map(|g| g.distortion).sum::<f64>() / n;
        let samples = groups.iter().map(|g| g.marched).sum::<usize>();
        let lit = groups.iter().map(|g| g.lit).sum();
        for group in &mut groups {
            self.occupancy.raise(&group.seen);
            group.seen.clear();
        }
        self.groups = groups;
        self.parameters.step(self.options.learning_rate * factor, step + 1);
        self.count_samples(samples, rays * GROUPS);
        if (step + 1).is_multiple_of(self.options.occupancy_every) {
            self.refresh_occupancy((step + 1) / self.options.occupancy_every);
        }
        let loss = mse + f64::from(self.options.distortion) * distortion;
        Ok(StepReport { loss, mse, rays: rays * GROUPS, samples, lit })
    }

    fn render(&self, rays: &[SceneRay]) -> Vec<[f32; 3]> {
        let parts: Vec<Vec<[f32; 3]>> = rays
            .par_chunks(128)
            .map(|rays| {
                let (mut tile, mut worker) = (Tile::default(), RadianceWorker::default());
                let mut out = Vec::with_capacity(rays.len());
                let mut shade = |tile: &mut Tile| {
                    let black = vec![[0.0; 3]; tile.samples.runs.len()];
                    self.shade(tile, &mut worker, &black, None);
                    out.extend(tile.composites.iter().map(|c| c.rgb));
                    tile.samples.clear();
                };
                for ray in rays {
                    self.march(ray, 0.5, &mut tile.samples);
                    if tile.samples.len() >= TILE {
                        shade(&mut tile);
                    }
                }
                shade(&mut tile);
                out
            })
            .collect();
        parts.concat()
    }

    fn level(&self) -> Level {
        Level { value: self.options.surface_density, larger_inside: true }
    }

    fn surface(&self, positions: &[[f32; 3]]) -> Vec<f32> {
        let mut worker = RadianceWorker::default();
        let mut out = Vec::with_capacity(positions.len());
        for tile in positions.chunks(TILE) {
            let tile: Vec<[f32; 3]> = tile.iter().map(|p| contract(*p)).collect();
            self.field.density(&self.parameters, &tile, &mut worker);
            out.extend_from_slice(&worker.sigma);
        }
        out
    }

    fn may_cross(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        self.occupancy.any_occupied(contract(low), contract(high))
    }

    fn color_at(&self, positions: &[[f32; 3]], directions: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let mut worker = RadianceWorker::default();
        let mut out = Vec::with_capacity(positions.len());
        for (positions, directions) in positions.chunks(TILE).zip(directions.chunks(TILE)) {
            let tile: Vec<[f32; 3]> = positions.iter().map(|p| contract(*p)).collect();
            let runs: Vec<_> = directions.iter().map(|d| (1, *d)).collect();
            self.field.density(&self.parameters, &tile, &mut worker);
            self.field.color(&self.parameters, &runs, &mut worker);
            out.extend_from_slice(&worker.rgb);
        }
        out
    }

    fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        let mut all = self.parameters.buffers();
        all.extend(self.occupancy.buffers());
        all.push(&mut self.samples_per_ray);
        all
    }

    fn restored(&mut self, _step: u64) -> std::result::Result<(), String> {
        let mut lengths: Vec<usize> = self.parameters.lengths();
        lengths.extend(self.occupancy.lengths());
        lengths.push(1);
        same_lengths(&self.buffers(), &lengths)?;
        self.occupancy.restored();
        Ok(())
    }

    fn is_finite(&self) -> bool {
        self.parameters.is_finite()
    }

    fn parameter_count(&self) -> usize {
        self.field.parameter_count()
    }

    fn bytes(&self) -> usize {
        let o = &self.options;
        16 * self.field.parameter_count()
            + 6 * o.occupancy.pow(3)
            + 2 * o.samples_per_step * self.field.bytes_per_sample()
    }
}
