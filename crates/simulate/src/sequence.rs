//! The whole simulated capture, written as a sequence folder.

use std::path::Path;

use mb_capture::{
    Alignment, AlignmentStage, FrameAlignment, FrameId, Keypoints, SequenceMeta, write_intrinsics_txt, write_pose_txt,
};
use mb_geometry::{Board, Object, Rigid3};
use mb_job::{InputError, Progress, Result, Steps, write_atomic};
use mb_mesh::TriangleMesh;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::clicks::{ClickView, click};
use crate::develop::{Development, develop, developments};
use crate::lens::Distortion;
use crate::lidar;
use crate::orbit::Orbit;
use crate::photo::{Shot, expose};
use crate::stage::Stage;
use crate::walk::Walk;
use crate::{SimulateOptions, Table, streams};

/// What was simulated.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SimulateSummary {
    /// Photographs of the sequence.
    pub frames: usize,
    /// Of these, how many lay there from an earlier run and were kept.
    pub frames_kept: usize,
    /// Size of the photographs.
    pub image_size: mb_geometry::ImageSize,
    /// Mean distance from the camera to the middle of the model.
    pub radius_m: f64,
    /// What the model stands on.
    pub table: Table,
    /// Points that the annotator clicked.
    pub keypoints: usize,
    /// Root mean square error of the reported poses' relative translations, over all pairs of frames.
    pub pose_translation_rmse_mm: f64,
    /// Mean error of the reported poses' relative rotations, over all pairs of frames.
    pub pose_rotation_mean_deg: f64,
    /// The seed.
    pub seed: u64,
    /// What a person should know about the result.
    pub warnings: Vec<String>,
}

/// `simulation/plan.json`: what a folder holds or will hold. A run goes on only where its own plan lies.
#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Plan {
    version: u32,
    program_version: String,
    options: SimulateOptions,
    /// Over the model's vertices, triangles, parts and colours.
    model_sha256: String,
}

/// `simulation/board.json`: the board under the model.
#[derive(Debug, Serialize)]
struct BoardRecord {
    version: u32,
    /// What was asked for.
    board: String,
    object_from_board: Rigid3<Object, Board>,
}

const BOARD: &str = "simulation/board.json";
const PLAN: &str = "simulation/plan.json";
const JPEG_QUALITY: u8 = 95;

fn fingerprint(model: &TriangleMesh) -> String {
    let mut hasher = Sha256::new();
    for v in &model.vertices {
        v.iter().for_each(|c| hasher.update(c.to_le_bytes()));
    }
    for t in &model.triangles {
        t.iter().for_each(|i| hasher.update(i.to_le_bytes()));
    }
    for colors in model.triangle_colors.iter().flatten() {
        hasher.update(colors);
    }
    for part in model.triangle_parts.iter().flatten() {
        hasher.update(part.to_le_bytes());
    }
    hasher.finalize().iter().map(|b| format!("{b:02x}")).collect()
}

fn to_json(value: &impl Serialize) -> Vec<u8> {
    let mut bytes = serde_json::to_vec_pretty(value).expect("plain data with string keys");
    bytes.push(b'\n');
    bytes
}

/// Makes `out` ours: empty, or begun with the very same plan.
fn claim(out: &Path, plan: &Plan) -> Result<()> {
    let path = out.join(PLAN);
    if path.exists() {
        let bytes = std::fs::read(&path).map_err(|e| InputError::unreadable(&path, &e))?;
        let found: Plan =
            serde_json::from_slice(&bytes).map_err(|e| InputError::new(&path, format!("not a plan ({e})")))?;
        if found == *plan {
            return Ok(());
        }
        return Err(InputError::new(out, "holds a simulation of another model or with other options")
            .help("Give another folder, or remove this one first")
            .into());
    }
    let occupied = out.is_dir() && std::fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_some());
    if occupied {
        return Err(InputError::new(out, "is not empty, and no simulation was begun there")
            .help("Give a new folder, so that nothing is overwritten")
            .into());
    }
    write_atomic(path, &to_json(plan))
}

/// Simulates a hand-held phone's capture of `model` (object frame, metres; y up, standing on its lowest point) and
/// writes it to `out` as a sequence folder, `docs/formats.md` file by file.
///
/// The same options and model give the same bytes, whatever the number of threads. A run that was stopped is taken up
/// where it ended: finished frames are kept. `sequence.json` is written last, so a folder with it is complete.
///
/// # Errors
/// An option is out of range; the model is empty or not of the size of a thing on a table; `out` holds something
/// else; a file cannot be written; or the person asked for a stop.
pub fn simulate(
    model: &TriangleMesh,
    options: &SimulateOptions,
    out: &Path,
    progress: &dyn Progress,
) -> Result<SimulateSummary> {
    options.validate()?;
    let stage = Stage::new(model, options)?;
    let plan = Plan {
        version: 1,
        program_version: env!("CARGO_PKG_VERSION").to_owned(),
        options: options.clone(),
        model_sha256: fingerprint(model),
    };
    claim(out, &plan)?;

    let bounds = model.bounds();
    let walk = Walk::new(&bounds, options)?;
    let orbit = &walk.orbit;

    let mut warnings = Vec::new();
    if !orbit.sees_all(&bounds) {
        warnings.push("some frames do not show the whole model; use a larger radius".to_owned());
    }
    if orbit.radius_m > 0.6 {
        warnings.push(format!(
            "the model is too large for the paper's 20 to 50 cm: the phone keeps {:.2} m away to see all of it",
            orbit.radius_m
        ));
    }

    let kept = photograph(&stage, options, orbit, out, progress)?;
    for i in 0..options.frames {
        let name = format!("{}.txt", FrameId(i as u32));
        write_intrinsics_txt(out.join("intrinsic").join(&name), &walk.intrinsics[i])?;
        write_intrinsics_txt(out.join("simulation/intrinsic").join(&name), &walk.intrinsics[i])?;
        write_pose_txt(out.join("pose").join(&name), &walk.reported_world_from_cam[i])?;
        write_pose_txt(out.join("simulation/pose").join(&name), &walk.true_world_from_cam[i])?;
    }
    let alignment = Alignment {
        version: 1,
        stage: AlignmentStage::Truth,
        world_from_object: walk.world_from_object,
        object_covariance: None,
        rms_px: None,
        frames: walk
            .true_world_from_cam
            .iter()
            .enumerate()
            .map(|(i, pose)| FrameAlignment {
                frame: FrameId(i as u32),
                world_from_cam: *pose,
                covariance: None,
                rms_px: None,
            })
            .collect(),
    };
    alignment.write(out.join("simulation/alignment.json"))?;

    if let (Some(board), Some(print)) = (&options.board, &stage.board) {
        let record = BoardRecord { version: 1, board: board.clone(), object_from_board: print.object_from_board };
        write_atomic(out.join(BOARD), &to_json(&record))?;
    }

    let keypoints = annotate(&stage, model, options, orbit, progress)?;
    if keypoints.keypoints.len() < options.keypoints {
        warnings.push(format!(
            "only {} of {} keypoints could be clicked: the model shows few corners",
            keypoints.keypoints.len(),
            options.keypoints
        ));
    }
    keypoints.write(out.join(Keypoints::FILE))?;
    mb_mesh::write_mesh(out.join("model/mesh.ply"), model)?;

    let meta = SequenceMeta {
        version: 1,
        image_size: options.size,
        device: "simulated phone".to_owned(),
        source: "mobilebrick capture simulate".to_owned(),
        frame_times_s: Some(walk.times_s.clone()),
        hashes_sha256: None,
        provenance: serde_json::to_value(&plan).expect("plain data with string keys"),
    };
    write_atomic(out.join("sequence.json"), &to_json(&meta))?;
    Ok(SimulateSummary {
        frames: options.frames,
        frames_kept: kept,
        image_size: options.size,
        radius_m: orbit.radius_m,
        table: stage.table_kind,
        keypoints: keypoints.keypoints.len(),
        pose_translation_rmse_mm: walk.error.translation_rmse_m * 1e3,
        pose_rotation_mean_deg: walk.error.rotation_mean_rad.to_degrees(),
        seed: options.seed,
        warnings,
    })
}

/// Takes the photographs and measures depth, frame by frame. Returns how many frames lay there already.
fn photograph(
    stage: &Stage,
    options: &SimulateOptions,
    orbit: &Orbit,
    out: &Path,
    progress: &dyn Progress,
) -> Result<usize> {
    let steps = Steps::new(progress, "frames", options.frames);
    let frame_salt = |i: usize| crate::random::hash(i as i32, options.seed as i32, streams::PHOTO as u32);
    let shoot = |i: usize, size, quality| {
        let t = orbit.time_s(i);
        let at_full = orbit.intrinsics(t);
        let shot = Shot {
            stage,
            size,
            intrinsics: at_full.resized(options.size, size),
            distortion: Distortion(options.lens.distortion),
            readout_s: options.lens.readout_s,
            quality,
            focus_m: orbit.distance_m(t) as f32,
            salt: frame_salt(i),
        };
        expose(&shot, |offset_s| orbit.object_from_cam(t + offset_s))
    };
    let mut exposures: Option<Vec<Development>> = None;
    let mut kept = 0;
    for i in 0..options.frames {
        let id = FrameId(i as u32);
        let photo_path = out.join("image").join(format!("{id}.jpg"));
        let depth_path = out.join("arkit_depth").join(format!("{id}.png"));
        let confidence_path = out.join("arkit_depth").join(format!("{id}_conf.png"));
        // Written in this order, so the last one there means all are there.
        if confidence_path.exists() {
            kept += 1;
            steps.step()?;
            continue;
        }
        // The phone meters on the first frame; a small rendering is enough for that.
        let exposures = exposures.get_or_insert_with(|| {
            let small = mb_geometry::ImageSize::new(
                160 * options.size.width / options.size.width.max(options.size.height),
                160 * options.size.height / options.size.width.max(options.size.height),
            );
            developments(&shoot(0, small, crate::Quality::Draft), options.frames, options.seed)
        });
        let photo = develop(&shoot(i, options.size, options.quality), &exposures[i], frame_salt(i));
        let t = orbit.time_s(i);
        let (depth, confidence) =
            lidar::measure(stage, &orbit.intrinsics(t), &photo, &orbit.object_from_cam(t), options.seed, i as u64);
        mb_image::write_jpeg(photo_path, &photo, JPEG_QUALITY)?;
        mb_image::write_depth_png(depth_path, &depth)?;
        mb_image::write_confidence_png(confidence_path, &confidence)?;
        steps.step()?;
    }
    Ok(kept)
}

fn annotate(
    stage: &Stage,
    model: &TriangleMesh,
    options: &SimulateOptions,
    orbit: &Orbit,
    progress: &dyn Progress,
) -> Result<Keypoints> {
    let views: Vec<ClickView> = (0..options.frames)
        .map(|i| {
            let t = orbit.time_s(i);
            ClickView {
                frame: FrameId(i as u32),
                intrinsics: orbit.intrinsics(t),
                size: options.size,
                distortion: Distortion(options.lens.distortion),
                object_from_cam: orbit.object_from_cam(t),
            }
        })
        .collect();
    let scale = options.size.width.max(options.size.height) as f64 / 1920.0;
    let noise_px = options.keypoint_noise_px * scale;
    click(stage, model, &views, options.keypoints, noise_px, options.seed, progress)
}
