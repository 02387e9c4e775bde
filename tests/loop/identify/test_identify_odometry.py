"""Odometry: what the joints alone lose with travel, and what the prior predicts of it."""

import numpy as np
from worn_arm import worn

from armsight.loop.identify.odometry import TRAVELS_M, odometry


def swept(arm):
    """Joint angles of a sweep of some metres, and the true poses of a worn arm on it."""
    rates = np.array([0.31, 0.47, 0.23, 0.59, 0.37, 0.71])
    phase = rates * np.linspace(0.0, 40.0, 1000)[:, None] + np.arange(6)
    q = arm.nominal.home + 0.5 * np.sin(phase)
    return q, arm.true.forward(arm.joints(q, np.sign(np.cos(phase))))


def test_an_exact_arm_loses_nothing_and_a_short_way_has_no_answer():
    arm = worn(1).nominal
    q, _ = swept(worn(1))
    found = odometry(arm, q, arm.forward(q))
    assert found.travel_m == TRAVELS_M
    assert max(found.error_rms_m) < 1e-12
    assert odometry(arm, q[:3], arm.forward(q[:3])) is None
    assert odometry(arm, q[:0], arm.forward(q[:0])) is None


def test_noise_of_an_arm_that_rests_is_no_travel_and_poses_that_are_no_numbers_are_left_out():
    arm, rng = worn(1).nominal, np.random.default_rng(6)
    q, _ = swept(worn(1))
    Ts = arm.forward(np.tile(q[:1], (4000, 1)))
    Ts[:, :3, 3] += rng.normal(0.0, 3e-4, (4000, 3))
    assert odometry(arm, np.tile(q[:1], (4000, 1)), Ts) is None
    Ts = arm.forward(q)
    Ts[[0, 500]], bad = np.nan, np.where(np.arange(len(q))[:, None] == 300, np.nan, q)
    assert max(odometry(arm, bad, Ts).error_rms_m) < 1e-12


def test_worn_arms_lose_with_travel_as_is_predicted():
    """These arms are wrong by less than the prior: by as much less after each travel, whose errors differ five-fold."""
    found = [odometry(arm.nominal, *swept(arm)) for arm in map(worn, range(40, 52))]
    error, predicted = (
        np.sqrt(np.mean([np.square(getattr(each, key)) for each in found], axis=0))
        for key in ("error_rms_m", "predicted_rms_m")
    )
    assert error.max() > 4 * error[0]
    ratio = predicted / error
    assert ratio.min() > 1.0
    assert ratio.max() < min(2.0, 1.2 * ratio.min())
