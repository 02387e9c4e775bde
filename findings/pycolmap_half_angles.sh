#!/bin/sh
# pycolmap 4.2.1: the covariance of a refined pose has half angles: its rotation sigma is half of that in radians.
#
# refine_absolute_pose(.., return_covariance=True), and the generalized one, return a 6 x 6 covariance, rotation first, whose
# documentation names no unit. The pull request that added it (colmap 1464) speaks of angle-axis. It is in the tangent of
# Ceres' quaternions, where 1 is an angle of 2: the standard deviation of the rotation is half of that in radians, that of the
# translation is right (of noise of 1 px, whatever the residuals are). get_covariance_for_inverse of the same package takes
# rotations in radians, and the translation's error to be that of a twist, not cam_from_world.translation's own: the sigma
# of the camera's position by it is up to half as large as the scatter. Multiply by diag(2 2 2 1 1 1) on both sides first,
# then take position = -R' t through its own derivative.
#
# A camera of f 800 px 1.2 m before 40 points, 0.5 m from the world's origin; noise of 0.01 px, 500 times (seeds 0 to 499).
#
# Seen, sigma by pycolmap over sigma of the normal equations: rotation 0.50 0.50 0.50, translation 1.00 1.00 1.00; over the
# scatter: rotation 0.51 0.53 0.50, translation 1.00 1.02 1.05; the camera's position by get_covariance_for_inverse: 0.48 0.68 0.93.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet numpy==2.3.5 scipy==1.16.3 pycolmap==4.2.1
"$folder/venv/bin/python" - <<'PYTHON'
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

camera = pycolmap.Camera.create_from_model_name(1, "PINHOLE", 800.0, 1280, 800)
K = camera.calibration_matrix()
points = np.random.default_rng(0).uniform([0.2, -0.2, -0.1], [0.8, 0.2, 0.1], (40, 3))
rotation = Rotation.from_rotvec([0.3, 0.5, 2.0])
translation = np.array([0.05, -0.02, 1.2]) - rotation.apply([0.5, 0, 0])
pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation.as_quat()), translation)
assert np.allclose(pose.matrix(), np.column_stack([rotation.as_matrix(), translation]))


def pixels(change):
    """Project the points by the pose after a small rotation (rad) and translation (m) in the camera's axes."""
    rays = ((Rotation.from_rotvec(change[:3]) * rotation).apply(points) + translation + change[3:]) @ K.T
    return rays[:, :2] / rays[:, 2:]


J = np.column_stack([(pixels(d) - pixels(-d)).ravel() / 2e-6 for d in 1e-6 * np.eye(6)])
expected = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))

options = pycolmap.AbsolutePoseRefinementOptions()
options.gradient_tolerance = 1e-6
noise_px, errors, positions = 0.01, [], []
for seed in range(500):
    seen = pixels(np.zeros(6)) + noise_px * np.random.default_rng(seed).normal(size=(40, 2))
    found = pycolmap.refine_absolute_pose(pose, seen, points, np.ones(40, bool), camera, options, return_covariance=True)
    refined, covariance = found["cam_from_world"], found["covariance"]
    rotated = Rotation.from_quat(refined.rotation.quat) * rotation.inv()
    errors.append(np.r_[rotated.as_rotvec(), refined.translation - translation])
    positions.append(refined.inverse().translation - pose.inverse().translation)

sigma = np.sqrt(np.diag(covariance))
by_theory, by_scatter = sigma / expected, sigma / (np.std(errors, axis=0) / noise_px)
inverse = np.sqrt(np.diag(pycolmap.get_covariance_for_inverse(pose, covariance)))[3:]
of_position = inverse / (np.std(positions, axis=0) / noise_px)
print("pycolmap's sigma / normal equations, rotation x y z, translation x y z:", by_theory.round(3))
print("pycolmap's sigma / scatter:", by_scatter.round(2))
print("the camera's position by get_covariance_for_inverse / scatter:", of_position.round(2))
assert np.allclose(by_theory, [0.5] * 3 + [1.0] * 3, atol=0.005)
assert np.allclose(by_scatter, [0.5] * 3 + [1.0] * 3, atol=0.08)
assert of_position.min() < 0.55
PYTHON
