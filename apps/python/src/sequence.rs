//! Sequences, their frames and alignments.

use std::path::PathBuf;
use std::sync::Arc;

use mb_capture::{Alignment, Frame, Sequence};
use numpy::{PyArray2, PyArray3};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};

use crate::arrays::{colour, intrinsics_matrix, plane, pose_matrix};
use crate::calls::{document, run};

/// A sequence folder. Its frames are read when they are asked for.
#[pyclass(name = "Sequence", frozen, module = "mobilebrick")]
pub struct PySequence {
    pub sequence: Arc<Sequence>,
}

#[pymethods]
impl PySequence {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        Ok(Self { sequence: Arc::new(run(py, |_| Sequence::open(path))?) })
    }

    #[getter]
    fn name(&self) -> String {
        self.sequence.name()
    }

    #[getter]
    fn path(&self) -> PathBuf {
        self.sequence.root().to_owned()
    }

    #[getter]
    fn image_size(&self) -> (usize, usize) {
        (self.sequence.image_size().width, self.sequence.image_size().height)
    }

    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.sequence.warnings().to_vec()
    }

    fn __len__(&self) -> usize {
        self.sequence.frames().len()
    }

    /// An IndexError beyond the end is also what makes `for frame in sequence` end.
    fn __getitem__(&self, index: isize) -> PyResult<PyFrame> {
        let count = self.sequence.frames().len();
        let at = if index < 0 { index + count as isize } else { index };
        let frame = usize::try_from(at).ok().and_then(|at| self.sequence.frames().get(at));
        match frame {
            Some(frame) => Ok(PyFrame { sequence: self.sequence.clone(), frame: frame.clone() }),
            None => Err(PyIndexError::new_err(format!("frame {index} of {count}"))),
        }
    }

    /// Pickles as its path: loaders with several processes open it anew in each.
    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> (Bound<'py, PyType>, (PathBuf,)) {
        (slf.get_type(), (slf.get().sequence.root().to_owned(),))
    }

    fn alignment(&self, py: Python<'_>) -> PyResult<PyAlignment> {
        Ok(PyAlignment { alignment: run(py, |_| self.sequence.read_alignment())? })
    }

    fn __repr__(&self) -> String {
        format!("Sequence({:?}, {} frames)", self.sequence.root().display().to_string(), self.sequence.frames().len())
    }
}

/// One frame of a sequence; images are read from disk at each access.
#[pyclass(name = "Frame", frozen, module = "mobilebrick")]
pub struct PyFrame {
    sequence: Arc<Sequence>,
    frame: Frame,
}

#[pymethods]
impl PyFrame {
    #[getter]
    fn id(&self) -> u32 {
        self.frame.id.0
    }

    #[getter]
    fn intrinsics<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        intrinsics_matrix(py, &self.frame.intrinsics)
    }

    #[getter]
    fn world_from_cam<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        pose_matrix(py, &self.frame.world_from_cam)
    }

    #[getter]
    fn has_image(&self) -> bool {
        self.frame.image.is_some()
    }

    #[getter]
    fn has_depth(&self) -> bool {
        self.frame.arkit_depth.is_some()
    }

    #[getter]
    fn image<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<u8>>> {
        Ok(colour(py, run(py, |_| self.sequence.read_image(&self.frame))?))
    }

    #[getter]
    fn depth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        Ok(plane(py, run(py, |_| self.sequence.read_arkit_depth(&self.frame))?.0))
    }

    #[getter]
    fn confidence<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<u8>>> {
        Ok(plane(py, run(py, |_| self.sequence.read_arkit_depth(&self.frame))?.1))
    }

    #[getter]
    fn gt_depth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        Ok(plane(py, run(py, |_| self.sequence.read_gt_depth(&self.frame))?))
    }

    #[getter]
    fn mask<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<bool>>> {
        Ok(plane(py, run(py, |_| self.sequence.read_mask(&self.frame))?))
    }

    fn __repr__(&self) -> String {
        format!("Frame({}, {:?})", self.frame.id.0, self.sequence.name())
    }
}

/// Where the object and the cameras are, as a stage of alignment found them.
#[pyclass(name = "Alignment", frozen, module = "mobilebrick")]
pub struct PyAlignment {
    alignment: Alignment,
}

#[pymethods]
impl PyAlignment {
    #[new]
    fn new(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        Ok(Self { alignment: run(py, |_| Alignment::read(&path))? })
    }

    #[getter]
    fn stage<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        document(py, &self.alignment.stage)
    }

    #[getter]
    fn rms_px(&self) -> Option<f64> {
        self.alignment.rms_px
    }

    #[getter]
    fn world_from_object<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        pose_matrix(py, &self.alignment.world_from_object)
    }

    #[getter]
    fn world_from_cam<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let cameras = PyDict::new(py);
        for camera in &self.alignment.frames {
            cameras.set_item(camera.frame.0, pose_matrix(py, &camera.world_from_cam))?;
        }
        Ok(cameras)
    }
}
