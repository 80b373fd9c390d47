"""Features of OpenCV's SIFT beside those of `--bench features` on real photographs (opencv-python-headless, numpy).

    opencv_sift.py BINARY DATA

BINARY is the compiled bench; DATA holds mobilebrick-video, gtsfm_lund_door and ngp_fox. For each data set:
- repeatability: photographs are turned by 20 degrees and shrunk to 0.8; the share of the features found again within 1.5
  pixels at a scale within a factor of 1.5, and their root mean square distance;
- matches of neighbouring photographs (ratio 0.75, mutual): how many lie within 2 pixels of the epipolar lines of the
  reference poses, and these matches' median distance;
- CPU seconds an image, one thread.
Both detectors keep the same number of features of an image, the most contrasted ones.
"""
import json
import pathlib
import subprocess
import sys
import tempfile
import time

import cv2
import numpy as np

cv2.setNumThreads(1)
BINARY, DATA = sys.argv[1], pathlib.Path(sys.argv[2])


def quaternion(q):
    w, x, y, z = q
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                     [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                     [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


def colmap(folder, images, step):
    _, _, _, _, f, cx, cy, k = [v for v in open(folder / "cameras.txt").read().splitlines() if v[0] != "#"][0].split()
    intrinsics = np.array([[float(f), 0, float(cx) - 0.5], [0, float(f), float(cy) - 0.5], [0, 0, 1]])
    rows = [v for v in open(folder / "images.txt").read().splitlines() if v and v[0] != "#"][::2]
    frames = {}
    for row in rows:
        v = row.split()
        frames[v[9]] = (quaternion([float(a) for a in v[1:5]]), np.array([float(a) for a in v[5:8]]))
    names = sorted(frames)[::step]
    return [(images / n, intrinsics, np.array([float(k), 0, 0, 0]), *frames[n]) for n in names]


def fox(folder):
    data = json.load(open(folder / "transforms.json"))
    intrinsics = np.array([[data["fl_x"], 0, data["cx"] - 0.5], [0, data["fl_y"], data["cy"] - 0.5], [0, 0, 1]])
    distortion = np.array([data[k] for k in ("k1", "k2", "p1", "p2")])
    frames = []
    for frame in sorted(data["frames"], key=lambda f: f["file_path"])[:10]:
        pose = np.array(frame["transform_matrix"]) @ np.diag([1, -1, -1, 1])
        rotation = pose[:3, :3].T
        path = folder / frame["file_path"]
        frames.append((path, intrinsics, distortion, rotation, -rotation @ pose[:3, 3]))
    return frames


def turned(path, out):
    image = cv2.imread(str(path))
    h, w = image.shape[:2]
    map_ = cv2.getRotationMatrix2D((w / 2, h / 2), 20, 0.8)
    # Shrinking by 0.8 wants a little blur beforehand.
    cv2.imwrite(str(out), cv2.warpAffine(cv2.GaussianBlur(image, (0, 0), 0.4), map_, (w, h), flags=cv2.INTER_CUBIC))
    return map_


def ours(paths, upsample):
    with tempfile.TemporaryDirectory() as folder:
        text = subprocess.run([BINARY, folder, upsample, *map(str, paths)], capture_output=True, text=True, check=True,
                              env={"RAYON_NUM_THREADS": "1"}).stdout
        seconds = float(text.split(" CPU s")[0].split()[-1])
        features = [np.loadtxt(pathlib.Path(folder) / (pathlib.Path(p).stem + ".txt"), ndmin=2) for p in paths]
    return features, seconds


def opencv(paths, upsample):
    sift = cv2.SIFT_create(enable_precise_upscale=True) if upsample == "yes" else None
    features, seconds = [], 0.0
    for path in paths:
        image = cv2.imread(str(path))
        start = time.process_time()
        keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), None)
        seconds += time.process_time() - start
        # Root-SIFT, as ours.
        descriptors = 255 * np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1))
        place = np.array([[k.pt[0], k.pt[1], k.size / 2, np.radians(k.angle), k.response] for k in keypoints])
        features.append(np.hstack([place, np.round(descriptors)]))
    return features, seconds / len(paths)


def strongest(f, count):
    return f[np.argsort(-f[:, 4], kind="stable")][:count]


def repeatability(a, b, map_, size):
    there = a[:, :2] @ map_[:, :2].T + map_[:, 2]
    inside = ((there > 8) & (there < np.array(size) - 8)).all(1)
    there, scale = there[inside], a[inside, 2] * 0.8
    found, distances = 0, []
    for p, s in zip(there, scale):
        d = np.linalg.norm(b[:, :2] - p, axis=1)
        d[np.abs(np.log(b[:, 2] / s)) > np.log(1.5)] = np.inf
        if d.min() < 1.5:
            found += 1
            distances.append(d.min())
    return found / max(len(there), 1), np.sqrt(np.mean(np.square(distances)))


def matches(a, b, ratio=0.75):
    x, y = a[:, 5:].astype(np.float32), b[:, 5:].astype(np.float32)
    matcher = cv2.BFMatcher()
    forward, backward = matcher.knnMatch(x, y, 2), {m.queryIdx: m.trainIdx for m in matcher.match(y, x)}
    good = [m for m, n in forward if m.distance < ratio * n.distance and backward[m.trainIdx] == m.queryIdx]
    return np.array([[m.queryIdx, m.trainIdx] for m in good])


def epipolar(a, b, frame_a, frame_b):
    (_, k, distortion, ra, ta), (_, _, _, rb, tb) = frame_a, frame_b
    r = rb @ ra.T
    t = tb - r @ ta
    e = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]]) @ r
    f = np.linalg.inv(k).T @ e @ np.linalg.inv(k)
    flat = lambda p: np.hstack([cv2.undistortPoints(p[:, None, :2], k, distortion, P=k)[:, 0], np.ones((len(p), 1))])
    p, q = flat(a), flat(b)
    lb, la = p @ f.T, q @ f
    value = np.abs((q * lb).sum(1))
    return 0.5 * value * (1 / np.linalg.norm(lb[:, :2], axis=1) + 1 / np.linalg.norm(la[:, :2], axis=1))


sets = {
    "mobilebrick-video": colmap(DATA / "mobilebrick-video/sparse", DATA / "mobilebrick-video/image", 6),
    "gtsfm_lund_door": colmap(DATA / "gtsfm_lund_door/colmap", DATA / "gtsfm_lund_door/images", 2),
    "ngp_fox": fox(DATA / "ngp_fox"),
}
print(f"{'':<18} {'':<7} {'found':>6} {'used':>6} {'repeat':>7} {'rms px':>7} {'matches':>8} {'right':>6} {'px':>6} {'CPU s':>6}")
for name, frames in sets.items():
    paths = [f[0] for f in frames]
    with tempfile.TemporaryDirectory() as folder:
        warped = [pathlib.Path(folder) / f"{i:03}.png" for i in range(3)]
        maps = [turned(p, w) for p, w in zip(paths, warped)]
        size = cv2.imread(str(paths[0])).shape[1::-1]
        results = {}
        for label, detect in (("ours", ours), ("OpenCV", opencv)):
            features, seconds = detect(paths, "yes")
            again, _ = detect(warped, "yes")
            results[label] = (features, again, seconds)
        counts = [min(len(results[l][0][i]) for l in results) for i in range(len(paths))]
        for label, (features, again, seconds) in results.items():
            found = np.mean([len(f) for f in features])
            used = [strongest(f, c) for f, c in zip(features, counts)]
            repeat = [repeatability(used[i], strongest(again[i], counts[i]), maps[i], size) for i in range(3)]
            total, right, distances = 0, 0, []
            for i in range(len(frames) - 1):
                m = matches(used[i], used[i + 1])
                d = epipolar(used[i][m[:, 0]], used[i + 1][m[:, 1]], frames[i], frames[i + 1])
                total, right = total + len(d), right + (d < 2).sum()
                distances.extend(d[d < 2])
            print(f"{name:<18} {label:<7} {found:>6.0f} {np.mean(counts):>6.0f} {np.mean([r[0] for r in repeat]):>7.3f} "
                  f"{np.mean([r[1] for r in repeat]):>7.3f} {total:>8} {right:>6} {np.median(distances):>6.3f} {seconds:>6.2f}")
