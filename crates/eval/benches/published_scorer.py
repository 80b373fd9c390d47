"""The published scorer's algorithm on Open3D 0.19 and scikit-learn, for its CPU time beside `surface.rs`.

    python3 -m venv venv && venv/bin/pip install open3d==0.19.0 scikit-learn
    venv/bin/python crates/eval/benches/published_scorer.py SEQUENCE PREDICTION [POINTS]
"""

import sys
import time

import numpy as np
import open3d as o3d
from sklearn.neighbors import NearestNeighbors


def inside(mesh, volume):
    """Whether each vertex lies in a visible voxel (the nearest one)."""
    mask = volume["mask"].reshape(volume["resolutions"])
    voxel = np.rint((np.asarray(mesh.vertices) - volume["min_pts"]) / volume["voxel_size"]).astype(int)
    valid = ((voxel >= 0) & (voxel < mask.shape)).all(axis=1)
    valid[valid] = mask[tuple(voxel[valid].T)]
    return valid


def nearest(queries, points):
    tree = NearestNeighbors(n_neighbors=1, algorithm="ball_tree").fit(points)
    return tree.kneighbors(queries)[0][:, 0]


def main(sequence, prediction, points=100_000):
    start = time.process_time()
    volume = np.load(f"{sequence}/visibility_mask.npy", allow_pickle=True).item()
    truth = o3d.io.read_triangle_mesh(f"{sequence}/mesh/gt_mesh.ply")
    found = o3d.io.read_triangle_mesh(prediction)
    truth_points = np.asarray(truth.sample_points_poisson_disk(int(points)).points)
    registration = o3d.pipelines.registration
    icp = registration.registration_icp(
        o3d.geometry.PointCloud(truth.vertices),
        o3d.geometry.PointCloud(found.vertices),
        0.02,
        np.eye(4),
        registration.TransformationEstimationPointToPoint(),
        registration.ICPConvergenceCriteria(max_iteration=10),
    )
    if icp.fitness > 0.99:
        found.transform(np.linalg.inv(icp.transformation))
    found.remove_vertices_by_mask(~inside(found, volume))
    found_points = np.asarray(found.sample_points_poisson_disk(int(points)).points)
    print(f"fitness {icp.fitness:.6f}")
    # The script computes every distance once per threshold.
    for threshold in (0.0025, 0.005):
        to_truth, to_found = nearest(found_points, truth_points), nearest(truth_points, found_points)
        accuracy, recall = (to_truth < threshold).mean(), (to_found < threshold).mean()
        chamfer_mm = 1000 * (to_truth.mean() + to_found.mean())
        print(f"{1000 * threshold} mm: accuracy {accuracy:.5f}, recall {recall:.5f}, Chamfer {chamfer_mm:.5f} mm")
    print(f"{time.process_time() - start:.1f} CPU s")


main(*sys.argv[1:])
