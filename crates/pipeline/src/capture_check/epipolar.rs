//! Do matched features lie where the poses put them?
//!
//! Two posed cameras say on which line of the second photograph a point of the first must lie (the epipolar line; Hartley and
//! Zisserman, section 9.1). The distance of matches from these lines needs neither depth nor a model, and is 15 px and more
//! where axes or directions are mixed up. It says nothing about the scale.

use std::collections::BTreeMap;

use mb_align::{Feature, FeatureOptions, MatchOptions, detect_features, match_features};
use mb_capture::{Frame, FrameId, Misreading, Problem, Sequence, check_pairs};
use mb_geometry::{Camera, Rigid3, World};
use mb_job::{Progress, Result, Steps};
use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

/// How matches are compared with poses.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EpipolarOptions {
    /// Pairs of photographs, half of them neighbours, half further apart.
    pub pairs: usize,
    /// Features of each photograph, those of most contrast.
    pub features: usize,
    /// Largest median distance, as a share of the photographs' width.
    pub limit: f64,
}

impl Default for EpipolarOptions {
    fn default() -> Self {
        // A phone's poses are good for 1 to 2 px of 1920; mix-ups give 15 and more.
        Self { pairs: 6, features: 2000, limit: 0.0025 }
    }
}

/// Fewer matches say nothing.
const FEWEST_MATCHES: usize = 30;
/// A mix-up explains a disagreement if mending it leaves less than this share of it.
const EXPLAINS: f64 = 0.34;

/// What the matches say.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EpipolarCheck {
    /// Median over the pairs of their medians.
    pub median_px: f64,
    /// Each pair of photographs with enough matches.
    pub pairs: Vec<EpipolarPair>,
}

/// Two photographs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EpipolarPair {
    /// The first.
    pub a: FrameId,
    /// The second.
    pub b: FrameId,
    /// Mutual matches, wrong ones among them.
    pub matches: usize,
    /// Distance of the cameras.
    pub baseline_mm: f64,
    /// Median distance of the matches from their epipolar lines, mean of both directions.
    pub median_px: f64,
}

/// A pair with its matches: pixels of the first and of the second photograph.
struct Matched<'a> {
    a: &'a Frame,
    b: &'a Frame,
    pixels: Vec<(Vector3<f64>, Vector3<f64>)>,
}

impl Matched<'_> {
    /// Median distance from the lines, for poses as `mend` makes them; `None` where the cameras are at one place.
    fn median_px(&self, mend: impl Fn(&Rigid3<World, Camera>) -> Rigid3<World, Camera>) -> Option<f64> {
        let b_from_a = mend(&self.b.world_from_cam).inverse() * mend(&self.a.world_from_cam);
        if b_from_a.translation().norm() < 1e-9 {
            return None;
        }
        let essential = b_from_a.translation().normalize().cross_matrix() * b_from_a.rotation_matrix();
        let inverse = |frame: &Frame| -> Option<Matrix3<f64>> { frame.intrinsics.to_matrix().try_inverse() };
        let fundamental = inverse(self.b)?.transpose() * essential * inverse(self.a)?;
        let distances = self.pixels.iter().map(|(p, q)| {
            let (line_b, line_a) = (fundamental * p, fundamental.transpose() * q);
            let off = q.dot(&line_b).abs();
            0.5 * (off / line_b.xy().norm().max(1e-12) + off / line_a.xy().norm().max(1e-12))
        });
        Some(median(distances))
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::INFINITY)
}

/// Matches photographs and compares them with the poses. Photographs that cannot be read are left out.
pub(super) fn check_epipolar(
    sequence: &Sequence,
    options: &EpipolarOptions,
    progress: &dyn Progress,
) -> Result<(Option<EpipolarCheck>, Option<Problem>)> {
    let frames: Vec<&Frame> = sequence.frames().iter().filter(|f| f.image.is_some()).collect();
    if frames.len() < 2 || options.pairs == 0 {
        return Ok((None, None));
    }
    let chosen = check_pairs(frames.len(), options.pairs);
    let steps = Steps::new(progress, "matches", chosen.len());
    let feature_options = FeatureOptions { upsample: false, most: options.features, ..FeatureOptions::default() };
    let mut features: BTreeMap<usize, Vec<Feature>> = BTreeMap::new();
    let mut matched = Vec::new();
    for (first, second) in chosen {
        for i in [first, second] {
            features.entry(i).or_insert_with(|| {
                let image = sequence.read_image(frames[i]);
                image.map(|image| detect_features(&image, &feature_options)).unwrap_or_default()
            });
        }
        let (a, b) = (&features[&first], &features[&second]);
        let pixels: Vec<_> = match_features(a, b, &MatchOptions { ratio: 0.7, mutual: true })
            .into_iter()
            .map(|(i, j)| (a[i].pixel.to_homogeneous(), b[j].pixel.to_homogeneous()))
            .collect();
        if pixels.len() >= FEWEST_MATCHES {
            matched.push(Matched { a: frames[first], b: frames[second], pixels });
        }
        // Pairs come in order: what lies before both is not needed again.
        features.retain(|&i, _| i >= first);
        steps.step()?;
    }
    Ok(judge(&matched, options.limit * sequence.image_size().width as f64))
}

/// Sums up the pairs, and names what is wrong where the distance is above the limit.
fn judge(matched: &[Matched<'_>], limit_px: f64) -> (Option<EpipolarCheck>, Option<Problem>) {
    let pairs: Vec<EpipolarPair> = matched
        .iter()
        .filter_map(|m| {
            Some(EpipolarPair {
                a: m.a.id,
                b: m.b.id,
                matches: m.pixels.len(),
                baseline_mm: 1e3 * (m.b.world_from_cam.translation() - m.a.world_from_cam.translation()).norm(),
                median_px: m.median_px(|pose| *pose)?,
            })
        })
        .collect();
    if pairs.is_empty() {
        return (None, None);
    }
    let median_px = median(pairs.iter().map(|p| p.median_px));
    let check = EpipolarCheck { median_px, pairs };
    if median_px <= limit_px {
        return (Some(check), None);
    }
    let best = Misreading::ALL
        .iter()
        .map(|misreading| {
            (median(matched.iter().filter_map(|m| m.median_px(|pose| misreading.mend(pose)))), misreading)
        })
        .min_by(|a, b| a.0.total_cmp(&b.0));
    let problem = match best {
        Some((px, misreading)) if px <= limit_px && px < EXPLAINS * median_px => {
            let message = format!("{} (then matches lie {px:.2} px from where they should)", misreading.advice());
            Problem::of_all("convention", message)
        }
        _ => {
            let message = format!("matches of photographs lie {median_px:.1} px from where the poses put them");
            Problem::of_all("pose", message)
        }
    };
    (Some(check), Some(problem))
}
