//! The least-squares problem behind the pose from clicks.

use mb_geometry::{Intrinsics, Object, Rigid3, World};
use nalgebra::{Matrix2x3, Matrix2x6, Matrix3, Matrix6, Point2, Point3, Vector2, Vector3, Vector6};

use crate::pnp::{Correspondence, PosedCamera};
use crate::sqpnp::Sighting;

/// Gauss-Newton's equations for a rotation about the centroid and a shift.
pub(crate) struct NormalEquations {
    pub hessian: Matrix6<f64>,
    /// `J' r`, with `r` found minus predicted.
    pub right: Vector6<f64>,
    /// Squared residuals, with what the drifts cost, square pixels.
    pub sum_sq: f64,
    /// Residuals that the drifts take up: the trace of the smoother.
    pub drift_freedom: f64,
    /// Each camera's drift, as a motion of the scene about the centroid.
    pub drifts: Vec<Vector6<f64>>,
}

pub(crate) struct Problem<'a> {
    pub cameras: &'a [PosedCamera],
    cam_from_world: Vec<(Matrix3<f64>, Vector3<f64>)>,
    pub correspondences: &'a [Correspondence],
    pub sightings: Vec<Sighting>,
    /// Information on each camera's drift, in units of a click's: rotation about the centroid, shift. `None` where
    /// the cameras' poses are exact.
    drift_prior: Option<Matrix6<f64>>,
}

impl<'a> Problem<'a> {
    pub fn new(
        cameras: &'a [PosedCamera],
        correspondences: &'a [Correspondence],
        drift_prior: Option<Matrix6<f64>>,
    ) -> Self {
        let cam_from_world = cameras
            .iter()
            .map(|c| c.world_from_cam.inverse())
            .map(|t| (t.rotation_matrix(), t.translation()))
            .collect();
        let sightings = correspondences
            .iter()
            .map(|c| {
                let camera = &cameras[c.camera_idx];
                let ray = camera.intrinsics.ray(&c.pixel, &camera.world_from_cam);
                Sighting {
                    origin_in_world: ray.origin,
                    direction_in_world: ray.direction,
                    point_in_object: c.point_in_object,
                }
            })
            .collect();
        Self { cameras, cam_from_world, correspondences, sightings, drift_prior }
    }

    /// Mean focal length over the correspondences.
    pub fn pixels_per_radian(&self) -> f64 {
        let sum: f64 = self.correspondences.iter().map(|c| self.cameras[c.camera_idx].intrinsics.fx).sum();
        sum / self.correspondences.len() as f64
    }

    pub fn centroid(&self, pose: &Rigid3<World, Object>, chosen: &[bool]) -> Vector3<f64> {
        let (mut sum, mut n) = (Vector3::zeros(), 0.0);
        for (c, _) in self.correspondences.iter().zip(chosen).filter(|(_, chosen)| **chosen) {
            sum += (*pose * c.point_in_object).coords;
            n += 1.0;
        }
        if n > 0.0 { sum / n } else { sum }
    }

    pub fn residuals(&self, pose: &Rigid3<World, Object>) -> Vec<Option<Vector2<f64>>> {
        let (rotation, translation) = (pose.rotation_matrix(), pose.translation());
        self.correspondences
            .iter()
            .map(|c| {
                let p_in_world = rotation * c.point_in_object.coords + translation;
                let (r, t) = &self.cam_from_world[c.camera_idx];
                let predicted = self.cameras[c.camera_idx].intrinsics.img_from_cam(&Point3::from(r * p_in_world + t));
                predicted.map(|predicted| c.pixel - predicted)
            })
            .collect()
    }

    /// `None` where a chosen point lies behind its camera.
    ///
    /// A camera's drift is a small motion of the scene, which moves a pixel as the same motion of the object would. It
    /// is eliminated per camera: with `N = J'J`, `g = J'r` of its pixels and the prior `P`, the best drift is
    /// `(N + P)^-1 g`, and what is left for the object is `N - N (N + P)^-1 N` and `g - N (N + P)^-1 g`.
    pub fn normal_equations(&self, pose: &Rigid3<World, Object>, chosen: &[bool]) -> Option<NormalEquations> {
        let center = self.centroid(pose, chosen);
        let (rotation, translation) = (pose.rotation_matrix(), pose.translation());
        let mut cameras = vec![(Matrix6::zeros(), Vector6::zeros()); self.cameras.len()];
        let mut sum_sq = 0.0;
        for (c, _) in self.correspondences.iter().zip(chosen).filter(|(_, chosen)| **chosen) {
            let p_in_world = rotation * c.point_in_object.coords + translation;
            let (r, t) = &self.cam_from_world[c.camera_idx];
            let k = &self.cameras[c.camera_idx].intrinsics;
            let (predicted, jacobian) = project(k, r, t, &p_in_world, &center)?;
            let residual = c.pixel - predicted;
            let (n, g) = &mut cameras[c.camera_idx];
            *n += jacobian.transpose() * jacobian;
            *g += jacobian.transpose() * residual;
            sum_sq += residual.norm_squared();
        }
        let mut sums = NormalEquations {
            hessian: Matrix6::zeros(),
            right: Vector6::zeros(),
            sum_sq,
            drift_freedom: 0.0,
            drifts: vec![Vector6::zeros(); cameras.len()],
        };
        for ((n, g), drift) in cameras.iter().zip(&mut sums.drifts) {
            sums.hessian += n;
            sums.right += g;
            if let Some(prior) = self.drift_prior {
                let inverse = (n + prior).cholesky()?.inverse();
                *drift = inverse * g;
                sums.hessian -= n * inverse * n;
                sums.right -= n * *drift;
                sums.sum_sq -= g.dot(drift);
                sums.drift_freedom += (n * inverse).trace();
            }
        }
        Some(sums)
    }

    /// Residuals after each camera's drift has been taken off, to first order.
    pub fn residuals_without_drift(&self, pose: &Rigid3<World, Object>, chosen: &[bool]) -> Vec<Option<Vector2<f64>>> {
        let residuals = self.residuals(pose);
        if self.drift_prior.is_none() {
            return residuals;
        }
        let Some(equations) = self.normal_equations(pose, chosen) else { return residuals };
        let center = self.centroid(pose, chosen);
        let of_drift = |c: &Correspondence| {
            let (r, t) = &self.cam_from_world[c.camera_idx];
            let p_in_world = (*pose * c.point_in_object).coords;
            let k = &self.cameras[c.camera_idx].intrinsics;
            project(k, r, t, &p_in_world, &center).map(|(_, jacobian)| jacobian * equations.drifts[c.camera_idx])
        };
        residuals.iter().zip(self.correspondences).map(|(r, c)| Some((*r)? - of_drift(c)?)).collect()
    }

    /// Levenberg-Marquardt over the chosen correspondences. `None` where the start already has one behind its camera.
    pub fn polish(&self, start: &Rigid3<World, Object>, chosen: &[bool]) -> Option<(Rigid3<World, Object>, f64)> {
        let mut pose = *start;
        let mut equations = self.normal_equations(&pose, chosen)?;
        let mut damping = 1e-6;
        for _ in 0..50 {
            let mut damped = equations.hessian;
            for i in 0..6 {
                damped[(i, i)] *= 1.0 + damping;
            }
            let Some(cholesky) = damped.cholesky() else {
                damping *= 10.0;
                continue;
            };
            let step = cholesky.solve(&equations.right);
            let next = moved(&pose, &step, &self.centroid(&pose, chosen));
            match self.normal_equations(&next, chosen) {
                Some(better) if better.sum_sq <= equations.sum_sq => {
                    let gain = equations.sum_sq - better.sum_sq;
                    (pose, equations) = (next, better);
                    damping = (damping * 0.1).max(1e-9);
                    if gain <= 1e-12 * equations.sum_sq || equations.sum_sq < 1e-18 {
                        break;
                    }
                }
                _ => damping *= 10.0,
            }
            if damping > 1e9 {
                break;
            }
        }
        Some((pose, equations.sum_sq))
    }
}

/// The pose after a rotation `step[0..3]` about `center` and a shift `step[3..6]`, in the world.
pub(crate) fn moved<From>(
    pose: &Rigid3<World, From>,
    step: &Vector6<f64>,
    center: &Vector3<f64>,
) -> Rigid3<World, From> {
    let turn = nalgebra::UnitQuaternion::from_scaled_axis(step.fixed_rows::<3>(0).into_owned());
    let shift = step.fixed_rows::<3>(3) + center - turn * center;
    let mut rotation = turn * pose.rotation();
    rotation.renormalize();
    Rigid3::from_parts(rotation, turn * pose.translation() + shift)
}

/// The pixel of a point, and its derivative with respect to a rotation about `center` and a shift of the point in the
/// world. `None` behind the camera.
pub(crate) fn project(
    k: &Intrinsics,
    rotation: &Matrix3<f64>,
    translation: &Vector3<f64>,
    p_in_world: &Vector3<f64>,
    center: &Vector3<f64>,
) -> Option<(Point2<f64>, Matrix2x6<f64>)> {
    let p = rotation * p_in_world + translation;
    let pixel = k.img_from_cam(&Point3::from(p))?;
    let inverse_z = 1.0 / p.z;
    let pixel_of_cam = Matrix2x3::new(
        k.fx * inverse_z,
        0.0,
        -k.fx * p.x * inverse_z * inverse_z,
        0.0,
        k.fy * inverse_z,
        -k.fy * p.y * inverse_z * inverse_z,
    );
    let pixel_of_world = pixel_of_cam * rotation;
    let mut jacobian = Matrix2x6::zeros();
    jacobian.fixed_view_mut::<2, 3>(0, 0).copy_from(&(-pixel_of_world * (p_in_world - center).cross_matrix()));
    jacobian.fixed_view_mut::<2, 3>(0, 3).copy_from(&pixel_of_world);
    Some((pixel, jacobian))
}
