//! Learned scene representations of one capture, trained with kernels of our own.
//!
//! In: a [`mb_capture::Sequence`]. Out: a mesh ([`reconstruct`]) or pictures of the held-out views ([`synthesize`]), in
//! the sequence's metric world frame. [`FieldOptions`] says which method (`nerf`, `dvgo`, `neus`) and how.
//!
//! ```no_run
//! # fn main() -> mb_job::Result<()> {
//! use mb_neural::{FieldOptions, device::Processor, reconstruct};
//! let sequence = mb_capture::Sequence::open("castle")?;
//! let options = FieldOptions::preset("neus", "fast", 0).expect("a known method");
//! let (mesh, summary) = reconstruct(&sequence, &options, &Processor, None, &mb_job::Silent)?;
//! println!("{} triangles after {:.0} s", mesh.triangles.len(), summary.training.seconds);
//! # Ok(())
//! # }
//! ```
//!
//! The layers, from below:
//! - kernels: [`simd`] (one matrix product, dispatched at run time), [`mlp`], [`hash_grid`], [`dense_grid`],
//!   [`encoding`], [`ray_samples`], [`composite`], [`neus_alpha`], [`sampling`], [`adam`]. Derivatives are derived by hand;
//!   each module states its equations, and its tests hold them to finite differences.
//! - fields: [`radiance_field`] (density and colour on a hash grid), [`voxel_field`] (the same on voxels),
//!   [`frequency_field`] (the same in one deep network), [`sdf_field`] (distance, exact normals, colour).
//! - methods: [`nerf`], [`dvgo`], [`neus`] for a processor, [`nerf_original`] and [`neus_original`] as published, all behind
//!   [`model::Model`]; [`dataset`] gives them rays, [`cameras`] corrects these, [`trainer`] runs them, [`extract`] takes
//!   the surface, [`camera_path`] says what to render, [`results`] writes what lies beside a result.
//!
//! A step is cut into a fixed number of groups of rays. Each has its own random numbers, and their sums are added in
//! order, so a run's result depends on the seed and the machine's instruction set, not on the number of threads.
//!
//! Limits: pinhole cameras without distortion (imports take it out); one exposure for all photographs; the GPU path is
//! another crate's, which fills [`device::Device`].

#![allow(clippy::too_many_arguments, reason = "kernels take buffers with their strides")]

pub mod adam;
pub mod camera_path;
pub mod cameras;
mod checkpoint;
pub mod composite;
pub mod contraction;
pub mod dataset;
pub mod dense_grid;
pub mod device;
pub mod dvgo;
pub mod encoding;
pub mod extract;
pub mod frequency_field;
pub mod hash_grid;
mod method;
pub mod mlp;
pub mod model;
pub mod nerf;
pub mod nerf_original;
pub mod network;
pub mod neus;
pub mod neus_alpha;
pub mod neus_original;
pub mod occupancy;
pub mod radiance_field;
pub mod ray_samples;
pub mod region;
pub mod results;
pub mod sampling;
pub mod sdf_field;
pub mod simd;
pub mod trainer;
pub mod voxel_field;

pub use method::{
    FieldOptions, Method, ReconstructSummary, SynthesizeSummary, ViewScore, Views, reconstruct, synthesize,
};
