//! Do depth and poses agree, and if not, what was mixed up?

use mb_geometry::{Camera, Rigid3, World};
use mb_image::DepthImage;
use mb_job::{Progress, Result, Steps};
use nalgebra::Point2;

use crate::{Frame, Sequence};

use super::{CheckOptions, Misreading, Problem, check_pairs, median};

/// Factors by which depth is tried against poses: units are mixed up by powers of ten.
const FACTORS: [f64; 6] = [1e-3, 1e-2, 0.1, 10.0, 100.0, 1000.0];
/// Median depths of a phone in a room or at a table, metres.
const PLAUSIBLE_DEPTH_M: std::ops::RangeInclusive<f64> = 0.05..=15.0;
/// A mix-up explains a disagreement if mending it leaves less than this share of it.
const EXPLAINS: f64 = 0.34;
/// Disagreements below this share of the depth are what depth maps have.
const ORDINARY: f64 = 0.02;

/// What the comparison found.
pub(super) struct DepthCheck {
    /// Median disagreement; `None` without depth, or where nothing meets.
    pub disagreement_m: Option<f64>,
    pub problems: Vec<Problem>,
}

/// Two frames with their depth.
struct Pair<'a> {
    a: (&'a Frame, DepthImage),
    b: (&'a Frame, DepthImage),
}

/// Median disagreement of all pairs as a share of the depth and in metres; `None` where hardly anything overlaps.
fn disagreement(
    pairs: &[Pair<'_>],
    sequence: &Sequence,
    factor: f64,
    mend: impl Fn(&Rigid3<World, Camera>) -> Rigid3<World, Camera>,
) -> Option<(f64, f64)> {
    let (mut shares, mut metres, mut tried) = (Vec::new(), Vec::new(), 0usize);
    for Pair { a: (a, depth_a), b: (b, depth_b) } in pairs {
        let k_a = a.intrinsics.resized(sequence.image_size(), depth_a.size());
        let k_b = b.intrinsics.resized(sequence.image_size(), depth_b.size());
        let b_from_a = mend(&b.world_from_cam).inverse() * mend(&a.world_from_cam);
        for y in (0..depth_a.height()).step_by(4) {
            for x in (0..depth_a.width()).step_by(4) {
                let z = factor * f64::from(depth_a[(x, y)]);
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
                    let found = factor * f64::from(found);
                    let off = (p.z - found).abs();
                    metres.push(off);
                    shares.push(off / found);
                }
            }
        }
    }
    if shares.len() * 10 < tried || shares.is_empty() {
        return None;
    }
    Some((median(shares.into_iter()), median(metres.into_iter())))
}

/// Compares depth maps of frames a few steps apart.
pub(super) fn check_depth(sequence: &Sequence, options: &CheckOptions, progress: &dyn Progress) -> Result<DepthCheck> {
    let with_depth: Vec<&Frame> = sequence.frames().iter().filter(|f| f.arkit_depth.is_some()).collect();
    let mut problems = Vec::new();
    if with_depth.len() < 2 {
        return Ok(DepthCheck { disagreement_m: None, problems });
    }
    let chosen = check_pairs(with_depth.len(), options.depth_pairs);
    let steps = Steps::new(progress, "depth", chosen.len());
    let mut pairs = Vec::with_capacity(chosen.len());
    for (first, second) in chosen {
        steps.step()?;
        let (a, b) = (with_depth[first], with_depth[second]);
        match (sequence.read_arkit_depth(a), sequence.read_arkit_depth(b)) {
            (Ok((depth_a, _)), Ok((depth_b, _))) => pairs.push(Pair { a: (a, depth_a), b: (b, depth_b) }),
            (Err(e), _) => problems.push(Problem::of_frame("depth", a.id, e.to_string())),
            (_, Err(e)) => problems.push(Problem::of_frame("depth", b.id, e.to_string())),
        }
    }
    problems.dedup();
    let as_read = disagreement(&pairs, sequence, 1.0, |pose| *pose);
    let disagreement_m = as_read.map(|(_, metres)| metres);
    if pairs.is_empty() || as_read.is_some_and(|(share, _)| share <= ORDINARY) {
        return Ok(DepthCheck { disagreement_m, problems });
    }
    if let Some((share, advice)) = best_explanation(&pairs, sequence)
        && share <= options.depth_disagreement
        && as_read.is_none_or(|(as_read, _)| share < EXPLAINS * as_read)
    {
        let message = format!("{advice} (then depth and poses agree to {:.1} %)", 100.0 * share);
        problems.push(Problem::of_all("convention", message));
    } else if as_read.is_none_or(|(share, _)| share > options.depth_disagreement) {
        let message = match as_read {
            Some((share, _)) => {
                format!("depth carried by the poses from frame to frame is off by {:.1} % of the depth", 100.0 * share)
            }
            None => "depth carried by the poses from frame to frame meets no other depth".to_owned(),
        };
        problems.push(Problem::of_all("pose", message));
    }
    Ok(DepthCheck { disagreement_m, problems })
}

/// The mix-up that mends most, what is left after it as a share of the depth, and what to do.
fn best_explanation(pairs: &[Pair<'_>], sequence: &Sequence) -> Option<(f64, String)> {
    let readings = Misreading::ALL.iter().filter_map(|misreading| {
        let (share, _) = disagreement(pairs, sequence, 1.0, |pose| misreading.mend(pose))?;
        Some((share, misreading.advice().to_owned()))
    });
    let depth_m = median(pairs.iter().flat_map(|p| p.a.1.data()).filter(|z| **z > 0.0).map(|z| f64::from(*z)));
    let factors = FACTORS.iter().filter_map(|&factor| {
        let (share, _) = disagreement(pairs, sequence, factor, |pose| *pose)?;
        Some((share, unit_advice(factor, depth_m)))
    });
    readings.chain(factors).min_by(|a, b| a.0.total_cmp(&b.0))
}

/// Depth that agrees with the poses once it is multiplied by `factor`: which of the two is in the wrong unit? A phone's tracker
/// works in metres and only files of depth have units of their own, so it is the depth, unless that makes it absurd.
fn unit_advice(factor: f64, depth_m: f64) -> String {
    let times = if factor > 1.0 { factor } else { 1.0 / factor };
    if PLAUSIBLE_DEPTH_M.contains(&(depth_m * factor)) {
        let (size, act) = if factor > 1.0 { ("small", "multiply") } else { ("large", "divide") };
        return format!(
            "the depth is too {size} by {times:.0} (median {depth_m:.3} m as millimetres); {act} it by {times:.0}, as depth is \
             stored in whole millimetres"
        );
    }
    match (factor > 1.0, times as u32) {
        (true, 1000) => "the translations are in millimetres; divide them by 1000".to_owned(),
        (true, 100) => "the translations are in centimetres; divide them by 100".to_owned(),
        (true, _) => format!("the translations are too large by {times:.0}; divide them by {times:.0}"),
        (false, _) => format!("the translations are too small by {times:.0}; multiply them by {times:.0}"),
    }
}
