//! The job: from an address and the names of parts to files on disk.

use std::fs::File;
use std::io::{BufReader, Read, Seek};
use std::path::{Path, PathBuf};

use mb_job::{Error, InputError, Progress, Result, write_atomic_with};
use serde::Serialize;

use crate::archive::{Extracted, extract, members, open, select};
use crate::http::{Answer, Failure, Patience, Server};
use crate::remote::RemoteFile;

/// Where the authors of the data set publish it (README of github.com/ActiveVisionLab/MobileBrick).
pub const PUBLISHED_URL: &str = "https://www.robots.ox.ac.uk/~victor/data/MobileBrick/MobileBrick_Mar23.zip";

/// What to download, and from where.
#[derive(Debug, Clone, PartialEq)]
pub struct DownloadOptions {
    /// Address of a zip archive, or the path of one that is here already.
    pub url: String,
    /// Folders or files of the archive, such as a sequence (`aston`), a kind of file (`mesh`) or both (`aston/mesh`); all where
    /// there are none.
    pub parts: Vec<String>,
    /// What a bad connection may cost.
    pub patience: Patience,
}

impl Default for DownloadOptions {
    fn default() -> Self {
        Self { url: PUBLISHED_URL.to_owned(), parts: Vec::new(), patience: Patience::default() }
    }
}

/// What was downloaded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DownloadSummary {
    /// Address or path of the archive.
    pub url: String,
    /// Whether the server answers requests for ranges, so that only what was asked for was read; false for a file.
    pub ranges: bool,
    /// Files of the archive that were asked for.
    pub files: usize,
    /// Of these, how many were written.
    pub files_written: usize,
    /// Of these, how many were there already, of the right size and checksum.
    pub files_kept: usize,
    /// Size of all of them.
    pub bytes: u64,
    /// The whole archive, where it had to be fetched.
    pub archive: Option<PathBuf>,
}

/// Downloads parts of an archive to `out`, where they lie as in the archive. Every file is checked against the size and
/// the checksum of the archive's index; those that are there already are not fetched again.
///
/// # Errors
/// The server cannot be reached, breaks off again and again, or refuses; the archive is damaged or changes meanwhile; a part
/// names nothing; a file cannot be written; the person asked for a stop.
pub fn download(out: &Path, options: &DownloadOptions, progress: &dyn Progress) -> Result<DownloadSummary> {
    let url = &options.url;
    if !url.starts_with("http://") && !url.starts_with("https://") {
        let file = File::open(url).map_err(|e| {
            InputError::unreadable(url, &e)
                .help("Give an address that begins with http:// or https://, or a zip archive")
        })?;
        let done = take(url, BufReader::new(file), out, &options.parts, progress)?;
        return Ok(summary(url, false, None, &done));
    }
    let server = Server::new(url, options.patience);
    let answer = server.persist(|| server.get(Some((0, 0))))?;
    if let Answer { range: Some((_, size)), version, .. } = answer {
        let remote = RemoteFile::new(&server, size, version, progress);
        let done = take(url, remote, out, &options.parts, progress)?;
        return Ok(summary(url, true, None, &done));
    }
    let archive = fetch_whole(&server, answer, out, progress)?;
    let file = File::open(&archive).map_err(|e| InputError::unreadable(&archive, &e))?;
    let done = take(&archive.display().to_string(), BufReader::new(file), out, &options.parts, progress)?;
    Ok(summary(url, false, Some(archive), &done))
}

fn summary(url: &str, ranges: bool, archive: Option<PathBuf>, done: &Extracted) -> DownloadSummary {
    DownloadSummary {
        url: url.to_owned(),
        ranges,
        files: done.files_written + done.files_kept,
        files_written: done.files_written,
        files_kept: done.files_kept,
        bytes: done.bytes,
        archive,
    }
}

fn take<R: Read + Seek>(
    url: &str,
    reader: R,
    out: &Path,
    parts: &[String],
    progress: &dyn Progress,
) -> Result<Extracted> {
    let mut zip = open(url, reader)?;
    let wanted = select(url, members(url, &zip)?, parts)?;
    extract(url, &mut zip, &wanted, out, progress)
}

/// Fetches the whole archive to `out`, or finds it there. Its first answer is at hand.
fn fetch_whole(server: &Server, first: Answer, out: &Path, progress: &dyn Progress) -> Result<PathBuf> {
    let name = server.url.split(['?', '#']).next().and_then(|url| url.rsplit('/').next()).filter(|n| !n.is_empty());
    let path = out.join(name.unwrap_or("archive.zip"));
    if let (Some(length), Ok(there)) = (first.length, std::fs::metadata(&path))
        && there.len() == length
    {
        return Ok(path);
    }
    let mut first = Some(first);
    server.persist(|| {
        let answer = match first.take() {
            Some(answer) => answer,
            None => server.get(None)?,
        };
        let mut trouble = None;
        let written = write_atomic_with(&path, |file| {
            let (mut body, mut count) = (answer.body, 0u64);
            let mut piece = vec![0; 64 << 10];
            loop {
                if progress.stop_requested() {
                    trouble = Some(Failure::Final(Error::Stopped));
                    return Err(std::io::Error::other("stopped"));
                }
                let read = match body.read(&mut piece) {
                    Ok(read) => read,
                    Err(e) => {
                        trouble = Some(Failure::Passing(e.to_string()));
                        return Err(e);
                    }
                };
                if read == 0 {
                    break;
                }
                count += read as u64;
                file.write_all(&piece[..read])?;
                let total = answer.length.unwrap_or(count);
                progress.report("whole archive, MB", (count / 1_000_000) as usize, (total / 1_000_000) as usize + 1);
            }
            if answer.length.is_some_and(|length| length != count) {
                trouble = Some(Failure::Passing(format!("it sent {count} of {} bytes", answer.length.unwrap_or(0))));
                return Err(std::io::Error::other("cut"));
            }
            Ok(())
        });
        match (written, trouble) {
            (_, Some(trouble)) => Err(trouble),
            (Err(error), None) => Err(Failure::Final(error)),
            (Ok(()), None) => Ok(()),
        }
    })?;
    Ok(path)
}
