//! From a recording to a sequence folder: selection, undistortion, writing.

use std::path::Path;

use mb_geometry::{ImageSize, Intrinsics};
use mb_image::RgbImage;
use mb_job::{Error, InputError, Progress, Result, Steps, write_atomic};

use crate::lens::Lens;
use crate::manifest::file_hashes;
use crate::photo_quality::PhotoQuality;
use crate::sequence::write_json;
use crate::{FrameId, SequenceMeta, write_intrinsics_txt, write_pose_txt};

use super::recording::{Photo, RecordedFrame, Recording};
use super::staging::Staging;
use super::video::VideoReader;
use super::{CaptureFormat, ImportOptions, ImportSummary};

/// Quality of photographs that had to be encoded anew.
const JPEG_QUALITY: u8 = 95;

/// A photograph's pixels, and its file where it can be kept byte for byte.
struct Loaded {
    image: RgbImage,
    original: Option<(Vec<u8>, &'static str)>,
}

fn extension(bytes: &[u8]) -> &'static str {
    if bytes.starts_with(b"\x89PNG") { "png" } else { "jpg" }
}

/// Names the frame in an error about one of its files.
fn at_frame(error: Error, id: FrameId) -> Error {
    match error {
        Error::Input(mut input) if input.place.as_ref().is_none_or(|place| !place.starts_with("frame ")) => {
            let within = input.place.take().map(|place| format!(", {place}")).unwrap_or_default();
            input.at(format!("frame {id}{within}")).into()
        }
        other => other,
    }
}

/// A photograph's pixels; `Err` is the reason why there are none.
fn load(photo: &Photo, video: &mut Option<VideoReader>) -> Result<std::result::Result<Loaded, String>> {
    match photo {
        Photo::File(path) => {
            let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
            let image = mb_image::decode_rgb(&bytes, path)?;
            let extension = extension(&bytes);
            Ok(Ok(Loaded { image, original: Some((bytes, extension)) }))
        }
        Photo::Entry(archive, name) => {
            let bytes = archive.read(name)?;
            let image = mb_image::decode_rgb(&bytes, &archive.path().join(name))?;
            let extension = extension(&bytes);
            Ok(Ok(Loaded { image, original: Some((bytes, extension)) }))
        }
        Photo::Video(path, index) => {
            if video.as_ref().is_none_or(|v| v.path() != path) {
                *video = Some(VideoReader::open(path)?);
            }
            let video = video.as_mut().expect("opened above");
            let image = video.frame(*index)?;
            Ok(image
                .map(|image| Loaded { image, original: None })
                .ok_or_else(|| format!("the video ends after {} frames", video.frames_read())))
        }
    }
}

/// Intrinsics for the photograph as it is, where the source states them for another size.
fn fitted(k: Intrinsics, stated: Option<ImageSize>, actual: ImageSize) -> std::result::Result<Intrinsics, String> {
    match stated {
        Some(stated) if stated != actual => {
            let aspect = |s: ImageSize| s.width as f64 / s.height as f64;
            if (aspect(stated) / aspect(actual) - 1.0).abs() > 0.01 {
                return Err(format!("the photograph is {actual}, its intrinsics are for {stated}"));
            }
            Ok(k.resized(stated, actual))
        }
        _ => Ok(k),
    }
}

/// A frame that can be written.
struct Ready {
    frame_idx: usize,
    /// Photograph and lens; `None` where the frame is depth or a pose alone.
    photo: Option<(Loaded, Option<Lens>)>,
    /// Of the photograph; below that of any where there is none.
    sharpness: f64,
}

/// Reads frames one after the other and finds out which can be used.
struct Reader<'a> {
    frames: &'a [RecordedFrame],
    video: Option<VideoReader>,
    /// Size of the photographs, from the first.
    size: Option<ImageSize>,
    /// Frames whose intrinsics were stated for another size.
    rescaled: usize,
    /// Whether the source is a camera path and nothing else: no frame has a photograph or depth.
    path_alone: bool,
}

impl Reader<'_> {
    /// A frame's photograph and lens; `Err` is the reason why it cannot be used.
    fn read(&mut self, frame_idx: usize, judge: bool) -> Result<std::result::Result<Ready, String>> {
        let frame = &self.frames[frame_idx];
        let Some(photo) = &frame.photo else {
            // Depth alone is a frame too, and so is a pose where the source has nothing else.
            let usable = frame.depth.is_some() || (self.path_alone && frame.world_from_cam.is_some());
            let without_photo = Ready { frame_idx, photo: None, sharpness: -1.0 };
            return Ok(if usable { Ok(without_photo) } else { Err("it has no photograph".to_owned()) });
        };
        let loaded = match load(photo, &mut self.video)? {
            Ok(loaded) => loaded,
            Err(reason) => return Ok(Err(reason)),
        };
        let actual = loaded.image.size();
        let first = *self.size.get_or_insert(actual);
        if first != actual {
            return Ok(Err(format!("the photograph is {actual}, those before it are {first}")));
        }
        let mut adapted = frame.lens;
        if let Some(lens) = &mut adapted {
            match fitted(lens.intrinsics, frame.lens_size, actual) {
                Ok(k) => {
                    self.rescaled += usize::from(k != lens.intrinsics);
                    lens.intrinsics = k;
                }
                Err(reason) => return Ok(Err(reason)),
            }
        }
        let sharpness = if judge { PhotoQuality::of(&loaded.image).sharpness } else { 0.0 };
        Ok(Ok(Ready { frame_idx, photo: Some((loaded, adapted)), sharpness }))
    }
}

/// The frames that range and step leave.
fn selected(frames: Vec<RecordedFrame>, options: &ImportOptions) -> Vec<RecordedFrame> {
    let in_range = |f: &RecordedFrame| options.range.is_none_or(|(first, last)| (first..=last).contains(&f.id.0));
    frames.into_iter().filter(in_range).step_by(options.every).collect()
}

/// Runs of frames of which one each is kept: single ones, or `sharpest` runs of about equal length.
fn runs(frames: usize, options: &ImportOptions) -> Vec<std::ops::Range<usize>> {
    let count = options.sharpest.map_or(frames, |k| k.min(frames));
    (0..count).map(|i| i * frames / count..(i + 1) * frames / count).collect()
}

/// Writes the selected frames of a recording to `out`.
pub(super) fn write(
    mut recording: Recording,
    source: &Path,
    format: CaptureFormat,
    out: &Path,
    options: &ImportOptions,
    progress: &dyn Progress,
) -> Result<ImportSummary> {
    if options.every == 0 || options.sharpest == Some(0) {
        return Err(Error::Failed("'every' and 'sharpest' must be at least 1".to_owned()));
    }
    let staging = Staging::new(out)?;
    let frames_found = recording.frames.len() + recording.skipped.len();
    if let Some(pair) = recording.frames.windows(2).find(|pair| pair[0].id == pair[1].id) {
        return Err(InputError::new(source, "the frame is there twice").at(format!("frame {}", pair[0].id)).into());
    }
    let path_alone = recording.frames.iter().all(|f| f.photo.is_none() && f.depth.is_none());
    if path_alone {
        recording.warnings.push("there are no photographs and no depth maps, only the camera path".to_owned());
    }
    let frames = selected(std::mem::take(&mut recording.frames), options);

    let steps = Steps::new(progress, "frames", frames.len());
    let mut summary = ImportSummary {
        format,
        frames_found,
        frames_imported: 0,
        frames_not_selected: 0,
        frames_with_depth: 0,
        frames_with_pose: 0,
        frames_with_mask: 0,
        frames_skipped: Vec::new(),
        image_size: ImageSize::new(0, 0),
        undistorted: 0,
        metric: recording.metric,
        warnings: Vec::new(),
    };
    let mut reader = Reader { frames: &frames, video: None, size: None, rescaled: 0, path_alone };
    let mut times = Vec::new();
    for run in runs(frames.len(), options) {
        let judge = run.len() > 1;
        let mut best: Option<Ready> = None;
        for frame_idx in run {
            let id = frames[frame_idx].id;
            match reader.read(frame_idx, judge).map_err(|e| at_frame(e, id))? {
                Ok(ready) if best.as_ref().is_none_or(|best| ready.sharpness > best.sharpness) => best = Some(ready),
                Ok(_) => {}
                Err(reason) => recording.skip(id.to_string(), reason),
            }
            steps.step()?;
        }
        if let Some(ready) = best {
            let frame = &frames[ready.frame_idx];
            write_frame(staging.path(), frame, ready.photo, &mut summary).map_err(|e| at_frame(e, frame.id))?;
            times.push(frame.time_s);
        }
    }
    if summary.frames_imported == 0 {
        let why = recording.skipped.first().map(|s| format!("; frame {}: {}", s.frame, s.reason)).unwrap_or_default();
        return Err(InputError::new(source, format!("none of its {frames_found} frames can be imported{why}")).into());
    }
    // What range, step and sharpness left out is neither imported nor skipped.
    summary.frames_not_selected = frames_found - summary.frames_imported - recording.skipped.len();
    if reader.rescaled > 0 {
        let rescaled = reader.rescaled;
        recording.warnings.push(format!("{rescaled} frames state intrinsics for another size of photograph; scaled"));
    }
    if !recording.metric && summary.frames_with_pose > 0 {
        recording.warnings.push("the scale of the poses is arbitrary, not metres".to_owned());
    }
    summary.image_size = reader.size.unwrap_or(crate::Sequence::PUBLISHED_SIZE);
    let first = times.iter().flatten().copied().fold(f64::INFINITY, f64::min);
    let meta = SequenceMeta {
        version: 1,
        image_size: summary.image_size,
        device: recording.device,
        source: source.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
        frame_times_s: times.iter().map(|t| t.map(|t| t - first)).collect(),
        hashes_sha256: Some(file_hashes(staging.path())?),
        provenance: serde_json::json!({
            "program_version": env!("CARGO_PKG_VERSION"),
            "format": format.name(),
            "metric": summary.metric,
            "options": options,
        }),
    };
    write_json(&staging.path().join("sequence.json"), &meta)?;
    staging.finish()?;
    summary.frames_skipped = recording.skipped;
    summary.warnings = recording.warnings;
    Ok(summary)
}

fn write_frame(
    out: &Path,
    frame: &RecordedFrame,
    photo: Option<(Loaded, Option<Lens>)>,
    summary: &mut ImportSummary,
) -> Result<()> {
    let id = frame.id;
    let lens = match &photo {
        Some((_, lens)) => *lens,
        None => frame.lens,
    };
    let bent = lens.filter(|lens| !lens.distortion.is_none());
    if let Some((loaded, _)) = photo {
        match (bent, loaded.original) {
            (Some(lens), _) => {
                let (image, valid) = lens.undistort(&loaded.image);
                mb_image::write_jpeg(out.join("image").join(format!("{id}.jpg")), &image, JPEG_QUALITY)?;
                mb_image::write_mask_png(out.join("image_valid").join(format!("{id}.png")), &valid)?;
                summary.undistorted += 1;
            }
            (None, Some((bytes, extension))) => {
                write_atomic(out.join("image").join(format!("{id}.{extension}")), &bytes)?;
            }
            (None, None) => {
                mb_image::write_jpeg(out.join("image").join(format!("{id}.jpg")), &loaded.image, JPEG_QUALITY)?;
            }
        }
        if let Some(path) = &frame.mask {
            let mask = mb_image::read_mask_png(path)?;
            if mask.size() != loaded.image.size() {
                let found = format!("the mask is {}, the photograph {}", mask.size(), loaded.image.size());
                return Err(InputError::new(path, found).into());
            }
            let mask = bent.map_or(mask.clone(), |lens| lens.undistort_mask(&mask));
            mb_image::write_mask_png(out.join("mask").join(format!("{id}.png")), &mask)?;
            summary.frames_with_mask += 1;
        }
    }
    if let Some(lens) = lens {
        write_intrinsics_txt(out.join("intrinsic").join(format!("{id}.txt")), &lens.intrinsics)?;
    }
    if let Some(pose) = &frame.world_from_cam {
        write_pose_txt(out.join("pose").join(format!("{id}.txt")), pose)?;
        summary.frames_with_pose += 1;
    }
    if let Some(depth) = &frame.depth {
        let (depth, confidence) = depth.read()?;
        mb_image::write_depth_png(out.join("arkit_depth").join(format!("{id}.png")), &depth)?;
        if let Some(confidence) = confidence {
            if confidence.size() != depth.size() {
                let found = format!("the confidence map is {}, the depth map {}", confidence.size(), depth.size());
                return Err(Error::input(out.join("arkit_depth"), found));
            }
            mb_image::write_confidence_png(out.join("arkit_depth").join(format!("{id}_conf.png")), &confidence)?;
        }
        summary.frames_with_depth += 1;
    }
    summary.frames_imported += 1;
    Ok(())
}
