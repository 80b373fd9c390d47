//! Rays on the device, and their samples.

use mb_job::Result;
use mb_neural::dataset::TargetRay;
use mb_neural::dvgo::UnitBox;
use mb_neural::occupancy::OccupancyGrid;

use crate::context::{Buffer, Context};
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

/// The cells that may hold something, as `march.wgsl` reads them.
pub fn occupied(context: &Context, cells: &OccupancyGrid) -> Buffer {
    context.upload(&cells.occupied().iter().map(|o| u32::from(*o)).collect::<Vec<_>>())
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

/// Samples of rays, one ray after the other.
pub struct Samples {
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
        Self { starts: none(), positions: none(), steps: none(), ray_of: none(), stays: none(), len: 0 }
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
    pub fn march(
        &mut self,
        context: &Context,
        k: &Kernels,
        space: &Space,
        (rays, count): (&Buffer, usize),
        occupied: &Buffer,
    ) -> Result<()> {
        let mut sizes = vec![count as u32, space.resolution as u32];
        sizes.extend([space.far, space.step, space.cone].map(f32::to_bits));
        let bounds = space.voxels.unwrap_or(UnitBox::ALL);
        sizes.extend(bounds.low.iter().chain(&bounds.high).map(|c| c.to_bits()));
        let [counting, placing] = match (space.voxels.is_some(), space.inside_ball) {
            (false, false) => &k.contracted,
            (false, true) => &k.inside_ball,
            (true, false) => &k.voxels,
            (true, true) => &k.voxels_inside,
        };
        context.reserve(&mut self.starts, count + 1);
        let mut work = context.work();
        work.run(counting, &sizes, &self.marched(rays, occupied), count);
        work.submit();
        self.add_up(context, count, 0)?;
        let mut work = context.work();
        work.run(placing, &sizes, &self.marched(rays, occupied), count);
        work.submit();
        Ok(())
    }

    /// From the number of each ray's samples, in `starts`: where they begin; makes room for them, and for `more` behind them.
    fn add_up(&mut self, context: &Context, count: usize, more: usize) -> Result<()> {
        let begins = starts(&context.read(&self.starts, count)?);
        self.len = begins[count] as usize;
        self.starts = context.upload(&begins);
        self.reserve(context, self.len + more);
        Ok(())
    }

    /// Becomes the samples of `all` that stay, with room for `more` behind them. `starts` has the number that stay of each
    /// of the `count` rays.
    ///
    /// # Errors
    /// As [`Context::read`].
    pub fn keep(&mut self, context: &Context, k: &Kernels, all: &Samples, count: usize, more: usize) -> Result<()> {
        self.add_up(context, count, more)?;
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

    /// What both entry points of march.wgsl read and write.
    fn marched<'a>(&'a self, rays: &'a Buffer, occupied: &'a Buffer) -> [(u32, &'a Buffer); 6] {
        [(1, rays), (2, occupied), (3, &self.starts), (4, &self.positions), (5, &self.steps), (6, &self.ray_of)]
    }
}
