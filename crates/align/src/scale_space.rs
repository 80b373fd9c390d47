//! Gaussian scale space of a grey image, octave by octave.

use mb_image::RgbImage;
use multiversion::multiversion;

/// A grey image, brightness in [0, 1], row-major.
#[derive(Debug, Clone)]
pub(crate) struct Plane {
    pub width: usize,
    pub height: usize,
    data: Vec<f32>,
}

/// Blur of the base of every octave, in its pixels (Lowe 2004, section 3.3).
const BASE_SIGMA: f32 = 1.6;
/// Blur that a photograph has to begin with, pixels.
const CAMERA_SIGMA: f32 = 0.5;

impl Plane {
    /// Brightness by Rec. 601.
    pub fn from_rgb(image: &RgbImage) -> Self {
        let grey = |p: &[u8; 3]| (0.299 * f32::from(p[0]) + 0.587 * f32::from(p[1]) + 0.114 * f32::from(p[2])) / 255.0;
        Self { width: image.width(), height: image.height(), data: image.data().iter().map(grey).collect() }
    }

    pub fn row(&self, y: usize) -> &[f32] {
        &self.data[y * self.width..(y + 1) * self.width]
    }

    fn at(&self, x: usize, y: usize) -> f32 {
        self.data[y * self.width + x]
    }

    /// Central differences; `None` at the border.
    pub fn gradient(&self, x: isize, y: isize) -> Option<(f32, f32)> {
        if x < 1 || y < 1 || x + 1 >= self.width as isize || y + 1 >= self.height as isize {
            return None;
        }
        let (x, y) = (x as usize, y as usize);
        Some((self.at(x + 1, y) - self.at(x - 1, y), self.at(x, y + 1) - self.at(x, y - 1)))
    }

    /// Twice the size, bilinear; pixel (2x, 2y) lies on pixel (x, y).
    fn doubled(&self) -> Self {
        let (width, height) = (2 * self.width, 2 * self.height);
        let mut data = Vec::with_capacity(width * height);
        for y in 0..height {
            let (above, below) = (self.row(y / 2), self.row((y / 2 + y % 2).min(self.height - 1)));
            for x in 0..width {
                let (left, right) = (x / 2, (x / 2 + x % 2).min(self.width - 1));
                data.push(0.25 * (above[left] + above[right] + below[left] + below[right]));
            }
        }
        Self { width, height, data }
    }

    /// Every second pixel.
    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let data = (0..height).flat_map(|y| self.row(2 * y).iter().step_by(2).take(width).copied()).collect();
        Self { width, height, data }
    }

    /// Blurred by a Gaussian; the border's pixels continue outside.
    fn blurred(&self, sigma: f32) -> Self {
        let radius = (4.0 * sigma).ceil() as usize;
        let mut kernel: Vec<f32> =
            (0..=2 * radius).map(|i| (-((i as f32 - radius as f32) / sigma).powi(2) / 2.0).exp()).collect();
        let sum: f32 = kernel.iter().sum();
        kernel.iter_mut().for_each(|k| *k /= sum);
        let (width, height) = (self.width, self.height);
        let mut across = vec![0.0f32; width * height];
        let mut padded = vec![0.0f32; width + 2 * radius];
        for (y, out) in across.chunks_exact_mut(width).enumerate() {
            let row = self.row(y);
            padded[..radius].fill(row[0]);
            padded[radius..radius + width].copy_from_slice(row);
            padded[radius + width..].fill(row[width - 1]);
            weighted_sum(out, &kernel, |k| &padded[k..k + width]);
        }
        let mut data = vec![0.0f32; width * height];
        for (y, out) in data.chunks_exact_mut(width).enumerate() {
            weighted_sum(out, &kernel, |k| {
                let y = (y + k).saturating_sub(radius).min(height - 1);
                &across[y * width..(y + 1) * width]
            });
        }
        Self { width, height, data }
    }
}

/// The sum of rows, each with its weight of a symmetric kernel of odd length; `row(k)` is the row of weight `k`.
fn weighted_sum<'a>(out: &mut [f32], kernel: &[f32], row: impl Fn(usize) -> &'a [f32]) {
    let radius = kernel.len() / 2;
    scale(out, row(radius), kernel[radius]);
    for k in 0..radius {
        add_pair(out, row(k), row(2 * radius - k), kernel[k]);
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn scale(out: &mut [f32], row: &[f32], weight: f32) {
    for (o, p) in out.iter_mut().zip(row) {
        *o = weight * p;
    }
}

#[multiversion(targets("x86_64+avx2"))]
fn add_pair(out: &mut [f32], a: &[f32], b: &[f32], weight: f32) {
    for ((o, a), b) in out.iter_mut().zip(a).zip(b) {
        *o += weight * (a + b);
    }
}

/// One octave: Gaussians whose blur doubles in [`Octave::SCALES`] steps, with what the differences need at both ends.
pub(crate) struct Octave {
    pub planes: Vec<Plane>,
}

impl Octave {
    /// Steps per octave.
    pub const SCALES: usize = 3;

    /// From its base, which already has [`BASE_SIGMA`].
    pub fn new(base: Plane) -> Self {
        let mut planes = vec![base];
        for i in 1..Self::SCALES + 3 {
            let sigma = |i: usize| BASE_SIGMA * 2f32.powf(i as f32 / Self::SCALES as f32);
            let more = (sigma(i).powi(2) - sigma(i - 1).powi(2)).sqrt();
            let next = planes[i - 1].blurred(more);
            planes.push(next);
        }
        Self { planes }
    }

    /// Difference of Gaussians.
    pub fn dog(&self, s: usize, x: usize, y: usize) -> f32 {
        self.planes[s + 1].at(x, y) - self.planes[s].at(x, y)
    }

    /// Blur at a fractional plane, in the octave's pixels.
    pub fn sigma(&self, scale: f32) -> f32 {
        BASE_SIGMA * 2f32.powf(scale / Self::SCALES as f32)
    }

    /// The plane whose blur is nearest.
    pub fn nearest_plane(&self, scale: f32) -> &Plane {
        &self.planes[(scale.round().max(0.0) as usize).min(self.planes.len() - 1)]
    }
}

/// The first octave's base.
pub(crate) fn base_plane(grey: &Plane, upsample: bool) -> Plane {
    let more = |has: f32| (BASE_SIGMA.powi(2) - has.powi(2)).sqrt();
    if upsample { grey.doubled().blurred(more(2.0 * CAMERA_SIGMA)) } else { grey.blurred(more(CAMERA_SIGMA)) }
}

/// The base of the next octave; `None` when it would be too small to hold a feature.
pub(crate) fn next_octave(octave: &Octave) -> Option<Plane> {
    let twice = &octave.planes[Octave::SCALES];
    (twice.width.min(twice.height) >= 24).then(|| twice.halved())
}
