//! Where a score comes from: the program and the very bytes that it read.

use std::io::Read as _;
use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

/// The program and the files that made a score.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Provenance {
    /// Program and version.
    pub program: String,
    /// The prediction.
    pub prediction: FileHash,
    /// The true surface.
    pub ground_truth: FileHash,
    /// The visibility volume.
    pub visibility: FileHash,
}

/// A file and its content.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileHash {
    /// The path, as it was given.
    pub path: PathBuf,
    /// Its length, bytes.
    pub bytes: u64,
    /// SHA-256 of its content, hexadecimal.
    pub sha256: String,
}

impl Provenance {
    pub(super) fn of(prediction: &Path, ground_truth: &Path, visibility: &Path) -> Result<Self> {
        Ok(Self {
            program: concat!("mobilebrick ", env!("CARGO_PKG_VERSION")).to_owned(),
            prediction: FileHash::of(prediction)?,
            ground_truth: FileHash::of(ground_truth)?,
            visibility: FileHash::of(visibility)?,
        })
    }
}

impl FileHash {
    /// Hashes a file piece by piece.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn of(path: &Path) -> Result<Self> {
        let unreadable = |e: std::io::Error| InputError::unreadable(path, &e);
        let mut file = std::fs::File::open(path).map_err(unreadable)?;
        let mut hash = Sha256::new();
        let mut piece = vec![0; 1 << 16];
        let mut bytes = 0;
        loop {
            let read = file.read(&mut piece).map_err(unreadable)?;
            if read == 0 {
                break;
            }
            bytes += read as u64;
            hash.update(&piece[..read]);
        }
        let sha256 = hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
        Ok(Self { path: path.to_owned(), bytes, sha256 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hash_is_the_one_that_everyone_computes() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("abc");
        std::fs::write(&path, "abc").unwrap();
        let hash = FileHash::of(&path).unwrap();
        // FIPS 180-2, appendix B.1.
        assert_eq!(hash.sha256, "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
        assert_eq!(hash.bytes, 3);
    }
}
