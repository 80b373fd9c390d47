//! Procedural surfaces: what the model stands on and what lies round it.
//!
//! Colours are linear-light albedos with the proportions of sRGB primaries; places are metres in the plane of the
//! surface. Detail that a pixel (`pixel_m` on the surface) cannot hold fades to its mean, so that cloth far away does
//! not shimmer.

use glam::Vec3;

use crate::Table;
use crate::random::{fractal, hash, noise, unit};

/// Colour and finish of a surface at a place.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Finish {
    /// Diffuse albedo, linear light.
    pub albedo: Vec3,
    /// GGX roughness (alpha is its square).
    pub roughness: f32,
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

/// How much of a detail of size `period_m` a pixel of size `pixel_m` still shows, 0 to 1.
fn kept(period_m: f32, pixel_m: f32) -> f32 {
    smoothstep(1.2, 3.0, period_m / pixel_m)
}

/// Wood in strips along x: each strip has its tone, is pieced together from lengths, and carries grain, stains and
/// (bamboo) nodes.
struct Planks {
    width_m: f32,
    length_m: f32,
    light: Vec3,
    dark: Vec3,
    grain: f32,
    nodes: bool,
}

impl Planks {
    fn albedo(&self, x: f32, y: f32, pixel_m: f32, salt: u32) -> Vec3 {
        let strip = (y / self.width_m).floor();
        let shift = unit(hash(strip as i32, 11, salt)) * self.length_m;
        let piece = ((x + shift) / self.length_m).floor();
        let tone = unit(hash(strip as i32, piece as i32, salt ^ 0x55));
        let own = hash(strip as i32, piece as i32, salt ^ 0x77);
        // Long fibres at two widths, and dark pores as short strokes.
        let (fibre_kept, pore_kept) = (kept(0.0006, pixel_m), kept(0.0005, pixel_m));
        let mut shade = 0.30 * tone - 0.15;
        if fibre_kept > 0.0 {
            let fibre = noise(x * 20.0, y * 2100.0, own) + noise(x * 34.0, y * 4300.0, own ^ 8);
            shade += self.grain * fibre_kept * 1.1 * (fibre - 1.0);
        }
        if pore_kept > 0.0 {
            let stroke = noise(x * 110.0, y * 3000.0, own ^ 1);
            shade += self.grain * pore_kept * 0.5 * smoothstep(0.7, 0.9, stroke);
        }
        let figure = fractal(x * 7.0 + 3.0 * noise(x * 4.0, y * 40.0, own), y * 120.0, 3, 0.6, own ^ 2);
        let stain = fractal(x * 14.0, y * 22.0, 4, 0.6, salt ^ 3);
        shade += self.grain * 0.9 * (figure - 0.25) + 0.4 * smoothstep(0.56, 0.8, stain);
        if self.nodes {
            // A node: a ring of dark dabs across the strip, with a stain behind it.
            let at = (unit(own ^ 0xABC) * 0.8 + 0.1) * self.length_m + 0.003 * (noise(y * 250.0, 0.0, own) - 0.5);
            let along = (x + shift) - piece * self.length_m - at;
            let dabs = smoothstep(0.45, 0.7, noise(x * 600.0, y * 900.0, own ^ 4));
            shade += 0.6 * dabs * smoothstep(0.0035, 0.001, along.abs());
            if along > 0.0 {
                shade += 0.25 * smoothstep(0.012, 0.0, along - 0.010 * noise(y * 900.0, 5.0, own));
            }
        }
        let mut color = mix(self.light, self.dark, shade);
        // The glue line between strips.
        let edge = ((y / self.width_m) - strip - 0.5).abs();
        color *= 1.0 - 0.22 * smoothstep(0.5 - 0.0006 / self.width_m, 0.5, edge);
        color
    }
}

/// A groove milled along the border of a rounded rectangle: how deep (0 to 1) and how steep it is at a place.
fn groove(x: f32, y: f32, half_x: f32, half_y: f32) -> (f32, (f32, f32)) {
    const RADIUS_M: f32 = 0.03;
    const HALF_WIDTH_M: f32 = 0.0045;
    let (qx, qy) = (x.abs() - half_x + RADIUS_M, y.abs() - half_y + RADIUS_M);
    let (ox, oy) = (qx.max(0.0), qy.max(0.0));
    let distance = (ox * ox + oy * oy).sqrt() + qx.max(qy).min(0.0) - RADIUS_M;
    let t = distance / HALF_WIDTH_M;
    if t.abs() >= 1.0 {
        return (0.0, (0.0, 0.0));
    }
    let steep = 0.8 * (std::f32::consts::PI * t).sin();
    let gradient = if qx > 0.0 && qy > 0.0 {
        let norm = (ox * ox + oy * oy).sqrt().max(1e-6);
        (ox / norm * x.signum(), oy / norm * y.signum())
    } else if qx > qy {
        (x.signum(), 0.0)
    } else {
        (0.0, y.signum())
    };
    (1.0 - t * t, (steep * gradient.0, steep * gradient.1))
}

/// Woven cloth: over-and-under threads, `pitch_m` apart. Returns brightness near 1 and the slope of the threads.
fn weave(x: f32, y: f32, pitch_m: f32, pixel_m: f32, salt: u32) -> (f32, (f32, f32)) {
    let (u, v) = (x / pitch_m, y / pitch_m);
    let (i, j) = (u.floor(), v.floor());
    let (fu, fv) = (u - i - 0.5, v - j - 0.5);
    let over = (i as i32 + j as i32).rem_euclid(2) == 0;
    let across = if over { fv } else { fu };
    let thread = if over { hash(j as i32, 1, salt) } else { hash(i as i32, 2, salt) };
    let tone = 0.75
        + 0.5 * (kept(2.0 * pitch_m, pixel_m) * (unit(thread) - 0.5) + 0.5) * noise(u * 0.3, v * 0.3, salt)
        + 0.2 * noise(u * 1.7, v * 1.7, salt ^ 9);
    let kept = kept(pitch_m, pixel_m);
    let brightness = tone * (1.0 - 0.13 * (1.0 - kept) - 1.6 * kept * across * across);
    let slope = if over { (0.0, 1.2 * kept * fv) } else { (1.2 * kept * fu, 0.0) };
    (brightness, slope)
}

/// The surface that the model stands on, at `(x, y)` metres from the middle of the table.
pub(crate) fn table(kind: Table, (x, y): (f32, f32), pixel_m: f32, half_extent_m: (f32, f32), salt: u32) -> Finish {
    match kind {
        Table::Bamboo => {
            let planks = Planks {
                width_m: 0.019,
                length_m: 0.33,
                light: Vec3::new(0.72, 0.58, 0.43),
                dark: Vec3::new(0.34, 0.21, 0.11),
                grain: 0.8,
                nodes: true,
            };
            let mut albedo = planks.albedo(x, y, pixel_m, salt);
            let (depth, slope) = groove(x, y, half_extent_m.0 - 0.035, half_extent_m.1 - 0.035);
            albedo *= 1.0 - 0.45 * depth;
            Finish { albedo, roughness: 0.55, slope }
        }
        Table::Oak => {
            let planks = Planks {
                width_m: 0.09,
                length_m: 0.9,
                light: Vec3::new(0.42, 0.26, 0.13),
                dark: Vec3::new(0.11, 0.055, 0.025),
                grain: 1.0,
                nodes: false,
            };
            let slope = (0.0, 0.06 * (noise(x * 30.0, y * 1500.0, salt) - 0.5));
            Finish { albedo: planks.albedo(x, y, pixel_m, salt), roughness: 0.38, slope }
        }
        Table::Gingham => {
            let check = |v: f32| ((v / 0.024).floor() as i32).rem_euclid(2) as f32;
            let color = mix(Vec3::new(0.80, 0.78, 0.74), Vec3::new(0.12, 0.16, 0.36), 0.5 * (check(x) + check(y)));
            let (brightness, slope) = weave(x, y, 0.0011, pixel_m, salt);
            let worn = 0.85 + 0.3 * fractal(x * 30.0, y * 30.0, 4, 0.6, salt);
            Finish { albedo: (color * brightness * worn).min(Vec3::splat(0.9)), roughness: 0.95, slope }
        }
        Table::Linen => {
            let (brightness, slope) = weave(x, y, 0.0013, pixel_m, salt);
            let (cx, cy) = ((x / 0.045).floor(), (y / 0.045).floor());
            let own = hash(cx as i32, cy as i32, salt);
            let (dx, dy) = (x / 0.045 - cx - 0.5, y / 0.045 - cy - 0.5);
            // A printed leaf in every cell, turned and sized at random.
            let (sin, cos) = (std::f32::consts::TAU * unit(own)).sin_cos();
            let (u, v) = (dx * cos + dy * sin, dy * cos - dx * sin);
            let leaf = 0.13 * (1.0 - (u / 0.4).powi(2)) - v.abs();
            let print = smoothstep(0.0, 0.02, leaf) * (0.6 + 0.4 * noise(x * 400.0, y * 400.0, own));
            let ground = mix(Vec3::new(0.55, 0.49, 0.40), Vec3::new(0.42, 0.36, 0.28), noise(x * 9.0, y * 9.0, salt));
            let ink = mix(Vec3::new(0.10, 0.17, 0.08), Vec3::new(0.32, 0.10, 0.07), unit(own ^ 5));
            Finish { albedo: mix(ground, ink, 0.85 * print) * brightness, roughness: 0.95, slope }
        }
    }
}

/// What lies below and beyond the table: the coarse cover of a sofa, or a floor.
pub(crate) fn surroundings((x, y): (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    let (brightness, slope) = weave(x, y, 0.0018, pixel_m, salt);
    let base = Vec3::new(0.055, 0.068, 0.095) * (0.7 + 0.6 * fractal(x * 25.0, y * 25.0, 4, 0.6, salt));
    Finish { albedo: base * brightness, roughness: 0.95, slope }
}

/// A painted wall: nearly even.
pub(crate) fn plaster((x, y): (f32, f32), salt: u32) -> Finish {
    let shade = 0.9 + 0.08 * fractal(x * 6.0, y * 6.0, 3, 0.5, salt) + 0.04 * noise(x * 300.0, y * 300.0, salt);
    Finish { albedo: Vec3::new(0.52, 0.50, 0.46) * shade, roughness: 0.9, slope: (0.0, 0.0) }
}

/// The bare edge of a wooden table.
pub(crate) fn edge((x, y): (f32, f32), salt: u32) -> Finish {
    let shade = 0.7 + 0.5 * fractal(x * 15.0, y * 600.0, 3, 0.6, salt);
    Finish { albedo: Vec3::new(0.34, 0.22, 0.12) * shade, roughness: 0.6, slope: (0.0, 0.0) }
}

/// Printed matter and other things at the edge of the scene: flat colour with blocks of text-like marks.
pub(crate) fn clutter(base: Vec3, (x, y): (f32, f32), salt: u32) -> Finish {
    let line = (y / 0.004).floor();
    let word = noise(x * 160.0, line * 7.3, salt);
    let in_line = (y / 0.004 - line - 0.5).abs() < 0.22;
    let block = noise(x * 14.0, y * 14.0, salt ^ 1) > 0.45;
    let ink = if in_line && block && word > 0.45 { 0.25 } else { 1.0 };
    Finish { albedo: base * ink, roughness: 0.5, slope: (0.0, 0.0) }
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
}
