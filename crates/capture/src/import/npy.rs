//! Depth and confidence as NumPy arrays, as old Stray Scanner recordings hold them.

use std::path::Path;

use mb_geometry::ImageSize;
use mb_image::{Confidence, DepthImage};
use mb_job::{InputError, Result};
use npyz::{NpyFile, Order, TypeChar};

/// Larger arrays are no depth map.
const MAX_BYTES: u64 = 256 << 20;

/// The values of a `[H, W]` array in row-major order, converted to f32, and whether they were floats.
fn read(path: &Path) -> Result<(ImageSize, Vec<f32>, bool)> {
    let bad = |found: String| InputError::new(path, found);
    let length = std::fs::metadata(path).map_err(|e| InputError::unreadable(path, &e))?.len();
    if length > MAX_BYTES {
        return Err(bad(format!("{length} bytes, more than a depth map can have")).into());
    }
    let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
    let damaged = |e: std::io::Error| bad(format!("the array is damaged or truncated ({e})"));
    let file = NpyFile::new(&bytes[..]).map_err(damaged)?;
    let (&[height, width], Order::C) = (file.shape(), file.order()) else {
        return Err(bad(format!("an array of shape {:?}, expected rows and columns in C order", file.shape())).into());
    };
    // The header may lie about the size; the file cannot.
    if height == 0 || width == 0 || height.checked_mul(width).is_none_or(|n| n > length) {
        return Err(bad(format!("states {height} rows of {width} values, but has {length} bytes")).into());
    }
    let size = ImageSize::new(width as usize, height as usize);
    let npyz::DType::Plain(kind) = file.dtype() else {
        return Err(bad("holds records, expected plain numbers".to_owned()).into());
    };
    let (values, float): (Vec<f32>, bool) = match (kind.type_char(), kind.size_field()) {
        (TypeChar::Uint, 1) => (file.into_vec::<u8>().map_err(damaged)?.into_iter().map(f32::from).collect(), false),
        (TypeChar::Uint, 2) => (file.into_vec::<u16>().map_err(damaged)?.into_iter().map(f32::from).collect(), false),
        (TypeChar::Float, 4) => (file.into_vec::<f32>().map_err(damaged)?, true),
        (TypeChar::Float, 8) => {
            (file.into_vec::<f64>().map_err(damaged)?.into_iter().map(|v| v as f32).collect(), true)
        }
        _ => return Err(bad(format!("numbers of type {kind}, expected uint8, uint16, float32 or float64")).into()),
    };
    Ok((size, values, float))
}

/// Depth in metres: integers are millimetres, floats are metres.
pub(super) fn read_depth(path: &Path) -> Result<DepthImage> {
    let (size, values, float) = read(path)?;
    let scale = if float { 1.0 } else { 1e-3 };
    let values = values.into_iter().map(|v| v * scale).map(|z| if z.is_finite() && z > 0.0 { z } else { 0.0 });
    Ok(DepthImage::from_data(size, values.collect()).expect("an array has as many values as its shape says"))
}

/// Confidence: 0, 1 or 2.
pub(super) fn read_confidence(path: &Path) -> Result<Confidence> {
    let (size, values, _) = read(path)?;
    if let Some(bad) = values.iter().find(|v| ![0.0, 1.0, 2.0].contains(*v)) {
        return Err(InputError::new(path, format!("confidence {bad} found, expected 0, 1 or 2")).into());
    }
    let values = values.into_iter().map(|v| v as u8).collect();
    Ok(Confidence::from_data(size, values).expect("an array has as many values as its shape says"))
}
