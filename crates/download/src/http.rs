//! One server, one address: requests for ranges of bytes, and bodies that do not wait for ever.

use std::io::Read;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::time::Duration;

use mb_job::Error;

/// How long a download puts up with a bad connection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Patience {
    /// A connection that is silent for so long is given up and made again.
    pub silence: Duration,
    /// Attempts in a row that bring nothing before the download fails.
    pub attempts: u32,
    /// Pause after the first of them; each later one is twice as long.
    pub pause: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        Self { silence: Duration::from_secs(30), attempts: 6, pause: Duration::from_secs(1) }
    }
}

/// Why a request brought nothing.
#[derive(Debug)]
pub(crate) enum Failure {
    /// It may work next time.
    Passing(String),
    /// It will not.
    Final(Error),
}

/// A file on a server.
pub(crate) struct Server {
    agent: ureq::Agent,
    pub url: String,
    pub patience: Patience,
}

/// What a server sends.
pub(crate) struct Answer {
    /// First byte and size of the whole file, where the server sends a range.
    pub range: Option<(u64, u64)>,
    /// Length of what is sent, where the server says so.
    pub length: Option<u64>,
    /// What changes when the file does: its ETag or date.
    pub version: Option<String>,
    pub body: Body,
}

impl Server {
    pub fn new(url: &str, patience: Patience) -> Self {
        let config = ureq::Agent::config_builder()
            .timeout_connect(Some(patience.silence))
            .timeout_recv_response(Some(patience.silence))
            .http_status_as_error(false)
            .user_agent(concat!("mobilebrick/", env!("CARGO_PKG_VERSION")))
            .build();
        Self { agent: config.into(), url: url.to_owned(), patience }
    }

    /// Asks for the bytes from the first to the last, both included, or for the whole file.
    pub fn get(&self, range: Option<(u64, u64)>) -> Result<Answer, Failure> {
        let mut request = self.agent.get(&self.url);
        if let Some((first, last)) = range {
            request = request.header("Range", format!("bytes={first}-{last}"));
        }
        let response = request.call().map_err(|e| match e {
            ureq::Error::BadUri(_) | ureq::Error::TooManyRedirects | ureq::Error::Http(_) => {
                Failure::Final(Error::input(&self.url, format!("cannot be asked for ({e})")))
            }
            e => Failure::Passing(e.to_string()),
        })?;
        let status = response.status();
        let header = |name: &str| response.headers().get(name).and_then(|v| v.to_str().ok()).map(str::to_owned);
        match status.as_u16() {
            200 | 206 => {}
            408 | 425 | 429 | 500 | 502 | 503 | 504 => return Err(Failure::Passing(format!("it answers {status}"))),
            _ => {
                let found = format!("{} answers {status}. Check the address, or give another one with --url", self.url);
                return Err(Failure::Final(Error::Failed(found)));
            }
        }
        let range = if status == 206 {
            let found = header("content-range").unwrap_or_default();
            let range = content_range(&found);
            Some(range.ok_or_else(|| Failure::Passing(format!("it sends a range without saying which ('{found}')")))?)
        } else {
            None
        };
        Ok(Answer {
            range,
            length: header("content-length").and_then(|v| v.parse().ok()),
            version: header("etag").or_else(|| header("last-modified")),
            body: Body::new(response.into_body().into_reader(), self.patience.silence),
        })
    }

    /// Asks again while failures may pass, each time after a longer pause.
    pub fn persist<T>(&self, mut ask: impl FnMut() -> Result<T, Failure>) -> Result<T, Error> {
        let mut failures = 0;
        loop {
            match ask() {
                Ok(answer) => return Ok(answer),
                Err(Failure::Final(error)) => return Err(error),
                Err(Failure::Passing(why)) => {
                    failures += 1;
                    self.wait_or_fail(failures, &why)?;
                }
            }
        }
    }

    /// Pauses after the `failures`-th failure in a row, or gives up.
    pub fn wait_or_fail(&self, failures: u32, why: &str) -> Result<(), Error> {
        if failures >= self.patience.attempts {
            return Err(Error::Failed(format!(
                "{} cannot be read: {why}, {failures} times in a row. Run the command again to go on from here",
                self.url
            )));
        }
        std::thread::sleep(self.patience.pause * 2u32.pow((failures - 1).min(6)));
        Ok(())
    }
}

/// First byte and size of the whole from `bytes FIRST-LAST/SIZE`.
fn content_range(header: &str) -> Option<(u64, u64)> {
    let (range, size) = header.strip_prefix("bytes ")?.split_once('/')?;
    Some((range.split_once('-')?.0.trim().parse().ok()?, size.trim().parse().ok()?))
}

/// A body that is read by a thread of its own, so that silence can be told from slowness.
pub(crate) struct Body {
    pieces: Receiver<std::io::Result<Vec<u8>>>,
    silence: Duration,
    piece: Vec<u8>,
    at: usize,
}

const PIECE: usize = 64 << 10;

impl Body {
    fn new(mut reader: impl Read + Send + 'static, silence: Duration) -> Self {
        let (send, pieces) = sync_channel(4);
        std::thread::spawn(move || {
            loop {
                let mut piece = vec![0; PIECE];
                let read = reader.read(&mut piece).map(|n| {
                    piece.truncate(n);
                    piece
                });
                let last = !read.as_ref().is_ok_and(|piece| !piece.is_empty());
                // Nobody listens any more where the body was dropped.
                if send.send(read).is_err() || last {
                    return;
                }
            }
        });
        Self { pieces, silence, piece: Vec::new(), at: 0 }
    }
}

impl Read for Body {
    fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
        if self.at == self.piece.len() {
            self.piece = match self.pieces.recv_timeout(self.silence) {
                Ok(piece) => piece?,
                Err(RecvTimeoutError::Disconnected) => Vec::new(),
                Err(RecvTimeoutError::Timeout) => {
                    let silent = format!("the server fell silent for {:.0} s", self.silence.as_secs_f64());
                    return Err(std::io::Error::new(std::io::ErrorKind::TimedOut, silent));
                }
            };
            self.at = 0;
        }
        let count = out.len().min(self.piece.len() - self.at);
        out[..count].copy_from_slice(&self.piece[self.at..self.at + count]);
        self.at += count;
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_read_from_their_header() {
        assert_eq!(content_range("bytes 10-19/200"), Some((10, 200)));
        for bad in ["", "bytes */200", "bytes 10-19/*", "items 1-2/3"] {
            assert_eq!(content_range(bad), None, "{bad}");
        }
    }

    #[test]
    fn silence_ends_a_body_and_slowness_does_not() {
        /// Sends two bytes, then nothing.
        struct Slow(u32);
        impl Read for Slow {
            fn read(&mut self, out: &mut [u8]) -> std::io::Result<usize> {
                self.0 += 1;
                std::thread::sleep(Duration::from_millis(if self.0 <= 2 { 20 } else { 100_000 }));
                out[0] = 7;
                Ok(1)
            }
        }
        let mut body = Body::new(Slow(0), Duration::from_millis(300));
        let mut two = [0; 2];
        body.read_exact(&mut two).unwrap();
        assert_eq!(body.read(&mut two).unwrap_err().kind(), std::io::ErrorKind::TimedOut);
    }
}
