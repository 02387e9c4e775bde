#!/bin/sh
# multical 0.4.0: a fisheye calibration is written as model "standard"; only the shape of dist tells the lens.
#
# multical calibrates with OpenCV's fisheye lens where --isFisheye is given. Its calibration.json then has, for each camera,
# "model": "standard", as that of a pinhole camera with Brown-Conrady distortion, and four coefficients k1 k2 k3 k4, which
# anyone takes for k1 k2 p1 p2. What differs is the shape: cv2.fisheye.calibrate returns (4, 1), a column, written
# [[k1], [k2], [k3], [k4]]; calibrateCamera returns a row, [[k1, k2, p1, p2, k3]].
#
# A lens of 400 px focal length at 35 degrees from its axis: read as it says, its points are off by 35 px.
#
# Seen: fisheye: standard (4, 1), pinhole: standard (1, 5); a point at 35 degrees 35.3 px off as a standard one.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet multical==0.4.0 opencv-contrib-python==4.6.0.66 numpy==1.26.4
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
from types import SimpleNamespace

import cv2
import numpy as np
from multical import camera
from multical.camera import Camera
from multical.camera_fisheye import CameraFisheye
from multical.io.export_calib import export_cameras

SIZE, K, D = (640, 480), np.array([[400.0, 0, 320], [0, 405, 240], [0, 0, 1]]), np.array([[-0.02], [0.005], [-0.002], [5e-4]])
rng = np.random.default_rng(1)
board = np.array([[[0.03 * x - 0.105, 0.03 * y - 0.075, 0.0]] for y in range(6) for x in range(8)])
poses = [(rng.normal(0, 0.3, (3, 1)), np.array([[0.0], [0.0], [0.25]]) + rng.normal(0, 0.02, (3, 1))) for _ in range(15)]


corners = [np.float32(cv2.fisheye.projectPoints(board, r, t, K, D)[0].reshape(-1, 2)) for r, t in poses]
views = SimpleNamespace(corners=corners, object_points=[np.float32(board.reshape(-1, 3))] * len(poses))
camera.calibration_points = lambda boards, detections: views
found, _ = CameraFisheye.calibrate(None, None, SIZE, max_iter=100, eps=1e-9)
dist = cv2.calibrateCamera(views.object_points, views.corners, SIZE, None, None)[2]
fisheye, pinhole = (export_cameras(["one"], [one])["one"] for one in (found, Camera(SIZE, K, dist)))
far = np.array([[[np.tan(np.radians(35.0)), 0.0, 1.0]]])
zero = np.zeros((3, 1))
lens = np.array(fisheye.K), np.array(fisheye.dist)
right, wrong = (cv2.fisheye.projectPoints(far, zero, zero, *lens)[0], cv2.projectPoints(far, zero, zero, *lens)[0])
off = float(np.linalg.norm(right - wrong))
shapes = np.shape(fisheye.dist), np.shape(pinhole.dist)
print(f"fisheye: {fisheye.model} {shapes[0]}, pinhole: {pinhole.model} {shapes[1]}; 35 degrees: {off:.1f} px off")
print("f", np.array(fisheye.K)[0, 0], "dist", np.ravel(fisheye.dist))
assert (fisheye.model, pinhole.model) == ("standard", "standard")
assert shapes == ((4, 1), (1, 5))
assert abs(np.array(fisheye.K)[0, 0] - 400) < 1
assert off > 5
PYTHON
