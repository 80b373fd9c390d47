//! Procedural surfaces: what the model stands on and what lies round it.
//!
//! Colours are linear-light albedos with the proportions of sRGB primaries; places are metres in the plane of the
//! surface. Detail that a pixel (`pixel_m` on the surface) cannot hold fades to its mean, so that cloth far away does
//! not shimmer.

mod cloth;
mod print;
mod stone;
mod wood;

use glam::Vec3;

use crate::Table;
use crate::random::{fractal, noise};

/// Colour and finish of a surface at a place.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Finish {
    /// Diffuse albedo, linear light.
    pub albedo: Vec3,
    /// GGX roughness (alpha is its square).
    pub roughness: f32,
    /// How much of the mirroring of a closed coat the surface has, 0 to 1.
    pub coat: f32,
    /// Slope of the surface along its two axes, for fine relief.
    pub slope: (f32, f32),
}

/// An albedo from 8-bit sRGB.
pub(crate) fn linear_from_srgb(color: [u8; 3]) -> Vec3 {
    Vec3::from(color.map(|v| {
        let v = f32::from(v) / 255.0;
        if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
    }))
}

fn mix(a: Vec3, b: Vec3, t: f32) -> Vec3 {
    a + (b - a) * t.clamp(0.0, 1.0)
}

fn smoothstep(low: f32, high: f32, v: f32) -> f32 {
    let t = ((v - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// How much of a noise whose lattice is `lattice_m` wide a pixel of size `pixel_m` still shows, 0 to 1.
fn kept(lattice_m: f32, pixel_m: f32) -> f32 {
    smoothstep(0.35, 1.0, lattice_m / pixel_m)
}

/// The surface that the model stands on, at `(x, y)` metres from the middle of the table.
pub(crate) fn table(kind: Table, at: (f32, f32), pixel_m: f32, half_extent_m: (f32, f32), salt: u32) -> Finish {
    let finish = match kind {
        Table::Bamboo => wood::bamboo(at, pixel_m, half_extent_m, salt),
        Table::Oak => wood::oak(at, pixel_m, salt),
        Table::Gingham => cloth::gingham(at, pixel_m, salt),
        Table::Linen => cloth::linen(at, pixel_m, salt),
        Table::Marble => stone::marble(at, pixel_m, salt),
        Table::Newspaper => print::newspaper(at, pixel_m, salt),
    };
    // Where light and dark patterns meet, their product may leave what a surface can have.
    Finish { albedo: finish.albedo.clamp(Vec3::splat(0.01), Vec3::splat(0.9)), ..finish }
}

/// What lies below and beyond the table: the coarse cover of a sofa, or a carpet.
pub(crate) fn surroundings(at: (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    cloth::cover(at, pixel_m, salt)
}

/// A painted wall: nearly even.
pub(crate) fn plaster((x, y): (f32, f32), salt: u32) -> Finish {
    let shade = 0.9 + 0.08 * fractal(x * 6.0, y * 6.0, 3, 0.5, salt) + 0.04 * noise(x * 300.0, y * 300.0, salt);
    Finish { albedo: Vec3::new(0.52, 0.50, 0.46) * shade, roughness: 0.9, coat: 0.2, slope: (0.0, 0.0) }
}

/// The bare edge of a table top.
pub(crate) fn edge(at: (f32, f32), salt: u32) -> Finish {
    wood::edge(at, salt)
}

/// A printed thing at the edge of the scene.
pub(crate) fn clutter(base: Vec3, at: (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    print::booklet(base, at, pixel_m, salt)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_table_has_believable_albedo_and_detail_to_hold_on_to() {
        for kind in Table::ALL {
            let samples: Vec<f32> = (0..90_000)
                .map(|i| {
                    let (x, y) = ((i % 300) as f32 * 0.0003, (i / 300) as f32 * 0.0003);
                    let finish = table(kind, (x, y), 2e-4, (0.4, 0.3), 5);
                    assert!(finish.albedo.min_element() >= 0.0 && finish.albedo.max_element() <= 1.0, "{kind:?}");
                    finish.albedo.y
                })
                .collect();
            let mean = samples.iter().sum::<f32>() / samples.len() as f32;
            let spread = (samples.iter().map(|s| (s - mean).powi(2)).sum::<f32>() / samples.len() as f32).sqrt();
            assert!(spread / mean > 0.12, "{kind:?}: contrast {}", spread / mean);
        }
    }

    #[test]
    fn detail_fades_to_its_mean() {
        // What a coarse pixel sees is about the mean of what fine ones see.
        for kind in Table::ALL {
            let mean = |pixel_m: f32| {
                let sum: f32 = (0..40_000)
                    .map(|i| ((i % 200) as f32 * 0.0004 + 0.1, (i / 200) as f32 * 0.0004 + 0.05))
                    .map(|at| table(kind, at, pixel_m, (0.4, 0.3), 5).albedo.y)
                    .sum();
                sum / 40_000.0
            };
            let (fine, coarse) = (mean(5e-5), mean(5e-3));
            assert!((coarse / fine - 1.0).abs() < 0.12, "{kind:?}: {fine} and {coarse}");
        }
    }
}
