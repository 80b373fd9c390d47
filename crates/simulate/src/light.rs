//! The light in the room: one large window, and the walls, furniture and ceiling that it lights.
//!
//! Radiances are relative to a white surface fully lit by the window, which has radiance about 1. Everything here is
//! far away: it depends on the direction alone.

use std::f32::consts::PI;

use glam::Vec3;
use mb_job::rng;
use rand::RngExt;

use crate::random::{hash, unit};
use crate::streams;

/// A window with a bar down its middle, and a room round it.
#[derive(Debug, Clone)]
pub(crate) struct Light {
    /// Unit direction towards the middle of the window (object frame, y up).
    pub window: Vec3,
    /// Axes of the window in the plane at unit distance: level, and upwards.
    axes: (Vec3, Vec3),
    /// Half width and half height of the window at unit distance.
    half: (f32, f32),
    /// Irradiance of a surface that faces the unoccluded window, divided by pi.
    pub window_strength: Vec3,
    /// Radiance of the panes.
    pane: Vec3,
    ceiling: Vec3,
    wall: Vec3,
    floor: Vec3,
    salt: u32,
}

/// An orthonormal pair perpendicular to the unit vector `n` (Duff et al. 2017).
pub(crate) fn tangents(n: Vec3) -> (Vec3, Vec3) {
    let sign = 1.0f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    (Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x), Vec3::new(b, sign + n.y * n.y * a, -n.y))
}

/// The share of a blur of width `blur` about `x` that lies within `[-half, half]`.
fn within(x: f32, half: f32, blur: f32) -> f32 {
    let rise = |v: f32| v / (v * v + blur * blur).sqrt();
    0.5 * (rise(x + half) - rise(x - half))
}

/// Half of the width of the bar, as a share of the window's half width.
const BAR: f32 = 0.06;
/// Pieces of furniture, doors and pictures along the walls.
const PANELS: f32 = 11.0;

impl Light {
    pub fn new(seed: u64) -> Self {
        let mut rng = rng(seed, streams::LIGHT);
        let azimuth = rng.random_range(0.0..2.0 * PI);
        let elevation = rng.random_range(0.55..0.95f32);
        let warmth = rng.random_range(-0.06..0.06f32);
        let window = Vec3::new(elevation.cos() * azimuth.cos(), elevation.sin(), elevation.cos() * azimuth.sin());
        let level = Vec3::Y.cross(window).normalize();
        let half = (rng.random_range(0.22..0.40f32), rng.random_range(0.16..0.28f32));
        let window_strength = rng.random_range(0.55..0.85f32) * Vec3::new(1.0 + warmth, 1.0, 1.0 - warmth);
        let solid_angle = 4.0 * half.0 * half.1 * (1.0 - BAR);
        Self {
            window,
            axes: (level, window.cross(level)),
            half,
            window_strength,
            pane: window_strength * (PI / solid_angle),
            ceiling: rng.random_range(0.34..0.46f32) * Vec3::new(1.03, 1.0, 0.96),
            wall: rng.random_range(0.18..0.28f32) * Vec3::new(1.02, 1.0, 0.97),
            floor: rng.random_range(0.08..0.16f32) * Vec3::new(1.1, 1.0, 0.85),
            salt: seed as u32 ^ 0x3C6E,
        }
    }

    /// Radiance that arrives from direction `d` out of the room, the window itself left out, seen through a blur of
    /// `blur` radians.
    pub fn room(&self, d: Vec3, blur: f32) -> Vec3 {
        let towards_window = 0.5 + 0.5 * d.dot(self.window);
        let lit = 0.7 + 0.6 * towards_window * towards_window;
        let soft = 0.08 + blur;
        // Walls reach from the floor, a little below the table, to the ceiling.
        let above = 0.5 + 0.5 * (d.y - 0.62) / ((d.y - 0.62).powi(2) + soft * soft).sqrt();
        let below = 0.5 - 0.5 * (d.y + 0.18) / ((d.y + 0.18).powi(2) + soft * soft).sqrt();
        let along = d.z.atan2(d.x) * (PANELS / (2.0 * PI));
        let panel = along.round();
        let own = hash((panel.rem_euclid(PANELS)) as i32, 3, self.salt);
        let shade = 1.8 * unit(own) - 0.8;
        let (width, top) = (0.2 + 0.25 * unit(own ^ 0x9E), 0.15 + 0.4 * unit(own ^ 0x51F));
        let soft = (0.02 + blur) * PANELS / (2.0 * PI);
        let covered = within(along - panel, width, soft) * within(d.y, top, 0.02 + blur);
        let wall = self.wall * (1.0 - covered * (0.25 + 0.6 * shade));
        (wall + (self.ceiling - wall) * above + (self.floor - wall) * below) * lit
    }

    /// Radiance of the window from direction `d`, seen through a blur of `blur` radians.
    pub fn panes(&self, d: Vec3, blur: f32) -> Vec3 {
        let ahead = d.dot(self.window);
        if ahead <= 0.05 {
            return Vec3::ZERO;
        }
        let (u, v) = (d.dot(self.axes.0) / ahead, d.dot(self.axes.1) / ahead);
        let blur = blur.max(0.004);
        let open = within(u, self.half.0, blur) - within(u, BAR * self.half.0, blur);
        self.pane * (open * within(v, self.half.1, blur))
    }

    /// The direction to a point of the window, for `(u, v)` uniform in the unit square.
    pub fn towards_window(&self, u: f32, v: f32) -> Vec3 {
        let (x, y) = ((2.0 * u - 1.0) * self.half.0, (2.0 * v - 1.0) * self.half.1);
        (self.window + self.axes.0 * x + self.axes.1 * y).normalize()
    }

    /// Whether a surface with this normal can see any of the window.
    pub fn may_light(&self, normal: Vec3) -> bool {
        normal.dot(self.window) > -self.half.0.hypot(self.half.1)
    }
}

/// Share of light that a surface of refractive index 1.54 (ABS) mirrors (Schlick 1994).
pub(crate) fn fresnel(cos: f32) -> f32 {
    const STRAIGHT: f32 = 0.045;
    STRAIGHT + (1.0 - STRAIGHT) * (1.0 - cos.clamp(0.0, 1.0)).powi(5)
}

/// A normal of the facets of a surface of GGX roughness `alpha` that `view` sees, for `(u, v)` uniform in the unit square
/// (Heitz 2018).
pub(crate) fn visible_facet(normal: Vec3, view: Vec3, alpha: f32, (u, v): (f32, f32)) -> Vec3 {
    let (a, b) = tangents(normal);
    let seen = Vec3::new(alpha * view.dot(a), alpha * view.dot(b), view.dot(normal).max(1e-4)).normalize();
    let flat = seen.x * seen.x + seen.y * seen.y;
    let first = if flat > 0.0 { Vec3::new(-seen.y, seen.x, 0.0) / flat.sqrt() } else { Vec3::X };
    let second = seen.cross(first);
    let radius = u.sqrt();
    let (sin, cos) = (2.0 * PI * v).sin_cos();
    let (p, q) = (radius * cos, radius * sin);
    let share = 0.5 * (1.0 + seen.z);
    let q = (1.0 - share) * (1.0 - p * p).max(0.0).sqrt() + share * q;
    let facet = first * p + second * q + seen * (1.0 - p * p - q * q).max(0.0).sqrt();
    (a * (alpha * facet.x) + b * (alpha * facet.y) + normal * facet.z.max(1e-6)).normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tangents_are_orthonormal() {
        for n in [Vec3::X, Vec3::Z, -Vec3::Z, Vec3::new(0.48, -0.6, 0.64)] {
            let (a, b) = tangents(n);
            for (v, expected) in [(a.dot(b), 0.0), (a.dot(n), 0.0), (a.length(), 1.0), (a.cross(b).dot(n), 1.0)] {
                assert!((v - expected).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn the_window_that_is_sampled_is_the_one_that_is_mirrored() {
        // The irradiance of a surface that faces the window, from its panes over the sphere, is its strength times pi.
        let light = Light::new(4);
        let (a, b) = tangents(light.window);
        let (steps, reach) = (600, 1.0f32);
        let cell = (2.0 * reach / steps as f32).powi(2);
        let mut sum = Vec3::ZERO;
        for i in 0..steps * steps {
            let at = |k: usize| (2.0 * (k as f32 + 0.5) / steps as f32 - 1.0) * reach;
            let off = a * at(i % steps) + b * at(i / steps);
            let d = (light.window + off).normalize();
            let cos = d.dot(light.window);
            // A cell at unit distance spans cos^3 of its area, and the surface sees it at cos.
            sum += light.panes(d, 0.0) * (cell * cos.powi(4));
        }
        let ratio = sum / (light.window_strength * PI);
        assert!((0.9..1.01).contains(&ratio.y), "{ratio}");
        for i in 0..64 {
            let d = light.towards_window(0.05 + 0.05 * (i % 8) as f32, 0.05 + 0.12 * (i / 8) as f32);
            assert!(light.panes(d, 0.0).y > 0.4 * light.pane.y);
        }
    }

    #[test]
    fn rough_surfaces_mirror_a_wider_and_weaker_window() {
        let light = Light::new(1);
        let off = (light.window + light.axes.0 * (1.5 * light.half.0)).normalize();
        assert!(light.panes(off, 0.3).y > 10.0 * light.panes(off, 0.01).y.max(1e-6));
        assert!(light.panes(light.window + light.axes.0 * 0.1, 0.3).y < light.pane.y);
        assert_eq!(light.panes(-light.window, 0.3), Vec3::ZERO);
    }

    #[test]
    fn facets_of_a_smooth_surface_lie_near_its_normal() {
        let normal = Vec3::new(0.36, 0.8, 0.48);
        let view = Vec3::new(0.6, 0.64, 0.48).normalize();
        for i in 0..64 {
            let place = ((i % 8) as f32 / 8.0, (i / 8) as f32 / 8.0);
            assert!(visible_facet(normal, view, 0.01, place).dot(normal) > 0.98);
            assert!(visible_facet(normal, view, 0.5, place).dot(view) > 0.0);
        }
    }
}
