//! The four scores.

use std::path::{Path, PathBuf};

use mb_eval::{
    DepthOptions, PerceptualMetric, SurfaceOptions, SurfaceProtocol, SurfaceTruth, ViewsOptions,
    evaluate_depth as eval_depth, evaluate_poses as eval_poses, evaluate_surface as eval_surface,
    evaluate_views as eval_views, score_depth, score_surface,
};
use mb_perceptual::{Lpips, LpipsNet};
use numpy::{PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{colour_image, metric_depth};
use crate::calls::{document, run};
use crate::mesh::PyMesh;

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

/// A surface to score.
#[derive(FromPyObject)]
pub enum Surface {
    Memory(Py<PyMesh>),
    File(PathBuf),
}

/// Scores a mesh against the ground truth of a sequence.
#[pyfunction]
#[pyo3(signature = (gt, pred, *, protocol = "mobilebrick-2023", points = None, seed = 0, thresholds_mm = Vec::new()))]
pub fn evaluate_surface<'py>(
    py: Python<'py>,
    gt: PathBuf,
    pred: Surface,
    protocol: &str,
    points: Option<usize>,
    seed: u64,
    thresholds_mm: Vec<f64>,
) -> PyResult<Bound<'py, PyAny>> {
    let protocol: SurfaceProtocol = protocol.parse().map_err(PyValueError::new_err)?;
    let mut options = SurfaceOptions { protocol, seed, more_thresholds_mm: thresholds_mm, ..SurfaceOptions::default() };
    options.points = points.unwrap_or(options.points);
    let scores = run(py, |progress| match &pred {
        Surface::File(path) => eval_surface(&gt, path, &options, progress),
        Surface::Memory(mesh) => {
            let truth = SurfaceTruth::read(&gt, protocol)?;
            score_surface(&truth, mesh.get().mesh.clone(), Path::new("the given mesh"), &options, progress)
        }
    })?;
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

/// The metrics of two depth maps in memory.
#[pyfunction]
pub fn compare_depth<'py>(
    py: Python<'py>,
    gt: PyReadonlyArray2<'py, f32>,
    pred: PyReadonlyArray2<'py, f32>,
) -> PyResult<Bound<'py, PyAny>> {
    let (gt, pred) = (metric_depth(&gt), metric_depth(&pred));
    if gt.size() != pred.size() {
        return Err(PyValueError::new_err(format!("gt is {} pixels, but pred is {}", gt.size(), pred.size())));
    }
    let scores = py.detach(|| score_depth(&[(gt, pred)], &DepthOptions::default()));
    let scores = scores.ok_or_else(|| PyValueError::new_err("no pixel has a depth above 0 on both sides"))?;
    document(py, &scores.mean)
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
