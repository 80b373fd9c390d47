//! Building the tree: binned surface area heuristic (Wald 2007), subtrees in parallel.
//!
//! Many triangles are first put into the cells of a coarse grid. The upper half of the tree is then built over cells in
//! place of triangles, which spares half of the passes over all of them (after Garanzha, Pantaleoni, McAllister 2011).

use nalgebra::Point3;
use rayon::prelude::*;

use super::{Bvh, Child, MAX_DEPTH, Node};
use crate::TriangleMesh;

/// Bins on each axis, for many triangles and for few.
const BINS: usize = 16;
const FEW_BINS: usize = 8;
/// As many triangles as this are few.
const FEW: usize = 48;
/// So many are split in the middle, which bins would hardly do better.
const VERY_FEW: usize = 16;
/// Up to so many triangles are always a leaf: testing them costs no more than visiting the nodes above single ones, and
/// half of the work of building a tree lies in its last two levels.
const MIN_LEAF: usize = 4;
/// More triangles than this are always split.
const MAX_LEAF: usize = 8;
/// Cost of visiting a node, in units of the cost of testing one triangle.
const NODE_COST: f32 = 1.0;
/// Subtrees below this size are built by one thread.
const PARALLEL_FROM: usize = 32_768;
/// As many triangles as this are put into cells first.
pub(super) const CELLS_FROM: usize = 65_536;
/// Cells of the grid on each axis.
const CELLS: usize = 32;
/// Where the subtrees of cells begin. No tree over 32^3 cells is deeper: from [`CELLS_DEPTH`] - 15 on, it halves their number.
const CELLS_DEPTH: usize = 40;
/// From this depth on, halves are split by count, so that even a hostile mesh keeps within [`MAX_DEPTH`]:
/// 2^32 triangles need 32 more levels.
const COUNT_SPLIT_FROM: usize = MAX_DEPTH - 34;

/// Three coordinates and a spare lane: four of them are one register of the processor.
type Lanes = [f32; 4];

// Not `f32::min`, which has more instructions for NaN; none comes here.
fn lesser(a: Lanes, b: Lanes) -> Lanes {
    std::array::from_fn(|lane| if a[lane] < b[lane] { a[lane] } else { b[lane] })
}

fn greater(a: Lanes, b: Lanes) -> Lanes {
    std::array::from_fn(|lane| if a[lane] > b[lane] { a[lane] } else { b[lane] })
}

/// A box in `f32`.
#[derive(Clone, Copy)]
#[repr(align(16))]
struct Box3 {
    min: Lanes,
    max: Lanes,
}

impl Box3 {
    const EMPTY: Self = Self { min: [f32::INFINITY; 4], max: [f32::NEG_INFINITY; 4] };

    #[inline]
    fn add(&mut self, other: &Self) {
        self.min = lesser(self.min, other.min);
        self.max = greater(self.max, other.max);
    }

    fn half_area(&self) -> f32 {
        let [x, y, z] = std::array::from_fn(|axis| (self.max[axis] - self.min[axis]).max(0.0));
        x * y + y * z + z * x
    }
}

/// A triangle, or a cell of many, while the tree is built: its box, whose spare lanes hold the number of triangles and its
/// own number.
#[derive(Clone, Copy)]
struct Primitive(Box3);

impl Primitive {
    fn cell(mut bounds: Box3, number: u32, triangles: u32) -> Self {
        bounds.min[3] = f32::from_bits(triangles);
        bounds.max[3] = f32::from_bits(number);
        Self(bounds)
    }

    /// Of no triangle, where a corner is not finite.
    fn of_triangle(corners: &[Point3<f64>; 3], triangle: u32) -> Self {
        let [a, b, c] = corners;
        let mut bounds = Box3 { min: [0.0; 4], max: [0.0; 4] };
        for axis in 0..3 {
            bounds.min[axis] = round_down(a[axis].min(b[axis]).min(c[axis]));
            bounds.max[axis] = round_up(a[axis].max(b[axis]).max(c[axis]));
        }
        let is_finite = corners.iter().all(|p| p.coords.iter().all(|v| v.is_finite()));
        Self::cell(bounds, triangle, u32::from(is_finite))
    }

    fn number(&self) -> u32 {
        self.0.max[3].to_bits()
    }

    fn triangles(&self) -> u32 {
        self.0.min[3].to_bits()
    }

    /// Twice the middle of the box, which sorts like the middle.
    #[inline]
    fn centre2(&self) -> Lanes {
        std::array::from_fn(|axis| self.centre2_along(axis))
    }

    #[inline]
    fn centre2_along(&self, axis: usize) -> f32 {
        self.0.min[axis] + self.0.max[axis]
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

pub(super) fn build(mesh: &TriangleMesh) -> Bvh {
    let mut bvh = build_without_corners(mesh);
    bvh.corners = bvh.triangles.par_iter().map(|&t| mesh.triangle(t as usize)).collect();
    bvh
}

pub(super) fn build_without_corners(mesh: &TriangleMesh) -> Bvh {
    let mut primitives: Vec<Primitive> = (0..mesh.triangles.len())
        .into_par_iter()
        .map(|index| Primitive::of_triangle(&mesh.triangle(index), index as u32))
        .collect();
    primitives.retain(|p| p.triangles() > 0);
    let extent = Extent::of(&primitives);
    let (nodes, root) = match primitives.len() {
        0 => (Vec::new(), Child::default()),
        count if count < CELLS_FROM => subtree(&mut primitives, &extent, 0, 0),
        _ => tree_over_cells(&mut primitives, &extent),
    };
    let triangles: Vec<u32> = primitives.par_iter().map(Primitive::number).collect();
    Bvh { nodes, root, corners: Vec::new(), triangles }
}

/// Builds the tree over many `primitives`, which reach over `extent` and are reordered in place.
fn tree_over_cells(primitives: &mut [Primitive], extent: &Extent) -> (Vec<Node>, Child) {
    let starts = sort_by_cell(primitives, &Bins::new(&extent.centres2));
    let mut cells = Vec::new();
    let mut rest = primitives;
    for range in starts.windows(2).filter(|range| range[0] < range[1]) {
        let (cell, others) = rest.split_at_mut(range[1] - range[0]);
        cells.push((range[0] as u32, cell));
        rest = others;
    }
    let (mut cells, mut subtrees): (Vec<Primitive>, Vec<(Vec<Node>, Child)>) = cells
        .into_par_iter()
        .enumerate()
        .map(|(number, (first, cell))| {
            let extent = Extent::of(cell);
            let whole = Primitive::cell(extent.bounds, number as u32, cell.len() as u32);
            (whole, subtree(cell, &extent, first, CELLS_DEPTH))
        })
        .unzip();

    // A tree with two children a node has one node less than leaves.
    let mut at = cells.len() as u32 - 1;
    for (nodes, root) in &mut subtrees {
        nodes.iter_mut().for_each(|node| node.children = node.children.map(|child| moved(child, at)));
        *root = moved(*root, at);
        at += nodes.len() as u32;
    }
    let mut nodes = Vec::with_capacity(at as usize);
    let extent = Extent::of(&cells);
    let root = join(&mut cells, &extent, 0, &mut nodes, &|cell| subtrees[cell as usize].1);
    subtrees.into_iter().for_each(|(subtree, _)| nodes.extend(subtree));
    (nodes, root)
}

/// Reorders `primitives` by the cells of a grid and returns where each cell begins, and the end (McIlroy, Bostic, McIlroy
/// 1993: in place, since tens of millions of them fill a good part of the memory).
fn sort_by_cell(primitives: &mut [Primitive], bins: &Bins<CELLS>) -> Vec<usize> {
    let cell = |p: &Primitive| bins.of(p).into_iter().rev().fold(0, |cell, bin| cell * CELLS + bin);
    let mut starts = vec![0; CELLS.pow(3) + 1];
    primitives.iter().for_each(|p| starts[cell(p) + 1] += 1);
    (1..starts.len()).for_each(|i| starts[i] += starts[i - 1]);
    let mut free = starts.clone();
    for here in 0..CELLS.pow(3) {
        while free[here] < starts[here + 1] {
            let home = cell(&primitives[free[here]]);
            primitives.swap(free[here], free[home]);
            free[home] += 1;
        }
    }
    starts
}

/// Appends the inner nodes over `cells` to `nodes`; `root` knows the root of a cell's own subtree.
fn join(
    cells: &mut [Primitive],
    extent: &Extent,
    depth: usize,
    nodes: &mut Vec<Node>,
    root: &impl Fn(u32) -> Child,
) -> Child {
    if let [cell] = cells {
        return root(cell.number());
    }
    let bins = Bins::<BINS>::new(&extent.centres2);
    let by_count = depth + 15 >= CELLS_DEPTH;
    let middle = match if by_count { None } else { best_bin(cells, &extent.bounds, &bins) } {
        Some((_, axis, bin)) => partition(cells, |p| bins.along(axis, p) < bin),
        None => halve(cells, extent),
    };
    let (left, right) = cells.split_at_mut(middle);
    let extents = [Extent::of(left), Extent::of(right)];
    let at = nodes.len();
    nodes.push(Node::new(&extents.map(|e| e.bounds), [Child::default(); 2]));
    let left = join(left, &extents[0], depth + 1, nodes, root);
    let right = join(right, &extents[1], depth + 1, nodes, root);
    nodes[at].children = [left, right];
    Child { first: at as u32, count: 0 }
}

/// Builds the subtree over `primitives`, which reach over `extent`, stand at `first` in the final order and are reordered
/// in place. Inner nodes are numbered from 0 within the subtree, its root first.
fn subtree(primitives: &mut [Primitive], extent: &Extent, first: u32, depth: usize) -> (Vec<Node>, Child) {
    let count = primitives.len();
    if count < PARALLEL_FROM {
        let mut nodes = Vec::with_capacity(count / 2);
        let root = grow(primitives, extent, first, depth, &mut nodes);
        return (nodes, root);
    }
    let Some(middle) = split(primitives, extent, depth) else {
        return (Vec::new(), Child { first, count: count as u32 });
    };
    let (left, right) = primitives.split_at_mut(middle);
    let (boxes, ((left_nodes, left), (right_nodes, right))) = {
        let build = |half: &mut [Primitive], first: u32| {
            let extent = Extent::of(half);
            (extent.bounds, subtree(half, &extent, first, depth + 1))
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
fn grow(primitives: &mut [Primitive], extent: &Extent, first: u32, depth: usize, nodes: &mut Vec<Node>) -> Child {
    let Some(middle) = split(primitives, extent, depth) else {
        return Child { first, count: primitives.len() as u32 };
    };
    let (left, right) = primitives.split_at_mut(middle);
    let extents = [Extent::of(left), Extent::of(right)];
    let at = nodes.len();
    // The children are known when they are built; they follow their parent.
    nodes.push(Node::new(&extents.map(|e| e.bounds), [Child::default(); 2]));
    let left = grow(left, &extents[0], first, depth + 1, nodes);
    let right = grow(right, &extents[1], first + middle as u32, depth + 1, nodes);
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

/// What some triangles reach over.
#[derive(Clone, Copy)]
struct Extent {
    bounds: Box3,
    /// Least and largest of [`Primitive::centre2`].
    centres2: Box3,
}

impl Extent {
    fn of(primitives: &[Primitive]) -> Self {
        let mut extent = Self { bounds: Box3::EMPTY, centres2: Box3::EMPTY };
        for p in primitives {
            extent.bounds.add(&p.0);
            let centre2 = p.centre2();
            extent.centres2.add(&Box3 { min: centre2, max: centre2 });
        }
        extent
    }

    /// Along which the centres reach farthest.
    fn longest_axis(&self) -> usize {
        let length = |axis: usize| self.centres2.max[axis] - self.centres2.min[axis];
        (0..3).max_by(|&a, &b| length(a).total_cmp(&length(b))).unwrap_or(0)
    }
}

/// Bins of equal width between the least and the largest centre on each axis.
struct Bins<const BINS: usize> {
    low: Lanes,
    /// Bins per unit; 0 on an axis along which no bin can tell the centres apart.
    scale: Lanes,
}

impl<const BINS: usize> Bins<BINS> {
    /// Added to a number of bins, this leaves it in bits 8 and up of the sum, in units of 2^-8 bins below. Rust's own
    /// conversion to integers looks after numbers that none can hold, which takes longer than all the rest.
    const SHIFT: f32 = 32768.0;

    fn new(centres2: &Box3) -> Self {
        let scale = std::array::from_fn(|axis| {
            let extent = centres2.max[axis] - centres2.min[axis];
            // Below this extent the quotient overflows.
            if extent > f32::MIN_POSITIVE * 1e6 { (BINS as f32 - 0.01) / extent } else { 0.0 }
        });
        Self { low: centres2.min, scale }
    }

    #[inline]
    fn of(&self, p: &Primitive) -> [usize; 3] {
        let centre2 = p.centre2();
        let shifted: Lanes =
            std::array::from_fn(|axis| (centre2[axis] - self.low[axis]) * self.scale[axis] + Self::SHIFT);
        [0, 1, 2].map(|axis| Self::number(shifted[axis]))
    }

    #[inline]
    fn along(&self, axis: usize, p: &Primitive) -> usize {
        Self::number((p.centre2_along(axis) - self.low[axis]) * self.scale[axis] + Self::SHIFT)
    }

    #[inline]
    fn number(shifted: f32) -> usize {
        (shifted.to_bits() >> 8) as usize % BINS
    }
}

/// Reorders `primitives` into two halves and returns where the second begins; `None` where one leaf is cheaper.
fn split(primitives: &mut [Primitive], extent: &Extent, depth: usize) -> Option<usize> {
    match primitives.len() {
        count if count <= MIN_LEAF => None,
        count if count <= VERY_FEW && depth < COUNT_SPLIT_FROM => split_in_the_middle(primitives, extent),
        count if count <= FEW => split_by_bins::<FEW_BINS>(primitives, extent, depth),
        _ => split_by_bins::<BINS>(primitives, extent, depth),
    }
}

/// Splits at the middle of the longest axis.
fn split_in_the_middle(primitives: &mut [Primitive], extent: &Extent) -> Option<usize> {
    let axis = extent.longest_axis();
    let middle = 0.5 * (extent.centres2.min[axis] + extent.centres2.max[axis]);
    match partition(primitives, |p| p.centre2_along(axis) < middle) {
        // The centres coincide.
        0 if primitives.len() <= MAX_LEAF => None,
        0 => Some(halve(primitives, extent)),
        second => Some(second),
    }
}

fn split_by_bins<const BINS: usize>(primitives: &mut [Primitive], extent: &Extent, depth: usize) -> Option<usize> {
    let count = primitives.len();
    let bins = Bins::<BINS>::new(&extent.centres2);
    let best = if depth >= COUNT_SPLIT_FROM { None } else { best_bin(primitives, &extent.bounds, &bins) };
    match best {
        Some((cost, axis, bin)) if count > MAX_LEAF || cost < count as f32 => {
            Some(partition(primitives, |p| bins.along(axis, p) < bin))
        }
        Some(_) => None,
        None if count <= MAX_LEAF => None,
        // No plane separates the centres: they coincide, or the tree is already too deep for the heuristic.
        None => Some(halve(primitives, extent)),
    }
}

/// Reorders `primitives` into two halves of the same number along the longest axis and returns where the second begins.
fn halve(primitives: &mut [Primitive], extent: &Extent) -> usize {
    let middle = primitives.len() / 2;
    let axis = extent.longest_axis();
    let key = |p: &Primitive| (p.centre2_along(axis), p.number());
    primitives.select_nth_unstable_by(middle, |a, b| {
        let (a, b) = (key(a), key(b));
        a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
    });
    middle
}

/// The cheapest border between bins over the three axes: cost, axis, and the first bin of the second half.
fn best_bin<const BINS: usize>(primitives: &[Primitive], all: &Box3, bins: &Bins<BINS>) -> Option<(f32, usize, usize)> {
    let mut filled = [[(Box3::EMPTY, 0u32); BINS]; 3];
    for p in primitives {
        let at = bins.of(p);
        for (axis, filled) in filled.iter_mut().enumerate() {
            let (bounds, count) = &mut filled[at[axis]];
            bounds.add(&p.0);
            *count += p.triangles();
        }
    }
    let whole = all.half_area().max(f32::MIN_POSITIVE);
    let mut best: Option<(f32, usize, usize)> = None;
    for axis in (0..3).filter(|&axis| bins.scale[axis] > 0.0) {
        let bins = &filled[axis];
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
        // Always exchanged, as it costs less than a guess that is wrong half of the time.
        primitives.swap(i, left);
        left += usize::from(is_left(&primitives[left]));
    }
    left
}
