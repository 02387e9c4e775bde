"""A rig whose cameras moved: estimated again from a body in view, honestly; rejected where that says too little."""

from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Missed
from armsight.geometry.pose import inverse, log_se3
from armsight.loop.health.update import DEPTHS_M, updated_rig
from moved_rig import BODY, SIGMA_PX, calibrated, moved, shots_of


@pytest.mark.parametrize("degrees", [0.05, 1.0])
def test_a_rotated_camera_is_put_right(degrees):
    rng = np.random.default_rng(3)
    xi = np.array([0.0, 1e-4, 0.0, *np.radians(degrees) * np.array([0.6, 0.64, 0.48])])
    update = updated_rig(calibrated(rng), BODY, shots_of(rng, moved(xi), 40))
    assert np.degrees(update.rotation_rad) == pytest.approx(degrees, abs=5 * np.degrees(update.sigma_rad) + 5e-3)
    off = log_se3(inverse(update.rig.T_left_right) @ moved(xi).T_left_right)
    assert np.degrees(np.linalg.norm(off[3:])) < 0.01
    assert update.epipolar_px[1] < 1.5 * SIGMA_PX < update.epipolar_px[0]
    assert len(update.depth_errors_m) == len(DEPTHS_M)
    assert abs(update.depth_errors_m[2]) > abs(update.depth_errors_m[0])


def test_the_covariance_of_the_new_pose_covers_its_error():
    """Mean of the normalised error squared of the five freedoms that are estimated anew, over 8 rigs."""
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        xi = np.array([0.0, 0.0, 0.0, *np.radians(0.1) * rng.normal(size=3)])
        update = updated_rig(calibrated(rng), BODY, shots_of(rng, moved(xi), 25))
        off = log_se3(inverse(update.rig.T_left_right) @ moved(xi).T_left_right)
        squares.append(off @ np.linalg.solve(update.rig.cov[-6:, -6:], off))
    assert 2.0 < np.mean(squares) < 12.0


def test_shots_that_say_too_little_are_rejected():
    rng = np.random.default_rng(4)
    rig, there = calibrated(rng), moved(np.zeros(6))
    still = updated_rig(rig, BODY, shots_of(rng, there, 30, spread=1e-4))
    assert isinstance(still, Missed)
    assert "move the body" in still.reason
    bare = updated_rig(replace(rig, cov=np.zeros_like(rig.cov)), BODY, shots_of(rng, there, 10))
    assert isinstance(bare, Missed)
    assert "no covariance" in bare.reason
