//! What a learned image distance must offer.

use mb_job::Result;

use crate::views::ColorImage;

/// A perceptual distance between images, such as LPIPS. This crate defines the measure's place in the scores; whoever
/// holds the network implements it.
pub trait PerceptualMetric: Sync {
    /// What goes into the scores beside the value, such as `lpips-vgg`, with a hash of the weights where it has one.
    fn name(&self) -> String;

    /// The distance of two images of one size, 0 for equal ones.
    ///
    /// # Errors
    /// The images are too small for the network, or their sizes differ.
    fn distance(&self, a: &ColorImage, b: &ColorImage) -> Result<f64>;
}
