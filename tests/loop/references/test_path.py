"""The tool's motion from poses: against the derivatives of a known path."""

import numpy as np
import pytest
from test_inertial import motion, pose

from armsight.errors import InputError
from armsight.loop.references.calibrate import PosePath


def test_pose_twist_and_acceleration_are_those_of_the_path():
    t = np.arange(0.0, 2.0, 0.02)
    path = PosePath(t, np.array([pose(at) for at in t]))
    for at in (0.5, 1.013, 1.49):
        got, true = path(at), motion(at)
        # A path of 2 rad/s frequency and 0.05 s to the ends: the fourth power left out is (2 * 0.05)^4 / 24 of a radian.
        np.testing.assert_allclose(got.T_base_tool, true.T_base_tool, atol=1e-5)
        np.testing.assert_allclose(got.twist, true.twist, atol=2e-3)
        np.testing.assert_allclose(got.acceleration, true.acceleration, atol=0.05)


def test_a_gap_is_not_bridged():
    t = np.concatenate([np.arange(0.0, 1.0, 0.02), np.arange(2.0, 3.0, 0.02)])
    path = PosePath(t, np.array([pose(at) for at in t]))
    with pytest.raises(InputError, match=r"no pose within 0.5 s of 1.500 s; they are from 0.000 to 2.980 s"):
        path(1.5)
