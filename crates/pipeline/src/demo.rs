//! The whole system on one model: capture, alignment, ground truth, a reconstruction, its scores, a report.

use std::path::{Path, PathBuf};
use std::time::Instant;

use mb_align::{BundleOptions, KeypointOptions, RefineOptions, align_bundle, align_keypoints, align_refine};
use mb_bricks::Model;
use mb_capture::Sequence;
use mb_eval::{PosesScores, SurfaceOptions, SurfaceProtocol, SurfaceScores, evaluate_poses, evaluate_surface};
use mb_geometry::ImageSize;
use mb_job::{Error, Progress, Result};
use mb_recon::{TsdfOptions, reconstruct_tsdf};
use mb_simulate::{Quality, SimulateOptions};
use mb_truth::{TruthOptions, truth};
use serde::Serialize;

use crate::model_capture::{ModelCapture, simulate_model};
use crate::report::Stage;
use crate::scene_report::{Scored, scene_report};

/// How the demo runs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DemoOptions {
    /// Photographs.
    pub frames: usize,
    /// Their size.
    pub size: ImageSize,
    /// Seed of everything random.
    pub seed: u64,
}

impl Default for DemoOptions {
    /// Half the phone's resolution and 32 frames: a minute and a half on two cores.
    fn default() -> Self {
        Self { frames: 32, size: ImageSize::new(960, 720), seed: 0 }
    }
}

/// What the demo found.
#[derive(Debug, Serialize)]
pub struct DemoSummary {
    /// The sequence folder.
    pub sequence: PathBuf,
    /// The reconstructed mesh.
    pub mesh: PathBuf,
    /// The report page.
    pub report: PathBuf,
    /// Errors of the aligned cameras against the simulator's truth.
    pub poses: PosesScores,
    /// Scores of the reconstruction, one entry per protocol.
    pub scores: Vec<SurfaceScores>,
    /// Wall time.
    pub seconds: f64,
    /// What deserves a look.
    pub warnings: Vec<String>,
}

/// Runs every stage on `model` in the folder `out`, and ends with `out/report.html` and its digest, `out/overview.jpg`.
///
/// A run that was stopped is taken up again: the capture keeps its finished frames, later stages are short.
///
/// # Errors
/// A stage fails, a file cannot be written, or the person asked for a stop.
pub fn demo(model: &Model, options: &DemoOptions, out: &Path, progress: &dyn Progress) -> Result<DemoSummary> {
    let start = Instant::now();
    let mut log = StageLog::default();
    let folder = out.join("sequence");

    let capture = ModelCapture {
        simulate: SimulateOptions {
            frames: options.frames,
            size: options.size,
            quality: Quality::Draft,
            seed: options.seed,
            ..SimulateOptions::default()
        },
        ..ModelCapture::default()
    };
    log.run("capture simulate", &capture, || simulate_model(model, &capture, &folder, progress))?;
    let sequence = Sequence::open(&folder)?;

    let keypoints = KeypointOptions::default();
    log.run("align keypoints", &keypoints, || align_keypoints(&sequence, &keypoints, progress))?;
    let refine = RefineOptions { seed: options.seed, ..RefineOptions::default() };
    log.run("align refine", &refine, || align_refine(&sequence, &refine, progress))?;
    let bundle = BundleOptions { seed: options.seed, ..BundleOptions::default() };
    log.run("align bundle", &bundle, || align_bundle(&sequence, &bundle, progress))?;
    let poses = log.run("eval poses", &(), || evaluate_poses(&folder.join("simulation"), &folder))?;
    // The bundle wrote new poses.
    let sequence = Sequence::open(&folder)?;

    let truth_options = TruthOptions::default();
    log.run("truth", &truth_options, || truth(&sequence, &truth_options, progress))?;

    let mesh_path = out.join("tsdf.ply");
    let tsdf = TsdfOptions::default();
    log.run("reconstruct tsdf", &tsdf, || {
        let (mesh, summary) = reconstruct_tsdf(&sequence, &tsdf, progress)?;
        mb_mesh::write_mesh(&mesh_path, &mesh)?;
        Ok(summary)
    })?;

    let mut scores = Vec::new();
    for protocol in [SurfaceProtocol::MobileBrick2023, SurfaceProtocol::Exact1] {
        let surface = SurfaceOptions { protocol, seed: options.seed, ..SurfaceOptions::default() };
        let name = format!("eval surface, {protocol}");
        scores.push(log.run(&name, &surface, || evaluate_surface(&folder, &mesh_path, &surface, progress))?);
    }

    let report_path = out.join("report.html");
    let scored = [Scored { method: "TSDF-Fusion".to_owned(), mesh: mesh_path.clone(), scores: scores.clone() }];
    let mut report = scene_report(&sequence, &scored, progress)?;
    report.stages = log.stages;
    report.warnings.extend(log.warnings.iter().cloned());
    report.write(&report_path)?;
    if let Some(overview) = report.overview() {
        mb_image::write_jpeg(out.join("overview.jpg"), &overview, 90)?;
    }

    Ok(DemoSummary {
        sequence: folder,
        mesh: mesh_path,
        report: report_path,
        poses,
        scores,
        seconds: start.elapsed().as_secs_f64(),
        warnings: log.warnings,
    })
}

/// Runs stages and remembers what was run.
#[derive(Default)]
struct StageLog {
    stages: Vec<Stage>,
    warnings: Vec<String>,
}

impl StageLog {
    fn run<T: Serialize>(
        &mut self,
        name: &str,
        options: &impl Serialize,
        work: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        let start = Instant::now();
        let result = work()?;
        let seconds = start.elapsed().as_secs_f64();
        let as_json = |e: serde_json::Error| Error::Failed(format!("the stage {name} cannot be recorded: {e}"));
        let summary = serde_json::to_value(&result).map_err(as_json)?;
        let warnings = summary.get("warnings").and_then(|w| w.as_array()).into_iter().flatten();
        self.warnings.extend(warnings.filter_map(|w| w.as_str()).map(|w| format!("{name}: {w}")));
        let options = serde_json::to_value(options).map_err(as_json)?;
        self.stages.push(Stage { name: name.to_owned(), options, summary, seconds });
        Ok(result)
    }
}
