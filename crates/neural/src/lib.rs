//! Learned scene representations trained on one capture: NeRF, NeuS and DVGO on kernels of our own.

pub mod hash_grid;
pub mod mlp;
pub mod simd;
