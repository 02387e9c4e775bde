"""A rig that moves against the arm's base: found at once, sized, and not found where nothing moves."""

from dataclasses import replace

import numpy as np
import pytest
from arm_rig import off, small
from faults import AT_S, watched_arm

from armsight.geometry.pose import inverse, log_se3
from armsight.loop.estimators import Innovation, Outcome
from armsight.loop.health.change import widened
from armsight.loop.health.fixed import ShakeWatch


@pytest.mark.parametrize("seed", [30, 31])
def test_a_rig_that_stands_still_is_not_suspected(seed):
    assert watched_arm(seed, lambda t_s: np.zeros(6)).monitor.findings() == ()


@pytest.mark.parametrize(("shift_mm", "rotation_deg"), [(10.0, 0.8), (2.0, 0.0)])
def test_a_knocked_rig_is_found_at_once(shift_mm, rotation_deg):
    motion = np.array([1e-3 * shift_mm, 0.0, 0.0, 0.0, np.radians(rotation_deg), 0.0])
    moved = watched_arm(33, lambda t_s: motion)
    (found,) = moved.monitor.findings()
    # Within seconds a body that slipped looks alike: one record names both.
    assert "fixed" in (found.cause, *found.alternatives)
    assert {found.cause, *found.alternatives} <= {"fixed", "body"}
    assert moved.found_s - AT_S < 0.5
    assert found.since_s == pytest.approx(AT_S, abs=0.3)
    if not rotation_deg:
        assert abs(found.size - shift_mm) < 4 * found.sigma


def test_a_knock_widens_what_is_given_out_from_then_on():
    moved = watched_arm(34, lambda t_s: np.array([4e-3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    (state,) = moved.estimator._states[-1:]
    given = widened(state.pose_measurement, moved.monitor.changes)
    shift_m = np.sqrt(np.trace((given.cov_common - state.pose_measurement.cov_common)[:3, :3]))
    assert 3e-3 < shift_m < 8e-3
    early = replace(state.pose_measurement, t_s=AT_S - 1.0)
    assert widened(early, moved.monitor.changes) is early
    rows = np.flatnonzero(moved.tracked.t_s > moved.found_s + 0.5)[::50]
    error = off(moved.tracked.Ts_base_tool[rows], moved.Ts_true[rows])
    squares = np.einsum("ni,ni->n", error, np.linalg.solve(moved.tracked.covs[rows], error[..., None])[..., 0])
    assert np.mean(squares) < 6.0


def test_what_is_given_out_of_an_arm_whose_backlash_grew_is_as_uncertain_as_it_is_wrong():
    moved = watched_arm(5517, seconds=20.0, joint=1, more_rad=np.radians(1.0))
    rows = np.flatnonzero(moved.tracked.t_s > AT_S + 1.0)[::50]
    error = off(moved.tracked.Ts_base_tool[rows], moved.Ts_true[rows])
    squares = np.einsum("ni,ni->n", error, np.linalg.solve(moved.tracked.covs[rows], error[..., None])[..., 0])
    assert np.mean(squares) < 9.5


def test_what_is_given_out_of_a_rig_that_drifts_far_is_as_uncertain_as_it_is_wrong():
    drift = np.array([20e-3, 0.0, 0.0, 0.0, np.radians(2.0), 0.0]) / 60.0
    moved = watched_arm(36, lambda age_s: drift * age_s, 22.0)
    assert {found.cause for found in moved.monitor.findings()} == {"fixed"}
    best, T_base_rig = moved.monitor.changes[0], moved.T_base_rig
    D = T_base_rig @ inverse(small(drift * (best.end_s - AT_S))) @ inverse(T_base_rig)
    shift = log_se3(inverse(best.T_base_tool) @ D @ best.T_base_tool)[:3]
    assert np.linalg.norm(best.newest[0][:3] - shift) < 0.08 * np.linalg.norm(shift)
    rows = np.flatnonzero(moved.tracked.t_s > moved.found_s + 1.0)[::50]
    error = off(moved.tracked.Ts_base_tool[rows], moved.Ts_true[rows])
    squares = np.einsum("ni,ni->n", error, np.linalg.solve(moved.tracked.covs[rows], error[..., None])[..., 0])
    assert np.mean(squares) < 6.0


@pytest.mark.parametrize(("shake_m", "moves_s"), [(0.0, 0.6), (2e-4, 0.6), (0.0, 1.0), (1e-3, 1.0)])
def test_a_rig_that_shakes_is_named_at_rest_and_in_motion_and_an_arm_that_wanders_is_not(shake_m, moves_s):
    rng, watch, arm, noise = np.random.default_rng(61), ShakeWatch(), np.zeros(6), 1e-8 * np.eye(6)
    for k in range(1200):
        t_s = k / 60.0
        added = 4e-8 * np.ones(6) * (t_s % 1.0 < moves_s)  # in motion
        before, arm = arm, arm + np.sqrt(added) * rng.normal(size=6)
        seen = arm + 1e-4 * rng.normal(size=6) + shake_m * np.sin(10 * np.pi * t_s) * np.eye(6)[1]
        given = seen - before, noise, np.eye(6), np.ones(6), np.zeros((6, 6)), Outcome.USED
        watch.take(Innovation(t_s, np.eye(4), *given, None, lambda seen=seen: (seen, np.eye(6)), added, noise, added))
    if not shake_m:
        assert watch.change is None
        return
    (found,) = watch.findings()
    assert found.cause == "fixed"
    assert found.size == pytest.approx(1e3 * shake_m / np.sqrt(2), rel=0.15)  # root mean square
