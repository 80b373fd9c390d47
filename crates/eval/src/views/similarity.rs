//! PSNR and SSIM of two images in memory.
//!
//! SSIM is that of the published `evaluate_nvs.py`: a Gaussian window of 11x11 pixels with sigma 1.5, zero outside the
//! image, per channel, averaged over every pixel including the borders; C1 = 0.01^2, C2 = 0.03^2 for values in [0, 1]
//! (Wang et al. 2004, "Image quality assessment: from error visibility to structural similarity", eq. 13).
//!
//! The arithmetic has one fixed order, whatever the processor and the number of threads: every machine finds the same
//! bits.

use mb_geometry::ImageSize;
use mb_image::{Image, Mask};
use rayon::prelude::*;

/// Colours as fractions of full scale, `[H, W]` of `[r, g, b]` in [0, 1].
pub type ColorImage = Image<[f32; 3]>;

/// How alike two images are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Similarity {
    /// Mean squared difference over pixels and channels.
    pub mse: f64,
    /// Peak signal-to-noise ratio in dB: `-10 log10(max(mse, 1e-10))`, so 100 for equal images.
    pub psnr: f64,
    /// Structural similarity, at most 1.
    pub ssim: f64,
}

/// The published floor of the mean squared error, which keeps equal images finite.
const MSE_FLOOR: f64 = 1e-10;
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
const RADIUS: usize = 5;
const TAPS: usize = 2 * RADIUS + 1;
const CHANNELS: usize = 3;
/// Rows of one piece of parallel work, and the unit of the fixed order of summation.
const BAND_ROWS: usize = 96;
/// Values (pixels times channels) of a column strip; the sliding rows of a strip then stay in the second-level cache.
const STRIP: usize = 320 * CHANNELS;
const HALO: usize = RADIUS * CHANNELS;
/// What is averaged over every window: u = x + y and v = x - y of the two images, and their squares.
///
/// With U, V the means of u, v and A, B their variances, `SSIM = (U^2 - V^2 + 2 C1) (A - B + 2 C2) / ((U^2 + V^2 + 2 C1)
/// (A + B + 2 C2))`, which is the usual formula in other letters. In f32 it is the better one: A, where rounding is
/// largest, stands in numerator and denominator alike, and B is small and exact where the images are alike.
const MAPS: usize = 4;
/// Independent partial sums, so that the compiler may use vectors and yet the order is fixed.
const LANES: usize = 16;

/// Compares two images of one size; with a mask, over its true pixels alone (their windows still see the rest).
/// `None` where the sizes differ or no pixel is compared.
pub fn similarity(a: &ColorImage, b: &ColorImage, mask: Option<&Mask>) -> Option<Similarity> {
    if a.size() != b.size() {
        return None;
    }
    similarity_of_pixels(a.size(), a.data(), b.data(), mask)
}

/// Like [`similarity`], of pixels that lie elsewhere: `[H, W]`, row after row. `None` where there are not as many as
/// `size` says.
pub fn similarity_of_pixels(
    size: ImageSize,
    a: &[[f32; 3]],
    b: &[[f32; 3]],
    mask: Option<&Mask>,
) -> Option<Similarity> {
    let pixels = mask.map_or(size.pixels(), |m| m.data().iter().filter(|&&m| m).count());
    if [a.len(), b.len()] != [size.pixels(); 2] || mask.is_some_and(|m| m.size() != size) || pixels == 0 {
        return None;
    }
    let (a, b) = (Pixels { size, values: a }, Pixels { size, values: b });
    let bands: Vec<usize> = (0..size.height).step_by(BAND_ROWS).collect();
    let sums: Vec<Sums> = bands.par_iter().map(|&first| band(a, b, mask, first)).collect();
    let (mut squares, mut ssim) = (0.0, 0.0);
    for band in &sums {
        squares += band.squares;
        ssim += band.ssim;
    }
    let values = (pixels * CHANNELS) as f64;
    let mse = squares / values;
    Some(Similarity { mse, psnr: psnr_of_mse(mse), ssim: ssim / values })
}

/// The PSNR in dB that belongs to a mean squared error of values in [0, 1].
pub fn psnr_of_mse(mse: f64) -> f64 {
    // `f64::max` would turn NaN into the floor, that is into a perfect score.
    if mse < MSE_FLOOR { -10.0 * MSE_FLOOR.log10() } else { -10.0 * mse.log10() }
}

/// An image's pixels, wherever they lie.
#[derive(Clone, Copy)]
struct Pixels<'a> {
    size: ImageSize,
    values: &'a [[f32; 3]],
}

impl<'a> Pixels<'a> {
    fn row(&self, y: usize) -> &'a [[f32; 3]] {
        &self.values[y * self.size.width..(y + 1) * self.size.width]
    }
}

/// Sums over the compared values of a band.
#[derive(Default)]
struct Sums {
    squares: f64,
    ssim: f64,
}

fn band(a: Pixels<'_>, b: Pixels<'_>, mask: Option<&Mask>, first: usize) -> Sums {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has the instructions that the function is compiled for.
        return unsafe { band_avx2(a, b, mask, first) };
    }
    band_portable(a, b, mask, first)
}

/// The portable code, compiled for wider vectors. Fused multiply-add stays off: it would change the last bits.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn band_avx2(a: Pixels<'_>, b: Pixels<'_>, mask: Option<&Mask>, first: usize) -> Sums {
    band_portable(a, b, mask, first)
}

/// Centre and right half of the normalised Gaussian window. The centre takes up the rounding of the rest: a sum that is
/// off by e adds e x^2 to every variance, which flat parts would show.
fn window() -> [f32; RADIUS + 1] {
    let weight = |i: usize| (-((i * i) as f64) / (2.0 * 1.5 * 1.5)).exp();
    let total: f64 = weight(0) + 2.0 * (1..=RADIUS).map(weight).sum::<f64>();
    let mut window: [f32; RADIUS + 1] = std::array::from_fn(|i| (weight(i) / total) as f32);
    window[0] = (1.0 - 2.0 * window[1..].iter().map(|&w| f64::from(w)).sum::<f64>()) as f32;
    window
}

/// Rows `first..first + BAND_ROWS`: slides down each strip, keeping the horizontally blurred maps of 11 rows.
#[inline(always)]
fn band_portable(a: Pixels<'_>, b: Pixels<'_>, mask: Option<&Mask>, first: usize) -> Sums {
    let (width, height) = (a.size.width * CHANNELS, a.size.height);
    let rows = BAND_ROWS.min(height - first);
    let window = window();
    let mut sums = Sums::default();
    let mut ring = vec![[[0f32; STRIP]; MAPS]; TAPS];
    let mut padded = [[0f32; STRIP + 2 * HALO]; MAPS];
    let mut weights = [1f32; STRIP];
    let mut values = [0f32; STRIP];
    for left in (0..width).step_by(STRIP) {
        let n = STRIP.min(width - left);
        for step in 0..rows + 2 * RADIUS {
            let slot = &mut ring[step % TAPS];
            // The row that enters at the window's lower edge; outside the image it is zero.
            match (first + step).checked_sub(RADIUS).filter(|&entering| entering < height) {
                Some(entering) => {
                    load(a.row(entering).as_flattened(), b.row(entering).as_flattened(), left, n, &mut padded);
                    for (blurred, padded) in slot.iter_mut().zip(&padded) {
                        blur_row(padded, &window, blurred);
                    }
                }
                None => slot.iter_mut().for_each(|map| map.fill(0.0)),
            }
            let Some(y) = (first + step).checked_sub(2 * RADIUS).filter(|_| step >= 2 * RADIUS) else { continue };
            if let Some(mask) = mask {
                let mask = mask.row(y);
                weights[..n].iter_mut().zip(left..).for_each(|(w, i)| *w = f32::from(u8::from(mask[i / CHANNELS])));
            }
            ssim_row(&std::array::from_fn(|k| &ring[(step + 1 + k) % TAPS]), &window, &mut values);
            sums.ssim += weighted_sum(&values[..n], &weights[..n]);
            let (xs, ys) = (&a.row(y).as_flattened()[left..left + n], &b.row(y).as_flattened()[left..left + n]);
            for (value, (x, y)) in values.iter_mut().zip(xs.iter().zip(ys)) {
                *value = (x - y) * (x - y);
            }
            sums.squares += weighted_sum(&values[..n], &weights[..n]);
        }
    }
    sums
}

/// Fills the four maps of values `left - HALO..left + n + HALO` of a row, zero outside the image.
#[inline(always)]
fn load(xs: &[f32], ys: &[f32], left: usize, n: usize, padded: &mut [[f32; STRIP + 2 * HALO]; MAPS]) {
    let from = left.saturating_sub(HALO);
    let to = (left + n + HALO).min(xs.len());
    let offset = from + HALO - left;
    let end = offset + (to - from);
    for map in padded.iter_mut() {
        map[..offset].fill(0.0);
        map[end..].fill(0.0);
    }
    let [u, v, uu, vv] = padded.each_mut().map(|map| &mut map[offset..end]);
    for (i, (x, y)) in xs[from..to].iter().zip(&ys[from..to]).enumerate() {
        let (sum, difference) = (x + y, x - y);
        u[i] = sum;
        v[i] = difference;
        uu[i] = sum * sum;
        vv[i] = difference * difference;
    }
}

/// Convolves a row with the window; neighbours of one channel are three values apart.
#[inline(always)]
fn blur_row(padded: &[f32; STRIP + 2 * HALO], window: &[f32; RADIUS + 1], blurred: &mut [f32; STRIP]) {
    for i in (0..STRIP).step_by(LANES) {
        let at = |offset: usize| lanes(padded, i + offset);
        let mut sum = scaled(at(HALO), window[0]);
        for k in 1..=RADIUS {
            sum = added(sum, scaled(added(at(HALO - k * CHANNELS), at(HALO + k * CHANNELS)), window[k]));
        }
        blurred[i..i + LANES].copy_from_slice(&sum);
    }
}

/// Finishes the blur down the columns, and computes SSIM of every value.
#[inline(always)]
fn ssim_row(rows: &[&[[f32; STRIP]; MAPS]; TAPS], window: &[f32; RADIUS + 1], ssim: &mut [f32; STRIP]) {
    for i in (0..STRIP).step_by(LANES) {
        let mut means = [[0f32; LANES]; MAPS];
        for (map, mean) in means.iter_mut().enumerate() {
            let at = |k: usize| lanes(&rows[k][map], i);
            *mean = scaled(at(RADIUS), window[0]);
            for k in 1..=RADIUS {
                *mean = added(*mean, scaled(added(at(RADIUS - k), at(RADIUS + k)), window[k]));
            }
        }
        for lane in 0..LANES {
            let [u, v, uu, vv] = means.each_ref().map(|mean| mean[lane]);
            let (u, v) = (u * u, v * v);
            let (a, b) = (uu - u, vv - v);
            ssim[i + lane] = (u - v + 2.0 * C1) * (a - b + 2.0 * C2) / ((u + v + 2.0 * C1) * (a + b + 2.0 * C2));
        }
    }
}

/// `LANES` values from `at` on.
#[inline(always)]
fn lanes(values: &[f32], at: usize) -> [f32; LANES] {
    let mut lanes = [0f32; LANES];
    lanes.copy_from_slice(&values[at..at + LANES]);
    lanes
}

#[inline(always)]
fn added(mut a: [f32; LANES], b: [f32; LANES]) -> [f32; LANES] {
    for lane in 0..LANES {
        a[lane] += b[lane];
    }
    a
}

#[inline(always)]
fn scaled(mut a: [f32; LANES], factor: f32) -> [f32; LANES] {
    for lane in &mut a {
        *lane *= factor;
    }
    a
}

#[inline(always)]
fn weighted_sum(values: &[f32], weights: &[f32]) -> f64 {
    let mut lanes = [0f32; LANES];
    let (values, weights) = (values.chunks(LANES), weights.chunks(LANES));
    for (values, weights) in values.zip(weights) {
        for (lane, (value, weight)) in lanes.iter_mut().zip(values.iter().zip(weights)) {
            *lane += value * weight;
        }
    }
    lanes.iter().map(|&lane| f64::from(lane)).sum()
}
