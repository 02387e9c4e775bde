"""A rig whose right camera moved after its calibration, and detections of the workcell's body by it."""

from dataclasses import replace

import numpy as np

from armsight.geometry.pose import exp_se3, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.sim.workcell.body import body_target
from armsight.vision.detections import SeenShot
from views import both_pixels

SIGMA_PX = 0.03
TRUE, BODY = example_rig(convergence_deg=1.0), body_target().body
#: As of a calibration with 30 pairs: focal lengths and centre, distortion; translation m, rotation rad.
SIGMAS = np.concatenate([*2 * [[0.05] * 4 + [5e-4, 1e-3, 2e-5, 2e-5, 1e-3]], 3 * [1e-5], 3 * [2e-5]])


def shots_of(rng, true, count, spread=1.0, rotation=0.3):
    """Detections of the body at poses all over the view."""
    shots, ids = [], np.arange(len(BODY.points))
    points = BODY.points + 2e-5 * rng.normal(size=BODY.points.shape)
    for k in range(count):
        u = spread * rng.uniform(-1, 1, 6)
        T = pose(exp_so3(rotation * u[3:]), np.array([0.1, 0.0, 0.9]) + np.array([0.2, 0.12, 0.2]) * u[:3])
        uv = both_pixels(true, points @ T[:3, :3].T + T[:3, 3])
        uv += SIGMA_PX * rng.normal(size=uv.shape)
        shots.append(SeenShot(str(k), (ids, ids), (uv[:, 0], uv[:, 1])))
    return shots


def calibrated(rng):
    """The rig as its calibration has it."""
    return replace(TRUE.perturbed(SIGMAS * rng.normal(size=len(SIGMAS))), cov=np.diag(SIGMAS**2), sigma_px=SIGMA_PX)


def moved(xi):
    """The rig as it is after the right camera moved by a tangent (6,)."""
    return replace(TRUE, T_left_right=TRUE.T_left_right @ exp_se3(xi))
