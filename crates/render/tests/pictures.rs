//! Shaded pictures and overlays say what they should.

use mb_geometry::{Aabb, ImageSize, Intrinsics, Object, Rigid3};
use mb_image::{Image, RgbImage};
use mb_mesh::TriangleMesh;
use mb_render::{ShadeOptions, View, over, overlay_edges, shade, three_quarter_view};
use nalgebra::{Point3, Vector3};
use proptest::prelude::*;

/// An axis-aligned box, each side a part of its own colour.
fn cuboid(min: [f64; 3], max: [f64; 3]) -> TriangleMesh {
    let corners = Aabb { min: min.into(), max: max.into() }.corners();
    let sides = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let triangles = sides.iter().flat_map(|&[a, b, c, d]| [[a, b, c], [a, c, d]]).collect();
    TriangleMesh::new(corners.to_vec(), triangles)
}

const SIZE: ImageSize = ImageSize::new(160, 120);

proptest! {
    #[test]
    fn the_automatic_view_sees_everything_and_fills_the_picture(
        min in prop::array::uniform3(-1.0..1.0f64),
        extent in prop::array::uniform3(0.001..2.0f64),
        azimuth in 0.0..6.3f64,
        elevation in -1.4..1.4f64,
    ) {
        let min = Point3::from(min);
        let bounds = Aabb { min, max: min + Vector3::from(extent) };
        let view: View<Object> = three_quarter_view(&bounds, &Vector3::y(), SIZE, azimuth, elevation);
        let pixels: Vec<_> = bounds.corners().iter()
            .map(|p| view.intrinsics.img_from_cam(&(view.cam_from_frame * *p)).expect("in front of the camera"))
            .collect();
        for p in &pixels {
            prop_assert!(p.x >= 0.0 && p.x <= 159.0 && p.y >= 0.0 && p.y <= 119.0, "{p}");
        }
        // Some corner comes near the border.
        let reach = pixels.iter().map(|p| ((p.x - 79.5).abs() / 80.0).max((p.y - 59.5).abs() / 60.0)).fold(0.0, f64::max);
        prop_assert!(reach > 0.85, "{reach}");
        // Up is up.
        let up = view.cam_from_frame.rotate(&Vector3::y());
        prop_assert!(up.y < 0.0 && up.x.abs() < 1e-9);
    }
}

#[test]
fn the_top_is_lighter_than_the_shadow_and_the_background_is_transparent() {
    let mut mesh = cuboid([-0.1, 0.0, -0.1], [0.1, 0.12, 0.1]);
    mesh.triangle_colors = Some(vec![[200, 30, 20]; 12]);
    let view: View<Object> = three_quarter_view(&mesh.bounds().grown(0.05), &Vector3::y(), SIZE, 0.6, 0.45);
    let picture = shade(&mesh, &view, &ShadeOptions::default());
    let pixel_at = |p: Point3<f64>| {
        let pixel = view.intrinsics.img_from_cam(&(view.cam_from_frame * p)).expect("in front");
        picture[(pixel.x.round() as usize, pixel.y.round() as usize)]
    };
    let top = pixel_at(Point3::new(0.0, 0.12, 0.0));
    let front = pixel_at(Point3::new(0.0, 0.06, 0.1));
    assert_eq!((top[3], front[3]), (255, 255));
    assert!(top[0] > front[0] && front[0] > 60, "top {top:?}, front {front:?}");
    assert!(top[0] > 3 * top[1], "the brick is red: {top:?}");
    assert_eq!(picture[(0, 0)], [0; 4]);
    // The ground before the box is nearly bare, right behind it lies in shadow.
    let beside = pixel_at(Point3::new(0.104, 0.0, 0.0))[3];
    assert!(beside > 40, "{beside}");
    let without = shade(&mesh, &view, &ShadeOptions { ground: false, ..ShadeOptions::default() });
    assert!(without.data().iter().filter(|p| p[3] > 0).count() < picture.data().iter().filter(|p| p[3] > 0).count());
    assert_eq!(over(&picture, [255; 3])[(0, 0)], [255; 3]);
}

#[test]
fn an_empty_mesh_is_an_empty_picture() {
    let view: View<Object> = three_quarter_view(&Aabb::empty(), &Vector3::y(), SIZE, 0.6, 0.45);
    let picture = shade(&TriangleMesh::default(), &view, &ShadeOptions::default());
    assert!(picture.data().iter().all(|p| p[3] == 0));
}

#[test]
fn overlays_mark_the_silhouette_and_nothing_else() {
    // A square of 40 pixels in the middle of the picture.
    let corners = [[-0.2, -0.2, 1.0], [0.2, -0.2, 1.0], [0.2, 0.2, 1.0], [-0.2, 0.2, 1.0]].map(Point3::from);
    let mesh = TriangleMesh::new(corners.to_vec(), vec![[0, 1, 2], [0, 2, 3]]);
    let view = View::<Object> {
        intrinsics: Intrinsics { fx: 100.0, fy: 100.0, cx: 79.5, cy: 59.5 },
        size: SIZE,
        cam_from_frame: Rigid3::identity(),
    };
    let photo: RgbImage = Image::filled(SIZE, [10, 20, 30]);
    let marked = overlay_edges(&photo, &mesh, &view, [255, 0, 255]);
    for y in 0..SIZE.height {
        for x in 0..SIZE.width {
            let (dx, dy) = ((x as f64 - 79.5).abs(), (y as f64 - 59.5).abs());
            let off = (dx.max(dy) - 20.0).abs();
            let changed = marked[(x, y)] != photo[(x, y)];
            assert!(!changed || off < 2.0, "({x}, {y}) is marked");
            assert!(changed || off > 0.6, "({x}, {y}) is not marked");
        }
    }
}
