//! Where a field is trained: the trait that other devices fill.

use mb_job::Result;

use crate::dataset::RayDataset;
use crate::method::FieldOptions;
use crate::model::Model;

/// A machine that trains fields. [`Processor`] knows every method and is the readable twin of all others.
pub trait Device {
    /// For people.
    fn name(&self) -> String;

    /// The untrained model of these options.
    ///
    /// # Errors
    /// The device does not know the method or an option, or lacks the memory: what to do instead.
    fn model(&self, options: &FieldOptions, data: &RayDataset) -> Result<Box<dyn Model>>;
}

/// This machine's processor, with all its cores.
#[derive(Debug, Clone, Copy, Default)]
pub struct Processor;

impl Device for Processor {
    fn name(&self) -> String {
        "the processor".to_owned()
    }

    fn model(&self, options: &FieldOptions, data: &RayDataset) -> Result<Box<dyn Model>> {
        Ok(options.model(data))
    }
}
