//! Is a capture fit for use? Completeness, camera path, sharpness, exposure, and whether depth and poses agree.
//!
//! Depth and poses check each other: a depth map carried into another frame by the poses must meet that frame's depth.
//! Where it does not, the usual mix-ups ([`Misreading`], wrong units) are tried, and the one that mends it is named. What
//! photographs alone can say about poses needs features, and lies in `mb-pipeline`.

mod depth;
mod files;
mod misreading;
mod path;

use mb_job::{Progress, Result, Steps};
use serde::{Deserialize, Serialize};

use crate::photo_quality::PhotoQuality;
use crate::{FrameId, Sequence};

pub use files::HashCheck;
pub use misreading::Misreading;
pub use path::RotationCheck;

/// Limits beyond which something is reported.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CheckOptions {
    /// A step between neighbouring frames this many times the median step is a jump.
    pub jump_ratio: f64,
    /// A photograph whose sharpness is below this share of the median is blurred.
    pub blur_share: f64,
    /// Largest share of pure black or pure white pixels.
    pub clipped_share: f64,
    /// Largest change of mean luma between a photograph and the median, as a share of the median.
    pub brightness_change: f64,
    /// Largest median disagreement of depth carried from frame to frame, as a share of the depth.
    pub depth_disagreement: f64,
    /// Pairs of frames whose depth is compared, spread over the sequence.
    pub depth_pairs: usize,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self {
            jump_ratio: 8.0,
            blur_share: 0.35,
            clipped_share: 0.2,
            brightness_change: 0.5,
            // A phone's depth agrees with its poses to 1 or 2 %; mix-ups disagree by 10 % and more.
            depth_disagreement: 0.05,
            depth_pairs: 16,
        }
    }
}

/// Something that is wrong.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Problem {
    /// What kind: `photograph`, `hash`, `blur`, `exposure`, `jump`, `rotation`, `pose`, `depth`, `convention`.
    pub kind: &'static str,
    /// Where, or null for the sequence as a whole.
    pub frame: Option<FrameId>,
    /// A sentence for a person.
    pub message: String,
}

impl Problem {
    /// A problem of one frame.
    pub fn of_frame(kind: &'static str, frame: FrameId, message: impl Into<String>) -> Self {
        Self { kind, frame: Some(frame), message: message.into() }
    }

    /// A problem of the sequence as a whole.
    pub fn of_all(kind: &'static str, message: impl Into<String>) -> Self {
        Self { kind, frame: None, message: message.into() }
    }
}

/// What the check found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CheckSummary {
    /// Whether there are no problems.
    pub ok: bool,
    /// Frames of the sequence.
    pub frames: usize,
    /// Frames with a photograph.
    pub frames_with_photo: usize,
    /// Frames with the phone's depth.
    pub frames_with_depth: usize,
    /// Frame numbers that are absent between the first and the last.
    pub frame_numbers_absent: usize,
    /// Files compared with the hashes of `sequence.json`; null where it has none.
    pub hashes: Option<HashCheck>,
    /// How far the rotations of `pose/` are from orthonormal.
    pub rotation: RotationCheck,
    /// Median step between neighbouring frames.
    pub step_median_mm: f64,
    /// Median turn between neighbouring frames.
    pub turn_median_deg: f64,
    /// Share of the circle round the watched point, in sectors of 10 degrees, from which some frame looks.
    pub orbit_coverage: f64,
    /// Lowest and highest angle above the horizon from which the point is watched (the world's y is up).
    pub elevation_deg: [f64; 2],
    /// Median disagreement of depth carried between frames; null without depth.
    pub depth_disagreement_mm: Option<f64>,
    /// Each photograph's sharpness and exposure.
    pub photographs: Vec<PhotoCheck>,
    /// What is wrong.
    pub problems: Vec<Problem>,
    /// What was mended while reading.
    pub warnings: Vec<String>,
}

/// Sharpness and exposure of one photograph.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PhotoCheck {
    /// Which frame.
    pub frame: FrameId,
    /// Mean difference of neighbouring pixels' luma, 0 to 255.
    pub sharpness: f64,
    /// Mean luma, 0 to 255.
    pub brightness: f64,
    /// Share of pixels with luma below 4 or above 251.
    pub clipped: f64,
}

/// Checks a sequence.
///
/// # Errors
/// The person asked for a stop. Files that cannot be read are problems of the summary, not errors.
pub fn check(sequence: &Sequence, options: &CheckOptions, progress: &dyn Progress) -> Result<CheckSummary> {
    let frames = sequence.frames();
    let (hashes, mut problems) = files::check_hashes(sequence, progress)?;
    let (photographs, found) = check_photographs(sequence, options, progress)?;
    problems.extend(found);
    let path = path::check_path(sequence, options);
    problems.extend(path.problems);
    let depth = depth::check_depth(sequence, options, progress)?;
    if depth.disagreement_m.is_none() && depth.problems.iter().all(|p| p.kind != "convention") {
        problems.extend(path::check_scale(sequence));
    }
    problems.extend(depth.problems);
    let span = (frames[frames.len() - 1].id.0 - frames[0].id.0) as usize + 1;
    Ok(CheckSummary {
        ok: problems.is_empty(),
        frames: frames.len(),
        frames_with_photo: frames.iter().filter(|f| f.image.is_some()).count(),
        frames_with_depth: frames.iter().filter(|f| f.arkit_depth.is_some()).count(),
        frame_numbers_absent: span - frames.len(),
        hashes,
        rotation: path.rotation,
        step_median_mm: path.step_m * 1e3,
        turn_median_deg: path.turn_rad.to_degrees(),
        orbit_coverage: path.orbit_coverage,
        elevation_deg: path.elevation_deg,
        depth_disagreement_mm: depth.disagreement_m.map(|m| m * 1e3),
        photographs,
        problems,
        warnings: sequence.warnings().to_vec(),
    })
}

/// About `count` pairs of frames to compare, by their place in the sequence: half of them neighbours, half a thirtieth of the
/// sequence apart (some 12 degrees of an orbit), which shows a wrong scale better. Needs at least two frames.
pub fn check_pairs(frames: usize, count: usize) -> Vec<(usize, usize)> {
    let mut chosen = Vec::new();
    for stride in [1, (frames / 30).max(1)] {
        let count = (count / 2).clamp(1, frames - stride);
        chosen.extend((0..count).map(|i| i * (frames - stride) / count).map(|first| (first, first + stride)));
    }
    chosen.sort_unstable();
    chosen.dedup();
    chosen
}

/// The median, 0 of nothing.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

/// Reads every photograph, one at a time.
fn check_photographs(
    sequence: &Sequence,
    options: &CheckOptions,
    progress: &dyn Progress,
) -> Result<(Vec<PhotoCheck>, Vec<Problem>)> {
    let steps = Steps::new(progress, "photographs", sequence.frames().len());
    let (mut photographs, mut problems) = (Vec::new(), Vec::new());
    for frame in sequence.frames() {
        steps.step()?;
        if frame.image.is_none() {
            problems.push(Problem::of_frame("photograph", frame.id, "has no photograph"));
            continue;
        }
        match sequence.read_image(frame) {
            Ok(photo) => {
                let PhotoQuality { sharpness, brightness, clipped } = PhotoQuality::of(&photo);
                photographs.push(PhotoCheck { frame: frame.id, sharpness, brightness, clipped });
            }
            Err(e) => problems.push(Problem::of_frame("photograph", frame.id, e.to_string())),
        }
    }
    let sharpness = median(photographs.iter().map(|p| p.sharpness));
    let brightness = median(photographs.iter().map(|p| p.brightness));
    for photo in &photographs {
        if photo.sharpness < options.blur_share * sharpness {
            let message = format!("is blurred: sharpness {:.2}, the median is {sharpness:.2}", photo.sharpness);
            problems.push(Problem::of_frame("blur", photo.frame, message));
        }
        if photo.clipped > options.clipped_share {
            let message = format!("{:.0} % of its pixels are pure black or white", 100.0 * photo.clipped);
            problems.push(Problem::of_frame("exposure", photo.frame, message));
        } else if (photo.brightness - brightness).abs() > options.brightness_change * brightness {
            let message = format!("its mean luma is {:.0}, the median is {brightness:.0}", photo.brightness);
            problems.push(Problem::of_frame("exposure", photo.frame, message));
        }
    }
    Ok((photographs, problems))
}
