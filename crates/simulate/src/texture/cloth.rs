//! Cloth: woven threads, plain, checked and printed.

use glam::Vec3;

use super::{Finish, kept, mix, smoothstep};
use crate::random::{fractal, hash, noise, unit};

/// Over-and-under threads, `pitch_m` apart. Returns brightness near 1 and the slope of the threads.
fn weave(x: f32, y: f32, pitch_m: f32, pixel_m: f32, salt: u32) -> (f32, (f32, f32)) {
    // Cloth does not lie straight.
    let (x, y) = (x + 0.0015 * noise(x * 40.0, y * 40.0, salt ^ 21), y + 0.0015 * noise(x * 40.0, y * 40.0, salt ^ 22));
    let (u, v) = (x / pitch_m, y / pitch_m);
    let (i, j) = (u.floor(), v.floor());
    let (fu, fv) = (u - i - 0.5, v - j - 0.5);
    let over = (i as i32 + j as i32).rem_euclid(2) == 0;
    let (across, along) = if over { (fv, fu) } else { (fu, fv) };
    let thread = if over { hash(j as i32, 1, salt) } else { hash(i as i32, 2, salt) };
    // Slubs: threads swell and thin along their length.
    let along_thread = if over { u } else { v };
    let slub = noise(along_thread * 0.22, unit(thread) * 900.0, salt ^ 7);
    let seen = kept(0.7 * pitch_m, pixel_m);
    let threads = kept(1.4 * pitch_m, pixel_m);
    let tone =
        0.80 + threads * (0.28 * (unit(thread) - 0.5) + 0.36 * (slub - 0.5)) + 0.28 * noise(u * 0.6, v * 0.6, salt ^ 9);
    let round = 1.0 - 1.4 * across * across - 0.6 * along * along;
    let brightness = tone * (0.84 * (1.0 - seen) + seen * round.max(0.15));
    let slope = 0.8 * seen;
    (brightness, if over { (0.5 * slope * fu, slope * fv) } else { (slope * fu, 0.5 * slope * fv) })
}

/// A checked tablecloth.
pub(super) fn gingham((x, y): (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    // Edges of checks fall between threads, which are uneven.
    let (wx, wy) = (x + 0.0007 * noise(y * 700.0, 1.0, salt), y + 0.0007 * noise(x * 700.0, 2.0, salt));
    let check = |v: f32| ((v / 0.024).floor() as i32).rem_euclid(2) as f32;
    let color = mix(Vec3::new(0.80, 0.78, 0.74), Vec3::new(0.11, 0.15, 0.36), 0.5 * (check(wx) + check(wy)));
    let (brightness, slope) = weave(x, y, 0.0011, pixel_m, salt);
    let worn = 0.85 + 0.3 * fractal(x * 30.0, y * 30.0, 4, 0.6, salt);
    Finish { albedo: color * brightness * worn, roughness: 0.95, coat: 0.15, slope }
}

/// A coarse linen cloth with a printed pattern of leaves.
pub(super) fn linen((x, y): (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    let (brightness, slope) = weave(x, y, 0.0010, pixel_m, salt);
    let (cx, cy) = ((x / 0.045).floor(), (y / 0.045).floor());
    let own = hash(cx as i32, cy as i32, salt);
    let (dx, dy) = (x / 0.045 - cx - 0.5, y / 0.045 - cy - 0.5);
    // A printed leaf in every cell, turned and sized at random, with ribs.
    let (sin, cos) = (std::f32::consts::TAU * unit(own)).sin_cos();
    let (u, v) = (dx * cos + dy * sin, dy * cos - dx * sin);
    let size = 0.75 + 0.5 * unit(own ^ 3);
    let leaf = 0.13 * size * (1.0 - (u / (0.4 * size)).powi(2)) - v.abs();
    let rib = ((u + 0.8 * v.abs()) * 22.0).fract().abs();
    let ribs = smoothstep(0.12, 0.04, (rib - 0.5).abs()) + smoothstep(0.012, 0.004, v.abs());
    let print =
        smoothstep(0.0, 0.02, leaf) * (0.7 + 0.3 * noise(x * 900.0, y * 900.0, own)) * (1.0 - 0.6 * ribs.min(1.0));
    let ground = mix(Vec3::new(0.62, 0.55, 0.45), Vec3::new(0.46, 0.40, 0.31), noise(x * 9.0, y * 9.0, salt));
    let ink = mix(Vec3::new(0.10, 0.17, 0.08), Vec3::new(0.32, 0.10, 0.07), unit(own ^ 5));
    Finish { albedo: mix(ground, ink, 0.85 * print) * brightness, roughness: 0.95, coat: 0.15, slope }
}

/// The coarse cover of a sofa, or a carpet.
pub(super) fn cover((x, y): (f32, f32), pixel_m: f32, salt: u32) -> Finish {
    let (brightness, slope) = weave(x, y, 0.0015, pixel_m, salt);
    let base = Vec3::new(0.060, 0.074, 0.100) * (0.75 + 0.5 * fractal(x * 25.0, y * 25.0, 4, 0.6, salt));
    // Single light threads.
    let fleck = kept(0.0015, pixel_m) * smoothstep(0.8, 0.95, noise(x * 500.0, y * 260.0, salt ^ 31));
    Finish { albedo: base * brightness * (1.0 + 1.2 * fleck), roughness: 0.95, coat: 0.1, slope }
}
