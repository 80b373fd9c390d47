//! Bricks that run into each other.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use mb_geometry::{Aabb, Ray};
use mb_mesh::{Bvh, TriangleMesh};
use nalgebra::Vector3;
use serde::Serialize;

use crate::flat::{METRES_PER_LDU, Shapes};
use crate::ldraw::file::{Affine, FileId};
use crate::ldraw::shape::PartShape;
use crate::model::Model;
use crate::neighbors::{Neighbors, overlap};

/// Bricks may reach so deep into each other, LDraw units (0.2 mm): studs in tubes touch, and round parts are drawn with
/// flat sides.
const TOLERANCE_LDU: f64 = 0.5;

/// Two bricks in the same place.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Collision {
    /// Index of one brick in [`Model::instances`].
    pub a: usize,
    /// Index of the other.
    pub b: usize,
    /// How far one reaches into the other at least along one of its edges, and at most what their boxes share,
    /// millimetres.
    pub depth_mm: f64,
}

/// Finds pairs of bricks of which one, shrunk by the tolerance, still pierces the other's surface with an edge, or
/// which coincide.
pub(crate) fn collisions(model: &Model, shapes: &Shapes, neighbors: &Neighbors) -> Vec<Collision> {
    let mut finder = Finder { shapes, prepared: HashMap::new(), depths: HashMap::new() };
    let mut found = vec![];
    for (a, b) in neighbors.overlapping_pairs(TOLERANCE_LDU) {
        let (brick_a, brick_b) = (&model.instances()[a], &model.instances()[b]);
        let Some(a_from_ldraw) = brick_a.ldraw_from_part.inverse() else { continue };
        let a_from_b = a_from_ldraw.then_inner(&brick_b.ldraw_from_part);
        if let Some(depth) = finder.depth(brick_a.part, brick_b.part, &a_from_b) {
            let shared = overlap(&neighbors.boxes[a], &neighbors.boxes[b]);
            found.push(Collision { a, b, depth_mm: depth.min(shared) * METRES_PER_LDU * 1e3 });
        }
    }
    found
}

/// A part made ready to be pierced and to pierce.
struct Prepared {
    bvh: Bvh,
    bounds: Aabb,
    /// Edges of the surface, shrunk.
    edges: Vec<[nalgebra::Point3<f64>; 2]>,
}

struct Finder<'a> {
    shapes: &'a Shapes,
    prepared: HashMap<FileId, Prepared>,
    /// By parts and relative placement in thousandths: models repeat themselves.
    depths: HashMap<(FileId, FileId, [i64; 12]), Option<f64>>,
}

impl Finder<'_> {
    fn depth(&mut self, a: FileId, b: FileId, a_from_b: &Affine) -> Option<f64> {
        let mut key = [0; 12];
        for (slot, v) in key.iter_mut().zip(a_from_b.linear.iter().chain(a_from_b.offset.iter())) {
            *slot = (v * 1000.0).round() as i64;
        }
        if let Some(known) = self.depths.get(&(a, b, key)) {
            return *known;
        }
        for part in [a, b] {
            let shape = self.shapes.get(part);
            self.prepared.entry(part).or_insert_with(|| prepare(shape));
        }
        let (shape_a, shape_b) = (&self.prepared[&a], &self.prepared[&b]);
        let same = a == b && (a_from_b.linear - nalgebra::Matrix3::identity()).norm() < 1e-3;
        let depth = if same && a_from_b.offset.norm() < TOLERANCE_LDU {
            Some(shape_a.bounds.extent().min())
        } else {
            let from_b = piercing_depth(shape_b, shape_a, a_from_b);
            let from_a = a_from_b.inverse().and_then(|b_from_a| piercing_depth(shape_a, shape_b, &b_from_a));
            match (from_a, from_b) {
                (Some(x), Some(y)) => Some(x.max(y)),
                (x, y) => x.or(y),
            }
        };
        self.depths.insert((a, b, key), depth);
        depth
    }
}

/// How far the edges of `moving` reach through the surface of `fixed`, in units of `fixed`'s frame.
fn piercing_depth(moving: &Prepared, fixed: &Prepared, fixed_from_moving: &Affine) -> Option<f64> {
    let mut deepest: Option<f64> = None;
    for edge in &moving.edges {
        let [start, end] = edge.map(|p| fixed_from_moving.apply(&p));
        let beside =
            |i: usize| start[i].max(end[i]) < fixed.bounds.min[i] || start[i].min(end[i]) > fixed.bounds.max[i];
        if (0..3).any(beside) {
            continue;
        }
        let direction = end - start;
        if let Some(hit) = fixed.bvh.cast(&Ray { origin: start, direction }, 1.0) {
            let depth = hit.t.min(1.0 - hit.t) * direction.norm();
            deepest = Some(deepest.map_or(depth, |d: f64| d.max(depth)));
        }
    }
    // The edges were shrunk by the tolerance.
    deepest.map(|depth| depth + TOLERANCE_LDU)
}

fn prepare(shape: &PartShape) -> Prepared {
    let bvh = Bvh::new(&TriangleMesh::new(shape.vertices.clone(), shape.triangles.clone()));
    // The normals at each vertex, each direction once.
    let mut normals: Vec<Vec<Vector3<f64>>> = vec![vec![]; shape.vertices.len()];
    let mut edges = BTreeSet::new();
    let mut facing: BTreeMap<(u32, u32), Vector3<f64>> = BTreeMap::new();
    for triangle in &shape.triangles {
        let [a, b, c] = triangle.map(|v| shape.vertices[v as usize]);
        let Some(normal) = (b - a).cross(&(c - a)).try_normalize(1e-12) else { continue };
        for (i, &corner) in triangle.iter().enumerate() {
            let known = &mut normals[corner as usize];
            if known.iter().all(|n| n.dot(&normal) < 0.95) {
                known.push(normal);
            }
            let next = triangle[(i + 1) % 3];
            let key = (corner.min(next), corner.max(next));
            match facing.get(&key) {
                // The diagonal of a flat face is no edge.
                Some(other) if other.dot(&normal) > 0.999 => {
                    edges.remove(&key);
                }
                _ => {
                    edges.insert(key);
                    facing.insert(key, normal);
                }
            }
        }
    }
    let shrunk: Vec<_> = shape
        .vertices
        .iter()
        .zip(&normals)
        .map(|(p, normals)| p - normals.iter().sum::<Vector3<f64>>() * TOLERANCE_LDU)
        .collect();
    let edges = edges.into_iter().map(|(a, b)| [shrunk[a as usize], shrunk[b as usize]]).collect();
    Prepared { bvh, bounds: Aabb::of(&shape.vertices), edges }
}
