//! Progress and the wish to stop.

use std::sync::atomic::{AtomicUsize, Ordering};

use crate::{Error, Result};

/// Someone who watches a job and may want it to stop. The command shows bars; tests and libraries pass [`Silent`].
pub trait Progress: Sync {
    /// `done` of `total` steps of the stage `what` are finished.
    fn report(&self, what: &str, done: usize, total: usize);

    /// How the stage `what` is doing, in a few words; the next note replaces it.
    fn note(&self, _what: &str, _note: &str) {}

    /// Whether the person asked for a stop.
    fn stop_requested(&self) -> bool;
}

/// Nobody watches and nobody stops.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Progress for Silent {
    fn report(&self, _what: &str, _done: usize, _total: usize) {}

    fn stop_requested(&self) -> bool {
        false
    }
}

/// Counts the steps of one stage, from any thread.
pub struct Steps<'a> {
    progress: &'a dyn Progress,
    what: &'a str,
    total: usize,
    done: AtomicUsize,
}

impl<'a> Steps<'a> {
    /// Announces a stage of `total` steps.
    pub fn new(progress: &'a dyn Progress, what: &'a str, total: usize) -> Self {
        progress.report(what, 0, total);
        Self { progress, what, total, done: AtomicUsize::new(0) }
    }

    /// Marks one more step as finished.
    ///
    /// # Errors
    /// [`Error::Stopped`] where the person asked for a stop.
    pub fn step(&self) -> Result<()> {
        let done = self.done.fetch_add(1, Ordering::Relaxed) + 1;
        self.progress.report(self.what, done, self.total);
        if self.progress.stop_requested() { Err(Error::Stopped) } else { Ok(()) }
    }
}
