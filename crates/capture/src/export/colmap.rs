//! COLMAP: `images/`, `sparse/0` in both forms, and masks as its feature extractor wants them.

use mb_job::{Result, Steps};

use crate::colmap_model::{ColmapCamera, ColmapImage, ColmapModel};
use crate::lens::{Distortion, Lens};

use super::{Job, copy_mask, copy_photo};

pub(super) fn write(job: &Job<'_>, steps: &Steps<'_>) -> Result<usize> {
    let mut model = ColmapModel::default();
    let mut masks = 0;
    for (i, (frame, photo)) in job.frames.iter().enumerate() {
        let extension = copy_photo(photo, &job.out.join("images"), &frame.id.to_string())?;
        let name = format!("{}.{extension}", frame.id);
        masks += copy_mask(job, frame, job.out.join("masks").join(format!("{name}.png")))?;
        // Phones refocus: every frame has a camera of its own.
        let camera = i as u32 + 1;
        let lens = Lens { intrinsics: frame.intrinsics, distortion: Distortion::None };
        model.cameras.insert(camera, ColmapCamera { size: job.sequence.image_size(), lens });
        model.images.push(ColmapImage { name, camera, cam_from_world: frame.world_from_cam.inverse() });
        steps.step()?;
    }
    let folder = job.out.join("sparse/0");
    model.write_text(&folder)?;
    model.write_binary(&folder)?;
    Ok(masks)
}
