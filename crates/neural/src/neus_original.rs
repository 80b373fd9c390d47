//! The original NeuS (Wang et al. 2021; `neus --preset paper`): a signed distance in a deep network, sampled where it
//! crosses zero.
//!
//! A ray has `samples` even samples over the two radii around its point nearest to the centre. Four rounds add a quarter
//! of `importance` each, drawn from the weights that the distances would have under a logistic density of sharpness 64,
//! 128, 256, 512. Opacities are taken at the middle of each section ([`crate::neus_alpha`]). Without masks, sections
//! outside the unit ball and `outside` further samples, even in inverse distance, belong to a NeRF++ background, whose
//! network sees a unit direction and an inverse distance.
//!
//! The loss is `sum_rgb |C - C*| + eikonal * mean (|n| - 1)^2 + mask * BCE(sum w, mask)`, the second over sections within
//! 1.2 radii. Nothing is sent back through the places of the samples.

use mb_job::{Result, Rng, rng};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::adam::{AdamOptions, Parameters, Schedule};
use crate::cameras::{CameraResiduals, RayGradient};
use crate::composite::{CompositeGradient, RayComposites, opacity};
use crate::dataset::{RayDataset, SceneRay, TargetRay};
use crate::frequency_field::{
    DensityActivation, FrequencyField, FrequencyFieldOptions, FrequencyParameters, FrequencyTransposed, FrequencyWorker,
};
use crate::model::{GROUPS, Level, Model, StepReport, same_lengths};
use crate::neus::{eikonal, mask_loss, section, surface_ray_gradient};
use crate::ray_samples::RaySamples;
use crate::sampling::importance;
use crate::sdf_field::{SdfField, SdfFieldOptions, SdfWorker};
use crate::simd::sigmoid;

/// How an original NeuS is trained. "NeuS" names the paper and the authors' `confs/wmask.conf`, `confs/womask.conf`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NeusOriginalOptions {
    /// Steps (NeuS: 300,000).
    pub iterations: u64,
    /// Rays of a step (NeuS: 512).
    pub rays: usize,
    /// Even samples (NeuS: 64).
    pub samples: usize,
    /// Further samples, over all rounds (NeuS: 64).
    pub importance: usize,
    /// Rounds (NeuS: 4).
    pub rounds: usize,
    /// Samples of the background, where there are no masks (NeuS: 32).
    pub outside: usize,
    /// The surface.
    pub field: SdfFieldOptions,
    /// The background.
    pub background: FrequencyFieldOptions,
    /// Learning rate (NeuS: 5e-4).
    pub learning_rate: f32,
    /// Its course (NeuS: 5,000 steps of warm-up, then a cosine to 0.05).
    pub schedule: Schedule,
    /// The sharpness starts at exp(10 v) with this v (NeuS: 0.3).
    pub initial_sharpness: f32,
    /// Steps until rays must face the surface (NeuS: 50,000 without masks, 0 with).
    pub anneal: u64,
    /// Weight of the eikonal loss (NeuS: 0.1).
    pub eikonal: f32,
    /// Weight of the mask loss (NeuS: 0.1 with masks).
    pub mask: f32,
    /// Learn only what the masks show, where there are masks.
    pub use_masks: bool,
    /// Random numbers.
    pub seed: u64,
}

impl NeusOriginalOptions {
    /// The paper's numbers.
    pub fn paper() -> Self {
        Self {
            iterations: 300_000,
            rays: 512,
            samples: 64,
            importance: 64,
            rounds: 4,
            outside: 32,
            field: SdfFieldOptions::paper(),
            background: FrequencyFieldOptions {
                activation: DensityActivation::Softplus,
                ..FrequencyFieldOptions::PAPER
            },
            learning_rate: 5e-4,
            schedule: Schedule::WarmCosine { warm_up: 5_000, end: 300_000, floor: 0.05 },
            initial_sharpness: 0.3,
            anneal: 50_000,
            eikonal: 0.1,
            mask: 0.1,
            use_masks: true,
            seed: 0,
        }
    }

    /// The same with another number of steps: warm-up, schedule and annealing follow.
    #[must_use]
    pub fn with_iterations(mut self, iterations: u64) -> Self {
        let scale = |n: u64| (n as f64 * iterations as f64 / self.iterations.max(1) as f64).round() as u64;
        if let Schedule::WarmCosine { warm_up, floor, .. } = self.schedule {
            self.schedule = Schedule::WarmCosine { warm_up: scale(warm_up), end: iterations, floor };
        }
        self.anneal = scale(self.anneal);
        self.iterations = iterations;
        self
    }
}

/// Where a section of a ray takes its opacity and colour from.
#[derive(Debug, Clone, Copy)]
enum Slot {
    Inner(usize),
    Outer(usize),
}

/// Sections of a tile: those that the surface is asked for, those of the background, and which of them each ray shows.
#[derive(Debug, Default)]
struct Tile {
    inner: RaySamples<3>,
    outer: RaySamples<4>,
    slots: Vec<Slot>,
    /// Slots of each ray.
    counts: Vec<usize>,
    shown: RayComposites,
}

#[derive(Debug, Default)]
struct Group {
    sdf: SdfWorker,
    /// For the rounds of sampling, which send nothing back.
    probe: SdfWorker,
    outside: FrequencyWorker<4>,
    tile: Tile,
    rays: Vec<TargetRay>,
    gradients: Vec<RayGradient>,
    d_cosines: Vec<f32>,
    loss: f64,
    squared: f64,
    samples: usize,
    d_sharpness: f32,
}

/// An original NeuS in training. Its state is open, for a device that trains it elsewhere.
pub struct NeusOriginal {
    /// How it is trained.
    pub options: NeusOriginalOptions,
    /// The surface.
    pub field: SdfField,
    /// The sizes of the background.
    pub outside: FrequencyField<4>,
    /// What the background has learned.
    pub outside_parameters: FrequencyParameters,
    /// v, with sharpness s = exp(10 v).
    sharpness: Parameters,
    groups: Vec<Group>,
    /// Only the object, before black; else with a background.
    pub with_masks: bool,
}

/// Rays that go through the networks at once, and share the eikonal loss.
pub const TILE_RAYS: usize = 4;
/// Reach of the eikonal loss around the centre, in radii (the authors' code).
pub const RELAXED: f32 = 1.2;
/// Adam's constants, PyTorch's.
pub const ADAM: AdamOptions = AdamOptions { beta1: 0.9, beta2: 0.999, epsilon: 1e-8, skip_untouched: false };

impl NeusOriginal {
    /// A NeuS at its start.
    pub fn new(options: NeusOriginalOptions, data: &RayDataset) -> Self {
        let mut rng = rng(options.seed, u64::MAX);
        let field = SdfField::new(options.field.clone(), &mut rng);
        let outside = FrequencyField::new(&options.background);
        Self {
            outside_parameters: outside.init(&mut rng),
            sharpness: Parameters::new(vec![options.initial_sharpness]),
            groups: (0..GROUPS).map(|_| Group::default()).collect(),
            with_masks: options.use_masks && data.has_masks(),
            field,
            outside,
            options,
        }
    }

    /// s.
    pub fn sharpness(&self) -> f32 {
        (10.0 * self.sharpness.values[0]).exp().clamp(1e-6, 1e6)
    }

    /// How far rays must face the surface, 0 to 1.
    pub fn anneal(&self, step: u64) -> f32 {
        // The authors anneal only without masks.
        let over = if self.with_masks { 0 } else { self.options.anneal };
        if over == 0 { 1.0 } else { (step as f32 / over as f32).min(1.0) }
    }

    /// Adam step number `t` of the sharpness, given the loss's derivative by s.
    pub fn step_sharpness(&mut self, d_sharpness: f32, lr: f32, t: u64) {
        // ds/dv = 10 s.
        self.sharpness.grads[0] = d_sharpness * 10.0 * self.sharpness();
        self.sharpness.step(&ADAM, lr, t);
    }

    /// Rays of each group of a step.
    pub fn rays_of_group(&self) -> usize {
        self.options.rays.div_ceil(GROUPS)
    }

    /// Even starts of a ray's sections around its point nearest to the centre.
    pub fn even_depths(&self, ray: &SceneRay, rng: Option<&mut Rng>) -> Vec<f32> {
        let n = self.options.samples;
        let shift = rng.map_or(0.0, |rng| (rng.random::<f32>() - 0.5) * 2.0 / n as f32);
        let even = |i: usize| middle(ray) - 1.0 + 2.0 * i as f32 / (n - 1).max(1) as f32 + shift;
        (0..n).map(even).collect()
    }

    /// Starts of a ray's sections behind the ball: even in inverse distance, ascending in distance, each shifted inside the
    /// half-way marks to its neighbours. None with masks.
    pub fn outside_depths(&self, ray: &SceneRay, mut rng: Option<&mut Rng>) -> Vec<f32> {
        let n = if self.with_masks { 0 } else { self.options.outside };
        let even = |i: f32| 1e-3 + (1.0 - 1.0 / (n as f32 + 1.0) - 1e-3) * i / n.saturating_sub(1).max(1) as f32;
        let shifted = (0..n).rev().map(|i| {
            let (low, high) = (even((i as f32 - 0.5).max(0.0)), even((i as f32 + 0.5).min((n - 1) as f32)));
            let u = match rng.as_mut() {
                Some(rng) => low + (high - low) * rng.random::<f32>(),
                None => even(i as f32),
            };
            (middle(ray) + 1.0) / u + 1.0 / self.options.samples as f32
        });
        shifted.collect()
    }

    /// Ascending starts of a ray's sections: even ones, then the rounds.
    pub fn depths(&self, ray: &SceneRay, rng: Option<&mut Rng>, probe: &mut SdfWorker) -> Vec<f32> {
        let o = &self.options;
        let mut depths = self.even_depths(ray, rng);
        let mut sdf = self.probed(ray, &depths, probe);
        for round in 0..o.rounds {
            let weights = round_weights(ray, &depths, &sdf, round_sharpness(round));
            let mut more = Vec::new();
            importance(&depths, &weights, o.importance / o.rounds, None, &mut more);
            let found = if round + 1 < o.rounds { self.probed(ray, &more, probe) } else { vec![0.0; more.len()] };
            let mut both: Vec<(f32, f32)> =
                depths.iter().copied().zip(sdf).chain(more.into_iter().zip(found)).collect();
            both.sort_by(|a, b| a.0.total_cmp(&b.0));
            (depths, sdf) = both.into_iter().unzip();
        }
        depths
    }

    fn probed(&self, ray: &SceneRay, depths: &[f32], probe: &mut SdfWorker) -> Vec<f32> {
        let positions: Vec<[f32; 3]> = depths.iter().map(|t| ray.at(*t)).collect();
        self.field.distance(&positions, probe);
        probe.sdf.clone()
    }

    /// Adds a ray's sections to the tile.
    fn place(&self, ray: &SceneRay, mut rng: Option<&mut Rng>, probe: &mut SdfWorker, tile: &mut Tile) {
        let o = &self.options;
        let mut starts = self.depths(ray, rng.as_deref_mut(), probe);
        let last = 2.0 / o.samples as f32;
        let inner_sections = starts.len();
        starts.extend(self.outside_depths(ray, rng));
        for (i, start) in starts.iter().enumerate() {
            let dt = starts.get(i + 1).map_or(last, |next| next - start);
            let t = start + 0.5 * dt;
            let p = ray.at(t);
            let norm = p.iter().map(|c| c * c).sum::<f32>().sqrt();
            let shows_surface = i < inner_sections && (self.with_masks || norm < 1.0);
            if i < inner_sections && (self.with_masks || norm < RELAXED) {
                tile.inner.push(p, t, dt);
            }
            if shows_surface {
                tile.slots.push(Slot::Inner(tile.inner.len() - 1));
            } else {
                let norm = norm.max(1.0);
                tile.slots.push(Slot::Outer(tile.outer.len()));
                tile.outer.push([p[0] / norm, p[1] / norm, p[2] / norm, 1.0 / norm], t, dt);
            }
        }
        tile.inner.end_ray(ray.direction);
        tile.outer.end_ray(ray.direction);
        tile.counts.push(starts.len());
    }

    /// Samples and renders some rays into the group's tile.
    fn shade(&self, rays: &[SceneRay], mut rng: Option<&mut Rng>, anneal: f32, group: &mut Group) {
        let Group { sdf, probe, outside, tile, .. } = group;
        tile.inner.clear();
        tile.outer.clear();
        tile.slots.clear();
        tile.counts.clear();
        tile.shown.clear();
        for ray in rays {
            self.place(ray, rng.as_deref_mut(), probe, tile);
        }
        let s = self.sharpness();
        let Tile { inner, outer, slots, counts, shown } = tile;
        self.field.distance(&inner.positions, sdf);
        self.field.normals(sdf);
        self.field.color(&inner.runs, sdf);
        self.outside.density(&self.outside_parameters, &outer.positions, outside);
        self.outside.color(&self.outside_parameters, &outer.runs, outside);
        let mut at = 0;
        for (ray, count) in rays.iter().zip(counts) {
            for slot in &slots[at..at + *count] {
                match *slot {
                    Slot::Inner(i) => {
                        let section = section(sdf, i, inner.lengths[i], ray.direction);
                        shown.push(section.alpha(s, anneal), sdf.rgb[i]);
                    }
                    Slot::Outer(i) => shown.push(opacity(outside.sigma[i], outer.lengths[i]), outside.rgb[i]),
                }
            }
            shown.end_ray([0.0; 3]);
            at += *count;
        }
    }

    fn run_group(
        &self,
        data: &RayDataset,
        cameras: &CameraResiduals,
        step: u64,
        transposed: &FrequencyTransposed,
        rng: &mut Rng,
        group: &mut Group,
    ) {
        let rays = self.rays_of_group();
        let anneal = self.anneal(step);
        data.draw(rng, rays, cameras, &mut group.rays);
        (group.loss, group.squared, group.samples, group.d_sharpness) = (0.0, 0.0, 0, 0.0);
        group.gradients.clear();
        for first in (0..rays).step_by(TILE_RAYS) {
            let range = first..(first + TILE_RAYS).min(rays);
            let tile: Vec<SceneRay> = group.rays[range.clone()].iter().map(|t| t.ray).collect();
            self.shade(&tile, Some(rng), anneal, group);
            group.samples += group.tile.slots.len();
            self.losses(group, range.clone(), 1.0 / (rays * GROUPS) as f32);
            self.send_back(group, &tile, anneal, 1.0 / (rays * GROUPS) as f32);
            self.outside.backward(&self.outside_parameters, transposed, &mut group.outside);
            self.field.backward(&mut group.sdf);
            if cameras.wants_gradients(step) {
                self.ray_gradients(group, range);
            }
        }
    }

    /// The loss of each ray, and its derivatives with respect to opacities and colours.
    fn losses(&self, group: &mut Group, range: std::ops::Range<usize>, scale: f32) {
        let shown = &mut group.tile.shown;
        for (i, target) in group.rays[range].iter().enumerate() {
            let found = shown.rays[i];
            let mask = target.mask.filter(|_| self.with_masks);
            // With masks only rays through the object count for the colour, as the authors weigh them.
            let share = mask.unwrap_or(1.0);
            let error: [f32; 3] = std::array::from_fn(|c| (found.rgb[c] - target.rgb[c]) * share);
            group.squared += error.iter().map(|e| f64::from(e * e)).sum::<f64>();
            group.loss += error.iter().map(|e| f64::from(e.abs())).sum::<f64>();
            let (loss, pull) = mask.map_or((0.0, 0.0), |mask| mask_loss(found.transmittance, mask));
            group.loss += f64::from(self.options.mask * loss);
            let gradient = CompositeGradient {
                d_rgb: error.map(|e| if e == 0.0 { 0.0 } else { e.signum() * scale * share }),
                d_transmittance: self.options.mask * scale * pull,
            };
            shown.send_back(i, &gradient);
        }
    }

    /// From opacities and colours back to distance, normal, sharpness and density; adds the eikonal loss.
    fn send_back(&self, group: &mut Group, rays: &[SceneRay], anneal: f32, scale: f32) {
        let s = self.sharpness();
        let Group { sdf, outside, tile: Tile { inner, outer, slots, counts, shown }, d_cosines, .. } = group;
        let near = |p: &[f32; 3]| p.iter().map(|c| c * c).sum::<f32>().sqrt() < RELAXED;
        let relaxed = inner.positions.iter().filter(|p| near(p)).count();
        // The mean over the sections of these rays stands for the mean over all.
        let weight = self.options.eikonal * scale * rays.len() as f32 / (relaxed as f32 + 1e-5);
        sdf.d_sdf.clear();
        sdf.d_sdf.resize(inner.len(), 0.0);
        sdf.d_rgb.clear();
        sdf.d_rgb.resize(inner.len(), [0.0; 3]);
        sdf.d_normals.clear();
        d_cosines.clear();
        d_cosines.resize(inner.len(), 0.0);
        for (p, n) in inner.positions.iter().zip(&sdf.normals) {
            let (loss, pull) = if near(p) { eikonal(*n, weight) } else { (0.0, [0.0; 3]) };
            group.loss += f64::from(loss / scale);
            sdf.d_normals.push(pull);
        }
        outside.d_sigma.clear();
        outside.d_sigma.resize(outer.len(), 0.0);
        outside.d_rgb.clear();
        outside.d_rgb.resize(outer.len(), [0.0; 3]);
        let mut at = 0;
        for (ray, count) in rays.iter().zip(counts) {
            for slot in at..at + *count {
                let d_alpha = shown.d_alphas[slot];
                match slots[slot] {
                    Slot::Inner(i) => {
                        let derivative = section(sdf, i, inner.lengths[i], ray.direction).gradient(s, anneal);
                        sdf.d_sdf[i] = d_alpha * derivative.sdf;
                        sdf.d_rgb[i] = shown.d_colors[slot];
                        group.d_sharpness += d_alpha * derivative.sharpness;
                        d_cosines[i] = d_alpha * derivative.cosine;
                        for d in 0..3 {
                            sdf.d_normals[i][d] += d_cosines[i] * ray.direction[d];
                        }
                    }
                    Slot::Outer(i) => {
                        outside.d_sigma[i] = d_alpha * outer.lengths[i] * (1.0 - shown.alphas[slot]);
                        outside.d_rgb[i] = shown.d_colors[slot];
                    }
                }
            }
            at += *count;
        }
    }

    fn ray_gradients(&self, group: &mut Group, range: std::ops::Range<usize>) {
        let Group { sdf, outside, tile: Tile { inner, outer, .. }, rays, gradients, d_cosines, .. } = group;
        self.field.ray_gradients(&inner.runs, sdf);
        self.outside.ray_gradients(&outer.runs, outside);
        let runs = inner.ranges().zip(outer.ranges());
        for (ray, (target, (surface, behind))) in rays[range].iter().zip(runs).enumerate() {
            let mut gradient = surface_ray_gradient(sdf, ray, surface, &inner.depths, d_cosines);
            for d in 0..3 {
                gradient.direction[d] += outside.d_directions[ray][d];
            }
            for i in behind {
                let t = outer.depths[i];
                gradient.add_point(t, inverted_gradient(target.ray.at(t), outside.d_positions[i]));
            }
            gradients.push(gradient);
        }
    }
}

/// Distance of the ray's point that is nearest to the centre.
fn middle(ray: &SceneRay) -> f32 {
    -(0..3).map(|d| ray.origin[d] * ray.direction[d]).sum::<f32>()
}

/// The sharpness that a round assumes: 64, and twice that of the round before.
pub fn round_sharpness(round: usize) -> f32 {
    64.0 * (1u32 << round) as f32
}

/// Weights of the sections between neighbouring samples under a logistic density of this sharpness, from the samples'
/// distances alone (the authors' `up_sample`): the slope of a section is the steeper of its own and the one before, never
/// upwards, and zero outside the ball.
fn round_weights(ray: &SceneRay, depths: &[f32], sdf: &[f32], sharpness: f32) -> Vec<f32> {
    let inside = |t: f32| ray.at(t).iter().map(|c| c * c).sum::<f32>() < 1.0;
    let (mut light, mut before) = (1.0, 0.0f32);
    (0..depths.len() - 1)
        .map(|i| {
            let dt = depths[i + 1] - depths[i];
            let slope = (sdf[i + 1] - sdf[i]) / (dt + 1e-5);
            let steeper = slope.min(before).clamp(-1e3, 0.0);
            before = slope;
            let slope = if inside(depths[i]) || inside(depths[i + 1]) { steeper } else { 0.0 };
            let middle = 0.5 * (sdf[i] + sdf[i + 1]);
            let (p, q) =
                (sigmoid(sharpness * (middle - 0.5 * slope * dt)), sigmoid(sharpness * (middle + 0.5 * slope * dt)));
            let alpha = (p - q + 1e-5) / (p + 1e-5);
            let weight = light * alpha;
            light *= 1.0 - alpha + 1e-7;
            weight
        })
        .collect()
}

/// `J^T g` of `p -> (p / m, 1 / m)`, `m = max(|p|, 1)`.
fn inverted_gradient(p: [f32; 3], g: [f32; 4]) -> [f32; 3] {
    let m = p.iter().map(|c| c * c).sum::<f32>().sqrt();
    if m <= 1.0 {
        return [g[0], g[1], g[2]];
    }
    let along = (p[0] * g[0] + p[1] * g[1] + p[2] * g[2]) / (m * m);
    std::array::from_fn(|d| (g[d] - along * p[d]) / m - g[3] * p[d] / (m * m * m))
}

impl Model for NeusOriginal {
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
        let transposed = self.outside.transpose(&self.outside_parameters);
        let mut groups = std::mem::take(&mut self.groups);
        groups.par_iter_mut().enumerate().for_each(|(i, group)| {
            let mut rng = rng(self.options.seed, step * GROUPS as u64 + i as u64);
            self.run_group(data, cameras, step, &transposed, &mut rng, group);
        });
        self.field.collect(groups.iter_mut().map(|g| &mut g.sdf));
        self.outside.collect(&mut self.outside_parameters, groups.iter_mut().map(|g| &mut g.outside));
        let factor = self.options.schedule.factor(step);
        if cameras.wants_gradients(step) {
            cameras.add(data, groups.iter().flat_map(|g| g.rays.iter().zip(&g.gradients)));
            cameras.step(data, factor, step);
        }
        let lr = self.options.learning_rate * factor;
        self.field.step(&ADAM, lr, lr, step + 1);
        self.step_sharpness(groups.iter().map(|g| g.d_sharpness).sum(), lr, step + 1);
        if !self.with_masks {
            self.outside_parameters.step(&ADAM, lr, step + 1);
        }
        let rays = groups.iter().map(|g| g.rays.len()).sum::<usize>();
        let samples = groups.iter().map(|g| g.samples).sum();
        let report = StepReport {
            loss: groups.iter().map(|g| g.loss).sum::<f64>() / rays as f64,
            mse: groups.iter().map(|g| g.squared).sum::<f64>() / (3 * rays) as f64,
            rays,
            samples,
            lit: samples,
        };
        self.groups = groups;
        Ok(report)
    }

    fn render(&self, rays: &[SceneRay]) -> Vec<[f32; 3]> {
        let parts: Vec<Vec<[f32; 3]>> = rays
            .par_chunks(16)
            .map(|rays| {
                let mut group = Group::default();
                let tiles = rays.chunks(TILE_RAYS).flat_map(|tile| {
                    self.shade(tile, None, 1.0, &mut group);
                    group.tile.shown.rays.iter().map(|c| c.rgb).collect::<Vec<_>>()
                });
                tiles.collect()
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

    fn may_cross(&self, _low: [f32; 3], _high: [f32; 3]) -> bool {
        true
    }

    fn color_at(&self, positions: &[[f32; 3]], directions: &[[f32; 3]]) -> Vec<[f32; 3]> {
        self.field.colors(positions, directions)
    }

    fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        let mut all = self.field.buffers();
        all.extend(self.outside_parameters.buffers());
        all.extend([&mut self.sharpness.values, &mut self.sharpness.m, &mut self.sharpness.v]);
        all
    }

    fn restored(&mut self, _step: u64) -> std::result::Result<(), String> {
        let mut lengths = self.field.lengths();
        lengths.extend(self.outside_parameters.lengths());
        lengths.extend([1; 3]);
        same_lengths(&self.buffers(), &lengths)?;
        self.field.refresh();
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
        let workers = 4 * GROUPS * self.field.parameter_count() + self.outside.worker_bytes(GROUPS);
        16 * self.parameter_count() + workers
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_gather_samples_at_the_surface() {
        // A plane at distance 2 along the ray, met at right angles.
        let ray = SceneRay { origin: [0.0, 0.0, -2.0], direction: [0.0, 0.0, 1.0] };
        let depths: Vec<f32> = (0..65).map(|i| 1.0 + 2.0 * i as f32 / 64.0).collect();
        let sdf: Vec<f32> = depths.iter().map(|t| 2.0 - t).collect();
        let weights = round_weights(&ray, &depths, &sdf, 512.0);
        let near: f32 = weights.iter().zip(&depths).filter(|(_, t)| (*t - 2.0).abs() < 0.05).map(|(w, _)| w).sum();
        assert!(near > 0.95 * weights.iter().sum::<f32>());
    }

    #[test]
    fn the_inverted_sphere_has_the_derivative_of_finite_differences() {
        let g = [0.4, -0.7, 0.2, 0.9];
        for p in [[0.2f32, 0.3, -0.1], [1.2, -0.8, 2.0]] {
            for d in 0..3 {
                let at = |h: f32| {
                    let mut p = p;
                    p[d] += h;
                    let m = p.iter().map(|c| c * c).sum::<f32>().sqrt().max(1.0);
                    (p[0] * g[0] + p[1] * g[1] + p[2] * g[2] + g[3]) / m
                };
                let expected = (at(1e-3) - at(-1e-3)) / 2e-3;
                assert!((inverted_gradient(p, g)[d] - expected).abs() < 2e-3);
            }
        }
    }
}
