//! The four scores.

use std::path::PathBuf;

use mb_eval::{
    DepthOptions, PerceptualMetric, SurfaceOptions, SurfaceProtocol, ViewsOptions, evaluate_depth as eval_depth,
    evaluate_poses as eval_poses, evaluate_surface as eval_surface, evaluate_views as eval_views,
};
use mb_perceptual::{Lpips, LpipsNet};
use numpy::PyReadonlyArray3;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::colour_image;
use crate::calls::{document, run};

/// One file, or several that belong together.
#[derive(FromPyObject)]
pub enum Paths {
    One(PathBuf),
    Many(Vec<PathBuf>),
}

impl From<Paths> for Vec<PathBuf> {
    fn from(paths: Paths) -> Self {
        match paths {
            Paths::One(path) => vec![path],
            Paths::Many(paths) => paths,
        }
    }
}

/// Scores a mesh against the ground truth of a sequence.
#[pyfunction]
#[pyo3(signature = (gt, pred, *, protocol = "mobilebrick-2023", points = None, seed = 0))]
pub fn evaluate_surface<'py>(
    py: Python<'py>,
    gt: PathBuf,
    pred: PathBuf,
    protocol: &str,
    points: Option<usize>,
    seed: u64,
) -> PyResult<Bound<'py, PyAny>> {
    let protocol = SurfaceProtocol::ALL.into_iter().find(|p| p.name() == protocol).ok_or_else(|| {
        let names = SurfaceProtocol::ALL.map(SurfaceProtocol::name).join(" and ");
        PyValueError::new_err(format!("'{protocol}' is no protocol; there are {names}"))
    })?;
    let mut options = SurfaceOptions { protocol, seed, ..SurfaceOptions::default() };
    options.points = points.unwrap_or(options.points);
    let scores = run(py, |progress| eval_surface(&gt, &pred, &options, progress))?;
    document(py, &scores)
}

/// Scores rendered views against photographs.
#[pyfunction]
#[pyo3(signature = (gt, pred, *, hold_out = None, masks = None, lpips_net = "vgg", lpips_weights = None))]
pub fn evaluate_views<'py>(
    py: Python<'py>,
    gt: PathBuf,
    pred: PathBuf,
    hold_out: Option<usize>,
    masks: Option<PathBuf>,
    lpips_net: &str,
    lpips_weights: Option<Paths>,
) -> PyResult<Bound<'py, PyAny>> {
    let net: LpipsNet = lpips_net.parse().map_err(PyValueError::new_err)?;
    let options = ViewsOptions { hold_out, masks };
    let scores = run(py, |progress| {
        let lpips = lpips_weights.map(|paths| Lpips::read(net, &Vec::from(paths))).transpose()?;
        let perceptual = lpips.as_ref().map(|lpips| lpips as &dyn PerceptualMetric);
        eval_views(&gt, &pred, &options, perceptual, progress)
    })?;
    document(py, &scores)
}

/// Scores depth maps.
#[pyfunction]
#[pyo3(signature = (gt, pred, *, confidence = None))]
pub fn evaluate_depth<'py>(
    py: Python<'py>,
    gt: PathBuf,
    pred: PathBuf,
    confidence: Option<PathBuf>,
) -> PyResult<Bound<'py, PyAny>> {
    let options = DepthOptions { confidence, ..DepthOptions::default() };
    let scores = run(py, |progress| eval_depth(&gt, &pred, &options, progress))?;
    document(py, &scores)
}

/// Scores camera poses.
#[pyfunction]
pub fn evaluate_poses<'py>(py: Python<'py>, gt: PathBuf, pred: PathBuf) -> PyResult<Bound<'py, PyAny>> {
    let scores = run(py, |_| eval_poses(&gt, &pred))?;
    document(py, &scores)
}

/// PSNR and SSIM of two images in memory.
#[pyfunction]
pub fn compare_images<'py>(
    py: Python<'py>,
    gt: PyReadonlyArray3<'py, f32>,
    pred: PyReadonlyArray3<'py, f32>,
) -> PyResult<Bound<'py, PyDict>> {
    let (gt, pred) = (colour_image("gt", &gt)?, colour_image("pred", &pred)?);
    if gt.size() != pred.size() {
        return Err(PyValueError::new_err(format!("gt is {} pixels, but pred is {}", gt.size(), pred.size())));
    }
    let found = py.detach(|| mb_eval::similarity(&pred, &gt, None));
    let found = found.ok_or_else(|| PyValueError::new_err("the images have no pixels"))?;
    let scores = PyDict::new(py);
    scores.set_item("psnr", found.psnr)?;
    scores.set_item("ssim", found.ssim)?;
    Ok(scores)
}
