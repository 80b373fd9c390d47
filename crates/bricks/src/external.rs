//! The outside of a model: what some view from outside can see.

use mb_geometry::Ray;
use mb_mesh::{Bvh, TriangleMesh};
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use serde::Serialize;

/// Directions in which every point looks for a way out, spread evenly over the sphere.
const DIRECTIONS: usize = 48;
/// Rays start this far off the surface, metres.
const LIFT_M: f64 = 1e-6;
/// Points of a triangle that look, as barycentric weights: the middle, and near the corners.
const LOOKOUTS: [[f64; 3]; 4] =
    [[1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0], [0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9]];

/// What [`external_only`] removed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ExternalSummary {
    /// Triangles before and after.
    pub triangles: usize,
    /// Triangles that are left.
    pub kept: usize,
    /// Share of the surface that was removed.
    pub removed_area: f64,
}

/// Removes the triangles that cannot be seen from outside: walls between bricks, studs inside bricks, tubes. A triangle
/// stays when from one of four points on it a straight line leads out in one of 48 directions, on either side of
/// it. Of what is seen only through gaps smaller than those samples, something may be lost.
pub fn external_only(mesh: &TriangleMesh) -> (TriangleMesh, ExternalSummary) {
    let bvh = Bvh::new(mesh);
    let directions = fibonacci_sphere(DIRECTIONS);
    let far = 2.0 * mesh.bounds().extent().norm() + 1.0;
    let keep: Vec<bool> = (0..mesh.triangles.len())
        .into_par_iter()
        .map(|index| {
            let [a, b, c] = mesh.triangle(index);
            let Some(normal) = mesh.scaled_normal(index).try_normalize(0.0) else { return false };
            LOOKOUTS.iter().any(|[u, v, w]| {
                let p = Point3::from(a.coords * *u + b.coords * *v + c.coords * *w);
                directions.iter().any(|direction| {
                    let side = normal.dot(direction).signum();
                    let origin = p + normal * (side * LIFT_M);
                    !bvh.occluded(&Ray { origin, direction: *direction }, far)
                })
            })
        })
        .collect();
    let pick = |values: &Vec<[u8; 3]>| values.iter().zip(&keep).filter(|(_, k)| **k).map(|(v, _)| *v).collect();
    let mut kept = TriangleMesh {
        vertices: mesh.vertices.clone(),
        triangles: mesh.triangles.iter().zip(&keep).filter(|(_, k)| **k).map(|(t, _)| *t).collect(),
        vertex_colors: mesh.vertex_colors.clone(),
        triangle_colors: mesh.triangle_colors.as_ref().map(pick),
        triangle_parts: mesh
            .triangle_parts
            .as_ref()
            .map(|parts| parts.iter().zip(&keep).filter(|(_, k)| **k).map(|(p, _)| *p).collect()),
    };
    drop_unused_vertices(&mut kept);
    let (before, after) = (mesh.area(), kept.area());
    let removed_area = if before > 0.0 { 1.0 - after / before } else { 0.0 };
    let summary = ExternalSummary { triangles: mesh.triangles.len(), kept: kept.triangles.len(), removed_area };
    (kept, summary)
}

fn fibonacci_sphere(count: usize) -> Vec<Vector3<f64>> {
    let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    (0..count)
        .map(|index| {
            let y = 1.0 - (2.0 * index as f64 + 1.0) / count as f64;
            let (radius, angle) = ((1.0 - y * y).sqrt(), golden * index as f64);
            Vector3::new(radius * angle.cos(), y, radius * angle.sin())
        })
        .collect()
}

fn drop_unused_vertices(mesh: &mut TriangleMesh) {
    let mut index = vec![u32::MAX; mesh.vertices.len()];
    let (mut vertices, mut colors) = (vec![], mesh.vertex_colors.as_ref().map(|_| vec![]));
    for corner in mesh.triangles.iter_mut().flatten() {
        let old = *corner as usize;
        if index[old] == u32::MAX {
            index[old] = vertices.len() as u32;
            vertices.push(mesh.vertices[old]);
            if let (Some(kept), Some(all)) = (&mut colors, &mesh.vertex_colors) {
                kept.push(all[old]);
            }
        }
        *corner = index[old];
    }
    (mesh.vertices, mesh.vertex_colors) = (vertices, colors);
}
