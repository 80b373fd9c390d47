//! Exact distances to surfaces of any size.

use mb_mesh::{Bvh, Closest, KdTree, TriangleMesh};
use nalgebra::Point3;
use rayon::prelude::*;

/// Triangles per search tree. Larger meshes are searched piece by piece, so that memory stays near 200 bytes times this
/// beside the mesh itself.
const PIECE: usize = 8_000_000;

/// Distances below this are rounding: a sample of a triangle lies off the triangle by some 1e-16 m.
const ZERO_M: f64 = 1e-9;

/// Something that distances are measured to: the surface of a mesh, or the points of a cloud.
pub(super) enum Target<'a> {
    Surface {
        mesh: &'a TriangleMesh,
        /// The tree, where one is enough.
        whole: Option<Bvh>,
    },
    Points {
        points: &'a [Point3<f64>],
        tree: KdTree,
    },
}

impl<'a> Target<'a> {
    /// A mesh without triangles is a cloud of its vertices.
    pub fn new(mesh: &'a TriangleMesh) -> Self {
        if mesh.triangles.is_empty() {
            return Self::Points { points: &mesh.vertices, tree: KdTree::new(&mesh.vertices) };
        }
        let whole = (mesh.triangles.len() <= PIECE).then(|| Bvh::new(mesh));
        Self::Surface { mesh, whole }
    }

    /// The closest point to each query, and its triangle (for a cloud: its point's index). `None` where nothing lies
    /// within `max_distance_m`.
    pub fn closest(&self, queries: &[Point3<f64>], max_distance_m: f64) -> Vec<Option<Closest>> {
        let queries_in_parallel = || queries.par_iter().with_min_len(64);
        match self {
            Self::Points { points, tree } => queries_in_parallel()
                .map(|q| {
                    let (index, distance) = tree.nearest_within(q, max_distance_m)?;
                    Some(Closest { triangle: index as u32, point: points[index], distance })
                })
                .collect(),
            Self::Surface { whole: Some(bvh), .. } => {
                queries_in_parallel().map(|q| bvh.closest_within(q, max_distance_m)).collect()
            }
            Self::Surface { mesh, whole: None } => {
                let mut best: Vec<Option<Closest>> = vec![None; queries.len()];
                for first in (0..mesh.triangles.len()).step_by(PIECE) {
                    let last = (first + PIECE).min(mesh.triangles.len());
                    let bvh = Bvh::new(&piece(mesh, first..last));
                    best.par_iter_mut().with_min_len(64).zip(queries).for_each(|(best, q)| {
                        let limit = best.map_or(max_distance_m, |b| b.distance);
                        if let Some(found) = bvh.closest_within(q, limit)
                            && best.is_none_or(|b| found.distance < b.distance)
                        {
                            *best = Some(Closest { triangle: found.triangle + first as u32, ..found });
                        }
                    });
                }
                best
            }
        }
    }

    /// The distance of each query, metres.
    pub fn distances_m(&self, queries: &[Point3<f64>]) -> Vec<f64> {
        self.closest(queries, f64::INFINITY).into_iter().map(|c| distance_m(c.as_ref())).collect()
    }
}

/// A closest point's distance with rounding taken off; infinite where there is none.
pub(super) fn distance_m(closest: Option<&Closest>) -> f64 {
    match closest {
        Some(closest) if closest.distance < ZERO_M => 0.0,
        Some(closest) => closest.distance,
        None => f64::INFINITY,
    }
}

/// Some triangles of a mesh, with only the vertices that they use.
fn piece(mesh: &TriangleMesh, range: std::ops::Range<usize>) -> TriangleMesh {
    const UNUSED: u32 = u32::MAX;
    let mut new_index = vec![UNUSED; mesh.vertices.len()];
    let mut vertices = Vec::new();
    let triangles = mesh.triangles[range]
        .iter()
        .map(|t| {
            t.map(|v| {
                let index = &mut new_index[v as usize];
                if *index == UNUSED {
                    *index = vertices.len() as u32;
                    vertices.push(mesh.vertices[v as usize]);
                }
                *index
            })
        })
        .collect();
    TriangleMesh::new(vertices, triangles)
}

/// Distance in metres of each point from the surface of `mesh` (from its vertices, where it has no triangles); infinite
/// where the mesh is empty or the point is not finite.
pub fn distances_to_surface_m(points: &[Point3<f64>], mesh: &TriangleMesh) -> Vec<f64> {
    Target::new(mesh).distances_m(points)
}

/// `[V]` distance in millimetres of each vertex of `from` from the surface of `to`, for heat maps: the prediction
/// against the truth shows what is wrong, the truth against the prediction what is missing.
pub fn vertex_distances_mm(from: &TriangleMesh, to: &TriangleMesh) -> Vec<f32> {
    distances_to_surface_m(&from.vertices, to).into_iter().map(|d| (1000.0 * d) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square_at(z: f64) -> TriangleMesh {
        let corners = [[0., 0., z], [1., 0., z], [1., 1., z], [0., 1., z]].map(Point3::from);
        TriangleMesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]])
    }

    #[test]
    fn heat_maps_measure_to_the_surface_not_to_its_vertices() {
        let mut small = square_at(0.003);
        small.vertices.iter_mut().for_each(|v| v.coords *= 0.5);
        for (found, expected) in vertex_distances_mm(&small, &square_at(0.0)).into_iter().zip([1.5; 4]) {
            assert!((found - expected).abs() < 1e-5, "{found}");
        }
        let cloud = TriangleMesh::new(vec![Point3::new(0.0, 0.0, 1.0)], vec![]);
        assert_eq!(vertex_distances_mm(&square_at(0.0), &cloud)[0], 1000.0);
        assert!(vertex_distances_mm(&cloud, &TriangleMesh::default())[0].is_infinite());
    }

    #[test]
    fn a_piece_holds_its_triangles() {
        let mesh = square_at(0.0);
        let second = piece(&mesh, 1..2);
        assert_eq!(second.triangle(0), mesh.triangle(1));
        assert_eq!(second.vertices.len(), 3);
    }
}
