"""Scaling curves of surface scores, with the published scorer's algorithm measured in the same run.

    cargo build --release && python3 crates/eval/benches/scaling.py target/release/mobilebrick [WHAT...]

WHAT is any of points, triangles, threads, table (18 sequences, 1 M triangles each), large (50 M triangles); without
arguments all but large. Peers are installed into a virtual environment, which MOBILEBRICK_PEERS may name. Prints
Markdown: CPU seconds (user and system, of all threads), wall seconds and peak memory of whole processes.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

VENV = Path(os.environ.get("MOBILEBRICK_PEERS", Path(tempfile.gettempdir()) / "mobilebrick-peers"))
PYTHON = VENV / "bin" / "python"
HERE = Path(__file__).resolve().parent

if Path(sys.prefix).resolve() != VENV.resolve():
    if not PYTHON.exists():
        subprocess.run([sys.executable, "-m", "venv", VENV], check=True)
        subprocess.run([PYTHON, "-m", "pip", "install", "-q", "open3d==0.19.0", "scikit-learn", "scipy"], check=True)
    os.execv(PYTHON, [PYTHON, __file__, *sys.argv[1:]])

import numpy as np  # noqa: E402  (only the virtual environment has it)


def sphere(n, bumps=0.004, squash=1.0):
    """A bumpy sphere of 2 n^2 triangles, radius 10 cm."""
    theta, phi = np.meshgrid(np.pi * np.arange(n + 1) / n, 2 * np.pi * np.arange(n) / n, indexing="ij")
    radius = 0.1 + bumps * np.sin(12 * theta) * np.cos(12 * phi)
    vertices = radius[..., None] * np.stack([np.sin(theta) * np.cos(phi), squash * np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    i, j = np.meshgrid(np.arange(n, dtype=np.int32), np.arange(n, dtype=np.int32), indexing="ij")
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + (j + 1) % n, i * n + (j + 1) % n
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3).astype(np.float32), triangles


def write_ply(path, vertices, triangles):
    path.parent.mkdir(parents=True, exist_ok=True)
    faces = np.empty(len(triangles), dtype=[("n", "u1"), ("v", "<i4", 3)])
    faces["n"], faces["v"] = 3, triangles
    with open(path, "wb") as out:
        out.write(
            b"ply\nformat binary_little_endian 1.0\n"
            + f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n".encode()
            + f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n".encode()
        )
        vertices.astype("<f4").tofile(out)
        faces.tofile(out)


def sequence(root, n=160):
    """Ground truth: the sphere, and a volume around it of which all is visible."""
    write_ply(root / "mesh" / "gt_mesh.ply", *sphere(n))
    resolution = np.array([120, 120, 120])
    volume = {
        "mask": np.ones(resolution.prod(), bool),
        "resolutions": resolution,
        "voxel_size": 0.0025,
        "min_pts": np.full(3, -0.149),
    }
    np.save(root / "visibility_mask.npy", volume, allow_pickle=True)


def run(*command):
    """Runs to the end; (CPU s, wall s, peak GB, stdout)."""
    with tempfile.TemporaryFile() as out:
        start = time.monotonic()
        child = subprocess.Popen([str(c) for c in command], stdout=out)
        _, status, usage = os.wait4(child.pid, 0)
        wall = time.monotonic() - start
        out.seek(0)
        text = out.read().decode()
    if status:
        raise SystemExit(f"{command} failed: {status}")
    return usage.ru_utime + usage.ru_stime, wall, usage.ru_maxrss / 1e6, text


def ours(gt, pred, protocol, points=100_000, threads=2):
    command = [BINARY, "eval", "surface", "--gt", gt, "--pred", pred, "--protocol", protocol, "--points", points]
    return run(*command, "--threads", threads, "--json", "-q")


def peer(gt, pred, points=100_000):
    return run(PYTHON, HERE / "published_scorer.py", gt, pred, points)


def row(name, measured):
    cells = " | ".join("" if m is None else f"{m[0]:.1f} / {m[1]:.1f} / {m[2]:.2f}" for m in measured)
    print(f"| {name} | {cells} |", flush=True)


PROTOCOLS = ["mobilebrick-2023", "exact-1", "dtu-style-1", "tnt-style-1"]


def heads(first, names):
    print(f"\n| {first} | {' | '.join(names)} |\n|{'---|' * (len(names) + 1)}", flush=True)


def points(folder):
    sequence(folder / "seq")
    write_ply(folder / "pred.ply", *sphere(500, bumps=0.005))
    heads("points (500,000 triangles)", [*PROTOCOLS, "published algorithm"])
    for n in [10_000, 100_000, 1_000_000]:
        # For a million points the published algorithm would take far more than five minutes.
        peers = peer(folder / "seq", folder / "pred.ply", n) if n <= 100_000 else None
        row(f"{n:,}", [*(ours(folder / "seq", folder / "pred.ply", p, n) for p in PROTOCOLS), peers])


def triangles(folder):
    sequence(folder / "seq")
    heads("triangles (100,000 points)", [*PROTOCOLS, "published algorithm"])
    for n in [70, 224, 707, 2236]:
        write_ply(folder / "pred.ply", *sphere(n, bumps=0.005))
        peers = peer(folder / "seq", folder / "pred.ply") if n < 1000 else None
        row(f"{2 * n * n:,}", [*(ours(folder / "seq", folder / "pred.ply", p) for p in PROTOCOLS), peers])


def threads(folder):
    sequence(folder / "seq")
    write_ply(folder / "pred.ply", *sphere(707, bumps=0.005))
    heads("threads (1,000,000 triangles, 100,000 points)", PROTOCOLS)
    for n in [1, 2, 4]:
        row(n, [ours(folder / "seq", folder / "pred.ply", p, threads=n) for p in PROTOCOLS])


def table(folder):
    names = [f"seq{i:02}" for i in range(18)]
    for i, name in enumerate(names):
        sequence(folder / "data" / name)
        write_ply(folder / "meshes" / "m" / f"{name}.ply", *sphere(707, bumps=0.0041 + 0.0001 * i))
    (folder / "list.txt").write_text(",".join(names))
    heads("18 sequences, 1 M triangles each", ["CPU s / wall s / GB"])
    for protocol in PROTOCOLS[:2]:
        command = [BINARY, "eval", "surface", "--method", "m", "--root", folder / "data", "--meshes", folder / "meshes"]
        command += ["--list", folder / "list.txt", "-o", folder / protocol, "--protocol", protocol, "--json", "-q"]
        row(protocol, [run(*command)])


def large(folder):
    """Background included: most of the triangles lie outside the visible volume."""
    sequence(folder / "seq")
    vertices, faces = sphere(3536, bumps=0.005)
    far, far_faces = sphere(3536, bumps=0.1)
    vertices = np.concatenate([vertices, 10 * far])
    faces = np.concatenate([faces, far_faces + np.int32(len(far))])
    write_ply(folder / "pred.ply", vertices, faces)
    count = len(faces)
    del vertices, faces, far, far_faces
    heads(f"{count:,} triangles", PROTOCOLS)
    row("CPU s / wall s / GB", [ours(folder / "seq", folder / "pred.ply", p) for p in PROTOCOLS])


if __name__ == "__main__":
    BINARY = Path(sys.argv[1]).resolve()
    print("CPU s / wall s / peak GB of each process;", json.dumps({"cpus": os.cpu_count()}))
    for what in sys.argv[2:] or ["points", "triangles", "threads", "table"]:
        with tempfile.TemporaryDirectory() as folder:
            globals()[what](Path(folder))
