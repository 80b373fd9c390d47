//! Bricks that run into each other.

use std::collections::{BTreeMap, BTreeSet, HashMap};

use mb_geometry::{Aabb, Ray};
use mb_mesh::Bvh;
use nalgebra::{Point3, Vector3};
use serde::Serialize;

use crate::connections::Connection;
use crate::flat::{METRES_PER_LDU, Shapes};
use crate::joints::Joint;
use crate::ldraw::file::{Affine, FileId};
use crate::ldraw::shape::PartShape;
use crate::model::Model;
use crate::neighbors::{Neighbors, overlap};

/// Bricks may reach so deep into each other, LDraw units (0.2 mm): studs in tubes touch, and round parts are drawn with
/// flat sides.
const TOLERANCE_LDU: f64 = 0.5;

/// An edge that stays this close to a surface runs along it, LDraw units: faces that lie on each other are no collision.
const GRAZING_LDU: f64 = 0.3;
/// After a hit the search goes on this share of the edge further.
const STEP: f64 = 1e-4;

/// How far around a joint its bricks may overlap, LDraw units: lips of clips, flanges, detents.
const ZONE_LDU: f64 = 3.0;

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
/// which coincide. What happens within a stud or joint of the two is intended.
pub(crate) fn collisions(
    model: &Model,
    shapes: &Shapes,
    neighbors: &Neighbors,
    studs: &[Connection],
    joints: &[Joint],
) -> Vec<Collision> {
    let mut zones_of_pair: HashMap<(usize, usize), Vec<Zone>> = HashMap::new();
    let joints = joints.iter().map(|joint| (joint.peg_brick, joint.hole_brick, Zone::of_joint(joint)));
    let studs = studs.iter().map(|stud| (stud.stud_brick, stud.grip_brick, Zone::of_stud(stud)));
    for (a, b, zone) in joints.chain(studs) {
        zones_of_pair.entry((a.min(b), a.max(b))).or_default().push(zone);
    }
    let mut finder = Finder { shapes, prepared: HashMap::new(), depths: HashMap::new() };
    let mut found = vec![];
    for (a, b) in neighbors.overlapping_pairs(TOLERANCE_LDU) {
        let (brick_a, brick_b) = (&model.instances()[a], &model.instances()[b]);
        let Some(a_from_ldraw) = brick_a.ldraw_from_part.inverse() else { continue };
        let a_from_b = a_from_ldraw.then_inner(&brick_b.ldraw_from_part);
        let zones = zones_of_pair.get(&(a, b)).map_or(&[][..], Vec::as_slice);
        let zones: Vec<Zone> = zones.iter().map(|zone| zone.placed(&a_from_ldraw)).collect();
        if let Some(depth) = finder.depth(brick_a.part, brick_b.part, &a_from_b, &zones) {
            let shared = overlap(&neighbors.boxes[a], &neighbors.boxes[b]);
            found.push(Collision { a, b, depth_mm: depth.min(shared) * METRES_PER_LDU * 1e3 });
        }
    }
    found
}

/// The neighbourhood of a stud or joint, where its two bricks may be in each other's way.
struct Zone {
    center: Point3<f64>,
    /// Unit vector, or zero for a ball.
    axis: Vector3<f64>,
    radius: f64,
    half_length: f64,
}

impl Zone {
    fn of_joint(joint: &Joint) -> Self {
        Self {
            center: joint.center_in_ldraw,
            axis: joint.axis_in_ldraw,
            radius: joint.radius + ZONE_LDU,
            half_length: 0.5 * joint.length + ZONE_LDU,
        }
    }

    /// A gripped stud: where it was looked for, nothing is in its way.
    fn of_stud(stud: &Connection) -> Self {
        Self {
            center: stud.foot_in_ldraw + stud.axis_in_ldraw * 2.0,
            axis: stud.axis_in_ldraw,
            radius: 6.3,
            half_length: 2.3,
        }
    }

    fn placed(&self, to_from_own: &Affine) -> Self {
        let axis = (to_from_own.linear * self.axis).try_normalize(1e-9).unwrap_or_default();
        Self { center: to_from_own.apply(&self.center), axis, ..*self }
    }

    fn holds(&self, p: &Point3<f64>) -> bool {
        let from_center = p - self.center;
        let along = from_center.dot(&self.axis);
        along.abs() < self.half_length && (from_center - self.axis * along).norm() < self.radius
    }
}

/// A part made ready to be pierced and to pierce.
struct Prepared {
    bvh: Bvh,
    /// One for each triangle, outwards, of any length.
    normals: Vec<Vector3<f64>>,
    bounds: Aabb,
    /// Edges of the surface, shrunk.
    edges: Vec<[Point3<f64>; 2]>,
}

struct Finder<'a> {
    shapes: &'a Shapes,
    prepared: HashMap<FileId, Prepared>,
    /// By parts and relative placement in thousandths: models repeat themselves.
    depths: HashMap<(FileId, FileId, [i64; 12]), Option<f64>>,
}

impl Finder<'_> {
    /// `zones` are in the frame of `a`; they follow from the parts and their placement.
    fn depth(&mut self, a: FileId, b: FileId, a_from_b: &Affine, zones: &[Zone]) -> Option<f64> {
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
            let from_b = piercing_depth(shape_b, shape_a, a_from_b, zones);
            let from_a = a_from_b.inverse().and_then(|b_from_a| {
                let zones: Vec<Zone> = zones.iter().map(|zone| zone.placed(&b_from_a)).collect();
                piercing_depth(shape_a, shape_b, &b_from_a, &zones)
            });
            match (from_a, from_b) {
                (Some(x), Some(y)) => Some(x.max(y)),
                (x, y) => x.or(y),
            }
        };
        self.depths.insert((a, b, key), depth);
        depth
    }
}

/// How far the edges of `moving` reach through the surface of `fixed` outside all zones, in units of `fixed`'s frame.
fn piercing_depth(moving: &Prepared, fixed: &Prepared, fixed_from_moving: &Affine, zones: &[Zone]) -> Option<f64> {
    let mut deepest: Option<f64> = None;
    for edge in &moving.edges {
        let [start, end] = edge.map(|p| fixed_from_moving.apply(&p));
        let beside =
            |i: usize| start[i].max(end[i]) < fixed.bounds.min[i] || start[i].min(end[i]) > fixed.bounds.max[i];
        if (0..3).any(beside) {
            continue;
        }
        let direction = end - start;
        let cast = |from: f64| {
            let ray = Ray { origin: start + direction * from, direction };
            fixed.bvh.cast(&ray, 1.0 - from).map(|hit| (from + hit.t, hit.triangle))
        };
        let mut before = 0.0;
        let mut next = cast(0.0);
        while let Some((t, triangle)) = next {
            let after = cast(t + STEP);
            let depth = t.min(1.0 - t) * direction.norm();
            let worth_it = deepest.is_none_or(|known| depth > known);
            let intended = || zones.iter().any(|zone| zone.holds(&(start + direction * t)));
            if worth_it && !intended() {
                // The inside lies behind a face that is entered, before one that is left.
                let enters = fixed.normals[triangle as usize].dot(&direction) < 0.0;
                let other_end = if enters { after.map_or(1.0, |(t, _)| t) } else { before };
                let inside = start + direction * (0.5 * (t + other_end));
                if fixed.bvh.closest_within(&inside, GRAZING_LDU).is_none() {
                    deepest = Some(depth);
                }
            }
            before = t;
            next = after;
        }
    }
    // The edges were shrunk by the tolerance.
    deepest.map(|depth| depth + TOLERANCE_LDU)
}

fn prepare(shape: &PartShape) -> Prepared {
    let bvh = Bvh::new(&shape.to_mesh());
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
    let normal = |triangle: &[u32; 3]| {
        let [a, b, c] = triangle.map(|v| shape.vertices[v as usize]);
        (b - a).cross(&(c - a))
    };
    Prepared { bvh, normals: shape.triangles.iter().map(normal).collect(), bounds: Aabb::of(&shape.vertices), edges }
}
