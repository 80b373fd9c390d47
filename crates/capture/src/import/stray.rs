//! Stray Scanner: `rgb.mp4`, `odometry.csv`, `camera_matrix.csv`, `depth/NNNNNN.png`, `confidence/NNNNNN.png`.
//!
//! Rows of the odometry are joined with files by their frame number, never by position. The quaternion (x y z w) is
//! already camera-to-world with OpenCV axes. New recordings state intrinsics in every row; `camera_matrix.csv` is only
//! the last frame's, and serves where rows have none.

use std::path::Path;

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

pub(super) fn read(source: &Path) -> Result<Recording> {
    let path = source.join("odometry.csv");
    let text = read_text(&path)?;
    let mut lines = text.lines().enumerate();
    let (_, header) = lines.next().ok_or_else(|| InputError::new(&path, "is empty"))?;
    let columns: Vec<&str> = header.split(',').map(str::trim).collect();
    let column = |name: &str| columns.iter().position(|c| *c == name);
    let need =
        |name: &str| column(name).ok_or_else(|| InputError::new(&path, format!("has no column '{name}'")).at_line(1));
    let pose_columns = [need("x")?, need("y")?, need("z")?, need("qx")?, need("qy")?, need("qz")?, need("qw")?];
    let (time_column, frame_column) = (need("timestamp")?, need("frame")?);
    let k_columns = [column("fx"), column("fy"), column("cx"), column("cy")];

    let video = source.join("rgb.mp4");
    let fallback = source.join("camera_matrix.csv");
    let mut shared = None;
    let mut recording = Recording::new("iPhone (Stray Scanner)", true);
    for (i, line) in lines {
        if line.trim().is_empty() {
            continue;
        }
        let words: Vec<&str> = line.split(',').map(str::trim).collect();
        let value = |at: usize| -> Result<f64> {
            let word = words.get(at).copied().unwrap_or("");
            let found = word.parse::<f64>().ok().filter(|v| v.is_finite());
            Ok(found.ok_or_else(|| {
                InputError::new(&path, format!("column {}: '{word}' is no number", at + 1)).at_line(i + 1)
            })?)
        };
        let frame = words.get(frame_column).copied().unwrap_or("");
        let id: u32 = frame
            .parse()
            .map_err(|_| InputError::new(&path, format!("frame '{frame}' is no number")).at_line(i + 1))?;
        let mut pose = [0.0; 7];
        for (to, at) in pose.iter_mut().zip(pose_columns) {
            *to = value(at)?;
        }
        let [x, y, z, qx, qy, qz, qw] = pose;
        let quaternion = Quaternion::new(qw, qx, qy, qz);
        if (quaternion.norm() - 1.0).abs() > 0.01 {
            let found = format!("the quaternion has norm {:.4}, not 1", quaternion.norm());
            return Err(InputError::new(&path, found).at_line(i + 1).into());
        }
        let own = k_columns
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
        let file = |folder: &str| source.join(folder).join(format!("{id:06}.png"));
        let (depth, confidence) = (file("depth"), file("confidence"));
        let photo =
            ["jpg", "png"].map(|e| source.join("rgb").join(format!("{id:06}.{e}"))).into_iter().find(|p| p.exists());
        recording.frames.push(RecordedFrame {
            id: FrameId(id),
            photo: match photo {
                Some(photo) => Some(Photo::File(photo)),
                None => video.exists().then(|| Photo::Video(video.clone(), id as usize)),
            },
            lens: Some(Lens { intrinsics, distortion: Distortion::None }),
            lens_size: None,
            world_from_cam: Some(Rigid3::from_parts(
                UnitQuaternion::from_quaternion(quaternion),
                Vector3::new(x, y, z),
            )),
            depth: depth.exists().then(|| Depth::Png(depth, confidence.exists().then_some(confidence))),
            time_s: Some(value(time_column)?),
        });
    }
    if shared.is_some() {
        recording.warnings.push(
            "odometry.csv has no intrinsics; camera_matrix.csv was used for every frame, although it is only the last frame's"
                .to_owned(),
        );
    }
    if !video.exists() && recording.frames.iter().all(|f| f.photo.is_none()) {
        recording.warnings.push("rgb.mp4 is absent, so there are no photographs".to_owned());
    }
    recording.frames.sort_by_key(|f| f.id);
    Ok(recording)
}
