#!/bin/sh
# pyrealsense2 2.59.1: a pixel of a modified Brown-Conrady camera is deprojected without its distortion.
#
# rs2_project_point_to_pixel distorts for distortion.modified_brown_conrady; rs2_deproject_pixel_to_point of the same
# intrinsics leaves the distortion out and says nothing (the C header forbids it by an assert, which the wheel is built
# without). A pixel deprojected and projected again is elsewhere: by 101 px near the corner of a 720p image with k1 -0.3.
# brown_conrady and inverse_brown_conrady come back to 0.02 px.
#
# inverse_brown_conrady, which colour cameras report, is no inverse when a point is projected: it applies the coefficients
# forward as brown_conrady does, but its tangential part takes the coordinates after the radial one. OpenCV's
# projectPoints with the same five numbers is off by 1 px here; brown_conrady agrees with it to 0.001 px.
#
# Seen: deprojected and projected again: brown_conrady 0.01, inverse 0.01, modified 101.4 px;
# against OpenCV's formula: brown_conrady 0.00, inverse 0.97, modified 0.97 px.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 pyrealsense2==2.59.1.11053
"$folder/venv/bin/python" - <<'PYTHON'
import itertools

import numpy as np
import pyrealsense2 as rs

F, CX, CY = 910.0, 640.0, 360.0
K1, K2, P1, P2, K3 = COEFFICIENTS = [-0.3, 0.1, 0.002, -0.003, -0.02]
PIXELS = list(itertools.product((40.0, 320.0, 640.0, 1000.0, 1240.0), (30.0, 200.0, 360.0, 690.0)))


def intrinsics(model):
    one = rs.intrinsics()
    one.width, one.height, one.fx, one.fy, one.ppx, one.ppy = 1280, 720, F, F, CX, CY
    one.model, one.coeffs = getattr(rs.distortion, model), COEFFICIENTS
    return one


def opencv(point):
    """The pixel that OpenCV documents for a point."""
    x, y = point[0] / point[2], point[1] / point[2]
    r2 = x * x + y * y
    f = 1 + r2 * (K1 + r2 * (K2 + r2 * K3))
    return [
        F * (x * f + 2 * P1 * x * y + P2 * (r2 + 2 * x * x)) + CX,
        F * (y * f + P1 * (r2 + 2 * y * y) + 2 * P2 * x * y) + CY,
    ]


def off(model):
    """How far pixels come back from themselves, and from OpenCV's formula, px."""
    one, rays = intrinsics(model), [[(u - CX) / F, (v - CY) / F, 1.0] for u, v in PIXELS]
    again = [rs.rs2_project_point_to_pixel(one, rs.rs2_deproject_pixel_to_point(one, pixel, 1.0)) for pixel in PIXELS]
    there = [rs.rs2_project_point_to_pixel(one, ray) for ray in rays]
    parts = (np.subtract(again, PIXELS), np.subtract(there, [opencv(ray) for ray in rays]))
    return [float(np.linalg.norm(part, axis=1).max()) for part in parts]


back, formula = zip(*(off(model) for model in ("brown_conrady", "inverse_brown_conrady", "modified_brown_conrady")))
print("deprojected and projected again: brown_conrady {:.2f}, inverse {:.2f}, modified {:.1f} px".format(*back))
print("against OpenCV's formula: brown_conrady {:.2f}, inverse {:.2f}, modified {:.2f} px".format(*formula))
assert max(back[:2]) < 0.02 and 100 < back[2] < 103
assert formula[0] < 0.001 and 0.9 < formula[1] < 1.05 and 0.9 < formula[2] < 1.05
PYTHON
