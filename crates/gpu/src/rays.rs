//! Rays on the device, and their samples.

use mb_job::Result;
use mb_neural::dataset::TargetRay;
use mb_neural::occupancy::OccupancyGrid;

use crate::context::{Buffer, Context};
use crate::encoding::Points;
use crate::kernels::Kernels;

/// Numbers of a ray; `march.wgsl` names them.
pub const RAY: usize = 20;

/// A ray as the kernels read it: with the colour that is wanted of it, and where contracted space and the ball are sampled.
pub fn pack(target: &TargetRay, jitter: f32, background: [f32; 3], wanted: [f32; 3], near: f32) -> [f32; RAY] {
    let mut out = [0.0; RAY];
    out[..3].copy_from_slice(&target.ray.origin);
    out[3..6].copy_from_slice(&target.ray.direction);
    out[6] = jitter;
    out[7..10].copy_from_slice(&wanted);
    out[10..13].copy_from_slice(&background);
    out[13] = near;
    out[16] = -1.0;
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
    /// Inside the unit ball instead of contracted space.
    pub inside_ball: bool,
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
    /// How many.
    pub len: usize,
}

impl Samples {
    /// None.
    pub fn new(context: &Context) -> Self {
        let none = || context.zeros(0);
        Self { starts: none(), positions: none(), steps: none(), ray_of: none(), len: 0 }
    }

    /// The first `count` of them, or, where more positions lie behind them, with these.
    pub fn points(&self, count: usize) -> Points<'_> {
        Points { positions: &self.positions, count }
    }

    /// Makes room for so many samples.
    pub fn reserve(&mut self, context: &Context, samples: usize) {
        for (buffer, width) in [(&mut self.positions, 3), (&mut self.steps, 2), (&mut self.ray_of, 1)] {
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
        let [counting, placing] = match space.inside_ball {
            true => [&k.count_inside, &k.place_inside],
            false => [&k.count, &k.place],
        };
        context.reserve(&mut self.starts, count + 1);
        let mut work = context.work();
        work.run(counting, &sizes, &self.marched(rays, occupied), count);
        work.submit();
        let begins = starts(&context.read(&self.starts, count)?);
        self.len = begins[count] as usize;
        self.starts = context.upload(&begins);
        self.reserve(context, self.len);
        let mut work = context.work();
        work.run(placing, &sizes, &self.marched(rays, occupied), count);
        work.submit();
        Ok(())
    }

    /// What both entry points of march.wgsl read and write.
    fn marched<'a>(&'a self, rays: &'a Buffer, occupied: &'a Buffer) -> [(u32, &'a Buffer); 6] {
        [(1, rays), (2, occupied), (3, &self.starts), (4, &self.positions), (5, &self.steps), (6, &self.ray_of)]
    }
}
