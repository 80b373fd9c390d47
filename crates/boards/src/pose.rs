//! Where a camera is, from the board that it sees.

use mb_geometry::{Board, Camera, Rigid3};
use nalgebra::{Matrix3, Matrix6, Point2, Point3, Rotation3, UnitQuaternion, Vector3, Vector6};

use crate::camera::moved;
use crate::homography::Homography;
use crate::{BoardSpec, LensCamera, SeenCorner};

/// The pose of a camera that sees a board, with the evidence for it.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardPose {
    /// The pose.
    pub cam_from_board: Rigid3<Camera, Board>,
    /// Covariance of `board_from_cam`, left perturbation in the board's frame, `[rotation; translation]` (rad, m), scaled
    /// by the residuals' variance. It takes board and camera as exact.
    pub covariance: Matrix6<f64>,
    /// Root mean square residual length over the corners used, pixels.
    pub rms_px: f64,
    /// Found minus predicted, of each corner given; `None` for corners left out as wrong.
    pub residuals_px: Vec<Option<f64>>,
    /// How much worse the best pose with the board tilted the other way fits (root mean square residual, pixels), where
    /// there is one: a board seen nearly face on, or from far, has two poses that fit.
    pub other_rms_px: Option<f64>,
}

/// Fewest corners that a pose is computed from.
const FEWEST: usize = 4;
/// A corner further off than this multiple of the typical residual is wrong.
const OUTLIER: f64 = 5.0;
/// Residuals below this are never wrong, pixels.
const SURELY_RIGHT_PX: f64 = 1.0;

/// One corner: board (z = 0) and photograph.
pub(crate) type Pair = (Point3<f64>, Point2<f64>);

/// Corners of the board with their pixels.
pub(crate) fn pairs(board: &BoardSpec, corners: &[SeenCorner]) -> Vec<Pair> {
    let on_board = board.corners();
    corners.iter().map(|c| (Point3::new(on_board[c.id].x, on_board[c.id].y, 0.0), c.pixel)).collect()
}

/// Estimates the pose from corners: a homography gives the start and its twin (the board tilted the other way),
/// Levenberg-Marquardt on pixel residuals polishes both, and the better is taken. Corners that do not agree with the
/// others are left out.
///
/// `None` where fewer than four corners, or corners on a line, determine no pose.
pub fn estimate_board_pose(board: &BoardSpec, corners: &[SeenCorner], camera: &LensCamera) -> Option<BoardPose> {
    let pairs = pairs(board, corners);
    let start = initial_pose(&pairs, camera)?;
    let mut used = vec![true; pairs.len()];
    let mut best = polish(&pairs, &used, camera, &start)?;
    let mut other = polish(&pairs, &used, camera, &twin(&pairs, &start));
    if let Some(twin) = other.filter(|twin| twin.1 < best.1) {
        other = Some(best);
        best = twin;
    }
    for _ in 0..3 {
        let lengths = residuals(&pairs, camera, &best.0);
        let mut sorted: Vec<f64> = lengths.iter().map(|r| r.unwrap_or(f64::INFINITY)).collect();
        sorted.sort_by(f64::total_cmp);
        let limit = (OUTLIER * sorted[sorted.len() / 2]).max(SURELY_RIGHT_PX);
        let now: Vec<bool> = lengths.iter().map(|r| r.is_some_and(|r| r < limit)).collect();
        if now == used || now.iter().filter(|u| **u).count() < FEWEST.max(pairs.len() / 2) {
            break;
        }
        used = now;
        best = polish(&pairs, &used, camera, &best.0)?;
    }
    let (cam_from_board, cost, normal) = best;
    let count = used.iter().filter(|u| **u).count();
    // Four corners leave two numbers over; of a perfect fit nothing is known but that it is no better than a hundredth.
    let freedom = (2 * count).saturating_sub(6).max(1) as f64;
    let variance = (cost / freedom).max(1e-4);
    let by_cam = normal.try_inverse()? * variance;
    let lengths = residuals(&pairs, camera, &cam_from_board);
    let differs = |t: &Rigid3<Camera, Board>| (t.inverse() * cam_from_board).angle_rad() > 0.02;
    Some(BoardPose {
        covariance: in_board_frame(&by_cam, &cam_from_board),
        cam_from_board,
        rms_px: (cost / count as f64).sqrt(),
        residuals_px: lengths.iter().zip(&used).map(|(r, used)| r.filter(|_| *used)).collect(),
        other_rms_px: other.filter(|(t, ..)| differs(t)).map(|(_, cost, _)| (cost / pairs.len() as f64).sqrt()),
    })
}

/// Covariance of `board_from_cam` (left, board frame) from that of `cam_from_board` (left, camera frame): the inverse
/// moves by minus the adjoint.
fn in_board_frame(covariance: &Matrix6<f64>, cam_from_board: &Rigid3<Camera, Board>) -> Matrix6<f64> {
    let board_from_cam = cam_from_board.inverse();
    let rotation = board_from_cam.rotation_matrix();
    let mut adjoint = Matrix6::zeros();
    adjoint.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
    adjoint.fixed_view_mut::<3, 3>(3, 3).copy_from(&rotation);
    adjoint.fixed_view_mut::<3, 3>(3, 0).copy_from(&(board_from_cam.translation().cross_matrix() * rotation));
    adjoint * covariance * adjoint.transpose()
}

fn residuals(pairs: &[Pair], camera: &LensCamera, cam_from_board: &Rigid3<Camera, Board>) -> Vec<Option<f64>> {
    pairs.iter().map(|(p, pixel)| camera.img_from_cam(&(*cam_from_board * *p)).map(|q| (pixel - q).norm())).collect()
}

/// The pose that a homography from the board to the plane at depth 1 stands for (Zhang 2000, section 3.1).
pub(crate) fn initial_pose(pairs: &[Pair], camera: &LensCamera) -> Option<Rigid3<Camera, Board>> {
    let flat: Vec<_> =
        pairs.iter().map(|(p, pixel)| Some((p.xy(), camera.plane_from_img(pixel)?))).collect::<Option<_>>()?;
    let h = Homography::fit(&flat)?.0;
    let scale = 2.0 / (h.column(0).norm() + h.column(1).norm());
    // The board lies before the camera.
    let middle = flat.iter().fold(nalgebra::Vector2::zeros(), |sum, (p, _)| sum + p.coords) / flat.len() as f64;
    let depth = (h * Vector3::new(middle.x, middle.y, 1.0)).z;
    let h = h * (scale * if depth < 0.0 { -1.0 } else { 1.0 });
    let (r1, r2, t) = (h.column(0).into_owned(), h.column(1).into_owned(), h.column(2).into_owned());
    let near = Matrix3::from_columns(&[r1, r2, r1.cross(&r2)]);
    let svd = near.svd(true, true);
    let rotation = Rotation3::from_matrix_unchecked(svd.u? * svd.v_t?);
    let pose = Rigid3::from_parts(UnitQuaternion::from_rotation_matrix(&rotation), t);
    pose.is_finite().then_some(pose)
}

/// The same board tilted the other way: its normal mirrored about the line of sight to its middle.
fn twin(pairs: &[Pair], pose: &Rigid3<Camera, Board>) -> Rigid3<Camera, Board> {
    let middle = Point3::from(pairs.iter().fold(Vector3::zeros(), |sum, (p, _)| sum + p.coords) / pairs.len() as f64);
    let in_cam = *pose * middle;
    let sight = in_cam.coords.normalize();
    let normal = pose.rotate(&Vector3::z());
    let mirrored = sight * (2.0 * sight.dot(&normal)) - normal;
    let turn = Rotation3::rotation_between(&normal, &mirrored).unwrap_or_else(Rotation3::identity);
    let rotation = UnitQuaternion::from_rotation_matrix(&turn) * pose.rotation();
    Rigid3::from_parts(rotation, in_cam.coords - rotation * middle.coords)
}

/// A pose, the squared residuals that it leaves, and the normal equations there.
pub(crate) type Polished = (Rigid3<Camera, Board>, f64, Matrix6<f64>);

/// Levenberg-Marquardt over the corners in use.
pub(crate) fn polish(
    pairs: &[Pair],
    used: &[bool],
    camera: &LensCamera,
    start: &Rigid3<Camera, Board>,
) -> Option<Polished> {
    let linearise = |pose: &Rigid3<Camera, Board>| {
        let (mut normal, mut right, mut cost) = (Matrix6::zeros(), Vector6::zeros(), 0.0);
        for ((p, pixel), _) in pairs.iter().zip(used).filter(|(_, used)| **used) {
            let (predicted, _, by_pose) = camera.project(&(*pose * *p))?;
            let residual = pixel - predicted;
            normal += by_pose.transpose() * by_pose;
            right += by_pose.transpose() * residual;
            cost += residual.norm_squared();
        }
        Some((normal, right, cost))
    };
    let mut pose = *start;
    let (mut normal, mut right, mut cost) = linearise(&pose)?;
    let mut damping = 1e-4;
    for _ in 0..50 {
        let mut damped = normal;
        for i in 0..6 {
            damped[(i, i)] *= 1.0 + damping;
        }
        let step = damped.cholesky()?.solve(&right);
        let next = moved(&pose, &step);
        match linearise(&next).filter(|(.., after)| *after < cost) {
            Some(state) => {
                let gain = cost - state.2;
                pose = next;
                (normal, right, cost) = state;
                damping = (damping * 0.2).max(1e-12);
                if gain < 1e-10 * cost {
                    break;
                }
            }
            None if damping > 1e6 || step.norm() < 1e-12 => break,
            None => damping *= 10.0,
        }
    }
    Some((pose, cost, normal))
}

#[cfg(test)]
mod tests {
    use super::*;
    use mb_geometry::Intrinsics;
    use proptest::prelude::*;
    use rand::RngExt;

    const LENS: LensCamera = LensCamera {
        intrinsics: Intrinsics { fx: 460.0, fy: 463.0, cx: 317.0, cy: 238.0 },
        distortion: [0.12, -0.4, 0.003, -0.002, 0.2],
    };

    fn board() -> BoardSpec {
        "charuco:5x7:0.04:0.02:DICT_6X6_250".parse().expect("a board")
    }

    fn seen(board: &BoardSpec, pose: &Rigid3<Camera, Board>, noise_px: f64, seed: u64) -> Vec<SeenCorner> {
        let mut rng = mb_job::rng(seed, 0);
        let mut noise = || noise_px * (0..12).map(|_| rng.random_range(-0.5..0.5)).sum::<f64>();
        let corners = board.corners();
        corners
            .iter()
            .enumerate()
            .map(|(id, c)| {
                let pixel = LENS.img_from_cam(&(*pose * Point3::new(c.x, c.y, 0.0))).expect("in front");
                SeenCorner { id, pixel: Point2::new(pixel.x + noise(), pixel.y + noise()) }
            })
            .collect()
    }

    proptest! {
        #[test]
        fn exact_corners_give_back_the_pose(turn in prop::array::uniform3(-0.7..0.7f64), x in -0.15..0.0f64, z in 0.35..0.8f64) {
            let board = board();
            let truth = Rigid3::exp(&Vector6::new(turn[0], turn[1], turn[2], x, -0.14, z));
            let found = estimate_board_pose(&board, &seen(&board, &truth, 0.0, 0), &LENS).expect("a pose");
            let error = (found.cam_from_board.inverse() * truth).log().norm();
            prop_assert!(error < 1e-6, "{} {}", error, found.rms_px);
        }
    }

    #[test]
    fn wrong_corners_are_left_out() {
        let board = board();
        let truth = Rigid3::exp(&Vector6::new(0.3, -0.4, 0.1, -0.1, -0.14, 0.5));
        let mut corners = seen(&board, &truth, 0.05, 1);
        corners[3].pixel.x += 12.0;
        corners[11].pixel.y -= 7.0;
        let found = estimate_board_pose(&board, &corners, &LENS).expect("a pose");
        let left_out: Vec<usize> = (0..corners.len()).filter(|&i| found.residuals_px[i].is_none()).collect();
        assert_eq!(left_out, [3, 11]);
        assert!((found.cam_from_board.inverse() * truth).translation().norm() < 1e-3);
        assert!(estimate_board_pose(&board, &corners[..3], &LENS).is_none());
        assert!(estimate_board_pose(&board, &corners[..4], &LENS).is_none(), "four corners on a line");
    }

    #[test]
    fn the_covariance_is_that_of_many_trials() {
        let board = board();
        let truth: Rigid3<Camera, Board> = Rigid3::exp(&Vector6::new(0.4, -0.5, 0.2, -0.1, -0.14, 0.5));
        let (mut spread, mut told) = (Matrix6::zeros(), Matrix6::zeros());
        let trials = 400;
        for seed in 0..trials {
            let found = estimate_board_pose(&board, &seen(&board, &truth, 0.1, seed), &LENS).expect("a pose");
            let error = (found.cam_from_board.inverse() * truth).log();
            spread += error * error.transpose() / trials as f64;
            told += found.covariance / trials as f64;
        }
        for i in 0..6 {
            let ratio = (spread[(i, i)] / told[(i, i)]).sqrt();
            assert!((0.85..1.15).contains(&ratio), "{i}: {ratio}");
        }
    }
}
