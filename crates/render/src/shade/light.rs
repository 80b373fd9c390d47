//! The sky: far lamps with depth maps.

use mb_geometry::Aabb;
use mb_image::DepthImage;
use nalgebra::{Point3, Vector3};

use super::outside_view;
use crate::{Scene, View};

/// Side of a depth map.
const PIXELS: usize = 512;
/// Lamps spread over the sky, and lamps that make up the sun.
const SKY_LAMPS: usize = 40;
const SUN_LAMPS: usize = 12;
/// Share of the light on a level surface that comes from the sun.
const SUN_SHARE: f64 = 0.5;
/// Half the sun's width: larger is softer.
const SUN_RADIUS_RAD: f64 = 0.12;
/// Light on a level surface in the open; a little above 1, so that white bricks look white.
const EXPOSURE: f64 = 1.05;
/// Light that reaches even a closed corner.
const FLOOR: f64 = 0.06;

/// Only the lamps know this frame.
enum Lit {}

struct Lamp {
    /// Towards the lamp, of unit length.
    direction: Vector3<f64>,
    weight: f64,
    view: View<Lit>,
    depth: DepthImage,
}

pub(super) struct Sky {
    lamps: Vec<Lamp>,
    /// Width of a depth map's pixel at the mesh, metres.
    texel: f64,
}

impl Sky {
    /// Lights a scene; the sun stands behind the left shoulder of somebody who looks along `forward`.
    pub(super) fn new(scene: &Scene, bounds: &Aabb, up: &Vector3<f64>, forward: &Vector3<f64>) -> Self {
        if bounds.is_empty() {
            return Self { lamps: Vec::new(), texel: 0.0 };
        }
        let middle = bounds.center();
        let radius = (0.5 * bounds.extent().norm()).max(1e-9);
        let level = (forward - up * forward.dot(up)).try_normalize(1e-6).unwrap_or(if up.x.abs() < 0.9 {
            up.cross(&Vector3::x()).normalize()
        } else {
            Vector3::z()
        });
        let right = level.cross(up);
        let sun = (up * 1.15 - level * 0.55 - right * 0.75).normalize();
        let (sun_x, sun_y) = (sun.cross(up).normalize(), sun.cross(&sun.cross(up).normalize()));

        // Golden-angle spirals: even, and the same each time.
        let spiral = |i: usize, n: usize| (i as f64 * 2.399_963_229_728_653, (i as f64 + 0.5) / n as f64);
        let mut directions = Vec::new();
        for i in 0..SKY_LAMPS {
            let (angle, share) = spiral(i, SKY_LAMPS);
            // Some light comes from a little below the horizon, as from a bright table.
            let height = 1.0 - 1.25 * share;
            let across = (1.0 - height * height).sqrt();
            let direction = up * height + (level * angle.cos() + right * angle.sin()) * across;
            directions.push((direction, if height > 0.0 { 0.6 + 0.4 * height } else { 0.35 }));
        }
        let on_level = |lamps: &[(Vector3<f64>, f64)]| lamps.iter().map(|(d, w)| w * d.dot(up).max(0.0)).sum::<f64>();
        let sky_scale = (1.0 - SUN_SHARE) / on_level(&directions);
        directions.iter_mut().for_each(|(_, weight)| *weight *= sky_scale);
        let sun_lamps: Vec<(Vector3<f64>, f64)> = (0..SUN_LAMPS)
            .map(|i| {
                let (angle, share) = spiral(i, SUN_LAMPS);
                let off = SUN_RADIUS_RAD * share.sqrt();
                ((sun + (sun_x * angle.cos() + sun_y * angle.sin()) * off).normalize(), 1.0)
            })
            .collect();
        let sun_scale = SUN_SHARE / on_level(&sun_lamps);
        directions.extend(sun_lamps.into_iter().map(|(d, w)| (d, w * sun_scale)));

        let lamps = directions
            .into_iter()
            .map(|(direction, weight)| {
                let view: View<Lit> = outside_view(&middle, radius, &direction, PIXELS);
                let depth = scene.depth(&view);
                Lamp { direction, weight, view, depth }
            })
            .collect();
        Self { lamps, texel: 2.0 * radius / PIXELS as f64 }
    }

    /// Light that reaches a point with the flat normal `flat` and the shading normal `normal`, both towards the viewer.
    pub(super) fn light(&self, p: &Point3<f64>, flat: &Vector3<f64>, normal: &Vector3<f64>) -> f64 {
        let mut sum = 0.0;
        for lamp in &self.lamps {
            let cosine = lamp.direction.dot(normal);
            if cosine > 0.0 && lamp.direction.dot(flat) > 0.0 {
                sum += lamp.weight * cosine * self.visible(lamp, p, flat);
            }
        }
        EXPOSURE * (FLOOR + (1.0 - FLOOR) * sum)
    }

    /// Share of the light on the open ground that does not reach the point `p` of it.
    pub(super) fn shadow(&self, p: &Point3<f64>, up: &Vector3<f64>) -> f64 {
        let (mut all, mut missing) = (0.0, 0.0);
        for lamp in &self.lamps {
            let light = lamp.weight * lamp.direction.dot(up);
            if light > 0.0 {
                all += light;
                missing += light * (1.0 - self.visible(lamp, p, up));
            }
        }
        if all > 0.0 { missing / all } else { 0.0 }
    }

    /// Share of the lamp that is seen from `p`, smoothed over four pixels of its depth map.
    fn visible(&self, lamp: &Lamp, p: &Point3<f64>, normal: &Vector3<f64>) -> f64 {
        // Off the surface, and towards the lamp, by what a pixel of the map may be wrong.
        let off = p + normal * (1.5 * self.texel);
        let in_lamp = lamp.view.cam_from_frame * off;
        let Some(pixel) = lamp.view.intrinsics.img_from_cam(&in_lamp) else { return 1.0 };
        let limit = (in_lamp.z - 0.5 * self.texel) as f32;
        let (x, y) = (pixel.x.floor(), pixel.y.floor());
        let (sx, sy) = (pixel.x - x, pixel.y - y);
        let mut seen = 0.0;
        for (dx, dy, weight) in [
            (0.0, 0.0, (1.0 - sx) * (1.0 - sy)),
            (1.0, 0.0, sx * (1.0 - sy)),
            (0.0, 1.0, (1.0 - sx) * sy),
            (1.0, 1.0, sx * sy),
        ] {
            let (x, y) = (x + dx, y + dy);
            let inside = x >= 0.0 && y >= 0.0;
            let blocked = inside && lamp.depth.get(x as usize, y as usize).is_some_and(|&z| z > 0.0 && z < limit);
            if !blocked {
                seen += weight;
            }
        }
        seen
    }
}
