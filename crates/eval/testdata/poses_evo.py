"""Writes poses_evo.json: two trajectories and what `evo` says of them.

Run in an environment with evo (pip install evo): python poses_evo.py
"""

import itertools
import json
import math
from pathlib import Path

import evo
import numpy as np
from evo.core import metrics, sync, trajectory
from scipy.spatial.transform import Rotation

FRAMES = 14
rng = np.random.default_rng(3)


def pose(rotvec, translation):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    matrix[:3, 3] = translation
    return matrix


# An orbit with drift and noise, then a rigid move of the whole prediction.
reference, predicted = [], []
move = pose([0.3, -0.8, 0.5], [1.0, -2.0, 0.4])
drift = np.eye(4)
for i in range(FRAMES):
    angle = 2 * math.pi * i / FRAMES
    world_from_cam = pose([0.2, angle, 0.1], [0.6 * math.sin(angle), 0.3 + 0.02 * i, -0.6 * math.cos(angle)])
    drift = drift @ pose(rng.normal(0, 0.004, 3), rng.normal(0, 0.003, 3))
    reference.append(world_from_cam)
    predicted.append(move @ world_from_cam @ drift)

stamps = np.arange(FRAMES, dtype=float)


def path(poses):
    return trajectory.PoseTrajectory3D(poses_se3=[p.copy() for p in poses], timestamps=stamps)


def figure(metric, data, statistic):
    metric.process_data(data)
    return metric.get_statistic(statistic)


ref, est = path(reference), path(predicted)
Relation, Statistic = metrics.PoseRelation, metrics.StatisticsType


def rpe(relation, statistic):
    return figure(metrics.RPE(relation, delta=1, delta_unit=metrics.Unit.frames), (ref, est), statistic)


# evo has relative errors of every pair at distance d; all distances together are all pairs.
translation, rotation = [], []
for delta in range(1, FRAMES):
    for relation, errors in [(Relation.translation_part, translation), (Relation.rotation_angle_deg, rotation)]:
        metric = metrics.RPE(relation, delta=delta, delta_unit=metrics.Unit.frames, all_pairs=True)
        metric.process_data((ref, est))
        errors.extend(metric.error)
assert len(translation) == len(list(itertools.combinations(range(FRAMES), 2)))

aligned = path(predicted)
aligned.align(ref, correct_scale=False)
scaled = path(predicted)
_, _, scale = scaled.align(ref, correct_scale=True)
document = {
    "evo": evo.__version__,
    "gt_world_from_cam": [p.flatten().tolist() for p in reference],
    "pred_world_from_cam": [p.flatten().tolist() for p in predicted],
    "pairwise_translation_rmse_mm": 1e3 * float(np.sqrt(np.mean(np.square(translation)))),
    "pairwise_rotation_mean_deg": float(np.mean(rotation)),
    "rpe_translation_rmse_mm": 1e3 * rpe(Relation.translation_part, Statistic.rmse),
    "rpe_rotation_mean_deg": rpe(Relation.rotation_angle_deg, Statistic.mean),
    "ate_rmse_mm": 1e3 * figure(metrics.APE(Relation.translation_part), (ref, aligned), Statistic.rmse),
    "ate_rotation_mean_deg": figure(metrics.APE(Relation.rotation_angle_deg), (ref, aligned), Statistic.mean),
    "ate_unaligned_translation_rmse_mm": 1e3 * figure(metrics.APE(Relation.translation_part), (ref, est), Statistic.rmse),
    "ate_unaligned_rotation_mean_deg": figure(metrics.APE(Relation.rotation_angle_deg), (ref, est), Statistic.mean),
    "ate_similarity_translation_rmse_mm": 1e3 * figure(metrics.APE(Relation.translation_part), (ref, scaled), Statistic.rmse),
    "ate_similarity_rotation_mean_deg": figure(metrics.APE(Relation.rotation_angle_deg), (ref, scaled), Statistic.mean),
    "scale": float(scale),
}
Path(__file__).with_suffix(".json").write_text(json.dumps(document, indent=1) + "\n")
