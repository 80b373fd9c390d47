//! The object's pose from clicked points: robust, over any number of posed cameras, with its uncertainty.

use mb_geometry::{Camera, Intrinsics, Object, Rigid3, World};
use mb_job::rng;
use nalgebra::{Matrix3, Matrix6, Point2, Point3, Vector2, Vector3, Vector6};
use rand::RngExt;
use serde::{Deserialize, Serialize};

use crate::pnp_problem::Problem;
use crate::sqpnp::{self, Sighting};

/// A camera whose pose is taken as known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosedCamera {
    /// Intrinsics of the photograph.
    pub intrinsics: Intrinsics,
    /// Its pose.
    pub world_from_cam: Rigid3<World, Camera>,
}

/// A point of the object and the pixel that shows it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// Index of the camera that shows it.
    pub camera_idx: usize,
    /// Pixel (x, y), pixel centres at integers.
    pub pixel: Point2<f64>,
    /// The point, metres, object frame.
    pub point_in_object: Point3<f64>,
}

/// How [`estimate_pose`] works.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PnpOptions {
    /// Standard deviation of a careful click along each image axis, pixels, above 0. Wrong clicks are told from right
    /// ones by it, or by the spread of the residuals where that is larger (relative poses of a phone drift).
    pub click_noise_px: f64,
    /// Largest root mean square angle between right clicks and the model for which a pose is accepted, degrees. The
    /// default is several times what a phone's drift causes.
    pub max_rms_deg: f64,
    /// How far each camera's pose may have drifted, as a turn of the scene about the clicked points, degrees (standard
    /// deviation); 0 takes the poses as exact.
    pub drift_deg: f64,
    /// The same as a shift of the scene, millimetres; 0 takes the poses as exact.
    pub drift_mm: f64,
    /// Random subsets tried in the search for wrong clicks.
    pub subsets: usize,
    /// Seed of the subsets.
    pub seed: u64,
}

impl Default for PnpOptions {
    fn default() -> Self {
        Self { click_noise_px: 2.0, max_rms_deg: 2.0, drift_deg: 0.0, drift_mm: 0.0, subsets: 300, seed: 0 }
    }
}

impl PnpOptions {
    /// Information on each camera's drift in units of a click's; none for one camera, whose drift is the object's.
    fn drift_prior(&self, cameras: usize) -> Option<Matrix6<f64>> {
        let (rotation_rad, shift_m) = (self.drift_deg.to_radians(), self.drift_mm * 1e-3);
        if cameras < 2 || rotation_rad <= 0.0 || shift_m <= 0.0 {
            return None;
        }
        let (r, t) = ((self.click_noise_px / rotation_rad).powi(2), (self.click_noise_px / shift_m).powi(2));
        Some(Matrix6::from_diagonal(&Vector6::new(r, r, r, t, t, t)))
    }
}

/// How the object's points lie in space, which decides what a pose can be told from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PointLayout {
    /// They span a volume.
    Solid,
    /// Their thickness is under 5 % of their length: the pose has a weak mirrored twin.
    NearlyCoplanar,
    /// They lie in a plane: from one camera the pose may have a mirrored twin that fits as well.
    Coplanar,
}

/// Why there is no pose.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PnpError {
    /// Fewer than four points.
    #[error("{found} keypoints, but a pose needs at least 4 (and 6 to find a wrong click)")]
    TooFew {
        /// How many there are.
        found: usize,
    },
    /// The 3D points coincide or lie on a line, so the object can turn about it.
    #[error("the 3D points lie on one line (spread across it {across_mm:.2} mm, along it {along_mm:.2} mm)")]
    Collinear {
        /// Root mean square distance along the line, millimetres.
        along_mm: f64,
        /// The same across the line.
        across_mm: f64,
    },
    /// The best fit puts most points behind the cameras that show them.
    #[error("the pose that fits best puts {behind} of {points} points behind the camera that shows them")]
    Behind {
        /// Points behind.
        behind: usize,
        /// Points in all.
        points: usize,
    },
    /// The mirror image of the 3D points fits and the points do not.
    #[error("the mirror image of the 3D points fits ({mirrored_px:.1} px), the points themselves do not ({px:.1} px)")]
    Mirrored {
        /// Root mean square residual of the points, wrong clicks counted at the limit.
        px: f64,
        /// The same for their mirror image.
        mirrored_px: f64,
    },
    /// Two different poses fit equally well.
    #[error(
        "two poses that are {apart_deg:.1} deg apart fit equally well ({rms_px:.2} and {other_rms_px:.2} px), because \
         the 3D points are (nearly) coplanar"
    )]
    Ambiguous {
        /// Residual of the better pose.
        rms_px: f64,
        /// Residual of its twin.
        other_rms_px: f64,
        /// Angle between the two.
        apart_deg: f64,
    },
    /// No pose fits most of the points.
    #[error("no pose fits the keypoints: the best leaves {rms_px:.1} px over {agreeing} of {points} points")]
    NoAgreement {
        /// Residual over the points that agree best.
        rms_px: f64,
        /// How many these are.
        agreeing: usize,
        /// Points in all.
        points: usize,
    },
}

/// A pose with the evidence for it.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseEstimate {
    /// The pose.
    pub world_from_object: Rigid3<World, Object>,
    /// Covariance, left perturbation in the world frame, `[rotation; translation]` (rad, m), scaled by the residuals'
    /// variance. It takes the cameras' poses as exact, or as independently drifted where the options say so.
    pub covariance: Matrix6<f64>,
    /// Standard deviation of the rotation, radians: the root of the trace of its covariance.
    pub rotation_std_rad: f64,
    /// Standard deviation of the position of the points' centroid, metres.
    pub centroid_std_m: f64,
    /// Condition number of the normal equations after scaling each parameter to unit curvature, about the centroid.
    pub condition: f64,
    /// Per correspondence: found minus predicted pixel; `None` behind the camera.
    pub residuals_px: Vec<Option<Vector2<f64>>>,
    /// Per correspondence: whether the pose was computed from it.
    pub inliers: Vec<bool>,
    /// Residual length beyond which a click counts as wrong.
    pub limit_px: f64,
    /// Root mean square residual length of the inliers.
    pub rms_px: f64,
    /// How the inliers' 3D points lie.
    pub layout: PointLayout,
}

/// Residuals of right clicks stay below this multiple of their standard deviation along an axis: the length is Rayleigh
/// distributed, which exceeds it once in a thousand.
const RAYLEIGH_LIMIT: f64 = 3.72;
/// Median of a Rayleigh distribution of unit scale.
const RAYLEIGH_MEDIAN: f64 = 1.177_410_022_515_474_7;
/// Chance that two poses of which one is wrong differ by less than this in squared residuals over variance: 1 %.
const TWIN_LIMIT: f64 = 6.63;

/// Estimates the pose of the object.
///
/// Starts come from SQPnP on all points and on random subsets, judged by the median residual, so nearly half of the
/// clicks may be wrong (from six points on). Each start is polished by Levenberg-Marquardt on squared pixel residuals
/// over the clicks that agree with it, until that set no longer changes.
///
/// # Errors
/// See [`PnpError`]: each kind of configuration that has no, or no unique, answer is told apart.
///
/// # Panics
/// If a correspondence names a camera that is not there.
pub fn estimate_pose(
    cameras: &[PosedCamera],
    correspondences: &[Correspondence],
    options: &PnpOptions,
) -> Result<PoseEstimate, PnpError> {
    let drift_prior = options.drift_prior(cameras.len());
    let problem = Problem::new(cameras, correspondences, drift_prior);
    let points = correspondences.len();
    if points < 4 {
        return Err(PnpError::TooFew { found: points });
    }
    let all = vec![true; points];
    layout(correspondences, &all)?;

    let fit = problem.best_fit(options);
    let Some(Fit { pose, inliers, limit_px }) = fit else {
        let behind = problem.closest_to_rays(&all).map_or(points, |s| points - s.in_front);
        return Err(PnpError::Behind { behind, points });
    };
    let residuals = problem.residuals_without_drift(&pose, &inliers);
    let behind = residuals.iter().filter(|r| r.is_none()).count();
    if 2 * behind > points {
        return Err(PnpError::Behind { behind, points });
    }
    let rms_px = rms(&residuals, &inliers);
    let agreeing = inliers.iter().filter(|&&i| i).count();

    // A pose found from good clicks of the right hand explains them all; only then is its mirror image not worth a try.
    if agreeing < points || rms_px > 2.0 * options.click_noise_px {
        let mirrored: Vec<Correspondence> = correspondences
            .iter()
            .map(|c| Correspondence { point_in_object: mirrored(&c.point_in_object), ..*c })
            .collect();
        let twin = Problem::new(cameras, &mirrored, drift_prior);
        if let Some(fit) = twin.best_fit(options) {
            let (px, mirrored_px) = (
                truncated_rms(&residuals, limit_px),
                truncated_rms(&twin.residuals_without_drift(&fit.pose, &fit.inliers), limit_px),
            );
            if mirrored_px < 0.5 * px {
                return Err(PnpError::Mirrored { px, mirrored_px });
            }
        }
    }
    if rms_px > problem.pixels_per_radian() * options.max_rms_deg.to_radians() || 2 * agreeing < points {
        return Err(PnpError::NoAgreement { rms_px, agreeing, points });
    }
    let layout = layout(correspondences, &inliers)?;
    let Some(equations) = problem.normal_equations(&pose, &inliers) else {
        return Err(PnpError::NoAgreement { rms_px, agreeing, points });
    };
    // Two residuals a point against six parameters, and what the drifts take up.
    let freedom = (2 * agreeing - 6) as f64 - equations.drift_freedom;
    let sum_sq = equations.sum_sq;
    let noise_px2 = options.click_noise_px.powi(2);
    // The drifts' prior is in units of the click noise, which the residuals may only raise.
    let least_px2 = if drift_prior.is_some() { noise_px2 } else { 1e-12 };
    let variance_px2 = (sum_sq / freedom.max(1.0)).max(least_px2);
    if let Some((other, other_sum_sq)) = problem.twin(&pose, &inliers)
        && (other_sum_sq - sum_sq) / variance_px2.max(noise_px2 / 16.0) < TWIN_LIMIT
    {
        return Err(PnpError::Ambiguous {
            rms_px,
            other_rms_px: (other_sum_sq / agreeing as f64).sqrt(),
            apart_deg: pose.rotation().angle_to(&other.rotation()).to_degrees(),
        });
    }

    let normal = equations.hessian;
    let scale = normal.diagonal().map(|v| 1.0 / v.max(f64::MIN_POSITIVE).sqrt());
    let scaled = Matrix6::from_diagonal(&scale) * normal * Matrix6::from_diagonal(&scale);
    let eigenvalues = scaled.symmetric_eigenvalues();
    let condition = eigenvalues.max() / eigenvalues.min().max(f64::MIN_POSITIVE);
    let Some(inverse) = scaled.cholesky().map(|c| c.inverse()) else {
        return Err(PnpError::NoAgreement { rms_px, agreeing, points });
    };
    let about_centroid = Matrix6::from_diagonal(&scale) * inverse * Matrix6::from_diagonal(&scale) * variance_px2;
    let centroid = problem.centroid(&pose, &inliers);
    Ok(PoseEstimate {
        world_from_object: pose,
        covariance: about_origin(&about_centroid, &centroid),
        rotation_std_rad: about_centroid.fixed_view::<3, 3>(0, 0).trace().sqrt(),
        centroid_std_m: about_centroid.fixed_view::<3, 3>(3, 3).trace().sqrt(),
        condition,
        residuals_px: residuals,
        inliers,
        limit_px,
        rms_px,
        layout,
    })
}

/// How the chosen points lie in space.
fn layout(correspondences: &[Correspondence], chosen: &[bool]) -> Result<PointLayout, PnpError> {
    let points: Vec<Point3<f64>> =
        correspondences.iter().zip(chosen).filter(|(_, chosen)| **chosen).map(|(c, _)| c.point_in_object).collect();
    let n = points.len().max(1) as f64;
    let mean = points.iter().map(|p| p.coords).sum::<Vector3<f64>>() / n;
    let spread: Matrix3<f64> =
        points.iter().map(|p| (p.coords - mean) * (p.coords - mean).transpose()).sum::<Matrix3<f64>>() / n;
    let mut lengths: [f64; 3] = spread.symmetric_eigenvalues().map(|v| v.max(0.0).sqrt()).into();
    lengths.sort_by(|a, b| b.total_cmp(a));
    let [along, across, thickness] = lengths;
    // A click of 1 px turns a strip that is 1 % as wide as long by far more than a pose may be off.
    if across <= 0.01 * along || along == 0.0 {
        Err(PnpError::Collinear { along_mm: along * 1e3, across_mm: across * 1e3 })
    } else if thickness <= 1e-4 * along {
        Ok(PointLayout::Coplanar)
    } else if thickness <= 0.05 * along {
        Ok(PointLayout::NearlyCoplanar)
    } else {
        Ok(PointLayout::Solid)
    }
}

fn mirrored(p: &Point3<f64>) -> Point3<f64> {
    Point3::new(-p.x, p.y, p.z)
}

/// Covariance of a left perturbation about the world's origin from that of one about `centroid`: a rotation `w` about
/// the centroid `c` with a shift `v` is the same motion as a rotation `w` about the origin with the shift `v + c x w`.
pub(crate) fn about_origin(about_centroid: &Matrix6<f64>, centroid: &Vector3<f64>) -> Matrix6<f64> {
    let mut map = Matrix6::identity();
    map.fixed_view_mut::<3, 3>(3, 0).copy_from(&centroid.cross_matrix());
    let covariance = map * about_centroid * map.transpose();
    (covariance + covariance.transpose()) * 0.5
}

fn median(residuals: &[Option<Vector2<f64>>]) -> f64 {
    let mut lengths: Vec<f64> = residuals.iter().map(|r| r.map_or(f64::INFINITY, |r| r.norm())).collect();
    lengths.sort_by(f64::total_cmp);
    lengths[lengths.len() / 2]
}

/// Root mean square residual where none counts for more than `limit_px`.
fn truncated_rms(residuals: &[Option<Vector2<f64>>], limit_px: f64) -> f64 {
    let sum: f64 = residuals.iter().map(|r| r.map_or(limit_px, |r| r.norm().min(limit_px)).powi(2)).sum();
    (sum / residuals.len() as f64).sqrt()
}

fn rms(residuals: &[Option<Vector2<f64>>], chosen: &[bool]) -> f64 {
    let mut sum = 0.0;
    let mut n = 0.0;
    for r in residuals.iter().zip(chosen).filter(|(_, chosen)| **chosen).filter_map(|(r, _)| *r) {
        sum += r.norm_squared();
        n += 1.0;
    }
    if n > 0.0 { f64::sqrt(sum / n) } else { f64::INFINITY }
}

/// A pose and the correspondences that agree with it.
struct Fit {
    pose: Rigid3<World, Object>,
    inliers: Vec<bool>,
    limit_px: f64,
}

impl Problem<'_> {
    fn chosen_sightings(&self, chosen: &[bool]) -> Vec<Sighting> {
        self.sightings.iter().zip(chosen).filter(|(_, chosen)| **chosen).map(|(s, _)| *s).collect()
    }

    /// The pose that brings points and rays, taken as full lines, closest.
    fn closest_to_rays(&self, chosen: &[bool]) -> Option<sqpnp::Solution> {
        let solutions = sqpnp::solve(&self.chosen_sightings(chosen));
        solutions.into_iter().min_by(|a, b| a.cost_m2.total_cmp(&b.cost_m2))
    }

    /// The best local minimum over the chosen correspondences with all of them in front.
    fn polished_minimum(&self, chosen: &[bool]) -> Option<(Rigid3<World, Object>, f64)> {
        let count = chosen.iter().filter(|&&c| c).count();
        sqpnp::solve(&self.chosen_sightings(chosen))
            .iter()
            .filter(|s| s.in_front == count)
            .take(3)
            .filter_map(|s| self.polish(&s.world_from_object, chosen))
            .min_by(|a, b| a.1.total_cmp(&b.1))
    }

    fn best_fit(&self, options: &PnpOptions) -> Option<Fit> {
        let points = self.correspondences.len();
        let all = vec![true; points];
        let noise_limit = RAYLEIGH_LIMIT * options.click_noise_px;
        let whole = self.polished_minimum(&all).map(|(pose, _)| pose);
        if let Some(pose) = whole {
            let residuals = self.residuals_without_drift(&pose, &all);
            let largest = residuals.iter().map(|r| r.map_or(f64::INFINITY, |r| r.norm())).fold(0.0, f64::max);
            // With five points or fewer, leaving one out always leaves an exact or nearly exact fit.
            if largest <= noise_limit || points < 6 {
                let limit_px = noise_limit.max(largest);
                return Some(Fit { pose, inliers: all, limit_px });
            }
        }
        if points < 6 {
            return None;
        }

        // Least median of squares (Rousseeuw 1984) over random subsets.
        let mut best = whole.map(|pose| (pose, median(&self.residuals(&pose))));
        let subset_size = if points < 10 { 4 } else { 5 };
        let mut rng = rng(options.seed, 0);
        let mut order: Vec<usize> = (0..points).collect();
        for _ in 0..options.subsets {
            for i in 0..subset_size {
                let j = rng.random_range(i..points);
                order.swap(i, j);
            }
            let subset: Vec<Sighting> = order[..subset_size].iter().map(|&i| self.sightings[i]).collect();
            for solution in sqpnp::solve(&subset).iter().filter(|s| s.in_front == subset_size) {
                let mut pose = solution.world_from_object;
                let mut score = median(&self.residuals(&pose));
                // The half that agrees best gives a better pose than the subset; only promising ones are worth it.
                if best.is_none_or(|(_, best)| score < 2.0 * best) {
                    let half = self.within(&pose, score);
                    if let Some((polished, _)) = self.polish(&pose, &half) {
                        let polished_score = median(&self.residuals(&polished));
                        if polished_score < score {
                            (pose, score) = (polished, polished_score);
                        }
                    }
                }
                if best.is_none_or(|(_, best)| score < best) {
                    best = Some((pose, score));
                }
            }
        }
        let (pose, score) = best.filter(|(_, score)| score.is_finite())?;

        // Small samples make the median too small (Rousseeuw and Leroy 1987, p. 202).
        let small_sample = 1.0 + 5.0 / (points as f64 - 5.0);
        let sigma = (score / RAYLEIGH_MEDIAN * small_sample).max(options.click_noise_px);
        let inliers = self.within(&pose, RAYLEIGH_LIMIT * sigma);
        let fit = self.settle(Fit { pose, inliers, limit_px: RAYLEIGH_LIMIT * sigma }, options)?;
        match self.with_drifted_cameras(&fit) {
            Some(inliers) => self.settle(Fit { inliers, ..fit }, options),
            None => Some(fit),
        }
    }

    /// Polishes a pose and chooses the clicks that agree with it, in turn, until these stay.
    fn settle(&self, fit: Fit, options: &PnpOptions) -> Option<Fit> {
        let Fit { mut pose, mut inliers, mut limit_px } = fit;
        for _ in 0..20 {
            let (polished, sum_sq) = self.polish(&pose, &inliers)?;
            pose = polished;
            let agreeing = inliers.iter().filter(|&&i| i).count();
            let taken = self.normal_equations(&pose, &inliers)?.drift_freedom;
            let freedom = 2.0 * agreeing as f64 - 6.0 - taken;
            let residuals = self.residuals_without_drift(&pose, &inliers);
            let mut sigma = (sum_sq / freedom.max(1.0)).sqrt();
            if taken > 0.0 {
                // A camera's drift follows its wrong click half way, which hides it in the sum, but not in the median.
                sigma =
                    sigma.min(median(&residuals) / RAYLEIGH_MEDIAN * (2.0 * agreeing as f64 / freedom.max(1.0)).sqrt());
            }
            limit_px = RAYLEIGH_LIMIT * sigma.max(options.click_noise_px);
            let next: Vec<bool> = residuals.iter().map(|r| r.is_some_and(|r| r.norm() <= limit_px)).collect();
            if next == inliers || next.iter().filter(|&&i| i).count() < 4 {
                break;
            }
            inliers = next;
        }
        Some(Fit { pose, inliers, limit_px })
    }

    /// The clicks that agree, chosen anew camera by camera where the cameras have drifted: the drift moves all of a camera's
    /// clicks alike, and a wrong click moves the drift. Each click in turn says what the drift is, and those that agree with it,
    /// at least three and more than half of the camera's, take the place of the former ones where this costs less: in squared
    /// residuals, in drift, and `limit_px` squared for a click that is left out. `None` where nothing changes.
    fn with_drifted_cameras(&self, fit: &Fit) -> Option<Vec<bool>> {
        if self.normal_equations(&fit.pose, &fit.inliers)?.drift_freedom <= 0.0 {
            return None;
        }
        let cost = |inliers: &[bool]| {
            let left_out = inliers.iter().filter(|&&i| !i).count();
            self.normal_equations(&fit.pose, inliers).map(|e| e.sum_sq + left_out as f64 * fit.limit_px.powi(2))
        };
        let mut inliers = fit.inliers.clone();
        for camera in 0..self.cameras.len() {
            let clicks: Vec<usize> =
                (0..inliers.len()).filter(|&i| self.correspondences[i].camera_idx == camera).collect();
            let mut best = cost(&inliers)?;
            let former = inliers.clone();
            for &i in &clicks {
                let mut chosen = former.clone();
                clicks.iter().for_each(|&j| chosen[j] = i == j);
                let residuals = self.residuals_without_drift(&fit.pose, &chosen);
                clicks.iter().for_each(|&j| chosen[j] = residuals[j].is_some_and(|r| r.norm() <= fit.limit_px));
                let agreeing = clicks.iter().filter(|&&j| chosen[j]).count();
                if agreeing < 3 || 2 * agreeing <= clicks.len() {
                    continue;
                }
                if let Some(cost) = cost(&chosen).filter(|cost| *cost < best) {
                    (best, inliers) = (cost, chosen);
                }
            }
        }
        (inliers != fit.inliers).then_some(inliers)
    }

    /// Which correspondences have a residual of at most `limit_px`.
    fn within(&self, pose: &Rigid3<World, Object>, limit_px: f64) -> Vec<bool> {
        self.residuals(pose).iter().map(|r| r.is_some_and(|r| r.norm() <= limit_px)).collect()
    }

    /// The best local minimum other than `pose`, with the sum of its squared residuals.
    fn twin(&self, pose: &Rigid3<World, Object>, chosen: &[bool]) -> Option<(Rigid3<World, Object>, f64)> {
        let count = chosen.iter().filter(|&&c| c).count();
        let centroid = Point3::from(self.centroid(pose, chosen));
        // A plane seen from afar looks the same when it is turned about the line of sight's perpendicular: try the
        // reflection of its normal at the line of sight, besides what SQPnP met.
        let normal = self.thinnest_direction(pose, chosen);
        let mut starts: Vec<Rigid3<World, Object>> = sqpnp::solve(&self.chosen_sightings(chosen))
            .iter()
            .filter(|s| s.in_front == count)
            .map(|s| s.world_from_object)
            .collect();
        for camera in self.cameras {
            let sight = (centroid.coords - camera.world_from_cam.translation()).normalize();
            let reflected = sight * (2.0 * sight.dot(&normal)) - normal;
            if let Some(turn) = nalgebra::Rotation3::rotation_between(&normal, &reflected) {
                let turn = nalgebra::UnitQuaternion::from_rotation_matrix(&turn);
                let about = Rigid3::<World, World>::from_parts(turn, centroid.coords - turn * centroid.coords);
                starts.push(about * *pose);
            }
        }
        starts
            .iter()
            .filter_map(|start| self.polish(start, chosen))
            .filter(|(other, _)| pose.rotation().angle_to(&other.rotation()) > 0.5_f64.to_radians())
            .min_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// The direction in the world in which the chosen points spread least.
    fn thinnest_direction(&self, pose: &Rigid3<World, Object>, chosen: &[bool]) -> Vector3<f64> {
        let center = self.centroid(pose, chosen);
        let mut spread = Matrix3::zeros();
        for (c, _) in self.correspondences.iter().zip(chosen).filter(|(_, chosen)| **chosen) {
            let d = (*pose * c.point_in_object).coords - center;
            spread += d * d.transpose();
        }
        let eigen = spread.symmetric_eigen();
        eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned()
    }
}

#[cfg(test)]
#[path = "pnp_tests.rs"]
mod tests;
