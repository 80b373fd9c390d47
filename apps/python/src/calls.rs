//! How the library is called: errors, documents, and a Ctrl-C that works.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use mb_job::{Error, Progress};
use pyo3::exceptions::{PyKeyboardInterrupt, PyOSError, PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use serde::Serialize;

pyo3::create_exception!(mobilebrick, InputError, PyValueError, "Bad input: what was found, where, and what to do.");

/// The Python exception with the same sentence.
pub fn exception(error: Error) -> PyErr {
    let sentence = error.to_string();
    match error {
        Error::Input(_) => InputError::new_err(sentence),
        Error::Write { .. } => PyOSError::new_err(sentence),
        Error::Stopped => PyKeyboardInterrupt::new_err(sentence),
        Error::Failed(_) => PyRuntimeError::new_err(sentence),
    }
}

/// How often a running job looks whether the person pressed Ctrl-C.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);

/// A job's ear for the wish to stop; nobody watches its progress.
struct Stop<'a>(&'a AtomicBool);

impl Progress for Stop<'_> {
    fn report(&self, _what: &str, _done: usize, _total: usize) {}

    fn stop_requested(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Runs a job in another thread with the interpreter released. Python delivers signals to its main thread alone, so
/// that one stays behind and listens; after Ctrl-C the job ends at its next step.
pub fn run<T: Send>(py: Python<'_>, job: impl FnOnce(&dyn Progress) -> mb_job::Result<T> + Send) -> PyResult<T> {
    let stop = AtomicBool::new(false);
    let mut interrupt = None;
    let outcome = std::thread::scope(|scope| {
        let (done, finished) = channel();
        let stop = &stop;
        let worker = scope.spawn(move || {
            let outcome = job(&Stop(stop));
            // The listener waits until the sender is dropped, so a panic wakes it too.
            let _ = done.send(());
            outcome
        });
        let mut finished = finished;
        loop {
            let (event, receiver) = py.detach(move || (finished.recv_timeout(SIGNAL_INTERVAL), finished));
            finished = receiver;
            if event != Err(RecvTimeoutError::Timeout) {
                break;
            }
            if interrupt.is_none()
                && let Err(signal) = py.check_signals()
            {
                stop.store(true, Ordering::Relaxed);
                interrupt = Some(signal);
            }
        }
        worker.join()
    });
    if let Some(interrupt) = interrupt {
        return Err(interrupt);
    }
    match outcome {
        Ok(outcome) => outcome.map_err(exception),
        Err(panic) => std::panic::resume_unwind(panic),
    }
}

/// A document as plain Python values.
pub fn document<'py>(py: Python<'py>, value: &impl Serialize) -> PyResult<Bound<'py, PyAny>> {
    let text = serde_json::to_string(value).map_err(|e| PyRuntimeError::new_err(e.to_string()))?;
    py.import("json")?.call_method1("loads", (text,))
}
