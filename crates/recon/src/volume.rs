//! The sparse volume of truncated signed distances.

use std::collections::HashMap;

use mb_geometry::{Camera, Intrinsics, Rigid3, World};
use mb_image::{DepthImage, RgbImage};
use mb_job::{Error, Result};
use rayon::prelude::*;

use crate::integrate::{DepthTiles, FrameView, touched_blocks};

/// Voxels along each side of a block.
pub(crate) const SIDE: usize = 8;
/// Voxels of a block.
pub(crate) const VOXELS: usize = SIDE * SIDE * SIDE;

/// A volume that would grow beyond this is refused: two gigabytes are more than six square metres of surface at 1 mm.
pub const MAX_VOLUME_BYTES: usize = 2 << 30;

/// A cube of 8x8x8 voxels. Voxel `(x, y, z)` of it is number `x + 8 * (y + 8 * z)`.
pub(crate) struct Block {
    /// Position in blocks; the first voxel lies at `8 * voxel_size * coord`.
    pub coord: [i32; 3],
    /// Average truncated distance, metres, positive towards the cameras.
    pub distance_m: [f32; VOXELS],
    /// Sum of weights, 0 = never seen.
    pub weight: [f32; VOXELS],
    /// Average colour (0 to 255), where the frames had photographs.
    pub color: Option<Box<[[f32; 3]; VOXELS]>>,
}

impl Block {
    fn new(coord: [i32; 3], colored: bool) -> Self {
        let color = colored.then(|| Box::new([[0.0; 3]; VOXELS]));
        Self { coord, distance_m: [0.0; VOXELS], weight: [0.0; VOXELS], color }
    }
}

/// A volume of truncated signed distances in blocks of 8x8x8 voxels, which exist only near surfaces.
///
/// Voxels are samples at integer multiples of the voxel size in the world frame. Every depth map updates all voxels of
/// existing blocks in its view: the distance along z to the measured surface, cut at the truncation, is averaged over
/// the frames; voxels further behind the surface than the truncation are not seen and stay as they are (Curless and
/// Levoy, "A volumetric method for building complex models from range images", 1996). The result depends neither on
/// the number of threads nor, where all frames were announced by [`TsdfVolume::allocate`] first, on their order
/// beyond rounding.
pub struct TsdfVolume {
    voxel_size_m: f64,
    truncation_m: f64,
    pub(crate) blocks: Vec<Block>,
    index: HashMap<[i32; 3], u32>,
    colored: bool,
}

impl TsdfVolume {
    /// An empty volume. Distances are cut at `truncation_m`, which must be from 1.5 to 64 voxels: less cannot hold a
    /// zero crossing, more fills memory with blocks far from any surface.
    ///
    /// # Errors
    /// Sizes that are not positive and finite, or a truncation out of range.
    pub fn new(voxel_size_m: f64, truncation_m: f64) -> Result<Self> {
        if !(voxel_size_m.is_finite() && voxel_size_m > 0.0) {
            return Err(Error::Failed(format!("the voxel size must be above 0 metres, it is {voxel_size_m}")));
        }
        let voxels = truncation_m / voxel_size_m;
        if !(1.5..=64.0).contains(&voxels) {
            return Err(Error::Failed(format!(
                "the truncation must be from 1.5 to 64 voxels; {truncation_m} m at {voxel_size_m} m a voxel is {voxels:.1}"
            )));
        }
        Ok(Self { voxel_size_m, truncation_m, blocks: Vec::new(), index: HashMap::new(), colored: false })
    }

    /// Edge of a voxel, metres.
    pub fn voxel_size_m(&self) -> f64 {
        self.voxel_size_m
    }

    /// Largest distance that is told apart, metres.
    pub fn truncation_m(&self) -> f64 {
        self.truncation_m
    }

    /// Number of blocks that exist.
    pub fn blocks(&self) -> usize {
        self.blocks.len()
    }

    /// Memory that the blocks take, bytes.
    pub fn bytes(&self) -> usize {
        self.blocks.len() * self.bytes_per_block()
    }

    fn bytes_per_block(&self) -> usize {
        size_of::<Block>() + if self.colored { size_of::<[[f32; 3]; VOXELS]>() } else { 0 }
    }

    /// The number of the block at a position in blocks.
    pub(crate) fn index_of(&self, coord: [i32; 3]) -> Option<u32> {
        self.index.get(&coord).copied()
    }

    /// Adds an empty block where there is none yet.
    pub(crate) fn add_block(&mut self, coord: [i32; 3]) -> &mut Block {
        let number = self.blocks.len();
        self.index.insert(coord, number as u32);
        self.blocks.push(Block::new(coord, self.colored));
        &mut self.blocks[number]
    }

    /// Makes the blocks within the truncation of what a depth map shows, without changing any distance. Announcing all
    /// frames before the first [`TsdfVolume::integrate`] lets every frame clear the free space that it saw in blocks
    /// that only later frames fill.
    ///
    /// # Errors
    /// The volume would outgrow [`MAX_VOLUME_BYTES`], or lies too far from the origin for its voxel size.
    pub fn allocate(
        &mut self,
        depth: &DepthImage,
        intrinsics: &Intrinsics,
        cam_from_world: &Rigid3<Camera, World>,
    ) -> Result<()> {
        let view = FrameView { depth, color: None, intrinsics, cam_from_world };
        self.allocate_touched(&view, &DepthTiles::of(depth))
    }

    fn allocate_touched(&mut self, view: &FrameView, tiles: &DepthTiles) -> Result<()> {
        let limit = MAX_VOLUME_BYTES / self.bytes_per_block();
        let touched = touched_blocks(view, tiles, self.voxel_size_m, self.truncation_m, limit)?;
        let new: Vec<[i32; 3]> = touched.into_iter().filter(|coord| !self.index.contains_key(coord)).collect();
        if self.blocks.len() + new.len() > limit {
            return Err(too_large(self.voxel_size_m));
        }
        for coord in new {
            self.add_block(coord);
        }
        Ok(())
    }

    /// Averages one frame into the volume. `depth` is along z in metres, 0 = no value, with its own `intrinsics`;
    /// `color` is the photograph of the same view at any size.
    ///
    /// Between pixels depth is interpolated, except across jumps larger than the truncation, where the nearest pixel
    /// counts: interpolation there would invent a surface in mid-air.
    ///
    /// # Errors
    /// As [`TsdfVolume::allocate`].
    pub fn integrate(
        &mut self,
        depth: &DepthImage,
        color: Option<&RgbImage>,
        intrinsics: &Intrinsics,
        cam_from_world: &Rigid3<Camera, World>,
    ) -> Result<()> {
        if color.is_some() && !self.colored {
            self.colored = true;
            for block in &mut self.blocks {
                block.color = Some(Box::new([[0.0; 3]; VOXELS]));
            }
        }
        let view = FrameView { depth, color, intrinsics, cam_from_world };
        let tiles = DepthTiles::of(depth);
        self.allocate_touched(&view, &tiles)?;
        let updater = view.updater(tiles, self.voxel_size_m, self.truncation_m);
        self.blocks.par_chunks_mut(16).for_each(|blocks| updater.update(blocks));
        Ok(())
    }
}

pub(crate) fn too_large(voxel_size_m: f64) -> Error {
    Error::Failed(format!(
        "the volume would need more than {} GB of memory at {} mm a voxel; use larger voxels or a smaller depth range",
        MAX_VOLUME_BYTES >> 30,
        voxel_size_m * 1e3
    ))
}
