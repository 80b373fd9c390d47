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
use super::npy;

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
    /// The object's mask, a PNG.
    pub mask: Option<PathBuf>,
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

/// Where a depth map is, with its confidence.
pub(crate) enum Depth {
    /// 16-bit PNG in millimetres (65535, which some devices write for "none", is none), and 8-bit confidence.
    Png(PathBuf, Option<PathBuf>),
    /// A NumPy array `[H, W]`: integers in millimetres or floats in metres; 8-bit confidence as PNG or array.
    Npy(PathBuf, Option<PathBuf>),
    /// One channel of an OpenEXR image in an archive, metres.
    Exr(Arc<Archive>, String),
    /// LZFSE-compressed `[H, W]` f32 metres (NaN = none) and u8 confidence in an archive. Files that do not state the
    /// size have the photograph's proportions.
    Lzfse { archive: Arc<Archive>, depth: String, confidence: Option<String>, size: DepthSize },
}

/// What is known of a raw depth map's size.
#[derive(Clone, Copy)]
pub(crate) enum DepthSize {
    /// The source states it.
    Stated(ImageSize),
    /// Width over height follows that of the photograph.
    LikePhoto(ImageSize),
}

/// More values than any phone's depth map has.
const MAX_DEPTH_PIXELS: usize = 16 << 20;

impl DepthSize {
    fn of(self, values: usize) -> std::result::Result<ImageSize, String> {
        match self {
            Self::Stated(size) if size.pixels() == values => Ok(size),
            Self::Stated(size) => Err(format!("unpacks to {values} values, expected {} ({size})", size.pixels())),
            Self::LikePhoto(photo) => {
                let width = (values as f64 * photo.width as f64 / photo.height as f64).sqrt().round() as usize;
                let height = values.checked_div(width).unwrap_or(0);
                let fits = values > 0
                    && width * height == values
                    && (width * photo.height).abs_diff(height * photo.width) <= photo.width.max(photo.height);
                fits.then(|| ImageSize::new(width, height))
                    .ok_or_else(|| format!("unpacks to {values} values, which make no depth map shaped like {photo}"))
            }
        }
    }
}

/// Depth from raw values: what is not finite or not above 0 is none.
fn depth_image(size: ImageSize, values: impl Iterator<Item = f32>) -> Option<DepthImage> {
    let values = values.map(|z| if z.is_finite() && z > 0.0 { z } else { 0.0 }).collect();
    DepthImage::from_data(size, values)
}

impl Depth {
    /// Reads depth in metres and confidence.
    pub fn read(&self) -> Result<(DepthImage, Option<Confidence>)> {
        let (depth, confidence) = match self {
            Self::Png(depth, confidence) => {
                let depth = mb_image::read_depth_png_mm(depth)?;
                let depth = depth.map(|&mm| if mm == u16::MAX { 0.0 } else { f32::from(mm) * 1e-3 });
                (depth, confidence.as_ref().map(mb_image::read_confidence_png).transpose()?)
            }
            Self::Npy(depth, confidence) => {
                let depth = npy::read_depth(depth)?;
                let confidence = confidence.as_ref().map(|path| match path.extension() {
                    Some(e) if e == "npy" => npy::read_confidence(path),
                    _ => mb_image::read_confidence_png(path),
                });
                (depth, confidence.transpose()?)
            }
            Self::Exr(archive, name) => {
                let depth = mb_image::decode_depth_exr(&archive.read(name)?, &archive.path().join(name))?;
                (depth, None)
            }
            Self::Lzfse { archive, depth, confidence, size } => {
                let bad = |name: &str, found: String| InputError::new(archive.path(), found).at(name.to_owned());
                let most = match size {
                    DepthSize::Stated(size) => size.pixels().min(MAX_DEPTH_PIXELS),
                    DepthSize::LikePhoto(_) => MAX_DEPTH_PIXELS,
                };
                let bytes = archive.read_lzfse(depth, 4 * most)?;
                if bytes.len() % 4 != 0 {
                    return Err(
                        bad(depth, format!("unpacks to {} bytes, no whole number of floats", bytes.len())).into()
                    );
                }
                let size = size.of(bytes.len() / 4).map_err(|found| bad(depth, found))?;
                let values = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
                let image = depth_image(size, values).expect("the length was checked");
                let confidence = confidence.as_ref().map(|name| -> Result<Confidence> {
                    let bytes = archive.read_lzfse(name, size.pixels())?;
                    if let Some(bad_value) = bytes.iter().find(|c| **c > 2) {
                        return Err(bad(name, format!("confidence {bad_value} found, expected 0, 1 or 2")).into());
                    }
                    let found = bytes.len();
                    Ok(Confidence::from_data(size, bytes)
                        .ok_or_else(|| bad(name, format!("unpacks to {found} values, expected {}", size.pixels())))?)
                });
                (image, confidence.transpose()?)
            }
        };
        Ok((depth, confidence))
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_raw_depth_map_has_the_photographs_proportions() {
        let portrait = DepthSize::LikePhoto(ImageSize::new(720, 960));
        assert_eq!(portrait.of(192 * 256), Ok(ImageSize::new(192, 256)));
        assert_eq!(portrait.of(480 * 640), Ok(ImageSize::new(480, 640)));
        assert!(portrait.of(192 * 256 - 1).is_err() && portrait.of(0).is_err());
        let landscape = DepthSize::LikePhoto(ImageSize::new(1920, 1440));
        assert_eq!(landscape.of(192 * 256), Ok(ImageSize::new(256, 192)));
    }

    #[test]
    fn names_that_share_their_digits_are_numbered_in_order() {
        let ids = |names: &[&str]| {
            frame_ids(&names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>())
                .iter()
                .map(|f| f.0)
                .collect::<Vec<_>>()
        };
        assert_eq!(ids(&["DSC_0012.JPG", "a/DSC_0003.JPG"]), [12, 3]);
        assert_eq!(ids(&["right/0001.png", "left/0001.png"]), [1, 0]);
    }
}
