//! Which file of one folder is compared with which of another.

use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};

/// The files of two folders, joined by name.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Pairing {
    /// What both folders have, in ascending order of names.
    pub pairs: Vec<Pair>,
    /// Names that only the ground truth has: the prediction lacks them.
    pub missing: Vec<String>,
    /// Names that only the prediction has: nothing to compare them with.
    pub unpaired: Vec<String>,
}

/// One name, and its file on both sides.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Pair {
    /// File name without extension (and without the published prefix).
    pub name: String,
    /// The ground truth.
    pub gt: PathBuf,
    /// The prediction.
    pub pred: PathBuf,
}

/// What a prediction may be called where ground truth is called `gt_NAME`.
const PREDICTION_PREFIXES: [&str; 2] = ["render_", "pred_"];

/// Joins the images of two folders by file name without extension. Where the ground truth has names `gt_NAME` and the
/// prediction `render_NAME` or `pred_NAME`, as the published scripts have in one folder, these are joined by `NAME`.
/// `skip` leaves files out by their name without extension.
pub(crate) fn pair_by_name(
    gt: &Path,
    pred: &Path,
    extensions: &[&str],
    skip: impl Fn(&str) -> bool,
) -> Result<Pairing> {
    let mut gt_files = named_files(gt, extensions, &skip)?;
    let mut pred_files = named_files(pred, extensions, &skip)?;
    let prefix = PREDICTION_PREFIXES.into_iter().find(|p| pred_files.iter().any(|(name, _)| name.starts_with(p)));
    if let Some(prefix) = prefix
        && gt_files.iter().any(|(name, _)| name.starts_with("gt_"))
    {
        gt_files = without_prefix(gt_files, "gt_");
        pred_files = without_prefix(pred_files, prefix);
    }
    let mut pairing = Pairing { pairs: Vec::new(), missing: Vec::new(), unpaired: Vec::new() };
    for (name, file) in &gt_files {
        match pred_files.binary_search_by(|(other, _)| other.cmp(name)) {
            Ok(i) => {
                let (gt, pred) = (file.clone(), pred_files[i].1.clone());
                pairing.pairs.push(Pair { name: name.clone(), gt, pred });
            }
            Err(_) => pairing.missing.push(name.clone()),
        }
    }
    pairing.unpaired = pred_files
        .into_iter()
        .filter(|(name, _)| gt_files.binary_search_by(|(other, _)| other.cmp(name)).is_err())
        .map(|(name, _)| name)
        .collect();
    if pairing.pairs.is_empty() {
        let found = format!(
            "no file name in common with {} ({} there, {} here)",
            gt.display(),
            some(&pairing.missing),
            some(&pairing.unpaired)
        );
        return Err(InputError::new(pred, found).help("Images are paired by file name, without the extension").into());
    }
    Ok(pairing)
}

/// A few of the names, for a sentence.
pub(crate) fn some(names: &[String]) -> String {
    match names {
        [] => "none".to_owned(),
        [first] => first.clone(),
        [first, second] => format!("{first} and {second}"),
        [first, .., last] => format!("{} from {first} to {last}", names.len()),
    }
}

/// Sorted by name.
fn named_files(folder: &Path, extensions: &[&str], skip: impl Fn(&str) -> bool) -> Result<Vec<(String, PathBuf)>> {
    let entries = std::fs::read_dir(folder).map_err(|e| InputError::unreadable(folder, &e))?;
    let mut files: Vec<(String, PathBuf)> = Vec::new();
    for entry in entries {
        let path = entry.map_err(|e| InputError::unreadable(folder, &e))?.path();
        let text = |part: Option<&std::ffi::OsStr>| part.map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
        let (name, extension) = (text(path.file_stem()), text(path.extension()).to_ascii_lowercase());
        if extensions.contains(&extension.as_str()) && !name.starts_with('.') && !skip(&name) && path.is_file() {
            files.push((name, path));
        }
    }
    files.sort();
    if files.is_empty() {
        let wanted = extensions.join(", ");
        return Err(InputError::new(folder, format!("no image in this folder (looked for {wanted})")).into());
    }
    if let Some(twice) = files.windows(2).find(|pair| pair[0].0 == pair[1].0) {
        let found = format!("the same name as {}, so it is not clear which one to score", twice[0].1.display());
        return Err(InputError::new(&twice[1].1, found).help("Keep one of the two").into());
    }
    Ok(files)
}

fn without_prefix(files: Vec<(String, PathBuf)>, prefix: &str) -> Vec<(String, PathBuf)> {
    files.into_iter().filter_map(|(name, path)| Some((name.strip_prefix(prefix)?.to_owned(), path))).collect()
}
