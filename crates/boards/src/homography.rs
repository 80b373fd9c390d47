//! Plane to plane.

use nalgebra::{Matrix2, Matrix3, Point2, SMatrix, Vector3};

/// A projective map between two planes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Homography(pub Matrix3<f64>);

impl Homography {
    /// The map that brings the first of each pair to the second, at least four pairs, least squares of the algebraic
    /// error in normalised coordinates (Hartley 1997, "In defense of the eight-point algorithm").
    ///
    /// `None` where the points determine none.
    pub fn fit(pairs: &[(Point2<f64>, Point2<f64>)]) -> Option<Self> {
        if pairs.len() < 4 {
            return None;
        }
        let from = normalising(pairs.iter().map(|p| &p.0))?;
        let to = normalising(pairs.iter().map(|p| &p.1))?;
        let mut normal = SMatrix::<f64, 9, 9>::zeros();
        for (source, target) in pairs {
            let s = from * source.to_homogeneous();
            let t = to * target.to_homogeneous();
            let rows = [
                [s.x, s.y, 1.0, 0.0, 0.0, 0.0, -t.x * s.x, -t.x * s.y, -t.x],
                [0.0, 0.0, 0.0, s.x, s.y, 1.0, -t.y * s.x, -t.y * s.y, -t.y],
            ];
            for row in rows {
                let row = SMatrix::<f64, 9, 1>::from(row);
                normal += row * row.transpose();
            }
        }
        let eigen = normal.symmetric_eigen();
        let smallest = eigen.eigenvalues.imin();
        // A second vanishing direction: the points lie on a line, or coincide.
        let mut sorted: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        if sorted[1] <= 1e-9 * sorted[8] {
            return None;
        }
        let h = eigen.eigenvectors.column(smallest);
        let h = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
        let map = to.try_inverse()? * h * from;
        let map = map / map.norm();
        (map.determinant().abs() > 1e-30 && map.iter().all(|v| v.is_finite())).then_some(Self(map))
    }

    /// Where a point goes; far away where it goes to infinity.
    pub fn apply(&self, p: &Point2<f64>) -> Point2<f64> {
        let q: Vector3<f64> = self.0 * p.to_homogeneous();
        Point2::new(q.x / q.z, q.y / q.z)
    }

    /// Derivative of [`Self::apply`].
    pub fn jacobian(&self, p: &Point2<f64>) -> Matrix2<f64> {
        let q: Vector3<f64> = self.0 * p.to_homogeneous();
        let (x, y) = (q.x / q.z, q.y / q.z);
        let m = &self.0;
        Matrix2::new(
            m[(0, 0)] - x * m[(2, 0)],
            m[(0, 1)] - x * m[(2, 1)],
            m[(1, 0)] - y * m[(2, 0)],
            m[(1, 1)] - y * m[(2, 1)],
        ) / q.z
    }
}

/// Moves points to zero mean and a root mean square distance of the root of 2.
fn normalising<'a>(points: impl Iterator<Item = &'a Point2<f64>> + Clone) -> Option<Matrix3<f64>> {
    let count = points.clone().count() as f64;
    let mean = points.clone().fold(nalgebra::Vector2::zeros(), |sum, p| sum + p.coords) / count;
    let spread = (points.map(|p| (p.coords - mean).norm_squared()).sum::<f64>() / count).sqrt();
    if !(spread > 0.0 && spread.is_finite()) {
        return None;
    }
    let s = std::f64::consts::SQRT_2 / spread;
    Some(Matrix3::new(s, 0.0, -s * mean.x, 0.0, s, -s * mean.y, 0.0, 0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn points_give_back_their_map(tilt in prop::array::uniform2(-1.0..1.0f64), turn in -3.0..3.0f64, x in -2.0..2.0f64) {
            let (c, s) = (turn.cos(), turn.sin());
            let truth = Homography(Matrix3::new(400.0 * c, -400.0 * s, 300.0, 390.0 * s, 390.0 * c, 200.0, tilt[0], tilt[1], 1.0));
            let points = [[0.0, 0.0], [0.2, 0.0], [0.2, 0.25], [0.0, 0.25], [0.1, 0.07]].map(Point2::from);
            let found = Homography::fit(&points.map(|p| (p, truth.apply(&p)))).expect("a map");
            let p = Point2::new(0.05 * x, 0.1);
            prop_assert!((found.apply(&p) - truth.apply(&p)).norm() < 1e-6);
            let step = 1e-6;
            let slope = (found.apply(&(p + nalgebra::Vector2::new(step, 0.0))) - found.apply(&p)) / step;
            prop_assert!((slope - found.jacobian(&p).column(0)).norm() < 1e-2);
        }
    }

    #[test]
    fn points_on_a_line_have_no_map() {
        let line = [0.0, 1.0, 2.0, 3.0, 4.0].map(|x| (Point2::new(x, 2.0 * x), Point2::new(x, x)));
        assert_eq!(Homography::fit(&line), None);
        assert_eq!(Homography::fit(&[(Point2::origin(), Point2::origin()); 6]), None);
        assert_eq!(Homography::fit(&line[..3]), None);
    }
}
