//! The light in the room: one large window and the walls and ceiling that it lights.
//!
//! Radiances are relative to a white surface fully lit by the window, which has radiance about 1.

use std::f32::consts::PI;

use glam::Vec3;
use mb_job::rng;
use rand::RngExt;

use crate::streams;

/// A window seen from the table as a round patch of sky, and a room round it.
#[derive(Debug, Clone)]
pub(crate) struct Light {
    /// Unit direction towards the middle of the window (object frame, y up).
    pub window: Vec3,
    /// Angular radius of the window.
    pub window_radius_rad: f32,
    /// Irradiance of a surface that faces the unoccluded window, divided by pi.
    pub window_strength: Vec3,
    ceiling: Vec3,
    wall: Vec3,
}

/// An orthonormal pair perpendicular to the unit vector `n` (Duff et al. 2017).
pub(crate) fn tangents(n: Vec3) -> (Vec3, Vec3) {
    let sign = 1.0f32.copysign(n.z);
    let a = -1.0 / (sign + n.z);
    let b = n.x * n.y * a;
    (Vec3::new(1.0 + sign * n.x * n.x * a, sign * b, -sign * n.x), Vec3::new(b, sign + n.y * n.y * a, -n.y))
}

impl Light {
    pub fn new(seed: u64) -> Self {
        let mut rng = rng(seed, streams::LIGHT);
        let azimuth = rng.random_range(0.0..2.0 * PI);
        let elevation = rng.random_range(0.65..1.05f32);
        let warmth = rng.random_range(-0.06..0.06f32);
        Self {
            window: Vec3::new(elevation.cos() * azimuth.cos(), elevation.sin(), elevation.cos() * azimuth.sin()),
            window_radius_rad: rng.random_range(0.14..0.30),
            window_strength: rng.random_range(0.55..0.85f32) * Vec3::new(1.0 + warmth, 1.0, 1.0 - warmth),
            ceiling: rng.random_range(0.42..0.55f32) * Vec3::new(1.03, 1.0, 0.96),
            wall: rng.random_range(0.22..0.34f32) * Vec3::new(1.02, 1.0, 0.97),
        }
    }

    /// Radiance that arrives from direction `d` out of the room, the window itself left out.
    pub fn room(&self, d: Vec3) -> Vec3 {
        let height = (0.5 + 0.9 * d.y).clamp(0.0, 1.0);
        let towards_window = 0.5 + 0.5 * d.dot(self.window);
        (self.wall + (self.ceiling - self.wall) * height * height) * (0.7 + 0.6 * towards_window * towards_window)
    }

    /// The direction to a point of the window, for `(u, v)` uniform in the unit square.
    pub fn towards_window(&self, u: f32, v: f32) -> Vec3 {
        let (a, b) = tangents(self.window);
        let radius = u.sqrt() * self.window_radius_rad.tan();
        let (sin, cos) = (2.0 * PI * v).sin_cos();
        (self.window + (a * cos + b * sin) * radius).normalize()
    }

    /// Radiance that a glossy surface of refractive index 1.5 mirrors from the unoccluded window towards `view`: GGX
    /// with Smith's shadowing (Walter et al. 2007) at the representative point of the window (Karis 2013).
    pub fn highlight(&self, normal: Vec3, view: Vec3, roughness: f32) -> Vec3 {
        let mirrored = 2.0 * normal.dot(view) * normal - view;
        // Move the light to the point of the window nearest to the mirrored ray.
        let off = mirrored - self.window * mirrored.dot(self.window);
        let reach = self.window_radius_rad.sin();
        let towards = (self.window + off * (reach / off.length().max(reach)).min(1.0)).normalize();
        let (n_l, n_v) = (normal.dot(towards), normal.dot(view).max(1e-3));
        if n_l <= 0.0 {
            return Vec3::ZERO;
        }
        let half = (towards + view).normalize();
        let n_h = normal.dot(half).clamp(0.0, 1.0);
        let alpha = roughness * roughness;
        let alpha_sq = alpha * alpha;
        let spread = n_h * n_h * (alpha_sq - 1.0) + 1.0;
        // The wider the window, the wider and weaker the lobe.
        let widened = (alpha + 0.5 * reach).min(1.0);
        let distribution = alpha_sq / (PI * spread * spread) * (alpha / widened).powi(2);
        let k = 0.5 * alpha;
        let shadowing = 1.0 / ((n_l * (1.0 - k) + k) * (n_v * (1.0 - k) + k));
        let reflected = fresnel(half.dot(view));
        self.window_strength * (PI * 0.25 * distribution * shadowing * reflected * n_l)
    }
}

/// Share of light that a surface of refractive index 1.5 mirrors (Schlick 1994).
pub(crate) fn fresnel(cos: f32) -> f32 {
    0.04 + 0.96 * (1.0 - cos.clamp(0.0, 1.0)).powi(5)
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
    fn samples_of_the_window_lie_within_it() {
        let light = Light::new(4);
        for i in 0..64 {
            let d = light.towards_window((i % 8) as f32 / 7.0, (i / 8) as f32 / 8.0);
            let off_rad = d.cross(light.window).length().asin();
            assert!(off_rad <= light.window_radius_rad + 1e-3, "{off_rad} off a window of {}", light.window_radius_rad);
        }
    }

    #[test]
    fn the_highlight_is_brightest_in_the_mirror_direction() {
        let light = Light { window: Vec3::new(0.6, 0.8, 0.0), ..Light::new(0) };
        let at = |view: Vec3| light.highlight(Vec3::Y, view.normalize(), 0.25).y;
        let mirror = at(Vec3::new(-0.6, 0.8, 0.0));
        assert!(mirror > 4.0 * at(Vec3::new(0.2, 0.8, 0.0)) && mirror > 4.0 * at(Vec3::new(-0.6, 0.8, 0.9)));
        assert_eq!(light.highlight(-Vec3::Y, Vec3::new(0.0, -1.0, 0.0), 0.25), Vec3::ZERO);
    }
}
