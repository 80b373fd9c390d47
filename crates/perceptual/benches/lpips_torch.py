"""LPIPS of two images by `mobilebrick eval views`, and by PyTorch with the same network and weights on the same CPU.

    cargo build --release && python3 crates/perceptual/benches/lpips_torch.py target/release/mobilebrick WEIGHTS [THREADS]

WEIGHTS is a folder with lpips_random_{vgg,alex,squeeze}_f16.safetensors, or files of trained weights by these names.
Needs torch, numpy and Pillow. Ours is a whole process that reads images and weights and computes PSNR and SSIM too;
PyTorch's figure is the best of three forward passes alone.
"""

import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

BINARY, WEIGHTS = Path(sys.argv[1]).resolve(), Path(sys.argv[2])
THREADS = int(sys.argv[3]) if len(sys.argv) > 3 else os.cpu_count()
# Layers of a slice: a number is a convolution (its stride and padding) or a fire module, P a pooling before it.
VGG = [[0, 2], ["P", 5, 7], ["P", 10, 12, 14], ["P", 17, 19, 21], ["P", 24, 26, 28]]
ALEX = [[0], ["P", 3], ["P", 6], [8], [10]]
SQUEEZE = [[0], ["P", 3, 4], ["P", 6, 7], ["P", 9], [10], [11], [12]]
NETS = {"vgg": (VGG, 2, False), "alex": (ALEX, 3, False), "squeeze": (SQUEEZE, 3, True)}


def weights_of(net):
    data = (WEIGHTS / f"lpips_random_{net}_f16.safetensors").read_bytes()
    length = struct.unpack("<Q", data[:8])[0]
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    types = {"F16": np.float16, "F32": np.float32}
    tensors = {}
    for name, entry in header.items():
        if name != "__metadata__":
            first, end = entry["data_offsets"]
            values = np.frombuffer(body[first:end], types[entry["dtype"]]).reshape(entry["shape"])
            tensors[name] = torch.from_numpy(values.astype(np.float32))
    return tensors


def features(net, weights, x):
    slices, window, ceil = NETS[net]
    for number, layers in enumerate(slices, 1):
        for layer in layers:
            if layer == "P":
                x = F.max_pool2d(x, window, 2, ceil_mode=ceil)
                continue
            of = lambda part: (weights[f"net.slice{number}.{layer}.{part}weight"], weights[f"net.slice{number}.{layer}.{part}bias"])
            if net == "squeeze" and layer > 0:
                x = F.relu(F.conv2d(x, *of("squeeze.")))
                x = torch.cat([F.relu(F.conv2d(x, *of("expand1x1."))), F.relu(F.conv2d(x, *of("expand3x3."), padding=1))], 1)
            else:
                kernel = of("")[0].shape[-1]
                stride = {"alex": 4, "squeeze": 2}.get(net, 1) if layer == 0 else 1
                padding = {("squeeze", 0): 0, ("alex", 0): 2}.get((net, layer), kernel // 2)
                x = F.relu(F.conv2d(x, *of(""), stride=stride, padding=padding))
        yield x


def lpips(net, weights, pair):
    scaled = [(2 * x - 1 - weights["scaling_layer.shift"]) / weights["scaling_layer.scale"] for x in pair]
    total = 0.0
    for i, (a, b) in enumerate(zip(*(features(net, weights, x) for x in scaled))):
        a, b = (f / (f.norm(dim=1, keepdim=True) + 1e-10) for f in (a, b))
        total += float(F.conv2d((a - b) ** 2, weights[f"lin{i}.model.1.weight"]).mean())
    return total


def ours(net, gt, pred):
    command = [BINARY, "eval", "views", "--gt", gt, "--pred", pred, "--lpips-net", net, "--json", "-q"]
    command += ["--lpips-weights", WEIGHTS / f"lpips_random_{net}_f16.safetensors", "--threads", str(THREADS)]
    with tempfile.TemporaryFile() as out:
        start = time.monotonic()
        child = subprocess.Popen([str(c) for c in command], stdout=out)
        _, status, usage = os.wait4(child.pid, 0)
        wall = time.monotonic() - start
        out.seek(0)
        if status:
            raise SystemExit(f"{command} failed: {status}")
        return json.load(out)["lpips"], usage.ru_utime + usage.ru_stime, wall


@torch.inference_mode()
def theirs(net, gt, pred):
    weights = weights_of(net)
    image = lambda path: torch.from_numpy(np.asarray(Image.open(path / "0.png"), np.float32) / 255).permute(2, 0, 1)[None]
    pair = [image(gt), image(pred)]
    value, best = None, (float("inf"), float("inf"))
    for _ in range(3):
        cpu, wall = time.process_time(), time.monotonic()
        value = lpips(net, weights, pair)
        best = min(best, (time.process_time() - cpu, time.monotonic() - wall))
    return value, *best


def main():
    torch.set_num_threads(THREADS)
    rng = np.random.default_rng(0)
    print(f"torch {torch.__version__}, {THREADS} threads\n")
    print("| | ours: CPU s / wall s | PyTorch: CPU s / wall s | relative difference |\n|---|---|---|---|", flush=True)
    for width, height in [(640, 480), (1920, 1440)]:
        with tempfile.TemporaryDirectory() as folder:
            gt, pred = Path(folder) / "gt", Path(folder) / "pred"
            y, x = np.mgrid[0:height, 0:width]
            smooth = np.stack([np.sin(x / (17 + 3 * c)) * np.cos(y / (23 - 2 * c)) for c in range(3)], -1)
            for path, noise in [(gt, 0), (pred, 12)]:
                path.mkdir()
                pixels = 128 + 90 * smooth + noise * rng.standard_normal(smooth.shape)
                Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(path / "0.png")
            for net in NETS:
                a, b = ours(net, gt, pred), theirs(net, gt, pred)
                difference = abs(a[0] - b[0]) / abs(b[0])
                print(f"| {net}, {width}x{height} | {a[1]:.2f} / {a[2]:.2f} | {b[1]:.2f} / {b[2]:.2f} | {difference:.1e} |", flush=True)


main()
