//! `align refine`: the object's pose, and the phone's drift, from the model's edges in the photographs.

use std::path::PathBuf;

use mb_capture::{Alignment, AlignmentStage, Frame, FrameAlignment, FrameId, Sequence};
use mb_geometry::{Object, Rigid3, World};
use mb_image::RgbImage;
use mb_job::{Error, Progress, Result, Steps};
use mb_mesh::read_mesh;
use nalgebra::{Matrix6, Point2, Vector6};
use serde::{Deserialize, Serialize};

use crate::FrameOutcome;
use crate::contour::{
    Agreement, ContourFit, ContourFrame, DriftPrior, Observed, Uncertainty, motion_about, twist_about,
};
use crate::model_edges::{ModelEdges, view_at};
use crate::output::{OVERLAYS, begin_stage, phone_frames, put_phone_cameras_back, rows};
use crate::pnp::about_origin;
use crate::profile::Pyramid;

/// How `align_refine` works.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RefineOptions {
    /// Photographs used, spread evenly over the sequence, at least 1; 8 or more to be sure of the result.
    pub frames: usize,
    /// Edge samples used of each photograph.
    pub samples: usize,
    /// Standard deviation of a phone pose's rotation about the object, degrees, above 0.
    pub drift_deg: f64,
    /// Standard deviation of a phone pose's shift of the object, millimetres, above 0.
    pub drift_mm: f64,
    /// Confidence below which the result is refused.
    pub least_confidence: f64,
    /// How many photographs are written with the model's edges drawn in.
    pub overlays: usize,
    /// Whether the object's size is estimated too, as the phone measures it: a phone whose metres are not metres, or a
    /// model in other units. The result then has the model's own size, and the cameras keep a matching distance.
    pub scale: bool,
    /// Seed of the choice of samples.
    pub seed: u64,
}

impl Default for RefineOptions {
    fn default() -> Self {
        // A phone's relative poses err by 4.5 mm and 0.6 degrees (Li et al. 2023, table 5).
        Self {
            frames: 24,
            samples: 800,
            drift_deg: 0.6,
            drift_mm: 4.5,
            least_confidence: 0.15,
            overlays: 6,
            scale: false,
            seed: 0,
        }
    }
}

/// What came out, for people and programs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RefineSummary {
    /// The pose.
    pub world_from_object: Rigid3<World, Object>,
    /// How far the object moved from the pose it started at, millimetres.
    pub moved_mm: f64,
    /// How far it turned, degrees.
    pub turned_deg: f64,
    /// Root mean square distance between the model's edges and the photographs', pixels.
    pub rms_px: f64,
    /// Share of the model's visible edges that the photographs show where they should be.
    pub agreement: f64,
    /// The share that would be found by chance.
    pub chance_agreement: f64,
    /// 0 = no better than chance, 1 = every edge found.
    pub confidence: f64,
    /// Expected error of the object's position as each camera sees it, root mean square, millimetres.
    pub expected_error_mm: f64,
    /// Expected error of its rotation as each camera sees it, degrees.
    pub expected_error_deg: f64,
    /// Size of the object as the phone measures it over the model's: 1 where both are right.
    pub scale: f64,
    /// Its standard deviation, as far as drifts are independent.
    pub scale_std: f64,
    /// Covariance of the object's pose in the world, left perturbation, `[rotation; translation]` (rad, m). Larger than
    /// the errors above: the world itself is only known as well as the phone's drift allows.
    pub covariance: [[f64; 6]; 6],
    /// Every photograph used.
    pub frames: Vec<RefinedFrame>,
    /// Files written.
    pub written: Vec<PathBuf>,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

/// One photograph of a refinement.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RefinedFrame {
    /// Which frame.
    pub frame: FrameId,
    /// What became of it.
    pub outcome: FrameOutcome,
    /// Share of the model's visible edges found in it.
    pub agreement: f64,
    /// Root mean square distance to them, pixels.
    pub rms_px: f64,
    /// How far the phone's pose had drifted, as a shift of the object, millimetres.
    pub drift_mm: f64,
    /// The same as a turn, degrees.
    pub drift_deg: f64,
}

/// Distance across an edge, in pixels, within which the photograph's edge counts as the model's.
const AGREES_PX: f64 = 2.0;

/// Refines an existing alignment by the model's edges.
///
/// Edges of `model/mesh.ply` that a rendering shows (creases, borders of colours, contours) are looked for in the
/// photographs across their direction, each with up to four candidates, from an eighth of the photographs' size up to
/// all of it. The object's pose and one small motion per frame are fitted together; the phone's poses are a prior of
/// the size of their drift. Frames that were not used take the drift between their neighbours'. Writes
/// `alignment/alignment.json` and pictures under `alignment/overlays/`.
///
/// # Errors
/// There is no alignment to start from, no model mesh or no photograph; or the model's edges cannot be found in the
/// photographs ([`Error::Failed`]; the earlier alignment stays).
pub fn align_refine(sequence: &Sequence, options: &RefineOptions, progress: &dyn Progress) -> Result<RefineSummary> {
    let start = sequence.read_alignment()?;
    let mesh = read_mesh(sequence.model_mesh_path())?;
    let phone = phone_frames(sequence)?;
    let chosen = choose(sequence, &phone, options.frames)?;
    let size = sequence.image_size();
    let coarsest = coarsest_level(size.width.min(size.height));

    let steps = Steps::new(progress, "contour refinement", chosen.len() + LEVELS);
    let mut edges = ModelEdges::new(&mesh, options.seed);
    let views: Vec<_> = chosen
        .iter()
        .map(|f| view_at(&f.intrinsics, size, &(f.world_from_cam.inverse() * start.world_from_object), 1))
        .collect();
    edges.keep_visible(&views);
    let mut frames = Vec::with_capacity(chosen.len());
    for frame in &chosen {
        frames.push(ContourFrame {
            intrinsics: frame.intrinsics,
            size,
            cam_from_world: frame.world_from_cam.inverse(),
            drift: Rigid3::identity(),
            pyramid: Pyramid::new(sequence.read_image(frame)?, coarsest),
        });
        steps.step()?;
    }
    let mut fit = ContourFit {
        edges: &edges,
        frames,
        world_from_object: start.world_from_object,
        log_scale: 0.0,
        // A few per cent of play keep the first steps from running away.
        scale_information: if options.scale { 0.1f64.powi(-2) } else { f64::INFINITY },
        prior: DriftPrior { rotation_rad: options.drift_deg.to_radians(), translation_m: options.drift_mm * 1e-3 },
        samples: options.samples,
    };
    coarse_to_fine(&mut fit, coarsest, &steps)?;

    let agreements = fit.agreement(0, AGREES_PX);
    let whole = Agreement::of_all(&agreements);
    let (confidence, agreement) = (whole.confidence(), whole.share());
    let observed = fit.observe(0, 4);
    let uncertainty = fit.uncertainty(&observed, AGREES_PX).zip(fit.log_scale_found(&observed, AGREES_PX));
    let Some((uncertainty, (log_scale, scale_std))) = uncertainty.filter(|_| confidence >= options.least_confidence)
    else {
        return Err(Error::Failed(format!(
            "the model's edges were not found in the photographs: {:.0} % agree, {:.0} % would by chance. Check that the \
             model is the one photographed, that its size is right (metres), and that the keypoints are right; the \
             earlier alignment was kept",
            100.0 * agreement,
            100.0 * whole.chance()
        )));
    };
    let written = begin_stage(sequence)?;
    put_phone_cameras_back(sequence, &phone)?;
    let mut outputs = write_overlays(sequence, &chosen, &fit, &observed, options.overlays)?;
    let statistics = fit.frame_statistics(&observed, AGREES_PX);
    let outcomes: Vec<FrameOutcome> = agreements.iter().map(|a| outcome(a, &whole)).collect();
    let drifts: Vec<Vector6<f64>> =
        fit.frames.iter().map(|f| twist_about(&fit.drift_at_true_size(f), &fit.center())).collect();
    let found = Found { chosen: &chosen, fit: &fit, drifts: &drifts, outcomes: &outcomes, statistics: &statistics };
    let alignment = found.alignment(&phone, &uncertainty);
    alignment.write(&written)?;
    outputs.insert(0, written);
    steps.step()?;

    let frames = found.frames();
    let mut warnings = found.warnings();
    let scale = log_scale.exp();
    if log_scale.abs() > LEAST_SCALE.max(4.0 * scale_std) {
        let size = if log_scale > 0.0 { "larger" } else { "smaller" };
        warnings.push(format!(
            "the object is {:.1} % {size} than the model, as the phone measures it: check the units of the model and of the \
             phone's poses",
            100.0 * (scale - 1.0).abs()
        ));
    }
    let n = uncertainty.object_in_cam.len() as f64;
    let mean_trace =
        |at: usize| uncertainty.object_in_cam.iter().map(|c| c.fixed_view::<3, 3>(at, at).trace()).sum::<f64>() / n;
    let (expected_error_mm, expected_error_deg) = (mean_trace(3).sqrt() * 1e3, mean_trace(0).sqrt().to_degrees());
    if confidence < 2.0 * options.least_confidence || expected_error_mm > 1.0 {
        warnings.push(format!(
            "the result is uncertain (confidence {confidence:.2}, expected error {expected_error_mm:.2} mm): look at \
             alignment/overlays"
        ));
    }
    if chosen.len() < 8 {
        warnings.push(format!("{} photographs were used; 8 or more make the result firm", chosen.len()));
    }
    let change = start.world_from_object.inverse() * fit.world_from_object;
    let center = edges.centroid_in_object;
    Ok(RefineSummary {
        world_from_object: fit.world_from_object,
        moved_mm: (change * center - center).norm() * 1e3,
        turned_deg: change.angle_rad().to_degrees(),
        rms_px: alignment.rms_px.unwrap_or(f64::NAN),
        agreement,
        chance_agreement: whole.chance(),
        confidence,
        expected_error_mm,
        expected_error_deg,
        scale,
        scale_std,
        covariance: alignment.object_covariance.unwrap_or_default(),
        frames,
        written: outputs,
        warnings,
    })
}

/// A size that differs by less is within what phones and bricks do.
const LEAST_SCALE: f64 = 0.015;
/// Drifts of neighbouring photographs that differ by more are no drift: a phone that finds its place again takes back a
/// few millimetres (Li et al. 2023 have 4.5 mm over whole sequences).
const JUMP_M: f64 = 0.012;
const JUMP_RAD: f64 = 0.045;

/// A frame that shows far fewer of the model's edges than all together do is of little use.
fn outcome(frame: &Agreement, whole: &Agreement) -> FrameOutcome {
    match frame.confidence() / whole.confidence() {
        share if share < 0.25 => FrameOutcome::Unseen,
        share if share < 0.6 => FrameOutcome::Weak,
        _ => FrameOutcome::Solved,
    }
}

/// Everything that was found of the photographs used.
struct Found<'a> {
    chosen: &'a [Frame],
    fit: &'a ContourFit<'a>,
    /// Twists about the object's middle, with the object at the model's size.
    drifts: &'a [Vector6<f64>],
    outcomes: &'a [FrameOutcome],
    /// Share of edges found, and their root mean square distance in pixels.
    statistics: &'a [(f64, f64)],
}

impl Found<'_> {
    fn frames(&self) -> Vec<RefinedFrame> {
        (0..self.chosen.len())
            .map(|i| RefinedFrame {
                frame: self.chosen[i].id,
                outcome: self.outcomes[i],
                agreement: self.statistics[i].0,
                rms_px: self.statistics[i].1,
                drift_mm: self.drifts[i].fixed_rows::<3>(3).norm() * 1e3,
                drift_deg: self.drifts[i].fixed_rows::<3>(0).norm().to_degrees(),
            })
            .collect()
    }

    fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        for (frame, (outcome, (agreement, _))) in self.chosen.iter().zip(self.outcomes.iter().zip(self.statistics)) {
            let share = 100.0 * agreement;
            match outcome {
                FrameOutcome::Solved => {}
                FrameOutcome::Weak => warnings.push(format!(
                    "frame {}: only {share:.0} % of the model's edges were found (blurred, dark, or the object moved?)",
                    frame.id
                )),
                FrameOutcome::Unseen => warnings.push(format!(
                    "frame {}: the model's edges were not found ({share:.0} %); its drift is taken from its neighbours",
                    frame.id
                )),
            }
        }
        let solved: Vec<usize> = (0..self.chosen.len()).filter(|i| self.outcomes[*i] == FrameOutcome::Solved).collect();
        for pair in solved.windows(2) {
            let step = self.drifts[pair[1]] - self.drifts[pair[0]];
            let (turn, shift) = (step.fixed_rows::<3>(0).norm(), step.fixed_rows::<3>(3).norm());
            if shift > JUMP_M || turn > JUMP_RAD {
                warnings.push(format!(
                    "between frames {} and {} the object moved by {:.1} mm and {:.1} deg against the phone's poses: it was \
                     pushed, or the phone lost its place",
                    self.chosen[pair[0]].id,
                    self.chosen[pair[1]].id,
                    shift * 1e3,
                    turn.to_degrees()
                ));
            }
        }
        warnings
    }

    /// The alignment of every frame: those that show the model with their own drift, the others with one between their
    /// neighbours'.
    fn alignment(&self, phone: &[Frame], uncertainty: &Uncertainty) -> Alignment {
        let center = self.fit.center();
        let seen: Vec<usize> = (0..self.chosen.len()).filter(|i| self.outcomes[*i] != FrameOutcome::Unseen).collect();
        let id = |at: usize| self.chosen[seen[at]].id;
        let position = |id: FrameId| phone.partition_point(|f| f.id < id) as f64;
        let frames = phone
            .iter()
            .map(|frame| {
                let next = seen.partition_point(|i| self.chosen[*i].id < frame.id);
                let used = (next < seen.len() && id(next) == frame.id).then(|| seen[next]);
                let twist = if let Some(i) = used {
                    self.drifts[i]
                } else if seen.is_empty() {
                    Vector6::zeros()
                } else if next == 0 || next == seen.len() {
                    self.drifts[seen[next.min(seen.len() - 1)]]
                } else {
                    let (before, after) = (position(id(next - 1)), position(id(next)));
                    let share = (position(frame.id) - before) / (after - before);
                    self.drifts[seen[next - 1]] * (1.0 - share) + self.drifts[seen[next]] * share
                };
                FrameAlignment {
                    frame: frame.id,
                    world_from_cam: motion_about(&twist, &center).inverse() * frame.world_from_cam,
                    covariance: used.map(|i| rows(&about_origin(&uncertainty.frames[i], &center))),
                    rms_px: used.map(|i| self.statistics[i].1),
                }
            })
            .collect();
        let n = seen.len().max(1) as f64;
        let mean_sq = seen.iter().map(|i| self.statistics[*i].1.powi(2)).sum::<f64>() / n;
        let object: Matrix6<f64> = about_origin(&uncertainty.object, &center);
        Alignment {
            version: 1,
            stage: AlignmentStage::Refine,
            world_from_object: self.fit.world_from_object,
            object_covariance: Some(rows(&object)),
            rms_px: Some(mean_sq.sqrt()),
            frames,
        }
    }
}

/// Passes over the pyramid, coarsest first: level below the coarsest, search range in its pixels, repetitions.
const PASSES: [(usize, usize, usize); 4] = [(3, 10, 6), (2, 7, 4), (1, 6, 4), (0, 5, 4)];
const LEVELS: usize = PASSES.len() + 1;

/// The level at which the shorter side is at least 80 pixels, at most 3.
fn coarsest_level(shorter_side: usize) -> usize {
    (0..=3).rev().find(|level| shorter_side >> level >= 80).unwrap_or(0)
}

/// Confidence after the coarsest pass from which the start is taken as good.
const GOOD_START: f64 = 0.35;

/// Where the coarsest pass ends is kept if the edges agree there; else it is repeated from starts around (1 cm along and
/// 4 degrees about each axis), and the one with the best agreement is kept.
fn coarsest_pass(fit: &mut ContourFit, coarsest: usize) {
    let start = fit.world_from_object;
    let mut twists = vec![Vector6::zeros()];
    for axis in 0..6 {
        for sign in [1.0, -1.0] {
            let mut twist = Vector6::zeros();
            twist[axis] = sign * if axis < 3 { 4f64.to_radians() } else { 0.01 };
            twists.push(twist);
        }
    }
    let center = fit.center();
    let mut best = (f64::NEG_INFINITY, start, 0.0, Vec::new());
    for twist in twists {
        fit.world_from_object = motion_about(&twist, &center) * start;
        fit.frames.iter_mut().for_each(|f| f.drift = Rigid3::identity());
        fit.log_scale = 0.0;
        for (level, range_px, repetitions) in PASSES.into_iter().filter(|pass| pass.0 == coarsest) {
            pass(fit, (level, range_px.max(10), repetitions), ContourFit::step);
        }
        let confidence = Agreement::of_all(&fit.agreement(coarsest.saturating_sub(1), AGREES_PX)).confidence();
        if confidence > best.0 {
            best = (confidence, fit.world_from_object, fit.log_scale, fit.frames.iter().map(|f| f.drift).collect());
        }
        if confidence >= GOOD_START {
            break;
        }
    }
    (fit.world_from_object, fit.log_scale) = (best.1, best.2);
    fit.frames.iter_mut().zip(best.3).for_each(|(f, drift)| f.drift = drift);
}

/// How a fit goes towards the observed edges within a limit in pixels.
type Step<'a> = fn(&mut ContourFit<'a>, &Observed, f64) -> bool;

/// One of [`PASSES`].
fn pass<'a>(fit: &mut ContourFit<'a>, (level, range_px, repetitions): (usize, usize, usize), step: Step<'a>) {
    let mut observed = fit.observe(level, range_px);
    for repetition in 0..repetitions {
        if repetition > 0 && repetition % 2 == 0 {
            observed = fit.observe(level, range_px);
        } else if repetition > 0 {
            fit.observe_again(&mut observed, range_px);
        }
        // Far edges count at first, near ones in the end.
        let share = 1.0 - repetition as f64 / repetitions as f64;
        let limit_px = (range_px as f64 * share).max(AGREES_PX);
        for _ in 0..4 {
            step(fit, &observed, limit_px);
        }
    }
}

fn coarse_to_fine(fit: &mut ContourFit, coarsest: usize, steps: &Steps) -> Result<()> {
    coarsest_pass(fit, coarsest);
    for finer in PASSES {
        if finer.0 < coarsest {
            pass(fit, finer, ContourFit::step);
        }
        if finer.0 == 0 && mend_strays(fit, coarsest) {
            pass(fit, finer, ContourFit::step);
        }
        steps.step()?;
    }
    Ok(())
}

/// Fits frames anew that may have taken wrong edges for the model's: rows of bricks look alike. Drift changes slowly, so
/// a frame whose drift is more than the prior's deviation from a neighbour's is fitted again from there, and what shows
/// more of the model's edges stays. Returns whether any frame changed.
fn mend_strays(fit: &mut ContourFit, coarsest: usize) -> bool {
    let count = fit.frames.len();
    // Forwards and backwards: a row of strays is mended from its good neighbour on.
    let pairs = (1..count).map(|i| (i, i - 1)).chain((1..count).rev().map(|i| (i - 1, i)));
    let mut mended = false;
    for (i, neighbour) in pairs {
        let step = fit.drift_twist(&fit.frames[i]) - fit.drift_twist(&fit.frames[neighbour]);
        if step.dot(&(fit.prior_information() * step)) <= 1.0 {
            continue;
        }
        let start = fit.frames[neighbour].drift;
        let mut alone = ContourFit { frames: vec![fit.frames.remove(i)], ..*fit };
        let confidence =
            |alone: &ContourFit| Agreement::of_all(&alone.agreement(coarsest.min(1), AGREES_PX)).confidence();
        let (before, kept) = (confidence(&alone), alone.frames[0].drift);
        alone.frames[0].drift = start;
        for finer in PASSES.into_iter().filter(|pass| pass.0 < coarsest.max(1)) {
            pass(&mut alone, finer, ContourFit::step_drifts);
        }
        if confidence(&alone) > before {
            mended = true;
        } else {
            alone.frames[0].drift = kept;
        }
        fit.frames.extend(alone.frames);
        fit.frames[i..].rotate_right(1);
    }
    mended
}

/// Frames with a photograph, spread evenly, posed as the phone has them.
fn choose(sequence: &Sequence, phone: &[Frame], count: usize) -> Result<Vec<Frame>> {
    let with_image: Vec<&Frame> = phone.iter().filter(|f| f.image.is_some()).collect();
    if with_image.is_empty() {
        return Err(Error::input(sequence.root().join("image"), "no photographs to find the model's edges in"));
    }
    let count = count.clamp(1, with_image.len());
    Ok((0..count).map(|i| with_image[i * with_image.len() / count].clone()).collect())
}

/// Draws the model's edges into photographs: green where the photograph has them, red where not.
fn write_overlays(
    sequence: &Sequence,
    chosen: &[Frame],
    fit: &ContourFit,
    observed: &Observed,
    count: usize,
) -> Result<Vec<PathBuf>> {
    let folder = sequence.root().join("alignment").join(OVERLAYS);
    let count = count.min(chosen.len());
    let mut written = Vec::with_capacity(count);
    for i in (0..count).map(|i| i * chosen.len() / count) {
        let mut picture = fit.frames[i].pyramid.level(0).clone();
        for (pixel, found) in fit.drawn(observed, i, AGREES_PX) {
            dot(&mut picture, &pixel, if found { [0, 255, 80] } else { [255, 40, 40] });
        }
        let path = folder.join(format!("{}.jpg", chosen[i].id));
        mb_image::write_jpeg(&path, &picture, 90)?;
        written.push(path);
    }
    Ok(written)
}

fn dot(picture: &mut RgbImage, pixel: &Point2<f64>, color: [u8; 3]) {
    let size = picture.size();
    let (x, y) = (pixel.x.round(), pixel.y.round());
    if x >= 0.0 && y >= 0.0 && x < size.width as f64 && y < size.height as f64 {
        picture[(x as usize, y as usize)] = color;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::{ImageSize, Intrinsics};
    use mb_image::Image;
    use mb_mesh::TriangleMesh;
    use mb_render::{NO_TRIANGLE, Scene};
    use nalgebra::{Point3, UnitQuaternion, Vector3};

    const ROW_M: f64 = 0.0096;

    /// A wall of rows of bricks in two colours by turns, 10 cm wide and 3 cm deep: two rows higher it looks much the same.
    fn wall(rows: usize) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        let (mut colors, mut parts) = (Vec::new(), Vec::new());
        for row in 0..rows {
            let first = mesh.vertices.len() as u32;
            for i in 0..8 {
                let side = |axis: usize| f64::from(i >> axis & 1);
                mesh.vertices.push(Point3::new(
                    0.1 * side(0) - 0.05,
                    ROW_M * (row as f64 + side(1)),
                    0.03 * side(2) - 0.015,
                ));
            }
            for [a, b, c, d] in [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]] {
                for triangle in [[a, b, c], [a, c, d]] {
                    mesh.triangles.push(triangle.map(|v: u32| v + first));
                    colors.push(if row % 2 == 0 { [190, 30, 30] } else { [220, 190, 40] });
                    parts.push(row as u32);
                }
            }
        }
        TriangleMesh { triangle_colors: Some(colors), triangle_parts: Some(parts), ..mesh }
    }

    #[test]
    fn a_frame_that_took_the_wrong_rows_of_bricks_is_brought_back_from_its_neighbours() {
        let mesh = wall(10);
        let colors = mesh.triangle_colors.as_ref().expect("the wall is coloured");
        let scene = Scene::new(&mesh);
        let (size, k) = (ImageSize::new(480, 360), Intrinsics { fx: 400.0, fy: 400.0, cx: 239.5, cy: 179.5 });
        let mut edges = ModelEdges::new(&mesh, 0);
        let frames: Vec<ContourFrame> = (0..4)
            .map(|i| {
                let angle = 0.5 * f64::from(i) + 0.3;
                let place = Vector3::new(0.3 * angle.cos(), 0.2, 0.3 * angle.sin());
                let towards = Vector3::new(0.0, 0.05, 0.0) - place;
                let rotation = UnitQuaternion::face_towards(&towards, &-Vector3::y());
                let cam_from_world = Rigid3::<World, _>::from_parts(rotation, place).inverse();
                let cam_from_object = cam_from_world * Rigid3::<World, Object>::identity();
                let raster = scene.render(&view_at(&k, size, &cam_from_object, 0));
                let image = Image::from_fn(size, |x, y| match raster.triangle[(x, y)] {
                    NO_TRIANGLE => [120, 130, 140],
                    t => colors[t as usize],
                });
                let pyramid = Pyramid::new(image, 2);
                ContourFrame { intrinsics: k, size, cam_from_world, drift: Rigid3::identity(), pyramid }
            })
            .collect();
        let views: Vec<_> = frames
            .iter()
            .map(|f| view_at(&k, size, &(f.cam_from_world * Rigid3::<World, Object>::identity()), 1))
            .collect();
        edges.keep_visible(&views);
        let mut fit = ContourFit {
            edges: &edges,
            frames,
            world_from_object: Rigid3::identity(),
            log_scale: 0.0,
            scale_information: f64::INFINITY,
            prior: DriftPrior { rotation_rad: 0.01, translation_m: 0.0045 },
            samples: 800,
        };
        assert!(!mend_strays(&mut fit, 2), "nothing has strayed");
        for strays in [vec![2], vec![0, 1]] {
            for &i in &strays {
                fit.frames[i].drift = Rigid3::from_translation(Vector3::new(0.0, 2.0 * ROW_M, 0.0));
            }
            assert!(mend_strays(&mut fit, 2));
            for frame in &fit.frames {
                let shift_mm = fit.drift_twist(frame).fixed_rows::<3>(3).norm() * 1e3;
                assert!(shift_mm < 0.5, "{strays:?}: {shift_mm} mm");
            }
        }
    }
}
