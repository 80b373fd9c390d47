//! A model that a device trains, and its twin on the processor, which answers for it.

use mb_job::Result;
use mb_neural::cameras::CameraResiduals;
use mb_neural::dataset::{RayDataset, SceneRay};
use mb_neural::model::{Level, Model, StepReport};

/// Trains on a device what its twin holds.
pub trait Learner: Sync {
    /// The same model on the processor.
    type Twin: Model;

    /// All that is not of the device, and, after a fetch, all that the device has learned.
    fn twin(&self) -> &Self::Twin;
    /// See [`Self::twin`].
    fn twin_mut(&mut self) -> &mut Self::Twin;
    /// See [`Model::step`].
    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport>;
    /// See [`Model::fetch`].
    fn fetch(&mut self) -> Result<()>;
    /// Brings the twin's state to the device.
    fn send(&mut self);
}

/// A learner as a model: the device steps, the twin answers.
pub struct OnDevice<L>(pub L);

impl<L: Learner> Model for OnDevice<L> {
    fn name(&self) -> &'static str {
        self.0.twin().name()
    }

    fn only_object(&self) -> bool {
        self.0.twin().only_object()
    }

    fn iterations(&self) -> u64 {
        self.0.twin().iterations()
    }

    fn step(&mut self, data: &RayDataset, cameras: &mut CameraResiduals, step: u64) -> Result<StepReport> {
        self.0.step(data, cameras, step)
    }

    fn fetch(&mut self) -> Result<()> {
        self.0.fetch()
    }

    fn render(&self, rays: &[SceneRay]) -> Vec<[f32; 3]> {
        self.0.twin().render(rays)
    }

    fn level(&self) -> Level {
        self.0.twin().level()
    }

    fn surface(&self, positions: &[[f32; 3]]) -> Vec<f32> {
        self.0.twin().surface(positions)
    }

    fn may_cross(&self, low: [f32; 3], high: [f32; 3]) -> bool {
        self.0.twin().may_cross(low, high)
    }

    fn color_at(&self, positions: &[[f32; 3]], directions: &[[f32; 3]]) -> Vec<[f32; 3]> {
        self.0.twin().color_at(positions, directions)
    }

    fn buffers(&mut self) -> Vec<&mut Vec<f32>> {
        self.0.twin_mut().buffers()
    }

    fn restored(&mut self, step: u64) -> std::result::Result<(), String> {
        self.0.twin_mut().restored(step)?;
        self.0.send();
        Ok(())
    }

    fn is_finite(&self) -> bool {
        self.0.twin().is_finite()
    }

    fn parameter_count(&self) -> usize {
        self.0.twin().parameter_count()
    }

    fn bytes(&self) -> usize {
        self.0.twin().bytes()
    }
}
