//! Rays on the device, and their samples.

use mb_job::Result;
use mb_neural::dataset::TargetRay;
use mb_neural::dvgo::UnitBox;
use mb_neural::occupancy::OccupancyGrid;
use rayon::prelude::*;

use crate::context::{Buffer, Context, Kernel, WORKGROUP};
use crate::encoding::Points;
use crate::kernels::Kernels;

/// Numbers of a ray; `march.wgsl` names them.
pub const RAY: usize = 20;

/// A ray as the kernels read it: with the colour that is wanted of it, and where contracted space is sampled; the ball is
/// the caller's.
pub fn pack(target: &TargetRay, jitter: f32, background: [f32; 3], wanted: [f32; 3], near: f32) -> [f32; RAY] {
    let mut out = [0.0; RAY];
    out[..3].copy_from_slice(&target.ray.origin);
    out[3..6].copy_from_slice(&target.ray.direction);
    out[6] = jitter;
    out[7..10].copy_from_slice(&wanted);
    out[10..13].copy_from_slice(&background);
    out[13] = near;
    out[16] = -1.0;
    out[17..].copy_from_slice(&target.rgb);
    out
}

/// Where each ray's samples begin, and where the last ones end.
pub fn starts(counts: &[u32]) -> Vec<u32> {
    let mut sum = 0;
    let mut out = vec![0];
    out.extend(counts.iter().map(|n| {
        sum += n;
        sum
    }));
    out
}

/// The cells that may hold something, as `march.wgsl` reads them: a bit each.
pub fn occupied(context: &Context, cells: &OccupancyGrid) -> Buffer {
    let word = |cells: &[bool]| cells.iter().rev().fold(0, |word, occupied| word << 1 | u32::from(*occupied));
    context.upload(&cells.occupied().par_chunks(32).map(word).collect::<Vec<_>>())
}

/// Where rays are sampled; see `march.wgsl`.
#[derive(Debug, Clone, Copy)]
pub struct Space {
    /// Cells a side of the occupancy grid.
    pub resolution: usize,
    /// Farthest sample of contracted space.
    pub far: f32,
    /// Shortest step.
    pub step: f32,
    /// A step's length as a share of the distance, where that is longer.
    pub cone: f32,
    /// Inside the unit ball or its cube instead of contracted space.
    pub inside_ball: bool,
    /// The box of the unit cube that voxels fill, where samples lie in one.
    pub voxels: Option<UnitBox>,
}

impl Space {
    /// `count` and `place` of march.wgsl.
    fn kernels<'a>(&self, k: &'a Kernels) -> &'a [Kernel; 2] {
        match (self.voxels.is_some(), self.inside_ball) {
            (false, false) => &k.contracted,
            (false, true) => &k.inside_ball,
            (true, false) => &k.voxels,
            (true, true) => &k.voxels_inside,
        }
    }

    /// What both are told.
    fn sizes(&self, rays: usize) -> Vec<u32> {
        let bounds = self.voxels.unwrap_or(UnitBox::ALL);
        let floats = [self.far, self.step, self.cone].into_iter().chain(bounds.low).chain(bounds.high);
        [rays as u32, self.resolution as u32].into_iter().chain(floats.map(f32::to_bits)).collect()
    }
}

/// Rays, and the cells that they pass.
#[derive(Clone, Copy)]
pub struct Rays<'a> {
    /// `[count, 20]`, at least.
    pub rays: &'a Buffer,
    /// How many.
    pub count: usize,
    /// By [`occupied`].
    pub occupied: &'a Buffer,
}

/// What the next step is given, drawn while the device works on this one.
pub struct Ahead<T>(Option<(u64, T)>);

impl<T> Ahead<T> {
    /// Nothing.
    pub fn none() -> Self {
        Self(None)
    }

    /// Keeps what a step is given.
    pub fn keep(&mut self, step: u64, drawn: T) {
        self.0 = Some((step, drawn));
    }

    /// What was kept for this step, if it was.
    pub fn take(&mut self, step: u64) -> Option<T> {
        self.0.take().filter(|(kept, _)| *kept == step).map(|(_, drawn)| drawn)
    }
}

/// Samples of rays, one ray after the other.
pub struct Samples {
    /// `[rays]`: how many samples each ray has, as a kernel counted them.
    pub counts: Buffer,
    /// `[rays + 1]`: where each ray's samples begin.
    pub starts: Buffer,
    /// `[samples, 3]`: position in the unit cube.
    pub positions: Buffer,
    /// `[samples, 2]`: distance and length.
    pub steps: Buffer,
    /// `[samples]`.
    pub ray_of: Buffer,
    /// `[samples]`: whether each stays, once a kernel has judged it for [`Self::keep`].
    pub stays: Buffer,
    /// How many.
    pub len: usize,
}

impl Samples {
    /// None.
    pub fn new(context: &Context) -> Self {
        let none = || context.zeros(0);
        Self { counts: none(), starts: none(), positions: none(), steps: none(), ray_of: none(), stays: none(), len: 0 }
    }

    /// The first `count` of them, or, where more positions lie behind them, with these.
    pub fn points(&self, count: usize) -> Points<'_> {
        Points { positions: &self.positions, count }
    }

    /// Makes room for so many samples.
    pub fn reserve(&mut self, context: &Context, samples: usize) {
        let Self { positions, steps, ray_of, stays, .. } = self;
        for (buffer, width) in [(positions, 3), (steps, 2), (ray_of, 1), (stays, 1)] {
            context.reserve(buffer, samples * width);
        }
    }

    /// Marches `[rays, 20]` rays through the cells that are `occupied`.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn march(&mut self, context: &Context, k: &Kernels, space: &Space, rays: Rays<'_>) -> Result<()> {
        self.count(context, k, space, rays);
        let counts = context.read(&self.counts, rays.count)?;
        self.place(context, k, space, rays, &counts);
        Ok(())
    }

    /// The first half of [`Self::march`]: how many samples each ray has, in `counts`. Leaves the samples as they are.
    pub fn count(&mut self, context: &Context, k: &Kernels, space: &Space, rays: Rays<'_>) {
        context.reserve(&mut self.counts, rays.count);
        let [counting, _] = space.kernels(k);
        self.walk(context, counting, space, rays, &self.counts);
    }

    /// The second half: the samples, of which each ray has so many.
    pub fn place(&mut self, context: &Context, k: &Kernels, space: &Space, rays: Rays<'_>, counts: &[u32]) {
        self.add_up(context, counts, 0);
        let [_, placing] = space.kernels(k);
        self.walk(context, placing, space, rays, &self.starts);
    }

    fn walk(&self, context: &Context, kernel: &Kernel, space: &Space, rays: Rays<'_>, starts: &Buffer) {
        let buffers = [
            (1, rays.rays),
            (2, rays.occupied),
            (3, starts),
            (4, &self.positions),
            (5, &self.steps),
            (6, &self.ray_of),
        ];
        let mut work = context.work();
        work.run(kernel, &space.sizes(rays.count), &buffers, rays.count * WORKGROUP);
        work.submit();
    }

    /// From the number of each ray's samples: where they begin, in `starts`; makes room for them, and for `more` behind them.
    fn add_up(&mut self, context: &Context, counts: &[u32], more: usize) {
        let begins = starts(counts);
        self.len = begins[counts.len()] as usize;
        context.replace(&mut self.starts, &begins);
        self.reserve(context, self.len + more);
    }

    /// Becomes the samples of `all` that stay, with room for `more` behind them. `counts` has the number that stay of each
    /// of the `count` rays.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn keep(&mut self, context: &Context, k: &Kernels, all: &Samples, count: usize, more: usize) -> Result<()> {
        let counts: Vec<u32> = context.read(&self.counts, count)?;
        self.add_up(context, &counts, more);
        let mut work = context.work();
        let moved = [
            (1, &all.starts),
            (3, &self.starts),
            (4, &all.positions),
            (5, &all.steps),
            (6, &self.positions),
            (7, &self.steps),
            (8, &self.ray_of),
            (9, &all.stays),
        ];
        work.run(&k.compact, &[count as u32, 0, 0, 0], &moved, count);
        work.submit();
        Ok(())
    }
}
