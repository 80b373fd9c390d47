//! What became of each frame.

use serde::Serialize;

/// How a frame's camera was found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameOutcome {
    /// Its own photograph determines it.
    Solved,
    /// Its photograph shows little that could be used (blurred, dark, the model hidden, or the object moved): the camera
    /// leans on its neighbours and on the phone.
    Weak,
    /// Its photograph shows nothing that could be used, or there is none: the camera's drift is its neighbours'.
    Unseen,
}
