//! Bundle adjustment: cameras and points from where photographs show the points.
//!
//! Levenberg-Marquardt; the points are eliminated by the Schur complement (Triggs et al., "Bundle Adjustment: A Modern
//! Synthesis", 2000, section 6), which leaves a dense system of six unknowns per camera.

use mb_geometry::{Camera, Intrinsics, Rigid3, World};
use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix3, Matrix6, Matrix6x3, Point2, Point3, Vector2, Vector3, Vector6};
use rayon::prelude::*;

use crate::contour::twist_about;
use crate::pnp_problem::{moved, project};

/// A camera: as the phone had it, after a motion of the scene that undoes the phone's drift.
#[derive(Debug, Clone, Copy)]
pub(crate) struct AdjustedCamera {
    pub intrinsics: Intrinsics,
    pub cam_from_world: Rigid3<Camera, World>,
    pub drift: Rigid3<World, World>,
}

/// A point seen in several photographs.
#[derive(Debug, Clone)]
pub(crate) struct AdjustedPoint {
    pub in_world: Point3<f64>,
    /// The model's surface there (a point of it and its unit normal), for points on the object.
    pub surface: Option<(Point3<f64>, Vector3<f64>)>,
    pub observations: Vec<PointObservation>,
}

/// Where a photograph shows a point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PointObservation {
    pub camera_idx: usize,
    pub pixel: Point2<f64>,
    /// Left out where it does not agree with the rest.
    pub is_inlier: bool,
}

/// What else is known of a camera's motion: `information` and `information * (best - current)` of its twist.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CameraTerm {
    pub information: Matrix6<f64>,
    pub right: Vector6<f64>,
}

/// The problem.
pub(crate) struct Adjustment {
    pub cameras: Vec<AdjustedCamera>,
    pub points: Vec<AdjustedPoint>,
    /// Pivot of the motions, metres in the world.
    pub center: Vector3<f64>,
    /// Standard deviation of a feature's place, pixels; residuals far beyond it count little (Cauchy).
    pub feature_px: f64,
    /// Standard deviation of a point's distance from the model's surface, metres.
    pub surface_m: f64,
    /// Information of each camera's drift on its own.
    pub drift_information: Matrix6<f64>,
    /// Information of the change of drift from one camera to the next.
    pub step_information: Matrix6<f64>,
}

/// A linearised problem with its points eliminated.
struct Reduced {
    hessian: DMatrix<f64>,
    right: DVector<f64>,
    cost: f64,
}

/// Camera, its own block and right side, and the block that couples it with the point.
type CameraBlocks = (usize, Matrix6<f64>, Vector6<f64>, Matrix6x3<f64>);

/// What a point contributes, before elimination.
struct PointBlocks {
    own: Matrix3<f64>,
    right: Vector3<f64>,
    cameras: Vec<CameraBlocks>,
    cost: f64,
}

/// Pieces of the sum over points, whatever the number of threads, so that sums do not depend on it.
const PIECES: usize = 8;

impl Adjustment {
    /// Runs `steps` steps of Levenberg-Marquardt with `terms` added per camera. Returns the covariance of the cameras'
    /// motions (six by six each), or `None` where the system is singular.
    pub fn solve(&mut self, terms: &[CameraTerm], steps: usize) -> Option<Vec<Matrix6<f64>>> {
        let start: Vec<Vector6<f64>> = self.twists();
        let mut damping = 1e-4;
        let mut current = self.linearise(terms, &start, damping)?;
        for _ in 0..steps {
            let Some(cholesky) = damped(&current.hessian, damping).cholesky() else {
                damping *= 10.0;
                continue;
            };
            let step = cholesky.solve(&current.right);
            let before = (self.cameras.clone(), self.points.iter().map(|p| p.in_world).collect::<Vec<_>>());
            self.apply(&step, damping);
            let next = self.linearise(terms, &start, damping * 0.1)?;
            if next.cost <= current.cost {
                let gain = (current.cost - next.cost) / current.cost.max(f64::MIN_POSITIVE);
                current = next;
                damping = (damping * 0.1).max(1e-8);
                if gain < 1e-6 {
                    break;
                }
            } else {
                self.cameras = before.0;
                self.points.iter_mut().zip(before.1).for_each(|(p, old)| p.in_world = old);
                damping *= 10.0;
                current = self.linearise(terms, &start, damping)?;
            }
        }
        let inverse = damped(&current.hessian, 1e-12).cholesky()?.inverse();
        Some((0..self.cameras.len()).map(|i| inverse.fixed_view::<6, 6>(6 * i, 6 * i).into_owned()).collect())
    }

    fn twists(&self) -> Vec<Vector6<f64>> {
        self.cameras.iter().map(|c| twist_about(&c.drift, &self.center)).collect()
    }

    /// Found minus predicted pixel; `None` behind the camera.
    pub fn residual(&self, point: &AdjustedPoint, o: &PointObservation) -> Option<Vector2<f64>> {
        let camera = &self.cameras[o.camera_idx];
        let p = camera.cam_from_world * (camera.drift * point.in_world);
        camera.intrinsics.img_from_cam(&p).map(|predicted| o.pixel - predicted)
    }

    fn blocks(&self, point: &AdjustedPoint, damping: f64) -> PointBlocks {
        let mut b = PointBlocks { own: Matrix3::zeros(), right: Vector3::zeros(), cameras: Vec::new(), cost: 0.0 };
        for o in point.observations.iter().filter(|o| o.is_inlier) {
            let camera = &self.cameras[o.camera_idx];
            let drifted = (camera.drift * point.in_world).coords;
            let (r, t) = (camera.cam_from_world.rotation_matrix(), camera.cam_from_world.translation());
            let Some((pixel, by_camera)) = project(&camera.intrinsics, &r, &t, &drifted, &self.center) else {
                // Behind the camera: a large constant, so that steps that put it there are refused.
                b.cost += 1e6;
                continue;
            };
            // The last three columns are the derivative with respect to the moved point.
            let by_point: Matrix2x3<f64> = by_camera.fixed_view::<2, 3>(0, 3) * camera.drift.rotation_matrix();
            let residual = (o.pixel - pixel) / self.feature_px;
            let sq = residual.norm_squared();
            let weight = 1.0 / (1.0 + sq) / self.feature_px.powi(2);
            b.cost += (1.0 + sq).ln();
            let pixel_residual = o.pixel - pixel;
            b.own += by_point.transpose() * by_point * weight;
            b.right += by_point.transpose() * pixel_residual * weight;
            b.cameras.push((
                o.camera_idx,
                by_camera.transpose() * by_camera * weight,
                by_camera.transpose() * pixel_residual * weight,
                by_camera.transpose() * by_point * weight,
            ));
        }
        if let Some((on_surface, normal)) = &point.surface {
            let weight = self.surface_m.powi(-2);
            let off = normal.dot(&(point.in_world - on_surface));
            b.own += normal * normal.transpose() * weight;
            b.right -= normal * (off * weight);
            b.cost += off * off * weight;
        }
        for i in 0..3 {
            b.own[(i, i)] *= 1.0 + damping;
        }
        b
    }

    fn linearise(&self, terms: &[CameraTerm], start: &[Vector6<f64>], damping: f64) -> Option<Reduced> {
        let n = 6 * self.cameras.len();
        let piece = self.points.len().div_ceil(PIECES).max(1);
        let sums: Vec<Reduced> = self
            .points
            .par_chunks(piece)
            .map(|points| {
                let mut sum = Reduced { hessian: DMatrix::zeros(n, n), right: DVector::zeros(n), cost: 0.0 };
                for point in points {
                    let b = self.blocks(point, damping);
                    sum.cost += b.cost;
                    let Some(inverse) = b.own.cholesky().map(|c| c.inverse()) else { continue };
                    for (i, own, right, mixed) in &b.cameras {
                        let through = mixed * inverse;
                        let mut block = sum.hessian.fixed_view_mut::<6, 6>(6 * i, 6 * i);
                        block += own;
                        let mut part = sum.right.fixed_rows_mut::<6>(6 * i);
                        part += right - through * b.right;
                        for (j, _, _, other) in &b.cameras {
                            let mut block = sum.hessian.fixed_view_mut::<6, 6>(6 * i, 6 * j);
                            block -= through * other.transpose();
                        }
                    }
                }
                sum
            })
            .collect();
        let mut total = Reduced { hessian: DMatrix::zeros(n, n), right: DVector::zeros(n), cost: 0.0 };
        for sum in &sums {
            total.hessian += &sum.hessian;
            total.right += &sum.right;
            total.cost += sum.cost;
        }
        self.add_camera_terms(&mut total, terms, start);
        total.cost.is_finite().then_some(total)
    }

    fn add_camera_terms(&self, total: &mut Reduced, terms: &[CameraTerm], start: &[Vector6<f64>]) {
        let twists = self.twists();
        let (hessian, right) = (&mut total.hessian, &mut total.right);
        let mut add = |i: usize, j: usize, block: &Matrix6<f64>| {
            let mut view = hessian.fixed_view_mut::<6, 6>(6 * i, 6 * j);
            view += block;
        };
        let mut pull = |i: usize, slope: &Vector6<f64>| {
            let mut view = right.fixed_rows_mut::<6>(6 * i);
            view -= slope;
        };
        for (i, twist) in twists.iter().enumerate() {
            add(i, i, &self.drift_information);
            if let Some(term) = terms.get(i) {
                add(i, i, &term.information);
            }
            if i > 0 {
                add(i, i, &self.step_information);
                add(i - 1, i - 1, &self.step_information);
                add(i, i - 1, &-self.step_information);
                add(i - 1, i, &-self.step_information);
            }
            pull(i, &(self.drift_information * twist));
            total.cost += twist.dot(&(self.drift_information * twist));
            if let Some(term) = terms.get(i) {
                let moved = twist - start[i];
                pull(i, &(term.information * moved - term.right));
                total.cost += moved.dot(&(term.information * moved)) - 2.0 * moved.dot(&term.right);
            }
            if i > 0 {
                let step = twist - twists[i - 1];
                let slope = self.step_information * step;
                pull(i, &slope);
                pull(i - 1, &-slope);
                total.cost += step.dot(&slope);
            }
        }
    }

    /// Moves the cameras by `step` and every point to its best place for it.
    fn apply(&mut self, step: &DVector<f64>, damping: f64) {
        let moves: Vec<Vector3<f64>> = self
            .points
            .par_iter()
            .map(|point| {
                let b = self.blocks(point, damping);
                let mut right = b.right;
                for (i, _, _, mixed) in &b.cameras {
                    right -= mixed.transpose() * step.fixed_rows::<6>(6 * i);
                }
                b.own.cholesky().map_or_else(Vector3::zeros, |c| c.solve(&right))
            })
            .collect();
        for (i, camera) in self.cameras.iter_mut().enumerate() {
            camera.drift = moved(&camera.drift, &step.fixed_rows::<6>(6 * i).into_owned(), &self.center);
        }
        self.points.iter_mut().zip(moves).for_each(|(p, by)| p.in_world += by);
    }
}

fn damped(hessian: &DMatrix<f64>, damping: f64) -> DMatrix<f64> {
    let mut damped = hessian.clone();
    for i in 0..damped.nrows() {
        damped[(i, i)] *= 1.0 + damping;
    }
    damped
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contour::motion_about;
    use nalgebra::UnitQuaternion;
    use rand::RngExt;

    /// Cameras on a circle, points in a box and on the plane y = 0, seen without noise, with wrong drifts and points.
    #[test]
    fn exact_pixels_give_back_the_cameras_in_the_frame_that_the_surface_fixes() {
        let mut rng = mb_job::rng(4, 0);
        let mut uniform = |size: f64| rng.random_range(-size..size);
        let center = Vector3::new(0.01, 0.0, -0.02);
        let intrinsics = Intrinsics { fx: 700.0, fy: 702.0, cx: 480.0, cy: 360.0 };
        let mut truths = Vec::new();
        let mut cameras: Vec<AdjustedCamera> = Vec::new();
        for i in 0..6 {
            let angle = f64::from(i) * 0.3;
            let eye = Vector3::new(0.3 * angle.cos(), 0.25, 0.3 * angle.sin());
            let pose = Rigid3::<World, Camera>::from_parts(UnitQuaternion::face_towards(&-eye, &-Vector3::y()), eye);
            let drift = motion_about(&Vector6::from_fn(|k, _| uniform(if k < 3 { 0.008 } else { 0.003 })), &center);
            truths.push(drift);
            cameras.push(AdjustedCamera { intrinsics, cam_from_world: pose.inverse(), drift });
        }
        let mut adjustment = Adjustment {
            cameras,
            points: Vec::new(),
            center,
            feature_px: 0.5,
            surface_m: 1e-4,
            drift_information: Matrix6::identity() * 1e-6,
            step_information: Matrix6::zeros(),
        };
        for i in 0..120 {
            let on_plane = i % 2 == 0;
            let p = Point3::new(uniform(0.06), if on_plane { 0.0 } else { uniform(0.05) }, uniform(0.06));
            // Three planes across each other fix the frame.
            let surface = match i % 6 {
                0 | 2 | 4 => Some((Point3::origin(), Vector3::y())),
                1 => Some((p, Vector3::x())),
                3 => Some((p, Vector3::z())),
                _ => None,
            };
            let mut point = AdjustedPoint { in_world: p, surface, observations: Vec::new() };
            for camera_idx in 0..6 {
                let zero = PointObservation { camera_idx, pixel: Point2::origin(), is_inlier: true };
                let minus_predicted = adjustment.residual(&point, &zero).expect("the point lies before the camera");
                point.observations.push(PointObservation { pixel: Point2::from(-minus_predicted), ..zero });
            }
            adjustment.points.push(point);
        }
        for camera in &mut adjustment.cameras {
            camera.drift = Rigid3::identity();
        }
        for point in &mut adjustment.points {
            point.in_world += Vector3::new(uniform(0.002), uniform(0.002), uniform(0.002));
        }
        let covariances = adjustment.solve(&[], 60).expect("the system has a solution");
        for ((camera, truth), covariance) in adjustment.cameras.iter().zip(&truths).zip(&covariances) {
            let error = twist_about(&(camera.drift.inverse() * *truth), &center);
            assert!(error.norm() < 1e-5, "{error:?}");
            assert!(covariance.symmetric_eigenvalues().min() > 0.0);
        }
    }
}
