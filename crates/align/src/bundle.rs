//! `align bundle`: every camera, with the model as the map.

use std::path::PathBuf;

use mb_capture::{
    Alignment, AlignmentStage, Frame, FrameAlignment, FrameId, Sequence, write_intrinsics_txt, write_pose_txt,
};
use mb_geometry::{Camera, Object, Ray, Rigid3, World};
use mb_job::{Error, Progress, Result, Steps, write_atomic};
use mb_mesh::{Bvh, TriangleMesh, read_mesh};
use mb_render::{Scene, View};
use nalgebra::{Matrix6, Point3, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::adjust::{AdjustedCamera, AdjustedPoint, Adjustment, CameraTerm, PointObservation};
use crate::contour::{ContourFit, ContourFrame, DriftPrior};
use crate::features::{FeatureOptions, detect_features};
use crate::model_edges::{ModelEdges, view_at};
use crate::outcome::FrameOutcome;
use crate::output::{BUNDLE, begin_stage, keep_phone_cameras, keeps_phone_intrinsics, phone_frames, rows};
use crate::pnp::about_origin;
use crate::profile::Pyramid;
use crate::tracks::{FeatureRef, TrackFrame, TrackOptions, find_tracks, triangulate};

/// How `align_bundle` works. The switches turn single terms off, to measure what each is worth.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BundleOptions {
    /// Features kept of each photograph.
    pub features: usize,
    /// Frames that each frame is matched with.
    pub partners: usize,
    /// Whether features on the model, held to its surface, take part.
    pub surface_points: bool,
    /// Whether features beside the model take part as free points.
    pub free_points: bool,
    /// Whether the model's edges in the photographs take part.
    pub contours: bool,
    /// Whether the change of drift between neighbouring frames is held small.
    pub relative_poses: bool,
    /// Whether each frame's focal length is estimated: for cameras whose intrinsics are not those of every frame.
    pub focal: bool,
    /// Times that points are lifted anew, edges looked for anew, and wrong matches sorted out anew, at least 1.
    pub rounds: usize,
    /// Edge samples used of each photograph.
    pub edge_samples: usize,
    /// Standard deviation of a feature's place, pixels, above 0.
    pub feature_px: f64,
    /// Standard deviation of a phone pose's rotation about the object, degrees, above 0.
    pub drift_deg: f64,
    /// Standard deviation of a phone pose's shift of the object, millimetres, above 0.
    pub drift_mm: f64,
    /// Seed of the choice of edge samples.
    pub seed: u64,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self {
            features: 2500,
            partners: 6,
            surface_points: true,
            free_points: true,
            contours: true,
            relative_poses: true,
            focal: false,
            rounds: 3,
            edge_samples: 800,
            feature_px: 0.7,
            drift_deg: 0.6,
            drift_mm: 4.5,
            seed: 0,
        }
    }
}

/// What came out, for people and programs; also written as `alignment/bundle.json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BundleSummary {
    /// Tracks on the model's surface that the cameras were computed from.
    pub surface_points: usize,
    /// Tracks beside the model that the cameras were computed from.
    pub free_points: usize,
    /// Places in photographs that took part.
    pub observations: usize,
    /// Their root mean square residual, pixels.
    pub rms_px: f64,
    /// What was left out, and why.
    pub dropped: Dropped,
    /// Every frame.
    pub frames: Vec<BundledFrame>,
    /// Root mean square change of the cameras' positions from where the phone had them, millimetres.
    pub moved_rms_mm: f64,
    /// Files and folders written.
    pub written: Vec<PathBuf>,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

/// What a bundle adjustment left out.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Dropped {
    /// Tracks that held two features of one frame.
    pub torn_tracks: usize,
    /// Observations whose point on the model lies over 2 cm from the rest of their track.
    pub apart_over_2_cm: usize,
    /// Tracks beside the model whose rays do not meet at a firm point.
    pub not_triangulated: usize,
    /// Observations too far from where the point appears in the end.
    pub large_residual: usize,
}

/// One frame of a bundle adjustment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BundledFrame {
    /// Which frame.
    pub frame: FrameId,
    /// What became of it.
    pub outcome: FrameOutcome,
    /// Features that took part.
    pub observations: usize,
    /// Their root mean square residual, pixels; `None` without any.
    pub rms_px: Option<f64>,
    /// Share of the model's visible edges found; `None` where contours take no part.
    pub edge_agreement: Option<f64>,
    /// How far the camera moved from where the phone had it, millimetres.
    pub moved_mm: f64,
    /// Standard deviation of the camera's position given the object, millimetres.
    pub position_std_mm: f64,
    /// Focal length over the phone's; 1 where it was not estimated.
    pub focal_ratio: f64,
}

/// Matches whose points on the model are further apart are wrong (Li et al. 2023, section 3.3), metres.
const APART_M: f64 = 0.02;
/// How far a point may lie off the model's surface (play of bricks, error of the pose), standard deviation in metres.
const SURFACE_M: f64 = 3e-4;
/// Residual beyond which an observation is left out, pixels, by round; the last repeats.
const LIMITS_PX: [f64; 3] = [12.0, 4.0, 3.0];
/// Standard deviation of a focal length that is not known of each frame, as a share: autofocus moves it by this much.
const FOCAL: f64 = 0.01;
/// Distance across an edge within which the photograph's edge is the model's, pixels.
const EDGE_LIMIT_PX: f64 = 2.5;
/// Features below which a frame hangs by its edges and neighbours alone.
const FEW: usize = 20;
/// Features below which a frame's own say nothing.
const LEAST: usize = 6;
/// Share of the model's edges below which those found are there by chance.
const FEW_EDGES: f64 = 0.3;
/// Share of the model's edges that determines a camera by itself.
const MANY_EDGES: f64 = 0.5;

/// Refines every camera of an aligned sequence, with the object's pose held.
///
/// Features are matched where the poses and the model's depth put them. Those on the model are lifted onto it and stay
/// on its surface; those beside it are triangulated as free points; the model's edges are terms of their own; the phone's
/// poses are priors, absolute and from frame to frame. Everything is minimised together, robustly, in rounds. Writes
/// `alignment/alignment.json`, `alignment/bundle.json`, and the cameras to `pose/`; the phone's own are kept in
/// `pose_arkit/`, and are what a later run starts its priors from.
///
/// # Errors
/// There is no alignment, model mesh or photograph to work from; a file cannot be written; or the system has no unique
/// solution ([`Error::Failed`]).
pub fn align_bundle(sequence: &Sequence, options: &BundleOptions, progress: &dyn Progress) -> Result<BundleSummary> {
    let start = sequence.read_alignment()?;
    let mesh = read_mesh(sequence.model_mesh_path())?;
    let world_from_object = start.world_from_object;
    let frames = sequence.aligned_frames(&start);
    if frames.iter().all(|f| f.image.is_none()) {
        return Err(Error::input(sequence.root().join("image"), "no photographs to find the model in"));
    }
    let phone = phone_frames(sequence)?;

    let steps = Steps::new(progress, "bundle adjustment", frames.len() + options.rounds.max(1) + 2);
    let mut edges = ModelEdges::new(&mesh, options.seed);
    let size = sequence.image_size();
    let view = |f: &Frame, level: usize| {
        view_at(&f.intrinsics, size, &(f.world_from_cam.inverse() * world_from_object), level)
    };
    edges.keep_visible(&frames.iter().map(|f| view(f, 1)).collect::<Vec<_>>());
    let read: Vec<Result<(TrackFrame, ContourFrame)>> = frames
        .par_iter()
        .zip(&phone)
        .map(|(frame, phone)| {
            // A frame without a photograph is one that shows nothing.
            let image = if frame.image.is_some() {
                sequence.read_image(frame)?
            } else {
                mb_image::Image::filled(size, [0u8; 3])
            };
            let features = detect_features(
                &image,
                // Small photographs have few features unless they are enlarged.
                &FeatureOptions {
                    upsample: size.pixels() < 2_000_000,
                    most: options.features,
                    ..FeatureOptions::default()
                },
            );
            let track = TrackFrame {
                intrinsics: frame.intrinsics,
                size,
                world_from_cam: frame.world_from_cam,
                features,
                model_depth: mb_image::Image::filled(size, 0.0),
            };
            let contour = ContourFrame {
                intrinsics: frame.intrinsics,
                size,
                cam_from_world: phone.world_from_cam.inverse(),
                drift: phone.world_from_cam * frame.world_from_cam.inverse(),
                pyramid: Pyramid::new(image, 0),
            };
            steps.step()?;
            Ok((track, contour))
        })
        .collect();
    let (mut tracked, contours): (Vec<TrackFrame>, Vec<ContourFrame>) =
        read.into_iter().collect::<Result<Vec<_>>>()?.into_iter().unzip();
    let prior = DriftPrior { rotation_rad: options.drift_deg.to_radians(), translation_m: options.drift_mm * 1e-3 };
    let mut fit = ContourFit {
        edges: &edges,
        frames: contours,
        world_from_object,
        log_scale: 0.0,
        scale_information: f64::INFINITY,
        prior,
        samples: options.edge_samples,
    };

    let model = Map { scene: Scene::new(&mesh), bvh: Bvh::new(&mesh), mesh: &mesh, world_from_object };
    model.render(&mut tracked);
    let matching = TrackOptions { partners: options.partners, max_angle_rad: 0.7, radius_px: 12.0, ratio: 0.8 };
    let (tracks, torn_tracks) = find_tracks(&tracked, &matching);
    steps.step()?;

    let information = fit.prior_information();
    // A random walk that grows to the drift's size over the sequence.
    let step_information =
        if options.relative_poses { information * (0.5 * frames.len() as f64) } else { Matrix6::zeros() };
    let mut adjustment = Adjustment {
        cameras: fit
            .frames
            .iter()
            .zip(&phone)
            .map(|(f, phone)| AdjustedCamera {
                intrinsics: phone.intrinsics,
                cam_from_world: f.cam_from_world,
                drift: f.drift,
                log_focal: 0.0,
            })
            .collect(),
        points: Vec::new(),
        center: fit.center(),
        feature_px: options.feature_px,
        surface_m: SURFACE_M,
        drift_information: information,
        step_information,
        focal_information: if options.focal { FOCAL.powi(-2) } else { f64::INFINITY },
    };
    let mut dropped = Dropped::default();
    let mut covariances = None;
    let mut edge_agreement = Vec::new();
    for round in 0..options.rounds.max(1) {
        if round > 0 {
            model.render(&mut tracked);
        }
        dropped = Dropped { torn_tracks, ..Dropped::default() };
        adjustment.points = model.points(&tracked, &tracks, options, &mut dropped);
        sort_out(&mut adjustment, LIMITS_PX[round.min(LIMITS_PX.len() - 1)], &mut dropped);
        let terms: Vec<CameraTerm> = if options.contours {
            let observed = fit.observe(0, 5);
            edge_agreement = fit.frame_statistics(&observed, EDGE_LIMIT_PX).iter().map(|s| s.0).collect();
            fit.frame_terms(&observed, EDGE_LIMIT_PX)
        } else {
            Vec::new()
        };
        covariances = adjustment.solve(&terms, 10);
        for ((camera, frame), track) in adjustment.cameras.iter().zip(&mut fit.frames).zip(&mut tracked) {
            frame.drift = camera.drift;
            (frame.intrinsics, track.intrinsics) = (camera.adjusted_intrinsics(), camera.adjusted_intrinsics());
            track.world_from_cam = camera.adjusted_cam_from_world().inverse();
        }
        steps.step()?;
    }
    let covariances = covariances.ok_or_else(|| {
        Error::Failed("the cameras are not determined: too few features and edges in common".to_owned())
    })?;
    let covariances: Vec<Matrix6<f64>> = covariances.into_iter().map(|c| c * COMMON_ERRORS.powi(2)).collect();

    let summary = summarise(sequence, &adjustment, &phone, &covariances, &edge_agreement, dropped);
    write(sequence, &adjustment, &phone, &start, &covariances, &summary)?;
    steps.step()?;
    Ok(summary)
}

/// Frames lie this much farther off than the equations say, which take errors to be independent: 1.6 times in the root mean
/// square of eight simulated captures, between 1.0 and 2.8 times, and much alike in all frames of one.
const COMMON_ERRORS: f64 = 1.6;

/// The aligned model.
struct Map<'a> {
    scene: Scene,
    bvh: Bvh,
    mesh: &'a TriangleMesh,
    world_from_object: Rigid3<World, Object>,
}

impl Map<'_> {
    fn render(&self, frames: &mut [TrackFrame]) {
        for frame in frames {
            let cam_from_frame = frame.world_from_cam.inverse() * self.world_from_object;
            frame.model_depth =
                self.scene.depth(&View { intrinsics: frame.intrinsics, size: frame.size, cam_from_frame });
        }
    }

    /// A point for every track that has one.
    fn points(
        &self,
        frames: &[TrackFrame],
        tracks: &[Vec<FeatureRef>],
        options: &BundleOptions,
        dropped: &mut Dropped,
    ) -> Vec<AdjustedPoint> {
        let mut points = Vec::new();
        for track in tracks {
            let lifted: Vec<(FeatureRef, Point3<f64>)> =
                track.iter().filter_map(|f| Some((*f, frames[f.frame_idx].lift(f.feature_idx)?))).collect();
            let point = if 2 * lifted.len() > track.len() {
                options.surface_points.then(|| self.surface_point(frames, &lifted, dropped)).flatten()
            } else if lifted.is_empty() {
                options.free_points.then(|| free_point(frames, track, dropped)).flatten()
            } else {
                None
            };
            points.extend(point);
        }
        points
    }

    fn surface_point(
        &self,
        frames: &[TrackFrame],
        lifted: &[(FeatureRef, Point3<f64>)],
        dropped: &mut Dropped,
    ) -> Option<AdjustedPoint> {
        let middle = |axis: usize| {
            let mut values: Vec<f64> = lifted.iter().map(|(_, p)| p[axis]).collect();
            values.sort_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let middle = Point3::new(middle(0), middle(1), middle(2));
        let near: Vec<&(FeatureRef, Point3<f64>)> =
            lifted.iter().filter(|(_, p)| (p - middle).norm() <= APART_M).collect();
        dropped.apart_over_2_cm += lifted.len() - near.len();
        if near.len() < 2 {
            return None;
        }
        let mean = near.iter().map(|(_, p)| p.coords).sum::<Vector3<f64>>() / near.len() as f64;
        let closest = self.bvh.closest(&(self.world_from_object.inverse() * Point3::from(mean)))?;
        let normal = self.mesh.scaled_normal(closest.triangle as usize).try_normalize(1e-18)?;
        let on_surface = self.world_from_object * closest.point;
        let observations = near.iter().map(|(f, _)| observation(frames, *f)).collect();
        let surface = Some((on_surface, self.world_from_object.rotate(&normal)));
        Some(AdjustedPoint { in_world: on_surface, surface, observations })
    }
}

fn free_point(frames: &[TrackFrame], track: &[FeatureRef], dropped: &mut Dropped) -> Option<AdjustedPoint> {
    let rays: Vec<(Point3<f64>, Vector3<f64>)> = track
        .iter()
        .map(|f| {
            let frame = &frames[f.frame_idx];
            let Ray { origin, direction } =
                frame.intrinsics.ray(&frame.features[f.feature_idx].pixel, &frame.world_from_cam);
            (origin, direction)
        })
        .collect();
    let Some(in_world) = triangulate(&rays) else {
        dropped.not_triangulated += 1;
        return None;
    };
    let observations = track.iter().map(|f| observation(frames, *f)).collect();
    Some(AdjustedPoint { in_world, surface: None, observations })
}

fn observation(frames: &[TrackFrame], f: FeatureRef) -> PointObservation {
    let pixel = frames[f.frame_idx].features[f.feature_idx].pixel;
    PointObservation { camera_idx: f.frame_idx, pixel, is_inlier: true }
}

/// Leaves out observations beyond the limit, and points that fewer than two are left of.
fn sort_out(adjustment: &mut Adjustment, limit_px: f64, dropped: &mut Dropped) {
    let mut points = std::mem::take(&mut adjustment.points);
    for point in &mut points {
        let flags: Vec<bool> = point
            .observations
            .iter()
            .map(|o| adjustment.residual(point, o).is_some_and(|r| r.norm() <= limit_px))
            .collect();
        dropped.large_residual += flags.iter().filter(|f| !**f).count();
        point.observations.iter_mut().zip(flags).for_each(|(o, inlier)| o.is_inlier = inlier);
    }
    points.retain(|p| p.observations.iter().filter(|o| o.is_inlier).count() >= 2);
    adjustment.points = points;
}

fn outcome(observations: usize, edge_agreement: Option<f64>) -> FrameOutcome {
    let edges = edge_agreement.unwrap_or(0.0);
    if edges >= MANY_EDGES || (observations >= FEW && (edge_agreement.is_none() || edges >= FEW_EDGES)) {
        FrameOutcome::Solved
    } else if observations < LEAST && edges < FEW_EDGES {
        FrameOutcome::Unseen
    } else {
        FrameOutcome::Weak
    }
}

fn world_from_cam(camera: &AdjustedCamera) -> Rigid3<World, Camera> {
    camera.adjusted_cam_from_world().inverse()
}

fn summarise(
    sequence: &Sequence,
    adjustment: &Adjustment,
    phone: &[Frame],
    covariances: &[Matrix6<f64>],
    edge_agreement: &[f64],
    dropped: Dropped,
) -> BundleSummary {
    let mut sums = vec![(0usize, 0.0); adjustment.cameras.len()];
    for point in &adjustment.points {
        for o in point.observations.iter().filter(|o| o.is_inlier) {
            if let Some(r) = adjustment.residual(point, o) {
                sums[o.camera_idx].0 += 1;
                sums[o.camera_idx].1 += r.norm_squared();
            }
        }
    }
    let frames: Vec<BundledFrame> = sequence
        .frames()
        .iter()
        .enumerate()
        .map(|(i, frame)| {
            let camera = world_from_cam(&adjustment.cameras[i]);
            let covariance = camera_covariance(&covariances[i], &adjustment.center);
            let position = position_covariance(&covariance, &camera.translation());
            let edge_agreement = edge_agreement.get(i).copied();
            BundledFrame {
                frame: frame.id,
                outcome: outcome(sums[i].0, edge_agreement),
                observations: sums[i].0,
                rms_px: (sums[i].0 > 0).then(|| (sums[i].1 / sums[i].0 as f64).sqrt()),
                edge_agreement,
                moved_mm: (camera.translation() - phone[i].world_from_cam.translation()).norm() * 1e3,
                position_std_mm: position.sqrt() * 1e3,
                focal_ratio: adjustment.cameras[i].log_focal.exp(),
            }
        })
        .collect();
    let (observations, sum_sq) = sums.iter().fold((0, 0.0), |(n, s), (m, t)| (n + m, s + t));
    let n = frames.len() as f64;
    let surface_points = adjustment.points.iter().filter(|p| p.surface.is_some()).count();
    let mut warnings = Vec::new();
    for f in &frames {
        let share = f.edge_agreement.map_or(String::new(), |a| format!(", {:.0} % of the model's edges", 100.0 * a));
        let seen = format!("{} features in common with other frames{share}", f.observations);
        match f.outcome {
            FrameOutcome::Solved => {}
            FrameOutcome::Weak => {
                warnings.push(format!("frame {}: only {seen} (blurred, dark, or did the object move?)", f.frame));
            }
            FrameOutcome::Unseen => warnings
                .push(format!("frame {}: nothing of use ({seen}); its drift is taken from its neighbours", f.frame)),
        }
    }
    let by_edges = frames.iter().filter(|f| f.outcome == FrameOutcome::Solved && f.observations < FEW).count();
    if by_edges > 0 {
        warnings.push(format!(
            "{by_edges} frames have fewer than {FEW} features in common with others: their cameras rest on the model's edges"
        ));
    }
    BundleSummary {
        surface_points,
        free_points: adjustment.points.len() - surface_points,
        observations,
        rms_px: (sum_sq / observations.max(1) as f64).sqrt(),
        dropped,
        moved_rms_mm: (frames.iter().map(|f| f.moved_mm * f.moved_mm).sum::<f64>() / n).sqrt(),
        frames,
        written: ["alignment/alignment.json", "alignment/bundle.json", "pose", "pose_arkit"]
            .map(|p| sequence.root().join(p))
            .to_vec(),
        warnings,
    }
}

/// Covariance of the camera's pose in the world: its drift's, about the world's origin. (The camera moves by the
/// inverse of the drift; to first order that only changes the sign.)
fn camera_covariance(drift: &Matrix6<f64>, center: &Vector3<f64>) -> Matrix6<f64> {
    about_origin(drift, center)
}

/// Trace of the covariance of a point that moves with a left perturbation: `dp = v - p x w`.
fn position_covariance(covariance: &Matrix6<f64>, p: &Vector3<f64>) -> f64 {
    let mut by_twist = nalgebra::Matrix3x6::zeros();
    by_twist.fixed_view_mut::<3, 3>(0, 0).copy_from(&-p.cross_matrix());
    by_twist.fixed_view_mut::<3, 3>(0, 3).fill_with_identity();
    (by_twist * covariance * by_twist.transpose()).trace()
}

/// The phone's poses are kept before any is replaced, and the alignment is written last.
fn write(
    sequence: &Sequence,
    adjustment: &Adjustment,
    phone: &[Frame],
    start: &Alignment,
    covariances: &[Matrix6<f64>],
    summary: &BundleSummary,
) -> Result<()> {
    let focal = adjustment.focal_information.is_finite();
    keep_phone_cameras(sequence, phone, focal)?;
    // An earlier run may have left focal lengths of its own in `intrinsic/`.
    let intrinsics = focal || keeps_phone_intrinsics(sequence);
    let ids = sequence.frames().iter().map(|f| f.id);
    let written = begin_stage(sequence)?;
    for (id, camera) in ids.clone().zip(&adjustment.cameras) {
        let name = format!("{id}.txt");
        write_pose_txt(sequence.root().join("pose").join(&name), &world_from_cam(camera))?;
        if intrinsics {
            write_intrinsics_txt(sequence.root().join("intrinsic").join(&name), &camera.adjusted_intrinsics())?;
        }
    }
    let frames = ids
        .zip(&adjustment.cameras)
        .zip(covariances)
        .zip(&summary.frames)
        .map(|(((frame, camera), covariance), statistics)| FrameAlignment {
            frame,
            world_from_cam: world_from_cam(camera),
            covariance: Some(rows(&camera_covariance(covariance, &adjustment.center))),
            rms_px: statistics.rms_px,
        })
        .collect();
    let json = serde_json::to_vec_pretty(summary).map_err(|e| Error::write(&written, e.into()))?;
    write_atomic(written.with_file_name(BUNDLE), &json)?;
    Alignment {
        version: 1,
        stage: AlignmentStage::Bundle,
        world_from_object: start.world_from_object,
        object_covariance: start.object_covariance,
        rms_px: Some(summary.rms_px),
        frames,
    }
    .write(written)
}
