//! DVGO: a NeRF on dense voxels (Sun, Sun and Chen, CVPR 2022).
//!
//! *Coarse stage.* A density and a colour grid over all of the space, every voxel with its own learning rate (by the share
//! of cameras that see it), find where matter is. *Fine stage.* A box around what was found gets a density grid, a feature
//! grid and a small network; the grids start small and double their voxels at given steps; places that the coarse stage
//! left empty are skipped, and samples that weigh next to nothing are given no colour.
//!
//! The loss is `MSE + entropy * H(T) + point * sum_i w_i |c_i - C*|^2` with H the binary entropy of the light T that
//! passes a ray, and the weights of the last term held fixed.
//!
//! With masks the space is the cube around the unit ball, as the original has it for objects, before white or a random colour.
//! Without, it is all of contracted space ([`crate::contraction`]), with steps that grow with distance, as its authors'
//! later code has it for open scenes.

use mb_job::{Error, Result, Rng, rng};
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cameras::{CameraResiduals, RayGradient};
use crate::composite::{Composite, CompositeGradient, composite, composite_backward};
use crate::contraction::{contract, contract_gradient};
use crate::dataset::{RayDataset, SceneRay, TargetRay};
use crate::model::{GROUPS, Level, Model, StepReport, same_lengths};
use crate::occupancy::OccupancyGrid;
use crate::ray_samples::RaySamples;
use crate::voxel_field::{ColorNetworkOptions, VoxelField, VoxelParameters, VoxelRates, VoxelWorker};

/// How a DVGO is trained. "DVGO" names the defaults of the authors' code (`configs/default.py`), which are the paper's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DvgoOptions {
    /// Rays of a step (DVGO: 8192).
    pub rays: usize,
    /// The coarse stage.
    pub coarse: StageOptions,
    /// The fine stage.
    pub fine: StageOptions,
    /// The network of the fine stage.
    pub network: ColorNetworkOptions,
    /// Steps of the fine stage at which its voxels double (DVGO: 1000, 2000, 3000).
    pub grow: Vec<u64>,
    /// Step along a ray in voxels (DVGO: 0.5).
    pub step: f32,
    /// Steps in which learning rates fall tenfold (DVGO: 20,000).
    pub decay: u64,
    /// Opacity below which the coarse stage calls a place free (DVGO: 1e-3).
    pub free_space: f32,
    /// The box of the fine stage is this much larger than what was found (DVGO: 1.05).
    pub box_scale: f32,
    /// Nearest sample, in radii of the region.
    pub near: f32,
    /// Learn only what the masks show, where there are masks.
    pub use_masks: bool,
    /// Before white (DVGO: `white_bkgd` of objects) in place of a random colour. A random one asks an empty place for matter
    /// half as much or less, and against the loss of entropy a start from 1e-6 takes the longer.
    #[serde(default)]
    pub white_background: bool,
    /// Random numbers.
    pub seed: u64,
}

/// One of the two stages.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StageOptions {
    /// Steps (DVGO: 5,000 and 20,000).
    pub iterations: u64,
    /// Voxels, at the end (DVGO: 1,024,000 and 160^3).
    pub voxels: usize,
    /// Opacity of a step at the start (DVGO: 1e-6 and 1e-2).
    pub start_alpha: f32,
    /// Samples with a smaller opacity or weight get no colour (DVGO: 1e-7 and 1e-4).
    pub dim: f32,
    /// Weight of the entropy of the light that passes (DVGO: 0.01 and 0.001).
    pub entropy: f32,
    /// Weight of the loss of each sample's colour (DVGO: 0.1 and 0.01).
    pub point_color: f32,
    /// Learning rate of the densities (DVGO: 0.1).
    pub density_learning_rate: f32,
    /// Learning rate of colours or features (DVGO: 0.1).
    pub feature_learning_rate: f32,
    /// Learning rate of the network (DVGO: 1e-3).
    pub network_learning_rate: f32,
}

impl DvgoOptions {
    /// The paper's numbers.
    pub fn paper() -> Self {
        let coarse = StageOptions {
            iterations: 5_000,
            voxels: 1_024_000,
            start_alpha: 1e-6,
            dim: 1e-7,
            entropy: 0.01,
            point_color: 0.1,
            density_learning_rate: 0.1,
            feature_learning_rate: 0.1,
            network_learning_rate: 1e-3,
        };
        Self {
            rays: 8192,
            fine: StageOptions {
                iterations: 20_000,
                voxels: 160 * 160 * 160,
                start_alpha: 1e-2,
                dim: 1e-4,
                entropy: 0.001,
                point_color: 0.01,
                ..coarse.clone()
            },
            coarse,
            network: ColorNetworkOptions {
                channels: 12,
                width: 128,
                hidden: 2,
                position_octaves: 5,
                direction_octaves: 4,
            },
            grow: vec![1000, 2000, 3000],
            step: 0.5,
            decay: 20_000,
            free_space: 1e-3,
            box_scale: 1.05,
            near: 0.2,
            use_masks: true,
            white_background: true,
            seed: 0,
        }
    }

    /// For a processor: fewer rays, voxels and steps, and a narrower network. The coarse stage starts denser: with an
    /// opacity of 1e-6 gradients are far below Adam's epsilon for the first thousand steps or more.
    pub fn fast() -> Self {
        let paper = Self::paper();
        Self {
            rays: 2048,
            coarse: StageOptions { iterations: 600, voxels: 64 * 64 * 64, start_alpha: 5e-4, ..paper.coarse },
            fine: StageOptions { iterations: 3_400, voxels: 144 * 144 * 144, ..paper.fine },
            network: ColorNetworkOptions { width: 64, ..paper.network },
            white_background: false,
            grow: vec![400, 800, 1200],
            step: 1.0,
            decay: 3_400,
            ..paper
        }
    }

    /// The same with another number of steps, shared by the stages as before; growth and decay follow.
    #[must_use]
    pub fn with_iterations(mut self, iterations: u64) -> Self {
        let scale = |n: u64, total: u64| (n as f64 * iterations as f64 / total as f64).round() as u64;
        let total = (self.coarse.iterations + self.fine.iterations).max(1);
        self.coarse.iterations = scale(self.coarse.iterations, total).min(iterations);
        self.fine.iterations = iterations - self.coarse.iterations;
        self.grow.iter_mut().for_each(|g| *g = scale(*g, total).max(1));
        self.decay = scale(self.decay, total).max(1);
        self
    }
}

/// A box of the unit cube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct UnitBox {
    /// Its corner with the smallest coordinates.
    pub low: [f32; 3],
    /// Its corner with the largest coordinates.
    pub high: [f32; 3],
}

impl UnitBox {
    /// All of it.
    pub const ALL: Self = Self { low: [0.0; 3], high: [1.0; 3] };

    #[inline(always)]
    fn inside(&self, u: [f32; 3]) -> Option<[f32; 3]> {
        let v: [f32; 3] = std::array::from_fn(|d| (u[d] - self.low[d]) / (self.high[d] - self.low[d]));
        v.iter().all(|c| (0.0..=1.0).contains(c)).then_some(v)
    }

    /// Edge of a voxel where the box has about `voxels` of them.
    fn edge(&self, voxels: usize) -> f32 {
        let volume: f64 = (0..3).map(|d| f64::from(self.high[d] - self.low[d])).product();
        (volume / voxels as f64).cbrt() as f32
    }

    fn size(&self, voxels: usize) -> [usize; 3] {
        let edge = self.edge(voxels);
        std::array::from_fn(|d| (((self.high[d] - self.low[d]) / edge).round() as usize).max(2))
    }
}

/// A tile: its samples, and what they became.
#[derive(Debug, Default)]
struct Tile {
    samples: RaySamples<3>,
    weights: Vec<f32>,
    composites: Vec<Composite>,
}

#[derive(Debug, Default)]
struct Group {
    field: VoxelWorker,
    tile: Tile,
    rays: Vec<TargetRay>,
    backgrounds: Vec<[f32; 3]>,
    gradients: Vec<RayGradient>,
    loss: f64,
    squared: f64,
    marched: usize,
    lit: usize,
}

/// A DVGO in training. The fields and parameters are those of the stage that it is in. Its state is open, for a device
/// that trains it elsewhere.
pub struct Dvgo {
    /// How it is trained.
    pub options: DvgoOptions,
    /// Its sizes.
    pub field: VoxelField,
    /// What it has learned.
    pub parameters: VoxelParameters,
    /// The part of the unit cube that the voxels fill.
    pub bounds: UnitBox,
    /// Where the coarse stage found something; all of the space before.
    pub free: OccupancyGrid,
    /// Share of the cameras that see each voxel of the coarse grid, by which the coarse stage scales its learning rates.
    pub views: Vec<f32>,
    /// What a checkpoint must know beside the parameters: the stage, the box, and the voxels on each side.
    layout: Vec<f32>,
    groups: Vec<Group>,
    /// Only the object, before a random background; else all of contracted space.
    pub with_masks: bool,
}

/// Samples of a tile before the dim ones are dropped.
const TILE_SAMPLES: usize = 4096;
/// Cells a side of the free-space grid.
const FREE_CELLS: usize = 128;
/// Farthest sample in radii of the region, where the space is open.
pub const FAR: f32 = 64.0;

impl Dvgo {
    /// A DVGO at its start.
    pub fn new(options: DvgoOptions, data: &RayDataset) -> Self {
        let with_masks = options.use_masks && data.has_masks();
        let size = UnitBox::ALL.size(options.coarse.voxels);
        let field = VoxelField::new(size, None, options.coarse.start_alpha, options.step);
        let parameters = field.init(&mut rng(options.seed, u64::MAX));
        let near = options.near;
        // The cameras' counts are in contracted space; the ball's cube is its middle half.
        let contracted = |u: [f32; 3]| if with_masks { u.map(|c| 0.25 + 0.5 * c) } else { u };
        let scale = if with_masks { 0.5 } else { 1.0 };
        let mut free = OccupancyGrid::new(FREE_CELLS);
        free.close(|center, half| data.seen_by(contracted(center), scale * half, near) > 2);
        let [nx, ny, nz] = size;
        let counts: Vec<usize> = (0..nx * ny * nz)
            .into_par_iter()
            .map(|i| {
                let u = [i % nx, i / nx % ny, i / (nx * ny)];
                let n = [nx, ny, nz];
                let u = std::array::from_fn(|d| u[d] as f32 / (n[d] - 1) as f32);
                data.seen_by(contracted(u), scale * 0.5 / nx as f32, near)
            })
            .collect();
        let most = counts.iter().copied().max().unwrap_or(1).max(1);
        let views = counts.into_iter().map(|n| n as f32 / most as f32).collect();
        let mut dvgo = Self {
            field,
            parameters,
            bounds: UnitBox::ALL,
            free,
            views,
            layout: Vec::new(),
            groups: (0..GROUPS).map(|_| Group::default()).collect(),
            with_masks,
            options,
        };
        dvgo.note_layout(false);
        dvgo
    }

    fn note_layout(&mut self, fine: bool) {
        self.layout = vec![f32::from(fine)];
        self.layout.extend(self.bounds.low.iter().chain(&self.bounds.high));
        self.layout.extend(self.field.size().map(|n| n as f32));
    }

    /// Whether the coarse stage has ended.
    pub fn is_fine(&self) -> bool {
        self.layout[0] > 0.0
    }

    /// How the stage that it is in is trained.
    pub fn stage(&self) -> &StageOptions {
        if self.is_fine() { &self.options.fine } else { &self.options.coarse }
    }

    /// A scene point in the unit cube.
    #[inline(always)]
    fn unit(&self, p: [f32; 3]) -> [f32; 3] {
        if self.with_masks { p.map(|c| 0.5 * c + 0.5) } else { contract(p) }
    }

    /// `J^T g` of [`Self::unit`].
    fn unit_gradient(&self, p: [f32; 3], g: [f32; 3]) -> [f32; 3] {
        if self.with_masks { g.map(|c| 0.5 * c) } else { contract_gradient(p, g) }
    }

    /// Step in base voxels: half a voxel of the grid as it is, of the stage's final grid as the unit.
    pub fn interval(&self) -> f32 {
        let [nx, ny, nz] = self.field.size();
        self.options.step * (self.stage().voxels as f32 / (nx * ny * nz) as f32).cbrt()
    }

    /// Step in radii of the region, where space is not contracted.
    pub fn step_length(&self) -> f32 {
        let [nx, ny, nz] = self.field.size();
        let cube = if self.with_masks { 2.0 } else { 4.0 };
        self.options.step * cube * self.bounds.edge(nx * ny * nz)
    }

    /// First and last distance of a ray's samples; `None` where it passes by.
    pub fn range(&self, ray: &SceneRay) -> Option<(f32, f32)> {
        let range = if self.with_masks { ray.ball(3f32.sqrt()) } else { Some((0.0, FAR)) };
        range.map(|(near, far)| (near.max(self.options.near), far))
    }

    /// Adds a ray's samples, places in [`Self::bounds`], to the tile; `jitter` in 0..1 shifts them by a part of a step.
    pub fn march(&self, ray: &SceneRay, jitter: f32, samples: &mut RaySamples<3>) {
        let h = self.step_length();
        if let Some((near, far)) = self.range(ray) {
            let mut t = near + jitter * h;
            while t < far {
                let p = ray.at(t);
                let u = self.unit(p);
                let reach = p.iter().fold(1.0f32, |a, c| a.max(c.abs()));
                // Contraction shrinks radial steps by the square of the distance.
                let dt = if self.with_masks { h } else { (h * reach * reach).min(0.5 * reach) };
                if let Some(v) = self.bounds.inside(u).filter(|_| self.free.is_occupied(u)) {
                    samples.push(v, t, dt);
                }
                t += dt;
            }
        }
        samples.end_ray(ray.direction);
    }

    /// Opacities, then colours of the samples that matter, then composites.
    /// What a ray ends at.
    pub fn background(&self, rng: &mut Rng) -> [f32; 3] {
        if self.with_masks && self.options.white_background { [1.0; 3] } else { std::array::from_fn(|_| rng.random()) }
    }

    fn shade(&self, tile: &mut Tile, worker: &mut VoxelWorker, backgrounds: &[[f32; 3]]) {
        let p = &self.parameters;
        let dim = self.stage().dim;
        let samples = &mut tile.samples;
        self.field.alphas(p, &samples.positions, self.interval(), worker);
        let kept = samples.retain(|run, keep| {
            let mut light = 1.0;
            for i in run {
                let weight = light * worker.alphas[i];
                if worker.alphas[i] > dim && weight > dim {
                    keep.push(i as u32);
                    light *= 1.0 - worker.alphas[i];
                }
            }
        });
        if let Some(keep) = kept {
            VoxelField::compact(keep, worker);
        }
        self.field.color(p, &samples.positions, &samples.runs, worker);
        tile.weights.resize(samples.len(), 0.0);
        tile.composites.clear();
        for (run, background) in samples.ranges().zip(backgrounds) {
            let (alphas, rgb) = (&worker.alphas[run.clone()], &worker.rgb[run.clone()]);
            tile.composites.push(composite(alphas, rgb, *background, &mut tile.weights[run]));
        }
    }

    fn run_group(
        &self,
        data: &RayDataset,
        cameras: &CameraResiduals,
        move_cameras: bool,
        transposed: &[f32],
        rng: &mut Rng,
        group: &mut Group,
    ) {
        let rays = self.rays_of_group();
        data.draw(rng, rays, cameras, &mut group.rays);
        (group.loss, group.squared) = (0.0, 0.0);
        (group.marched, group.lit) = (0, 0);
        group.gradients.clear();
        let mut next = 0;
        while next < group.rays.len() {
            let first = next;
            group.tile.samples.clear();
            group.backgrounds.clear();
            while next < group.rays.len() && group.tile.samples.len() < TILE_SAMPLES {
                group.backgrounds.push(self.background(rng));
                self.march(&group.rays[next].ray, rng.random(), &mut group.tile.samples);
                next += 1;
            }
            group.marched += group.tile.samples.len();
            self.shade(&mut group.tile, &mut group.field, &group.backgrounds);
            group.lit += group.tile.samples.len();
            self.losses(group, first..next, 1.0 / (rays * GROUPS) as f32);
            let Group { field: worker, tile: Tile { samples, .. }, gradients, rays, .. } = &mut *group;
            self.field.backward(&self.parameters, transposed, &samples.positions, worker);
            if move_cameras {
                self.field.ray_gradients(&self.parameters, &samples.runs, worker);
                for ((target, run), d) in rays[first..next].iter().zip(samples.ranges()).zip(&worker.d_directions) {
                    let mut gradient = RayGradient { origin: [0.0; 3], direction: *d };
                    for i in run {
                        let t = samples.depths[i];
                        let g: [f32; 3] = std::array::from_fn(|d| {
                            worker.d_positions[i][d] / (self.bounds.high[d] - self.bounds.low[d])
                        });
                        gradient.add_point(t, self.unit_gradient(target.ray.at(t), g));
                    }
                    gradients.push(gradient);
                }
            }
        }
    }

    /// Rays of each group of a step.
    pub fn rays_of_group(&self) -> usize {
        self.options.rays.div_ceil(GROUPS)
    }

    /// The losses of a tile's rays and their derivatives with respect to opacities and colours.
    fn losses(&self, group: &mut Group, range: std::ops::Range<usize>, scale: f32) {
        let stage = self.stage();
        let Group { field: worker, tile, rays, backgrounds, loss, squared, .. } = group;
        let samples = tile.samples.len();
        worker.d_alphas.clear();
        worker.d_alphas.resize(samples, 0.0);
        worker.d_rgb.clear();
        worker.d_rgb.resize(samples, [0.0; 3]);
        for (i, (target, run)) in rays[range].iter().zip(tile.samples.ranges()).enumerate() {
            let found = &tile.composites[i];
            let wanted = target.before(backgrounds[i], self.with_masks);
            let error: [f32; 3] = std::array::from_fn(|c| found.rgb[c] - wanted[c]);
            let square = error.iter().map(|e| f64::from(e * e)).sum::<f64>();
            let passed = found.transmittance.clamp(1e-6, 1.0 - 1e-6);
            let entropy = -(passed * passed.ln() + (1.0 - passed) * (1.0 - passed).ln());
            *squared += square;
            *loss += square / 3.0 + f64::from(stage.entropy * entropy);
            let gradient = CompositeGradient {
                d_rgb: error.map(|e| 2.0 / 3.0 * scale * e),
                d_transmittance: -scale * stage.entropy * (passed.ln() - (1.0 - passed).ln()),
            };
            composite_backward(
                &worker.alphas[run.clone()],
                &worker.rgb[run.clone()],
                backgrounds[i],
                &tile.weights[run.clone()],
                &gradient,
                &mut worker.d_alphas[run.clone()],
                &mut worker.d_rgb[run.clone()],
            );
            for s in run {
                let weight = stage.point_color * tile.weights[s];
                for c in 0..3 {
                    let e = worker.rgb[s][c] - target.rgb[c];
                    *loss += f64::from(weight * e * e);
                    worker.d_rgb[s][c] += 2.0 * scale * weight * e;
                }
            }
        }
    }

    /// Ends the coarse stage: free space, the box of what was found, and an empty fine field in it.
    fn begin_fine(&mut self) -> Result<()> {
        let (field, parameters, step) = (&self.field, &self.parameters, self.interval());
        let cells = FREE_CELLS;
        let mut alphas = vec![0.0; cells * cells * cells];
        alphas.par_chunks_mut(cells).enumerate().for_each(|(row, out)| {
            let unit = |i: usize| (i as f32 + 0.5) / cells as f32;
            let positions: Vec<[f32; 3]> =
                (0..cells).map(|x| [unit(x), unit(row % cells), unit(row / cells)]).collect();
            let mut found = Vec::new();
            field.opacities(parameters, &positions, step, &mut found);
            out.copy_from_slice(&found);
        });
        self.free.values = widened(&alphas, cells);
        self.free.decide(self.options.free_space);
        let (mut low, mut high) = ([1.0f32; 3], [0.0f32; 3]);
        for (i, _) in self.free.occupied_cells() {
            let cell = [i % cells, i / cells % cells, i / (cells * cells)];
            for d in 0..3 {
                low[d] = low[d].min(cell[d] as f32 / cells as f32);
                high[d] = high[d].max((cell[d] + 1) as f32 / cells as f32);
            }
        }
        if low.iter().zip(&high).any(|(a, b)| a >= b) {
            return Err(Error::Failed(format!(
                "the coarse stage of dvgo found no matter in {} steps: train longer (--iterations), or check the poses with \
                 `capture check`",
                self.options.coarse.iterations
            )));
        }
        let grow = |d: usize, sign: f32| {
            let (middle, half) = (0.5 * (low[d] + high[d]), 0.5 * (high[d] - low[d]));
            (middle + sign * half * self.options.box_scale).clamp(0.0, 1.0)
        };
        self.bounds =
            UnitBox { low: std::array::from_fn(|d| grow(d, -1.0)), high: std::array::from_fn(|d| grow(d, 1.0)) };
        let first = self.options.fine.voxels >> self.options.grow.len();
        self.field = self.fine_field(self.bounds.size(first.max(8)));
        self.parameters = self.field.init(&mut rng(self.options.seed, u64::MAX - 1));
        self.note_layout(true);
        Ok(())
    }

    fn fine_field(&self, size: [usize; 3]) -> VoxelField {
        let o = &self.options;
        VoxelField::new(size, Some(&o.network), o.fine.start_alpha, o.step)
    }

    /// What happens before step `fine` of the fine stage: growth, where it is due.
    fn grow(&mut self, fine: u64) {
        let Some(done) = self.options.grow.iter().position(|g| *g == fine) else { return };
        let voxels = self.options.fine.voxels >> (self.options.grow.len() - done - 1);
        let (field, parameters) = self.field.grown(&self.parameters, self.bounds.size(voxels));
        (self.field, self.parameters) = (field, parameters);
        self.note_layout(true);
    }

    /// Whether [`Self::begin`] replaces the field before this step.
    pub fn is_replaced_at(&self, step: u64) -> bool {
        step.checked_sub(self.options.coarse.iterations)
            .is_some_and(|fine| !self.is_fine() || self.options.grow.contains(&fine))
    }

    /// What happens before a step: the fine stage begins, or its voxels double, where that is due.
    ///
    /// # Errors
    /// The coarse stage found nothing.
    pub fn begin(&mut self, step: u64) -> Result<()> {
        if let Some(fine) = step.checked_sub(self.options.coarse.iterations) {
            if !self.is_fine() {
                self.begin_fine()?;
            }
            self.grow(fine);
        }
        Ok(())
    }

    /// The optimiser's number of a step, from 1, and what is left of its learning rates. It starts anew with the stage and
    /// with each growth, and so does the decay of its rates.
    pub fn course(&self, step: u64) -> (u64, f32) {
        let since = match step.checked_sub(self.options.coarse.iterations) {
            None => step,
            Some(fine) => fine - self.options.grow.iter().copied().filter(|g| *g <= fine).max().unwrap_or(0),
        };
        (since + 1, 0.1f64.powf(since as f64 / self.options.decay.max(1) as f64) as f32)
    }

    /// The stage's learning rates, of which this factor is left.
    pub fn rates(&self, factor: f32) -> VoxelRates {
        let stage = self.stage();
        VoxelRates {
            density: factor * stage.density_learning_rate,
            features: factor * stage.feature_learning_rate,
            network: factor * stage.network_learning_rate,
        }
    }

    fn final_size(&self) -> usize {
        let channels = self.options.network.channels;
        (self.options.coarse.voxels * 4).max(self.options.fine.voxels * (1 + channels))
    }
}

/// The largest of the 27 cells around each.
fn widened(values: &[f32], n: usize) -> Vec<f32> {
    let mut out = values.to_vec();
    for stride in [1, n, n * n] {
        let from = out.clone();
        out.par_iter_mut().enumerate().for_each(|(i, v)| {
            let at = i / stride % n;
            if at > 0 {
                *v = v.max(from[i - stride]);
            }
            if at + 1 < n {
                *v = v.max(from[i + stride]);
            }
        });
    }
    out
}

impl Model for Dvgo {
    fn name(&self) -> &'static str {
        "dvgo"
    }

    fn only_object(&self) -> bool {
        self.with_masks
    }

    fn iterations(&self) -> u64 {
        self.options.coarse.iterations + self.options.fine.iterations
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        self.begin(step)?;
        let transposed = self.field.transpose(&self.parameters);
        let move_cameras = cameras.wants_gradients(step);
        let mut groups = std::mem::take(&mut self.groups);
        groups.par_iter_mut().enumerate().for_each(|(i, group)| {
            let mut rng = rng(self.options.seed, step * GROUPS as u64 + i as u64);
            self.run_group(data, cameras, move_cameras, &transposed, &mut rng, group);
        });
        self.field.collect(&mut self.parameters, groups.iter_mut().map(|g| &mut g.field));
        let (t, factor) = self.course(step);
        if move_cameras {
            cameras.add(data, groups.iter().flat_map(|g| g.rays.iter().zip(&g.gradients)));
            cameras.step(data, factor, step);
        }
        let scales = (!self.is_fine()).then_some(self.views.as_slice());
        self.parameters.step(self.rates(factor), scales, t);
        let rays = groups.iter().map(|g| g.rays.len()).sum::<usize>();
        let report = StepReport {
            loss: groups.iter().map(|g| g.loss).sum::<f64>() / rays as f64,
            mse: groups.iter().map(|g| g.squared).sum::<f64>() / (3 * rays) as f64,
            rays,
            samples: groups.iter().map(|g| g.marched).sum(),
            lit: groups.iter().map(|g| g.lit).sum(),
        };
        self.groups = groups;
        Ok(report)
    }

    fn render(&self, rays: &[SceneRay]) -> Vec<[f32; 3]> {
        let parts: Vec<Vec<[f32; 3]>> = rays
            .par_chunks(64)
            .map(|rays| {
                let (mut tile, mut worker) = (Tile::default(), VoxelWorker::default());
                rays.iter().for_each(|ray| self.march(ray, 0.5, &mut tile.samples));
                self.shade(&mut tile, &mut worker, &vec![[0.0; 3]; rays.len()]);
                tile.composites.iter().map(|c| c.rgb).collect()
            })
            .collect();
        parts.concat()
    }

    fn level(&self) -> Level {
        // Half of the light is stopped in one voxel.
        Level { value: 0.5, larger_inside: true }
    }

    fn surface(&self, positions: &[[f32; 3]]) -> Vec<f32> {
        let inside: Vec<Option<[f32; 3]>> = positions
            .iter()
            .map(|p| {
                let u = self.unit(*p);
                self.bounds.inside(u).filter(|_| self.free.is_occupied(u))
            })
            .collect();
        let known: Vec<[f32; 3]> = inside.iter().flatten().copied().collect();
        let mut found = Vec::new();
        self.field.opacities(&self.parameters, &known, 1.0, &mut found);
        let mut found = found.into_iter();
        inside.iter().map(|p| if p.is_some() { found.next().unwrap_or(0.0) } else { 0.0 }).collect()
    }

    fn may_cross(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        self.free.any_occupied(self.unit(low), self.unit(high))
    }

    fn color_at(&self, positions: &[[f32; 3]], directions: &[[f32; 3]]) -> Vec<[f32; 3]> {
        let positions: Vec<[f32; 3]> =
            positions.iter().map(|p| self.bounds.inside(self.unit(*p)).unwrap_or([0.5; 3])).collect();
        let runs: Vec<_> = directions.iter().map(|d| (1, *d)).collect();
        let mut worker = VoxelWorker::default();
        self.field.color(&self.parameters, &positions, &runs, &mut worker);
        worker.rgb
    }

    fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        let mut all = self.parameters.buffers();
        all.extend(self.free.buffers());
        all.push(&mut self.layout);
        all
    }

    fn restored(&mut self, _step: u64) -> std::result::Result<(), String> {
        let wrong = || "the checkpoint belongs to a run with other options".to_owned();
        let [fine, l0, l1, l2, h0, h1, h2, nx, ny, nz] = *self.layout.as_slice() else { return Err(wrong()) };
        let size = [nx, ny, nz].map(|n| n as usize);
        let limit = self.options.coarse.voxels.max(self.options.fine.voxels) as f64 * 2.0;
        let voxels: f64 = size.iter().map(|n| *n as f64).product();
        if size.iter().any(|n| *n < 2) || voxels > limit {
            return Err(wrong());
        }
        self.bounds = UnitBox { low: [l0, l1, l2], high: [h0, h1, h2] };
        if fine > 0.0 {
            self.field = self.fine_field(size);
        }
        let mut lengths: Vec<usize> = self.field.lengths().iter().flat_map(|n| [*n; 3]).collect();
        lengths.extend(self.free.lengths());
        lengths.push(10);
        same_lengths(&self.buffers(), &lengths)?;
        self.parameters.restored();
        self.free.restored();
        Ok(())
    }

    fn is_finite(&self) -> bool {
        self.parameters.is_finite()
    }

    fn parameter_count(&self) -> usize {
        self.field.parameter_count()
    }

    fn bytes(&self) -> usize {
        // A hundred samples of a ray pass the dim ones' threshold early in a stage.
        let sample = 16 + 4 * self.options.network.channels;
        16 * self.final_size() + 6 * FREE_CELLS.pow(3) + 100 * self.options.rays * sample
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_grids_have_the_papers_sizes() {
        let options = DvgoOptions::paper();
        let coarse = VoxelField::new(UnitBox::ALL.size(options.coarse.voxels), None, 1e-6, 0.5);
        // The authors' code rounds down: 100 voxels a side of a cube of 1.024 million are 101 here and 100 there.
        assert!((coarse.parameter_count() as f64 / (4.0 * 1_024_000.0) - 1.0).abs() < 0.01);
        let fine = VoxelField::new(UnitBox::ALL.size(options.fine.voxels), Some(&options.network), 1e-2, 0.5);
        let network = (72 * 128 + 128) + (128 * 128 + 128) + (128 * 3 + 3);
        assert_eq!(fine.parameter_count(), 160 * 160 * 160 * 13 + network);
    }

    #[test]
    fn widening_reaches_every_neighbour() {
        let mut values = vec![0.0; 125];
        values[(2 * 5 + 2) * 5] = 1.0;
        let out = widened(&values, 5);
        assert_eq!(out.iter().sum::<f32>(), 18.0);
    }
}
