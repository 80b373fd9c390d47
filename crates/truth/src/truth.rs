//! All ground truth of one sequence.

use std::time::Instant;

use mb_capture::{FrameId, Sequence, write_neus_cameras};
use mb_job::{Error, Progress, Result, Steps};
use mb_recon::TsdfVolume;
use serde::{Deserialize, Serialize};

use crate::visible_surface::VisibleSurface;
use crate::{ExactScene, visibility};

/// Options of [`truth`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TruthOptions {
    /// Voxels of the fused `gt_mesh.ply`, millimetres.
    pub gt_mesh_voxel_mm: f64,
    /// Truncation of the fused mesh, millimetres. Below the thinnest walls (1.5 mm) nothing would be fused, far above
    /// them their two sides merge.
    pub gt_mesh_truncation_mm: f64,
    /// Longest edge of the pieces by which the visible surface is decided, millimetres.
    pub piece_edge_mm: f64,
    /// Voxels of the visibility volume, millimetres; the published ones have 2.5.
    pub visibility_voxel_mm: f64,
    /// Room around the model in the visibility volume, millimetres.
    pub visibility_margin_mm: f64,
}

impl Default for TruthOptions {
    fn default() -> Self {
        Self {
            gt_mesh_voxel_mm: 1.0,
            gt_mesh_truncation_mm: 3.0,
            piece_edge_mm: 2.0,
            visibility_voxel_mm: 2.5,
            visibility_margin_mm: 20.0,
        }
    }
}

impl TruthOptions {
    fn validate(&self) -> Result<()> {
        let lengths = [
            ("gt_mesh_voxel_mm", self.gt_mesh_voxel_mm, 0.1),
            ("piece_edge_mm", self.piece_edge_mm, 0.1),
            ("visibility_voxel_mm", self.visibility_voxel_mm, 0.1),
            ("visibility_margin_mm", self.visibility_margin_mm, 0.0),
        ];
        for (name, value, least) in lengths {
            if !(least..=1000.0).contains(&value) {
                return Err(Error::Failed(format!("{name} is {value}, must be {least} to 1000 mm")));
            }
        }
        Ok(())
    }
}

/// What [`truth`] wrote.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TruthSummary {
    /// Frames with depth and mask.
    pub frames: usize,
    /// Frames in which no pixel shows the model.
    pub frames_without_model: Vec<FrameId>,
    /// Mean share of the photograph that shows the model.
    pub mask_share: f64,
    /// Area of the model, square millimetres, both sides of every wall.
    pub model_area_mm2: f64,
    /// Area that some frame sees, square millimetres.
    pub visible_area_mm2: f64,
    /// Triangles of `mesh/visible_surface.ply`.
    pub visible_triangles: usize,
    /// Triangles of `mesh/gt_mesh.ply`.
    pub gt_mesh_triangles: usize,
    /// Voxels of the visibility volume along x, y, z.
    pub visibility_resolutions: [usize; 3],
    /// Share of these that some frame can judge.
    pub visible_voxel_share: f64,
    /// The options as used.
    pub options: TruthOptions,
    /// Wall time.
    pub seconds: f64,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

/// Writes `gt_depth/`, `mask/`, `mesh/gt_mesh.ply`, `mesh/visible_surface.ply`, `visibility_mask.npy` and `cameras.npz`
/// into the sequence's folder, from its model and its alignment.
///
/// Meshes are in metres in the sequence's world frame, double precision. Files are replaced one by one when they are whole;
/// a stopped run leaves earlier ones as they were, and a new run does all again, with the same bytes.
///
/// # Errors
/// The sequence has no model or alignment, an option is out of range, no frame shows the model, a file cannot be
/// written, or the person asked for a stop.
pub fn truth(sequence: &Sequence, options: &TruthOptions, progress: &dyn Progress) -> Result<TruthSummary> {
    options.validate()?;
    let start = Instant::now();
    let exact = ExactScene::open(sequence)?;
    let bounds_in_world = exact.mesh.bounds();
    let mut volume = visibility::empty_volume(
        &bounds_in_world,
        options.visibility_margin_mm * 1e-3,
        options.visibility_voxel_mm * 1e-3,
    )?;
    let mut tsdf = TsdfVolume::new(options.gt_mesh_voxel_mm * 1e-3, options.gt_mesh_truncation_mm * 1e-3)?;
    let mut surface = VisibleSurface::new(&exact.mesh, options.piece_edge_mm * 1e-3);

    let mut frames_without_model = Vec::new();
    let mut model_pixels = 0;
    let steps = Steps::new(progress, "exact depth", exact.frames.len());
    for frame in &exact.frames {
        let view = exact.view(frame);
        let raster = exact.render(frame);
        let mask = raster.mask();
        match mask.data().iter().filter(|m| **m).count() {
            0 => frames_without_model.push(frame.id),
            pixels => model_pixels += pixels,
        }
        let (depth_file, mask_file) = rayon::join(
            || mb_image::write_depth_png(sequence.gt_depth_path(frame.id), &raster.depth),
            || mb_image::write_mask_png(sequence.mask_path(frame.id), &mask),
        );
        depth_file.and(mask_file)?;
        visibility::observe(&mut volume, &raster.depth, &view);
        surface.observe(&raster.depth, &view);
        tsdf.allocate(&raster.depth, &view.intrinsics, &view.cam_from_frame)?;
        steps.step()?;
    }
    if model_pixels == 0 {
        return Err(Error::Failed(format!(
            "no frame of {} shows the model: the alignment or the poses are wrong",
            sequence.root().display()
        )));
    }
    // Distances are averaged in a second pass, so that every frame clears the space that it saw in every block.
    let steps = Steps::new(progress, "fuse exact depth", exact.frames.len());
    for frame in &exact.frames {
        let view = exact.view(frame);
        tsdf.integrate(&exact.render(frame).depth, None, &view.intrinsics, &view.cam_from_frame)?;
        steps.step()?;
    }
    let gt_mesh = tsdf.extract_mesh(1.0);
    drop(tsdf);
    let visible = surface.into_mesh();
    mb_mesh::write_ply(sequence.gt_mesh_path(), &gt_mesh)?;
    mb_mesh::write_ply(sequence.visible_surface_path(), &visible)?;
    volume.write(sequence.visibility_path())?;
    write_neus_cameras(sequence.neus_cameras_path(), &exact.frames, &bounds_in_world)?;

    let mut warnings = Vec::new();
    if !frames_without_model.is_empty() {
        let ids: Vec<String> = frames_without_model.iter().map(ToString::to_string).collect();
        warnings.push(format!("no pixel shows the model in frames {}", ids.join(", ")));
    }
    let visible_voxels = volume.mask.iter().filter(|m| **m).count();
    Ok(TruthSummary {
        frames: exact.frames.len(),
        frames_without_model,
        mask_share: model_pixels as f64 / (exact.frames.len() * sequence.image_size().pixels()) as f64,
        model_area_mm2: exact.mesh.area() * 1e6,
        visible_area_mm2: visible.area() * 1e6,
        visible_triangles: visible.triangles.len(),
        gt_mesh_triangles: gt_mesh.triangles.len(),
        visibility_resolutions: volume.resolutions,
        visible_voxel_share: visible_voxels as f64 / volume.mask.len() as f64,
        options: options.clone(),
        seconds: start.elapsed().as_secs_f64(),
        warnings,
    })
}
