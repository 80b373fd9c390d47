//! Photographs of coloured boxes, made by the renderer, as a sequence folder.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on should panic")]

use std::path::Path;

use mb_capture::{Alignment, AlignmentStage, Sequence, write_intrinsics_txt, write_pose_txt};
use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Rigid3, World};
use mb_image::{Image, RgbImage};
use mb_mesh::{TriangleMesh, write_mesh};
use mb_render::{NO_TRIANGLE, Scene, View};
use nalgebra::{Point3, UnitQuaternion, Vector3, Vector6};
use rand::RngExt;

pub const SIZE: ImageSize = ImageSize::new(480, 360);
const PHONE: Intrinsics = Intrinsics { fx: 400.0, fy: 400.0, cx: 239.5, cy: 179.5 };
pub const FRAMES: u32 = 8;

/// Six boxes of three colours on two floors, nowhere symmetric.
pub fn boxes() -> TriangleMesh {
    let places: [([f64; 3], [f64; 3], [u8; 3]); 6] = [
        ([-0.05, 0.0, -0.03], [0.03, 0.02, 0.02], [190, 30, 30]),
        ([0.03, 0.0, -0.02], [0.06, 0.035, 0.03], [40, 60, 180]),
        ([-0.04, 0.02, -0.02], [0.0, 0.05, 0.01], [220, 190, 40]),
        ([0.035, 0.035, -0.01], [0.05, 0.06, 0.005], [190, 30, 30]),
        ([-0.05, 0.0, 0.02], [-0.02, 0.015, 0.045], [40, 60, 180]),
        ([-0.01, 0.02, -0.015], [0.02, 0.03, 0.0], [30, 140, 60]),
    ];
    let (mut mesh, mut colors, mut parts) = (TriangleMesh::default(), Vec::new(), Vec::new());
    for (part, (min, max, color)) in places.iter().enumerate() {
        let first = mesh.vertices.len() as u32;
        for i in 0..8 {
            let pick = |axis: usize| if i >> axis & 1 == 0 { min[axis] } else { max[axis] };
            mesh.vertices.push(Point3::new(pick(0), pick(1), pick(2)));
        }
        let faces = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
        for [a, b, c, d] in faces {
            for triangle in [[a, b, c], [a, c, d]] {
                mesh.triangles.push(triangle.map(|v| v + first));
                colors.push(*color);
                parts.push(part as u32);
            }
        }
    }
    mesh.triangle_colors = Some(colors);
    mesh.triangle_parts = Some(parts);
    mesh
}

/// The photograph: each face lit by its direction, four samples a pixel, averaged as light is.
pub fn photograph(mesh: &TriangleMesh, cam_from_object: &Rigid3<Camera, Object>) -> RgbImage {
    let fine = ImageSize::new(SIZE.width * 2, SIZE.height * 2);
    let view = View { intrinsics: PHONE.resized(SIZE, fine), size: fine, cam_from_frame: *cam_from_object };
    let raster = Scene::new(mesh).render(&view);
    let light = Vector3::new(0.4, 0.8, 0.3).normalize();
    let color = |t: u32| {
        if t == NO_TRIANGLE {
            return [150.0, 140.0, 125.0];
        }
        let lit = 0.35 + 0.65 * mesh.scaled_normal(t as usize).normalize().dot(&light).abs();
        mesh.triangle_colors.as_ref().expect("the boxes are coloured")[t as usize].map(|c| f64::from(c) * lit)
    };
    Image::from_fn(SIZE, |x, y| {
        let mut sum = [0.0; 3];
        for (dx, dy) in [(0, 0), (1, 0), (0, 1), (1, 1)] {
            let c = color(raster.triangle[(2 * x + dx, 2 * y + dy)]);
            (0..3).for_each(|i| sum[i] += (c[i] / 255.0f64).powf(2.2) / 4.0);
        }
        sum.map(|v: f64| (255.0 * v.powf(1.0 / 2.2)).round() as u8)
    })
}

pub struct Truth {
    pub world_from_object: Rigid3<World, Object>,
    pub cameras: Vec<Rigid3<World, Camera>>,
}

/// Eight frames with drifted poses, and an alignment that starts `start_mm` and `start_deg` off.
pub fn capture(root: &Path, start_mm: f64, start_deg: f64) -> Truth {
    let mesh = boxes();
    write_mesh(root.join("model/mesh.ply"), &mesh).unwrap();
    let mut rng = mb_job::rng(11, 0);
    let mut uniform = |size: f64| rng.random_range(-size..size);
    let world_from_object = Rigid3::<World, Object>::exp(&Vector6::new(0.0, 0.6, 0.0, 0.3, -0.2, 0.1));
    let middle = (world_from_object * Point3::new(0.0, 0.02, 0.0)).coords;
    let mut cameras = Vec::new();
    for frame in 0..FRAMES {
        let angle = f64::from(frame) * 0.75;
        let center = middle + Vector3::new(0.28 * angle.cos(), 0.17, 0.28 * angle.sin());
        let rotation = UnitQuaternion::face_towards(&(middle - center), &-Vector3::y());
        let world_from_cam = Rigid3::<World, Camera>::from_parts(rotation, center);
        let image = photograph(&mesh, &(world_from_cam.inverse() * world_from_object));
        mb_image::write_rgb_png(root.join(format!("image/{frame:06}.png")), &image).unwrap();
        write_intrinsics_txt(root.join(format!("intrinsic/{frame:06}.txt")), &PHONE).unwrap();
        let turn = UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| uniform(0.006)));
        let shift = Vector3::from_fn(|_, _| uniform(0.003));
        let drift = Rigid3::<World, World>::from_parts(turn, middle + shift - turn * middle);
        write_pose_txt(root.join(format!("pose/{frame:06}.txt")), &(drift * world_from_cam)).unwrap();
        cameras.push(world_from_cam);
    }
    let off = Rigid3::<Object, Object>::from_parts(
        UnitQuaternion::from_scaled_axis(Vector3::new(0.6, 0.64, -0.48) * start_deg.to_radians()),
        Vector3::new(0.48, 0.6, 0.64) * start_mm * 1e-3,
    );
    Alignment {
        version: 1,
        stage: AlignmentStage::Keypoints,
        world_from_object: world_from_object * off,
        object_covariance: None,
        rms_px: None,
        frames: Vec::new(),
    }
    .write(root.join(Alignment::FILE))
    .unwrap();
    Truth { world_from_object, cameras }
}

/// Root mean square error of the object's place (mm) and mean error of its rotation (deg) as the cameras see it.
pub fn errors(root: &Path, truth: &Truth) -> (f64, f64) {
    let sequence = Sequence::open(root).unwrap();
    let alignment = sequence.read_alignment().unwrap();
    let frames = sequence.aligned_frames(&alignment);
    let (mut sq, mut deg) = (0.0, 0.0);
    for (frame, camera) in frames.iter().zip(&truth.cameras) {
        let found = frame.world_from_cam.inverse() * alignment.world_from_object;
        let right = camera.inverse() * truth.world_from_object;
        let middle = Point3::new(0.0, 0.02, 0.0);
        sq += (found * middle - right * middle).norm_squared();
        deg += found.rotation().angle_to(&right.rotation()).to_degrees();
    }
    ((sq / f64::from(FRAMES)).sqrt() * 1e3, deg / f64::from(FRAMES))
}
