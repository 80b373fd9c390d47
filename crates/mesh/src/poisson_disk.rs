//! Blue-noise points on surfaces: weighted sample elimination.
//!
//! Yuksel, "Sample Elimination for Generating Poisson Disk Sample Sets", Computer Graphics Forum 34(2), 2015, with the
//! parameters and the weight of Open3D 0.19 (`SamplePointsPoissonDisk`), which the published scorer calls.

use mb_geometry::Aabb;
use nalgebra::Point3;
use rayon::prelude::*;

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
    let (mut order, mut grid) = Grid::new(candidates, reach);
    let count = order.len();
    // Enough for what is left of the grid later, too.
    let mut room = grid.room();
    let weights: Vec<f64> = (0..count)
        .into_par_iter()
        .with_min_len(4096)
        .map_init(
            || room.clone(),
            |room, i| {
                let weight = grid.near(i, room).iter().fold(0.0, |sum, near| sum + crowding(near.squared, floor));
                // The point itself is no neighbour.
                weight - crowding(0.0, floor)
            },
        )
        .collect();
    for (point, weight) in grid.points.iter_mut().zip(weights) {
        point.weight = weight;
    }

    let mut surplus = count.saturating_sub(n);
    // Few are removed in the order of the whole surface, which jumps through memory.
    while surplus > count / SHARE_IN_ORDER {
        // No more points than the surplus are more crowded than this, and removals only make it fewer.
        let Some(limit) = nth_largest_weight(&grid.points, surplus) else { break };
        let removed = grid.remove_above(limit, floor, &mut room);
        if removed == 0 {
            break;
        }
        surplus -= removed;
        grid.compact(&mut order);
    }
    let mut queue = Queue::new(&grid.points);
    for _ in 0..surplus {
        let Some(i) = queue.pop_most_crowded(&grid.points) else { break };
        let near = grid.near(i as usize, &mut room);
        remove(&mut grid.points, i as usize, near, floor);
    }
    let mut survivors: Vec<u32> =
        order.into_iter().zip(&grid.points).filter(|(_, point)| !point.is_removed()).map(|(i, _)| i).collect();
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

/// A point within the reach of another.
#[derive(Clone, Copy, Default)]
struct Near {
    /// Squared distance in reaches, below 1.
    squared: f64,
    point: u32,
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
    points: Vec<Candidate>,
    cell_of_point: Vec<u32>,
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
        let mut sorted: Vec<(u64, u32)> = points.par_iter().enumerate().map(|(i, p)| (key_of(p), i as u32)).collect();
        sorted.par_sort_unstable();

        let mut keys = Vec::new();
        let mut starts = Vec::new();
        let mut cell_of_point = Vec::with_capacity(points.len());
        for (at, &(key, _)) in sorted.iter().enumerate() {
            if keys.last() != Some(&key) {
                keys.push(key);
                starts.push(at as u32);
            }
            cell_of_point.push(keys.len() as u32 - 1);
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
        let points =
            order.iter().map(|&i| Candidate { at: in_reaches(&points[i as usize]).into(), weight: 0.0 }).collect();
        (order, Self { points, cell_of_point, runs })
    }

    /// Forgets the points that were removed, in `order` too: what is left is near in memory again.
    fn compact(&mut self, order: &mut Vec<u32>) {
        let mut kept_before = Vec::with_capacity(self.points.len() + 1);
        kept_before.push(0);
        let mut kept = 0;
        for i in 0..self.points.len() {
            if !self.points[i].is_removed() {
                self.points[kept] = self.points[i];
                self.cell_of_point[kept] = self.cell_of_point[i];
                order[kept] = order[i];
                kept += 1;
            }
            kept_before.push(kept as u32);
        }
        self.points.truncate(kept);
        self.cell_of_point.truncate(kept);
        order.truncate(kept);
        for (first, end) in self.runs.as_flattened_mut() {
            (*first, *end) = (kept_before[*first as usize], kept_before[*end as usize]);
        }
    }

    /// Removes the most crowded point until none is above `limit`; returns how many went.
    ///
    /// The result is that of removing them in the order of their weights. Weights only ever fall, and fall only where a
    /// neighbour goes; so a point with no more crowded neighbour goes before all of them, whatever happens elsewhere. The
    /// points are visited where they lie, and each waits for its more crowded neighbours: all is near in memory.
    fn remove_above(&mut self, limit: f64, floor: f64, room: &mut [Near]) -> usize {
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
                let near = self.near(i, room);
                // Of equal ones the lowest number counts as more crowded.
                let mut most = (weight, i);
                for point in near.iter().map(|near| near.point as usize) {
                    let weight = self.points[point].weight;
                    if weight > most.0 || (weight == most.0 && point < most.1) {
                        most = (weight, point);
                    }
                }
                if most.1 != i {
                    waiting.push(most.1);
                } else {
                    remove(&mut self.points, i, near, floor);
                    removed += 1;
                    waiting.pop();
                }
            }
        }
        removed
    }

    /// Room for the points that [`Grid::near`] looks at.
    fn room(&self) -> Vec<Near> {
        let around = |runs: &[(u32, u32); 9]| runs.iter().map(|(first, end)| (end - first) as usize).sum();
        vec![Near::default(); self.runs.iter().map(around).max().unwrap_or(0) + 1]
    }

    /// The points within reach of point `i`, itself included, by number.
    fn near<'a>(&self, i: usize, room: &'a mut [Near]) -> &'a [Near] {
        let [x, y, z] = self.points[i].at;
        let mut count = 0;
        for (first, end) in self.runs[self.cell_of_point[i] as usize] {
            for (point, p) in (first..end).zip(&self.points[first as usize..end as usize]) {
                let (dx, dy, dz) = (p.at[0] - x, p.at[1] - y, p.at[2] - z);
                let squared = dx * dx + dy * dy + dz * dz;
                // Always written, and kept where it counts: a guess would be wrong too often.
                room[count] = Near { squared, point };
                count += usize::from(squared < 1.0);
            }
        }
        &room[..count]
    }
}

/// Takes point `i` away; those near it are less crowded.
fn remove(points: &mut [Candidate], i: usize, near: &[Near], floor: f64) {
    for near in near {
        points[near.point as usize].weight -= crowding(near.squared, floor);
    }
    points[i].weight = f64::NEG_INFINITY;
}

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
