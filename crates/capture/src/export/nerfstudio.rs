//! nerfstudio and instant-ngp: `transforms.json` with intrinsics for every frame.

use mb_job::{Result, Steps};
use nalgebra::{Matrix4, Vector4};
use serde_json::{Value, json};

use super::{Job, copy_mask, copy_photo};

pub(super) fn write(job: &Job<'_>, steps: &Steps<'_>) -> Result<usize> {
    let size = job.sequence.image_size();
    let opengl_from_cam = Matrix4::from_diagonal(&Vector4::new(1.0, -1.0, -1.0, 1.0));
    let mut frames = Vec::with_capacity(job.frames.len());
    let mut masks = 0;
    for (frame, photo) in &job.frames {
        let extension = copy_photo(photo, &job.out.join("images"), &frame.id.to_string())?;
        let matrix = frame.world_from_cam.to_matrix() * opengl_from_cam;
        let rows: Vec<Vec<f64>> = matrix.row_iter().map(|row| row.iter().copied().collect()).collect();
        let k = frame.intrinsics;
        let mut entry = json!({
            "file_path": format!("images/{}.{extension}", frame.id),
            "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx + 0.5, "cy": k.cy + 0.5,
            "w": size.width, "h": size.height,
            "transform_matrix": rows,
        });
        let mask = format!("masks/{}.png", frame.id);
        if copy_mask(job, frame, job.out.join(&mask))? == 1 {
            masks += 1;
            entry["mask_path"] = Value::from(mask);
        }
        frames.push(entry);
        steps.step()?;
    }
    let document = json!({ "camera_model": "OPENCV", "frames": frames });
    crate::sequence::write_json(&job.out.join("transforms.json"), &document)?;
    Ok(masks)
}
