#!/bin/sh
# ROS camera_calibration 1.17.0 (Debian 12): of a fisheye pair it saves P = K R, beside a baseline in other pixels.
#
# CameraInfo's P is documented as [fx' 0 cx' Tx; 0 fy' cy' 0; 0 0 1 0] of the rectified images, Tx = -fx' B, and is so for pinhole
# pairs. For fisheye ones cv2.fisheye.stereoRectify gives just that, and the calibrator then writes K R, camera matrix times
# rectification, over its left 3 x 3 (StereoCalibrator.set_alpha; ROS 2's stereo_calibrator.py has the same two lines). Tx stays
# in the pixels of the fx' that is gone: no program can recover the baseline from the file. Who rectifies points by it, as the
# calibrator itself does, rotates them twice: rows disagree, and disparity / P gives a third of the distance.
# Issue 626 of ros-perception/image_pipeline asks about the two lines, without an answer.
#
# Exact lenses and an exact pose of 0.120 m are given, as a perfect calibration would find; 200 points before them.
#
# Seen: P[1, 0] -23.8 and P[2, 0] -0.055 in the left file, where 0 belongs; baseline by P 0.095 m; the calibrator's own
# epipolar error 6.06 px; distances by fx' B / disparity 0.33 of the true ones (median). By stereoRectify's P: 0.120 m, 0.00 px, 1.00.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 opencv-python-headless==4.14.0.94
cd "$folder"
package=python3-camera-calibration=1.17.0-1
apt-get download -qq "$package" 2>apt.txt || { apt-get update -qq && apt-get download -qq "$package" 2>apt.txt; } || { cat apt.txt; exit 1; }
dpkg-deb -x python3-camera-calibration_*.deb debian
PYTHONPATH="$folder/debian/usr/lib/python3/dist-packages" "$folder/venv/bin/python" - <<'PYTHON'
import sys
import types
from unittest.mock import MagicMock

# ROS itself is not needed for what follows: messages, bridges and versions are stand-ins that nothing here calls.
for name in ("cv_bridge", "image_geometry", "sensor_msgs", "sensor_msgs.msg"):
    sys.modules[name] = MagicMock()
sys.modules["distutils"] = types.ModuleType("distutils")
sys.modules["distutils.version"] = types.ModuleType("distutils.version")
sys.modules["distutils.version"].LooseVersion = MagicMock()

import cv2
import numpy as np
from camera_calibration.calibrator import CAMERA_MODEL, ChessboardInfo, StereoCalibrator

SIZE = (1280, 800)
K = np.array([[520.0, 0, 640], [0, 521, 402], [0, 0, 1]]), np.array([[518.0, 0, 633], [0, 519, 395], [0, 0, 1]])
D = np.array([[0.02, 0.003, -0.001, 0.0002]]).T, np.array([[0.018, 0.002, -0.001, 0.0001]]).T
R, T = cv2.Rodrigues(np.array([0.01, 0.08, -0.02]))[0], np.array([[-0.12], [0.002], [0.003]])

pair = StereoCalibrator([ChessboardInfo("chessboard", 7, 6, 0.03)])
for each in (pair, pair.l, pair.r):
    each.camera_model, each.size = CAMERA_MODEL.FISHEYE, SIZE
for each, k, d in zip((pair.l, pair.r), K, D, strict=True):
    each.intrinsics, each.distortion, each.R, each.P = k, d, np.eye(3), np.zeros((3, 4))
    each.mapx, each.mapy = np.zeros(SIZE[::-1], np.float32), np.zeros(SIZE[::-1], np.float32)
pair.R, pair.T = R, T
pair.set_alpha(0.0)  # what cal_fromcorners ends with
saved = pair.yaml("/left", pair.l)
print(saved[saved.index("projection_matrix") :])

points = np.random.default_rng(1).uniform([-1, -0.6, 1], [1, 0.6, 2.5], (200, 1, 3))
seen = (
    cv2.fisheye.projectPoints(points, np.zeros(3), np.zeros(3), K[0], D[0])[0],
    cv2.fisheye.projectPoints(points, cv2.Rodrigues(R)[0], T, K[1], D[1])[0],
)
depth = (points[:, 0] @ pair.l.R.T)[:, 2]


def judged(name, P, left, right):
    """Return the baseline, m, the rows' disagreement, px, and the median of found distances over true ones."""
    baseline, rows = -P[0, 3] / P[0, 0], pair.epipolar_error(left, right)
    share = np.median(P[0, 0] * baseline / (left - right)[:, 0, 0] / depth)
    print(f"{name:15} baseline {baseline:.3f} m, epipolar error {rows:.2f} px, distances {share:.2f} of the true ones")
    return baseline, rows, share


true = cv2.fisheye.stereoRectify(
    *(K[0], D[0], K[1], D[1], SIZE, R, T), flags=cv2.CALIB_ZERO_DISPARITY, newImageSize=SIZE, balance=0.0, fov_scale=1.0
)
assert np.allclose(true[0], pair.l.R)
assert np.allclose(true[1], pair.r.R)
rectified = [cv2.fisheye.undistortPoints(uv, k, d, R=r, P=p) for uv, k, d, r, p in zip(seen, K, D, true[:2], true[2:4], strict=True)]
assert np.allclose(judged("stereoRectify", true[3], *rectified), (np.linalg.norm(T), 0.0, 1.0), atol=1e-6)
found = judged("the calibrator", pair.r.P, pair.l.undistort_points(seen[0]), pair.r.undistort_points(seen[1]))
assert np.allclose(pair.l.P[:, :3], K[0] @ pair.l.R)
assert np.allclose(pair.l.P[[1, 2], 0], (-23.8, -0.055), atol=0.05)
assert np.allclose(found, (0.095, 6.06, 0.33), atol=0.01)
PYTHON
