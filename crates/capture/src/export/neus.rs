//! NeuS: photographs and masks by number, and `cameras_sphere.npz`.

use mb_job::{Result, Steps};

use crate::{Frame, write_neus_cameras};

use super::{Job, copy_mask, copy_photo};

pub(super) fn write(job: &Job<'_>, steps: &Steps<'_>) -> Result<usize> {
    let mut masks = 0;
    for (i, (frame, photo)) in job.frames.iter().enumerate() {
        copy_photo(photo, &job.out.join("image"), &format!("{i:03}"))?;
        masks += copy_mask(job, frame, job.out.join("mask").join(format!("{i:03}.png")))?;
        steps.step()?;
    }
    let frames: Vec<Frame> = job.frames.iter().map(|(frame, _)| frame.clone()).collect();
    write_neus_cameras(job.out.join("cameras_sphere.npz"), &frames, &job.object_in_world)?;
    Ok(masks)
}
