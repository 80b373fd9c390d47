//! The rasteriser against the ray caster: at most 1e-6 m apart, except within 1e-3 px of a silhouette.

use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Rigid3};
use mb_mesh::{Bvh, TriangleMesh};
use mb_render::{NO_TRIANGLE, Raster, Scene, View, ray_cast};
use nalgebra::{Point2, Point3, Vector3, Vector6};
use proptest::prelude::*;
use proptest::strategy::ValueTree;

type ObjectView = View<Object>;

const SIZE: ImageSize = ImageSize::new(101, 77);

fn view(twist: [f64; 6]) -> ObjectView {
    View {
        intrinsics: Intrinsics { fx: 80.0, fy: 82.0, cx: 49.3, cy: 38.1 },
        size: SIZE,
        cam_from_frame: Rigid3::<Camera, Camera>::from_translation(Vector3::new(0.0, 0.0, 1.0))
            * Rigid3::exp(&Vector6::from(twist)),
    }
}

/// Pixels where the two disagree by more than 1e-6 m and no ray within 1e-3 px explains the rasteriser's answer.
fn unexplained(mesh: &TriangleMesh, view: &ObjectView) -> Vec<(usize, usize, f32, f32)> {
    let bvh = Bvh::new(mesh);
    let fast = Scene::new(mesh).render(view);
    let slow = ray_cast(&bvh, view);
    check_consistency(mesh, view, &fast);
    let frame_from_cam = view.cam_from_frame.inverse();
    let mut found = Vec::new();
    for y in 0..view.size.height {
        for x in 0..view.size.width {
            let (a, b) = (fast.depth[(x, y)], slow.depth[(x, y)]);
            let near = |z: f32| (a - z).abs() <= 1e-6 + z * 1e-6;
            let explained = near(b)
                || [(1., 0.), (-1., 0.), (0., 1.), (0., -1.), (0.7, 0.7), (-0.7, 0.7), (0.7, -0.7), (-0.7, -0.7)]
                    .into_iter()
                    .any(|(dx, dy)| {
                        let pixel = Point2::new(x as f64 + 1e-3 * dx, y as f64 + 1e-3 * dy);
                        let hit = bvh.cast(&view.intrinsics.ray(&pixel, &frame_from_cam), f64::INFINITY);
                        // A steep surface moves in depth within 1e-3 px: allow what it moves.
                        hit.map_or(a == 0.0, |hit| near(hit.t as f32) || (fast.triangle[(x, y)] == hit.triangle))
                    });
            if !explained {
                found.push((x, y, a, b));
            }
        }
    }
    found
}

/// A pixel's triangle is met by the pixel's ray at the pixel's depth.
fn check_consistency(mesh: &TriangleMesh, view: &ObjectView, raster: &Raster) {
    for y in 0..view.size.height {
        for x in 0..view.size.width {
            let (z, triangle) = (raster.depth[(x, y)], raster.triangle[(x, y)]);
            assert_eq!(z > 0.0, triangle != NO_TRIANGLE);
            if z > 0.0 {
                let corners = mesh.triangle(triangle as usize);
                let p = view.ray(x, y).at(f64::from(z));
                let away = (mb_mesh::closest_point_on_triangle(&p, &corners) - p).norm();
                assert!(away < 1e-6 * (1.0 + f64::from(z)), "({x}, {y}) is {away} m off its triangle");
            }
        }
    }
}

fn soup(size: impl Strategy<Value = f64>, thin: bool) -> impl Strategy<Value = TriangleMesh> {
    let coordinate = || prop::array::uniform3(-1.0..1.0f64);
    let triangle = (coordinate(), coordinate(), coordinate(), size);
    prop::collection::vec(triangle, 1..60).prop_map(move |triangles| {
        let mut vertices = Vec::new();
        for (a, b, c, size) in triangles {
            let (a, b, mut c) = (Point3::from(a) * 0.6, Vector3::from(b) * size, Vector3::from(c) * size);
            if thin {
                c = b * 0.6 + c * 1e-5;
            }
            vertices.extend([a, a + b, a + c]);
        }
        let triangles = (0..vertices.len() as u32 / 3).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect();
        TriangleMesh::new(vertices, triangles)
    })
}

fn twist() -> impl Strategy<Value = [f64; 6]> {
    prop::array::uniform6(-0.6..0.6f64)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// Many of these cross the camera's plane: it lies 1 m from the middle of triangles up to 3 m large.
    #[test]
    fn random_triangles_of_any_size(
        mesh in soup(prop::sample::select(vec![1e-4, 1e-2, 0.3, 3.0, 1000.0]), false),
        twist in twist(),
    ) {
        prop_assert_eq!(unexplained(&mesh, &view(twist)), vec![]);
    }

    #[test]
    fn slivers(mesh in soup(prop::sample::select(vec![0.05, 1.0]), true), twist in twist()) {
        prop_assert_eq!(unexplained(&mesh, &view(twist)), vec![]);
    }

    /// A surface without holes has no holes in its image, wherever its edges run.
    #[test]
    fn shared_edges_leave_no_cracks(seed in 0u64..1000, rows in 2usize..30, turn in -0.5..0.5f64) {
        use rand::RngExt;
        let mut rng = mb_job::rng(seed, 0);
        let n = rows;
        let vertices = (0..=n).flat_map(|i| (0..=n).map(move |j| (i, j))).map(|(i, j)| {
            Point3::new(4.0 * i as f64 / n as f64 - 2.0, 4.0 * j as f64 / n as f64 - 2.0, 0.2 * rng.random::<f64>())
        }).collect();
        let at = |i: usize, j: usize| (i * (n + 1) + j) as u32;
        let triangles = (0..n).flat_map(|i| (0..n).map(move |j| (i, j))).flat_map(|(i, j)| {
            [[at(i, j), at(i + 1, j), at(i + 1, j + 1)], [at(i, j), at(i + 1, j + 1), at(i, j + 1)]]
        }).collect();
        let mesh = TriangleMesh::new(vertices, triangles);
        let raster = Scene::new(&mesh).render(&view([0.0, 0.0, turn, 0.0, 0.0, 0.0]));
        prop_assert!(raster.mask().data().iter().all(|&seen| seen));
    }
}

/// Edges right through pixel centres: every pixel belongs to exactly one of two triangles.
#[test]
fn a_pixel_centre_on_a_shared_edge_is_seen_once() {
    let view: ObjectView = View {
        intrinsics: Intrinsics { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 },
        size: ImageSize::new(9, 9),
        cam_from_frame: Rigid3::identity(),
    };
    let corners = [[0., 0., 1.], [8., 0., 1.], [8., 8., 1.], [0., 8., 1.]].map(Point3::from);
    let quad =
        |triangles: Vec<[u32; 3]>| Scene::new(&TriangleMesh::new(corners.to_vec(), triangles)).render(&view).mask();
    let count = |mask: &mb_image::Mask| mask.data().iter().filter(|&&seen| seen).count();
    // Left and upper border belong to the square, right and lower border to what comes after.
    let whole = quad(vec![[0, 1, 2], [0, 2, 3]]);
    assert_eq!(count(&whole), 64);
    let (one, other) = (quad(vec![[0, 1, 2]]), quad(vec![[0, 3, 2]]));
    assert_eq!(count(&one) + count(&other), 64);
    assert!(one.data().iter().zip(other.data()).all(|(a, b)| !(a & b)));
}

#[test]
fn a_plane_has_the_depth_that_geometry_says() {
    // The floor y = 0.3, below a camera that looks along z: depth = 0.3 fy / (y - cy), up to the horizon.
    let corners = [[-1e4, 0.3, -5.], [1e4, 0.3, -5.], [1e4, 0.3, 2e4], [-1e4, 0.3, 2e4]].map(Point3::from);
    let mesh = TriangleMesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]]);
    let mut view = view([0.0; 6]);
    view.cam_from_frame = Rigid3::identity();
    let depth = Scene::new(&mesh).depth(&view);
    for y in 0..SIZE.height {
        let below = y as f64 - view.intrinsics.cy;
        let expected = if below > 0.0 { 0.3 * view.intrinsics.fy / below } else { 0.0 };
        for x in 0..SIZE.width {
            assert!((f64::from(depth[(x, y)]) - expected).abs() <= 1e-7 * expected, "({x}, {y})");
        }
    }
}

#[test]
fn threads_change_nothing() {
    let mut runner = proptest::test_runner::TestRunner::deterministic();
    let mesh = soup(0.1..2.0, false).new_tree(&mut runner).unwrap().current();
    let scene = Scene::new(&mesh);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| scene.render(&view([0.1; 6])))
    };
    assert_eq!(with(1), with(5));
    assert_eq!(scene.depth(&view([0.1; 6])), with(1).depth);
}

#[test]
fn what_is_no_number_is_not_seen() {
    let mut vertices: Vec<Point3<f64>> =
        [[-1., -1., 0.], [1., -1., 0.], [0., 1., 0.], [f64::NAN, 0., 0.], [0., f64::INFINITY, 0.]]
            .map(Point3::from)
            .to_vec();
    let mesh = TriangleMesh::new(vertices.clone(), vec![[0, 1, 3], [0, 1, 4], [0, 0, 1], [2, 2, 2], [0, 1, 2]]);
    let raster = Scene::new(&mesh).render(&view([0.0; 6]));
    assert!(raster.triangle.data().iter().all(|&t| t == 4 || t == NO_TRIANGLE));
    assert_eq!(raster.depth[(49, 38)], 1.0);
    // Everything behind the camera.
    vertices.truncate(3);
    vertices.iter_mut().for_each(|p| p.z = -3.0);
    let behind = Scene::new(&TriangleMesh::new(vertices, vec![[0, 1, 2]])).render(&view([0.0; 6]));
    assert!(behind.mask().data().iter().all(|&seen| !seen));
    let empty = Scene::new(&TriangleMesh::default()).depth(&view([0.0; 6]));
    assert!(empty.data().iter().all(|&z| z == 0.0));
}

/// Bricks of a real model: slivers, T-junctions, coplanar touching walls, open parts.
#[test]
fn a_brick_model_agrees_from_all_around() {
    let Some(path) = mb_testdata::find("official_scorer/wedge/mesh/cad_mesh.ply") else { return };
    let mesh = mb_mesh::read_mesh(path).unwrap();
    for i in 0..4 {
        let view: ObjectView = mb_render::three_quarter_view(&mesh.bounds(), &Vector3::y(), SIZE, f64::from(i), 0.4);
        assert_eq!(unexplained(&mesh, &view), vec![], "view {i}");
    }
}
