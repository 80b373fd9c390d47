//! `align keypoints`: the object's pose from what a person clicked.

use std::path::{Path, PathBuf};

use mb_capture::{Alignment, AlignmentStage, FrameId, Keypoints, Sequence};
use mb_geometry::{Object, Rigid3, World};
use mb_job::{Error, InputError, Progress, Result, Steps};
use nalgebra::{Matrix2, Matrix2x6, Matrix6, Point2, Vector2, Vector3};
use serde::{Deserialize, Serialize};

use crate::model_scale::fitting_scale;
use crate::output::{begin_stage, phone_frames, put_phone_cameras_back, rows};
use crate::pnp::{Correspondence, PnpError, PnpOptions, PointLayout, PoseEstimate, PosedCamera, estimate_pose};

/// How `align_keypoints` works.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct KeypointOptions {
    /// The pose estimate. Its drift is that of a phone, and is only assumed where the clicks of several frames do not
    /// agree without it.
    pub pnp: PnpOptions,
}

impl Default for KeypointOptions {
    fn default() -> Self {
        // A phone's relative poses err by 4.5 mm and 0.6 degrees (Li et al. 2023, table 5).
        Self { pnp: PnpOptions { drift_deg: 0.6, drift_mm: 4.5, ..PnpOptions::default() } }
    }
}

/// What came out, for people and programs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct KeypointSummary {
    /// Clicked points.
    pub points: usize,
    /// Frames that were clicked in.
    pub frames: usize,
    /// Points that the pose was computed from.
    pub inliers: usize,
    /// The pose.
    pub world_from_object: Rigid3<World, Object>,
    /// Root mean square residual length of the inliers, pixels.
    pub rms_px: f64,
    /// Residual length from which a click counts as wrong, pixels.
    pub limit_px: f64,
    /// Every clicked point in the file's order.
    pub residuals: Vec<KeypointResidual>,
    /// Covariance of the pose, left perturbation in the world frame, `[rotation; translation]` (rad, m), row-major,
    /// scaled by the residuals' variance. It is conditional on the phone's poses (see `poses_drifted`): errors that all
    /// annotated frames share are not in it.
    pub covariance: [[f64; 6]; 6],
    /// Standard deviation of the rotation, degrees.
    pub rotation_std_deg: f64,
    /// Standard deviation of the position of the points' centroid, millimetres.
    pub translation_std_mm: f64,
    /// Condition number of the scaled normal equations; above about 1e4 the points leave some motion nearly free.
    pub condition: f64,
    /// How the inliers' 3D points lie in space.
    pub layout: PointLayout,
    /// Whether the frames' clicks only agree if the phone's poses have drifted; residuals are then after a small motion
    /// of each frame, and the covariance takes the drifts as independent.
    pub poses_drifted: bool,
    /// Whether the pose was drawn from the one that the clicks alone give, which the residuals belong to, towards upright:
    /// done where the model's y axis lies within three standard deviations of the world's, as on a table under a phone.
    pub drawn_upright: bool,
    /// The file written.
    pub written: PathBuf,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

/// One clicked point after the fit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct KeypointResidual {
    /// Position in the file, from 0.
    pub index: usize,
    /// What the annotator called it.
    pub name: String,
    /// The frame.
    pub frame: FrameId,
    /// Clicked pixel.
    pub pixel: Point2<f64>,
    /// Where the model's point appears with the pose found; `None` behind the camera.
    pub predicted: Option<Point2<f64>>,
    /// Distance between the two, pixels; `None` behind the camera.
    pub residual_px: Option<f64>,
    /// Whether the pose was computed from it.
    pub inlier: bool,
}

/// Computes the object's pose from `annotation/keypoints.json` and writes `alignment/alignment.json`.
///
/// The cameras' poses are the phone's (refined ones of an earlier bundle adjustment are taken back), as exact where the clicks of all frames agree to within their noise, and
/// else as drifted by about [`PnpOptions::drift_mm`] each. Wrong clicks are left out and named in
/// the warnings. Results of later stages that an earlier run left behind in `alignment/` are removed.
///
/// # Errors
/// The file is missing, malformed, names a frame that is not there or a pixel outside the photograph, or its points
/// determine no pose (too few, on one line, mirrored, ambiguous, contradictory); nothing is written then.
pub fn align_keypoints(
    sequence: &Sequence,
    options: &KeypointOptions,
    progress: &dyn Progress,
) -> Result<KeypointSummary> {
    let path = sequence.root().join(Keypoints::FILE);
    if !path.exists() {
        return Err(InputError::new(path, "the sequence has no clicked points")
            .help("Click 10 to 20 points in `mobilebrick studio`, or write the file by hand (docs/formats.md)")
            .into());
    }
    let steps = Steps::new(progress, "pose from keypoints", 1);
    let keypoints = Keypoints::read(&path)?;
    check(&path, &keypoints, sequence)?;

    let mut ids: Vec<FrameId> = keypoints.keypoints.iter().map(|k| k.frame).collect();
    ids.sort_unstable();
    ids.dedup();
    let phone = phone_frames(sequence)?;
    let cameras: Vec<PosedCamera> = phone
        .iter()
        .filter(|f| ids.binary_search(&f.id).is_ok())
        .map(|f| PosedCamera { intrinsics: f.intrinsics, world_from_cam: f.world_from_cam })
        .collect();
    let correspondences: Vec<Correspondence> = keypoints
        .keypoints
        .iter()
        .map(|k| Correspondence {
            camera_idx: ids.partition_point(|id| *id < k.frame),
            pixel: k.pixel,
            point_in_object: k.point_in_object_m,
        })
        .collect();
    let found = estimate(&cameras, &correspondences, &options.pnp);
    // Clicks that agree with exact cameras also agree about the size; other failures are about how the points lie.
    let size_matters = match &found {
        Ok((_, drifted)) => *drifted,
        Err(e) => matches!(e, PnpError::NoAgreement { .. } | PnpError::Behind { .. }),
    };
    let size = size_matters.then(|| wrong_size(&cameras, &correspondences, &options.pnp)).flatten();
    let beyond_drift = size.filter(|factor| found.is_err() || factor.max(1.0 / factor) > BEYOND_DRIFT);
    if let Some(factor) = beyond_drift {
        let found = format!("the clicks fit a model {factor:.3} times as large as point_in_object_m says");
        return Err(InputError::new(path, found)
            .help("Lengths are metres in point_in_object_m, model/mesh.ply and pose/: 1 LDraw unit is 0.0004 m")
            .into());
    }
    let (mut estimate, drifted) = found.map_err(|e| explain(&path, &e))?;
    let is_drawn_upright = draw_upright(&mut estimate);

    let written = begin_stage(sequence)?;
    put_phone_cameras_back(sequence, &phone)?;
    Alignment {
        version: 1,
        stage: AlignmentStage::Keypoints,
        world_from_object: estimate.world_from_object,
        object_covariance: Some(rows(&estimate.covariance)),
        rms_px: Some(estimate.rms_px),
        frames: Vec::new(),
    }
    .write(&written)?;
    steps.step()?;
    let mut summary = summary(&keypoints, &estimate, ids.len(), [drifted, is_drawn_upright], written);
    if let Some(factor) = size {
        summary.warnings.push(format!(
            "the clicks agree better with a model {factor:.3} times as large: check the units of the model and of the phone's poses"
        ));
    }
    Ok(summary)
}

/// The pose with the cameras' relative poses taken as exact where the clicks bear that out, else as drifted; and which.
fn estimate(
    cameras: &[PosedCamera],
    correspondences: &[Correspondence],
    options: &PnpOptions,
) -> Result<(PoseEstimate, bool), PnpError> {
    // What no pose explains with exact cameras is no matter of drift.
    let exact =
        estimate_pose(cameras, correspondences, &PnpOptions { drift_deg: 0.0, drift_mm: 0.0, ..options.clone() })?;
    // Residual lengths of right clicks have a root mean square of the noise times the root of 2.
    let noise_rms_px = std::f64::consts::SQRT_2 * options.click_noise_px;
    let agreeing = exact.inliers.iter().filter(|i| **i).count();
    // A frame most of whose clicks are left out has drifted: a person does not click one photograph wrong throughout.
    let lost = (0..cameras.len()).any(|camera| {
        let clicks = correspondences.iter().zip(&exact.inliers).filter(|(c, _)| c.camera_idx == camera);
        let (agree, differ): (Vec<_>, Vec<_>) = clicks.partition(|(_, inlier)| **inlier);
        differ.len() >= 2 && differ.len() > agree.len()
    });
    let bears_out = exact.rms_px <= 1.5 * noise_rms_px && 4 * agreeing >= 3 * correspondences.len() && !lost;
    if bears_out || cameras.len() < 2 || options.drift_deg <= 0.0 || options.drift_mm <= 0.0 {
        return Ok((exact, false));
    }
    match estimate_pose(cameras, correspondences, options) {
        Ok(drifted) => Ok((drifted, true)),
        Err(_) => Ok((exact, false)),
    }
}

/// Standard deviation of the tilt of a model on a table in a world aligned with gravity, radians: one degree.
const UPRIGHT_RAD: f64 = std::f64::consts::PI / 180.0;

/// Where the tilt may be chance, weighs it against [`UPRIGHT_RAD`] (the update of a Kalman filter) and returns `true`. Clicks on a
/// small object say little of its tilt, and gravity says much.
fn draw_upright(estimate: &mut PoseEstimate) -> bool {
    let up = estimate.world_from_object.rotate(&Vector3::y());
    // The rotation about the world's x and z that would bring it upright.
    let tilt = Vector2::new(-up.z, up.x);
    let mut by_motion = Matrix2x6::zeros();
    (by_motion[(0, 0)], by_motion[(1, 2)]) = (1.0, 1.0);
    let covariance = estimate.covariance;
    let spread = by_motion * covariance * by_motion.transpose() + Matrix2::identity() * UPRIGHT_RAD.powi(2);
    let Some(information) = spread.try_inverse() else { return false };
    if up.y <= 0.0 || (tilt.transpose() * information * tilt)[0] > 9.0 {
        return false;
    }
    let gain = covariance * by_motion.transpose() * information;
    estimate.world_from_object = Rigid3::exp(&(gain * tilt)) * estimate.world_from_object;
    let kept = Matrix6::identity() - gain * by_motion;
    // Joseph's form stays symmetric and positive.
    estimate.covariance = kept * covariance * kept.transpose() + gain * gain.transpose() * UPRIGHT_RAD.powi(2);
    estimate.rotation_std_rad = estimate.covariance.fixed_view::<3, 3>(0, 0).trace().sqrt();
    true
}

/// Refuses what no annotator can have clicked.
fn check(path: &Path, keypoints: &Keypoints, sequence: &Sequence) -> Result<()> {
    if keypoints.version != 1 {
        let found = format!("version {} of the keypoint file, this program reads version 1", keypoints.version);
        return Err(Error::input(path, found));
    }
    let size = sequence.image_size();
    for (i, k) in keypoints.keypoints.iter().enumerate() {
        let wrong = |found: String, help: &str| -> Result<()> {
            let place = format!("keypoint {i} (frame {})", k.frame);
            Err(InputError::new(path, found).at(place).help(help).into())
        };
        if sequence.frame(k.frame).is_none() {
            return wrong("the sequence has no such frame".to_owned(), "Remove the point or add the frame");
        }
        let inside = |v: f64, count: usize| v >= -0.5 && v <= count as f64 - 0.5;
        if !(inside(k.pixel.x, size.width) && inside(k.pixel.y, size.height)) {
            let found = format!("pixel ({}, {}) lies outside the photograph of {size}", k.pixel.x, k.pixel.y);
            return wrong(found, "Pixels are (x, y) of the photograph in sensor orientation, as it lies in image/");
        }
        let far = k.point_in_object_m.coords.amax();
        // No brick model is ten metres across; a nominal one in millimetres or LDraw units is.
        if !far.is_finite() || far > 10.0 {
            let found = format!("a coordinate of the 3D point is {far}");
            return wrong(found, "point_in_object_m is in metres in the object's frame (1 LDraw unit = 0.0004 m)");
        }
    }
    Ok(())
}

/// A size that differs by more than this factor is no matter of drifting poses.
const BEYOND_DRIFT: f64 = 1.1;

/// What the model's lengths must be multiplied by, where the clicks say clearly that its size is wrong.
fn wrong_size(cameras: &[PosedCamera], correspondences: &[Correspondence], options: &PnpOptions) -> Option<f64> {
    /// Half the clicks lie this much closer, and the size differs by more than drifting poses feign.
    const CLEARLY: f64 = 0.5;
    const LEAST: f64 = 1.04;
    let fit = fitting_scale(cameras, correspondences)?;
    // The best of many sizes always fits a little better than the model's own; drift adds several pixels to both.
    let fits = fit.median_px < CLEARLY * fit.own_median_px && fit.own_median_px > 2.0 * options.click_noise_px;
    (fits && fit.factor.max(1.0 / fit.factor) > LEAST).then_some(fit.factor)
}

/// A pose failure as bad input, with what to do.
fn explain(path: &Path, error: &PnpError) -> Error {
    let help = match error {
        PnpError::TooFew { .. } => "Click more points, best 10 to 20 over three or more frames",
        PnpError::Collinear { .. } => "Click points off that line",
        PnpError::Behind { .. } => {
            "Check that pose/ holds camera-to-world matrices with OpenCV axes (z forward), and that the frames are right"
        }
        PnpError::Mirrored { .. } => {
            "One axis of point_in_object_m has the wrong sign: the object frame is y up, LDraw's is -y up"
        }
        PnpError::Ambiguous { .. } => "Click points off the plane, or in a frame seen from another side",
        PnpError::NoAgreement { .. } => {
            "Check the scale (metres) and frame of point_in_object_m, the frame numbers, and that x comes before y in pixel"
        }
    };
    InputError::new(path, error.to_string()).help(help).into()
}

fn summary(
    keypoints: &Keypoints,
    estimate: &PoseEstimate,
    frames: usize,
    [poses_drifted, drawn_upright]: [bool; 2],
    written: PathBuf,
) -> KeypointSummary {
    let residuals: Vec<KeypointResidual> = keypoints
        .keypoints
        .iter()
        .enumerate()
        .map(|(index, k)| {
            let residual = estimate.residuals_px[index];
            KeypointResidual {
                index,
                name: k.name.clone(),
                frame: k.frame,
                pixel: k.pixel,
                predicted: residual.map(|r| k.pixel - r),
                residual_px: residual.map(|r| r.norm()),
                inlier: estimate.inliers[index],
            }
        })
        .collect();
    let points = residuals.len();
    let inliers = residuals.iter().filter(|r| r.inlier).count();
    let mut warnings: Vec<String> = residuals.iter().filter(|r| !r.inlier).map(|r| wrong_click(r, estimate)).collect();
    match estimate.layout {
        PointLayout::Solid => {}
        PointLayout::NearlyCoplanar => warnings
            .push("the 3D points are nearly coplanar: points off that plane would make the pose firmer".to_owned()),
        PointLayout::Coplanar => {
            warnings.push("the 3D points are coplanar: points off that plane would make the pose firmer".to_owned());
        }
    }
    if points < 6 {
        warnings.push(format!("{points} points are too few to find a wrong click; 6 or more are needed"));
    }
    let (rotation_std_deg, translation_std_mm) =
        (estimate.rotation_std_rad.to_degrees(), estimate.centroid_std_m * 1e3);
    if rotation_std_deg > 2.0 || translation_std_mm > 10.0 {
        warnings.push(format!(
            "the pose is uncertain by {rotation_std_deg:.1} deg and {translation_std_mm:.1} mm: add points in other frames"
        ));
    }
    KeypointSummary {
        points,
        frames,
        inliers,
        world_from_object: estimate.world_from_object,
        rms_px: estimate.rms_px,
        limit_px: estimate.limit_px,
        residuals,
        covariance: rows(&estimate.covariance),
        rotation_std_deg,
        translation_std_mm,
        condition: estimate.condition,
        layout: estimate.layout,
        poses_drifted,
        drawn_upright,
        written,
        warnings,
    }
}

fn wrong_click(r: &KeypointResidual, estimate: &PoseEstimate) -> String {
    let name = if r.name.is_empty() { String::new() } else { format!(" '{}'", r.name) };
    let why = match r.residual_px {
        Some(px) => format!("is {px:.1} px from where the model has it (limit {:.1} px)", estimate.limit_px),
        None => "lies behind the camera".to_owned(),
    };
    format!("keypoint {}{name} in frame {} {why}: a wrong click, left out", r.index, r.frame)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::UnitQuaternion;

    fn tilted(degrees: f64, std_deg: f64) -> PoseEstimate {
        let rotation = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), degrees.to_radians())
            * UnitQuaternion::from_axis_angle(&Vector3::y_axis(), 0.8);
        let mut covariance = Matrix6::identity() * 1e-6;
        covariance.fixed_view_mut::<3, 3>(0, 0).fill_with_identity();
        covariance.fixed_view_mut::<3, 3>(0, 0).scale_mut(std_deg.to_radians().powi(2));
        PoseEstimate {
            world_from_object: Rigid3::from_parts(rotation, Vector3::new(0.3, -0.2, 0.5)),
            covariance,
            rotation_std_rad: 3f64.sqrt() * std_deg.to_radians(),
            centroid_std_m: 1e-3,
            condition: 1.0,
            residuals_px: Vec::new(),
            inliers: Vec::new(),
            limit_px: 1.0,
            rms_px: 1.0,
            layout: PointLayout::Solid,
        }
    }

    fn tilt_deg(estimate: &PoseEstimate) -> f64 {
        estimate.world_from_object.rotate(&Vector3::y()).angle(&Vector3::y()).to_degrees()
    }

    #[test]
    fn a_tilt_that_may_be_chance_is_weighed_against_gravity() {
        // Equal trust in clicks and table: half of it goes, and the turn about the vertical stays.
        let mut estimate = tilted(1.0, 1.0);
        assert!(draw_upright(&mut estimate));
        assert!((tilt_deg(&estimate) - 0.5).abs() < 1e-3, "{}", tilt_deg(&estimate));
        let x = estimate.world_from_object.rotate(&Vector3::x());
        assert!(((-x.z).atan2(x.x) - 0.8).abs() < 1e-3);
        let variances = estimate.covariance.diagonal().map(|v| v.sqrt().to_degrees());
        assert!((variances[0] - 0.5f64.sqrt()).abs() < 1e-9 && (variances[1] - 1.0).abs() < 1e-9);

        // Good clicks are believed.
        let mut estimate = tilted(1.0, 0.05);
        assert!(draw_upright(&mut estimate));
        assert!(tilt_deg(&estimate) > 0.99);
    }

    #[test]
    fn a_model_that_leans_or_lies_stays_as_clicked() {
        for degrees in [6.0, 90.0, 180.0] {
            let mut estimate = tilted(degrees, 1.0);
            let before = estimate.clone();
            assert!(!draw_upright(&mut estimate));
            assert_eq!(estimate, before);
        }
    }
}
