//! From radiance to the photograph that the phone stores: lens, sensor, and the phone's own processing.

use glam::Vec3;
use mb_image::{Image, RgbImage};
use mb_job::rng;
use rand::RngExt;
use rayon::prelude::*;

use crate::random::hash;
use crate::streams;

/// Sensor and processing of one photograph.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Development {
    /// Radiance to display white.
    pub exposure: f32,
    /// Gains of red, green and blue.
    pub white_balance: Vec3,
}

/// Standard deviation of the lens blur with the phone's own smoothing, pixels of a 1920-pixel-wide photograph.
const BLUR_PX: f32 = 0.5;
/// Strength of the phone's sharpening: it adds this share of what a blur of [`SHARPEN_PX`] removes.
const SHARPEN: f32 = 1.0;
const SHARPEN_PX: f32 = 1.1;
/// Noise after the phone's denoising: variance is `READ^2 + SHOT * signal`, signal 1 is white.
const READ: f32 = 0.0028;
const SHOT: f32 = 0.000_07;
/// Light that the corners of the frame lose.
const VIGNETTE: f32 = 0.10;

/// Automatic exposure and white balance over a sequence: they settle on the scene and drift a little.
pub(crate) fn developments(radiance_of_first: &Image<Vec3>, frames: usize, seed: u64) -> Vec<Development> {
    let mut rng = rng(seed, streams::EXPOSURE);
    // Meter for the scene's mean, as phones do, but spare the highlights.
    let mean =
        radiance_of_first.data().iter().map(|p| luminance(*p)).sum::<f32>() / radiance_of_first.data().len() as f32;
    let target = rng.random_range(0.29..0.37f32);
    let base = (target / mean.max(1e-4)).min(40.0);
    let tint = rng.random_range(-0.04..0.05f32);
    let phases: [f32; 3] = std::array::from_fn(|_| rng.random_range(0.0..std::f32::consts::TAU));
    (0..frames)
        .map(|i| {
            let along = std::f32::consts::TAU * i as f32 / frames.max(2) as f32;
            let breath = 0.05 * (1.3 * along + phases[0]).sin() + 0.02 * (4.7 * along + phases[1]).sin();
            let warm = tint + 0.015 * (1.7 * along + phases[2]).sin();
            Development { exposure: base * (1.0 + breath), white_balance: Vec3::new(1.0 + warm, 1.0, 1.0 - warm) }
        })
        .collect()
}

fn luminance(p: Vec3) -> f32 {
    p.dot(Vec3::new(0.2126, 0.7152, 0.0722))
}

/// Separable Gaussian blur.
fn blurred(image: &Image<Vec3>, sigma_px: f32) -> Image<Vec3> {
    let radius = (2.5 * sigma_px).ceil() as isize;
    let kernel: Vec<f32> = (-radius..=radius).map(|d| (-0.5 * (d as f32 / sigma_px).powi(2)).exp()).collect();
    let total: f32 = kernel.iter().sum();
    let (width, height) = (image.width(), image.height());
    let convolve = |count: usize, at: usize, sample: &dyn Fn(usize) -> Vec3| -> Vec3 {
        kernel
            .iter()
            .zip(-radius..)
            .map(|(w, d)| sample((at as isize + d).clamp(0, count as isize - 1) as usize) * *w)
            .sum::<Vec3>()
            / total
    };
    let mut across = vec![Vec3::ZERO; width * height];
    across.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let source = image.row(y);
        for (x, out) in row.iter_mut().enumerate() {
            *out = convolve(width, x, &|i| source[i]);
        }
    });
    let mut out = Image::filled(image.size(), Vec3::ZERO);
    out.data_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, out) in row.iter_mut().enumerate() {
            *out = convolve(height, y, &|j| across[j * width + x]);
        }
    });
    out
}

/// The tone curve of a phone: sRGB with a lifted contrast and a soft shoulder, from linear signal (1 = white).
fn tone(v: f32) -> f32 {
    // The shoulder bends off what lies above 0.6 towards 1.
    let v = if v > 0.6 { 0.6 + 0.4 * (1.0 - (-(v - 0.6) / 0.4).exp()) } else { v.max(0.0) };
    let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    // A gentle S round the middle.
    encoded + 0.10 * (encoded - 0.5) * 4.0 * encoded * (1.0 - encoded)
}

/// Makes the photograph. `salt` seeds the noise of this frame.
pub(crate) fn develop(radiance: &Image<Vec3>, development: &Development, salt: u32) -> RgbImage {
    let size = radiance.size();
    let scale = size.width.max(size.height) as f32 / 1920.0;
    let image = blurred(radiance, (BLUR_PX * scale).max(0.35));
    let soft = blurred(&image, (SHARPEN_PX * scale).max(0.7));
    let half = Vec3::new(size.width as f32, size.height as f32, 0.0) * 0.5;
    let gain = development.white_balance * development.exposure;
    let mut out = Image::filled(size, [0u8; 3]);
    out.data_mut().par_chunks_mut(size.width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let off = (Vec3::new(x as f32, y as f32, 0.0) - half) / half.length();
            let (here, around) = (image[(x, y)], soft[(x, y)]);
            let sharp = (here + (here - around) * SHARPEN).max(here * 0.3);
            let signal = sharp * gain * (1.0 - VIGNETTE * off.length_squared());
            for c in 0..3 {
                let deviation = (READ * READ + SHOT * signal[c].max(0.0)).sqrt();
                let noisy = signal[c] + deviation * gaussian(hash(x as i32, y as i32, salt ^ (c as u32 + 1)));
                pixel[c] = (255.0 * tone(noisy) + 0.5).clamp(0.0, 255.0) as u8;
            }
        }
    });
    out
}

/// A nearly normal deviate from a hash: the sum of four uniform bytes, scaled to unit variance.
fn gaussian(h: u32) -> f32 {
    let sum: u32 = h.to_le_bytes().iter().map(|b| u32::from(*b)).sum();
    // Four bytes have mean 510 and variance 4 * (256^2 - 1) / 12.
    (sum as f32 - 510.0) / 147.8
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::ImageSize;

    #[test]
    fn the_tone_curve_grows_from_black_to_white() {
        let values: Vec<f32> = (0..400).map(|i| tone(i as f32 / 100.0)).collect();
        assert!(values.windows(2).all(|w| w[0] <= w[1]));
        assert!(values[0].abs() < 0.01 && values[399] > 0.99 && values[399] <= 1.01);
    }

    #[test]
    fn noise_of_a_grey_card_is_a_phones() {
        let card = Image::filled(ImageSize::new(320, 240), Vec3::splat(0.2));
        let development = Development { exposure: 1.0, white_balance: Vec3::ONE };
        let photo = develop(&card, &development, 3);
        // The middle, where the vignette is flat.
        let greens: Vec<f64> =
            (110..130).flat_map(|y| photo.row(y)[150..170].to_vec()).map(|p| f64::from(p[1])).collect();
        let mean = greens.iter().sum::<f64>() / greens.len() as f64;
        let deviation = (greens.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / greens.len() as f64).sqrt();
        assert!((110.0..135.0).contains(&mean) && (0.5..2.5).contains(&deviation), "mean {mean}, noise {deviation}");
    }
}
