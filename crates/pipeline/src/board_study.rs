//! The paper's study of camera poses: against a board in view, how far a phone's cameras are off, how far the aligned ones,
//! and what either does to a reconstruction.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use mb_align::{
    BoardOptions, BundleOptions, KeypointOptions, RefineOptions, align_board, align_bundle, align_keypoints,
    align_refine,
};
use mb_boards::BoardSpec;
use mb_capture::{Alignment, AlignmentStage, FrameAlignment, FrameId, PoseFolder, Sequence, read_pose_txt};
use mb_eval::{PosePair, score_poses};
use mb_geometry::{Camera, Rigid3, World};
use mb_job::{Error, InputError, Progress, Result, write_atomic};
use mb_truth::{ExactScene, PoseStudyOptions, common_motion, perturbed_pose_study};
use serde::{Deserialize, Serialize};

/// How the study is done.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BoardStudyOptions {
    /// The reconstructions and their comparison.
    pub study: PoseStudyOptions,
    /// Seed of alignment.
    pub seed: u64,
}

/// Cameras of one sequence, or of all, against the board's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StudiedPoses {
    /// Where the cameras come from: `phone`, `refine`, `bundle`; `board` in a table of errors against the truth.
    pub poses: String,
    /// Root mean square error of relative translations over all pairs of frames, millimetres.
    pub pairwise_translation_rmse_mm: f64,
    /// Mean error of relative rotations over all pairs of frames, degrees.
    pub pairwise_rotation_mean_deg: f64,
    /// Share of the reconstruction with these cameras within the threshold of the one with the reference cameras.
    pub accuracy: f64,
    /// Share of the reconstruction with the reference cameras within the threshold of the one with these.
    pub recall: f64,
}

/// One sequence.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StudiedSequence {
    /// Its folder.
    pub sequence: PathBuf,
    /// Whether a program made it (it has `simulation/`).
    pub is_simulated: bool,
    /// Frames.
    pub frames: usize,
    /// Frames that the board gives a pose.
    pub posed: usize,
    /// Root mean square residual of the board's corners, pixels.
    pub board_rms_px: f64,
    /// Cameras against the board's.
    pub against_board: Vec<StudiedPoses>,
    /// Cameras against the true ones, the board's among them; where they are known.
    pub against_truth: Vec<StudiedPoses>,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

/// The whole study.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BoardStudy {
    /// The board, as text.
    pub board: String,
    /// How many of the sequences are simulated.
    pub simulated: usize,
    /// Sequence by sequence.
    pub sequences: Vec<StudiedSequence>,
    /// Means over the sequences.
    pub mean: Vec<StudiedPoses>,
    /// What the paper prints.
    pub paper: Vec<StudiedPoses>,
    /// The options as used.
    pub options: BoardStudyOptions,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

type Pose = Rigid3<World, Camera>;
/// Cameras of some frames, in frame order.
type Cameras = Vec<(FrameId, Pose)>;

/// Studies sequences that show a board, and writes `OUT/NAME.json` for each, `OUT/poses.json` and `OUT/poses.md`.
///
/// Reference cameras come from the board ([`align_board`]). A sequence that is not yet bundle-adjusted is aligned first, from
/// its clicked points (which replaces its `pose/` and keeps the phone's in `pose_arkit/`). Reconstructions are exact depth of the
/// model fused with either cameras. A sequence whose result lies in OUT already is not done again.
///
/// # Errors
/// A sequence lacks model or clicked points, does not show the board, or cannot be aligned; a file cannot be written; or
/// the person asked for a stop (what is finished stays).
pub fn board_study(
    sequences: &[PathBuf],
    board: &BoardSpec,
    options: &BoardStudyOptions,
    out: &Path,
    progress: &dyn Progress,
) -> Result<BoardStudy> {
    if sequences.is_empty() {
        return Err(Error::Failed("no sequence to study".to_owned()));
    }
    let mut done = Vec::new();
    for (i, folder) in sequences.iter().enumerate() {
        progress.report("pose study", i, sequences.len());
        let sequence = Sequence::open(folder)?;
        let file = out.join(format!("{:02}-{}.json", i + 1, sequence.name()));
        done.push(match recorded(&file, folder, board, options) {
            Some(known) => known,
            None => {
                let studied = study_sequence(&sequence, board, options, progress)?;
                let record = Record { board: board.to_string(), options: options.clone(), result: studied };
                write_atomic(&file, &serde_json::to_vec_pretty(&record).map_err(|e| Error::write(&file, e.into()))?)?;
                record.result
            }
        });
    }
    progress.report("pose study", sequences.len(), sequences.len());
    let simulated = done.iter().filter(|s| s.is_simulated).count();
    let mut study = BoardStudy {
        board: board.to_string(),
        simulated,
        mean: mean(&done, |s| &s.against_board),
        paper: paper(),
        options: options.clone(),
        warnings: done.iter().flat_map(|s| s.warnings.iter().cloned()).collect(),
        sequences: done,
    };
    if simulated > 0 && simulated < study.sequences.len() {
        study
            .warnings
            .push(format!("{simulated} of {} sequences are simulated; the means mix both", study.sequences.len()));
    }
    let path = out.join("poses.json");
    write_atomic(&path, &serde_json::to_vec_pretty(&study).map_err(|e| Error::write(&path, e.into()))?)?;
    write_atomic(out.join("poses.md"), markdown(&study).as_bytes())?;
    Ok(study)
}

/// A finished sequence on disk, with what it was done with.
#[derive(Serialize, Deserialize)]
struct Record {
    board: String,
    options: BoardStudyOptions,
    result: StudiedSequence,
}

fn recorded(file: &Path, folder: &Path, board: &BoardSpec, options: &BoardStudyOptions) -> Option<StudiedSequence> {
    let record: Record = serde_json::from_slice(&std::fs::read(file).ok()?).ok()?;
    let same = record.board == board.to_string() && record.options == *options && record.result.sequence == folder;
    same.then_some(record.result)
}

fn study_sequence(
    sequence: &Sequence,
    board: &BoardSpec,
    options: &BoardStudyOptions,
    progress: &dyn Progress,
) -> Result<StudiedSequence> {
    let root = sequence.root();
    let name = sequence.name();
    let found = align_board(sequence, board, &BoardOptions::default(), progress)?;
    let reference: Cameras = found.frames.iter().filter_map(|f| Some((f.frame, f.world_from_cam?))).collect();
    if reference.len() < 3 {
        let what = format!("the board gives only {} frames a pose; relative poses need 3", reference.len());
        return Err(InputError::new(root.join("image"), what).into());
    }
    let (sets, alignment) = align(sequence, options, progress)?;
    let against_board = compare(sequence, &reference, &sets, &alignment, options, progress)?;
    let truth = root.join("simulation");
    let against_truth = if truth.join("pose").is_dir() {
        let truth = PoseFolder::open(&truth)?;
        let mut with_board = vec![("board".to_owned(), reference.clone())];
        with_board.extend(sets);
        compare(sequence, truth.frames(), &with_board, &alignment, options, progress)?
    } else {
        Vec::new()
    };
    Ok(StudiedSequence {
        sequence: root.to_owned(),
        is_simulated: !against_truth.is_empty(),
        frames: sequence.frames().len(),
        posed: found.posed,
        board_rms_px: found.rms_px,
        against_board,
        against_truth,
        warnings: found.warnings.iter().map(|w| format!("{name}: {w}")).collect(),
    })
}

/// The phone's cameras and the aligned ones, and the last alignment.
fn align(
    sequence: &Sequence,
    options: &BoardStudyOptions,
    progress: &dyn Progress,
) -> Result<(Vec<(String, Cameras)>, Alignment)> {
    let root = sequence.root();
    let known = root.join(Alignment::FILE).exists().then(|| sequence.read_alignment()).transpose()?;
    let cameras = |sequence: &Sequence, alignment: &Alignment| -> Cameras {
        sequence.aligned_frames(alignment).iter().map(|f| (f.id, f.world_from_cam)).collect()
    };
    let mut sets = vec![("phone".to_owned(), phone_cameras(sequence)?)];
    if let Some(alignment) = known.filter(|a| a.stage == AlignmentStage::Bundle) {
        sets.push(("bundle".to_owned(), cameras(sequence, &alignment)));
        return Ok((sets, alignment));
    }
    align_keypoints(sequence, &KeypointOptions::default(), progress)?;
    align_refine(sequence, &RefineOptions { seed: options.seed, ..RefineOptions::default() }, progress)?;
    sets.push(("refine".to_owned(), cameras(sequence, &sequence.read_alignment()?)));
    align_bundle(sequence, &BundleOptions { seed: options.seed, ..BundleOptions::default() }, progress)?;
    let bundled = Sequence::open(root)?;
    let alignment = bundled.read_alignment()?;
    sets.push(("bundle".to_owned(), cameras(&bundled, &alignment)));
    Ok((sets, alignment))
}

/// The phone's own cameras: `pose_arkit/` where bundle adjustment has replaced `pose/`.
fn phone_cameras(sequence: &Sequence) -> Result<Cameras> {
    let kept = sequence.root().join("pose_arkit");
    sequence
        .frames()
        .iter()
        .map(|frame| {
            let path = kept.join(format!("{}.txt", frame.id));
            let pose = if path.exists() { read_pose_txt(&path)?.0 } else { frame.world_from_cam };
            Ok((frame.id, pose))
        })
        .collect()
}

/// Every set of cameras against the reference, over the frames that the reference has.
fn compare(
    sequence: &Sequence,
    reference: &[(FrameId, Pose)],
    sets: &[(String, Cameras)],
    alignment: &Alignment,
    options: &BoardStudyOptions,
    progress: &dyn Progress,
) -> Result<Vec<StudiedPoses>> {
    let of = |cameras: &Cameras, id: FrameId| cameras.iter().find(|(f, _)| *f == id).map(|(_, pose)| *pose);
    // Where the object is among the reference cameras: the motion that brings the aligned cameras to them.
    let aligned = sets.last().map(|(_, cameras)| cameras.clone()).unwrap_or_default();
    let both: Vec<(Pose, Pose)> = reference.iter().filter_map(|(id, r)| Some((*r, of(&aligned, *id)?))).collect();
    let (to, from): (Vec<Pose>, Vec<Pose>) = both.into_iter().unzip();
    let placed = Alignment {
        world_from_object: common_motion(&to, &from) * alignment.world_from_object,
        frames: reference
            .iter()
            .map(|(frame, world_from_cam)| FrameAlignment {
                frame: *frame,
                world_from_cam: *world_from_cam,
                covariance: None,
                rms_px: None,
            })
            .collect(),
        ..alignment.clone()
    };
    let mut rows = Vec::new();
    for (name, cameras) in sets {
        let pairs: Vec<PosePair> = reference
            .iter()
            .filter_map(|(frame, gt)| {
                Some(PosePair { frame: *frame, gt_world_from_cam: *gt, pred_world_from_cam: of(cameras, *frame)? })
            })
            .collect();
        let scores = score_poses(&pairs, None)?;
        let mut scene = ExactScene::with_alignment(sequence, &placed)?;
        scene.frames.retain(|f| pairs.iter().any(|p| p.frame == f.id));
        let poses: Vec<Pose> = pairs.iter().map(|p| p.pred_world_from_cam).collect();
        let fused = perturbed_pose_study(&scene, &poses, &options.study, progress)?;
        rows.push(StudiedPoses {
            poses: name.clone(),
            pairwise_translation_rmse_mm: scores.pairwise.translation_rmse_mm,
            pairwise_rotation_mean_deg: scores.pairwise.rotation_mean_deg,
            accuracy: fused.accuracy,
            recall: fused.recall,
        });
    }
    Ok(rows)
}

/// Means over the sequences that have a row, in the order of the first that has all.
fn mean(sequences: &[StudiedSequence], rows: impl Fn(&StudiedSequence) -> &Vec<StudiedPoses>) -> Vec<StudiedPoses> {
    let mut names: Vec<String> = Vec::new();
    for row in sequences.iter().flat_map(|s| rows(s).iter()) {
        if !names.contains(&row.poses) {
            names.push(row.poses.clone());
        }
    }
    names
        .into_iter()
        .map(|name| {
            let of: Vec<&StudiedPoses> =
                sequences.iter().flat_map(|s| rows(s).iter()).filter(|r| r.poses == name).collect();
            let average = |value: fn(&StudiedPoses) -> f64| of.iter().map(|r| value(r)).sum::<f64>() / of.len() as f64;
            StudiedPoses {
                pairwise_translation_rmse_mm: average(|r| r.pairwise_translation_rmse_mm),
                pairwise_rotation_mean_deg: average(|r| r.pairwise_rotation_mean_deg),
                accuracy: average(|r| r.accuracy),
                recall: average(|r| r.recall),
                poses: name,
            }
        })
        .collect()
}

/// Table 5 of Li et al. 2023: ten real sequences with a ChArUco board.
fn paper() -> Vec<StudiedPoses> {
    let row = |poses: &str, mm: f64, deg: f64, accuracy: f64, recall: f64| StudiedPoses {
        poses: poses.to_owned(),
        pairwise_translation_rmse_mm: mm,
        pairwise_rotation_mean_deg: deg,
        accuracy,
        recall,
    };
    vec![row("ARKit", 4.454, 0.581, 0.901, 0.913), row("refined", 2.060, 0.522, 0.937, 0.938)]
}

/// The study as a page of Markdown.
fn markdown(study: &BoardStudy) -> String {
    let mut text = String::from("# Camera poses against a board\n\n");
    let count = study.sequences.len();
    let made = match study.simulated {
        0 => "all real".to_owned(),
        n if n == count => "all simulated: their photographs, boards and phone poses are a program's".to_owned(),
        n => format!("{n} of them simulated"),
    };
    let threshold = study.options.study.threshold_mm;
    let _ = writeln!(
        text,
        "Board `{}`, {count} sequences, {made}. Errors of relative poses over all pairs of frames, nothing aligned; exact depth \
         fused with either cameras, shares within {threshold} mm. The paper's rows are of ten real sequences.\n",
        study.board
    );
    text += "| cameras | translation RMSE mm | mean rotation deg | accuracy % | recall % |\n|---|---|---|---|---|\n";
    let mut line = |label: String, r: &StudiedPoses| {
        let (mm, deg) = (r.pairwise_translation_rmse_mm, r.pairwise_rotation_mean_deg);
        let _ =
            writeln!(text, "| {label} | {mm:.3} | {deg:.3} | {:.1} | {:.1} |", 100.0 * r.accuracy, 100.0 * r.recall);
    };
    study.paper.iter().for_each(|r| line(format!("paper: {}", r.poses), r));
    study.mean.iter().for_each(|r| line(r.poses.clone(), r));
    let truth = mean(&study.sequences, |s| &s.against_truth);
    if !truth.is_empty() {
        text += "\nAgainst the simulator's truth, the board's own cameras among them:\n\n";
        text +=
            "| cameras | translation RMSE mm | mean rotation deg | accuracy % | recall % |\n|---|---|---|---|---|\n";
        for r in &truth {
            let (mm, deg) = (r.pairwise_translation_rmse_mm, r.pairwise_rotation_mean_deg);
            let (accuracy, recall) = (100.0 * r.accuracy, 100.0 * r.recall);
            let _ = writeln!(text, "| {} | {mm:.3} | {deg:.3} | {accuracy:.1} | {recall:.1} |", r.poses);
        }
    }
    text += "\n| sequence | frames | posed | board rms px | cameras | translation RMSE mm | mean rotation deg |\n";
    text += "|---|---|---|---|---|---|---|\n";
    for s in &study.sequences {
        for r in &s.against_board {
            let _ = writeln!(
                text,
                "| {} | {} | {} | {:.3} | {} | {:.3} | {:.3} |",
                s.sequence.display(),
                s.frames,
                s.posed,
                s.board_rms_px,
                r.poses,
                r.pairwise_translation_rmse_mm,
                r.pairwise_rotation_mean_deg
            );
        }
    }
    text
}
