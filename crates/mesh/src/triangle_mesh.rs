//! The mesh type.

use mb_geometry::{Aabb, Rigid3};
use nalgebra::{Point3, Vector3};

/// An indexed triangle mesh. Triangles are counter-clockwise seen from outside. A mesh without triangles is a point
/// cloud.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TriangleMesh {
    /// `[V]` positions in metres (the mesh's owner says in which frame).
    pub vertices: Vec<Point3<f64>>,
    /// `[T]` vertex indices.
    pub triangles: Vec<[u32; 3]>,
    /// `[V]` 8-bit sRGB, where the mesh is coloured per vertex.
    pub vertex_colors: Option<Vec<[u8; 3]>>,
    /// `[T]` 8-bit sRGB, where the mesh is coloured per triangle.
    pub triangle_colors: Option<Vec<[u8; 3]>>,
    /// `[T]` index of the part instance (brick) that a triangle belongs to.
    pub triangle_parts: Option<Vec<u32>>,
}

impl TriangleMesh {
    /// A mesh of positions and triangles alone.
    pub fn new(vertices: Vec<Point3<f64>>, triangles: Vec<[u32; 3]>) -> Self {
        Self { vertices, triangles, ..Self::default() }
    }

    /// The corners of triangle `index`.
    #[inline]
    pub fn triangle(&self, index: usize) -> [Point3<f64>; 3] {
        self.triangles[index].map(|v| self.vertices[v as usize])
    }

    /// Twice the area of triangle `index` times its unit normal.
    #[inline]
    pub fn scaled_normal(&self, index: usize) -> Vector3<f64> {
        let [a, b, c] = self.triangle(index);
        (b - a).cross(&(c - a))
    }

    /// Sum of the triangles' areas, square metres.
    pub fn area(&self) -> f64 {
        (0..self.triangles.len()).map(|t| 0.5 * self.scaled_normal(t).norm()).sum()
    }

    /// The box around all vertices.
    pub fn bounds(&self) -> Aabb {
        Aabb::of(&self.vertices)
    }

    /// Keeps the vertices marked in `keep` (one entry a vertex) and the triangles whose three corners are kept; returns
    /// the number of triangles that went.
    ///
    /// # Panics
    /// Where `keep` has another length.
    pub fn retain_vertices(&mut self, keep: &[bool]) -> usize {
        assert_eq!(keep.len(), self.vertices.len(), "one mark a vertex");
        let mut next = 0;
        let new_index: Vec<u32> = keep
            .iter()
            .map(|&keep| {
                next += u32::from(keep);
                next.wrapping_sub(1)
            })
            .collect();
        retain_marked(&mut self.vertices, keep);
        if let Some(colors) = &mut self.vertex_colors {
            retain_marked(colors, keep);
        }
        let kept: Vec<bool> = self.triangles.iter().map(|t| t.iter().all(|&v| keep[v as usize])).collect();
        self.retain_triangles(&kept);
        for corner in self.triangles.as_flattened_mut() {
            *corner = new_index[*corner as usize];
        }
        kept.iter().filter(|kept| !**kept).count()
    }

    /// Keeps the triangles marked in `keep` (one entry a triangle), and every vertex.
    ///
    /// # Panics
    /// Where `keep` has another length.
    pub fn retain_triangles(&mut self, keep: &[bool]) {
        assert_eq!(keep.len(), self.triangles.len(), "one mark a triangle");
        retain_marked(&mut self.triangles, keep);
        if let Some(colors) = &mut self.triangle_colors {
            retain_marked(colors, keep);
        }
        if let Some(parts) = &mut self.triangle_parts {
            retain_marked(parts, keep);
        }
    }

    /// The same mesh in another frame.
    #[must_use]
    pub fn transformed<To, From>(mut self, to_from_from: &Rigid3<To, From>) -> Self {
        for v in &mut self.vertices {
            *v = *to_from_from * *v;
        }
        self
    }
}

fn retain_marked<T>(items: &mut Vec<T>, keep: &[bool]) {
    let mut marks = keep.iter();
    items.retain(|_| *marks.next().expect("one mark an item"));
}
