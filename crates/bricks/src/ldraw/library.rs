//! The official parts library, as a folder or as its zip.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};

use super::archive::{Archive, looks_like_zip};
use super::colors::{Color, ColorTable};
use super::file::FileKind;

/// No part file may be larger. The largest official one is 4 MB.
const MAX_PART_BYTES: u64 = 128 << 20;

/// Folders of a library in the order in which names are looked up, and what lies in them.
const SHELVES: [(&str, FileKind); 4] = [
    ("parts/", FileKind::Part),
    ("p/", FileKind::Piece),
    ("unofficial/parts/", FileKind::Part),
    ("unofficial/p/", FileKind::Piece),
];

/// A parts library: finds part files by name, whatever the case and the direction of the slashes.
///
/// Nothing is read at opening but the list of files and the colour table.
pub struct PartLibrary {
    path: PathBuf,
    store: Store,
    /// By normalised name (`3001.dat`, `s/3001s01.dat`, `48/4-4cyli.dat`).
    entries: HashMap<String, Entry>,
    colors: Option<Vec<Color>>,
}

enum Store {
    Folder,
    Zip(Archive),
}

struct Entry {
    place: Place,
    kind: FileKind,
    /// Position in [`SHELVES`]: earlier shelves win.
    shelf: usize,
}

enum Place {
    Path(PathBuf),
    Index(usize),
}

/// A part file's text as it lies in the library.
pub(crate) struct LibraryText {
    pub bytes: Vec<u8>,
    pub source: String,
    pub kind: FileKind,
}

impl PartLibrary {
    /// Opens the folder that holds `parts/` and `p/` (or a folder around it named `ldraw`), or a zip of either.
    ///
    /// # Errors
    /// `Error::Input` where there is no such folder or zip, or no parts in it.
    pub fn open(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let help = "A parts library is the folder that holds `parts` and `p`, or its zip (complete.zip of LDraw.org)";
        let mut library = if path.is_dir() {
            Self::open_folder(path)?
        } else if looks_like_zip(path) {
            Self::open_zip(path)?
        } else if path.exists() {
            return Err(InputError::new(path, "this is neither a folder nor a zip archive").help(help).into());
        } else {
            return Err(InputError::new(path, "no such file or folder").help(help).into());
        };
        if !library.entries.values().any(|entry| entry.kind == FileKind::Part) {
            return Err(InputError::new(path, "it holds no parts (no parts/*.dat)").help(help).into());
        }
        if let Some(config) = library.read("ldconfig.ldr")? {
            let text = String::from_utf8_lossy(&config.bytes);
            let definitions = text.lines().filter_map(|line| line.trim().strip_prefix("0 !COLOUR"));
            library.colors = Some(definitions.filter_map(Color::parse).collect());
        }
        Ok(library)
    }

    fn open_folder(path: &Path) -> Result<Self> {
        let root = [path.to_owned(), path.join("ldraw"), path.join("LDraw")]
            .into_iter()
            .find(|root| root.join("parts").is_dir() || root.join("PARTS").is_dir())
            .unwrap_or_else(|| path.to_owned());
        let mut entries = HashMap::new();
        for file in list_files(&root, 4)? {
            let relative = file.strip_prefix(&root).unwrap_or(&file).to_string_lossy().replace('\\', "/");
            shelve(&mut entries, &relative, Place::Path(file));
        }
        Ok(Self { path: path.to_owned(), store: Store::Folder, entries, colors: None })
    }

    fn open_zip(path: &Path) -> Result<Self> {
        let archive = Archive::open(path)?;
        let prefix = archive
            .entries()
            .find_map(|(name, _)| {
                let at = name.to_lowercase().find("parts/")?;
                let prefix = name.get(..at)?;
                (prefix.is_empty() || prefix.ends_with('/')).then(|| prefix.to_owned())
            })
            .unwrap_or_default();
        let mut entries = HashMap::new();
        for (name, index) in archive.entries() {
            if let Some(relative) = name.strip_prefix(&prefix) {
                shelve(&mut entries, relative, Place::Index(index));
            }
        }
        Ok(Self { path: path.to_owned(), store: Store::Zip(archive), entries, colors: None })
    }

    /// Where it was opened.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The names of all parts (no subparts, no primitives), sorted.
    pub fn part_names(&self) -> Vec<&str> {
        let parts = self.entries.iter().filter(|(name, entry)| entry.kind == FileKind::Part && !name.contains('/'));
        let mut names: Vec<&str> = parts.map(|(name, _)| name.as_str()).collect();
        names.sort_unstable();
        names
    }

    /// Whether there is a file of that name.
    pub fn contains(&self, name: &str) -> bool {
        self.entries.contains_key(&super::file::normalized_name(name))
    }

    /// The library's colour table, or the built-in one where it has none.
    pub fn colors(&self) -> ColorTable {
        let mut table = ColorTable::builtin();
        if let Some(colors) = &self.colors {
            table = ColorTable::default();
            colors.iter().for_each(|color| table.define(color.clone()));
        }
        table
    }

    /// The file of that (normalised) name; `None` where there is none.
    pub(crate) fn read(&self, name: &str) -> Result<Option<LibraryText>> {
        let Some(entry) = self.entries.get(name) else { return Ok(None) };
        let (bytes, source) = match (&entry.place, &self.store) {
            (Place::Index(index), Store::Zip(archive)) => {
                (archive.read(*index, "A parts library is not encrypted: fetch it again")?, archive.label(name))
            }
            (Place::Path(path), _) => (read_bounded(path, MAX_PART_BYTES)?, path.display().to_string()),
            (Place::Index(_), Store::Folder) => return Ok(None),
        };
        Ok(Some(LibraryText { bytes, source, kind: entry.kind }))
    }
}

/// Puts a file into the index under the name by which others refer to it.
fn shelve(entries: &mut HashMap<String, Entry>, relative: &str, place: Place) {
    let lower = relative.to_lowercase();
    if lower == "ldconfig.ldr" {
        entries.insert(lower, Entry { place, kind: FileKind::Model, shelf: 0 });
        return;
    }
    if !lower.ends_with(".dat") {
        return;
    }
    let Some((shelf, (prefix, kind))) = SHELVES.iter().enumerate().find(|(_, (prefix, _))| lower.starts_with(prefix))
    else {
        return;
    };
    let name = lower[prefix.len()..].to_owned();
    let kind = if name.starts_with("s/") { FileKind::Piece } else { *kind };
    match entries.get(&name) {
        Some(present) if present.shelf <= shelf => {}
        _ => {
            entries.insert(name, Entry { place, kind, shelf });
        }
    }
}

/// All files under `folder`, to a depth, sorted.
fn list_files(folder: &Path, depth: usize) -> Result<Vec<PathBuf>> {
    let unreadable = |e: std::io::Error| InputError::unreadable(folder, &e);
    let mut found = vec![];
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let entry = entry.map_err(unreadable)?;
        let path = entry.path();
        if path.is_dir() {
            if depth > 0 {
                found.extend(list_files(&path, depth - 1)?);
            }
        } else {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}

/// The bytes of a file that may be anything, up to a limit.
pub(crate) fn read_bounded(path: &Path, max_bytes: u64) -> Result<Vec<u8>> {
    use std::io::Read;
    let unreadable = |e: std::io::Error| InputError::unreadable(path, &e);
    let file = std::fs::File::open(path).map_err(unreadable)?;
    let mut bytes = vec![];
    file.take(max_bytes + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > max_bytes {
        let found = format!("it is larger than {} MB", max_bytes >> 20);
        return Err(InputError::new(path, found).help("No LDraw file is: is it the right one?").into());
    }
    Ok(bytes)
}
