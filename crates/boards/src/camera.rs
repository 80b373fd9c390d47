//! A lens on a pinhole, its derivatives, and its inverse.

use mb_geometry::{Intrinsics, Rigid3};
use nalgebra::{Matrix2, Point2, Point3, SMatrix, SVector};
use serde::{Deserialize, Serialize};

/// A camera with a lens: intrinsics, and OpenCV's five coefficients of distortion (Brown and Conrady).
///
/// A point of the plane at depth 1 moves by `1 + k1 r^2 + k2 r^4 + k3 r^6` radially and by `p1, p2` tangentially before
/// the intrinsics apply.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LensCamera {
    /// Focal lengths and principal point, pixel centres at integers.
    pub intrinsics: Intrinsics,
    /// `k1, k2, p1, p2, k3`, in OpenCV's order.
    pub distortion: [f64; 5],
}

/// Derivative of a pixel by fx, fy, cx, cy, k1, k2, p1, p2, k3.
pub(crate) type ByCamera = SMatrix<f64, 2, 9>;
/// Derivative of a pixel by a small motion of the scene in the camera's frame, `[rotation; translation]`.
pub(crate) type ByPose = SMatrix<f64, 2, 6>;

impl LensCamera {
    /// A pinhole.
    pub fn pinhole(intrinsics: Intrinsics) -> Self {
        Self { intrinsics, distortion: [0.0; 5] }
    }

    /// Where a point appears; `None` on or behind the plane of the centre of projection.
    pub fn img_from_cam(&self, p_in_cam: &Point3<f64>) -> Option<Point2<f64>> {
        (p_in_cam.z > 0.0).then(|| self.img_from_plane(&Point2::new(p_in_cam.x / p_in_cam.z, p_in_cam.y / p_in_cam.z)))
    }

    fn img_from_plane(&self, p: &Point2<f64>) -> Point2<f64> {
        let (bent, ..) = self.bend(p);
        let k = &self.intrinsics;
        Point2::new(k.fx * bent.x + k.cx, k.fy * bent.y + k.cy)
    }

    /// The point of the plane at depth 1 that appears at a pixel, by Newton's method; `None` where the lens has no
    /// inverse (beyond the image that it was fitted to).
    pub fn plane_from_img(&self, pixel: &Point2<f64>) -> Option<Point2<f64>> {
        let k = &self.intrinsics;
        let bent = Point2::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy);
        let mut p = bent;
        for _ in 0..20 {
            let (at, by_plane, _) = self.bend(&p);
            let step = by_plane.try_inverse()? * (bent - at);
            p += step;
            if step.norm() < 1e-13 {
                break;
            }
        }
        ((self.bend(&p).0 - bent).norm() < 1e-9).then_some(p)
    }

    /// The lens alone: where a point of the plane goes, the derivative by the point, and by the coefficients.
    fn bend(&self, p: &Point2<f64>) -> (Point2<f64>, Matrix2<f64>, SMatrix<f64, 2, 5>) {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let (x, y) = (p.x, p.y);
        let r2 = x * x + y * y;
        let (r4, r6) = (r2 * r2, r2 * r2 * r2);
        let radial = 1.0 + k1 * r2 + k2 * r4 + k3 * r6;
        // By r^2.
        let slope = k1 + 2.0 * k2 * r2 + 3.0 * k3 * r4;
        let bent = Point2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let mixed = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        let by_plane = Matrix2::new(
            radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            mixed,
            mixed,
            radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        );
        let by_coefficients = SMatrix::<f64, 2, 5>::new(
            x * r2,
            x * r4,
            2.0 * x * y,
            r2 + 2.0 * x * x,
            x * r6,
            y * r2,
            y * r4,
            r2 + 2.0 * y * y,
            2.0 * x * y,
            y * r6,
        );
        (bent, by_plane, by_coefficients)
    }

    /// Where a point appears, with derivatives; `None` behind the camera.
    pub(crate) fn project(&self, p_in_cam: &Point3<f64>) -> Option<(Point2<f64>, ByCamera, ByPose)> {
        let Point3 { coords } = p_in_cam;
        let (x, y, z) = (coords.x, coords.y, coords.z);
        if z <= 1e-9 {
            return None;
        }
        let plane = Point2::new(x / z, y / z);
        let (bent, by_plane, by_coefficients) = self.bend(&plane);
        let k = &self.intrinsics;
        let focal = Matrix2::new(k.fx, 0.0, 0.0, k.fy);
        let pixel = Point2::new(k.fx * bent.x + k.cx, k.fy * bent.y + k.cy);
        let plane_by_point = SMatrix::<f64, 2, 3>::new(1.0, 0.0, -plane.x, 0.0, 1.0, -plane.y) / z;
        let by_point = focal * by_plane * plane_by_point;
        let mut point_by_motion = SMatrix::<f64, 3, 6>::zeros();
        point_by_motion.fixed_view_mut::<3, 3>(0, 0).copy_from(&-coords.cross_matrix());
        point_by_motion.fixed_view_mut::<3, 3>(0, 3).fill_with_identity();
        let mut by_camera = ByCamera::zeros();
        by_camera[(0, 0)] = bent.x;
        by_camera[(1, 1)] = bent.y;
        by_camera[(0, 2)] = 1.0;
        by_camera[(1, 3)] = 1.0;
        by_camera.fixed_view_mut::<2, 5>(0, 4).copy_from(&(focal * by_coefficients));
        Some((pixel, by_camera, by_point * point_by_motion))
    }

    /// fx, fy, cx, cy, k1, k2, p1, p2, k3.
    pub(crate) fn parameters(&self) -> SVector<f64, 9> {
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let [k1, k2, p1, p2, k3] = self.distortion;
        SVector::from([fx, fy, cx, cy, k1, k2, p1, p2, k3])
    }

    /// The camera of some [`Self::parameters`].
    pub(crate) fn from_parameters(p: &SVector<f64, 9>) -> Self {
        Self {
            intrinsics: Intrinsics { fx: p[0], fy: p[1], cx: p[2], cy: p[3] },
            distortion: [p[4], p[5], p[6], p[7], p[8]],
        }
    }
}

/// A small motion in the target frame of a transform.
pub(crate) fn moved<To, From>(t: &Rigid3<To, From>, twist: &SVector<f64, 6>) -> Rigid3<To, From> {
    Rigid3::<To, To>::exp(twist) * *t
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::{Board, Camera};
    use proptest::prelude::*;

    const LENS: LensCamera = LensCamera {
        intrinsics: Intrinsics { fx: 460.0, fy: 463.0, cx: 317.0, cy: 238.0 },
        distortion: [0.12, -0.4, 0.003, -0.002, 0.2],
    };

    proptest! {
        #[test]
        fn derivatives_are_those_of_differences(x in -0.25..0.25f64, y in -0.2..0.2f64, z in 0.3..1.0f64) {
            let p = Point3::new(x * z, y * z, z);
            let (_, by_camera, by_pose) = LENS.project(&p).expect("in front");
            for i in 0..9 {
                let step = 1e-6;
                let at = |by: f64| {
                    let mut parameters = LENS.parameters();
                    parameters[i] += by;
                    LensCamera::from_parameters(&parameters).img_from_cam(&p).expect("in front")
                };
                let difference = (at(step) - at(-step)) / (2.0 * step);
                prop_assert!((difference - by_camera.column(i)).norm() < 1e-5, "camera {}", i);
            }
            for i in 0..6 {
                let step = 1e-7;
                let at = |by: f64| {
                    let mut twist = SVector::<f64, 6>::zeros();
                    twist[i] = by;
                    LENS.img_from_cam(&(moved(&Rigid3::<Camera, Board>::identity(), &twist) * p)).expect("in front")
                };
                let difference = (at(step) - at(-step)) / (2.0 * step);
                prop_assert!((difference - by_pose.column(i)).norm() < 1e-3, "pose {}", i);
            }
        }

        #[test]
        fn the_lens_has_an_inverse_in_the_image(x in 0.0..640.0f64, y in 0.0..480.0f64) {
            let pixel = Point2::new(x, y);
            let plane = LENS.plane_from_img(&pixel).expect("an inverse");
            prop_assert!((LENS.img_from_plane(&plane) - pixel).norm() < 1e-6);
        }
    }
}
