//! Random points on surfaces.

use nalgebra::Point3;
use rand::RngExt;
use rayon::prelude::*;

use crate::TriangleMesh;

/// A point on a mesh.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceSample {
    /// Position, metres, in the mesh's frame.
    pub point: Point3<f64>,
    /// Index of the triangle it lies on.
    pub triangle: u32,
}

/// Samples that one random stream makes, whatever the number of threads.
const CHUNK: usize = 4096;

/// `n` random points, uniform by area. Empty where the mesh has no area.
///
/// The area is cut into `n` equal strata in the order of the triangles, and each stratum gets one point: every triangle
/// has its share of the points to within one, and neighbours in the result are neighbours on the surface more often
/// than not. Triangles with a corner that is not finite have no area here. The same seed gives the same points.
pub fn sample_uniform(mesh: &TriangleMesh, n: usize, seed: u64) -> Vec<SurfaceSample> {
    let mut total = 0.0;
    // Running sums, one after the other: the same whatever the number of threads.
    let cumulative: Vec<f64> = (0..mesh.triangles.len())
        .map(|t| {
            let area = mesh.scaled_normal(t).norm();
            total += if area.is_finite() { area } else { 0.0 };
            total
        })
        .collect();
    if !(total.is_finite() && total > 0.0) {
        return Vec::new();
    }
    let last = cumulative.partition_point(|&sum| sum < total);
    let chunk = |index: usize| {
        let mut rng = mb_job::rng(seed, index as u64);
        let range = index * CHUNK..((index + 1) * CHUNK).min(n);
        let mut triangle = cumulative.partition_point(|&sum| sum <= total * (range.start as f64 / n as f64));
        range
            .map(|i| {
                let at = total * ((i as f64 + rng.random::<f64>()) / n as f64);
                while triangle < last && cumulative[triangle] <= at {
                    triangle += 1;
                }
                let [a, b, c] = mesh.triangle(triangle.min(last));
                // Uniform in the triangle (Osada et al. 2002, eq. 1).
                let (root, v) = (rng.random::<f64>().sqrt(), rng.random::<f64>());
                let point = a + (b - a) * (root * (1.0 - v)) + (c - a) * (root * v);
                SurfaceSample { point, triangle: triangle.min(last) as u32 }
            })
            .collect::<Vec<_>>()
    };
    let chunks: Vec<_> = (0..n.div_ceil(CHUNK)).into_par_iter().map(chunk).collect();
    chunks.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::closest_point_on_triangle;

    fn two_squares() -> TriangleMesh {
        // Areas 1 and 4, and a triangle without area between them.
        let square = |x: f64, side: f64| {
            [[x, 0., 0.], [x + side, 0., 0.], [x + side, side, 0.], [x, side, 0.]].map(Point3::from)
        };
        let vertices = square(0.0, 1.0).into_iter().chain(square(5.0, 2.0)).collect();
        TriangleMesh::new(vertices, vec![[0, 1, 2], [0, 2, 3], [1, 1, 6], [4, 5, 6], [4, 6, 7]])
    }

    #[test]
    fn triangles_get_their_share_and_samples_lie_on_them() {
        let mesh = two_squares();
        let n = 10_000;
        let samples = sample_uniform(&mesh, n, 7);
        assert_eq!(samples.len(), n);
        let mut counts = [0i64; 5];
        let mut mean = nalgebra::Vector3::zeros();
        for s in &samples {
            counts[s.triangle as usize] += 1;
            let on = closest_point_on_triangle(&s.point, &mesh.triangle(s.triangle as usize));
            assert!((on - s.point).norm() < 1e-12);
            mean += s.point.coords / n as f64;
        }
        for (count, expected) in counts.into_iter().zip([1000, 1000, 0, 4000, 4000]) {
            assert!((count - expected).abs() <= 1, "{counts:?}");
        }
        // Centre of area: (1 * 0.5 + 4 * 6) / 5; the standard error is below 0.01.
        assert!((mean.x - 4.9).abs() < 0.03 && (mean.y - 0.9).abs() < 0.03);
    }

    #[test]
    fn the_seed_decides_and_threads_do_not() {
        let mesh = two_squares();
        let threads = |n| rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        let one = threads(1).install(|| sample_uniform(&mesh, 9_999, 1));
        assert_eq!(one, threads(3).install(|| sample_uniform(&mesh, 9_999, 1)));
        assert_ne!(one, sample_uniform(&mesh, 9_999, 2));
    }

    #[test]
    fn a_mesh_without_area_has_no_samples() {
        assert!(sample_uniform(&TriangleMesh::default(), 10, 0).is_empty());
        let mut mesh = two_squares();
        mesh.triangles = vec![[0, 0, 1]];
        assert!(sample_uniform(&mesh, 10, 0).is_empty());
        mesh.vertices[0].x = f64::NAN;
        mesh.triangles = vec![[0, 1, 2]];
        assert!(sample_uniform(&mesh, 10, 0).is_empty());
    }
}
