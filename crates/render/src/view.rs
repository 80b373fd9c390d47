//! A camera in its place.

use mb_geometry::{Camera, ImageSize, Intrinsics, Ray, Rigid3};
use nalgebra::{Point2, Point3, Vector3};

use crate::shade::looking;

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
    /// A view from so far away that it keeps parallels and sizes, as drawings do: along `forward`, `up` as upright as it
    /// can be, `middle` in the middle of the image, `metres_per_pixel` at that depth. Nothing within `reach` of the middle
    /// is out of proportion by more than a fortieth.
    pub fn from_afar(
        middle: &Point3<f64>,
        forward: &Vector3<f64>,
        up: &Vector3<f64>,
        size: ImageSize,
        metres_per_pixel: f64,
        reach: f64,
    ) -> Self {
        let rotation = looking(forward, up);
        let distance = 40.0 * reach.max(1e-3);
        let focal = distance / metres_per_pixel;
        let (cx, cy) = (0.5 * (size.width as f64 - 1.0), 0.5 * (size.height as f64 - 1.0));
        let translation = Vector3::new(0.0, 0.0, distance) - rotation * middle.coords;
        Self {
            intrinsics: Intrinsics { fx: focal, fy: focal, cx, cy },
            size,
            cam_from_frame: Rigid3::from_parts(rotation, translation),
        }
    }

    /// The ray through the centre of pixel (`x`, `y`), in frame `F`; its parameter is the depth.
    pub fn ray(&self, x: usize, y: usize) -> Ray {
        self.intrinsics.ray(&Point2::new(x as f64, y as f64), &self.cam_from_frame.inverse())
    }

    /// The part of the view inside a window, as a view of its own.
    pub fn within(&self, window: &Window) -> Self {
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let (cx, cy) = (cx - window.x as f64, cy - window.y as f64);
        Self { intrinsics: Intrinsics { fx, fy, cx, cy }, size: window.size, cam_from_frame: self.cam_from_frame }
    }
}

/// A rectangle of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Window {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Width and height, at least 1.
    pub size: ImageSize,
}

impl Window {
    /// The pixels of an image of `size` around some places in it; `None` where there are none.
    pub fn around(places: impl IntoIterator<Item = [f64; 2]>, size: ImageSize) -> Option<Self> {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for place in places {
            for axis in 0..2 {
                low[axis] = low[axis].min(place[axis]);
                high[axis] = high[axis].max(place[axis]);
            }
        }
        let range = |axis: usize, count: usize| {
            let (first, last) = (low[axis].floor().max(0.0), high[axis].ceil().min(count as f64 - 1.0));
            (first <= last).then(|| (first as usize, last as usize + 1 - first as usize))
        };
        let ((x, width), (y, height)) = (range(0, size.width)?, range(1, size.height)?);
        Some(Self { x, y, size: ImageSize::new(width, height) })
    }
}
