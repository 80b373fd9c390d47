"""What OpenCV's SQPNP with LM refinement finds on the problems that `--bench pnp -- FILE` wrote (opencv-python-headless)."""
import sys
import time

import cv2
import numpy as np

camera = np.array([[1460.0, 0, 959.5], [0, 1460.0, 719.5], [0, 0, 1]])
rotation_deg, translation_mm, seconds = [], [], 0.0
for row in np.loadtxt(sys.argv[1]):
    truth, points = row[:6], row[6:].reshape(-1, 5)
    points_in_object, pixels = points[:, :3].copy(), points[:, 3:].copy()
    start = time.process_time()
    _, rvec, tvec = cv2.solvePnP(points_in_object, pixels, camera, None, flags=cv2.SOLVEPNP_SQPNP)
    rvec, tvec = cv2.solvePnPRefineLM(points_in_object, pixels, camera, None, rvec, tvec)
    seconds += time.process_time() - start
    difference = cv2.Rodrigues(truth[:3])[0].T @ cv2.Rodrigues(rvec)[0]
    rotation_deg.append(np.degrees(np.linalg.norm(cv2.Rodrigues(difference)[0])))
    translation_mm.append(1e3 * np.linalg.norm(tvec.ravel() - truth[3:]))
print(f"median rotation {np.median(rotation_deg):.4f} deg, median translation {np.median(translation_mm):.4f} mm, "
      f"{seconds * 1e6 / len(rotation_deg):.1f} us CPU a problem")
