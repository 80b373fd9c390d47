//! `cameras.npz`: cameras as NeuS, IDR and their descendants read them.

use std::io::{Cursor, Write as _};
use std::path::Path;

use mb_geometry::Aabb;
use mb_job::{Error, Result, write_atomic};
use nalgebra::Matrix4;
use npyz::WriterBuilder as _;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use crate::Frame;

/// How much larger than the object's box the unit sphere of `scale_mat_i` is.
const MARGIN: f64 = 1.1;

/// Writes `world_mat_i` (4x4, `K * cam_from_world`, last row 0 0 0 1) and `scale_mat_i` (4x4, maps the unit sphere to
/// the sphere around `object_in_world`) for every frame, numbered from 0 in their order, as `f32`.
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

/// A 4x4 `f32` array in NumPy's format.
fn npy_bytes(matrix: &Matrix4<f64>) -> std::io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let mut array = npyz::WriteOptions::new().default_dtype().shape(&[4, 4]).writer(&mut bytes).begin_nd()?;
    // nalgebra iterates by columns, the file runs by rows.
    array.extend(matrix.transpose().iter().map(|v| *v as f32))?;
    array.finish()?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FrameId;
    use mb_geometry::{Intrinsics, Rigid3};
    use nalgebra::{Point3, Vector3, Vector6};
    use npyz::npz::NpzArchive;

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
            let values: Vec<f32> = npz.by_name(name).unwrap().unwrap().into_vec().unwrap();
            Matrix4::from_row_iterator(values.into_iter().map(f64::from))
        };
        let projection = read("world_mat_0") * read("scale_mat_0");
        // The sphere's north pole, by hand.
        let radius = 1.1 * 0.5 * Vector3::new(0.2f64, 0.1, 0.2).norm();
        let p_in_world = Point3::new(0.4, 0.45 + radius, 0.2);
        let expected = frame.intrinsics.img_from_cam(&(frame.world_from_cam.inverse() * p_in_world)).unwrap();
        let found = projection * nalgebra::Vector4::new(0.0, 1.0, 0.0, 1.0);
        assert!((found.x / found.z - expected.x).abs() < 1e-2 && (found.y / found.z - expected.y).abs() < 1e-2);
    }
}
