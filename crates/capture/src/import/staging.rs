//! A folder that appears under its name when it is complete, or not at all.

use std::path::{Path, PathBuf};

use mb_job::{Error, InputError, Result};

/// A folder in the making, `NAME.partial` beside the one that it becomes. Dropped before [`Self::finish`] it is removed.
pub(super) struct Staging {
    partial: PathBuf,
    out: PathBuf,
    finished: bool,
}

impl Staging {
    /// Begins a folder. What a killed run left under the same name is removed.
    ///
    /// # Errors
    /// `out` is there and not empty, or nothing can be written beside it.
    pub fn new(out: &Path) -> Result<Self> {
        if out.exists() && !out.is_dir() {
            return Err(InputError::new(out, "is a file").help("Give a new folder").into());
        }
        if out.is_dir() && std::fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_some()) {
            return Err(InputError::new(out, "is not empty")
                .help("Give a new folder, so that nothing is overwritten")
                .into());
        }
        let out = std::path::absolute(out).map_err(|e| Error::write(out, e))?;
        let name = out.file_name().ok_or_else(|| InputError::new(&out, "is no folder that can be made"))?;
        let mut partial = name.to_owned();
        partial.push(".partial");
        let partial = out.with_file_name(partial);
        if partial.exists() {
            std::fs::remove_dir_all(&partial).map_err(|e| Error::write(&partial, e))?;
        }
        std::fs::create_dir_all(&partial).map_err(|e| Error::write(&partial, e))?;
        Ok(Self { partial, out, finished: false })
    }

    /// Where to write.
    pub fn path(&self) -> &Path {
        &self.partial
    }

    /// Gives the folder its name.
    pub fn finish(mut self) -> Result<()> {
        if self.out.is_dir() {
            std::fs::remove_dir(&self.out).map_err(|e| Error::write(&self.out, e))?;
        }
        std::fs::rename(&self.partial, &self.out).map_err(|e| Error::write(&self.out, e))?;
        self.finished = true;
        Ok(())
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        if !self.finished {
            let _ = std::fs::remove_dir_all(&self.partial);
        }
    }
}
