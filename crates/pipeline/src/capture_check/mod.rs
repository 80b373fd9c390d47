//! `capture check`: what the files alone say (`mb_capture::check`), and what matched features say of the poses; and the page
//! that shows both.

mod epipolar;
mod page;
mod path_drawing;

use mb_capture::{CheckOptions, CheckSummary, Sequence};
use mb_job::{Progress, Result};
use serde::{Deserialize, Serialize};

pub use epipolar::{EpipolarCheck, EpipolarOptions, EpipolarPair};
pub use page::check_report;

/// Limits beyond which something is reported.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CaptureCheckOptions {
    /// Of the checks of files, photographs, path and depth.
    pub capture: CheckOptions,
    /// Of the check of poses by matched features.
    pub epipolar: EpipolarOptions,
}

/// What a check found: the keys of [`CheckSummary`], and `epipolar`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CaptureCheck {
    /// Files, photographs, path and depth; its problems include those that the matches show.
    #[serde(flatten)]
    pub capture: CheckSummary,
    /// How far matches lie from where the poses put them; null where too few photographs match.
    pub epipolar: Option<EpipolarCheck>,
}

/// Checks a sequence.
///
/// # Errors
/// The person asked for a stop. Files that cannot be read are problems of the summary, not errors.
pub fn check_capture(
    sequence: &Sequence,
    options: &CaptureCheckOptions,
    progress: &dyn Progress,
) -> Result<CaptureCheck> {
    let mut capture = mb_capture::check(sequence, &options.capture, progress)?;
    let (epipolar, problem) = epipolar::check_epipolar(sequence, &options.epipolar, progress)?;
    // Depth and matches see the same mix-up: it is told once.
    let known = |message: &str| capture.problems.iter().any(|p| p.message.starts_with(message));
    if let Some(problem) = problem
        && !problem.message.split(" (").next().is_some_and(known)
    {
        capture.problems.push(problem);
    }
    capture.ok = capture.problems.is_empty();
    Ok(CaptureCheck { capture, epipolar })
}
