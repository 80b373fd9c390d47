//! One frame into the volume: which blocks it touches, and how it changes a block.

use mb_geometry::{Camera, Intrinsics, Rigid3, World};
use mb_image::{DepthImage, RgbImage};
use mb_job::{Error, Result};
use multiversion::multiversion;
use nalgebra::{Matrix3, Point2, Vector3};
use rayon::prelude::*;

use crate::volume::{Block, SIDE, too_large};

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
pub(crate) struct FarthestDepth {
    columns: usize,
    tiles: Vec<f32>,
}

impl FarthestDepth {
    pub fn of(depth: &DepthImage) -> Self {
        let columns = depth.width().div_ceil(TILE);
        let mut tiles = vec![0.0; columns * depth.height().div_ceil(TILE)];
        if columns > 0 {
            let bands = depth.data().par_chunks(TILE * depth.width());
            tiles.par_chunks_mut(columns).zip(bands).for_each(|(tiles, band)| {
                farthest_in_band(tiles, band, depth.width());
            });
        }
        Self { columns, tiles }
    }
}

/// The largest depth of each tile of a band of rows.
#[multiversion(targets("x86_64+avx2"))]
fn farthest_in_band(tiles: &mut [f32], band: &[f32], width: usize) {
    let mut most = [0.0f32; TILE];
    for (index, tile) in tiles.iter_mut().enumerate() {
        most.fill(0.0);
        for row in band.chunks_exact(width) {
            let pixels = &row[index * TILE..width.min((index + 1) * TILE)];
            for (most, &z) in most.iter_mut().zip(pixels) {
                *most = if z > *most { z } else { *most };
            }
        }
        *tile = most.iter().fold(0.0, |a, &b| if b > a { b } else { a });
    }
}

/// The blocks that hold any point within `truncation_m` (along z) of what the depth map shows, in ascending order.
///
/// Pixels are visited at a stride whose footprint is at most one voxel, and each stands for those up to the next: the
/// stretch of its ray is grown sideways by the stride.
pub(crate) fn touched_blocks(
    view: &FrameView,
    farthest: &FarthestDepth,
    voxel_size_m: f64,
    truncation_m: f64,
    limit: usize,
) -> Result<Vec<[i32; 3]>> {
    let size = view.depth.size();
    let world_from_cam = view.cam_from_world.inverse();
    let focal = view.intrinsics.fx.min(view.intrinsics.fy);
    let farthest_of_all = farthest.tiles.iter().copied().filter(|&z| is_depth(z)).fold(0.0, f32::max);
    let stride = ((voxel_size_m * focal / f64::from(farthest_of_all)) as usize).clamp(1, SIDE);
    let block_size = voxel_size_m * SIDE as f64;

    // In blocks: a point at depth z on the ray of pixel (x, y) is origin + z * (first + x * across).
    let in_blocks = |v: Vector3<f64>| world_from_cam.rotate(&v) / block_size;
    let origin = world_from_cam.translation() / block_size;
    let across = in_blocks(Vector3::new(1.0 / view.intrinsics.fx, 0.0, 0.0));

    let mark_row = |y: usize, found: &mut FoundBlocks| -> Result<()> {
        let first = in_blocks(view.intrinsics.cam_from_img(&Point2::new(0.0, y as f64), 1.0).coords);
        // The blocks along the previous ray: neighbouring rays mostly touch the same.
        let mut previous = None;
        for (x, &z) in view.depth.row(y).iter().enumerate().step_by(stride) {
            if !is_depth(z) {
                continue;
            }
            let z = f64::from(z);
            let direction = first + across * x as f64;
            let (near, far) = ((z - truncation_m).max(0.0), z + truncation_m);
            let margin = stride as f64 * z / focal / block_size;
            let start = origin + direction * near;
            let end = origin + direction * far;
            if !start.iter().chain(&end).all(|v| v.abs() + margin < MAX_BLOCK_COORD) {
                return Err(Error::Failed(format!(
                    "a surface lies {:.0} m from the origin, too far for voxels of {} mm; check the unit of the poses",
                    end.norm() * block_size,
                    voxel_size_m * 1e3
                )));
            }
            let whole = BlockRange::around(&start, &end, margin);
            // A single row of blocks is touched all along; in a wider range the pieces of the ray decide.
            if whole.is_row() {
                if previous != Some(whole) {
                    found.add(whole)?;
                }
            } else {
                let pieces = (2.0 * (far - near) * direction.norm()).ceil().max(1.0);
                let mut start = start;
                for i in 0..pieces as usize {
                    let end = origin + direction * (near + (far - near) * (i + 1) as f64 / pieces);
                    found.add(BlockRange::around(&start, &end, margin))?;
                    start = end;
                }
            }
            previous = Some(whole);
        }
        Ok(())
    };
    let rows: Vec<usize> = (0..size.height).step_by(stride).collect();
    let mark_rows = |rows: &[usize]| -> Result<Vec<[i32; 3]>> {
        let mut found = FoundBlocks::new(limit, voxel_size_m);
        rows.iter().try_for_each(|&y| mark_row(y, &mut found))?;
        Ok(found.into_sorted())
    };
    let found: Vec<Vec<[i32; 3]>> = rows.par_chunks(16).map(mark_rows).collect::<Result<_>>()?;
    let mut touched = found.concat();
    touched.sort_unstable();
    touched.dedup();
    if touched.len() > limit {
        return Err(too_large(voxel_size_m));
    }
    Ok(touched)
}

/// A box of blocks, both ends included.
#[derive(Clone, Copy, PartialEq)]
struct BlockRange {
    low: Vector3<i32>,
    high: Vector3<i32>,
}

impl BlockRange {
    /// The blocks within `margin` of the box that two points span, all in blocks.
    fn around(a: &Vector3<f64>, b: &Vector3<f64>, margin: f64) -> Self {
        // Plain comparisons: these compile to single instructions, `f64::min` does not.
        let low = a.zip_map(b, |a, b| if a < b { a } else { b });
        let high = a.zip_map(b, |a, b| if a > b { a } else { b });
        Self { low: low.map(|v| floor(v - margin)), high: high.map(|v| floor(v + margin)) }
    }

    /// Whether the blocks lie in one line along an axis.
    fn is_row(&self) -> bool {
        (0..3).filter(|&axis| self.low[axis] < self.high[axis]).count() <= 1
    }

    fn count(&self) -> f64 {
        (0..3).map(|axis| f64::from(self.high[axis] - self.low[axis] + 1)).product()
    }
}

/// A list of blocks that forgets most repetitions as they come.
struct FoundBlocks {
    blocks: Vec<[i32; 3]>,
    /// The block that last fell into each slot.
    recent: [[i32; 3]; 256],
    limit: usize,
    voxel_size_m: f64,
}

impl FoundBlocks {
    /// A list of at most `limit` blocks.
    fn new(limit: usize, voxel_size_m: f64) -> Self {
        Self { blocks: Vec::new(), recent: [[i32::MAX; 3]; 256], limit, voxel_size_m }
    }

    fn add(&mut self, range: BlockRange) -> Result<()> {
        // A depth map whose pixels are many blocks wide cannot be fused at this voxel size.
        if self.blocks.len() as f64 + range.count() > self.limit as f64 {
            self.blocks.sort_unstable();
            self.blocks.dedup();
            if self.blocks.len() as f64 + range.count() > self.limit as f64 {
                return Err(too_large(self.voxel_size_m));
            }
        }
        let BlockRange { low, high } = range;
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                for x in low.x..=high.x {
                    let slot = &mut self.recent[((x & 7) | (y & 7) << 3 | (z & 3) << 6) as usize];
                    if *slot != [x, y, z] {
                        *slot = [x, y, z];
                        self.blocks.push([x, y, z]);
                    }
                }
            }
        }
        Ok(())
    }

    /// Each block once, in ascending order.
    fn into_sorted(mut self) -> Vec<[i32; 3]> {
        self.blocks.sort_unstable();
        self.blocks.dedup();
        self.blocks
    }
}

/// The largest integer not above `x`, for `x` within [`MAX_BLOCK_COORD`]; the library's is a call on older processors.
fn floor(x: f64) -> i32 {
    let cut = x as i32;
    cut - i32::from(f64::from(cut) > x)
}

impl<'a> FrameView<'a> {
    /// Everything about the frame that a block's update needs, in single precision.
    pub fn updater(&self, farthest: FarthestDepth, voxel_size_m: f64, truncation_m: f64) -> BlockUpdater<'a> {
        let size = self.depth.size();
        let color = self.color.map(|image| {
            let scale = |to: usize, from: usize| to as f32 / from as f32;
            (image, [scale(image.width(), size.width), scale(image.height(), size.height)])
        });
        let steps: Matrix3<f32> = (self.cam_from_world.rotation_matrix() * voxel_size_m).cast();
        BlockUpdater {
            depth: self.depth,
            farthest,
            color,
            focal: [self.intrinsics.fx as f32, self.intrinsics.fy as f32],
            center: [self.intrinsics.cx as f32, self.intrinsics.cy as f32],
            cam_from_world: *self.cam_from_world,
            steps,
            layer: std::array::from_fn(|axis| {
                std::array::from_fn(|i| steps[(axis, 0)] * (i % SIDE) as f32 + steps[(axis, 1)] * (i / SIDE) as f32)
            }),
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
    /// Camera x, y, z of the voxels of a layer, from its first.
    layer: [Layer; 3],
    voxel_size_m: f64,
    truncation_m: f32,
}

impl BlockUpdater<'_> {
    /// Updates the voxels of blocks that this frame sees.
    pub fn update(&self, blocks: &mut [Block]) {
        for block in blocks {
            let corner = block.coord.map(|c| f64::from(c) * SIDE as f64 * self.voxel_size_m);
            let corner: Vector3<f32> = (self.cam_from_world * nalgebra::Point3::from(corner)).coords.cast();
            if self.may_see(&corner) {
                update_block(self, block, &corner);
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

    /// Averages the photograph's pixel at image position (`u`, `v`) into a voxel's colour.
    fn update_color(&self, color: &mut [f32; 3], u: f32, v: f32, share: f32) {
        let Some((image, scale)) = self.color else { return };
        let pixel = |at: f32, scale: f32, count: usize| (((at + 0.5) * scale) as usize).min(count - 1);
        let seen = image[(pixel(u, scale[0], image.width()), pixel(v, scale[1], image.height()))];
        for (average, seen) in color.iter_mut().zip(seen) {
            *average += (f32::from(seen) - *average) * share;
        }
    }
}

/// Voxels of a block's layer, which are computed together.
const LAYER: usize = SIDE * SIDE;
type Layer = [f32; LAYER];

/// Averages a frame into a block whose first voxel is at `corner` (camera frame).
///
/// Compiled for wider vectors too; nothing is contracted to fused operations, so every processor gives the same bits.
/// Each loop does one thing to a whole layer, which is what the compiler turns into vectors.
#[multiversion(targets("x86_64+avx2"))]
fn update_block(frame: &BlockUpdater, block: &mut Block, corner: &Vector3<f32>) {
    let (distances, _) = block.distance_m.as_chunks_mut::<LAYER>();
    let (weights, _) = block.weight.as_chunks_mut::<LAYER>();
    let [across, down, along] = &frame.layer;
    let (mut z, mut u, mut v, mut seen, mut share) =
        ([0.0; LAYER], [0.0; LAYER], [0.0; LAYER], [0.0; LAYER], [0.0; LAYER]);
    for (number, (distance, weight)) in distances.iter_mut().zip(weights).enumerate() {
        let start = corner + frame.steps.column(2) * number as f32;
        for i in 0..LAYER {
            z[i] = start.z + along[i];
            u[i] = frame.focal[0] * (start.x + across[i]) / z[i] + frame.center[0];
            v[i] = frame.focal[1] * (start.y + down[i]) / z[i] + frame.center[1];
        }
        if !depth_at(frame.depth, frame.truncation_m, (&z, &u, &v), &mut seen) {
            continue;
        }
        for i in 0..LAYER {
            let ahead = seen[i] - z[i];
            // Also false where nothing is seen, which is far nearer than any voxel.
            let counts = ahead >= -frame.truncation_m;
            let ahead = if ahead < frame.truncation_m { ahead } else { frame.truncation_m };
            let grown = weight[i] + 1.0;
            share[i] = if counts { 1.0 / grown } else { 0.0 };
            weight[i] = if counts { grown } else { weight[i] };
            let change = (ahead - distance[i]) * share[i];
            distance[i] += if counts { change } else { 0.0 };
        }
        if let Some(colors) = &mut block.color {
            for (i, color) in colors[number * LAYER..][..LAYER].iter_mut().enumerate() {
                if share[i] > 0.0 {
                    frame.update_color(color, u[i], v[i], share[i]);
                }
            }
        }
    }
}

/// Depth where voxels at depths `z` and pixels (`u`, `v`) are seen: interpolated on smooth surfaces, else that of the
/// nearest pixel; minus infinity where there is none. False where none of them lies in the image.
#[inline(always)]
fn depth_at(depth: &DepthImage, jump_m: f32, (z, u, v): (&Layer, &Layer, &Layer), seen: &mut Layer) -> bool {
    let (width, height) = (depth.width(), depth.height());
    let data = depth.data();
    let (right, bottom) = (width as f32 - 0.5, height as f32 - 0.5);
    // In the outer half of a border pixel the interpolation extrapolates.
    let (last_x, last_y) = (width.saturating_sub(2) as f32, height.saturating_sub(2) as f32);
    let clamp = |x: f32, most: f32| {
        let x = if x > 0.0 { x } else { 0.0 };
        if x < most { x } else { most }
    };
    let mut inside = [0u32; LAYER];
    let mut any = 0;
    let (mut first, mut a, mut b) = ([0i32; LAYER], [0.0; LAYER], [0.0; LAYER]);
    for i in 0..LAYER {
        // All false for NaN.
        let within = (z[i] > 0.0) & (u[i] >= -0.5) & (u[i] < right) & (v[i] >= -0.5) & (v[i] < bottom);
        inside[i] = u32::from(within);
        any |= inside[i];
        let (x, y) = (clamp(u[i], last_x) as i32, clamp(v[i], last_y) as i32);
        (a[i], b[i]) = (u[i] - x as f32, v[i] - y as f32);
        first[i] = y * width as i32 + x;
    }
    if any == 0 {
        return false;
    }
    // An image of one column or row has no neighbours there.
    let (next_x, next_y) = (usize::from(width > 1), if height > 1 { width } else { 0 });
    let mut corners = [[0.0; LAYER]; 4];
    for i in 0..LAYER {
        let around = &data[first[i] as usize..][..=next_y + next_x];
        (corners[0][i], corners[1][i]) = (around[0], around[next_x]);
        (corners[2][i], corners[3][i]) = (around[next_y], around[next_y + next_x]);
    }
    let [p, q, r, s] = &corners;
    let min = |a: f32, b: f32| if a < b { a } else { b };
    let max = |a: f32, b: f32| if a > b { a } else { b };
    for i in 0..LAYER {
        let low = min(min(p[i], q[i]), min(r[i], s[i]));
        let high = max(max(p[i], q[i]), max(r[i], s[i]));
        let over = p[i] + (q[i] - p[i]) * a[i];
        let under = r[i] + (s[i] - r[i]) * a[i];
        let smooth = over + (under - over) * b[i];
        let upper = if a[i] < 0.5 { p[i] } else { q[i] };
        let lower = if a[i] < 0.5 { r[i] } else { s[i] };
        let nearest = if b[i] < 0.5 { upper } else { lower };
        let found = if (low > 0.0) & (high - low < jump_m) { smooth } else { nearest };
        // Also false for NaN.
        let counts = (inside[i] != 0) & (found > 0.0) & (found < f32::INFINITY);
        seen[i] = if counts { found } else { f32::NEG_INFINITY };
    }
    true
}
