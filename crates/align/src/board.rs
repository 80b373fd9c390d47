//! `align board`: reference poses of every frame from a calibration board in view.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use mb_boards::{
    BoardDetector, BoardPattern, BoardSpec, CalibrationError, Detection, DictionaryFit, LensCamera, LensModel,
    SeenCorner, SeenMarker, calibrate, estimate_board_pose, fitting_dictionaries, luma,
};
use mb_capture::{Frame, FrameId, Sequence, write_intrinsics_txt, write_pose_txt};
use mb_geometry::{Board, Camera, ImageSize, Rigid3, Sim3, World};
use mb_image::Image;
use mb_job::{Error, InputError, Progress, Result, Steps, write_atomic};
use nalgebra::Point3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::output::rows;

/// How [`align_board`] works.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BoardOptions {
    /// Estimate one camera with a lens for all frames from their corners, in the place of the sequence's intrinsics.
    pub calibrate: bool,
}

/// What came out, for people and programs; also `board/board.json`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BoardSummary {
    /// The board, as text.
    pub board: String,
    /// Frames with a pose.
    pub posed: usize,
    /// Corners used, over all frames.
    pub corners: usize,
    /// Root mean square residual length over them, pixels.
    pub rms_px: f64,
    /// The camera, where it was estimated.
    pub calibration: Option<CalibrationSummary>,
    /// Length of one of the phone's metres in metres of the board, from the camera centres; `None` where the phone did not
    /// move enough to tell.
    pub phone_scale: Option<f64>,
    /// Every frame, in order.
    pub frames: Vec<BoardFrame>,
    /// The folder written.
    pub written: PathBuf,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

/// A calibrated camera.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CalibrationSummary {
    /// Focal lengths, principal point (pixels, centres at integers) and OpenCV's `k1, k2, p1, p2, k3`.
    #[serde(flatten)]
    pub camera: LensCamera,
    /// Standard deviations of fx, fy, cx, cy, pixels.
    pub intrinsics_std_px: [f64; 4],
    /// Root mean square residual length, pixels.
    pub rms_px: f64,
    /// Views that it comes from.
    pub views: usize,
}

/// What became of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum BoardOutcome {
    /// It has a pose.
    Posed,
    /// There is no photograph.
    NoPhotograph,
    /// The board is not in the photograph, or too blurred or too small.
    NoBoard,
    /// Too few corners for a pose, or corners on a line.
    TooFewCorners,
}

/// One frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BoardFrame {
    /// Which frame.
    pub frame: FrameId,
    /// What became of it.
    pub outcome: BoardOutcome,
    /// Markers seen.
    pub markers: usize,
    /// Corners seen.
    pub corners: Vec<SeenCorner>,
    /// Corners left out as wrong.
    pub left_out: usize,
    /// Root mean square residual length of the others, pixels.
    pub rms_px: Option<f64>,
    /// The camera in the board's frame, which is the world of these poses.
    pub world_from_cam: Option<Rigid3<World, Camera>>,
    /// Covariance of the pose, left perturbation in the board's frame, `[rotation; translation]` (rad, m), row-major.
    pub covariance: Option<[[f64; 6]; 6]>,
}

/// Where the reference poses lie inside a sequence folder; it can be read wherever a folder of poses is.
const FOLDER: &str = "board";
/// A pose with the board tilted the other way must fit worse by this factor.
const CLEARLY_WORSE: f64 = 1.5;
/// A print whose size is off by more than this is told.
const SCALE_TOLERANCE: f64 = 0.02;
/// Corners are found to a few hundredths of a pixel; more than this is the camera's.
const POOR_FIT_PX: f64 = 0.6;
/// Photographs looked at to find out why there is no board.
const MOST_DIAGNOSED: usize = 8;

/// Finds the board in every photograph, and writes `board/`: `pose/NNNNNN.txt` (camera to board), `intrinsic/NNNNNN.txt`
/// and `board.json`. A folder that an earlier run left is replaced.
///
/// # Errors
/// No photograph shows the board (what is seen instead is said); a photograph is damaged; with `calibrate`, the views
/// determine no camera.
pub fn align_board(
    sequence: &Sequence,
    board: &BoardSpec,
    options: &BoardOptions,
    progress: &dyn Progress,
) -> Result<BoardSummary> {
    let detector = BoardDetector::new(board);
    let steps = Steps::new(progress, "looking for the board", sequence.frames().len());
    let detections: Vec<Detection> = sequence
        .frames()
        .par_iter()
        .map(|frame| {
            let found = match &frame.image {
                Some(_) => detector.detect(&luma(&sequence.read_image(frame)?)),
                None => Detection::default(),
            };
            steps.step()?;
            Ok(found)
        })
        .collect::<Result<_>>()?;
    if detections.iter().all(|d| d.corners.is_empty()) {
        return Err(explain_absence(sequence, board, &detections)?);
    }

    let mut warnings: Vec<String> = Vec::new();
    for (frame, found) in sequence.frames().iter().zip(&detections) {
        warnings.extend(found.warnings.iter().map(|w| format!("frame {}: {w}", frame.id)));
    }
    let calibration = if options.calibrate {
        Some(camera_of(&sequence.root().join("image"), board, sequence.image_size(), &detections, &mut warnings)?)
    } else {
        None
    };
    let calibrated = calibration.as_ref().map(|c| c.camera);
    let camera = |frame: &Frame| calibrated.unwrap_or(LensCamera::pinhole(frame.intrinsics));
    let frames: Vec<BoardFrame> = sequence
        .frames()
        .iter()
        .zip(&detections)
        .map(|(frame, found)| posed(board, frame, found, &camera(frame), &mut warnings))
        .collect();
    let posed = frames.iter().filter(|f| f.outcome == BoardOutcome::Posed).count();
    let used = |f: &BoardFrame| (f.corners.len() - f.left_out) as f64;
    let residuals: Vec<(f64, f64)> = frames.iter().filter_map(|f| Some((f.rms_px?, used(f)))).collect();
    let corners: f64 = residuals.iter().map(|(_, n)| n).sum();
    let rms_px = (residuals.iter().map(|(rms, n)| rms * rms * n).sum::<f64>() / corners.max(1.0)).sqrt();
    let phone_scale = phone_scale(sequence, &frames);
    if let Some(scale) = phone_scale.filter(|s| (s - 1.0).abs() > SCALE_TOLERANCE) {
        warnings.push(format!(
            "a metre of the poses in pose/ is {scale:.3} metres by the board: if the poses are metric, the board's lengths \
             are wrong by that factor (measure a square of the print)"
        ));
    }
    if calibration.is_none() && rms_px > POOR_FIT_PX {
        warnings.push(format!(
            "{rms_px:.1} px remain between corners and board: the intrinsics or the lens do not fit; try --calibrate"
        ));
    }
    let written = sequence.root().join(FOLDER);
    let summary = BoardSummary {
        board: board.to_string(),
        posed,
        corners: corners as usize,
        rms_px,
        calibration,
        phone_scale,
        frames,
        written,
        warnings,
    };
    write(sequence, &summary, camera)?;
    Ok(summary)
}

fn posed(
    board: &BoardSpec,
    frame: &Frame,
    found: &Detection,
    camera: &LensCamera,
    warnings: &mut Vec<String>,
) -> BoardFrame {
    let mut result = BoardFrame {
        frame: frame.id,
        outcome: BoardOutcome::NoBoard,
        markers: found.markers.len(),
        corners: found.corners.clone(),
        left_out: 0,
        rms_px: None,
        world_from_cam: None,
        covariance: None,
    };
    if frame.image.is_none() {
        result.outcome = BoardOutcome::NoPhotograph;
    } else if !found.corners.is_empty() {
        result.outcome = BoardOutcome::TooFewCorners;
        if let Some(pose) = estimate_board_pose(board, &found.corners, camera) {
            result.outcome = BoardOutcome::Posed;
            result.left_out = pose.residuals_px.iter().filter(|r| r.is_none()).count();
            result.rms_px = Some(pose.rms_px);
            let board_from_cam = pose.cam_from_board.inverse();
            // The board's frame is the world of these poses.
            let world_from_cam = Rigid3::from_parts(board_from_cam.rotation(), board_from_cam.translation());
            result.world_from_cam = Some(world_from_cam);
            result.covariance = Some(rows(&pose.covariance));
            if let Some(other) = pose.other_rms_px.filter(|other| *other < CLEARLY_WORSE * pose.rms_px) {
                warnings.push(format!(
                    "frame {}: the board tilted the other way fits nearly as well ({:.2} and {other:.2} px)",
                    frame.id, pose.rms_px
                ));
            }
        }
    }
    result
}

/// Photographs of a board, and the camera that took them.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PhotoCalibration {
    /// The board, as text.
    pub board: String,
    /// The camera.
    pub calibration: CalibrationSummary,
    /// Every photograph, in the order given.
    pub photos: Vec<CalibratedPhoto>,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

/// One photograph of a [`PhotoCalibration`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CalibratedPhoto {
    /// The file.
    pub photo: PathBuf,
    /// Markers seen.
    pub markers: Vec<SeenMarker>,
    /// Corners seen.
    pub corners: Vec<SeenCorner>,
    /// Corners left out as wrong.
    pub left_out: usize,
    /// Root mean square residual length of the others, pixels; `None` where the board was not found.
    pub rms_px: Option<f64>,
    /// The camera's pose.
    pub cam_from_board: Option<Rigid3<Camera, Board>>,
}

/// Calibrates the camera that took some photographs of a board.
///
/// # Errors
/// A photograph is missing or damaged, or not of the size of the first; none shows the board; or too few do to determine
/// a camera.
pub fn calibrate_photos(paths: &[PathBuf], board: &BoardSpec, progress: &dyn Progress) -> Result<PhotoCalibration> {
    let Some(first) = paths.first() else {
        return Err(Error::Failed("no photographs are given".to_owned()));
    };
    let size = mb_image::read_size(first)?;
    let read = |path: &PathBuf| {
        let photo = mb_image::read_rgb(path)?;
        if photo.size() == size {
            return Ok(luma(&photo));
        }
        let found = format!("{} pixels, but {} has {size}", photo.size(), first.display());
        Err(InputError::new(path, found).help("One camera takes photographs of one size").into())
    };
    let detector = BoardDetector::new(board);
    let steps = Steps::new(progress, "looking for the board", paths.len());
    let detections: Vec<Detection> = paths
        .par_iter()
        .map(|path| {
            let found = detector.detect(&read(path)?);
            steps.step()?;
            Ok(found)
        })
        .collect::<Result<_>>()?;
    let place = first.parent().unwrap_or(first);
    if detections.iter().all(|d| d.corners.is_empty()) {
        let images: Vec<Image<u8>> = paths.iter().take(MOST_DIAGNOSED).map(read).collect::<Result<_>>()?;
        let found = format!("the board {board} is in none of the {} photographs", paths.len());
        return Err(InputError::new(place, found).help(advice(board, &images)).into());
    }
    let mut warnings: Vec<String> = Vec::new();
    for (path, found) in paths.iter().zip(&detections) {
        warnings.extend(found.warnings.iter().map(|w| format!("{}: {w}", path.display())));
    }
    let calibration = camera_of(place, board, size, &detections, &mut warnings)?;
    let photos = paths
        .iter()
        .zip(detections)
        .map(|(path, found)| {
            let pose = estimate_board_pose(board, &found.corners, &calibration.camera);
            CalibratedPhoto {
                photo: path.clone(),
                left_out: pose.as_ref().map_or(0, |p| p.residuals_px.iter().filter(|r| r.is_none()).count()),
                rms_px: pose.as_ref().map(|p| p.rms_px),
                cam_from_board: pose.map(|p| p.cam_from_board),
                markers: found.markers,
                corners: found.corners,
            }
        })
        .collect();
    Ok(PhotoCalibration { board: board.to_string(), calibration, photos, warnings })
}

fn camera_of(
    place: &Path,
    board: &BoardSpec,
    size: ImageSize,
    detections: &[Detection],
    warnings: &mut Vec<String>,
) -> Result<CalibrationSummary> {
    let views: Vec<Vec<SeenCorner>> =
        detections.iter().filter(|d| d.corners.len() >= 6).map(|d| d.corners.clone()).collect();
    let count = views.len();
    let fit = calibrate(board, &views, size, LensModel::Full).map_err(|e| {
        let help = match e {
            CalibrationError::TooFewViews { .. } => "Take more photographs of the board, or drop --calibrate",
            CalibrationError::NotTilted => {
                "Take photographs with the board tilted by 30 degrees and more, in several directions"
            }
            CalibrationError::NoAgreement { .. } => {
                "Check the board's columns, rows and lengths, and that one camera took all photographs"
            }
        };
        Error::from(InputError::new(place, e.to_string()).help(help))
    })?;
    warnings.extend(fit.warnings);
    Ok(CalibrationSummary {
        camera: fit.camera,
        intrinsics_std_px: std::array::from_fn(|i| fit.std[i]),
        rms_px: fit.rms_px,
        views: count,
    })
}

/// How long one of the phone's metres is by the board, where the camera moved by 5 cm and more.
fn phone_scale(sequence: &Sequence, frames: &[BoardFrame]) -> Option<f64> {
    let (board, phone): (Vec<Point3<f64>>, Vec<Point3<f64>>) = frames
        .iter()
        .filter_map(|f| {
            let phone = sequence.frame(f.frame)?.world_from_cam.translation();
            Some((Point3::from(f.world_from_cam?.translation()), Point3::from(phone)))
        })
        .unzip();
    let spread = mb_geometry::Aabb::of(&board).extent().norm();
    let moved = mb_geometry::Aabb::of(&phone).extent().norm();
    let tells = board.len() >= 4 && spread > 0.05 && moved > 1e-3;
    if !tells {
        return None;
    }
    Sim3::<World, World>::align(&board, &phone, true).map(|sim| sim.scale)
}

fn write(sequence: &Sequence, summary: &BoardSummary, camera: impl Fn(&Frame) -> LensCamera) -> Result<()> {
    let folder = &summary.written;
    match std::fs::remove_dir_all(folder) {
        Err(e) if e.kind() != ErrorKind::NotFound => return Err(Error::write(folder, e)),
        _ => {}
    }
    for result in &summary.frames {
        let (Some(world_from_cam), Some(frame)) = (&result.world_from_cam, sequence.frame(result.frame)) else {
            continue;
        };
        write_pose_txt(folder.join(format!("pose/{}.txt", result.frame)), world_from_cam)?;
        write_intrinsics_txt(folder.join(format!("intrinsic/{}.txt", result.frame)), &camera(frame).intrinsics)?;
    }
    let path = folder.join("board.json");
    let mut bytes = serde_json::to_vec_pretty(summary).map_err(|e| Error::write(&path, e.into()))?;
    bytes.push(b'\n');
    write_atomic(&path, &bytes)
}

/// Why no photograph shows the board, as far as the photographs tell.
fn explain_absence(sequence: &Sequence, board: &BoardSpec, detections: &[Detection]) -> Result<Error> {
    let place = sequence.root().join("image");
    let with_photo: Vec<&Frame> = sequence.frames().iter().filter(|f| f.image.is_some()).collect();
    if with_photo.is_empty() {
        return Ok(InputError::new(place, "no photographs").help("`align board` looks for the board in image/").into());
    }
    // Those that show markers of the board's dictionary first, then some spread over the sequence.
    let mut chosen: Vec<&Frame> = sequence
        .frames()
        .iter()
        .zip(detections)
        .filter(|(_, d)| !d.warnings.is_empty())
        .map(|(f, _)| f)
        .take(MOST_DIAGNOSED / 2)
        .collect();
    let stride = with_photo.len().div_ceil(MOST_DIAGNOSED / 2);
    chosen.extend(with_photo.iter().step_by(stride));
    let images: Vec<Image<u8>> = chosen.iter().map(|f| Ok(luma(&sequence.read_image(f)?))).collect::<Result<_>>()?;
    let found = format!("the board {board} is in none of the {} photographs", with_photo.len());
    let help = advice(board, &images);
    Ok(InputError::new(place, found).help(help).into())
}

/// What to try instead of a board that was not found.
fn advice(board: &BoardSpec, images: &[Image<u8>]) -> String {
    let fits = fitting_dictionaries(images);
    let own_ids: Vec<usize> = board.markers().iter().map(|m| m.id).collect();
    let own = fits.iter().find(|f| f.dictionary == board.dictionary().name());
    let own_count = own.map_or(0, |f| f.ids.iter().filter(|id| own_ids.contains(id)).count());
    if let Some(other) = arrangement(board, images) {
        return format!("{own_count} of its markers are seen, but arranged as on {other}: name that board");
    }
    match fits.first() {
        Some(best) if best.markers > own_count.max(1) => format!(
            "{} of its markers were seen in {} of the photographs; {} different markers of {} are there (ids {}): check \
             the dictionary",
            own_count,
            images.len(),
            best.markers,
            best.dictionary,
            told(best)
        ),
        _ if own_count > 0 => format!(
            "{own_count} of its {} markers are seen, but not where the board has them: check columns x rows, legacy and the \
             ratio of marker to square",
            own_ids.len()
        ),
        _ => "No marker of any predefined dictionary is seen: check the focus, that white surrounds the markers, and that \
              the print is not mirrored"
            .to_owned(),
    }
}

/// Ids in a few words.
fn told(fit: &DictionaryFit) -> String {
    match fit.ids[..] {
        [first, .., last] if fit.ids.len() > 4 => format!("{first} to {last}"),
        _ => fit.ids.iter().map(usize::to_string).collect::<Vec<_>>().join(", "),
    }
}

/// A board of the same markers in another arrangement that is in the photographs: columns and rows swapped, the other
/// pattern.
fn arrangement(board: &BoardSpec, images: &[Image<u8>]) -> Option<BoardSpec> {
    let BoardPattern::Charuco { square_m, marker_m, legacy } = board.pattern() else { return None };
    let (columns, rows) = (board.columns(), board.rows());
    let candidates = [(columns, rows, !legacy), (rows, columns, legacy), (rows, columns, !legacy)]
        .into_iter()
        .filter_map(|(c, r, l)| {
            let pattern = BoardPattern::Charuco { square_m, marker_m, legacy: l };
            BoardSpec::new(pattern, c, r, board.dictionary().clone(), 0).ok().filter(|b| b != board)
        });
    let seen = |board: &BoardSpec| -> usize {
        let detector = BoardDetector::new(board);
        images.iter().map(|image| detector.detect(image).corners.len()).sum()
    };
    candidates.map(|b| (seen(&b), b)).filter(|(n, _)| *n > 0).max_by_key(|(n, _)| *n).map(|(_, b)| b)
}
