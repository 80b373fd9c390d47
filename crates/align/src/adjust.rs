//! Bundle adjustment: cameras and points from where photographs show the points.
//!
//! Levenberg-Marquardt; the points are eliminated by the Schur complement (Triggs et al., "Bundle Adjustment: A Modern
//! Synthesis", 2000, section 6), which leaves a dense system of seven unknowns per camera: its motion and the logarithm of
//! its focal length.

use mb_geometry::{Camera, Intrinsics, Rigid3, World};
use nalgebra::{
    DMatrix, DVector, Matrix2x3, Matrix3, Matrix6, Point2, Point3, SMatrix, SVector, Vector2, Vector3, Vector6,
};
use rayon::prelude::*;

use crate::contour::twist_about;
use crate::pnp_problem::{moved, project};

/// A camera: as the phone had it, after a motion of the scene that undoes the phone's drift.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdjustedCamera {
    /// Intrinsics as the phone had them.
    pub intrinsics: Intrinsics,
    /// Pose as the phone had it.
    pub cam_from_world: Rigid3<Camera, World>,
    /// How the scene must move for this camera to see it where the photograph shows it. Unknown.
    pub drift: Rigid3<World, World>,
    /// Logarithm of the focal length's ratio to the phone's. Unknown where [`Adjustment::focal_information`] is finite.
    pub log_focal: f64,
}

impl AdjustedCamera {
    /// The intrinsics with the focal length found.
    pub fn adjusted_intrinsics(&self) -> Intrinsics {
        let ratio = self.log_focal.exp();
        Intrinsics { fx: self.intrinsics.fx * ratio, fy: self.intrinsics.fy * ratio, ..self.intrinsics }
    }

    /// The pose found.
    pub fn adjusted_cam_from_world(&self) -> Rigid3<Camera, World> {
        self.cam_from_world * self.drift
    }
}

/// A point seen in several photographs.
#[derive(Debug, Clone, PartialEq)]
pub struct AdjustedPoint {
    /// Where it is, metres. Unknown.
    pub in_world: Point3<f64>,
    /// The model's surface there (a point of it and its unit normal), for points on the object.
    pub surface: Option<(Point3<f64>, Vector3<f64>)>,
    /// Where photographs show it.
    pub observations: Vec<PointObservation>,
}

/// Where a photograph shows a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointObservation {
    /// Index of the camera.
    pub camera_idx: usize,
    /// Pixel (x, y), pixel centres at integers.
    pub pixel: Point2<f64>,
    /// False leaves it out.
    pub is_inlier: bool,
}

/// What else is known of a camera's motion: `information` and `information * (best - current)` of its twist about
/// [`Adjustment::center`], `[rotation; translation]` (rad, m).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraTerm {
    /// Inverse covariance.
    pub information: Matrix6<f64>,
    /// Inverse covariance times the way to the best motion.
    pub right: Vector6<f64>,
}

/// The problem, and after [`Adjustment::solve`] its solution.
#[derive(Debug, Clone, PartialEq)]
pub struct Adjustment {
    /// The cameras.
    pub cameras: Vec<AdjustedCamera>,
    /// The points.
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
    /// Information of each camera's `log_focal`; infinite takes the phone's focal lengths as exact.
    pub focal_information: f64,
}

/// Unknowns of a camera: turn, shift, logarithm of the focal length.
const UNKNOWNS: usize = 7;
/// Stands for an infinite information of the focal length: nothing that pixels say comes near.
const EXACT: f64 = 1e15;
type CameraBlock = SMatrix<f64, UNKNOWNS, UNKNOWNS>;
type CameraVector = SVector<f64, UNKNOWNS>;
type CameraPointBlock = SMatrix<f64, UNKNOWNS, 3>;
type CameraJacobian = SMatrix<f64, 2, UNKNOWNS>;

/// A linearised problem with its points eliminated.
struct Reduced {
    hessian: DMatrix<f64>,
    right: DVector<f64>,
    cost: f64,
}

/// Camera, its own block and right side, and the block that couples it with the point.
type CameraBlocks = (usize, CameraBlock, CameraVector, CameraPointBlock);

/// What a point contributes, before elimination.
struct PointBlocks {
    own: Matrix3<f64>,
    right: Vector3<f64>,
    cameras: Vec<CameraBlocks>,
    cost: f64,
}

/// A camera prepared for many points.
struct Projector {
    intrinsics: Intrinsics,
    drift: Rigid3<World, World>,
    drift_rotation: Matrix3<f64>,
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    center: Vector3<f64>,
}

impl Projector {
    fn new(camera: &AdjustedCamera, center: &Vector3<f64>) -> Self {
        Self {
            intrinsics: camera.adjusted_intrinsics(),
            drift: camera.drift,
            drift_rotation: camera.drift.rotation_matrix(),
            rotation: camera.cam_from_world.rotation_matrix(),
            translation: camera.cam_from_world.translation(),
            center: *center,
        }
    }

    /// The pixel of a point, and its derivatives by the camera's unknowns and by the point. `None` behind the camera.
    fn project(&self, in_world: &Point3<f64>) -> Option<(Point2<f64>, CameraJacobian, Matrix2x3<f64>)> {
        let drifted = self.drift_rotation * in_world.coords + self.drift.translation();
        let k = &self.intrinsics;
        let (pixel, by_motion) = project(k, &self.rotation, &self.translation, &drifted, &self.center)?;
        let mut by_camera = CameraJacobian::zeros();
        by_camera.fixed_view_mut::<2, 6>(0, 0).copy_from(&by_motion);
        by_camera.set_column(6, &Vector2::new(pixel.x - k.cx, pixel.y - k.cy));
        // The columns of the shift are the derivative with respect to the moved point.
        let by_point = by_motion.fixed_view::<2, 3>(0, 3) * self.drift_rotation;
        Some((pixel, by_camera, by_point))
    }
}

/// Pieces of the sum over points, whatever the number of threads, so that sums do not depend on it.
const PIECES: usize = 8;

impl Adjustment {
    /// Runs at most `steps` steps of Levenberg-Marquardt with `terms` added per camera. Returns the covariance of the
    /// cameras' motions (twists about the center), or `None` where the system is singular.
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
        let block = |i: usize| inverse.fixed_view::<6, 6>(UNKNOWNS * i, UNKNOWNS * i).into_owned();
        Some((0..self.cameras.len()).map(block).collect())
    }

    fn projectors(&self) -> Vec<Projector> {
        self.cameras.iter().map(|c| Projector::new(c, &self.center)).collect()
    }

    fn twists(&self) -> Vec<Vector6<f64>> {
        self.cameras.iter().map(|c| twist_about(&c.drift, &self.center)).collect()
    }

    /// Found minus predicted pixel; `None` behind the camera.
    pub fn residual(&self, point: &AdjustedPoint, o: &PointObservation) -> Option<Vector2<f64>> {
        let camera = &self.cameras[o.camera_idx];
        let p = camera.adjusted_cam_from_world() * point.in_world;
        camera.adjusted_intrinsics().img_from_cam(&p).map(|predicted| o.pixel - predicted)
    }

    fn blocks(&self, projectors: &[Projector], point: &AdjustedPoint, damping: f64) -> PointBlocks {
        let mut b = PointBlocks { own: Matrix3::zeros(), right: Vector3::zeros(), cameras: Vec::new(), cost: 0.0 };
        for o in point.observations.iter().filter(|o| o.is_inlier) {
            let Some((pixel, by_camera, by_point)) = projectors[o.camera_idx].project(&point.in_world) else {
                // Behind the camera: a large constant, so that steps that put it there are refused.
                b.cost += 1e6;
                continue;
            };
            let residual = o.pixel - pixel;
            let sq = (residual / self.feature_px).norm_squared();
            let weight = 1.0 / (1.0 + sq) / self.feature_px.powi(2);
            b.cost += sq.ln_1p();
            b.own += by_point.transpose() * by_point * weight;
            b.right += by_point.transpose() * residual * weight;
            b.cameras.push((
                o.camera_idx,
                by_camera.transpose() * by_camera * weight,
                by_camera.transpose() * residual * weight,
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
        let n = UNKNOWNS * self.cameras.len();
        let projectors = self.projectors();
        let piece = self.points.len().div_ceil(PIECES).max(1);
        let sums: Vec<Reduced> = self
            .points
            .par_chunks(piece)
            .map(|points| {
                let mut sum = Reduced { hessian: DMatrix::zeros(n, n), right: DVector::zeros(n), cost: 0.0 };
                for point in points {
                    let b = self.blocks(&projectors, point, damping);
                    sum.cost += b.cost;
                    let Some(inverse) = b.own.cholesky().map(|c| c.inverse()) else { continue };
                    for (i, own, right, mixed) in &b.cameras {
                        let through = mixed * inverse;
                        let mut block = sum.hessian.fixed_view_mut::<UNKNOWNS, UNKNOWNS>(UNKNOWNS * i, UNKNOWNS * i);
                        block += own;
                        let mut part = sum.right.fixed_rows_mut::<UNKNOWNS>(UNKNOWNS * i);
                        part += right - through * b.right;
                        // Below the diagonal only; the rest follows by symmetry.
                        for (j, _, _, other) in b.cameras.iter().filter(|other| other.0 <= *i) {
                            let at = (UNKNOWNS * i, UNKNOWNS * j);
                            let mut block = sum.hessian.fixed_view_mut::<UNKNOWNS, UNKNOWNS>(at.0, at.1);
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
        total.hessian.fill_upper_triangle_with_lower_triangle();
        total.cost.is_finite().then_some(total)
    }

    /// Adds to the lower triangle.
    fn add_camera_terms(&self, total: &mut Reduced, terms: &[CameraTerm], start: &[Vector6<f64>]) {
        let twists = self.twists();
        let (hessian, right) = (&mut total.hessian, &mut total.right);
        let mut add = |i: usize, j: usize, block: &Matrix6<f64>| {
            let mut view = hessian.fixed_view_mut::<6, 6>(UNKNOWNS * i, UNKNOWNS * j);
            view += block;
        };
        let mut pull = |i: usize, slope: &Vector6<f64>| {
            let mut view = right.fixed_rows_mut::<6>(UNKNOWNS * i);
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
        let focal = self.focal_information.min(EXACT);
        for (i, camera) in self.cameras.iter().enumerate() {
            let at = UNKNOWNS * i + 6;
            hessian[(at, at)] += focal;
            right[at] -= focal * camera.log_focal;
            total.cost += focal * camera.log_focal.powi(2);
        }
    }

    /// Moves the cameras by `step` and every point to its best place for it.
    fn apply(&mut self, step: &DVector<f64>, damping: f64) {
        let projectors = self.projectors();
        let moves: Vec<Vector3<f64>> = self
            .points
            .par_iter()
            .map(|point| {
                let b = self.blocks(&projectors, point, damping);
                let mut right = b.right;
                for (i, _, _, mixed) in &b.cameras {
                    right -= mixed.transpose() * step.fixed_rows::<UNKNOWNS>(UNKNOWNS * i);
                }
                b.own.cholesky().map_or_else(Vector3::zeros, |c| c.solve(&right))
            })
            .collect();
        for (i, camera) in self.cameras.iter_mut().enumerate() {
            camera.drift = moved(&camera.drift, &step.fixed_rows::<6>(UNKNOWNS * i).into_owned(), &self.center);
            if self.focal_information.is_finite() {
                camera.log_focal += step[UNKNOWNS * i + 6];
            }
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

    #[test]
    fn derivatives_are_those_of_finite_differences() {
        let mut rng = mb_job::rng(9, 0);
        let mut uniform = |size: f64| rng.random_range(-size..size);
        let center = Vector3::new(0.02, -0.01, 0.03);
        for _ in 0..50 {
            let camera = AdjustedCamera {
                intrinsics: Intrinsics { fx: 700.0, fy: 710.0, cx: 480.0, cy: 360.0 },
                cam_from_world: Rigid3::exp(&Vector6::from_fn(|k, _| {
                    uniform(if k < 3 { 0.5 } else { 0.05 }) + if k == 5 { 0.4 } else { 0.0 }
                })),
                drift: Rigid3::exp(&Vector6::from_fn(|_, _| uniform(0.02))),
                log_focal: uniform(0.05),
            };
            let p = Point3::from(Vector3::from_fn(|_, _| uniform(0.08)));
            let (_, by_camera, by_point) = Projector::new(&camera, &center).project(&p).expect("before the camera");
            let step = 1e-6;
            let pixel = |camera: &AdjustedCamera, p: &Point3<f64>| {
                Projector::new(camera, &center).project(p).expect("before the camera").0
            };
            for unknown in 0..UNKNOWNS {
                let at = |sign: f64| {
                    let mut camera = camera;
                    let mut twist = Vector6::zeros();
                    if unknown < 6 {
                        twist[unknown] = sign * step;
                    } else {
                        camera.log_focal += sign * step;
                    }
                    camera.drift = moved(&camera.drift, &twist, &center);
                    pixel(&camera, &p)
                };
                let slope = (at(1.0) - at(-1.0)) / (2.0 * step);
                assert!((slope - by_camera.column(unknown)).norm() < 1e-4 * (1.0 + slope.norm()), "unknown {unknown}");
            }
            for axis in 0..3 {
                let by = Vector3::ith(axis, step);
                let slope = (pixel(&camera, &(p + by)) - pixel(&camera, &(p - by))) / (2.0 * step);
                assert!((slope - by_point.column(axis)).norm() < 1e-4 * (1.0 + slope.norm()), "axis {axis}");
            }
        }
    }

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
            cameras.push(AdjustedCamera { intrinsics, cam_from_world: pose.inverse(), drift, log_focal: 0.0 });
        }
        let mut adjustment = Adjustment {
            cameras,
            points: Vec::new(),
            center,
            feature_px: 0.5,
            surface_m: 1e-4,
            drift_information: Matrix6::identity() * 1e-6,
            step_information: Matrix6::zeros(),
            focal_information: f64::INFINITY,
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
