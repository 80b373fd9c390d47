//! Stray Scanner: `rgb.mp4`, `odometry.csv`, `camera_matrix.csv`, `depth/NNNNNN.png`, `confidence/NNNNNN.png`.
//!
//! Rows of the odometry are joined with files by their frame number, never by position. The quaternion (x y z w) is
//! already camera-to-world with OpenCV axes. New recordings state intrinsics in every row; `camera_matrix.csv` is only
//! the last frame's, and serves where rows have none. The first versions of the app wrote neither a header nor frame numbers
//! (x, y, z, qx, qy, qz, qw, a row a frame), and depth as `.npy` arrays in millimetres.

use std::path::{Path, PathBuf};

use mb_geometry::{Intrinsics, Rigid3};
use mb_job::{InputError, Result};
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use crate::FrameId;
use crate::lens::{Distortion, Lens};

use super::recording::{Depth, Photo, RecordedFrame, Recording};

pub(super) fn looks_like(source: &Path) -> bool {
    source.join("odometry.csv").is_file()
}

fn read_text(path: &Path) -> Result<String> {
    let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
    String::from_utf8(bytes).map_err(|_| InputError::new(path, "not a text file").into())
}

fn camera_matrix(path: &Path) -> Result<Intrinsics> {
    let words: Option<Vec<f64>> = read_text(path)?
        .split([',', '\n', '\r'])
        .map(str::trim)
        .filter(|w| !w.is_empty())
        .map(|w| w.parse().ok())
        .collect();
    let words =
        words.filter(|w| w.len() == 9).ok_or_else(|| InputError::new(path, "not three rows of three numbers"))?;
    Ok(Intrinsics::from_matrix(&Matrix3::from_row_slice(&words)).map_err(|e| InputError::new(path, e.to_string()))?)
}

/// Which column of `odometry.csv` holds what.
struct Columns {
    pose: [usize; 7],
    /// `None` where rows are frames in order.
    frame: Option<usize>,
    time: Option<usize>,
    intrinsics: [Option<usize>; 4],
}

impl Columns {
    /// From the first line, which is a header unless it is a row of seven numbers.
    fn of(first: &str, path: &Path) -> Result<(Self, bool)> {
        let words: Vec<&str> = first.split(',').map(str::trim).collect();
        if words.len() == 7 && words.iter().all(|w| w.parse::<f64>().is_ok()) {
            return Ok((Self { pose: [0, 1, 2, 3, 4, 5, 6], frame: None, time: None, intrinsics: [None; 4] }, false));
        }
        let column = |name: &str| words.iter().position(|c| *c == name);
        let need = |name: &str| {
            column(name).ok_or_else(|| InputError::new(path, format!("has no column '{name}'")).at_line(1))
        };
        let columns = Self {
            pose: [need("x")?, need("y")?, need("z")?, need("qx")?, need("qy")?, need("qz")?, need("qw")?],
            frame: Some(need("frame")?),
            time: Some(need("timestamp")?),
            intrinsics: ["fx", "fy", "cx", "cy"].map(column),
        };
        Ok((columns, true))
    }
}

/// The first of these files that exists.
fn first_file(candidates: impl IntoIterator<Item = PathBuf>) -> Option<PathBuf> {
    candidates.into_iter().find(|p| p.is_file())
}

pub(super) fn read(source: &Path) -> Result<Recording> {
    let path = source.join("odometry.csv");
    let text = read_text(&path)?;
    let (columns, has_header) = Columns::of(text.lines().next().unwrap_or_default(), &path)?;
    let video = source.join("rgb.mp4");
    let has_video = video.is_file();
    let fallback = source.join("camera_matrix.csv");
    let mut shared = None;
    let mut recording = Recording::new("iPhone (Stray Scanner)", true);
    let rows = text.lines().enumerate().skip(usize::from(has_header)).filter(|(_, line)| !line.trim().is_empty());
    for (row, (i, line)) in rows.enumerate() {
        let words: Vec<&str> = line.split(',').map(str::trim).collect();
        let value = |at: usize| -> Result<f64> {
            let word = words.get(at).copied().unwrap_or("");
            let found = word.parse::<f64>().ok().filter(|v| v.is_finite());
            Ok(found.ok_or_else(|| {
                InputError::new(&path, format!("column {}: '{word}' is no number", at + 1)).at_line(i + 1)
            })?)
        };
        let id: u32 = match columns.frame {
            None => row as u32,
            Some(column) => {
                let frame = words.get(column).copied().unwrap_or("");
                let bad = || InputError::new(&path, format!("frame '{frame}' is no number")).at_line(i + 1);
                frame.parse().map_err(|_| bad())?
            }
        };
        let mut pose = [0.0; 7];
        for (to, at) in pose.iter_mut().zip(columns.pose) {
            *to = value(at)?;
        }
        let [x, y, z, qx, qy, qz, qw] = pose;
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        if (quaternion.norm() - 1.0).abs() > 0.01 {
            let found = format!("the quaternion has norm {:.4}, not 1", quaternion.norm());
            return Err(InputError::new(&path, found).at_line(i + 1).into());
        }
        let own = columns
            .intrinsics
            .iter()
            .map(|c| c.filter(|c| words.get(*c).is_some_and(|w| !w.is_empty())))
            .collect::<Option<Vec<_>>>();
        let intrinsics = match own {
            Some(own) => {
                let k = Intrinsics { fx: value(own[0])?, fy: value(own[1])?, cx: value(own[2])?, cy: value(own[3])? };
                if k.fx <= 0.0 || k.fy <= 0.0 {
                    return Err(InputError::new(&path, "a focal length is not above 0").at_line(i + 1).into());
                }
                k
            }
            None => match shared {
                Some(shared) => shared,
                None => *shared.insert(camera_matrix(&fallback)?),
            },
        };
        let file = |folder: &str, extensions: [&str; 2]| {
            first_file(extensions.map(|e| source.join(folder).join(format!("{id:06}.{e}"))))
        };
        let confidence = file("confidence", ["png", "npy"]);
        let depth = file("depth", ["png", "npy"]).map(|depth| match depth.extension() {
            Some(e) if e == "npy" => Depth::Npy(depth, confidence),
            _ => Depth::Png(depth, confidence),
        });
        recording.frames.push(RecordedFrame {
            id: FrameId(id),
            photo: match file("rgb", ["jpg", "png"]) {
                Some(photo) => Some(Photo::File(photo)),
                None => has_video.then(|| Photo::Video(video.clone(), id as usize)),
            },
            lens: Some(Lens { intrinsics, distortion: Distortion::None }),
            lens_size: None,
            world_from_cam: Some(Rigid3::from_parts(
                UnitQuaternion::from_quaternion(quaternion),
                Vector3::new(x, y, z),
            )),
            depth,
            mask: None,
            time_s: columns.time.map(value).transpose()?,
        });
    }
    if recording.frames.is_empty() {
        return Err(InputError::new(&path, "has no rows").into());
    }
    if shared.is_some() {
        recording.warnings.push(
            "odometry.csv has no intrinsics; camera_matrix.csv was used for every frame, although it is only the last frame's"
                .to_owned(),
        );
    }
    if !has_video && recording.frames.iter().all(|f| f.photo.is_none()) {
        recording.warnings.push("rgb.mp4 is absent, so there are no photographs".to_owned());
    }
    recording.frames.sort_by_key(|f| f.id);
    Ok(recording)
}
