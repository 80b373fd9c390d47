//! Is a capture fit for use? Completeness, camera path, sharpness, exposure, and whether depth and poses agree.
//!
//! Depth and poses check each other: a depth map carried into another frame by the poses must meet that frame's depth.
//! Where it does not, the usual mix-ups (OpenGL axes, world-to-camera, millimetres) are tried, and the one that mends
//! it is named.

use mb_geometry::{Camera, Rigid3, World};
use mb_image::{DepthImage, RgbImage};
use mb_job::{Progress, Result, Steps};
use nalgebra::{Matrix3, Point2, Rotation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::{Frame, FrameId, Sequence};

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
    /// Largest median disagreement of depth carried from frame to frame, as a share of the depth.
    pub depth_disagreement: f64,
    /// Pairs of frames whose depth is compared, spread over the sequence.
    pub depth_pairs: usize,
}

impl Default for CheckOptions {
    fn default() -> Self {
        // A phone's depth agrees with its poses to 1 or 2 %; mix-ups disagree by 10 % and more.
        Self { jump_ratio: 8.0, blur_share: 0.35, clipped_share: 0.2, depth_disagreement: 0.05, depth_pairs: 16 }
    }
}

/// Something that is wrong.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Problem {
    /// What kind: `photograph`, `blur`, `exposure`, `jump`, `pose`, `depth`, `convention`.
    pub kind: &'static str,
    /// Where, or null for the sequence as a whole.
    pub frame: Option<FrameId>,
    /// A sentence for a person.
    pub message: String,
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
    /// Each photograph's sharpness (mean gradient of the luma, 0 to 255 per pixel) and mean luma.
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
    /// Mean gradient of the luma.
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
    let mut problems = Vec::new();
    let problem = |kind, frame, message: String| Problem { kind, frame, message };

    // Photographs, one at a time.
    let steps = Steps::new(progress, "photographs", frames.len());
    let mut photographs = Vec::new();
    for frame in frames {
        steps.step()?;
        if frame.image.is_none() {
            problems.push(problem("photograph", Some(frame.id), "has no photograph".to_owned()));
            continue;
        }
        match sequence.read_image(frame) {
            Ok(photo) => photographs.push(photo_check(frame.id, &photo)),
            Err(e) => problems.push(problem("photograph", Some(frame.id), e.to_string())),
        }
    }
    let sharpness = median(photographs.iter().map(|p| p.sharpness));
    for photo in &photographs {
        if photo.sharpness < options.blur_share * sharpness {
            let message = format!("is blurred: sharpness {:.2}, the median is {sharpness:.2}", photo.sharpness);
            problems.push(problem("blur", Some(photo.frame), message));
        }
        if photo.clipped > options.clipped_share {
            let message = format!("{:.0} % of its pixels are pure black or white", 100.0 * photo.clipped);
            problems.push(problem("exposure", Some(photo.frame), message));
        }
    }

    // The path.
    let moves: Vec<Rigid3<Camera, Camera>> =
        frames.windows(2).map(|pair| pair[0].world_from_cam.inverse() * pair[1].world_from_cam).collect();
    let step_m = median(moves.iter().map(|m| m.translation().norm()));
    let turn_rad = median(moves.iter().map(|m| m.angle_rad()));
    for (pair, relative) in frames.windows(2).zip(&moves) {
        let (step, turn) = (relative.translation().norm(), relative.angle_rad());
        if step > options.jump_ratio * step_m.max(1e-3) || turn > (options.jump_ratio * turn_rad).max(0.1) {
            let message = format!(
                "jumps by {:.1} mm and {:.1} degrees from frame {}; the medians are {:.1} and {:.1}",
                step * 1e3,
                turn.to_degrees(),
                pair[0].id,
                step_m * 1e3,
                turn_rad.to_degrees()
            );
            problems.push(problem("jump", Some(pair[1].id), message));
        }
    }
    let (orbit_coverage, elevation_deg) = coverage(frames);

    let (depth_disagreement, depth_problems) = check_depth(sequence, options, progress)?;
    problems.extend(depth_problems);
    Ok(CheckSummary {
        ok: problems.is_empty(),
        frames: frames.len(),
        frames_with_photo: frames.iter().filter(|f| f.image.is_some()).count(),
        frames_with_depth: frames.iter().filter(|f| f.arkit_depth.is_some()).count(),
        step_median_mm: step_m * 1e3,
        turn_median_deg: turn_rad.to_degrees(),
        orbit_coverage,
        elevation_deg,
        depth_disagreement_mm: depth_disagreement.map(|m| m * 1e3),
        photographs,
        problems,
        warnings: sequence.warnings().to_vec(),
    })
}

/// The median, 0 of nothing.
fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(0.0)
}

fn photo_check(frame: FrameId, photo: &RgbImage) -> PhotoCheck {
    let luma = |p: [u8; 3]| 0.299 * f64::from(p[0]) + 0.587 * f64::from(p[1]) + 0.114 * f64::from(p[2]);
    let (mut gradient, mut sum, mut clipped) = (0.0, 0.0, 0usize);
    for y in 0..photo.height() {
        let row: Vec<f64> = photo.row(y).iter().map(|p| luma(*p)).collect();
        gradient += row.windows(2).map(|pair| (pair[1] - pair[0]).abs()).sum::<f64>();
        sum += row.iter().sum::<f64>();
        clipped += row.iter().filter(|v| **v < 4.0 || **v > 251.0).count();
    }
    let pixels = photo.size().pixels() as f64;
    PhotoCheck { frame, sharpness: gradient / pixels, brightness: sum / pixels, clipped: clipped as f64 / pixels }
}

/// Share of the circle round the watched point, and lowest and highest elevation.
fn coverage(frames: &[Frame]) -> (f64, [f64; 2]) {
    let (mut matrix, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for frame in frames {
        let axis = frame.world_from_cam.rotate(&Vector3::z());
        let across = Matrix3::identity() - axis * axis.transpose();
        matrix += across;
        right += across * frame.world_from_cam.translation();
    }
    let Some(watched) = matrix.try_inverse().map(|inverse| inverse * right) else { return (0.0, [0.0; 2]) };
    let mut sectors = [false; 36];
    let mut elevations = [f64::INFINITY, f64::NEG_INFINITY];
    for frame in frames {
        let d = frame.world_from_cam.translation() - watched;
        let azimuth = d.z.atan2(d.x).to_degrees().rem_euclid(360.0);
        sectors[(azimuth / 10.0) as usize % 36] = true;
        let elevation = d.y.atan2(d.x.hypot(d.z)).to_degrees();
        elevations = [elevations[0].min(elevation), elevations[1].max(elevation)];
    }
    (sectors.iter().filter(|s| **s).count() as f64 / 36.0, elevations)
}

/// A way in which a file may have been misread: how the true pose follows from the one that was read.
struct Misreading {
    name: &'static str,
    mend: fn(&Rigid3<World, Camera>) -> Rigid3<World, Camera>,
}

fn flip() -> Rigid3<Camera, Camera> {
    let half_turn = Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    Rigid3::from_parts(UnitQuaternion::from_rotation_matrix(&half_turn), Vector3::zeros())
}

/// The pose whose inverse was read.
fn inverted(pose: &Rigid3<World, Camera>) -> Rigid3<World, Camera> {
    let inverse = pose.inverse();
    Rigid3::from_parts(inverse.rotation(), inverse.translation())
}

fn scaled(pose: &Rigid3<World, Camera>, scale: f64) -> Rigid3<World, Camera> {
    Rigid3::from_parts(pose.rotation(), pose.translation() * scale)
}

const MISREADINGS: [Misreading; 5] = [
    Misreading {
        name: "the poses have OpenGL camera axes (y up, z backward); multiply them by diag(1, -1, -1, 1) on the right",
        mend: |pose| *pose * flip(),
    },
    Misreading { name: "the poses are world-to-camera; invert them", mend: inverted },
    Misreading {
        name: "the poses are world-to-camera with OpenGL camera axes; invert them and flip y and z",
        mend: |pose| inverted(pose) * flip(),
    },
    Misreading { name: "the translations are in millimetres; divide them by 1000", mend: |pose| scaled(pose, 1e-3) },
    Misreading {
        name: "the translations are too small by 1000, or the depth is stored in a finer unit than millimetres",
        mend: |pose| scaled(pose, 1e3),
    },
];

/// Median disagreement over all pairs as a share of the depth and in metres; `None` where hardly anything overlaps.
fn disagreement(
    pairs: &[(&Frame, DepthImage, &Frame, DepthImage)],
    sequence: &Sequence,
    mend: impl Fn(&Rigid3<World, Camera>) -> Rigid3<World, Camera>,
) -> Option<(f64, f64)> {
    let (mut shares, mut metres, mut tried) = (Vec::new(), Vec::new(), 0usize);
    for (a, depth_a, b, depth_b) in pairs {
        let k_a = a.intrinsics.resized(sequence.image_size(), depth_a.size());
        let k_b = b.intrinsics.resized(sequence.image_size(), depth_b.size());
        let b_from_a = mend(&b.world_from_cam).inverse() * mend(&a.world_from_cam);
        for y in (0..depth_a.height()).step_by(4) {
            for x in (0..depth_a.width()).step_by(4) {
                let z = f64::from(depth_a[(x, y)]);
                if z <= 0.0 {
                    continue;
                }
                tried += 1;
                let p = b_from_a * k_a.cam_from_img(&Point2::new(x as f64, y as f64), z);
                let Some(pixel) = k_b.img_from_cam(&p) else { continue };
                let (u, v) = (pixel.x.round(), pixel.y.round());
                if u < 0.0 || v < 0.0 {
                    continue;
                }
                let Some(&found) = depth_b.get(u as usize, v as usize) else { continue };
                if found > 0.0 {
                    let off = (p.z - f64::from(found)).abs();
                    metres.push(off);
                    shares.push(off / f64::from(found));
                }
            }
        }
    }
    if shares.len() * 10 < tried || shares.is_empty() {
        return None;
    }
    Some((median(shares.into_iter()), median(metres.into_iter())))
}

/// Compares depth maps of frames a few steps apart. Returns the median disagreement in metres, and what is wrong.
fn check_depth(
    sequence: &Sequence,
    options: &CheckOptions,
    progress: &dyn Progress,
) -> Result<(Option<f64>, Vec<Problem>)> {
    let with_depth: Vec<&Frame> = sequence.frames().iter().filter(|f| f.arkit_depth.is_some()).collect();
    let mut problems = Vec::new();
    if with_depth.len() < 2 {
        return Ok((None, problems));
    }
    let count = options.depth_pairs.clamp(1, with_depth.len() - 1);
    let steps = Steps::new(progress, "depth", count);
    let mut pairs = Vec::with_capacity(count);
    for i in 0..count {
        steps.step()?;
        let first = i * (with_depth.len() - 1) / count;
        let (a, b) = (with_depth[first], with_depth[first + 1]);
        match (sequence.read_arkit_depth(a), sequence.read_arkit_depth(b)) {
            (Ok((depth_a, _)), Ok((depth_b, _))) => pairs.push((a, depth_a, b, depth_b)),
            (Err(e), _) => problems.push(Problem { kind: "depth", frame: Some(a.id), message: e.to_string() }),
            (_, Err(e)) => problems.push(Problem { kind: "depth", frame: Some(b.id), message: e.to_string() }),
        }
    }
    problems.dedup();
    let as_read = disagreement(&pairs, sequence, |pose| *pose);
    if pairs.is_empty() || as_read.is_some_and(|(share, _)| share <= options.depth_disagreement) {
        return Ok((as_read.map(|(_, metres)| metres), problems));
    }
    // Something is wrong: does a usual mix-up explain it?
    let best = MISREADINGS
        .iter()
        .filter_map(|m| disagreement(&pairs, sequence, m.mend).map(|(share, _)| (share, m.name)))
        .min_by(|a, b| a.0.total_cmp(&b.0));
    let explained = best.filter(|(share, _)| {
        *share <= options.depth_disagreement && as_read.is_none_or(|(as_read, _)| *share < 0.34 * as_read)
    });
    problems.push(match (explained, as_read) {
        (Some((share, name)), _) => Problem {
            kind: "convention",
            frame: None,
            message: format!("{name} (then depth and poses agree to {:.1} %)", 100.0 * share),
        },
        (None, Some((share, _))) => Problem {
            kind: "pose",
            frame: None,
            message: format!(
                "depth carried by the poses from frame to frame is off by {:.1} % of the depth",
                100.0 * share
            ),
        },
        (None, None) => Problem {
            kind: "pose",
            frame: None,
            message: "depth carried by the poses from frame to frame meets no other depth".to_owned(),
        },
    });
    Ok((as_read.map(|(_, metres)| metres), problems))
}
