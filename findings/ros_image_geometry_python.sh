#!/bin/sh
# ROS image_geometry 1.16.2 (Debian 12), Python: the distortion model is not read, and neither are two different cx.
#
# PinholeCameraModel.fromCameraInfo takes D and leaves distortion_model aside: rectifyPoint and rectifyImage apply the
# Brown-Conrady model to whatever the four numbers are. Those of a fisheye camera, "equidistant", which camera_calibration of the
# same distribution writes, come out as k1 k2 p1 p2: near the corner 119 px off, near the centre 2, and no error.
# StereoCameraModel.projectPixelTo3d is documented as the inverse of project3dToPixel. It leaves (Crx - Clx) / Tx out of its
# matrix Q, which its own comment has: where the two P have another cx (stereoRectify without CALIB_ZERO_DISPARITY), points
# come back at another distance. getZ and getDisparity do the same.
#
# Seen, f 520 px, 1280 x 800: pixels of the rays (0.2 0.1 1), (0.5 0.3 1), (0.9 0.5 1) rectified: off by 1.9, 28.6, 119.2 px.
# f 600 px, baseline 0.12 m, cx 640 and 610: a point at 1.000 m projected and back: 0.706 m; with cx 640 in both: 1.000 m.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 opencv-python-headless==4.14.0.94
cd "$folder"
package=python3-image-geometry=1.16.2+ds-1
apt-get download -qq "$package" 2>apt.txt || { apt-get update -qq && apt-get download -qq "$package" 2>apt.txt; } || { cat apt.txt; exit 1; }
dpkg-deb -x python3-image-geometry_*.deb debian
PYTHONPATH="$folder/debian/usr/lib/python3/dist-packages" "$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys
from types import SimpleNamespace
from unittest.mock import MagicMock

sys.modules["sensor_msgs"] = sys.modules["sensor_msgs.msg"] = MagicMock()  # of ROS, only the messages' fields are used

import cv2
import numpy as np
from image_geometry import PinholeCameraModel, StereoCameraModel


def camera_info(K, D, model, Tx=0.0):
    """Return the fields of a sensor_msgs/CameraInfo."""
    return SimpleNamespace(
        **{"width": 1280, "height": 800, "distortion_model": model, "binning_x": 0, "binning_y": 0},
        **{"K": K.ravel(), "D": D, "R": np.eye(3).ravel(), "P": np.column_stack([K, [Tx, 0, 0]]).ravel()},
        roi=SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0, do_rectify=False),
        header=SimpleNamespace(frame_id="camera", stamp=0),
    )


def matrix(f, cx):
    return np.array([[f, 0.0, cx], [0.0, f, 400.0], [0.0, 0.0, 1.0]])


K, D = matrix(520.0, 640.0), [0.02, 0.003, -0.001, 0.0002]
model = PinholeCameraModel()
model.fromCameraInfo(camera_info(K, D, "equidistant"))
for ray, expected in (((0.2, 0.1, 1.0), 1.9), ((0.5, 0.3, 1.0), 28.6), ((0.9, 0.5, 1.0), 119.2)):
    uv = cv2.fisheye.projectPoints(np.array([[ray]]), np.zeros(3), np.zeros(3), K, np.array(D))[0].ravel()
    ideal = (K @ ray)[:2]
    assert np.allclose(cv2.fisheye.undistortPoints(uv.reshape(1, 1, 2), K, np.array(D), P=K).ravel(), ideal, atol=1e-4)
    off = np.linalg.norm(np.ravel(model.rectifyPoint(uv)) - ideal)
    print(f"ray {ray}: rectified {off:.1f} px off")
    assert abs(off - expected) < 0.1

for cx, expected in ((640.0, 1.0), (610.0, 0.706)):
    pair = StereoCameraModel()
    pair.fromCameraInfo(
        camera_info(matrix(600.0, 640.0), [], "plumb_bob"), camera_info(matrix(600.0, cx), [], "plumb_bob", -600 * 0.12)
    )
    left, right = pair.project3dToPixel((0.1, 0.05, 1.0))
    back = pair.projectPixelTo3d(left, left[0] - right[0])
    print(f"cx 640 and {cx:.0f}: a point at 1.000 m comes back at {back[2]:.3f} m, getZ {pair.getZ(left[0] - right[0]):.3f} m")
    assert np.isclose(back[2], expected, atol=1e-3)
    assert np.isclose(pair.getZ(left[0] - right[0]), expected, atol=1e-3)
PYTHON
