//! `capture`: sequences in, out, checked and simulated.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use mb_capture::{CaptureFormat, ExportFormat, ImportOptions};
use mb_download::DownloadOptions;
use mb_geometry::ImageSize;
use mb_job::Result;
use mb_pipeline::{ModelCapture, simulate_model};
use mb_simulate::{DriftOptions, LensOptions, Quality, SimulateOptions, Table};

use super::model::ModelArgument;
use super::{Seed, SequenceArgument};
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Sequences: photographs, depth and poses of a phone, or of one in software
#[derive(Debug, Subcommand)]
pub enum Capture {
    /// Read a recording of a phone app or another data set as a sequence; the format is detected
    Import(Import),
    /// Film a model with a phone in software; the truth is kept beside what the phone says
    Simulate(Simulate),
    /// Look for what is missing, damaged, inconsistent or in the wrong convention
    Check(Check),
    /// Write a sequence in the layout of another program
    Export(Export),
    /// Fetch the published data set, or parts of it; a stopped run is taken up again
    Download(Download),
}

impl Capture {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Import(c) => c.run(terminal),
            Self::Simulate(c) => c.run(terminal),
            Self::Check(c) => c.run(terminal),
            Self::Export(c) => c.run(terminal),
            Self::Download(c) => c.run(terminal),
        }
    }
}

/// Effort per photograph.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum QualityArgument {
    /// For demos and tests
    Draft,
    /// Soft shadows, reflections
    Standard,
    /// Everything traced finely
    Photo,
}

/// Film a model with a phone in software; the truth is kept beside what the phone says
#[derive(Debug, Args)]
pub struct Simulate {
    #[command(flatten)]
    model: ModelArgument,

    /// Sequence folder to write; a stopped run is taken up again
    #[arg(short, long, value_name = "SEQ")]
    out: PathBuf,

    /// Photographs
    #[arg(long, value_name = "N", default_value_t = SimulateOptions::default().frames)]
    frames: usize,

    /// Size of the photographs, sensor orientation
    #[arg(long, value_name = "WxH", default_value = "1920x1440", value_parser = parse_size)]
    size: ImageSize,

    /// Effort per photograph
    #[arg(long, value_enum, default_value = "standard")]
    quality: QualityArgument,

    /// Mean distance of the camera, millimetres; chosen to fit the model where absent
    #[arg(long, value_name = "MM")]
    radius: Option<f64>,

    /// Camera angles above the table, degrees: one circle round the model for each
    #[arg(long, value_name = "DEG,...", value_delimiter = ',', default_values_t = SimulateOptions::default().elevations_deg)]
    elevations: Vec<f64>,

    /// How much the hand wavers: 1 is a person's, 0 a rail
    #[arg(long, value_name = "SHARE", default_value_t = SimulateOptions::default().hand_jitter)]
    jitter: f64,

    /// Photographs per second of a walk at 0.2 m/s (published sequences: 10); absent, they spread over all circles
    #[arg(long, value_name = "HZ")]
    fps: Option<f64>,

    /// Calibration board printed under the model, such as charuco:7x5:0.030:0.022:DICT_5X5_100
    #[arg(long, value_name = "SPEC")]
    board: Option<String>,

    /// What the model stands on; the seed chooses where absent
    #[arg(long, value_enum)]
    table: Option<TableArgument>,

    /// Radial distortion k1,k2 that the intrinsic files do not tell
    #[arg(long, value_name = "K1,K2", value_parser = parse_distortion, allow_hyphen_values = true)]
    distortion: Option<[f64; 2]>,

    /// Rolling shutter: time to read the sensor, milliseconds
    #[arg(long, value_name = "MS", default_value_t = 0.0)]
    readout: f64,

    /// Expected error of the reported poses: relative translations, millimetres
    #[arg(long, value_name = "MM", default_value_t = DriftOptions::default().translation_rmse_mm)]
    drift_translation: f64,

    /// Expected error of the reported poses: relative rotations, degrees
    #[arg(long, value_name = "DEG", default_value_t = DriftOptions::default().rotation_mean_deg)]
    drift_rotation: f64,

    /// Play of outer side walls, millimetres; real bricks have about 0.1
    #[arg(long, value_name = "MM", default_value_t = 0.0)]
    clearance: f64,

    #[command(flatten)]
    seed: Seed,
}

/// What the model stands on.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum TableArgument {
    /// Two bamboo boards on a sofa
    Bamboo,
    /// Oiled oak planks
    Oak,
    /// A checked tablecloth
    Gingham,
    /// A printed linen cloth
    Linen,
    /// Polished marble
    Marble,
    /// A newspaper
    Newspaper,
}

impl From<TableArgument> for Table {
    fn from(table: TableArgument) -> Self {
        match table {
            TableArgument::Bamboo => Self::Bamboo,
            TableArgument::Oak => Self::Oak,
            TableArgument::Gingham => Self::Gingham,
            TableArgument::Linen => Self::Linen,
            TableArgument::Marble => Self::Marble,
            TableArgument::Newspaper => Self::Newspaper,
        }
    }
}

impl Simulate {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let capture = ModelCapture {
            clearance_mm: self.clearance,
            simulate: SimulateOptions {
                frames: self.frames,
                size: self.size,
                quality: match self.quality {
                    QualityArgument::Draft => Quality::Draft,
                    QualityArgument::Standard => Quality::Standard,
                    QualityArgument::Photo => Quality::Photo,
                },
                seed: self.seed.seed,
                radius_m: self.radius.map(|mm| mm * 1e-3),
                elevations_deg: self.elevations.clone(),
                hand_jitter: self.jitter,
                frames_per_s: self.fps,
                board: self.board.clone(),
                table: self.table.map(Into::into),
                lens: LensOptions { distortion: self.distortion.unwrap_or_default(), readout_s: self.readout * 1e-3 },
                drift: DriftOptions {
                    translation_rmse_mm: self.drift_translation,
                    rotation_mean_deg: self.drift_rotation,
                    ..DriftOptions::default()
                },
                ..SimulateOptions::default()
            },
        };
        let summary = simulate_model(&self.model.read()?, &capture, &self.out, terminal)?;
        let text = format!(
            "wrote {}: {} photographs of {}, {:.0} mm away; reported poses off by {:.2} mm and {:.2} deg",
            self.out.display(),
            summary.frames,
            summary.image_size,
            summary.radius_m * 1e3,
            summary.pose_translation_rmse_mm,
            summary.pose_rotation_mean_deg
        );
        Outcome::new(&summary, text)
    }
}

pub(super) fn parse_size(text: &str) -> Result<ImageSize, String> {
    let sides = text.split_once(['x', 'X']).and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    let (width, height) = sides.ok_or("must look like 1920x1440")?;
    Ok(ImageSize::new(width, height))
}

fn parse_distortion(text: &str) -> Result<[f64; 2], String> {
    let pair = text.split_once(',').and_then(|(a, b)| Some([a.trim().parse().ok()?, b.trim().parse().ok()?]));
    pair.ok_or_else(|| "must look like 0.01,-0.002".to_owned())
}

/// Formats that can be read.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum ImportFormat {
    Mobilebrick,
    ArkitJson,
    Stray,
    Record3d,
    Arkitscenes,
    Nerfstudio,
    Colmap,
    SevenScenes,
    Neus,
    Mvsnet,
    Opensfm,
    Photos,
}

impl From<ImportFormat> for CaptureFormat {
    fn from(format: ImportFormat) -> Self {
        match format {
            ImportFormat::Mobilebrick => Self::Mobilebrick,
            ImportFormat::ArkitJson => Self::ArkitJson,
            ImportFormat::Stray => Self::Stray,
            ImportFormat::Record3d => Self::Record3d,
            ImportFormat::Arkitscenes => Self::Arkitscenes,
            ImportFormat::Nerfstudio => Self::Nerfstudio,
            ImportFormat::Colmap => Self::Colmap,
            ImportFormat::SevenScenes => Self::SevenScenes,
            ImportFormat::Neus => Self::Neus,
            ImportFormat::Mvsnet => Self::Mvsnet,
            ImportFormat::Opensfm => Self::Opensfm,
            ImportFormat::Photos => Self::Photos,
        }
    }
}

/// Read a recording of a phone app or another data set as a sequence; the format is detected
#[derive(Debug, Args)]
pub struct Import {
    /// Folder or archive to read
    #[arg(value_name = "SRC")]
    source: PathBuf,

    /// Its format, where detection is not wanted
    #[arg(long = "as", value_enum, value_name = "FORMAT")]
    format: Option<ImportFormat>,

    /// Sequence folder to write, new or empty
    #[arg(short, long, value_name = "SEQ")]
    out: PathBuf,

    /// Take every N-th frame
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    every: u32,

    /// First and last frame number to take, such as 10..99
    #[arg(long, value_name = "FIRST..LAST", value_parser = parse_range)]
    range: Option<(u32, u32)>,

    /// Keep K frames: the sharpest of each of K runs of equal length, which drops blurred ones
    #[arg(long, value_name = "K", value_parser = clap::value_parser!(u32).range(1..))]
    sharpest: Option<u32>,
}

impl Import {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let options = ImportOptions {
            range: self.range,
            every: self.every as usize,
            sharpest: self.sharpest.map(|k| k as usize),
        };
        let summary = mb_capture::import(&self.source, self.format.map(Into::into), &self.out, &options, terminal)?;
        let mut text = format!(
            "read {}: {} of {} frames ({} not asked for, {} left out), {} with depth, {} with a pose; wrote {}\n",
            summary.format.name(),
            summary.frames_imported,
            summary.frames_found,
            summary.frames_not_selected,
            summary.frames_skipped.len(),
            summary.frames_with_depth,
            summary.frames_with_pose,
            self.out.display()
        );
        for skipped in &summary.frames_skipped {
            text += &format!("left out {}: {}\n", skipped.frame, skipped.reason);
        }
        Outcome::new(&summary, text)
    }
}

/// Look for what is missing, damaged, inconsistent or in the wrong convention
#[derive(Debug, Args)]
pub struct Check {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// Also write a page with the camera path, photographs and depth
    #[arg(long, value_name = "FILE.html")]
    report: Option<PathBuf>,
}

impl Check {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let sequence = self.sequence.open()?;
        let check = mb_pipeline::check_capture(&sequence, &Default::default(), terminal)?;
        let summary = &check.capture;
        let mut text = format!(
            "{} frames, {} photographs, {} depth maps, {:.0} % of the way round: {}\n",
            summary.frames,
            summary.frames_with_photo,
            summary.frames_with_depth,
            summary.orbit_coverage * 100.0,
            if summary.ok { "nothing wrong".to_owned() } else { format!("{} problems", summary.problems.len()) }
        );
        if let Some(mm) = summary.depth_disagreement_mm {
            text += &format!("depth and poses disagree by {mm:.1} mm\n");
        }
        if let Some(epipolar) = &check.epipolar {
            let (px, pairs) = (epipolar.median_px, epipolar.pairs.len());
            text += &format!("matches lie {px:.2} px from where the poses put them ({pairs} pairs of photographs)\n");
        }
        for problem in &summary.problems {
            let place = problem.frame.map(|frame| format!("frame {frame}: ")).unwrap_or_default();
            text += &format!("{}: {place}{}\n", problem.kind, problem.message);
        }
        if let Some(path) = &self.report {
            mb_pipeline::check_report(&sequence, &check, terminal)?.write(path)?;
            text += &format!("wrote {}\n", path.display());
        }
        Outcome::new(&check, text)
    }
}

/// Layouts that can be written.
#[derive(Debug, Clone, Copy, ValueEnum)]
enum ExportLayout {
    Colmap,
    Nerfstudio,
    Neus,
    Mvsnet,
}

/// Write a sequence in the layout of another program
#[derive(Debug, Args)]
pub struct Export {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// The layout
    #[arg(long = "as", value_enum, value_name = "LAYOUT")]
    layout: ExportLayout,

    /// Folder to write, new or empty
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
}

impl Export {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let format = match self.layout {
            ExportLayout::Colmap => ExportFormat::Colmap,
            ExportLayout::Nerfstudio => ExportFormat::Nerfstudio,
            ExportLayout::Neus => ExportFormat::Neus,
            ExportLayout::Mvsnet => ExportFormat::Mvsnet,
        };
        let summary = mb_capture::export(&self.sequence.open()?, format, &self.out, terminal)?;
        let text = format!("wrote {}: {} frames, {} masks", self.out.display(), summary.frames, summary.masks);
        Outcome::new(&summary, text)
    }
}

/// Fetch the published data set, or parts of it; a stopped run is taken up again
#[derive(Debug, Args)]
pub struct Download {
    /// A folder of the archive: a sequence (aston), a kind of file (mesh), or both (aston/mesh); may be repeated
    #[arg(long = "part", value_name = "NAME")]
    parts: Vec<String>,

    /// Address of another zip archive, or the path of one that is here already
    #[arg(long, value_name = "URL", default_value = mb_download::PUBLISHED_URL)]
    url: String,

    /// Folder to write, where files lie as in the archive
    #[arg(short, long, value_name = "DIR")]
    out: PathBuf,
}

impl Download {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let options = DownloadOptions { url: self.url.clone(), parts: self.parts.clone(), ..Default::default() };
        let summary = mb_download::download(&self.out, &options, terminal)?;
        let mut text = format!(
            "wrote {}: {} files, {} were there already; {:.1} MB in all, every file checked\n",
            self.out.display(),
            summary.files_written,
            summary.files_kept,
            summary.bytes as f64 * 1e-6
        );
        if let Some(archive) = &summary.archive {
            text += &format!(
                "the server sends only the whole archive; it is kept as {} (--url takes its path)\n",
                archive.display()
            );
        }
        Outcome::new(&summary, text)
    }
}

fn parse_range(text: &str) -> Result<(u32, u32), String> {
    let halves = text.split_once("..").or_else(|| text.split_once('-'));
    let ends = halves.and_then(|(a, b)| Some((a.trim().parse().ok()?, b.trim().parse().ok()?)));
    ends.filter(|(first, last)| first <= last).ok_or_else(|| "must look like 10..99, both included".to_owned())
}
