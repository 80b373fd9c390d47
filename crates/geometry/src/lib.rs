//! Frames, rigid and similarity transforms, cameras, rays and boxes.
//!
//! This crate is pure arithmetic: it reads no files and cannot fail on them. Everything is `f64`, in metres and
//! radians. A transform is named and typed target-first, so that only products that make sense compile:
//!
//! ```
//! use mb_geometry::{Camera, Object, Rigid3, World};
//! use nalgebra::{Point3, Vector3};
//! let cam_from_world = Rigid3::<Camera, World>::exp(&[0.1, 0.0, 0.2, 0.0, 0.0, 0.3].into());
//! let world_from_object = Rigid3::<World, Object>::from_translation(Vector3::new(0.0, 1.0, 0.0));
//! let cam_from_object: Rigid3<Camera, Object> = cam_from_world * world_from_object;
//! let p_in_object = Point3::new(0.01, 0.02, 0.03);
//! let p_in_cam = cam_from_object * p_in_object;
//! # assert!((cam_from_object.inverse() * p_in_cam - p_in_object).norm() < 1e-12);
//! ```
//!
//! Conventions (`docs/conventions.md` has all of them): camera axes are OpenCV's (x right, y down, z forward), pixel
//! centres lie at integer coordinates, depth is z.

mod aabb;
mod camera;
mod frames;
mod rigid;
mod similarity;

pub use aabb::Aabb;
pub use camera::{ImageSize, Intrinsics, IntrinsicsError, Ray};
pub use frames::{Board, Camera, Ldraw, Object, World};
pub use rigid::{Rigid3, RotationDefect};
pub use similarity::Sim3;
