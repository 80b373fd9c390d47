//! The exact surface that some camera saw.
//!
//! Each triangle is cut into pieces no longer than a given edge. A piece counts as seen when, in some frame, its centroid
//! falls into the image and the straight line from there to the camera meets nothing. Triangles whose pieces were
//! all seen come out whole, so the surface stays exact and small.

use mb_geometry::{Ray, World};
use mb_image::DepthImage;
use mb_mesh::{Bvh, TriangleMesh};
use mb_render::View;
use nalgebra::{Point3, center};
use rayon::prelude::*;

/// The line of sight starts this far in front of the surface, metres: touching walls of two bricks coincide, and a point
/// between them is hidden by the other brick, not by its own twin.
const LIFT_M: f64 = 10e-6;

/// A point this far behind every neighbouring pixel's surface is hidden without tracing a ray, metres.
const CLEARLY_BEHIND_M: f32 = 1e-3;

/// A part of a triangle.
#[derive(Clone, Copy)]
struct Piece {
    triangle: u32,
    corners: [Point3<f64>; 3],
}

impl Piece {
    fn centroid(&self) -> Point3<f64> {
        let [a, b, c] = self.corners;
        Point3::from((a.coords + b.coords + c.coords) / 3.0)
    }
}

/// Collects what the frames see.
pub(crate) struct VisibleSurface<'a> {
    mesh: &'a TriangleMesh,
    bvh: Bvh,
    /// Pieces that no frame has seen yet.
    unseen: Vec<Piece>,
    seen: Vec<Piece>,
}

impl<'a> VisibleSurface<'a> {
    /// Nothing seen yet. Pieces have no edge above `max_edge_m`.
    pub fn new(mesh: &'a TriangleMesh, max_edge_m: f64) -> Self {
        let unseen = (0..mesh.triangles.len())
            .into_par_iter()
            .flat_map_iter(|t| {
                let mut pieces = Vec::new();
                cut(Piece { triangle: t as u32, corners: mesh.triangle(t) }, max_edge_m, &mut pieces);
                pieces
            })
            .collect();
        Self { mesh, bvh: Bvh::new(mesh), unseen, seen: Vec::new() }
    }

    /// Adds what one frame sees; `depth` is its exact depth.
    pub fn observe(&mut self, depth: &DepthImage, view: &View<World>) {
        let cam_in_world = Point3::from(view.cam_from_frame.inverse().translation());
        let bvh = &self.bvh;
        let (seen, unseen): (Vec<Piece>, Vec<Piece>) =
            self.unseen.par_iter().partition(|piece| sees(bvh, &cam_in_world, &piece.centroid(), depth, view));
        self.seen.extend(seen);
        self.unseen = unseen;
    }

    /// The seen surface with the mesh's colours and parts, in the order of its triangles.
    pub fn into_mesh(mut self) -> TriangleMesh {
        self.seen.sort_by_key(|p| p.triangle);
        let mut partly = vec![false; self.mesh.triangles.len()];
        for piece in &self.unseen {
            partly[piece.triangle as usize] = true;
        }
        let mut out = TriangleMesh::default();
        // Vertices of whole triangles are shared as in the model.
        let mut new_index = vec![u32::MAX; self.mesh.vertices.len()];
        let mut sources = Vec::new();
        let mut last_whole = None;
        for piece in &self.seen {
            if partly[piece.triangle as usize] {
                let first = out.vertices.len() as u32;
                out.vertices.extend(piece.corners);
                out.triangles.push([first, first + 1, first + 2]);
            } else if last_whole == Some(piece.triangle) {
                continue;
            } else {
                last_whole = Some(piece.triangle);
                out.triangles.push(self.mesh.triangles[piece.triangle as usize].map(|v| {
                    let index = &mut new_index[v as usize];
                    if *index == u32::MAX {
                        *index = out.vertices.len() as u32;
                        out.vertices.push(self.mesh.vertices[v as usize]);
                    }
                    *index
                }));
            }
            sources.push(piece.triangle as usize);
        }
        out.triangle_colors = self.mesh.triangle_colors.as_ref().map(|c| sources.iter().map(|&t| c[t]).collect());
        out.triangle_parts = self.mesh.triangle_parts.as_ref().map(|p| sources.iter().map(|&t| p[t]).collect());
        out
    }
}

/// Cuts at the middle of the longest edge until none is above `max_edge_m`. An edge is cut at the same place from both
/// of its triangles. Triangles that are not finite or have no area have no surface to see.
fn cut(piece: Piece, max_edge_m: f64, pieces: &mut Vec<Piece>) {
    let [a, b, c] = piece.corners;
    let lengths = [(b - a).norm(), (c - b).norm(), (a - c).norm()];
    let longest = (0..3).max_by(|&i, &j| lengths[i].total_cmp(&lengths[j])).unwrap_or(0);
    let area = (b - a).cross(&(c - a)).norm();
    if !area.is_finite() || area == 0.0 {
        return;
    }
    if lengths[longest] <= max_edge_m {
        pieces.push(piece);
        return;
    }
    let [from, to, apex] = [[a, b, c], [b, c, a], [c, a, b]][longest];
    let middle = center(&from, &to);
    // A middle that rounds to an end would go on for ever.
    if middle == from || middle == to {
        pieces.push(piece);
        return;
    }
    cut(Piece { corners: [from, middle, apex], ..piece }, max_edge_m, pieces);
    cut(Piece { corners: [middle, to, apex], ..piece }, max_edge_m, pieces);
}

fn sees(
    bvh: &Bvh,
    cam_in_world: &Point3<f64>,
    p_in_world: &Point3<f64>,
    depth: &DepthImage,
    view: &View<World>,
) -> bool {
    let p_in_cam = view.cam_from_frame * *p_in_world;
    let Some(pixel) = view.intrinsics.img_from_cam(&p_in_cam) else { return false };
    let (u, v) = (pixel.x + 0.5, pixel.y + 0.5);
    if !(u >= 0.0 && u < view.size.width as f64 && v >= 0.0 && v < view.size.height as f64) {
        return false;
    }
    // Cheap first: the farthest surface among the neighbouring pixels; no surface is infinitely far.
    let (u, v) = (u as usize, v as usize);
    let rows = v.saturating_sub(1)..(v + 2).min(view.size.height);
    let columns = u.saturating_sub(1)..(u + 2).min(view.size.width);
    let farthest = rows.flat_map(|y| depth.row(y)[columns.clone()].iter());
    let farthest = farthest.map(|&z| if z > 0.0 { z } else { f32::INFINITY }).fold(0.0, f32::max);
    if p_in_cam.z as f32 > farthest + CLEARLY_BEHIND_M {
        return false;
    }
    let to_camera = cam_in_world - p_in_world;
    let distance = to_camera.norm();
    let ray = Ray { origin: p_in_world + to_camera * (LIFT_M / distance), direction: to_camera };
    !bvh.occluded(&ray, 1.0 - LIFT_M / distance)
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::{ImageSize, Intrinsics, Rigid3};

    fn square(side: f64, z: f64) -> TriangleMesh {
        let h = side / 2.0;
        let corners = [[-h, -h, z], [-h, h, z], [h, h, z], [h, -h, z]].map(Point3::from);
        TriangleMesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]])
    }

    fn joined(a: &TriangleMesh, b: &TriangleMesh) -> TriangleMesh {
        let shift = a.vertices.len() as u32;
        let vertices = a.vertices.iter().chain(&b.vertices).copied().collect();
        let triangles = a.triangles.iter().copied().chain(b.triangles.iter().map(|t| t.map(|v| v + shift))).collect();
        TriangleMesh::new(vertices, triangles)
    }

    fn seen_by_one_camera(mesh: &TriangleMesh) -> TriangleMesh {
        let view = View {
            intrinsics: Intrinsics { fx: 500.0, fy: 500.0, cx: 319.5, cy: 239.5 },
            size: ImageSize::new(640, 480),
            cam_from_frame: Rigid3::<_, World>::identity(),
        };
        let mut surface = VisibleSurface::new(mesh, 0.002);
        let depth = mb_render::Scene::new(mesh).depth(&view);
        surface.observe(&depth, &view);
        surface.into_mesh()
    }

    #[test]
    fn what_nothing_hides_comes_out_whole() {
        let wall = square(0.1, 0.5);
        assert_eq!(seen_by_one_camera(&wall), wall);
    }

    #[test]
    fn a_shadow_has_the_area_of_the_pinhole_projection() {
        // A 4 cm square at 0.4 m hides a 5 cm square of the wall at 0.5 m.
        let mesh = joined(&square(0.04, 0.4), &square(0.1, 0.5));
        let seen = seen_by_one_camera(&mesh);
        let wall: f64 = (0..seen.triangles.len())
            .filter(|&t| seen.triangle(t)[0].z > 0.45)
            .map(|t| 0.5 * seen.scaled_normal(t).norm())
            .sum();
        assert!((wall - (0.1f64.powi(2) - 0.05f64.powi(2))).abs() < 1.5e-4, "{wall} m2");
    }

    #[test]
    fn walls_that_touch_are_not_seen_through_each_other() {
        // Two boxes side by side, seen from the front: their touching sides are hidden, although they coincide.
        let side = |x: f64, flip: bool| {
            let c = [[x, -0.02, 0.40], [x, 0.02, 0.40], [x, 0.02, 0.44], [x, -0.02, 0.44]].map(Point3::from);
            TriangleMesh::new(c.to_vec(), if flip { vec![[0, 2, 1], [0, 3, 2]] } else { vec![[0, 1, 2], [0, 2, 3]] })
        };
        let mesh = joined(&joined(&square(0.08, 0.40), &side(0.01, false)), &side(0.01, true));
        let seen = seen_by_one_camera(&mesh);
        assert_eq!(seen.triangles.len(), 2, "only the front is seen");
    }
}
