//! CPU seconds of one frame of 1440x1920 of a model of 500,000 triangles.
//!
//! `cargo bench -p mb-render`; `embree.py` beside does the same with Open3D's ray casting.

use cpu_time::ProcessTime;
use mb_geometry::{ImageSize, Intrinsics, Object, Rigid3};
use mb_mesh::TriangleMesh;
use mb_render::{Scene, View};
use nalgebra::{Point3, Vector3};

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
    // The best of several: the machine may be busy.
    let mut best = f64::INFINITY;
    let mut result = None;
    for _ in 0..10 {
        let start = ProcessTime::now();
        result = Some(job());
        best = best.min(start.elapsed().as_secs_f64());
    }
    println!("{what:<52} {best:8.4} CPU s");
    result.expect("ten runs")
}

fn main() {
    let mesh = bumpy_sphere(500);
    let view = View {
        intrinsics: Intrinsics { fx: 1460.0, fy: 1460.0, cx: 719.5, cy: 959.5 },
        size: ImageSize::new(1440, 1920),
        cam_from_frame: Rigid3::<_, Object>::from_translation(Vector3::new(0.0, 0.0, 0.3)),
    };
    println!("{} triangles, {}, {} threads", mesh.triangles.len(), view.size, rayon::current_num_threads());
    let scene = timed("Scene::new", || Scene::new(&mesh));
    let depth = timed("Scene::depth", || scene.depth(&view));
    timed("Scene::render", || scene.render(&view));
    let seen = depth.data().iter().filter(|&&z| z > 0.0).count();
    println!("{seen} pixels see the model");
}
