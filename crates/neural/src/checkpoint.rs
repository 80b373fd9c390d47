//! Checkpoints: everything that a run needs to go on as if it had never stopped.
//!
//! A file is a mark, the length of a JSON header, the header (method, options, data, step, lengths), and the numbers of
//! all buffers, little-endian f32. It appears whole or not at all.

use std::path::Path;

use mb_job::{Error, InputError, Result, write_atomic_with};
use serde::{Deserialize, Serialize};

const MAGIC: &[u8; 16] = b"mb-neural ckpt 2";

/// What a checkpoint belongs to.
#[derive(Debug, Clone, Serialize, Deserialize, PartialEq)]
pub(crate) struct Header {
    pub method: String,
    /// As text: numbers read back from JSON may differ in their last bit.
    pub options: String,
    /// [`crate::dataset::RayDataset::fingerprint`].
    pub data: u64,
    pub step: u64,
    lengths: Vec<usize>,
}

impl Header {
    pub fn new(method: &str, options: &serde_json::Value, data: u64) -> Self {
        Self { method: method.to_owned(), options: options.to_string(), data, step: 0, lengths: Vec::new() }
    }
}

/// Writes a checkpoint.
pub(crate) fn write(path: &Path, header: &Header, step: u64, buffers: &[&mut Vec<f32>]) -> Result<()> {
    let header = Header { step, lengths: buffers.iter().map(|b| b.len()).collect(), ..header.clone() };
    let json = serde_json::to_vec(&header).map_err(|e| Error::write(path, e.into()))?;
    write_atomic_with(path, |out| {
        out.write_all(MAGIC)?;
        out.write_all(&(json.len() as u64).to_le_bytes())?;
        out.write_all(&json)?;
        for buffer in buffers {
            for piece in buffer.chunks(4096) {
                let bytes: Vec<u8> = piece.iter().flat_map(|v| v.to_le_bytes()).collect();
                out.write_all(&bytes)?;
            }
        }
        out.flush()
    })
}

/// Fills the buffers, which take the lengths that they had, and returns the step.
pub(crate) fn read(path: &Path, expected: &Header, buffers: Vec<&mut Vec<f32>>) -> Result<u64> {
    let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
    let rest = bytes.strip_prefix(MAGIC).ok_or_else(|| other(path, "not a checkpoint of this program's version"))?;
    let truncated = || other(path, "the checkpoint is truncated");
    let (length, rest) = rest.split_first_chunk::<8>().ok_or_else(truncated)?;
    let length =
        usize::try_from(u64::from_le_bytes(*length)).ok().filter(|n| *n <= rest.len()).ok_or_else(truncated)?;
    let header: Header =
        serde_json::from_slice(&rest[..length]).map_err(|e| other(path, &format!("damaged header ({e})")))?;
    if header.method != expected.method || header.options != expected.options || header.lengths.len() != buffers.len() {
        return Err(other(path, "the checkpoint belongs to a run with other options").into());
    }
    if header.data != expected.data {
        return Err(other(path, "the checkpoint belongs to other photographs or cameras").into());
    }
    let mut numbers = rest[length..].chunks_exact(4);
    if header.lengths.iter().try_fold(0usize, |sum, n| sum.checked_add(*n)) != Some(numbers.len()) {
        return Err(truncated().into());
    }
    for (buffer, length) in buffers.into_iter().zip(header.lengths) {
        buffer.clear();
        buffer.extend(numbers.by_ref().take(length).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])));
    }
    Ok(header.step)
}

/// An error about a checkpoint, with what to do.
pub(crate) fn other(path: &Path, found: &str) -> InputError {
    InputError::new(path, found).help("Remove it, or name another checkpoint")
}
