//! The one change of camera axes that sources need.

use mb_geometry::{Camera, Rigid3, RotationDefect, World};
use nalgebra::{Matrix4, Vector4};

/// The camera's pose from a camera-to-world matrix with ARKit's and OpenGL's camera axes (x right, y up, z backward):
/// multiplied by `diag(1, -1, -1, 1)` on the right. `None` where it is no rigid transform.
pub(super) fn from_opengl(world_from_opengl_cam: &Matrix4<f64>) -> Option<(Rigid3<World, Camera>, RotationDefect)> {
    Rigid3::from_matrix(&(world_from_opengl_cam * Matrix4::from_diagonal(&Vector4::new(1.0, -1.0, -1.0, 1.0))))
}
