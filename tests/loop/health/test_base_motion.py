"""A motion of the rig that the arm's own filter estimates."""

import faults
import numpy as np
import pytest

from armsight.geometry.pose import exp_se3, inverse, log_se3
from armsight.loop.health import follow


def test_it_is_as_far_off_as_it_is_said_to_be(monkeypatch):
    """The closure of these arms takes what floats in the gears for noise: off by 0.8 mm, it says 0.2 mm."""
    bump, found = np.array([0.002, 0.0, 0.0, 0.0, 0.0, 0.0]), []
    monkeypatch.setattr(faults, "AT_S", 10.0)

    def estimated(self, changes, T_base_rig, at_s, moved):
        true = T_base_rig @ inverse(exp_se3(bump)) @ inverse(T_base_rig)
        if at_s > 14.0 and moved is not None:
            found.append((moved, log_se3(true)))

    monkeypatch.setattr(follow.RigFollower, "base_by_arm", estimated)
    faults.closed_loop(5561, lambda t_s: bump, follows=True, seconds=21.0)
    squares = []
    for moved, true in found:
        xi, cov = moved.at(moved.Ts_base_tool[-1])
        off = xi - log_se3(inverse(moved.Ts_base_tool[-1]) @ exp_se3(true) @ moved.Ts_base_tool[-1])
        squares.append(off @ np.linalg.solve(cov, off))
    assert len(found) > 10
    assert np.mean(squares) < 9.0
    assert found[-1][0].sigma_m < 4e-4


def test_what_was_put_right_is_counted_from_there():
    """The rest of the motion is what is estimated afterwards; measurements from before it was put right do not count."""
    shift = np.array([0.002, 0.0, 0.0, 0.0, 0.0, 0.0])
    monitor = faults.watched_arm(61, lambda t_s: shift, seconds=12.0).monitor
    one, measured = monitor.base_motion(faults.AT_S, slow=False), monitor.measurements
    assert one.moved is None
    one.take(measured[:-10])
    before = one.moved
    one.put_right(measured[-1].t_s)  # as if a computer had been so long about it
    assert np.linalg.norm(before.at(before.Ts_base_tool[-1])[0][:3]) == pytest.approx(0.002, abs=5e-4)
    one.take(measured)
    np.testing.assert_array_equal(one.moved.xi, 0.0)
    np.testing.assert_array_equal(one.moved.cov, before.cov)
