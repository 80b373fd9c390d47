//! What a leaderboard shows: the scores of methods, by protocol, read from the documents of `eval`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use mb_eval::{
    Comparison, CurvePoint, MethodScores, MissingScore, PaperTable, SurfaceProtocol, SurfaceScores, SurfaceTable,
    compare,
};
use mb_job::Result;

/// Everything that the pages show.
pub(super) struct Board {
    /// Surface scores, one entry per protocol that occurs, in the order of [`SurfaceProtocol::ALL`].
    pub surfaces: Vec<SurfaceBoard>,
    /// The paper's tables with rows of these methods, surfaces included.
    pub tables: Vec<Comparison>,
    /// The documents, each with the name of its method.
    pub documents: Vec<(String, PathBuf)>,
}

/// The surface scores of one protocol.
pub(super) struct SurfaceBoard {
    pub protocol: SurfaceProtocol,
    /// Best mean F1 at 2.5 mm first.
    pub methods: Vec<Method>,
}

/// The scores of one method by one protocol.
pub(super) struct Method {
    pub name: String,
    pub sequences: BTreeMap<String, SurfaceScores>,
    pub missing: Vec<MissingScore>,
}

impl Board {
    /// Reads the documents: `(name of the method where the document lacks it, path)`.
    pub fn read(results: &[(Option<String>, PathBuf)], seed: u64) -> Result<Self> {
        let mut scores = Vec::new();
        for (method, path) in results {
            scores.extend(MethodScores::read(path, method.as_deref())?);
        }
        let mut documents: Vec<(String, PathBuf)> = Vec::new();
        let mut surfaces: BTreeMap<usize, Vec<Method>> = BTreeMap::new();
        for method in &scores {
            let Some(file) = method.sequences.first().map(|s| s.file.clone()) else { continue };
            documents.push((method.method.clone(), file.clone()));
            if let (PaperTable::Surfaces, Ok(protocol)) = (method.table, method.protocol.parse::<SurfaceProtocol>()) {
                let order = SurfaceProtocol::ALL.iter().position(|p| *p == protocol).unwrap_or(0);
                add(surfaces.entry(order).or_default(), &method.method, SurfaceTable::read(&file)?);
            }
        }
        let surfaces = surfaces.into_iter().map(|(order, mut methods)| {
            methods.sort_by(|a, b| b.f1().total_cmp(&a.f1()).then_with(|| a.name.cmp(&b.name)));
            SurfaceBoard { protocol: SurfaceProtocol::ALL[order], methods }
        });
        let surfaces = surfaces.collect();
        let with_rows: Vec<PaperTable> =
            PaperTable::ALL.into_iter().filter(|t| scores.iter().any(|s| s.table == *t)).collect();
        Ok(Self { surfaces, tables: compare(scores, &with_rows, seed)?, documents })
    }

    /// Every sequence that some method was asked for, in alphabetical order.
    pub fn sequences(&self) -> Vec<String> {
        let methods = || self.surfaces.iter().flat_map(|b| &b.methods);
        let scored = methods().flat_map(|m| m.sequences.keys().cloned());
        let mut names: Vec<String> =
            scored.chain(methods().flat_map(|m| m.missing.iter().map(|s| s.sequence.clone()))).collect();
        names.sort();
        names.dedup();
        names
    }

    /// The comparison with the rows of a surface protocol.
    pub fn comparison(&self, protocol: SurfaceProtocol) -> Option<&Comparison> {
        self.tables.iter().find(|t| t.table == PaperTable::Surfaces && t.protocol == protocol.name())
    }
}

fn add(methods: &mut Vec<Method>, name: &str, table: SurfaceTable) {
    let at = methods.iter().position(|m| m.name == name).unwrap_or_else(|| {
        methods.push(Method { name: name.to_owned(), sequences: BTreeMap::new(), missing: Vec::new() });
        methods.len() - 1
    });
    let method = &mut methods[at];
    method.sequences.extend(table.sequences.into_iter().map(|s| (s.sequence.clone(), s)));
    method.missing.extend(table.missing);
    let sequences = &method.sequences;
    method.missing.retain(|m| !sequences.contains_key(&m.sequence));
}

impl Method {
    /// Mean over the scored sequences.
    pub fn mean(&self, value: impl Fn(&SurfaceScores) -> f64) -> f64 {
        self.sequences.values().map(value).sum::<f64>() / self.sequences.len() as f64
    }

    /// Mean F1 at 2.5 mm.
    pub fn f1(&self) -> f64 {
        self.mean(|s| f1_at(s, 2.5))
    }

    /// A mean curve over the scored sequences: (threshold in mm, fraction).
    pub fn curve(&self, value: fn(&CurvePoint) -> f64) -> Vec<(f64, f64)> {
        let Some(first) = self.sequences.values().next() else { return Vec::new() };
        let at = |i: usize| self.mean(|s| s.curve.points.get(i).map_or(f64::NAN, value));
        first.curve.points.iter().enumerate().map(|(i, p)| (p.threshold_mm, at(i))).collect()
    }
}

/// F1 at a threshold that the score has; else NaN.
pub(super) fn f1_at(scores: &SurfaceScores, threshold_mm: f64) -> f64 {
    scores.thresholds.iter().find(|t| t.threshold_mm == threshold_mm).map_or(f64::NAN, |t| t.f1)
}

/// Name of a sequence's page, below the index.
pub(super) fn page_of(sequence: &str) -> String {
    format!("sequences/{}.html", file_name(sequence))
}

/// A name as part of a file name and of a link.
pub(super) fn file_name(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.') { c } else { '_' }).collect()
}

/// The sequence folder that a score's ground truth lies in.
pub(super) fn sequence_folder(scores: &SurfaceScores) -> Option<&Path> {
    scores.provenance.as_ref()?.ground_truth.path.parent()?.parent()
}
