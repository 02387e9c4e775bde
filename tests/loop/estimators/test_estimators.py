"""What every estimator promises, and what a measurement is."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from arm_rig import ARM, MIDDLE, MOUNT, SHOT, TICK_S, measured, mounts, off, seen, small, states

from armsight.app.replay.run import ESTIMATORS
from armsight.errors import InputError
from armsight.geometry.pose import inverse
from armsight.loop.estimators import Delay, Mounting, Outcome, PoseMeasurement

EXACT = Delay(0.0, 1e-6)


@pytest.fixture(params=ESTIMATORS)
def estimator(request):
    return ESTIMATORS[request.param](ARM, delay=EXACT)


def still(estimator, seconds, q=MIDDLE, start_s=0.0):
    t = start_s + np.arange(round(seconds / TICK_S)) * TICK_S
    estimator.joints(states(t, np.repeat(q[None], len(t), axis=0)))
    return t


def plain(t_s, T=None, shift_m=0.0):
    """A measurement of the tool where the table says it is, but for a shift along base x."""
    T = ARM.forward(MIDDLE).copy() if T is None else T.copy()
    T[0, 3] += shift_m
    return PoseMeasurement(t_s, T, np.diag(SHOT**2), np.diag(MOUNT**2))


def test_without_readings_it_says_so(estimator):
    for ask in (estimator.estimate, lambda: estimator.vision(plain(0.0))):
        with pytest.raises(InputError, match="no potentiometer readings yet"):
            ask()


def test_without_vision_the_potentiometers_stand_alone_and_know_how_little(estimator):
    still(estimator, 0.2)
    estimate = estimator.estimate()
    assert np.allclose(estimate.T_base_tool, ARM.forward(MIDDLE), atol=1e-12)
    assert estimate.vision_age_s == np.inf
    # A zero off by 0.5 deg at 0.5 m from the axis is 4 mm; there are several such.
    assert 4e-3 < np.sqrt(np.trace(estimate.cov[:3, :3])) < 40e-3


def test_a_measurement_brings_it_there_and_its_age_is_reported(estimator):
    t = still(estimator, 0.5)
    assert estimator.vision(plain(0.4, shift_m=3e-3)) is Outcome.USED
    estimate = estimator.estimate()
    assert off(estimate.T_base_tool, plain(0.4, shift_m=3e-3).T_base_tool)[:3] == pytest.approx(0, abs=SHOT[0])
    assert estimate.vision_age_s == pytest.approx(t[-1] - 0.4, abs=1e-5)
    assert np.linalg.eigvalsh(estimate.cov - estimate.cov_own).min() > -1e-15


def test_the_calibration_is_not_averaged_away(estimator):
    still(estimator, 2.0)
    for t_s in np.arange(0.1, 1.9, 1 / 120):
        estimator.vision(plain(t_s))
    estimate = estimator.estimate()
    assert np.linalg.eigvalsh(estimate.cov - np.diag(MOUNT**2)).min() > -1e-12
    assert (np.diag(estimate.cov_own) <= 1.001 * SHOT**2).all()  # the noise may be, and is no worse than one shot's


def test_a_track_is_its_estimates(estimator):
    t = still(estimator, 0.3)
    estimator.vision(plain(0.1))
    track = estimator.track(t[[50, 120, 299]])
    assert len(track) == 3
    for row, t_s in enumerate(t[[50, 120, 299]]):
        one, other = track[row], estimator.estimate(float(t_s))
        for name in ("T_base_tool", "cov", "cov_own", "q", "qd"):
            assert np.allclose(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-15)
        assert one.vision_age_s == other.vision_age_s


def test_the_tool_is_where_the_estimate_says_at_the_readings_of_now(estimator):
    still(estimator, 0.3)
    estimator.vision(plain(0.2, shift_m=2e-3))
    T = estimator.tool(MIDDLE[None], np.zeros((1, 6)))
    assert np.allclose(T[0], estimator.estimate().T_base_tool, atol=1e-9)


def test_times_that_do_not_rise_or_are_not_kept_are_rejected(estimator):
    still(estimator, 0.2, start_s=10.0)
    with pytest.raises(InputError, match="order of time"):
        estimator.joints(states([10.1], MIDDLE[None]))
    with pytest.raises(InputError, match=r"kept from 10\.0000 to 10\.1990"):
        estimator.estimate(9.0)
    with pytest.raises(InputError, match=r"JointStates\.q"):
        estimator.joints(states([11.0], np.zeros((1, 5))))


def test_a_measurement_is_the_measurement_carried_to_the_tool_with_its_covariance():
    rng = np.random.default_rng(4)
    T_tool = ARM.forward(MIDDLE)
    samples = []
    for _ in range(4000):
        true, mounting = mounts(rng)
        samples.append(off(mounting.pose_measurement(seen(rng, T_tool, true), 0.0).T_base_tool, T_tool))
    pose = seen(rng, T_tool, true)
    pose_measurement, by_hand = mounting.pose_measurement(pose, 0.0), measured(mounting, pose, 0.0)
    for name in ("T_base_tool", "cov_noise", "cov_common"):
        ours, theirs = getattr(pose_measurement, name), getattr(by_hand, name)
        assert np.abs(ours - theirs).max() <= 1e-12 * np.abs(theirs).max()
    claimed, found = pose_measurement.cov_noise + pose_measurement.cov_common, np.cov(np.array(samples).T)
    # An element of the covariance of N samples is off by at most 5 / sqrt(N) of the root of its diagonals, 1 in 1e6.
    scale = np.sqrt(np.diag(claimed))
    assert (np.abs(found - claimed) <= 5 * np.sqrt(2 / 4000) * np.outer(scale, scale)).all()


def test_a_mounting_comes_from_a_hand_eye_calibration():
    T_base_rig, T_flange_body = small([1, 0, 0.2, 0.1, 0.2, 0.3]), small([0.01, 0, 0.05, 0, 0.3, 0])
    cov = np.diag(np.tile(MOUNT, 2) ** 2)
    handeye = SimpleNamespace(T_base_rig=T_base_rig, T_flange_body=T_flange_body, cov=cov)
    arm = dataclasses.replace(ARM, T_flange_tool=small([0, 0, 0.1, 0, 0, 1.0]))
    mounting = Mounting.of(handeye, arm)
    assert np.allclose(arm.T_flange_tool @ mounting.T_tool_body, T_flange_body)
    assert np.array_equal(mounting.T_base_rig, T_base_rig)
    assert np.array_equal(mounting.cov, cov)


def test_a_measurement_needs_its_time():
    rng = np.random.default_rng(0)
    true, mounting = mounts(rng)
    with pytest.raises(InputError, match="needs the time of its exposure"):
        mounting.pose_measurement(seen(rng, inverse(true[0]), true), float("nan"))
