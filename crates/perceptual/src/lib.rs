//! LPIPS: how different two images look to a network that was trained to recognise things (Zhang et al. 2018, "The
//! unreasonable effectiveness of deep features as a perceptual metric").
//!
//! What comes in: two images and a file of weights that the user supplies (none are part of the project). What goes out:
//! one distance, 0 for equal images. [`Lpips`] holds a network, reads its weights from safetensors or from the original
//! `.pth` files, and implements [`mb_eval::PerceptualMetric`], through which the scores of views use it.
//!
//! Forward passes of three networks (VGG-16, AlexNet, SqueezeNet 1.1) are all there is: no training, no other layers.
//! A pair of 1920x1440 images takes VGG about 2.2 GB of memory.

mod activation;
mod lpips;
mod network;
mod safetensors;
mod tensors;
mod torch_file;

pub use lpips::{Lpips, LpipsNet, WeightsReport};
