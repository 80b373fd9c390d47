//! PyTorch's `.pth` files, without PyTorch and without running what is in them.
//!
//! Since version 1.6 such a file is a zip with a pickle and one member per storage. Before, and so for the weights that
//! LPIPS and torchvision publish, it is a row of pickles (a magic number, a version, the machine's word sizes, the
//! weights, the storages' keys), and behind them each storage as its element count and its numbers.

use std::collections::hash_map::Entry;
use std::collections::{BTreeMap, HashMap};
use std::io::Read as _;
use std::path::Path;

use mb_capture::pickle::{Callable, Fault, Pickle, StorageType, Tensor as View, Value};
use mb_job::{InputError, Result};

use crate::safetensors::decoder;
use crate::tensors::Tensor;

/// A pickle of the number 0x1950a86a20f9469cfc6c.
const LEGACY_MAGIC: &[u8] = b"\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.";
const ZIP_MAGIC: &[u8] = b"PK\x03\x04";

/// Whether the bytes begin like a file of PyTorch, old or new.
pub(crate) fn is_torch_file(bytes: &[u8]) -> bool {
    bytes.starts_with(LEGACY_MAGIC) || bytes.starts_with(ZIP_MAGIC)
}

/// Reads every tensor of a pickled dictionary as f32.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<BTreeMap<String, Tensor>> {
    if bytes.starts_with(ZIP_MAGIC) { read_zip(path, bytes) } else { read_legacy(path, bytes) }
}

fn read_zip(path: &Path, bytes: &[u8]) -> Result<BTreeMap<String, Tensor>> {
    let damaged = |e: zip::result::ZipError| InputError::new(path, format!("the archive is damaged ({e})"));
    let mut archive = zip::ZipArchive::new(std::io::Cursor::new(bytes)).map_err(damaged)?;
    let names: Vec<String> = archive.file_names().filter_map(|name| Some(name.ok()?.into_owned())).collect();
    let pickle = names.iter().find(|name| name.ends_with("/data.pkl") || *name == "data.pkl");
    let folder = pickle.and_then(|name| name.strip_suffix("data.pkl")).ok_or_else(|| {
        InputError::new(path, "a zip archive without data.pkl").help("Expected a file that torch.save wrote")
    })?;
    // PyTorch stores its members without compression, so none is larger than the file.
    let mut member = |name: &str| -> Result<Vec<u8>> {
        let file = archive.by_name(name).map_err(|e| InputError::new(path, e.to_string()).at(name.to_owned()))?;
        let mut content = Vec::new();
        file.take(bytes.len() as u64 + 1).read_to_end(&mut content).map_err(|e| InputError::unreadable(path, &e))?;
        if content.len() > bytes.len() {
            return Err(InputError::new(path, "larger than the whole archive").at(name.to_owned()).into());
        }
        Ok(content)
    };
    let pickle = Pickle::read(&member(&format!("{folder}data.pkl"))?).map_err(|fault| bad_pickle(path, &fault))?;
    let mut storages = HashMap::new();
    for (_, view) in views(path, &pickle)? {
        let (key, _) = storage_of(path, &pickle, view)?;
        if let Entry::Vacant(storage) = storages.entry(key) {
            let content = member(&format!("{folder}data/{}", storage.key()))?;
            storage.insert(content);
        }
    }
    tensors(path, &pickle, |key| storages.get(key).map(Vec::as_slice))
}

fn read_legacy(path: &Path, bytes: &[u8]) -> Result<BTreeMap<String, Tensor>> {
    let mut rest = &bytes[LEGACY_MAGIC.len()..];
    let mut next = || -> Result<Pickle> {
        let (pickle, length) = Pickle::read_prefix(rest).map_err(|fault| bad_pickle(path, &fault))?;
        rest = &rest[length..];
        Ok(pickle)
    };
    let (_version, _word_sizes) = (next()?, next()?);
    let pickle = next()?;
    let keys = next()?;
    let Value::Items(keys_in_order) = keys.root() else {
        return Err(InputError::new(path, "no list of storages where PyTorch writes it").into());
    };
    let mut types = HashMap::new();
    for (_, view) in views(path, &pickle)? {
        let (key, kind) = storage_of(path, &pickle, view)?;
        types.insert(key, kind);
    }
    let truncated = || InputError::new(path, "the file ends too early; it is truncated");
    let mut storages = HashMap::new();
    for &key in keys_in_order {
        let key = text(keys.get(key)).ok_or_else(|| InputError::new(path, "a storage whose key is no text"))?;
        let count = rest.first_chunk::<8>().map(|b| u64::from_le_bytes(*b)).ok_or_else(truncated)?;
        let Some((size, _)) = types.get(&key).copied().and_then(decoder_of) else {
            return Err(InputError::new(path, "a storage that holds no floating-point numbers, or no weights").into());
        };
        let length = usize::try_from(count).ok().and_then(|n| n.checked_mul(size)).ok_or_else(truncated)?;
        let content = rest[8..].get(..length).ok_or_else(truncated)?;
        rest = &rest[8 + length..];
        storages.insert(key, content);
    }
    tensors(path, &pickle, |key| storages.get(key).copied())
}

fn bad_pickle(path: &Path, fault: &Fault) -> InputError {
    InputError::new(path, format!("the pickle has {}", fault.found))
        .at(format!("byte {} of it", fault.byte))
        .help("Expected a state_dict: a dictionary of weights, saved with torch.save")
}

fn text(value: &Value) -> Option<String> {
    match value {
        Value::Text(text) => Some(text.clone()),
        Value::Bytes(bytes) => String::from_utf8(bytes.clone()).ok(),
        _ => None,
    }
}

/// The tensors of the dictionary that the pickle stands for, by name.
fn views<'a>(path: &Path, pickle: &'a Pickle) -> Result<Vec<(String, &'a View)>> {
    let Value::Dict(entries) = pickle.root() else {
        return Err(InputError::new(path, "not a dictionary of weights").help("Save `model.state_dict()`").into());
    };
    let tensor = |&(name, value): &(usize, usize)| match pickle.get(value) {
        Value::Tensor(view) => Some((text(pickle.get(name))?, view)),
        _ => None,
    };
    Ok(entries.iter().filter_map(tensor).collect())
}

/// Key and number type of a tensor's storage.
fn storage_of(path: &Path, pickle: &Pickle, view: &View) -> Result<(String, StorageType)> {
    let parts = match pickle.get(view.storage) {
        Value::Persistent(reference) => match pickle.get(*reference) {
            Value::Items(parts) => parts.as_slice(),
            _ => &[],
        },
        _ => &[],
    };
    let part = |i: usize| parts.get(i).map(|&id| pickle.get(id));
    match (part(1), part(2).and_then(text)) {
        (Some(Value::Callable(Callable::Storage(kind))), Some(key)) => Ok((key, *kind)),
        _ => Err(InputError::new(path, "a tensor whose storage is not described").into()),
    }
}

/// Reads one number.
type Decode = fn(&[u8]) -> f32;

/// Bytes per number, and how to read one.
fn decoder_of(kind: StorageType) -> Option<(usize, Decode)> {
    decoder(match kind {
        StorageType::F16 => "F16",
        StorageType::BF16 => "BF16",
        StorageType::F32 => "F32",
        StorageType::F64 => "F64",
        StorageType::Other => return None,
    })
}

fn tensors<'a>(
    path: &Path,
    pickle: &Pickle,
    storage: impl Fn(&str) -> Option<&'a [u8]>,
) -> Result<BTreeMap<String, Tensor>> {
    let mut tensors = BTreeMap::new();
    for (name, view) in views(path, pickle)? {
        let (key, kind) = storage_of(path, pickle, view)?;
        let fault = |found: &str| InputError::new(path, found.to_owned()).at(name.clone());
        // Counters of batches and the like are integers, which LPIPS has no use for.
        let Some((size, decode)) = decoder_of(kind) else { continue };
        let bytes = storage(&key).ok_or_else(|| fault("its numbers are missing"))?;
        if !is_contiguous(view) {
            return Err(fault("is a strided view").help("Save it with `.contiguous()`").into());
        }
        let count = view.shape.iter().try_fold(size, |n, &d| n.checked_mul(d));
        let start = view.offset.checked_mul(size);
        let raw = start.zip(count).and_then(|(start, count)| bytes.get(start..start.checked_add(count)?));
        let raw = raw.ok_or_else(|| fault("reaches beyond its numbers; the file is truncated"))?;
        tensors.insert(name, Tensor { shape: view.shape.clone(), data: raw.chunks_exact(size).map(decode).collect() });
    }
    Ok(tensors)
}

/// Whether the last index runs fastest, without gaps.
fn is_contiguous(view: &View) -> bool {
    let mut expected = 1usize;
    view.shape.len() == view.stride.len()
        && view.shape.iter().zip(&view.stride).rev().all(|(&size, &stride)| {
            let fits = size <= 1 || stride == expected;
            expected = expected.saturating_mul(size);
            fits
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const OLD: &[u8] = include_bytes!("../testdata/old.pth");
    const NEW: &[u8] = include_bytes!("../testdata/new.pth");

    #[test]
    fn both_generations_of_files_hold_the_same_tensors() {
        for bytes in [OLD, NEW] {
            assert!(is_torch_file(bytes));
            let tensors = read(Path::new("weights.pth"), bytes).unwrap();
            assert_eq!(tensors.len(), 2);
            let weight = &tensors["features.0.weight"];
            assert_eq!((weight.shape.as_slice(), weight.data.as_slice()), (&[2, 3][..], &[1., 2., 3., 4., 5., 6.][..]));
            assert_eq!(tensors["features.0.bias"].data, [-0.5, 0.25]);
        }
    }

    #[test]
    fn every_truncation_is_an_error() {
        for bytes in [OLD, NEW] {
            for length in LEGACY_MAGIC.len()..bytes.len() {
                assert!(read(Path::new("weights.pth"), &bytes[..length]).is_err(), "{length} of {} bytes", bytes.len());
            }
        }
    }

    proptest! {
        #[test]
        fn damage_ends_in_tensors_or_an_error(at in 15usize..400, byte in any::<u8>()) {
            for bytes in [OLD, NEW] {
                let mut bytes = bytes.to_vec();
                let at = at % bytes.len();
                bytes[at] = byte;
                if is_torch_file(&bytes) {
                    let _ = read(Path::new("weights.pth"), &bytes);
                }
            }
        }
    }
}
