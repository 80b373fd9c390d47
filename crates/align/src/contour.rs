//! The pose of the object, and small motions of each camera, from edges of the model in photographs.

use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Rigid3, World};
use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Point2, RowVector6, UnitQuaternion, Vector2, Vector3, Vector6};
use rayon::prelude::*;

use crate::adjust::CameraTerm;
use crate::model_edges::{ModelEdges, VisibleSample, view_at};
use crate::pnp_problem::{moved, project};
use crate::profile::{Candidates, MAX_RANGE_PX, Pyramid, candidates};

/// Edge residuals of one frame err together (lighting, play between bricks, the photograph's sharpening), so that a
/// frame's hundreds of samples say less than their number. Measured on simulated captures: errors are about this many
/// times what independent samples would leave.
const CORRELATION: f64 = 3.0;

/// One photograph.
pub(crate) struct ContourFrame {
    pub intrinsics: Intrinsics,
    pub size: ImageSize,
    /// As the phone has it.
    pub cam_from_world: Rigid3<Camera, World>,
    /// How the scene must move for this camera to see it where the photograph shows it; undoes the phone's drift.
    pub drift: Rigid3<World, World>,
    pub pyramid: Pyramid,
}

/// How far the phone's poses stray, as motions of the scene about the object's middle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DriftPrior {
    pub rotation_rad: f64,
    pub translation_m: f64,
}

/// The object's pose and the frames' drifts, which together put the model into every photograph.
pub(crate) struct ContourFit<'a> {
    pub edges: &'a ModelEdges,
    pub frames: Vec<ContourFrame>,
    pub world_from_object: Rigid3<World, Object>,
    pub prior: DriftPrior,
    /// Samples used of each frame.
    pub samples: usize,
}

/// A visible sample and the photograph's edges near it.
struct Observation {
    visible: VisibleSample,
    candidates: Candidates,
}

/// The photograph's edges near the model's, at one level of the pyramid.
pub(crate) struct Observed {
    level: usize,
    /// Per frame.
    observations: Vec<Vec<Observation>>,
}

/// A frame's camera at one level of the pyramid, and the motions that put the model before it.
struct Projection {
    k: Intrinsics,
    center: Vector3<f64>,
    world_from_object: Rigid3<World, Object>,
    drift: Rigid3<World, World>,
    cam_from_world: (Matrix3<f64>, Vector3<f64>),
    cam_from_drifted: (Matrix3<f64>, Vector3<f64>),
}

/// An observation after the current pose.
struct Residual {
    /// Signed distance across the edge, from the model's edge to the nearest of the photograph's; pixels of the level.
    px: f64,
    /// Derivatives of the model's edge with respect to motions of the object and of the frame's drift.
    by_object: RowVector6<f64>,
    by_drift: RowVector6<f64>,
}

impl Projection {
    fn residual(&self, o: &Observation) -> Option<Residual> {
        let in_world = self.world_from_object * o.visible.sample.point_in_object;
        let drifted = (self.drift * in_world).coords;
        let (r, t) = &self.cam_from_world;
        let (pixel, by_drift) = project(&self.k, r, t, &drifted, &self.center)?;
        let (r, t) = &self.cam_from_drifted;
        let (_, by_object) = project(&self.k, r, t, &in_world.coords, &self.center)?;
        let n = o.visible.normal;
        let along = n.dot(&(pixel - o.visible.pixel));
        let offsets = o.candidates.as_slice().iter().map(|offset| offset - along);
        let px = offsets.min_by(|a, b| a.abs().total_cmp(&b.abs()))?;
        Some(Residual { px, by_object: n.transpose() * by_object, by_drift: n.transpose() * by_drift })
    }
}

/// Gauss-Newton's equations: the object's motion, and each frame's.
struct Equations {
    object: Matrix6<f64>,
    object_right: Vector6<f64>,
    frames: Vec<FrameEquations>,
}

struct FrameEquations {
    /// Rows: the object; columns: the frame.
    mixed: Matrix6<f64>,
    own: Matrix6<f64>,
    object: Matrix6<f64>,
    right: Vector6<f64>,
    object_right: Vector6<f64>,
}

/// How well the fit is known. Motions are about the object's middle, `[rotation; translation]`.
pub(crate) struct Uncertainty {
    /// Of the object in the world.
    pub object: Matrix6<f64>,
    /// Of each frame's drift.
    pub frames: Vec<Matrix6<f64>>,
    /// Of the object as each camera sees it: the sum of the two.
    pub object_in_cam: Vec<Matrix6<f64>>,
}

impl ContourFit<'_> {
    fn cam_from_object(&self, frame: &ContourFrame) -> Rigid3<Camera, Object> {
        frame.cam_from_world * frame.drift * self.world_from_object
    }

    /// The object's middle in the world: the motions' pivot.
    pub fn center(&self) -> Vector3<f64> {
        (self.world_from_object * self.edges.centroid_in_object).coords
    }

    /// Looks for the photographs' edges around where the model's are now.
    pub fn observe(&self, level: usize, range_px: usize) -> Observed {
        let observations = self
            .frames
            .par_iter()
            .map(|frame| {
                let view = view_at(&frame.intrinsics, frame.size, &self.cam_from_object(frame), level);
                let image = frame.pyramid.level(level);
                self.edges
                    .visible_samples(&view, self.samples)
                    .into_iter()
                    .map(|visible| {
                        let candidates = candidates(image, &visible.pixel, &visible.normal, range_px);
                        Observation { visible, candidates }
                    })
                    .collect()
            })
            .collect();
        Observed { level, observations }
    }

    /// The frame's projection at a level, prepared for many samples.
    fn projection(&self, frame: &ContourFrame, level: usize) -> Projection {
        let cam_from_drifted = frame.cam_from_world * frame.drift;
        Projection {
            k: view_at(&frame.intrinsics, frame.size, &self.cam_from_object(frame), level).intrinsics,
            center: self.center(),
            world_from_object: self.world_from_object,
            drift: frame.drift,
            cam_from_world: (frame.cam_from_world.rotation_matrix(), frame.cam_from_world.translation()),
            cam_from_drifted: (cam_from_drifted.rotation_matrix(), cam_from_drifted.translation()),
        }
    }

    /// Steps towards the observed edges; residuals beyond `limit_px` do not count (Tukey's biweight).
    pub fn step(&mut self, observed: &Observed, limit_px: f64) -> bool {
        let noise_px = self.noise_px(observed, limit_px);
        let equations = self.equations(observed, limit_px, noise_px);
        let Some((object_step, frame_steps)) = equations.solve() else { return false };
        let center = self.center();
        self.world_from_object = moved(&self.world_from_object, &object_step, &center);
        for (frame, step) in self.frames.iter_mut().zip(&frame_steps) {
            frame.drift = moved(&frame.drift, step, &center);
        }
        object_step.iter().all(|v| v.is_finite())
    }

    /// Standard deviation of the residuals within the limit, from their median.
    fn noise_px(&self, observed: &Observed, limit_px: f64) -> f64 {
        let mut lengths: Vec<f64> = self
            .frames
            .par_iter()
            .zip(&observed.observations)
            .flat_map_iter(|(frame, list)| {
                let projection = self.projection(frame, observed.level);
                list.iter().filter_map(move |o| projection.residual(o)).map(|r| r.px.abs())
            })
            .filter(|r| *r < limit_px)
            .collect();
        lengths.sort_by(f64::total_cmp);
        // 1.4826 makes the median absolute deviation the standard deviation of normal errors.
        lengths.get(lengths.len() / 2).map_or(limit_px, |m| 1.4826 * m).max(0.1)
    }

    fn equations(&self, observed: &Observed, limit_px: f64, noise_px: f64) -> Equations {
        let information = 1.0 / (CORRELATION * noise_px).powi(2);
        let frames: Vec<FrameEquations> = self
            .frames
            .par_iter()
            .zip(&observed.observations)
            .map(|(frame, list)| {
                let mut e = FrameEquations {
                    mixed: Matrix6::zeros(),
                    own: self.prior_information(),
                    object: Matrix6::zeros(),
                    right: self.prior_information() * -self.drift_twist(frame),
                    object_right: Vector6::zeros(),
                };
                let projection = self.projection(frame, observed.level);
                for Residual { px: r, by_object, by_drift } in list.iter().filter_map(|o| projection.residual(o)) {
                    let weight = tukey(r, limit_px) * information;
                    if weight > 0.0 {
                        e.object += by_object.transpose() * by_object * weight;
                        e.mixed += by_object.transpose() * by_drift * weight;
                        e.own += by_drift.transpose() * by_drift * weight;
                        e.object_right += by_object.transpose() * (r * weight);
                        e.right += by_drift.transpose() * (r * weight);
                    }
                }
                e
            })
            .collect();
        let object = frames.iter().map(|f| f.object).sum();
        let object_right = frames.iter().map(|f| f.object_right).sum();
        Equations { object, object_right, frames }
    }

    /// What the edges say of each frame's drift with the object held, without the prior.
    pub fn frame_terms(&self, observed: &Observed, limit_px: f64) -> Vec<CameraTerm> {
        let equations = self.equations(observed, limit_px, self.noise_px(observed, limit_px));
        let prior = self.prior_information();
        self.frames
            .iter()
            .zip(&equations.frames)
            .map(|(frame, e)| CameraTerm {
                information: e.own - prior,
                right: e.right + prior * self.drift_twist(frame),
            })
            .collect()
    }

    pub fn prior_information(&self) -> Matrix6<f64> {
        let (r, t) = (self.prior.rotation_rad.powi(-2), self.prior.translation_m.powi(-2));
        Matrix6::from_diagonal(&Vector6::new(r, r, r, t, t, t))
    }

    /// A frame's drift as a turn about the object's middle and a shift of it.
    pub fn drift_twist(&self, frame: &ContourFrame) -> Vector6<f64> {
        twist_about(&frame.drift, &self.center())
    }

    /// Share of the model's visible edges that the photographs show where they should be, and the share that would be
    /// found by chance, with the model shifted in the image.
    pub fn agreement(&self, level: usize, limit_px: f64) -> (f64, f64) {
        const SHIFTS_PX: [(f64, f64); 4] = [(7.3, 5.1), (-5.7, 6.9), (-6.3, -7.7), (8.1, -4.9)];
        let range = (limit_px.ceil() as usize + 1).min(MAX_RANGE_PX);
        let sums: Vec<(f64, f64, f64)> = self
            .frames
            .par_iter()
            .map(|frame| {
                let view = view_at(&frame.intrinsics, frame.size, &self.cam_from_object(frame), level);
                let image = frame.pyramid.level(level);
                let hit = |pixel: Point2<f64>, normal: &Vector2<f64>| {
                    let found = candidates(image, &pixel, normal, range);
                    found.as_slice().iter().map(|r| tukey(*r, limit_px)).fold(0.0, f64::max)
                };
                let visible = self.edges.visible_samples(&view, self.samples);
                let mut sums = (0.0, 0.0, visible.len() as f64);
                for v in &visible {
                    sums.0 += hit(v.pixel, &v.normal);
                    let by_chance: f64 =
                        SHIFTS_PX.iter().map(|(x, y)| hit(v.pixel + Vector2::new(*x, *y), &v.normal)).sum();
                    sums.1 += by_chance / SHIFTS_PX.len() as f64;
                }
                sums
            })
            .collect();
        let total = sums.iter().fold((0.0, 0.0, 0.0), |a, b| (a.0 + b.0, a.1 + b.1, a.2 + b.2));
        if total.2 > 0.0 { (total.0 / total.2, total.1 / total.2) } else { (0.0, 0.0) }
    }

    /// Per frame: share of samples within `limit_px`, and their root mean square residual in pixels of the photograph.
    pub fn frame_statistics(&self, observed: &Observed, limit_px: f64) -> Vec<(f64, f64)> {
        let to_photograph = f64::from(1u32 << observed.level);
        self.frames
            .iter()
            .zip(&observed.observations)
            .map(|(frame, list)| {
                let projection = self.projection(frame, observed.level);
                let within: Vec<f64> = list
                    .iter()
                    .filter_map(|o| projection.residual(o))
                    .map(|r| r.px)
                    .filter(|r| r.abs() < limit_px)
                    .collect();
                let mean_sq = within.iter().map(|r| r * r).sum::<f64>() / within.len().max(1) as f64;
                (within.len() as f64 / list.len().max(1) as f64, mean_sq.sqrt() * to_photograph)
            })
            .collect()
    }

    /// Pixels of the photograph and whether an edge was found there, for pictures.
    pub fn drawn(&self, observed: &Observed, frame_idx: usize, limit_px: f64) -> Vec<(Point2<f64>, bool)> {
        let frame = &self.frames[frame_idx];
        let cam_from_object = self.cam_from_object(frame);
        let projection = self.projection(frame, observed.level);
        observed.observations[frame_idx]
            .iter()
            .filter_map(|o| {
                let pixel = frame.intrinsics.img_from_cam(&(cam_from_object * o.visible.sample.point_in_object))?;
                let found = projection.residual(o).is_some_and(|r| r.px.abs() < limit_px);
                Some((pixel, found))
            })
            .collect()
    }

    /// The inverse of the normal equations around the sandwich of scores summed over each edge in each frame (the
    /// cluster-robust covariance of White 1980 and Liang and Zeger 1986): samples of one edge err together.
    pub fn uncertainty(&self, observed: &Observed, limit_px: f64) -> Option<Uncertainty> {
        let noise_px = self.noise_px(observed, limit_px);
        let equations = self.equations(observed, limit_px, noise_px);
        let n = 6 + 6 * self.frames.len();
        let inverse = equations.dense().cholesky()?.inverse();
        let information = 1.0 / (CORRELATION * noise_px).powi(2);
        let mut scores = DMatrix::zeros(n, n);
        for (i, (frame, list)) in self.frames.iter().zip(&observed.observations).enumerate() {
            let at = 6 + 6 * i;
            let mut add = |sum: &(Vector6<f64>, Vector6<f64>)| {
                let mut g = DVector::zeros(12);
                g.rows_mut(0, 6).copy_from(&sum.0);
                g.rows_mut(6, 6).copy_from(&sum.1);
                let outer = &g * g.transpose();
                for (from_row, to_row) in [(0, 0), (6, at)] {
                    for (from_col, to_col) in [(0, 0), (6, at)] {
                        let mut block = scores.view_mut((to_row, to_col), (6, 6));
                        block += outer.view((from_row, from_col), (6, 6));
                    }
                }
            };
            let projection = self.projection(frame, observed.level);
            let mut rows: Vec<(u32, f64, RowVector6<f64>, RowVector6<f64>)> = list
                .iter()
                .filter_map(|o| {
                    let Residual { px: r, by_object, by_drift } = projection.residual(o)?;
                    let weight = tukey(r, limit_px) * information;
                    (weight > 0.0).then_some((o.visible.sample.edge, r * weight, by_object, by_drift))
                })
                .collect();
            rows.sort_by_key(|row| row.0);
            for edge in rows.chunk_by(|a, b| a.0 == b.0) {
                let mut sum = (Vector6::zeros(), Vector6::zeros());
                for (_, r, by_object, by_drift) in edge {
                    sum.0 += by_object.transpose() * *r;
                    sum.1 += by_drift.transpose() * *r;
                }
                add(&sum);
            }
            let mut own = scores.view_mut((at, at), (6, 6));
            own += self.prior_information();
        }
        let covariance = &inverse * scores * &inverse;
        let block = |row: usize, col: usize| -> Matrix6<f64> { covariance.fixed_view::<6, 6>(row, col).into_owned() };
        let object = block(0, 0);
        let frames: Vec<Matrix6<f64>> = (0..self.frames.len()).map(|i| block(6 + 6 * i, 6 + 6 * i)).collect();
        let object_in_cam = (0..self.frames.len())
            .map(|i| {
                let mixed = block(0, 6 + 6 * i);
                object + frames[i] + mixed + mixed.transpose()
            })
            .collect();
        Some(Uncertainty { object, frames, object_in_cam })
    }
}

impl Equations {
    /// The object's step and each frame's; the frames are eliminated first (Schur complement).
    fn solve(&self) -> Option<(Vector6<f64>, Vec<Vector6<f64>>)> {
        let mut reduced = self.object;
        let mut right = self.object_right;
        let mut inverses = Vec::with_capacity(self.frames.len());
        for f in &self.frames {
            let inverse = f.own.cholesky()?.inverse();
            reduced -= f.mixed * inverse * f.mixed.transpose();
            right -= f.mixed * inverse * f.right;
            inverses.push(inverse);
        }
        // What no edge determines does not move.
        reduced += Matrix6::from_diagonal(&(self.object.diagonal() * 1e-9));
        let object = reduced.cholesky()?.solve(&right);
        let frames =
            self.frames.iter().zip(&inverses).map(|(f, i)| i * (f.right - f.mixed.transpose() * object)).collect();
        Some((object, frames))
    }

    fn dense(&self) -> DMatrix<f64> {
        let n = 6 + 6 * self.frames.len();
        let mut dense = DMatrix::zeros(n, n);
        dense.view_mut((0, 0), (6, 6)).copy_from(&self.object);
        for (i, f) in self.frames.iter().enumerate() {
            let at = 6 + 6 * i;
            dense.view_mut((0, at), (6, 6)).copy_from(&f.mixed);
            dense.view_mut((at, 0), (6, 6)).copy_from(&f.mixed.transpose());
            dense.view_mut((at, at), (6, 6)).copy_from(&f.own);
        }
        dense
    }
}

/// A motion as a turn about `center` (rotation vector) and the shift of `center`.
pub(crate) fn twist_about(motion: &Rigid3<World, World>, center: &Vector3<f64>) -> Vector6<f64> {
    let turn = motion.rotation().scaled_axis();
    let shift = motion.rotation() * center + motion.translation() - center;
    Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z)
}

/// The motion whose twist about `center` this is.
pub(crate) fn motion_about(twist: &Vector6<f64>, center: &Vector3<f64>) -> Rigid3<World, World> {
    let turn = UnitQuaternion::from_scaled_axis(twist.fixed_rows::<3>(0).into_owned());
    Rigid3::from_parts(turn, center + twist.fixed_rows::<3>(3) - turn * center)
}

/// Tukey's biweight: 1 for no residual, 0 from the limit on.
fn tukey(r: f64, limit: f64) -> f64 {
    let u = (r / limit).powi(2);
    if u < 1.0 { (1.0 - u).powi(2) } else { 0.0 }
}
