//! What the trainer needs of a method.

use mb_job::Result;

use crate::cameras::CameraResiduals;
use crate::dataset::{RayDataset, SceneRay};

/// What one training step found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// The whole loss.
    pub loss: f64,
    /// Mean squared error of the colours, sRGB in 0..=1.
    pub mse: f64,
    /// Rays of the step.
    pub rays: usize,
    /// Samples of the step.
    pub samples: usize,
    /// Of them, those that light reached: only they get colours and derivatives.
    pub lit: usize,
}

/// Where a method's surface is: the level set of a function.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Level {
    /// The value on the surface.
    pub value: f32,
    /// Whether larger values lie inside (densities) or outside (distances).
    pub larger_inside: bool,
}

/// A scene representation that learns from rays. Everything that a step depends on is the model's state, the data, the
/// seed and the step's number: a model restored from a checkpoint goes on exactly as if it had never stopped.
pub trait Model: Sync {
    /// `nerf`, `neus`, `dvgo`.
    fn name(&self) -> &'static str;
    /// Whether it learned only the object, before black: what [`crate::dataset::View::shown`] then gives is its
    /// measure.
    fn only_object(&self) -> bool;
    /// Steps of a whole run.
    fn iterations(&self) -> u64;
    /// One step, counted from 0.
    ///
    /// # Errors
    /// The device was lost or ran out of memory.
    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport>;
    /// Brings what a device has learned to this side; everything below is asked for after it.
    ///
    /// # Errors
    /// As [`Self::step`].
    fn fetch(&mut self) -> Result<()> {
        Ok(())
    }
    /// Colours of rays.
    fn render(&self, rays: &[SceneRay]) -> Vec<[f32; 3]>;
    /// The surface's level.
    fn level(&self) -> Level;
    /// The function whose level set is the surface, at points of the scene frame.
    fn surface(&self, positions: &[[f32; 3]]) -> Vec<f32>;
    /// Whether the surface may cross a box of the scene frame; a box where it cannot is not evaluated.
    fn may_cross(&self, low: [f32; 3], high: [f32; 3]) -> bool;
    /// Colours of points of the scene frame, each seen along its (unit) direction.
    fn color_at(&self, positions: &[[f32; 3]], directions: &[[f32; 3]]) -> Vec<[f32; 3]>;
    /// Everything that a checkpoint holds, always in the same order.
    fn buffers(&mut self) -> Vec<&mut Vec<f32>>;
    /// Called after a checkpoint has been read into the buffers, which then have the lengths that they had when it was
    /// written; `step` comes next.
    ///
    /// # Errors
    /// The buffers do not fit the model.
    fn restored(&mut self, step: u64) -> std::result::Result<(), String>;
    /// Whether every parameter is a finite number.
    fn is_finite(&self) -> bool;
    /// Number of parameters.
    fn parameter_count(&self) -> usize;
    /// Bytes of the parameters with their gradients and moments, and of the work buffers of a step, at their largest.
    fn bytes(&self) -> usize;
}

/// Whether a checkpoint gave each buffer the length that it has to have.
pub fn same_lengths(buffers: &[&mut Vec<f32>], lengths: &[usize]) -> std::result::Result<(), String> {
    if buffers.len() == lengths.len() && buffers.iter().zip(lengths).all(|(b, n)| b.len() == *n) {
        Ok(())
    } else {
        Err("the checkpoint belongs to a run with other options".to_owned())
    }
}

/// Independent pieces of a step. Fixed, because each piece has its own stream of random numbers and its own sums.
pub const GROUPS: usize = 32;

/// Samples that go through the networks at once: their activations stay in the second-level cache.
pub const TILE: usize = 512;
