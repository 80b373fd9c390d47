//! Ambient light and soft shadows, traced at a coarse grid of pixels and carried to the others.
//!
//! Both vary slowly over a smooth surface, so a ray budget that would be noise at every pixel is plenty at every n-th:
//! each probe is averaged with its neighbours on the same surface (a bilateral filter on place and normal), and a
//! pixel takes the probes round it that lie on its own surface. Pixels without such a probe (thin parts) are traced.

use std::f32::consts::PI;

use glam::Vec3;
use mb_geometry::{Intrinsics, Object, Rigid3};
use mb_image::Image;
use mb_render::View;
use nalgebra::Point3;
use rayon::prelude::*;

use crate::light::tangents;
use crate::random::{hash, unit};
use crate::stage::{LIFT_M, REACH_M, Stage, ray};

/// How finely light is traced.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tracing {
    /// Photograph pixels from probe to probe.
    pub stride: usize,
    /// Rays into the room for each probe.
    pub ambient_rays: u32,
    /// Rays to the window for each probe.
    pub shadow_rays: u32,
    /// Whether light that bounces off another surface is itself shadowed.
    pub shadowed_bounce: bool,
}

/// Light that arrives at a point of a surface.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Arriving {
    /// Irradiance from the room and from other surfaces, divided by pi.
    pub ambient: Vec3,
    /// Share of the half space that leads out of the set, weighted like irradiance, 0 to 1.
    pub open: f32,
    /// Share of the window that is seen, 0 to 1.
    pub window: f32,
}

#[derive(Debug, Clone, Copy)]
struct Probe {
    place: Vec3,
    normal: Vec3,
    /// Pixel footprint at the probe, metres; 0 marks a probe that hit nothing.
    footprint: f32,
    arriving: Arriving,
}

/// The probes of one photograph.
pub(crate) struct Probes<'a> {
    stage: &'a Stage,
    tracing: Tracing,
    /// The camera that sees probe `(i, j)` at pixel `(i, j)`.
    view: View<Object>,
    probes: Image<Probe>,
    salt: u32,
}

/// Point `i` of `n` of a rotated Fibonacci lattice in the unit square: even coverage for any small n.
fn lattice(i: u32, n: u32, turn: (f32, f32)) -> (f32, f32) {
    const GOLDEN: f32 = 0.618_034;
    let u = (i as f32 + 0.5) / n as f32 + turn.0 / n as f32;
    let v = i as f32 * GOLDEN + turn.1;
    (u - u.floor(), v - v.floor())
}

/// Traces the light that arrives at a point; `noise` decorrelates the rays of different points.
pub(crate) fn trace(stage: &Stage, tracing: Tracing, place: Vec3, normal: Vec3, noise: u32) -> Arriving {
    let turn = (unit(noise), unit(hash(noise as i32, 1, 2)));
    let (a, b) = tangents(normal);
    let light = &stage.light;
    let start = place + normal * LIFT_M;
    // Each ray stands for its share of the half space.
    let blur = (2.0 / tracing.ambient_rays as f32).sqrt();
    let (mut ambient, mut open) = (Vec3::ZERO, 0.0);
    for i in 0..tracing.ambient_rays {
        let (u, v) = lattice(i, tracing.ambient_rays, turn);
        let (sin, cos) = (2.0 * PI * v).sin_cos();
        let towards = (a * cos + b * sin) * u.sqrt() + normal * (1.0 - u).sqrt();
        let glimpse = stage.glimpse(start, towards, tracing.shadowed_bounce, 0.3 * blur);
        ambient += glimpse.radiance;
        open += f32::from(u8::from(glimpse.free));
    }
    let mut seen = 0.0;
    // Towards the window from behind: no ray needed.
    if light.may_light(normal) {
        for i in 0..tracing.shadow_rays {
            let (u, v) = lattice(i, tracing.shadow_rays, (turn.1, turn.0));
            let towards = light.towards_window(u, v);
            if normal.dot(towards) > 0.0 && !stage.bvh.occluded(&ray(start, towards), REACH_M) {
                seen += 1.0;
            }
        }
    }
    let rays = tracing.ambient_rays as f32;
    Arriving { ambient: ambient / rays, open: open / rays, window: seen / tracing.shadow_rays as f32 }
}

impl<'a> Probes<'a> {
    /// Traces the probes of a view. `salt` differs from frame to frame.
    pub fn new(stage: &'a Stage, view: &View<Object>, tracing: Tracing, salt: u32) -> Self {
        let coarse_size = mb_geometry::ImageSize::new(
            view.size.width.div_ceil(tracing.stride) + 1,
            view.size.height.div_ceil(tracing.stride) + 1,
        );
        // Probe (i, j) lies at pixel (i, j) * stride exactly.
        let s = tracing.stride as f64;
        let k = view.intrinsics;
        let intrinsics = Intrinsics { fx: k.fx / s, fy: k.fy / s, cx: k.cx / s, cy: k.cy / s };
        let coarse = View { intrinsics, size: coarse_size, cam_from_frame: view.cam_from_frame };
        let raster = stage.scene.render(&coarse);
        let object_from_cam: Rigid3<Object, _> = view.cam_from_frame.inverse();
        let camera = object_from_cam.translation();
        let camera = Vec3::new(camera.x as f32, camera.y as f32, camera.z as f32);
        let width = coarse_size.width;
        let traced: Vec<Probe> = (0..coarse_size.pixels())
            .into_par_iter()
            .map(|i| {
                let (x, y) = (i % width, i / width);
                let z = f64::from(raster.depth[(x, y)]);
                let none =
                    Probe { place: Vec3::ZERO, normal: Vec3::ZERO, footprint: 0.0, arriving: Arriving::default() };
                if z <= 0.0 {
                    return none;
                }
                let p = object_from_cam * intrinsics.cam_from_img(&nalgebra::Point2::new(x as f64, y as f64), z);
                let place = crate::stage::vec3(&p);
                let normal = stage.normal(raster.triangle[(x, y)], place, (camera - place).normalize());
                let arriving = trace(stage, tracing, place, normal, hash(x as i32, y as i32, salt));
                Probe { place, normal, footprint: (z / intrinsics.fx) as f32, arriving }
            })
            .collect();
        let traced = Image::from_data(coarse_size, traced).expect("one probe for each coarse pixel");
        let mut probes = Self { stage, tracing, view: coarse, probes: traced, salt };
        probes.filter();
        probes
    }

    /// Averages each probe with its 5 x 5 neighbours on the same surface.
    fn filter(&mut self) {
        let size = self.probes.size();
        let old = &self.probes;
        let filtered: Vec<Probe> = (0..size.pixels())
            .into_par_iter()
            .map(|i| {
                let (x, y) = (i % size.width, i / size.width);
                let mut probe = old[(x, y)];
                let (mut sum, mut open, mut window, mut total) = (Vec3::ZERO, 0.0, 0.0, 0.0);
                for ny in y.saturating_sub(2)..(y + 3).min(size.height) {
                    for nx in x.saturating_sub(2)..(x + 3).min(size.width) {
                        let other = &old[(nx, ny)];
                        let weight = affinity(&probe, other.place, other.normal) * f32::from(other.footprint > 0.0);
                        // Shadows keep their edges: half the reach.
                        let near = nx.abs_diff(x) <= 1 && ny.abs_diff(y) <= 1;
                        sum += other.arriving.ambient * weight;
                        open += other.arriving.open * weight;
                        total += weight;
                        if near {
                            window += other.arriving.window * weight;
                        }
                    }
                }
                let near_total: f32 = (y.saturating_sub(1)..(y + 2).min(size.height))
                    .flat_map(|ny| (x.saturating_sub(1)..(x + 2).min(size.width)).map(move |nx| (nx, ny)))
                    .map(|at| {
                        let other = &old[at];
                        affinity(&probe, other.place, other.normal) * f32::from(other.footprint > 0.0)
                    })
                    .sum();
                if total > 0.0 && near_total > 0.0 {
                    probe.arriving = Arriving { ambient: sum / total, open: open / total, window: window / near_total };
                }
                probe
            })
            .collect();
        self.probes = Image::from_data(size, filtered).expect("as many probes as before");
    }

    /// The light at `place` with `normal`.
    pub fn at(&self, place: Vec3, normal: Vec3) -> Arriving {
        let size = self.probes.size();
        let in_frame = Point3::new(f64::from(place.x), f64::from(place.y), f64::from(place.z));
        let pixel = self.view.intrinsics.img_from_cam(&(self.view.cam_from_frame * in_frame));
        let (u, v) = pixel.map_or((0.0, 0.0), |p| ((p.x as f32).max(0.0), (p.y as f32).max(0.0)));
        let (i, j) = ((u as usize).min(size.width - 2), (v as usize).min(size.height - 2));
        let (fu, fv) = ((u - i as f32).min(1.0), (v - j as f32).min(1.0));
        let (mut sum, mut total) = (Arriving::default(), 0.0);
        for (di, wu) in [(0, 1.0 - fu), (1, fu)] {
            for (dj, wv) in [(0, 1.0 - fv), (1, fv)] {
                let probe = &self.probes[(i + di, j + dj)];
                let weight = (wu * wv).max(0.01) * affinity(probe, place, normal);
                sum.ambient += probe.arriving.ambient * weight;
                sum.open += probe.arriving.open * weight;
                sum.window += probe.arriving.window * weight;
                total += weight;
            }
        }
        if total > 0.02 {
            return Arriving { ambient: sum.ambient / total, open: sum.open / total, window: sum.window / total };
        }
        trace(self.stage, self.tracing, place, normal, hash((u * 64.0) as i32, (v * 64.0) as i32, self.salt))
    }
}

/// How far a probe speaks for a place: 1 on the same smooth surface, falling to 0 off its plane or round an edge.
fn affinity(probe: &Probe, place: Vec3, normal: Vec3) -> f32 {
    if probe.footprint <= 0.0 {
        return 0.0;
    }
    let off_plane = (place - probe.place).dot(probe.normal) / (0.7 * probe.footprint);
    let off = (1.0 - off_plane * off_plane).max(0.0);
    let turn = probe.normal.dot(normal).max(0.0);
    off * turn * turn * turn * turn
}
