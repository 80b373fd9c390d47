//! The eye of the phone: which ray each pixel of a photograph follows, with distortion and a shutter that rolls.

use glam::{Mat3, Vec3};
use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Ray, Rigid3};
use mb_image::{DepthImage, Image};
use mb_render::{NO_TRIANGLE, Raster, View};
use nalgebra::{Point2, Point3, Vector3};
use rayon::prelude::*;

use crate::stage::{Stage, vec3};

/// Radial distortion: a point at radius `r` from the principal point, in focal lengths, is seen at
/// `r * (1 + k1 * r^2 + k2 * r^4)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Distortion(pub [f64; 2]);

impl Distortion {
    pub fn is_none(self) -> bool {
        self.0 == [0.0, 0.0]
    }

    /// Where the lens puts the point that a pinhole would put at `pixel`.
    pub fn distorted(self, k: &Intrinsics, pixel: &Point2<f64>) -> Point2<f64> {
        let (x, y) = ((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy);
        let r2 = x * x + y * y;
        let scale = 1.0 + r2 * (self.0[0] + r2 * self.0[1]);
        Point2::new(k.cx + k.fx * x * scale, k.cy + k.fy * y * scale)
    }

    /// Where a pinhole would put the point that the lens puts at `pixel`: Newton's method on the radius.
    fn ideal(self, k: &Intrinsics, pixel: &Point2<f64>) -> Point2<f64> {
        let (x, y) = ((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy);
        let seen = x.hypot(y);
        let [k1, k2] = self.0;
        let mut r = seen;
        for _ in 0..8 {
            let r2 = r * r;
            let slope = 1.0 + r2 * (3.0 * k1 + 5.0 * k2 * r2);
            r -= (r * (1.0 + r2 * (k1 + k2 * r2)) - seen) / slope.max(0.2);
        }
        let scale = if seen > 0.0 { r / seen } else { 1.0 };
        Point2::new(k.cx + k.fx * x * scale, k.cy + k.fy * y * scale)
    }
}

/// The camera at one moment of the exposure. Rows are read one after the other along the shorter side, so each may have
/// its own pose.
pub(crate) struct Eye {
    size: ImageSize,
    intrinsics: Intrinsics,
    distortion: Distortion,
    /// One pose, or one for each line (row, or column of an upright photograph).
    object_from_cam: Vec<Rigid3<Object, Camera>>,
    /// The same in single precision.
    lines: Vec<(Mat3, Vec3)>,
}

impl Eye {
    /// `object_from_cam` takes a time offset from the middle row, seconds; `readout_s` is the time from the first line to
    /// the last.
    pub fn new(
        size: ImageSize,
        intrinsics: Intrinsics,
        distortion: Distortion,
        readout_s: f64,
        object_from_cam: impl Fn(f64) -> Rigid3<Object, Camera>,
    ) -> Self {
        let count = if readout_s > 0.0 { size.width.min(size.height) } else { 1 };
        let poses: Vec<_> =
            (0..count).map(|i| object_from_cam(readout_s * ((i as f64 + 0.5) / count as f64 - 0.5))).collect();
        let lines = poses
            .iter()
            .map(|pose| {
                let r = pose.rotation_matrix();
                let column = |c: usize| Vec3::new(r[(0, c)] as f32, r[(1, c)] as f32, r[(2, c)] as f32);
                (Mat3::from_cols(column(0), column(1), column(2)), vec3(&Point3::from(pose.translation())))
            })
            .collect();
        Self { size, intrinsics, distortion, object_from_cam: poses, lines }
    }

    fn line(&self, x: usize, y: usize) -> usize {
        let along = if self.size.width >= self.size.height { y } else { x };
        along.min(self.lines.len() - 1)
    }

    /// Where the camera is when it sees pixel `(x, y)`.
    pub fn place(&self, x: usize, y: usize) -> Vec3 {
        self.lines[self.line(x, y)].1
    }

    /// Where the pixel `(x, y)` looks, object frame, with unit depth.
    pub fn direction(&self, x: usize, y: usize) -> Vec3 {
        let k = &self.intrinsics;
        let pixel = Point2::new(x as f64, y as f64);
        let ideal = if self.distortion.is_none() { pixel } else { self.distortion.ideal(k, &pixel) };
        let in_camera = Vec3::new(((ideal.x - k.cx) / k.fx) as f32, ((ideal.y - k.cy) / k.fy) as f32, 1.0);
        self.lines[self.line(x, y)].0 * in_camera
    }

    /// Pixels for a metre at a metre.
    pub fn focal_px(&self) -> f32 {
        self.intrinsics.fx as f32
    }

    /// Depth and triangle of every pixel: drawn for a plain pinhole, else followed ray by ray.
    pub fn look(&self, stage: &Stage) -> Raster {
        if self.distortion.is_none() && self.lines.len() == 1 {
            let cam_from_frame = self.object_from_cam[0].inverse();
            return stage.scene.render(&View { intrinsics: self.intrinsics, size: self.size, cam_from_frame });
        }
        let seen: Vec<(f32, u32)> = (0..self.size.pixels())
            .into_par_iter()
            .map(|i| {
                let (x, y) = (i % self.size.width, i / self.size.width);
                let pose = &self.object_from_cam[self.line(x, y)];
                let pixel = self.distortion.ideal(&self.intrinsics, &Point2::new(x as f64, y as f64));
                let k = &self.intrinsics;
                let direction = pose.rotate(&Vector3::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy, 1.0));
                let ray = Ray { origin: Point3::from(pose.translation()), direction };
                stage.bvh.cast(&ray, f64::INFINITY).map_or((0.0, NO_TRIANGLE), |hit| (hit.t as f32, hit.triangle))
            })
            .collect();
        let (depth, triangle): (Vec<f32>, Vec<u32>) = seen.into_iter().unzip();
        Raster {
            depth: DepthImage::from_data(self.size, depth).expect("one depth a pixel"),
            triangle: Image::from_data(self.size, triangle).expect("one triangle a pixel"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_lens_moves_comes_back() {
        let k = Intrinsics { fx: 1460.0, fy: 1460.0, cx: 962.0, cy: 724.0 };
        for distortion in [[0.0, 0.0], [0.05, -0.02], [-0.1, 0.03]].map(Distortion) {
            for pixel in [Point2::new(0.0, 0.0), Point2::new(1919.0, 700.0), Point2::new(962.0, 724.0)] {
                let back = distortion.ideal(&k, &distortion.distorted(&k, &pixel));
                assert!((back - pixel).norm() < 1e-6, "{distortion:?}: {pixel} came back as {back}");
            }
        }
        // Positive coefficients push points outwards.
        assert!(Distortion([0.05, 0.0]).distorted(&k, &Point2::new(1900.0, 724.0)).x > 1900.0);
    }

    #[test]
    fn a_rolling_shutter_sees_the_middle_row_on_time() {
        let size = ImageSize::new(64, 48);
        let k = Intrinsics { fx: 50.0, fy: 50.0, cx: 31.5, cy: 23.5 };
        let slide = |t: f64| Rigid3::from_translation(Vector3::new(t, 0.0, 0.0));
        let eye = Eye::new(size, k, Distortion([0.0; 2]), 0.02, slide);
        assert!((eye.place(0, 0).x + 0.01).abs() < 0.0003 && (eye.place(63, 47).x - 0.01).abs() < 0.0003);
        assert!((eye.place(5, 23).x + eye.place(5, 24).x).abs() < 1e-6);
        assert!((eye.direction(31, 23) - Vec3::new(-0.01, -0.01, 1.0)).length() < 1e-6);
    }
}
