//! What lies in `alignment/`, and which stage may leave it there.

use std::io::ErrorKind;
use std::path::PathBuf;

use mb_capture::{Alignment, Sequence};
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

/// A covariance as alignment files have it.
pub(crate) fn rows(m: &Matrix6<f64>) -> [[f64; 6]; 6] {
    std::array::from_fn(|row| std::array::from_fn(|col| m[(row, col)]))
}
