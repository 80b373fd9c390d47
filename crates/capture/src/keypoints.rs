//! `annotation/keypoints.json`: what a person clicked.

use mb_job::Result;
use nalgebra::{Point2, Point3};
use serde::{Deserialize, Serialize};

use crate::FrameId;
use crate::sequence::{read_json, write_json};

/// The clicked points of a sequence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Keypoints {
    /// Version of this document, 1.
    pub version: u32,
    /// Who clicked (free text; the simulator names itself).
    #[serde(default)]
    pub author: String,
    /// When, as RFC 3339 text; empty where unknown.
    #[serde(default)]
    pub time: String,
    /// The points, in the order in which they were clicked.
    pub keypoints: Vec<Keypoint>,
}

/// One clicked correspondence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Keypoint {
    /// The frame that was clicked in.
    pub frame: FrameId,
    /// Pixel in the photograph, (x, y), pixel centres at integers.
    pub pixel: Point2<f64>,
    /// The model's point, metres, object frame.
    pub point_in_object_m: Point3<f64>,
    /// What it is (free text), such as `stud, part 12`.
    #[serde(default)]
    pub name: String,
}

impl Keypoints {
    /// Where the keypoints lie inside a sequence folder.
    pub const FILE: &'static str = "annotation/keypoints.json";

    /// Reads a keypoint file.
    ///
    /// # Errors
    /// The file is missing or malformed; line and column are named.
    pub fn read(path: impl AsRef<std::path::Path>) -> Result<Self> {
        read_json(path.as_ref())
    }

    /// Writes a keypoint file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write(&self, path: impl AsRef<std::path::Path>) -> Result<()> {
        write_json(path.as_ref(), self)
    }
}
