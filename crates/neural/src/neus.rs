//! NeuS on a hash grid (`neus --preset fast` and `best`): a signed distance field, rendered through its logistic density.
//!
//! Inside the unit ball (the region of interest) a ray is sampled where the surface may be: in cells whose distance is
//! within the reach of the logistic density, with steps that shorten as it sharpens. Behind the ball, where there are
//! no masks, a radiance field on contracted space ([`crate::radiance_field`]) is the background. All samples of a ray
//! are composited together. The loss is
//!
//! `mean |C - C*| + eikonal * mean (|n| - 1)^2 + mask * BCE(1 - T, mask)`,
//!
//! the second over the samples and over random points of the ball; its weight falls once the shape has settled. Levels
//! of the hash grid join one by one (coarse to fine), so that the shape settles before its details. All derivatives are
//! exact ([`crate::sdf_field`], [`crate::neus_alpha`], [`crate::composite`]).

use mb_job::{Result, Rng, rng};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::adam::{Parameters, Schedule};
use crate::cameras::{CameraResiduals, RayGradient};
use crate::composite::{CompositeGradient, RayComposites, opacity};
use crate::contraction::{contract, contract_gradient};
use crate::dataset::{RayDataset, SceneRay, TargetRay};
use crate::hash_grid::HashGridOptions;
use crate::model::{GROUPS, Level, Model, StepReport, TILE, same_lengths};
use crate::neus_alpha::Section;
use crate::occupancy::{CELL_MEMORY, OccupancyGrid, looks_everywhere};
use crate::radiance_field::{
    ADAM, RadianceField, RadianceFieldOptions, RadianceParameters, RadianceWorker, Transposed,
};
use crate::ray_samples::RaySamples;
use crate::sdf_field::{DirectionEncoding, PositionEncoding, SdfField, SdfFieldOptions, SdfWorker};
use crate::simd::sigmoid;

/// How a fast NeuS is trained. Lengths are in radii of the region of interest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NeusOptions {
    /// Steps.
    pub iterations: u64,
    /// Samples inside the ball that a step aims at; the number of rays follows.
    pub samples_per_step: usize,
    /// The surface.
    pub field: SdfFieldOptions,
    /// What lies behind the ball; not used with masks.
    pub background: RadianceFieldOptions,
    /// Learning rate of the hash tables.
    pub table_learning_rate: f32,
    /// Learning rate of the networks (NeuS: 5e-4).
    pub learning_rate: f32,
    /// Learning rate of the sharpness.
    pub sharpness_learning_rate: f32,
    /// Their course.
    pub schedule: Schedule,
    /// The sharpness starts at exp(10 v) with this v (NeuS: 0.3).
    pub initial_sharpness: f32,
    /// Steps until rays must face the surface (NeuS: 50,000 of 300,000).
    pub anneal: u64,
    /// Weight of the eikonal loss (NeuS: 0.1, over samples all along the rays; here they are those near the surface). With
    /// 0.1 to the end the surface stays a skin over gaps and windows, painted with what lies behind.
    pub eikonal: f32,
    /// The same at the start, until the shape has settled.
    pub first_eikonal: f32,
    /// Steps in which it falls from the one to the other.
    pub settle: u64,
    /// Learn only what the masks show, where there are masks.
    pub use_masks: bool,
    /// Weight of the mask loss (NeuS: 0.1 with masks).
    pub mask: f32,
    /// Levels of the hash grid in use at the start.
    pub first_levels: usize,
    /// Steps between further levels.
    pub level_every: u64,
    /// Longest step inside the ball.
    pub longest_step: f32,
    /// Shortest step inside the ball.
    pub shortest_step: f32,
    /// First step of the background as a share of the distance.
    pub background_cone: f32,
    /// Farthest sample of the background.
    pub far: f32,
    /// Cells a side of both occupancy grids.
    pub occupancy: usize,
    /// Steps between refreshes of a sixteenth of the grids.
    pub occupancy_every: u64,
    /// Random numbers.
    pub seed: u64,
}

impl Default for NeusOptions {
    /// The preset `fast`.
    fn default() -> Self {
        let iterations = 6_000;
        Self {
            iterations,
            samples_per_step: 1 << 15,
            field: SdfFieldOptions {
                position: PositionEncoding::Hash(HashGridOptions {
                    levels: 8,
                    features: 4,
                    log2_entries: 17,
                    coarsest: 16,
                    finest: 512,
                }),
                direction: DirectionEncoding::Harmonics,
                width: 64,
                hidden: 1,
                skip: None,
                features: 15,
                softplus: 100.0,
                color_width: 64,
                color_hidden: 1,
                weight_norm: false,
                initial_radius: 0.5,
            },
            background: RadianceFieldOptions {
                grid: HashGridOptions { levels: 8, features: 4, log2_entries: 15, coarsest: 16, finest: 256 },
                width: 32,
                color_hidden: 1,
            },
            table_learning_rate: 2e-2,
            learning_rate: 1e-2,
            sharpness_learning_rate: 1e-3,
            schedule: Schedule::WarmExponential { warm_up: 100, end: iterations, floor: 0.03 },
            initial_sharpness: 0.3,
            anneal: iterations / 6,
            eikonal: 0.002,
            first_eikonal: 0.1,
            settle: iterations / 16,
            use_masks: true,
            mask: 0.1,
            first_levels: 3,
            level_every: iterations / 12,
            longest_step: 0.04,
            shortest_step: 0.006,
            background_cone: 1.0 / 48.0,
            far: 32.0,
            occupancy: 64,
            occupancy_every: 16,
            seed: 0,
        }
    }
}

impl NeusOptions {
    /// The preset `best`: details half as large, steps to match, four times as many samples in a step, and twice as many
    /// steps.
    pub fn best() -> Self {
        let mut options = Self { samples_per_step: 1 << 17, shortest_step: 0.004, ..Self::default() };
        options.field.position = PositionEncoding::Hash(HashGridOptions {
            levels: 10,
            features: 4,
            log2_entries: 19,
            coarsest: 16,
            finest: 1024,
        });
        options.with_iterations(12_000)
    }

    /// The same with another number of steps: everything that is counted in steps follows.
    #[must_use]
    pub fn with_iterations(mut self, iterations: u64) -> Self {
        self.iterations = iterations;
        self.schedule = Schedule::WarmExponential { warm_up: 100.min(iterations / 10), end: iterations, floor: 0.03 };
        self.anneal = iterations / 6;
        self.settle = iterations / 16;
        self.level_every = (iterations / 12).max(1);
        self
    }
}

/// A tile: its samples inside the ball and behind it, and both together ray by ray.
#[derive(Debug, Default)]
struct Tile {
    inner: RaySamples<3>,
    outer: RaySamples<3>,
    shown: RayComposites,
}

impl Tile {
    fn clear(&mut self) {
        self.inner.clear();
        self.outer.clear();
    }

    fn len(&self) -> usize {
        self.inner.len() + self.outer.len()
    }
}

#[derive(Debug, Default)]
struct Group {
    sdf: SdfWorker,
    outside: RadianceWorker,
    tile: Tile,
    rays: Vec<TargetRay>,
    backgrounds: Vec<[f32; 3]>,
    gradients: Vec<RayGradient>,
    /// Cells of the background that were sampled, and the density found.
    seen: Vec<(u32, f32)>,
    d_cosines: Vec<f32>,
    loss: f64,
    squared: f64,
    marched: usize,
    lit: usize,
    d_sharpness: f32,
}

/// What a step asks of its groups.
#[derive(Clone, Copy)]
struct Task<'a> {
    data: &'a RayDataset,
    cameras: &'a CameraResiduals,
    transposed: &'a Transposed,
    rays: usize,
    step: u64,
    move_cameras: bool,
}

/// A NeuS in training. Its state is open, for a device that trains it elsewhere.
pub struct Neus {
    /// How it is trained.
    pub options: NeusOptions,
    /// The surface.
    pub field: SdfField,
    /// What lies behind the ball.
    pub outside: RadianceField,
    /// What was learned of it.
    pub outside_parameters: RadianceParameters,
    /// v, with sharpness s = exp(10 v).
    pub sharpness: Parameters,
    /// Where the surface may be, in the ball.
    pub inner_cells: OccupancyGrid,
    /// Where matter may be, in contracted space.
    pub outer_cells: OccupancyGrid,
    /// Running mean of the samples of a ray inside the ball (one number).
    pub samples_per_ray: Vec<f32>,
    groups: Vec<Group>,
    /// Whether it learns only the object.
    pub with_masks: bool,
}

/// Light below which the rest of a ray is dropped.
pub const DARK: f32 = 1e-3;
/// Largest product of sharpness and shortest step. Training goes wrong from about 2.5 on.
const SHARPNESS_OF_STEP: f32 = 2.0;
/// Half width of the logistic density in units of 1 / s: beyond it lies less than a thousandth of the step.
const REACH: f32 = 7.0;
/// Shortest step behind the ball.
pub const SHORTEST_OUTER_STEP: f32 = 0.02;
/// Random points of the ball in each group, for the eikonal loss alone.
pub const FREE_POINTS: usize = 32;

impl Neus {
    /// A NeuS at its start. Masks are used where the data has them and the options want them.
    pub fn new(options: NeusOptions, data: &RayDataset) -> Self {
        let mut rng = rng(options.seed, u64::MAX);
        let field = SdfField::new(options.field.clone(), &mut rng);
        let outside = RadianceField::new(&options.background);
        let mut outer_cells = OccupancyGrid::new(options.occupancy);
        outer_cells.close(|center, half| data.seen_by(center, half, 0.5) >= 2);
        let mut neus = Self {
            outside_parameters: outside.init(&mut rng),
            sharpness: Parameters::new(vec![options.initial_sharpness]),
            inner_cells: OccupancyGrid::new(options.occupancy),
            outer_cells,
            samples_per_ray: vec![64.0],
            groups: (0..GROUPS).map(|_| Group::default()).collect(),
            with_masks: options.use_masks && data.has_masks(),
            field,
            outside,
            options,
        };
        neus.set_levels(0);
        neus
    }

    /// Puts the levels into use that belong to a step.
    pub fn set_levels(&mut self, step: u64) {
        let more = step / self.options.level_every.max(1);
        self.field.active_levels = (self.options.first_levels + more as usize).min(self.field.levels());
    }

    /// Sharpness s of the logistic density, per radius.
    pub fn sharpness(&self) -> f32 {
        (10.0 * self.sharpness.values[0]).clamp(-10.0, 12.0).exp()
    }

    /// One Adam step of the sharpness, number `t` from 1, given the loss's derivative by it: ds/dv = 10 s. It stays where the
    /// shortest step can follow: sections see a narrower density as a jump, and between two of them light leaks through.
    pub fn step_sharpness(&mut self, d_sharpness: f32, t: u64) {
        self.sharpness.grads[0] = d_sharpness * 10.0 * self.sharpness();
        self.sharpness.step(&ADAM, self.options.sharpness_learning_rate, t);
        let most = SHARPNESS_OF_STEP / self.options.shortest_step;
        self.sharpness.values[0] = self.sharpness.values[0].min(most.ln() / 10.0);
    }

    /// How far rays must face the surface: r of [`crate::neus_alpha`].
    pub fn anneal(&self, step: u64) -> f32 {
        if self.options.anneal == 0 { 1.0 } else { (step as f32 / self.options.anneal as f32).min(1.0) }
    }

    /// Weight of the eikonal loss: from the first to the last in equal factors.
    pub fn eikonal_weight(&self, step: u64) -> f32 {
        let o = &self.options;
        let settled = (step as f32 / o.settle.max(1) as f32).min(1.0);
        o.first_eikonal.powf(1.0 - settled) * o.eikonal.powf(settled)
    }

    /// Distance from the surface within which a cell of the inner grid counts.
    fn band(&self) -> f32 {
        let cell = 2.0 / self.options.occupancy as f32;
        REACH / self.sharpness() + cell * 3f32.sqrt()
    }

    /// Rays of each group of the next step.
    pub fn rays_of_group(&self) -> usize {
        let wanted = self.options.samples_per_step as f32 / self.samples_per_ray[0].max(1.0);
        // Where rays have few samples, their number is bounded too.
        let most = (self.options.samples_per_step / 8 / GROUPS).max(128);
        (wanted as usize / GROUPS).clamp(8, most)
    }

    /// Notes how many samples inside the ball a step took on so many rays.
    pub fn count_samples(&mut self, samples: usize, rays: usize) {
        self.samples_per_ray[0] += 0.1 * (samples as f32 / rays as f32 - self.samples_per_ray[0]);
    }

    /// Length of a step inside the ball.
    pub fn inner_step(&self) -> f32 {
        (1.0 / self.sharpness()).clamp(self.options.shortest_step, self.options.longest_step)
    }

    /// Where samples begin behind the ball, given where a ray enters and leaves it.
    pub fn outer_start(ball: Option<(f32, f32)>) -> f32 {
        ball.map_or(0.5, |(_, far)| far)
    }

    fn march(&self, ray: &SceneRay, jitter: f32, tile: &mut Tile) {
        let o = &self.options;
        let ball = ray.ball(1.0);
        if let Some((near, far)) = ball {
            let dt = self.inner_step();
            let mut t = near + jitter * dt;
            while t < far {
                let p = ray.at(t);
                if self.inner_cells.is_occupied(p.map(|c| 0.5 * c + 0.5)) {
                    tile.inner.push(p, t, dt);
                }
                t += dt;
            }
        }
        if !self.with_masks {
            let start = Self::outer_start(ball);
            let step = |t: f32| (t * o.background_cone).max(SHORTEST_OUTER_STEP);
            let mut t = start + jitter * step(start);
            while t < o.far {
                let dt = step(t);
                let u = contract(ray.at(t));
                if self.outer_cells.is_occupied(u) {
                    tile.outer.push(u, t, dt);
                }
                t += dt;
            }
        }
        tile.inner.end_ray(ray.direction);
        tile.outer.end_ray(ray.direction);
    }

    /// Computes everything of a tile: distances, normals, opacities, colours, composites.
    fn shade(
        &self,
        tile: &mut Tile,
        sdf: &mut SdfWorker,
        outside: &mut RadianceWorker,
        backgrounds: &[[f32; 3]],
        anneal: f32,
    ) {
        let s = self.sharpness();
        let Tile { inner, outer, shown } = tile;
        self.field.distance(&inner.positions, sdf);
        // Judged by the drop of the logistic function between neighbours, which needs no normals.
        let passed = |i: usize, next: Option<usize>| match next {
            Some(next) => {
                let (p, q) = (sigmoid(s * sdf.sdf[i]), sigmoid(s * sdf.sdf[next]));
                ((q + 1e-5) / (p + 1e-5)).min(1.0)
            }
            None => 1.0,
        };
        if let Some(keep) = inner.drop_dark(DARK, passed) {
            self.field.compact(keep, sdf);
        }
        self.field.normals(sdf);
        self.field.color(&inner.runs, sdf);
        if !self.with_masks {
            self.outside.density(&self.outside_parameters, &outer.positions, outside);
            self.outside.color(&self.outside_parameters, &outer.runs, outside);
        }
        shown.clear();
        let runs = inner.ranges().zip(&inner.runs).zip(outer.ranges());
        for (((surface, (_, direction)), behind), background) in runs.zip(backgrounds) {
            for i in surface {
                shown.push(section(sdf, i, inner.lengths[i], *direction).alpha(s, anneal), sdf.rgb[i]);
            }
            for i in behind {
                shown.push(opacity(outside.sigma[i], outer.lengths[i]), outside.rgb[i]);
            }
            shown.end_ray(*background);
        }
    }

    fn run_group(&self, task: &Task<'_>, rng: &mut Rng, group: &mut Group) {
        let (rays, anneal, eikonal_weight) = (task.rays, self.anneal(task.step), self.eikonal_weight(task.step));
        task.data.draw(rng, rays, task.cameras, &mut group.rays);
        (group.loss, group.squared, group.d_sharpness) = (0.0, 0.0, 0.0);
        (group.marched, group.lit) = (0, 0);
        group.gradients.clear();
        let mut next = 0;
        while next < group.rays.len() {
            let first = next;
            group.tile.clear();
            group.backgrounds.clear();
            while next < group.rays.len() && group.tile.len() < TILE {
                let background = if self.with_masks { [0.0; 3] } else { std::array::from_fn(|_| rng.random()) };
                group.backgrounds.push(background);
                self.march(&group.rays[next].ray, rng.random(), &mut group.tile);
                next += 1;
            }
            group.marched += group.tile.inner.len();
            let Group { sdf, outside, tile, backgrounds, seen, .. } = group;
            self.shade(tile, sdf, outside, backgrounds, anneal);
            group.lit += tile.inner.len();
            let cells = tile.outer.positions.iter().map(|u| self.outer_cells.cell(*u) as u32);
            seen.extend(cells.zip(outside.sigma.iter().copied()));
            self.losses(group, first..next, rays);
            self.send_back(group, anneal, eikonal_weight, rays);
            if !self.with_masks {
                let Group { outside, tile, .. } = &mut *group;
                self.outside.backward(&self.outside_parameters, task.transposed, &tile.outer.positions, outside);
            }
            self.field.backward(&mut group.sdf);
            if task.move_cameras {
                self.ray_gradients(group, first..next);
            }
        }
        self.free_points(rng, eikonal_weight, group);
    }

    /// What the losses ask of the tile's rays: through the samples' positions (their distances stay), the encoded
    /// direction, and the cosine between direction and normal.
    fn ray_gradients(&self, group: &mut Group, range: std::ops::Range<usize>) {
        let Group { sdf, outside, tile: Tile { inner, outer, .. }, rays, gradients, d_cosines, .. } = group;
        self.field.ray_gradients(&inner.runs, sdf);
        if !self.with_masks {
            self.outside.ray_gradients(&self.outside_parameters, &outer.positions, &outer.runs, outside);
        }
        let runs = inner.ranges().zip(outer.ranges());
        for (ray, (target, (surface, behind))) in rays[range].iter().zip(runs).enumerate() {
            let mut gradient = surface_ray_gradient(sdf, ray, surface, &inner.depths, d_cosines);
            if !self.with_masks {
                for d in 0..3 {
                    gradient.direction[d] += outside.d_directions[ray][d];
                }
                for i in behind {
                    let t = outer.depths[i];
                    gradient.add_point(t, contract_gradient(target.ray.at(t), outside.d_positions[i]));
                }
            }
            gradients.push(gradient);
        }
    }

    /// The loss of each ray, and its derivatives with respect to opacities and colours.
    fn losses(&self, group: &mut Group, range: std::ops::Range<usize>, rays: usize) {
        let scale = 1.0 / (rays * GROUPS) as f32;
        let shown = &mut group.tile.shown;
        for (i, target) in group.rays[range].iter().enumerate() {
            let found = shown.rays[i];
            let mask = target.mask.filter(|_| self.with_masks);
            let wanted = target.rgb.map(|c| c * mask.unwrap_or(1.0));
            let error: [f32; 3] = std::array::from_fn(|c| found.rgb[c] - wanted[c]);
            group.squared += error.iter().map(|e| f64::from(e * e)).sum::<f64>();
            group.loss += error.iter().map(|e| f64::from(e.abs())).sum::<f64>() / 3.0;
            let (loss, pull) = mask.map_or((0.0, 0.0), |mask| mask_loss(found.transmittance, mask));
            group.loss += f64::from(self.options.mask * loss);
            let gradient = CompositeGradient {
                d_rgb: error.map(|e| e.signum() * scale / 3.0),
                d_transmittance: self.options.mask * scale * pull,
            };
            shown.send_back(i, &gradient);
        }
    }

    /// From opacities and colours back to distance, normal, sharpness, density; adds the eikonal loss.
    fn send_back(&self, group: &mut Group, anneal: f32, eikonal_weight: f32, rays: usize) {
        let s = self.sharpness();
        let Group { sdf, outside, tile: Tile { inner, outer, shown }, d_cosines, .. } = group;
        d_cosines.clear();
        let samples = rays as f32 * GROUPS as f32 * self.samples_per_ray[0].max(1.0);
        for d in [&mut sdf.d_rgb, &mut sdf.d_normals] {
            d.clear();
        }
        sdf.d_sdf.clear();
        outside.d_sigma.clear();
        outside.d_rgb.clear();
        let mut at = 0;
        for ((surface, (_, direction)), behind) in inner.ranges().zip(&inner.runs).zip(outer.ranges()) {
            for i in surface {
                let derivative = section(sdf, i, inner.lengths[i], *direction).gradient(s, anneal);
                let d_alpha = shown.d_alphas[at];
                sdf.d_sdf.push(d_alpha * derivative.sdf);
                group.d_sharpness += d_alpha * derivative.sharpness;
                let (loss, pull) = eikonal(sdf.normals[i], eikonal_weight / samples);
                group.loss += f64::from(loss) * (rays * GROUPS) as f64;
                let d_cosine = d_alpha * derivative.cosine;
                sdf.d_normals.push(std::array::from_fn(|d| d_cosine * direction[d] + pull[d]));
                d_cosines.push(d_cosine);
                sdf.d_rgb.push(shown.d_colors[at]);
                at += 1;
            }
            for i in behind {
                outside.d_sigma.push(shown.d_alphas[at] * outer.lengths[i] * (1.0 - shown.alphas[at]));
                outside.d_rgb.push(shown.d_colors[at]);
                at += 1;
            }
        }
    }

    /// The eikonal loss at random points of the ball.
    fn free_points(&self, rng: &mut Rng, eikonal_weight: f32, group: &mut Group) {
        let points: Vec<[f32; 3]> =
            (0..FREE_POINTS).map(|_| std::array::from_fn(|_| rng.random_range(-1.0..1.0f32))).collect();
        let sdf = &mut group.sdf;
        self.field.distance(&points, sdf);
        self.field.normals(sdf);
        let weight = eikonal_weight / (FREE_POINTS * GROUPS) as f32;
        sdf.d_normals.clear();
        sdf.d_normals.extend(sdf.normals.iter().map(|n| eikonal(*n, weight).1));
        sdf.d_sdf.clear();
        sdf.d_sdf.resize(FREE_POINTS, 0.0);
        sdf.d_rgb.clear();
        self.field.backward(sdf);
    }

    fn refresh_cells(&mut self, turn: u64) {
        let all = looks_everywhere(turn);
        let [inner_seed, outer_seed] = self.cell_seeds();
        let field = &self.field;
        // The distance is known at once: nothing is remembered.
        self.inner_cells.update(inner_seed, turn, all, 0.0, |units, out| {
            let mut worker = SdfWorker::default();
            for tile in units.chunks(TILE) {
                let tile: Vec<[f32; 3]> = tile.iter().map(|u| u.map(|c| 2.0 * c - 1.0)).collect();
                field.distance(&tile, &mut worker);
                out.extend(worker.sdf.iter().map(|f| nearness(*f)));
            }
        });
        if !self.with_masks {
            let (outside, parameters) = (&self.outside, &self.outside_parameters);
            self.outer_cells.update(outer_seed, turn, all, CELL_MEMORY, |units, out| {
                let mut worker = RadianceWorker::default();
                for tile in units.chunks(TILE) {
                    outside.density(parameters, tile, &mut worker);
                    out.extend_from_slice(&worker.sigma);
                }
            });
        }
        self.decide();
    }

    /// The random numbers of a refresh of the inner and of the outer cells.
    pub fn cell_seeds(&self) -> [u64; 2] {
        [self.options.seed ^ 0x696e, self.options.seed ^ 0x6f75]
    }

    /// Decides which cells count, from what was found in them.
    pub fn decide(&mut self) {
        self.inner_cells.decide(nearness(self.band()));
        self.outer_cells.decide(self.outer_cells.mean().min(0.5));
    }
}

/// What a cell of the inner grid keeps of a distance.
pub fn nearness(sdf: f32) -> f32 {
    1.0 / (sdf.abs() + 1e-3)
}

pub(crate) fn section(sdf: &SdfWorker, i: usize, dt: f32, direction: [f32; 3]) -> Section {
    let n = sdf.normals[i];
    Section { sdf: sdf.sdf[i], cosine: n[0] * direction[0] + n[1] * direction[1] + n[2] * direction[2], dt }
}

/// `weight (|n| - 1)^2` and its derivative with respect to n.
pub(crate) fn eikonal(n: [f32; 3], weight: f32) -> (f32, [f32; 3]) {
    let norm = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt().max(1e-6);
    (weight * (norm - 1.0) * (norm - 1.0), n.map(|c| 2.0 * weight * (norm - 1.0) / norm * c))
}

/// How badly the light that passes a ray fits its mask: the binary cross-entropy of `1 - transmittance`, and its derivative by
/// the transmittance.
pub(crate) fn mask_loss(transmittance: f32, mask: f32) -> (f32, f32) {
    let cover = (1.0 - transmittance).clamp(1e-3, 1.0 - 1e-3);
    (-(mask * cover.ln() + (1.0 - mask) * (1.0 - cover).ln()), mask / cover - (1.0 - mask) / (1.0 - cover))
}

/// What the losses ask of ray number `ray` through its samples of the surface.
pub(crate) fn surface_ray_gradient(
    sdf: &SdfWorker,
    ray: usize,
    samples: std::ops::Range<usize>,
    depths: &[f32],
    d_cosines: &[f32],
) -> RayGradient {
    let mut gradient = RayGradient { origin: [0.0; 3], direction: sdf.d_directions[ray] };
    for i in samples {
        gradient.add_point(depths[i], sdf.d_positions[i]);
        for d in 0..3 {
            gradient.direction[d] += d_cosines[i] * sdf.normals[i][d];
        }
    }
    gradient
}

impl Model for Neus {
    fn name(&self) -> &'static str {
        "neus"
    }

    fn only_object(&self) -> bool {
        self.with_masks
    }

    fn iterations(&self) -> u64 {
        self.options.iterations
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        self.set_levels(step);
        let rays = self.rays_of_group();
        let transposed = self.outside.transpose(&self.outside_parameters);
        let move_cameras = cameras.wants_gradients(step);
        let task = Task { data, cameras, transposed: &transposed, rays, step, move_cameras };
        let mut groups = std::mem::take(&mut self.groups);
        groups.par_iter_mut().enumerate().for_each(|(i, group)| {
            let mut rng = rng(self.options.seed, step * GROUPS as u64 + i as u64);
            self.run_group(&task, &mut rng, group);
        });
        self.field.collect(groups.iter_mut().map(|g| &mut g.sdf));
        if !self.with_masks {
            self.outside.collect(&mut self.outside_parameters, groups.iter_mut().map(|g| &mut g.outside));
        }
        if move_cameras {
            cameras.add(data, groups.iter().flat_map(|g| g.rays.iter().zip(&g.gradients)));
            cameras.step(data, self.options.schedule.factor(step + 1), step);
        }
        let n = (rays * GROUPS) as f64;
        let loss = groups.iter().map(|g| g.loss).sum::<f64>() / n;
        let mse = groups.iter().map(|g| g.squared).sum::<f64>() / (3.0 * n);
        let samples = groups.iter().map(|g| g.marched).sum::<usize>();
        let lit = groups.iter().map(|g| g.lit).sum();
        let d_sharpness = groups.iter().map(|g| g.d_sharpness).sum();
        for group in &mut groups {
            self.outer_cells.raise(&group.seen);
            group.seen.clear();
        }
        self.groups = groups;
        let factor = self.options.schedule.factor(step + 1);
        let (table, network) = (self.options.table_learning_rate * factor, self.options.learning_rate * factor);
        self.field.step(&ADAM, table, network, step + 1);
        self.step_sharpness(d_sharpness, step + 1);
        if !self.with_masks {
            self.outside_parameters.step(table, step + 1);
        }
        self.count_samples(samples, rays * GROUPS);
        if (step + 1).is_multiple_of(self.options.occupancy_every) {
            self.refresh_cells((step + 1) / self.options.occupancy_every);
        }
        Ok(StepReport { loss, mse, rays: rays * GROUPS, samples, lit })
    }

    fn render(&self, rays: &[SceneRay]) -> Vec<[f32; 3]> {
        let parts: Vec<Vec<[f32; 3]>> = rays
            .par_chunks(64)
            .map(|rays| {
                let mut group = Group::default();
                let mut out = Vec::with_capacity(rays.len());
                let mut first = 0;
                while first < rays.len() {
                    group.tile.clear();
                    let mut next = first;
                    while next < rays.len() && group.tile.len() < TILE {
                        self.march(&rays[next], 0.5, &mut group.tile);
                        next += 1;
                    }
                    let black = vec![[0.0; 3]; next - first];
                    self.shade(&mut group.tile, &mut group.sdf, &mut group.outside, &black, 1.0);
                    out.extend(group.tile.shown.rays.iter().map(|c| c.rgb));
                    first = next;
                }
                out
            })
            .collect();
        parts.concat()
    }

    fn level(&self) -> Level {
        Level { value: 0.0, larger_inside: false }
    }

    fn surface(&self, positions: &[[f32; 3]]) -> Vec<f32> {
        self.field.distances(positions)
    }

    fn may_cross(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        let unit = |p: [f32; 3]| p.map(|c| 0.5 * c + 0.5);
        self.inner_cells.any_occupied(unit(low), unit(high))
    }

    fn color_at(&self, positions: &[[f32; 3]], directions: &[[f32; 3]]) -> Vec<[f32; 3]> {
        self.field.colors(positions, directions)
    }

    fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        let mut all = self.field.buffers();
        all.extend(self.outside_parameters.buffers());
        all.extend([&mut self.sharpness.values, &mut self.sharpness.m, &mut self.sharpness.v]);
        all.extend(self.inner_cells.buffers());
        all.extend(self.outer_cells.buffers());
        all.push(&mut self.samples_per_ray);
        all
    }

    fn restored(&mut self, step: u64) -> std::result::Result<(), String> {
        let mut lengths = self.field.lengths();
        lengths.extend(self.outside_parameters.lengths());
        lengths.extend([1, 1, 1]);
        lengths.extend(self.inner_cells.lengths());
        lengths.extend(self.outer_cells.lengths());
        lengths.push(1);
        same_lengths(&self.buffers(), &lengths)?;
        self.field.refresh();
        self.set_levels(step);
        self.inner_cells.restored();
        self.outer_cells.restored();
        Ok(())
    }

    fn is_finite(&self) -> bool {
        self.field.is_finite() && self.outside_parameters.is_finite() && self.sharpness.is_finite()
    }

    fn parameter_count(&self) -> usize {
        let outside = if self.with_masks { 0 } else { self.outside.parameter_count() };
        self.field.parameter_count() + outside + 1
    }

    fn bytes(&self) -> usize {
        let o = &self.options;
        16 * self.parameter_count() + 12 * o.occupancy.pow(3) + 2 * o.samples_per_step * self.field.bytes_per_sample()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_of_normals_and_masks_have_the_derivatives_of_finite_differences() {
        let n = [0.3f32, -0.9, 0.4];
        let h = 1e-3;
        for d in 0..3 {
            let at = |h: f32| {
                let mut n = n;
                n[d] += h;
                n
            };
            let slope = |loss: &dyn Fn([f32; 3]) -> f32| (loss(at(h)) - loss(at(-h))) / (2.0 * h);
            assert!((eikonal(n, 0.7).1[d] - slope(&|n| eikonal(n, 0.7).0)).abs() < 1e-3);
        }
        for (transmittance, mask) in [(0.3, 1.0), (0.6, 0.25), (0.9, 0.0)] {
            let slope = (mask_loss(transmittance + h, mask).0 - mask_loss(transmittance - h, mask).0) / (2.0 * h);
            assert!((mask_loss(transmittance, mask).1 - slope).abs() < 1e-3 * slope.abs().max(1.0));
        }
    }
}
