//! What to simulate.

use mb_boards::BoardSpec;
use mb_geometry::ImageSize;
use mb_job::{Error, Result};
use serde::{Deserialize, Serialize};

/// How much work goes into a photograph. Geometry, cameras, depth and poses are the same in all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Quality {
    /// Two samples a pixel, coarse ambient light: for demos and tests.
    Draft,
    /// Four samples a pixel, soft shadows, ambient light and reflections traced at half resolution.
    Standard,
    /// Eight samples a pixel, everything traced finely.
    Photo,
}

/// What the model stands on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Table {
    /// A bamboo board on a dark sofa.
    Bamboo,
    /// A desk of oak planks.
    Oak,
    /// A checked tablecloth.
    Gingham,
    /// A linen cloth with a printed pattern.
    Linen,
    /// A slab of polished marble.
    Marble,
    /// A newspaper.
    Newspaper,
}

impl Table {
    /// Every table.
    pub const ALL: [Self; 6] = [Self::Bamboo, Self::Oak, Self::Gingham, Self::Linen, Self::Marble, Self::Newspaper];
}

/// How far the poses that the phone reports stray from the true ones.
///
/// The two sizes are the paper's figures, errors of the relative poses over all pairs of frames with nothing aligned, as
/// expectations: the mean over seeds has them, single sequences scatter by about a quarter. The defaults are the ARKit
/// row of the paper's pose table.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DriftOptions {
    /// Expected root mean square error of relative translations, millimetres. From more than about 45 cm away the
    /// rotations alone make a larger one.
    pub translation_rmse_mm: f64,
    /// Expected mean error of relative rotations, degrees.
    pub rotation_mean_deg: f64,
    /// Time after which the random walk has forgotten where it was, seconds.
    pub walk_memory_s: f64,
    /// Share of the variance that is a slow swing instead of a walk, 0 to 1.
    pub bias_share: f64,
    /// Period of the slow swing, seconds; each coordinate has its own, 0.7 to 1.4 times this.
    pub bias_period_s: f64,
    /// Expected number of relocalisation jumps in a sequence, at which the phone takes half of its walk back.
    pub relocalisations: f64,
}

impl Default for DriftOptions {
    fn default() -> Self {
        Self {
            translation_rmse_mm: 4.454,
            rotation_mean_deg: 0.581,
            walk_memory_s: 8.0,
            bias_share: 0.35,
            bias_period_s: 12.0,
            relocalisations: 0.5,
        }
    }
}

/// The camera's deviations from a pinhole that sees all rows at once.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LensOptions {
    /// Radial distortion `k1, k2`: a point at radius `r` (in focal lengths) is seen at `r * (1 + k1 * r^2 + k2 * r^4)`. What
    /// phones store has about 0.002 left. The intrinsic files do not tell it.
    pub distortion: [f64; 2],
    /// Time from the first to the last row of the sensor (along its shorter side), seconds; phones need 0.005 to 0.03. Poses
    /// are those of the middle row.
    pub readout_s: f64,
}

/// What to simulate. Plain data; unknown keys are refused.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SimulateOptions {
    /// Number of photographs, 1 to 100,000.
    pub frames: usize,
    /// Size of the photographs. Intrinsics scale with the longer side.
    pub size: ImageSize,
    /// Effort per photograph.
    pub quality: Quality,
    /// Seed of everything that is random.
    pub seed: u64,
    /// Mean distance from the camera to the middle of the model, metres; `None` takes the smallest distance of at
    /// least 25 cm that keeps the whole model in view in every frame.
    pub radius_m: Option<f64>,
    /// One circle round the model for each entry: the camera's angle above the table, degrees, in (0, 85].
    pub elevations_deg: Vec<f64>,
    /// How much the hand wavers: 1 is a person's, 0 a rail.
    pub hand_jitter: f64,
    /// Photographs per second, while the phone moves on at 0.2 m/s: 10 in the published sequences. `None` spreads them
    /// evenly over all circles.
    pub frames_per_s: Option<f64>,
    /// Lens and shutter.
    pub lens: LensOptions,
    /// A calibration board printed under the model, such as `charuco:7x5:0.030:0.022:DICT_5X5_100`
    /// ([`mb_boards::BoardSpec`]).
    pub board: Option<String>,
    /// What the model stands on; `None` lets the seed choose.
    pub table: Option<Table>,
    /// Errors of the reported poses.
    pub drift: DriftOptions,
    /// Number of points that the simulated annotator clicks.
    pub keypoints: usize,
    /// Standard deviation of a click, pixels of a 1920-pixel-wide photograph.
    pub keypoint_noise_px: f64,
}

impl Default for SimulateOptions {
    fn default() -> Self {
        Self {
            frames: 60,
            size: mb_capture::Sequence::PUBLISHED_SIZE,
            quality: Quality::Standard,
            seed: 0,
            radius_m: None,
            elevations_deg: vec![28.0, 50.0],
            hand_jitter: 1.0,
            frames_per_s: None,
            lens: LensOptions::default(),
            board: None,
            table: None,
            drift: DriftOptions::default(),
            keypoints: 20,
            keypoint_noise_px: 2.0,
        }
    }
}

impl SimulateOptions {
    /// The board that [`SimulateOptions::board`] describes.
    ///
    /// # Errors
    /// Its text is malformed.
    pub(crate) fn board_spec(&self) -> Result<Option<BoardSpec>> {
        self.board.as_deref().map(BoardSpec::parse).transpose()
    }

    /// Checks every field.
    ///
    /// # Errors
    /// A sentence that names the field, what it is, and what it may be.
    pub fn validate(&self) -> Result<()> {
        let need = |ok: bool, sentence: String| if ok { Ok(()) } else { Err(Error::Failed(sentence)) };
        let fits = |v: f64, low: f64, high: f64| v.is_finite() && v >= low && v <= high;
        need((1..=100_000).contains(&self.frames), format!("frames is {}, must be 1 to 100000", self.frames))?;
        need(
            (64..=8192).contains(&self.size.width) && (64..=8192).contains(&self.size.height),
            format!("size is {}, each side must be 64 to 8192 pixels", self.size),
        )?;
        self.board_spec()?;
        if let Some(radius) = self.radius_m {
            need(fits(radius, 0.02, 10.0), format!("radius_m is {radius}, must be 0.02 to 10"))?;
        }
        need(
            !self.elevations_deg.is_empty() && self.elevations_deg.iter().all(|e| *e > 0.0 && *e <= 85.0),
            format!("elevations_deg is {:?}, needs at least one angle above 0 and at most 85", self.elevations_deg),
        )?;
        need(fits(self.hand_jitter, 0.0, 5.0), format!("hand_jitter is {}, must be 0 to 5", self.hand_jitter))?;
        if let Some(rate) = self.frames_per_s {
            need(fits(rate, 0.1, 240.0), format!("frames_per_s is {rate}, must be 0.1 to 240"))?;
        }
        let lens = &self.lens;
        need(
            lens.distortion.iter().all(|k| fits(*k, -0.3, 0.3)) && fits(lens.readout_s, 0.0, 0.1),
            format!("lens is {lens:?}, needs coefficients of -0.3 to 0.3 and a readout of 0 to 0.1 s"),
        )?;
        let drift = &self.drift;
        need(
            fits(drift.translation_rmse_mm, 0.0, 1000.0)
                && fits(drift.rotation_mean_deg, 0.0, 30.0)
                && fits(drift.relocalisations, 0.0, 100.0)
                && fits(drift.walk_memory_s, 1e-3, 1e6)
                && fits(drift.bias_share, 0.0, 1.0)
                && fits(drift.bias_period_s, 1e-3, 1e6),
            format!(
                "drift is {drift:?}, needs 0 to 1000 mm, 0 to 30 degrees, 0 to 100 relocalisations, a share of 0 to 1, and times above 0"
            ),
        )?;
        need(
            self.keypoints <= 1000 && fits(self.keypoint_noise_px, 0.0, 100.0),
            format!(
                "keypoints is {} with noise {} px, may be at most 1000 and 100 px",
                self.keypoints, self.keypoint_noise_px
            ),
        )
    }
}
