//! The entries of a capture that comes as one zip archive, or as the folder that it unpacks to; read with limits.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use mb_job::{InputError, Result};
use zip::ZipArchive;

/// A larger entry is no photograph, depth map or list of poses.
const MAX_ENTRY_BYTES: u64 = 256 << 20;

/// An open archive or folder.
pub(crate) struct Archive {
    path: PathBuf,
    store: Store,
}

enum Store {
    Zip { names: Vec<String>, zip: Mutex<ZipArchive<BufReader<File>>> },
    Folder,
}

impl Archive {
    /// Opens a folder, or a zip file by reading its index.
    pub fn open(path: &Path) -> Result<Self> {
        if path.is_dir() {
            return Ok(Self { path: path.to_owned(), store: Store::Folder });
        }
        let file = File::open(path).map_err(|e| InputError::unreadable(path, &e))?;
        let zip = ZipArchive::new(BufReader::new(file)).map_err(|e| {
            InputError::new(path, format!("not a readable zip archive ({e})")).help("Copy or export the file again")
        })?;
        let names = zip.file_names().flatten().map(std::borrow::Cow::into_owned).collect();
        Ok(Self { path: path.to_owned(), store: Store::Zip { names, zip: Mutex::new(zip) } })
    }

    /// The archive's file, or the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Whether there is such an entry.
    pub fn contains(&self, name: &str) -> bool {
        match &self.store {
            Store::Zip { names, .. } => names.iter().any(|n| n == name),
            Store::Folder => self.path.join(name).is_file(),
        }
    }

    /// Reads one entry.
    pub fn read(&self, name: &str) -> Result<Vec<u8>> {
        let bad = |found: String| InputError::new(&self.path, found).at(name.to_owned());
        let mut bytes = Vec::new();
        // The declared size may lie, so the limit is on what comes out.
        match &self.store {
            Store::Zip { zip, .. } => {
                let mut zip = zip.lock().unwrap_or_else(PoisonError::into_inner);
                let entry = zip.by_name(name).map_err(|e| bad(format!("cannot be read ({e})")))?;
                entry.take(MAX_ENTRY_BYTES + 1).read_to_end(&mut bytes)
            }
            Store::Folder => {
                let file = File::open(self.path.join(name)).map_err(|e| bad(format!("cannot be read ({e})")))?;
                file.take(MAX_ENTRY_BYTES + 1).read_to_end(&mut bytes)
            }
        }
        .map_err(|e| bad(format!("is damaged ({e})")))?;
        if bytes.len() as u64 > MAX_ENTRY_BYTES {
            return Err(
                bad(format!("unpacks to more than {} MiB, which no capture needs", MAX_ENTRY_BYTES >> 20)).into()
            );
        }
        Ok(bytes)
    }

    /// Reads one LZFSE-compressed entry that must not unpack to more than `most_bytes`.
    pub fn read_lzfse(&self, name: &str, most_bytes: usize) -> Result<Vec<u8>> {
        let packed = self.read(name)?;
        let bad = |found: String| InputError::new(&self.path, found).at(name.to_owned());
        let mut bytes = Vec::new();
        let mut decoder = lzfse_rust::LzfseRingDecoder::default();
        decoder
            .reader_bytes(&packed)
            .take(most_bytes as u64 + 1)
            .read_to_end(&mut bytes)
            .map_err(|e| bad(format!("not LZFSE data ({e})")))?;
        if bytes.len() > most_bytes {
            return Err(bad(format!("unpacks to more than {most_bytes} bytes")).into());
        }
        Ok(bytes)
    }
}
