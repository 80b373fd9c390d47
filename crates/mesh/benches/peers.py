"""The queries of queries.rs in Open3D and scipy, in CPU seconds.

python3 -m venv venv && venv/bin/pip install open3d==0.19.0 scipy && venv/bin/python crates/mesh/benches/peers.py
"""

import time

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree


def bumpy_sphere(n):
    theta, phi = np.meshgrid(np.pi * np.arange(n + 1) / n, 2 * np.pi * np.arange(n) / n, indexing="ij")
    radius = 0.1 + 0.004 * np.sin(12 * theta) * np.cos(12 * phi)
    vertices = radius[..., None] * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a, b, c, d = i * n + j, (i + 1) * n + j, (i + 1) * n + (j + 1) % n, i * n + (j + 1) % n
    triangles = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return vertices.reshape(-1, 3), triangles


def timed(what, job, runs=3):
    best = np.inf
    for _ in range(runs):
        start = time.process_time()
        result = job()
        best = min(best, time.process_time() - start)
    print(f"{what:<52} {best:8.3f} CPU s", flush=True)
    return result


vertices, triangles = bumpy_sphere(500)
mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices), o3d.utility.Vector3iVector(triangles))
n = 100_000
rng = np.random.default_rng(0)
queries = np.asarray(mesh.sample_points_uniformly(n).points) + 0.01 * (rng.random((n, 3)) - 0.5)

scene = o3d.t.geometry.RaycastingScene()


def build():
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    scene.cast_rays(np.zeros((1, 6), np.float32))
    return scene


scene = timed("Open3D RaycastingScene", build)
tensor = o3d.core.Tensor(queries.astype(np.float32))
timed("Open3D compute_distance", lambda: scene.compute_distance(tensor))
timed("Open3D sample_points_uniformly", lambda: mesh.sample_points_uniformly(n))
points = np.asarray(timed("Open3D sample_points_poisson_disk", lambda: mesh.sample_points_poisson_disk(n), runs=1).points)
timed("scipy cKDTree", lambda: cKDTree(points))
tree = cKDTree(points)
timed("scipy cKDTree.query", lambda: tree.query(queries, workers=-1))
