//! From radiance to the photograph that the phone stores: lens, sensor, and the phone's own processing, which smooths noise,
//! bends tones and sharpens what is bright or dark, in this order.

use std::ops::{Add, Mul};

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

/// Standard deviation of the lens's blur and of the phone's smoothing of noise together, pixels of a 1920-pixel-wide
/// photograph.
const BLUR_PX: f32 = 0.70;
/// The phone's sharpening: it adds this share of what a blur of [`SHARPEN_PX`] removes from the brightness.
const SHARPEN: f32 = 1.2;
const SHARPEN_PX: f32 = 1.2;
/// Noise of the sensor: variance is `READ^2 + SHOT * signal`, signal 1 is white.
const READ: f32 = 0.0052;
const SHOT: f32 = 0.000_30;
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
pub(crate) fn blurred<T>(image: &Image<T>, sigma_px: f32) -> Image<T>
where
    T: Copy + Send + Sync + Add<Output = T> + Mul<f32, Output = T>,
{
    let radius = (2.5 * sigma_px).ceil() as usize;
    let kernel: Vec<f32> = (0..=radius).map(|d| (-0.5 * (d as f32 / sigma_px).powi(2)).exp()).collect();
    let total = kernel[0] + 2.0 * kernel[1..].iter().sum::<f32>();
    let kernel: Vec<f32> = kernel.iter().map(|w| w / total).collect();
    let (width, height) = (image.width(), image.height());
    // Each output pixel is a weighted sum of pairs at the same distance before and after it.
    let mut across = image.clone();
    across.data_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let source = image.row(y);
        for (x, out) in row.iter_mut().enumerate() {
            *out = source[x] * kernel[0];
            for (d, w) in kernel.iter().enumerate().skip(1) {
                *out = *out + (source[x.saturating_sub(d)] + source[(x + d).min(width - 1)]) * *w;
            }
        }
    });
    let mut out = across.clone();
    out.data_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        row.iter_mut().for_each(|v| *v = *v * kernel[0]);
        for (d, w) in kernel.iter().enumerate().skip(1) {
            let (above, below) = (across.row(y.saturating_sub(d)), across.row((y + d).min(height - 1)));
            for ((v, a), b) in row.iter_mut().zip(above).zip(below) {
                *v = *v + (*a + *b) * *w;
            }
        }
    });
    out
}

/// The tone curve of a phone, from linear signal (1 = white) to display, 0 to 1: shadows are lifted off black, the
/// middle has contrast, and highlights bend over a soft shoulder.
fn tone(v: f32) -> f32 {
    const SHOULDER: f32 = 0.5;
    let v = v.max(0.0);
    let v = if v > SHOULDER { SHOULDER + (1.0 - SHOULDER) * (1.0 - (-(v - SHOULDER) / 0.62).exp()) } else { v };
    let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    // A gentle S round the middle.
    encoded + 0.10 * (encoded - 0.5) * 4.0 * encoded * (1.0 - encoded)
}

/// [`tone`] by interpolation in a table: a power for each channel of each pixel would be the longest step of all.
struct ToneTable(Vec<f32>);

impl ToneTable {
    /// Steps per unit of the square root of the signal, where the curve is nearly straight.
    const STEPS: f32 = 1024.0;

    fn new() -> Self {
        Self((0..=(2.0 * Self::STEPS) as usize + 1).map(|i| tone((i as f32 / Self::STEPS).powi(2))).collect())
    }

    fn at(&self, v: f32) -> f32 {
        let place = (v.max(0.0).sqrt() * Self::STEPS).min((self.0.len() - 2) as f32);
        let (i, share) = (place as usize, place.fract());
        self.0[i] + (self.0[i + 1] - self.0[i]) * share
    }
}

/// Makes the photograph. `salt` seeds the noise of this frame.
pub(crate) fn develop(radiance: &Image<Vec3>, development: &Development, salt: u32) -> RgbImage {
    let size = radiance.size();
    // A smaller photograph is a full one, averaged.
    let scale = size.width.max(size.height) as f32 / 1920.0;
    let half = Vec3::new(size.width as f32, size.height as f32, 0.0) * 0.5;
    let gain = development.white_balance * development.exposure;
    let mut signal = Image::filled(size, Vec3::ZERO);
    signal.data_mut().par_chunks_mut(size.width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let off = (Vec3::new(x as f32, y as f32, 0.0) - half) / half.length();
            *pixel = radiance[(x, y)] * gain * (1.0 - VIGNETTE * off.length_squared());
            for c in 0..3 {
                let deviation = scale.min(1.5) * (READ * READ + SHOT * pixel[c].max(0.0)).sqrt();
                pixel[c] += deviation * gaussian(hash(x as i32, y as i32, salt ^ (c as u32 + 1)));
            }
        }
    });
    let mut display = blurred(&signal, (BLUR_PX * scale).max(0.3));
    let table = ToneTable::new();
    display.data_mut().par_iter_mut().for_each(|p| *p = Vec3::new(table.at(p.x), table.at(p.y), table.at(p.z)));
    let bright = display.map(|p| luminance(*p));
    let soft = blurred(&bright, (SHARPEN_PX * scale).max(0.6));
    let mut out = Image::filled(size, [0u8; 3]);
    out.data_mut().par_iter_mut().enumerate().for_each(|(i, pixel)| {
        let crisp = display.data()[i] + SHARPEN * (bright.data()[i] - soft.data()[i]);
        *pixel = crisp.to_array().map(|v| (255.0 * v + 0.5).clamp(0.0, 255.0) as u8);
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
