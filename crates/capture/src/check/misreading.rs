//! The ways in which poses are commonly misread.

use mb_geometry::{Camera, Rigid3, World};
use nalgebra::{Rotation3, UnitQuaternion, Vector3};

/// A convention that a file may have and a reader may not have expected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Misreading {
    /// Camera axes of OpenGL and ARKit: y up, z backward.
    OpenGlAxes,
    /// The pose is world-to-camera.
    Inverted,
    /// The pose is world-to-camera with OpenGL's camera axes.
    InvertedOpenGlAxes,
    /// The rotation is world-to-camera (or stored column by column), the translation is right.
    TransposedRotation,
    /// As before, with OpenGL's camera axes.
    TransposedOpenGlAxes,
}

/// Half a turn about the camera's x axis.
fn flip() -> Rigid3<Camera, Camera> {
    let half_turn = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    Rigid3::from_parts(UnitQuaternion::from_rotation_matrix(&half_turn), Vector3::zeros())
}

/// The pose whose inverse was read.
fn inverted(pose: &Rigid3<World, Camera>) -> Rigid3<World, Camera> {
    let inverse = pose.inverse();
    Rigid3::from_parts(inverse.rotation(), inverse.translation())
}

/// The pose whose rotation was read transposed.
fn transposed(pose: &Rigid3<World, Camera>) -> Rigid3<World, Camera> {
    Rigid3::from_parts(pose.rotation().inverse(), pose.translation())
}

impl Misreading {
    /// All of them, the most common first.
    pub const ALL: [Self; 5] = [
        Self::OpenGlAxes,
        Self::Inverted,
        Self::InvertedOpenGlAxes,
        Self::TransposedRotation,
        Self::TransposedOpenGlAxes,
    ];

    /// What is wrong and what to do, for a person.
    pub fn advice(self) -> &'static str {
        match self {
            Self::OpenGlAxes => {
                "the poses have OpenGL camera axes (y up, z backward); multiply them by diag(1, -1, -1, 1) on the right"
            }
            Self::Inverted => "the poses are world-to-camera; invert them",
            Self::InvertedOpenGlAxes => {
                "the poses are world-to-camera with OpenGL camera axes; invert them, then multiply by diag(1, -1, -1, 1) on \
                 the right"
            }
            Self::TransposedRotation => {
                "the rotations are transposed, while the translations are right; transpose them"
            }
            Self::TransposedOpenGlAxes => {
                "the rotations are transposed and the camera axes are OpenGL's, while the translations are right; transpose \
                 the rotations, then multiply by diag(1, -1, -1, 1) on the right"
            }
        }
    }

    /// The true pose, from the one that was read.
    pub fn mend(self, read: &Rigid3<World, Camera>) -> Rigid3<World, Camera> {
        match self {
            Self::OpenGlAxes => *read * flip(),
            Self::Inverted => inverted(read),
            Self::InvertedOpenGlAxes => inverted(read) * flip(),
            Self::TransposedRotation => transposed(read),
            Self::TransposedOpenGlAxes => transposed(read) * flip(),
        }
    }
}
