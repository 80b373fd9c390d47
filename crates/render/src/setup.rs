//! What a triangle needs for many pixel tests.
//!
//! A pixel's ray, in homogeneous pixel coordinates, is p = (x, y, 1). With the corners q0, q1, q2 of a triangle in the
//! same coordinates (q = K * p_in_cam), the ray meets the triangle where (qj x qk) . p has the sign of
//! det = q0 . (q1 x q2) for all three sides, and 1 / depth = n . p / det with n = (q1 - q0) x (q2 - q0) (Olano and
//! Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", 1997). Nothing is divided by the depth of a
//! corner behind the camera, so triangles that cross its plane need no clipping. A side between two corners in front of
//! the camera is computed from their pixel coordinates, q / q.z, which is the same up to a positive factor.
//!
//! Everything is `f64`, and a side's function is, to the last bit, the negative of what the neighbour across that side
//! computes: no pixel falls between two triangles, and none belongs to both.

use nalgebra::Vector3;
use wide::f64x4;

/// A vertex as seen from a view.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Corner {
    /// Pixel coordinates, of meaning in front of the camera.
    pub(crate) x: f64,
    pub(crate) y: f64,
    /// 1 / depth; not above 0 for vertices that are not in front.
    pub(crate) w: f64,
}

impl Corner {
    /// From homogeneous pixel coordinates.
    pub(crate) fn new(q: &Vector3<f64>) -> Self {
        let w = 1.0 / q.z;
        // 1 / 0 is infinite: on the camera's plane is not in front of it.
        Self { x: q.x * w, y: q.y * w, w: if w.is_finite() { w } else { 0.0 } }
    }

    pub(crate) fn is_in_front(&self) -> bool {
        self.w > 0.0
    }
}

/// `a x + b y + c`.
#[derive(Debug, Clone, Copy)]
struct Linear {
    a: f64,
    b: f64,
    c: f64,
}

impl Linear {
    /// The side from `p` to `q`, positive to its left on a screen whose y points up.
    fn side(p: &Corner, q: &Corner) -> Self {
        Self { a: p.y - q.y, b: q.x - p.x, c: p.x * q.y - q.x * p.y }
    }
}

impl From<Vector3<f64>> for Linear {
    fn from(v: Vector3<f64>) -> Self {
        Self { a: v.x, b: v.y, c: v.z }
    }
}

/// Linear functions over the image for one triangle: three sides and the inverse depth.
pub(crate) struct Setup {
    /// Positive inside.
    sides: [Linear; 3],
    /// Smallest value of each side's function that still belongs to the triangle: 0 or the next number above it, so
    /// that a pixel centre right on a shared side belongs to exactly one of two triangles on either side of it.
    least: [f64; 3],
    /// 1 / depth.
    inverse_depth: Linear,
    /// 1 / depth of the farthest corner and of the nearest: between pixels a steep plane must not overshoot.
    range: (f64, f64),
}

impl Setup {
    /// For a triangle wholly in front of the camera. `None` for one seen edge-on, or without area.
    #[inline(always)]
    pub(crate) fn in_front([a, b, c]: [&Corner; 3]) -> Option<Self> {
        let area = (b.x - a.x) * (c.y - a.y) - (c.x - a.x) * (b.y - a.y);
        let (b, c, area) = if area < 0.0 { (c, b, -area) } else { (b, c, area) };
        if !(area > 0.0 && area.is_finite()) {
            return None;
        }
        let (bx, by, bw) = (b.x - a.x, b.y - a.y, b.w - a.w);
        let (cx, cy, cw) = (c.x - a.x, c.y - a.y, c.w - a.w);
        let per_area = 1.0 / area;
        let wx = (bw * cy - cw * by) * per_area;
        let wy = (bx * cw - cx * bw) * per_area;
        let min = |a: f64, b: f64| if a < b { a } else { b };
        let max = |a: f64, b: f64| if a > b { a } else { b };
        Some(Self::new(
            [Linear::side(b, c), Linear::side(c, a), Linear::side(a, b)],
            Linear { a: wx, b: wy, c: a.w - wx * a.x - wy * a.y },
            (min(min(a.w, b.w), c.w), max(max(a.w, b.w), c.w)),
        ))
    }

    /// For a triangle that crosses the camera's plane; `q` are its corners in homogeneous pixel coordinates.
    pub(crate) fn across(corners: [&Corner; 3], q: [Vector3<f64>; 3]) -> Option<Self> {
        let normal = (q[1] - q[0]).cross(&(q[2] - q[0]));
        let determinant = normal.dot(&q[0]);
        if determinant == 0.0 || !determinant.is_finite() {
            return None;
        }
        let side = |i: usize, j: usize| {
            // Swapping the ends negates the function, as a negative determinant demands.
            let (i, j) = if determinant > 0.0 { (i, j) } else { (j, i) };
            if corners[i].is_in_front() && corners[j].is_in_front() {
                Linear::side(corners[i], corners[j])
            } else {
                q[i].cross(&q[j]).into()
            }
        };
        let farthest = q.iter().map(|q| q.z).fold(0.0, f64::max);
        Some(Self::new(
            [side(1, 2), side(2, 0), side(0, 1)],
            (normal / determinant).into(),
            (1.0 / farthest, f64::INFINITY),
        ))
    }

    #[inline]
    fn new(sides: [Linear; 3], inverse_depth: Linear, range: (f64, f64)) -> Self {
        let least = sides.map(|side| {
            let owns_border = side.a > 0.0 || (side.a == 0.0 && side.b > 0.0);
            if owns_border { 0.0 } else { f64::from_bits(1) }
        });
        Self { sides, least, inverse_depth, range }
    }

    /// The functions' parts that depend on the column, for the columns from `x` on.
    #[inline]
    pub(crate) fn columns(&self, x: f64) -> Columns {
        let x = f64x4::splat(x) + f64x4::new([0.0, 1.0, 2.0, 3.0]);
        let across = |f: &Linear| f64x4::splat(f.a) * x;
        let [a, b, c] = &self.sides;
        Columns { sides: [across(a), across(b), across(c)], inverse_depth: across(&self.inverse_depth) }
    }

    /// The functions' parts that are constant along row `y`.
    #[inline]
    pub(crate) fn row(&self, y: f64) -> Row {
        let along = |f: &Linear| f.b * y + f.c;
        let [a, b, c] = &self.sides;
        Row { sides: [along(a), along(b), along(c)], inverse_depth: along(&self.inverse_depth) }
    }

    /// Which of the pixel centres belong to the triangle, as a mask.
    #[inline]
    pub(crate) fn contains(&self, columns: &Columns, row: &Row) -> f64x4 {
        let side = |i: usize| (columns.sides[i] + f64x4::splat(row.sides[i])).simd_ge(f64x4::splat(self.least[i]));
        side(0) & side(1) & side(2)
    }

    /// 1 / depth of the triangle at pixel centres.
    #[inline]
    pub(crate) fn inverse_depth(&self, columns: &Columns, row: &Row) -> f64x4 {
        let (low, high) = (f64x4::splat(self.range.0), f64x4::splat(self.range.1));
        let w = columns.inverse_depth + f64x4::splat(row.inverse_depth);
        // Written so that a number that is none, from a plane too steep for words, becomes the farthest.
        let w = w.simd_gt(low).bitselect(w, low);
        w.simd_lt(high).bitselect(w, high)
    }

    /// The part of the columns `first..=last` that may belong to the triangle in row `y`, a pixel too many rather than
    /// too few.
    pub(crate) fn narrow(&self, y: f64, first: usize, last: usize) -> (usize, usize) {
        let (mut low, mut high) = (first as f64, last as f64);
        for (side, at) in self.sides.iter().zip(self.row(y).sides) {
            let crossing = -at / side.a;
            if side.a > 0.0 {
                low = low.max(crossing - 1.0);
            } else if side.a < 0.0 {
                high = high.min(crossing + 1.0);
            }
        }
        if low <= high { (low as usize, high as usize) } else { (1, 0) }
    }
}

/// What the functions add up from in four columns, ...
pub(crate) struct Columns {
    sides: [f64x4; 3],
    inverse_depth: f64x4,
}

/// ... and along one row of pixels.
pub(crate) struct Row {
    sides: [f64; 3],
    inverse_depth: f64,
}
