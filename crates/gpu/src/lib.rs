//! Training on a GPU: a [`mb_neural::device::Device`] over Vulkan, with WGSL kernels of our own.
//!
//! In: [`DeviceChoice`] and the options of a field. Out: the device that trains it. Only the feature `wgpu` brings in
//! the driver; without it, a wish for a GPU ends with a sentence that says so.
//!
//! ```
//! use mb_gpu::{DeviceChoice, device};
//! let options = mb_neural::FieldOptions::preset("nerf", "fast", 0).expect("a known method");
//! let device = device("cpu".parse::<DeviceChoice>().expect("a device"), &options).expect("always there");
//! assert_eq!(device.name(), "the processor");
//! ```
//!
//! Every kernel has a twin on the processor, to which the tests compare it. Sums that meet in one place are added as
//! whole numbers or in a fixed order, so a run's result does not depend on the order of threads.
//!
//! Limits: a hash encoding in `neus` of the preset `fast` and frequencies in that of `paper`; rendering and extraction run on the processor.

use std::str::FromStr;

use mb_job::{Error, Result};
use mb_neural::device::{Device, Processor};
use mb_neural::sdf_field::PositionEncoding;
use mb_neural::{FieldOptions, Method};

#[cfg(feature = "wgpu")]
pub mod context;
#[cfg(feature = "wgpu")]
mod dvgo;
#[cfg(feature = "wgpu")]
pub mod encoding;
#[cfg(feature = "wgpu")]
mod frequencies;
#[cfg(feature = "wgpu")]
mod frequency_field;
#[cfg(feature = "wgpu")]
pub mod kernels;
#[cfg(feature = "wgpu")]
mod nerf;
#[cfg(feature = "wgpu")]
mod nerf_original;
#[cfg(feature = "wgpu")]
pub mod network;
#[cfg(feature = "wgpu")]
mod neus;
#[cfg(feature = "wgpu")]
mod neus_original;
#[cfg(feature = "wgpu")]
mod on_device;
#[cfg(feature = "wgpu")]
mod radiance;
#[cfg(feature = "wgpu")]
mod ray_gradients;
#[cfg(feature = "wgpu")]
mod rays;
pub mod shaders;
#[cfg(feature = "wgpu")]
mod surface;
#[cfg(all(test, feature = "wgpu"))]
mod tests;
#[cfg(feature = "wgpu")]
pub mod trained;

/// Where to train.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeviceChoice {
    /// The first GPU, where there is one that knows the method; else the processor.
    Auto,
    /// The processor.
    Cpu,
    /// The GPU of this number, or the first one.
    Gpu(Option<usize>),
}

impl FromStr for DeviceChoice {
    type Err = String;

    fn from_str(text: &str) -> std::result::Result<Self, String> {
        match text {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu(None)),
            _ => text
                .strip_prefix("gpu:")
                .and_then(|number| number.parse().ok())
                .map(|number| Self::Gpu(Some(number)))
                .ok_or_else(|| format!("{text:?} is no device: auto, cpu, gpu or gpu:N")),
        }
    }
}

/// The device of a choice, for a run with these options.
///
/// # Errors
/// A GPU is asked for, and this build, this machine or the method has none: what to do instead.
pub fn device(choice: DeviceChoice, options: &FieldOptions) -> Result<Box<dyn Device>> {
    match (choice, unsupported(options)) {
        (DeviceChoice::Cpu, _) | (DeviceChoice::Auto, Some(_)) => Ok(Box::new(Processor)),
        (DeviceChoice::Auto, None) => Ok(first_gpu().unwrap_or_else(|| Box::new(Processor))),
        (DeviceChoice::Gpu(_), Some(why)) => Err(Error::Failed(format!("{why}. Use --device cpu"))),
        (DeviceChoice::Gpu(number), None) => gpu(number),
    }
}

/// Why no GPU can train it.
fn unsupported(options: &FieldOptions) -> Option<&'static str> {
    let hashed = |position| matches!(position, PositionEncoding::Hash(_));
    match &options.method {
        Method::Neus(neus) if !hashed(neus.field.position) => {
            Some("a GPU trains neus with frequencies only as published, with the preset paper")
        }
        Method::NeusOriginal(neus) if hashed(neus.field.position) => {
            Some("a GPU trains neus on a hash encoding only with the preset fast")
        }
        _ => None,
    }
}

#[cfg(not(feature = "wgpu"))]
fn first_gpu() -> Option<Box<dyn Device>> {
    None
}

#[cfg(not(feature = "wgpu"))]
fn gpu(_number: Option<usize>) -> Result<Box<dyn Device>> {
    Err(Error::Failed(
        "this build has no GPU support: build it with `cargo build --release --features gpu`, or use --device cpu"
            .to_owned(),
    ))
}

#[cfg(feature = "wgpu")]
fn first_gpu() -> Option<Box<dyn Device>> {
    context::Context::first_hardware().map(|context| on(context.into()))
}

#[cfg(feature = "wgpu")]
fn gpu(number: Option<usize>) -> Result<Box<dyn Device>> {
    Ok(on(context::Context::numbered(number)?.into()))
}

/// The device of an open context.
#[cfg(feature = "wgpu")]
pub fn on(context: std::sync::Arc<context::Context>) -> Box<dyn Device> {
    Box::new(Gpu(context))
}

/// An open GPU.
#[cfg(feature = "wgpu")]
struct Gpu(std::sync::Arc<context::Context>);

#[cfg(feature = "wgpu")]
impl Device for Gpu {
    fn name(&self) -> String {
        self.0.name.clone()
    }

    fn model(
        &self,
        options: &FieldOptions,
        data: &mb_neural::dataset::RayDataset,
    ) -> Result<Box<dyn mb_neural::model::Model>> {
        use mb_neural::dvgo::Dvgo;
        use mb_neural::nerf::Nerf;
        use mb_neural::nerf_original::NerfOriginal;
        use mb_neural::neus::Neus;
        use mb_neural::neus_original::NeusOriginal;
        use on_device::OnDevice;
        if let Some(why) = unsupported(options) {
            return Err(Error::Failed(format!("{why}. Use --device cpu")));
        }
        let context = self.0.clone();
        Ok(match &options.method {
            Method::Nerf(o) => Box::new(OnDevice(nerf::GpuNerf::new(Nerf::new(o.clone(), data), context))),
            Method::NerfOriginal(o) => {
                let twin = NerfOriginal::new(o.clone(), data);
                Box::new(OnDevice(nerf_original::GpuNerfOriginal::new(twin, context)))
            }
            Method::Dvgo(o) => Box::new(OnDevice(dvgo::GpuDvgo::new(Dvgo::new(o.clone(), data), context))),
            Method::Neus(o) => Box::new(OnDevice(neus::GpuNeus::new(Neus::new(o.clone(), data), context))),
            Method::NeusOriginal(o) => {
                let twin = NeusOriginal::new(o.clone(), data);
                Box::new(OnDevice(neus_original::GpuNeusOriginal::new(twin, context)))
            }
        })
    }
}

#[cfg(test)]
mod choices {
    use super::*;

    #[test]
    fn devices_are_named_and_what_no_gpu_does_is_said() {
        assert_eq!("auto".parse(), Ok(DeviceChoice::Auto));
        assert_eq!("gpu:3".parse(), Ok(DeviceChoice::Gpu(Some(3))));
        assert!("gpu:x".parse::<DeviceChoice>().is_err() && "".parse::<DeviceChoice>().is_err());
        for (name, preset) in
            [("nerf", "fast"), ("nerf", "paper"), ("dvgo", "paper"), ("neus", "fast"), ("neus", "paper")]
        {
            let mut options = FieldOptions::preset(name, preset, 0).expect("a preset");
            (options.cameras.refine_poses, options.cameras.refine_focal) = (true, true);
            assert_eq!(unsupported(&options), None, "{name} {preset}");
        }
        let mut neus = FieldOptions::preset("neus", "fast", 0).expect("a preset");
        let Method::Neus(options) = &mut neus.method else { panic!("another method") };
        options.field.position = PositionEncoding::Frequencies(6);
        let Err(error) = device(DeviceChoice::Gpu(None), &neus) else { panic!("no GPU trains it") };
        assert!(error.to_string().contains("--device cpu"), "{error}");
        assert_eq!(device(DeviceChoice::Auto, &neus).expect("the processor").name(), "the processor");
    }
}
