//! Poses and intrinsics as text matrices: `pose/*.txt` (4x4, camera-to-world) and `intrinsic/*.txt` (3x3).

use std::fmt::Write as _;
use std::path::Path;

use mb_geometry::{Camera, Intrinsics, Rigid3, RotationDefect, World};
use mb_job::{InputError, Result, write_atomic};
use nalgebra::{DMatrix, Matrix3, Matrix4};

/// Reads a square matrix of numbers, which may be NaN or infinite.
pub(crate) fn read_matrix_txt(path: &Path, size: usize) -> Result<DMatrix<f64>> {
    let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
    let text = std::str::from_utf8(&bytes).map_err(|_| InputError::new(path, "not a text file"))?;
    let mut values = Vec::with_capacity(size * size);
    let mut rows = 0;
    for (i, line) in text.lines().enumerate() {
        let line = line.trim();
        if line.is_empty() {
            continue;
        }
        rows += 1;
        let before = values.len();
        for word in line.split([' ', '\t', ',']).filter(|w| !w.is_empty()) {
            let value: f64 =
                word.parse().map_err(|_| InputError::new(path, format!("'{word}' is not a number")).at_line(i + 1))?;
            values.push(value);
        }
        if values.len() - before != size {
            let found = format!("{} numbers in a row, expected {size}", values.len() - before);
            return Err(InputError::new(path, found).at_line(i + 1).into());
        }
    }
    if rows != size {
        return Err(InputError::new(path, format!("{rows} rows, expected {size}")).into());
    }
    Ok(DMatrix::from_row_slice(size, size, &values))
}

fn write_matrix(path: &Path, matrix: &DMatrix<f64>) -> Result<()> {
    let mut text = String::new();
    for row in matrix.row_iter() {
        let words: Vec<String> = row.iter().map(|v| format!("{v:.17e}")).collect();
        let _ = writeln!(text, "{}", words.join(" "));
    }
    write_atomic(path, text.as_bytes())
}

/// Reads a camera-to-world matrix. Rotations that are slightly off are mended; the defect is returned.
///
/// # Errors
/// The file is missing, not 4x4 numbers, or not a rigid transform.
pub fn read_pose_txt(path: impl AsRef<Path>) -> Result<(Rigid3<World, Camera>, RotationDefect)> {
    let path = path.as_ref();
    let matrix: Matrix4<f64> = read_matrix_txt(path, 4)?.fixed_view::<4, 4>(0, 0).into();
    Rigid3::from_matrix(&matrix).ok_or_else(|| {
        InputError::new(path, "not a rigid transform (rotation, translation in metres, last row 0 0 0 1)")
            .help("Poses are 4x4 camera-to-world matrices with OpenCV camera axes")
            .into()
    })
}

/// Reads a 3x3 intrinsic matrix.
///
/// # Errors
/// The file is missing, not 3x3 numbers, or no pinhole camera (singular, skewed).
pub fn read_intrinsics_txt(path: impl AsRef<Path>) -> Result<Intrinsics> {
    let path = path.as_ref();
    let matrix: Matrix3<f64> = read_matrix_txt(path, 3)?.fixed_view::<3, 3>(0, 0).into();
    Intrinsics::from_matrix(&matrix).map_err(|e| InputError::new(path, e.to_string()).into())
}

/// Writes a camera-to-world matrix with all its digits.
///
/// # Errors
/// The file cannot be written.
pub fn write_pose_txt(path: impl AsRef<Path>, world_from_cam: &Rigid3<World, Camera>) -> Result<()> {
    write_matrix(path.as_ref(), &DMatrix::from_iterator(4, 4, world_from_cam.to_matrix().iter().copied()))
}

/// Writes an intrinsic matrix with all its digits.
///
/// # Errors
/// The file cannot be written.
pub fn write_intrinsics_txt(path: impl AsRef<Path>, intrinsics: &Intrinsics) -> Result<()> {
    write_matrix(path.as_ref(), &DMatrix::from_iterator(3, 3, intrinsics.to_matrix().iter().copied()))
}
