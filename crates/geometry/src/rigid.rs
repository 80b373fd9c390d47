//! Rigid transforms between named frames.

use std::marker::PhantomData;
use std::ops::Mul;

use nalgebra::{
    Isometry3, Matrix3, Matrix4, Point3, Quaternion, Rotation3, Translation3, UnitQuaternion, Vector3, Vector6,
};
use serde::{Deserialize, Serialize};

/// A rigid transform that maps coordinates in `From` to coordinates in `To`.
///
/// Written and stored target-first: `cam_from_world: Rigid3<Camera, World>`, and
/// `cam_from_world * p_in_world = p_in_cam`.
///
/// Perturbations act on the left, in the target frame: `exp(delta) * t`, with `delta = [rotation; translation]`
/// (radians, metres). Covariances follow the same order and side.
///
/// Serialised as `{"rotation_wxyz": [4], "translation_m": [3]}`.
#[derive(Serialize, Deserialize)]
#[serde(try_from = "RigidRecord", into = "RigidRecord", bound = "")]
pub struct Rigid3<To, From> {
    isometry: Isometry3<f64>,
    frames: PhantomData<fn(From) -> To>,
}

/// How far a matrix's upper-left block was from a rotation when it was made into one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotationDefect {
    /// Largest absolute entry of `R^T R - I`.
    pub orthogonality: f64,
    /// Determinant of the block as found.
    pub determinant: f64,
}

impl RotationDefect {
    /// Whether the block is a rotation up to rounding of a text file with `tolerance` per entry.
    pub fn is_within(&self, tolerance: f64) -> bool {
        self.orthogonality <= tolerance && (self.determinant - 1.0).abs() <= tolerance
    }
}

impl<To, From> Rigid3<To, From> {
    /// The transform between two frames that coincide.
    pub fn identity() -> Self {
        Self::from_isometry(Isometry3::identity())
    }

    /// From rotation and translation; the caller vouches for the frames.
    pub fn from_parts(rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self::from_isometry(Isometry3::from_parts(Translation3::from(translation), rotation))
    }

    /// From an isometry; the caller vouches for the frames.
    pub fn from_isometry(isometry: Isometry3<f64>) -> Self {
        Self { isometry, frames: PhantomData }
    }

    /// A pure translation (metres in the target frame).
    pub fn from_translation(translation: Vector3<f64>) -> Self {
        Self::from_parts(UnitQuaternion::identity(), translation)
    }

    /// From a 4x4 matrix; the caller vouches for the frames.
    ///
    /// The upper-left block is replaced by the nearest rotation (polar decomposition), and the defect that this mended
    /// is returned so that the caller can report it: published poses reach a determinant of 0.99986.
    /// `None` where an entry is not finite, the last row is not (0, 0, 0, 1), or the block is nowhere near a rotation
    /// (singular, reflected, or scaled by more than 10 %).
    pub fn from_matrix(matrix: &Matrix4<f64>) -> Option<(Self, RotationDefect)> {
        let last_row = matrix.fixed_view::<1, 4>(3, 0);
        let last_row_ok = (last_row - nalgebra::RowVector4::new(0.0, 0.0, 0.0, 1.0)).amax() < 1e-6;
        if !matrix.iter().all(|v| v.is_finite()) || !last_row_ok {
            return None;
        }
        let block: Matrix3<f64> = matrix.fixed_view::<3, 3>(0, 0).into();
        let defect = RotationDefect {
            orthogonality: (block.transpose() * block - Matrix3::identity()).amax(),
            determinant: block.determinant(),
        };
        if defect.determinant < 0.7 || defect.orthogonality > 0.25 {
            return None;
        }
        let svd = block.svd(true, true);
        let rotation = Rotation3::from_matrix_unchecked(svd.u? * svd.v_t?);
        let translation = matrix.fixed_view::<3, 1>(0, 3).into_owned();
        Some((Self::from_parts(UnitQuaternion::from_rotation_matrix(&rotation), translation), defect))
    }

    /// The 4x4 matrix, last row (0, 0, 0, 1).
    pub fn to_matrix(&self) -> Matrix4<f64> {
        self.isometry.to_homogeneous()
    }

    /// The rotation.
    pub fn rotation(&self) -> UnitQuaternion<f64> {
        self.isometry.rotation
    }

    /// The rotation as a matrix.
    pub fn rotation_matrix(&self) -> Matrix3<f64> {
        self.isometry.rotation.to_rotation_matrix().into_inner()
    }

    /// The translation: the source frame's origin, in the target frame (metres).
    pub fn translation(&self) -> Vector3<f64> {
        self.isometry.translation.vector
    }

    /// The inverse transform.
    pub fn inverse(&self) -> Rigid3<From, To> {
        Rigid3::from_isometry(self.isometry.inverse())
    }

    /// Rotates a direction (or any free vector) without translating it.
    pub fn rotate(&self, v_in_from: &Vector3<f64>) -> Vector3<f64> {
        self.isometry.rotation * v_in_from
    }

    /// The angle of the rotation, in radians, in [0, pi].
    pub fn angle_rad(&self) -> f64 {
        self.isometry.rotation.angle()
    }

    /// The exponential map of `[rotation; translation]` (radians, metres), with the full coupling of SE(3):
    /// translation = V(rotation) * rho (Eade, "Lie Groups for 2D and 3D Transformations", eq. 77).
    pub fn exp(twist: &Vector6<f64>) -> Self {
        let omega: Vector3<f64> = twist.fixed_rows::<3>(0).into();
        let rho: Vector3<f64> = twist.fixed_rows::<3>(3).into();
        Self::from_parts(UnitQuaternion::from_scaled_axis(omega), left_jacobian(&omega) * rho)
    }

    /// The logarithm: the twist `[rotation; translation]` whose exponential this is, rotation angle at most pi.
    pub fn log(&self) -> Vector6<f64> {
        let omega = self.isometry.rotation.scaled_axis();
        // The left Jacobian is invertible for every angle below 2 pi.
        let rho = left_jacobian(&omega).try_inverse().unwrap_or_else(Matrix3::identity) * self.translation();
        let mut twist = Vector6::zeros();
        twist.fixed_rows_mut::<3>(0).copy_from(&omega);
        twist.fixed_rows_mut::<3>(3).copy_from(&rho);
        twist
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        self.isometry.rotation.coords.iter().chain(self.isometry.translation.vector.iter()).all(|v| v.is_finite())
    }
}

/// The left Jacobian of SO(3): `V = I + (1 - cos t)/t^2 [w]x + (t - sin t)/t^3 [w]x^2`, with its series near zero.
fn left_jacobian(omega: &Vector3<f64>) -> Matrix3<f64> {
    let theta_sq = omega.norm_squared();
    let skew = omega.cross_matrix();
    let (a, b) = if theta_sq < 1e-6 {
        (0.5 - theta_sq / 24.0, 1.0 / 6.0 - theta_sq / 120.0)
    } else {
        let theta = theta_sq.sqrt();
        ((1.0 - theta.cos()) / theta_sq, (theta - theta.sin()) / (theta_sq * theta))
    };
    Matrix3::identity() + skew * a + skew * skew * b
}

impl<A, B, C> Mul<Rigid3<B, C>> for Rigid3<A, B> {
    type Output = Rigid3<A, C>;
    fn mul(self, right: Rigid3<B, C>) -> Rigid3<A, C> {
        Rigid3::from_isometry(self.isometry * right.isometry)
    }
}

impl<To, From> Mul<Point3<f64>> for Rigid3<To, From> {
    type Output = Point3<f64>;
    fn mul(self, p_in_from: Point3<f64>) -> Point3<f64> {
        self.isometry * p_in_from
    }
}

// Derived implementations would demand the same traits of the frame markers.
impl<To, From> Clone for Rigid3<To, From> {
    fn clone(&self) -> Self {
        *self
    }
}
impl<To, From> Copy for Rigid3<To, From> {}
impl<To, From> PartialEq for Rigid3<To, From> {
    fn eq(&self, other: &Self) -> bool {
        self.isometry == other.isometry
    }
}
impl<To, From> std::fmt::Debug for Rigid3<To, From> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let t = self.translation();
        let w = self.isometry.rotation.scaled_axis();
        write!(f, "Rigid3(axis-angle [{}, {}, {}] rad, translation [{}, {}, {}] m)", w.x, w.y, w.z, t.x, t.y, t.z)
    }
}

/// The form on disk.
#[derive(Serialize, Deserialize)]
struct RigidRecord {
    rotation_wxyz: [f64; 4],
    translation_m: [f64; 3],
}

impl<To, From> std::convert::From<Rigid3<To, From>> for RigidRecord {
    fn from(t: Rigid3<To, From>) -> Self {
        let q = t.rotation();
        Self { rotation_wxyz: [q.w, q.i, q.j, q.k], translation_m: t.translation().into() }
    }
}

impl<To, From> TryFrom<RigidRecord> for Rigid3<To, From> {
    type Error = String;
    fn try_from(record: RigidRecord) -> Result<Self, String> {
        let [w, x, y, z] = record.rotation_wxyz;
        let norm = (w * w + x * x + y * y + z * z).sqrt();
        if !(0.9..1.1).contains(&norm) {
            return Err(format!("rotation_wxyz has norm {norm}, not 1"));
        }
        let t =
            Self::from_parts(UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)), record.translation_m.into());
        if t.is_finite() { Ok(t) } else { Err("translation_m is not finite".to_owned()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Camera, World};
    use proptest::prelude::*;

    type CamFromWorld = Rigid3<Camera, World>;

    fn twist(limit_rad: f64) -> impl Strategy<Value = Vector6<f64>> {
        (prop::array::uniform3(-1.0..1.0f64), 0.0..limit_rad, prop::array::uniform3(-2.0..2.0f64)).prop_map(
            |(axis, angle, t)| {
                let axis = Vector3::from(axis);
                let w = if axis.norm() > 1e-3 { axis.normalize() * angle } else { Vector3::zeros() };
                Vector6::new(w.x, w.y, w.z, t[0], t[1], t[2])
            },
        )
    }

    proptest! {
        #[test]
        fn log_inverts_exp(xi in twist(3.1)) {
            prop_assert!((CamFromWorld::exp(&xi).log() - xi).norm() < 1e-9);
        }

        #[test]
        fn inverse_undoes(xi in twist(3.1), p in prop::array::uniform3(-5.0..5.0f64)) {
            let t = CamFromWorld::exp(&xi);
            let p = Point3::from(p);
            prop_assert!((t.inverse() * (t * p) - p).norm() < 1e-12);
        }

        #[test]
        fn matrix_round_trip(xi in twist(3.1)) {
            let t = CamFromWorld::exp(&xi);
            let (back, defect) = CamFromWorld::from_matrix(&t.to_matrix()).unwrap();
            prop_assert!((back.inverse() * t).log().norm() < 1e-12);
            prop_assert!(defect.is_within(1e-12));
        }

        #[test]
        fn exp_is_the_limit_of_small_steps(xi in twist(2.0)) {
            let n = 4096;
            let step = CamFromWorld::exp(&(xi / n as f64)).isometry;
            let mut product = Isometry3::identity();
            for _ in 0..n { product *= step; }
            let difference = CamFromWorld::from_isometry(product).inverse() * CamFromWorld::exp(&xi);
            prop_assert!(difference.log().norm() < 1e-9);
        }
    }

    #[test]
    fn a_published_rotation_defect_is_mended_and_told() {
        let mut m = CamFromWorld::exp(&Vector6::new(0.3, -0.2, 0.9, 1.0, 2.0, 3.0)).to_matrix();
        for row in 0..3 {
            for col in 0..3 {
                m[(row, col)] *= 0.99986f64.cbrt();
            }
        }
        let (t, defect) = CamFromWorld::from_matrix(&m).unwrap();
        assert!((t.rotation_matrix().determinant() - 1.0).abs() < 1e-12);
        assert!((defect.determinant - 0.99986).abs() < 1e-9);
        assert!(!defect.is_within(1e-5));
    }

    #[test]
    fn what_is_no_rotation_is_refused() {
        let good = CamFromWorld::identity().to_matrix();
        for (row, col, value) in [(0, 0, -1.0), (0, 0, f64::NAN), (2, 2, 0.0), (3, 0, 1.0), (3, 3, 0.0), (1, 1, 2.0)] {
            let mut m = good;
            m[(row, col)] = value;
            assert!(CamFromWorld::from_matrix(&m).is_none(), "entry ({row}, {col}) = {value} was accepted");
        }
    }
}
