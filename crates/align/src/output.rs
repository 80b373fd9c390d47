//! What lies in `alignment/`, `pose_arkit/` and `intrinsic_arkit/`, and which stage may leave it there.

use std::io::ErrorKind;
use std::path::PathBuf;

use mb_capture::{
    Alignment, Frame, FrameId, Sequence, read_intrinsics_txt, read_pose_txt, write_intrinsics_txt, write_pose_txt,
};
use mb_job::{Error, Result};
use nalgebra::Matrix6;

/// Photographs with the model drawn in.
pub(crate) const OVERLAYS: &str = "overlays";
/// What a bundle adjustment used and left out.
pub(crate) const BUNDLE: &str = "bundle.json";
/// Files and folders that a stage writes beside `alignment.json`.
const LATER_RESULTS: [&str; 2] = [BUNDLE, OVERLAYS];

/// Removes what earlier runs of any stage left in `alignment/` besides `alignment.json`, which the stage replaces, so
/// that nothing there speaks of a pose that no longer holds. Returns where `alignment.json` goes.
pub(crate) fn begin_stage(sequence: &Sequence) -> Result<PathBuf> {
    let file = sequence.root().join(Alignment::FILE);
    for name in LATER_RESULTS {
        let path = file.with_file_name(name);
        let removed = if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        match removed {
            Err(e) if e.kind() != ErrorKind::NotFound => return Err(Error::write(path, e)),
            _ => {}
        }
    }
    Ok(file)
}

/// Where the phone's own poses and intrinsics are kept once `pose/` and `intrinsic/` hold refined ones.
const PHONE_POSES: &str = "pose_arkit";
const PHONE_INTRINSICS: &str = "intrinsic_arkit";

fn file(sequence: &Sequence, folder: &str, id: FrameId) -> PathBuf {
    sequence.root().join(folder).join(format!("{id}.txt"))
}

/// The sequence's frames, as the phone had their cameras, whatever `pose/` and `intrinsic/` hold by now.
pub(crate) fn phone_frames(sequence: &Sequence) -> Result<Vec<Frame>> {
    let kept = |frame: &Frame| {
        let (pose, k) = (file(sequence, PHONE_POSES, frame.id), file(sequence, PHONE_INTRINSICS, frame.id));
        let mut frame = frame.clone();
        if pose.exists() {
            frame.world_from_cam = read_pose_txt(pose)?.0;
        }
        if k.exists() {
            frame.intrinsics = read_intrinsics_txt(k)?;
        }
        Ok(frame)
    };
    sequence.frames().iter().map(kept).collect()
}

/// Keeps the phone's poses, and its intrinsics where `intrinsics` says so, before others take their place.
pub(crate) fn keep_phone_cameras(sequence: &Sequence, phone: &[Frame], intrinsics: bool) -> Result<()> {
    for frame in phone {
        let (pose, k) = (file(sequence, PHONE_POSES, frame.id), file(sequence, PHONE_INTRINSICS, frame.id));
        if !pose.exists() {
            write_pose_txt(pose, &frame.world_from_cam)?;
        }
        if intrinsics && !k.exists() {
            write_intrinsics_txt(k, &frame.intrinsics)?;
        }
    }
    Ok(())
}

/// Whether `intrinsic/` may hold other intrinsics than the phone's.
pub(crate) fn keeps_phone_intrinsics(sequence: &Sequence) -> bool {
    sequence.root().join(PHONE_INTRINSICS).is_dir()
}

/// Gives `pose/` and `intrinsic/` the phone's back, for a stage whose cameras are the phone's: refined ones of an earlier
/// bundle adjustment would go with another pose of the object.
pub(crate) fn put_phone_cameras_back(sequence: &Sequence, phone: &[Frame]) -> Result<()> {
    for (kept, folder) in [(PHONE_POSES, "pose"), (PHONE_INTRINSICS, "intrinsic")] {
        let kept = sequence.root().join(kept);
        if !kept.is_dir() {
            continue;
        }
        for frame in phone {
            let path = file(sequence, folder, frame.id);
            if folder == "pose" {
                write_pose_txt(path, &frame.world_from_cam)?;
            } else {
                write_intrinsics_txt(path, &frame.intrinsics)?;
            }
        }
        std::fs::remove_dir_all(&kept).map_err(|e| Error::write(kept, e))?;
    }
    Ok(())
}

/// A covariance as alignment files have it.
pub(crate) fn rows(m: &Matrix6<f64>) -> [[f64; 6]; 6] {
    std::array::from_fn(|row| std::array::from_fn(|col| m[(row, col)]))
}
