//! Ray casting (Woop, Benthin, Wald, "Watertight Ray/Triangle Intersection", JCGT 2013), in `f64`.

use mb_geometry::Ray;
use nalgebra::Point3;

use super::{Bvh, Child, Hit, MAX_DEPTH, Node};

/// What a ray needs for many tests: the axis of its largest direction component and the shear that maps the ray onto
/// that axis.
struct Prepared {
    origin: [f64; 3],
    inverse: [f64; 3],
    axes: [usize; 3],
    shear: [f64; 3],
}

impl Prepared {
    /// `None` for a ray without direction or with numbers that are not finite.
    fn new(ray: &Ray) -> Option<Self> {
        let d = ray.direction;
        let finite = d.iter().chain(ray.origin.coords.iter()).all(|v| v.is_finite());
        let z = d.iamax();
        if !finite || d[z] == 0.0 {
            return None;
        }
        let (x, y) = ((z + 1) % 3, (z + 2) % 3);
        Some(Self {
            origin: ray.origin.coords.into(),
            inverse: d.map(|v| 1.0 / v).into(),
            axes: [x, y, z],
            shear: [d[x] / d[z], d[y] / d[z], 1.0 / d[z]],
        })
    }

    /// The ray parameter where the ray's line meets the triangle, edges included.
    fn triangle(&self, corners: &[Point3<f64>; 3]) -> Option<f64> {
        let [kx, ky, kz] = self.axes;
        let [sx, sy, sz] = self.shear;
        let project = |p: &Point3<f64>| {
            let (x, y, z) = (p[kx] - self.origin[kx], p[ky] - self.origin[ky], p[kz] - self.origin[kz]);
            (x - sx * z, y - sy * z, sz * z)
        };
        let [(ax, ay, az), (bx, by, bz), (cx, cy, cz)] =
            [project(&corners[0]), project(&corners[1]), project(&corners[2])];
        // Each is the negative of what the neighbour across that side computes, to the last bit: no gaps.
        let u = cx * by - cy * bx;
        let v = ax * cy - ay * cx;
        let w = bx * ay - by * ax;
        if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
            return None;
        }
        let determinant = u + v + w;
        if determinant == 0.0 {
            return None;
        }
        Some((u * az + v * bz + w * cz) / determinant)
    }

    /// Where the ray enters the two boxes of a node, infinite where it misses them within [0, `t_max`].
    fn boxes(&self, node: &Node, t_max: f64) -> [f64; 2] {
        // Three roundings on the way (Ize 2013): widen the far side by that much, so that no box is missed.
        const SLACK: f64 = 1.0 + 4.0 * f64::EPSILON;
        let mut enter = [0.0f64; 2];
        let mut leave = [t_max; 2];
        for axis in 0..3 {
            for child in 0..2 {
                let t0 = (f64::from(node.min[axis][child]) - self.origin[axis]) * self.inverse[axis];
                let t1 = (f64::from(node.max[axis][child]) - self.origin[axis]) * self.inverse[axis];
                // 0 * infinity is NaN: a ray within the plane of a box's side, which the slab does not bound.
                let (near, far) = match t0.is_nan() || t1.is_nan() {
                    true => (f64::NEG_INFINITY, f64::INFINITY),
                    false => (t0.min(t1), t0.max(t1)),
                };
                enter[child] = enter[child].max(near);
                leave[child] = leave[child].min(far * SLACK);
            }
        }
        std::array::from_fn(|child| if enter[child] <= leave[child] { enter[child] } else { f64::INFINITY })
    }
}

pub(super) fn cast(bvh: &Bvh, ray: &Ray, t_max: f64) -> Option<Hit> {
    let mut best: Option<Hit> = None;
    traverse(bvh, ray, t_max, |triangle, t| {
        if best.is_none_or(|b| t < b.t || triangle < b.triangle) {
            best = Some(Hit { triangle, t });
        }
        t
    });
    best
}

pub(super) fn occluded(bvh: &Bvh, ray: &Ray, t_max: f64) -> bool {
    let mut found = false;
    traverse(bvh, ray, t_max, |_, _| {
        found = true;
        f64::NEG_INFINITY
    });
    found
}

/// Visits triangles near to far. `hit` is told of each one at 0 <= t <= limit, and returns the new limit.
fn traverse(bvh: &Bvh, ray: &Ray, t_max: f64, mut hit: impl FnMut(u32, f64) -> f64) {
    let Some(prepared) = Prepared::new(ray) else { return };
    let mut limit = t_max;
    let mut stack = [(0.0, Child::default()); MAX_DEPTH];
    let mut waiting = 0;
    if bvh.is_empty() {
        return;
    }
    let mut current = bvh.root;
    loop {
        if current.count > 0 {
            let range = current.first as usize..(current.first + current.count) as usize;
            for (corners, &triangle) in bvh.corners[range.clone()].iter().zip(&bvh.triangles[range]) {
                if let Some(t) = prepared.triangle(corners)
                    && (0.0..=limit).contains(&t)
                {
                    limit = hit(triangle, t);
                }
            }
        } else {
            let node = &bvh.nodes[current.first as usize];
            let enter = prepared.boxes(node, limit);
            let near = usize::from(enter[1] < enter[0]);
            let far = 1 - near;
            if enter[near] <= limit && enter[near].is_finite() {
                if enter[far] <= limit && enter[far].is_finite() {
                    stack[waiting] = (enter[far], node.children[far]);
                    waiting += 1;
                }
                current = node.children[near];
                continue;
            }
        }
        loop {
            if waiting == 0 {
                return;
            }
            waiting -= 1;
            if stack[waiting].0 <= limit {
                current = stack[waiting].1;
                break;
            }
        }
    }
}
