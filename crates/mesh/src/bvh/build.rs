//! Building the tree: binned surface area heuristic (Wald 2007), subtrees in parallel.

use nalgebra::Point3;
use rayon::prelude::*;

use super::{Bvh, Child, MAX_DEPTH, Node};
use crate::TriangleMesh;

/// Bins on each axis, for many triangles and for few.
const BINS: usize = 16;
const FEW_BINS: usize = 8;
/// As many triangles as this are few.
const FEW: usize = 48;
/// Up to so many triangles are always a leaf: testing them costs no more than visiting the nodes above single ones, and
/// half of the work of building a tree lies in its last two levels.
const MIN_LEAF: usize = 4;
/// More triangles than this are always split.
const MAX_LEAF: usize = 8;
/// Cost of visiting a node, in units of the cost of testing one triangle.
const NODE_COST: f32 = 1.0;
/// Subtrees below this size are built by one thread.
const PARALLEL_FROM: usize = 32_768;
/// From this depth on, halves are split by count, so that even a hostile mesh keeps within [`MAX_DEPTH`]:
/// 2^32 triangles need 32 more levels.
const COUNT_SPLIT_FROM: usize = MAX_DEPTH - 34;

/// A box in `f32`.
#[derive(Clone, Copy)]
struct Box3 {
    min: [f32; 3],
    max: [f32; 3],
}

impl Box3 {
    const EMPTY: Self = Self { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };

    fn add(&mut self, other: &Self) {
        for axis in 0..3 {
            self.min[axis] = self.min[axis].min(other.min[axis]);
            self.max[axis] = self.max[axis].max(other.max[axis]);
        }
    }

    fn half_area(&self) -> f32 {
        let [x, y, z] = std::array::from_fn(|axis| (self.max[axis] - self.min[axis]).max(0.0));
        x * y + y * z + z * x
    }
}

/// A triangle while the tree is built.
#[derive(Clone, Copy)]
struct Primitive {
    bounds: Box3,
    triangle: u32,
}

impl Primitive {
    /// Twice the middle of the box, which sorts like the middle.
    fn centre2(&self, axis: usize) -> f32 {
        self.bounds.min[axis] + self.bounds.max[axis]
    }
}

/// Largest `f32` that is not above `v`.
fn round_down(v: f64) -> f32 {
    let r = v as f32;
    if f64::from(r) > v { r.next_down() } else { r }
}

/// Smallest `f32` that is not below `v`.
fn round_up(v: f64) -> f32 {
    let r = v as f32;
    if f64::from(r) < v { r.next_up() } else { r }
}

fn bounds_of(corners: &[Point3<f64>; 3]) -> Box3 {
    let [a, b, c] = corners;
    Box3 {
        min: std::array::from_fn(|axis| round_down(a[axis].min(b[axis]).min(c[axis]))),
        max: std::array::from_fn(|axis| round_up(a[axis].max(b[axis]).max(c[axis]))),
    }
}

pub(super) fn build(mesh: &TriangleMesh) -> Bvh {
    let mut bvh = build_without_corners(mesh);
    bvh.corners = bvh.triangles.par_iter().map(|&t| mesh.triangle(t as usize)).collect();
    bvh
}

pub(super) fn build_without_corners(mesh: &TriangleMesh) -> Bvh {
    let mut primitives: Vec<Primitive> = (0..mesh.triangles.len())
        .into_par_iter()
        .filter_map(|index| {
            let corners = mesh.triangle(index);
            let finite = corners.iter().all(|p| p.coords.iter().all(|v| v.is_finite()));
            finite.then(|| Primitive { bounds: bounds_of(&corners), triangle: index as u32 })
        })
        .collect();
    let all = bounds(&primitives);
    let (nodes, root) =
        if primitives.is_empty() { (Vec::new(), Child::default()) } else { subtree(&mut primitives, &all, 0, 0) };
    let triangles: Vec<u32> = primitives.par_iter().map(|p| p.triangle).collect();
    Bvh { nodes, root, corners: Vec::new(), triangles }
}

/// Builds the subtree over `primitives`, which lie in the box `all`, stand at `first` in the final order and are reordered
/// in place. Inner nodes are numbered from 0 within the subtree, its root first.
fn subtree(primitives: &mut [Primitive], all: &Box3, first: u32, depth: usize) -> (Vec<Node>, Child) {
    let count = primitives.len();
    if count < PARALLEL_FROM {
        let mut nodes = Vec::with_capacity(count / 2);
        let root = grow(primitives, all, first, depth, &mut nodes);
        return (nodes, root);
    }
    let Some(middle) = split(primitives, all, depth) else {
        return (Vec::new(), Child { first, count: count as u32 });
    };
    let (left, right) = primitives.split_at_mut(middle);
    let (boxes, ((left_nodes, left), (right_nodes, right))) = {
        let build = |half: &mut [Primitive], first: u32| {
            let all = bounds(half);
            (all, subtree(half, &all, first, depth + 1))
        };
        let (left, right) = rayon::join(|| build(left, first), || build(right, first + middle as u32));
        ([left.0, right.0], (left.1, right.1))
    };

    let left_at = 1;
    let right_at = left_at + left_nodes.len() as u32;
    let mut nodes = Vec::with_capacity(1 + left_nodes.len() + right_nodes.len());
    nodes.push(Node::new(&boxes, [moved(left, left_at), moved(right, right_at)]));
    for (part, at) in [(left_nodes, left_at), (right_nodes, right_at)] {
        nodes.extend(part.into_iter().map(|node| Node { children: node.children.map(|c| moved(c, at)), ..node }));
    }
    (nodes, Child { first: 0, count: 0 })
}

/// Like [`subtree`] by one thread, which puts the inner nodes where they stay: behind those of `nodes`.
fn grow(primitives: &mut [Primitive], all: &Box3, first: u32, depth: usize, nodes: &mut Vec<Node>) -> Child {
    let Some(middle) = split(primitives, all, depth) else {
        return Child { first, count: primitives.len() as u32 };
    };
    let (left, right) = primitives.split_at_mut(middle);
    let boxes = [bounds(left), bounds(right)];
    let at = nodes.len();
    // The children are known when they are built; they follow their parent.
    nodes.push(Node::new(&boxes, [Child::default(); 2]));
    let left = grow(left, &boxes[0], first, depth + 1, nodes);
    let right = grow(right, &boxes[1], first + middle as u32, depth + 1, nodes);
    nodes[at].children = [left, right];
    Child { first: at as u32, count: 0 }
}

impl Node {
    fn new(boxes: &[Box3; 2], children: [Child; 2]) -> Self {
        Self {
            min: std::array::from_fn(|axis| [boxes[0].min[axis], boxes[1].min[axis]]),
            max: std::array::from_fn(|axis| [boxes[0].max[axis], boxes[1].max[axis]]),
            children,
        }
    }
}

/// A child whose inner nodes were moved by `offset`.
fn moved(child: Child, offset: u32) -> Child {
    if child.count > 0 { child } else { Child { first: child.first + offset, count: 0 } }
}

fn bounds(primitives: &[Primitive]) -> Box3 {
    primitives.iter().fold(Box3::EMPTY, |mut all, p| {
        all.add(&p.bounds);
        all
    })
}

/// Reorders `primitives` into two halves and returns where the second begins; `None` where one leaf is cheaper.
fn split(primitives: &mut [Primitive], all: &Box3, depth: usize) -> Option<usize> {
    match primitives.len() {
        count if count <= MIN_LEAF => None,
        count if count <= FEW => split_by_bins::<FEW_BINS>(primitives, all, depth),
        _ => split_by_bins::<BINS>(primitives, all, depth),
    }
}

fn split_by_bins<const BINS: usize>(primitives: &mut [Primitive], all: &Box3, depth: usize) -> Option<usize> {
    let count = primitives.len();
    let mut low = [f32::INFINITY; 3];
    let mut high = [f32::NEG_INFINITY; 3];
    for p in primitives.iter() {
        for axis in 0..3 {
            low[axis] = low[axis].min(p.centre2(axis));
            high[axis] = high[axis].max(p.centre2(axis));
        }
    }
    let scale: [f32; 3] = std::array::from_fn(|axis| {
        let extent = high[axis] - low[axis];
        // Below this extent the quotient overflows, and no bin can tell the centres apart.
        if extent > f32::MIN_POSITIVE * 1e6 { BINS as f32 * (1.0 - 1e-6) / extent } else { 0.0 }
    });
    let bin_of = |p: &Primitive, axis: usize| (((p.centre2(axis) - low[axis]) * scale[axis]) as usize).min(BINS - 1);

    let best = if depth >= COUNT_SPLIT_FROM { None } else { best_bin::<BINS>(primitives, all, &scale, bin_of) };
    match best {
        Some((cost, axis, bin)) if count > MAX_LEAF || cost < count as f32 => {
            Some(partition(primitives, |p| bin_of(p, axis) < bin))
        }
        Some(_) => None,
        None if count <= MAX_LEAF => None,
        // No plane separates the centres: they coincide, or the tree is already too deep for the heuristic.
        None => {
            let axis = (0..3).max_by(|&a, &b| (high[a] - low[a]).total_cmp(&(high[b] - low[b]))).unwrap_or(0);
            let key = |p: &Primitive| (p.centre2(axis), p.triangle);
            primitives.select_nth_unstable_by(count / 2, |a, b| {
                let (a, b) = (key(a), key(b));
                a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
            });
            Some(count / 2)
        }
    }
}

/// The cheapest border between bins over the three axes: cost, axis, and the first bin of the second half.
fn best_bin<const BINS: usize>(
    primitives: &[Primitive],
    all: &Box3,
    scale: &[f32; 3],
    bin_of: impl Fn(&Primitive, usize) -> usize,
) -> Option<(f32, usize, usize)> {
    let mut bins = [[(Box3::EMPTY, 0u32); BINS]; 3];
    for p in primitives {
        for (axis, bins) in bins.iter_mut().enumerate() {
            let (bounds, count) = &mut bins[bin_of(p, axis)];
            bounds.add(&p.bounds);
            *count += 1;
        }
    }
    let whole = all.half_area().max(f32::MIN_POSITIVE);
    let mut best: Option<(f32, usize, usize)> = None;
    for axis in (0..3).filter(|&axis| scale[axis] > 0.0) {
        let bins = &bins[axis];
        let mut right_cost = [0.0f32; BINS];
        let (mut bounds, mut count) = (Box3::EMPTY, 0);
        for bin in (1..BINS).rev() {
            bounds.add(&bins[bin].0);
            count += bins[bin].1;
            right_cost[bin] = if count > 0 { bounds.half_area() * count as f32 } else { f32::INFINITY };
        }
        let (mut bounds, mut count) = (Box3::EMPTY, 0);
        for bin in 1..BINS {
            bounds.add(&bins[bin - 1].0);
            count += bins[bin - 1].1;
            let left_cost = if count > 0 { bounds.half_area() * count as f32 } else { f32::INFINITY };
            let cost = NODE_COST + (left_cost + right_cost[bin]) / whole;
            if cost.is_finite() && best.is_none_or(|(least, ..)| cost < least) {
                best = Some((cost, axis, bin));
            }
        }
    }
    best
}

/// Moves those that satisfy `is_left` to the front and returns their number.
fn partition(primitives: &mut [Primitive], is_left: impl Fn(&Primitive) -> bool) -> usize {
    let mut left = 0;
    for i in 0..primitives.len() {
        if is_left(&primitives[i]) {
            primitives.swap(left, i);
            left += 1;
        }
    }
    left
}
