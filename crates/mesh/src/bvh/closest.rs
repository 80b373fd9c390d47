//! Closest points.

use nalgebra::Point3;

use super::{Bvh, Child, Closest, MAX_DEPTH, Node, vector};

/// The closest point of the triangle `a b c` to `p`. Degenerate triangles (segments, points) are answered too.
///
/// The foot of the perpendicular where it falls inside, else the nearest point of the three sides: unlike the shorter
/// barycentric form (Ericson 2005, section 5.1.5) this needs no division by an area that may vanish.
pub fn closest_point_on_triangle(p: &Point3<f64>, [a, b, c]: &[Point3<f64>; 3]) -> Point3<f64> {
    let (ab, bc, ca) = (b - a, c - b, a - c);
    let (ap, bp, cp) = (p - a, p - b, p - c);
    let normal = ca.cross(&ab);
    let inside =
        ab.cross(&normal).dot(&ap) < 0.0 && bc.cross(&normal).dot(&bp) < 0.0 && ca.cross(&normal).dot(&cp) < 0.0;
    if inside {
        return p - normal * (normal.dot(&ap) / normal.norm_squared());
    }
    let on_side = |from: &Point3<f64>, side: nalgebra::Vector3<f64>, from_p: nalgebra::Vector3<f64>| {
        let length_sq = side.norm_squared();
        let s = if length_sq > 0.0 { (from_p.dot(&side) / length_sq).clamp(0.0, 1.0) } else { 0.0 };
        from + side * s
    };
    let mut best = on_side(a, ab, ap);
    let mut best_sq = (p - best).norm_squared();
    for candidate in [on_side(b, bc, bp), on_side(c, ca, cp)] {
        let distance_sq = (p - candidate).norm_squared();
        if distance_sq < best_sq {
            (best, best_sq) = (candidate, distance_sq);
        }
    }
    best
}

/// Squared distances from `p` to the two boxes of a node.
fn box_distances_sq(node: &Node, p: &[f64; 3]) -> [f64; 2] {
    let mut sum = [0.0; 2];
    for axis in 0..3 {
        for child in 0..2 {
            let below = f64::from(node.min[axis][child]) - p[axis];
            let above = p[axis] - f64::from(node.max[axis][child]);
            // Not `f64::max`, which has more instructions for NaN; none comes here.
            let outside = if below > above { below } else { above };
            let outside = if outside > 0.0 { outside } else { 0.0 };
            sum[child] += outside * outside;
        }
    }
    sum
}

/// Whether even the box around the triangle is farther from `p` than the square root of `limit_sq`: a tenth of the work of
/// the exact answer.
fn beyond([a, b, c]: &[Point3<f64>; 3], p: &[f64; 3], limit_sq: f64) -> bool {
    let mut sum = 0.0;
    for axis in 0..3 {
        let (low, high) = if a[axis] < b[axis] { (a[axis], b[axis]) } else { (b[axis], a[axis]) };
        let low = if c[axis] < low { c[axis] } else { low };
        let high = if c[axis] > high { c[axis] } else { high };
        let below = low - p[axis];
        let above = p[axis] - high;
        let outside = if below > above { below } else { above };
        let outside = if outside > 0.0 { outside } else { 0.0 };
        sum += outside * outside;
    }
    // The triangle's own distance is rounded too.
    sum > limit_sq * (1.0 + 1e-12)
}

/// `corners` gives the corners of an entry of `bvh.triangles`.
pub(super) fn closest<C: std::borrow::Borrow<[Point3<f64>; 3]>>(
    bvh: &Bvh,
    corners: impl Fn(usize) -> C,
    query: &Point3<f64>,
    max_distance: f64,
) -> Option<Closest> {
    if bvh.is_empty() || !vector(query).iter().all(|v| v.is_finite()) {
        return None;
    }
    let p = [query.x, query.y, query.z];
    let mut best_sq = max_distance * max_distance;
    let mut best: Option<(u32, Point3<f64>)> = None;
    let mut stack = [(0.0, Child::default()); MAX_DEPTH];
    let mut waiting = 0;
    let mut current = bvh.root;
    loop {
        if current.count > 0 {
            let range = current.first as usize..(current.first + current.count) as usize;
            for entry in range {
                let corners = corners(entry);
                let corners = corners.borrow();
                if beyond(corners, &p, best_sq) {
                    continue;
                }
                let triangle = bvh.triangles[entry];
                let point = closest_point_on_triangle(query, corners);
                let distance_sq = (point - query).norm_squared();
                let tie = distance_sq == best_sq && best.is_none_or(|(t, _)| triangle < t);
                if distance_sq < best_sq || tie {
                    best_sq = distance_sq;
                    best = Some((triangle, point));
                }
            }
        } else {
            let node = &bvh.nodes[current.first as usize];
            let distances = box_distances_sq(node, &p);
            let near = usize::from(distances[1] < distances[0]);
            let far = 1 - near;
            if distances[near] <= best_sq {
                if distances[far] <= best_sq {
                    stack[waiting] = (distances[far], node.children[far]);
                    waiting += 1;
                }
                current = node.children[near];
                continue;
            }
        }
        loop {
            if waiting == 0 {
                return best.map(|(triangle, point)| Closest { triangle, point, distance: best_sq.sqrt() });
            }
            waiting -= 1;
            if stack[waiting].0 <= best_sq {
                current = stack[waiting].1;
                break;
            }
        }
    }
}
