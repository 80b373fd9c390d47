//! A method over a list of sequences: the published table of one method.

use std::path::{Path, PathBuf};

use mb_job::{Error, InputError, Progress, Result, Steps, write_atomic};
use serde::{Deserialize, Serialize};

use super::{Chamfer, ExactScores, SurfaceOptions, SurfaceProtocol, SurfaceScores, ThresholdScore, evaluate_surface};

/// Scores of one method.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SurfaceTable {
    /// Name of the method.
    pub method: String,
    /// The protocol.
    pub protocol: SurfaceProtocol,
    /// What was scored and how.
    pub options: SurfaceOptions,
    /// Means over the scored sequences; `None` where none was scored.
    pub mean: Option<SurfaceMean>,
    /// The scored sequences, in the order of the list.
    pub sequences: Vec<SurfaceScores>,
    /// Sequences of the list without a score; they are in no mean.
    pub missing: Vec<MissingScore>,
    /// The list, in order.
    pub list: Vec<String>,
    /// Folder with the ground truth's sequences, as it was given.
    pub root: PathBuf,
    /// What the person who reads the numbers should know.
    #[serde(default)]
    pub warnings: Vec<String>,
}

/// A sequence that could not be scored.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct MissingScore {
    /// Its name.
    pub sequence: String,
    /// Why.
    pub reason: String,
}

/// Means over sequences, as the published tables average.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SurfaceMean {
    /// Number of sequences in the means.
    pub sequences: usize,
    /// Mean distances.
    #[serde(flatten)]
    pub chamfer: Chamfer,
    /// Means of the shares; `f1` is the mean of the sequences' F1.
    pub thresholds: Vec<ThresholdScore>,
    /// The same after rigid alignment, in `exact-1`.
    pub aligned: Option<AlignedMean>,
}

/// Means over sequences after rigid alignment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AlignedMean {
    /// Mean distances.
    #[serde(flatten)]
    pub chamfer: Chamfer,
    /// Means of the shares.
    pub thresholds: Vec<ThresholdScore>,
}

/// The test sequences of the paper, in the order of the published list.
pub const PUBLISHED_TEST_SEQUENCES: [&str; 18] = [
    "aston",
    "audi",
    "beetles",
    "big_ben",
    "boat",
    "bridge",
    "cabin",
    "camera",
    "castle",
    "colosseum",
    "convertible",
    "ferrari",
    "jeep",
    "london_bus",
    "motorcycle",
    "porsche",
    "satellite",
    "space_shuttle",
];

/// Reads a list of sequences: names separated by commas or line ends. The published list is one line with commas and no
/// line end. Blanks, empty entries, and lines that begin with `#` are skipped.
///
/// # Errors
/// The file cannot be read, names no sequence, or names one twice.
pub fn read_sequence_list(path: &Path) -> Result<Vec<String>> {
    let text = std::fs::read_to_string(path).map_err(|e| InputError::unreadable(path, &e))?;
    let text = text.trim_start_matches('\u{feff}');
    let mut names: Vec<String> = Vec::new();
    for (number, line) in text.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with('#')) {
        for name in line.split(',').map(str::trim).filter(|name| !name.is_empty()) {
            if names.iter().any(|n| n == name) {
                return Err(InputError::new(path, format!("{name:?} is listed twice")).at_line(number + 1).into());
            }
            if Path::new(name).components().count() != 1 || name == ".." {
                let found = format!("{name:?} is no name of a sequence");
                return Err(InputError::new(path, found).at_line(number + 1).into());
            }
            names.push(name.to_owned());
        }
    }
    if names.is_empty() {
        let help = "Expected names separated by commas, as in the published test_seqs.txt";
        return Err(InputError::new(path, "the list names no sequence").help(help).into());
    }
    Ok(names)
}

/// Scores `predictions/SEQ.ply` against `root/SEQ` for every name of `list`. The published scripts keep the predictions
/// of a method in `./meshes/METHOD`; meshes of other formats are taken where no PLY file lies there.
///
/// A prediction that is missing or cannot be scored is named in `missing`, and no mean contains it.
///
/// # Errors
/// The folder of predictions or the root is missing; not one sequence could be scored; the job was stopped.
pub fn evaluate_surface_method(
    method: &str,
    predictions: &Path,
    root: &Path,
    list: &[String],
    options: &SurfaceOptions,
    progress: &dyn Progress,
) -> Result<SurfaceTable> {
    options.validate()?;
    for folder in [root, predictions] {
        if !folder.is_dir() {
            let help = "The ground truth lies in ROOT/SEQ, the predictions in ./meshes/METHOD/SEQ.ply";
            return Err(InputError::new(folder, "no such folder").help(help).into());
        }
    }
    let steps = Steps::new(progress, "scoring sequences", list.len());
    let (mut sequences, mut missing) = (Vec::new(), Vec::new());
    for name in list {
        match score_one(&root.join(name), predictions, name, options) {
            Ok(scores) => sequences.push(scores),
            Err(Error::Input(error)) => {
                missing.push(MissingScore { sequence: name.clone(), reason: error.to_string() });
            }
            Err(error) => return Err(error),
        }
        steps.step()?;
    }
    if sequences.is_empty() {
        let first = missing.first().map(|m| m.reason.clone()).unwrap_or_default();
        let found = format!("none of the {} listed sequences could be scored; the first: {first}", list.len());
        return Err(InputError::new(predictions, found).into());
    }
    Ok(SurfaceTable {
        method: method.to_owned(),
        protocol: options.protocol,
        options: options.clone(),
        mean: SurfaceMean::of(&sequences),
        warnings: missing.iter().map(|m| format!("no score for {}: {}", m.sequence, m.reason)).collect(),
        sequences,
        missing,
        list: list.to_vec(),
        root: root.to_owned(),
    })
}

fn score_one(truth: &Path, predictions: &Path, name: &str, options: &SurfaceOptions) -> Result<SurfaceScores> {
    let candidates: Vec<PathBuf> =
        ["ply", "obj", "glb", "stl"].iter().map(|e| predictions.join(format!("{name}.{e}"))).collect();
    let Some(path) = candidates.iter().find(|path| path.exists()) else {
        return Err(InputError::new(&candidates[0], "no prediction for this sequence").into());
    };
    evaluate_surface(truth, path, options, &mb_job::Silent)
}

impl SurfaceMean {
    fn of(sequences: &[SurfaceScores]) -> Option<Self> {
        let scores: Vec<_> = sequences.iter().map(|s| (&s.chamfer, s.thresholds.as_slice())).collect();
        let aligned: Option<Vec<_>> = sequences.iter().map(|s| s.exact.as_ref().map(|e| &e.aligned)).collect();
        let aligned = aligned.and_then(|aligned| {
            let scores: Vec<_> = aligned.iter().map(|a| (&a.chamfer, a.thresholds.as_slice())).collect();
            mean_of(&scores).map(|(chamfer, thresholds)| AlignedMean { chamfer, thresholds })
        });
        let (chamfer, thresholds) = mean_of(&scores)?;
        Some(Self { sequences: sequences.len(), chamfer, thresholds, aligned })
    }
}

/// Means of scores with the same thresholds; `None` of no scores.
fn mean_of(scores: &[(&Chamfer, &[ThresholdScore])]) -> Option<(Chamfer, Vec<ThresholdScore>)> {
    let count = scores.len() as f64;
    let mean = |value: &dyn Fn(&Chamfer, &[ThresholdScore]) -> f64| {
        scores.iter().map(|(chamfer, thresholds)| value(chamfer, thresholds)).sum::<f64>() / count
    };
    let (_, first) = scores.first()?;
    let threshold = |(i, t): (usize, &ThresholdScore)| ThresholdScore {
        threshold_mm: t.threshold_mm,
        accuracy: mean(&|_, t| t[i].accuracy),
        recall: mean(&|_, t| t[i].recall),
        f1: mean(&|_, t| t[i].f1),
    };
    let chamfer = Chamfer {
        chamfer_mm: mean(&|c, _| c.chamfer_mm),
        pred_to_gt_mm: mean(&|c, _| c.pred_to_gt_mm),
        gt_to_pred_mm: mean(&|c, _| c.gt_to_pred_mm),
    };
    Some((chamfer, first.iter().enumerate().map(threshold).collect()))
}

impl SurfaceTable {
    /// Reads the `scores.json` that [`SurfaceTable::write`] wrote.
    ///
    /// # Errors
    /// The file is missing, or no such document.
    pub fn read(path: &Path) -> Result<Self> {
        let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
        serde_json::from_slice(&bytes).map_err(|e| {
            let help = "Expected the scores.json of `mobilebrick eval surface --method NAME ... -o DIR`";
            InputError::new(path, format!("no table of surface scores: {e}")).help(help).into()
        })
    }

    /// Writes `data.csv` as the published script does, `scores.csv` with named columns, and `scores.json`.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        write_atomic(folder.join("data.csv"), self.published_csv().as_bytes())?;
        write_atomic(folder.join("scores.csv"), self.named_csv().as_bytes())?;
        let path = folder.join("scores.json");
        let mut json = serde_json::to_vec_pretty(self).map_err(|e| Error::write(&path, e.into()))?;
        json.push(b'\n');
        write_atomic(path, &json)
    }

    fn score_of(&self, sequence: &str) -> Option<&SurfaceScores> {
        self.sequences.iter().find(|s| s.sequence == sequence)
    }

    /// The published `data.csv`: a column per sequence; rows names, fitness, Chamfer distance in metres, then accuracy,
    /// recall and F1 at 2.5 mm and at 5 mm. Missing sequences have empty cells. Lines end as Python's csv writes them.
    pub fn published_csv(&self) -> String {
        const ROWS: usize = 8;
        let column = |s: &SurfaceScores| -> Vec<f64> {
            let published = SurfaceOptions::PUBLISHED_THRESHOLDS_MM;
            let shares = s.thresholds.iter().filter(|t| published.contains(&t.threshold_mm));
            let shares = shares.flat_map(|t| [t.accuracy, t.recall, t.f1]);
            [s.icp.fitness, s.chamfer.chamfer_mm / 1000.0].into_iter().chain(shares).collect()
        };
        let columns: Vec<Option<Vec<f64>>> = self.list.iter().map(|name| self.score_of(name).map(column)).collect();
        let mut csv = self.list.iter().map(|name| quoted(name)).collect::<Vec<_>>().join(",") + "\r\n";
        for row in 0..ROWS {
            let cell = |column: &Option<Vec<f64>>| column.as_ref().map(|c| c[row].to_string()).unwrap_or_default();
            csv += &(columns.iter().map(cell).collect::<Vec<_>>().join(",") + "\r\n");
        }
        csv
    }

    /// One line per sequence of the list and a last one with the means; columns carry units. Missing sequences have
    /// empty cells and the reason in the last column.
    pub fn named_csv(&self) -> String {
        let thresholds = self.options.thresholds_mm();
        let mut lines = vec![column_names(&thresholds)];
        for name in &self.list {
            let mut cells = vec![self.method.clone(), self.protocol.to_string(), name.clone()];
            let mut reason = String::new();
            match self.score_of(name) {
                Some(s) => {
                    cells.extend([s.icp.fitness.to_string(), s.icp.applied.to_string()]);
                    cells.extend(number_cells(&s.chamfer, &s.thresholds));
                    if let Some(ExactScores { aligned, .. }) = &s.exact {
                        cells.extend(number_cells(&aligned.chamfer, &aligned.thresholds));
                        cells.push(aligned.effect.chamfer_mm.to_string());
                        cells.extend(aligned.effect.f1.iter().map(|f| f.change.to_string()));
                    }
                }
                None => {
                    let missing = self.missing.iter().find(|m| &m.sequence == name);
                    reason = missing.map(|m| m.reason.clone()).unwrap_or_default();
                }
            }
            cells.resize(lines[0].len() - 1, String::new());
            cells.push(reason);
            lines.push(cells);
        }
        if let Some(mean) = &self.mean {
            let name = format!("mean of {}", mean.sequences);
            let mut cells = vec![self.method.clone(), self.protocol.to_string(), name, String::new(), String::new()];
            cells.extend(number_cells(&mean.chamfer, &mean.thresholds));
            if let Some(aligned) = &mean.aligned {
                cells.extend(number_cells(&aligned.chamfer, &aligned.thresholds));
                cells.push((aligned.chamfer.chamfer_mm - mean.chamfer.chamfer_mm).to_string());
                cells.extend(aligned.thresholds.iter().zip(&mean.thresholds).map(|(a, b)| (a.f1 - b.f1).to_string()));
            }
            cells.resize(lines[0].len(), String::new());
            lines.push(cells);
        }
        let line = |cells: Vec<String>| cells.iter().map(|c| quoted(c)).collect::<Vec<_>>().join(",") + "\n";
        lines.into_iter().map(line).collect()
    }
}

fn column_names(thresholds_mm: &[f64]) -> Vec<String> {
    let mut names = ["method", "protocol", "sequence", "icp_fitness", "icp_applied"].map(str::to_owned).to_vec();
    for prefix in ["", "aligned_"] {
        names.extend(["chamfer_mm", "pred_to_gt_mm", "gt_to_pred_mm"].map(|name| format!("{prefix}{name}")));
        for t in thresholds_mm {
            names.extend(["accuracy", "recall", "f1"].map(|name| format!("{prefix}{name}_{t}mm")));
        }
    }
    names.push("icp_effect_chamfer_mm".to_owned());
    names.extend(thresholds_mm.iter().map(|t| format!("icp_effect_f1_{t}mm")));
    names.push("missing".to_owned());
    names
}

fn number_cells(chamfer: &Chamfer, thresholds: &[ThresholdScore]) -> Vec<String> {
    let distances = [chamfer.chamfer_mm, chamfer.pred_to_gt_mm, chamfer.gt_to_pred_mm];
    let shares = thresholds.iter().flat_map(|t| [t.accuracy, t.recall, t.f1]);
    distances.into_iter().chain(shares).map(|v| v.to_string()).collect()
}

/// A CSV cell, quoted where it must be (RFC 4180).
pub(crate) fn quoted(text: &str) -> String {
    if text.contains(['"', ',', '\n', '\r']) { format!("\"{}\"", text.replace('"', "\"\"")) } else { text.to_owned() }
}
