//! Photographs: what the phone's camera sees of the set.
//!
//! A photograph is the mean of a few sharp renderings, shifted by parts of a pixel (which smooths edges) and taken at
//! different moments of the exposure (which blurs what moves). Each pixel is a diffuse surface under ambient light and the window
//! with a glossy coat: ABS plastic, refractive index 1.5. Parts touch with visible seams and have rounded edges, which
//! catch highlights.

use glam::Vec3;
use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Rigid3};
use mb_image::Image;
use mb_mesh::TriangleMesh;
use mb_render::{Raster, View};
use nalgebra::Point2;
use rayon::prelude::*;

use crate::Quality;
use crate::light::fresnel;
use crate::probes::{Probes, Tracing};
use crate::stage::{Stage, vec3};

/// Gap between the walls of two bricks: each side wall stands back by 0.1 mm from the nominal pitch.
const SEAM_M: f32 = 0.0002;
/// Radius of a brick's edges.
const EDGE_M: f32 = 0.00025;
/// Time that the shutter is open. Indoors by day a phone needs about this much.
const EXPOSURE_S: f64 = 1.0 / 120.0;

/// Offsets of the samples within a pixel, in pixels: rotated grids.
const TWO: [(f64, f64); 2] = [(-0.25, 0.25), (0.25, -0.25)];
const FOUR: [(f64, f64); 4] = [(-0.125, -0.375), (0.375, -0.125), (-0.375, 0.125), (0.125, 0.375)];
const EIGHT: [(f64, f64); 8] = [
    (0.0625, -0.1875),
    (-0.0625, 0.1875),
    (0.3125, 0.0625),
    (-0.1875, -0.3125),
    (-0.3125, 0.3125),
    (-0.4375, -0.0625),
    (0.1875, 0.4375),
    (0.4375, -0.4375),
];

impl Quality {
    fn samples(self) -> &'static [(f64, f64)] {
        match self {
            Self::Draft => &TWO,
            Self::Standard => &FOUR,
            Self::Photo => &EIGHT,
        }
    }

    fn tracing(self, width_px: usize) -> Tracing {
        // Probes keep their distance on the surface whatever the size of the photograph.
        let stride = |at_1920: usize| (at_1920 * width_px / 1920).max(2);
        match self {
            Self::Draft => Tracing { stride: stride(16), ambient_rays: 6, shadow_rays: 3, shadowed_bounce: false },
            Self::Standard => Tracing { stride: stride(6), ambient_rays: 12, shadow_rays: 6, shadowed_bounce: true },
            Self::Photo => Tracing { stride: stride(4), ambient_rays: 32, shadow_rays: 16, shadowed_bounce: true },
        }
    }
}

/// What a photograph is taken of and with.
pub(crate) struct Shot<'a> {
    pub stage: &'a Stage,
    pub model: &'a TriangleMesh,
    pub size: ImageSize,
    pub intrinsics: Intrinsics,
    pub quality: Quality,
    /// Differs from frame to frame.
    pub salt: u32,
}

/// Renders the linear radiance `[H, W]` that reaches the sensor. `object_from_cam` is the camera's pose at a time offset
/// in seconds from the middle of the exposure.
pub(crate) fn expose(shot: &Shot<'_>, object_from_cam: impl Fn(f64) -> Rigid3<Object, Camera>) -> Image<Vec3> {
    let view = |k: Intrinsics, at_s: f64| View {
        intrinsics: k,
        size: shot.size,
        cam_from_frame: object_from_cam(at_s).inverse(),
    };
    let longer = shot.size.width.max(shot.size.height);
    let probes = Probes::new(shot.stage, &view(shot.intrinsics, 0.0), shot.quality.tracing(longer), shot.salt);
    let samples = shot.quality.samples();
    let mut sum = Image::filled(shot.size, Vec3::ZERO);
    for (i, (dx, dy)) in samples.iter().enumerate() {
        let at_s = ((i as f64 + 0.5) / samples.len() as f64 - 0.5) * EXPOSURE_S;
        let k = shot.intrinsics;
        let shifted = Intrinsics { cx: k.cx - dx, cy: k.cy - dy, ..k };
        let view = view(shifted, at_s);
        let raster = shot.stage.scene.render(&view);
        let pass = Pass { shot, raster: &raster, view: &view, probes: &probes, object_from_cam: object_from_cam(at_s) };
        let width = shot.size.width;
        sum.data_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                *pixel += pass.radiance(x, y) / samples.len() as f32;
            }
        });
    }
    sum
}

/// One sharp rendering.
struct Pass<'a> {
    shot: &'a Shot<'a>,
    raster: &'a Raster,
    view: &'a View<Object>,
    probes: &'a Probes<'a>,
    object_from_cam: Rigid3<Object, Camera>,
}

impl Pass<'_> {
    fn place(&self, x: usize, y: usize, z: f32) -> Vec3 {
        let pixel = Point2::new(x as f64, y as f64);
        vec3(&(self.object_from_cam * self.view.intrinsics.cam_from_img(&pixel, f64::from(z))))
    }

    fn radiance(&self, x: usize, y: usize) -> Vec3 {
        let stage = self.shot.stage;
        let z = self.raster.depth[(x, y)];
        let camera = self.object_from_cam.translation();
        let camera = Vec3::new(camera.x as f32, camera.y as f32, camera.z as f32);
        if z <= 0.0 {
            let towards = self.place(x, y, 1.0) - camera;
            return stage.light.room(towards.normalize());
        }
        let triangle = self.raster.triangle[(x, y)];
        let place = self.place(x, y, z);
        let view = (camera - place).normalize();
        let mut surface = stage.surface(triangle, place, view, z / self.view.intrinsics.fx as f32);
        let arriving = self.probes.at(x as f32, y as f32, place, stage.normal(triangle, place, view));
        let mut seam = 0.0;
        if stage.is_model(triangle) {
            seam = self.round_edges(x, y, triangle, place, view, &mut surface.normal);
        }
        let light = &stage.light;
        let facing = surface.normal.dot(light.window).max(0.0);
        let diffuse = surface.finish.albedo * (arriving.ambient + light.window_strength * (facing * arriving.window));
        let mirrored = 2.0 * surface.normal.dot(view) * surface.normal - view;
        // The room in the coat, dimmed where the surface sees little of the room.
        let openness = (arriving.ambient.y / light.room(surface.normal).y).min(1.0);
        let rough = surface.finish.roughness;
        let coat = light.room(mirrored) * (fresnel(surface.normal.dot(view)) * (1.0 - 0.7 * rough) * openness);
        let highlight = light.highlight(surface.normal, view, rough) * arriving.window;
        (diffuse * 0.96 + coat + highlight) * (1.0 - 0.75 * seam)
    }

    /// Rounds `normal` towards the neighbouring facets of the same part, and returns how much of the pixel is the gap
    /// to another part, 0 to 1.
    fn round_edges(&self, x: usize, y: usize, triangle: u32, place: Vec3, view: Vec3, normal: &mut Vec3) -> f32 {
        let stage = self.shot.stage;
        let own_part = stage.part(self.shot.model, triangle);
        let z = self.raster.depth[(x, y)];
        let pixel_m = z / self.view.intrinsics.fx as f32;
        let flat = *normal;
        let mut seam = 0.0f32;
        let neighbours = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
        for (nx, ny) in neighbours {
            let Some(&other) = self.raster.triangle.get(nx, ny) else { continue };
            if other == triangle || other == u32::MAX {
                continue;
            }
            let beside = self.place(nx, ny, self.raster.depth[(nx, ny)]);
            // Surfaces that do not touch are a silhouette: no seam and no common edge.
            if (beside - place).length() > 4.0 * pixel_m + 1.5 * SEAM_M {
                continue;
            }
            if stage.part(self.shot.model, other) != own_part {
                seam = seam.max((0.5 * SEAM_M / pixel_m).min(1.0));
            } else {
                let turned = stage.normal(other, beside, view);
                if turned.dot(flat) < 0.85 {
                    *normal += turned * (0.8 * EDGE_M / pixel_m).min(1.0);
                }
            }
        }
        *normal = normal.normalize();
        seam
    }
}
