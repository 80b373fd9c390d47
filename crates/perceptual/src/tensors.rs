//! Named arrays of weights, whatever file they came from.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use mb_job::{InputError, Result};

use crate::{safetensors, torch_file};

/// An array of weights.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Tensor {
    pub shape: Vec<usize>,
    /// Row-major, as many as the shape says.
    pub data: Vec<f32>,
}

/// Weights by canonical name: `N.weight`, `N.bias`, `N.squeeze.weight`, ... with torchvision's layer number N,
/// `linK.weight`, and `scaling.shift`, `scaling.scale`.
#[derive(Debug, Clone)]
pub(crate) struct Tensors {
    by_name: BTreeMap<String, Tensor>,
    /// Named in errors.
    path: PathBuf,
}

impl Tensors {
    /// Reads one or more files; later files add to and replace what earlier ones have.
    pub fn read(paths: &[PathBuf]) -> Result<Self> {
        let mut by_name = BTreeMap::new();
        for path in paths {
            let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
            let tensors = if torch_file::is_torch_file(&bytes) {
                torch_file::read(path, &bytes)?
            } else {
                safetensors::read(path, &bytes)?
            };
            by_name.extend(tensors.into_iter().filter_map(|(name, tensor)| Some((canonical(&name)?, tensor))));
        }
        Ok(Self { by_name, path: paths.last().cloned().unwrap_or_default() })
    }

    /// The tensor's values in row-major order.
    pub fn get(&self, name: &str, shape: &[usize]) -> Result<&[f32]> {
        let Some(tensor) = self.by_name.get(name) else {
            return Err(InputError::new(&self.path, format!("the weights {name} are missing"))
                .help(
                    "Give the whole LPIPS state_dict, or both the backbone's file (such as vgg16-397923af.pth) and the \
                     linear layers' (such as lpips/weights/v0.1/vgg.pth), and check that they are for this network",
                )
                .into());
        };
        if tensor.shape != shape {
            return Err(InputError::new(&self.path, format!("has shape {:?}, expected {shape:?}", tensor.shape))
                .at(name.to_owned())
                .help("The weights are for another network")
                .into());
        }
        if let Some(value) = tensor.data.iter().find(|v| !v.is_finite()) {
            return Err(InputError::new(&self.path, format!("holds {value}")).at(name.to_owned()).into());
        }
        Ok(&tensor.data)
    }

    /// Whether a tensor of this name was read.
    pub fn has(&self, name: &str) -> bool {
        self.by_name.contains_key(name)
    }

    /// The last file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// All weights of the features, the linear layers and the scaling, in the order of names.
    pub fn iter(&self) -> impl Iterator<Item = (&str, &Tensor)> {
        self.by_name.iter().map(|(name, tensor)| (name.as_str(), tensor))
    }
}

/// The canonical name of a tensor, or `None` for what LPIPS does not use (a classifier's layers).
///
/// `net.sliceK.N.*` is LPIPS's own name and `features.N.*` torchvision's; the linear layers are `linK.model.1.weight`, and
/// once more `lins.K.model.1.weight` in a whole state_dict.
fn canonical(name: &str) -> Option<String> {
    let name = name.strip_prefix("module.").unwrap_or(name);
    if let Some(rest) = name.strip_prefix("net.slice") {
        return rest.split_once('.').map(|(_, rest)| rest.to_owned());
    }
    if let Some(rest) = name.strip_prefix("features.") {
        return Some(rest.to_owned());
    }
    if let Some(rest) = name.strip_prefix("scaling_layer.") {
        return Some(format!("scaling.{rest}"));
    }
    let rest = name.strip_prefix("lins.").or_else(|| name.strip_prefix("lin"))?;
    let number = rest.strip_suffix(".model.1.weight")?;
    number.bytes().all(|b| b.is_ascii_digit()).then(|| format!("lin{number}.weight"))
}
