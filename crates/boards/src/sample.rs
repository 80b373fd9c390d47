//! Brightness of a photograph, at and between its pixels.

use mb_image::{Image, RgbImage};
use nalgebra::Point2;

/// Brightness of a colour photograph, Rec. 601 weights on the values as stored.
pub fn luma(image: &RgbImage) -> Image<u8> {
    image.map(|&[r, g, b]| ((77 * u32::from(r) + 150 * u32::from(g) + 29 * u32::from(b) + 128) >> 8) as u8)
}

/// Brightness between pixels; `None` outside.
pub(crate) fn bilinear(image: &Image<u8>, p: &Point2<f64>) -> Option<f32> {
    let (x, y) = (p.x.floor(), p.y.floor());
    let inside = x >= 0.0 && y >= 0.0 && x + 1.0 < image.width() as f64 && y + 1.0 < image.height() as f64;
    if !inside {
        return None;
    }
    let (u, v) = ((p.x - x) as f32, (p.y - y) as f32);
    let (x, y) = (x as usize, y as usize);
    let (top, bottom) = (&image.row(y)[x..x + 2], &image.row(y + 1)[x..x + 2]);
    let mix = |pair: &[u8]| f32::from(pair[0]) + u * (f32::from(pair[1]) - f32::from(pair[0]));
    let (above, below) = (mix(top), mix(bottom));
    Some(above + v * (below - above))
}
