//! The tree against brute force and against geometry that is known in closed form.

use mb_geometry::Ray;
use nalgebra::{Point3, Vector3};
use proptest::prelude::*;

use super::{Bvh, LeanBvh, closest_point_on_triangle};
use crate::TriangleMesh;

fn soup() -> impl Strategy<Value = TriangleMesh> {
    let corner = || prop::array::uniform3(-1.0..1.0f64);
    let triangle = (corner(), corner(), corner(), 0.001..1.0f64);
    prop::collection::vec(triangle, 1..200).prop_map(|triangles| {
        let mut vertices = Vec::new();
        for (a, b, c, size) in triangles {
            let a = Point3::from(a);
            vertices.extend([a, a + Vector3::from(b) * size, a + Vector3::from(c) * size]);
        }
        let triangles = (0..vertices.len() as u32 / 3).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        TriangleMesh::new(vertices, triangles)
    })
}

proptest! {
    #[test]
    fn closest_is_the_nearest_of_all_triangles(mesh in soup(), q in prop::array::uniform3(-2.0..2.0f64)) {
        let q = Point3::from(q);
        let found = Bvh::new(&mesh).closest(&q).unwrap();
        let brute = (0..mesh.triangles.len())
            .map(|t| (closest_point_on_triangle(&q, &mesh.triangle(t)) - q).norm())
            .fold(f64::INFINITY, f64::min);
        prop_assert!((found.distance - brute).abs() < 1e-14);
        prop_assert_eq!(LeanBvh::new(&mesh).closest_within(&q, f64::INFINITY), Some(found));
        prop_assert_eq!(LeanBvh::new(&mesh).closest_within(&q, 0.999 * found.distance), None);
        let on = closest_point_on_triangle(&found.point, &mesh.triangle(found.triangle as usize));
        prop_assert!((on - found.point).norm() < 1e-12);
    }

    /// No point of a dense grid over the triangle is nearer, and the answer is a point of the triangle.
    #[test]
    fn the_point_triangle_distance_is_a_minimum(
        corners in prop::array::uniform3(prop::array::uniform3(-1.0..1.0f64)),
        squash in prop::sample::select(vec![0.0, 1e-9, 1.0]),
        q in prop::array::uniform3(-2.0..2.0f64),
    ) {
        let mut corners = corners.map(Point3::from);
        let along = corners[1] - corners[0];
        corners[2] = corners[0] + along * 0.3 + (corners[2] - corners[0]) * squash;
        let q = Point3::from(q);
        let best = (closest_point_on_triangle(&q, &corners) - q).norm();
        let n = 40;
        let mut least = f64::INFINITY;
        for i in 0..=n {
            for j in 0..=n - i {
                let (u, v) = (i as f64 / n as f64, j as f64 / n as f64);
                let p = corners[0] + (corners[1] - corners[0]) * u + (corners[2] - corners[0]) * v;
                least = least.min((p - q).norm());
            }
        }
        let step = (0..3).map(|i| (corners[i] - corners[(i + 1) % 3]).norm()).fold(0.0, f64::max) / n as f64;
        prop_assert!(best <= least + 1e-12, "{best} is not below {least}");
        prop_assert!(best >= least - step, "{best} is no distance of the triangle, {least}");
    }

    #[test]
    fn a_ray_finds_the_first_of_all_triangles(
        mesh in soup(),
        origin in prop::array::uniform3(-2.0..2.0f64),
        target in prop::array::uniform3(-1.0..1.0f64),
    ) {
        let origin = Point3::from(origin);
        let ray = Ray { origin, direction: Point3::from(target) - origin };
        let first = (0..mesh.triangles.len())
            .filter_map(|t| {
                let single = TriangleMesh::new(mesh.triangle(t).to_vec(), vec![[0, 1, 2]]);
                Bvh::new(&single).cast(&ray, 10.0).map(|hit| hit.t)
            })
            .min_by(f64::total_cmp);
        let bvh = Bvh::new(&mesh);
        prop_assert_eq!(bvh.cast(&ray, 10.0).map(|hit| hit.t), first);
        prop_assert_eq!(bvh.occluded(&ray, 10.0), first.is_some());
        if let Some(t) = first {
            prop_assert!(!bvh.occluded(&ray, t * 0.999_999));
        }
    }
}

/// A unit square in z = 0, as a fan around a point on which several edges meet.
fn fan(n: usize) -> TriangleMesh {
    let mut vertices = vec![Point3::origin()];
    vertices.extend((0..n).map(|i| {
        let angle = std::f64::consts::TAU * i as f64 / n as f64;
        Point3::new(angle.cos(), angle.sin(), 0.0)
    }));
    let triangles = (0..n as u32).map(|i| [0, 1 + i, 1 + (i + 1) % n as u32]).collect();
    TriangleMesh::new(vertices, triangles)
}

#[test]
fn rays_through_edges_and_vertices_find_no_gap() {
    let mesh = fan(17);
    let bvh = Bvh::new(&mesh);
    for triangle in &mesh.triangles {
        for s in [0.0, 0.1, 0.25, 0.7, 0.99] {
            let rim = mesh.vertices[triangle[1] as usize];
            let origin = Point3::new(0.3, -0.2, 1.7);
            let ray = Ray { origin, direction: Point3::from(rim.coords * s) - origin };
            let hit = bvh.cast(&ray, 2.0).expect("the ray meets a shared edge");
            assert!((hit.t - 1.0).abs() < 1e-12);
        }
    }
}

#[test]
fn rays_along_box_planes_and_axes_are_not_lost() {
    let mesh = fan(8);
    let bvh = Bvh::new(&mesh);
    for x in [-0.5, 0.0, 0.5] {
        let ray = Ray { origin: Point3::new(x, 0.0, 3.0), direction: Vector3::new(0.0, -0.0, -2.0) };
        assert!((bvh.cast(&ray, 10.0).expect("a hit").t - 1.5).abs() < 1e-14);
        assert_eq!(bvh.cast(&ray, 1.4), None);
        assert!(!bvh.occluded(&Ray { direction: -ray.direction, ..ray }, 10.0));
    }
}

#[test]
fn nothing_is_near_an_empty_mesh_or_a_query_that_is_no_number() {
    let empty = Bvh::new(&TriangleMesh::default());
    assert_eq!(empty.closest(&Point3::origin()), None);
    assert_eq!(empty.cast(&Ray { origin: Point3::origin(), direction: Vector3::x() }, 1.0), None);
    let bvh = Bvh::new(&fan(5));
    assert_eq!(bvh.closest(&Point3::new(f64::NAN, 0.0, 0.0)), None);
    assert_eq!(bvh.cast(&Ray { origin: Point3::origin(), direction: Vector3::zeros() }, 1.0), None);
    assert_eq!(bvh.closest_within(&Point3::new(0.0, 0.0, 1.0), 0.5), None);
}

/// A bumpy sphere with an outlier, so that most cells are empty and some are full: the tree over cells knows the same
/// triangles as one over each tenth of them.
#[test]
fn a_tree_over_cells_finds_what_small_trees_find() {
    let n = 220;
    let vertex = |i: usize, j: usize| {
        let (theta, phi) = (std::f64::consts::PI * i as f64 / n as f64, std::f64::consts::TAU * j as f64 / n as f64);
        let radius = 1.0 + 0.1 * (7.0 * theta).sin() * (5.0 * phi).cos();
        Point3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()) * radius
    };
    let mut vertices: Vec<Point3<f64>> = (0..=n).flat_map(|i| (0..n).map(move |j| vertex(i, j))).collect();
    let at = |i: usize, j: usize| (i * n + j % n) as u32;
    let mut triangles: Vec<[u32; 3]> = (0..n)
        .flat_map(|i| {
            (0..n).flat_map(move |j| {
                [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]]
            })
        })
        .collect();
    vertices.push(Point3::new(9.0, -9.0, 9.0));
    triangles.push([0, 1, vertices.len() as u32 - 1]);
    let mesh = TriangleMesh::new(vertices, triangles);
    assert!(mesh.triangles.len() > super::build::CELLS_FROM);

    let bvh = Bvh::new(&mesh);
    let tenth = mesh.triangles.len().div_ceil(10);
    let parts: Vec<Bvh> = mesh
        .triangles
        .chunks(tenth)
        .map(|part| Bvh::new(&TriangleMesh::new(mesh.vertices.clone(), part.to_vec())))
        .collect();
    for i in 0..300 {
        let t = f64::from(i);
        let q = Point3::new((1.3 * t).sin(), (1.7 * t).cos(), (0.9 * t).sin()) * (0.01 * t);
        let whole = bvh.closest(&q).unwrap();
        let least = parts.iter().map(|part| part.closest(&q).unwrap().distance).fold(f64::INFINITY, f64::min);
        assert_eq!(whole.distance, least);
        let ray = Ray { origin: q, direction: Vector3::new((0.3 * t).cos(), (0.7 * t).sin(), 0.2) };
        let first = parts.iter().filter_map(|part| part.cast(&ray, 20.0)).map(|hit| hit.t).min_by(f64::total_cmp);
        assert_eq!(bvh.cast(&ray, 20.0).map(|hit| hit.t), first);
    }
}

#[test]
fn triangles_that_are_not_finite_are_left_out() {
    let mut mesh = fan(6);
    mesh.vertices[1].x = f64::NAN;
    let bvh = Bvh::new(&mesh);
    let found = bvh.closest(&Point3::new(-2.0, 0.0, 0.0)).unwrap();
    assert!((found.distance - 1.0).abs() < 1e-12);
}

/// Many equal triangles, and triangles whose sizes grow without bound, still give a shallow tree.
#[test]
fn hostile_distributions_do_not_overflow_the_stack() {
    let equal = TriangleMesh::new(
        vec![Point3::origin(), Point3::new(1.0, 0.0, 0.0), Point3::new(0.0, 1.0, 0.0)],
        vec![[0, 1, 2]; 5000],
    );
    let many_equal = TriangleMesh { triangles: vec![[0, 1, 2]; 70_000], ..equal.clone() };
    let mut growing = TriangleMesh::default();
    for i in 0..2000u32 {
        let s = 1.1f64.powi(i as i32 % 700) * 1e-20;
        growing.vertices.extend([Point3::new(s, 0.0, 0.0), Point3::new(s, s, 0.0), Point3::new(s, 0.0, s)]);
        growing.triangles.push([3 * i, 3 * i + 1, 3 * i + 2]);
    }
    for mesh in [equal, many_equal, growing] {
        let bvh = Bvh::new(&mesh);
        let corner = mesh.triangle(7)[0];
        assert_eq!(bvh.closest(&corner).unwrap().distance, 0.0);
        let ray = Ray { origin: Point3::new(0.25, 0.25, -1.0), direction: Vector3::z() };
        bvh.cast(&ray, f64::INFINITY);
    }
}
