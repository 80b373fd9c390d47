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

/// The blocks that hold any point within `truncation_m` (along z) of what the depth map shows, in ascending order.
///
/// Pixels are visited at a stride whose footprint is at most one voxel, and each stands for its surroundings: the
/// stretch of its ray is grown sideways by more than the distance to the next visited pixel.
pub(crate) fn touched_blocks(
    view: &FrameView,
    voxel_size_m: f64,
    truncation_m: f64,
    limit: usize,
) -> Result<Vec<[i32; 3]>> {
    let size = view.depth.size();
    let world_from_cam = view.cam_from_world.inverse();
    let focal = view.intrinsics.fx.min(view.intrinsics.fy);
    let farthest = view.depth.data().iter().copied().filter(|&z| is_depth(z)).fold(0.0, f32::max);
    if farthest == 0.0 {
        return Ok(Vec::new());
    }
    let stride = ((voxel_size_m * focal / f64::from(farthest)) as usize).clamp(1, SIDE);
    let block_size = voxel_size_m * SIDE as f64;

    let rows: Vec<usize> = (0..size.height).step_by(stride).collect();
    let mark_row = |&y: &usize| -> Result<Vec<[i32; 3]>> {
        let mut found = Vec::new();
        let mut last = None;
        for x in (0..size.width).step_by(stride) {
            let z = view.depth[(x, y)];
            if !is_depth(z) {
                continue;
            }
            let z = f64::from(z);
            let ray = view.intrinsics.ray(&Point2::new(x as f64, y as f64), &world_from_cam);
            let near = (z - truncation_m).max(0.0);
            let far = z + truncation_m;
            let pieces = ((far - near) * ray.direction.norm() / (0.5 * block_size)).ceil().max(1.0);
            let margin = 0.5 * stride as f64 * z / focal + 0.5 * voxel_size_m;
            let mut start = ray.at(near);
            for i in 1..=pieces as usize {
                let end = ray.at(near + (far - near) * i as f64 / pieces);
                let lowest = (start.inf(&end).coords.add_scalar(-margin) / block_size).map(f64::floor);
                let highest = (start.sup(&end).coords.add_scalar(margin) / block_size).map(f64::floor);
                if !(lowest.min() > -MAX_BLOCK_COORD && highest.max() < MAX_BLOCK_COORD) {
                    return Err(Error::Failed(format!(
                        "a surface lies {:.0} m from the origin, too far for voxels of {} mm; check the unit of the poses",
                        end.coords.norm(),
                        voxel_size_m * 1e3
                    )));
                }
                start = end;
                let range = (lowest.map(|c| c as i32), highest.map(|c| c as i32));
                // Neighbouring pixels mostly see the same blocks.
                if last == Some(range) {
                    continue;
                }
                last = Some(range);
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
            for x in 0..SIDE {
                let p = start + dx * x as f32;
                self.update_voxel(block, row * SIDE + x, &p);
            }
        }
    }

    /// Whether a block whose first voxel is at `corner` (camera frame) can project into the image.
    fn may_see(&self, corner: &Vector3<f32>) -> bool {
        let half = (SIDE - 1) as f32 / 2.0;
        let center = corner + self.steps * Vector3::repeat(half);
        let radius = half * 3f32.sqrt() * self.voxel_size_m as f32;
        if center.z + radius <= 0.0 {
            return false;
        }
        // Distance of the centre from each side of the view's pyramid, inside positive.
        let size = self.depth.size();
        let inside = |focal: f32, middle: f32, pixels: usize, across: f32| {
            let low = (middle + 0.5) / focal;
            let high = (pixels as f32 - 0.5 - middle) / focal;
            let from_low = (across + low * center.z) / (1.0 + low * low).sqrt();
            let from_high = (high * center.z - across) / (1.0 + high * high).sqrt();
            from_low >= -radius && from_high >= -radius
        };
        inside(self.focal[0], self.center[0], size.width, center.x)
            && inside(self.focal[1], self.center[1], size.height, center.y)
    }

    #[inline(always)]
    fn update_voxel(&self, block: &mut Block, voxel: usize, p_in_cam: &Vector3<f32>) {
        if p_in_cam.z <= 0.0 {
            return;
        }
        let per_z = 1.0 / p_in_cam.z;
        let u = self.focal[0] * p_in_cam.x * per_z + self.center[0];
        let v = self.focal[1] * p_in_cam.y * per_z + self.center[1];
        let Some(z) = self.depth_at(u, v) else { return };
        let ahead = z - p_in_cam.z;
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
