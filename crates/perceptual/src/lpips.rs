//! The distance itself.

use std::path::{Path, PathBuf};
use std::str::FromStr;

use mb_eval::{ColorImage, PerceptualMetric};
use mb_job::{Error, InputError, Result};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::activation::Activation;
use crate::network::{self, Slice};
use crate::safetensors;
use crate::tensors::Tensors;

/// Which network looks at the images. Distances of different networks cannot be compared; the paper's tables use VGG.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LpipsNet {
    /// VGG-16, five features.
    Vgg,
    /// AlexNet, five features.
    Alex,
    /// SqueezeNet 1.1, seven features.
    Squeeze,
}

impl LpipsNet {
    /// `vgg`, `alex` or `squeeze`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Vgg => "vgg",
            Self::Alex => "alex",
            Self::Squeeze => "squeeze",
        }
    }
}

impl FromStr for LpipsNet {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        [Self::Vgg, Self::Alex, Self::Squeeze]
            .into_iter()
            .find(|net| net.name() == name)
            .ok_or_else(|| format!("'{name}' is no LPIPS network; there are vgg, alex and squeeze"))
    }
}

/// A network with its weights.
pub struct Lpips {
    net: LpipsNet,
    slices: Vec<Slice>,
    /// Weight of each channel of each slice's output.
    linear: Vec<Vec<f32>>,
    /// Subtracted from each colour in [-1, 1].
    shift: [f32; 3],
    /// Each colour is divided by it.
    scale: [f32; 3],
    tensors: Tensors,
    report: WeightsReport,
}

/// What is known of a network's weights.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WeightsReport {
    /// The network that the weights fit.
    pub net: LpipsNet,
    /// The files, in the order in which they were read.
    pub files: Vec<WeightsFile>,
    /// Number of weights that the network uses.
    pub parameters: usize,
    /// Distance of two small built-in pictures: equal weights, however stored, give equal distances to 1e-5.
    pub probe: f64,
    /// What looks unusual.
    pub warnings: Vec<String>,
}

/// One file of weights.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WeightsFile {
    /// Where it is.
    pub path: PathBuf,
    /// Its SHA-256, hexadecimal. torchvision's file names carry the first eight digits.
    pub sha256: String,
}

/// As in the published implementation: colours in [-1, 1] to the means and deviations of the training images.
const SHIFT: [f32; 3] = [-0.030, -0.088, -0.188];
const SCALE: [f32; 3] = [0.458, 0.448, 0.450];

impl Lpips {
    /// Reads the weights of `net`: one file with everything, or a backbone and its linear layers. Each is a safetensors
    /// file or an original `.pth`.
    ///
    /// # Errors
    /// A file is missing, damaged or of another kind; weights are missing, of another shape, or not finite.
    pub fn read(net: LpipsNet, paths: &[PathBuf]) -> Result<Self> {
        if paths.is_empty() {
            return Err(Error::Failed("LPIPS needs a file of weights".to_owned()));
        }
        let tensors = Tensors::read(paths)?;
        let slices = network::build(net, &tensors)?;
        let mut linear = Vec::new();
        let mut warnings = Vec::new();
        for (k, slice) in slices.iter().enumerate() {
            let name = format!("lin{k}.weight");
            let weights = tensors.get(&name, &[1, slice.channels, 1, 1])?.to_vec();
            if weights.iter().any(|&w| w < 0.0) {
                warnings.push(format!("{name} has negative weights; trained ones have none"));
            }
            linear.push(weights);
        }
        let colour = |name: &str, default: [f32; 3]| -> Result<[f32; 3]> {
            if !tensors.has(name) {
                return Ok(default);
            }
            let values = tensors.get(name, &[1, 3, 1, 1])?;
            Ok([values[0], values[1], values[2]])
        };
        let (shift, scale) = (colour("scaling.shift", SHIFT)?, colour("scaling.scale", SCALE)?);
        if scale.contains(&0.0) {
            return Err(InputError::new(tensors.path(), "scaling.scale holds a zero").into());
        }
        let mut files = Vec::new();
        for path in paths {
            let bytes = std::fs::read(path).map_err(|e| InputError::unreadable(path, &e))?;
            let sha256 = Sha256::digest(&bytes).iter().map(|byte| format!("{byte:02x}")).collect();
            files.push(WeightsFile { path: path.clone(), sha256 });
        }
        let parameters = tensors.iter().map(|(_, tensor)| tensor.data.len()).sum();
        let report = WeightsReport { net, files, parameters, probe: 0.0, warnings };
        let mut lpips = Self { net, slices, linear, shift, scale, tensors, report };
        let [a, b] = probe_pictures();
        lpips.report.probe = lpips.distance(&a, &b)?;
        Ok(lpips)
    }

    /// What is known of the weights.
    pub fn report(&self) -> &WeightsReport {
        &self.report
    }

    /// Writes the weights as one safetensors file in the layout of the published implementation's state_dict, f32.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn write_safetensors(&self, path: &Path) -> Result<()> {
        safetensors::write(path, &self.tensors, |name| network::state_dict_name(self.net, name))
    }

    /// The share of each feature in the distance, from the network's first to its last.
    ///
    /// # Errors
    /// The images are too small for the network, or their sizes differ.
    pub fn layer_distances(&self, a: &ColorImage, b: &ColorImage) -> Result<Vec<f64>> {
        if a.size() != b.size() {
            return Err(Error::Failed(format!("LPIPS of images of different sizes, {} and {}", a.size(), b.size())));
        }
        let mut states = [self.scaled(a), self.scaled(b)];
        let mut distances = Vec::new();
        for (slice, weights) in self.slices.iter().zip(&self.linear) {
            for state in &mut states {
                *state = slice.forward(state).ok_or_else(|| {
                    Error::Failed(format!(
                        "images of {} pixels are too small for LPIPS with {}",
                        a.size(),
                        self.net.name()
                    ))
                })?;
            }
            distances.push(feature_distance(&states[0], &states[1], weights));
        }
        Ok(distances)
    }

    /// Colours in [0, 1] to what the network was trained on.
    fn scaled(&self, image: &ColorImage) -> Activation {
        let mut input = Activation::zeros(image.width(), image.height(), 3);
        for (pixel, rgb) in input.data.chunks_exact_mut(3).zip(image.data()) {
            for c in 0..3 {
                pixel[c] = (2.0 * rgb[c] - 1.0 - self.shift[c]) / self.scale[c];
            }
        }
        input
    }
}

impl PerceptualMetric for Lpips {
    fn name(&self) -> String {
        let digest: String = self.report.files.iter().map(|f| f.sha256[..8].to_owned()).collect::<Vec<_>>().join("+");
        format!("lpips-{} (weights {digest})", self.net.name())
    }

    fn distance(&self, a: &ColorImage, b: &ColorImage) -> Result<f64> {
        Ok(self.layer_distances(a, b)?.iter().sum())
    }
}

/// Mean over pixels of the weighted squared difference of features that are scaled to unit length at each pixel.
fn feature_distance(a: &Activation, b: &Activation, weights: &[f32]) -> f64 {
    /// Keeps features that are all zero, as in the published implementation.
    const EPSILON: f32 = 1e-10;
    /// Pixels whose sum is one term of the total: the order of additions is fixed.
    const PIECE: usize = 1024;
    let length = |pixel: &[f32]| pixel.iter().map(|v| v * v).sum::<f32>().sqrt() + EPSILON;
    let channels = weights.len();
    let pieces = a.data.par_chunks(PIECE * channels).zip(b.data.par_chunks(PIECE * channels));
    let sums: Vec<f64> = pieces
        .map(|(a, b)| {
            let pixels = a.chunks_exact(channels).zip(b.chunks_exact(channels));
            pixels
                .map(|(a, b)| {
                    let (length_a, length_b) = (length(a), length(b));
                    let terms = a.iter().zip(b).zip(weights);
                    f64::from(terms.map(|((a, b), w)| (a / length_a - b / length_b).powi(2) * w).sum::<f32>())
                })
                .sum()
        })
        .collect();
    sums.iter().sum::<f64>() / (a.width * a.height) as f64
}

/// Two pictures of 64x64 pixels: waves of colour, and the same with a square in it.
fn probe_pictures() -> [ColorImage; 2] {
    let size = mb_geometry::ImageSize::new(64, 64);
    let waves =
        |x: usize, y: usize| std::array::from_fn(|c| 0.5 + 0.4 * ((x * (c + 2)) as f32 * 0.11 + y as f32 * 0.07).sin());
    let with_square =
        |x: usize, y: usize| if (20..40).contains(&x) && (16..44).contains(&y) { [0.9, 0.2, 0.1] } else { waves(x, y) };
    [ColorImage::from_fn(size, waves), ColorImage::from_fn(size, with_square)]
}
