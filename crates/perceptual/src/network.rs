//! The three networks, layer by layer, as `torchvision` builds them and LPIPS cuts them into slices.

use mb_job::Result;

use crate::LpipsNet;
use crate::activation::{Activation, Conv, MaxPool};
use crate::tensors::Tensors;

/// A layer as the tables below name it: the number is its place in torchvision's `features`, by which its weights go.
enum Spec {
    Conv {
        index: usize,
        out: usize,
        kernel: usize,
        stride: usize,
        padding: usize,
    },
    Pool(MaxPool),
    /// A SqueezeNet module: 1x1 to `squeeze` channels, then 1x1 and 3x3 side by side, `expand` channels each.
    Fire {
        index: usize,
        squeeze: usize,
        expand: usize,
    },
}

/// A layer with its weights.
enum Layer {
    Conv(Conv),
    Pool(MaxPool),
    Fire { squeeze: Conv, expand1x1: Conv, expand3x3: Conv },
}

/// One slice of a network: its output is one of the features that LPIPS compares.
pub(crate) struct Slice {
    layers: Vec<Layer>,
    /// Channels of its output.
    pub channels: usize,
}

const fn conv3(index: usize, out: usize) -> Spec {
    Spec::Conv { index, out, kernel: 3, stride: 1, padding: 1 }
}

const fn fire(index: usize, squeeze: usize, expand: usize) -> Spec {
    Spec::Fire { index, squeeze, expand }
}

const POOL2: Spec = Spec::Pool(MaxPool { size: 2, ceil: false });
const POOL3: Spec = Spec::Pool(MaxPool { size: 3, ceil: false });
const POOL3_CEIL: Spec = Spec::Pool(MaxPool { size: 3, ceil: true });

const VGG: &[&[Spec]] = &[
    &[conv3(0, 64), conv3(2, 64)],
    &[POOL2, conv3(5, 128), conv3(7, 128)],
    &[POOL2, conv3(10, 256), conv3(12, 256), conv3(14, 256)],
    &[POOL2, conv3(17, 512), conv3(19, 512), conv3(21, 512)],
    &[POOL2, conv3(24, 512), conv3(26, 512), conv3(28, 512)],
];

const ALEX: &[&[Spec]] = &[
    &[Spec::Conv { index: 0, out: 64, kernel: 11, stride: 4, padding: 2 }],
    &[POOL3, Spec::Conv { index: 3, out: 192, kernel: 5, stride: 1, padding: 2 }],
    &[POOL3, conv3(6, 384)],
    &[conv3(8, 256)],
    &[conv3(10, 256)],
];

const SQUEEZE: &[&[Spec]] = &[
    &[Spec::Conv { index: 0, out: 64, kernel: 3, stride: 2, padding: 0 }],
    &[POOL3_CEIL, fire(3, 16, 64), fire(4, 16, 64)],
    &[POOL3_CEIL, fire(6, 32, 128), fire(7, 32, 128)],
    &[POOL3_CEIL, fire(9, 48, 192)],
    &[fire(10, 48, 192)],
    &[fire(11, 64, 256)],
    &[fire(12, 64, 256)],
];

fn specs(net: LpipsNet) -> &'static [&'static [Spec]] {
    match net {
        LpipsNet::Vgg => VGG,
        LpipsNet::Alex => ALEX,
        LpipsNet::Squeeze => SQUEEZE,
    }
}

/// The published implementation's name of a tensor.
pub(crate) fn state_dict_name(net: LpipsNet, canonical: &str) -> String {
    let (first, rest) = canonical.split_once('.').unwrap_or((canonical, ""));
    if first == "scaling" {
        return format!("scaling_layer.{rest}");
    }
    if first.starts_with("lin") {
        return format!("{first}.model.1.{rest}");
    }
    let has_layer = |slice: &&[Spec]| {
        slice.iter().any(|spec| match spec {
            Spec::Conv { index, .. } | Spec::Fire { index, .. } => index.to_string() == first,
            Spec::Pool(_) => false,
        })
    };
    let slice = specs(net).iter().position(has_layer).map_or(0, |k| k + 1);
    format!("net.slice{slice}.{canonical}")
}

/// Builds a network from its weights.
pub(crate) fn build(net: LpipsNet, tensors: &Tensors) -> Result<Vec<Slice>> {
    let specs = specs(net);
    let mut channels = 3;
    let mut slices = Vec::new();
    for slice in specs {
        let mut layers = Vec::new();
        for spec in *slice {
            let read = |name: &str, [in_channels, out, kernel, stride, padding]: [usize; 5]| -> Result<Conv> {
                let shape = [out, in_channels, kernel, kernel];
                let weights = tensors.get(&format!("{name}.weight"), &shape)?;
                let bias = tensors.get(&format!("{name}.bias"), &[out])?.to_vec();
                let weights = kernel_last(weights, shape);
                Ok(Conv { kernel, stride, padding, in_channels, out_channels: out, weights, bias })
            };
            layers.push(match *spec {
                Spec::Pool(pool) => Layer::Pool(pool),
                Spec::Conv { index, out, kernel, stride, padding } => {
                    let conv = read(&index.to_string(), [channels, out, kernel, stride, padding])?;
                    channels = out;
                    Layer::Conv(conv)
                }
                Spec::Fire { index, squeeze, expand } => {
                    let conv = |part: &str, shape| read(&format!("{index}.{part}"), shape);
                    let layer = Layer::Fire {
                        squeeze: conv("squeeze", [channels, squeeze, 1, 1, 0])?,
                        expand1x1: conv("expand1x1", [squeeze, expand, 1, 1, 0])?,
                        expand3x3: conv("expand3x3", [squeeze, expand, 3, 1, 1])?,
                    };
                    channels = 2 * expand;
                    layer
                }
            });
        }
        slices.push(Slice { layers, channels });
    }
    Ok(slices)
}

/// From torch's `[out, in, ky, kx]` to `[ky, kx, in, out]`.
fn kernel_last(weights: &[f32], [out, input, height, width]: [usize; 4]) -> Vec<f32> {
    let mut reordered = vec![0.0; weights.len()];
    for o in 0..out {
        for i in 0..input {
            for k in 0..height * width {
                reordered[(k * input + i) * out + o] = weights[(o * input + i) * height * width + k];
            }
        }
    }
    reordered
}

impl Slice {
    /// `None` where the image has become too small for a layer.
    pub fn forward(&self, input: &Activation) -> Option<Activation> {
        let mut state: Option<Activation> = None;
        for layer in &self.layers {
            let input = state.as_ref().unwrap_or(input);
            state = Some(match layer {
                Layer::Conv(conv) => conv.forward(input)?,
                Layer::Pool(pool) => pool.forward(input)?,
                Layer::Fire { squeeze, expand1x1, expand3x3 } => {
                    let squeezed = squeeze.forward(input)?;
                    expand1x1.forward(&squeezed)?.concatenated(&expand3x3.forward(&squeezed)?)
                }
            });
        }
        state
    }
}
