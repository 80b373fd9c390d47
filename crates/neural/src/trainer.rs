//! Training: progress, checkpoints, exact resume, divergence.

use std::path::{Path, PathBuf};
use std::time::Instant;

use mb_image::{Image, RgbImage};
use mb_job::{Error, InputError, Progress, Result, write_atomic_with};
use serde::{Deserialize, Serialize};

use crate::dataset::{RayDataset, View};
use crate::model::{Model, StepReport};

/// How a run is kept.
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
}

impl Default for RunOptions {
    fn default() -> Self {
        Self { checkpoint: None, checkpoint_every: 1000, report_every: 100 }
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
    /// The loss curve.
    pub curve: Vec<CurvePoint>,
}

/// Peak signal-to-noise ratio of a mean squared error of values in 0..=1.
pub fn psnr_db(mse: f64) -> f64 {
    -10.0 * mse.max(1e-12).log10()
}

const MAGIC: &[u8; 16] = b"mb-neural ckpt 1";

#[derive(Debug, Serialize, Deserialize, PartialEq)]
struct CheckpointHeader {
    method: String,
    options: serde_json::Value,
    data: u64,
    step: u64,
    lengths: Vec<usize>,
}

/// Trains `model` on `data` to the end, or until the person asks for a stop (then the checkpoint is saved).
/// `options_json` are the resolved options, which a checkpoint must agree with.
///
/// # Errors
/// [`Error::Stopped`]; a checkpoint of another run; training diverged (the last checkpoint is kept).
pub fn train(
    model: &mut dyn Model,
    data: &RayDataset,
    options_json: &serde_json::Value,
    run: &RunOptions,
    progress: &dyn Progress,
) -> Result<TrainSummary> {
    let total = model.iterations();
    let header = |model: &mut dyn Model, step| CheckpointHeader {
        method: model.name().to_owned(),
        options: options_json.clone(),
        data: data.fingerprint(),
        step,
        lengths: model.buffers().iter().map(|b| b.len()).collect(),
    };
    let expected = header(model, 0);
    let mut step = match &run.checkpoint {
        Some(path) if path.exists() => read_checkpoint(path, &expected, model)?,
        _ => 0,
    };
    let first_step = step;
    let clock = Instant::now();
    let mut curve = Vec::new();
    let mut window = Window::default();
    let mut best = f64::INFINITY;
    let mut what = format!("training {}", model.name());
    progress.report(&what, step as usize, total as usize);
    while step < total {
        let report = model.step(data, step);
        step += 1;
        window.add(&report);
        let point_due = step.is_multiple_of(run.report_every.max(1)) || step == total;
        if !report.loss.is_finite() || (point_due && !model.is_finite()) {
            return Err(diverged(step, "a number is no longer finite", run));
        }
        if point_due {
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
            let left = point.seconds / (step - first_step) as f64 * (total - step) as f64;
            what = format!(
                "training {}: {:.1} dB, loss {:.4}, {} left",
                model.name(),
                point.psnr_db,
                point.loss,
                time(left)
            );
            curve.push(point);
        }
        progress.report(&what, step as usize, total as usize);
        let stop = progress.stop_requested();
        if let Some(path) = &run.checkpoint
            && (stop || step == total || step.is_multiple_of(run.checkpoint_every.max(1)))
        {
            write_checkpoint(path, &header(model, step), model)?;
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
        curve,
    })
}

fn time(seconds: f64) -> String {
    if seconds < 90.0 { format!("{seconds:.0} s") } else { format!("{:.0} min", seconds / 60.0) }
}

fn diverged(step: u64, why: &str, run: &RunOptions) -> Error {
    let kept = match &run.checkpoint {
        Some(path) if path.exists() => format!("; {} holds the last good state", path.display()),
        _ => String::new(),
    };
    Error::Failed(format!(
        "training diverged at step {step}: {why}{kept}. Check the poses with `capture check`, or lower the learning rate"
    ))
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

fn write_checkpoint(path: &Path, header: &CheckpointHeader, model: &mut dyn Model) -> Result<()> {
    let json = serde_json::to_vec(header).map_err(|e| Error::write(path, e.into()))?;
    write_atomic_with(path, |out| {
        out.write_all(MAGIC)?;
        out.write_all(&(json.len() as u64).to_le_bytes())?;
        out.write_all(&json)?;
        for buffer in model.buffers() {
            for piece in buffer.chunks(4096) {
                let bytes: Vec<u8> = piece.iter().flat_map(|v| v.to_le_bytes()).collect();
                out.write_all(&bytes)?;
            }
        }
        out.flush()
    })
}

fn read_checkpoint(path: &Path, expected: &CheckpointHeader, model: &mut dyn Model) -> Result<u64> {
    let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
    let other = |found: &str| InputError::new(path, found).help("Remove it, or name another checkpoint");
    let rest = bytes.strip_prefix(MAGIC).ok_or_else(|| other("not a checkpoint of this program"))?;
    let truncated = || other("the checkpoint is truncated");
    let (length, rest) = rest.split_first_chunk::<8>().ok_or_else(truncated)?;
    let length =
        usize::try_from(u64::from_le_bytes(*length)).ok().filter(|n| *n <= rest.len()).ok_or_else(truncated)?;
    let header: CheckpointHeader =
        serde_json::from_slice(&rest[..length]).map_err(|e| other(&format!("damaged header ({e})")))?;
    if header.method != expected.method || header.options != expected.options || header.lengths != expected.lengths {
        return Err(other("the checkpoint belongs to a run with other options").into());
    }
    if header.data != expected.data {
        return Err(other("the checkpoint belongs to other photographs or cameras").into());
    }
    let mut numbers = rest[length..].chunks_exact(4);
    if numbers.len() != header.lengths.iter().sum::<usize>() {
        return Err(truncated().into());
    }
    for buffer in model.buffers() {
        for (to, from) in buffer.iter_mut().zip(&mut numbers) {
            *to = f32::from_le_bytes([from[0], from[1], from[2], from[3]]);
        }
    }
    model.restored(header.step);
    Ok(header.step)
}

/// Renders a view at its working size.
pub fn render_view(model: &dyn Model, view: &View) -> RgbImage {
    let size = view.size();
    let rays: Vec<_> = (0..size.pixels()).map(|i| view.ray((i % size.width) as f32, (i / size.width) as f32)).collect();
    let colors = model.render(&rays);
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
