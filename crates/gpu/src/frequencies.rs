//! The frequency encoding on the device, and its derivatives.

use mb_neural::encoding::Frequencies;

use crate::context::{Buffer, Kernel, Work};
use crate::encoding::Points;
use crate::kernels::Kernels;
use crate::rays::Samples;

/// The columns that an encoding fills of `[samples, stride]` rows.
#[derive(Clone, Copy)]
pub struct Columns<'a> {
    /// The rows.
    pub to: &'a Buffer,
    /// Row length.
    pub stride: usize,
    /// First column.
    pub first: usize,
}

fn sizes(octaves: Frequencies, coordinates: usize, samples: usize, columns: Columns<'_>) -> [u32; 5] {
    [samples, coordinates, octaves.0, columns.stride, columns.first].map(|n| n as u32)
}

/// Encodes `scale x + shift` of points with so many coordinates.
pub fn encode_positions(
    work: &mut Work<'_>,
    k: &Kernels,
    octaves: Frequencies,
    (points, coordinates): (Points<'_>, usize),
    [scale, shift]: [f32; 2],
    columns: Columns<'_>,
) {
    let mut sizes = sizes(octaves, coordinates, points.count, columns).to_vec();
    sizes.extend([scale, shift].map(f32::to_bits));
    let buffers = [(3, points.positions), (4, columns.to)];
    work.run(&k.frequencies_of_positions, &sizes, &buffers, points.count * coordinates);
}

/// Encodes the directions of the samples' rays.
pub fn encode_directions(
    work: &mut Work<'_>,
    k: &Kernels,
    octaves: Frequencies,
    (rays, samples): (&Buffer, &Samples),
    columns: Columns<'_>,
) {
    let mut sizes = sizes(octaves, 3, samples.len, columns).to_vec();
    sizes.extend([0; 2]);
    let buffers = [(1, rays), (2, &samples.ray_of), (4, columns.to)];
    work.run(&k.frequencies_of_directions, &sizes, &buffers, 3 * samples.len);
}

/// Writes `[samples, coordinates]` normals: what `[samples, stride]` derivatives by an encoding of positions ask.
pub fn normals(
    work: &mut Work<'_>,
    k: &Kernels,
    octaves: Frequencies,
    (samples, coordinates): (usize, usize),
    columns: Columns<'_>,
    [gradient, normals]: [&Buffer; 2],
) {
    let buffers = [(4, columns.to), (5, gradient), (6, normals)];
    derive(work, &k.normals_of_frequencies, octaves, (samples, coordinates), columns, &buffers);
}

/// Writes the tangents of an encoding of positions along `[samples, 3]` vectors.
pub fn tangent(
    work: &mut Work<'_>,
    k: &Kernels,
    octaves: Frequencies,
    samples: usize,
    columns: Columns<'_>,
    [along, tangent]: [&Buffer; 2],
) {
    let buffers = [(4, columns.to), (5, tangent), (6, along)];
    derive(work, &k.tangent_of_frequencies, octaves, (samples, 3), columns, &buffers);
}

/// Writes `[samples, 3]` derivatives by the position: what derivatives of the encoding and, with g, derivatives of the normals
/// ask.
pub fn position_gradient(
    work: &mut Work<'_>,
    k: &Kernels,
    octaves: Frequencies,
    samples: usize,
    columns: Columns<'_>,
    [d, gradient, d_normals, to]: [&Buffer; 4],
) {
    let buffers = [(4, columns.to), (5, d), (6, d_normals), (7, gradient), (8, to)];
    derive(work, &k.position_gradient_of_frequencies, octaves, (samples, 3), columns, &buffers);
}

fn derive(
    work: &mut Work<'_>,
    kernel: &Kernel,
    octaves: Frequencies,
    (samples, coordinates): (usize, usize),
    columns: Columns<'_>,
    buffers: &[(u32, &Buffer)],
) {
    let mut sizes = sizes(octaves, coordinates, samples, columns).to_vec();
    sizes.extend([0; 2]);
    work.run(kernel, &sizes, buffers, coordinates * samples);
}
