//! `eval`: scores of surfaces, views, depth maps and poses.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use mb_eval::{
    DepthOptions, PUBLISHED_TEST_SEQUENCES, PerceptualMetric, SurfaceOptions, SurfaceProtocol, ThresholdScore,
    ViewsOptions, evaluate_depth, evaluate_poses, evaluate_surface, evaluate_surface_method, evaluate_views,
    evaluate_views_method, read_sequence_list,
};
use mb_job::{Error, Result};
use mb_perceptual::{Lpips, LpipsNet};

use super::Seed;

use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Score surfaces, views, depth maps and poses
#[derive(Debug, Subcommand)]
pub enum Eval {
    /// A reconstructed surface, or a method over a list of sequences
    Surface(Surface),
    /// Novel views: PSNR, SSIM, LPIPS; images are paired by file name
    Views(Views),
    /// Depth maps: 16-bit PNGs in millimetres, paired by file name, valid where both are above 0
    Depth(Depth),
    /// Camera poses: sequences, or folders with pose/*.txt
    Poses(Poses),
    /// Check LPIPS weights, and convert them to one safetensors file
    LpipsWeights(LpipsWeights),
}

impl Eval {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Surface(c) => c.run(terminal),
            Self::Views(c) => c.run(terminal),
            Self::Depth(c) => c.run(terminal),
            Self::Poses(c) => c.run(),
            Self::LpipsWeights(c) => c.run(),
        }
    }
}

/// Two folders to compare.
#[derive(Debug, Args)]
struct Folders {
    /// Ground truth
    #[arg(long, value_name = "DIR")]
    gt: PathBuf,

    /// Prediction
    #[arg(long, value_name = "DIR")]
    pred: PathBuf,
}

/// The sequences of a table.
#[derive(Debug, Args)]
struct List {
    /// File with the sequences' names, separated by commas or line ends; ./evaluations/test_seqs.txt, else the 18 published
    /// test sequences
    #[arg(long, value_name = "FILE", requires = "method", alias = "seq_txt")]
    list: Option<PathBuf>,

    /// Sequences to leave out
    #[arg(long, value_name = "SEQ", requires = "method", num_args = 1..)]
    skip: Vec<String>,
}

impl List {
    /// Where the published repository keeps its list.
    const PUBLISHED: &str = "evaluations/test_seqs.txt";

    fn read(&self) -> Result<Vec<String>> {
        let published = Path::new(Self::PUBLISHED);
        let mut names = match &self.list {
            Some(list) => read_sequence_list(list)?,
            None if published.exists() => read_sequence_list(published)?,
            None => PUBLISHED_TEST_SEQUENCES.map(str::to_owned).to_vec(),
        };
        if let Some(unknown) = self.skip.iter().find(|s| !names.contains(s)) {
            return Err(Error::Failed(format!("--skip {unknown}: the list has no such sequence")));
        }
        names.retain(|name| !self.skip.contains(name));
        Ok(names)
    }
}

/// A reconstructed surface, or a method over a list of sequences
///
/// One prediction: `--gt SEQ --pred MESH`. A table: `--method NAME`, with the predictions at ./meshes/NAME/SEQ.ply and the
/// sequences in ./data as the published script has them; it takes that script's options too.
#[derive(Debug, Args)]
pub struct Surface {
    /// Sequence with the ground truth
    #[arg(long, value_name = "SEQ", requires = "pred", required_unless_present = "method", conflicts_with = "method")]
    gt: Option<PathBuf>,

    /// Mesh or point cloud to score, metres, the sequence's world frame
    #[arg(long, value_name = "MESH", requires = "gt")]
    pred: Option<PathBuf>,

    /// Method whose predictions lie in the folder of that name
    #[arg(long, value_name = "NAME")]
    method: Option<String>,

    /// Folder that holds the sequences
    #[arg(long, value_name = "DATA", requires = "method", default_value = "data", alias = "gt_root")]
    root: PathBuf,

    #[command(flatten)]
    list: List,

    /// Folder that holds a folder of meshes for each method
    #[arg(long, value_name = "DIR", default_value = "meshes")]
    meshes: PathBuf,

    /// Folder for data.csv (as published), scores.csv and scores.json; the predictions' own, as published
    #[arg(short, long, value_name = "DIR", requires = "method")]
    out: Option<PathBuf>,

    /// mobilebrick-2023 (as published), exact-1, dtu-style-1 or tnt-style-1
    #[arg(long, default_value_t = SurfaceProtocol::default())]
    protocol: SurfaceProtocol,

    /// Points sampled on each surface
    #[arg(long, value_name = "N", default_value_t = SurfaceOptions::default().points, alias = "n_pts")]
    points: usize,

    /// A threshold beside 2.5 and 5 mm; may be repeated
    #[arg(long = "threshold", value_name = "MM")]
    thresholds: Vec<f64>,

    #[command(flatten)]
    seed: Seed,
}

impl Surface {
    fn run(self, terminal: &Terminal) -> Result<Outcome> {
        let options = SurfaceOptions {
            protocol: self.protocol,
            points: self.points,
            seed: self.seed.seed,
            more_thresholds_mm: self.thresholds,
        };
        if let Some(method) = self.method {
            let list = self.list.read()?;
            let predictions = self.meshes.join(&method);
            crate::memory::keep_freed();
            let table = evaluate_surface_method(&method, &predictions, &self.root, &list, &options, terminal)?;
            let out = self.out.unwrap_or(predictions);
            table.write(&out)?;
            let mut text = format!("{method}: {} of {} sequences scored\n", table.sequences.len(), list.len());
            if let Some(mean) = &table.mean {
                text += &score_lines(mean.chamfer.chamfer_mm, &mean.thresholds);
            }
            return Outcome::new(&table, text + &format!("wrote {}", out.display()));
        }
        let (Some(gt), Some(pred)) = (self.gt, self.pred) else {
            return Err(Error::Failed("needs --gt and --pred, or --method".into()));
        };
        let scores = evaluate_surface(&gt, &pred, &options, terminal)?;
        let text = format!(
            "{}, {}: ICP fitness {:.4}, {}\n{}",
            scores.sequence,
            scores.protocol,
            scores.icp.fitness,
            if scores.icp.applied { "prediction moved" } else { "prediction not moved" },
            score_lines(scores.chamfer.chamfer_mm, &scores.thresholds)
        );
        Outcome::new(&scores, text)
    }
}

/// The figures of the published tables, in percent as printed there.
fn score_lines(chamfer_mm: f64, thresholds: &[ThresholdScore]) -> String {
    let mut text = format!("Chamfer {chamfer_mm:.3} mm\n");
    for t in thresholds {
        text += &format!(
            "{:>5} mm: accuracy {:6.2} %, recall {:6.2} %, F1 {:6.2} %\n",
            t.threshold_mm,
            t.accuracy * 100.0,
            t.recall * 100.0,
            t.f1 * 100.0
        );
    }
    text
}

/// Novel views: PSNR, SSIM, LPIPS; images are paired by file name
///
/// Two folders: `--gt DIR --pred DIR`. A method over a list of sequences: `--method NAME`, with the images at
/// ./nvs/NAME/SEQ/{gt,render}_ID.png as the published script has them; it takes that script's options too.
#[derive(Debug, Args)]
pub struct Views {
    /// Ground truth
    #[arg(long, value_name = "DIR", requires = "pred", required_unless_present = "method", conflicts_with = "method")]
    gt: Option<PathBuf>,

    /// Prediction
    #[arg(long, value_name = "DIR", requires = "gt")]
    pred: Option<PathBuf>,

    /// Method whose views lie in the folder of that name
    #[arg(long, value_name = "NAME")]
    method: Option<String>,

    #[command(flatten)]
    list: List,

    /// Folder that holds a folder of views for each method
    #[arg(long, value_name = "DIR", default_value = "nvs")]
    nvs: PathBuf,

    /// Folder for data.csv and scores.json; the views' own
    #[arg(short, long, value_name = "DIR", requires = "method")]
    out: Option<PathBuf>,

    /// Score every N-th image of the ground truth only; the paper holds out every 8th
    #[arg(long, value_name = "N")]
    hold_out: Option<usize>,

    /// Folder of masks with the images' names; white is scored
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,

    /// Network of LPIPS: vgg (as in the paper's tables), alex or squeeze
    #[arg(long, value_name = "NET", default_value = "vgg")]
    lpips_net: LpipsNet,

    /// Weights of LPIPS, safetensors or the original .pth; repeat for a backbone and its linear layers
    #[arg(long, value_name = "FILE")]
    lpips_weights: Vec<PathBuf>,
}

impl Views {
    fn run(self, terminal: &Terminal) -> Result<Outcome> {
        let options = ViewsOptions { hold_out: self.hold_out, masks: self.masks };
        let lpips = match self.lpips_weights.as_slice() {
            [] => None,
            files => Some(Lpips::read(self.lpips_net, files)?),
        };
        let perceptual = lpips.as_ref().map(|l| l as &dyn PerceptualMetric);
        let line = |images: usize, psnr: f64, ssim: f64, lpips: Option<f64>| {
            let lpips = lpips.map_or_else(|| "not computed: give --lpips-weights".to_owned(), |v| format!("{v:.4}"));
            let images = if images == 1 { "1 image".to_owned() } else { format!("{images} images") };
            format!("{images}: PSNR {psnr:.2} dB, SSIM {ssim:.4}, LPIPS {lpips}")
        };
        if let Some(method) = self.method {
            let list = self.list.read()?;
            let views = self.nvs.join(method);
            let table = evaluate_views_method(&views, &list, &options, perceptual, terminal)?;
            let out = self.out.unwrap_or(views);
            table.write(&out, &list)?;
            let text = line(table.images, table.psnr, table.ssim, table.lpips);
            return Outcome::new(&table, format!("{text}\nwrote {}", out.display()));
        }
        let (Some(gt), Some(pred)) = (self.gt, self.pred) else {
            return Err(Error::Failed("needs --gt and --pred, or --method".into()));
        };
        let scores = evaluate_views(&gt, &pred, &options, perceptual, terminal)?;
        let text = line(scores.images, scores.psnr, scores.ssim, scores.lpips);
        Outcome::new(&scores, text)
    }
}

/// Check LPIPS weights, and convert them to one safetensors file
#[derive(Debug, Args)]
pub struct LpipsWeights {
    /// Safetensors or the original .pth: a whole state dictionary, or a backbone and its linear layers
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,

    /// Network: vgg, alex or squeeze
    #[arg(long, value_name = "NET", default_value = "vgg")]
    net: LpipsNet,

    /// Safetensors file to write
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
}

impl LpipsWeights {
    fn run(&self) -> Result<Outcome> {
        let lpips = Lpips::read(self.net, &self.files)?;
        if let Some(out) = &self.out {
            lpips.write_safetensors(out)?;
        }
        let written = self.out.as_ref().map(|out| format!(", wrote {}", out.display())).unwrap_or_default();
        Outcome::new(lpips.report(), format!("complete weights of LPIPS with {}{written}", self.net.name()))
    }
}

/// Depth maps: 16-bit PNGs in millimetres, paired by file name, valid where both are above 0
#[derive(Debug, Args)]
pub struct Depth {
    #[command(flatten)]
    folders: Folders,

    /// Folder of confidence maps NAME_conf.png, for scores by confidence
    #[arg(long, value_name = "DIR")]
    confidence: Option<PathBuf>,
}

impl Depth {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let options = DepthOptions { confidence: self.confidence.clone(), ..DepthOptions::default() };
        let scores = evaluate_depth(&self.folders.gt, &self.folders.pred, &options, terminal)?;
        let m = &scores.mean;
        let text = format!(
            "{} pixels: AbsRel {:.4}, SqRel {:.4}, RMSE {:.4} m, RMSE log {:.4}, d1 {:.4}, d2 {:.4}, d3 {:.4}",
            m.valid_pixels, m.abs_rel, m.sq_rel, m.rmse_m, m.rmse_log, m.delta1, m.delta2, m.delta3
        );
        Outcome::new(&scores, text)
    }
}

/// Camera poses: sequences, or folders with pose/*.txt
#[derive(Debug, Args)]
pub struct Poses {
    #[command(flatten)]
    folders: Folders,
}

impl Poses {
    fn run(&self) -> Result<Outcome> {
        let scores = evaluate_poses(&self.folders.gt, &self.folders.pred)?;
        let mut text = format!(
            "{} frames: pairs {:.3} mm rms, {:.3} deg mean; after rigid alignment {:.3} mm rms",
            scores.frames, scores.pairwise.translation_rmse_mm, scores.pairwise.rotation_mean_deg, scores.ate_rmse_mm
        );
        if let Some(object) = &scores.object {
            text += &format!(
                "\nin the object's frame {:.3} mm rms, {:.3} deg mean",
                object.translation_rmse_mm, object.rotation_mean_deg
            );
        }
        Outcome::new(&scores, text)
    }
}
