"""What pycolmap's bundle adjustment (Ceres) finds on the problem that `--bench bundle -- FILE` wrote (pycolmap, numpy)."""
import sys
import time

import numpy as np
import pycolmap

lines = open(sys.argv[1]).read().splitlines()
cameras, points, observations = (int(v) for v in lines[0].split())
values = [np.array(line.split(), float) for line in lines[1:]]
poses, places, seen = values[:cameras], values[cameras:cameras + points], values[cameras + points:]

rec = pycolmap.Reconstruction()
# COLMAP puts the corner of the first pixel at (0, 0).
rec.add_camera_with_trivial_rig(pycolmap.Camera(
    camera_id=1, model="PINHOLE", width=1920, height=1440, params=[1460.0, 1460.0, 960.0, 720.0]))
by_camera = [[] for _ in range(cameras)]
for row in seen:
    by_camera[int(row[0])].append(row)
slots = {}
for i, (pose, rows) in enumerate(zip(poses, by_camera)):
    image = pycolmap.Image(image_id=i + 1, name=f"{i:06}.jpg", camera_id=1,
                           keypoints=np.array([r[2:] + 0.5 for r in rows]))
    rec.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:4]), pose[4:]))
    for j, r in enumerate(rows):
        slots.setdefault(int(r[1]), []).append((i + 1, j))
for p, place in enumerate(places):
    rec.add_point3D(place, pycolmap.Track([pycolmap.TrackElement(*s) for s in slots[p]]), np.zeros(3, np.uint8))

config = pycolmap.BundleAdjustmentConfig()
for image_id in rec.images:
    config.add_image(image_id)
config.set_constant_cam_intrinsics(1)
config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
options = pycolmap.BundleAdjustmentOptions()
options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
options.ceres.loss_function_scale = 1.0
options.print_summary = False


def rms():
    total = 0.0
    for image in rec.images.values():
        for point in image.points2D:
            found = image.project_point(rec.points3D[point.point3D_id].xyz)
            total += ((found - point.xy) ** 2).sum()
    return np.sqrt(total / (2 * observations))


print(f"start: rms {rms():.6f} px")
start = time.process_time()
pycolmap.create_default_bundle_adjuster(options, config, rec).solve()
print(f"end: rms {rms():.6f} px, {time.process_time() - start:.2f} CPU s")
