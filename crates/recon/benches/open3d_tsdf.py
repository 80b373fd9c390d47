"""The peer of tsdf.rs: Open3D's VoxelBlockGrid on the same depth maps, CPU seconds apart from reading the files.

python open3d_tsdf.py WEDGE    with open3d==0.19.0
"""
import sys
import time
from pathlib import Path

import numpy as np
import open3d as o3d

root = Path(sys.argv[1])
core, device = o3d.core, o3d.core.Device("CPU:0")
frames = []
for pose in sorted(root.glob("pose/*.txt")):
    depth = o3d.t.io.read_image(str(root / "gt_depth" / f"{pose.stem}.png"))
    intrinsic = core.Tensor(np.loadtxt(root / "intrinsic" / pose.name))
    extrinsic = core.Tensor(np.linalg.inv(np.loadtxt(pose)))
    frames.append((depth, intrinsic, extrinsic))
for run in range(3):
    start = time.process_time()
    grid = o3d.t.geometry.VoxelBlockGrid(
        ("tsdf", "weight"), (core.float32, core.float32), ((1), (1)), 0.001, 8, 20000, device
    )
    for depth, intrinsic, extrinsic in frames:
        blocks = grid.compute_unique_block_coordinates(depth, intrinsic, extrinsic, 1000.0, 3.0, 4.0)
        grid.integrate(blocks, depth, intrinsic, extrinsic, 1000.0, 3.0, 4.0)
    integrated = time.process_time() - start
    mesh = grid.extract_triangle_mesh(1.0)
    extracted = time.process_time() - start - integrated
    print(f"run {run}: integrate {integrated:.3f} CPU s, extract {extracted:.3f} CPU s, "
          f"{grid.hashmap().size()} blocks, {len(mesh.triangle.indices)} triangles")
