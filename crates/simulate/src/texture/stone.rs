//! Stone: polished marble.

use glam::Vec3;

use super::{Finish, kept, mix, smoothstep};
use crate::random::{fractal, noise};

/// A polished slab of veined marble.
pub(super) fn marble((x, y): (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    // Veins are the zeros of a warped noise, in two sizes.
    let warp = |s: f32, k: u32| fractal(x * s, y * s, 4, 0.55, salt ^ k) - 0.5;
    let (wx, wy) = (0.06 * warp(14.0, 1), 0.06 * warp(14.0, 2));
    let vein = |scale: f32, width: f32, k: u32| {
        let v = (fractal((x + wx) * scale, (y + wy) * scale * 1.7, 3, 0.5, salt ^ k) - 0.5).abs();
        smoothstep(width, 0.0, v)
    };
    let cloud = fractal((x + wx) * 9.0, (y + wy) * 9.0, 5, 0.6, salt ^ 4);
    let mut color = mix(Vec3::new(0.74, 0.72, 0.69), Vec3::new(0.38, 0.38, 0.40), smoothstep(0.35, 0.75, cloud));
    color = mix(color, Vec3::new(0.16, 0.15, 0.15), 0.75 * vein(11.0, 0.035, 5));
    color = mix(color, Vec3::new(0.30, 0.25, 0.20), 0.55 * vein(31.0, 0.05, 6));
    color = mix(color, Vec3::new(0.45, 0.44, 0.43), 0.5 * vein(90.0, 0.07, 7));
    // Crystals.
    for (lattice_m, strength) in [(0.0011f32, 0.34), (0.00045, 0.42), (0.00025, 0.42)] {
        let seen = kept(lattice_m, pixel_m);
        if seen > 0.0 {
            color *= 1.0 + seen * strength * (noise(x / lattice_m, y / lattice_m, salt ^ 8) - 0.5);
        }
    }
    Finish { albedo: color, roughness: 0.22, coat: 1.0, slope: (0.0, 0.0) }
}
