//! From a recording to a sequence folder: selection, undistortion, writing.

use std::path::Path;

use mb_geometry::{ImageSize, Intrinsics};
use mb_image::RgbImage;
use mb_job::{Error, InputError, Progress, Result, Steps, write_atomic};

use crate::sequence::write_json;
use crate::{SequenceMeta, write_intrinsics_txt, write_pose_txt};

use super::recording::{Photo, RecordedFrame, Recording};
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

fn load(photo: &Photo, frame: &str, video: &mut Option<VideoReader>) -> Result<Option<Loaded>> {
    match photo {
        Photo::File(path) => {
            let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e).at(frame.to_owned()))?;
            let image = mb_image::decode_rgb(&bytes, path)?;
            let extension = extension(&bytes);
            Ok(Some(Loaded { image, original: Some((bytes, extension)) }))
        }
        Photo::Entry(archive, name) => {
            let bytes = archive.read(name)?;
            let image = mb_image::decode_rgb(&bytes, &archive.path().join(name))?;
            let extension = extension(&bytes);
            Ok(Some(Loaded { image, original: Some((bytes, extension)) }))
        }
        Photo::Video(path, index) => {
            if video.as_ref().is_none_or(|v| v.path() != path) {
                *video = Some(VideoReader::open(path)?);
            }
            let image = video.as_mut().expect("opened above").frame(*index)?;
            Ok(image.map(|image| Loaded { image, original: None }))
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

/// Writes the selected frames of a recording to `out`.
pub(super) fn write(
    mut recording: Recording,
    source: &Path,
    format: CaptureFormat,
    out: &Path,
    options: &ImportOptions,
    progress: &dyn Progress,
) -> Result<ImportSummary> {
    if options.every == 0 {
        return Err(Error::Failed("'every' must be at least 1".to_owned()));
    }
    if out.is_dir() && std::fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_some()) {
        return Err(InputError::new(out, "is not empty")
            .help("Give a new folder, so that nothing is overwritten")
            .into());
    }
    let frames_found = recording.frames.len() + recording.skipped.len();
    if let Some(pair) = recording.frames.windows(2).find(|pair| pair[0].id == pair[1].id) {
        return Err(InputError::new(source, "the frame is there twice").at(format!("frame {}", pair[0].id)).into());
    }
    let frames: Vec<RecordedFrame> = std::mem::take(&mut recording.frames)
        .into_iter()
        .filter(|f| options.range.is_none_or(|(first, last)| (first..=last).contains(&f.id.0)))
        .step_by(options.every)
        .collect();

    let steps = Steps::new(progress, "frames", frames.len());
    let mut summary = ImportSummary {
        format,
        frames_found,
        frames_imported: 0,
        frames_with_depth: 0,
        frames_with_pose: 0,
        frames_skipped: Vec::new(),
        image_size: ImageSize::new(0, 0),
        undistorted: 0,
        metric: recording.metric,
        warnings: Vec::new(),
    };
    let mut video = None;
    let mut times = Vec::new();
    let mut size = None;
    let mut rescaled = 0;
    for frame in &frames {
        steps.step()?;
        let name = format!("frame {}", frame.id);
        let loaded = match &frame.photo {
            Some(photo) => load(photo, &name, &mut video)?,
            None => None,
        };
        let Some(loaded) = loaded else {
            // Depth alone is a frame too, where it has a camera.
            if frame.photo.is_some() || frame.depth.is_none() {
                recording.skip(frame.id.to_string(), "it has no photograph");
                continue;
            }
            write_frame(out, frame, None, &mut summary)?;
            times.push(frame.time_s);
            continue;
        };
        let actual = loaded.image.size();
        if *size.get_or_insert(actual) != actual {
            let first = size.unwrap_or(actual);
            recording.skip(frame.id.to_string(), format!("the photograph is {actual}, those before it are {first}"));
            continue;
        }
        let mut adapted = frame.lens;
        if let Some(lens) = &mut adapted {
            match fitted(lens.intrinsics, frame.lens_size, actual) {
                Ok(k) => {
                    rescaled += usize::from(k != lens.intrinsics);
                    lens.intrinsics = k;
                }
                Err(reason) => {
                    recording.skip(frame.id.to_string(), reason);
                    continue;
                }
            }
        }
        write_frame(out, frame, Some((loaded, adapted)), &mut summary)?;
        times.push(frame.time_s);
    }
    if summary.frames_imported == 0 {
        let why = recording.skipped.first().map(|s| format!("; frame {}: {}", s.frame, s.reason)).unwrap_or_default();
        return Err(InputError::new(source, format!("none of its {frames_found} frames can be imported{why}")).into());
    }
    if rescaled > 0 {
        recording.warnings.push(format!("{rescaled} frames state intrinsics for another size of photograph; scaled"));
    }
    if !recording.metric && summary.frames_with_pose > 0 {
        recording.warnings.push("the scale of the poses is arbitrary, not metres".to_owned());
    }
    summary.image_size = size.unwrap_or(crate::Sequence::PUBLISHED_SIZE);
    let first = times.iter().flatten().copied().fold(f64::INFINITY, f64::min);
    let meta = SequenceMeta {
        version: 1,
        image_size: summary.image_size,
        device: recording.device,
        source: source.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
        frame_times_s: times.iter().map(|t| t.map(|t| t - first)).collect(),
        provenance: serde_json::json!({
            "program_version": env!("CARGO_PKG_VERSION"),
            "format": format.name(),
            "metric": summary.metric,
            "options": options,
        }),
    };
    write_json(&out.join("sequence.json"), &meta)?;
    summary.frames_skipped = recording.skipped;
    summary.warnings = recording.warnings;
    Ok(summary)
}

fn write_frame(
    out: &Path,
    frame: &RecordedFrame,
    photo: Option<(Loaded, Option<crate::Lens>)>,
    summary: &mut ImportSummary,
) -> Result<()> {
    let id = frame.id;
    let lens = match &photo {
        Some((_, lens)) => *lens,
        None => frame.lens,
    };
    if let Some((loaded, lens)) = photo {
        let bent = lens.filter(|lens| !lens.distortion.is_none());
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
            mb_image::write_confidence_png(out.join("arkit_depth").join(format!("{id}_conf.png")), &confidence)?;
        }
        summary.frames_with_depth += 1;
    }
    summary.frames_imported += 1;
    Ok(())
}
