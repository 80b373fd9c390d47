//! What lies in `alignment/`, and which stage may leave it there.

use std::io::ErrorKind;
use std::path::PathBuf;

use mb_capture::{Alignment, Sequence};
use mb_job::{Error, Result};

/// Files and folders that a stage writes beside `alignment.json`.
const LATER_RESULTS: [&str; 2] = ["bundle.json", "overlays"];

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
