//! Errors for people.

use std::fmt;
use std::path::{Path, PathBuf};

/// The result of anything that reads input or writes output.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why a job did not finish.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The input is at fault (exit status 3).
    #[error(transparent)]
    Input(#[from] InputError),
    /// An output could not be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The person asked for a stop; finished pieces are kept.
    #[error("stopped as asked")]
    Stopped,
    /// The input was readable, but the computation has no answer; the sentence says why and what to do.
    #[error("{0}")]
    Failed(String),
}

impl Error {
    /// [`Error::Input`] from its parts.
    pub fn input(path: impl Into<PathBuf>, found: impl Into<String>) -> Self {
        InputError::new(path, found).into()
    }

    /// [`Error::Write`] from its parts.
    pub fn write(path: impl AsRef<Path>, source: std::io::Error) -> Self {
        Self::Write { path: path.as_ref().to_owned(), source }
    }
}

/// Bad input: where it is, what was found, and what to do about it.
///
/// Displays as `FILE: PLACE: FOUND. HELP`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputError {
    /// The file or folder.
    pub path: PathBuf,
    /// Line, frame, element or entry inside it, such as `line 12` or `frame 000003`.
    pub place: Option<String>,
    /// What was found, as a clause without a final full stop.
    pub found: String,
    /// What to do, as a sentence without a final full stop.
    pub help: Option<String>,
}

impl InputError {
    /// Something wrong with the file as a whole.
    pub fn new(path: impl Into<PathBuf>, found: impl Into<String>) -> Self {
        Self { path: path.into(), place: None, found: found.into(), help: None }
    }

    /// A file that cannot be opened or read.
    pub fn unreadable(path: impl Into<PathBuf>, source: &std::io::Error) -> Self {
        let found = match source.kind() {
            std::io::ErrorKind::NotFound => "no such file or folder".to_owned(),
            std::io::ErrorKind::UnexpectedEof => "the file ends too early; it is truncated".to_owned(),
            _ => source.to_string(),
        };
        Self::new(path, found)
    }

    /// Names the place inside the file.
    #[must_use]
    pub fn at(mut self, place: impl Into<String>) -> Self {
        self.place = Some(place.into());
        self
    }

    /// Names a line, counted from 1.
    #[must_use]
    pub fn at_line(self, line: usize) -> Self {
        self.at(format!("line {line}"))
    }

    /// Says what to do.
    #[must_use]
    pub fn help(mut self, help: impl Into<String>) -> Self {
        self.help = Some(help.into());
        self
    }
}

impl fmt::Display for InputError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: ", self.path.display())?;
        if let Some(place) = &self.place {
            write!(f, "{place}: ")?;
        }
        f.write_str(&self.found)?;
        if let Some(help) = &self.help {
            write!(f, ". {help}")?;
        }
        Ok(())
    }
}

impl std::error::Error for InputError {}
