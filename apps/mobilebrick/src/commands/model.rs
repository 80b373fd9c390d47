//! `model`: what a brick model is made of, and its geometry.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use mb_bricks::{
    BatchSummary, CheckReport, MeshOptions, Model as BrickModel, RandomModel, RandomOptions, RandomProfile,
    random_models,
};
use mb_instructions::{Form, Plan};
use mb_job::{Error, InputError, Result};
use serde_json::json;

use super::Seed;
use super::parts::{NO_LIBRARY, Parts, PartsArgument};
use crate::outcome::Outcome;
use crate::terminal::Terminal;

/// So many collisions, and kinds of parts, are listed for people; the document has all.
const SHOWN: usize = 5;

/// Brick models: LDraw and Studio files, built-in bricks
#[derive(Debug, Subcommand)]
pub enum Model {
    /// Count parts, triangles and steps; list what is missing
    Info(Info),
    /// Write the model's geometry: PLY, OBJ, GLB or STL
    Mesh(Mesh),
    /// Make random models that can be built and stand
    Random(Random),
    /// Collisions, connections, stability and a build order
    Check(Check),
    /// Building instructions: a PDF or an HTML page, and lists for buying the parts
    Instructions(Instructions),
    /// The official parts library
    #[command(subcommand)]
    Parts(Parts),
}

impl Model {
    /// Runs the subcommand.
    pub fn run(self, terminal: &Terminal) -> Result<Outcome> {
        match self {
            Self::Info(c) => c.run(),
            Self::Mesh(c) => c.run(),
            Self::Random(c) => c.run(terminal),
            Self::Check(c) => c.run(),
            Self::Instructions(c) => c.run(terminal),
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
        if !info.missing.is_empty() && !self.model.parts.has_library() {
            text += &format!("{NO_LIBRARY}\n");
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

    /// Leave out what no view from outside can see: inner walls, tubes
    #[arg(long)]
    external_only: bool,

    /// One object for the whole model, where the format knows objects; otherwise each brick is one
    #[arg(long)]
    one_object: bool,

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
        let (mut mesh, external) = if self.external_only {
            let (mesh, outside) = mb_render::outside_only(&mesh);
            let removed = outside.triangles - outside.kept;
            let external = json!({ "triangles": outside.triangles, "kept": outside.kept, "removed": removed,
                                   "removed_area": outside.removed_area, "changed_pixels": outside.changed_pixels });
            (mesh, external)
        } else {
            (mesh, json!(null))
        };
        if self.one_object {
            mesh.triangle_parts = None;
        }
        mb_mesh::write_mesh(&self.out, &mesh)?;
        let (vertices, triangles) = (mesh.vertices.len(), mesh.triangles.len());
        let warnings = model.info().warnings;
        Outcome::new(
            &json!({ "file": self.out, "vertices": vertices, "triangles": triangles, "clearance_mm": self.clearance,
                     "external": external, "frame": "object", "unit": "m", "warnings": warnings }),
            format!("wrote {}: {triangles} triangles, metres, y up", self.out.display()),
        )
    }
}

/// Make random models that can be built and stand
#[derive(Debug, Args)]
pub struct Random {
    /// Bricks of each model; 0 draws a number between 25 and 150 for each
    #[arg(long, value_name = "N", default_value_t = 0)]
    bricks: usize,

    /// How many models
    #[arg(long, value_name = "N", default_value_t = 1)]
    count: usize,

    /// TOML file with brick types, colours, shapes and size limits
    #[arg(long, value_name = "FILE")]
    profile: Option<PathBuf>,

    /// A file for one model, a folder for more
    #[arg(short, long, value_name = "FILE.ldr|DIR")]
    out: PathBuf,

    /// Also draw all models into one picture
    #[arg(long, value_name = "FILE.png")]
    contact_sheet: Option<PathBuf>,

    #[command(flatten)]
    seed: Seed,
}

impl Random {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        let profile = self.profile.as_ref().map_or_else(|| Ok(RandomProfile::default()), RandomProfile::read)?;
        let options = RandomOptions { bricks: self.bricks, seed: self.seed.seed, profile };
        let models = random_models(&options, self.count, terminal)?;
        let one_file = self.count == 1 && self.out.extension().is_some();
        let mut text = String::new();
        for RandomModel { model, summary, .. } in &models {
            let path =
                if one_file { self.out.clone() } else { self.out.join(format!("random_{:03}.ldr", summary.index)) };
            model.write_ldraw(&path)?;
            let [x, y, z] = summary.size_mm;
            let style = serde_json::to_value(summary.style).unwrap_or_default();
            text += &format!(
                "{}: {}, {} bricks, {x:.0} x {y:.0} x {z:.0} mm, {:.0} % overhang\n",
                path.display(),
                style.as_str().unwrap_or("model"),
                summary.parts,
                100.0 * summary.overhang
            );
        }
        if let Some(path) = &self.contact_sheet {
            let meshes: Vec<_> = models.iter().map(|random| random.model.mesh(&MeshOptions::default())).collect();
            mb_image::write_rgb_png(path, &mb_pipeline::contact_sheet(&meshes, terminal)?)?;
            text += &format!("wrote {}\n", path.display());
        }
        let summaries: Vec<_> = models.iter().map(|m| &m.summary).collect();
        let batch = BatchSummary::of(&models);
        if let Some(alike) = batch.most_alike {
            text += &format!(
                "{} models, no two alike: the closest two ({} and {}) share {:.0} % of their cells\n",
                batch.models,
                alike.a,
                alike.b,
                100.0 * alike.shared
            );
        }
        let document = json!({ "seed": self.seed.seed, "models": summaries, "batch": batch,
                               "contact_sheet": self.contact_sheet });
        Outcome::new(&document, text)
    }
}

/// Collisions, connections, stability and a build order
#[derive(Debug, Args)]
pub struct Check {
    #[command(flatten)]
    model: ModelArgument,
}

impl Check {
    fn run(&self) -> Result<Outcome> {
        let report = self.model.read()?.check(&Default::default())?;
        let text = describe(&report);
        Outcome::new(&report, text)
    }
}

/// The report in a few lines.
fn describe(report: &CheckReport) -> String {
    let answer = |fact: Option<bool>, yes, no, unknown| match fact {
        Some(true) => yes,
        Some(false) => no,
        None => unknown,
    };
    let joints = report.joints;
    let mut text = format!(
        "{} parts, joints known of {}: {} studs, {} bars and fingers, {} pins, {} balls, {} others\n",
        report.parts, report.covered_parts, report.connections, joints.bars, joints.pins, joints.balls, joints.others
    );
    text += &format!(
        "{}, {}, {}, {} collisions, {} overlaps that may be joints\n",
        if report.connected { "connected" } else { "not connected" },
        answer(report.stable, "stands", "does not stand", "whether it stands cannot be said"),
        answer(
            report.buildable,
            "can be built brick by brick",
            "cannot be built",
            "whether it can be built brick by brick cannot be said"
        ),
        report.collisions.len(),
        report.unclear_overlaps.len()
    );
    for collision in report.collisions.iter().take(SHOWN) {
        text += &format!("collision: bricks {} and {}, {:.2} mm deep\n", collision.a, collision.b, collision.depth_mm);
    }
    if let Some(weakest) = &report.weakest {
        text += &format!(
            "weakest: {} studs between bricks {} and {} bear {:.0} % of their clutch force\n",
            weakest.studs,
            weakest.stud_brick,
            weakest.grip_brick,
            100.0 * weakest.load
        );
    }
    for part in report.uncovered.iter().take(SHOWN) {
        text += &format!("joints unknown: {} x {} {}\n", part.count, part.part, part.description);
    }
    for note in &report.notes {
        text += &format!("{note}\n");
    }
    text
}

/// Building instructions: a PDF or an HTML page, and lists for buying the parts
#[derive(Debug, Args)]
pub struct Instructions {
    #[command(flatten)]
    model: ModelArgument,

    /// Output; the ending chooses the form: a PDF (A4, landscape), or one HTML page that needs no other file
    #[arg(short, long, value_name = "FILE.pdf|FILE.html")]
    out: PathBuf,

    /// Also write the parts list as CSV
    #[arg(long, value_name = "FILE.csv")]
    shopping_list: Option<PathBuf>,

    /// Also write the parts list as a wanted list that BrickLink imports
    #[arg(long, value_name = "FILE.xml")]
    wanted_list: Option<PathBuf>,
}

impl Instructions {
    fn run(&self, terminal: &Terminal) -> Result<Outcome> {
        Form::of(&self.out)?;
        let outputs: Vec<&PathBuf> =
            [Some(&self.out), self.shopping_list.as_ref(), self.wanted_list.as_ref()].into_iter().flatten().collect();
        // One file may be written in several ways.
        let places: Vec<PathBuf> = outputs.iter().map(|path| place(path)).collect();
        if let Some(twice) = (1..places.len()).find(|&i| places[..i].contains(&places[i])) {
            return Err(InputError::new(outputs[twice], "two outputs are this file")
                .help("Give the booklet and each list a file of its own")
                .into());
        }
        if let Some(own) = places.iter().position(|path| *path == place(&self.model.model)) {
            return Err(InputError::new(outputs[own], "this output is the model itself")
                .help("Give it another name: the model would be overwritten")
                .into());
        }
        let model = self.model.read()?;
        let plan = Plan::of(&model);
        // The lists take no time: what keeps them from being written is known before the drawing begins.
        if let Some(path) = &self.shopping_list {
            mb_job::write_atomic(path, mb_instructions::shopping_list(&model, &plan).as_bytes())?;
        }
        if let Some(path) = &self.wanted_list {
            mb_job::write_atomic(path, mb_instructions::wanted_list(&model, &plan).as_bytes())?;
        }
        let summary = mb_instructions::write_booklet(&model, &plan, &self.out, terminal)?;
        let mut text = format!(
            "wrote {}: {} pages, {} steps, {} submodels, {} parts\n",
            self.out.display(),
            summary.pages,
            summary.steps,
            summary.submodels,
            summary.parts
        );
        for path in &outputs[1..] {
            text += &format!("wrote {}\n", path.display());
        }
        let mut document = serde_json::to_value(&summary)
            .map_err(|e| Error::Failed(format!("the result is no JSON document: {e}")))?;
        document["file"] = json!(self.out);
        document["shopping_list"] = json!(self.shopping_list);
        document["wanted_list"] = json!(self.wanted_list);
        if self.shopping_list.is_some() || self.wanted_list.is_some() {
            let notes = mb_instructions::list_notes(&model, &plan);
            for color in &notes.unmapped_colors {
                text += &format!("no BrickLink colour is known for {color}\n");
            }
            if !notes.missing_parts.is_empty() {
                text += &format!("listed, but in no step: {}\n", notes.missing_parts.join(", "));
            }
            if !notes.uncertain_parts.is_empty() {
                text += &format!("look up at BrickLink: {}\n", notes.uncertain_parts.join(", "));
            }
            document["unmapped_colors"] = json!(notes.unmapped_colors);
            document["uncertain_parts"] = json!(notes.uncertain_parts);
            document["missing_part_names"] = json!(notes.missing_parts);
        }
        Outcome::new(&document, text)
    }
}

/// Where a path leads, whatever its spelling; the file need not be there yet.
fn place(path: &Path) -> PathBuf {
    let absolute = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    // The deepest folder that is there decides about links and `..`; what is missing below it has none.
    let known = absolute.ancestors().find_map(|folder| Some((folder, folder.canonicalize().ok()?)));
    let Some((folder, canonical)) = known else { return absolute };
    let rest = absolute.strip_prefix(folder).unwrap_or(Path::new(""));
    rest.components().fold(canonical, |mut place, part| {
        match part {
            std::path::Component::ParentDir => drop(place.pop()),
            part => place.push(part),
        }
        place
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_one_place_however_it_is_spelled() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        std::fs::create_dir(root.join("sub")).unwrap();
        let same = |a: &str, b: &str| place(&root.join(a)) == place(&root.join(b));
        assert!(same("a.pdf", "./a.pdf") && same("a.pdf", "sub/../a.pdf") && same("new/a.pdf", "new/b/../a.pdf"));
        assert!(!same("a.pdf", "sub/a.pdf") && !same("a.pdf", "b.pdf"));
        std::fs::write(root.join("a.pdf"), "x").unwrap();
        assert!(same("a.pdf", "sub/../a.pdf"));
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(root.join("sub"), root.join("link")).unwrap();
            assert!(same("link/b.pdf", "sub/b.pdf"));
        }
    }
}
