//! Scores of camera poses against reference poses.
//!
//! - `pairwise`, the paper's figure: for every pair of frames, the pose of the later camera seen from the earlier one,
//!   predicted against reference. Nothing is aligned; a drift shows in full.
//! - `object`: each camera's pose in the object's frame, the error that ground truth inherits. It needs the object's
//!   pose on both sides.
//! - `ate`: distances of the camera centres after the best rigid alignment of the predicted ones (Sturm et al. 2012, "A
//!   benchmark for the evaluation of RGB-D SLAM systems", section VI), and beside it without alignment and after the best
//!   similarity (`evo_ape` as it is, with `-a` and with `-as`); `rpe`: relative poses of neighbouring frames.

use std::path::Path;

use mb_capture::{FrameId, PoseFolder};
use mb_geometry::{Camera, Object, Rigid3, Sim3, World};
use mb_job::{Error, InputError, Result};
use nalgebra::Point3;
use rayon::prelude::*;
use serde::Serialize;

/// The version of this protocol that the scores carry. A change that moves a score changes it.
pub const POSES_PROTOCOL: &str = "poses-1";

/// The scores of a set of camera poses.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PosesScores {
    /// [`POSES_PROTOCOL`].
    pub protocol: &'static str,
    /// Number of frames that both sides have.
    pub frames: usize,
    /// Relative poses over all pairs of frames, nothing aligned.
    pub pairwise: PoseErrors,
    /// Cameras in the object's frame, where both sides know the object's pose.
    pub object: Option<PoseErrors>,
    /// Root mean square distance of the camera centres after rigid alignment, millimetres.
    pub ate_rmse_mm: f64,
    /// Mean angle between the cameras' rotations after the same alignment, degrees.
    pub ate_rotation_mean_deg: f64,
    /// Poses as they are, for two sides that share a world; large and without meaning where they do not.
    pub ate_unaligned: PoseErrors,
    /// Poses after the similarity that brings the predicted centres closest; `None` where nothing determines its scale.
    pub ate_similarity: Option<PoseErrors>,
    /// Length of a predicted metre in reference metres, from the best similarity; `None` where nothing determines it.
    pub scale: Option<f64>,
    /// Relative poses of neighbouring frames, in the order of their numbers.
    pub rpe: PoseErrors,
    /// Frames that the prediction lacks; they are in no figure.
    pub missing: Vec<FrameId>,
    /// Frames that only the prediction has.
    pub unpaired: Vec<FrameId>,
    /// Where the poses come from, where that is not `pose/` alone.
    pub sources: Vec<String>,
    /// What a reader of the scores should know.
    pub warnings: Vec<String>,
}

/// Errors of poses or of relative poses.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PoseErrors {
    /// Root mean square of the translation errors, millimetres.
    pub translation_rmse_mm: f64,
    /// Mean of the translation errors, millimetres.
    pub translation_mean_mm: f64,
    /// Largest translation error, millimetres.
    pub translation_max_mm: f64,
    /// Mean of the rotation errors (angles), degrees.
    pub rotation_mean_deg: f64,
    /// Root mean square of the rotation errors, degrees.
    pub rotation_rmse_deg: f64,
    /// Largest rotation error, degrees.
    pub rotation_max_deg: f64,
    /// Number of poses or pairs.
    pub count: u64,
}

/// One frame's pose on both sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosePair {
    /// Which frame.
    pub frame: FrameId,
    /// Reference.
    pub gt_world_from_cam: Rigid3<World, Camera>,
    /// Prediction, in a world of its own.
    pub pred_world_from_cam: Rigid3<World, Camera>,
}

/// The object's pose on both sides.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectPair {
    /// Reference.
    pub gt_world_from_object: Rigid3<World, Object>,
    /// Prediction.
    pub pred_world_from_object: Rigid3<World, Object>,
}

/// Scores the poses of the folder `pred` against those of `gt`, joined by frame number. Each is a sequence or any folder
/// with `pose/NNNNNN.txt`; the poses of its alignment (`alignment/alignment.json` or `alignment.json`) count where there
/// is one.
///
/// # Errors
/// A side has no pose or a malformed one, or fewer than two frames are in common.
pub fn evaluate_poses(gt: &Path, pred: &Path) -> Result<PosesScores> {
    let (gt, pred) = (PoseFolder::open(gt)?, PoseFolder::open(pred)?);
    let find = |folder: &PoseFolder, id: FrameId| {
        folder.frames().binary_search_by_key(&id, |(id, _)| *id).ok().map(|i| folder.frames()[i].1)
    };
    let mut pairs = Vec::new();
    let mut missing = Vec::new();
    for &(frame, gt_world_from_cam) in gt.frames() {
        match find(&pred, frame) {
            Some(pred_world_from_cam) => pairs.push(PosePair { frame, gt_world_from_cam, pred_world_from_cam }),
            None => missing.push(frame),
        }
    }
    let unpaired: Vec<FrameId> =
        pred.frames().iter().map(|(id, _)| *id).filter(|&id| find(&gt, id).is_none()).collect();
    if pairs.len() < 2 {
        let found = format!("{} frames in common with {}, at least 2 are needed", pairs.len(), gt.root().display());
        return Err(InputError::new(pred.root(), found)
            .help("Frames are joined by the numbers of pose/NNNNNN.txt")
            .into());
    }
    let object = match (gt.alignment(), pred.alignment()) {
        (Some((_, gt)), Some((_, pred))) => Some(ObjectPair {
            gt_world_from_object: gt.world_from_object,
            pred_world_from_object: pred.world_from_object,
        }),
        _ => None,
    };
    let mut scores = score_poses(&pairs, object.as_ref())?;
    for (side, folder) in [("reference", &gt), ("predicted", &pred)] {
        scores.warnings.extend(folder.warnings().iter().cloned());
        match folder.alignment() {
            Some((path, alignment)) if !alignment.frames.is_empty() => {
                let count = alignment.frames.len();
                scores.sources.push(format!("{side} poses: {count} from {}", path.display()));
            }
            Some(_) => {}
            None => scores.warnings.push(format!(
                "object is empty: the {side} side {} has no alignment/alignment.json with the object's pose",
                folder.root().display()
            )),
        }
    }
    if !missing.is_empty() {
        let count = missing.len();
        scores.warnings.push(format!("{count} frames are missing in {}; no figure counts them", pred.root().display()));
    }
    (scores.missing, scores.unpaired) = (missing, unpaired);
    Ok(scores)
}

/// Scores poses in memory. Both worlds are arbitrary; neighbours are neighbours in the order of `pairs`.
///
/// # Errors
/// [`Error::Failed`] for fewer than two frames, or numbers that are not finite.
pub fn score_poses(pairs: &[PosePair], object: Option<&ObjectPair>) -> Result<PosesScores> {
    if pairs.len() < 2 {
        return Err(Error::Failed(format!("{} poses; relative poses need at least 2", pairs.len())));
    }
    if !pairs.iter().all(|p| p.gt_world_from_cam.is_finite() && p.pred_world_from_cam.is_finite()) {
        return Err(Error::Failed("a pose holds numbers that are not finite".to_owned()));
    }
    let relative = |i: usize, j: usize| {
        let between = |a: Rigid3<World, Camera>, b: Rigid3<World, Camera>| a.inverse() * b;
        error_of(
            &between(pairs[i].gt_world_from_cam, pairs[j].gt_world_from_cam),
            &between(pairs[i].pred_world_from_cam, pairs[j].pred_world_from_cam),
        )
    };
    // One tally per first frame, merged in frame order: the same bits for any number of threads.
    let per_frame: Vec<Tally> =
        (0..pairs.len()).into_par_iter().map(|i| (i + 1..pairs.len()).map(|j| relative(i, j)).collect()).collect();
    let mut pairwise = Tally::default();
    per_frame.iter().for_each(|tally| pairwise.merge(tally));
    let rpe: Tally = (1..pairs.len()).map(|j| relative(j - 1, j)).collect();
    let object = object.map(|object| {
        let errors = pairs.iter().map(|p| {
            error_of(
                &(object.gt_world_from_object.inverse() * p.gt_world_from_cam),
                &(object.pred_world_from_object.inverse() * p.pred_world_from_cam),
            )
        });
        errors.collect::<Tally>().errors()
    });

    let centres = |pose: fn(&PosePair) -> Rigid3<World, Camera>| -> Vec<Point3<f64>> {
        pairs.iter().map(|p| pose(p).translation().into()).collect()
    };
    let (gt, pred) = (centres(|p| p.gt_world_from_cam), centres(|p| p.pred_world_from_cam));
    let gt_from_pred = Sim3::<World, World>::align_any(&gt, &pred, false)
        .ok_or_else(|| Error::Failed("the camera centres overflow".to_owned()))?
        .rigid;
    let aligned: Tally =
        pairs.iter().map(|p| error_of(&p.gt_world_from_cam, &(gt_from_pred * p.pred_world_from_cam))).collect();
    let unaligned: Tally = pairs.iter().map(|p| error_of(&p.gt_world_from_cam, &p.pred_world_from_cam)).collect();
    let similarity = Sim3::<World, World>::align_any(&gt, &pred, true);
    let scaled = similarity.map(|sim| {
        let moved = |p: &PosePair| {
            let center = sim.transform_point(&Point3::from(p.pred_world_from_cam.translation()));
            Rigid3::from_parts(sim.rigid.rotation() * p.pred_world_from_cam.rotation(), center.coords)
        };
        pairs.iter().map(|p| error_of(&p.gt_world_from_cam, &moved(p))).collect::<Tally>().errors()
    });
    let scale = similarity.map(|sim| sim.scale);

    let mut warnings = Vec::new();
    if let Some(scale) = scale.filter(|s| !(0.9..1.1).contains(s)) {
        warnings.push(format!(
            "a predicted metre is {scale:.4} reference metres long: the prediction may be in another unit, or known \
             only up to scale"
        ));
    }
    let aligned = aligned.errors();
    Ok(PosesScores {
        protocol: POSES_PROTOCOL,
        frames: pairs.len(),
        pairwise: pairwise.errors(),
        object,
        ate_rmse_mm: aligned.translation_rmse_mm,
        ate_rotation_mean_deg: aligned.rotation_mean_deg,
        ate_unaligned: unaligned.errors(),
        ate_similarity: scaled,
        scale,
        rpe: rpe.errors(),
        missing: Vec::new(),
        unpaired: Vec::new(),
        sources: Vec::new(),
        warnings,
    })
}

/// Translation error in metres and rotation error in radians.
type ErrorPair = (f64, f64);

/// How far `pred` is from `gt`: the distance of the source frames' origins, and the angle between their axes.
fn error_of<To, From>(gt: &Rigid3<To, From>, pred: &Rigid3<To, From>) -> ErrorPair {
    ((pred.translation() - gt.translation()).norm(), (gt.inverse() * *pred).angle_rad())
}

/// Running sums of errors.
#[derive(Debug, Clone, Copy, Default)]
struct Tally {
    count: u64,
    translation: f64,
    translation_squares: f64,
    translation_max: f64,
    rotation: f64,
    rotation_squares: f64,
    rotation_max: f64,
}

impl FromIterator<ErrorPair> for Tally {
    fn from_iter<I: IntoIterator<Item = ErrorPair>>(errors: I) -> Self {
        let mut tally = Self::default();
        for (translation, rotation) in errors {
            tally.count += 1;
            tally.translation += translation;
            tally.translation_squares += translation * translation;
            tally.translation_max = tally.translation_max.max(translation);
            tally.rotation += rotation;
            tally.rotation_squares += rotation * rotation;
            tally.rotation_max = tally.rotation_max.max(rotation);
        }
        tally
    }
}

impl Tally {
    fn merge(&mut self, other: &Self) {
        self.count += other.count;
        self.translation += other.translation;
        self.translation_squares += other.translation_squares;
        self.translation_max = self.translation_max.max(other.translation_max);
        self.rotation += other.rotation;
        self.rotation_squares += other.rotation_squares;
        self.rotation_max = self.rotation_max.max(other.rotation_max);
    }

    fn errors(&self) -> PoseErrors {
        let n = self.count as f64;
        PoseErrors {
            translation_rmse_mm: (self.translation_squares / n).sqrt() * 1e3,
            translation_mean_mm: self.translation / n * 1e3,
            translation_max_mm: self.translation_max * 1e3,
            rotation_mean_deg: (self.rotation / n).to_degrees(),
            rotation_rmse_deg: (self.rotation_squares / n).sqrt().to_degrees(),
            rotation_max_deg: self.rotation_max.to_degrees(),
            count: self.count,
        }
    }
}
