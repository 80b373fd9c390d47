//! The model's surface: ABS plastic as it is moulded, in the triangles of an ideal drawing.
//!
//! Drawings have sharp edges, real parts have rounded ones that catch light. Each triangle knows which of its sides are
//! convex edges of its part; within the radius of the edge the normal turns over to the other side.

use glam::Vec3;
use mb_mesh::TriangleMesh;

use crate::random::{hash, unit};
use crate::stage::vec3;

/// Facets that meet at less than this angle are one curved surface: a stud has 16 facets of 22.5 degrees.
const CREASE_COS: f32 = 0.85;
/// Radius of a part's edges.
const EDGE_M: f32 = 0.000_25;
/// How far parts are turned out of the ideal by their play, radians.
const PLAY_RAD: f32 = 0.006;

/// A convex edge near a place.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Edge {
    /// How far the place is from it.
    pub distance_m: f32,
    /// Unit direction from the place across the edge, in the plane of the facet.
    pub across: Vec3,
}

/// The surface at a place of the model.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Moulded {
    /// Normal of the surface as it is moulded.
    pub normal: Vec3,
    /// The nearest convex edge within reach.
    pub edge: Option<Edge>,
}

/// What is known of each triangle of the model.
pub(crate) struct Plastic {
    corners: Vec<[Vec3; 3]>,
    normals: Vec<[Vec3; 3]>,
    /// Unit normal half-way round the edge opposite each corner, zero where that side is no convex edge.
    bisectors: Vec<[Vec3; 3]>,
    parts: Vec<u32>,
    salt: u32,
}

impl Plastic {
    pub fn new(mesh: &TriangleMesh, salt: u32) -> Self {
        let parts =
            (0..mesh.triangles.len()).map(|t| mesh.triangle_parts.as_ref().map_or(0, |parts| parts[t])).collect();
        let corners = mesh.triangles.iter().map(|t| t.map(|v| vec3(&mesh.vertices[v as usize]))).collect();
        let mut plastic = Self { corners, normals: Vec::new(), bisectors: Vec::new(), parts, salt };
        let scaled: Vec<Vec3> = (0..mesh.triangles.len())
            .map(|t| {
                let n = mesh.scaled_normal(t);
                Vec3::new((n.x * 1e6) as f32, (n.y * 1e6) as f32, (n.z * 1e6) as f32)
            })
            .collect();
        // Vertices at the same place, to 10 micrometres, are one.
        let places: Vec<[i32; 3]> =
            mesh.vertices.iter().map(|p| [p.x, p.y, p.z].map(|c| (c * 1e5).round() as i32)).collect();
        plastic.normals = plastic.corner_normals(mesh, &places, &scaled);
        plastic.bisectors = plastic.edge_bisectors(mesh, &places, &scaled);
        plastic
    }

    /// Normals at the corners of each triangle: the area-weighted mean over the facets of the same part that meet
    /// there at less than the crease angle.
    fn corner_normals(&self, mesh: &TriangleMesh, places: &[[i32; 3]], scaled: &[Vec3]) -> Vec<[Vec3; 3]> {
        let mut corners: Vec<([i32; 3], u32, u32, u8)> = Vec::with_capacity(3 * scaled.len());
        for (t, triangle) in mesh.triangles.iter().enumerate() {
            for (k, v) in triangle.iter().enumerate() {
                corners.push((places[*v as usize], self.parts[t], t as u32, k as u8));
            }
        }
        corners.sort_unstable();
        let mut normals = vec![[Vec3::ZERO; 3]; scaled.len()];
        for group in corners.chunk_by(|a, b| a.0 == b.0 && a.1 == b.1) {
            for &(_, _, t, k) in group {
                let own = scaled[t as usize].normalize_or_zero();
                let sum: Vec3 = group
                    .iter()
                    .map(|g| scaled[g.2 as usize])
                    .filter(|n| n.normalize_or_zero().dot(own) > CREASE_COS)
                    .sum();
                normals[t as usize][usize::from(k)] = sum.try_normalize().unwrap_or(own);
            }
        }
        normals
    }

    /// The normals half-way round the convex edges of each triangle.
    fn edge_bisectors(&self, mesh: &TriangleMesh, places: &[[i32; 3]], scaled: &[Vec3]) -> Vec<[Vec3; 3]> {
        // Sides with the same ends, of the same part, stand beside each other once sorted.
        type Side = ([i32; 3], [i32; 3], u32, u32, u8);
        let mut sides: Vec<Side> = Vec::with_capacity(3 * scaled.len());
        for (t, triangle) in mesh.triangles.iter().enumerate() {
            for k in 0..3 {
                let ends = [1, 2].map(|d| places[triangle[(k + d) % 3] as usize]);
                sides.push((ends[0].min(ends[1]), ends[0].max(ends[1]), self.parts[t], t as u32, k as u8));
            }
        }
        sides.sort_unstable();
        let mut bisectors = vec![[Vec3::ZERO; 3]; scaled.len()];
        for pair in sides.chunk_by(|a, b| (a.0, a.1, a.2) == (b.0, b.1, b.2)) {
            let [one, two] = pair else { continue };
            let (t, s) = (one.3 as usize, two.3 as usize);
            let (n, m) = (scaled[t].normalize_or_zero(), scaled[s].normalize_or_zero());
            // Convex where the far corner of each lies below the other's plane; drawings of either winding.
            let far = self.corners[s][usize::from(two.4)] - self.corners[t][(usize::from(one.4) + 1) % 3];
            if n.dot(m) > CREASE_COS || n.dot(far) >= 0.0 {
                continue;
            }
            let Some(bisector) = (n + m).try_normalize() else { continue };
            bisectors[t][usize::from(one.4)] = bisector;
            bisectors[s][usize::from(two.4)] = bisector;
        }
        bisectors
    }

    /// The part of a triangle.
    pub fn part(&self, triangle: usize) -> u32 {
        self.parts[triangle]
    }

    /// Normal of the ideal surface at `p` on a triangle, smooth over curved parts, towards `view`.
    pub fn normal(&self, triangle: usize, p: Vec3, view: Vec3) -> Vec3 {
        let normal = self.smooth(triangle, self.barycentric(triangle, p));
        if normal.dot(view) < 0.0 { -normal } else { normal }
    }

    fn smooth(&self, triangle: usize, weights: [f32; 3]) -> Vec3 {
        let [a, b, c] = self.normals[triangle];
        (a * weights[0] + b * weights[1] + c * weights[2]).try_normalize().unwrap_or(a)
    }

    fn barycentric(&self, triangle: usize, p: Vec3) -> [f32; 3] {
        let [a, b, c] = self.corners[triangle];
        let (e1, e2, d) = (b - a, c - a, p - a);
        let (d11, d12, d22) = (e1.dot(e1), e1.dot(e2), e2.dot(e2));
        let (d1, d2) = (d.dot(e1), d.dot(e2));
        let determinant = d11 * d22 - d12 * d12;
        if determinant <= 0.0 {
            return [1.0, 0.0, 0.0];
        }
        let v = ((d22 * d1 - d12 * d2) / determinant).clamp(0.0, 1.0);
        let w = ((d11 * d2 - d12 * d1) / determinant).clamp(0.0, 1.0 - v);
        [1.0 - v - w, v, w]
    }

    /// The surface at `p` on a triangle, its normal towards `view`. Edges narrower than a pixel (`pixel_m`) are widened
    /// to it.
    pub fn moulded(&self, triangle: usize, p: Vec3, view: Vec3, pixel_m: f32) -> Moulded {
        let weights = self.barycentric(triangle, p);
        let flat = self.smooth(triangle, weights);
        let corners = &self.corners[triangle];
        let scaled = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
        let area = scaled.length();
        let radius = EDGE_M.max(0.6 * pixel_m);
        let mut normal = flat;
        let mut edge: Option<Edge> = None;
        for k in 0..3 {
            let bisector = self.bisectors[triangle][k];
            if bisector == Vec3::ZERO {
                continue;
            }
            let side = corners[(k + 2) % 3] - corners[(k + 1) % 3];
            let length = side.length();
            let distance_m = weights[k] * area / length;
            if distance_m >= radius {
                continue;
            }
            let turned = 1.0 - distance_m / radius;
            normal += (bisector - flat) * turned;
            if edge.is_none_or(|nearest| distance_m < nearest.distance_m) {
                let across = side.cross(scaled).normalize_or_zero();
                edge = Some(Edge { distance_m, across });
            }
        }
        // The part sits a little askew.
        let own = hash(self.parts[triangle] as i32, 5, self.salt);
        let lean = Vec3::new(unit(own), unit(own ^ 0xA5A5), unit(own ^ 0x3C3C)) - 0.5;
        normal = (normal + lean * PLAY_RAD).normalize_or_zero();
        Moulded { normal: if flat.dot(view) < 0.0 { -normal } else { normal }, edge }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    /// Two squares of 1 cm that meet at a right angle along the x axis: the top y = 0 and the wall z = 0 below it.
    fn corner() -> Plastic {
        let vertices =
            [[0., 0., 0.], [0.01, 0., 0.], [0.01, 0., -0.01], [0., 0., -0.01], [0., -0.01, 0.], [0.01, -0.01, 0.]];
        let triangles = vec![[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 5, 1]];
        Plastic::new(&TriangleMesh::new(vertices.map(Point3::from).to_vec(), triangles), 1)
    }

    #[test]
    fn normals_turn_over_at_a_convex_edge_and_only_there() {
        let plastic = corner();
        let view = Vec3::new(0.1, 1.0, 1.0).normalize();
        let middle = plastic.moulded(0, Vec3::new(0.008, 0.0, -0.004), view, 1e-5);
        assert!(middle.edge.is_none() && middle.normal.dot(Vec3::Y) > 0.999);
        let near = plastic.moulded(0, Vec3::new(0.005, 0.0, -1e-5), view, 1e-5);
        let edge = near.edge.unwrap();
        assert!(near.normal.dot(Vec3::new(0.0, 1.0, 1.0).normalize()) > 0.99, "{:?}", near.normal);
        assert!((edge.distance_m - 1e-5).abs() < 1e-6 && edge.across.dot(Vec3::Z) > 0.999, "{edge:?}");
        // From below the sheet both are seen from behind.
        assert!(plastic.normal(0, Vec3::new(0.008, 0.0, -0.004), -view).dot(Vec3::Y) < -0.999);
    }

    #[test]
    fn a_concave_corner_keeps_its_crease() {
        let vertices = [[0., 0., 0.], [0.01, 0., 0.], [0.01, 0., -0.01], [0., 0.01, 0.], [0.01, 0.01, 0.]];
        let mesh = TriangleMesh::new(vertices.map(Point3::from).to_vec(), vec![[0, 1, 2], [0, 4, 1]]);
        let plastic = Plastic::new(&mesh, 1);
        let near = plastic.moulded(0, Vec3::new(0.005, 0.0, -1e-5), Vec3::Y, 1e-5);
        assert!(near.edge.is_none());
    }
}
