//! The documents that `eval` wrote, reduced to the columns of a table.

use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};
use serde::Deserialize;

use super::PaperTable;
use crate::{DEPTH_PROTOCOL, DepthMetrics, POSES_PROTOCOL, SurfaceProtocol, VIEWS_PROTOCOL};

/// What one method scored by one protocol.
#[derive(Debug, Clone, PartialEq)]
pub struct MethodScores {
    /// The method.
    pub method: String,
    /// The protocol.
    pub protocol: String,
    /// The table whose columns the values fill.
    pub table: PaperTable,
    /// The scored sequences, in the order of the documents.
    pub sequences: Vec<SequenceValues>,
    /// Sequences that were asked for and have no score.
    pub missing: Vec<String>,
}

/// The values of one sequence.
#[derive(Debug, Clone, PartialEq)]
pub struct SequenceValues {
    /// Its name; the document's file name where the document does not say.
    pub sequence: String,
    /// One entry per column of the table.
    pub values: Vec<Option<f64>>,
    /// Its weight in the mean: 1, for views the number of images, as the published script averages over all images.
    pub weight: f64,
    /// Where it was read.
    pub file: PathBuf,
}

impl MethodScores {
    /// Reads a document that `mobilebrick eval ... --json` printed or `-o` wrote (`scores.json`), or a folder of them.
    /// `method` names what the document does not: scores of single sequences carry no method.
    ///
    /// # Errors
    /// A file is missing or no such document, or nothing names the method.
    pub fn read(path: &Path, method: Option<&str>) -> Result<Vec<Self>> {
        if !path.is_dir() {
            return Ok(vec![Self::read_file(path, method)?]);
        }
        let entries = std::fs::read_dir(path).map_err(|e| InputError::unreadable(path, &e))?;
        let mut files: Vec<PathBuf> =
            entries.flatten().map(|e| e.path()).filter(|p| p.extension().is_some_and(|e| e == "json")).collect();
        files.sort();
        if files.is_empty() {
            let help = "Give a document of `mobilebrick eval`, or a folder of them";
            return Err(InputError::new(path, "no .json file in this folder").help(help).into());
        }
        files.iter().map(|file| Self::read_file(file, method)).collect()
    }

    fn read_file(path: &Path, method: Option<&str>) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
        let found = |what: String| {
            InputError::new(path, what).help("Expected a document that `mobilebrick eval ... --json` printed")
        };
        let document: Document = serde_json::from_slice(&bytes).map_err(|e| found(format!("no scores: {e}")))?;
        let stem = path.file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let method = method.map(str::to_owned).or_else(|| document.method.clone()).ok_or_else(|| {
            InputError::new(path, "nothing says which method these scores belong to").help("Give it as NAME=FILE")
        })?;
        let of = |table, sequences: Vec<(String, Vec<Option<f64>>, f64)>, missing| {
            let sequence =
                |(sequence, values, weight)| SequenceValues { sequence, values, weight, file: path.to_owned() };
            let sequences = sequences.into_iter().map(sequence).collect();
            Self { method: method.clone(), protocol: document.protocol.clone(), table, sequences, missing }
        };
        let malformed = |e: serde_json::Error| found(format!("malformed scores: {e}"));
        Ok(match document.protocol.as_str() {
            name if name.parse::<SurfaceProtocol>().is_ok() => {
                let surfaces: Surfaces = serde_json::from_slice(&bytes).map_err(malformed)?;
                let missing = surfaces.missing.into_iter().map(|m| m.sequence).collect();
                let scores = match surfaces.sequences {
                    Some(scores) => scores,
                    None => vec![serde_json::from_slice(&bytes).map_err(malformed)?],
                };
                of(
                    PaperTable::Surfaces,
                    scores.into_iter().map(|s| (s.columns(), s)).map(|(v, s)| (s.sequence, v, 1.0)).collect(),
                    missing,
                )
            }
            VIEWS_PROTOCOL => {
                let views: Views = serde_json::from_slice(&bytes).map_err(malformed)?;
                let scores = match views.per_sequence {
                    Some(scores) => scores,
                    None => vec![serde_json::from_slice(&bytes).map_err(malformed)?],
                };
                let sequences = scores.into_iter().map(|s| {
                    let name = s.sequence.clone().unwrap_or_else(|| stem.clone());
                    (name, vec![Some(s.psnr), Some(s.ssim), s.lpips], s.images as f64)
                });
                of(PaperTable::Views, sequences.collect(), views.missing_sequences)
            }
            DEPTH_PROTOCOL => {
                let m: DepthMetrics = serde_json::from_slice(&bytes).map_err(malformed)?;
                let values = [m.abs_rel, m.sq_rel, m.rmse_m, m.rmse_log, m.delta1, m.delta2, m.delta3];
                of(PaperTable::Depth, vec![(stem, values.map(Some).to_vec(), 1.0)], Vec::new())
            }
            POSES_PROTOCOL => {
                let poses: Poses = serde_json::from_slice(&bytes).map_err(malformed)?;
                let errors = poses.pairwise;
                let values = vec![Some(errors.translation_rmse_mm), Some(errors.rotation_mean_deg), None, None];
                of(PaperTable::Poses, vec![(stem, values, 1.0)], Vec::new())
            }
            other => return Err(found(format!("scores by a protocol {other:?} that no table has")).into()),
        })
    }

    /// The mean of each column, as the tables average: over sequences (for views over images). `None` where a sequence
    /// lacks the value: a mean over fewer would pass for one over all.
    pub fn means(&self) -> Vec<Option<f64>> {
        let weight: f64 = self.sequences.iter().map(|s| s.weight).sum();
        let columns = self.sequences.first().map_or(0, |s| s.values.len());
        let mean = |column: usize| -> Option<f64> {
            let values = self.sequences.iter().map(|s| s.values[column].map(|v| v * s.weight));
            Some(values.sum::<Option<f64>>()? / weight)
        };
        (0..columns).map(mean).collect()
    }
}

/// What every document says.
#[derive(Deserialize)]
struct Document {
    protocol: String,
    method: Option<String>,
}

/// Scores of surfaces: a method's, or one sequence's.
#[derive(Deserialize)]
struct Surfaces {
    sequences: Option<Vec<Surface>>,
    #[serde(default)]
    missing: Vec<Missing>,
}

#[derive(Deserialize)]
struct Missing {
    sequence: String,
}

#[derive(Deserialize)]
struct Surface {
    sequence: String,
    chamfer_mm: f64,
    thresholds: Vec<Threshold>,
}

#[derive(Deserialize)]
struct Threshold {
    threshold_mm: f64,
    accuracy: f64,
    recall: f64,
    f1: f64,
}

impl Surface {
    /// Shares in percent at 2.5 and at 5 mm, Chamfer distance.
    fn columns(&self) -> Vec<Option<f64>> {
        let mut columns = Vec::new();
        for mm in crate::SurfaceOptions::PUBLISHED_THRESHOLDS_MM {
            let at = self.thresholds.iter().find(|t| t.threshold_mm == mm);
            columns.extend([at.map(|t| 100.0 * t.accuracy), at.map(|t| 100.0 * t.recall), at.map(|t| 100.0 * t.f1)]);
        }
        columns.push(Some(self.chamfer_mm));
        columns
    }
}

/// Scores of views: a method's, or one folder's.
#[derive(Deserialize)]
struct Views {
    per_sequence: Option<Vec<View>>,
    #[serde(default)]
    missing_sequences: Vec<String>,
}

#[derive(Deserialize)]
struct View {
    sequence: Option<String>,
    images: usize,
    psnr: f64,
    ssim: f64,
    lpips: Option<f64>,
}

#[derive(Deserialize)]
struct Poses {
    pairwise: Pairwise,
}

#[derive(Deserialize)]
struct Pairwise {
    translation_rmse_mm: f64,
    rotation_mean_deg: f64,
}
