//! Blue-noise points on surfaces: weighted sample elimination.
//!
//! Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets", Computer Graphics Forum 34(2), 2015, with the
//! parameters and the weight of Open3D 0.19 (`SamplePointsPoissonDisk`), which the published scorer calls.

use mb_geometry::Aabb;
use nalgebra::Point3;

use crate::radix::sorted_by_key;
use crate::{TriangleMesh, sample_uniform};

/// Uniform samples per wanted point, from which the points are chosen (Open3D's `init_factor`).
const CANDIDATES_PER_POINT: usize = 5;
/// `r_min` of the weight as a share of `r_max`, before the correction for the candidates' density (paper, section 4.1).
const BETA: f64 = 0.65;
const GAMMA: f64 = 1.5;

/// `n` points of the surface that keep their distance from each other: of `5 n` area-uniform candidates the most crowded
/// one is removed until `n` are left. Empty where the mesh has no area. The same seed gives the same points.
pub fn sample_poisson_disk(mesh: &TriangleMesh, n: usize, seed: u64) -> Vec<Point3<f64>> {
    let candidates: Vec<Point3<f64>> =
        sample_uniform(mesh, CANDIDATES_PER_POINT * n, seed).into_iter().map(|s| s.point).collect();
    if candidates.is_empty() {
        return candidates;
    }
    let area: f64 =
        (0..mesh.triangles.len()).map(|t| 0.5 * mesh.scaled_normal(t).norm()).filter(|a| a.is_finite()).sum();
    // Largest radius at which n discs can cover the area in a hexagonal packing, doubled (paper, eq. 2 and 3).
    let reach = 2.0 * (area / n as f64 / (2.0 * 3f64.sqrt())).sqrt();
    eliminate(&candidates, n, reach)
}

/// Removes the most crowded of `candidates` until `n` are left; the survivors keep their order.
fn eliminate(candidates: &[Point3<f64>], n: usize, reach: f64) -> Vec<Point3<f64>> {
    let ratio = n as f64 / candidates.len() as f64;
    let floor = BETA * (1.0 - ratio.powf(GAMMA));
    let (mut order, grid) = Grid::new(candidates, reach);
    let mut crowd = Crowd::new(grid, floor);
    let count = order.len();
    let mut surplus = count.saturating_sub(n);
    // Few are removed in the order of the whole surface, which jumps through memory.
    while surplus > count / SHARE_IN_ORDER {
        // No more points than the surplus are more crowded than this, and removals only make it fewer.
        let Some(limit) = nth_largest_weight(&crowd.points, surplus) else { break };
        let removed = crowd.remove_above(limit);
        if removed == 0 {
            break;
        }
        surplus -= removed;
        crowd.compact(&mut order);
    }
    let mut queue = Queue::new(&crowd.points);
    for _ in 0..surplus {
        let Some(i) = queue.pop_most_crowded(&crowd.points) else { break };
        crowd.remove(i as usize);
    }
    let mut survivors: Vec<u32> =
        order.into_iter().zip(&crowd.points).filter(|(_, point)| !point.is_removed()).map(|(i, _)| i).collect();
    survivors.sort_unstable();
    survivors.into_iter().map(|i| candidates[i as usize]).collect()
}

/// The share (one in so many) of points that are removed in the order of the whole surface.
const SHARE_IN_ORDER: usize = 64;

/// The weight that exactly `n` points exceed, where no two are equal. `None` where fewer are left.
fn nth_largest_weight(points: &[Candidate], n: usize) -> Option<f64> {
    let mut weights: Vec<f64> = points.iter().filter(|p| !p.is_removed()).map(|p| p.weight).collect();
    (n < weights.len()).then(|| *weights.select_nth_unstable_by(n, |a, b| b.total_cmp(a)).1)
}

/// Points by crowding, the most crowded first.
///
/// Weights only ever fall. So a point may wait under an old, too large weight: it is brought up to date when its turn
/// comes. Points wait in buckets of equal steps of weight, and only those of the highest bucket are kept in order, in a
/// small heap that stays in the processor's cache.
struct Queue {
    /// Points that waited under a weight of `step * index` and more.
    buckets: Vec<Vec<u32>>,
    step: f64,
    /// Weight and number of the points of bucket `buckets.len()`, largest first.
    heap: Vec<(f64, u32)>,
}

impl Queue {
    fn new(points: &[Candidate]) -> Self {
        let most = points.iter().map(|p| p.weight).fold(0.0, f64::max);
        let count = (points.len() / 64).clamp(1, 1 << 14);
        let mut queue = Self {
            buckets: vec![Vec::new(); count + 1],
            step: (most / count as f64).max(f64::MIN_POSITIVE),
            heap: Vec::new(),
        };
        for (i, point) in points.iter().enumerate().filter(|(_, point)| !point.is_removed()) {
            let bucket = queue.bucket_of(point.weight);
            queue.buckets[bucket].push(i as u32);
        }
        queue
    }

    fn bucket_of(&self, weight: f64) -> usize {
        // What rounding pushed below 0 belongs to the lowest bucket: the conversion saturates.
        (weight / self.step) as usize
    }

    /// Takes out the point with the largest weight, of equal ones the lowest number.
    fn pop_most_crowded(&mut self, points: &[Candidate]) -> Option<u32> {
        loop {
            let Some(&(old, i)) = self.heap.first() else {
                for i in self.buckets.pop()? {
                    let weight = points[i as usize].weight;
                    match self.bucket_of(weight) {
                        lower if lower < self.buckets.len() => self.buckets[lower].push(i),
                        _ => self.heap.push((weight, i)),
                    }
                }
                for at in (0..self.heap.len() / 2).rev() {
                    sift_down(&mut self.heap, at);
                }
                continue;
            };
            let weight = points[i as usize].weight;
            let bucket = self.bucket_of(weight);
            if weight < old && bucket >= self.buckets.len() {
                self.heap[0].0 = weight;
                sift_down(&mut self.heap, 0);
                continue;
            }
            self.heap.swap_remove(0);
            sift_down(&mut self.heap, 0);
            if weight == old {
                return Some(i);
            }
            self.buckets[bucket].push(i);
        }
    }
}

/// Moves the entry at `i` down to its place in a heap whose largest entry is first. Equal weights: lowest index first.
fn sift_down(heap: &mut [(f64, u32)], mut i: usize) {
    let above = |a: &(f64, u32), b: &(f64, u32)| a.0 > b.0 || (a.0 == b.0 && a.1 < b.1);
    loop {
        let left = 2 * i + 1;
        if left >= heap.len() {
            return;
        }
        let right = left + 1;
        let larger = if right < heap.len() && above(&heap[right], &heap[left]) { right } else { left };
        if !above(&heap[larger], &heap[i]) {
            return;
        }
        heap.swap(i, larger);
        i = larger;
    }
}

/// A point, and how crowded it is. Kept together: the elimination jumps through memory, so what counts is how many
/// places it touches.
#[derive(Clone, Copy)]
struct Candidate {
    at: [f64; 3],
    /// Minus infinity once it is removed.
    weight: f64,
}

impl Candidate {
    fn is_removed(&self) -> bool {
        self.weight == f64::NEG_INFINITY
    }
}

/// (1 - d / reach)^8 from the squared distance in reaches, 0 beyond the reach.
#[inline]
fn crowding(squared: f64, floor: f64) -> f64 {
    let d = squared.sqrt();
    let w = 1.0 - if d > floor { d } else { floor };
    let w = if w > 0.0 { w } else { 0.0 };
    let w = w * w;
    let w = w * w;
    w * w
}

/// Points sorted into cubic cells at least as wide as the reach, so that all neighbours lie in 27 cells. Only cells with
/// points are stored, sorted by z, y, x: three cells in a row along x are one run of points.
struct Grid {
    /// Points in cell order, in units of the reach, from the corner of the grid.
    points: Vec<[f64; 3]>,
    /// First point of each cell, and the number of points.
    starts: Vec<u32>,
    /// For each cell, the nine runs of points (first, end) in the cells around it.
    runs: Vec<[(u32, u32); 9]>,
}

/// Bits of a cell's coordinate along one axis.
const AXIS_BITS: u32 = 21;

impl Grid {
    /// Sorts the points; returns their order too.
    fn new(points: &[Point3<f64>], reach: f64) -> (Vec<u32>, Self) {
        let bounds = Aabb::of(points);
        let extent = bounds.extent().max() / reach;
        let cells_per_reach = (f64::from(1 << (AXIS_BITS - 1)) / extent).min(1.0);
        let in_reaches = |p: &Point3<f64>| (p - bounds.min) / reach;
        let key_of = |p: &Point3<f64>| {
            // One empty cell before the first, so that every cell has a neighbour before it.
            let cell = in_reaches(p).map(|v| (v * cells_per_reach) as u64 + 1);
            cell.z << (2 * AXIS_BITS) | cell.y << AXIS_BITS | cell.x
        };
        let sorted = sorted_by_key(points.iter().enumerate().map(|(i, p)| (key_of(p), i as u32)).collect());

        let mut keys = Vec::new();
        let mut starts = Vec::new();
        for (at, &(key, _)) in sorted.iter().enumerate() {
            if keys.last() != Some(&key) {
                keys.push(key);
                starts.push(at as u32);
            }
        }
        starts.push(points.len() as u32);

        let mut runs = vec![[(0, 0); 9]; keys.len()];
        for row in 0..9 {
            let (dy, dz) = (row % 3, row / 3);
            // Keys ascend, and so do those of the neighbours: two fingers move through the list once.
            let (mut first, mut end) = (0, 0);
            for (&key, runs) in keys.iter().zip(&mut runs) {
                let middle = key + (dz << (2 * AXIS_BITS)) + (dy << AXIS_BITS);
                let middle = middle - (1 << (2 * AXIS_BITS)) - (1 << AXIS_BITS);
                while first < keys.len() && keys[first] < middle - 1 {
                    first += 1;
                }
                while end < keys.len() && keys[end] <= middle + 1 {
                    end += 1;
                }
                runs[row as usize] = (starts[first], starts[end.max(first)]);
            }
        }
        let order: Vec<u32> = sorted.into_iter().map(|(_, i)| i).collect();
        let points = order.iter().map(|&i| in_reaches(&points[i as usize]).into()).collect();
        (order, Self { points, starts, runs })
    }
}

/// Points, and who crowds whom.
struct Crowd {
    points: Vec<Candidate>,
    /// Where each point's numbers in `near` end.
    ends: Vec<usize>,
    /// Point after point the numbers of all points within its reach, itself included, ascending.
    near: Vec<u32>,
    /// Neighbours nearer than this, in reaches, crowd no more than at this distance.
    floor: f64,
}

impl Crowd {
    fn new(grid: Grid, floor: f64) -> Self {
        let axes: [Vec<f64>; 3] = std::array::from_fn(|axis| grid.points.iter().map(|p| p[axis]).collect());
        let mut crowd = Self {
            points: grid.points.into_iter().map(|at| Candidate { at, weight: 0.0 }).collect(),
            ends: Vec::with_capacity(axes[0].len()),
            // Random points of a surface have some 18 of the candidates in reach.
            near: Vec::with_capacity(20 * axes[0].len()),
            floor,
        };
        let mut cells = Neighbourhood::default();
        for (cell, runs) in grid.starts.windows(2).zip(&grid.runs) {
            cells.gather(runs, &axes);
            for i in cell[0] as usize..cell[1] as usize {
                let weights = cells.weights_around(&crowd.points[i].at, floor, &mut crowd.near);
                // The point itself is no neighbour.
                crowd.points[i].weight = weights.iter().fold(0.0, |sum, w| sum + w) - crowding(0.0, floor);
                crowd.ends.push(crowd.near.len());
            }
        }
        crowd
    }

    /// Numbers of the points within reach of point `i`, itself included.
    fn near(&self, i: usize) -> &[u32] {
        let first = if i == 0 { 0 } else { self.ends[i - 1] };
        &self.near[first..self.ends[i]]
    }

    /// Takes point `i` away; those near it are less crowded.
    fn remove(&mut self, i: usize) {
        let [x, y, z] = self.points[i].at;
        let first = if i == 0 { 0 } else { self.ends[i - 1] };
        for &near in &self.near[first..self.ends[i]] {
            let near = &mut self.points[near as usize];
            let (dx, dy, dz) = (near.at[0] - x, near.at[1] - y, near.at[2] - z);
            near.weight -= crowding(dx * dx + dy * dy + dz * dz, self.floor);
        }
        self.points[i].weight = f64::NEG_INFINITY;
    }

    /// Forgets the points that were removed, in `order` too: what is left is near in memory again.
    fn compact(&mut self, order: &mut Vec<u32>) {
        const GONE: u32 = u32::MAX;
        let mut count = 0;
        let number = |point: &Candidate| {
            let number = if point.is_removed() { GONE } else { count };
            count += u32::from(!point.is_removed());
            number
        };
        let numbers: Vec<u32> = self.points.iter().map(number).collect();
        let (mut kept, mut first, mut kept_near) = (0, 0, 0);
        for i in 0..self.points.len() {
            let end = self.ends[i];
            if numbers[i] != GONE {
                for at in first..end {
                    let number = numbers[self.near[at] as usize];
                    self.near[kept_near] = number;
                    kept_near += usize::from(number != GONE);
                }
                self.points[kept] = self.points[i];
                self.ends[kept] = kept_near;
                order[kept] = order[i];
                kept += 1;
            }
            first = end;
        }
        self.points.truncate(kept);
        self.ends.truncate(kept);
        self.near.truncate(kept_near);
        order.truncate(kept);
    }

    /// Removes the most crowded point until none is above `limit`; returns how many went.
    ///
    /// The result is that of removing them in the order of their weights. Weights only ever fall, and fall only where a
    /// neighbour goes; so a point with no more crowded neighbour goes before all of them, whatever happens elsewhere. The
    /// points are visited where they lie, and each waits for its more crowded neighbours: all is near in memory.
    fn remove_above(&mut self, limit: f64) -> usize {
        let mut removed = 0;
        let mut waiting = Vec::new();
        for start in 0..self.points.len() {
            waiting.push(start);
            while let Some(&i) = waiting.last() {
                let weight = self.points[i].weight;
                if weight <= limit {
                    waiting.pop();
                    continue;
                }
                // In two passes: a guess which of the weights is larger would be wrong too often.
                let weight_of = |near: u32| self.points[near as usize].weight;
                let most = self.near(i).iter().fold(weight, |most, &near| {
                    let weight = weight_of(near);
                    if weight > most { weight } else { most }
                });
                // Of equal ones the lowest number counts as more crowded. The point itself is among them.
                let first = self.near(i).iter().copied().find(|&near| weight_of(near) == most).unwrap_or(i as u32);
                if first as usize != i {
                    waiting.push(first as usize);
                } else {
                    self.remove(i);
                    removed += 1;
                    waiting.pop();
                }
            }
        }
        removed
    }
}

/// The points of 27 cells side by side, axis by axis, as the processor likes to compare them; and room to do it.
#[derive(Default)]
struct Neighbourhood {
    axes: [Vec<f64>; 3],
    numbers: Vec<u32>,
    squares: Vec<f64>,
    found: Vec<u32>,
    weights: Vec<f64>,
}

impl Neighbourhood {
    /// Collects the points of some runs from their coordinates, axis by axis.
    fn gather(&mut self, runs: &[(u32, u32)], from: &[Vec<f64>; 3]) {
        self.numbers.clear();
        self.numbers.extend(runs.iter().flat_map(|&(first, end)| first..end));
        for (axis, from) in self.axes.iter_mut().zip(from) {
            axis.clear();
            runs.iter().for_each(|&(first, end)| axis.extend_from_slice(&from[first as usize..end as usize]));
        }
        let count = self.numbers.len();
        // What fills up the last group of lanes is out of everyone's reach.
        self.squares.clear();
        self.squares.resize(count.next_multiple_of(LANES), f64::INFINITY);
        self.found.resize(self.squares.len(), 0);
        self.weights.resize(self.squares.len(), 0.0);
    }

    /// How much each point within reach of `at` crowds it, itself included, by number; the numbers go to `near`.
    fn weights_around(&mut self, at: &[f64; 3], floor: f64, near: &mut Vec<u32>) -> &[f64] {
        let [xs, ys, zs] = &self.axes;
        for (((squared, x), y), z) in self.squares.iter_mut().zip(xs).zip(ys).zip(zs) {
            let (dx, dy, dz) = (x - at[0], y - at[1], z - at[2]);
            *squared = dx * dx + dy * dy + dz * dz;
        }
        let mut count = 0;
        for (first, squares) in (0..).step_by(LANES).zip(self.squares.as_chunks::<LANES>().0) {
            let inside = squares.iter().rev().fold(0, |bits, &squared| 2 * bits + usize::from(squared < 1.0));
            // Four are always written, and those inside stay: a guess would be wrong too often.
            self.found[count..count + LANES].copy_from_slice(&SET_LANES[inside].map(|lane| first + lane));
            count += inside.count_ones() as usize;
        }
        let (found, weights) = (&mut self.found[..count], &mut self.weights[..count]);
        for (found, weight) in found.iter_mut().zip(&mut *weights) {
            *weight = self.squares[*found as usize];
            *found = self.numbers[*found as usize];
        }
        weights.iter_mut().for_each(|w| *w = crowding(*w, floor));
        near.extend_from_slice(found);
        weights
    }
}

/// Points that are compared at a time.
const LANES: usize = 4;

/// For each set of lanes, as bits, its lanes from the lowest on.
const SET_LANES: [[u32; LANES]; 1 << LANES] = {
    let mut table = [[0; LANES]; 1 << LANES];
    let mut set = 0;
    while set < table.len() {
        let (mut lane, mut count) = (0, 0);
        while lane < LANES {
            if set >> lane & 1 == 1 {
                table[set][count] = lane as u32;
                count += 1;
            }
            lane += 1;
        }
        set += 1;
    }
    table
};

#[cfg(test)]
mod tests {
    use super::*;
    use crate::KdTree;

    fn square(side: f64) -> TriangleMesh {
        let corners = [[0., 0., 0.], [side, 0., 0.], [side, side, 0.], [0., side, 0.]].map(Point3::from);
        TriangleMesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]])
    }

    /// Distance of each point from its nearest other point.
    fn gaps(points: &[Point3<f64>]) -> Vec<f64> {
        let tree = KdTree::new(points);
        points
            .iter()
            .enumerate()
            .map(|(i, p)| {
                let mut reach = 0.02;
                loop {
                    let others = tree.within(p, reach).into_iter().filter(|&(j, _)| j != i).map(|(_, d)| d);
                    if let Some(nearest) = others.min_by(f64::total_cmp) {
                        break nearest;
                    }
                    reach *= 2.0;
                }
            })
            .collect()
    }

    #[test]
    fn points_keep_their_distance() {
        let n = 2000;
        let points = sample_poisson_disk(&square(1.0), n, 3);
        assert_eq!(points.len(), n);
        let reach = 2.0 * (1.0 / n as f64 / (2.0 * 3f64.sqrt())).sqrt();
        let gaps = gaps(&points);
        let mean = gaps.iter().sum::<f64>() / n as f64;
        let least = gaps.iter().copied().fold(f64::INFINITY, f64::min);
        // Random points have a mean gap of 0.5 / sqrt(n) = 0.46 reaches, and a least gap of nearly 0.
        assert!((mean / reach - 0.79).abs() < 0.02, "{}", mean / reach);
        assert!(least / reach > 0.6, "{}", least / reach);
    }

    /// The same elimination without grid, heap or updates: recompute everything, remove the most crowded.
    #[test]
    fn the_most_crowded_goes_first() {
        let candidates: Vec<Point3<f64>> = sample_uniform(&square(1.0), 150, 5).into_iter().map(|s| s.point).collect();
        let (n, reach) = (30, 0.2);
        let floor = BETA * (1.0 - (n as f64 / 150.0).powf(1.5)) * reach;
        let mut left: Vec<usize> = (0..150).collect();
        while left.len() > n {
            let crowding = |&i: &usize| -> f64 {
                let others = left.iter().filter(|&&j| j != i).map(|&j| (candidates[i] - candidates[j]).norm());
                others.filter(|&d| d < reach).map(|d| (1.0 - d.max(floor) / reach).powi(8)).sum()
            };
            let worst = *left.iter().max_by(|a, b| crowding(a).total_cmp(&crowding(b))).unwrap();
            left.retain(|&i| i != worst);
        }
        let expected: Vec<Point3<f64>> = left.into_iter().map(|i| candidates[i]).collect();
        assert_eq!(eliminate(&candidates, n, reach), expected);
    }

    #[test]
    fn the_seed_decides_and_a_mesh_without_area_has_none() {
        let mesh = square(0.1);
        assert_eq!(sample_poisson_disk(&mesh, 500, 1), sample_poisson_disk(&mesh, 500, 1));
        assert_ne!(sample_poisson_disk(&mesh, 500, 1), sample_poisson_disk(&mesh, 500, 2));
        assert!(sample_poisson_disk(&TriangleMesh::default(), 10, 0).is_empty());
        assert!(sample_poisson_disk(&mesh, 0, 0).is_empty());
    }

    /// Two far apart pieces: more cells between them than keys can number.
    #[test]
    fn sparse_scenes_are_no_trouble() {
        let mut mesh = square(0.01);
        let far: Vec<_> = mesh.vertices.iter().map(|p| p + nalgebra::Vector3::new(1e6, 0.0, -1e6)).collect();
        mesh.vertices.extend(far);
        mesh.triangles.extend([[4, 5, 6], [4, 6, 7]]);
        let points = sample_poisson_disk(&mesh, 1000, 0);
        let near = points.iter().filter(|p| p.x < 1.0).count();
        assert!((450..=550).contains(&near), "{near}");
    }
}
