//! Where two bricks touch without a stud or a joint: surfaces that meet, and faces that lie on each other.

use std::collections::HashMap;

use mb_mesh::Bvh;
use nalgebra::{Point3, Vector3};

use crate::convex_hull::convex_hull;
use crate::flat::Shapes;
use crate::ldraw::file::FileId;
use crate::model::Model;
use crate::neighbors::Neighbors;

/// Surfaces this near touch, LDraw units (0.2 mm).
const TOUCH_LDU: f64 = 0.5;
/// Sine of the tilt up to which a face is level.
const LEVEL: f64 = 0.02;

/// Tells which bricks touch; keeps what it prepared of each part.
pub(crate) struct Touching<'a> {
    model: &'a Model,
    shapes: &'a Shapes,
    neighbors: &'a Neighbors,
    surfaces: HashMap<FileId, Bvh>,
}

impl<'a> Touching<'a> {
    pub fn new(model: &'a Model, shapes: &'a Shapes, neighbors: &'a Neighbors) -> Self {
        Self { model, shapes, neighbors, surfaces: HashMap::new() }
    }

    /// Whether a corner of one brick comes near the surface of the other.
    pub fn touch(&mut self, a: usize, b: usize) -> bool {
        [(a, b), (b, a)].into_iter().any(|(moving, fixed)| {
            let bricks = [moving, fixed].map(|brick| &self.model.instances()[brick]);
            let Some(fixed_from_ldraw) = bricks[1].ldraw_from_part.inverse() else { return false };
            let fixed_from_moving = fixed_from_ldraw.then_inner(&bricks[0].ldraw_from_part);
            let near = self.neighbors.boxes[fixed].grown(TOUCH_LDU);
            let corners = self.shapes.get(bricks[0].part).vertices.iter();
            let mut close = corners.filter(|p| near.contains(&bricks[0].ldraw_from_part.apply(p)));
            let shape = self.shapes.get(bricks[1].part);
            let surface = self.surfaces.entry(bricks[1].part).or_insert_with(|| Bvh::new(&shape.to_mesh()));
            close.any(|p| surface.closest_within(&fixed_from_moving.apply(p), TOUCH_LDU).is_some())
        })
    }
}

/// The corners of the patch on which a level underside of `upper` lies on a level top of `lower`; empty where none
/// does. LDraw frame.
pub(crate) fn resting_patch(model: &Model, shapes: &Shapes, upper: usize, lower: usize) -> Vec<Point3<f64>> {
    // LDraw's y points down: tops face -y.
    let (undersides, tops) = (level_faces(model, shapes, upper, 1.0), level_faces(model, shapes, lower, -1.0));
    let (mut shared, mut height) = (vec![], f64::INFINITY);
    for [a, b, c] in &undersides {
        for top in tops.iter().filter(|top| (top[0].y - a.y).abs() < TOUCH_LDU) {
            let overlap = clipped([a, b, c], top);
            if !overlap.is_empty() {
                height = height.min(a.y);
                shared.extend(overlap);
            }
        }
    }
    convex_hull(shared).into_iter().map(|[x, z]| Point3::new(x, height, z)).collect()
}

/// The level triangles of a brick that face `way` along y.
fn level_faces(model: &Model, shapes: &Shapes, brick: usize, way: f64) -> Vec<[Point3<f64>; 3]> {
    let brick = &model.instances()[brick];
    let shape = shapes.get(brick.part);
    let flip = if brick.inverted ^ brick.ldraw_from_part.is_mirrored() { -1.0 } else { 1.0 };
    let corners = |t: &[u32; 3]| t.map(|v| brick.ldraw_from_part.apply(&shape.vertices[v as usize]));
    let faces = shape.triangles.iter().map(corners).filter(|[a, b, c]| {
        let normal: Vector3<f64> = (b - a).cross(&(c - a)) * flip;
        let length = normal.norm();
        length > 1e-6 && normal.y * way > 0.0 && normal.x.hypot(normal.z) < LEVEL * length
    });
    faces.collect()
}

/// What two triangles share seen from above, as `[x, z]` corners (Sutherland and Hodgman).
fn clipped(subject: [&Point3<f64>; 3], clip: &[Point3<f64>; 3]) -> Vec<[f64; 2]> {
    let mut polygon: Vec<[f64; 2]> = subject.iter().map(|p| [p.x, p.z]).collect();
    let side = |a: &Point3<f64>, b: &Point3<f64>, p: &[f64; 2]| (b.x - a.x) * (p[1] - a.z) - (b.z - a.z) * (p[0] - a.x);
    let sense = side(&clip[0], &clip[1], &[clip[2].x, clip[2].z]).signum();
    for index in 0..3 {
        let (a, b) = (&clip[index], &clip[(index + 1) % 3]);
        let mut kept = vec![];
        for (at, p) in polygon.iter().enumerate() {
            let q = &polygon[(at + 1) % polygon.len()];
            let (from, to) = (side(a, b, p) * sense, side(a, b, q) * sense);
            if from >= 0.0 {
                kept.push(*p);
            }
            if (from > 0.0 && to < 0.0) || (from < 0.0 && to > 0.0) {
                let t = from / (from - to);
                kept.push([p[0] + t * (q[0] - p[0]), p[1] + t * (q[1] - p[1])]);
            }
        }
        polygon = kept;
    }
    // Neighbours that share an edge alone do not carry each other.
    let area: f64 = (0..polygon.len())
        .map(|i| {
            let (p, q) = (polygon[i], polygon[(i + 1) % polygon.len()]);
            0.5 * (p[0] * q[1] - p[1] * q[0])
        })
        .sum();
    if area.abs() > 0.05 { polygon } else { vec![] }
}
