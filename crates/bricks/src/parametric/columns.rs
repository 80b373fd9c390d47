//! Closed solids from vertical columns.
//!
//! A solid is a list of operations: fill or empty the space between two planes above a polygon of the ground. All
//! polygon sides together cut the ground into triangles (a constrained Delaunay triangulation); over each triangle
//! the solid is a stack of intervals. Tops and bottoms are those triangles, walls stand on their sides, and every
//! vertical edge is cut at every height where something ends on it. So neighbours always share whole edges and the
//! surface is closed by construction; nothing has to be intersected in space.
//!
//! Coordinates are LDraw's: x and z on the ground, y down, LDraw units. "Top" is the smaller y.
//!
//! What the caller must see to: two planes must not cross within one triangle (add the crease where they do as a side
//! of some polygon), and solids must not touch along an edge alone.

use std::cmp::Ordering;

use crate::ldraw::file::StudSite;
use nalgebra::Point3;
use spade::{ConstrainedDelaunayTriangulation, InsertionError, Point2, Triangulation};

/// Heights closer than this are one, LDraw units.
const SAME_LDU: f64 = 1e-5;

/// A height over the ground that varies linearly: `y = at_origin + slope_x x + slope_z z`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Plane {
    at_origin: f64,
    slope: [f64; 2],
}

impl Plane {
    pub const fn level(y: f64) -> Self {
        Self { at_origin: y, slope: [0.0; 2] }
    }

    /// Through `[x, y, z]` points that are not above one line of the ground.
    pub fn through(a: [f64; 3], b: [f64; 3], c: [f64; 3]) -> Self {
        let (u, v) = ([b[0] - a[0], b[1] - a[1], b[2] - a[2]], [c[0] - a[0], c[1] - a[1], c[2] - a[2]]);
        let ground = u[0] * v[2] - u[2] * v[0];
        let slope = [(u[1] * v[2] - v[1] * u[2]) / ground, (u[0] * v[1] - v[0] * u[1]) / ground];
        Self { at_origin: a[1] - slope[0] * a[0] - slope[1] * a[2], slope }
    }

    /// Level along x, through two points given as `[y, z]`.
    pub fn along_x(a: [f64; 2], b: [f64; 2]) -> Self {
        Self::through([0.0, a[0], a[1]], [0.0, b[0], b[1]], [1.0, a[0], a[1]])
    }

    /// Level along z, through two points given as `[x, y]`.
    pub fn along_z(a: [f64; 2], b: [f64; 2]) -> Self {
        Self::through([a[0], a[1], 0.0], [b[0], b[1], 0.0], [a[0], a[1], 1.0])
    }

    /// The same slope, higher by `lift`.
    #[must_use]
    pub fn raised(self, lift: f64) -> Self {
        Self { at_origin: self.at_origin - lift, ..self }
    }

    fn at(&self, [x, z]: [f64; 2]) -> f64 {
        self.at_origin + self.slope[0] * x + self.slope[1] * z
    }
}

/// A simple polygon on the ground, as `[x, z]` corners in either sense.
pub(crate) type Outline = Vec<[f64; 2]>;

/// The rectangle between two corners.
pub(crate) fn rectangle(x: [f64; 2], z: [f64; 2]) -> Outline {
    vec![[x[0], z[0]], [x[1], z[0]], [x[1], z[1]], [x[0], z[1]]]
}

/// How many sides LDraw's standard circles have.
pub(crate) const CIRCLE_SIDES: usize = 16;

/// The corner `index` of a circle's polygon, as the library's round primitives have them: on the axes and between.
pub(crate) fn circle_corner(center: [f64; 2], radius: f64, index: usize) -> [f64; 2] {
    // Exact on the axes and symmetric everywhere, which keeps tangent polygons tangent.
    const COS: [f64; 5] = [1.0, 0.923_879_532_511_286_7, std::f64::consts::FRAC_1_SQRT_2, 0.382_683_432_365_089_8, 0.0];
    let (quarter, step) = (index / 4 % 4, index % 4);
    let (c, s) = (COS[step] * radius, COS[4 - step] * radius);
    let [x, z] = match quarter {
        0 => [c, s],
        1 => [-s, c],
        2 => [-c, -s],
        _ => [s, -c],
    };
    [center[0] + x, center[1] + z]
}

/// A circle as a polygon.
pub(crate) fn circle(center: [f64; 2], radius: f64) -> Outline {
    (0..CIRCLE_SIDES).map(|index| circle_corner(center, radius, index)).collect()
}

/// A solid under construction.
#[derive(Debug, Clone, Default)]
pub(crate) struct Columns {
    operations: Vec<Operation>,
    /// Where other bricks can be put on.
    pub studs: Vec<StudSite>,
}

#[derive(Debug, Clone)]
struct Operation {
    /// Loops, inside by the even-odd rule.
    loops: Vec<Outline>,
    /// The rectangle around them.
    min: [f64; 2],
    max: [f64; 2],
    change: Change,
}

impl Operation {
    fn reaches(&self, at: [f64; 2]) -> bool {
        (0..2).all(|axis| self.min[axis] < at[axis] && at[axis] < self.max[axis])
            && self.loops.iter().filter(|outline| contains(outline, at)).count() % 2 == 1
    }
}

/// What happens over the outline.
#[derive(Debug, Clone, Copy)]
enum Change {
    Fill(Plane, Plane),
    Empty(Plane, Plane),
    /// What hangs lowest grows down to here.
    Extend(Plane),
}

/// A closed surface, LDraw units, counter-clockwise seen from outside.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Surface {
    pub vertices: Vec<Point3<f64>>,
    pub triangles: Vec<[u32; 3]>,
}

impl Columns {
    /// Fills the space over `outline` between two planes.
    pub fn fill_between(&mut self, outline: Outline, top: Plane, bottom: Plane) -> &mut Self {
        self.push(vec![outline], Change::Fill(top, bottom))
    }

    /// Empties the space over `outline` between two planes.
    pub fn empty_between(&mut self, outline: Outline, top: Plane, bottom: Plane) -> &mut Self {
        self.push(vec![outline], Change::Empty(top, bottom))
    }

    /// Fills the space over `outline` between two heights.
    pub fn fill(&mut self, outline: Outline, y: [f64; 2]) -> &mut Self {
        self.fill_between(outline, Plane::level(y[0]), Plane::level(y[1]))
    }

    /// Empties the space over `outline` between two heights.
    pub fn empty(&mut self, outline: Outline, y: [f64; 2]) -> &mut Self {
        self.empty_between(outline, Plane::level(y[0]), Plane::level(y[1]))
    }

    /// A post from whatever ceiling there is over `outline` down to `bottom`.
    pub fn post(&mut self, outline: Outline, bottom: f64) -> &mut Self {
        self.push(vec![outline], Change::Extend(Plane::level(bottom)))
    }

    /// A tube from whatever ceiling there is down to `bottom`.
    pub fn tube(&mut self, outer: Outline, inner: Outline, bottom: f64) -> &mut Self {
        self.push(vec![outer, inner], Change::Extend(Plane::level(bottom)))
    }

    fn push(&mut self, mut loops: Vec<Outline>, change: Change) -> &mut Self {
        // On a binary grid, sums and differences of coordinates are exact.
        let snap = |v: &mut f64| *v = (*v * 1_048_576.0).round() / 1_048_576.0;
        loops.iter_mut().flatten().flatten().for_each(snap);
        let (mut min, mut max) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for corner in loops.iter().flatten() {
            for axis in 0..2 {
                min[axis] = min[axis].min(corner[axis]);
                max[axis] = max[axis].max(corner[axis]);
            }
        }
        self.operations.push(Operation { loops, min, max, change });
        self
    }

    /// The surface of the solid.
    pub fn surface(&self) -> Surface {
        let ground = self.cut_ground().expect("outlines are finite");
        Assembly::new(self, &ground).build()
    }

    fn cut_ground(&self) -> Result<Ground, InsertionError> {
        let mut ground = Ground::new();
        for outline in self.operations.iter().flat_map(|operation| &operation.loops) {
            let corners: Vec<_> =
                outline.iter().map(|&[x, z]| ground.insert(Point2::new(x, z))).collect::<Result<_, _>>()?;
            for (index, &from) in corners.iter().enumerate() {
                let to = corners[(index + 1) % corners.len()];
                if from != to {
                    ground.add_constraint_and_split(from, to, |vertex| vertex);
                }
            }
        }
        Ok(ground)
    }

    /// The filled intervals over a point of the ground, from top to bottom.
    fn stack(&self, at: [f64; 2]) -> Vec<[Plane; 2]> {
        let mut stack: Vec<[Plane; 2]> = vec![];
        for operation in self.operations.iter().filter(|operation| operation.reaches(at)) {
            stack = changed(stack, operation.change, at);
        }
        stack
    }
}

/// The intervals over a point after one change, from top to bottom.
fn changed(mut stack: Vec<[Plane; 2]>, change: Change, at: [f64; 2]) -> Vec<[Plane; 2]> {
    match change {
        Change::Fill(top, bottom) => {
            let mut filled = [top, bottom];
            stack.retain(|[t, b]| {
                let apart = b.at(at) < top.at(at) - SAME_LDU || t.at(at) > bottom.at(at) + SAME_LDU;
                if !apart && t.at(at) < filled[0].at(at) {
                    filled[0] = *t;
                }
                if !apart && b.at(at) > filled[1].at(at) {
                    filled[1] = *b;
                }
                apart
            });
            stack.push(filled);
            stack.sort_by(|a, b| ascending(a[0].at(at), b[0].at(at)));
            stack
        }
        Change::Empty(top, bottom) => {
            let mut left = vec![];
            for [t, b] in stack {
                if t.at(at) < top.at(at) - SAME_LDU {
                    left.push([t, if b.at(at) < top.at(at) { b } else { top }]);
                }
                if b.at(at) > bottom.at(at) + SAME_LDU {
                    left.push([if t.at(at) > bottom.at(at) { t } else { bottom }, b]);
                }
            }
            left
        }
        Change::Extend(bottom) => {
            if let Some([_, lowest]) = stack.last_mut()
                && lowest.at(at) < bottom.at(at)
            {
                *lowest = bottom;
            }
            stack
        }
    }
}

type Ground = ConstrainedDelaunayTriangulation<Point2<f64>>;

fn ascending(a: f64, b: f64) -> Ordering {
    a.partial_cmp(&b).unwrap_or(Ordering::Equal)
}

/// Even-odd rule.
fn contains(outline: &[[f64; 2]], [x, z]: [f64; 2]) -> bool {
    let mut inside = false;
    for (index, &[ax, az]) in outline.iter().enumerate() {
        let [bx, bz] = outline[(index + 1) % outline.len()];
        if (az > z) != (bz > z) && x < (bx - ax) * (z - az) / (bz - az) + ax {
            inside = !inside;
        }
    }
    inside
}

/// Turns columns into a surface.
struct Assembly<'a> {
    ground: &'a Ground,
    /// Filled intervals over each triangle of the ground, by face index.
    stacks: Vec<Vec<[Plane; 2]>>,
    /// Heights at which something ends over each vertex of the ground, by vertex index, ascending.
    heights: Vec<Vec<f64>>,
    /// Index of the first surface vertex over each vertex of the ground.
    base: Vec<u32>,
    surface: Surface,
}

impl<'a> Assembly<'a> {
    fn new(columns: &Columns, ground: &'a Ground) -> Self {
        let mut stacks = vec![vec![]; ground.num_all_faces()];
        let mut heights = vec![vec![]; ground.num_vertices()];
        for face in ground.inner_faces() {
            let corners = face.vertices();
            let center = face.center();
            let stack = columns.stack([center.x, center.y]);
            for vertex in corners {
                let at = [vertex.position().x, vertex.position().y];
                let ends = stack.iter().flatten().map(|plane| plane.at(at));
                heights[vertex.fix().index()].extend(ends);
            }
            stacks[face.fix().index()] = stack;
        }
        let mut surface = Surface::default();
        let mut base = vec![];
        for vertex in ground.vertices() {
            let levels = &mut heights[vertex.fix().index()];
            levels.sort_by(|a, b| ascending(*a, *b));
            levels.dedup_by(|a, b| (*a - *b).abs() < SAME_LDU);
            base.push(surface.vertices.len() as u32);
            let at = vertex.position();
            surface.vertices.extend(levels.iter().map(|&y| Point3::new(at.x, y, at.y)));
        }
        Self { ground, stacks, heights, base, surface }
    }

    fn build(mut self) -> Surface {
        for face in self.ground.inner_faces() {
            let corners = face.vertices().map(|v| v.fix().index());
            for [top, bottom] in self.stacks[face.fix().index()].clone() {
                // Triangles of the ground turn from x to z, which faces up (towards -y).
                let [a, b, c] = corners.map(|v| self.vertex(v, &top));
                self.triangle(a, b, c);
                let [a, b, c] = corners.map(|v| self.vertex(v, &bottom));
                self.triangle(a, c, b);
            }
        }
        for edge in self.ground.undirected_edges() {
            let edge = edge.as_directed();
            let [from, to] = edge.vertices();
            let ends = [from, to].map(|v| (v.fix().index(), [v.position().x, v.position().y]));
            let inside = self.stacks[edge.face().fix().index()].clone();
            let outside = self.stacks[edge.rev().face().fix().index()].clone();
            self.walls(ends, &inside, &outside);
        }
        self.without_loose_vertices()
    }

    /// The walls over the ground edge `u` to `v` between the stacks on its left and on its right.
    fn walls(&mut self, ends: [(usize, [f64; 2]); 2], left: &[[Plane; 2]], right: &[[Plane; 2]]) {
        let [(_, u), (_, v)] = ends;
        let middle = [0.5 * (u[0] + v[0]), 0.5 * (u[1] + v[1])];
        let mut planes: Vec<Plane> = left.iter().chain(right).flatten().copied().collect();
        planes.sort_by(|a, b| ascending(a.at(middle), b.at(middle)));
        let filled = |stack: &[[Plane; 2]], y: f64| stack.iter().any(|[t, b]| t.at(middle) < y && y < b.at(middle));
        // Slabs of one kind that follow each other become one wall.
        let mut wall: Option<(Plane, Plane, bool)> = None;
        for pair in planes.windows(2) {
            let (top, bottom) = (pair[0], pair[1]);
            if bottom.at(middle) - top.at(middle) < SAME_LDU {
                continue;
            }
            let y = 0.5 * (top.at(middle) + bottom.at(middle));
            let (on_left, on_right) = (filled(left, y), filled(right, y));
            if on_left == on_right {
                continue;
            }
            wall = match wall {
                Some((start, end, side)) if side == on_left && (end.at(middle) - top.at(middle)).abs() < SAME_LDU => {
                    Some((start, bottom, side))
                }
                previous => {
                    self.wall(ends, previous);
                    Some((top, bottom, on_left))
                }
            };
        }
        self.wall(ends, wall);
    }

    fn wall(&mut self, ends: [(usize, [f64; 2]); 2], wall: Option<(Plane, Plane, bool)>) {
        let Some((top, bottom, on_left)) = wall else { return };
        let chain =
            |(vertex, _): (usize, [f64; 2])| (self.vertex(vertex, &top)..=self.vertex(vertex, &bottom)).collect();
        let (u, v): (Vec<u32>, Vec<u32>) = (chain(ends[0]), chain(ends[1]));
        let (mut i, mut j) = (0, 0);
        while i + 1 < u.len() || j + 1 < v.len() {
            // Keeps both sides about equally far down.
            let down_u = j + 1 == v.len() || (i + 1 < u.len() && i * (v.len() - 1) <= j * (u.len() - 1));
            let next = if down_u { u[i + 1] } else { v[j + 1] };
            // Filled on the left, the wall faces right.
            if on_left {
                self.triangle(u[i], next, v[j]);
            } else {
                self.triangle(u[i], v[j], next);
            }
            if down_u {
                i += 1;
            } else {
                j += 1;
            }
        }
    }

    /// The surface vertex where `plane` passes over a vertex of the ground.
    fn vertex(&self, vertex: usize, plane: &Plane) -> u32 {
        let position = self.ground.vertex(spade::handles::FixedVertexHandle::from_index(vertex)).position();
        let y = plane.at([position.x, position.y]);
        let levels = &self.heights[vertex];
        let after = levels.partition_point(|&level| level < y);
        let nearest = match (after.checked_sub(1), levels.get(after)) {
            (Some(before), Some(&next)) if y - levels[before] <= next - y => before,
            (Some(before), None) => before,
            _ => after,
        };
        self.base[vertex] + nearest as u32
    }

    /// Where planes meet over a vertex, triangles shrink to lines; those are left out.
    fn triangle(&mut self, a: u32, b: u32, c: u32) {
        if a != b && b != c && c != a {
            self.surface.triangles.push([a, b, c]);
        }
    }

    fn without_loose_vertices(self) -> Surface {
        let Surface { vertices, mut triangles } = self.surface;
        let mut index = vec![u32::MAX; vertices.len()];
        let mut kept = vec![];
        for corner in triangles.iter_mut().flatten() {
            let slot = &mut index[*corner as usize];
            if *slot == u32::MAX {
                *slot = kept.len() as u32;
                kept.push(vertices[*corner as usize]);
            }
            *corner = *slot;
        }
        Surface { vertices: kept, triangles }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// Every edge of a closed, consistently oriented surface is walked once each way.
    pub(crate) fn assert_closed(surface: &Surface, what: &str) {
        let mut walked: BTreeMap<(u32, u32), i32> = BTreeMap::new();
        for [a, b, c] in &surface.triangles {
            for (from, to) in [(a, b), (b, c), (c, a)] {
                *walked.entry((*from, *to)).or_default() += 1;
            }
        }
        for (&(from, to), &times) in &walked {
            let p = surface.vertices[from as usize];
            assert_eq!(times, 1, "{what}: the edge from {p} is walked {times} times");
            assert_eq!(walked.get(&(to, from)), Some(&1), "{what}: the edge from {p} has one side only");
        }
    }

    /// Six times the volume is a sum of determinants (the divergence theorem).
    pub(crate) fn volume(surface: &Surface) -> f64 {
        let p = |v: u32| surface.vertices[v as usize].coords;
        surface.triangles.iter().map(|&[a, b, c]| p(a).dot(&p(b).cross(&p(c)))).sum::<f64>() / 6.0
    }

    #[test]
    fn a_block_with_a_hole_and_a_pillar_is_closed_and_has_its_volume() {
        let mut solid = Columns::default();
        solid
            .fill(rectangle([-10.0, 10.0], [-10.0, 10.0]), [0.0, 24.0])
            .empty(rectangle([-6.0, 6.0], [-6.0, 6.0]), [4.0, 30.0])
            .fill(circle([0.0, 0.0], 3.0), [2.0, 24.0])
            .fill(circle([0.0, 0.0], 6.0), [-4.0, 1.0]);
        let surface = solid.surface();
        assert_closed(&surface, "block");
        let disc = |r: f64| 0.5 * 16.0 * r * r * (std::f64::consts::TAU / 16.0).sin();
        let expected = 20.0 * 20.0 * 24.0 - 12.0 * 12.0 * 20.0 + disc(3.0) * 20.0 + disc(6.0) * 4.0;
        assert!((volume(&surface) - expected).abs() < 1e-3, "{} for {expected}", volume(&surface));
    }

    #[test]
    fn a_wedge_that_ends_in_an_edge_is_closed() {
        let mut solid = Columns::default();
        let slope = Plane::along_x([0.0, -10.0], [20.0, 10.0]);
        solid.fill_between(rectangle([-10.0, 10.0], [-10.0, 10.0]), slope, Plane::level(20.0));
        let surface = solid.surface();
        assert_closed(&surface, "wedge");
        assert!((volume(&surface) - 20.0 * 20.0 * 20.0 / 2.0).abs() < 1e-6);
    }

    #[test]
    fn a_lying_cylinder_grows_out_of_a_wall() {
        let mut solid = Columns::default();
        solid.fill(rectangle([-10.0, 10.0], [-10.0, 10.0]), [0.0, 24.0]);
        for side in 0..CIRCLE_SIDES / 2 {
            let upper = [circle_corner([0.0, 0.0], 6.0, side), circle_corner([0.0, 0.0], 6.0, side + 1)];
            let [a, b] = upper.map(|[x, h]| [x, 12.0 - h]);
            let [c, d] = upper.map(|[x, h]| [x, 12.0 + h]);
            solid.fill_between(rectangle([b[0], a[0]], [-14.0, -10.0]), Plane::along_z(a, b), Plane::along_z(c, d));
        }
        let surface = solid.surface();
        assert_closed(&surface, "side stud");
        let disc = 0.5 * 16.0 * 36.0 * (std::f64::consts::TAU / 16.0).sin();
        assert!((volume(&surface) - 20.0 * 20.0 * 24.0 - 4.0 * disc).abs() < 1e-4);
    }
}
