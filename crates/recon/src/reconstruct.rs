//! TSDF-Fusion of a whole sequence.

use std::time::Instant;

use mb_capture::{Frame, Sequence};
use mb_geometry::ImageSize;
use mb_image::{Confidence, DepthImage, Mask};
use mb_job::{Error, InputError, Progress, Result, Steps};
use mb_mesh::TriangleMesh;
use serde::{Deserialize, Serialize};

use crate::TsdfVolume;

/// Which camera poses a reconstruction believes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseSource {
    /// Those of `alignment/alignment.json` for the frames that it has (the published data set ships such refined poses
    /// as its `pose/`), those of `pose/` for the rest.
    #[default]
    Aligned,
    /// Those of `pose/`, as the phone gave them.
    Phone,
}

/// Options of [`reconstruct_tsdf`]. The defaults suit a phone's 256x192 depth of a scene at 20 to 50 cm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TsdfOptions {
    /// Edge of a voxel, millimetres. The default of 3 is about the footprint of a depth pixel at half a metre; finer
    /// voxels follow the noise.
    pub voxel_size_mm: f64,
    /// Largest signed distance that is told apart, millimetres, from 1.5 to 64 voxels. The default of 12 is a few times
    /// the noise of the depth: less leaves double surfaces, more fills gaps between bricks.
    pub truncation_mm: f64,
    /// Depth nearer than this is ignored, metres.
    pub min_depth_m: f64,
    /// Depth further than this is ignored, metres. The default of 1.5 keeps the table and drops the room.
    pub max_depth_m: f64,
    /// Depth with a lower confidence is ignored: 0 keeps all, 2 keeps only what the phone is sure of.
    pub min_confidence: u8,
    /// Ignore depth outside the frame's object mask (which must exist): reconstructs the object alone. Off by default,
    /// as masks come from the ground truth.
    pub use_masks: bool,
    /// A voxel must be seen in this many frames to carry surface.
    pub min_weight: f64,
    /// Colour the vertices from the photographs.
    pub color: bool,
    /// Which poses to believe.
    pub poses: PoseSource,
}

impl Default for TsdfOptions {
    fn default() -> Self {
        Self {
            voxel_size_mm: 3.0,
            truncation_mm: 12.0,
            min_depth_m: 0.05,
            max_depth_m: 1.5,
            min_confidence: 1,
            use_masks: false,
            min_weight: 2.0,
            color: true,
            poses: PoseSource::Aligned,
        }
    }
}

impl TsdfOptions {
    /// Checks ranges.
    ///
    /// # Errors
    /// The first option out of range, by name.
    pub fn validate(&self) -> Result<()> {
        let fail = |sentence: String| Err(Error::Failed(sentence));
        if !(self.min_depth_m >= 0.0 && self.min_depth_m < self.max_depth_m) {
            return fail(format!(
                "min_depth_m must be at least 0 and below max_depth_m; they are {} and {}",
                self.min_depth_m, self.max_depth_m
            ));
        }
        if self.min_confidence > 2 {
            return fail(format!("min_confidence must be 0, 1 or 2, it is {}", self.min_confidence));
        }
        if !(self.min_weight > 0.0 && self.min_weight.is_finite()) {
            return fail(format!("min_weight must be above 0, it is {}", self.min_weight));
        }
        // The volume checks its sizes itself.
        TsdfVolume::new(self.voxel_size_mm * 1e-3, self.truncation_mm * 1e-3).map(|_| ())
    }
}

/// What [`reconstruct_tsdf`] did.
#[derive(Debug, Clone, Serialize)]
pub struct TsdfSummary {
    /// Always `tsdf`.
    pub method: &'static str,
    /// Frames that were fused.
    pub frames: usize,
    /// Frames without depth.
    pub frames_without_depth: usize,
    /// Share of depth pixels that passed range, confidence and mask.
    pub depth_used: f64,
    /// Vertices of the mesh.
    pub vertices: usize,
    /// Triangles of the mesh.
    pub triangles: usize,
    /// Area of the mesh, square metres.
    pub area_m2: f64,
    /// Memory of the volume, megabytes.
    pub volume_mb: f64,
    /// Wall time.
    pub seconds: f64,
    /// What was mended or left out.
    pub warnings: Vec<String>,
    /// The options as used.
    pub options: TsdfOptions,
}

/// Fuses the phone's depth maps (`arkit_depth/`) into one mesh, metres, in the sequence's world frame.
///
/// Depth is read twice: the first pass finds the blocks near surfaces, the second averages, so that each frame also
/// clears the free space that it saw and the order of frames does not matter. One frame is in memory at a time.
///
/// # Errors
/// No frame has depth, a file is damaged or of a wrong size, an option is out of range, the volume would be too large,
/// or nothing was left to reconstruct.
pub fn reconstruct_tsdf(
    sequence: &Sequence,
    options: &TsdfOptions,
    progress: &dyn Progress,
) -> Result<(TriangleMesh, TsdfSummary)> {
    options.validate()?;
    let start = Instant::now();
    let mut warnings = sequence.warnings().to_vec();
    let all = match options.poses {
        PoseSource::Phone => sequence.frames().to_vec(),
        PoseSource::Aligned if sequence.root().join(mb_capture::Alignment::FILE).exists() => {
            sequence.aligned_frames(&sequence.read_alignment()?)
        }
        PoseSource::Aligned => sequence.frames().to_vec(),
    };
    let total = all.len();
    let frames: Vec<Frame> = all.into_iter().filter(|f| f.arkit_depth.is_some()).collect();
    if frames.is_empty() {
        return Err(InputError::new(sequence.root().join("arkit_depth"), "no frame has a depth map")
            .help("TSDF fusion needs arkit_depth/NNNNNN.png, 16-bit millimetres")
            .into());
    }
    if frames.len() < total {
        warnings.push(format!("{} of {total} frames have no depth and were left out", total - frames.len()));
    }
    let color = options.color && frames.iter().any(|f| f.image.is_some());
    if options.color && !color {
        warnings.push("no photographs: the mesh has no colours".to_owned());
    }

    let mut volume = TsdfVolume::new(options.voxel_size_mm * 1e-3, options.truncation_mm * 1e-3)?;
    let steps = Steps::new(progress, "find surfaces", frames.len());
    let (mut used, mut pixels) = (0, 0);
    for frame in &frames {
        let depth = filtered_depth(sequence, frame, options)?;
        let kept = depth.data().iter().filter(|&&z| z > 0.0).count();
        if kept == 0 {
            warnings.push(format!("frame {}: no depth within range and confidence", frame.id));
        }
        used += kept;
        pixels += depth.size().pixels();
        volume.allocate(&depth, &depth_intrinsics(sequence, frame, depth.size()), &frame.world_from_cam.inverse())?;
        steps.step()?;
    }
    let steps = Steps::new(progress, "fuse depth", frames.len());
    for frame in &frames {
        let depth = filtered_depth(sequence, frame, options)?;
        let photograph = if color && frame.image.is_some() { Some(sequence.read_image(frame)?) } else { None };
        let intrinsics = depth_intrinsics(sequence, frame, depth.size());
        volume.integrate(&depth, photograph.as_ref(), &intrinsics, &frame.world_from_cam.inverse())?;
        steps.step()?;
    }
    let mesh = volume.extract_mesh(options.min_weight as f32);
    if mesh.triangles.is_empty() {
        return Err(Error::Failed(format!(
            "no surface was found: {used} of {pixels} depth pixels passed; widen the depth range ({} to {} m), lower min_confidence or min_weight",
            options.min_depth_m, options.max_depth_m
        )));
    }
    let summary = TsdfSummary {
        method: "tsdf",
        frames: frames.len(),
        frames_without_depth: total - frames.len(),
        depth_used: used as f64 / pixels as f64,
        vertices: mesh.vertices.len(),
        triangles: mesh.triangles.len(),
        area_m2: mesh.area(),
        volume_mb: volume.bytes() as f64 / 1e6,
        seconds: start.elapsed().as_secs_f64(),
        warnings,
        options: options.clone(),
    };
    Ok((mesh, summary))
}

/// Intrinsics of a depth map that shows the same view as the photograph.
fn depth_intrinsics(sequence: &Sequence, frame: &Frame, size: ImageSize) -> mb_geometry::Intrinsics {
    frame.intrinsics.resized(sequence.image_size(), size)
}

/// A frame's depth with everything zeroed that the options exclude.
fn filtered_depth(sequence: &Sequence, frame: &Frame, options: &TsdfOptions) -> Result<DepthImage> {
    let (mut depth, confidence) = sequence.read_arkit_depth(frame)?;
    let mask = if options.use_masks { Some(sequence.read_mask(frame)?) } else { None };
    filter_depth(&mut depth, &confidence, mask.as_ref(), options);
    Ok(depth)
}

fn filter_depth(depth: &mut DepthImage, confidence: &Confidence, mask: Option<&Mask>, options: &TsdfOptions) {
    let range = options.min_depth_m as f32..=options.max_depth_m as f32;
    let size = depth.size();
    for y in 0..size.height {
        for x in 0..size.width {
            // The mask has the photograph's size; the pixel at the same place of the view decides.
            let masked = |mask: &Mask| {
                let scaled = |at: usize, to: usize, from: usize| ((2 * at + 1) * to / (2 * from)).min(to - 1);
                !mask[(scaled(x, mask.width(), size.width), scaled(y, mask.height(), size.height))]
            };
            let pixel = (x, y);
            if !range.contains(&depth[pixel]) || confidence[pixel] < options.min_confidence || mask.is_some_and(masked)
            {
                depth[pixel] = 0.0;
            }
        }
    }
}
