//! A bounding volume hierarchy over triangles: exact closest points and watertight rays.

mod build;
mod closest;
mod ray;

use mb_geometry::Ray;
use nalgebra::{Point3, Vector3};

use crate::TriangleMesh;

pub use closest::closest_point_on_triangle;

/// The point of a mesh that is closest to a query.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Closest {
    /// Index of the triangle that holds the point; the lowest of those visited that are equally near.
    pub triangle: u32,
    /// The closest point, metres, in the mesh's frame.
    pub point: Point3<f64>,
    /// Its distance from the query, metres.
    pub distance: f64,
}

/// Where a ray first meets a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Hit {
    /// Index of the triangle.
    pub triangle: u32,
    /// Ray parameter: the point is `ray.at(t)`. For rays of [`mb_geometry::Intrinsics::ray`] this is the depth.
    pub t: f64,
}

/// A binary tree of boxes over the triangles of a mesh, built with the surface area heuristic.
///
/// Boxes are `f32`, rounded outwards; the triangles are kept in `f64`, and every distance and every hit is computed
/// from them. Triangles with a corner that is not finite are left out. The tree, and so each answer, depends on the
/// mesh alone, not on the number of threads.
pub struct Bvh {
    nodes: Vec<Node>,
    root: Child,
    /// Corners in the order of the leaves.
    corners: Vec<[Point3<f64>; 3]>,
    /// The mesh's triangle index of each entry of `corners`.
    triangles: Vec<u32>,
}

/// An inner node: the boxes of both children, side by side for the processor's sake, in one cache line.
#[derive(Debug, Clone, Copy)]
#[repr(align(64))]
struct Node {
    /// `min[axis][child]`.
    min: [[f32; 2]; 3],
    /// `max[axis][child]`.
    max: [[f32; 2]; 3],
    children: [Child; 2],
}

/// A leaf: `count` entries of `corners` from `first`; or, where `count` is 0, the inner node `first`.
#[derive(Debug, Clone, Copy, Default)]
struct Child {
    first: u32,
    count: u32,
}

/// Deepest tree that the builder makes, hence the size of a traversal's stack.
const MAX_DEPTH: usize = 96;

impl Bvh {
    /// Builds the tree over all triangles of `mesh`, on all threads.
    pub fn new(mesh: &TriangleMesh) -> Self {
        build::build(mesh)
    }

    /// Whether there is no triangle to hit.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// The closest point of the surface (not of the vertices), exact to `f64` rounding. `None` for an empty mesh or a
    /// query that is not finite.
    pub fn closest(&self, query: &Point3<f64>) -> Option<Closest> {
        self.closest_within(query, f64::INFINITY)
    }

    /// Like [`Bvh::closest`], but `None` where nothing lies within `max_distance` (metres), which is then cheap.
    pub fn closest_within(&self, query: &Point3<f64>, max_distance: f64) -> Option<Closest> {
        closest::closest(self, |entry| &self.corners[entry], query, max_distance)
    }

    /// The first triangle that the ray meets at 0 <= t <= `t_max`, from either side. Rays through a shared edge or
    /// vertex hit one of its triangles, never the gap between them (Woop, Benthin, Wald 2013). Of triangles at the very
    /// same t, the lowest index wins. A triangle seen exactly edge-on is not hit.
    pub fn cast(&self, ray: &Ray, t_max: f64) -> Option<Hit> {
        ray::cast(self, ray, t_max)
    }

    /// Whether any triangle lies on the ray at 0 <= t <= `t_max`.
    pub fn occluded(&self, ray: &Ray, t_max: f64) -> bool {
        ray::occluded(self, ray, t_max)
    }
}

/// A [`Bvh`] for closest points in meshes of tens of millions of triangles: it looks the corners up in the mesh instead of
/// keeping copies of them, which takes a quarter of the memory (about 30 bytes a triangle, twice that while it is built)
/// and some more time.
pub struct LeanBvh<'a> {
    mesh: &'a TriangleMesh,
    bvh: Bvh,
}

impl<'a> LeanBvh<'a> {
    /// Builds the tree over all triangles of `mesh`, on all threads.
    pub fn new(mesh: &'a TriangleMesh) -> Self {
        Self { mesh, bvh: build::build_without_corners(mesh) }
    }

    /// As [`Bvh::closest_within`].
    pub fn closest_within(&self, query: &Point3<f64>, max_distance: f64) -> Option<Closest> {
        let corners = |entry: usize| self.mesh.triangle(self.bvh.triangles[entry] as usize);
        closest::closest(&self.bvh, corners, query, max_distance)
    }
}

fn vector(p: &Point3<f64>) -> Vector3<f64> {
    p.coords
}

#[cfg(test)]
mod tests;
