"""A tiny sequence of our own: a wall half a metre away, seen by four cameras that move sideways."""

import struct
import zlib

import numpy as np
import pytest

import mobilebrick as mb

WIDTH, HEIGHT = 64, 48
INTRINSICS = np.array([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])


def write_png(path, array):
    """[H, W] u8 or u16, or [H, W, 3] u8."""
    height, width = array.shape[:2]
    depth, colour = (16, 0) if array.dtype == np.uint16 else (8, 2 if array.ndim == 3 else 0)
    rows = array.astype(">u2" if depth == 16 else np.uint8).reshape(height, -1)
    raw = b"".join(b"\0" + row.tobytes() for row in rows)

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")
    )


@pytest.fixture
def sequence_path(tmp_path):
    root = tmp_path / "sequence"
    for i in range(4):
        pose = np.eye(4)
        pose[0, 3] = 0.02 * i
        for folder, matrix in [("pose", pose), ("intrinsic", INTRINSICS)]:
            (root / folder).mkdir(parents=True, exist_ok=True)
            np.savetxt(root / folder / f"{i:06}.txt", matrix)
        x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        image = np.stack([(x * 3 + i) % 256, (y * 5) % 256, (x + y) % 256], axis=-1).astype(np.uint8)
        write_png(root / "image" / f"{i:06}.png", image)
        write_png(root / "arkit_depth" / f"{i:06}.png", np.full((HEIGHT, WIDTH), 503, np.uint16))
    return root


@pytest.fixture
def scored_path(sequence_path):
    """The sequence with ground truth: the wall, 20 cm square, and a volume around it of which all is visible."""
    steps = np.linspace(-0.1, 0.1, 41)
    x, y = np.meshgrid(steps, steps)
    vertices = np.stack([x, y, np.full_like(x, 0.503)], axis=-1).reshape(-1, 3)
    corner = (np.arange(40)[:, None] * 41 + np.arange(40)).reshape(-1, 1)
    triangles = np.concatenate([corner + [0, 41, 42], corner + [0, 42, 1]]).astype(np.uint32)
    (sequence_path / "mesh").mkdir()
    mb.Mesh(vertices, triangles).write(sequence_path / "mesh" / "gt_mesh.ply")
    resolutions = np.array([60, 60, 20])
    volume = {
        "mask": np.ones(resolutions.prod(), bool),
        "resolutions": resolutions,
        "voxel_size": 0.01,
        "min_pts": np.array([-0.3, -0.3, 0.4]),
    }
    np.save(sequence_path / "visibility_mask.npy", volume, allow_pickle=True)
    return sequence_path
