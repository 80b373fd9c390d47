//! Nearest neighbours among points.

use nalgebra::Point3;

/// Points per leaf, at most.
const LEAF: usize = 10;

/// A balanced k-d tree over points (Bentley 1975), for exact nearest neighbours. Every node keeps the box of its points:
/// queries far from a surface are common, and cells that reach into empty space would turn few of them away.
///
/// Points that are not finite are left out: they are never the nearest of anything.
pub struct KdTree {
    /// Points in leaf order.
    points: Vec<[f64; 3]>,
    /// Index in the input of each entry of `points`.
    indices: Vec<u32>,
    /// Boxes of the nodes of a complete binary tree: node 1 is the root, 2k and 2k + 1 are the children of k, and the
    /// second half are leaves.
    boxes: Vec<PointBox>,
}

/// The least and the largest coordinates of some points.
#[derive(Clone, Copy)]
struct PointBox {
    min: [f64; 3],
    max: [f64; 3],
}

impl PointBox {
    const EMPTY: Self = Self { min: [f64::INFINITY; 3], max: [f64::NEG_INFINITY; 3] };

    fn of(entries: &[([f64; 3], u32)]) -> Self {
        let mut bounds = Self::EMPTY;
        for (p, _) in entries {
            for axis in 0..3 {
                bounds.min[axis] = bounds.min[axis].min(p[axis]);
                bounds.max[axis] = bounds.max[axis].max(p[axis]);
            }
        }
        bounds
    }

    fn longest_axis(&self) -> usize {
        let extent = |axis: usize| self.max[axis] - self.min[axis];
        if extent(0) >= extent(1) && extent(0) >= extent(2) { 0 } else { 1 + usize::from(extent(2) > extent(1)) }
    }

    /// Squared distance of a point, 0 inside.
    #[inline]
    fn distance_sq(&self, p: &[f64; 3]) -> f64 {
        let along = |axis: usize| {
            let (before, beyond) = (self.min[axis] - p[axis], p[axis] - self.max[axis]);
            let outside = if before > beyond { before } else { beyond };
            if outside > 0.0 { outside } else { 0.0 }
        };
        let (x, y, z) = (along(0), along(1), along(2));
        x * x + y * y + z * z
    }
}

/// A subtree that is still to be visited.
#[derive(Clone, Copy)]
struct Waiting {
    distance_sq: f64,
    node: u32,
    from: u32,
    to: u32,
}

impl KdTree {
    /// Builds the tree.
    ///
    /// # Panics
    /// For more than `u32::MAX` points.
    pub fn new(points: &[Point3<f64>]) -> Self {
        assert!(u32::try_from(points.len()).is_ok(), "a k-d tree holds at most 2^32 - 1 points");
        let finite = |p: &Point3<f64>| p.coords.iter().all(|v| v.is_finite());
        let mut entries: Vec<([f64; 3], u32)> = points
            .iter()
            .enumerate()
            .filter(|(_, p)| finite(p))
            .map(|(index, p)| (p.coords.into(), index as u32))
            .collect();
        let leaves = entries.len().div_ceil(LEAF).next_power_of_two();
        let mut boxes = vec![PointBox::EMPTY; 2 * leaves];
        for (node, bounds) in split(&mut entries, leaves.trailing_zeros()) {
            boxes[node as usize] = bounds;
        }
        let (points, indices) = entries.into_iter().unzip();
        Self { points, indices, boxes }
    }

    /// Number of points that can be found.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether no point can be found.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// The nearest point's index and its distance (metres). `None` where there is no point, or the query is not finite.
    pub fn nearest(&self, query: &Point3<f64>) -> Option<(usize, f64)> {
        self.nearest_within(query, f64::INFINITY)
    }

    /// Like [`KdTree::nearest`], but `None` where nothing lies within `max_distance` (metres).
    pub fn nearest_within(&self, query: &Point3<f64>, max_distance: f64) -> Option<(usize, f64)> {
        let query: [f64; 3] = query.coords.into();
        if self.is_empty() || !query.iter().all(|v| v.is_finite()) {
            return None;
        }
        let mut best_sq = max_distance * max_distance;
        let mut best = None;
        self.visit(&query, &mut best_sq, |index, distance_sq, best_sq| {
            if distance_sq < *best_sq || (distance_sq == *best_sq && best.is_none_or(|b| index < b)) {
                *best_sq = distance_sq;
                best = Some(index);
            }
        });
        best.map(|index| (index as usize, best_sq.sqrt()))
    }

    /// Indices and distances (metres) of all points within `radius`, the border included, by index.
    pub fn within(&self, query: &Point3<f64>, radius: f64) -> Vec<(usize, f64)> {
        let query: [f64; 3] = query.coords.into();
        let mut found = Vec::new();
        if self.is_empty() || !query.iter().all(|v| v.is_finite()) {
            return found;
        }
        self.visit(&query, &mut (radius * radius), |index, distance_sq, limit_sq| {
            if distance_sq <= *limit_sq {
                found.push((index as usize, distance_sq.sqrt()));
            }
        });
        found.sort_unstable_by_key(|&(index, _)| index);
        found
    }

    /// Calls `point(index, squared distance, limit)` for every point of every leaf whose box is within the squared
    /// distance `limit_sq`, which `point` may lower on the way; near leaves come first.
    fn visit(&self, query: &[f64; 3], limit_sq: &mut f64, mut point: impl FnMut(u32, f64, &mut f64)) {
        let leaves = self.boxes.len() / 2;
        let root = Waiting { distance_sq: 0.0, node: 1, from: 0, to: self.points.len() as u32 };
        // A complete tree of 2^32 points is at most 32 deep, and each level leaves at most one subtree waiting.
        let mut stack = [root; 34];
        let mut waiting = 1;
        while waiting > 0 {
            waiting -= 1;
            let mut next = stack[waiting];
            if next.distance_sq > *limit_sq {
                continue;
            }
            while (next.node as usize) < leaves {
                let middle = next.from + (next.to - next.from) / 2;
                let child = |node: u32, from: u32, to: u32| Waiting {
                    distance_sq: self.boxes[node as usize].distance_sq(query),
                    node,
                    from,
                    to,
                };
                let left = child(2 * next.node, next.from, middle);
                let right = child(2 * next.node + 1, middle, next.to);
                let (near, far) = if right.distance_sq < left.distance_sq { (right, left) } else { (left, right) };
                if far.distance_sq <= *limit_sq {
                    stack[waiting] = far;
                    waiting += 1;
                }
                next = near;
            }
            if next.distance_sq > *limit_sq {
                continue;
            }
            let range = next.from as usize..next.to as usize;
            for (p, &index) in self.points[range.clone()].iter().zip(&self.indices[range]) {
                let (x, y, z) = (p[0] - query[0], p[1] - query[1], p[2] - query[2]);
                point(index, x * x + y * y + z * z, limit_sq);
            }
        }
    }
}

/// Reorders `entries` so that each of the `levels` levels of halves is split at its median along its longest side, and
/// returns the boxes by node number.
fn split(entries: &mut [([f64; 3], u32)], levels: u32) -> Vec<(u32, PointBox)> {
    fn recurse(entries: &mut [([f64; 3], u32)], node: u32, levels: u32) -> Vec<(u32, PointBox)> {
        let bounds = PointBox::of(entries);
        if levels == 0 {
            return vec![(node, bounds)];
        }
        let axis = bounds.longest_axis();
        let middle = entries.len() / 2;
        entries.select_nth_unstable_by(middle, |a, b| a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1)));
        let (left, right) = entries.split_at_mut(middle);
        let mut build_left = || recurse(left, 2 * node, levels - 1);
        let mut build_right = || recurse(right, 2 * node + 1, levels - 1);
        // Small subtrees are not worth a task.
        let (mut boxes, right) =
            if levels > 8 { rayon::join(build_left, build_right) } else { (build_left(), build_right()) };
        boxes.extend(right);
        boxes.push((node, bounds));
        boxes
    }
    recurse(entries, 1, levels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn cloud() -> impl Strategy<Value = Vec<Point3<f64>>> {
        // Coarse coordinates make ties and duplicates likely.
        let coordinate = prop_oneof![(-8..8i32).prop_map(f64::from), -8.0..8.0f64];
        prop::collection::vec(prop::array::uniform3(coordinate).prop_map(Point3::from), 0..400)
    }

    proptest! {
        #[test]
        fn nearest_is_the_nearest_of_all(points in cloud(), q in prop::array::uniform3(-10.0..10.0f64), round: bool) {
            let q = Point3::from(if round { q.map(f64::round) } else { q });
            let brute = points.iter().enumerate().map(|(i, p)| (i, (p - q).norm())).min_by(|a, b| a.1.total_cmp(&b.1));
            let found = KdTree::new(&points).nearest(&q);
            prop_assert_eq!(found.map(|(_, d)| d), brute.map(|(_, d)| d));
            if let Some((index, distance)) = found {
                prop_assert_eq!((points[index] - q).norm(), distance);
            }
        }

        #[test]
        fn within_finds_exactly_the_points_in_the_ball(points in cloud(), q in prop::array::uniform3(-10.0..10.0f64)) {
            let q = Point3::from(q);
            let radius = 2.5;
            let brute: Vec<usize> = (0..points.len()).filter(|&i| (points[i] - q).norm_squared() <= radius * radius).collect();
            let found: Vec<usize> = KdTree::new(&points).within(&q, radius).into_iter().map(|(i, _)| i).collect();
            prop_assert_eq!(found, brute);
        }
    }

    #[test]
    fn points_that_are_no_numbers_are_never_near() {
        let points =
            [Point3::new(f64::NAN, 0.0, 0.0), Point3::new(5.0, 0.0, 0.0), Point3::new(f64::INFINITY, 0.0, 0.0)];
        let tree = KdTree::new(&points);
        assert_eq!(tree.nearest(&Point3::origin()), Some((1, 5.0)));
        assert_eq!(tree.nearest_within(&Point3::origin(), 4.0), None);
        assert_eq!(tree.nearest(&Point3::new(0.0, f64::NAN, 0.0)), None);
        assert_eq!(KdTree::new(&points[..1]).nearest(&Point3::origin()), None);
    }
}
