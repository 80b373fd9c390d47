//! The rigid alignment of `exact-1`: point to surface, reported beside the unaligned score and never instead of it.

use mb_geometry::{Rigid3, World};
use mb_mesh::TriangleMesh;
use nalgebra::{Matrix6, Point3, SymmetricEigen, Vector3, Vector6};

use super::distance::Target;
use super::{Icp, SurfaceTruth};

/// Ground-truth points that take part.
const POINTS: usize = 5_000;
/// Pairs farther apart than this do not count, metres.
const REACH_M: f64 = 0.02;
const MAX_ITERATIONS: usize = 30;
/// The motion has settled when no point moves by more than this, metres.
const SETTLED_M: f64 = 1e-7;
/// Directions with less than this share of the strongest one's stiffness are free and stay as they are.
const FREE: f64 = 1e-6;

/// Outcome of the alignment.
pub(super) struct Alignment {
    pub pred_from_gt: Rigid3<World, World>,
    /// Share of the points within [`REACH_M`] of the prediction, after the last iteration.
    pub fitness: f64,
}

/// The rigid motion that brings points of the ground truth onto the prediction: Gauss-Newton on the distances to the
/// planes of the closest triangles (Chen and Medioni 1992); on a point cloud, to the closest points.
pub(super) fn align(gt_points: &[Point3<f64>], mesh: &TriangleMesh, target: &Target) -> Alignment {
    let step = gt_points.len().div_ceil(POINTS).max(1);
    let points: Vec<Point3<f64>> = gt_points.iter().step_by(step).copied().collect();
    let middle = points.iter().map(|p| p.coords).sum::<Vector3<f64>>() / points.len() as f64;
    let radius = points.iter().map(|p| (p.coords - middle).norm()).fold(0.0, f64::max);
    let mut pred_from_gt = Rigid3::<World, World>::identity();
    let mut fitness = 0.0;
    for _ in 0..MAX_ITERATIONS {
        let moved: Vec<Point3<f64>> = points.iter().map(|p| pred_from_gt * *p).collect();
        let closest = target.closest(&moved, REACH_M);
        fitness = closest.iter().flatten().count() as f64 / points.len() as f64;
        let mut stiffness = Matrix6::zeros();
        let mut pull = Vector6::zeros();
        for (p, closest) in moved.iter().zip(&closest) {
            let Some(closest) = closest else { continue };
            let normals = match target {
                Target::Points { .. } => [Some(Vector3::x()), Some(Vector3::y()), Some(Vector3::z())],
                _ => [mesh.scaled_normal(closest.triangle as usize).try_normalize(0.0), None, None],
            };
            // Radii scaled to 1, so that rotations and translations weigh alike.
            let arm = (p.coords - middle) / radius;
            for normal in normals.into_iter().flatten() {
                let torque = arm.cross(&normal);
                let row = Vector6::new(torque.x, torque.y, torque.z, normal.x, normal.y, normal.z);
                stiffness += row * row.transpose();
                pull += row * (closest.point - p).dot(&normal);
            }
        }
        let motion = solve(&stiffness, &pull);
        let rotation = motion.fixed_rows::<3>(0) / radius;
        let shift: Vector3<f64> = motion.fixed_rows::<3>(3).into();
        let about_middle =
            Rigid3::<World, World>::from_parts(nalgebra::UnitQuaternion::from_scaled_axis(rotation), shift);
        let (there, back) = (Rigid3::<World, World>::from_translation(middle), Rigid3::from_translation(-middle));
        pred_from_gt = there * about_middle * back * pred_from_gt;
        if motion.norm() < SETTLED_M {
            break;
        }
    }
    Alignment { pred_from_gt, fitness }
}

/// The least-squares motion, zero along directions that nothing holds.
fn solve(stiffness: &Matrix6<f64>, pull: &Vector6<f64>) -> Vector6<f64> {
    let eigen = SymmetricEigen::new(*stiffness);
    let strongest = eigen.eigenvalues.amax();
    let mut motion = Vector6::zeros();
    for (value, direction) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
        if *value > FREE * strongest {
            motion += direction * (direction.dot(pull) / value);
        }
    }
    motion
}

impl Alignment {
    /// In numbers for people.
    pub fn describe(&self, truth: &SurfaceTruth, applied: bool) -> Icp {
        let middle = truth.mesh.bounds().center();
        Icp {
            fitness: self.fitness,
            applied,
            rotation_deg: self.pred_from_gt.angle_rad().to_degrees(),
            translation_mm: 1000.0 * (self.pred_from_gt * middle - middle).norm(),
        }
    }

    /// Whether it moves nothing: points around `middle` stay where they are up to rounding.
    pub fn is_rest(&self, middle: &Point3<f64>) -> bool {
        let moved = self.pred_from_gt * *middle;
        self.pred_from_gt.angle_rad() < 1e-9 && (moved - middle).norm() < 1e-9
    }
}
