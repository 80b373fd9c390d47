//! What the rasteriser and the ray caster return.

use mb_image::{DepthImage, Image, Mask};

/// Marks pixels that see no triangle.
pub const NO_TRIANGLE: u32 = u32::MAX;

/// What a camera sees, pixel by pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct Raster {
    /// Depth along z at the pixel's centre, metres; 0 where nothing is seen.
    pub depth: DepthImage,
    /// Index of the nearest triangle, [`NO_TRIANGLE`] where nothing is seen. Which one of triangles at the very same
    /// depth is seen depends on the mesh and the view alone.
    pub triangle: Image<u32>,
}

impl Raster {
    /// Where anything is seen.
    pub fn mask(&self) -> Mask {
        self.triangle.map(|&t| t != NO_TRIANGLE)
    }
}
