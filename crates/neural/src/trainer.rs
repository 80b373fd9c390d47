//! Training: progress, previews, exact resume, bounded memory, divergence.

use std::path::{Path, PathBuf};
use std::time::Instant;

use mb_geometry::ImageSize;
use mb_image::{Image, RgbImage};
use mb_job::{Error, Progress, Result};
use serde::{Deserialize, Serialize};

use crate::cameras::CameraResiduals;
use crate::checkpoint;
use crate::dataset::{RayDataset, View};
use crate::model::{Model, StepReport};

/// How a run is kept, watched and bounded.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RunOptions {
    /// Where the checkpoint lies; `None` keeps none. A run that finds one with the same options and data goes on from
    /// it, with the same result as without the stop.
    pub checkpoint: Option<PathBuf>,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Steps between points of the loss curve.
    pub report_every: u64,
    /// Folder for preview pictures of one view, beside its photograph; `None` paints none.
    pub previews: Option<PathBuf>,
    /// Steps between previews.
    pub preview_every: u64,
    /// Largest memory of photographs, parameters and work buffers together, MiB. A run that would need more is refused
    /// before it starts.
    pub memory_mib: usize,
}

impl Default for RunOptions {
    fn default() -> Self {
        Self {
            checkpoint: None,
            checkpoint_every: 1000,
            report_every: 100,
            previews: None,
            preview_every: 500,
            memory_mib: 6144,
        }
    }
}

/// A point of the loss curve: means since the last one.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CurvePoint {
    /// Steps done.
    pub step: u64,
    /// Wall time of this run until here.
    pub seconds: f64,
    /// The whole loss.
    pub loss: f64,
    /// Of the training pixels.
    pub psnr_db: f64,
    /// Mean samples of a ray.
    pub samples_per_ray: f64,
}

/// What a run did.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrainSummary {
    /// `nerf`, `neus`, `dvgo`.
    pub method: &'static str,
    /// Parameters of the model.
    pub parameters: usize,
    /// Steps that this run began with (above 0 after a resume).
    pub first_step: u64,
    /// Steps done in all.
    pub steps: u64,
    /// Wall time of this run.
    pub seconds: f64,
    /// Root mean square of what the cameras were corrected by; where they were.
    pub cameras: Option<CameraChange>,
    /// The loss curve.
    pub curve: Vec<CurvePoint>,
}

/// How far corrected cameras moved, root mean square.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct CameraChange {
    /// Turned by, degrees.
    pub rotation_deg: f64,
    /// Centre moved by, millimetres of the sequence's world.
    pub center_mm: f64,
    /// Focal length, per cent.
    pub focal_percent: f64,
}

/// Peak signal-to-noise ratio of a mean squared error of values in 0..=1.
pub fn psnr_db(mse: f64) -> f64 {
    -10.0 * mse.max(1e-12).log10()
}

/// Trains `model` on `data` to the end, or until the person asks for a stop (then the checkpoint is saved).
/// `options_json` are the resolved options, which a checkpoint must agree with.
///
/// # Errors
/// [`Error::Stopped`]; too little memory; a checkpoint of another run; training diverged (the last checkpoint is kept).
pub fn train(
    model: &mut dyn Model,
    data: &RayDataset,
    cameras: &mut CameraResiduals,
    options_json: &serde_json::Value,
    run: &RunOptions,
    progress: &dyn Progress,
) -> Result<TrainSummary> {
    let total = model.iterations();
    check_memory(model, data, run)?;
    let header = checkpoint::Header::new(model.name(), options_json, data.fingerprint());
    let mut step = match &run.checkpoint {
        Some(path) if path.exists() => {
            let mut buffers = model.buffers();
            buffers.extend(cameras.buffers());
            let step = checkpoint::read(path, &header, buffers)?;
            model.restored(step).map_err(|found| checkpoint::other(path, &found))?;
            cameras.restored(data).map_err(|found| checkpoint::other(path, &found))?;
            step
        }
        _ => 0,
    };
    let first_step = step;
    let clock = Instant::now();
    let mut curve = Vec::new();
    let mut window = Window::default();
    let mut best = f64::INFINITY;
    let what = format!("training {}", model.name());
    progress.report(&what, step as usize, total as usize);
    while step < total {
        let report = model.step(data, cameras, step).map_err(|e| kept(e, run))?;
        step += 1;
        window.add(&report);
        if !report.loss.is_finite() {
            return Err(diverged(step, "the loss is no longer finite", run));
        }
        let due = |every: u64| step == total || step.is_multiple_of(every.max(1));
        if due(run.report_every) {
            let point = window.point(step, clock.elapsed().as_secs_f64());
            window = Window::default();
            if point.samples_per_ray == 0.0 {
                return Err(diverged(step, "nothing is left of the scene", run));
            }
            // The first steps of a method with a warm-up are no measure; afterwards nothing makes the error ten times
            // the best but a loss of control.
            if step > total / 20 {
                best = best.min(point.loss);
                if point.loss > 10.0 * best.max(1e-5) {
                    return Err(diverged(step, "the loss rose to ten times its best", run));
                }
            }
            progress.note(&what, &format!("{:.1} dB, loss {:.4}", point.psnr_db, point.loss));
            curve.push(point);
        }
        progress.report(&what, step as usize, total as usize);
        let stop = progress.stop_requested();
        let checkpoint = run.checkpoint.as_ref().filter(|_| stop || due(run.checkpoint_every));
        let previews = run.previews.as_ref().filter(|_| due(run.preview_every));
        // What a device has learned is brought here only where somebody needs it.
        if checkpoint.is_some() || previews.is_some() || step == total {
            model.fetch().map_err(|e| kept(e, run))?;
            if !model.is_finite() {
                return Err(diverged(step, "a parameter is no longer finite", run));
            }
        }
        if let Some(path) = checkpoint {
            let mut buffers = model.buffers();
            buffers.extend(cameras.buffers());
            checkpoint::write(path, &header, step, &buffers)?;
        }
        if let Some(folder) = previews {
            write_preview(folder, model, data, cameras, step)?;
        }
        if stop && step < total {
            return Err(Error::Stopped);
        }
    }
    Ok(TrainSummary {
        method: model.name(),
        parameters: model.parameter_count(),
        first_step,
        steps: step,
        seconds: clock.elapsed().as_secs_f64(),
        cameras: cameras.size().map(|[rotation_deg, center, log_focal]| CameraChange {
            rotation_deg,
            center_mm: 1e3 * center * data.region().radius_m,
            focal_percent: 100.0 * log_focal,
        }),
        curve,
    })
}

/// Parameters with their gradients and both moments, and about a gradient of the networks and a list of samples for
/// each worker, which are small beside them.
fn check_memory(model: &dyn Model, data: &RayDataset, run: &RunOptions) -> Result<()> {
    let mib = |bytes: usize| bytes.div_ceil(1 << 20);
    let (photographs, parameters) = (mib(data.bytes()), mib(model.bytes()));
    if photographs + parameters <= run.memory_mib {
        return Ok(());
    }
    Err(Error::Failed(format!(
        "training {} would need {} MiB ({photographs} for the photographs, {parameters} for the parameters and samples), \
         and {} MiB are allowed: reduce the photographs (--max-side), choose a smaller preset, or allow more (--memory)",
        model.name(),
        photographs + parameters,
        run.memory_mib
    )))
}

/// One view beside its photograph: a held-out one where there is one, the first otherwise.
fn write_preview(
    folder: &Path,
    model: &dyn Model,
    data: &RayDataset,
    cameras: &CameraResiduals,
    step: u64,
) -> Result<()> {
    let index = data.views().iter().position(|v| v.held_out).unwrap_or(0);
    let view = &data.views()[index];
    let image = render_view(model, view, index, cameras);
    let shown = view.shown(model.only_object());
    let (width, height) = (view.size().width, view.size().height);
    let pair = Image::from_fn(ImageSize::new(2 * width, height), |x, y| {
        if x < width { image[(x, y)] } else { shown[(x - width, y)] }
    });
    mb_image::write_rgb_png(folder.join(format!("step_{step:07}.png")), &pair)
}

fn diverged(step: u64, why: &str, run: &RunOptions) -> Error {
    Error::Failed(format!(
        "training diverged at step {step}: {why}{}. Check the poses with `capture check`, or lower the learning rate",
        last_good_state(run)
    ))
}

/// The failure of a device, with what is left of the run.
fn kept(error: Error, run: &RunOptions) -> Error {
    match error {
        Error::Failed(why) => Error::Failed(why + &last_good_state(run)),
        other => other,
    }
}

fn last_good_state(run: &RunOptions) -> String {
    match &run.checkpoint {
        Some(path) if path.exists() => format!("; {} holds the last good state", path.display()),
        _ => String::new(),
    }
}

#[derive(Debug, Default)]
struct Window {
    loss: f64,
    mse: f64,
    rays: usize,
    samples: usize,
    steps: usize,
}

impl Window {
    fn add(&mut self, report: &StepReport) {
        self.loss += report.loss;
        self.mse += report.mse;
        self.rays += report.rays;
        self.samples += report.samples;
        self.steps += 1;
    }

    fn point(&self, step: u64, seconds: f64) -> CurvePoint {
        let n = self.steps.max(1) as f64;
        CurvePoint {
            step,
            seconds,
            loss: self.loss / n,
            psnr_db: psnr_db(self.mse / n),
            samples_per_ray: self.samples as f64 / self.rays.max(1) as f64,
        }
    }
}

/// Renders a view at its working size, from its corrected camera.
pub fn render_view(model: &dyn Model, view: &View, index: usize, cameras: &CameraResiduals) -> RgbImage {
    let size = view.size();
    let rays: Vec<_> = (0..size.pixels())
        .map(|i| cameras.ray(view, index, [(i % size.width) as f32, (i / size.width) as f32]))
        .collect();
    image_of(size, &model.render(&rays))
}

/// Renders a view that has no photograph.
pub fn render_new_view(model: &dyn Model, view: &View) -> RgbImage {
    let size = view.size();
    let rays: Vec<_> = (0..size.pixels()).map(|i| view.ray((i % size.width) as f32, (i / size.width) as f32)).collect();
    image_of(size, &model.render(&rays))
}

/// A picture from its colours, row by row.
fn image_of(size: ImageSize, colors: &[[f32; 3]]) -> RgbImage {
    Image::from_fn(size, |x, y| colors[y * size.width + x].map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u8))
}

/// Peak signal-to-noise ratio between two images of one size, over all pixels and channels.
pub fn image_psnr_db(a: &RgbImage, b: &RgbImage) -> f64 {
    let sum: f64 = a
        .data()
        .iter()
        .flatten()
        .zip(b.data().iter().flatten())
        .map(|(a, b)| ((f64::from(*a) - f64::from(*b)) / 255.0).powi(2))
        .sum();
    psnr_db(sum / (3 * a.size().pixels().max(1)) as f64)
}
