#!/bin/sh
# opencv-contrib-python-headless 5.0.0.93: cv2.calibrateMultiview takes points marked as not seen for points.
#
# OpenCV 5 has calibrateMultiview for rigs of several cameras. Its documentation says: "This function supports partial observation
# of the calibration pattern. To enable this, set the unobserved image points to be invalid points (eg. (-1., -1.))". The first
# step, the intrinsics of each camera, fits them as if they had been seen at -1 -1. Two corners of one frame of fifteen are
# enough: focal length, baseline and all board poses are wrong, and only a line on stderr ("Mean RMSE of intrinsics calibration is
# higher") and the returned RMS say so. With intrinsics that are right as a start the boards' poses and the baseline
# are wrong still. What is right is detectionMask 0 for a
# camera's frame that is not whole: objPoints with fewer points in one frame are an error ("0 <= _rowRange.start"). Both shapes of points, (N, 1, 2) and (N, 2), do the same.
#
# Rig: two cameras, f 900 px, 1280x720, 200 mm apart, a board of 9x7 corners of 30 mm, 15 frames, noise 0.1 px; corners 10 and 11
# of frame 5 are not seen by the left camera.
#
# Seen: all corners seen: RMS 0.139 px, f 898.8, baseline 201.0 mm. Two marked -1 -1: RMS above 1000 px, f below 300, baseline above
# 500 mm. That frame out of the left camera's mask: as with all.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 opencv-contrib-python-headless==5.0.0.93
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import cv2
import numpy as np

rng = np.random.default_rng(1)
K = np.array([[900.0, 0, 640], [0, 900, 360], [0, 0, 1]])
board = np.zeros((63, 3), np.float32)
board[:, :2] = np.mgrid[:9, :7].T.reshape(-1, 2) * 0.03
R1, t1 = cv2.Rodrigues(np.array([0, np.radians(-5), 0.0]))[0], np.array([-0.2, 0, 0.02])
left, right = [], []
for _ in range(15):
    R = cv2.Rodrigues(rng.uniform(-0.4, 0.4, 3))[0]
    t = np.array([rng.uniform(-0.3, 0), rng.uniform(-0.2, 0), rng.uniform(0.8, 1.2)])
    for points, Rc, tc in ((left, R, t), (right, R1 @ R, R1 @ t + t1)):
        seen = cv2.projectPoints(board.astype(float), cv2.Rodrigues(Rc)[0], tc, K, None)[0]
        points.append((seen + rng.normal(0, 0.1, seen.shape)).astype(np.float32))


def calibrated(boards, left, right, mask):
    sizes, models = [(1280, 720)] * 2, np.full(2, cv2.CALIB_MODEL_PINHOLE, np.uint8)
    rms, Ks, _, _, Ts = cv2.calibrateMultiview(boards, [left, right], sizes, mask, models, None, None, None, None)
    print(f"RMS {rms:.3g} px, f {Ks[0][0, 0]:.1f} px, baseline {1000 * np.linalg.norm(Ts[1]):.1f} mm")
    return rms, Ks[0][0, 0], 1000 * np.linalg.norm(Ts[1])


def right_one(found):
    return found[0] < 0.2 and abs(found[1] - 900) < 6 and abs(found[2] - 201) < 1


boards, mask = [board] * 15, np.ones((2, 15), np.uint8)
assert right_one(calibrated(boards, left, right, mask))
for shape in ((63, 1, 2), (63, 2)):
    marked = [points.reshape(shape).copy() for points in left]
    marked[5][10:12] = -1
    rms, f, baseline = calibrated(boards, marked, [points.reshape(shape) for points in right], mask)
    assert rms > 1000 and f < 300 and baseline > 500, "the behaviour has changed"
without = mask.copy()
without[0, 5] = 0
assert right_one(calibrated(boards, marked, [points.reshape(shape) for points in right], without))
try:
    calibrated([board[:61] if k == 5 else board for k in range(15)], [p[: 61 if k == 5 else 63] for k, p in enumerate(left)],
               [p[: 61 if k == 5 else 63] for k, p in enumerate(right)], mask)
    raise SystemExit("frames of fewer points are taken: the behaviour has changed")
except cv2.error:
    pass
PYTHON
echo "as stated"
