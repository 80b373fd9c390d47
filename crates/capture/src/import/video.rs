//! Frames of a video, one after the other, through the `ffmpeg` command.
//!
//! Frames arrive as PPM through a pipe, in the order of display, in sensor orientation (`-noautorotate`); nothing is
//! written to disk and one frame is in memory at a time.

use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};

use mb_geometry::ImageSize;
use mb_image::{MAX_PIXELS, RgbImage};
use mb_job::{InputError, Result};

/// A video that is being decoded.
pub(super) struct VideoReader {
    path: PathBuf,
    decoder: Child,
    pipe: BufReader<ChildStdout>,
    /// Number of the frame that comes next.
    next: usize,
}

impl VideoReader {
    /// Starts decoding.
    pub fn open(path: &Path) -> Result<Self> {
        let mut decoder = Command::new("ffmpeg")
            .args(["-v", "error", "-nostdin", "-noautorotate", "-i"])
            .arg(path)
            .args(["-fps_mode", "passthrough", "-f", "image2pipe", "-c:v", "ppm", "pipe:1"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|e| {
                InputError::new(
                    path,
                    format!("a video, and the command 'ffmpeg' that decodes it cannot be started ({e})"),
                )
                .help("Install ffmpeg (Debian: apt install ffmpeg; macOS: brew install ffmpeg)")
            })?;
        let pipe = BufReader::new(decoder.stdout.take().expect("stdout was asked to be a pipe"));
        Ok(Self { path: path.to_owned(), decoder, pipe, next: 0 })
    }

    /// The video's file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Frame `index`, which must not lie before one already read; `None` after the end.
    pub fn frame(&mut self, index: usize) -> Result<Option<RgbImage>> {
        loop {
            let Some(image) = self.read_ppm()? else { return Ok(None) };
            self.next += 1;
            if self.next > index {
                return Ok(Some(image));
            }
        }
    }

    fn read_ppm(&mut self) -> Result<Option<RgbImage>> {
        let bad = |found: &str| InputError::new(&self.path, found.to_owned());
        let mut words = Vec::new();
        // "P6", width, height and 255, each ended by one white space.
        for _ in 0..4 {
            let mut word = Vec::new();
            loop {
                let mut byte = [0];
                match self.pipe.read(&mut byte) {
                    Ok(0) if words.is_empty() && word.is_empty() => return Ok(None),
                    Ok(1) if byte[0].is_ascii_whitespace() => break,
                    Ok(1) if word.len() < 8 => word.push(byte[0]),
                    _ => return Err(bad("the video is damaged, or ffmpeg stopped early").into()),
                }
            }
            words.push(String::from_utf8_lossy(&word).into_owned());
        }
        let size = match (words[0].as_str(), words[1].parse::<usize>(), words[2].parse::<usize>()) {
            ("P6", Ok(w), Ok(h)) if w * h > 0 && w * h <= MAX_PIXELS => ImageSize::new(w, h),
            _ => return Err(bad("ffmpeg sent something that is no frame").into()),
        };
        let mut bytes = vec![0; 3 * size.pixels()];
        self.pipe.read_exact(&mut bytes).map_err(|_| bad("the video ends within a frame"))?;
        let pixels = bytes.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
        Ok(RgbImage::from_data(size, pixels))
    }
}

impl Drop for VideoReader {
    fn drop(&mut self) {
        // Drain nothing: a decoder that nobody reads from is stopped and waited for.
        let _ = self.pipe.fill_buf();
        let _ = self.decoder.kill();
        let _ = self.decoder.wait();
    }
}
