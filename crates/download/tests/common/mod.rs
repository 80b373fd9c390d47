//! A web server for one file that can be told to misbehave.

use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// What the server does wrong; the default is nothing.
#[derive(Debug, Clone, Default)]
pub struct Faults {
    /// Sends the whole file whatever was asked for.
    pub ignores_ranges: bool,
    /// Cuts this many of the answers (the first ones longer than a hundred bytes) in the middle.
    pub cuts: usize,
    /// Falls silent in the middle of this many answers.
    pub silences: usize,
    /// Sends the head of every answer longer than a hundred bytes, and nothing of the body.
    pub mute: bool,
    /// Sends this many answers that claim to be longer than they are.
    pub wrong_lengths: usize,
    /// Answers this many requests with "503 Service Unavailable".
    pub refusals: usize,
    /// Answers every request with this status.
    pub status: Option<&'static str>,
    /// Flips the bits of the byte at this place, in this many answers that hold it.
    pub corrupts: Option<(usize, usize)>,
    /// Gives every answer another ETag, as if the file changed.
    pub changes: bool,
    /// Sends ranges that begin elsewhere than asked for.
    pub shifts: bool,
}

pub struct TestServer {
    pub url: String,
    /// Bytes of bodies sent.
    sent: Arc<AtomicU64>,
    state: Arc<(Vec<u8>, Mutex<Faults>)>,
}

impl TestServer {
    pub fn start(file: Vec<u8>, faults: Faults) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}/data/set.zip", listener.local_addr().unwrap());
        let (sent, requests) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicUsize::new(0)));
        let state = Arc::new((file, Mutex::new(faults)));
        let counters = (sent.clone(), requests);
        let shared = state.clone();
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let (state, counters) = (shared.clone(), counters.clone());
                std::thread::spawn(move || {
                    // A connection that the other side closes is no fault of the server.
                    let _ = serve(stream, &state.0, &state.1, &counters);
                });
            }
        });
        Self { url, sent, state }
    }

    /// From the next request on.
    pub fn misbehave(&self, faults: Faults) {
        *self.state.1.lock().unwrap() = faults;
    }

    pub fn sent(&self) -> u64 {
        self.sent.load(Ordering::SeqCst)
    }
}

fn serve(
    mut stream: TcpStream,
    file: &[u8],
    faults: &Mutex<Faults>,
    (sent, requests): &(Arc<AtomicU64>, Arc<AtomicUsize>),
) -> std::io::Result<()> {
    let mut reader = BufReader::new(stream.try_clone()?);
    let mut range = None;
    loop {
        let mut line = String::new();
        if reader.read_line(&mut line)? == 0 || line == "\r\n" {
            break;
        }
        if let Some(value) = line.to_ascii_lowercase().strip_prefix("range: bytes=") {
            let (first, last) = value.trim().split_once('-').unwrap();
            range = Some((first.parse::<usize>().unwrap(), last.parse::<usize>().unwrap()));
        }
    }
    let number = requests.fetch_add(1, Ordering::SeqCst);
    let take = |count: &mut usize| {
        let left = *count > 0;
        *count = count.saturating_sub(1);
        left
    };
    // Decided under the lock, sent without it.
    let mut f = faults.lock().unwrap();
    if let Some(status) = f.status {
        return write!(stream, "HTTP/1.1 {status}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
    }
    if take(&mut f.refusals) {
        return write!(stream, "HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
    }
    let asked = range.filter(|_| !f.ignores_ranges);
    let (first, end) =
        asked.map_or((0, file.len()), |(first, last)| (first.min(file.len()), (last + 1).min(file.len())));
    let mut body = file[first..end].to_vec();
    if let Some((place, left)) = &mut f.corrupts
        && (first..end).contains(place)
        && body.len() > 100
        && take(left)
    {
        body[*place - first] ^= 0xff;
    }
    let long = body.len() > 100;
    let (cut, silent, wrong) =
        (long && take(&mut f.cuts), long && take(&mut f.silences), long && take(&mut f.wrong_lengths));
    let (changes, shifts, mute) = (f.changes, f.shifts, f.mute && long);
    drop(f);

    let etag = if changes { number } else { 1 };
    let length = body.len() + if wrong { 1000 } else { 0 };
    let head = match asked {
        Some(_) => {
            let stated = first + usize::from(shifts && long);
            format!("206 Partial Content\r\nContent-Range: bytes {stated}-{}/{}", end - 1, file.len())
        }
        None => "200 OK".to_owned(),
    };
    write!(stream, "HTTP/1.1 {head}\r\nETag: \"{etag}\"\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n")?;
    let sent_bytes = match (mute, cut || silent) {
        (true, _) => 0,
        (false, true) => body.len() / 2,
        (false, false) => body.len(),
    };
    for piece in body[..sent_bytes].chunks(16 << 10) {
        stream.write_all(piece)?;
        sent.fetch_add(piece.len() as u64, Ordering::SeqCst);
    }
    if silent || mute {
        std::thread::sleep(Duration::from_secs(20));
    }
    Ok(())
}
