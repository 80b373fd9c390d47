//! Typed images: colour, depth in metres, masks, confidence; and their files.
//!
//! An [`Image`] is a row-major grid; the pixel (x, y) is column x, row y, and its centre lies at integer coordinates.
//! Depth is z in metres as `f32`, 0 where there is no value; on disk it is a 16-bit PNG in millimetres.

mod exr;
mod grid;
mod io;

pub use exr::decode_depth_exr;
pub use grid::{Confidence, DepthImage, Image, Mask, RgbImage};
pub use io::{
    MAX_PIXELS, decode_rgb, is_grey16, read_confidence_png, read_depth_png, read_depth_png_mm, read_mask_png, read_rgb,
    read_rgb_fraction, read_size, write_confidence_png, write_depth_png, write_jpeg, write_mask_png, write_rgb_png,
};
