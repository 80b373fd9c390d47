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

/// Pixels along each side of a tile of [`DepthTiles`].
const TILE: usize = 8;

/// The range of depths in each tile of a depth map, row by row.
pub(crate) struct DepthTiles {
    columns: usize,
    tiles: Vec<DepthRange>,
}

/// From the nearest to the farthest depth; `far` is 0 where there is none.
#[derive(Clone, Copy)]
struct DepthRange {
    near: f32,
    far: f32,
}

impl DepthRange {
    const NONE: Self = Self { near: f32::INFINITY, far: 0.0 };
}

impl DepthTiles {
    pub fn of(depth: &DepthImage) -> Self {
        let columns = depth.width().div_ceil(TILE);
        let mut tiles = vec![DepthRange::NONE; columns * depth.height().div_ceil(TILE)];
        if columns > 0 {
            let bands = depth.data().par_chunks(TILE * depth.width());
            tiles.par_chunks_mut(columns).zip(bands).with_min_len(8).for_each_init(
                || (vec![0.0; depth.width()], vec![0.0; depth.width()]),
                |(near, far), (tiles, band)| ranges_in_band(tiles, band, near, far),
            );
        }
        Self { columns, tiles }
    }

    fn farthest(&self) -> f32 {
        self.tiles.iter().map(|tile| tile.far).fold(0.0, f32::max)
    }
}

/// The depths of each tile of a band of rows; `near` and `far` are room for one row.
#[multiversion(targets("x86_64+avx2"))]
fn ranges_in_band(tiles: &mut [DepthRange], band: &[f32], near: &mut [f32], far: &mut [f32]) {
    near.fill(f32::INFINITY);
    far.fill(0.0);
    // Rows from end to end, as memory likes it.
    for row in band.chunks_exact(far.len()) {
        for ((near, far), &z) in near.iter_mut().zip(far.iter_mut()).zip(row) {
            // Both are also false for NaN.
            *far = far.max(if z < f32::INFINITY { z } else { 0.0 });
            *near = near.min(if z > 0.0 { z } else { f32::INFINITY });
        }
    }
    for (tile, (near, far)) in tiles.iter_mut().zip(near.chunks(TILE).zip(far.chunks(TILE))) {
        tile.near = near.iter().fold(f32::INFINITY, |a, &b| if b < a { b } else { a });
        tile.far = far.iter().fold(0.0, |a, &b| if b > a { b } else { a });
    }
}

/// The blocks that hold any point within `truncation_m` (along z) of what the depth map shows, in ascending order.
///
/// Where depth changes little, a tile of pixels is taken as one thick ray. Elsewhere pixels are visited at a stride whose
/// footprint is at most one voxel, and each stands for those around it.
pub(crate) fn touched_blocks(
    view: &FrameView,
    tiles: &DepthTiles,
    voxel_size_m: f64,
    truncation_m: f64,
    limit: usize,
) -> Result<Vec<[i32; 3]>> {
    let size = view.depth.size();
    let world_from_cam = view.cam_from_world.inverse();
    let focal = view.intrinsics.fx.min(view.intrinsics.fy);
    let stride = ((voxel_size_m * focal / f64::from(tiles.farthest())) as usize).clamp(1, TILE);
    let block_size = voxel_size_m * SIDE as f64;

    // In blocks: a point at depth z on the ray of pixel (x, y) is origin + z * (first + x * across + y * down).
    let in_blocks = |v: Vector3<f64>| world_from_cam.rotate(&v) / block_size;
    let rays = Rays {
        origin: world_from_cam.translation() / block_size,
        first: in_blocks(view.intrinsics.cam_from_img(&Point2::origin(), 1.0).coords),
        across: in_blocks(Vector3::new(1.0 / view.intrinsics.fx, 0.0, 0.0)),
        down: in_blocks(Vector3::new(0.0, 1.0 / view.intrinsics.fy, 0.0)),
        truncation_m,
    };
    let mark_tile = |column: usize, row: usize, tile: DepthRange, found: &mut FoundBlocks| -> Result<()> {
        let (near, far) = (f64::from(tile.near), f64::from(tile.far));
        let corner = [column * TILE, row * TILE];
        if far - near <= truncation_m {
            let middle = corner.map(|v| v as f64 + (TILE - 1) as f64 / 2.0);
            return rays.mark(middle, TILE as f64 / 2.0, near, far, found);
        }
        for y in (corner[1]..size.height.min(corner[1] + TILE)).step_by(stride) {
            for x in (corner[0]..size.width.min(corner[0] + TILE)).step_by(stride) {
                let z = view.depth[(x, y)];
                if is_depth(z) {
                    let z = f64::from(z);
                    rays.mark([x as f64, y as f64], stride as f64, z, z, found)?;
                }
            }
        }
        Ok(())
    };
    let mark_rows = |(band, rows): (usize, &[DepthRange])| -> Result<Vec<[i32; 3]>> {
        let mut found = FoundBlocks::new(limit, voxel_size_m);
        for (i, &tile) in rows.iter().enumerate().filter(|(_, tile)| tile.far > 0.0) {
            mark_tile(i % tiles.columns, band * BAND + i / tiles.columns, tile, &mut found)?;
        }
        Ok(found.into_sorted())
    };
    let found: Vec<Vec<[i32; 3]>> =
        tiles.tiles.par_chunks(BAND * tiles.columns.max(1)).enumerate().map(mark_rows).collect::<Result<_>>()?;
    let mut touched = found.concat();
    touched.sort_unstable();
    touched.dedup();
    if touched.len() > limit {
        return Err(too_large(voxel_size_m));
    }
    Ok(touched)
}

/// Rows of tiles that are searched for blocks in one go.
const BAND: usize = 8;

/// The rays of an image's pixels, in blocks.
struct Rays {
    origin: Vector3<f64>,
    /// Direction of pixel (0, 0) for a depth of 1 m, and what a pixel to the right and one below add to it.
    first: Vector3<f64>,
    across: Vector3<f64>,
    down: Vector3<f64>,
    truncation_m: f64,
}

impl Rays {
    /// Adds the blocks along the ray of a pixel, `reach` pixels thick to each side, within the truncation of the depths from
    /// `near` to `far`.
    fn mark(&self, pixel: [f64; 2], reach: f64, near: f64, far: f64, found: &mut FoundBlocks) -> Result<()> {
        let direction = self.first + self.across * pixel[0] + self.down * pixel[1];
        let (near, far) = ((near - self.truncation_m).max(0.0), far + self.truncation_m);
        let margin = (self.across.abs() + self.down.abs()) * (reach * far);
        let start = self.origin + direction * near;
        let end = self.origin + direction * far;
        let within = |v: &Vector3<f64>| (v.abs() + margin).iter().all(|&v| v < MAX_BLOCK_COORD);
        if !(within(&start) && within(&end)) {
            return Err(found.too_far(&end));
        }
        let whole = BlockRange::around(&start, &end, &margin);
        // A single row of blocks is touched all along; in a wider range the pieces of the ray decide.
        if whole.is_row() {
            return found.add(whole);
        }
        let pieces = (2.0 * (far - near) * direction.norm()).ceil().max(1.0);
        let step = (end - start) / pieces;
        let mut start = start;
        for _ in 0..pieces as usize {
            let end = start + step;
            found.add(BlockRange::around(&start, &end, &margin))?;
            start = end;
        }
        Ok(())
    }
}

/// A box of blocks, both ends included.
#[derive(Clone, Copy)]
struct BlockRange {
    low: Vector3<i32>,
    high: Vector3<i32>,
}

impl BlockRange {
    /// The blocks within `margin` (of each axis) of the box that two points span, all in blocks.
    fn around(a: &Vector3<f64>, b: &Vector3<f64>, margin: &Vector3<f64>) -> Self {
        // Plain comparisons: these compile to single instructions, `f64::min` does not.
        let low = a.zip_map(b, |a, b| if a < b { a } else { b });
        let high = a.zip_map(b, |a, b| if a > b { a } else { b });
        Self { low: (low - margin).map(floor), high: (high + margin).map(floor) }
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

    fn too_far(&self, at: &Vector3<f64>) -> Error {
        Error::Failed(format!(
            "a surface lies {:.0} m from the origin, too far for voxels of {} mm; check the unit of the poses",
            at.norm() * self.voxel_size_m * SIDE as f64,
            self.voxel_size_m * 1e3
        ))
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

/// The largest integer not above `x`, from 0 to 2^22, twice. In arithmetic that becomes vectors; conversions do not.
#[inline(always)]
fn floor_pixel(x: f32) -> (f32, i32) {
    // From 2^23 on, single precision holds integers only: adding rounds, and the last bits are the number.
    const SHIFT: f32 = (1 << 23) as f32;
    let shifted = x + SHIFT;
    let rounded = shifted - SHIFT;
    let number = (shifted.to_bits() ^ SHIFT.to_bits()) as i32;
    if rounded > x { (rounded - 1.0, number.wrapping_sub(1)) } else { (rounded, number) }
}

/// The largest integer not above `x`, for `x` within [`MAX_BLOCK_COORD`]; the library's is a call on older processors.
fn floor(x: f64) -> i32 {
    let cut = x as i32;
    cut - i32::from(f64::from(cut) > x)
}

impl<'a> FrameView<'a> {
    /// Everything about the frame that a block's update needs, in single precision.
    pub fn updater(&self, tiles: DepthTiles, voxel_size_m: f64, truncation_m: f64) -> BlockUpdater<'a> {
        let size = self.depth.size();
        let color = self.color.map(|image| {
            let scale = |to: usize, from: usize| to as f32 / from as f32;
            (image, [scale(image.width(), size.width), scale(image.height(), size.height)])
        });
        let steps: Matrix3<f32> = (self.cam_from_world.rotation_matrix() * voxel_size_m).cast();
        BlockUpdater {
            depth: self.depth,
            tiles,
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
    tiles: DepthTiles,
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
            let tiles = &self.tiles.tiles[row * self.tiles.columns..][left / TILE..=right / TILE];
            tiles.iter().any(|tile| tile.far > 0.0 && tile.far >= hidden_beyond)
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
            // Sums of nothing in place of branches: stores under a mask are slow on some processors.
            weight[i] += if counts { 1.0 } else { 0.0 };
            share[i] = if counts { 1.0 / weight[i] } else { 0.0 };
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
        inside[i] = if within { 1 } else { 0 };
        any |= inside[i];
        let ((x, column), (y, row)) = (floor_pixel(clamp(u[i], last_x)), floor_pixel(clamp(v[i], last_y)));
        (a[i], b[i]) = (u[i] - x, v[i] - y);
        first[i] = row.wrapping_mul(width as i32).wrapping_add(column);
    }
    if any == 0 {
        return false;
    }
    // An image of one column or row has no neighbours there.
    let below = if height > 1 { width } else { 0 };
    let (mut upper, mut lower) = ([[0.0; 2]; LAYER], [[0.0; 2]; LAYER]);
    for i in 0..LAYER {
        let at = first[i] as usize;
        if width > 1 {
            upper[i].copy_from_slice(&data[at..][..2]);
            lower[i].copy_from_slice(&data[at..][below..][..2]);
        } else {
            (upper[i], lower[i]) = ([data[at]; 2], [data[at + below]; 2]);
        }
    }
    let min = |a: f32, b: f32| if a < b { a } else { b };
    let max = |a: f32, b: f32| if a > b { a } else { b };
    for i in 0..LAYER {
        let ([p, q], [r, s]) = (upper[i], lower[i]);
        let low = min(min(p, q), min(r, s));
        let high = max(max(p, q), max(r, s));
        let over = p + (q - p) * a[i];
        let under = r + (s - r) * a[i];
        let smooth = over + (under - over) * b[i];
        let nearest = [if a[i] < 0.5 { p } else { q }, if a[i] < 0.5 { r } else { s }];
        let nearest = if b[i] < 0.5 { nearest[0] } else { nearest[1] };
        let found = if (low > 0.0) & (high - low < jump_m) { smooth } else { nearest };
        // Also false for NaN.
        let counts = (inside[i] != 0) & (found > 0.0) & (found < f32::INFINITY);
        seen[i] = if counts { found } else { f32::NEG_INFINITY };
    }
    true
}
