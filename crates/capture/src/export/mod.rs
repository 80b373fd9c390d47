//! Sequences for other programs.
//!
//! Photographs are copied byte for byte; cameras keep all their digits, so that importing an export gives them back. Where the
//! sequence has an alignment its cameras are exported, otherwise the phone's.

mod colmap;
mod mvsnet;
mod nerfstudio;
mod neus;

use std::path::{Path, PathBuf};

use mb_geometry::Aabb;
use mb_job::{InputError, Progress, Result, Steps, write_atomic};
use nalgebra::{Matrix3, Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::{Alignment, Frame, Sequence};

/// A layout that sequences can be exported to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExportFormat {
    /// COLMAP: `images/`, `sparse/0` as text and binary, `masks/` where the sequence has masks.
    Colmap,
    /// nerfstudio and instant-ngp: `transforms.json`, `images/`.
    Nerfstudio,
    /// NeuS: `image/NNN.png` or `.jpg`, `mask/NNN.png`, `cameras_sphere.npz`.
    Neus,
    /// MVSNet: `images/NNNNNNNN.jpg`, `cams/NNNNNNNN_cam.txt`, `pair.txt`.
    Mvsnet,
}

/// What was exported.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ExportSummary {
    /// The layout.
    pub format: ExportFormat,
    /// Frames written.
    pub frames: usize,
    /// Frames left out, for want of a photograph.
    pub frames_skipped: Vec<crate::FrameId>,
    /// Masks written.
    pub masks: usize,
    /// Whether the cameras are those of the sequence's alignment.
    pub aligned: bool,
}

/// What all layouts are written from.
struct Job<'a> {
    sequence: &'a Sequence,
    /// Frames that have a photograph.
    frames: Vec<(Frame, PathBuf)>,
    /// Where the object is, in the world.
    object_in_world: Aabb,
    out: &'a Path,
}

/// Exports a sequence to `out`, which must be new or empty.
///
/// # Errors
/// No frame has a photograph, the alignment is malformed, or a file cannot be read or written.
pub fn export(sequence: &Sequence, format: ExportFormat, out: &Path, progress: &dyn Progress) -> Result<ExportSummary> {
    if out.is_dir() && std::fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_some()) {
        return Err(InputError::new(out, "is not empty")
            .help("Give a new folder, so that nothing is overwritten")
            .into());
    }
    let aligned = sequence.root().join(Alignment::FILE).exists();
    let alignment = if aligned { Some(sequence.read_alignment()?) } else { None };
    let all = match &alignment {
        Some(alignment) => sequence.aligned_frames(alignment),
        None => sequence.frames().to_vec(),
    };
    let frames_skipped = all.iter().filter(|f| f.image.is_none()).map(|f| f.id).collect();
    let frames: Vec<(Frame, PathBuf)> =
        all.into_iter().filter_map(|f| f.image.clone().map(|image| (f, image))).collect();
    if frames.is_empty() {
        return Err(InputError::new(sequence.root(), "no frame has a photograph to export").into());
    }
    let model = sequence.model_mesh_path();
    let object_in_world = match &alignment {
        Some(alignment) if model.exists() => {
            let mesh = mb_mesh::read_mesh(&model)?;
            Aabb::of(&mesh.transformed(&alignment.world_from_object).vertices)
        }
        _ => watched_box(&frames),
    };
    let job = Job { sequence, frames, object_in_world, out };
    let steps = Steps::new(progress, "frames", job.frames.len());
    let masks = match format {
        ExportFormat::Colmap => colmap::write(&job, &steps)?,
        ExportFormat::Nerfstudio => nerfstudio::write(&job, &steps)?,
        ExportFormat::Neus => neus::write(&job, &steps)?,
        ExportFormat::Mvsnet => mvsnet::write(&job, &steps)?,
    };
    Ok(ExportSummary { format, frames: job.frames.len(), frames_skipped, masks, aligned })
}

/// Without a model: a box round the point that the cameras look at, half as wide as they are away.
fn watched_box(frames: &[(Frame, PathBuf)]) -> Aabb {
    // The point nearest to all optical axes: sum (I - d d^T) (p - c) = 0.
    let (mut matrix, mut right) = (Matrix3::zeros(), Vector3::zeros());
    let mut middle = Vector3::zeros();
    for (frame, _) in frames {
        let (axis, center) = (frame.world_from_cam.rotate(&Vector3::z()), frame.world_from_cam.translation());
        let across = Matrix3::identity() - axis * axis.transpose();
        matrix += across;
        right += across * center;
        middle += center / frames.len() as f64;
    }
    // Parallel axes meet nowhere: then half a metre ahead of the middle camera.
    let ahead = frames[0].0.world_from_cam.rotate(&Vector3::z()) * 0.5;
    let well_posed = matrix.symmetric_eigenvalues().min() > 1e-3 * frames.len() as f64;
    let watched = matrix.try_inverse().filter(|_| well_posed).map_or(middle + ahead, |inverse| inverse * right);
    let distance = frames
        .iter()
        .map(|(frame, _)| (frame.world_from_cam.translation() - watched).norm())
        .fold(f64::INFINITY, f64::min);
    let watched = Point3::from(watched);
    Aabb { min: watched, max: watched }.grown(0.25 * distance.max(1e-6))
}

/// Copies a photograph byte for byte and returns its extension.
fn copy_photo(from: &Path, folder: &Path, stem: &str) -> Result<String> {
    let bytes = std::fs::read(from).map_err(|e| InputError::unreadable(from, &e))?;
    let extension = from.extension().map(|e| e.to_string_lossy().to_ascii_lowercase()).unwrap_or_default();
    write_atomic(folder.join(format!("{stem}.{extension}")), &bytes)?;
    Ok(extension)
}

/// Copies a frame's mask, where there is one.
fn copy_mask(job: &Job<'_>, frame: &Frame, to: PathBuf) -> Result<usize> {
    let from = job.sequence.mask_path(frame.id);
    if !from.exists() {
        return Ok(0);
    }
    let bytes = std::fs::read(&from).map_err(|e| InputError::unreadable(&from, &e))?;
    write_atomic(to, &bytes)?;
    Ok(1)
}
