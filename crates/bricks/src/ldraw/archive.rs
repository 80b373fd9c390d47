//! Zip archives that strangers made: every read is bounded.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use mb_job::{InputError, Result};
use zip::ZipArchive;
use zip::result::ZipError;

/// No text in an archive may be larger. The largest official part is 4 MB.
const MAX_ENTRY_BYTES: u64 = 128 << 20;
/// A text that packs better than this is a bomb (LDraw files reach about 15).
const MAX_RATIO: u64 = 200;
/// Small texts may pack well by chance.
const RATIO_MATTERS_FROM_BYTES: u64 = 1 << 20;
const DAMAGED: &str = "The archive is damaged: fetch or save it again";

/// An open zip archive.
pub(crate) struct Archive {
    path: PathBuf,
    zip: Mutex<ZipArchive<BufReader<File>>>,
    /// Entries by name as stored.
    index_of_name: BTreeMap<String, usize>,
}

impl Archive {
    pub fn open(path: &Path) -> Result<Self> {
        let file = File::open(path).map_err(|e| InputError::unreadable(path, &e))?;
        let zip = ZipArchive::new(BufReader::new(file)).map_err(|e| {
            InputError::new(path, format!("this is no readable zip archive ({e})"))
                .help("The file may be truncated: fetch or save it again")
        })?;
        let mut index_of_name = BTreeMap::new();
        for (index, name) in zip.file_names().enumerate() {
            let name =
                name.map_err(|e| InputError::new(path, e.to_string()).at(format!("entry {index}")).help(DAMAGED))?;
            let name = name.replace('\\', "/");
            if name.starts_with('/') || name.split('/').any(|piece| piece == "..") || name.contains(':') {
                let shown: String = name.chars().take(80).collect();
                return Err(InputError::new(path, "the entry's name points outside the archive")
                    .at(format!("entry {shown}"))
                    .help("Such archives are made to overwrite files elsewhere; this one is not read")
                    .into());
            }
            index_of_name.entry(name).or_insert(index);
        }
        Ok(Self { path: path.to_owned(), zip: Mutex::new(zip), index_of_name })
    }

    /// Names as stored (with forward slashes) and their indices.
    pub fn entries(&self) -> impl Iterator<Item = (&str, usize)> {
        self.index_of_name.iter().map(|(name, &index)| (name.as_str(), index))
    }

    /// `encrypted_help` says what to do where the entry is encrypted.
    pub fn read(&self, index: usize, encrypted_help: &str) -> Result<Vec<u8>> {
        let mut zip = self.zip.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let name = zip.file_names().nth(index).and_then(Result::ok).unwrap_or_default();
        let place = format!("entry {}", name.chars().take(80).collect::<String>());
        let bad = |found: &str| InputError::new(&self.path, found).at(place.clone());
        let entry = match zip.by_index(index) {
            Ok(entry) => entry,
            Err(ZipError::UnsupportedArchive(ZipError::PASSWORD_REQUIRED)) => {
                return Err(bad("it is encrypted").help(encrypted_help).into());
            }
            Err(e) => return Err(bad(&format!("it cannot be read ({e})")).help(DAMAGED).into()),
        };
        let (declared, packed) = (entry.size(), entry.compressed_size());
        let bomb = |bytes: u64| bytes > RATIO_MATTERS_FROM_BYTES && bytes / packed.max(1) > MAX_RATIO;
        let refuse = |bytes: u64| {
            bad(&format!("{packed} bytes unpack to {bytes} or more: a zip bomb"))
                .help("No brick model packs like that; it is not read")
        };
        if declared > MAX_ENTRY_BYTES || bomb(declared) {
            return Err(refuse(declared).into());
        }
        let mut bytes = Vec::with_capacity(declared.min(RATIO_MATTERS_FROM_BYTES) as usize);
        // The declared size may lie.
        let limit = if declared > 0 { declared } else { MAX_ENTRY_BYTES };
        entry
            .take(limit + 1)
            .read_to_end(&mut bytes)
            .map_err(|e| bad(&format!("it cannot be unpacked ({e})")).help(DAMAGED))?;
        if bytes.len() as u64 > limit || bomb(bytes.len() as u64) {
            return Err(refuse(bytes.len() as u64).into());
        }
        Ok(bytes)
    }

    /// The name of the archive for messages, with the entry behind it.
    pub fn label(&self, entry: &str) -> String {
        format!("{}:{entry}", self.path.display())
    }
}

/// Whether the file begins like a zip archive.
pub(crate) fn looks_like_zip(path: &Path) -> bool {
    let mut magic = [0; 4];
    File::open(path).and_then(|mut f| f.read_exact(&mut magic)).is_ok() && magic == *b"PK\x03\x04"
}
