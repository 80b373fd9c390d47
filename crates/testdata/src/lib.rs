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

/// A damaged copy of a valid file, for tests that readers refuse what they cannot read: one to four times, bytes are changed,
/// cut off, left out, doubled, or replaced by values that sizes and counts must not have. The same seed gives the same
/// damage.
pub fn damaged(bytes: &[u8], seed: u64) -> Vec<u8> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x2545_f491_4f6c_dd1d;
    let mut below = |limit: usize| {
        // splitmix64
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) % limit.max(1) as u64) as usize
    };
    const EXTREMES: [&[u8]; 8] = [
        &[0xff; 8],
        &[0; 8],
        &[0xff, 0xff, 0xff, 0x7f],
        &[0, 0, 0, 0x80],
        b"-1",
        b"1e999",
        b"NaN",
        b"99999999999999999999",
    ];
    let mut out = bytes.to_vec();
    for _ in 0..=below(4) {
        let at = below(out.len());
        let end = (at + 1 + below(16)).min(out.len());
        match below(7) {
            0 if !out.is_empty() => out[at] ^= 1 << below(8),
            1 if !out.is_empty() => out[at] = below(256) as u8,
            2 => out.truncate(at),
            3 => drop(out.drain(at..end)),
            4 => {
                let piece = out[at..end].to_vec();
                out.splice(at..at, piece);
            }
            5 => {
                let value = EXTREMES[below(EXTREMES.len())];
                let end = (at + value.len()).min(out.len());
                out.splice(at..end, value.iter().copied());
            }
            _ => {
                let from = below(out.len());
                if !out.is_empty() {
                    out.swap(at, from);
                }
            }
        }
    }
    out
}

/// How many damaged copies a test tries: `usual`, or what `MOBILEBRICK_FUZZ_CASES` says.
pub fn fuzz_cases(usual: u64) -> u64 {
    std::env::var("MOBILEBRICK_FUZZ_CASES").ok().and_then(|v| v.parse().ok()).unwrap_or(usual)
}

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
    skip(relative, "set MOBILEBRICK_TEST_DATA to the folder that holds it");
    None
}

/// The path of a program that the product calls, or `None` (said aloud) where it is not installed.
///
/// # Panics
/// On CI where it is not installed.
pub fn find_program(name: &str) -> Option<PathBuf> {
    let folders = std::env::var_os("PATH").unwrap_or_default();
    let found = std::env::split_paths(&folders).map(|folder| folder.join(name)).find(|path| path.is_file());
    if found.is_none() {
        absent(name, "install it");
    }
    found
}

/// Says that something which the machine must have is not there; the test then passes without testing.
///
/// # Panics
/// On CI.
pub fn absent(what: &str, help: &str) {
    assert!(std::env::var_os("CI").is_none(), "{what} is not there, and CI must have it: {help}");
    skip(what, help);
}

/// Says that a test passes without testing.
fn skip(what: &str, help: &str) {
    let test = std::thread::current().name().unwrap_or("a test").to_owned();
    eprintln!("SKIPPED {test}: no {what}; {help}");
    if let Some(log) = std::env::var_os("MOBILEBRICK_SKIP_LOG")
        && let Ok(mut log) = std::fs::OpenOptions::new().create(true).append(true).open(log)
    {
        let _ = writeln!(log, "{test}: {what}");
    }
}
