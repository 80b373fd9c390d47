"""The frame of depth.rs through Open3D's ray casting (Embree), in CPU seconds.

python3 -m venv venv && venv/bin/pip install open3d==0.19.0 && venv/bin/python crates/render/benches/embree.py
"""

import time

import numpy as np
import open3d as o3d


def bumpy_sphere(n):
    theta, phi = np.meshgrid(np.pi * np.arange(n + 1) / n, 2 * np.pi * np.arange(n) / n, indexing="ij")
    radius = 0.1 + 0.004 * np.sin(12 * theta) * np.cos(12 * phi)
    vertices = radius[..., None] * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + (j + 1) % n, i * n + (j + 1) % n
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3), triangles


vertices, triangles = bumpy_sphere(500)
scene = o3d.t.geometry.RaycastingScene()
scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
x, y = np.meshgrid(np.arange(1440), np.arange(1920))
directions = np.stack([(x - 719.5) / 1460, (y - 959.5) / 1460, np.ones(x.shape)], -1)
origins = np.broadcast_to([0, 0, -0.3], directions.shape)
rays = o3d.core.Tensor(np.concatenate([origins, directions], -1).astype(np.float32))
best = np.inf
for _ in range(11):  # the first one builds the tree
    start = time.process_time()
    depth = scene.cast_rays(rays)["t_hit"].numpy()
    best = min(best, time.process_time() - start)
print(f"Open3D RaycastingScene.cast_rays: {best:.3f} CPU s, {np.isfinite(depth).sum()} pixels see the model")
