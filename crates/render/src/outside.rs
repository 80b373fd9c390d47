//! The outside of a mesh: what views from all around can see.

use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Ray, Rigid3};
use mb_mesh::{Bvh, TriangleMesh};
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion, Vector3};
use rayon::prelude::*;

use crate::{NO_TRIANGLE, Raster, Scene, View};

/// Cameras around the mesh, spread evenly over a sphere.
const VIEWS: usize = 96;
/// Cameras that judge the result: they stand between the others.
const JUDGES: usize = 24;
/// Edge of their pictures, pixels. Of a model 15 cm across a pixel is 0.2 mm.
const PIXELS: usize = 800;
/// Distance of the cameras from the middle, in radii of the mesh.
const DISTANCE: f64 = 3.0;
/// Rays start this far in front of the surface, metres.
const LIFT_M: f64 = 1e-6;
/// Points of a triangle that look out, as barycentric weights: the middle, and near the corners.
const LOOKOUTS: [[f64; 3]; 4] =
    [[1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0], [0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9]];

/// What [`outside_only`] removed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OutsideSummary {
    /// Triangles before.
    pub triangles: usize,
    /// Triangles that are left.
    pub kept: usize,
    /// Share of the surface that was removed.
    pub removed_area: f64,
    /// Share of the mesh's pixels in views that took no part in the choice where the depth is another than before: how
    /// much of what can be seen was lost.
    pub changed_pixels: f64,
}

/// Removes the triangles that cannot be seen from outside: of a brick model, walls between bricks, studs inside bricks,
/// tubes.
///
/// A triangle stays when it shows in a pixel of one of 96 pictures from all around, or when a straight line leads from
/// one of four points on it to one of the 96 cameras, so that small and thin triangles are not lost. Rays are followed
/// only where the picture leaves a doubt: a point that lies behind all four pixels around it is hidden.
pub fn outside_only(mesh: &TriangleMesh) -> (TriangleMesh, OutsideSummary) {
    let (scene, bvh) = (Scene::new(mesh), Bvh::new(mesh));
    let mut keep = vec![false; mesh.triangles.len()];
    for view in views_around(mesh, VIEWS, 0.0) {
        let raster = scene.render(&view);
        for &triangle in raster.triangle.data().iter().filter(|&&triangle| triangle != NO_TRIANGLE) {
            keep[triangle as usize] = true;
        }
        let in_doubt = keep.par_iter_mut().enumerate().filter(|(_, keep)| !**keep);
        in_doubt.for_each(|(triangle, keep)| *keep = looks_out(mesh, triangle, &view, &raster, &bvh));
    }
    let mut kept = mesh.clone();
    kept.retain_triangles(&keep);
    let mut used = vec![false; mesh.vertices.len()];
    kept.triangles.as_flattened().iter().for_each(|&v| used[v as usize] = true);
    kept.retain_vertices(&used);
    let (before, after) = (mesh.area(), kept.area());
    let summary = OutsideSummary {
        triangles: mesh.triangles.len(),
        kept: kept.triangles.len(),
        removed_area: if before > 0.0 { 1.0 - after / before } else { 0.0 },
        changed_pixels: changed_pixels(mesh, &scene, &kept),
    };
    (kept, summary)
}

/// Whether one of the lookouts of a triangle sees the camera.
fn looks_out(mesh: &TriangleMesh, index: usize, view: &View<Object>, raster: &Raster, bvh: &Bvh) -> bool {
    let [a, b, c] = mesh.triangle(index);
    if mesh.scaled_normal(index).norm() == 0.0 {
        return false;
    }
    let Intrinsics { fx, fy, cx, cy } = view.intrinsics;
    let camera = view.cam_from_frame.inverse() * Point3::<f64>::origin();
    LOOKOUTS.iter().any(|[u, v, w]| {
        let p = Point3::from(a.coords * *u + b.coords * *v + c.coords * *w);
        let in_cam = view.cam_from_frame * p;
        let pixel = |at: f64, focal: f64, middle: f64| {
            let pixel = (focal * at / in_cam.z + middle).floor();
            (pixel >= 0.0 && pixel + 1.0 < PIXELS as f64).then_some(pixel as usize)
        };
        let (Some(x), Some(y)) = (pixel(in_cam.x, fx, cx), pixel(in_cam.y, fy, cy)) else { return false };
        let may_be_seen = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)].into_iter().any(|at| {
            let depth = f64::from(raster.depth[at]);
            depth == 0.0 || in_cam.z <= depth * (1.0 + 1e-6)
        });
        let way = camera - p;
        let direction = way.normalize();
        let ray = Ray { origin: p + direction * LIFT_M, direction };
        may_be_seen && !bvh.occluded(&ray, way.norm() - LIFT_M)
    })
}

/// The share of pixels on the mesh that show another depth without what was removed.
fn changed_pixels(mesh: &TriangleMesh, scene: &Scene, kept: &TriangleMesh) -> f64 {
    let outside = Scene::new(kept);
    let (mut pixels, mut changed) = (0_usize, 0_usize);
    for view in views_around(mesh, JUDGES, 0.5) {
        let (before, after) = (scene.depth(&view), outside.depth(&view));
        for (a, b) in before.data().iter().zip(after.data()).filter(|(a, _)| **a > 0.0) {
            pixels += 1;
            changed += usize::from((a - b).abs() > 1e-5);
        }
    }
    changed as f64 / pixels.max(1) as f64
}

/// Cameras on a spiral over the sphere around the mesh; `phase` turns it.
fn views_around(mesh: &TriangleMesh, count: usize, phase: f64) -> Vec<View<Object>> {
    let bounds = mesh.bounds();
    if bounds.is_empty() {
        return vec![];
    }
    let (middle, radius) = (bounds.center(), (0.5 * bounds.extent().norm()).max(1e-6));
    // The ball around the mesh fills the picture.
    let focal = 0.5 * (PIXELS - 4) as f64 * (DISTANCE * DISTANCE - 1.0_f64).sqrt();
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: 0.5 * (PIXELS - 1) as f64, cy: 0.5 * (PIXELS - 1) as f64 };
    let golden = std::f64::consts::PI * (3.0 - 5.0_f64.sqrt());
    (0..count)
        .map(|index| {
            let rise = 1.0 - (2.0 * index as f64 + 1.0) / count as f64;
            let (reach, angle) = ((1.0 - rise * rise).sqrt(), golden * (index as f64 + phase));
            let outwards = Vector3::new(reach * angle.cos(), rise, reach * angle.sin());
            let forward = -outwards;
            let across = forward.cross(&if rise.abs() < 0.9 { Vector3::y() } else { Vector3::x() }).normalize();
            let rows =
                Matrix3::from_rows(&[across.transpose(), forward.cross(&across).transpose(), forward.transpose()]);
            let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rows));
            let camera = middle + outwards * (DISTANCE * radius);
            let cam_from_frame = Rigid3::<Camera, Object>::from_parts(rotation, -(rotation * camera.coords));
            View { intrinsics, size: ImageSize::new(PIXELS, PIXELS), cam_from_frame }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A closed box from its corners, counter-clockwise from outside.
    fn add_box(mesh: &mut TriangleMesh, min: [f64; 3], max: [f64; 3]) {
        let first = mesh.vertices.len() as u32;
        for i in 0..8 {
            let pick = |axis: usize| if i >> axis & 1 == 0 { min[axis] } else { max[axis] };
            mesh.vertices.push(Point3::new(pick(0), pick(1), pick(2)));
        }
        let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        for [a, b, c, d] in quads {
            mesh.triangles.extend([[a, b, c], [a, c, d]].map(|t| t.map(|v| first + v)));
        }
    }

    #[test]
    fn a_box_in_a_box_goes_and_a_box_under_a_grate_stays() {
        let mut mesh = TriangleMesh::default();
        add_box(&mut mesh, [-0.05; 3], [0.05; 3]);
        add_box(&mut mesh, [-0.02; 3], [0.02; 3]);
        let (outside, summary) = outside_only(&mesh);
        assert_eq!((summary.triangles, summary.kept, outside.triangles.len()), (24, 12, 12));
        assert_eq!(outside.vertices.len(), 8);
        assert!((summary.removed_area - 0.16 / 1.16).abs() < 1e-9, "{summary:?}");
        assert_eq!(summary.changed_pixels, 0.0);

        // Bars with gaps of half a millimetre over a box: its top can be seen through them.
        let mut mesh = TriangleMesh::default();
        add_box(&mut mesh, [-0.03, -0.03, -0.03], [0.03, 0.0, 0.03]);
        for bar in 0..20 {
            let x = -0.03 + 0.003 * f64::from(bar);
            add_box(&mut mesh, [x, 0.001, -0.03], [x + 0.0025, 0.002, 0.03]);
        }
        let (outside, summary) = outside_only(&mesh);
        assert!(outside.triangles.contains(&[2, 6, 7]) || outside.triangles.contains(&[2, 7, 3]), "{summary:?}");
        assert!(summary.changed_pixels < 1e-3, "{summary:?}");
    }

    #[test]
    fn triangles_smaller_than_a_pixel_stay() {
        let mut mesh = TriangleMesh::default();
        add_box(&mut mesh, [-0.5; 3], [0.5; 3]);
        for grain in 0..50 {
            let x = -0.4 + 0.015 * f64::from(grain);
            add_box(&mut mesh, [x, 0.5, x], [x + 1e-5, 0.50001, x + 1e-5]);
        }
        let (outside, _) = outside_only(&mesh);
        // The undersides of the grains lie on the box.
        assert!(outside.triangles.len() >= 12 + 50 * 10, "{}", outside.triangles.len());
    }

    #[test]
    fn nothing_gives_nothing() {
        assert_eq!(outside_only(&TriangleMesh::default()).0, TriangleMesh::default());
        let mut lonely = TriangleMesh::new(vec![Point3::origin(); 3], vec![[0, 1, 2]]);
        lonely.triangle_parts = Some(vec![7]);
        assert_eq!(outside_only(&lonely).1.kept, 0);
    }
}
