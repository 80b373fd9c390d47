//! What an importer hands on: frames with cameras in our convention, and where their pixels are.

use std::path::PathBuf;
use std::sync::Arc;

use mb_geometry::{Camera, ImageSize, Rigid3, World};
use mb_image::{Confidence, DepthImage};
use mb_job::{InputError, Result};
use serde::Serialize;

use crate::FrameId;
use crate::lens::Lens;

use super::archive::Archive;

/// A frame that was left out.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct SkippedFrame {
    /// Its name or number in the source.
    pub frame: String,
    /// Why.
    pub reason: String,
}

/// A capture, read but for its pixels.
pub(crate) struct Recording {
    /// What made the capture.
    pub device: String,
    /// Whether lengths are metres.
    pub metric: bool,
    /// Frames in ascending order of their numbers.
    pub frames: Vec<RecordedFrame>,
    pub skipped: Vec<SkippedFrame>,
    pub warnings: Vec<String>,
}

/// One frame of a capture.
pub(crate) struct RecordedFrame {
    pub id: FrameId,
    pub photo: Option<Photo>,
    /// `None` where the source has no camera.
    pub lens: Option<Lens>,
    /// Size that the lens refers to, where the source states it.
    pub lens_size: Option<ImageSize>,
    pub world_from_cam: Option<Rigid3<World, Camera>>,
    pub depth: Option<Depth>,
    pub time_s: Option<f64>,
}

/// Where a photograph is.
pub(crate) enum Photo {
    /// A JPEG or PNG file.
    File(PathBuf),
    /// A JPEG or PNG in an archive.
    Entry(Arc<Archive>, String),
    /// A frame of a video, counted from 0 in the order of display.
    Video(PathBuf, usize),
}

/// Where a depth map and its confidence are.
pub(crate) enum Depth {
    /// 16-bit PNG in millimetres, and 8-bit confidence.
    Png(PathBuf, Option<PathBuf>),
    /// LZFSE-compressed `[H, W]` f32 metres (NaN = none) and u8 confidence in an archive.
    Lzfse { archive: Arc<Archive>, depth: String, confidence: Option<String>, size: ImageSize },
}

impl Depth {
    /// Reads depth in metres and confidence.
    pub fn read(&self) -> Result<(DepthImage, Option<Confidence>)> {
        match self {
            Self::Png(depth, confidence) => {
                let depth = mb_image::read_depth_png(depth)?;
                let confidence = confidence.as_ref().map(mb_image::read_confidence_png).transpose()?;
                Ok((depth, confidence))
            }
            Self::Lzfse { archive, depth, confidence, size } => {
                let bytes = archive.read_lzfse(depth, 4 * size.pixels())?;
                let values = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
                let values = values.map(|z| if z.is_finite() && z > 0.0 { z } else { 0.0 }).collect();
                let image = DepthImage::from_data(*size, values).expect("the length was checked");
                let confidence = match confidence {
                    None => None,
                    Some(name) => {
                        let bytes = archive.read_lzfse(name, size.pixels())?;
                        if let Some(bad) = bytes.iter().find(|c| **c > 2) {
                            let found = format!("confidence {bad} found, expected 0, 1 or 2");
                            return Err(InputError::new(archive.path(), found).at(name.clone()).into());
                        }
                        Some(Confidence::from_data(*size, bytes).expect("the length was checked"))
                    }
                };
                Ok((image, confidence))
            }
        }
    }
}

impl Recording {
    /// An empty recording of a device.
    pub fn new(device: impl Into<String>, metric: bool) -> Self {
        Self { device: device.into(), metric, frames: Vec::new(), skipped: Vec::new(), warnings: Vec::new() }
    }

    /// Notes a frame that cannot be used.
    pub fn skip(&mut self, frame: impl Into<String>, reason: impl Into<String>) {
        self.skipped.push(SkippedFrame { frame: frame.into(), reason: reason.into() });
    }
}

/// Frame numbers for named photographs: the digits that end each name (`DSC_0012.JPG` is 12) where they tell all apart,
/// otherwise the order of the names.
pub(crate) fn frame_ids(names: &[String]) -> Vec<FrameId> {
    let number = |name: &String| -> Option<u32> {
        let file = name.rsplit(['/', '\\']).next().unwrap_or(name);
        let stem = file.rsplit_once('.').map_or(file, |(stem, _)| stem);
        let digits = stem.len() - stem.bytes().rev().take_while(u8::is_ascii_digit).count();
        stem[digits..].parse().ok()
    };
    let numbers: Option<Vec<u32>> = names.iter().map(number).collect();
    if let Some(numbers) = numbers {
        let distinct: std::collections::BTreeSet<u32> = numbers.iter().copied().collect();
        if distinct.len() == numbers.len() {
            return numbers.into_iter().map(FrameId).collect();
        }
    }
    let mut order: Vec<usize> = (0..names.len()).collect();
    order.sort_by(|a, b| names[*a].cmp(&names[*b]));
    let mut ids = vec![FrameId(0); names.len()];
    for (rank, i) in order.into_iter().enumerate() {
        ids[i] = FrameId(rank as u32);
    }
    ids
}
