//! NumPy arrays to images and matrices, and back. Arrays that go out take over the image's memory.

use mb_eval::MetricDepth;
use mb_geometry::{Camera, ImageSize, Intrinsics, Rigid3};
use mb_image::Image;
use nalgebra::{Matrix3, Matrix4};
use numpy::ndarray::{Array2, Array3};
use numpy::{IntoPyArray, PyArray2, PyArray3, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// `[H, W]` from an image of one value per pixel.
pub fn plane<T: numpy::Element>(py: Python<'_>, image: Image<T>) -> Bound<'_, PyArray2<T>> {
    let shape = (image.height(), image.width());
    let array = Array2::from_shape_vec(shape, image.into_data()).expect("an image has as many pixels as its size says");
    array.into_pyarray(py)
}

/// `[H, W, 3]` from an image of three values per pixel.
pub fn colour<T: numpy::Element>(py: Python<'_>, image: Image<[T; 3]>) -> Bound<'_, PyArray3<T>> {
    let shape = (image.height(), image.width(), 3);
    let array =
        Array3::from_shape_vec(shape, image.into_data().into_flattened()).expect("an image has three values a pixel");
    array.into_pyarray(py)
}

/// An image in [0, 1] from `[H, W, 3]`.
pub fn colour_image(name: &str, array: &PyReadonlyArray3<'_, f32>) -> PyResult<Image<[f32; 3]>> {
    let view = array.as_array();
    let (height, width, channels) = view.dim();
    if channels != 3 || height * width == 0 {
        return Err(PyValueError::new_err(format!("{name} has shape {:?}, expected (height, width, 3)", view.shape())));
    }
    if let Some(value) = view.iter().find(|v| !(0.0..=1.0).contains(*v)) {
        return Err(PyValueError::new_err(format!("{name} holds {value}; colours are fractions from 0 to 1")));
    }
    Ok(Image::from_fn(ImageSize::new(width, height), |x, y| std::array::from_fn(|c| view[(y, x, c)])))
}

/// Depth in metres from `[H, W]`.
pub fn metric_depth(array: &PyReadonlyArray2<'_, f32>) -> MetricDepth {
    let view = array.as_array();
    let (height, width) = view.dim();
    Image::from_fn(ImageSize::new(width, height), |x, y| f64::from(view[(y, x)]))
}

/// A 4x4 matrix, row by row.
pub fn pose_matrix<'py, To, From>(py: Python<'py>, pose: &Rigid3<To, From>) -> Bound<'py, PyArray2<f64>> {
    let matrix = pose.to_matrix();
    Array2::from_shape_fn((4, 4), |at| matrix[at]).into_pyarray(py)
}

/// A rigid transform from a 4x4 matrix.
pub fn pose<To>(name: &str, array: &PyReadonlyArray2<'_, f64>) -> PyResult<Rigid3<To, Camera>> {
    let view = array.as_array();
    let fault = || {
        PyValueError::new_err(format!(
            "{name} is not a rigid transform: a 4x4 matrix of rotation and translation in metres, last row 0 0 0 1"
        ))
    };
    if view.dim() != (4, 4) {
        return Err(fault());
    }
    let matrix = Matrix4::from_fn(|row, col| view[(row, col)]);
    Rigid3::from_matrix(&matrix).map(|(pose, _)| pose).ok_or_else(fault)
}

/// The 3x3 matrix.
pub fn intrinsics_matrix<'py>(py: Python<'py>, intrinsics: &Intrinsics) -> Bound<'py, PyArray2<f64>> {
    let matrix = intrinsics.to_matrix();
    Array2::from_shape_fn((3, 3), |at| matrix[at]).into_pyarray(py)
}

/// Pinhole intrinsics from a 3x3 matrix.
pub fn intrinsics(array: &PyReadonlyArray2<'_, f64>) -> PyResult<Intrinsics> {
    let view = array.as_array();
    if view.dim() != (3, 3) {
        return Err(PyValueError::new_err(format!("intrinsics have shape {:?}, expected (3, 3)", view.shape())));
    }
    let matrix = Matrix3::from_fn(|row, col| view[(row, col)]);
    Intrinsics::from_matrix(&matrix).map_err(|e| PyValueError::new_err(format!("intrinsics: {e}")))
}
