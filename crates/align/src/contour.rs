//! The pose of the object, and small motions of each camera, from edges of the model in photographs.

use mb_geometry::{Camera, ImageSize, Intrinsics, Object, Rigid3, World};
use nalgebra::{
    DMatrix, DVector, Matrix3, Matrix6, Point2, Point3, RowSVector, RowVector6, SMatrix, SVector, UnitQuaternion,
    Vector2, Vector3, Vector6,
};
use rayon::prelude::*;

use crate::adjust::CameraTerm;
use crate::model_edges::{EdgeKind, ModelEdges, VisibleSample, image_normal, view_at};
use crate::pnp_problem::{moved, project};
use crate::profile::{Candidates, MAX_RANGE_PX, Pyramid, candidates};

/// Edge residuals of one frame err together (lighting, play between bricks, the photograph's sharpening), so that a
/// frame's hundreds of samples say less than their number. Measured on simulated captures: errors are about this many
/// times what independent samples would leave.
const CORRELATION: f64 = 3.0;

/// The errors that different edges of a photograph have in common (light that falls from one side, neighbours that pull,
/// edges that every start leads to but are not the model's) leave the pose this many times further off than the edges'
/// own scatter says. Measured: on ten alignments of seven models, simulated, the ratio was 2.1 to 5.7, 3.2 in the middle.
const COMMON_ERRORS: f64 = 3.0;

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
    /// Logarithm of the object's size over the model's, as the phone measures it; the object grows about its middle.
    pub log_scale: f64,
    /// Information of `log_scale`; infinite where the model's size is exact.
    pub scale_information: f64,
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
    scale: f64,
    drift: Rigid3<World, World>,
    cam_from_world: (Matrix3<f64>, Vector3<f64>),
    cam_from_drifted: (Matrix3<f64>, Vector3<f64>),
}

/// An observation after the current pose.
struct Residual {
    /// Signed distance across the edge, from the model's edge to the nearest of the photograph's; pixels of the level.
    px: f64,
    /// Derivatives of the model's edge with respect to motions of the object and of the frame's drift.
    by_object: RowSVector<f64, OBJECT>,
    by_drift: RowVector6<f64>,
}

impl Projection {
    fn residual(&self, o: &Observation) -> Option<Residual> {
        let from_center =
            ((self.world_from_object * o.visible.sample.point_in_object).coords - self.center) * self.scale;
        let in_world = Point3::from(self.center + from_center);
        let drifted = (self.drift * in_world).coords;
        let (r, t) = &self.cam_from_world;
        let (pixel, by_drift) = project(&self.k, r, t, &drifted, &self.center)?;
        let (r, t) = &self.cam_from_drifted;
        let (_, by_motion) = project(&self.k, r, t, &in_world.coords, &self.center)?;
        let n = o.visible.normal;
        let along = n.dot(&(pixel - o.visible.pixel));
        let offsets = o.candidates.as_slice().iter().map(|offset| offset - along);
        let px = offsets.min_by(|a, b| a.abs().total_cmp(&b.abs()))?;
        let by_motion = n.transpose() * by_motion;
        let mut by_object = RowSVector::<f64, OBJECT>::zeros();
        by_object.fixed_columns_mut::<6>(0).copy_from(&by_motion);
        by_object[6] = (by_motion.fixed_columns::<3>(3) * from_center)[0];
        Some(Residual { px, by_object, by_drift: n.transpose() * by_drift })
    }
}

/// Unknowns of the object: turn, shift, logarithm of its scale.
const OBJECT: usize = 7;
type ObjectMatrix = SMatrix<f64, OBJECT, OBJECT>;
type ObjectVector = SVector<f64, OBJECT>;
/// Stands for an infinite information of the scale: nothing that edges say comes near.
const EXACT: f64 = 1e15;

/// Gauss-Newton's equations: the object's motion, and each frame's.
struct Equations {
    object: ObjectMatrix,
    object_right: ObjectVector,
    frames: Vec<FrameEquations>,
}

struct FrameEquations {
    /// Rows: the object; columns: the frame.
    mixed: SMatrix<f64, OBJECT, 6>,
    own: Matrix6<f64>,
    object: ObjectMatrix,
    right: Vector6<f64>,
    object_right: ObjectVector,
}

/// Standard deviation of residuals.
struct Noise {
    /// By kind of edge, over all frames, pixels.
    px: [f64; EdgeKind::COUNT],
    /// By frame, in units of the above, at least 1; infinite at coarse levels. A frame that is still far off must not lose
    /// its edges because all others have found theirs.
    of_frame: Vec<f64>,
}

impl Noise {
    /// Of an observation of a frame, its information and the residual from which it does not count.
    fn of(&self, frame: usize, o: &Observation, limit_px: f64) -> (f64, f64) {
        let noise_px = self.px[o.visible.kind as usize];
        ((CORRELATION * noise_px).powi(-2), limit_px.min(TUKEY * noise_px * self.of_frame[frame]))
    }
}

/// Tukey's biweight with this limit in standard deviations is 95 % as efficient as least squares on normal errors.
const TUKEY: f64 = 4.685;

/// How many of the model's visible edges photographs show.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Agreement {
    /// Those found where they should be, by how near they are.
    found: f64,
    /// Those found where the model is not.
    by_chance: f64,
    samples: f64,
}

impl Agreement {
    pub fn of_all(frames: &[Self]) -> Self {
        frames.iter().fold(Self::default(), |a, b| Self {
            found: a.found + b.found,
            by_chance: a.by_chance + b.by_chance,
            samples: a.samples + b.samples,
        })
    }

    pub fn share(&self) -> f64 {
        self.found / self.samples.max(1.0)
    }

    pub fn chance(&self) -> f64 {
        self.by_chance / self.samples.max(1.0)
    }

    /// 0 = no better than chance, 1 = every edge found.
    pub fn confidence(&self) -> f64 {
        ((self.share() - self.chance()) / (1.0 - self.chance()).max(1e-9)).clamp(0.0, 1.0)
    }
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
        frame.cam_from_world * self.drift_at_true_size(frame) * self.world_from_object
    }

    /// The drift with which the camera sees the model, in its own size, exactly as it would see it scaled: an object
    /// that is larger by a factor looks the same from that much farther away.
    pub fn drift_at_true_size(&self, frame: &ContourFrame) -> Rigid3<World, World> {
        let center = Point3::from(self.center());
        let cam_from_drifted = frame.cam_from_world * frame.drift;
        let shift =
            (cam_from_drifted * center).coords * (-self.log_scale).exp() - cam_from_drifted.rotate(&center.coords);
        frame.cam_from_world.inverse() * Rigid3::from_parts(cam_from_drifted.rotation(), shift)
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
                        let candidates = candidates(image, &visible.pixel, &visible.normal, range_px, visible.kind);
                        Observation { visible, candidates }
                    })
                    .collect()
            })
            .collect();
        Observed { level, observations }
    }

    /// Looks for the photographs' edges anew around where the same samples are now, without asking which are visible: cheap,
    /// and right while nothing has moved by much.
    pub fn observe_again(&self, observed: &mut Observed, range_px: usize) {
        let level = observed.level;
        self.frames.par_iter().zip(&mut observed.observations).for_each(|(frame, list)| {
            let image = frame.pyramid.level(level);
            let view = view_at(&frame.intrinsics, frame.size, &self.cam_from_object(frame), level);
            list.retain_mut(|o| {
                let p = view.cam_from_frame * o.visible.sample.point_in_object;
                let pixel = view.intrinsics.img_from_cam(&p);
                let normal = image_normal(&view.intrinsics, &view.cam_from_frame, &o.visible.sample, &p);
                let Some((pixel, normal)) = pixel.zip(normal) else { return false };
                (o.visible.pixel, o.visible.normal) = (pixel, normal);
                o.candidates = candidates(image, &pixel, &normal, range_px, o.visible.kind);
                true
            });
        });
    }

    /// The frame's projection at a level, prepared for many samples.
    fn projection(&self, frame: &ContourFrame, level: usize) -> Projection {
        let cam_from_drifted = frame.cam_from_world * frame.drift;
        Projection {
            k: view_at(&frame.intrinsics, frame.size, &self.cam_from_object(frame), level).intrinsics,
            center: self.center(),
            world_from_object: self.world_from_object,
            scale: self.log_scale.exp(),
            drift: frame.drift,
            cam_from_world: (frame.cam_from_world.rotation_matrix(), frame.cam_from_world.translation()),
            cam_from_drifted: (cam_from_drifted.rotation_matrix(), cam_from_drifted.translation()),
        }
    }

    /// Steps towards the observed edges; residuals beyond `limit_px` do not count (Tukey's biweight).
    pub fn step(&mut self, observed: &Observed, limit_px: f64) -> bool {
        let noise = self.noise_px(observed, limit_px);
        let equations = self.equations(observed, limit_px, &noise);
        let Some((object_step, frame_steps)) = equations.solve() else { return false };
        let center = self.center();
        self.world_from_object = moved(&self.world_from_object, &object_step.fixed_rows::<6>(0).into_owned(), &center);
        if self.scale_information.is_finite() {
            self.log_scale += object_step[6];
        }
        for (frame, step) in self.frames.iter_mut().zip(&frame_steps) {
            frame.drift = moved(&frame.drift, step, &center);
        }
        object_step.iter().all(|v| v.is_finite())
    }

    /// Like [`Self::step`], with the object held.
    pub fn step_drifts(&mut self, observed: &Observed, limit_px: f64) -> bool {
        let noise = self.noise_px(observed, limit_px);
        let equations = self.equations(observed, limit_px, &noise);
        let center = self.center();
        for (frame, e) in self.frames.iter_mut().zip(&equations.frames) {
            let Some(cholesky) = e.own.cholesky() else { return false };
            frame.drift = moved(&frame.drift, &cholesky.solve(&e.right), &center);
        }
        true
    }

    /// Standard deviation of the residuals within the limit, from their median, for each kind of edge (outlines before
    /// the table are sharp, edges of one colour inside the model are not) and for each frame.
    fn noise_px(&self, observed: &Observed, limit_px: f64) -> Noise {
        // 1.4826 makes the median absolute deviation the standard deviation of normal errors.
        let deviation = |mut lengths: Vec<f64>| {
            lengths.sort_by(f64::total_cmp);
            lengths.get(lengths.len() / 2).map(|median| 1.4826 * median)
        };
        let lengths: Vec<Vec<(usize, f64)>> = self
            .frames
            .par_iter()
            .zip(&observed.observations)
            .map(|(frame, list)| {
                let projection = self.projection(frame, observed.level);
                let length = |o: &Observation| Some((o.visible.kind as usize, projection.residual(o)?.px.abs()));
                list.iter().filter_map(length).filter(|(_, r)| *r < limit_px).collect()
            })
            .collect();
        let px: [f64; EdgeKind::COUNT] = std::array::from_fn(|kind| {
            let of_kind = lengths.iter().flatten().filter(|(k, _)| *k == kind).map(|(_, r)| *r).collect();
            deviation(of_kind).unwrap_or(limit_px).max(0.1)
        });
        let of_frame = |list: &Vec<(usize, f64)>| {
            if observed.level > 0 {
                return f64::INFINITY;
            }
            deviation(list.iter().map(|&(kind, r): &(usize, f64)| r / px[kind]).collect()).unwrap_or(1.0).max(1.0)
        };
        Noise { px, of_frame: lengths.par_iter().map(of_frame).collect() }
    }

    fn equations(&self, observed: &Observed, limit_px: f64, noise: &Noise) -> Equations {
        let frames: Vec<FrameEquations> = self
            .frames
            .par_iter()
            .zip(&observed.observations)
            .enumerate()
            .map(|(index, (frame, list))| {
                let mut e = FrameEquations {
                    mixed: SMatrix::zeros(),
                    own: self.prior_information(),
                    object: ObjectMatrix::zeros(),
                    right: self.prior_information() * -self.drift_twist(frame),
                    object_right: ObjectVector::zeros(),
                };
                let projection = self.projection(frame, observed.level);
                for o in list {
                    let Some(Residual { px: r, by_object, by_drift }) = projection.residual(o) else { continue };
                    let (information, limit_px) = noise.of(index, o, limit_px);
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
        let mut object: ObjectMatrix = frames.iter().map(|f| f.object).sum();
        let mut object_right: ObjectVector = frames.iter().map(|f| f.object_right).sum();
        let scale_information = self.scale_information.min(EXACT);
        object[(6, 6)] += scale_information;
        object_right[6] -= scale_information * self.log_scale;
        Equations { object, object_right, frames }
    }

    /// What the edges and the phone's poses together say of the object's size: the logarithm of its ratio to the model's,
    /// and its standard deviation. The drifts have taken up a wrong size by moving all cameras towards the object or away;
    /// freeing it as well shows how much of that is common to them.
    pub fn log_scale_found(&self, observed: &Observed, limit_px: f64) -> Option<(f64, f64)> {
        let mut equations = self.equations(observed, limit_px, &self.noise_px(observed, limit_px));
        let scale_information = self.scale_information.min(EXACT);
        equations.object[(6, 6)] -= scale_information;
        equations.object_right[6] += scale_information * self.log_scale;
        let mut right = DVector::zeros(OBJECT + 6 * self.frames.len());
        right.rows_mut(0, OBJECT).copy_from(&equations.object_right);
        for (i, f) in equations.frames.iter().enumerate() {
            right.rows_mut(OBJECT + 6 * i, 6).copy_from(&f.right);
        }
        let cholesky = equations.dense().cholesky()?;
        let unit = DVector::from_fn(right.len(), |i, _| f64::from(u8::from(i == 6)));
        Some((self.log_scale + cholesky.solve(&right)[6], cholesky.solve(&unit)[6].sqrt()))
    }

    /// What the edges say of each frame's drift with the object held, without the prior.
    pub fn frame_terms(&self, observed: &Observed, limit_px: f64) -> Vec<CameraTerm> {
        let equations = self.equations(observed, limit_px, &self.noise_px(observed, limit_px));
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

    /// Per frame: share of the model's visible edges that the photograph shows where they should be, and the share that
    /// would be found by chance, with the model shifted in the image.
    pub fn agreement(&self, level: usize, limit_px: f64) -> Vec<Agreement> {
        const SHIFTS_PX: [(f64, f64); 4] = [(7.3, 5.1), (-5.7, 6.9), (-6.3, -7.7), (8.1, -4.9)];
        let range = (limit_px.ceil() as usize + 1).min(MAX_RANGE_PX);
        self.frames
            .par_iter()
            .map(|frame| {
                let view = view_at(&frame.intrinsics, frame.size, &self.cam_from_object(frame), level);
                let image = frame.pyramid.level(level);
                let hit = |pixel: Point2<f64>, v: &VisibleSample| {
                    let found = candidates(image, &pixel, &v.normal, range, v.kind);
                    found.as_slice().iter().map(|r| tukey(*r, limit_px)).fold(0.0, f64::max)
                };
                let visible = self.edges.visible_samples(&view, self.samples);
                let mut sum = Agreement { found: 0.0, by_chance: 0.0, samples: visible.len() as f64 };
                for v in &visible {
                    sum.found += hit(v.pixel, v);
                    let by_chance: f64 = SHIFTS_PX.iter().map(|(x, y)| hit(v.pixel + Vector2::new(*x, *y), v)).sum();
                    sum.by_chance += by_chance / SHIFTS_PX.len() as f64;
                }
                sum
            })
            .collect()
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
    /// cluster-robust covariance of White 1980 and Liang and Zeger 1986): samples of one edge err together. What edges
    /// have in common is beyond it, and added as [`COMMON_ERRORS`].
    pub fn uncertainty(&self, observed: &Observed, limit_px: f64) -> Option<Uncertainty> {
        let noise = self.noise_px(observed, limit_px);
        let equations = self.equations(observed, limit_px, &noise);
        let n = OBJECT + 6 * self.frames.len();
        let inverse = equations.dense().cholesky()?.inverse();
        let mut scores = DMatrix::zeros(n, n);
        for (i, (frame, list)) in self.frames.iter().zip(&observed.observations).enumerate() {
            let at = OBJECT + 6 * i;
            let mut add = |sum: &(ObjectVector, Vector6<f64>)| {
                let mut g = DVector::zeros(OBJECT + 6);
                g.rows_mut(0, OBJECT).copy_from(&sum.0);
                g.rows_mut(OBJECT, 6).copy_from(&sum.1);
                let outer = &g * g.transpose() * COMMON_ERRORS.powi(2);
                for (from_row, to_row, rows) in [(0, 0, OBJECT), (OBJECT, at, 6)] {
                    for (from_col, to_col, cols) in [(0, 0, OBJECT), (OBJECT, at, 6)] {
                        let mut block = scores.view_mut((to_row, to_col), (rows, cols));
                        block += outer.view((from_row, from_col), (rows, cols));
                    }
                }
            };
            let projection = self.projection(frame, observed.level);
            let mut rows: Vec<(u32, f64, RowSVector<f64, OBJECT>, RowVector6<f64>)> = list
                .iter()
                .filter_map(|o| {
                    let Residual { px: r, by_object, by_drift } = projection.residual(o)?;
                    let (information, limit_px) = noise.of(i, o, limit_px);
                    let weight = tukey(r, limit_px) * information;
                    (weight > 0.0).then_some((o.visible.sample.edge, r * weight, by_object, by_drift))
                })
                .collect();
            rows.sort_by_key(|row| row.0);
            for edge in rows.chunk_by(|a, b| a.0 == b.0) {
                let mut sum = (ObjectVector::zeros(), Vector6::zeros());
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
        let frames: Vec<Matrix6<f64>> = (0..self.frames.len()).map(|i| block(OBJECT + 6 * i, OBJECT + 6 * i)).collect();
        let object_in_cam = (0..self.frames.len())
            .map(|i| {
                let mixed = block(0, OBJECT + 6 * i);
                object + frames[i] + mixed + mixed.transpose()
            })
            .collect();
        Some(Uncertainty { object, frames, object_in_cam })
    }
}

impl Equations {
    /// The object's step and each frame's; the frames are eliminated first (Schur complement).
    fn solve(&self) -> Option<(ObjectVector, Vec<Vector6<f64>>)> {
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
        reduced += ObjectMatrix::from_diagonal(&(self.object.diagonal() * 1e-9));
        let object = reduced.cholesky()?.solve(&right);
        let frames =
            self.frames.iter().zip(&inverses).map(|(f, i)| i * (f.right - f.mixed.transpose() * object)).collect();
        Some((object, frames))
    }

    fn dense(&self) -> DMatrix<f64> {
        let n = OBJECT + 6 * self.frames.len();
        let mut dense = DMatrix::zeros(n, n);
        dense.view_mut((0, 0), (OBJECT, OBJECT)).copy_from(&self.object);
        for (i, f) in self.frames.iter().enumerate() {
            let at = OBJECT + 6 * i;
            dense.view_mut((0, at), (OBJECT, 6)).copy_from(&f.mixed);
            dense.view_mut((at, 0), (6, OBJECT)).copy_from(&f.mixed.transpose());
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
