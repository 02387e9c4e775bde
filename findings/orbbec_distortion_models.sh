#!/bin/sh
# pyorbbecsdk2 2.1.2 (SDK 2.9.3): a pixel of a camera with six radial coefficients, carried to its own camera, is 72 px away.
#
# transformation3dto2d and 2dto2d take a camera's OBCameraDistortion with its model. Forward, only BROWN_CONRADY distorts:
# BROWN_CONRADY_K6, INVERSE_ and MODIFIED_BROWN_CONRADY and KANNALA_BRANDT4 are projected as a pinhole. Backward,
# the polynomial is inverted for every model, NONE included. So 2dto2d, by which depth is found for a pixel of the colour image,
# is right for BROWN_CONRADY alone; no error, no warning for the rest.
#
# A lens of 900 px, 1280 x 720, k1 -0.1, k2 0.05, k3 -0.02, p1 0.002, p2 -0.003, and of K6 k4 0.1, k5 0.02, k6 -0.01.
#
# Seen, projected / OpenCV's formula of the point 0.6 -0.3 1: BROWN_CONRADY 1156.4 / 1156.4, K6 1180.0 (the pinhole's) /
# 1132.5; pixel 1180 90 carried to the same camera: BROWN_CONRADY 1180.0 90.0, NONE 1206.7 76.4, K6 1244.7 57.4.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --no-deps numpy==1.26.4 pyorbbecsdk2==2.1.2
cd "$folder"
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import pyorbbecsdk as orbbec

F, CX, CY = 900.0, 640.0, 360.0
K1, K2, K3, P1, P2 = -0.1, 0.05, -0.02, 0.002, -0.003
POINT, PIXEL = (0.6, -0.3, 1.0), (1180.0, 90.0)
lens, still = orbbec.OBCameraIntrinsic(), orbbec.OBExtrinsic()
lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height = F, F, CX, CY, 1280, 720
still.rot, still.transform = np.eye(3, dtype=np.float32), np.zeros(3, np.float32)


def opencv(k4, k5, k6):
    """Where OpenCV's documented formula projects the point."""
    x, y = POINT[:2]
    r2 = x * x + y * y
    radial = (1 + r2 * (K1 + r2 * (K2 + r2 * K3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.array(
        [
            F * (x * radial + 2 * P1 * x * y + P2 * (r2 + 2 * x * x)) + CX,
            F * (y * radial + P1 * (r2 + 2 * y * y) + 2 * P2 * x * y) + CY,
        ]
    )


pinhole = np.array([F * POINT[0] + CX, F * POINT[1] + CY])
for name, more, expected, carried in (
    ("BROWN_CONRADY", (0.0, 0.0, 0.0), opencv(0.0, 0.0, 0.0), PIXEL),
    ("NONE", (0.0, 0.0, 0.0), pinhole, (1206.7, 76.4)),
    ("BROWN_CONRADY_K6", (0.1, 0.02, -0.01), pinhole, (1244.7, 57.4)),
):
    one = orbbec.OBCameraDistortion()
    one.k1, one.k2, one.k3, one.p1, one.p2 = K1, K2, K3, P1, P2
    one.k4, one.k5, one.k6 = more
    one.model = getattr(orbbec.OBCameraDistortionModel, name)
    seen = orbbec.transformation3dto2d(orbbec.OBPoint3f(*(1000 * each for each in POINT)), lens, one, still)
    back = orbbec.transformation2dto2d(orbbec.OBPoint2f(*PIXEL), 1000.0, lens, one, lens, one, still)
    formula = opencv(*more)
    print(
        f"{name}: projected {seen.x:.1f} {seen.y:.1f}, by OpenCV's formula {formula[0]:.1f} {formula[1]:.1f}; pixel "
        f"{PIXEL[0]:.0f} {PIXEL[1]:.0f} carried to the same camera: {back.x:.1f} {back.y:.1f}"
    )
    assert np.abs(np.array([seen.x, seen.y]) - expected).max() < 0.01
    assert np.abs(np.array([back.x, back.y]) - carried).max() < 0.3
assert np.linalg.norm(pinhole - opencv(0.1, 0.02, -0.01)) > 40
PYTHON
