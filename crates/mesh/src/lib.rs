//! Triangle meshes and point clouds: files, acceleration structures, sampling, distances.
//!
//! A [`TriangleMesh`] is plain data in one frame, metres, counter-clockwise triangles seen from outside. Nothing here
//! assumes that a mesh is closed: brick parts are not.

mod triangle_mesh;

pub use triangle_mesh::TriangleMesh;
