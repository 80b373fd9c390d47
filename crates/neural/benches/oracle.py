"""Computes again, with PyTorch's autograd in double precision, what `oracle.rs` wrote: the networks of NeRF's and NeuS's
papers, their outputs, normals, and the derivatives of a loss on all of them with respect to every parameter, position and
direction. Prints the largest difference of each, relative to the largest number; ends with status 1 above 1e-3.

    cargo bench -p mb-neural --bench oracle -- DIR && python crates/neural/benches/oracle.py DIR
"""

import sys
from pathlib import Path

import numpy as np
import torch

folder = Path(sys.argv[1])
torch.set_default_dtype(torch.float64)
worst = 0.0


def read(name, *shape):
    return torch.from_numpy(np.fromfile(folder / f"{name}.f32", "<f4").astype(np.float64)).reshape(shape)


def compare(name, found, expected):
    global worst
    difference = float((found.detach() - expected.detach()).abs().max() / expected.detach().abs().max())
    worst = max(worst, difference)
    print(f"{name:28} {difference:.1e}")


def padded(n):
    return (n + 7) // 8 * 8


def layers(flat, sizes):
    """(weight [in, out], bias [out]) of each layer of a flat buffer, as views of it."""
    out, at = [], 0
    for inputs, outputs in sizes:
        stride = padded(outputs)
        weight = flat[at : at + inputs * stride].reshape(inputs, stride)[:, :outputs]
        at += inputs * stride
        out.append((weight, flat[at : at + stride][:outputs]))
        at += stride
    return out


def frequencies(x, octaves):
    parts = [x]
    for k in range(octaves):
        parts += [torch.sin(2.0**k * x), torch.cos(2.0**k * x)]
    return torch.cat(parts, -1)


positions = read("positions", -1, 3).requires_grad_()
directions = read("directions", -1, 3).requires_grad_()
d_first, d_normals, d_rgb = read("d_first", -1), read("d_normals", -1, 3), read("d_rgb", -1, 3)

# NeuS: distance 8 x 256, colour 4 x 256, normalised weights w = g v / |v|.
sdf_sizes = [(39, 256)] + [(256, 256)] * 2 + [(256, 217)] + [(256, 256)] * 4 + [(256, 257)]
color_sizes = [(6 + 27 + 256, 256)] + [(256, 256)] * 3 + [(256, 3)]
buffers = [read(f"neus_{i}", -1).requires_grad_() for i in range(5)]


def normalised(direct, gains, sizes):
    out, at = [], 0
    for (weight, bias), (_, outputs) in zip(layers(direct, sizes), sizes):
        out.append((gains[at : at + outputs] * weight / weight.norm(dim=0), bias))
        at += outputs
    return out


geometry, color = normalised(buffers[1], buffers[2], sdf_sizes), normalised(buffers[3], buffers[4], color_sizes)
encoded = frequencies(positions, 6)
h = encoded
for k, (weight, bias) in enumerate(geometry):
    if k == 4:
        h = torch.cat([h, encoded], -1) / np.sqrt(2)
    h = h @ weight + bias
    if k < len(geometry) - 1:
        h = torch.nn.functional.softplus(h, beta=100)
sdf, feature = h[:, 0], h[:, 1:]
(normals,) = torch.autograd.grad(sdf.sum(), positions, create_graph=True)
h = torch.cat([positions, normals, frequencies(directions, 4), feature], -1)
for k, (weight, bias) in enumerate(color):
    h = h @ weight + bias
    if k < len(color) - 1:
        h = torch.relu(h)
rgb = torch.sigmoid(h)
compare("neus distance", read("neus_sdf", -1), sdf)
compare("neus normals", read("neus_normals", -1, 3), normals)
compare("neus colour", read("neus_rgb", -1, 3), rgb)
loss = (sdf * d_first).sum() + (normals * d_normals).sum() + (rgb * d_rgb).sum()
grads = torch.autograd.grad(loss, [positions, directions] + buffers[1:])
compare("neus d positions", read("neus_d_positions", -1, 3), grads[0])
compare("neus d directions", read("neus_d_directions", -1, 3), grads[1])
for i, name in enumerate(["distance v, bias", "distance g", "colour v, bias", "colour g"]):
    compare(f"neus d {name}", read(f"neus_grad_{i + 1}", -1), grads[i + 2])

# NeRF: trunk 8 x 256 with the position again at layer 5, head 128.
trunk_sizes = [(63, 256)] + [(256, 256)] * 4 + [(256 + 63, 256)] + [(256, 256)] * 2 + [(256, 257)]
head_sizes = [(256 + 27, 128), (128, 3)]
buffers = [read(f"nerf_{i}", -1).requires_grad_() for i in range(2)]
encoded = frequencies(positions, 10)
h = encoded
for k, (weight, bias) in enumerate(layers(buffers[0], trunk_sizes)):
    if k == 5:
        h = torch.cat([h, encoded], -1)
    h = h @ weight + bias
    if k < 8:
        h = torch.relu(h)
sigma = torch.relu(h[:, 0])
h = torch.cat([h[:, 1:], frequencies(directions, 4)], -1)
(first, last) = layers(buffers[1], head_sizes)
rgb = torch.sigmoid(torch.relu(h @ first[0] + first[1]) @ last[0] + last[1])
compare("nerf density", read("nerf_sigma", -1), sigma)
compare("nerf colour", read("nerf_rgb", -1, 3), rgb)
loss = (sigma * d_first).sum() + (rgb * d_rgb).sum()
grads = torch.autograd.grad(loss, [positions, directions] + buffers)
compare("nerf d positions", read("nerf_d_positions", -1, 3), grads[0])
compare("nerf d directions", read("nerf_d_directions", -1, 3), grads[1])
compare("nerf d trunk", read("nerf_grad_0", -1), grads[2])
compare("nerf d head", read("nerf_grad_1", -1), grads[3])
print(f"largest difference {worst:.1e}")
sys.exit(worst > 1e-3)
