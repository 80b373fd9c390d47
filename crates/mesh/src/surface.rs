//! Operations on whole surfaces: normals, pieces, welding, clipping.

use std::collections::HashMap;

use nalgebra::{Point3, Vector3};

use crate::TriangleMesh;

impl TriangleMesh {
    /// `[V]` unit normals, the mean of the triangles around each vertex weighted by area; zero where there is none.
    pub fn vertex_normals(&self) -> Vec<Vector3<f64>> {
        let mut normals = vec![Vector3::zeros(); self.vertices.len()];
        for (index, triangle) in self.triangles.iter().enumerate() {
            let normal = self.scaled_normal(index);
            for &v in triangle {
                normals[v as usize] += normal;
            }
        }
        normals.iter().map(|n| n.try_normalize(0.0).unwrap_or_default()).collect()
    }

    /// `[T]` number of the connected piece of each triangle, and how many there are. Triangles that share a vertex
    /// belong together; pieces are numbered in the order of their first triangle.
    pub fn connected_components(&self) -> (Vec<u32>, usize) {
        let mut parent: Vec<u32> = (0..self.vertices.len() as u32).collect();
        fn root(parent: &mut [u32], mut v: u32) -> u32 {
            while parent[v as usize] != v {
                parent[v as usize] = parent[parent[v as usize] as usize];
                v = parent[v as usize];
            }
            v
        }
        for &[a, b, c] in &self.triangles {
            for other in [b, c] {
                let (a, other) = (root(&mut parent, a), root(&mut parent, other));
                parent[a.max(other) as usize] = a.min(other);
            }
        }
        let mut number_of_root = vec![u32::MAX; self.vertices.len()];
        let mut count = 0;
        let numbers = self
            .triangles
            .iter()
            .map(|&[a, ..]| {
                let number = &mut number_of_root[root(&mut parent, a) as usize];
                if *number == u32::MAX {
                    *number = count;
                    count += 1;
                }
                *number
            })
            .collect();
        (numbers, count as usize)
    }

    /// The same surface with vertices joined that lie at the same place, to within `tolerance` (metres, above 0) of the
    /// first of them. Vertex colours are those of the first. Triangles that lose a corner are kept: they have no area.
    #[must_use]
    pub fn welded(&self, tolerance: f64) -> Self {
        let cell = |p: &Point3<f64>| p.coords.map(|v| (v / tolerance).floor() as i64);
        let mut kept: HashMap<Vector3<i64>, Vec<u32>> = HashMap::new();
        let mut welded = Self { vertex_colors: self.vertex_colors.as_ref().map(|_| Vec::new()), ..self.clone() };
        welded.vertices.clear();
        let mut new_index = Vec::with_capacity(self.vertices.len());
        for (index, p) in self.vertices.iter().enumerate() {
            let home = cell(p);
            let near = (0..27).find_map(|i| {
                let step = Vector3::new(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1);
                let cell = home.zip_map(&step, i64::saturating_add);
                let found = kept.get(&cell)?.iter().find(|&&v| (welded.vertices[v as usize] - p).norm() <= tolerance);
                found.copied()
            });
            new_index.push(near.unwrap_or_else(|| {
                let new = welded.vertices.len() as u32;
                welded.vertices.push(*p);
                if let (Some(to), Some(from)) = (&mut welded.vertex_colors, &self.vertex_colors) {
                    to.push(from[index]);
                }
                kept.entry(home).or_default().push(new);
                new
            }));
        }
        for corner in welded.triangles.as_flattened_mut() {
            *corner = new_index[*corner as usize];
        }
        welded
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn two_squares() -> TriangleMesh {
        let vertices =
            [[0., 0., 0.], [1., 0., 0.], [1., 1., 0.], [0., 1., 0.], [5., 0., 0.], [6., 0., 0.], [5., 0., -1.]];
        TriangleMesh::new(vertices.map(Point3::from).to_vec(), vec![[4, 5, 6], [0, 1, 2], [0, 2, 3]])
    }

    #[test]
    fn normals_point_out_of_the_surface() {
        let normals = two_squares().vertex_normals();
        assert_eq!(normals[0], Vector3::z());
        assert_eq!(normals[5], Vector3::y());
    }

    #[test]
    fn pieces_are_told_apart() {
        assert_eq!(two_squares().connected_components(), (vec![0, 1, 1], 2));
        assert_eq!(TriangleMesh::default().connected_components(), (vec![], 0));
    }

    #[test]
    fn welding_joins_a_soup() {
        let mesh = two_squares();
        let mut soup = TriangleMesh::default();
        for t in 0..mesh.triangles.len() {
            let first = soup.vertices.len() as u32;
            // Corners are off by less than the tolerance, on both sides of a cell's border.
            soup.vertices.extend(mesh.triangle(t).map(|p| p + Vector3::repeat(1e-7 * (t as f64 - 1.0))));
            soup.triangles.push([first, first + 1, first + 2]);
        }
        let welded = soup.welded(1e-6);
        assert_eq!(welded.vertices.len(), 7);
        assert_eq!(welded.connected_components().1, 2);
        assert_eq!(soup.connected_components().1, 3);
    }
}
