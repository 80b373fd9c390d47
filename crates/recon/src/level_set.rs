//! Marching cubes on a dense grid of numbers.

use mb_mesh::TriangleMesh;
use nalgebra::Point3;

use crate::cube_table::CubeTable;

/// Vertices keep this share of an edge between themselves and its ends, so that no triangle collapses where a grid
/// point lies exactly on the surface.
const CLEAR_OF_CORNERS: f64 = 1e-3;
const NONE: u32 = u32::MAX;

/// The surface where `values` is zero: `size` grid points along x, y and z (x fastest), negative inside. Vertices are in
/// grid coordinates (the first point is the origin, the spacing 1) and shared between cells; triangles are
/// counter-clockwise seen from outside. Cells with a corner that is NaN have no surface. The surface is open where it
/// leaves the grid.
///
/// # Panics
/// `values` does not have the product of `size` numbers, or the surface has more than 2^32 - 1 vertices.
pub fn level_set_mesh(size: [usize; 3], values: &[f32]) -> TriangleMesh {
    let [nx, ny, nz] = size;
    assert_eq!(values.len(), nx * ny * nz, "one number for each grid point");
    let mut mesh = TriangleMesh::default();
    if size.iter().any(|n| *n < 2) {
        return mesh;
    }
    let table = CubeTable::new();
    let at = |p: [usize; 3]| values[(p[2] * ny + p[1]) * nx + p[0]];
    // Vertices on the edges that start in the lower and upper layer of the current cells, three axes a grid point.
    let mut layers = [vec![NONE; 3 * nx * ny], vec![NONE; 3 * nx * ny]];
    for z in 0..nz - 1 {
        for y in 0..ny - 1 {
            for x in 0..nx - 1 {
                let corners: [f32; 8] = std::array::from_fn(|c| at([x + (c & 1), y + (c >> 1 & 1), z + (c >> 2)]));
                if corners.iter().any(|v| v.is_nan()) {
                    continue;
                }
                let inside = (0..8).fold(0u8, |bits, c| bits | u8::from(corners[c] < 0.0) << c);
                for triangle in table.triangles(inside) {
                    let triangle = triangle.map(|edge| {
                        let (corner, axis) = (edge.corner as usize, edge.axis as usize);
                        let start = [x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2)];
                        let slot = &mut layers[corner >> 2][3 * (start[1] * nx + start[0]) + axis];
                        if *slot == NONE {
                            let (a, b) = (f64::from(corners[corner]), f64::from(corners[corner | 1 << axis]));
                            let t = (a / (a - b)).clamp(CLEAR_OF_CORNERS, 1.0 - CLEAR_OF_CORNERS);
                            let mut p = Point3::new(start[0] as f64, start[1] as f64, start[2] as f64);
                            p[axis] += t;
                            *slot = u32::try_from(mesh.vertices.len()).expect("fewer than 2^32 vertices");
                            mesh.vertices.push(p);
                        }
                        *slot
                    });
                    mesh.triangles.push(triangle);
                }
            }
        }
        layers.swap(0, 1);
        layers[1].fill(NONE);
    }
    mesh
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    fn ball(n: usize, radius: f32) -> Vec<f32> {
        let c = (n as f32 - 1.0) * 0.5;
        (0..n * n * n)
            .map(|i| {
                let d = [i % n, i / n % n, i / (n * n)].map(|v| (v as f32 - c).powi(2));
                (d[0] + d[1] + d[2]).sqrt() - radius
            })
            .collect()
    }

    #[test]
    fn a_ball_comes_back_closed_with_its_volume_and_outward_faces() {
        let mesh = level_set_mesh([24; 3], &ball(24, 9.3));
        let mut edges = BTreeMap::new();
        for [a, b, c] in &mesh.triangles {
            for edge in [(a, b), (b, c), (c, a)] {
                *edges.entry(edge).or_insert(0) += 1;
            }
        }
        assert!(edges.iter().all(|(&(a, b), n)| *n == 1 && edges.get(&(b, a)) == Some(&1)), "not a closed manifold");
        let volume: f64 = mesh
            .triangles
            .iter()
            .map(|t| {
                let [a, b, c] = t.map(|v| mesh.vertices[v as usize].coords);
                a.dot(&b.cross(&c)) / 6.0
            })
            .sum();
        let expected = 4.0 / 3.0 * std::f64::consts::PI * 9.3f64.powi(3);
        assert!((volume / expected - 1.0).abs() < 0.01, "{volume} is not {expected}");
    }

    #[test]
    fn unknown_points_open_a_hole_and_thin_grids_are_empty() {
        let mut values = ball(24, 9.3);
        let closed = level_set_mesh([24; 3], &values).triangles.len();
        values[(12 * 24 + 12) * 24 + 2] = f32::NAN;
        let open = level_set_mesh([24; 3], &values).triangles.len();
        assert!(0 < open && open < closed);
        assert!(level_set_mesh([1, 4, 4], &[0.0; 16]).triangles.is_empty());
    }
}
