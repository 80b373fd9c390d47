//! Scores of reconstructed surfaces: how far the prediction is from the truth, and how much of the truth it found.
//!
//! [`evaluate_surface`] scores one file against a sequence's ground truth, [`score_surface`] the same in memory,
//! [`evaluate_surface_method`] a method over a list of sequences. `docs/metrics.md` defines every number by protocol.

mod breakdown;
mod clip;
mod curve;
mod distance;
mod dtu;
mod exact;
mod icp;
mod input;
mod method;
mod provenance;
mod published;
mod rigid;
mod samples;
mod score;
mod setting;
mod tanks;

use std::path::Path;
use std::time::Instant;

use mb_job::{InputError, Progress, Result};
use mb_mesh::TriangleMesh;
use serde::{Deserialize, Serialize};

pub use breakdown::{
    Breakdown, Coverage, Floaters, Group, GroupThreshold, Normals, OfAngle, OfPart, OfRegion, OfViews, Region,
};
pub use curve::{Curve, CurvePoint};
pub use distance::{distances_to_surface_m, vertex_distances_mm};
pub use dtu::DtuScores;
pub use exact::{Aligned, AlignmentEffect, Confidence95, ExactScores, F1Change, Interval, ThresholdIntervals};
pub use input::SurfaceTruth;
pub(crate) use method::quoted;
pub use method::{
    AlignedMean, MissingScore, PUBLISHED_TEST_SEQUENCES, SurfaceMean, SurfaceTable, evaluate_surface_method,
    read_sequence_list,
};
pub use provenance::{FileHash, Provenance};
pub(crate) use score::f1;
pub use score::{Chamfer, ThresholdScore};

/// How surfaces are scored; a change that moves a score makes a new variant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub enum SurfaceProtocol {
    /// The published script, as it behaves: numbers comparable with the paper's tables.
    #[default]
    #[serde(rename = "mobilebrick-2023")]
    MobileBrick2023,
    /// Exact distances between exact surfaces, nothing aligned in secret.
    #[serde(rename = "exact-1")]
    Exact1,
    /// Mean distances without outliers, as the DTU benchmark scores.
    #[serde(rename = "dtu-style-1")]
    DtuStyle1,
    /// F-scores of registered and thinned clouds, as Tanks and Temples scores.
    #[serde(rename = "tnt-style-1")]
    TntStyle1,
}

impl SurfaceProtocol {
    /// Every protocol.
    pub const ALL: [Self; 4] = [Self::MobileBrick2023, Self::Exact1, Self::DtuStyle1, Self::TntStyle1];

    /// The name in documents and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::MobileBrick2023 => "mobilebrick-2023",
            Self::Exact1 => "exact-1",
            Self::DtuStyle1 => "dtu-style-1",
            Self::TntStyle1 => "tnt-style-1",
        }
    }
}

/// The protocol's name.
impl std::fmt::Display for SurfaceProtocol {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.pad(self.name())
    }
}

/// From the protocol's name.
impl std::str::FromStr for SurfaceProtocol {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        let names = Self::ALL.map(Self::name);
        let found = Self::ALL.into_iter().find(|p| p.name() == name);
        found.ok_or_else(|| format!("no protocol {name:?}; there are {}", names.join(", ")))
    }
}

/// Options of a surface score.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SurfaceOptions {
    /// The protocol.
    pub protocol: SurfaceProtocol,
    /// Points sampled on each surface, at least 1; the published tables use 100,000.
    pub points: usize,
    /// Seed of the sampling.
    pub seed: u64,
    /// Thresholds beside 2.5 and 5 mm, which are always there; millimetres, above 0.
    pub more_thresholds_mm: Vec<f64>,
}

impl Default for SurfaceOptions {
    fn default() -> Self {
        Self { protocol: SurfaceProtocol::default(), points: 100_000, seed: 0, more_thresholds_mm: Vec::new() }
    }
}

impl SurfaceOptions {
    /// The thresholds of the published tables, millimetres.
    pub const PUBLISHED_THRESHOLDS_MM: [f64; 2] = [2.5, 5.0];

    /// All thresholds in ascending order, millimetres.
    pub fn thresholds_mm(&self) -> Vec<f64> {
        let mut thresholds = Self::PUBLISHED_THRESHOLDS_MM.to_vec();
        thresholds.extend(&self.more_thresholds_mm);
        thresholds.sort_by(f64::total_cmp);
        thresholds.dedup();
        thresholds
    }

    /// Checks the ranges.
    ///
    /// # Errors
    /// [`mb_job::Error::Failed`] with what is out of range.
    pub fn validate(&self) -> Result<()> {
        let fail = |message: String| Err(mb_job::Error::Failed(message));
        if self.points == 0 || self.points > 10_000_000 {
            return fail(format!("{} points are asked for; 1 to 10,000,000 can be sampled", self.points));
        }
        match self.more_thresholds_mm.iter().find(|t| !(t.is_finite() && **t > 0.0)) {
            Some(threshold) => fail(format!("a threshold of {threshold} mm; thresholds are above 0")),
            None => Ok(()),
        }
    }

    /// The seed for sampling the ground truth: even, the prediction's is odd. Equal meshes must not get equal samples, or
    /// the published protocol would lose the sampling floor that it has.
    fn truth_seed(&self) -> u64 {
        self.seed.wrapping_mul(2).wrapping_add(2)
    }

    fn prediction_seed(&self) -> u64 {
        self.seed.wrapping_mul(2).wrapping_add(1)
    }
}

/// What the hidden alignment of the published protocol found.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Icp {
    /// Share of the ground truth's vertices with a vertex of the prediction within 20 mm, after the last iteration.
    pub fitness: f64,
    /// Whether the prediction was moved before it was scored.
    pub applied: bool,
    /// Rotation that the alignment proposes, degrees.
    pub rotation_deg: f64,
    /// How far the alignment moves the middle of the ground truth, millimetres.
    pub translation_mm: f64,
}

/// The score of one prediction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SurfaceScores {
    /// The protocol.
    pub protocol: SurfaceProtocol,
    /// Name of the sequence.
    pub sequence: String,
    /// The alignment: applied by `mobilebrick-2023` above its cliff, by `tnt-style-1` always, by the others never.
    pub icp: Icp,
    /// Mean distances.
    #[serde(flatten)]
    pub chamfer: Chamfer,
    /// One entry per threshold, ascending.
    pub thresholds: Vec<ThresholdScore>,
    /// Area under the threshold curves, 0 to [`Curve::LIMIT_MM`].
    pub curve: Curve,
    /// What only `exact-1` measures.
    #[serde(flatten)]
    pub exact: Option<ExactScores>,
    /// What only `dtu-style-1` measures.
    #[serde(flatten)]
    pub dtu: Option<DtuScores>,
    /// Points on the ground truth and on the prediction that were compared.
    pub points: [usize; 2],
    /// Seed of the sampling.
    pub seed: u64,
    /// The ground truth's mesh, relative to the sequence.
    pub ground_truth: String,
    /// The program and the files that made the score; `None` for meshes in memory.
    pub provenance: Option<Provenance>,
    /// What a reader of the score should know.
    pub warnings: Vec<String>,
    /// Wall time of scoring without reading files.
    pub seconds: f64,
}

/// Scores the mesh or point cloud `pred` against the ground truth in the sequence folder `gt`.
///
/// # Errors
/// A file is missing or damaged; the prediction is empty, has no finite place, is in another unit or frame, or has
/// nothing inside the visible volume. The likely fix is named.
pub fn evaluate_surface(
    gt: &Path,
    pred: &Path,
    options: &SurfaceOptions,
    progress: &dyn Progress,
) -> Result<SurfaceScores> {
    options.validate()?;
    let truth = SurfaceTruth::read(gt, options.protocol)?;
    let prediction = mb_mesh::read_mesh(pred)?;
    let provenance = Provenance::of(pred, &truth.mesh_path, &gt.join("visibility_mask.npy"))?;
    let mut scores = score_surface(&truth, prediction, pred, options, progress)?;
    scores.provenance = Some(provenance);
    Ok(scores)
}

/// Scores a prediction in memory. `name` is the file that errors speak of.
///
/// # Errors
/// As [`evaluate_surface`].
pub fn score_surface(
    truth: &SurfaceTruth,
    prediction: TriangleMesh,
    name: &Path,
    options: &SurfaceOptions,
    progress: &dyn Progress,
) -> Result<SurfaceScores> {
    let start = Instant::now();
    options.validate()?;
    let mut warnings = input::check_prediction(truth, &prediction, name)?;
    let mut scores = match options.protocol {
        SurfaceProtocol::MobileBrick2023 => published::score(truth, prediction, name, options, progress)?,
        SurfaceProtocol::Exact1 => exact::score(truth, &prediction, name, options, progress)?,
        SurfaceProtocol::DtuStyle1 => dtu::score(truth, &prediction, name, options, progress)?,
        SurfaceProtocol::TntStyle1 => tanks::score(truth, &prediction, name, options, progress)?,
    };
    warnings.append(&mut scores.warnings);
    scores.warnings = warnings;
    for threshold in scores.thresholds.iter().filter(|t| t.accuracy + t.recall == 0.0) {
        scores.warnings.push(format!(
            "F1 at {} mm is 0/0, counted as 0: no point lies within the threshold in either direction",
            threshold.threshold_mm
        ));
    }
    scores.seconds = start.elapsed().as_secs_f64();
    Ok(scores)
}

/// The error of a prediction that has nothing where it can be judged.
fn nothing_visible(name: &Path) -> InputError {
    InputError::new(name, "no part of the prediction lies inside the sequence's visible volume").help(
        "Predictions are compared in metres in the sequence's world frame, the frame of pose/; check unit and frame",
    )
}
