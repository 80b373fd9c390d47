//! A camera in its place.

use mb_geometry::{Camera, ImageSize, Intrinsics, Ray, Rigid3};
use nalgebra::Point2;

/// A pinhole camera of a given image size, posed in frame `F`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View<F> {
    /// Focal lengths and principal point, pixels; pixel centres are integers.
    pub intrinsics: Intrinsics,
    /// Size of the image.
    pub size: ImageSize,
    /// The camera's pose.
    pub cam_from_frame: Rigid3<Camera, F>,
}

impl<F> View<F> {
    /// The ray through the centre of pixel (`x`, `y`), in frame `F`; its parameter is the depth.
    pub fn ray(&self, x: usize, y: usize) -> Ray {
        self.intrinsics.ray(&Point2::new(x as f64, y as f64), &self.cam_from_frame.inverse())
    }
}
