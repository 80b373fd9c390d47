//! A folder of renders as the published scripts lay it out: `nvs/METHOD/SEQUENCE/{gt,render}_NNNNNN.png`.

use std::fmt::Write as _;
use std::path::Path;

use mb_job::{Error, InputError, Progress, Result, Steps, write_atomic};
use serde::Serialize;

use super::{VIEWS_PROTOCOL, ViewsOptions, ViewsScores, evaluate_views};
use crate::PerceptualMetric;
use crate::pairing::some;

/// The views of one method over a list of sequences.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewsTable {
    /// [`VIEWS_PROTOCOL`].
    pub protocol: &'static str,
    /// The method, as its folder is called.
    pub method: String,
    /// Number of scored images of all sequences.
    pub images: usize,
    /// Mean over all images of the PSNR in dB, as the published script prints it (a sequence counts by its images).
    pub psnr: f64,
    /// Mean over all images of SSIM.
    pub ssim: f64,
    /// Mean over all images of the perceptual metric.
    pub lpips: Option<f64>,
    /// One entry per scored sequence, in the order of the list.
    pub per_sequence: Vec<SequenceViews>,
    /// Sequences of the list that the method's folder lacks; they are in no mean.
    pub missing_sequences: Vec<String>,
    /// What a reader of the scores should know.
    pub warnings: Vec<String>,
}

/// One row of a [`ViewsTable`].
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SequenceViews {
    /// Its name.
    pub sequence: String,
    /// Its scores; means are over the sequence's images.
    #[serde(flatten)]
    pub scores: ViewsScores,
}

/// Scores a method's folder in the published layout.
///
/// `folder` is `nvs/METHOD`; each sequence is a folder in it with `gt_NAME.png` and `render_NAME.png`.
///
/// # Errors
/// The list is empty, no sequence is there, or a sequence cannot be scored ([`evaluate_views`]).
pub fn evaluate_views_method(
    folder: &Path,
    sequences: &[String],
    options: &ViewsOptions,
    perceptual: Option<&dyn PerceptualMetric>,
    progress: &dyn Progress,
) -> Result<ViewsTable> {
    let mut per_sequence = Vec::new();
    let mut missing_sequences = Vec::new();
    let mut warnings = Vec::new();
    let steps = Steps::new(progress, "sequences", sequences.len());
    for sequence in sequences {
        let renders = folder.join(sequence);
        if renders.is_dir() {
            let scores = evaluate_views(&renders, &renders, options, perceptual, progress)?;
            warnings.extend(scores.warnings.iter().map(|w| format!("{sequence}: {w}")));
            per_sequence.push(SequenceViews { sequence: sequence.clone(), scores });
        } else {
            missing_sequences.push(sequence.clone());
        }
        steps.step()?;
    }
    if per_sequence.is_empty() {
        return Err(InputError::new(folder, format!("none of the sequences is there ({})", some(sequences)))
            .help("Expected a folder per sequence with gt_NAME.png and render_NAME.png")
            .into());
    }
    if !missing_sequences.is_empty() {
        warnings.push(format!("missing: {}; the means do not count them", missing_sequences.join(", ")));
    }
    let images = per_sequence.iter().map(|s| s.scores.images).sum::<usize>();
    let mean = |value: &dyn Fn(&ViewsScores) -> f64| {
        per_sequence.iter().map(|s| value(&s.scores) * s.scores.images as f64).sum::<f64>() / images as f64
    };
    Ok(ViewsTable {
        protocol: VIEWS_PROTOCOL,
        method: folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default(),
        images,
        psnr: mean(&|s| s.psnr),
        ssim: mean(&|s| s.ssim),
        lpips: perceptual.map(|_| mean(&|s| s.lpips.unwrap_or(f64::NAN))),
        per_sequence,
        missing_sequences,
        warnings,
    })
}

impl ViewsTable {
    /// Writes `data.csv` as the published script does for surfaces, and `scores.json`.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write(&self, folder: &Path, sequences: &[String]) -> Result<()> {
        write_atomic(folder.join("data.csv"), self.to_csv(sequences).as_bytes())?;
        let path = folder.join("scores.json");
        let mut json = serde_json::to_vec_pretty(self).map_err(|e| Error::write(&path, e.into()))?;
        json.push(b'\n');
        write_atomic(path, &json)
    }

    /// Rows as the published surface script writes them: the names of the sequences, then a row for each of PSNR, SSIM
    /// and LPIPS. A missing sequence keeps its column, empty.
    pub fn to_csv(&self, sequences: &[String]) -> String {
        let mut csv = String::new();
        let row = |value: &dyn Fn(&ViewsScores) -> Option<f64>| {
            let cells = sequences.iter().map(|name| {
                let scores = self.per_sequence.iter().find(|s| s.sequence == *name).map(|s| &s.scores);
                scores.and_then(value).map(|v| v.to_string()).unwrap_or_default()
            });
            cells.collect::<Vec<_>>().join(",")
        };
        let _ = writeln!(csv, "{}", sequences.join(","));
        let _ = writeln!(csv, "{}", row(&|s| Some(s.psnr)));
        let _ = writeln!(csv, "{}", row(&|s| Some(s.ssim)));
        let _ = writeln!(csv, "{}", row(&|s| s.lpips));
        csv
    }
}
