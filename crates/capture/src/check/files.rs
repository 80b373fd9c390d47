//! Files against the hashes that the import took.

use mb_job::{Progress, Result, Steps};
use serde::Serialize;

use crate::Sequence;
use crate::manifest::{file_hash, file_hashes};

use super::Problem;

/// Files compared with their hashes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct HashCheck {
    /// Files that have a hash.
    pub files: usize,
    /// Of these, how many differ.
    pub changed: usize,
    /// Of these, how many are not there.
    pub missing: usize,
    /// Files of the capture's folders that have no hash.
    pub unknown: usize,
}

/// Compares the files of a capture with the hashes in `sequence.json`, where it has some. Poses that `align bundle`
/// replaced are looked for in `pose_arkit/`, where it keeps the phone's own.
pub(super) fn check_hashes(sequence: &Sequence, progress: &dyn Progress) -> Result<(Option<HashCheck>, Vec<Problem>)> {
    let Some(expected) = sequence.meta().and_then(|meta| meta.hashes_sha256.as_ref()) else {
        return Ok((None, Vec::new()));
    };
    let steps = Steps::new(progress, "hashes", expected.len());
    let mut found = HashCheck { files: expected.len(), changed: 0, missing: 0, unknown: 0 };
    let mut problems = Vec::new();
    for (name, hash) in expected {
        steps.step()?;
        let kept = name.strip_prefix("pose/").map(|file| sequence.root().join("pose_arkit").join(file));
        let path = kept.filter(|path| path.is_file()).unwrap_or_else(|| sequence.root().join(name));
        if !path.is_file() {
            found.missing += 1;
            problems.push(Problem::of_all("hash", format!("{name} is gone since the import")));
        } else if file_hash(&path)? != *hash {
            found.changed += 1;
            problems.push(Problem::of_all("hash", format!("{name} has changed since the import")));
        }
    }
    if let Ok(present) = file_hashes(sequence.root()) {
        found.unknown = present.keys().filter(|name| !expected.contains_key(*name)).count();
    }
    Ok((Some(found), problems))
}
