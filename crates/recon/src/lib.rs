//! Classical reconstruction: depth maps and their cameras come in, a triangle mesh goes out.
//!
//! [`reconstruct_tsdf`] is the whole method for a sequence; [`TsdfVolume`] is its engine, which ground truth uses too:
//! a sparse volume of averaged signed distances, from which [`TsdfVolume::extract_mesh`] takes the surface.
//!
//! ```
//! use mb_geometry::{ImageSize, Intrinsics, Rigid3};
//! use mb_image::DepthImage;
//! use mb_recon::TsdfVolume;
//! // A wall 0.503 m in front of a camera at the origin.
//! let depth = DepthImage::filled(ImageSize::new(64, 48), 0.503);
//! let intrinsics = Intrinsics { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 };
//! let mut volume = TsdfVolume::new(0.01, 0.04)?;
//! volume.integrate(&depth, None, &intrinsics, &Rigid3::identity())?;
//! let wall = volume.extract_mesh(1.0);
//! assert!(wall.vertices.iter().all(|p| (p.z - 0.503).abs() < 1e-6));
//! # Ok::<(), mb_job::Error>(())
//! ```
//!
//! Limits: a volume beyond [`MAX_VOLUME_BYTES`] is refused. Distances are measured along z of each camera, so edges
//! and details of a few voxels come out rounded, and walls thinner than the truncation suffer.

mod cube_table;
mod integrate;
mod level_set;
mod marching_cubes;
mod reconstruct;
mod support_plane;
mod volume;

pub use level_set::level_set_mesh;
pub use reconstruct::{PoseSource, TsdfOptions, TsdfSummary, reconstruct_tsdf};
pub use support_plane::SupportPlane;
pub use volume::{MAX_VOLUME_BYTES, TsdfVolume};
