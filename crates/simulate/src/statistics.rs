//! What makes a photograph a phone's: statistics that simulated and real ones can be compared by.

use mb_image::{Image, RgbImage};
use serde::Serialize;

use crate::develop::blurred;

/// Colour, contrast, sharpness and noise of one photograph. Brightness is Rec. 709 luma of the 8-bit values, 0 to 255.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhotoStatistics {
    /// Brightness that 1, 10, 50, 90 and 99 % of the pixels stay below.
    pub luma_percentiles: [f64; 5],
    /// Standard deviation of brightness.
    pub contrast: f64,
    /// Mean of (largest - smallest channel) / largest channel.
    pub saturation: f64,
    /// Mean of red less green.
    pub red_less_green: f64,
    /// Mean of blue less green.
    pub blue_less_green: f64,
    /// Slope of brightness (central differences, per pixel) that 50, 75, 90 and 99 % of the pixels stay below.
    pub gradient_percentiles: [f64; 4],
    /// Standard deviation of what lies between blurs of 0, 1, 2, 4, 8 and 16 pixels.
    pub bands: [f64; 5],
    /// Standard deviation about a plane in the flattest twentieth of all blocks of 16 x 16 pixels, their median.
    pub noise: f64,
    /// Correlation of that noise between neighbouring pixels of a row.
    pub noise_correlation: f64,
}

/// The value that a share of the sorted values stays below.
fn percentile(sorted: &[f32], share: f64) -> f64 {
    f64::from(sorted[((sorted.len() - 1) as f64 * share).round() as usize])
}

fn sorted(mut values: Vec<f32>) -> Vec<f32> {
    values.sort_unstable_by(f32::total_cmp);
    values
}

fn deviation(values: &[f32]) -> f64 {
    let count = values.len().max(1) as f64;
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / count;
    (values.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / count).sqrt()
}

impl PhotoStatistics {
    /// Names of [`PhotoStatistics::values`].
    pub const NAMES: [&'static str; 20] = [
        "luma 1 %",
        "luma 10 %",
        "luma 50 %",
        "luma 90 %",
        "luma 99 %",
        "contrast",
        "saturation",
        "red - green",
        "blue - green",
        "gradient 50 %",
        "gradient 75 %",
        "gradient 90 %",
        "gradient 99 %",
        "band 0-1 px",
        "band 1-2 px",
        "band 2-4 px",
        "band 4-8 px",
        "band 8-16 px",
        "noise",
        "noise correlation",
    ];

    /// Measures a photograph; `None` where a side is below 48 pixels.
    pub fn of(photo: &RgbImage) -> Option<Self> {
        let (width, height) = (photo.width(), photo.height());
        if width < 48 || height < 48 {
            return None;
        }
        let luma = photo.map(|p| {
            let [r, g, b] = p.map(f32::from);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        });
        let count = photo.data().len() as f64;
        let mean = |value: &dyn Fn([f32; 3]) -> f32| {
            photo.data().iter().map(|p| f64::from(value(p.map(f32::from)))).sum::<f64>() / count
        };
        let levels = sorted(luma.data().to_vec());
        let mut slopes = Vec::with_capacity(luma.data().len());
        for y in 1..height - 1 {
            let (above, row, below) = (luma.row(y - 1), luma.row(y), luma.row(y + 1));
            slopes.extend((1..width - 1).map(|x| 0.5 * (row[x + 1] - row[x - 1]).hypot(below[x] - above[x])));
        }
        let slopes = sorted(slopes);
        let mut finer = luma.clone();
        let bands = [1.0f32, 2.0, 4.0, 8.0, 16.0].map(|sigma| {
            let coarser = blurred(&luma, sigma);
            let band: Vec<f32> = finer.data().iter().zip(coarser.data()).map(|(a, b)| a - b).collect();
            finer = coarser;
            deviation(&band)
        });
        let (noise, noise_correlation) = noise(&luma);
        Some(Self {
            luma_percentiles: [0.01, 0.1, 0.5, 0.9, 0.99].map(|share| percentile(&levels, share)),
            contrast: deviation(luma.data()),
            saturation: mean(&|[r, g, b]| {
                let most = r.max(g).max(b);
                (most - r.min(g).min(b)) / most.max(1.0)
            }),
            red_less_green: mean(&|[r, g, _]| r - g),
            blue_less_green: mean(&|[_, g, b]| b - g),
            gradient_percentiles: [0.5, 0.75, 0.9, 0.99].map(|share| percentile(&slopes, share)),
            bands,
            noise,
            noise_correlation,
        })
    }

    /// All figures in the order of [`PhotoStatistics::NAMES`].
    pub fn values(&self) -> [f64; 20] {
        let mut values = [0.0; 20];
        let singles = [self.contrast, self.saturation, self.red_less_green, self.blue_less_green];
        let all = self
            .luma_percentiles
            .iter()
            .chain(&singles)
            .chain(&self.gradient_percentiles)
            .chain(&self.bands)
            .chain([&self.noise, &self.noise_correlation]);
        for (value, figure) in values.iter_mut().zip(all) {
            *value = *figure;
        }
        values
    }
}

/// Noise and its correlation, from the flattest blocks of middling brightness.
fn noise(luma: &Image<f32>) -> (f64, f64) {
    const SIDE: usize = 16;
    let middle = 0.5 * (SIDE as f32 - 1.0);
    // Sum of squares of one coordinate over a block, for the plane's slopes.
    let spread: f32 = (0..SIDE).map(|i| (i as f32 - middle).powi(2)).sum::<f32>() * SIDE as f32;
    let mut blocks: Vec<(f64, f64)> = Vec::new();
    for top in (0..luma.height() - SIDE + 1).step_by(SIDE) {
        for left in (0..luma.width() - SIDE + 1).step_by(SIDE) {
            let at = |i: usize, j: usize| luma[(left + i, top + j)];
            let places = || (0..SIDE * SIDE).map(|n| (n % SIDE, n / SIDE));
            let mean = places().map(|(i, j)| at(i, j)).sum::<f32>() / (SIDE * SIDE) as f32;
            if !(15.0..240.0).contains(&mean) {
                continue;
            }
            let along_x = places().map(|(i, j)| at(i, j) * (i as f32 - middle)).sum::<f32>() / spread;
            let along_y = places().map(|(i, j)| at(i, j) * (j as f32 - middle)).sum::<f32>() / spread;
            let rest = |i: usize, j: usize| {
                f64::from(at(i, j) - mean - along_x * (i as f32 - middle) - along_y * (j as f32 - middle))
            };
            let squares: f64 = places().map(|(i, j)| rest(i, j).powi(2)).sum();
            let products: f64 = places().filter(|(i, _)| *i > 0).map(|(i, j)| rest(i, j) * rest(i - 1, j)).sum();
            blocks.push((squares, products * SIDE as f64 / (SIDE as f64 - 1.0)));
        }
    }
    blocks.sort_by(|a, b| a.0.total_cmp(&b.0));
    blocks.truncate(blocks.len().div_ceil(20));
    let Some(median) = blocks.get(blocks.len() / 2) else { return (0.0, 0.0) };
    let (squares, products) = blocks.iter().fold((0.0, 0.0), |sum, b| (sum.0 + b.0, sum.1 + b.1));
    let correlation = if squares > 0.0 { products / squares } else { 0.0 };
    ((median.0 / (SIDE * SIDE - 3) as f64).sqrt(), correlation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::normal;
    use mb_geometry::ImageSize;
    use mb_job::rng;

    fn grey(size: ImageSize, value: impl FnMut(usize, usize) -> f64) -> RgbImage {
        let mut value = value;
        Image::from_fn(size, |x, y| [value(x, y).round().clamp(0.0, 255.0) as u8; 3])
    }

    #[test]
    fn a_ramp_has_its_slope_and_no_noise() {
        let found = PhotoStatistics::of(&grey(ImageSize::new(128, 64), |x, _| 2.0 * x as f64)).unwrap();
        assert!(found.gradient_percentiles.iter().all(|g| (g - 2.0).abs() < 1e-4), "{found:?}");
        assert!(found.noise < 0.01 && found.saturation == 0.0 && found.red_less_green == 0.0, "{found:?}");
        assert!((found.luma_percentiles[2] - 127.0).abs() < 3.0);
    }

    #[test]
    fn white_noise_is_measured_and_found_uncorrelated() {
        let mut rng = rng(1, 0);
        let photo = grey(ImageSize::new(320, 320), |_, _| 120.0 + 3.0 * normal(&mut rng));
        let found = PhotoStatistics::of(&photo).unwrap();
        // The flattest twentieth has a little less than all.
        assert!((2.4..3.05).contains(&found.noise) && found.noise_correlation.abs() < 0.1, "{found:?}");
        assert!((found.contrast - 3.0).abs() < 0.1);
        assert_eq!(PhotoStatistics::NAMES.len(), found.values().len());
        assert!(PhotoStatistics::of(&grey(ImageSize::new(40, 320), |_, _| 1.0)).is_none());
    }
}
