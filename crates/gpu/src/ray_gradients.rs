//! What the losses ask of rays, and so of the cameras, from what they ask of the rays' samples.

use mb_neural::cameras::{CameraResiduals, RayGradient};
use mb_neural::dataset::{RayDataset, TargetRay};
use mb_neural::encoding::{Frequencies, HARMONICS};
use mb_neural::sdf_field::DirectionEncoding;

use crate::context::{Buffer, WORKGROUP, Work};
use crate::kernels::Kernels;
use crate::rays::Samples;

/// Numbers of a ray's derivatives: of its origin and of its direction, each with one of padding.
pub const RAY_GRADIENT: usize = 8;

/// Of what the positions of samples are coordinates. Their origin is the middle of the region of interest.
#[derive(Debug, Clone, Copy)]
pub enum Coordinates {
    /// The scene.
    Scene,
    /// Contracted space, whose cube is -2..2.
    Contracted,
    /// What is outside the ball, as four numbers: `(p / |p|, 1 / |p|)`.
    Inverted,
}

/// Derivatives of a loss by the positions of samples.
#[derive(Clone, Copy)]
pub struct ByPosition<'a> {
    /// `[samples, 3]`, or 4.
    pub d: &'a Buffer,
    /// Of what the positions are coordinates.
    pub of: Coordinates,
    /// How fast the positions grow with those; their fourth number is as it is.
    pub scale: [f32; 3],
}

/// Derivatives of a loss by what a colour network takes.
#[derive(Clone, Copy)]
pub struct ByColor<'a> {
    /// `[samples, stride]`
    pub d: &'a Buffer,
    /// Row length.
    pub stride: usize,
    /// Whether the position comes first, as a point of the scene.
    pub with_position: bool,
    /// First column of the encoded direction.
    pub first: usize,
    /// How the direction is encoded, where the network sees it.
    pub direction: Option<DirectionEncoding>,
}

impl ByColor<'_> {
    fn sizes(&self) -> [u32; 5] {
        let (columns, harmonics) = match self.direction {
            None => (0, 0),
            Some(DirectionEncoding::Harmonics) => (HARMONICS, 1),
            Some(DirectionEncoding::Frequencies(octaves)) => (Frequencies(octaves).width(), 0),
        };
        [self.stride, usize::from(self.with_position), self.first, columns, harmonics].map(|n| n as u32)
    }
}

/// Adds what the samples' derivatives ask of each of the `count` rays to `[rays, 8]` numbers, which begin at number `4 first`
/// of a buffer.
pub fn add(
    work: &mut Work<'_>,
    k: &Kernels,
    (rays, count): (&Buffer, usize),
    s: &Samples,
    (position, color): (ByPosition<'_>, ByColor<'_>),
    (to, first): (&Buffer, usize),
) {
    let space = match position.of {
        Coordinates::Scene => 0,
        Coordinates::Contracted => 1,
        Coordinates::Inverted => 2,
    };
    let mut sizes = vec![count as u32, space];
    sizes.extend(position.scale.map(f32::to_bits));
    sizes.extend(color.sizes());
    sizes.push(first as u32);
    let buffers = [(1, rays), (2, &s.starts), (3, &s.steps), (4, position.d), (5, color.d), (6, to)];
    work.run(&k.ray_gradient, &sizes, &buffers, count * WORKGROUP);
}

/// Moves the cameras of a step's rays, which come in the order in which they were drawn, as their derivatives ask; without rays
/// they stay. `factor` is the schedule's.
pub fn correct(
    cameras: &mut CameraResiduals,
    data: &RayDataset,
    targets: &[TargetRay],
    found: &[[f32; RAY_GRADIENT]],
    (factor, step): (f32, u64),
) {
    let gradient = |g: &[f32; RAY_GRADIENT]| RayGradient { origin: [g[0], g[1], g[2]], direction: [g[4], g[5], g[6]] };
    let gradients: Vec<RayGradient> = found.iter().map(gradient).collect();
    cameras.add(data, targets.iter().zip(&gradients));
    cameras.step(data, factor, step);
}
