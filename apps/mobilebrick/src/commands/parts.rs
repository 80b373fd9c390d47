//! Where the official parts library is, and how it gets there.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};
use mb_bricks::PartLibrary;
use mb_job::{Error, InputError, Result};
use serde_json::json;

use crate::outcome::Outcome;

/// The library to resolve parts in.
#[derive(Debug, Args)]
pub struct PartsArgument {
    /// Parts library: an LDraw folder or its zip, or `built-in` for no library. Default: $LDRAWDIR, then the installed
    /// one, then built-in bricks
    #[arg(long, value_name = "PATH")]
    parts: Option<PathBuf>,
}

/// What `--parts` says where the bricks that need no library are wanted, whatever library there is.
const BUILT_IN: &str = "built-in";
/// What to do where no library is used.
pub(super) const NO_LIBRARY: &str = "no library: built-in bricks only (`model parts list` names them). Give one with --parts, LDRAWDIR or \
                                     `model parts install`";

impl PartsArgument {
    /// Whether there is a library to open.
    pub fn has_library(&self) -> bool {
        locate(self.parts.as_deref()).is_some()
    }

    /// Opens the library, or `None` where there is none and built-in bricks must do.
    pub fn open(&self) -> Result<Option<PartLibrary>> {
        locate(self.parts.as_deref()).map(|(path, _)| PartLibrary::open(path)).transpose()
    }
}

/// The library's path and which rule found it.
fn locate(given: Option<&Path>) -> Option<(PathBuf, &'static str)> {
    if let Some(path) = given {
        return (path != Path::new(BUILT_IN)).then(|| (path.to_owned(), "--parts"));
    }
    if let Some(path) = std::env::var_os("LDRAWDIR").filter(|v| !v.is_empty()) {
        return Some((path.into(), "LDRAWDIR"));
    }
    installed_path().ok().filter(|path| path.exists()).map(|path| (path, "installed"))
}

/// Where `model parts install` puts the library: the user's data folder.
fn installed_path() -> Result<PathBuf> {
    let base = std::env::var_os("XDG_DATA_HOME")
        .filter(|v| !v.is_empty())
        .map(PathBuf::from)
        .or_else(|| Some(std::env::home_dir()?.join(".local/share")))
        .ok_or_else(|| Error::Failed("no home folder; set XDG_DATA_HOME, or name the library with --parts".into()))?;
    Ok(base.join("mobilebrick/ldraw.zip"))
}

/// The official parts library (a folder or its zip)
#[derive(Debug, Subcommand)]
pub enum Parts {
    /// Keep a copy of the library's zip (such as complete.zip from ldraw.org) where every run finds it
    Install {
        /// The zip
        #[arg(value_name = "ZIP")]
        source: PathBuf,
    },
    /// Open the library and count what is in it
    Verify(PartsArgument),
    /// Say which library is used, and why
    Where(PartsArgument),
    /// The bricks that are drawn without a library
    List,
}

impl Parts {
    /// Runs the subcommand.
    pub fn run(self) -> Result<Outcome> {
        match self {
            Self::Install { source } => install(&source),
            Self::Verify(argument) => verify(argument.parts.as_deref()),
            Self::Where(argument) => where_is(argument.parts.as_deref()),
            Self::List => list(),
        }
    }
}

fn install(source: &Path) -> Result<Outcome> {
    if source.is_dir() {
        return Err(InputError::new(source, "a folder")
            .help("A folder needs no installation: set LDRAWDIR to it, or give it with --parts")
            .into());
    }
    let parts = PartLibrary::open(source)?.part_names().len();
    let target = installed_path()?;
    let bytes = std::fs::read(source).map_err(|e| InputError::unreadable(source, &e))?;
    mb_job::write_atomic(&target, &bytes)?;
    Outcome::new(&json!({ "path": target, "parts": parts }), format!("installed {parts} parts as {}", target.display()))
}

fn verify(given: Option<&Path>) -> Result<Outcome> {
    let Some((path, rule)) = locate(given) else { return where_is(given) };
    let library = PartLibrary::open(&path)?;
    let (parts, colors) = (library.part_names().len(), library.colors().iter().count());
    Outcome::new(
        &json!({ "path": path, "found_by": rule, "parts": parts, "colors": colors }),
        format!("{} ({rule}): {parts} parts, {colors} colours", path.display()),
    )
}

fn where_is(given: Option<&Path>) -> Result<Outcome> {
    let found = locate(given);
    let text = match &found {
        Some((path, rule)) => format!("{} ({rule})", path.display()),
        None => NO_LIBRARY.to_owned(),
    };
    let (path, rule) = found.unzip();
    Outcome::new(&json!({ "path": path, "found_by": rule }), text)
}

fn list() -> Result<Outcome> {
    let bricks: Vec<_> = mb_bricks::drawable_parts().collect();
    let text: String = bricks.iter().map(|(number, title)| format!("{number:<8} {title}\n")).collect();
    let bricks: Vec<_> = bricks.iter().map(|(part, title)| json!({ "part": part, "description": title })).collect();
    Outcome::new(&json!({ "built_in": bricks }), text)
}
