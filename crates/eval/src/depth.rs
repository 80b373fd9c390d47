//! Scores of depth maps: AbsRel, SqRel, RMSE, RMSE log, SI-log and the delta accuracies (Eigen et al. 2014, "Depth map
//! prediction from a single image", section 4.1), with splits by the phone's confidence and by distance to depth edges.

use std::path::{Path, PathBuf};

use mb_geometry::ImageSize;
use mb_image::{Confidence, Image, read_confidence_png, read_depth_png_mm};
use mb_job::{InputError, Progress, Result, Steps};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::pairing::{Pair, pair_by_name, some};

/// The version of this protocol that the scores carry. A change that moves a score changes it.
pub const DEPTH_PROTOCOL: &str = "depth-1";

/// Depth in metres as `f64`, so that whole millimetres on disk keep their exact ratios; no value where it is not a
/// finite number above 0.
pub type MetricDepth = Image<f64>;

/// How depth maps are scored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DepthOptions {
    /// A folder of confidence maps `NAME_conf.png` (0, 1, 2; of any size) for the split by confidence.
    pub confidence: Option<PathBuf>,
    /// Neighbouring ground-truth pixels make an edge where their depths differ by more than this share of the nearer.
    pub edge_step: f64,
    /// Pixels up to this many columns and rows from an edge count as edge, the rest as interior.
    pub edge_radius_px: usize,
}

impl Default for DepthOptions {
    /// A step of 2 % (1 cm at half a metre, about one brick) and 3 pixels to either side.
    fn default() -> Self {
        Self { confidence: None, edge_step: 0.02, edge_radius_px: 3 }
    }
}

/// The standard metrics over some pixels, d the predicted and g the true depth in metres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct DepthMetrics {
    /// Mean of |d - g| / g.
    pub abs_rel: f64,
    /// Mean of (d - g)^2 / g, metres.
    pub sq_rel: f64,
    /// Root mean square of d - g, metres.
    pub rmse_m: f64,
    /// Root mean square of ln d - ln g.
    pub rmse_log: f64,
    /// Share of pixels with max(d/g, g/d) < 1.25.
    pub delta1: f64,
    /// The same below 1.25^2.
    pub delta2: f64,
    /// The same below 1.25^3.
    pub delta3: f64,
    /// 100 times the standard deviation of ln d - ln g.
    pub silog: f64,
    /// Share of pixels with max(d/g, g/d) < 1.05.
    pub delta_105: f64,
    /// The same below 1.025.
    pub delta_1025: f64,
    /// Pixels where both have depth.
    pub valid_pixels: u64,
}

/// The scores of a folder of depth maps.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DepthScores {
    /// [`DEPTH_PROTOCOL`].
    pub protocol: &'static str,
    /// Number of scored images.
    pub images: usize,
    /// Each metric's mean over the images; pixels are counted together.
    #[serde(flatten)]
    pub mean: DepthMetrics,
    /// Pixels of the scored images where the ground truth has depth; those without a prediction are in no metric.
    pub gt_pixels: u64,
    /// Every valid pixel weighted alike, over all images.
    pub pooled: DepthMetrics,
    /// Means over images by the phone's confidence, where confidence maps were given.
    pub by_confidence: Option<ByConfidence>,
    /// Means over images near depth edges and away from them.
    pub by_region: ByRegion,
    /// One entry per image, in the order of names.
    pub per_image: Vec<DepthImageScore>,
    /// Ground-truth maps that the prediction lacks; they are in no mean.
    pub missing: Vec<String>,
    /// Predicted maps without ground truth.
    pub unpaired: Vec<String>,
    /// How it was scored.
    pub options: DepthOptions,
    /// What a reader of the scores should know.
    pub warnings: Vec<String>,
}

/// A split by confidence; `None` where no pixel has that confidence.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ByConfidence {
    /// Confidence 0.
    pub low: Option<DepthMetrics>,
    /// Confidence 1.
    pub medium: Option<DepthMetrics>,
    /// Confidence 2.
    pub high: Option<DepthMetrics>,
}

/// A split by distance to edges; `None` where there is no such pixel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ByRegion {
    /// Near a depth step of the ground truth, or where the ground truth ends.
    pub edge: Option<DepthMetrics>,
    /// Elsewhere.
    pub interior: Option<DepthMetrics>,
}

/// The scores of one depth map.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DepthImageScore {
    /// File name without extension.
    pub name: String,
    /// The metrics; `None` (and a warning) where no pixel has both depths.
    #[serde(flatten)]
    pub metrics: Option<DepthMetrics>,
    /// Pixels where the ground truth has depth.
    pub gt_pixels: u64,
}

/// Scores the depth maps of `pred` against those of `gt`: 16-bit PNGs in millimetres, paired by file name; files
/// `NAME_conf.png` are confidence, not depth, and are left out. Valid where both are above 0.
///
/// # Errors
/// A folder has no depth map, or no name in common; a map is damaged, not 16-bit grey, or of another size than its
/// partner; no pixel anywhere has both depths.
pub fn evaluate_depth(gt: &Path, pred: &Path, options: &DepthOptions, progress: &dyn Progress) -> Result<DepthScores> {
    let pairing = pair_by_name(gt, pred, &["png"], |name| name.ends_with("_conf"))?;
    let steps = Steps::new(progress, "depth", pairing.pairs.len());
    let tallies = pairing
        .pairs
        .par_iter()
        .map(|pair| {
            let (gt, pred, confidence) = read_pair(pair, options)?;
            let tally = tally(&gt, &pred, confidence.as_ref(), options);
            steps.step()?;
            Ok(tally)
        })
        .collect::<Result<Vec<Tally>>>()?;
    let mut scores = summarise(pairing.pairs.iter().map(|p| p.name.clone()), &tallies, options).ok_or_else(|| {
        InputError::new(pred, "no pixel has depth both here and in the ground truth")
            .help("Depth maps are 16-bit PNGs in millimetres, 0 = no value")
    })?;
    if !pairing.missing.is_empty() {
        scores.warnings.push(format!("missing: {}; the means do not count them", some(&pairing.missing)));
    }
    if !pairing.unpaired.is_empty() {
        scores.warnings.push(format!("no ground truth for {}", some(&pairing.unpaired)));
    }
    (scores.missing, scores.unpaired) = (pairing.missing, pairing.unpaired);
    Ok(scores)
}

/// Scores depth maps in memory, `(ground truth, prediction)`, both of one size. `None` where sizes differ, or no pixel
/// of any pair has both depths. `options.confidence` is not read here.
pub fn score_depth(pairs: &[(MetricDepth, MetricDepth)], options: &DepthOptions) -> Option<DepthScores> {
    if pairs.iter().any(|(gt, pred)| gt.size() != pred.size()) {
        return None;
    }
    let tallies: Vec<Tally> = pairs.par_iter().map(|(gt, pred)| tally(gt, pred, None, options)).collect();
    summarise((0..pairs.len()).map(|i| i.to_string()), &tallies, options)
}

fn read_pair(pair: &Pair, options: &DepthOptions) -> Result<(MetricDepth, MetricDepth, Option<Confidence>)> {
    // Divided in f64, as 400 mm against 500 mm is a ratio of exactly 1.25, which no delta accuracy counts.
    let metres = |path| Ok::<_, mb_job::Error>(read_depth_png_mm(path)?.map(|&mm| f64::from(mm) / 1000.0));
    let (gt, pred) = (metres(&pair.gt)?, metres(&pair.pred)?);
    if gt.size() != pred.size() {
        let found = format!("{} pixels, but the ground truth {} is {}", pred.size(), pair.gt.display(), gt.size());
        let help = "Bring the prediction to the ground truth's size first, such as by taking the nearest pixel";
        return Err(InputError::new(&pair.pred, found).help(help).into());
    }
    let confidence = match &options.confidence {
        Some(folder) => Some(read_confidence_png(folder.join(format!("{}_conf.png", pair.name)))?),
        None => None,
    };
    Ok((gt, pred, confidence))
}

/// Running sums over pixels.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    pixels: u64,
    abs_rel: f64,
    sq_rel: f64,
    squares: f64,
    log_squares: f64,
    logs: f64,
    /// Pixels below each of [`RATIOS`].
    within: [u64; RATIOS.len()],
}

/// Thresholds of max(d/g, g/d).
const RATIOS: [f64; 5] = [1.25, 1.25 * 1.25, 1.25 * 1.25 * 1.25, 1.05, 1.025];

impl Sums {
    fn add(&mut self, g: f64, d: f64) {
        let (error, log) = (d - g, (d / g).ln());
        self.pixels += 1;
        self.abs_rel += error.abs() / g;
        self.sq_rel += error * error / g;
        self.squares += error * error;
        self.log_squares += log * log;
        self.logs += log;
        let ratio = (d / g).max(g / d);
        for (count, threshold) in self.within.iter_mut().zip(RATIOS) {
            *count += u64::from(ratio < threshold);
        }
    }

    fn merge(&mut self, other: &Self) {
        self.pixels += other.pixels;
        self.abs_rel += other.abs_rel;
        self.sq_rel += other.sq_rel;
        self.squares += other.squares;
        self.log_squares += other.log_squares;
        self.logs += other.logs;
        self.within.iter_mut().zip(other.within).for_each(|(a, b)| *a += b);
    }

    fn metrics(&self) -> Option<DepthMetrics> {
        if self.pixels == 0 {
            return None;
        }
        let n = self.pixels as f64;
        let mean_log = self.logs / n;
        let [delta1, delta2, delta3, delta_105, delta_1025] = self.within.map(|count| count as f64 / n);
        Some(DepthMetrics {
            abs_rel: self.abs_rel / n,
            sq_rel: self.sq_rel / n,
            rmse_m: (self.squares / n).sqrt(),
            rmse_log: (self.log_squares / n).sqrt(),
            delta1,
            delta2,
            delta3,
            silog: 100.0 * (self.log_squares / n - mean_log * mean_log).max(0.0).sqrt(),
            delta_105,
            delta_1025,
            valid_pixels: self.pixels,
        })
    }
}

/// One image's sums, whole and by split.
struct Tally {
    gt_pixels: u64,
    all: Sums,
    /// By confidence 0, 1, 2, where there is a confidence map.
    by_confidence: Option<[Sums; 3]>,
    edge: Sums,
    interior: Sums,
}

fn has_depth(z: f64) -> bool {
    z > 0.0 && z.is_finite()
}

fn tally(gt: &MetricDepth, pred: &MetricDepth, confidence: Option<&Confidence>, options: &DepthOptions) -> Tally {
    let edges = near_edges(gt, options);
    let mut tally = Tally {
        gt_pixels: 0,
        all: Sums::default(),
        by_confidence: confidence.map(|_| Default::default()),
        edge: Sums::default(),
        interior: Sums::default(),
    };
    let ImageSize { width, height } = gt.size();
    for y in 0..height {
        // Summed row by row first, which keeps the rounding of large images small.
        let mut row = [Sums::default(); 2];
        for x in 0..width {
            let (g, d) = (gt[(x, y)], pred[(x, y)]);
            if !has_depth(g) {
                continue;
            }
            tally.gt_pixels += 1;
            if !has_depth(d) {
                continue;
            }
            row[usize::from(edges[(x, y)])].add(g, d);
            if let (Some(confidence), Some(split)) = (confidence, &mut tally.by_confidence) {
                // The confidence pixel that covers this pixel's centre.
                let (cx, cy) =
                    ((2 * x + 1) * confidence.width() / (2 * width), (2 * y + 1) * confidence.height() / (2 * height));
                split[usize::from(confidence[(cx, cy)]).min(2)].add(g, d);
            }
        }
        tally.interior.merge(&row[0]);
        tally.edge.merge(&row[1]);
    }
    tally.all.merge(&tally.interior);
    tally.all.merge(&tally.edge);
    tally
}

/// True up to `edge_radius_px` from a pair of neighbours that make an edge: a step, or one with depth and one without.
fn near_edges(gt: &MetricDepth, options: &DepthOptions) -> Image<bool> {
    let ImageSize { width, height } = gt.size();
    let is_edge = |a: f64, b: f64| match (has_depth(a), has_depth(b)) {
        (true, true) => (a - b).abs() > options.edge_step * a.min(b),
        (a, b) => a != b,
    };
    let mut edges = Image::from_fn(gt.size(), |x, y| {
        let here = gt[(x, y)];
        let mut neighbours = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)].into_iter();
        neighbours.any(|(nx, ny)| gt.get(nx, ny).is_some_and(|&there| is_edge(here, there)))
    });
    // A square grows along columns and rows one after the other.
    for (count, length, stride, step) in [(height, width, width, 1), (width, height, 1, width)] {
        for line in 0..count {
            let at = |i: usize| line * stride + i * step;
            let marked: Vec<usize> = (0..length).filter(|&i| edges.data()[at(i)]).collect();
            for i in marked {
                let reach = i.saturating_sub(options.edge_radius_px)..=(i + options.edge_radius_px).min(length - 1);
                reach.for_each(|j| edges.data_mut()[at(j)] = true);
            }
        }
    }
    edges
}

fn summarise(names: impl Iterator<Item = String>, tallies: &[Tally], options: &DepthOptions) -> Option<DepthScores> {
    let mut warnings = Vec::new();
    let per_image: Vec<DepthImageScore> = names
        .zip(tallies)
        .map(|(name, tally)| {
            let metrics = tally.all.metrics();
            if metrics.is_none() {
                warnings.push(format!("{name}: no pixel has both depths; the means do not count it"));
            }
            DepthImageScore { name, metrics, gt_pixels: tally.gt_pixels }
        })
        .collect();
    let mut pooled = Sums::default();
    tallies.iter().for_each(|t| pooled.merge(&t.all));
    let mean = mean_over_images(tallies.iter().map(|t| &t.all))?;
    // A single factor with little scatter around it is a unit or a scale, not an error of measurement.
    let factor = (pooled.logs / pooled.pixels as f64).exp();
    let pooled = pooled.metrics()?;
    if !(0.5..2.0).contains(&factor) && pooled.silog < 30.0 {
        warnings.push(format!(
            "predicted depth is {factor:.4} times the true one throughout: it may be in another unit than millimetres, \
             or known only up to scale"
        ));
    }
    let by_confidence = tallies.iter().map(|t| t.by_confidence.as_ref()).collect::<Option<Vec<_>>>().map(|splits| {
        let split = |value: usize| mean_over_images(splits.iter().map(|s| &s[value]));
        ByConfidence { low: split(0), medium: split(1), high: split(2) }
    });
    Some(DepthScores {
        protocol: DEPTH_PROTOCOL,
        images: per_image.iter().filter(|s| s.metrics.is_some()).count(),
        mean,
        gt_pixels: per_image.iter().map(|s| s.gt_pixels).sum(),
        pooled,
        by_confidence,
        by_region: ByRegion {
            edge: mean_over_images(tallies.iter().map(|t| &t.edge)),
            interior: mean_over_images(tallies.iter().map(|t| &t.interior)),
        },
        per_image,
        missing: Vec::new(),
        unpaired: Vec::new(),
        options: options.clone(),
        warnings,
    })
}

/// The mean of each metric over the images that have pixels.
fn mean_over_images<'a>(images: impl Iterator<Item = &'a Sums>) -> Option<DepthMetrics> {
    let metrics: Vec<DepthMetrics> = images.filter_map(Sums::metrics).collect();
    if metrics.is_empty() {
        return None;
    }
    let mean = |value: fn(&DepthMetrics) -> f64| metrics.iter().map(value).sum::<f64>() / metrics.len() as f64;
    Some(DepthMetrics {
        abs_rel: mean(|m| m.abs_rel),
        sq_rel: mean(|m| m.sq_rel),
        rmse_m: mean(|m| m.rmse_m),
        rmse_log: mean(|m| m.rmse_log),
        delta1: mean(|m| m.delta1),
        delta2: mean(|m| m.delta2),
        delta3: mean(|m| m.delta3),
        silog: mean(|m| m.silog),
        delta_105: mean(|m| m.delta_105),
        delta_1025: mean(|m| m.delta_1025),
        valid_pixels: metrics.iter().map(|m| m.valid_pixels).sum(),
    })
}
