"""Times OpenCV's ChArUco detector: python opencv_boards.py COLUMNS ROWS MARKER_RATIO DICTIONARY PHOTO..."""

import sys
import time

import cv2

columns, rows, ratio, dictionary = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
cv2.setNumThreads(1)
predefined = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
detector = cv2.aruco.CharucoDetector(cv2.aruco.CharucoBoard((columns, rows), 1.0, ratio, predefined))
for photo in sys.argv[5:]:
    image = cv2.imread(photo, cv2.IMREAD_GRAYSCALE)
    best = float("inf")
    for _ in range(10):
        start = time.process_time()
        corners, ids, _, _ = detector.detectBoard(image)
        best = min(best, time.process_time() - start)
    count = 0 if ids is None else len(ids)
    print(f"{photo}: {image.shape[1]}x{image.shape[0]}, {count} corners, {best * 1e3:.1f} ms of CPU (best of 10)")
