//! TSDF fusion of shapes whose surface is known in closed form.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3, World};
use mb_image::{DepthImage, Image, RgbImage};
use mb_mesh::TriangleMesh;
use mb_recon::TsdfVolume;
use nalgebra::{Matrix4, Point2, Point3, Vector3};
use proptest::prelude::*;

const SIZE: ImageSize = ImageSize::new(320, 240);
const INTRINSICS: Intrinsics = Intrinsics { fx: 300.0, fy: 301.0, cx: 158.2, cy: 121.7 };

/// A camera at `eye` that looks at `target`.
fn looking_at(eye: Point3<f64>, target: Point3<f64>) -> Rigid3<Camera, World> {
    let forward = (target - eye).normalize();
    let up = if forward.y.abs() > 0.9 { Vector3::x() } else { Vector3::y() };
    let right = forward.cross(&up).normalize();
    let down = forward.cross(&right);
    let mut world_from_cam = Matrix4::identity();
    for (column, axis) in [right, down, forward, eye.coords].iter().enumerate() {
        world_from_cam.fixed_view_mut::<3, 1>(0, column).copy_from(axis);
    }
    Rigid3::<World, Camera>::from_matrix(&world_from_cam).unwrap().0.inverse()
}

/// Depth of whatever `hit` finds along a ray (its parameter, which is the depth).
fn depth_map(cam_from_world: &Rigid3<Camera, World>, hit: impl Fn(&mb_geometry::Ray) -> Option<f64>) -> DepthImage {
    let world_from_cam = cam_from_world.inverse();
    Image::from_fn(SIZE, |x, y| {
        let ray = INTRINSICS.ray(&Point2::new(x as f64, y as f64), &world_from_cam);
        hit(&ray).map_or(0.0, |t| t as f32)
    })
}

fn sphere_hit(ray: &mb_geometry::Ray, center: Point3<f64>, radius: f64) -> Option<f64> {
    let to_origin = ray.origin - center;
    let (a, b) = (ray.direction.norm_squared(), ray.direction.dot(&to_origin));
    let discriminant = b * b - a * (to_origin.norm_squared() - radius * radius);
    (discriminant >= 0.0).then(|| (-b - discriminant.sqrt()) / a)
}

/// Directions to the 26 neighbours of a cube's centre: a view from every side.
fn directions() -> Vec<Vector3<f64>> {
    (0..27)
        .filter(|&i| i != 13)
        .map(|i| Vector3::new((i % 3) as f64 - 1.0, (i / 3 % 3) as f64 - 1.0, (i / 9) as f64 - 1.0).normalize())
        .collect()
}

const CENTER: Point3<f64> = Point3::new(0.031, -0.012, 0.4);
const RADIUS: f64 = 0.05;

fn sphere_views() -> Vec<(Rigid3<Camera, World>, DepthImage)> {
    let view = |direction: Vector3<f64>| {
        let cam_from_world = looking_at(CENTER + 0.3 * direction, CENTER);
        (cam_from_world, depth_map(&cam_from_world, |ray| sphere_hit(ray, CENTER, RADIUS)))
    };
    directions().into_iter().map(view).collect()
}

fn fused(views: &[(Rigid3<Camera, World>, DepthImage)], color: Option<&RgbImage>) -> TriangleMesh {
    let mut volume = TsdfVolume::new(0.002, 0.008).unwrap();
    for (cam_from_world, depth) in views {
        volume.allocate(depth, &INTRINSICS, cam_from_world).unwrap();
    }
    for (cam_from_world, depth) in views {
        volume.integrate(depth, color, &INTRINSICS, cam_from_world).unwrap();
    }
    volume.extract_mesh(1.0)
}

#[test]
fn a_sphere_seen_from_all_sides_is_round_closed_and_faces_outward() {
    let mesh = fused(&sphere_views(), None);
    let errors: Vec<f64> = mesh.vertices.iter().map(|p| (p - CENTER).norm() - RADIUS).collect();
    let rms = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    let worst = errors.iter().fold(0.0, |w: f64, e| w.max(e.abs()));
    // Distances along z overestimate those of slanted surfaces, which cancels at the zero crossing up to a small part
    // of the 2 mm voxel.
    assert!(rms < 0.2e-3 && worst < 0.8e-3, "rms {:.3} mm, worst {:.3} mm", rms * 1e3, worst * 1e3);
    let sphere_area = 4.0 * std::f64::consts::PI * RADIUS * RADIUS;
    assert!((mesh.area() / sphere_area - 1.0).abs() < 0.02, "area {} of {sphere_area}", mesh.area());

    let mut edges = std::collections::BTreeMap::new();
    for &[a, b, c] in &mesh.triangles {
        for edge in [(a, b), (b, c), (c, a)] {
            *edges.entry(edge).or_insert(0) += 1;
        }
    }
    for (&(a, b), &uses) in &edges {
        assert_eq!((uses, edges.get(&(b, a))), (1, Some(&1)), "edge {a}-{b}");
    }
    // Euler: a sphere, in one piece.
    assert_eq!(mesh.vertices.len() as i64 - edges.len() as i64 / 2 + mesh.triangles.len() as i64, 2);
    for t in 0..mesh.triangles.len() {
        let [a, b, c] = mesh.triangle(t);
        let outward = (a.coords + b.coords + c.coords) / 3.0 - CENTER.coords;
        assert!(mesh.scaled_normal(t).dot(&outward) > 0.0);
    }
}

#[test]
fn neither_threads_nor_the_order_of_frames_change_the_sphere() {
    let mut views = sphere_views();
    views.truncate(8);
    let on = |threads: usize, views: &[_]| {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(|| fused(views, None))
    };
    let mesh = on(1, &views);
    assert_eq!(mesh, on(3, &views));
    views.reverse();
    let reversed = on(2, &views);
    // Sums in another order round differently, so vertices move by less than a nanometre; the faces stay.
    assert_eq!(mesh.triangles, reversed.triangles);
    for (a, b) in mesh.vertices.iter().zip(&reversed.vertices) {
        assert!((a - b).norm() < 1e-7, "{a} became {b}");
    }
}

#[test]
fn free_space_clears_a_surface_that_one_frame_imagined() {
    let cam_from_world = looking_at(Point3::new(0.0, 0.0, 0.0), Point3::new(0.0, 0.0, 1.0));
    let wall = DepthImage::filled(SIZE, 0.503);
    let mut flying = wall.clone();
    for y in 100..110 {
        flying.data_mut()[y * SIZE.width + 150..y * SIZE.width + 160].fill(0.41);
    }
    let mut views = vec![(cam_from_world, wall.clone()), (cam_from_world, flying)];
    views.extend([(cam_from_world, wall.clone()), (cam_from_world, wall)]);
    let mesh = fused(&views, None);
    assert!(mesh.vertices.iter().all(|p| (p.z - 0.503).abs() < 1e-3));
}

#[test]
fn colours_come_from_the_photograph_at_its_own_size() {
    let cam_from_world = looking_at(Point3::origin(), Point3::new(0.0, 0.0, 1.0));
    let color = Image::from_fn(ImageSize::new(640, 480), |x, _| if x < 320 { [200, 10, 20] } else { [10, 20, 200] });
    let mesh = fused(&[(cam_from_world, DepthImage::filled(SIZE, 0.503))], Some(&color));
    let colors = mesh.vertex_colors.as_ref().unwrap();
    assert_eq!(colors.len(), mesh.vertices.len());
    for (p, c) in mesh.vertices.iter().zip(colors) {
        let u = INTRINSICS.img_from_cam(&(cam_from_world * *p)).unwrap().x;
        if (u - 159.5).abs() > 2.0 {
            assert_eq!(*c, if u < 159.5 { [200, 10, 20] } else { [10, 20, 200] });
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Interpolated depth makes a plane come out flat whatever its slant, to a small part of a voxel.
    #[test]
    fn a_slanted_wall_is_flat(tilt_x in -0.6..0.6f64, tilt_y in -0.6..0.6f64, distance in 0.25..0.5f64) {
        let cam_from_world = looking_at(Point3::origin(), Point3::new(0.0, 0.0, 1.0));
        let normal = Vector3::new(tilt_x, tilt_y, -1.0).normalize();
        let on_wall = Point3::new(0.0, 0.0, distance);
        let depth = depth_map(&cam_from_world, |ray| {
            let t = (on_wall - ray.origin).dot(&normal) / ray.direction.dot(&normal);
            (t > 0.05 && t < 0.6).then_some(t)
        });
        let mesh = fused(&[(cam_from_world, depth)], None);
        prop_assert!(mesh.triangles.len() > 1000);
        // Where the depth ends, the nearest pixel counts instead of interpolation.
        for p in mesh.vertices.iter().filter(|p| p.z < 0.57) {
            let (x, off_mm) = (INTRINSICS.img_from_cam(&(cam_from_world * *p)).unwrap(), (p - on_wall).dot(&normal) * 1e3);
            prop_assert!(off_mm.abs() < 0.02, "{off_mm} mm off at pixel {x}");
        }
        // Slivers have no exact direction of their own; together the triangles face the camera side of the wall.
        let inner = (0..mesh.triangles.len()).filter(|&t| mesh.triangle(t).iter().all(|p| p.z < 0.57));
        let (sum, areas) = inner.fold((Vector3::zeros(), 0.0), |(sum, areas): (Vector3<f64>, f64), t| {
            (sum + mesh.scaled_normal(t), areas + mesh.scaled_normal(t).norm())
        });
        prop_assert!(sum.dot(&normal) > 0.9999 * areas, "{} of {areas}", sum.dot(&normal));
    }

    /// Whatever the numbers, no panic: a result or a sentence.
    #[test]
    fn hostile_numbers_are_survived(
        values in prop::collection::vec(prop_oneof![
            Just(f32::NAN), Just(f32::INFINITY), Just(-1.0), Just(0.0), Just(1e-30), Just(1e30), 0.1..2.0f32
        ], 12 * 16),
        translation in prop_oneof![Just(0.0), Just(1e6), Just(1e300), Just(f64::NAN)],
    ) {
        let depth = DepthImage::from_data(ImageSize::new(16, 12), values).unwrap();
        let intrinsics = Intrinsics { fx: 15.0, fy: 15.0, cx: 7.5, cy: 5.5 };
        let cam_from_world = Rigid3::from_translation(Vector3::new(translation, 0.0, 0.0));
        let mut volume = TsdfVolume::new(0.02, 0.08).unwrap();
        if let Err(e) = volume.integrate(&depth, None, &intrinsics, &cam_from_world) {
            let sentence = e.to_string();
            prop_assert!(sentence.contains("voxel"), "{}", sentence);
        }
        for p in &volume.extract_mesh(1.0).vertices {
            prop_assert!(p.coords.iter().all(|v| v.is_finite()));
        }
    }
}

#[test]
fn absurd_sizes_are_refused_with_a_sentence() {
    for (voxel, truncation) in [(0.0, 0.01), (-0.001, 0.01), (f64::NAN, 0.01), (0.001, 0.001), (0.001, 1.0)] {
        assert!(TsdfVolume::new(voxel, truncation).err().unwrap().to_string().contains("voxel"));
    }
    // A wall of a square kilometre at a millimetre a voxel.
    let depth = DepthImage::filled(SIZE, 1000.0);
    let mut volume = TsdfVolume::new(0.001, 0.004).unwrap();
    let refused = volume.integrate(&depth, None, &INTRINSICS, &Rigid3::identity()).unwrap_err().to_string();
    assert!(refused.contains("memory") && refused.contains("larger voxels"), "{refused}");
    assert_eq!(volume.blocks(), 0);
}
