//! CPU seconds of the queries that scoring is made of, on a bumpy sphere of 500,000 triangles.
//!
//! `cargo bench -p mb-mesh`; `peers.py` beside does the same in Open3D and scipy.

use cpu_time::ProcessTime;
use mb_mesh::{Bvh, KdTree, TriangleMesh, sample_poisson_disk, sample_uniform};
use nalgebra::{Point3, Vector3};
use rand::RngExt;
use rayon::prelude::*;

/// A sphere of 0.1 m with bumps of 4 mm: `2 n^2` triangles.
fn bumpy_sphere(n: usize) -> TriangleMesh {
    let vertex = |i: usize, j: usize| {
        let theta = std::f64::consts::PI * i as f64 / n as f64;
        let phi = std::f64::consts::TAU * j as f64 / n as f64;
        let radius = 0.1 + 0.004 * (12.0 * theta).sin() * (12.0 * phi).cos();
        Point3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()) * radius
    };
    let vertices = (0..=n).flat_map(|i| (0..n).map(move |j| vertex(i, j))).collect();
    let at = |i: usize, j: usize| (i * n + j % n) as u32;
    let quads = (0..n).flat_map(|i| (0..n).map(move |j| (i, j)));
    let triangles = quads
        .flat_map(|(i, j)| [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]])
        .collect();
    TriangleMesh::new(vertices, triangles)
}

fn timed<T>(what: &str, job: impl Fn() -> T) -> T {
    // The best of three: the machine may be busy.
    let mut best = f64::INFINITY;
    let mut result = None;
    for _ in 0..3 {
        let start = ProcessTime::now();
        result = Some(job());
        best = best.min(start.elapsed().as_secs_f64());
    }
    println!("{what:<52} {best:8.3} CPU s");
    result.expect("three runs")
}

fn main() {
    let mesh = bumpy_sphere(500);
    let n = 100_000;
    let mut rng = mb_job::rng(0, 0);
    let mut near = |mesh: &TriangleMesh, n: usize| -> Vec<Point3<f64>> {
        sample_uniform(mesh, n, 1)
            .into_iter()
            .map(|s| s.point + Vector3::from_fn(|_, _| 0.01 * (rng.random::<f64>() - 0.5)))
            .collect()
    };
    let queries = near(&mesh, n);
    println!("{} triangles, {n} points, {} threads", mesh.triangles.len(), rayon::current_num_threads());

    let bvh = timed("Bvh::new", || Bvh::new(&mesh));
    timed("Bvh::closest", || {
        queries.par_iter().map(|q| bvh.closest(q).map_or(0.0, |c| c.distance)).collect::<Vec<_>>()
    });
    timed("sample_uniform", || sample_uniform(&mesh, n, 0));
    let points = timed("sample_poisson_disk", || sample_poisson_disk(&mesh, n, 0));
    let tree = timed("KdTree::new", || KdTree::new(&points));
    timed("KdTree::nearest", || {
        queries.par_iter().map(|q| tree.nearest(q).map_or(0.0, |(_, d)| d)).collect::<Vec<_>>()
    });
    timed("KdTree::new and nearest", || {
        let tree = KdTree::new(&points);
        queries.par_iter().map(|q| tree.nearest(q).map_or(0.0, |(_, d)| d)).collect::<Vec<_>>()
    });
}
