//! What flows between the layers of a network, and the three kinds of layer that change it.

use rayon::prelude::*;

/// Features of an image: `[H, W, C]`, the channels of one pixel side by side.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Activation {
    pub width: usize,
    pub height: usize,
    pub channels: usize,
    pub data: Vec<f32>,
}

/// A convolution with zero padding, followed by ReLU as everywhere in these networks.
#[derive(Debug, Clone)]
pub(crate) struct Conv {
    pub kernel: usize,
    pub stride: usize,
    pub padding: usize,
    pub in_channels: usize,
    pub out_channels: usize,
    /// `[ky, kx, in, out]`.
    pub weights: Vec<f32>,
    /// `[out]`.
    pub bias: Vec<f32>,
}

/// A maximum over windows of `size` x `size` pixels, two pixels apart.
#[derive(Debug, Clone, Copy)]
pub(crate) struct MaxPool {
    pub size: usize,
    /// Whether a window that is cut off by the border counts.
    pub ceil: bool,
}

/// Floats of gathered patches that one piece of work multiplies: about a megabyte, within the second-level cache.
const PATCH_FLOATS: usize = 1 << 18;

impl Activation {
    pub fn zeros(width: usize, height: usize, channels: usize) -> Self {
        Self { width, height, channels, data: vec![0.0; width * height * channels] }
    }

    /// The channels of both, one after the other, pixel by pixel; sizes must agree.
    pub fn concatenated(&self, other: &Self) -> Self {
        let channels = self.channels + other.channels;
        let mut both = Self::zeros(self.width, self.height, channels);
        let halves = self.data.chunks_exact(self.channels).zip(other.data.chunks_exact(other.channels));
        for (pixel, (first, second)) in both.data.chunks_exact_mut(channels).zip(halves) {
            pixel[..first.len()].copy_from_slice(first);
            pixel[first.len()..].copy_from_slice(second);
        }
        both
    }
}

impl Conv {
    /// Size of the output along an axis of `size` pixels; `None` where the kernel does not fit.
    pub fn output_size(&self, size: usize) -> Option<usize> {
        Some((size + 2 * self.padding).checked_sub(self.kernel)? / self.stride + 1)
    }

    /// Convolves and clamps at zero. `None` where the input is smaller than the kernel.
    ///
    /// Each piece gathers the patches of some output pixels as rows of a matrix, and multiplies it with the weights. The
    /// pieces depend on the layer alone, and so does the result.
    pub fn forward(&self, input: &Activation) -> Option<Activation> {
        debug_assert_eq!(input.channels, self.in_channels);
        let (width, height) = (self.output_size(input.width)?, self.output_size(input.height)?);
        let mut output = Activation::zeros(width, height, self.out_channels);
        let patch = self.kernel * self.kernel * self.in_channels;
        let piece = (PATCH_FLOATS / patch).max(16);
        output.data.par_chunks_mut(piece * self.out_channels).enumerate().for_each_init(
            Vec::new,
            |patches, (i, out)| {
                let pixels = out.len() / self.out_channels;
                patches.clear();
                patches.resize(pixels * patch, 0.0);
                for (pixel, row) in patches.chunks_exact_mut(patch).enumerate() {
                    let at = i * piece + pixel;
                    self.gather(input, at % width, at / width, row);
                }
                out.chunks_exact_mut(self.out_channels).for_each(|o| o.copy_from_slice(&self.bias));
                multiply_add(patches, &self.weights, out, [pixels, patch, self.out_channels]);
                out.iter_mut().for_each(|v| *v = v.max(0.0));
            },
        );
        Some(output)
    }

    /// Copies what the kernel covers at an output pixel; what lies outside the image stays zero.
    fn gather(&self, input: &Activation, x: usize, y: usize, row: &mut [f32]) {
        let (left, top) = (x * self.stride, y * self.stride);
        // The kernel's columns that lie inside the image; `left` counts from the padded border.
        let first = self.padding.saturating_sub(left).min(self.kernel);
        let last = (input.width + self.padding).saturating_sub(left).clamp(first, self.kernel);
        let count = (last - first) * self.in_channels;
        for ky in 0..self.kernel {
            let Some(source_y) = (top + ky).checked_sub(self.padding).filter(|&y| y < input.height) else { continue };
            if count == 0 {
                continue;
            }
            let from = (source_y * input.width + left + first - self.padding) * self.in_channels;
            let to = (ky * self.kernel + first) * self.in_channels;
            row[to..to + count].copy_from_slice(&input.data[from..from + count]);
        }
    }
}

/// `out[m, n] += a[m, k] * b[k, n]`, all row-major.
fn multiply_add(a: &[f32], b: &[f32], out: &mut [f32], [m, k, n]: [usize; 3]) {
    assert!(a.len() == m * k && b.len() == k * n && out.len() == m * n);
    let [rows, columns] = [k as isize, n as isize];
    // SAFETY: the three slices have exactly the sizes that the row strides reach over, and `out` is borrowed alone.
    unsafe {
        matrixmultiply::sgemm(
            m,
            k,
            n,
            1.0,
            a.as_ptr(),
            rows,
            1,
            b.as_ptr(),
            columns,
            1,
            1.0,
            out.as_mut_ptr(),
            columns,
            1,
        );
    }
}

impl MaxPool {
    /// `None` where the input is smaller than the window.
    pub fn forward(self, input: &Activation) -> Option<Activation> {
        const STRIDE: usize = 2;
        let output_size = |size: usize| {
            let room = size.checked_sub(self.size)?;
            Some(if self.ceil { room.div_ceil(STRIDE) } else { room / STRIDE } + 1)
        };
        let (width, height) = (output_size(input.width)?, output_size(input.height)?);
        let channels = input.channels;
        let mut output =
            Activation { data: vec![f32::NEG_INFINITY; width * height * channels], width, height, channels };
        output.data.par_chunks_mut(width * channels).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.chunks_exact_mut(channels).enumerate() {
                for source_y in y * STRIDE..(y * STRIDE + self.size).min(input.height) {
                    for source_x in x * STRIDE..(x * STRIDE + self.size).min(input.width) {
                        let from = (source_y * input.width + source_x) * channels;
                        for (best, value) in pixel.iter_mut().zip(&input.data[from..from + channels]) {
                            *best = best.max(*value);
                        }
                    }
                }
            }
        });
        Some(output)
    }
}
