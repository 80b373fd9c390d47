//! A file on a server as something that can be read and sought in.

use std::io::{self, Read, Seek, SeekFrom};

use mb_job::{Error, Progress};

use crate::http::{Body, Failure, Server};

/// First request of a run of reads, bytes; each that goes on where the last one ended asks for twice as much.
const FIRST_WINDOW: u64 = 256 << 10;
const LARGEST_WINDOW: u64 = 64 << 20;
/// Bytes that are read and dropped rather than asked for anew.
const SKIP: u64 = 256 << 10;
const BLOCK: usize = 64 << 10;

/// A failure that no reader can mend, inside an [`io::Error`].
#[derive(Debug)]
pub(crate) struct Broken(pub Error);

impl std::fmt::Display for Broken {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.fmt(f)
    }
}

impl std::error::Error for Broken {}

/// The failure inside an [`io::Error`], or the error itself where it is of another kind.
pub(crate) fn broken(error: io::Error) -> Result<Error, io::Error> {
    if error.get_ref().is_some_and(|inner| inner.is::<Broken>()) {
        let inner = error.into_inner().and_then(|inner| inner.downcast::<Broken>().ok());
        return Ok(inner.map_or_else(|| Error::Failed("the download broke off".to_owned()), |broken| broken.0));
    }
    Err(error)
}

/// A file on a server that answers requests for ranges.
pub(crate) struct RemoteFile<'a> {
    server: &'a Server,
    progress: &'a dyn Progress,
    size: u64,
    version: Option<String>,
    pos: u64,
    /// The last bytes read, and where they begin.
    block: Vec<u8>,
    block_at: u64,
    stream: Option<Stream>,
    /// Size of the next request if it goes on where the last one ended.
    window: u64,
    last_end: u64,
}

/// A body that is being read.
struct Stream {
    body: Body,
    at: u64,
    end: u64,
}

impl<'a> RemoteFile<'a> {
    pub fn new(server: &'a Server, size: u64, version: Option<String>, progress: &'a dyn Progress) -> Self {
        Self {
            server,
            progress,
            size,
            version,
            pos: 0,
            block: Vec::new(),
            block_at: 0,
            stream: None,
            window: FIRST_WINDOW,
            last_end: 0,
        }
    }

    /// Asks for the bytes from the position on.
    fn open(&mut self) -> Result<Stream, Failure> {
        self.window = if self.pos == self.last_end { (2 * self.window).min(LARGEST_WINDOW) } else { FIRST_WINDOW };
        let end = (self.pos + self.window).min(self.size);
        let answer = self.server.get(Some((self.pos, end - 1)))?;
        match answer.range {
            Some((first, size)) if first == self.pos && size == self.size => {}
            Some((first, size)) => {
                let found = format!(
                    "sends byte {first} of {size} where byte {} of {} was asked for; the archive has changed, or the server is \
                     at fault. Start again",
                    self.pos, self.size
                );
                return Err(Failure::Final(Error::input(&self.server.url, found)));
            }
            None => return Err(Failure::Passing("it ignores the range that was asked for".to_owned())),
        }
        if answer.version != self.version {
            let found = "has changed on the server while it was read. Start again";
            return Err(Failure::Final(Error::input(&self.server.url, found)));
        }
        self.last_end = end;
        Ok(Stream { body: answer.body, at: self.pos, end })
    }

    /// Reads the block at the position.
    fn next_block(&mut self) -> Result<(), Failure> {
        let near = |s: &Stream| s.at <= self.pos && self.pos < s.end && self.pos - s.at <= SKIP;
        if !self.stream.as_ref().is_some_and(near) {
            self.stream = None;
            self.stream = Some(self.open()?);
        }
        let stream = self.stream.as_mut().expect("opened above");
        let mut block = vec![0; BLOCK];
        loop {
            let most = (stream.end - stream.at).min(BLOCK as u64) as usize;
            let count = stream.body.read(&mut block[..most]).map_err(|e| Failure::Passing(e.to_string()))?;
            if count == 0 {
                let cut = format!("the connection was cut {} bytes before its end", stream.end - stream.at);
                return Err(Failure::Passing(cut));
            }
            let at = stream.at;
            stream.at += count as u64;
            if stream.at > self.pos {
                block.truncate(count);
                (self.block, self.block_at) = (block, at);
                return Ok(());
            }
        }
    }

    fn fill(&mut self) -> Result<(), Error> {
        let mut failures = 0;
        loop {
            if self.progress.stop_requested() {
                return Err(Error::Stopped);
            }
            match self.next_block() {
                Ok(()) => return Ok(()),
                Err(Failure::Final(error)) => return Err(error),
                Err(Failure::Passing(why)) => {
                    self.stream = None;
                    failures += 1;
                    self.server.wait_or_fail(failures, &why)?;
                }
            }
        }
    }
}

impl Read for RemoteFile<'_> {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        if self.pos >= self.size || out.is_empty() {
            return Ok(0);
        }
        let in_block = (self.block_at..self.block_at + self.block.len() as u64).contains(&self.pos);
        if !in_block {
            self.fill().map_err(|e| io::Error::other(Broken(e)))?;
        }
        let from = (self.pos - self.block_at) as usize;
        let count = out.len().min(self.block.len() - from);
        out[..count].copy_from_slice(&self.block[from..from + count]);
        self.pos += count as u64;
        Ok(count)
    }
}

impl Seek for RemoteFile<'_> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let pos = match to {
            SeekFrom::Start(pos) => Some(pos),
            SeekFrom::End(by) => self.size.checked_add_signed(by),
            SeekFrom::Current(by) => self.pos.checked_add_signed(by),
        };
        self.pos = pos.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "a place before the file's start"))?;
        Ok(self.pos)
    }
}
