//! Scores of rendered views against photographs: PSNR, SSIM and, where a network is given, LPIPS.

mod published;
mod similarity;

use std::path::{Path, PathBuf};

use mb_image::{Mask, read_mask_png, read_rgb_fraction};
use mb_job::{InputError, Progress, Result, Steps};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use published::{SequenceViews, ViewsTable, evaluate_views_method};
pub use similarity::{ColorImage, Similarity, psnr_of_mse, similarity, similarity_of_pixels};

use crate::PerceptualMetric;
use crate::pairing::{Pair, pair_by_name, some};

/// The version of this protocol that the scores carry. A change that moves a score changes it.
pub const VIEWS_PROTOCOL: &str = "mobilebrick-nvs-2023";

/// Extensions of photographs and renders.
const EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];

/// How views are scored.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ViewsOptions {
    /// Score only every n-th ground-truth image in the order of names, beginning with the first; the paper holds out
    /// every 8th. `None` scores all.
    pub hold_out: Option<usize>,
    /// A folder of masks (white = scored) with the names of the images. PSNR and SSIM then average over masked pixels;
    /// for the perceptual metric both images are black outside the mask.
    pub masks: Option<PathBuf>,
}

/// The scores of a folder of views.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewsScores {
    /// [`VIEWS_PROTOCOL`].
    pub protocol: &'static str,
    /// Number of scored images.
    pub images: usize,
    /// Mean over images of the PSNR in dB.
    pub psnr: f64,
    /// Mean over images of SSIM.
    pub ssim: f64,
    /// Mean over images of the perceptual metric; `None` where none was given.
    pub lpips: Option<f64>,
    /// Name of the perceptual metric.
    pub lpips_net: Option<String>,
    /// One entry per scored image, in the order of names.
    pub per_image: Vec<ViewScore>,
    /// Ground-truth images that the prediction lacks; they are in no mean.
    pub missing: Vec<String>,
    /// Predicted images without ground truth.
    pub unpaired: Vec<String>,
    /// What was scored and how.
    pub options: ViewsOptions,
    /// What a reader of the scores should know.
    pub warnings: Vec<String>,
}

/// The scores of one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewScore {
    /// File name without extension.
    pub name: String,
    /// PSNR in dB; 100 for equal images.
    pub psnr: f64,
    /// SSIM, at most 1.
    pub ssim: f64,
    /// The perceptual metric, where one was given.
    pub lpips: Option<f64>,
}

/// Scores the images of `pred` against those of `gt`, paired by file name without extension.
///
/// # Errors
/// A folder has no image, or no name in common; an image is damaged, transparent, or of another size than its partner.
pub fn evaluate_views(
    gt: &Path,
    pred: &Path,
    options: &ViewsOptions,
    perceptual: Option<&dyn PerceptualMetric>,
    progress: &dyn Progress,
) -> Result<ViewsScores> {
    let mut pairing = pair_by_name(gt, pred, &EXTENSIONS, |_| false)?;
    if let Some(every) = options.hold_out {
        if every == 0 {
            return Err(InputError::new(gt, "every 0th image was asked for").help("Hold out every 8th, say").into());
        }
        let mut names: Vec<String> =
            pairing.pairs.iter().map(|p| p.name.clone()).chain(pairing.missing.iter().cloned()).collect();
        names.sort();
        let held_out: Vec<String> = names.into_iter().step_by(every).collect();
        let is_held_out = |name: &String| held_out.binary_search(name).is_ok();
        pairing.pairs.retain(|p| is_held_out(&p.name));
        pairing.missing.retain(is_held_out);
        if pairing.pairs.is_empty() {
            let found = format!("none of the held-out views is there ({})", some(&pairing.missing));
            return Err(InputError::new(pred, found).into());
        }
    }
    let mut warnings = Vec::new();
    if !pairing.missing.is_empty() {
        warnings.push(format!("{} lacks {}; the means do not count them", pred.display(), some(&pairing.missing)));
    }
    if !pairing.unpaired.is_empty() {
        warnings.push(format!("{} has no image for {}", gt.display(), some(&pairing.unpaired)));
    }
    if perceptual.is_none() {
        warnings
            .push("lpips is empty: it needs the network's weights (`--lpips-net vgg --lpips-weights FILE`)".to_owned());
    }
    let steps = Steps::new(progress, "views", pairing.pairs.len());
    let mut per_image = pairing
        .pairs
        .par_iter()
        .map(|pair| {
            let score = score_pair(pair, options)?;
            steps.step()?;
            Ok(score)
        })
        .collect::<Result<Vec<ViewScore>>>()?;
    if let Some(perceptual) = perceptual {
        // One after another: the activations of one full-size pair fill gigabytes, and the network uses all threads.
        let steps = Steps::new(progress, "lpips", pairing.pairs.len());
        for (pair, score) in pairing.pairs.iter().zip(&mut per_image) {
            score.lpips = Some(perceptual_distance(pair, options, perceptual)?);
            steps.step()?;
        }
    }
    let mean = |value: &dyn Fn(&ViewScore) -> f64| per_image.iter().map(value).sum::<f64>() / per_image.len() as f64;
    Ok(ViewsScores {
        protocol: VIEWS_PROTOCOL,
        images: per_image.len(),
        psnr: mean(&|s| s.psnr),
        ssim: mean(&|s| s.ssim),
        lpips: perceptual.map(|_| mean(&|s| s.lpips.unwrap_or(f64::NAN))),
        lpips_net: perceptual.map(PerceptualMetric::name),
        per_image,
        missing: pairing.missing,
        unpaired: pairing.unpaired,
        options: options.clone(),
        warnings,
    })
}

fn score_pair(pair: &Pair, options: &ViewsOptions) -> Result<ViewScore> {
    let (gt, pred, mask) = read_pair(pair, options)?;
    let Similarity { psnr, ssim, .. } = similarity(&pred, &gt, mask.as_ref())
        .ok_or_else(|| InputError::new(&pair.gt, "the mask leaves no pixel of this image"))?;
    Ok(ViewScore { name: pair.name.clone(), psnr, ssim, lpips: None })
}

fn perceptual_distance(pair: &Pair, options: &ViewsOptions, perceptual: &dyn PerceptualMetric) -> Result<f64> {
    let (mut gt, mut pred, mask) = read_pair(pair, options)?;
    for image in [&mut gt, &mut pred] {
        for (pixel, _) in image.data_mut().iter_mut().zip(mask.iter().flat_map(Mask::data)).filter(|(_, m)| !**m) {
            *pixel = [0.0; 3];
        }
    }
    perceptual.distance(&pred, &gt)
}

/// Reads ground truth, prediction and mask, and checks that they have one size.
fn read_pair(pair: &Pair, options: &ViewsOptions) -> Result<(ColorImage, ColorImage, Option<Mask>)> {
    let gt = read_rgb_fraction(&pair.gt)?;
    let pred = read_rgb_fraction(&pair.pred)?;
    if pred.size() != gt.size() {
        let found = format!("{} pixels, but the ground truth {} is {}", pred.size(), pair.gt.display(), gt.size());
        let help = "Render at the size of the ground truth; a resized image would score the resizing";
        return Err(InputError::new(&pair.pred, found).help(help).into());
    }
    let Some(folder) = &options.masks else { return Ok((gt, pred, None)) };
    let path = folder.join(format!("{}.png", pair.name));
    let mask = read_mask_png(&path)?;
    if mask.size() != gt.size() {
        let found = format!("{} pixels, but the image {} is {}", mask.size(), pair.gt.display(), gt.size());
        return Err(InputError::new(path, found).into());
    }
    Ok((gt, pred, Some(mask)))
}
