//! Frames and depth maps as pictures for people.

use mb_capture::Frame;
use mb_geometry::ImageSize;
use mb_image::{DepthImage, RgbImage};
use nalgebra::Vector3;

/// At most `count` of the frames that have a photograph, evenly spread.
pub(crate) fn spread(frames: &[Frame], count: usize) -> Vec<&Frame> {
    let with_image: Vec<&Frame> = frames.iter().filter(|f| f.image.is_some()).collect();
    let count = count.min(with_image.len());
    (0..count).map(|i| with_image[i * with_image.len() / count]).collect()
}

/// Clockwise quarter turns that bring the world's up to the top of a frame's picture.
pub(crate) fn turns_to_upright(frame: &Frame, up_in_world: &Vector3<f64>) -> usize {
    let up_in_cam = frame.world_from_cam.inverse().rotate(up_in_world);
    match (up_in_cam.x.abs() > up_in_cam.y.abs(), up_in_cam.x > 0.0, up_in_cam.y > 0.0) {
        (true, false, _) => 1,
        (false, _, true) => 2,
        (true, true, _) => 3,
        (false, _, false) => 0,
    }
}

/// A depth map at the photograph's size, each pixel the nearest of its own.
pub(crate) fn enlarged(depth: &DepthImage, size: ImageSize) -> DepthImage {
    let at = |i: usize, to: usize, from: usize| ((2 * i + 1) * to / (2 * from)).min(to - 1);
    DepthImage::from_fn(size, |x, y| depth[(at(x, depth.width(), size.width), at(y, depth.height(), size.height))])
}

/// A photograph whose longer side has at most `longest` pixels; each pixel the mean of those that it covers.
pub(crate) fn thumbnail(photo: &RgbImage, longest: usize) -> RgbImage {
    let by = photo.width().max(photo.height()).div_ceil(longest).max(1);
    let size = ImageSize::new((photo.width() / by).max(1), (photo.height() / by).max(1));
    RgbImage::from_fn(size, |x, y| {
        let (mut sum, mut count) = ([0u32; 3], 0);
        for row in (y * by..(y + 1) * by).filter(|row| *row < photo.height()) {
            for pixel in photo.row(row).iter().skip(x * by).take(by) {
                for (sum, value) in sum.iter_mut().zip(pixel) {
                    *sum += u32::from(*value);
                }
                count += 1;
            }
        }
        sum.map(|v| (v / count.max(1)) as u8)
    })
}
