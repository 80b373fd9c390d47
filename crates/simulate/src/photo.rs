//! Photographs: what the phone's camera sees of the set.
//!
//! A photograph is the mean of a few sharp renderings, shifted by parts of a pixel (which smooths edges) and taken at
//! different moments of the exposure (which blurs what moves). Each pixel is a diffuse surface under the window, the room
//! and what other surfaces send on ([`crate::probes`]), below a glossy coat. The coat mirrors the window and the room, and in
//! the finer efforts also the set, by rays of their own.

use glam::{Vec3, Vec4};
use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Rigid3};
use mb_image::{DepthImage, Image};
use mb_render::{NO_TRIANGLE, Raster, View};
use rayon::prelude::*;

use crate::Quality;
use crate::develop::blurred;
use crate::lens::{Distortion, Eye};
use crate::light::{fresnel, visible_facet};
use crate::probes::{Arriving, Probes, Tracing};
use crate::random::{hash, unit};
use crate::stage::{LIFT_M, Stage, Surface};

/// Time that the shutter is open. Indoors by day a phone needs about this much.
const EXPOSURE_S: f64 = 1.0 / 120.0;

/// Aperture of a phone's lens: a point is blurred over this many pixels of a 1920-pixel-wide photograph for each 1/m that
/// it is out of focus. A lens 3 mm across and 5 mm long over pixels of 3.7 micrometres makes 4; what phones store is
/// crisper than that.
const APERTURE_PX_M: f32 = 1.8;

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
            Self::Photo => Tracing { stride: stride(3), ambient_rays: 40, shadow_rays: 20, shadowed_bounce: true },
        }
    }

    /// Whether the flats of the surroundings are shaded once a pixel, in its middle, for all samples that see them: textures
    /// are filtered to the pixel already. The samples of bricks, whose edges and highlights are finer, are always their own.
    fn shades_flats_once(self) -> bool {
        self == Self::Draft
    }

    /// The least share of light mirrored by a coat for which a ray is followed.
    fn mirrors_from(self) -> f32 {
        match self {
            Self::Draft => f32::INFINITY,
            Self::Standard => 0.04,
            Self::Photo => 0.01,
        }
    }
}

/// What a photograph is taken of and with.
pub(crate) struct Shot<'a> {
    pub stage: &'a Stage,
    pub size: ImageSize,
    pub intrinsics: Intrinsics,
    pub distortion: Distortion,
    /// Time from the first line of the sensor to the last, seconds.
    pub readout_s: f64,
    pub quality: Quality,
    /// Depth at which everything is sharp, metres.
    pub focus_m: f32,
    /// Differs from frame to frame.
    pub salt: u32,
}

/// Renders the linear radiance `[H, W]` that reaches the sensor. `object_from_cam` is the camera's pose at a time offset
/// in seconds from the middle of the exposure.
pub(crate) fn expose(shot: &Shot<'_>, object_from_cam: impl Fn(f64) -> Rigid3<Object, Camera>) -> Image<Vec3> {
    let middle = View { intrinsics: shot.intrinsics, size: shot.size, cam_from_frame: object_from_cam(0.0).inverse() };
    let longer = shot.size.width.max(shot.size.height);
    let probes = Probes::new(shot.stage, &middle, shot.quality.tracing(longer), shot.salt);
    let samples = shot.quality.samples();
    let eye_at = |at_s: f64, (dx, dy): (f64, f64)| {
        let k = shot.intrinsics;
        let shifted = Intrinsics { cx: k.cx - dx, cy: k.cy - dy, ..k };
        Eye::new(shot.size, shifted, shot.distortion, shot.readout_s, |row_s| object_from_cam(at_s + row_s))
    };
    let centred = shot.quality.shades_flats_once().then(|| eye_at(0.0, (0.0, 0.0)));
    let mut sum = Image::filled(shot.size, Vec3::ZERO);
    let mut depth = None;
    // Triangles of the first pass, and what they added to the sum.
    let mut first: Option<(Image<u32>, Image<Vec3>)> = None;
    for (i, offset) in samples.iter().enumerate() {
        let at_s = ((i as f64 + 0.5) / samples.len() as f64 - 0.5) * EXPOSURE_S;
        let eye = eye_at(at_s, *offset);
        let raster = eye.look(shot.stage);
        let salt = hash(i as i32, 77, shot.salt);
        let pass = Pass { shot, raster: &raster, eye: &eye, flats: centred.as_ref(), probes: &probes, salt };
        let width = shot.size.width;
        sum.data_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                let triangle = raster.triangle[(x, y)];
                *pixel += match &first {
                    Some((known, added)) if known[(x, y)] == triangle && !shot.stage.is_model(triangle) => {
                        added[(x, y)]
                    }
                    _ => pass.radiance(x, y) / samples.len() as f32,
                };
            }
        });
        if i == 0 {
            depth = Some(raster.depth);
            first = centred.is_some().then(|| (raster.triangle, sum.clone()));
        }
    }
    let scale = longer as f32 / 1920.0;
    match depth {
        Some(depth) => focused(&sum, &depth, shot.focus_m, scale),
        None => sum,
    }
}

/// Blurs what is out of focus. `scale` is the photograph's width over 1920 pixels.
///
/// Each pixel is mixed from a few blurs of the whole image, to which sharp pixels contribute little, so that what is in
/// focus does not bleed into what is not.
fn focused(sharp: &Image<Vec3>, depth: &DepthImage, focus_m: f32, scale: f32) -> Image<Vec3> {
    /// Standard deviations of the blurs, pixels of a 1920-pixel-wide photograph.
    const LEVELS: [f32; 2] = [0.9, 2.2];
    // A disc's standard deviation is a quarter of its diameter.
    let spread = depth.map(|z| {
        let z = if *z > 0.0 { *z } else { 5.0 };
        (0.25 * APERTURE_PX_M * (1.0 / z - 1.0 / focus_m).abs()).min(LEVELS[1])
    });
    let blurs = LEVELS.map(|level| {
        let mut weighted = Image::filled(sharp.size(), Vec4::ZERO);
        weighted.data_mut().par_iter_mut().enumerate().for_each(|(i, out)| {
            *out = sharp.data()[i].extend(1.0) * (spread.data()[i] / level).clamp(0.02, 1.0);
        });
        blurred(&weighted, (level * scale).max(0.3))
    });
    let mut out = sharp.clone();
    out.data_mut().par_iter_mut().enumerate().for_each(|(i, pixel)| {
        let of = |blur: &Image<Vec4>| blur.data()[i].truncate() / blur.data()[i].w;
        let spread = spread.data()[i];
        *pixel = if spread < LEVELS[0] {
            pixel.lerp(of(&blurs[0]), spread / LEVELS[0])
        } else {
            of(&blurs[0]).lerp(of(&blurs[1]), (spread - LEVELS[0]) / (LEVELS[1] - LEVELS[0]))
        };
    });
    out
}

/// One sharp rendering.
struct Pass<'a> {
    shot: &'a Shot<'a>,
    raster: &'a Raster,
    eye: &'a Eye,
    /// How flats of the surroundings are seen, where that is another way.
    flats: Option<&'a Eye>,
    probes: &'a Probes<'a>,
    salt: u32,
}

impl Pass<'_> {
    fn radiance(&self, x: usize, y: usize) -> Vec3 {
        let stage = self.shot.stage;
        let triangle = self.raster.triangle[(x, y)];
        if triangle == NO_TRIANGLE {
            let d = self.flats.unwrap_or(self.eye).direction(x, y).normalize();
            return stage.light.room(d, 0.01) + stage.light.panes(d, 0.005);
        }
        let mut direction = self.eye.direction(x, y);
        let mut z = self.raster.depth[(x, y)];
        let mut place = self.eye.place(x, y) + direction * z;
        let mut normal = stage.normal(triangle, place, -direction.normalize());
        if let Some(flats) = self.flats.filter(|_| !stage.is_model(triangle)) {
            // Where the pixel's middle meets the same plane.
            let (from, along) = (flats.place(x, y), flats.direction(x, y));
            let met = (place - from).dot(normal) / along.dot(normal);
            if met > 0.0 && met.is_finite() {
                (direction, z, place) = (along, met, from + along * met);
                normal = stage.normal(triangle, place, -direction.normalize());
            }
        }
        let view = -direction.normalize();
        let surface = stage.surface(triangle, place, view, z / self.eye.focal_px());
        let arriving = self.probes.at(place, normal);
        let noise = hash(x as i32, y as i32, self.salt);
        shade(stage, &surface, place, view, arriving, self.shot.quality.mirrors_from(), noise)
    }
}

/// Radiance that a surface sends towards `view`, for the light that arrives there. A ray is followed for what its coat
/// mirrors where that is at least `mirrors_from` of the light.
fn shade(
    stage: &Stage,
    surface: &Surface,
    place: Vec3,
    view: Vec3,
    arriving: Arriving,
    mirrors_from: f32,
    noise: u32,
) -> Vec3 {
    let (light, finish, normal) = (&stage.light, &surface.finish, surface.normal);
    let facing = normal.dot(light.window).max(0.0);
    let straight = finish.coat * fresnel(normal.dot(view));
    let below = (1.0 - straight) * (1.0 - finish.coat * 0.05);
    let diffuse = finish.albedo * (arriving.ambient + light.window_strength * (facing * arriving.window)) * below;
    let alpha = finish.roughness * finish.roughness;
    let coat = if straight >= mirrors_from {
        let facet = visible_facet(normal, view, alpha, (unit(noise), unit(noise.rotate_left(16) ^ 0x5A5A)));
        let towards = 2.0 * facet.dot(view) * facet - view;
        let share = finish.coat * fresnel(facet.dot(view));
        let glimpse = stage.glimpse(place + normal * LIFT_M, towards, false, 0.02 + 0.5 * alpha);
        let panes = if glimpse.free { light.panes(towards, 0.5 * alpha) } else { Vec3::ZERO };
        (glimpse.radiance + panes) * share
    } else {
        // Rough surfaces mirror less at a slant than smooth ones, and what stands round a place hides the room from it.
        let towards = 2.0 * normal.dot(view) * normal - view;
        let room = light.room(towards, alpha) * (1.0 - 0.7 * alpha) * arriving.open;
        (room + light.panes(towards, alpha) * arriving.window) * straight
    };
    (diffuse + coat) * (1.0 - 0.8 * surface.gap)
}
