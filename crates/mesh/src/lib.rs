//! Triangle meshes and point clouds: files, acceleration structures, sampling, distances.
//!
//! A [`TriangleMesh`] is plain data in one frame, metres, counter-clockwise triangles seen from outside. Nothing here
//! assumes that a mesh is closed: brick parts are not.

mod bvh;
mod files;
mod glb;
mod kd_tree;
mod obj;
mod ply;
mod poisson_disk;
mod radix;
mod sample;
mod stl;
mod surface;
mod triangle_mesh;

pub use bvh::{Bvh, Closest, Hit, LeanBvh, closest_point_on_triangle};
pub use files::{Dropped, read_mesh, read_mesh_lenient, read_ply, write_mesh};
pub use glb::write_glb;
pub use kd_tree::KdTree;
pub use obj::write_obj;
pub use ply::write_ply;
pub use poisson_disk::sample_poisson_disk;
pub use sample::{SurfaceSample, sample_uniform};
pub use stl::write_stl;
pub use triangle_mesh::TriangleMesh;
