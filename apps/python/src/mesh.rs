//! Meshes, brick models, rendering and fusion.

use std::path::PathBuf;

use mb_bricks::{MeshOptions, Model, PartLibrary};
use mb_geometry::{ImageSize, World};
use mb_mesh::TriangleMesh;
use mb_recon::{TsdfOptions, reconstruct_tsdf};
use mb_render::{Scene, View};
use nalgebra::Point3;
use numpy::ndarray::Array2;
use numpy::{IntoPyArray, PyArray2, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

use crate::arrays;
use crate::calls::{document, exception, run};
use crate::sequence::PySequence;

/// Triangles in metres.
#[pyclass(name = "Mesh", frozen, module = "mobilebrick")]
pub struct PyMesh {
    pub mesh: TriangleMesh,
}

#[pymethods]
impl PyMesh {
    #[new]
    #[pyo3(signature = (vertices, triangles = None))]
    fn new(vertices: PyReadonlyArray2<'_, f64>, triangles: Option<PyReadonlyArray2<'_, u32>>) -> PyResult<Self> {
        let none = Array2::zeros((0, 3));
        let vertices = vertices.as_array();
        let triangles = triangles.as_ref().map_or_else(|| none.view(), |triangles| triangles.as_array());
        for (name, shape) in [("vertices", vertices.shape()), ("triangles", triangles.shape())] {
            if shape[1] != 3 {
                return Err(PyValueError::new_err(format!("{name} have shape {shape:?}, expected (n, 3)")));
            }
        }
        if let Some(index) = triangles.iter().find(|&&v| v as usize >= vertices.nrows()) {
            let count = vertices.nrows();
            return Err(PyValueError::new_err(format!("a triangle names vertex {index}, but there are {count}")));
        }
        let vertices = vertices.rows().into_iter().map(|v| Point3::new(v[0], v[1], v[2])).collect();
        let triangles = triangles.rows().into_iter().map(|t| [t[0], t[1], t[2]]).collect();
        Ok(Self { mesh: TriangleMesh::new(vertices, triangles) })
    }

    #[staticmethod]
    fn read(py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        Ok(Self { mesh: run(py, |_| mb_mesh::read_mesh(&path))? })
    }

    fn write(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        run(py, |_| mb_mesh::write_mesh(&path, &self.mesh))
    }

    #[getter]
    fn vertices<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        Array2::from_shape_fn((self.mesh.vertices.len(), 3), |(v, axis)| self.mesh.vertices[v][axis]).into_pyarray(py)
    }

    #[getter]
    fn triangles<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<u32>> {
        Array2::from_shape_fn((self.mesh.triangles.len(), 3), |(t, corner)| self.mesh.triangles[t][corner])
            .into_pyarray(py)
    }

    fn __repr__(&self) -> String {
        format!("Mesh({} vertices, {} triangles)", self.mesh.vertices.len(), self.mesh.triangles.len())
    }
}

/// A brick model.
#[pyclass(name = "Model", frozen, module = "mobilebrick")]
pub struct PyModel {
    model: Model,
}

#[pymethods]
impl PyModel {
    fn info<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        document(py, &self.model.info())
    }

    #[pyo3(signature = (*, clearance_mm = 0.0))]
    fn mesh(&self, py: Python<'_>, clearance_mm: f64) -> PyMesh {
        PyMesh { mesh: py.detach(|| self.model.mesh(&MeshOptions { clearance_mm })) }
    }
}

/// Reads a brick model, with parts from the official library's folder or zip where one is given.
#[pyfunction]
#[pyo3(signature = (path, *, parts = None))]
pub fn load_model(py: Python<'_>, path: PathBuf, parts: Option<PathBuf>) -> PyResult<PyModel> {
    let model = run(py, |_| {
        let library = parts.map(PartLibrary::open).transpose()?;
        Model::read(path, library.as_ref())
    })?;
    Ok(PyModel { model })
}

/// Exact depth of a mesh, `[H, W]` in metres, 0 = nothing there.
#[pyfunction]
pub fn render_depth<'py>(
    py: Python<'py>,
    mesh: &PyMesh,
    intrinsics: PyReadonlyArray2<'py, f64>,
    frame_from_cam: PyReadonlyArray2<'py, f64>,
    size: (usize, usize),
) -> PyResult<Bound<'py, PyArray2<f32>>> {
    let (width, height) = size;
    let pixels = width.checked_mul(height).filter(|n| (1..=mb_image::MAX_PIXELS).contains(n));
    if pixels.is_none() {
        return Err(PyValueError::new_err(format!("an image of {width}x{height} pixels")));
    }
    let frame_from_cam = arrays::pose::<World>("frame_from_cam", &frame_from_cam)?;
    let view = View {
        intrinsics: arrays::intrinsics(&intrinsics)?,
        size: ImageSize::new(width, height),
        cam_from_frame: frame_from_cam.inverse(),
    };
    let depth = py.detach(|| Scene::new(&mesh.mesh).depth(&view));
    Ok(arrays::plane(py, depth))
}

/// Fuses a sequence's phone depth into a mesh in its world frame.
#[pyfunction]
#[pyo3(signature = (sequence, **options))]
pub fn fuse_tsdf<'py>(
    py: Python<'py>,
    sequence: &PySequence,
    options: Option<Bound<'py, pyo3::types::PyDict>>,
) -> PyResult<(PyMesh, Bound<'py, PyAny>)> {
    let options: TsdfOptions = match options {
        Some(options) => {
            let text: String = py.import("json")?.call_method1("dumps", (options,))?.extract()?;
            serde_json::from_str(&text).map_err(|e| PyValueError::new_err(e.to_string()))?
        }
        None => TsdfOptions::default(),
    };
    options.validate().map_err(exception)?;
    let (mesh, summary) = run(py, |progress| reconstruct_tsdf(&sequence.sequence, &options, progress))?;
    Ok((PyMesh { mesh }, document(py, &summary)?))
}
