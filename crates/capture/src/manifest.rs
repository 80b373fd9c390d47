//! Hashes of the files that a capture consists of, so that a later change or loss is noticed.

use std::collections::BTreeMap;
use std::path::Path;

use mb_job::{InputError, Result};
use sha2::{Digest as _, Sha256};

/// Folders that a capture arrives with. What later stages write is not the capture.
const FOLDERS: [&str; 5] = ["image", "image_valid", "intrinsic", "pose", "arkit_depth"];

/// SHA-256 in hexadecimal of one file.
///
/// # Errors
/// The file cannot be read.
pub(crate) fn file_hash(path: &Path) -> Result<String> {
    let mut file = std::fs::File::open(path).map_err(|e| InputError::unreadable(path, &e))?;
    let mut hasher = Sha256::new();
    std::io::copy(&mut file, &mut hasher).map_err(|e| InputError::unreadable(path, &e))?;
    Ok(hasher.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Hashes of every file of a capture, by its path in the folder.
///
/// # Errors
/// A file cannot be read.
pub(crate) fn file_hashes(root: &Path) -> Result<BTreeMap<String, String>> {
    let mut hashes = BTreeMap::new();
    for folder in FOLDERS {
        let Ok(entries) = std::fs::read_dir(root.join(folder)) else { continue };
        for entry in entries.flatten() {
            let name = format!("{folder}/{}", entry.file_name().to_string_lossy());
            hashes.insert(name, file_hash(&entry.path())?);
        }
    }
    Ok(hashes)
}
