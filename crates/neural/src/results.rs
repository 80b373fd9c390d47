//! What lies beside a result: its options and figures, its loss curve, its cameras, a film.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;
use std::process::{Command, Stdio};

use mb_capture::write_pose_txt;
use mb_image::RgbImage;
use mb_job::{Error, Result, write_atomic};
use serde::Serialize;

use crate::cameras::CameraResiduals;
use crate::dataset::RayDataset;
use crate::trainer::CurvePoint;

/// Writes `NAME.json` (everything of `summary`, options included) and `NAME.curve.csv`.
///
/// # Errors
/// A file cannot be written.
pub fn write_beside(name: &Path, summary: &impl Serialize, curve: &[CurvePoint]) -> Result<()> {
    let with = |ending: &str| {
        let mut file = name.as_os_str().to_owned();
        file.push(ending);
        std::path::PathBuf::from(file)
    };
    let mut json = serde_json::to_vec_pretty(summary).map_err(|e| Error::write(with(".json"), e.into()))?;
    json.push(b'\n');
    write_atomic(with(".json"), &json)?;
    let mut csv = "step,seconds,loss,psnr_db,samples_per_ray\n".to_owned();
    for p in curve {
        writeln!(csv, "{},{:.3},{:.6},{:.4},{:.2}", p.step, p.seconds, p.loss, p.psnr_db, p.samples_per_ray)
            .expect("a string takes everything");
    }
    write_atomic(with(".curve.csv"), csv.as_bytes())
}

/// Writes the corrected poses of all views as `FOLDER/pose/NNNNNN.txt`, which `eval poses` reads.
///
/// # Errors
/// A file cannot be written.
pub(crate) fn write_cameras(folder: &Path, data: &RayDataset, cameras: &CameraResiduals) -> Result<()> {
    for (index, view) in data.views().iter().enumerate() {
        let pose = cameras.world_from_cam(data, index);
        write_pose_txt(folder.join(format!("pose/{}.txt", view.frame)), &pose)?;
    }
    Ok(())
}

/// Writes pictures of one size as a film, through the command `ffmpeg`.
///
/// # Errors
/// There is no `ffmpeg`; it fails; the file cannot be written.
pub fn write_film(path: &Path, images: &[RgbImage], frames_per_second: f64) -> Result<()> {
    let Some(first) = images.first() else {
        return Err(Error::Failed("a film of no pictures cannot be written".to_owned()));
    };
    let size = first.size();
    if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(|e| Error::write(folder, e))?;
    }
    // The film appears under its name when it is whole.
    let stem = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let unfinished = path.with_file_name(format!(".unfinished-{}-{stem}", std::process::id()));
    let failed = |why: String| {
        std::fs::remove_file(&unfinished).ok();
        Error::Failed(format!("{}: {why}", path.display()))
    };
    let mut child = Command::new("ffmpeg")
        .args(["-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24"])
        .args(["-s", &format!("{}x{}", size.width, size.height), "-r", &frames_per_second.to_string(), "-i", "-"])
        // H.264 wants even sides; yuv420p plays everywhere.
        .args(["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-c:v", "libx264", "-crf", "18", "-pix_fmt", "yuv420p"])
        .args(["-f", "mp4"])
        .arg(&unfinished)
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|e| {
            failed(format!("a film needs the command ffmpeg, which did not start ({e}); the pictures are written"))
        })?;
    if let Some(mut pipe) = child.stdin.take() {
        for image in images {
            // A broken pipe is told below, by what ffmpeg says.
            if pipe.write_all(image.data().as_flattened()).is_err() {
                break;
            }
        }
    }
    let output = child.wait_with_output().map_err(|e| failed(e.to_string()))?;
    if !output.status.success() {
        return Err(failed(format!("ffmpeg failed: {}", String::from_utf8_lossy(&output.stderr).trim())));
    }
    std::fs::rename(&unfinished, path).map_err(|e| Error::write(path, e))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_and_curve_lie_beside_a_result() {
        let dir = tempfile::tempdir().expect("a folder");
        let curve = [CurvePoint { step: 100, seconds: 1.5, loss: 0.25, psnr_db: 20.0, samples_per_ray: 30.5 }];
        write_beside(&dir.path().join("castle"), &serde_json::json!({"a": 1}), &curve).expect("written");
        let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).expect("a file");
        assert_eq!(read("castle.json"), "{\n  \"a\": 1\n}\n");
        assert_eq!(
            read("castle.curve.csv"),
            "step,seconds,loss,psnr_db,samples_per_ray\n100,1.500,0.250000,20.0000,30.50\n"
        );
    }

    #[test]
    fn a_film_of_nothing_is_refused() {
        assert!(write_film(Path::new("film.mp4"), &[], 30.0).is_err());
    }
}
