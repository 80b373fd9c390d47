//! A camera's intrinsics and lens from several views of a board.

use mb_geometry::{Board, Camera, ImageSize, Intrinsics, Rigid3};
use nalgebra::{Matrix3, Matrix6, Point2, SMatrix, SVector, Vector6};
use serde::{Deserialize, Serialize};

use crate::camera::moved;
use crate::homography::Homography;
use crate::pose::{Pair, initial_pose, pairs};
use crate::{BoardSpec, LensCamera, SeenCorner};

/// A calibrated camera, with the evidence for it.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// The camera.
    pub camera: LensCamera,
    /// Standard deviations of fx, fy, cx, cy (pixels), then k1, k2, p1, p2, k3.
    pub std: [f64; 9],
    /// Root mean square residual length over all corners used, pixels.
    pub rms_px: f64,
    /// Corners used.
    pub corners: usize,
    /// One a view, in their order.
    pub views: Vec<CalibratedView>,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

/// One view of a [`Calibration`].
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedView {
    /// Where the camera was.
    pub cam_from_board: Rigid3<Camera, Board>,
    /// Root mean square residual length, pixels.
    pub rms_px: f64,
    /// Corners left out as wrong, by their ids.
    pub left_out: Vec<usize>,
}

/// Why there is no calibration.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibrationError {
    /// Fewer than three views.
    #[error("{found} views with at least {FEWEST_CORNERS} corners; a camera needs at least {FEWEST_VIEWS}")]
    TooFewViews {
        /// Views that have enough corners.
        found: usize,
    },
    /// The views leave the focal length free.
    #[error("the views do not determine the focal length: the board must be tilted to the camera in different ways")]
    NotTilted,
    /// The iteration came to no end.
    #[error("no camera explains the corners: {rms_px:.1} px remain")]
    NoAgreement {
        /// Root mean square residual.
        rms_px: f64,
    },
}

/// Fewest views.
const FEWEST_VIEWS: usize = 3;
/// Fewest corners of a view.
const FEWEST_CORNERS: usize = 6;
/// A corner further off than this multiple of the typical residual is wrong.
const OUTLIER: f64 = 6.0;
/// A residual above this is no agreement, pixels.
const WORST_RMS_PX: f64 = 5.0;

/// How many of the camera's numbers are estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LensModel {
    /// Focal lengths and principal point.
    Pinhole,
    /// And the two first radial coefficients.
    Radial,
    /// And all five of OpenCV's coefficients.
    #[default]
    Full,
}

impl LensModel {
    fn is_free(self, parameter: usize) -> bool {
        match self {
            Self::Pinhole => parameter < 4,
            Self::Radial => parameter < 6,
            Self::Full => true,
        }
    }
}

struct View {
    pairs: Vec<Pair>,
    used: Vec<bool>,
    pose: Rigid3<Camera, Board>,
}

/// Calibrates a camera from views of a board; views with fewer than six corners take no part and have no place in the
/// result's list, so leave them out before.
///
/// The start is Zhang's closed form ("A flexible new technique for camera calibration", 2000) with the principal point in
/// the middle of the image; Levenberg-Marquardt on the pixel residuals of all views follows, poses eliminated by the Schur
/// complement. Corners that do not agree with the rest are left out once the camera stands.
///
/// # Errors
/// [`CalibrationError`] where the views determine no camera.
pub fn calibrate(
    board: &BoardSpec,
    views: &[Vec<SeenCorner>],
    size: ImageSize,
    model: LensModel,
) -> Result<Calibration, CalibrationError> {
    let usable: Vec<Vec<Pair>> = views.iter().map(|v| pairs(board, v)).collect();
    let found = usable.iter().filter(|v| v.len() >= FEWEST_CORNERS).count();
    if found < FEWEST_VIEWS || found < views.len() {
        return Err(CalibrationError::TooFewViews { found });
    }
    let mut camera = LensCamera::pinhole(initial_intrinsics(&usable, size)?);
    let mut views_now = Vec::with_capacity(usable.len());
    for pairs in usable {
        let pose = initial_pose(&pairs, &camera).ok_or(CalibrationError::NotTilted)?;
        views_now.push(View { used: vec![true; pairs.len()], pairs, pose });
    }
    for stage in [LensModel::Pinhole, LensModel::Radial, LensModel::Full] {
        solve(&mut camera, &mut views_now, stage, 60).ok_or(CalibrationError::NotTilted)?;
        if stage == model {
            break;
        }
    }
    for _ in 0..3 {
        if !leave_out_wrong(&camera, &mut views_now) {
            break;
        }
        solve(&mut camera, &mut views_now, model, 60).ok_or(CalibrationError::NotTilted)?;
    }
    let reduced = solve(&mut camera, &mut views_now, model, 100).ok_or(CalibrationError::NotTilted)?;
    summary(board, &camera, &views_now, views, &reduced, size, model)
}

fn summary(
    board: &BoardSpec,
    camera: &LensCamera,
    solved: &[View],
    views: &[Vec<SeenCorner>],
    reduced: &Reduced,
    size: ImageSize,
    model: LensModel,
) -> Result<Calibration, CalibrationError> {
    let count: usize = solved.iter().map(|v| v.used.iter().filter(|u| **u).count()).sum();
    let rms_px = (reduced.cost / count as f64).sqrt();
    let k = camera.intrinsics;
    if !(rms_px < WORST_RMS_PX && k.fx > 0.0 && k.fy > 0.0) {
        return Err(CalibrationError::NoAgreement { rms_px });
    }
    let free = (0..9).filter(|&i| model.is_free(i)).count();
    let freedom = (2 * count).saturating_sub(free + 6 * solved.len()).max(1) as f64;
    let inverse = reduced.hessian.try_inverse().ok_or(CalibrationError::NotTilted)?;
    let std = std::array::from_fn(|i| {
        if model.is_free(i) { (inverse[(i, i)].max(0.0) * reduced.cost / freedom).sqrt() } else { 0.0 }
    });
    let mut warnings = Vec::new();
    if std[0] > 0.01 * k.fx || std[1] > 0.01 * k.fy {
        warnings.push(format!(
            "the focal length is known to {:.1} % only: take more views, the board tilted by 30 degrees and more in all \
             directions",
            100.0 * (std[0] / k.fx).max(std[1] / k.fy)
        ));
    }
    if !((0.0..size.width as f64).contains(&k.cx) && (0.0..size.height as f64).contains(&k.cy)) {
        warnings.push(format!("the principal point ({:.0}, {:.0}) lies outside the photographs", k.cx, k.cy));
    }
    let corners = views.iter().flatten().map(|c| c.pixel);
    let filled = covered(corners, size);
    if filled < 0.5 && model != LensModel::Pinhole {
        let found =
            format!("the corners cover {:.0} % of the photographs; the lens is guessed elsewhere", 100.0 * filled);
        warnings.push(found);
    }
    debug_assert!(views.iter().flatten().all(|c| c.id < board.corners().len()));
    let of_view = |(view, seen): (&View, &Vec<SeenCorner>)| {
        let (mut sum, mut used) = (0.0, 0.0);
        for ((p, pixel), _) in view.pairs.iter().zip(&view.used).filter(|(_, used)| **used) {
            let predicted = camera.img_from_cam(&(view.pose * *p)).unwrap_or(*pixel);
            sum += (pixel - predicted).norm_squared();
            used += 1.0;
        }
        let left_out = seen.iter().zip(&view.used).filter(|(_, used)| !**used).map(|(c, _)| c.id).collect();
        CalibratedView { cam_from_board: view.pose, rms_px: (sum / f64::max(used, 1.0)).sqrt(), left_out }
    };
    let views = solved.iter().zip(views).map(of_view).collect();
    Ok(Calibration { camera: *camera, std, rms_px, corners: count, views, warnings })
}

/// Share of a grid of 8x6 cells over the photograph that holds a corner.
fn covered(corners: impl Iterator<Item = Point2<f64>>, size: ImageSize) -> f64 {
    let mut cells = [false; 48];
    for p in corners {
        let cell = |v: f64, along: usize, count: usize| {
            ((v + 0.5) / along as f64 * count as f64).clamp(0.0, count as f64 - 1.0) as usize
        };
        cells[cell(p.y, size.height, 6) * 8 + cell(p.x, size.width, 8)] = true;
    }
    cells.iter().filter(|c| **c).count() as f64 / 48.0
}

/// Focal lengths in closed form, the principal point in the middle of the image.
fn initial_intrinsics(views: &[Vec<Pair>], size: ImageSize) -> Result<Intrinsics, CalibrationError> {
    let (cx, cy) = ((size.width as f64 - 1.0) / 2.0, (size.height as f64 - 1.0) / 2.0);
    let unit = size.width.max(size.height) as f64;
    // Unknown are 1 / fx^2 and 1 / fy^2: the board's axes are at right angles and of equal length.
    let mut normal = nalgebra::Matrix2::zeros();
    let mut right = nalgebra::Vector2::zeros();
    for pairs in views {
        let flat: Vec<_> = pairs
            .iter()
            .map(|(p, pixel)| (p.xy(), Point2::new((pixel.x - cx) / unit, (pixel.y - cy) / unit)))
            .collect();
        let h: Matrix3<f64> = Homography::fit(&flat).ok_or(CalibrationError::NotTilted)?.0;
        let (a, b) = (h.column(0), h.column(1));
        let scale = a.norm() * b.norm();
        for (row, value) in [
            (nalgebra::Vector2::new(a[0] * b[0], a[1] * b[1]), -a[2] * b[2]),
            (nalgebra::Vector2::new(a[0] * a[0] - b[0] * b[0], a[1] * a[1] - b[1] * b[1]), b[2] * b[2] - a[2] * a[2]),
        ] {
            let (row, value) = (row / scale, value / scale);
            normal += row * row.transpose();
            right += row * value;
        }
    }
    let separate = normal.try_inverse().map(|inverse| inverse * right).filter(|s| s.iter().all(|v| *v > 0.0));
    // Square pixels where both cannot be told apart.
    let one = (normal[(0, 0)] + 2.0 * normal[(0, 1)] + normal[(1, 1)], right.x + right.y);
    let inverse_squares = match separate.filter(|s| (0.25..4.0).contains(&(s.x / s.y))) {
        Some(found) => [found.x, found.y],
        None if one.0 > 1e-12 && one.1 > 0.0 => [one.1 / one.0; 2],
        None => return Err(CalibrationError::NotTilted),
    };
    let [fx, fy] = inverse_squares.map(|s| unit / s.sqrt());
    let plausible = |f: f64| (0.2..50.0).contains(&(f / unit));
    if plausible(fx) && plausible(fy) { Ok(Intrinsics { fx, fy, cx, cy }) } else { Err(CalibrationError::NotTilted) }
}

/// Marks corners as wrong or right; whether anything changed.
fn leave_out_wrong(camera: &LensCamera, views: &mut [View]) -> bool {
    let lengths = |view: &View| -> Vec<f64> {
        let off = |(p, pixel): &Pair| camera.img_from_cam(&(view.pose * *p)).map(|q| (pixel - q).norm());
        view.pairs.iter().map(|pair| off(pair).unwrap_or(f64::INFINITY)).collect()
    };
    let mut all: Vec<f64> = views.iter().flat_map(lengths).collect();
    all.sort_by(f64::total_cmp);
    let limit = (OUTLIER * all[all.len() / 2]).max(0.5);
    let mut changed = false;
    for view in views {
        let now: Vec<bool> = lengths(view).iter().map(|r| *r < limit).collect();
        let enough = now.iter().filter(|u| **u).count() >= FEWEST_CORNERS;
        if enough && now != view.used {
            view.used = now;
            changed = true;
        }
    }
    changed
}

/// The normal equations of the camera after the poses are eliminated, and the squared residuals.
struct Reduced {
    hessian: SMatrix<f64, 9, 9>,
    right: SVector<f64, 9>,
    cost: f64,
    /// Of each view: own block inverted, its right side, and the mixed block (pose by camera).
    poses: Vec<(Matrix6<f64>, Vector6<f64>, SMatrix<f64, 6, 9>)>,
}

fn linearise(camera: &LensCamera, views: &[View], model: LensModel, damping: f64) -> Option<Reduced> {
    let mut reduced = Reduced { hessian: SMatrix::zeros(), right: SVector::zeros(), cost: 0.0, poses: Vec::new() };
    for view in views {
        let (mut own, mut right, mut mixed) = (Matrix6::zeros(), Vector6::zeros(), SMatrix::<f64, 6, 9>::zeros());
        for ((p, pixel), _) in view.pairs.iter().zip(&view.used).filter(|(_, used)| **used) {
            let (predicted, mut by_camera, by_pose) = camera.project(&(view.pose * *p))?;
            (0..9).filter(|&i| !model.is_free(i)).for_each(|i| by_camera.column_mut(i).fill(0.0));
            let residual = pixel - predicted;
            own += by_pose.transpose() * by_pose;
            right += by_pose.transpose() * residual;
            mixed += by_pose.transpose() * by_camera;
            reduced.hessian += by_camera.transpose() * by_camera;
            reduced.right += by_camera.transpose() * residual;
            reduced.cost += residual.norm_squared();
        }
        for i in 0..6 {
            own[(i, i)] *= 1.0 + damping;
        }
        reduced.poses.push((own.cholesky()?.inverse(), right, mixed));
    }
    for i in 0..9 {
        reduced.hessian[(i, i)] *= 1.0 + damping;
    }
    for (inverse, right, mixed) in &reduced.poses {
        reduced.hessian -= mixed.transpose() * inverse * mixed;
        reduced.right -= mixed.transpose() * inverse * right;
    }
    (0..9).filter(|&i| !model.is_free(i)).for_each(|i| reduced.hessian[(i, i)] = 1.0);
    reduced.cost.is_finite().then_some(reduced)
}

/// Levenberg-Marquardt; the undamped equations at the end. `None` where they have no solution.
fn solve(camera: &mut LensCamera, views: &mut [View], model: LensModel, most: usize) -> Option<Reduced> {
    let mut damping = 1e-4;
    let mut cost = linearise(camera, views, model, damping)?.cost;
    for _ in 0..most {
        let reduced = linearise(camera, views, model, damping)?;
        // Focal lengths and coefficients differ by orders: unit diagonal first.
        let scale = reduced.hessian.diagonal().map(|d| 1.0 / d.abs().sqrt().max(1e-12));
        let scaled = SMatrix::<f64, 9, 9>::from_fn(|i, j| reduced.hessian[(i, j)] * scale[i] * scale[j]);
        let by = scaled.cholesky().map(|c| c.solve(&reduced.right.component_mul(&scale)).component_mul(&scale));
        let next = by.map(|by| {
            let poses: Vec<_> = reduced
                .poses
                .iter()
                .zip(views.iter())
                .map(|((inverse, right, mixed), view)| moved(&view.pose, &(inverse * (right - mixed * by))))
                .collect();
            (LensCamera::from_parameters(&(camera.parameters() + by)), poses)
        });
        let after = next.as_ref().map_or(f64::INFINITY, |(camera, poses)| total(camera, views, poses));
        match next {
            Some((moved_camera, poses)) if after < cost => {
                *camera = moved_camera;
                views.iter_mut().zip(poses).for_each(|(view, pose)| view.pose = pose);
                let gain = cost - after;
                cost = after;
                damping = (damping * 0.2).max(1e-12);
                if gain < 1e-10 * cost {
                    break;
                }
            }
            _ if damping > 1e8 => break,
            _ => damping *= 10.0,
        }
    }
    linearise(camera, views, model, 0.0)
}

fn total(camera: &LensCamera, views: &[View], poses: &[Rigid3<Camera, Board>]) -> f64 {
    let mut sum = 0.0;
    for (view, pose) in views.iter().zip(poses) {
        for ((p, pixel), _) in view.pairs.iter().zip(&view.used).filter(|(_, used)| **used) {
            match camera.img_from_cam(&(*pose * *p)) {
                Some(predicted) => sum += (pixel - predicted).norm_squared(),
                None => return f64::INFINITY,
            }
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;
    use rand::RngExt;

    const LENS: LensCamera = LensCamera {
        intrinsics: Intrinsics { fx: 460.0, fy: 463.0, cx: 317.0, cy: 238.0 },
        distortion: [0.12, -0.3, 0.003, -0.002, 0.15],
    };
    const SIZE: ImageSize = ImageSize::new(640, 480);

    fn views(noise_px: f64, seed: u64) -> (BoardSpec, Vec<Vec<SeenCorner>>) {
        let board: BoardSpec = "charuco:9x7:0.03:0.02:DICT_5X5_100".parse().expect("a board");
        let mut rng = mb_job::rng(seed, 0);
        let views = (0..12)
            .map(|i| {
                let (tilt_x, tilt_y) = (0.6 * f64::from(i).sin(), 0.6 * f64::from(2 * i).cos());
                let center = Rigid3::<Board, Board>::from_translation(nalgebra::Vector3::new(-0.135, -0.105, 0.0));
                let at = Vector6::new(tilt_x, tilt_y, 0.2 * f64::from(i), 0.02 * f64::from(i % 3 - 1), 0.0, 0.33);
                let pose = Rigid3::<Camera, Board>::exp(&at) * center;
                let project = |(id, c): (usize, &Point2<f64>)| {
                    let exact = LENS.img_from_cam(&(pose * Point3::new(c.x, c.y, 0.0)))?;
                    let mut noise = || noise_px * (0..12).map(|_| rng.random_range(-0.5..0.5)).sum::<f64>();
                    let pixel = Point2::new(exact.x + noise(), exact.y + noise());
                    let inside = pixel.x > 0.0 && pixel.y > 0.0 && pixel.x < 639.0 && pixel.y < 479.0;
                    inside.then_some(SeenCorner { id, pixel })
                };
                board.corners().iter().enumerate().filter_map(project).collect()
            })
            .collect();
        (board, views)
    }

    #[test]
    fn exact_corners_give_back_the_camera() {
        let (board, views) = views(0.0, 0);
        let found = calibrate(&board, &views, SIZE, LensModel::Full).expect("a camera");
        assert!(found.rms_px < 1e-6, "{}", found.rms_px);
        assert!((found.camera.parameters() - LENS.parameters()).amax() < 1e-3, "{:?}", found.camera);
    }

    #[test]
    fn noise_moves_the_camera_by_what_is_told() {
        let mut squares = [0.0; 9];
        let trials = 20;
        for seed in 0..trials {
            let (board, mut views) = views(0.1, seed);
            // A wrong corner must not matter.
            views[2][5].pixel.x += 9.0;
            let found = calibrate(&board, &views, SIZE, LensModel::Full).expect("a camera");
            // 9 numbers of the camera and 6 of each view take their share of the noise.
            let left = 1.0 - (9.0 + 6.0 * 12.0) / (2.0 * found.corners as f64);
            assert!((found.rms_px / (0.02 * left).sqrt() - 1.0).abs() < 0.1, "{}", found.rms_px);
            assert_eq!(found.views[2].left_out, [views[2][5].id]);
            let error = found.camera.parameters() - LENS.parameters();
            (0..9).for_each(|i| squares[i] += (error[i] / found.std[i]).powi(2) / trials as f64);
        }
        assert!(squares.iter().all(|s| (0.3..2.5).contains(s)), "{squares:?}");
    }

    #[test]
    fn views_that_determine_nothing_are_told_apart() {
        let (board, views) = views(0.0, 0);
        let few = calibrate(&board, &views[..2], SIZE, LensModel::Full);
        assert_eq!(few, Err(CalibrationError::TooFewViews { found: 2 }));
        // Face on three times.
        let flat: Vec<Vec<SeenCorner>> = (0..3)
            .map(|i| {
                let pose = Rigid3::<Camera, Board>::from_translation(nalgebra::Vector3::new(
                    -0.1,
                    -0.1,
                    0.4 + 0.1 * f64::from(i),
                ));
                let pixel = |c: &Point2<f64>| {
                    LensCamera::pinhole(LENS.intrinsics)
                        .img_from_cam(&(pose * Point3::new(c.x, c.y, 0.0)))
                        .expect("in front")
                };
                board.corners().iter().enumerate().map(|(id, c)| SeenCorner { id, pixel: pixel(c) }).collect()
            })
            .collect();
        assert!(calibrate(&board, &flat, SIZE, LensModel::Full).is_err());
    }
}
