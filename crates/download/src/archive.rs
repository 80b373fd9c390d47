//! Members of the archive: which are wanted, which are there already, and how they get out.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{self, Read, Seek};
use std::path::{Path, PathBuf};

use mb_job::{Error, InputError, Progress, Result, write_atomic_with};
use zip::ZipArchive;
use zip::result::ZipError;

use crate::remote::broken;

/// A file of the archive.
pub(crate) struct Member {
    index: usize,
    /// Its path in the archive.
    pub name: String,
    /// The same as a path that stays inside the folder it is joined to.
    path: PathBuf,
    pub size: u64,
    crc: u32,
    offset: u64,
}

/// Deflate shrinks to a 1032nd at most: a member that claims to grow more is no file but a bomb.
const MAX_GROWTH: u64 = 1040;

/// An archive's error with its address, or what broke the connection below it.
fn zip_error(url: &str, place: Option<&str>, error: ZipError) -> Error {
    let input = |found: String| {
        let input = InputError::new(url, found);
        place.map_or(input.clone(), |place| input.at(place)).into()
    };
    match error {
        ZipError::Io(io) => match broken(io) {
            Ok(error) => error,
            Err(io) => input(format!("is no readable zip archive ({io})")),
        },
        other => input(format!("is no readable zip archive ({other})")),
    }
}

/// Opens an archive by its index.
pub(crate) fn open<R: Read + Seek>(url: &str, reader: R) -> Result<ZipArchive<R>> {
    ZipArchive::new(reader).map_err(|e| zip_error(url, None, e))
}

/// Files of an archive, from its index alone.
pub(crate) fn members<R: Read + Seek>(url: &str, zip: &ZipArchive<R>) -> Result<Vec<Member>> {
    let mut members = Vec::with_capacity(zip.len());
    let mut packed = 0u64;
    for index in 0..zip.len() {
        let entry = zip.by_index_data(index).map_err(|e| zip_error(url, None, e))?;
        let name = entry.name().map_err(|e| zip_error(url, None, e))?.into_owned();
        if entry.is_dir() || entry.is_symlink() || is_litter(&name) {
            continue;
        }
        let Some(path) = entry.enclosed_name() else {
            return Err(InputError::new(url, "a member whose path leaves the folder").at(name).into());
        };
        if entry.size() > MAX_GROWTH.saturating_mul(entry.compressed_size()).saturating_add(1024) {
            let found = format!("claims to unpack {} bytes to {}", entry.compressed_size(), entry.size());
            return Err(InputError::new(url, found).at(name).into());
        }
        packed = packed.saturating_add(entry.compressed_size());
        members.push(Member {
            index,
            path,
            size: entry.size(),
            crc: entry.crc32(),
            offset: entry.header_start(),
            name,
        });
    }
    if packed > zip.central_directory_start() {
        return Err(InputError::new(url, "its members overlap: it is no archive of files but a bomb").into());
    }
    // In the order in which they lie, so that a connection is read from its start to its end.
    members.sort_by_key(|m| m.offset);
    Ok(members)
}

/// What archivers of some systems leave in archives.
fn is_litter(name: &str) -> bool {
    name.starts_with("__MACOSX/") || name.rsplit('/').next() == Some(".DS_Store")
}

/// Whether a part names this member: the part's folders follow each other somewhere in its path, the last of them not as the
/// file itself unless the whole name is given.
fn selects(part: &str, name: &str) -> bool {
    let wanted: Vec<&str> = part.split('/').filter(|p| !p.is_empty()).collect();
    let path: Vec<&str> = name.split('/').collect();
    !wanted.is_empty() && path.windows(wanted.len()).any(|w| w == wanted)
}

/// The members that are wanted: all, or those of the named parts.
///
/// # Errors
/// A part names nothing; the folders that there are are listed.
pub(crate) fn select(url: &str, members: Vec<Member>, parts: &[String]) -> Result<Vec<Member>> {
    for part in parts {
        if !members.iter().any(|m| selects(part, &m.name)) {
            let folders: BTreeSet<&str> =
                members.iter().flat_map(|m| m.name.split('/').rev().skip(1)).filter(|f| !f.is_empty()).collect();
            let shown: Vec<&str> = folders.iter().copied().take(40).collect();
            let more = if folders.len() > shown.len() { ", ..." } else { "" };
            return Err(InputError::new(url, format!("has no folder or file '{part}'"))
                .help(format!("It has {}{more}", shown.join(", ")))
                .into());
        }
    }
    let wanted = |m: &Member| parts.is_empty() || parts.iter().any(|part| selects(part, &m.name));
    Ok(members.into_iter().filter(wanted).collect())
}

/// What was done with the wanted members.
#[derive(Debug, Default)]
pub(crate) struct Extracted {
    pub files_written: usize,
    pub files_kept: usize,
    pub bytes: u64,
}

/// Whether the file is there, of the member's size and checksum.
fn is_there(path: &Path, member: &Member) -> bool {
    let Ok(mut file) = File::open(path) else { return false };
    if file.metadata().map_or(0, |m| m.len()) != member.size {
        return false;
    }
    let mut hasher = crc32fast::Hasher::new();
    let mut piece = vec![0; 64 << 10];
    loop {
        match file.read(&mut piece) {
            Ok(0) => return hasher.finalize() == member.crc,
            Ok(count) => hasher.update(&piece[..count]),
            Err(_) => return false,
        }
    }
}

/// Members that arrive damaged are asked for so many times.
const TRIES: usize = 3;

/// Writes the members below `out`, leaving out those that are there already.
pub(crate) fn extract<R: Read + Seek>(
    url: &str,
    zip: &mut ZipArchive<R>,
    members: &[Member],
    out: &Path,
    progress: &dyn Progress,
) -> Result<Extracted> {
    let megabytes = |bytes: u64| bytes.div_ceil(1_000_000) as usize;
    let total = members.iter().map(|m| m.size).sum();
    let mut done = Extracted::default();
    for member in members {
        progress.report("download, MB", megabytes(done.bytes), megabytes(total));
        if progress.stop_requested() {
            return Err(Error::Stopped);
        }
        let path = out.join(&member.path);
        if is_there(&path, member) {
            done.files_kept += 1;
        } else {
            let mut tries = 1;
            while let Err(damage) = extract_one(url, zip, member, &path)? {
                if tries == TRIES {
                    return Err(InputError::new(url, format!("arrives damaged, {TRIES} times: {damage}"))
                        .at(&member.name)
                        .help("The archive on the server may be damaged; tell whoever keeps it")
                        .into());
                }
                tries += 1;
            }
            done.files_written += 1;
        }
        done.bytes += member.size;
    }
    progress.report("download, MB", megabytes(total), megabytes(total));
    Ok(done)
}

/// Writes one member; the inner error says how it is damaged.
fn extract_one<R: Read + Seek>(
    url: &str,
    zip: &mut ZipArchive<R>,
    member: &Member,
    path: &Path,
) -> Result<std::result::Result<(), String>> {
    let mut entry = match zip.by_index(member.index) {
        Ok(entry) => entry,
        Err(ZipError::Io(io)) => match broken(io) {
            Ok(error) => return Err(error),
            Err(io) => return Ok(Err(io.to_string())),
        },
        Err(ZipError::UnsupportedArchive(why)) => {
            return Err(InputError::new(url, format!("cannot be unpacked here ({why})")).at(&member.name).into());
        }
        Err(other) => return Ok(Err(other.to_string())),
    };
    let mut trouble = None;
    let written = write_atomic_with(path, |file| {
        let mut piece = vec![0; 64 << 10];
        let mut count = 0;
        // The checksum is compared where the member ends.
        loop {
            match entry.read(&mut piece) {
                Ok(0) => break,
                Ok(n) => {
                    count += n as u64;
                    if count > member.size {
                        trouble = Some(io::Error::other(format!("more than the {} bytes of the index", member.size)));
                        return Err(io::Error::other("too long"));
                    }
                    file.write_all(&piece[..n])?;
                }
                Err(e) => {
                    trouble = Some(e);
                    return Err(io::Error::other("unreadable"));
                }
            }
        }
        if count < member.size {
            trouble = Some(io::Error::other(format!("{count} bytes, {} in the index", member.size)));
            return Err(io::Error::other("too short"));
        }
        Ok(())
    });
    match (written, trouble) {
        (_, Some(trouble)) => match broken(trouble) {
            Ok(error) => Err(error),
            Err(damage) => Ok(Err(damage.to_string())),
        },
        (Err(error), None) => Err(error),
        (Ok(()), None) => Ok(Ok(())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_is_a_run_of_folders() {
        let name = "MobileBrick/test/aston/mesh/gt_mesh.ply";
        for part in ["aston", "mesh", "aston/mesh", "test", "test/aston/", "gt_mesh.ply", name] {
            assert!(selects(part, name), "{part}");
        }
        for part in ["", "/", "ast", "mesh/aston", "aston/gt_mesh.ply", "train"] {
            assert!(!selects(part, name), "{part}");
        }
    }
}
