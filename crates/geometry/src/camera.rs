//! Pinhole cameras and rays.

use nalgebra::{Matrix3, Point2, Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::{Camera, Rigid3};

/// Width and height of an image, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct ImageSize {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl ImageSize {
    /// Columns, then rows.
    pub const fn new(width: usize, height: usize) -> Self {
        Self { width, height }
    }

    /// Number of pixels.
    pub const fn pixels(&self) -> usize {
        self.width * self.height
    }
}

impl std::fmt::Display for ImageSize {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

/// Pinhole intrinsics in pixels; the centre of the first pixel is (0, 0).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
}

/// Why a 3x3 matrix is no pinhole camera.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum IntrinsicsError {
    /// An entry is NaN or infinite.
    #[error("an entry is not a finite number")]
    NotFinite,
    /// A focal length is zero or negative, so the matrix cannot be inverted.
    #[error("singular: the focal lengths are {fx} and {fy}, both must be above 0")]
    Singular {
        /// Entry (0, 0).
        fx: f64,
        /// Entry (1, 1).
        fy: f64,
    },
    /// Skew, a lower-left entry, or a last row other than (0, 0, 1).
    #[error("not of the form [fx 0 cx; 0 fy cy; 0 0 1]: entry ({row}, {col}) is {value}")]
    NotPinhole {
        /// Row, from 0.
        row: usize,
        /// Column, from 0.
        col: usize,
        /// What was found there.
        value: f64,
    },
}

impl Intrinsics {
    /// From a 3x3 matrix `[fx 0 cx; 0 fy cy; 0 0 1]`.
    ///
    /// # Errors
    /// The matrix is not finite, singular, or not of that form (skew below 1e-6 of the focal length is taken as zero).
    pub fn from_matrix(k: &Matrix3<f64>) -> Result<Self, IntrinsicsError> {
        if !k.iter().all(|v| v.is_finite()) {
            return Err(IntrinsicsError::NotFinite);
        }
        let (fx, fy) = (k[(0, 0)], k[(1, 1)]);
        if fx <= 0.0 || fy <= 0.0 {
            return Err(IntrinsicsError::Singular { fx, fy });
        }
        let expected = [(0, 1, 0.0), (1, 0, 0.0), (2, 0, 0.0), (2, 1, 0.0), (2, 2, 1.0)];
        for (row, col, value) in expected {
            let tolerance = if row == 2 { 1e-6 } else { 1e-6 * fx };
            if (k[(row, col)] - value).abs() > tolerance {
                return Err(IntrinsicsError::NotPinhole { row, col, value: k[(row, col)] });
            }
        }
        Ok(Self { fx, fy, cx: k[(0, 2)], cy: k[(1, 2)] })
    }

    /// The 3x3 matrix.
    pub fn to_matrix(&self) -> Matrix3<f64> {
        Matrix3::new(self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }

    /// Projects a point; `None` on or behind the plane of the centre of projection.
    pub fn img_from_cam(&self, p_in_cam: &Point3<f64>) -> Option<Point2<f64>> {
        (p_in_cam.z > 0.0).then(|| {
            Point2::new(self.fx * p_in_cam.x / p_in_cam.z + self.cx, self.fy * p_in_cam.y / p_in_cam.z + self.cy)
        })
    }

    /// The point at depth `z` (metres) behind pixel `p_in_img`.
    pub fn cam_from_img(&self, p_in_img: &Point2<f64>, z: f64) -> Point3<f64> {
        Point3::new((p_in_img.x - self.cx) / self.fx * z, (p_in_img.y - self.cy) / self.fy * z, z)
    }

    /// Intrinsics of the same view resampled from `from` to `to` pixels.
    ///
    /// Pixel centres are integers, so the image spans [-0.5, width - 0.5] and `cx' = (cx + 0.5) * s - 0.5`. This is
    /// also how depth intrinsics follow from those of the photograph (1920x1440 to 256x192: s = 1 / 7.5).
    pub fn resized(&self, from: ImageSize, to: ImageSize) -> Self {
        let sx = to.width as f64 / from.width as f64;
        let sy = to.height as f64 / from.height as f64;
        Self { fx: self.fx * sx, fy: self.fy * sy, cx: (self.cx + 0.5) * sx - 0.5, cy: (self.cy + 0.5) * sy - 0.5 }
    }

    /// The ray through a pixel, in the frame `To` that the camera is posed in. Its direction has unit z in the camera
    /// frame, so the ray parameter is the depth.
    pub fn ray<To>(&self, p_in_img: &Point2<f64>, to_from_cam: &Rigid3<To, Camera>) -> Ray {
        let direction = self.cam_from_img(p_in_img, 1.0).coords;
        Ray { origin: to_from_cam.translation().into(), direction: to_from_cam.rotate(&direction) }
    }
}

/// A half line; points on it are `origin + t * direction`, t >= 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ray {
    /// Start.
    pub origin: Point3<f64>,
    /// Direction, not necessarily of unit length.
    pub direction: Vector3<f64>,
}

impl Ray {
    /// The point at parameter `t`.
    pub fn at(&self, t: f64) -> Point3<f64> {
        self.origin + self.direction * t
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const PHONE: Intrinsics = Intrinsics { fx: 1460.0, fy: 1461.0, cx: 962.0, cy: 724.5 };

    proptest! {
        #[test]
        fn projection_inverts_unprojection(x in -0.5..1919.5f64, y in -0.5..1439.5f64, z in 0.05..5.0f64) {
            let p = Point2::new(x, y);
            let back = PHONE.img_from_cam(&PHONE.cam_from_img(&p, z)).unwrap();
            prop_assert!((back - p).norm() < 1e-9);
        }

        #[test]
        fn resizing_keeps_the_view(x in -0.5..1919.5f64, y in -0.5..1439.5f64) {
            let (photo, depth) = (ImageSize::new(1920, 1440), ImageSize::new(256, 192));
            let small = PHONE.resized(photo, depth);
            let in_photo = Point2::new(x, y);
            let in_depth = Point2::new((x + 0.5) / 7.5 - 0.5, (y + 0.5) / 7.5 - 0.5);
            let difference = small.cam_from_img(&in_depth, 1.0) - PHONE.cam_from_img(&in_photo, 1.0);
            prop_assert!(difference.norm() < 1e-12);
        }
    }

    #[test]
    fn a_point_behind_the_camera_has_no_image() {
        assert_eq!(PHONE.img_from_cam(&Point3::new(0.0, 0.0, -1.0)), None);
        assert_eq!(PHONE.img_from_cam(&Point3::new(0.0, 0.0, 0.0)), None);
    }

    #[test]
    fn matrices_that_are_no_pinhole_are_told_apart() {
        let good = PHONE.to_matrix();
        assert_eq!(Intrinsics::from_matrix(&good), Ok(PHONE));
        let with = |row, col, value| {
            let mut k = good;
            k[(row, col)] = value;
            Intrinsics::from_matrix(&k)
        };
        assert_eq!(with(0, 0, 0.0), Err(IntrinsicsError::Singular { fx: 0.0, fy: 1461.0 }));
        assert_eq!(with(1, 2, f64::NAN), Err(IntrinsicsError::NotFinite));
        assert_eq!(with(0, 1, 3.0), Err(IntrinsicsError::NotPinhole { row: 0, col: 1, value: 3.0 }));
    }
}
