//! Frames of a video, one after the other, through the `ffmpeg` command.
//!
//! Frames arrive as PPM through a pipe, in the order of display, in sensor orientation (`-noautorotate`); nothing is
//! written to disk and one frame is in memory at a time.

use std::ffi::OsStr;
use std::io::{BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::thread::JoinHandle;

use mb_geometry::ImageSize;
use mb_image::{MAX_PIXELS, RgbImage};
use mb_job::{InputError, Result};

/// A video that is being decoded.
pub(super) struct VideoReader {
    path: PathBuf,
    decoder: Child,
    pipe: BufReader<ChildStdout>,
    /// Reads what the decoder complains of, so that it never waits for a reader.
    complaints: Option<JoinHandle<String>>,
    /// Number of the frame that comes next.
    next: usize,
}

impl VideoReader {
    /// Starts decoding.
    pub fn open(path: &Path) -> Result<Self> {
        Self::open_with(OsStr::new("ffmpeg"), path)
    }

    fn open_with(command: &OsStr, path: &Path) -> Result<Self> {
        let mut decoder = Command::new(command)
            .args(["-v", "error", "-nostdin", "-noautorotate", "-i"])
            .arg(path)
            // Full chroma interpolation: the colours that a careful viewer shows, not the fastest ones.
            .args(["-map", "0:v:0", "-fps_mode", "passthrough"])
            .args(["-sws_flags", "accurate_rnd+full_chroma_int+bicubic", "-f", "image2pipe", "-c:v", "ppm", "pipe:1"])
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(|e| {
                InputError::new(
                    path,
                    format!("a video, and the command 'ffmpeg' that decodes it cannot be started ({e})"),
                )
                .help("Install ffmpeg 5.1 or newer (Debian: apt install ffmpeg; macOS: brew install ffmpeg)")
            })?;
        let pipe = BufReader::new(decoder.stdout.take().expect("stdout was asked to be a pipe"));
        let stderr = decoder.stderr.take().expect("stderr was asked to be a pipe");
        let complaints = std::thread::spawn(move || {
            // The first complaint says most; the rest is only drained.
            let mut first = String::new();
            for line in BufReader::new(stderr).split(b'\n').map_while(std::result::Result::ok) {
                if first.is_empty() {
                    first = String::from_utf8_lossy(&line).trim().to_owned();
                }
            }
            first
        });
        Ok(Self { path: path.to_owned(), decoder, pipe, complaints: Some(complaints), next: 0 })
    }

    /// The video's file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Frame `index`, which must not lie before one already read; `None` after the end.
    ///
    /// # Errors
    /// The video is damaged; what ffmpeg says is passed on.
    pub fn frame(&mut self, index: usize) -> Result<Option<RgbImage>> {
        assert!(index >= self.next, "frames are read in order");
        loop {
            let Some(image) = self.read_ppm()? else { return Ok(None) };
            self.next += 1;
            if self.next > index {
                return Ok(Some(image));
            }
        }
    }

    /// How many frames have been read.
    pub fn frames_read(&self) -> usize {
        self.next
    }

    /// An error with what ffmpeg said, once its output has ended.
    fn damaged(&mut self, found: &str) -> mb_job::Error {
        let said = self.complaints.take().and_then(|thread| thread.join().ok()).filter(|said| !said.is_empty());
        let said = said.map(|said| format!("; ffmpeg says: {said}")).unwrap_or_default();
        InputError::new(&self.path, format!("{found}{said}")).at(format!("frame {}", self.next)).into()
    }

    /// The next frame; `None` where the video ends as it should.
    fn read_ppm(&mut self) -> Result<Option<RgbImage>> {
        let mut words: Vec<String> = Vec::new();
        // "P6", width, height and 255, each ended by one white space.
        while words.len() < 4 {
            let mut word = Vec::new();
            loop {
                let mut byte = [0];
                match self.pipe.read(&mut byte) {
                    Ok(0) if words.is_empty() && word.is_empty() => {
                        let status = self.decoder.wait().ok();
                        let fine = status.is_some_and(|s| s.success()) && self.next > 0;
                        return if fine { Ok(None) } else { Err(self.damaged("the video cannot be decoded")) };
                    }
                    Ok(1) if byte[0].is_ascii_whitespace() => break,
                    Ok(1) if word.len() < 8 => word.push(byte[0]),
                    _ => return Err(self.damaged("the video is damaged, or ffmpeg stopped early")),
                }
            }
            words.push(String::from_utf8_lossy(&word).into_owned());
        }
        let pixels = |w: usize, h: usize| w.checked_mul(h).is_some_and(|n| (1..=MAX_PIXELS).contains(&n));
        let size = match (words[0].as_str(), words[1].parse::<usize>(), words[2].parse::<usize>()) {
            ("P6", Ok(w), Ok(h)) if pixels(w, h) => ImageSize::new(w, h),
            _ => return Err(self.damaged("ffmpeg sent something that is no frame")),
        };
        let mut bytes = vec![0; 3 * size.pixels()];
        if self.pipe.read_exact(&mut bytes).is_err() {
            return Err(self.damaged("the video ends within a frame"));
        }
        let pixels = bytes.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
        Ok(RgbImage::from_data(size, pixels))
    }
}

impl Drop for VideoReader {
    fn drop(&mut self) {
        // A decoder that nobody reads from is stopped and waited for.
        let _ = self.decoder.kill();
        let _ = self.decoder.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean absolute difference of two images, levels of 255.
    fn difference(a: &RgbImage, b: &RgbImage) -> f64 {
        assert_eq!(a.size(), b.size());
        let sum: u64 =
            a.data().as_flattened().iter().zip(b.data().as_flattened()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        sum as f64 / (3 * a.size().pixels()) as f64
    }

    #[test]
    fn frames_come_in_order_unrotated_and_as_another_decoder_shows_them() {
        let (Some(folder), Some(_)) = (mb_testdata::find("hevc_mp4"), mb_testdata::find_program("ffmpeg")) else {
            return;
        };
        for (name, size, frames) in [
            ("h265_video", ImageSize::new(128, 128), 10),
            // Its display matrix turns it by 90 degrees; the sensor's orientation is kept.
            ("nasa_13013_rotated", ImageSize::new(480, 270), 17),
        ] {
            let mut video = VideoReader::open(&folder.join(format!("{name}.mp4"))).unwrap();
            let fifth = video.frame(5).unwrap().unwrap();
            assert_eq!(fifth.size(), size);
            let reference = mb_image::read_rgb(folder.join(format!("{name}.frame5.png"))).unwrap();
            let off = difference(&fifth, &reference);
            assert!(off < 2.0, "{name}: {off} levels from the reference");
            while video.frame(video.frames_read()).unwrap().is_some() {}
            assert_eq!(video.frames_read(), frames, "{name}");
        }
    }

    #[test]
    fn a_damaged_video_is_named_with_what_the_decoder_says() {
        let (Some(folder), Some(_)) = (mb_testdata::find("hevc_mp4"), mb_testdata::find_program("ffmpeg")) else {
            return;
        };
        let whole = std::fs::read(folder.join("h265_video.mp4")).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("rgb.mp4");
        for cut in [0, 100, whole.len() / 2] {
            std::fs::write(&path, &whole[..cut]).unwrap();
            let message = VideoReader::open(&path).unwrap().frame(0).unwrap_err().to_string();
            assert!(message.contains("rgb.mp4: frame 0: the video cannot be decoded; ffmpeg says"), "{message}");
        }
    }

    #[test]
    fn without_the_command_the_message_says_what_to_install() {
        let missing = OsStr::new("/nonexistent/ffmpeg");
        let Err(error) = VideoReader::open_with(missing, Path::new("rgb.mp4")) else { panic!("it cannot start") };
        let message = error.to_string();
        assert!(message.contains("rgb.mp4") && message.contains("Install ffmpeg"), "{message}");
    }
}
