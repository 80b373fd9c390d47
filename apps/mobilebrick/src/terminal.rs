//! Progress bars with time left, Ctrl-C, and the log.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use mb_job::Progress;

static STOP: AtomicBool = AtomicBool::new(false);

/// Sends log lines to stderr: warnings by default, more with `-v`, errors alone with `-q`.
pub fn start_logging(verbose: u8, quiet: bool) {
    let level = match (quiet, verbose) {
        (true, _) => "error",
        (_, 0) => "warn",
        (_, 1) => "info",
        (_, 2) => "debug",
        _ => "trace",
    };
    let filter = tracing_subscriber::EnvFilter::try_from_env("MOBILEBRICK_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(level));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
}

/// The person at the terminal.
pub struct Terminal {
    bars: MultiProgress,
    stages: Mutex<BTreeMap<String, Stage>>,
    quiet: bool,
}

struct Stage {
    bar: ProgressBar,
    /// For terminals without bars: when this stage was last mentioned in a line.
    last_line: Instant,
}

impl Terminal {
    /// Watches for Ctrl-C: the first asks jobs to stop at the next whole step, the second ends the program.
    pub fn new(quiet: bool) -> Self {
        // Without a handler Ctrl-C still ends the program, and outputs are atomic: nothing to tell.
        let _ = ctrlc::set_handler(|| {
            if STOP.swap(true, Ordering::Relaxed) {
                std::process::exit(130);
            }
            eprintln!("stopping at the next whole step; press Ctrl-C again to stop at once");
        });
        let target = if quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr_with_hz(8) };
        Self { bars: MultiProgress::with_draw_target(target), stages: Mutex::default(), quiet }
    }

    /// Removes the bars.
    pub fn finish(&self) {
        let _ = self.bars.clear();
    }
}

impl Progress for Terminal {
    fn report(&self, what: &str, done: usize, total: usize) {
        let mut stages = self.stages.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let stage = stages.entry(what.to_owned()).or_insert_with(|| {
            let style = ProgressStyle::with_template("{msg:28} {wide_bar} {pos}/{len} {elapsed} left {eta}")
                .unwrap_or_else(|_| ProgressStyle::default_bar());
            let bar = self.bars.add(ProgressBar::new(total as u64).with_style(style).with_message(what.to_owned()));
            // What an earlier run did took no time of this one.
            bar.set_position(done as u64);
            bar.reset_eta();
            Stage { bar, last_line: Instant::now() }
        });
        stage.bar.set_length(total as u64);
        stage.bar.set_position(done as u64);
        // A log file has no bars: one line every ten seconds instead.
        if self.bars.is_hidden() && !self.quiet && stage.last_line.elapsed() > Duration::from_secs(10) {
            stage.last_line = Instant::now();
            let left = HumanDuration(stage.bar.eta());
            eprintln!("{}: {done} of {total}, about {left} left", stage.bar.message());
        }
        if done >= total {
            stage.bar.finish_and_clear();
            stages.remove(what);
        }
    }

    fn note(&self, what: &str, note: &str) {
        let stages = self.stages.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(stage) = stages.get(what) {
            stage.bar.set_message(format!("{what}: {note}"));
        }
    }

    fn stop_requested(&self) -> bool {
        STOP.load(Ordering::Relaxed)
    }
}
