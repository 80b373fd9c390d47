//! Finds the real inputs that tests read, which are not part of the repository.
//!
//! They lie in the folder that `MOBILEBRICK_TEST_DATA` names, or in `shared/data` beside the repository. A test that
//! needs some of them starts with
//!
//! ```no_run
//! let Some(model) = mb_testdata::find("ldraw/models/40448-1-vintage-car.mpd") else { return };
//! ```
//!
//! Where they are absent the test passes without testing, and says so: on stderr, and as a line in the file that
//! `MOBILEBRICK_SKIP_LOG` names, which `cargo xtask test` counts and reports. On CI (`CI=true`) absence is a failure.

use std::io::Write as _;
use std::path::{Path, PathBuf};

/// The path of a real input, or `None` (said aloud) where the data is absent.
///
/// # Panics
/// On CI where the data is absent, or anywhere when the data folder is there but lacks this input.
pub fn find(relative: &str) -> Option<PathBuf> {
    let root = match std::env::var_os("MOBILEBRICK_TEST_DATA") {
        Some(root) => PathBuf::from(root),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"),
    };
    let path = root.join(relative);
    if path.exists() {
        return Some(path);
    }
    assert!(!root.is_dir(), "{} lacks {relative}", root.display());
    assert!(std::env::var_os("CI").is_none(), "the test data is absent ({}), and CI must have it", root.display());
    let test = std::thread::current().name().unwrap_or("a test").to_owned();
    eprintln!("SKIPPED {test}: no {relative}; set MOBILEBRICK_TEST_DATA to the folder that holds it");
    if let Some(log) = std::env::var_os("MOBILEBRICK_SKIP_LOG")
        && let Ok(mut log) = std::fs::OpenOptions::new().create(true).append(true).open(log)
    {
        let _ = writeln!(log, "{test}: {relative}");
    }
    None
}
