"""Whole training steps of `nerf`, `neus` (with masks) and `dvgo` (fine stage) in PyTorch on the CPU, at the sizes of the
presets `fast`, to be held beside ours in the same run: `train.rs` prints rays, samples and seconds of a step.

    cargo bench -p mb-neural --bench train -- SEQ METHOD STEPS MAX_SIDE_PX OUT
    python crates/neural/benches/pytorch_methods.py METHOD RAYS SAMPLES [--lit SAMPLES] [--voxels N] [--steps N]
        [--warm-up N] [--threads N] [--compile]

RAYS and SAMPLES are those of a whole step. Only the samples that light reaches get colours and derivatives in ours; with
`--lit` so they do here: densities of all without derivatives, then the whole step on that many, which is the faster way.
A step is forward, losses, backward, and Adam (fused) over all parameters. Every ray has equally many samples, so the number
of rays is rounded; what was computed is printed.

PyTorch is spared the rest of our step: samples lie at random along chords of the unit ball and were drawn before the clock
started, with the colours that they should show; there is no occupancy grid to march through and to keep up to date; and
which samples light reaches is given. Only Adam does more here: ours skips entries of a grid that no sample touched.
"""

import argparse
import ctypes
import functools
import time

import torch
from torch import nn
from torch.nn import functional as F

M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8
BATCHES = 4  # Drawn before the clock starts, and taken in turn.


class HashGrid(nn.Module):
    """8 levels of 4 features, at most 2^17 entries a level, from 16 to `finest` cells a side; positions in 0..1."""

    PRIMES = (1, 2_654_435_761, 805_459_861)

    def __init__(self, finest, levels=8, features=4, log2_entries=17, coarsest=16):
        super().__init__()
        growth = (finest / coarsest) ** (1 / (levels - 1))
        self.cells = [int(coarsest * growth**level + 1e-6) for level in range(levels)]
        self.features, self.largest = features, 1 << log2_entries
        entries = [min((cells + 1) ** 3, self.largest) for cells in self.cells]
        self.tables = nn.ParameterList(torch.empty(n, features).uniform_(-1e-4, 1e-4) for n in entries)

    def forward(self, u):
        return torch.cat([self.level(u, cells, table) for cells, table in zip(self.cells, self.tables)], -1)

    def level(self, u, cells, table):
        at = u * cells
        base = at.detach().floor().clamp(0, cells - 1)
        far = at - base
        # The eight corners of each cell, [z, y, x, sample].
        ends = torch.stack([base, base + 1]).long()
        dense = (cells + 1) ** 3 <= self.largest
        strides = (1, cells + 1, (cells + 1) ** 2) if dense else self.PRIMES
        x, y, z = (ends[..., d] * strides[d] for d in range(3))
        if dense:
            corners = z[:, None, None] + y[:, None] + x
        else:
            corners = (z[:, None, None] ^ y[:, None] ^ x) & (self.largest - 1)
        values = table.index_select(0, corners.flatten()).view(2, 2, 2, -1, self.features)
        for d in (2, 1, 0):
            values = torch.lerp(values[0], values[1], far[:, d : d + 1])
        return values


def network(inputs, width, hidden, outputs, activation=nn.ReLU):
    sizes = [inputs] + [width] * hidden
    layers = [layer for a, b in zip(sizes, sizes[1:]) for layer in (nn.Linear(a, b), activation())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], outputs))


def harmonics(d):
    """Real spherical harmonics of degree 0 to 3 of unit directions."""
    x, y, z = d.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    return torch.stack(
        [
            torch.full_like(x, 0.2820948), -0.4886025 * y, 0.4886025 * z, -0.4886025 * x,
            1.0925484 * x * y, -1.0925484 * y * z, 0.9461747 * zz - 0.31539157, -1.0925484 * x * z,
            0.5462742 * (xx - yy), 0.5900436 * y * (yy - 3 * xx), 2.8906114 * x * y * z,
            0.4570458 * y * (1 - 5 * zz), 0.37317633 * z * (5 * zz - 3), 0.4570458 * x * (1 - 5 * zz),
            1.4453057 * z * (xx - yy), 0.5900436 * x * (3 * yy - xx),
        ],
        -1,
    )  # fmt: skip


def frequencies(x, octaves):
    scaled = x[..., None, :] * 2.0 ** torch.arange(octaves)[:, None]
    return torch.cat([x, torch.cat([scaled.sin(), scaled.cos()], -1).flatten(-2)], -1)


def per_sample(of_rays, samples):
    """A row of each ray, for each of its samples."""
    return of_rays[:, None].expand(-1, samples, -1).flatten(0, 1)


def composite(alpha, rgb, background):
    """Colours `[rays, 3]`, weights `[rays, samples]` and what passes `[rays, 1]`, of opacities and colours."""
    light = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha + 1e-7], -1), -1)
    weights, passed = alpha * light[:, :-1], light[:, -1:]
    return (weights[..., None] * rgb.view(*alpha.shape, 3)).sum(1) + passed * background, weights, passed


class Nerf(nn.Module):
    def __init__(self, _):
        super().__init__()
        self.grid, self.geometry, self.color = HashGrid(1024), network(32, 64, 1, 16), network(32, 64, 1, 3)

    def optimizer(self):
        return torch.optim.Adam(self.parameters(), lr=1e-2, betas=(0.9, 0.99), eps=1e-15, fused=True)

    def density(self, x):
        # The ball is the middle of contracted space.
        features = self.geometry(self.grid(0.25 * x + 0.5))
        return (features[:, 0] - 1).clamp(-15, 15).exp(), features

    look = density

    def loss(self, batch):
        rays, samples = batch["depths"].shape
        sigma, features = self.density(batch["positions"])
        harmonic = per_sample(harmonics(batch["directions"]), samples)
        rgb = self.color(torch.cat([features, harmonic], -1)).sigmoid()
        alpha = -torch.expm1(-sigma.view(rays, samples) * batch["lengths"])
        shown, w, _ = composite(alpha, rgb, batch["background"])
        # Distortion (mip-NeRF 360) in linear time, in units that shrink like disparity.
        depths = batch["depths"]
        s, lengths = depths / (1 + depths), batch["lengths"] / (1 + depths) ** 2
        before, moment = w.cumsum(-1) - w, (w * s).cumsum(-1) - w * s
        distortion = (2 * w * (s * before - moment) + w * w * lengths / 3).sum(-1).mean()
        return F.mse_loss(shown, batch["colors"]) + 0.005 * distortion


class Neus(nn.Module):
    FREE_POINTS = 1024  # Of the eikonal loss alone.

    def __init__(self, _):
        super().__init__()
        self.grid, self.geometry = HashGrid(512), network(35, 64, 1, 16, functools.partial(nn.Softplus, beta=100))
        self.color, self.sharpness = network(37, 64, 1, 3), nn.Parameter(torch.tensor(0.3))
        first, last = self.geometry[0], self.geometry[-1]
        with torch.no_grad():  # A ball at the start.
            first.weight.normal_(0, (2 / 64) ** 0.5)[:, 3:] = 0
            first.bias.zero_()
            last.weight.normal_((torch.pi / 64) ** 0.5, 1e-4)
            last.bias.fill_(-0.5)

    def optimizer(self):
        groups = [
            {"params": self.grid.parameters(), "lr": 1e-2},
            {"params": [*self.geometry.parameters(), *self.color.parameters()], "lr": 2e-3},
            {"params": [self.sharpness], "lr": 1e-3},
        ]
        return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15, fused=True)

    def look(self, x):
        return self.geometry(torch.cat([x, self.grid(0.5 * x + 0.5)], -1))

    def loss(self, batch):
        rays, samples = batch["depths"].shape
        free = torch.rand(self.FREE_POINTS, 3) * 2 - 1
        x = torch.cat([batch["positions"], free]).requires_grad_()
        out = self.look(x)
        # Differentiable themselves: the losses on them are exact.
        (normals,) = torch.autograd.grad(out[:, 0].sum(), x, create_graph=True)
        eikonal = (normals.norm(dim=-1) - 1) ** 2
        n = rays * samples
        sdf, features, normal = out[:n, 0], out[:n, 1:], normals[:n]
        directions = per_sample(batch["directions"], samples)
        harmonic = per_sample(harmonics(batch["directions"]), samples)
        rgb = self.color(torch.cat([x[:n], normal, harmonic, features], -1)).sigmoid()
        # Opacity of a section (NeuS, eq. 13); rays already have to face the surface.
        half = -0.5 * F.relu(-(directions * normal).sum(-1)) * batch["lengths"].flatten()
        sharpness = (10 * self.sharpness).exp()
        p, q = torch.sigmoid(sharpness * (sdf - half)), torch.sigmoid(sharpness * (sdf + half))
        alpha = ((p - q + 1e-5) / (p + 1e-5)).clamp(0, 1).view(rays, samples)
        shown, _, passed = composite(alpha, rgb, torch.zeros(3))
        cover, mask = (1 - passed).clamp(1e-3, 1 - 1e-3), batch["mask"]
        color = F.l1_loss(shown, mask * batch["colors"])
        eikonal = eikonal[:n].sum() / batch["looked"] + eikonal[n:].mean()
        return color + 0.002 * eikonal + 0.1 * F.binary_cross_entropy(cover, mask)


class Dvgo(nn.Module):
    def __init__(self, voxels):
        super().__init__()
        self.voxels = voxels
        self.density = nn.Parameter(torch.zeros(1, 1, voxels, voxels, voxels))
        self.features = nn.Parameter(torch.zeros(voxels**3, 12))
        self.color = network(12 + 33 + 27, 64, 2, 3)
        self.shift = torch.tensor(1 / (1 - 1e-2) - 1).log()

    def optimizer(self):
        groups = [
            {"params": [self.density, self.features], "lr": 0.1},
            {"params": self.color.parameters(), "lr": 1e-3},
        ]
        return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-8, fused=True)

    def look(self, x):
        raw = F.grid_sample(self.density, x.view(1, -1, 1, 1, 3), align_corners=True).flatten()
        return -torch.expm1(-F.softplus(raw + self.shift))

    def interpolated(self, x):
        """As `grid_sample` of the features, which reads channel by channel and takes twice as long."""
        n = self.voxels
        at = (0.5 * x + 0.5) * (n - 1)
        base = at.floor().clamp(0, n - 2)
        far = at - base
        x, y, z = torch.stack([base, base + 1], 1).long().unbind(-1)
        # The eight corners of each voxel, [sample, z, y, x].
        corners = (z[:, :, None, None] * n + y[:, None, :, None]) * n + x[:, None, None]
        x, y, z = torch.stack([1 - far, far], 1).unbind(-1)
        weights = z[:, :, None, None] * y[:, None, :, None] * x[:, None, None]
        values = self.features.index_select(0, corners.flatten()).view(-1, 8, 12)
        return torch.bmm(weights.view(-1, 1, 8), values)[:, 0]

    def loss(self, batch):
        rays, samples = batch["depths"].shape
        x = batch["positions"]
        alpha = self.look(x).view(rays, samples)
        directions = per_sample(frequencies(batch["directions"], 4), samples)
        inputs = [self.interpolated(x), frequencies(x, 5), directions]
        rgb = self.color(torch.cat(inputs, -1)).sigmoid()
        shown, weights, passed = composite(alpha, rgb, batch["background"])
        passed = passed.clamp(1e-6, 1 - 1e-6)
        entropy = -(passed * passed.log() + (1 - passed) * (1 - passed).log()).mean()
        of_points = ((rgb.view(rays, samples, 3) - batch["colors"][:, None]) ** 2).sum(-1)
        points = (weights.detach() * of_points).sum() / rays
        return F.mse_loss(shown, batch["colors"]) + 0.001 * entropy + 0.01 * points


def draw(rays, kept, looked):
    """Chords of the unit ball, seen from one radius outside it. Light reaches the first `kept` of the samples of a ray, and
    `looked` are all samples of all rays."""
    samples = -(-looked // rays)
    ends = F.normalize(torch.randn(2, rays, 1, 3), dim=-1)
    chord = ends[1] - ends[0]
    length = chord.norm(dim=-1)
    along = torch.rand(rays, samples).sort(-1).values
    positions, directions = ends[0] + along[..., None] * chord, chord[:, 0] / length
    return {
        "all": positions.flatten(0, 1)[:looked],
        "positions": positions[:, :kept].flatten(0, 1),
        "depths": 1 + (along * length)[:, :kept],
        "lengths": (length / samples).expand(-1, kept).contiguous(),
        "directions": directions,
        "colors": 0.5 + 0.5 * directions.flip(-1),
        "background": torch.rand(rays, 3),
        "mask": (torch.rand(rays, 1) < 0.5).float(),
        "looked": looked,
    }


def keep_memory():
    """Has glibc keep what PyTorch frees: fresh pages from the system would take as long as the work itself."""
    set_option = getattr(ctypes.CDLL(None), "mallopt", lambda option, value: None)
    for option, value in [(M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1), (M_ARENA_MAX, 1)]:
        set_option(option, value)


def main():
    parser = argparse.ArgumentParser(description="One training step of a method in PyTorch on the CPU.")
    parser.add_argument("method", choices=["nerf", "neus", "dvgo"])
    parser.add_argument("rays", type=float, help="rays a step")
    parser.add_argument("samples", type=float, help="samples a step")
    parser.add_argument("--lit", type=float, help="of them, those that light reaches; all by default")
    parser.add_argument("--voxels", type=int, default=144, help="voxels a side (dvgo)")
    parser.add_argument("--steps", type=int, default=20, help="steps that are measured")
    parser.add_argument("--warm-up", type=int, default=5, help="steps before them")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--compile", action="store_true", help="torch.compile; has no second derivatives, so not of neus")
    arguments = parser.parse_args()
    keep_memory()
    torch.set_num_threads(arguments.threads)
    torch.set_flush_denormal(True)
    torch.manual_seed(0)

    looked = round(arguments.samples)
    of_ray = max(1, round((arguments.lit or looked) / arguments.rays))
    rays = round((arguments.lit or looked) / of_ray)
    batches = [draw(rays, of_ray, max(looked, rays * of_ray)) for _ in range(BATCHES)]
    model = {"nerf": Nerf, "neus": Neus, "dvgo": Dvgo}[arguments.method](arguments.voxels)
    optimizer = model.optimizer()
    look, loss_of = model.look, model.loss
    if arguments.compile:
        look, loss_of = torch.compile(look), torch.compile(loss_of)

    def step(number):
        batch = batches[number % BATCHES]
        if arguments.lit:
            with torch.no_grad():
                look(batch["all"])
        optimizer.zero_grad(set_to_none=True)
        loss = loss_of(batch)
        loss.backward()
        optimizer.step()
        return loss.item()

    for number in range(arguments.warm_up):
        step(number)
    wall, cpu = time.perf_counter(), time.process_time()
    for number in range(arguments.steps):
        loss = step(number)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(
        f"{arguments.method}, torch {torch.__version__}, {torch.get_num_threads()} threads: {rays} rays, "
        f"{looked} samples, {rays * of_ray} of them lit: {cpu / arguments.steps:.4f} CPU s and "
        f"{wall / arguments.steps:.4f} wall s a step, {arguments.steps / wall:.2f} steps/s, loss {loss:.5f}"
    )


if __name__ == "__main__":
    main()
