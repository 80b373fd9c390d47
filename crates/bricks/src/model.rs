//! A brick model: files, placed parts, steps.

use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};

use crate::ldraw::colors::{ColorCode, ColorTable};
use crate::ldraw::file::{Affine, FileId, FileKind, LdrawFile, Reference};
use crate::ldraw::library::PartLibrary;
use crate::ldraw::load::{self, Loaded, MissingPart};
use crate::ldraw::shape::PartShape;

/// One brick of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct PartInstance {
    /// Which part.
    pub part: FileId,
    /// Its colour; [`ColorCode::INHERIT`] where nothing gives it one.
    pub color: ColorCode,
    /// Placement in the whole model, LDraw units.
    pub ldraw_from_part: Affine,
    /// Whether an odd number of `INVERTNEXT` lies above it.
    pub inverted: bool,
    /// The submodel that holds it: index into [`Model::occurrences`].
    pub occurrence: usize,
    /// Index of its line in the references of that submodel's file.
    pub reference: usize,
}

/// A brick whose part is nowhere: only its line says anything about it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct MissingBrick {
    /// The name that was looked for.
    pub name: String,
    /// Its colour.
    pub color: ColorCode,
}

/// One use of a submodel; the first is the model itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Occurrence {
    /// Which file.
    pub file: FileId,
    /// The occurrence that holds it, and the index of its line in the references of that one's file.
    pub parent: Option<(usize, usize)>,
    /// Colour that its uncoloured parts take.
    pub color: ColorCode,
    /// Placement in the whole model, LDraw units.
    pub ldraw_from_file: Affine,
    /// Whether an odd number of `INVERTNEXT` lies above it.
    pub inverted: bool,
}

/// How to read a model.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ReadOptions {
    /// Draws bricks ourselves where we can, even with a parts library at hand: closed surfaces, no engraved text.
    pub prefer_parametric: bool,
}

/// A brick model with everything that it refers to.
#[derive(Debug, Clone)]
pub struct Model {
    path: PathBuf,
    files: Vec<LdrawFile>,
    reachable: Vec<FileId>,
    colors: ColorTable,
    missing: Vec<MissingPart>,
    missing_bricks: Vec<MissingBrick>,
    warnings: Vec<String>,
    occurrences: Vec<Occurrence>,
    instances: Vec<PartInstance>,
}

impl Model {
    /// Reads an LDraw model (.ldr, .mpd, .dat) or a Studio archive (.io). Parts are looked up inside the file, in the
    /// library, beside the file, and among the bricks that we draw ourselves. A part that is nowhere is listed in
    /// [`Model::missing`] and left out.
    ///
    /// # Errors
    /// `Error::Input` for what no model can be made of: no readable text, nothing in it, numbers that are not finite,
    /// files that contain themselves, sizes beyond reason, encrypted or malicious archives.
    pub fn read(path: impl AsRef<Path>, library: Option<&PartLibrary>) -> Result<Self> {
        Self::read_with(path, library, ReadOptions::default())
    }

    /// Like [`Model::read`], with options.
    ///
    /// # Errors
    /// As for [`Model::read`].
    pub fn read_with(path: impl AsRef<Path>, library: Option<&PartLibrary>, options: ReadOptions) -> Result<Self> {
        let path = path.as_ref();
        Self::assemble(path.to_owned(), load::load(path, library, options.prefer_parametric)?)
    }

    /// Reads a model from text; `name` stands for the file in messages.
    ///
    /// # Errors
    /// As for [`Model::read`].
    pub fn from_text(text: &str, name: &str, library: Option<&PartLibrary>) -> Result<Self> {
        Self::assemble(PathBuf::from(name), load::load_text(text, name, library)?)
    }

    fn assemble(path: PathBuf, loaded: Loaded) -> Result<Self> {
        let Loaded { files, reachable, colors, missing, warnings } = loaded;
        let mut placing =
            Placing { files: &files, occurrences: vec![], instances: vec![], missing: vec![], missing_bricks: vec![] };
        let root = Occurrence {
            file: FileId(0),
            parent: None,
            color: ColorCode::INHERIT,
            ldraw_from_file: Affine::identity(),
            inverted: false,
        };
        placing.submodel(root)?;
        let Placing { occurrences, instances, missing: mut missing_in_model, missing_bricks, .. } = placing;
        let in_parts = missing.into_iter().filter(|(file, _)| !occurrences.iter().any(|o| o.file == *file));
        missing_in_model.extend(in_parts.map(|(file, index)| MissingPart::of(&files[file.index()], index)));
        let missing = missing_in_model;
        Ok(Self { path, files, reachable, colors, missing, missing_bricks, warnings, occurrences, instances })
    }

    /// Where it was read.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// All files: the model itself first, then those found with it or in the library.
    pub fn files(&self) -> &[LdrawFile] {
        &self.files
    }

    /// One file.
    pub fn file(&self, id: FileId) -> &LdrawFile {
        &self.files[id.index()]
    }

    /// The model's own file.
    pub fn root(&self) -> FileId {
        FileId(0)
    }

    /// The files that the model uses, in the order of first need, beginning with its own.
    pub fn used_files(&self) -> &[FileId] {
        &self.reachable
    }

    /// What the colours look like.
    pub fn colors(&self) -> &ColorTable {
        &self.colors
    }

    /// References to files that are nowhere, in order.
    pub fn missing(&self) -> &[MissingPart] {
        &self.missing
    }

    /// The bricks that are left out because their parts are nowhere, every use of their submodels counted.
    pub fn missing_bricks(&self) -> &[MissingBrick] {
        &self.missing_bricks
    }

    /// What is odd about the files, for people.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// Every use of a submodel, in building order; the first is the model itself.
    pub fn occurrences(&self) -> &[Occurrence] {
        &self.occurrences
    }

    /// Every brick, in building order.
    pub fn instances(&self) -> &[PartInstance] {
        &self.instances
    }

    /// The line that places a brick; `None` where the model is itself a part.
    pub fn reference(&self, instance: &PartInstance) -> Option<&Reference> {
        let file = self.occurrences.get(instance.occurrence)?.file;
        self.file(file).references.get(instance.reference)
    }

    /// The surface of a part in its own frame.
    pub fn part_shape(&self, part: FileId) -> PartShape {
        PartShape::of(&self.files, part, true)
    }

    /// Refuses a model that lacks parts: what is made from it would lack them too.
    ///
    /// # Errors
    /// `Error::Input` naming the first missing part, its file and its line.
    pub fn require_complete(&self) -> Result<()> {
        let Some(first) = self.missing.first() else { return Ok(()) };
        let more = match self.missing.len() - 1 {
            0 => String::new(),
            more => format!(" (and {more} more references to missing files)"),
        };
        Err(InputError::new(&first.file, format!("the part `{}` is in no library{more}", first.name))
            .at_line(first.line as usize)
            .help("Give a parts library with --parts or LDRAWDIR, or put the file beside the model")
            .into())
    }
}

/// Walks the tree of submodels. Its depth was bounded at loading.
struct Placing<'a> {
    files: &'a [LdrawFile],
    occurrences: Vec<Occurrence>,
    instances: Vec<PartInstance>,
    missing: Vec<MissingPart>,
    missing_bricks: Vec<MissingBrick>,
}

impl Placing<'_> {
    fn submodel(&mut self, occurrence: Occurrence) -> Result<()> {
        let index = self.occurrences.len();
        let file = &self.files[occurrence.file.index()];
        self.occurrences.push(occurrence);
        if file.kind != FileKind::Model {
            // A part opened as a model.
            self.instances.push(PartInstance {
                part: occurrence.file,
                color: occurrence.color,
                ldraw_from_part: occurrence.ldraw_from_file,
                inverted: false,
                occurrence: index,
                reference: usize::MAX,
            });
            return Ok(());
        }
        for (reference_index, reference) in file.references.iter().enumerate() {
            let Some(target) = reference.target else {
                self.missing.push(MissingPart::of(file, reference_index));
                let color = reference.color.within(occurrence.color);
                self.missing_bricks.push(MissingBrick { name: reference.name.clone(), color });
                continue;
            };
            let placed = occurrence.ldraw_from_file.then_inner(&reference.parent_from_child);
            if !placed.is_finite() {
                return Err(InputError::new(&file.source, "the part ends up infinitely far away")
                    .at_line(reference.line as usize)
                    .help("Mend the numbers of this line or of the lines that place this submodel")
                    .into());
            }
            let color = reference.color.within(occurrence.color);
            let inverted = occurrence.inverted ^ reference.inverted;
            if self.files[target.index()].kind == FileKind::Model {
                let parent = Some((index, reference_index));
                self.submodel(Occurrence { file: target, parent, color, ldraw_from_file: placed, inverted })?;
            } else {
                self.instances.push(PartInstance {
                    part: target,
                    color,
                    ldraw_from_part: placed,
                    inverted,
                    occurrence: index,
                    reference: reference_index,
                });
            }
        }
        Ok(())
    }
}
