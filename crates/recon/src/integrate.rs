//! One frame into the volume: which blocks it touches, and how it changes a block.

use mb_geometry::{Camera, Intrinsics, Rigid3, World};
use mb_image::{DepthImage, RgbImage};
use mb_job::{Error, Result};
use nalgebra::{Matrix3, Point2, Vector3};
use rayon::prelude::*;

use crate::volume::{Block, SIDE, VOXELS, too_large};

/// Blocks further from the origin than this many blocks are refused; beyond it single precision loses voxels.
const MAX_BLOCK_COORD: f64 = (1 << 26) as f64;

/// What one camera saw.
pub(crate) struct FrameView<'a> {
    pub depth: &'a DepthImage,
    pub color: Option<&'a RgbImage>,
    pub intrinsics: &'a Intrinsics,
    pub cam_from_world: &'a Rigid3<Camera, World>,
}

/// A depth that counts: positive and finite.
fn is_depth(z: f32) -> bool {
    z > 0.0 && z.is_finite()
}

/// Pixels along each side of a tile of [`FarthestDepth`].
const TILE: usize = 16;

/// The largest depth in each tile of a depth map, 0 where a tile has no depth.
struct FarthestDepth {
    columns: usize,
    tiles: Vec<f32>,
}

impl FarthestDepth {
    fn of(depth: &DepthImage) -> Self {
        let columns = depth.width().div_ceil(TILE);
        let mut tiles = vec![0.0; columns * depth.height().div_ceil(TILE)];
        for (y, row) in depth.data().chunks_exact(depth.width().max(1)).enumerate() {
            let tiles = &mut tiles[y / TILE * columns..][..columns];
            for (tile, pixels) in tiles.iter_mut().zip(row.chunks(TILE)) {
                *tile = pixels.iter().fold(*tile, |most, &z| if z > most { z } else { most });
            }
        }
        Self { columns, tiles }
    }
}

/// The blocks that hold any point within `truncation_m` (along z) of what the depth map shows, in ascending order.
///
/// Pixels are visited at a stride whose footprint is at most one voxel, and each stands for those up to the next: the
/// stretch of its ray is grown sideways by the stride.
pub(crate) fn touched_blocks(
    view: &FrameView,
    voxel_size_m: f64,
    truncation_m: f64,
    limit: usize,
) -> Result<Vec<[i32; 3]>> {
    let size = view.depth.size();
    let world_from_cam = view.cam_from_world.inverse();
    let focal = view.intrinsics.fx.min(view.intrinsics.fy);
    let farthest = FarthestDepth::of(view.depth);
    let farthest_of_all = farthest.tiles.iter().copied().filter(|&z| is_depth(z)).fold(0.0, f32::max);
    let stride = ((voxel_size_m * focal / f64::from(farthest_of_all)) as usize).clamp(1, SIDE);
    let block_size = voxel_size_m * SIDE as f64;

    let mark_row = |&y: &usize| -> Result<Vec<[i32; 3]>> {
        let mut found = Vec::new();
        // The block ranges that the pieces of the previous ray touched: neighbouring rays mostly touch the same.
        let mut previous = Vec::new();
        for x in (0..size.width).step_by(stride) {
            let z = view.depth[(x, y)];
            if !is_depth(z) {
                continue;
            }
            let z = f64::from(z);
            let ray = view.intrinsics.ray(&Point2::new(x as f64, y as f64), &world_from_cam);
            let near = (z - truncation_m).max(0.0);
            let far = z + truncation_m;
            let pieces = ((far - near) * ray.direction.norm() / (0.5 * block_size)).ceil().max(1.0) as usize;
            let margin = stride as f64 * z / focal;
            previous.resize(pieces, None);
            let mut start = ray.at(near);
            for (i, previous) in previous.iter_mut().enumerate() {
                let end = ray.at(near + (far - near) * (i + 1) as f64 / pieces as f64);
                let lowest = start.inf(&end).coords.add_scalar(-margin) / block_size;
                let highest = start.sup(&end).coords.add_scalar(margin) / block_size;
                if !(lowest.min() > -MAX_BLOCK_COORD && highest.max() < MAX_BLOCK_COORD) {
                    return Err(Error::Failed(format!(
                        "a surface lies {:.0} m from the origin, too far for voxels of {} mm; check the unit of the poses",
                        end.coords.norm(),
                        voxel_size_m * 1e3
                    )));
                }
                start = end;
                let range = (lowest.map(floor), highest.map(floor));
                if *previous == Some(range) {
                    continue;
                }
                *previous = Some(range);
                let (low, high) = range;
                // A depth map whose pixels are many blocks wide cannot be fused at this voxel size.
                let count = (0..3).map(|a| (high[a] - low[a] + 1) as f64).product::<f64>();
                if found.len() as f64 + count > limit as f64 {
                    found.sort_unstable();
                    found.dedup();
                    if found.len() as f64 + count > limit as f64 {
                        return Err(too_large(voxel_size_m));
                    }
                }
                for bz in low.z..=high.z {
                    for by in low.y..=high.y {
                        found.extend((low.x..=high.x).map(|bx| [bx, by, bz]));
                    }
                }
            }
        }
        found.sort_unstable();
        found.dedup();
        Ok(found)
    };
    // Rows are merged in batches, so that memory stays bounded for depth maps that touch far too much.
    let rows: Vec<usize> = (0..size.height).step_by(stride).collect();
    let mut touched: Vec<[i32; 3]> = Vec::new();
    for batch in rows.chunks(64) {
        let found: Vec<Vec<[i32; 3]>> = batch.par_iter().map(mark_row).collect::<Result<_>>()?;
        found.into_iter().for_each(|blocks| touched.extend(blocks));
        touched.sort_unstable();
        touched.dedup();
        if touched.len() > limit {
            return Err(too_large(voxel_size_m));
        }
    }
    Ok(touched)
}

/// The largest integer not above `x`, for `x` within [`MAX_BLOCK_COORD`]; the library's is a call on older processors.
fn floor(x: f64) -> i32 {
    let cut = x as i32;
    cut - i32::from(f64::from(cut) > x)
}

impl<'a> FrameView<'a> {
    /// Everything about the frame that a block's update needs, in single precision.
    pub fn updater(&self, voxel_size_m: f64, truncation_m: f64) -> BlockUpdater<'a> {
        let size = self.depth.size();
        let color = self.color.map(|image| {
            let scale = |to: usize, from: usize| to as f32 / from as f32;
            (image, [scale(image.width(), size.width), scale(image.height(), size.height)])
        });
        BlockUpdater {
            depth: self.depth,
            farthest: FarthestDepth::of(self.depth),
            color,
            focal: [self.intrinsics.fx as f32, self.intrinsics.fy as f32],
            center: [self.intrinsics.cx as f32, self.intrinsics.cy as f32],
            cam_from_world: *self.cam_from_world,
            steps: (self.cam_from_world.rotation_matrix() * voxel_size_m).cast(),
            voxel_size_m,
            truncation_m: truncation_m as f32,
        }
    }
}

/// Averages one frame into blocks.
pub(crate) struct BlockUpdater<'a> {
    depth: &'a DepthImage,
    farthest: FarthestDepth,
    /// The photograph, and its pixels per depth pixel.
    color: Option<(&'a RgbImage, [f32; 2])>,
    focal: [f32; 2],
    center: [f32; 2],
    cam_from_world: Rigid3<Camera, World>,
    /// Columns: one voxel along x, y, z of the world, in the camera frame.
    steps: Matrix3<f32>,
    voxel_size_m: f64,
    truncation_m: f32,
}

impl BlockUpdater<'_> {
    /// Updates the voxels of a block that this frame sees.
    pub fn update(&self, block: &mut Block) {
        let corner = block.coord.map(|c| f64::from(c) * SIDE as f64 * self.voxel_size_m);
        let corner: Vector3<f32> = (self.cam_from_world * nalgebra::Point3::from(corner)).coords.cast();
        if !self.may_see(&corner) {
            return;
        }
        let (dx, dy, dz) = (self.steps.column(0), self.steps.column(1), self.steps.column(2));
        for row in 0..VOXELS / SIDE {
            let start = corner + dy * (row % SIDE) as f32 + dz * (row / SIDE) as f32;
            // Project the whole row first: plain arithmetic on eight numbers, which the compiler does at once.
            let z: [f32; SIDE] = std::array::from_fn(|i| start.z + dx[2] * i as f32);
            let u: [f32; SIDE] =
                std::array::from_fn(|i| self.focal[0] * (start.x + dx[0] * i as f32) / z[i] + self.center[0]);
            let v: [f32; SIDE] =
                std::array::from_fn(|i| self.focal[1] * (start.y + dx[1] * i as f32) / z[i] + self.center[1]);
            for i in 0..SIDE {
                if z[i] > 0.0 {
                    self.update_voxel(block, row * SIDE + i, z[i], u[i], v[i]);
                }
            }
        }
    }

    /// Whether this frame can change a block whose first voxel is at `corner` (camera frame): some voxel projects into
    /// the image, where some depth is not nearer than the block by more than the truncation.
    fn may_see(&self, corner: &Vector3<f32>) -> bool {
        let half = (SIDE - 1) as f32 / 2.0;
        let center = corner + self.steps * Vector3::repeat(half);
        let radius = half * 3f32.sqrt() * self.voxel_size_m as f32;
        let nearest = center.z - radius;
        if nearest <= 0.0 {
            // The camera is inside the ball around the block, or behind it.
            return center.z + radius > 0.0;
        }
        // A ball's image lies within its extent divided by its least depth.
        let size = self.depth.size();
        let pixels = |axis: usize, count: usize| {
            let middle = self.focal[axis] * center[axis] / center.z + self.center[axis];
            let tangent = (center[axis] / center.z).abs();
            let reach = self.focal[axis] * radius * (1.0 + tangent) / nearest + 1.0;
            let (low, high) = (middle - reach, middle + reach);
            (high >= 0.0 && low <= count as f32).then(|| (low.max(0.0) as usize, (high as usize).min(count - 1)))
        };
        let (Some((left, right)), Some((top, bottom))) = (pixels(0, size.width), pixels(1, size.height)) else {
            return false;
        };
        let hidden_beyond = nearest - self.truncation_m;
        (top / TILE..=bottom / TILE).any(|row| {
            let tiles = &self.farthest.tiles[row * self.farthest.columns..][left / TILE..=right / TILE];
            tiles.iter().any(|&z| z > 0.0 && z >= hidden_beyond)
        })
    }

    /// Averages what the frame shows at image position (`u`, `v`) into a voxel at depth `voxel_z`.
    #[inline(always)]
    fn update_voxel(&self, block: &mut Block, voxel: usize, voxel_z: f32, u: f32, v: f32) {
        let Some(z) = self.depth_at(u, v) else { return };
        let ahead = z - voxel_z;
        if ahead < -self.truncation_m {
            return;
        }
        let weight = block.weight[voxel] + 1.0;
        let share = 1.0 / weight;
        let distance = &mut block.distance_m[voxel];
        *distance += (ahead.min(self.truncation_m) - *distance) * share;
        block.weight[voxel] = weight;
        if let (Some((image, scale)), Some(color)) = (self.color, &mut block.color) {
            let pixel = |at: f32, scale: f32, count: usize| (((at + 0.5) * scale) as usize).min(count - 1);
            let seen = image[(pixel(u, scale[0], image.width()), pixel(v, scale[1], image.height()))];
            for (average, seen) in color[voxel].iter_mut().zip(seen) {
                *average += (f32::from(seen) - *average) * share;
            }
        }
    }

    /// Depth at a position in the image: interpolated on smooth surfaces, else that of the nearest pixel.
    #[inline(always)]
    fn depth_at(&self, u: f32, v: f32) -> Option<f32> {
        let (width, height) = (self.depth.width(), self.depth.height());
        // Also false for NaN.
        if !(u >= -0.5 && v >= -0.5 && u < width as f32 - 0.5 && v < height as f32 - 0.5) {
            return None;
        }
        let data = self.depth.data();
        if width > 1 && height > 1 {
            // In the outer half of a border pixel this extrapolates.
            let (x, y) = ((u as usize).min(width - 2), (v as usize).min(height - 2));
            let (a, b) = (u - x as f32, v - y as f32);
            let first = y * width + x;
            let [p, q] = [data[first], data[first + 1]];
            let [r, s] = [data[first + width], data[first + width + 1]];
            let low = p.min(q).min(r.min(s));
            let high = p.max(q).max(r.max(s));
            if low > 0.0 && high - low < self.truncation_m {
                let top = p + (q - p) * a;
                let bottom = r + (s - r) * a;
                return Some(top + (bottom - top) * b);
            }
        }
        let nearest = data[(v + 0.5) as usize * width + (u + 0.5) as usize];
        is_depth(nearest).then_some(nearest)
    }
}
