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

    /// Every second pixel.
    fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let data = (0..height).flat_map(|y| self.row(2 * y).iter().step_by(2).take(width).copied()).collect();
        Self { width, height, data }
    }

    /// Blurred by a Gaussian; the border's pixels continue outside.
    fn blurred(&self, sigma: f32) -> Self {
        let kernel = gaussian(sigma);
        let (width, height, radius) = (self.width, self.height, kernel.len() / 2);
        let mut data = vec![0.0f32; width * height];
        let mut padded = Padded::new(width, radius);
        for (y, out) in data.chunks_exact_mut(width).enumerate() {
            weighted_sum(padded.row(), &kernel, &self.rows_about(y, radius, radius));
            weighted_sum(out, &kernel, &padded.shifted(kernel.len(), 0));
        }
        Self { width, height, data }
    }

    /// Twice the size, bilinear, pixel (2x, 2y) on pixel (x, y), and then blurred by a Gaussian; both at once.
    fn doubled_and_blurred(&self, sigma: f32) -> Self {
        let (even, odd) = polyphase(&gaussian(sigma));
        let (width, height, radius) = (self.width, self.height, even.len() / 2);
        let mut data = vec![0.0f32; 4 * width * height];
        let mut padded = Padded::new(width, radius);
        let (mut on, mut between) = (vec![0.0f32; width], vec![0.0f32; width]);
        for (y, out) in data.chunks_exact_mut(4 * width).enumerate() {
            let (upper, lower) = out.split_at_mut(2 * width);
            for (out, kernel, above) in [(upper, &even, radius), (lower, &odd, radius - 1)] {
                weighted_sum(padded.row(), kernel, &self.rows_about(y, above, kernel.len() - 1 - above));
                weighted_sum(&mut on, &even, &padded.shifted(even.len(), 0));
                weighted_sum(&mut between, &odd, &padded.shifted(odd.len(), 1));
                for (out, (a, b)) in out.chunks_exact_mut(2).zip(on.iter().zip(&between)) {
                    (out[0], out[1]) = (*a, *b);
                }
            }
        }
        Self { width: 2 * width, height: 2 * height, data }
    }

    /// Row `y` with so many above and below it; the border's rows continue outside.
    fn rows_about(&self, y: usize, above: usize, below: usize) -> Vec<&[f32]> {
        (0..=above + below).map(|k| self.row((y + k).saturating_sub(above).min(self.height - 1))).collect()
    }
}

/// A Gaussian at the integers up to four deviations, its sum one.
fn gaussian(sigma: f32) -> Vec<f32> {
    let radius = (4.0 * sigma).ceil() as usize;
    let mut kernel: Vec<f32> =
        (0..=2 * radius).map(|i| (-((i as f32 - radius as f32) / sigma).powi(2) / 2.0).exp()).collect();
    let sum: f32 = kernel.iter().sum();
    kernel.iter_mut().for_each(|k| *k /= sum);
    kernel
}

/// Linear interpolation to twice as many values, then `kernel` (odd length), as two kernels on the values that were
/// there: for a value on one of them (odd length), and for the one between it and the next (one shorter).
fn polyphase(kernel: &[f32]) -> (Vec<f32>, Vec<f32>) {
    let radius = kernel.len() as isize / 2;
    // The furthest neighbour that either touches.
    let reach = radius / 2 + 1;
    let phase = |to: isize, first: isize| {
        let mut phase = vec![0.0f32; (reach - first + 1) as usize];
        for (k, weight) in kernel.iter().enumerate() {
            let at = to + k as isize - radius;
            let (left, right) = (at.div_euclid(2), (at + 1).div_euclid(2));
            phase[(left - first) as usize] += 0.5 * weight;
            phase[(right - first) as usize] += 0.5 * weight;
        }
        phase
    };
    (phase(0, -reach), phase(1, 1 - reach))
}

/// A row whose first and last values continue outside it.
struct Padded {
    width: usize,
    radius: usize,
    data: Vec<f32>,
}

impl Padded {
    fn new(width: usize, radius: usize) -> Self {
        Self { width, radius, data: vec![0.0; width + 2 * radius] }
    }

    /// The row itself, to be written.
    fn row(&mut self) -> &mut [f32] {
        &mut self.data[self.radius..self.radius + self.width]
    }

    /// The row shifted `count` times by one, so that what lies `radius - first` to the left comes first.
    fn shifted(&mut self, count: usize, first: usize) -> Vec<&[f32]> {
        let (width, radius) = (self.width, self.radius);
        let (left, right) = (self.data[radius], self.data[radius + width - 1]);
        self.data[..radius].fill(left);
        self.data[radius + width..].fill(right);
        (first..first + count).map(|k| &self.data[k..k + width]).collect()
    }
}

/// The sum of rows, each with its weight.
#[multiversion(targets("x86_64+avx2"))]
fn weighted_sum(out: &mut [f32], weights: &[f32], rows: &[&[f32]]) {
    /// Sums that are held in registers.
    const BLOCK: usize = 32;
    let (blocks, rest) = out.as_chunks_mut::<BLOCK>();
    for (i, out) in blocks.iter_mut().enumerate() {
        let mut sums = [0.0f32; BLOCK];
        for (row, weight) in rows.iter().zip(weights) {
            let row = &row[i * BLOCK..(i + 1) * BLOCK];
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += weight * value;
            }
        }
        *out = sums;
    }
    let done = blocks.len() * BLOCK;
    for (i, out) in rest.iter_mut().enumerate() {
        *out = rows.iter().zip(weights).map(|(row, weight)| weight * row[done + i]).sum();
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
    if upsample { grey.doubled_and_blurred(more(2.0 * CAMERA_SIGMA)) } else { grey.blurred(more(CAMERA_SIGMA)) }
}

/// The base of the next octave; `None` when it would be too small to hold a feature.
pub(crate) fn next_octave(octave: &Octave) -> Option<Plane> {
    let twice = &octave.planes[Octave::SCALES];
    (twice.width.min(twice.height) >= 24).then(|| twice.halved())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn doubling_and_blurring_at_once_is_one_after_the_other() {
        let (width, height) = (41, 29);
        let brightness = |i: usize| (i * 7919 % 251) as f32 / 250.0;
        let grey = Plane { width, height, data: (0..width * height).map(brightness).collect() };
        let mut doubled = Plane { width: 2 * width, height: 2 * height, data: Vec::new() };
        for (y, x) in (0..2 * height).flat_map(|y| (0..2 * width).map(move |x| (y, x))) {
            let (right, below) = ((x.div_ceil(2)).min(width - 1), (y.div_ceil(2)).min(height - 1));
            let corners = [(x / 2, y / 2), (right, y / 2), (x / 2, below), (right, below)];
            doubled.data.push(corners.iter().map(|&(x, y)| grey.at(x, y)).sum::<f32>() / 4.0);
        }
        // Kernels of even and of odd radius.
        for sigma in [0.9, 1.2, 1.6] {
            let (at_once, expected) = (grey.doubled_and_blurred(sigma), doubled.blurred(sigma));
            assert_eq!((at_once.width, at_once.height), (2 * width, 2 * height));
            for (i, (a, b)) in at_once.data.iter().zip(&expected.data).enumerate() {
                assert!((a - b).abs() < 1e-6, "sigma {sigma}, pixel {i}: {a} is not {b}");
            }
        }
    }

    #[test]
    fn a_blurred_step_is_the_error_function() {
        let (width, height) = (80, 3);
        let data = (0..width * height).map(|i| if i % width < 40 { 0.0 } else { 1.0 }).collect();
        let sigma = 3.0;
        let blurred = Plane { width, height, data }.blurred(sigma);
        // The Gaussian's integral at -1.5, -0.5, 0.5 and 1.5 pixels from the step, in deviations of 3 pixels.
        for (x, expected) in [(38, 0.30854), (39, 0.43382), (40, 0.56618), (41, 0.69146)] {
            assert!((blurred.at(x, 1) - expected).abs() < 1e-3, "{x}: {}", blurred.at(x, 1));
        }
        assert!(blurred.at(0, 0).abs() < 1e-6 && (blurred.at(79, 2) - 1.0).abs() < 1e-6);
    }
}
