//! `model`: what a brick model is made of, and its geometry.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use mb_bricks::{MeshOptions, Model as BrickModel};
use mb_job::{Error, Result};
use serde_json::json;

use super::parts::{Parts, PartsArgument};
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// Brick models: LDraw and Studio files, built-in bricks
#[derive(Debug, Subcommand)]
pub enum Model {
    /// Count parts, triangles and steps; list what is missing
    Info(Info),
    /// Write the model's geometry: PLY, OBJ, GLB or STL
    Mesh(Mesh),
    /// The official parts library
    #[command(subcommand)]
    Parts(Parts),
}

impl Model {
    /// Runs the subcommand.
    pub fn run(self, _terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Info(c) => c.run(),
            Self::Mesh(c) => c.run(),
            Self::Parts(c) => c.run(),
        }
    }
}

/// A model file and the library for its parts.
#[derive(Debug, Args)]
pub struct ModelArgument {
    /// LDraw model (.ldr, .mpd, .dat) or Studio file (.io); `demo` is the built-in model
    #[arg(value_name = "MODEL")]
    model: PathBuf,

    #[command(flatten)]
    parts: PartsArgument,
}

impl ModelArgument {
    /// Reads the model; missing parts are warnings of the model.
    pub fn read(&self) -> Result<BrickModel> {
        if self.model == Path::new("demo") && !self.model.exists() {
            return Ok(mb_bricks::demo_model());
        }
        BrickModel::read(&self.model, self.parts.open()?.as_ref())
    }
}

/// Count parts, triangles and steps; list what is missing
#[derive(Debug, Args)]
pub struct Info {
    #[command(flatten)]
    model: ModelArgument,
}

impl Info {
    fn run(&self) -> Result<Outcome> {
        let info = self.model.read()?.info();
        let size = info.bbox_mm.map_or_else(
            || "empty".to_owned(),
            |b| {
                let side = |axis: usize| b.max[axis] - b.min[axis];
                format!("{:.1} x {:.1} x {:.1} mm", side(0), side(1), side(2))
            },
        );
        let mut text = format!(
            "{} parts ({} distinct), {} triangles, {} steps, {size}\n",
            info.parts, info.distinct_parts, info.triangles, info.steps
        );
        for missing in &info.missing {
            text += &format!("missing: {} ({} line {})\n", missing.name, missing.file, missing.line);
        }
        for line in &info.bom {
            text += &format!("{:>5} x {:<16} {:<28} {}\n", line.count, line.part, line.color_name, line.description);
        }
        Outcome::new(&info, text)
    }
}

/// Write the model's geometry: PLY, OBJ, GLB or STL
#[derive(Debug, Args)]
pub struct Mesh {
    #[command(flatten)]
    model: ModelArgument,

    /// Play of outer side walls, millimetres; real bricks have about 0.1
    #[arg(long, value_name = "MM", default_value_t = 0.0)]
    clearance: f64,

    /// Output; the ending chooses the format
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
}

impl Mesh {
    fn run(&self) -> Result<Outcome> {
        if !(0.0..=0.5).contains(&self.clearance) {
            return Err(Error::Failed(format!("--clearance is {} mm, must be 0 to 0.5", self.clearance)));
        }
        let model = self.model.read()?;
        let mesh = model.mesh(&MeshOptions { clearance_mm: self.clearance });
        mb_mesh::write_mesh(&self.out, &mesh)?;
        let (vertices, triangles) = (mesh.vertices.len(), mesh.triangles.len());
        let warnings = model.info().warnings;
        Outcome::new(
            &json!({ "file": self.out, "vertices": vertices, "triangles": triangles, "clearance_mm": self.clearance,
                     "frame": "object", "unit": "m", "warnings": warnings }),
            format!("wrote {}: {triangles} triangles, metres, y up", self.out.display()),
        )
    }
}
