//! Finds every file that a model refers to, and refuses what could not be drawn in bounded time and memory.

use std::collections::{HashMap, HashSet};
use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};

use super::archive::looks_like_zip;
use super::colors::{ColorCode, ColorTable};
use super::file::{FileId, FileKind, LdrawFile, normalized_name};
use super::library::{PartLibrary, read_bounded};
use super::parse::{Document, parse};
use super::studio;
use super::warnings::Warnings;
use crate::parametric;

/// No model file may be larger. The largest published ones are 30 MB.
const MAX_MODEL_BYTES: u64 = 512 << 20;
/// References may nest so deep; real models reach about 15.
const MAX_DEPTH: usize = 200;
/// Flat triangles of a model; the largest published models have about 20 million.
const MAX_TRIANGLES: u64 = 50_000_000;
/// Parts and submodels of a model.
const MAX_INSTANCES: u64 = 2_000_000;
/// Placed files of any kind.
const MAX_PIECES: u64 = 50_000_000;

/// A reference to a file that is nowhere; once for each use of the submodel that holds the line.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct MissingPart {
    /// The name that was looked for.
    pub name: String,
    /// The text file that refers to it.
    pub file: String,
    /// The line there, counted from 1.
    pub line: u32,
}

/// Everything that a model needs, resolved.
pub(crate) struct Loaded {
    pub files: Vec<LdrawFile>,
    /// Files in the order in which they were first needed, beginning with the root.
    pub reachable: Vec<FileId>,
    pub colors: ColorTable,
    /// Files and the indices of those of their references that lead nowhere.
    pub missing: Vec<(FileId, usize)>,
    pub warnings: Vec<String>,
}

/// Loads the model at `path`. The root is file 0.
pub(crate) fn load(path: &Path, library: Option<&PartLibrary>, prefer_parametric: bool) -> Result<Loaded> {
    let mut gathering = Gathering::new(library, prefer_parametric);
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    if looks_like_zip(path) {
        let studio = studio::read(path)?;
        gathering.add_document(&studio.model, &studio.source, "model.ldr", Some(FileKind::Model))?;
        for (part, bytes, source) in &studio.custom_parts {
            gathering.add_document(bytes, source, part, Some(FileKind::Part))?;
        }
    } else {
        let bytes = read_bounded(path, MAX_MODEL_BYTES)?;
        gathering.siblings = Siblings::beside(path);
        gathering.add_document(&bytes, &path.display().to_string(), &name, None)?;
    }
    if gathering.useful_lines == 0 {
        return Err(InputError::new(path, "it holds no part, submodel or polygon")
            .help("An LDraw model has lines such as `1 4 0 0 0 1 0 0 0 1 0 0 0 1 3001.dat`")
            .into());
    }
    gathering.resolve()
}

/// Loads a model from text in memory; nothing beside it is looked at.
pub(crate) fn load_text(text: &str, name: &str, library: Option<&PartLibrary>) -> Result<Loaded> {
    let mut gathering = Gathering::new(library, false);
    gathering.add_document(text.as_bytes(), name, name, None)?;
    gathering.resolve()
}

struct Gathering<'a> {
    library: Option<&'a PartLibrary>,
    prefer_parametric: bool,
    siblings: Siblings,
    files: Vec<LdrawFile>,
    id_of_name: HashMap<String, FileId>,
    nowhere: HashSet<String>,
    colors: ColorTable,
    useful_lines: usize,
    warnings: Warnings,
}

impl MissingPart {
    /// What the `index`-th reference of `file` leads to, which is nothing.
    pub(crate) fn of(file: &LdrawFile, index: usize) -> Self {
        let reference = &file.references[index];
        Self { name: reference.name.clone(), file: file.source.clone(), line: reference.line }
    }
}

impl<'a> Gathering<'a> {
    fn new(library: Option<&'a PartLibrary>, prefer_parametric: bool) -> Self {
        Self {
            library,
            prefer_parametric,
            siblings: Siblings::default(),
            files: vec![],
            id_of_name: HashMap::new(),
            nowhere: HashSet::new(),
            colors: library.map_or_else(ColorTable::builtin, PartLibrary::colors),
            useful_lines: 0,
            warnings: Warnings::default(),
        }
    }

    fn add_document(&mut self, bytes: &[u8], source: &str, name: &str, kind: Option<FileKind>) -> Result<()> {
        let Document { files, colors, useful_lines } = parse(bytes, source, name, kind, &mut self.warnings)?;
        self.useful_lines += useful_lines;
        colors.into_iter().for_each(|color| self.colors.define(color));
        for file in files {
            self.add_file(file);
        }
        Ok(())
    }

    fn add_file(&mut self, file: LdrawFile) {
        if self.id_of_name.contains_key(&file.name) {
            let message = format!("{}: `{}` is defined twice; the first one counts", file.source, file.name);
            self.warnings.add("file defined twice", message);
            return;
        }
        self.id_of_name.insert(file.name.clone(), FileId(self.files.len() as u32));
        self.files.push(file);
    }

    /// The file of that name: inside the model, in the library, beside the model, or drawn by ourselves.
    fn find(&mut self, name: &str) -> Result<Option<FileId>> {
        if let Some(&id) = self.id_of_name.get(name) {
            return Ok(Some(id));
        }
        if self.nowhere.contains(name) {
            return Ok(None);
        }
        let drawn = if self.prefer_parametric { parametric::part_file(name) } else { None };
        if let Some(file) = drawn {
            self.add_file(file);
        } else if let Some(text) = self.library.map_or(Ok(None), |library| library.read(name))? {
            self.add_document(&text.bytes, &text.source, name, Some(text.kind))?;
        } else if let Some(path) = self.siblings.find(name) {
            let bytes = read_bounded(&path, MAX_MODEL_BYTES)?;
            self.add_sibling(&bytes, &path, name)?;
        } else if let Some(file) = parametric::part_file(name) {
            self.add_file(file);
        }
        let id = self.id_of_name.get(name).copied();
        if id.is_none() {
            self.nowhere.insert(name.to_owned());
        }
        Ok(id)
    }

    /// A file beside the model. Where it is an MPD, its first file goes by the name of the file.
    fn add_sibling(&mut self, bytes: &[u8], path: &Path, name: &str) -> Result<()> {
        let source = path.display().to_string();
        let mut document = parse(bytes, &source, name, None, &mut self.warnings)?;
        document.colors.into_iter().for_each(|color| self.colors.define(color));
        if let Some(first) = document.files.first_mut() {
            name.clone_into(&mut first.name);
        }
        document.files.into_iter().for_each(|file| self.add_file(file));
        Ok(())
    }

    fn resolve(mut self) -> Result<Loaded> {
        let mut reachable = vec![FileId(0)];
        let mut seen = HashSet::from([FileId(0)]);
        let mut missing = vec![];
        let mut next = 0;
        while let Some(&id) = reachable.get(next) {
            next += 1;
            self.check_placements(id)?;
            for index in 0..self.files[id.index()].references.len() {
                let name = self.files[id.index()].references[index].name.clone();
                let target = self.find(&name)?;
                self.files[id.index()].references[index].target = target;
                match target {
                    Some(target) if seen.insert(target) => reachable.push(target),
                    Some(_) => {}
                    None => missing.push((id, index)),
                }
            }
        }
        let order = children_first(&self.files)?;
        check_size(&self.files, &order)?;
        self.say_what_is_odd(&reachable);
        self.describe_moved_parts(&order);
        let Self { files, colors, warnings, .. } = self;
        Ok(Loaded { files, reachable, colors, missing, warnings: warnings.finish() })
    }

    /// A flattened or vanishing brick in a model is a damaged line, not a brick.
    fn check_placements(&self, id: FileId) -> Result<()> {
        let file = &self.files[id.index()];
        if file.kind != FileKind::Model {
            return Ok(());
        }
        for reference in &file.references {
            let linear = &reference.parent_from_child.linear;
            let volume: f64 = linear.row_iter().map(|row| row.norm()).product();
            if linear.determinant().abs() <= 1e-9 * volume {
                let found = format!("the matrix of `{}` is singular: it flattens the part", reference.name);
                return Err(InputError::new(&file.source, found)
                    .at_line(reference.line as usize)
                    .help("Mend the nine numbers after the position")
                    .into());
            }
        }
        Ok(())
    }

    /// A part that moved is called what it is, not where it went. `order` has children first, so chains of moves resolve.
    fn describe_moved_parts(&mut self, order: &[FileId]) {
        for &id in order {
            let file = &self.files[id.index()];
            if file.moved_to.is_some()
                && let Some(target) = file.references.iter().find_map(|reference| reference.target)
            {
                self.files[id.index()].description = self.files[target.index()].description.clone();
            }
        }
    }

    fn say_what_is_odd(&mut self, reachable: &[FileId]) {
        let mut said = HashSet::new();
        for &id in reachable {
            let file = &self.files[id.index()];
            for reference in &file.references {
                let place = || format!("{}: line {}", file.source, reference.line);
                if let Some(target) = reference.target
                    && file.kind == FileKind::Model
                    && let Some(moved_to) = &self.files[target.index()].moved_to
                    && said.insert((0, target.0))
                {
                    let message =
                        format!("{}: {} has moved to {moved_to}; the new part is drawn", place(), reference.name);
                    self.warnings.add("moved part", message);
                }
                let code = reference.color;
                if !is_known(&self.colors, code) && said.insert((1, code.0)) {
                    let message = format!("{}: colour {code} is in no table; it is drawn in magenta", place());
                    self.warnings.add("unknown colour", message);
                }
            }
            for face in &file.faces {
                if !is_known(&self.colors, face.color) && said.insert((1, face.color.0)) {
                    let message = format!(
                        "{}: {}: colour {} is in no table; it is drawn in magenta",
                        file.source, file.name, face.color
                    );
                    self.warnings.add("unknown colour", message);
                }
            }
        }
    }
}

fn is_known(colors: &ColorTable, code: ColorCode) -> bool {
    code == ColorCode::INHERIT || code == ColorCode::EDGE || colors.get(code).is_some()
}

/// The files below file 0, each after all that it refers to.
fn children_first(files: &[LdrawFile]) -> Result<Vec<FileId>> {
    #[derive(Clone, Copy, PartialEq)]
    enum Mark {
        New,
        Open,
        Done,
    }
    let mut mark = vec![Mark::New; files.len()];
    let mut order = vec![];
    // The path from the root: file and the next reference to follow. A loop, as recursion could exhaust the stack.
    let mut path = vec![(0_usize, 0_usize)];
    mark[0] = Mark::Open;
    while let Some(top) = path.last_mut() {
        let (file, index) = *top;
        top.1 += 1;
        let Some(reference) = files[file].references.get(index) else {
            mark[file] = Mark::Done;
            order.push(FileId(file as u32));
            path.pop();
            continue;
        };
        let Some(target) = reference.target.map(FileId::index) else { continue };
        let bad = |found: String| InputError::new(&files[file].source, found).at_line(reference.line as usize);
        match mark[target] {
            Mark::New => {
                mark[target] = Mark::Open;
                path.push((target, 0));
            }
            Mark::Open => {
                let start = path.iter().position(|&(f, _)| f == target).unwrap_or(0);
                let ring: Vec<&str> = path[start..].iter().take(6).map(|&(f, _)| files[f].name.as_str()).collect();
                let found = if ring.len() == 1 {
                    format!("`{}` refers to itself", reference.name)
                } else {
                    format!("`{}` contains itself ({} -> ...)", reference.name, ring.join(" -> "))
                };
                return Err(bad(found).help("Remove one of the references in the ring").into());
            }
            Mark::Done => {}
        }
    }
    Ok(order)
}

/// What a file amounts to when all that it refers to is put in its place.
#[derive(Clone, Copy, Default)]
struct Extent {
    depth: usize,
    triangles: u64,
    /// Parts and submodels.
    instances: u64,
    /// Files of any kind, pieces of parts included.
    pieces: u64,
}

/// Refuses a model whose flat form would not fit: a few lines can ask for 2^200 bricks.
fn check_size(files: &[LdrawFile], children_first: &[FileId]) -> Result<()> {
    let mut extents = vec![Extent::default(); files.len()];
    for id in children_first {
        let file = &files[id.index()];
        let mut sum = Extent { depth: 1, triangles: file.faces.len() as u64, ..Extent::default() };
        for reference in &file.references {
            let inner = reference.target.map_or_else(Extent::default, |target| extents[target.index()]);
            sum.depth = sum.depth.max(inner.depth + 1);
            sum.triangles = sum.triangles.saturating_add(inner.triangles);
            sum.pieces = sum.pieces.saturating_add(inner.pieces).saturating_add(1);
            if file.kind == FileKind::Model {
                sum.instances = sum.instances.saturating_add(inner.instances).saturating_add(1);
            }
            let bad = |found: String| InputError::new(&file.source, found).at_line(reference.line as usize);
            if sum.depth > MAX_DEPTH {
                let found = format!("with `{}` files refer to files more than {MAX_DEPTH} deep", reference.name);
                return Err(bad(found).help("Real models nest a dozen deep: the file is damaged or hostile").into());
            }
            if sum.triangles > MAX_TRIANGLES || sum.instances > MAX_INSTANCES || sum.pieces > MAX_PIECES {
                let found = format!(
                    "with `{}` the model passes {MAX_TRIANGLES} triangles or {MAX_INSTANCES} parts",
                    reference.name
                );
                return Err(bad(found).help("Split the model, or mend references that multiply").into());
            }
        }
        extents[id.index()] = sum;
    }
    Ok(())
}

/// Files beside the model, by normalised name.
#[derive(Default)]
struct Siblings(HashMap<String, PathBuf>);

impl Siblings {
    fn beside(path: &Path) -> Self {
        let folder = match path.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        let mut found = HashMap::new();
        for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
            let name = normalized_name(&entry.file_name().to_string_lossy());
            if name.ends_with(".ldr") || name.ends_with(".dat") || name.ends_with(".mpd") {
                found.insert(name, entry.path());
            }
        }
        Self(found)
    }

    fn find(&self, name: &str) -> Option<PathBuf> {
        self.0.get(name).filter(|path| path.is_file()).cloned()
    }
}
