//! `reconstruct`: a sequence's surface, by one of the methods.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use mb_gpu::DeviceChoice;
use mb_job::{Error, InputError, Result};
use mb_neural::FieldOptions;
use mb_neural::device::Device;
use mb_neural::results::write_beside;
use mb_recon::{PoseSource, TsdfOptions, reconstruct_tsdf};

use super::{Seed, SequenceArgument};
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Reconstruct a sequence's surface with one of the methods
#[derive(Debug, Subcommand)]
pub enum Reconstruct {
    /// Fuse the phone's depth maps into a truncated signed distance (Curless and Levoy 1996)
    Tsdf(Tsdf),
    /// A density field on a hash grid, trained on the photographs (Mildenhall et al. 2020; Mueller et al. 2022)
    Nerf(Field),
    /// A density field on voxels, trained on the photographs (Sun et al. 2022)
    Dvgo(Field),
    /// A signed distance field on a hash grid, trained on the photographs (Wang et al. 2021)
    Neus(Field),
}

impl Reconstruct {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Tsdf(c) => c.run(terminal),
            Self::Nerf(c) => c.run("nerf", terminal),
            Self::Dvgo(c) => c.run("dvgo", terminal),
            Self::Neus(c) => c.run("neus", terminal),
        }
    }
}

/// Which poses a method believes.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Poses {
    /// Those of the alignment, where there is one
    Aligned,
    /// Those of pose/, as the phone gave them
    Phone,
}

/// Fuse the phone's depth maps into a truncated signed distance (Curless and Levoy 1996)
#[derive(Debug, Args)]
pub struct Tsdf {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// Mesh to write: .ply, .obj, .glb or .stl; metres, the sequence's world frame
    #[arg(short, long, value_name = "MESH")]
    out: PathBuf,

    /// Edge of a voxel, millimetres
    #[arg(long, value_name = "MM", default_value_t = TsdfOptions::default().voxel_size_mm)]
    voxel: f64,

    /// Largest signed distance, millimetres
    #[arg(long, value_name = "MM", default_value_t = TsdfOptions::default().truncation_mm)]
    truncation: f64,

    /// Depth further than this is ignored, metres
    #[arg(long, value_name = "M", default_value_t = TsdfOptions::default().max_depth_m)]
    max_depth: f64,

    /// Lowest confidence that counts: 0, 1 or 2
    #[arg(long, value_name = "C", default_value_t = TsdfOptions::default().min_confidence)]
    confidence: u8,

    /// Leave out depth outside the object's mask, which `truth` writes
    #[arg(long)]
    masks: bool,

    /// Which poses to believe
    #[arg(long, value_enum, default_value = "aligned")]
    poses: Poses,
}

impl Tsdf {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let options = TsdfOptions {
            voxel_size_mm: self.voxel,
            truncation_mm: self.truncation,
            max_depth_m: self.max_depth,
            min_confidence: self.confidence,
            use_masks: self.masks,
            poses: match self.poses {
                Poses::Aligned => PoseSource::Aligned,
                Poses::Phone => PoseSource::Phone,
            },
            ..TsdfOptions::default()
        };
        let (mesh, summary) = reconstruct_tsdf(&self.sequence.open()?, &options, terminal)?;
        mb_mesh::write_mesh(&self.out, &mesh)?;
        let text = format!(
            "wrote {}: {} triangles from {} frames in {:.1} s",
            self.out.display(),
            summary.triangles,
            summary.frames,
            summary.seconds
        );
        Outcome::new(&summary, text)
    }
}

/// What all trained fields share.
#[derive(Debug, Args)]
pub struct FieldTraining {
    /// `fast` is made for a processor; `paper` has the published sizes and steps, which take days there; `best`, of neus,
    /// is slower than `fast` and finds more
    #[arg(long, value_name = "PRESET", default_value = "fast", value_parser = FieldOptions::PRESETS, conflicts_with = "options")]
    preset: String,

    /// Start from the options of this JSON file instead: those that lie beside every result, under "options"
    #[arg(long, value_name = "FILE")]
    options: Option<PathBuf>,

    /// Steps of training; schedules follow. The default is the preset's
    #[arg(long, value_name = "N")]
    iterations: Option<u64>,

    /// Longer side to which photographs are reduced
    #[arg(long, value_name = "PX")]
    max_side: Option<usize>,

    /// Do not use masks, also where every frame has one
    #[arg(long)]
    no_masks: bool,

    /// Correct the pose of each photograph while training
    #[arg(long)]
    refine_poses: bool,

    /// Correct the focal length of each photograph while training
    #[arg(long)]
    refine_focal: bool,

    /// File to keep the state of training in, also after the end; a run that finds one goes on from it. Without it the
    /// state is kept beside the output until the run has ended
    #[arg(long, value_name = "FILE")]
    checkpoint: Option<PathBuf>,

    /// Folder for pictures of one view as training goes on, beside its photograph
    #[arg(long, value_name = "DIR")]
    previews: Option<PathBuf>,

    /// What trains: the processor (cpu), a GPU (gpu, or gpu:N for the one of this number), or auto: a GPU where there is
    /// one that knows the method. A GPU needs a build with `--features gpu`
    #[arg(long, value_name = "DEVICE", default_value = "auto")]
    device: DeviceChoice,

    /// Largest memory for photographs, parameters and work, MiB; a run that needs more is refused at its start
    #[arg(long, value_name = "MIB")]
    memory: Option<usize>,

    #[command(flatten)]
    seed: Seed,
}

impl FieldTraining {
    /// The options of `method` (`nerf`, `dvgo`, `neus`) for a result of this name.
    pub fn options(&self, method: &str, out: &Path) -> Result<FieldOptions> {
        let mut options = match &self.options {
            Some(file) => read_options(file, method)?,
            None => FieldOptions::preset(method, &self.preset, self.seed.seed).ok_or_else(|| {
                Error::Failed(format!("{method} has no preset `{}`: take fast or paper", self.preset))
            })?,
        };
        if let Some(iterations) = self.iterations {
            options = options.with_iterations(iterations);
        }
        if let Some(max_side_px) = self.max_side {
            options.data.max_side_px = max_side_px;
        }
        options.data.masks &= !self.no_masks;
        options.cameras.refine_poses |= self.refine_poses;
        options.cameras.refine_focal |= self.refine_focal;
        options.run.checkpoint = Some(self.checkpoint.clone().unwrap_or_else(|| own_checkpoint(out)));
        options.run.previews.clone_from(&self.previews);
        if let Some(memory) = self.memory {
            options.run.memory_mib = memory;
        }
        Ok(options)
    }

    /// What trains a run with these options.
    pub fn device(&self, options: &FieldOptions) -> Result<Box<dyn Device>> {
        mb_gpu::device(self.device, options)
    }

    /// Removes the state of training after the end, unless the person named a file for it.
    pub fn finish(&self, out: &Path) {
        if self.checkpoint.is_none() {
            std::fs::remove_file(own_checkpoint(out)).ok();
        }
    }
}

/// The state of training of a result, until it is there.
fn own_checkpoint(out: &Path) -> PathBuf {
    beside(out, ".checkpoint")
}

/// `DIR/castle` and `.json` for `DIR/castle.ply`.
fn beside(out: &Path, ending: &str) -> PathBuf {
    let mut name = out.with_extension("").into_os_string();
    name.push(ending);
    name.into()
}

fn read_options(file: &Path, method: &str) -> Result<FieldOptions> {
    let text = std::fs::read_to_string(file).map_err(|e| InputError::unreadable(file, &e))?;
    let wrong =
        |found: String| InputError::new(file, found).help("Take the file that lies beside a result of the same method");
    let json: serde_json::Value = serde_json::from_str(&text).map_err(|e| wrong(format!("not JSON ({e})")))?;
    let inner = json.get("options").cloned().unwrap_or(json);
    let options: FieldOptions =
        serde_json::from_value(inner).map_err(|e| wrong(format!("not the options of a field ({e})")))?;
    match options.method.name() == method {
        true => Ok(options),
        false => Err(wrong(format!("the options of {}, not of {method}", options.method.name())).into()),
    }
}

/// A field, trained on every photograph of the sequence
#[derive(Debug, Args)]
pub struct Field {
    #[command(flatten)]
    sequence: SequenceArgument,

    /// Mesh to write: .ply, .obj, .glb or .stl; metres, the sequence's world frame. Beside it: options and figures
    /// (.json), the loss curve (.curve.csv), corrected cameras (.cameras/)
    #[arg(short, long, value_name = "MESH")]
    out: PathBuf,

    /// Spacing of the grid that the surface is taken from, millimetres
    #[arg(long, value_name = "MM")]
    voxel: Option<f64>,

    /// Keep also what no camera sees
    #[arg(long)]
    no_cull: bool,

    /// Without masks, keep also the table or floor that the object stands on
    #[arg(long)]
    keep_table: bool,

    #[command(flatten)]
    training: FieldTraining,
}

impl Field {
    fn run(&self, method: &str, terminal: &Terminal) -> Result<Outcome> {
        let mut options = self.training.options(method, &self.out)?;
        if let Some(voxel_mm) = self.voxel {
            options.surface.voxel_mm = voxel_mm;
        }
        options.surface.cull &= !self.no_cull;
        options.surface.keep_table |= self.keep_table;
        let cameras = beside(&self.out, ".cameras");
        let device = self.training.device(&options)?;
        let (mesh, summary) =
            mb_neural::reconstruct(&self.sequence.open()?, &options, device.as_ref(), Some(&cameras), terminal)?;
        mb_mesh::write_mesh(&self.out, &mesh)?;
        write_beside(&beside(&self.out, ""), &summary, &summary.training.curve)?;
        self.training.finish(&self.out);
        let mut text = format!(
            "wrote {}: {} triangles from {} photographs after {} steps on {} ({:.1} dB)",
            self.out.display(),
            summary.triangles,
            summary.images,
            summary.training.steps,
            summary.device,
            summary.training.curve.last().map_or(f64::NAN, |p| p.psnr_db),
        );
        if let Some(table) = &summary.table {
            write!(
                text,
                "\ncut off what the object stands on, up to {:.1} mm above it ({:.0} % of the surface); --keep-table keeps it",
                table.cut_mm,
                100.0 * table.plane.share,
            )
            .expect("a string takes everything");
        }
        Outcome::new(&summary, text)
    }
}
