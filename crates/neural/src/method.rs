//! Whole methods: a sequence in, a mesh or pictures out.

use std::path::{Path, PathBuf};

use mb_capture::{FrameId, Sequence};
use mb_image::RgbImage;
use mb_job::{Progress, Result, Steps};
use mb_mesh::TriangleMesh;
use serde::{Deserialize, Serialize};

use crate::camera_path::{CameraPath, new_views};
use crate::cameras::{CameraOptions, CameraResiduals};
use crate::dataset::{DataOptions, RayDataset, View};
use crate::device::Device;
use crate::dvgo::{Dvgo, DvgoOptions};
use crate::extract::{Extracted, SurfaceOptions, Table, extract};
use crate::model::Model;
use crate::nerf::{Nerf, NerfOptions};
use crate::nerf_original::{NerfOriginal, NerfOriginalOptions};
use crate::neus::{Neus, NeusOptions};
use crate::neus_original::{NeusOriginal, NeusOriginalOptions};
use crate::region::Region;
use crate::results::{write_cameras, write_film};
use crate::trainer::{RunOptions, TrainSummary, image_psnr_db, render_new_view, render_view, train};

/// A method with its options.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Method {
    /// Density and colour on a hash grid.
    Nerf(NerfOptions),
    /// Density and colour in two networks, as NeRF began.
    NerfOriginal(NerfOriginalOptions),
    /// Density and colour on voxels.
    Dvgo(DvgoOptions),
    /// Signed distance and colour on a hash grid.
    Neus(NeusOptions),
    /// Signed distance and colour in deep networks, as NeuS began.
    NeusOriginal(NeusOriginalOptions),
}

impl Method {
    /// `nerf`, `dvgo` or `neus`, whichever the preset.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Nerf(_) | Self::NerfOriginal(_) => "nerf",
            Self::Dvgo(_) => "dvgo",
            Self::Neus(_) | Self::NeusOriginal(_) => "neus",
        }
    }
}

/// Everything that decides a run's result, and how it is kept.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldOptions {
    /// The method.
    pub method: Method,
    /// The photographs.
    #[serde(default)]
    pub data: DataOptions,
    /// Correction of the cameras.
    #[serde(default)]
    pub cameras: CameraOptions,
    /// The run.
    #[serde(default)]
    pub run: RunOptions,
    /// The extracted surface.
    #[serde(default)]
    pub surface: SurfaceOptions,
}

impl FieldOptions {
    /// The names that [`FieldOptions::preset`] knows.
    pub const METHODS: [&'static str; 3] = ["nerf", "dvgo", "neus"];

    /// The names that it knows of their presets: small enough for a processor, as published, and, of `neus`, for the best
    /// surface.
    pub const PRESETS: [&'static str; 3] = ["fast", "paper", "best"];

    /// The options of a method in a preset; `None` for other names.
    pub fn preset(method: &str, preset: &str, seed: u64) -> Option<Self> {
        let method = match (method, preset) {
            ("nerf", "fast") => Method::Nerf(NerfOptions { seed, ..NerfOptions::default() }),
            ("nerf", "paper") => Method::NerfOriginal(NerfOriginalOptions { seed, ..NerfOriginalOptions::paper() }),
            ("dvgo", "fast") => Method::Dvgo(DvgoOptions { seed, ..DvgoOptions::fast() }),
            ("dvgo", "paper") => Method::Dvgo(DvgoOptions { seed, ..DvgoOptions::paper() }),
            ("neus", "fast") => Method::Neus(NeusOptions { seed, ..NeusOptions::default() }),
            ("neus", "best") => Method::Neus(NeusOptions { seed, ..NeusOptions::best() }),
            ("neus", "paper") => Method::NeusOriginal(NeusOriginalOptions { seed, ..NeusOriginalOptions::paper() }),
            _ => return None,
        };
        Some(Self {
            method,
            data: DataOptions::default(),
            cameras: CameraOptions::default(),
            run: RunOptions::default(),
            surface: SurfaceOptions::default(),
        })
    }

    /// The same with another number of steps; schedules follow.
    #[must_use]
    pub fn with_iterations(mut self, iterations: u64) -> Self {
        self.method = match self.method {
            Method::Nerf(o) => Method::Nerf(o.with_iterations(iterations)),
            Method::NerfOriginal(o) => Method::NerfOriginal(o.with_iterations(iterations)),
            Method::Dvgo(o) => Method::Dvgo(o.with_iterations(iterations)),
            Method::Neus(o) => Method::Neus(o.with_iterations(iterations)),
            Method::NeusOriginal(o) => Method::NeusOriginal(o.with_iterations(iterations)),
        };
        self
    }

    /// The untrained model, for the processor.
    pub fn model(&self, data: &RayDataset) -> Box<dyn Model> {
        match &self.method {
            Method::Nerf(options) => Box::new(Nerf::new(options.clone(), data)),
            Method::NerfOriginal(options) => Box::new(NerfOriginal::new(options.clone(), data)),
            Method::Dvgo(options) => Box::new(Dvgo::new(options.clone(), data)),
            Method::Neus(options) => Box::new(Neus::new(options.clone(), data)),
            Method::NeusOriginal(options) => Box::new(NeusOriginal::new(options.clone(), data)),
        }
    }

    fn train(&self, data: &RayDataset, device: &dyn Device, progress: &dyn Progress) -> Result<Trained> {
        let mut model = device.model(self, data)?;
        let mut cameras = CameraResiduals::new(&self.cameras, data);
        let json =
            serde_json::to_value((&self.method, &self.cameras)).expect("options are plain data with string keys");
        let summary = train(model.as_mut(), data, &mut cameras, &json, &self.run, progress)?;
        Ok(Trained { model, cameras, summary })
    }
}

/// A trained field.
struct Trained {
    model: Box<dyn Model>,
    cameras: CameraResiduals,
    summary: TrainSummary,
}

/// What [`reconstruct`] did.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReconstructSummary {
    /// The resolved options.
    pub options: FieldOptions,
    /// Where the object was taken to be (world frame).
    pub region: Region,
    /// Photographs used.
    pub images: usize,
    /// What trained.
    pub device: String,
    /// The training.
    pub training: TrainSummary,
    /// Triangles of the mesh.
    pub triangles: usize,
    /// The table that was cut off, where there are no masks.
    pub table: Option<Table>,
    /// What was found and mended.
    pub warnings: Vec<String>,
}

/// Trains on every photograph (none is held out) and extracts the surface: world frame, metres, vertex colours. Where
/// cameras were corrected, their poses are written to `cameras_to/pose/`.
///
/// # Errors
/// As [`RayDataset::open`], [`Device::model`], [`train`] and [`extract`].
pub fn reconstruct(
    sequence: &Sequence,
    options: &FieldOptions,
    device: &dyn Device,
    cameras_to: Option<&Path>,
    progress: &dyn Progress,
) -> Result<(TriangleMesh, ReconstructSummary)> {
    let all = DataOptions { hold_out_every: 0, ..options.data.clone() };
    let options = FieldOptions { data: all, ..options.clone() };
    let data = RayDataset::open(sequence, &options.data, progress)?;
    let Trained { model, cameras, summary: training } = options.train(&data, device, progress)?;
    let Extracted { mesh, table } = extract(model.as_ref(), &data, &cameras, &options.surface, progress)?;
    if let Some(folder) = cameras_to.filter(|_| cameras.size().is_some()) {
        write_cameras(folder, &data, &cameras)?;
    }
    let summary = ReconstructSummary {
        options,
        region: *data.region(),
        images: data.views().len(),
        device: device.name(),
        training,
        triangles: mesh.triangles.len(),
        table,
        warnings: data.warnings().to_vec(),
    };
    Ok((mesh, summary))
}

/// One rendered view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewScore {
    /// Which frame.
    pub frame: FrameId,
    /// Against the photograph at working size, or, of a model that learned with masks, against the object in it before
    /// black.
    pub psnr_db: f64,
}

/// Which pictures [`synthesize`] makes, and where they go.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Views {
    /// Which views.
    pub path: CameraPath,
    /// Folder for `NNNNNN.png`, and `reference/NNNNNN.png` where there are photographs.
    pub out: PathBuf,
    /// A film of them, where one is wanted.
    pub film: Option<PathBuf>,
    /// Pictures of the film in a second.
    pub frames_per_second: f64,
}

/// What [`synthesize`] did.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SynthesizeSummary {
    /// The resolved options.
    pub options: FieldOptions,
    /// Where the object was taken to be (world frame).
    pub region: Region,
    /// What trained.
    pub device: String,
    /// The training.
    pub training: TrainSummary,
    /// Rendered views.
    pub images: usize,
    /// Mean over the views that have a photograph; `None` where none has.
    pub psnr_db: Option<f64>,
    /// Each view that has a photograph.
    pub per_image: Vec<ViewScore>,
    /// What was found and mended.
    pub warnings: Vec<String>,
}

/// Trains on all but the held-out photographs and renders views: the held-out ones, with the photographs at the same
/// size as `reference/NNNNNN.png`, so that `eval views --gt OUT/reference --pred OUT` scores them; or others.
///
/// # Errors
/// As [`RayDataset::open`], [`Device::model`], [`train`], [`CameraPath`] and [`write_film`]; a picture cannot be written.
pub fn synthesize(
    sequence: &Sequence,
    options: &FieldOptions,
    device: &dyn Device,
    views: &Views,
    progress: &dyn Progress,
) -> Result<SynthesizeSummary> {
    let data = RayDataset::open(sequence, &options.data, progress)?;
    // Before the long work: a path that cannot be read is told at once.
    let others = match &views.path {
        CameraPath::HeldOut => Vec::new(),
        path => new_views(path, &data, sequence.image_size())?,
    };
    let Trained { model, cameras, summary: training } = options.train(&data, device, progress)?;
    let mut per_image = Vec::new();
    let mut images = Vec::new();
    let held_out: Vec<_> = data.views().iter().enumerate().filter(|(_, v)| v.held_out && others.is_empty()).collect();
    let steps = Steps::new(progress, "rendering views", held_out.len() + others.len());
    let mut keep = |view: &View, image: RgbImage| -> Result<()> {
        mb_image::write_rgb_png(views.out.join(format!("{}.png", view.frame)), &image)?;
        if views.film.is_some() {
            images.push(image);
        }
        steps.step()
    };
    for (index, view) in &held_out {
        let image = render_view(model.as_ref(), view, *index, &cameras);
        let shown = view.shown(model.only_object());
        mb_image::write_rgb_png(views.out.join("reference").join(format!("{}.png", view.frame)), &shown)?;
        per_image.push(ViewScore { frame: view.frame, psnr_db: image_psnr_db(&image, &shown) });
        keep(view, image)?;
    }
    for view in &others {
        keep(view, render_new_view(model.as_ref(), view))?;
    }
    if let Some(film) = &views.film {
        write_film(film, &images, views.frames_per_second)?;
    }
    let mean = per_image.iter().map(|v| v.psnr_db).sum::<f64>() / per_image.len().max(1) as f64;
    Ok(SynthesizeSummary {
        options: options.clone(),
        region: *data.region(),
        device: device.name(),
        training,
        images: held_out.len() + others.len(),
        psnr_db: (!per_image.is_empty()).then_some(mean),
        per_image,
        warnings: data.warnings().to_vec(),
    })
}
