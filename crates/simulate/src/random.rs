//! Random numbers with a normal distribution, and noise that is a function of place.

use glam::Vec3;
use mb_job::Rng;
use rand::RngExt;

/// A draw from the standard normal distribution (Box and Muller 1958).
pub(crate) fn normal(rng: &mut Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()
}

/// A well-mixed 32-bit hash of three integers (the finaliser of MurmurHash3 over their mixed products).
pub(crate) fn hash(x: i32, y: i32, z: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9E37_79B1)
        ^ (y as u32).wrapping_mul(0x85EB_CA77).rotate_left(13)
        ^ z.wrapping_mul(0xC2B2_AE3D).rotate_left(7);
    h = (h ^ (h >> 16)).wrapping_mul(0x85EB_CA6B);
    h = (h ^ (h >> 13)).wrapping_mul(0xC2B2_AE35);
    h ^ (h >> 16)
}

/// A uniform number in [0, 1) from a hash.
pub(crate) fn unit(h: u32) -> f32 {
    (h >> 8) as f32 / 16_777_216.0
}

/// The largest whole number not above `x`, for `x` within 2^31; the library's is a call on older processors.
fn floor(x: f32) -> f32 {
    let cut = x as i32 as f32;
    if cut > x { cut - 1.0 } else { cut }
}

/// Value noise over the plane, in [0, 1), with features of unit size.
pub(crate) fn noise(x: f32, y: f32, salt: u32) -> f32 {
    let (x0, y0) = (floor(x), floor(y));
    let (u, v) = (x - x0, y - y0);
    let (u, v) = (u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v));
    let (i, j) = (x0 as i32, y0 as i32);
    let at = |di: i32, dj: i32| unit(hash(i.wrapping_add(di), j.wrapping_add(dj), salt));
    let low = at(0, 0) + (at(1, 0) - at(0, 0)) * u;
    let high = at(0, 1) + (at(1, 1) - at(0, 1)) * u;
    low + (high - low) * v
}

/// Value noise in space, in [-1, 1), with features of unit size.
pub(crate) fn noise3(p: Vec3, salt: u32) -> f32 {
    let layer = floor(p.z);
    let w = p.z - layer;
    let w = w * w * (3.0 - 2.0 * w);
    let salted = |l: f32| salt ^ (l as i32 as u32).wrapping_mul(0x27D4_EB2F);
    let (low, high) = (noise(p.x, p.y, salted(layer)), noise(p.x, p.y, salted(layer + 1.0)));
    2.0 * (low + (high - low) * w) - 1.0
}

/// A sum of `octaves` of [`noise`], each half the size and `gain` times the strength of the last, in [0, 1).
pub(crate) fn fractal(x: f32, y: f32, octaves: u32, gain: f32, salt: u32) -> f32 {
    let (mut sum, mut total, mut weight, mut scale) = (0.0, 0.0, 1.0, 1.0);
    for octave in 0..octaves {
        sum += weight * noise(x * scale, y * scale, salt.wrapping_add(octave.wrapping_mul(0x51ED_270B)));
        total += weight;
        weight *= gain;
        scale *= 2.0;
    }
    sum / total
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_job::rng;

    #[test]
    fn normal_has_mean_zero_and_variance_one() {
        let mut rng = rng(3, 0);
        let draws: Vec<f64> = (0..40_000).map(|_| normal(&mut rng)).collect();
        let mean = draws.iter().sum::<f64>() / draws.len() as f64;
        let variance = draws.iter().map(|d| d * d).sum::<f64>() / draws.len() as f64;
        assert!(mean.abs() < 0.02 && (variance - 1.0).abs() < 0.03, "mean {mean}, variance {variance}");
    }

    #[test]
    fn noise_is_continuous_and_spreads_over_its_range() {
        let step = 1e-3;
        let (mut low, mut high) = (1.0f32, 0.0f32);
        for i in 0..20_000 {
            let (x, y) = (i as f32 * 0.0137 - 100.0, i as f32 * 0.0071);
            let v = noise(x, y, 7);
            assert!((noise(x + step, y, 7) - v).abs() < 3.0 * step);
            (low, high) = (low.min(v), high.max(v));
        }
        assert!(low < 0.05 && high > 0.95);
    }
}
