"""A rig that moves against the arm's base: found at once, sized, and not found where nothing moves."""

from dataclasses import replace

import numpy as np
import pytest

from arm_rig import ARM, legs, mounts, run, small, worn
from armsight.loop.estimators import Delay, KalmanEstimator
from armsight.loop.health import HealthMonitor
from armsight.sim.example_rig import example_rig
from armsight.sim.workcell.body import body_target

LEARNED_S, AT_S = 5.0, 6.5


class Moved:
    """An estimator whose cameras move at a time, which it does not know; it is watched once it has learned the arm."""

    def __init__(self, estimator, T_base_rig, motion):
        self.estimator, self.motion, self.T_base_rig = estimator, motion, T_base_rig
        self.monitor = HealthMonitor(example_rig(), body_target().body, 0.0)
        self.found_s = None

    def joints(self, states):
        self.estimator.joints(states)

    def track(self, t_s):
        return self.estimator.track(t_s)

    def vision(self, measurement):
        t_s, T = measurement.t_s, self.T_base_rig
        if t_s >= LEARNED_S and self.estimator.on_innovation is None:
            self.monitor.follow(self.estimator, ARM)
        if t_s >= AT_S:
            D = T @ np.linalg.inv(small(self.motion(t_s - AT_S))) @ np.linalg.inv(T)
            measurement = replace(measurement, T_base_tool=D @ measurement.T_base_tool)
        outcome = self.estimator.vision(measurement)
        if self.found_s is None and self.monitor.findings():
            self.found_s = t_s
        return outcome


def watched(seed, motion, seconds=9.0):
    """Run an arm with errors; return the estimator with its monitor."""
    rng = np.random.default_rng(seed)
    mount = mounts(rng)
    moved = Moved(KalmanEstimator(ARM, delay=Delay(0.0, 1e-4)), mount[1].T_base_rig, motion)
    run(rng, moved, worn(rng), legs(rng, seconds), mount=mount)
    return moved


@pytest.mark.parametrize("seed", [30, 31, 32])
def test_a_rig_that_stands_still_is_not_suspected(seed):
    assert watched(seed, lambda t_s: np.zeros(6)).monitor.findings() == ()


@pytest.mark.parametrize(("shift_mm", "rotation_deg"), [(10.0, 0.8), (2.0, 0.0)])
def test_a_knocked_rig_is_found_at_once(shift_mm, rotation_deg):
    motion = np.array([1e-3 * shift_mm, 0.0, 0.0, 0.0, np.radians(rotation_deg), 0.0])
    moved = watched(33, lambda t_s: motion)
    (found,) = moved.monitor.findings()
    assert (found.cause, found.unit) == ("fixed", "mm")
    assert moved.found_s - AT_S < 0.5
    assert found.since_s == pytest.approx(AT_S, abs=0.3)
    if not rotation_deg:
        assert abs(found.size - shift_mm) < 4 * found.sigma


def test_a_knock_widens_what_is_given_out_from_then_on():
    moved = watched(34, lambda t_s: np.array([4e-3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    (state,) = moved.estimator._states[-1:]
    given = moved.monitor.widened(state.pose_measurement)
    shift_m = np.sqrt(np.trace((given.cov_common - state.pose_measurement.cov_common)[:3, :3]))
    assert 3e-3 < shift_m < 8e-3
    early = replace(state.pose_measurement, t_s=AT_S - 1.0)
    assert moved.monitor.widened(early) is early
