//! NeRF on a hash grid with occupancy marching (`nerf --preset fast`).
//!
//! A ray is marched through contracted space ([`crate::contraction`]): steps of `step` inside the region, growing with
//! distance, wherever the occupancy grid has matter. Densities become opacities `1 - exp(-sigma dt)`, samples behind
//! the point where less than a thousandth of the light is left are dropped, colours are composited
//! ([`crate::composite`]), and the squared error is sent back.

use mb_job::{Rng, rng};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::adam::Schedule;
use crate::composite::{Composite, CompositeGradient, composite, composite_backward, opacity};
use crate::contraction::contract;
use crate::dataset::{RayDataset, SceneRay, TargetRay};
use crate::hash_grid::HashGridOptions;
use crate::model::{GROUPS, Level, Model, StepReport, TILE};
use crate::occupancy::{CELL_MEMORY, OccupancyGrid, TURNS};
use crate::radiance_field::{RadianceField, RadianceFieldOptions, RadianceParameters, RadianceWorker, Transposed};

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

/// Samples of a tile: where they are, how they group into rays, and what they became.
#[derive(Debug, Default)]
struct Tile {
    positions: Vec<[f32; 3]>,
    lengths: Vec<f32>,
    /// Samples and direction of each ray.
    runs: Vec<(u32, [f32; 3])>,
    keep: Vec<u32>,
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
    loss: f64,
    marched: usize,
}

/// A NeRF in training.
pub struct Nerf {
    options: NerfOptions,
    field: RadianceField,
    parameters: RadianceParameters,
    occupancy: OccupancyGrid,
    /// Running mean of the samples of a ray.
    samples_per_ray: Vec<f32>,
    groups: Vec<Group>,
}

/// Light below which the rest of a ray is dropped.
const DARK: f32 = 1e-3;

impl Nerf {
    /// A NeRF at its start.
    pub fn new(options: NerfOptions) -> Self {
        let field = RadianceField::new(&options.field);
        let parameters = field.init(&mut rng(options.seed, u64::MAX));
        Self {
            occupancy: OccupancyGrid::new(options.occupancy),
            samples_per_ray: vec![128.0],
            groups: (0..GROUPS).map(|_| Group::default()).collect(),
            options,
            field,
            parameters,
        }
    }

    /// Adds a ray's samples to the tile; `jitter` in 0..1 shifts them by a part of a step.
    fn march(&self, ray: &SceneRay, jitter: f32, tile: &mut Tile) {
        let o = &self.options;
        let step = |t: f32| (t * o.cone).max(o.step);
        let mut t = o.near + jitter * step(o.near);
        let before = tile.positions.len();
        while t < o.far {
            let dt = step(t);
            let u = contract(ray.at(t));
            if self.occupancy.is_occupied(u) {
                tile.positions.push(u);
                tile.lengths.push(dt);
            }
            t += dt;
        }
        tile.runs.push(((tile.positions.len() - before) as u32, ray.direction));
    }

    /// Drops samples that no light reaches, then computes densities, opacities, colours and composites of the tile.
    fn shade(&self, tile: &mut Tile, worker: &mut RadianceWorker, backgrounds: &[[f32; 3]]) {
        let p = &self.parameters;
        self.field.density(p, &tile.positions, worker);
        tile.keep.clear();
        let mut first = 0;
        for run in &mut tile.runs {
            let last = first + run.0 as usize;
            let mut light = 1.0;
            let mut kept = 0;
            for i in first..last {
                if light < DARK {
                    break;
                }
                tile.keep.push(i as u32);
                kept += 1;
                light *= 1.0 - opacity(worker.sigma[i], tile.lengths[i]);
            }
            run.0 = kept;
            first = last;
        }
        if tile.keep.len() < tile.positions.len() {
            self.field.compact(p, &tile.keep, worker);
            for (to, from) in tile.keep.iter().enumerate() {
                tile.positions[to] = tile.positions[*from as usize];
                tile.lengths[to] = tile.lengths[*from as usize];
            }
            tile.positions.truncate(tile.keep.len());
            tile.lengths.truncate(tile.keep.len());
        }
        self.field.color(p, &tile.runs, worker);
        tile.alphas.clear();
        tile.alphas.extend(worker.sigma.iter().zip(&tile.lengths).map(|(sigma, dt)| opacity(*sigma, *dt)));
        tile.weights.resize(tile.alphas.len(), 0.0);
        tile.composites.clear();
        let mut first = 0;
        for ((count, _), background) in tile.runs.iter().zip(backgrounds) {
            let run = first..first + *count as usize;
            first = run.end;
            let (alphas, rgb) = (&tile.alphas[run.clone()], &worker.rgb[run.clone()]);
            tile.composites.push(composite(alphas, rgb, *background, &mut tile.weights[run]));
        }
    }

    fn clear(tile: &mut Tile) {
        tile.positions.clear();
        tile.lengths.clear();
        tile.runs.clear();
    }

    fn run_group(
        &self,
        data: &RayDataset,
        rng: &mut Rng,
        rays: usize,
        scale: f32,
        transposed: &Transposed,
        group: &mut Group,
    ) {
        let Group { field: worker, tile, rays: targets, backgrounds, loss, marched } = group;
        data.draw(rng, rays, targets);
        (*loss, *marched) = (0.0, 0);
        let mut next = 0;
        while next < targets.len() {
            let first = next;
            Self::clear(tile);
            backgrounds.clear();
            while next < targets.len() && tile.positions.len() < TILE {
                // A random background, so that nothing can hide behind a transparent foreground.
                backgrounds.push(std::array::from_fn(|_| rng.random()));
                self.march(&targets[next].ray, rng.random(), tile);
                next += 1;
            }
            *marched += tile.positions.len();
            self.shade(tile, worker, backgrounds);
            worker.d_sigma.clear();
            worker.d_sigma.resize(tile.alphas.len(), 0.0);
            worker.d_rgb.clear();
            worker.d_rgb.resize(tile.alphas.len(), [0.0; 3]);
            let mut start = 0;
            for (i, target) in targets[first..next].iter().enumerate() {
                let run = start..start + tile.runs[i].0 as usize;
                start = run.end;
                let wanted = match target.mask.filter(|_| self.options.object_only) {
                    Some(mask) => std::array::from_fn(|c| mask * target.rgb[c] + (1.0 - mask) * backgrounds[i][c]),
                    None => target.rgb,
                };
                let error: [f32; 3] = std::array::from_fn(|c| tile.composites[i].rgb[c] - wanted[c]);
                *loss += error.iter().map(|e| f64::from(e * e)).sum::<f64>();
                let gradient = CompositeGradient { d_rgb: error.map(|e| 2.0 * scale * e), d_transmittance: 0.0 };
                composite_backward(
                    &tile.alphas[run.clone()],
                    &worker.rgb[run.clone()],
                    backgrounds[i],
                    &tile.weights[run.clone()],
                    &tile.composites[i],
                    &gradient,
                    &mut worker.d_sigma[run.clone()],
                    &mut worker.d_rgb[run],
                );
            }
            // d alpha / d sigma = dt (1 - alpha).
            for ((d, alpha), dt) in worker.d_sigma.iter_mut().zip(&tile.alphas).zip(&tile.lengths) {
                *d *= dt * (1.0 - alpha);
            }
            self.field.backward(&self.parameters, transposed, &tile.positions, worker);
        }
    }

    /// A cell counts where a shortest step through it stops a hundredth of the light, or, while everything is thin,
    /// where it is denser than the mean (as in instant-ngp). After the first round a haze below four times the mean
    /// has to go, or a processor would spend most of its samples on it.
    fn occupancy_threshold(&self, turn: u64) -> f32 {
        let thin = self.occupancy.mean() * if turn < TURNS { 1.0 } else { 4.0 };
        thin.min(0.01 / self.options.step)
    }

    /// The `turn`-th refresh. Turns 1, 3, 7, 15 look at every cell, so that empty space is left early.
    fn refresh_occupancy(&mut self, turn: u64) {
        let all = turn < TURNS && (turn + 1).is_power_of_two();
        let (field, parameters) = (&self.field, &self.parameters);
        self.occupancy.update(self.options.seed ^ 0x6f63, turn, all, CELL_MEMORY, |positions, out| {
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

    fn iterations(&self) -> u64 {
        self.options.iterations
    }

    fn step(&mut self, data: &RayDataset, step: u64) -> StepReport {
        let wanted = self.options.samples_per_step as f32 / self.samples_per_ray[0].max(1.0);
        let rays = (wanted as usize / GROUPS).clamp(8, 1024);
        let scale = 1.0 / (3 * rays * GROUPS) as f32;
        let transposed = self.field.transpose(&self.parameters);
        let mut groups = std::mem::take(&mut self.groups);
        groups.par_iter_mut().enumerate().for_each(|(i, group)| {
            let mut rng = rng(self.options.seed, step * GROUPS as u64 + i as u64);
            self.run_group(data, &mut rng, rays, scale, &transposed, group);
        });
        self.field.collect(&mut self.parameters, groups.iter_mut().map(|g| &mut g.field));
        let mse = groups.iter().map(|g| g.loss).sum::<f64>() / (3 * rays * GROUPS) as f64;
        let samples = groups.iter().map(|g| g.marched).sum::<usize>();
        self.groups = groups;
        let lr = self.options.learning_rate * self.options.schedule.factor(step + 1);
        self.parameters.step(lr, step + 1);
        self.samples_per_ray[0] += 0.1 * (samples as f32 / (rays * GROUPS) as f32 - self.samples_per_ray[0]);
        if (step + 1).is_multiple_of(self.options.occupancy_every) {
            self.refresh_occupancy((step + 1) / self.options.occupancy_every);
        }
        StepReport { loss: mse, mse, rays: rays * GROUPS, samples }
    }

    fn render(&self, rays: &[SceneRay]) -> Vec<[f32; 3]> {
        let parts: Vec<Vec<[f32; 3]>> = rays
            .par_chunks(128)
            .map(|rays| {
                let (mut tile, mut worker) = (Tile::default(), RadianceWorker::default());
                let mut out = Vec::with_capacity(rays.len());
                for ray in rays {
                    self.march(ray, 0.5, &mut tile);
                    if tile.positions.len() >= TILE {
                        let black = vec![[0.0; 3]; tile.runs.len()];
                        self.shade(&mut tile, &mut worker, &black);
                        out.extend(tile.composites.iter().map(|c| c.rgb));
                        Self::clear(&mut tile);
                    }
                }
                let black = vec![[0.0; 3]; tile.runs.len()];
                self.shade(&mut tile, &mut worker, &black);
                out.extend(tile.composites.iter().map(|c| c.rgb));
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
        all.push(&mut self.occupancy.values);
        all.push(&mut self.samples_per_ray);
        all
    }

    fn restored(&mut self, step: u64) {
        let turn = step / self.options.occupancy_every;
        if turn > 0 {
            self.occupancy.decide(self.occupancy_threshold(turn));
        }
    }

    fn is_finite(&self) -> bool {
        self.parameters.is_finite()
    }

    fn parameter_count(&self) -> usize {
        self.field.parameter_count()
    }
}
