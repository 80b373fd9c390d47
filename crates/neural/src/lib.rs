//! Learned scene representations trained on one capture: NeRF, NeuS and DVGO on kernels of our own.

pub mod adam;
pub mod composite;
pub mod contraction;
pub mod dataset;
pub mod dense_grid;
pub mod encoding;
pub mod hash_grid;
pub mod mlp;
pub mod model;
pub mod network;
pub mod nerf;
pub mod neus;
pub mod neus_alpha;
pub mod occupancy;
pub mod radiance_field;
pub mod region;
pub mod sampling;
pub mod sdf_field;
pub mod simd;
pub mod trainer;
