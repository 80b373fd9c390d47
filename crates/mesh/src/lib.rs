//! Triangle meshes and point clouds: files, acceleration structures, sampling, distances.
//!
//! A [`TriangleMesh`] is plain data in one frame, metres, counter-clockwise triangles seen from outside. Nothing here
//! assumes that a mesh is closed: brick parts are not.

#![allow(clippy::needless_range_loop, reason = "kernels index several small arrays by axis and child")]

mod bvh;
mod kd_tree;
mod poisson_disk;
mod sample;
mod triangle_mesh;

pub use bvh::{Bvh, Closest, Hit, closest_point_on_triangle};
pub use kd_tree::KdTree;
pub use poisson_disk::sample_poisson_disk;
pub use sample::{SurfaceSample, sample_uniform};
pub use triangle_mesh::TriangleMesh;
