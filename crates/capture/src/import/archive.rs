//! Zip archives of captures, read entry by entry with limits.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use mb_job::{InputError, Result};
use zip::ZipArchive;

/// A larger entry is no photograph, depth map or list of poses.
const MAX_ENTRY_BYTES: u64 = 256 << 20;

/// An open archive.
pub(crate) struct Archive {
    path: PathBuf,
    names: Vec<String>,
    zip: Mutex<ZipArchive<BufReader<File>>>,
}

impl Archive {
    /// Opens a zip file and reads its index.
    pub fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(|e| InputError::unreadable(path, &e))?;
        let zip = ZipArchive::new(BufReader::new(file)).map_err(|e| {
            InputError::new(path, format!("not a readable zip archive ({e})")).help("Copy or export the file again")
        })?;
        let names = zip.file_names().flatten().map(std::borrow::Cow::into_owned).collect();
        Ok(Self { path: path.to_owned(), names, zip: Mutex::new(zip) })
    }

    /// The archive's file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether there is such an entry.
    pub fn contains(&self, name: &str) -> bool {
        self.names.iter().any(|n| n == name)
    }

    /// Reads one entry.
    pub fn read(&self, name: &str) -> Result<Vec<u8>> {
        let bad = |found: String| InputError::new(&self.path, found).at(name.to_owned());
        let mut zip = self.zip.lock().unwrap_or_else(PoisonError::into_inner);
        let entry = zip.by_name(name).map_err(|e| bad(format!("cannot be read ({e})")))?;
        let mut bytes = Vec::new();
        // The declared size may lie, so the limit is on what comes out.
        let mut limited = entry.take(MAX_ENTRY_BYTES + 1);
        limited.read_to_end(&mut bytes).map_err(|e| bad(format!("is damaged ({e})")))?;
        if bytes.len() as u64 > MAX_ENTRY_BYTES {
            return Err(
                bad(format!("unpacks to more than {} MiB, which no capture needs", MAX_ENTRY_BYTES >> 20)).into()
            );
        }
        Ok(bytes)
    }

    /// Reads one LZFSE-compressed entry of a known length.
    pub fn read_lzfse(&self, name: &str, expected_bytes: usize) -> Result<Vec<u8>> {
        let packed = self.read(name)?;
        let bad = |found: String| InputError::new(&self.path, found).at(name.to_owned());
        let mut bytes = Vec::new();
        let mut decoder = lzfse_rust::LzfseRingDecoder::default();
        decoder
            .reader_bytes(&packed)
            .take(expected_bytes as u64 + 1)
            .read_to_end(&mut bytes)
            .map_err(|e| bad(format!("not LZFSE data ({e})")))?;
        if bytes.len() != expected_bytes {
            let found = if bytes.len() > expected_bytes { "more than".to_owned() } else { bytes.len().to_string() };
            return Err(bad(format!("unpacks to {found} bytes, expected {expected_bytes}")).into());
        }
        Ok(bytes)
    }
}
