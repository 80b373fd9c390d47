//! MVSNet: one text file per camera, and for every view the views to match it with.

use std::fmt::Write as _;

use mb_job::{Result, Steps, write_atomic};
use nalgebra::Point3;

use super::{Job, copy_mask, copy_photo};

/// Source views listed for each view.
const SOURCES: usize = 10;
/// Depth planes that the interval is meant for.
const PLANES: f64 = 192.0;

pub(super) fn write(job: &Job<'_>, steps: &Steps<'_>) -> Result<usize> {
    let mut masks = 0;
    for (i, (frame, photo)) in job.frames.iter().enumerate() {
        let stem = format!("{i:08}");
        copy_photo(photo, &job.out.join("images"), &stem)?;
        masks += copy_mask(job, frame, job.out.join("masks").join(format!("{stem}.png")))?;
        let cam_from_world = frame.world_from_cam.inverse();
        // The object's depth range in this view, with a tenth to spare.
        let depths = job.object_in_world.corners().map(|corner| (cam_from_world * corner).z);
        let far = 1.1 * depths.iter().copied().fold(f64::MIN, f64::max).max(0.02);
        let near = (0.9 * depths.iter().copied().fold(f64::MAX, f64::min)).clamp(0.05 * far, 0.9 * far);
        let mut text = String::from("extrinsic\n");
        for row in cam_from_world.to_matrix().row_iter() {
            let _ = writeln!(text, "{} {} {} {}", row[0], row[1], row[2], row[3]);
        }
        text.push_str("\nintrinsic\n");
        for row in frame.intrinsics.to_matrix().row_iter() {
            let _ = writeln!(text, "{} {} {}", row[0], row[1], row[2]);
        }
        let _ = writeln!(text, "\n{near} {} {PLANES} {far}", (far - near) / (PLANES - 1.0));
        write_atomic(job.out.join("cams").join(format!("{stem}_cam.txt")), text.as_bytes())?;
        steps.step()?;
    }
    write_atomic(job.out.join("pair.txt"), pairs(job).as_bytes())?;
    Ok(masks)
}

/// The best sources of each view: those that see the object's middle under an angle near 10 degrees (MVSNet's own
/// choice is 5), wide enough for depth and narrow enough to match.
fn pairs(job: &Job<'_>) -> String {
    let middle = job.object_in_world.center();
    let towards: Vec<_> = job
        .frames
        .iter()
        .map(|(frame, _)| (Point3::from(frame.world_from_cam.translation()) - middle).normalize())
        .collect();
    let mut text = format!("{}\n", towards.len());
    for (i, own) in towards.iter().enumerate() {
        let mut scored: Vec<(f64, usize)> = towards
            .iter()
            .enumerate()
            .filter(|(j, _)| *j != i)
            .map(|(j, other)| {
                let angle = own.dot(other).clamp(-1.0, 1.0).acos().to_degrees();
                let width = if angle <= 10.0 { 5.0 } else { 15.0 };
                ((-0.5 * ((angle - 10.0) / width).powi(2)).exp(), j)
            })
            .collect();
        scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        scored.truncate(SOURCES);
        let _ = write!(text, "{i}\n{}", scored.len());
        for (score, j) in scored {
            let _ = write!(text, " {j} {score:.6}");
        }
        text.push('\n');
    }
    text
}
