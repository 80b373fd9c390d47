//! `cameras.npz`: cameras as NeuS, IDR and their descendants read them.

use std::io::{Cursor, Write as _};
use std::path::Path;

use mb_geometry::{Aabb, Camera, Intrinsics, Rigid3, World};
use mb_job::{Error, InputError, Result, write_atomic};
use nalgebra::{Matrix3, Matrix3x4, Matrix4, Point3, Rotation3, UnitQuaternion};
use npyz::WriterBuilder as _;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use crate::Frame;
use crate::import::archive::Archive;

/// How much larger than the object's box the unit sphere of `scale_mat_i` is.
const MARGIN: f64 = 1.1;

/// Writes `world_mat_i` (4x4, `K * cam_from_world`, last row 0 0 0 1) and `scale_mat_i` (4x4, maps the unit sphere to
/// the sphere around `object_in_world`) for every frame, numbered from 0 in their order, as `f64`: in `f32` the product loses a
/// ten-thousandth of a pixel.
///
/// # Errors
/// The file cannot be written.
pub fn write_neus_cameras(path: impl AsRef<Path>, frames: &[Frame], object_in_world: &Aabb) -> Result<()> {
    let path = path.as_ref();
    let fail = |e: std::io::Error| Error::write(path, e);
    let radius = MARGIN * 0.5 * object_in_world.extent().norm();
    let mut scale_mat = Matrix4::from_diagonal_element(radius);
    scale_mat[(3, 3)] = 1.0;
    scale_mat.fixed_view_mut::<3, 1>(0, 3).copy_from(&object_in_world.center().coords);

    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    // A fixed date: the same cameras give the same bytes.
    let options = SimpleFileOptions::default().last_modified_time(zip::DateTime::default());
    for (i, frame) in frames.iter().enumerate() {
        let mut intrinsics = Matrix4::identity();
        intrinsics.fixed_view_mut::<3, 3>(0, 0).copy_from(&frame.intrinsics.to_matrix());
        let world_mat = intrinsics * frame.world_from_cam.inverse().to_matrix();
        for (name, matrix) in [("world_mat", &world_mat), ("scale_mat", &scale_mat)] {
            archive.start_file(format!("{name}_{i}.npy"), options).map_err(|e| fail(e.into()))?;
            archive.write_all(&npy_bytes(matrix).map_err(fail)?).map_err(fail)?;
        }
    }
    write_atomic(path, archive.finish().map_err(|e| fail(e.into()))?.get_ref())
}

/// A sphere around the object, in the world frame, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectSphere {
    /// Its centre.
    pub center: Point3<f64>,
    /// Its radius.
    pub radius_m: f64,
}

/// Reads the sphere of `scale_mat_0`, in which NeuS and its descendants look for the object.
///
/// # Errors
/// The file is damaged, has no such matrix, or the matrix does not turn the unit sphere into a sphere.
pub fn read_neus_sphere(path: impl AsRef<Path>) -> Result<ObjectSphere> {
    let path = path.as_ref();
    let wrong = |found: String| InputError::new(path, found).at("scale_mat_0".to_owned());
    let m = read_matrix(&Archive::open(path)?.read("scale_mat_0.npy")?).map_err(wrong)?;
    let linear: Matrix3<f64> = m.fixed_view::<3, 3>(0, 0).into();
    let squares = linear.transpose() * linear;
    let radius_m = (squares.trace() / 3.0).sqrt();
    let is_sphere = (squares - Matrix3::identity() * radius_m.powi(2)).amax() <= 1e-4 * radius_m.powi(2);
    if !(m.iter().all(|v| v.is_finite()) && radius_m > 0.0 && is_sphere) {
        return Err(wrong("turns the unit sphere into something else than a sphere".to_owned()).into());
    }
    Ok(ObjectSphere { center: Point3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)]), radius_m })
}

/// A 4x4 array in NumPy's format.
fn npy_bytes(matrix: &Matrix4<f64>) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut array = npyz::WriteOptions::new().default_dtype().shape(&[4, 4]).writer(&mut bytes).begin_nd()?;
    // nalgebra iterates by columns, the file runs by rows.
    array.extend(matrix.transpose().iter().copied())?;
    array.finish()?;
    Ok(bytes)
}

/// A 4x4 array of floats in NumPy's format.
pub(crate) fn read_matrix(bytes: &[u8]) -> std::result::Result<Matrix4<f64>, String> {
    let damaged = |e: std::io::Error| format!("the array is damaged ({e})");
    let file = npyz::NpyFile::new(bytes).map_err(damaged)?;
    if file.shape() != [4, 4] {
        return Err(format!("an array of shape {:?}, expected 4 by 4", file.shape()));
    }
    let order = file.order();
    let values: Vec<f64> = match file.try_data::<f64>() {
        Ok(values) => values.collect::<std::io::Result<_>>().map_err(damaged)?,
        Err(file) => {
            let values = file.try_data::<f32>().map_err(|_| "an array of something else than floats".to_owned())?;
            values.map(|v| v.map(f64::from)).collect::<std::io::Result<_>>().map_err(damaged)?
        }
    };
    let matrix = Matrix4::from_row_slice(&values);
    Ok(if order == npyz::Order::Fortran { matrix.transpose() } else { matrix })
}

/// Intrinsics and pose of a projection `K * [R t]`, known up to its scale, by RQ decomposition. `None` where it is singular or
/// skewed by more than a thousandth of the focal length.
pub(crate) fn split_projection(p: &Matrix3x4<f64>) -> Option<(Intrinsics, Rigid3<Camera, World>)> {
    if !p.iter().all(|v| v.is_finite()) {
        return None;
    }
    let block: Matrix3<f64> = p.fixed_view::<3, 3>(0, 0).into();
    let sign = block.determinant().signum();
    // (J M)^T = Q U gives M = (J U^T J) (J Q^T), J the matrix that reverses rows.
    let reversed = Matrix3::from_rows(&[block.row(2), block.row(1), block.row(0)]) * sign;
    let qr = reversed.transpose().qr();
    let (q, u) = (qr.q(), qr.r());
    let mut k = Matrix3::from_fn(|row, column| u[(2 - column, 2 - row)]);
    let mut rotation = Matrix3::from_fn(|row, column| q[(column, 2 - row)]);
    for i in 0..3 {
        if k[(i, i)] < 0.0 {
            k.column_mut(i).neg_mut();
            rotation.row_mut(i).neg_mut();
        }
    }
    let scale = k[(2, 2)];
    if k.diagonal().amin() <= 1e-12 * k.amax() {
        return None;
    }
    let translation = k.try_inverse()? * p.column(3) * sign;
    k /= scale;
    if k[(0, 1)].abs() > 1e-3 * k[(0, 0)] {
        return None;
    }
    let intrinsics = Intrinsics { fx: k[(0, 0)], fy: k[(1, 1)], cx: k[(0, 2)], cy: k[(1, 2)] };
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Some((intrinsics, Rigid3::from_parts(rotation, translation)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FrameId;
    use nalgebra::{Point3, Vector3, Vector6};
    use npyz::npz::NpzArchive;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_projection_comes_apart_into_what_it_was_made_of(
            v in prop::array::uniform6(-2.5..2.5f64), fx in 200.0..2000.0f64, ratio in 0.8..1.2f64,
            cx in -50.0..900.0f64, cy in -50.0..900.0f64, scale in prop_oneof![-3.0..-0.1f64, 0.1..3.0f64],
        ) {
            let k = Intrinsics { fx, fy: fx * ratio, cx, cy };
            let cam_from_world = Rigid3::<Camera, World>::exp(&Vector6::from(v));
            let projection: Matrix3x4<f64> =
                (k.to_matrix() * cam_from_world.to_matrix().fixed_view::<3, 4>(0, 0)) * scale;
            let (found_k, found) = split_projection(&projection).unwrap();
            prop_assert!((found_k.to_matrix() - k.to_matrix()).amax() < 1e-9);
            prop_assert!((found.to_matrix() - cam_from_world.to_matrix()).amax() < 1e-12);
        }
    }

    #[test]
    fn the_product_of_both_matrices_projects_the_unit_sphere_into_the_photograph() {
        let frame = Frame {
            id: FrameId(7),
            intrinsics: Intrinsics { fx: 1460.0, fy: 1461.0, cx: 960.0, cy: 720.0 },
            world_from_cam: Rigid3::exp(&Vector6::new(0.1, -0.2, 0.3, 0.4, 0.5, -0.6)),
            image: None,
            arkit_depth: None,
        };
        let object = Aabb { min: Point3::new(0.3, 0.4, 0.1), max: Point3::new(0.5, 0.5, 0.3) };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cameras.npz");
        write_neus_cameras(&path, std::slice::from_ref(&frame), &object).unwrap();

        let mut npz = NpzArchive::open(&path).unwrap();
        let mut read = |name: &str| {
            let values: Vec<f64> = npz.by_name(name).unwrap().unwrap().into_vec().unwrap();
            Matrix4::from_row_iterator(values)
        };
        let projection = read("world_mat_0") * read("scale_mat_0");
        // The sphere's north pole, by hand.
        let radius = 1.1 * 0.5 * Vector3::new(0.2f64, 0.1, 0.2).norm();
        let p_in_world = Point3::new(0.4, 0.45 + radius, 0.2);
        let expected = frame.intrinsics.img_from_cam(&(frame.world_from_cam.inverse() * p_in_world)).unwrap();
        let found = projection * nalgebra::Vector4::new(0.0, 1.0, 0.0, 1.0);
        assert!((found.x / found.z - expected.x).abs() < 1e-9 && (found.y / found.z - expected.y).abs() < 1e-9);

        let sphere = read_neus_sphere(&path).unwrap();
        assert!((sphere.center - object.center()).norm() < 1e-12 && (sphere.radius_m - radius).abs() < 1e-12);
    }

    #[test]
    fn a_scale_matrix_that_makes_no_sphere_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("cameras.npz");
        for (matrix, found) in [
            (Matrix4::from_diagonal(&nalgebra::Vector4::new(1.0, 2.0, 1.0, 1.0)), "something else than a sphere"),
            (Matrix4::from_element(f64::NAN), "something else than a sphere"),
        ] {
            let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
            archive.start_file("scale_mat_0.npy", SimpleFileOptions::default()).unwrap();
            archive.write_all(&npy_bytes(&matrix).unwrap()).unwrap();
            std::fs::write(&path, archive.finish().unwrap().get_ref()).unwrap();
            assert!(read_neus_sphere(&path).unwrap_err().to_string().contains(found));
        }
        std::fs::write(&path, b"no archive").unwrap();
        assert!(read_neus_sphere(&path).unwrap_err().to_string().contains("not a readable zip archive"));
    }
}
