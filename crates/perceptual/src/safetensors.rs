//! safetensors files: eight bytes of header length, a JSON header, and the arrays behind it.

use std::collections::BTreeMap;
use std::path::Path;

use mb_job::{InputError, Result, write_atomic_with};
use serde::Deserialize;

use crate::tensors::{Tensor, Tensors};

/// Headers of real files have some kilobytes.
const MAX_HEADER_BYTES: u64 = 1 << 24;

#[derive(Deserialize)]
struct Entry {
    dtype: String,
    shape: Vec<usize>,
    data_offsets: [usize; 2],
}

/// Reads every floating-point array as f32.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<BTreeMap<String, Tensor>> {
    let neither = || {
        InputError::new(path, "neither a safetensors nor a PyTorch file")
            .help("Weights come as .safetensors or as the original .pth")
    };
    let length = bytes.first_chunk::<8>().map(|b| u64::from_le_bytes(*b)).filter(|&l| l <= MAX_HEADER_BYTES);
    let length = length.ok_or_else(neither)? as usize;
    let header = bytes.get(8..8 + length).ok_or_else(neither)?;
    let data = &bytes[8 + length..];
    let header: BTreeMap<String, serde_json::Value> = serde_json::from_slice(header).map_err(|_| neither())?;
    let mut tensors = BTreeMap::new();
    let mut left = data.len();
    for (name, entry) in header {
        if name == "__metadata__" {
            continue;
        }
        let fault = |found: String| InputError::new(path, found).at(name.clone());
        let entry: Entry = serde_json::from_value(entry).map_err(|e| fault(e.to_string()))?;
        let raw = data
            .get(entry.data_offsets[0]..entry.data_offsets[1])
            .ok_or_else(|| fault("the file ends too early; it is truncated".to_owned()))?;
        let Some((size, decode)) = decoder(&entry.dtype) else {
            return Err(fault(format!("numbers of type {}", entry.dtype))
                .help("Expected F16, BF16, F32 or F64")
                .into());
        };
        let count = entry.shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d));
        if count.and_then(|n| n.checked_mul(size)) != Some(raw.len()) {
            return Err(fault(format!("{} bytes for the shape {:?}", raw.len(), entry.shape)).into());
        }
        // Arrays do not overlap, so together they are no larger than the file.
        left = left.checked_sub(raw.len()).ok_or_else(|| fault("the arrays overlap".to_owned()))?;
        let data = raw.chunks_exact(size).map(decode).collect();
        tensors.insert(name, Tensor { shape: entry.shape, data });
    }
    Ok(tensors)
}

/// Bytes per number, and how to read one.
pub(crate) type Decoder = (usize, fn(&[u8]) -> f32);

/// How numbers of a type are read; types go by their safetensors names.
pub(crate) fn decoder(dtype: &str) -> Option<Decoder> {
    /// The first bytes of a chunk that has at least as many.
    fn head<const N: usize>(chunk: &[u8]) -> [u8; N] {
        std::array::from_fn(|i| chunk[i])
    }
    Some(match dtype {
        "F16" => (2, |b| f32_from_f16(u16::from_le_bytes(head(b)))),
        "BF16" => (2, |b| f32::from_bits(u32::from(u16::from_le_bytes(head(b))) << 16)),
        "F32" => (4, |b| f32::from_le_bytes(head(b))),
        "F64" => (8, |b| f64::from_le_bytes(head(b)) as f32),
        _ => return None,
    })
}

/// IEEE 754 half precision, subnormal numbers, infinities and NaN included.
fn f32_from_f16(half: u16) -> f32 {
    let sign = if half & 0x8000 == 0 { 1.0 } else { -1.0 };
    let (exponent, fraction) = (i32::from(half >> 10 & 0x1f), f32::from(half & 0x3ff));
    sign * match exponent {
        0 => fraction * 2f32.powi(-24),
        31 => {
            if fraction == 0.0 {
                f32::INFINITY
            } else {
                f32::NAN
            }
        }
        _ => (1024.0 + fraction) * 2f32.powi(exponent - 25),
    }
}

/// Writes all tensors as F32 under their canonical names, through LPIPS's own.
pub(crate) fn write(path: &Path, tensors: &Tensors, name_of: impl Fn(&str) -> String) -> Result<()> {
    let mut header = serde_json::Map::new();
    let mut offset = 0;
    for (name, tensor) in tensors.iter() {
        let end = offset + 4 * tensor.data.len();
        let entry = serde_json::json!({ "dtype": "F32", "shape": tensor.shape, "data_offsets": [offset, end] });
        header.insert(name_of(name), entry);
        offset = end;
    }
    let mut header = serde_json::Value::Object(header).to_string().into_bytes();
    // The arrays begin at a multiple of eight bytes.
    header.resize(header.len().next_multiple_of(8), b' ');
    write_atomic_with(path, |out| {
        out.write_all(&(header.len() as u64).to_le_bytes())?;
        out.write_all(&header)?;
        for (_, tensor) in tensors.iter() {
            for value in &tensor.data {
                out.write_all(&value.to_le_bytes())?;
            }
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_precision_is_exact() {
        for (half, value) in [
            (0x0000, 0.0),
            (0x3c00, 1.0),
            (0xc000, -2.0),
            (0x7bff, 65504.0),
            (0x0001, 5.960_464_5e-8),
            (0x03ff, 6.097_555e-5),
            (0x3555, 0.333_251_95),
        ] {
            assert_eq!(f32_from_f16(half), value, "{half:04x}");
        }
        assert!(f32_from_f16(0x7c00).is_infinite() && f32_from_f16(0x7e00).is_nan());
    }
}
