//! Whole methods: a sequence in, a mesh or pictures out.

use std::path::Path;

use mb_capture::{FrameId, Sequence};
use mb_job::{Progress, Result, Steps};
use mb_mesh::TriangleMesh;
use serde::{Deserialize, Serialize};

use crate::dataset::{DataOptions, RayDataset};
use crate::extract::{SurfaceOptions, extract};
use crate::model::Model;
use crate::nerf::{Nerf, NerfOptions};
use crate::neus::{Neus, NeusOptions};
use crate::region::Region;
use crate::trainer::{RunOptions, TrainSummary, image_psnr_db, render_view, train};

/// A method with its options.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Method {
    /// Density and colour.
    Nerf(NerfOptions),
    /// Signed distance and colour.
    Neus(NeusOptions),
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
    /// The run.
    #[serde(default)]
    pub run: RunOptions,
    /// The extracted surface.
    #[serde(default)]
    pub surface: SurfaceOptions,
}

impl FieldOptions {
    /// The names that [`FieldOptions::preset`] knows.
    pub const METHODS: [&'static str; 2] = ["nerf", "neus"];

    /// The options of a method (`nerf`, `neus`) in the preset `fast`; `None` for other names.
    pub fn preset(method: &str, preset: &str, seed: u64) -> Option<Self> {
        let method = match (method, preset) {
            ("nerf", "fast") => Method::Nerf(NerfOptions { seed, ..NerfOptions::default() }),
            ("neus", "fast") => Method::Neus(NeusOptions { seed, ..NeusOptions::default() }),
            _ => return None,
        };
        Some(Self {
            method,
            data: DataOptions::default(),
            run: RunOptions::default(),
            surface: SurfaceOptions::default(),
        })
    }

    /// The same with another number of steps; schedules follow.
    #[must_use]
    pub fn with_iterations(mut self, iterations: u64) -> Self {
        self.method = match self.method {
            Method::Nerf(o) => Method::Nerf(o.with_iterations(iterations)),
            Method::Neus(o) => Method::Neus(o.with_iterations(iterations)),
        };
        self
    }

    fn train(&self, data: &RayDataset, progress: &dyn Progress) -> Result<(Box<dyn Model>, TrainSummary)> {
        let mut model: Box<dyn Model> = match &self.method {
            Method::Nerf(options) => Box::new(Nerf::new(options.clone())),
            Method::Neus(options) => Box::new(Neus::new(options.clone(), data)),
        };
        let json = serde_json::to_value(&self.method).expect("options are plain data with string keys");
        let summary = train(model.as_mut(), data, &json, &self.run, progress)?;
        Ok((model, summary))
    }
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
    /// The training.
    pub training: TrainSummary,
    /// Triangles of the mesh.
    pub triangles: usize,
    /// What was found and mended.
    pub warnings: Vec<String>,
}

/// Trains on every photograph (none is held out) and extracts the surface: world frame, metres, vertex colours.
///
/// # Errors
/// As [`RayDataset::open`], [`train`] and [`extract`].
pub fn reconstruct(
    sequence: &Sequence,
    options: &FieldOptions,
    progress: &dyn Progress,
) -> Result<(TriangleMesh, ReconstructSummary)> {
    let all = DataOptions { hold_out_every: 0, ..options.data.clone() };
    let data = RayDataset::open(sequence, &all, progress)?;
    let (model, training) = options.train(&data, progress)?;
    let mesh = extract(model.as_ref(), &data, &options.surface, progress)?;
    let summary = ReconstructSummary {
        options: FieldOptions { data: all, ..options.clone() },
        region: *data.region(),
        images: data.views().len(),
        training,
        triangles: mesh.triangles.len(),
        warnings: data.warnings().to_vec(),
    };
    Ok((mesh, summary))
}

/// One rendered view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewScore {
    /// Which frame.
    pub frame: FrameId,
    /// Against the photograph at working size.
    pub psnr_db: f64,
}

/// What [`synthesize`] did.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SynthesizeSummary {
    /// The resolved options.
    pub options: FieldOptions,
    /// Where the object was taken to be (world frame).
    pub region: Region,
    /// The training.
    pub training: TrainSummary,
    /// Rendered views.
    pub images: usize,
    /// Mean over them.
    pub psnr_db: f64,
    /// Each of them.
    pub per_image: Vec<ViewScore>,
    /// What was found and mended.
    pub warnings: Vec<String>,
}

/// Trains on all but the held-out photographs and renders those: `out/NNNNNN.png`, and the photograph at the same size
/// as `out/reference/NNNNNN.png`, so that `eval views --gt OUT/reference --pred OUT` scores them.
///
/// # Errors
/// As [`RayDataset::open`] and [`train`]; a picture cannot be written.
pub fn synthesize(
    sequence: &Sequence,
    options: &FieldOptions,
    out: &Path,
    progress: &dyn Progress,
) -> Result<SynthesizeSummary> {
    let data = RayDataset::open(sequence, &options.data, progress)?;
    let (model, training) = options.train(&data, progress)?;
    let steps = Steps::new(progress, "rendering held-out views", data.held_out().count());
    let mut per_image = Vec::new();
    for view in data.held_out() {
        let image = render_view(model.as_ref(), view);
        let name = format!("{}.png", view.frame);
        mb_image::write_rgb_png(out.join(&name), &image)?;
        mb_image::write_rgb_png(out.join("reference").join(&name), &view.rgb)?;
        per_image.push(ViewScore { frame: view.frame, psnr_db: image_psnr_db(&image, &view.rgb) });
        steps.step()?;
    }
    Ok(SynthesizeSummary {
        options: options.clone(),
        region: *data.region(),
        training,
        images: per_image.len(),
        psnr_db: per_image.iter().map(|v| v.psnr_db).sum::<f64>() / per_image.len().max(1) as f64,
        per_image,
        warnings: data.warnings().to_vec(),
    })
}
