//! What a triangle needs for many pixel tests.

use nalgebra::Vector3;

/// Linear functions over the image for one triangle: three sides and the inverse depth.
pub(crate) struct Setup {
    /// `side[i] . (x, y, 1)` is positive inside.
    sides: [Vector3<f64>; 3],
    /// Smallest value of each side's function that still belongs to the triangle: 0 or the next number above it, so
    /// that a pixel centre right on a shared side belongs to exactly one of two triangles on either side of it.
    least: [f64; 3],
    /// `plane . (x, y, 1)` is 1 / depth.
    plane: Vector3<f64>,
    /// 1 / depth of the farthest corner and of the nearest: between pixels a steep plane must not overshoot.
    range: (f64, f64),
}

/// The same along one row of pixels.
pub(crate) struct Row<'a> {
    setup: &'a Setup,
    sides: [f64; 3],
    plane: f64,
}

impl Setup {
    /// From corners in homogeneous pixel coordinates. `None` for a triangle seen edge-on, or without area.
    pub(crate) fn new([q0, q1, q2]: [&Vector3<f64>; 3]) -> Option<Self> {
        let normal = (q1 - q0).cross(&(q2 - q0));
        let determinant = normal.dot(q0);
        if determinant == 0.0 || !determinant.is_finite() {
            return None;
        }
        let sign = determinant.signum();
        let sides = [q1.cross(q2) * sign, q2.cross(q0) * sign, q0.cross(q1) * sign];
        let least = sides.map(|side| {
            let owns_border = side.x > 0.0 || (side.x == 0.0 && side.y > 0.0);
            if owns_border { 0.0 } else { f64::from_bits(1) }
        });
        let depths = [q0.z, q1.z, q2.z];
        let farthest = depths.into_iter().fold(0.0, f64::max);
        let nearest = depths.into_iter().fold(f64::INFINITY, f64::min);
        let range = (1.0 / farthest, if nearest > 0.0 { 1.0 / nearest } else { f64::INFINITY });
        Some(Self { sides, least, plane: normal / determinant, range })
    }

    pub(crate) fn row(&self, y: f64) -> Row<'_> {
        let along = |f: &Vector3<f64>| f.y * y + f.z;
        let [a, b, c] = &self.sides;
        Row { setup: self, sides: [along(a), along(b), along(c)], plane: along(&self.plane) }
    }
}

impl Row<'_> {
    /// Whether the pixel centre at column `x` belongs to the triangle.
    #[inline]
    pub(crate) fn contains(&self, x: f64) -> bool {
        let side = |i: usize| self.setup.sides[i].x * x + self.sides[i] >= self.setup.least[i];
        side(0) & side(1) & side(2)
    }

    /// 1 / depth of the triangle at column `x`.
    #[inline]
    pub(crate) fn inverse_depth(&self, x: f64) -> f64 {
        let (low, high) = self.setup.range;
        (self.setup.plane.x * x + self.plane).max(low).min(high)
    }
}
