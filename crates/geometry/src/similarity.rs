//! Similarity transforms, for maps whose scale is unknown.

use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};

use crate::Rigid3;

/// A similarity: `p_in_to = scale * R * p_in_from + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sim3<To, From> {
    /// Rotation and translation; the translation is not scaled.
    pub rigid: Rigid3<To, From>,
    /// Length in `To` of a unit length in `From`, above zero.
    pub scale: f64,
}

impl<To, From> Sim3<To, From> {
    /// Maps a point.
    pub fn transform_point(&self, p_in_from: &Point3<f64>) -> Point3<f64> {
        self.rigid * Point3::from(p_in_from.coords * self.scale)
    }

    /// The inverse similarity.
    pub fn inverse(&self) -> Sim3<From, To> {
        let inverse = self.rigid.inverse();
        let rigid = Rigid3::from_parts(inverse.rotation(), inverse.translation() / self.scale);
        Sim3 { rigid, scale: 1.0 / self.scale }
    }

    /// The least-squares similarity (or rigid transform, where `with_scale` is false) that maps `points_in_from` onto
    /// `points_in_to` (Umeyama 1991, eq. 40-42). `None` for fewer than three pairs, unequal counts, points on one
    /// line, or numbers that are not finite.
    pub fn align(points_in_to: &[Point3<f64>], points_in_from: &[Point3<f64>], with_scale: bool) -> Option<Self> {
        let (found, is_unique) = umeyama(points_in_to, points_in_from, with_scale)?;
        is_unique.then_some(found)
    }

    /// Like [`Self::align`], but where the points lie on a line or are fewer than three, one of the transforms that
    /// map them equally well: enough where only the remaining distances matter. `None` for no pair, unequal counts,
    /// numbers that are not finite, or a scale that nothing determines.
    pub fn align_any(points_in_to: &[Point3<f64>], points_in_from: &[Point3<f64>], with_scale: bool) -> Option<Self> {
        umeyama(points_in_to, points_in_from, with_scale).map(|(found, _)| found)
    }
}

/// The alignment, and whether no other is as good.
fn umeyama<To, From>(
    points_in_to: &[Point3<f64>],
    points_in_from: &[Point3<f64>],
    with_scale: bool,
) -> Option<(Sim3<To, From>, bool)> {
    let n = points_in_from.len();
    if n == 0 || points_in_to.len() != n {
        return None;
    }
    let mean = |points: &[Point3<f64>]| points.iter().map(|p| p.coords).sum::<Vector3<f64>>() / n as f64;
    let (mean_to, mean_from) = (mean(points_in_to), mean(points_in_from));
    let mut covariance = Matrix3::zeros();
    let mut variance_from = 0.0;
    for (to, from) in points_in_to.iter().zip(points_in_from) {
        let (to, from) = (to.coords - mean_to, from.coords - mean_from);
        covariance += to * from.transpose() / n as f64;
        variance_from += from.norm_squared() / n as f64;
    }
    if !covariance.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    // Two directions must carry spread, or the rotation about the line is free.
    let is_unique = n >= 3 && svd.singular_values[1] > 1e-7 * svd.singular_values[0].max(f64::MIN_POSITIVE);
    let mut sign = Vector3::new(1.0, 1.0, 1.0);
    if (u * v_t).determinant() < 0.0 {
        sign.z = -1.0;
    }
    let rotation = if is_unique {
        Rotation3::from_matrix_unchecked(u * Matrix3::from_diagonal(&sign) * v_t)
    } else {
        // On a line the decomposition means little: turn the direction of the point farthest out into its partner's.
        let offset = |i: usize| (points_in_from[i].coords - mean_from, points_in_to[i].coords - mean_to);
        let farthest = (0..n).max_by(|&i, &j| offset(i).0.norm().total_cmp(&offset(j).0.norm())).unwrap_or(0);
        let (from, to) = offset(farthest);
        Rotation3::rotation_between(&from, &to).unwrap_or_else(Rotation3::identity)
    };
    let scale = if with_scale { svd.singular_values.dot(&sign) / variance_from } else { 1.0 };
    if !(scale > 0.0 && scale.is_finite()) {
        return None;
    }
    let translation = mean_to - rotation * mean_from * scale;
    let rigid = Rigid3::from_parts(UnitQuaternion::from_rotation_matrix(&rotation), translation);
    Some((Sim3 { rigid, scale }, is_unique))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Object, World};
    use nalgebra::Vector6;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn align_recovers_a_similarity(xi in prop::array::uniform6(-1.8..1.8f64), scale in 0.1..10.0f64) {
            let truth = Sim3::<World, Object> { rigid: Rigid3::exp(&Vector6::from(xi)), scale };
            let from: Vec<Point3<f64>> =
                [[0., 0., 0.], [1., 0., 0.], [0., 2., 0.], [0.3, 0.1, 1.], [-1., 0.5, 0.2]].map(Point3::from).to_vec();
            let to: Vec<_> = from.iter().map(|p| truth.transform_point(p)).collect();
            let found = Sim3::<World, Object>::align(&to, &from, true).unwrap();
            for (to, from) in to.iter().zip(&from) {
                prop_assert!((found.transform_point(from) - to).norm() < 1e-9);
                prop_assert!((found.inverse().transform_point(to) - from).norm() < 1e-9);
            }
        }
    }

    #[test]
    fn points_on_a_line_have_no_unique_alignment() {
        let line: Vec<Point3<f64>> = (0..5).map(|i| Point3::new(i as f64, 0.0, 0.0)).collect();
        assert!(Sim3::<World, Object>::align(&line, &line, false).is_none());
        let turned: Vec<Point3<f64>> = (0..5).map(|i| Point3::new(0.5, 2.0 - i as f64, 7.0)).collect();
        let any = Sim3::<World, Object>::align_any(&turned, &line, false).unwrap();
        for (to, from) in turned.iter().zip(&line) {
            assert!((any.transform_point(from) - to).norm() < 1e-12);
        }
        assert!(Sim3::<World, Object>::align_any(&line[..1], &line[..1], true).is_none(), "one point has no scale");
    }
}
