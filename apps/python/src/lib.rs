//! Python bindings: the only crate that knows Python.
//!
//! Each function calls one function of the library beside it, in a thread of its own with the interpreter released, and
//! hands its document back as plain dictionaries, its images as NumPy arrays. Errors carry the library's sentences.
//! `python/mobilebrick/__init__.pyi` is the reference of the interface.

mod arrays;
mod calls;
mod mesh;
mod scores;
mod sequence;

use pyo3::prelude::*;

/// The native part of the package `mobilebrick`.
#[pymodule]
fn _native(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    module.add("__version__", env!("CARGO_PKG_VERSION"))?;
    module.add("InputError", py.get_type::<calls::InputError>())?;
    module.add_class::<sequence::PySequence>()?;
    module.add_class::<sequence::PyFrame>()?;
    module.add_class::<sequence::PyAlignment>()?;
    module.add_class::<mesh::PyMesh>()?;
    module.add_class::<mesh::PyModel>()?;
    module.add_function(wrap_pyfunction!(scores::evaluate_surface, module)?)?;
    module.add_function(wrap_pyfunction!(scores::evaluate_views, module)?)?;
    module.add_function(wrap_pyfunction!(scores::evaluate_depth, module)?)?;
    module.add_function(wrap_pyfunction!(scores::evaluate_poses, module)?)?;
    module.add_function(wrap_pyfunction!(scores::compare_depth, module)?)?;
    module.add_function(wrap_pyfunction!(scores::compare_images, module)?)?;
    module.add_function(wrap_pyfunction!(mesh::render_depth, module)?)?;
    module.add_function(wrap_pyfunction!(mesh::fuse_tsdf, module)?)?;
    module.add_function(wrap_pyfunction!(mesh::load_model, module)?)?;
    Ok(())
}
