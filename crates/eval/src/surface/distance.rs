//! Exact distances to surfaces of any size.

use mb_mesh::{Bvh, Closest, KdTree, LeanBvh, TriangleMesh};
use nalgebra::Point3;
use rayon::prelude::*;

/// Larger meshes are searched with a tree that needs a quarter of the memory, and some more time.
const LARGE: usize = 8_000_000;

/// Distances below this are rounding: a sample of a triangle lies off the triangle by some 1e-16 m.
const ZERO_M: f64 = 1e-9;

/// Something that distances are measured to: the surface of a mesh, or the points of a cloud.
pub(super) enum Target<'a> {
    Surface(Bvh),
    LargeSurface(LeanBvh<'a>),
    Points { points: &'a [Point3<f64>], tree: KdTree },
}

impl<'a> Target<'a> {
    /// A mesh without triangles is a cloud of its vertices.
    pub fn new(mesh: &'a TriangleMesh) -> Self {
        if mesh.triangles.is_empty() {
            return Self::Points { points: &mesh.vertices, tree: KdTree::new(&mesh.vertices) };
        }
        if mesh.triangles.len() > LARGE {
            Self::LargeSurface(LeanBvh::new(mesh))
        } else {
            Self::Surface(Bvh::new(mesh))
        }
    }

    /// The tree for rays; `None` for clouds and very large meshes.
    pub fn bvh(&self) -> Option<&Bvh> {
        match self {
            Self::Surface(bvh) => Some(bvh),
            Self::LargeSurface(_) | Self::Points { .. } => None,
        }
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
            Self::Surface(bvh) => queries_in_parallel().map(|q| bvh.closest_within(q, max_distance_m)).collect(),
            Self::LargeSurface(bvh) => queries_in_parallel().map(|q| bvh.closest_within(q, max_distance_m)).collect(),
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
}
