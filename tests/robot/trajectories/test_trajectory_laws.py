"""What holds of every way to move, on every arm: limits, ends, and that the speeds are those of the angles."""

import numpy as np
import pytest
from arm_motions import START_DEG, ordinary, start, within

from armsight.errors import InputError
from armsight.robot.models import MODELS
from armsight.robot.trajectories import TRAJECTORIES

MEMBERS = list(TRAJECTORIES)


@pytest.mark.parametrize("name", START_DEG)
@pytest.mark.parametrize("member", MEMBERS)
def test_limits_hold_from_the_start_to_rest(member, name):
    arm, motion = MODELS[name], ordinary(member, name)
    within(arm, motion)
    first, last = motion.at(0.0), motion.at(motion.duration_s)
    np.testing.assert_allclose(first.q, start(name), atol=1e-9)
    still = (
        2e-3 if member == "resolved_rate" else 1e-6
    )  # the tracker settles; its last speed is below 1e-4 of the limit
    for at in (first, last):
        np.testing.assert_allclose(at.qd, 0, atol=still * arm.qd_max.max())
    for t, at in ((-1.0, first), (motion.duration_s + 1, last)):
        np.testing.assert_array_equal(np.array(motion.at(t)), np.array(at))


@pytest.mark.parametrize("member", MEMBERS)
def test_a_motion_is_frozen_and_says_what_it_returns(member):
    motion = ordinary(member, "ur5")
    assert [part.shape for part in motion.at(0.1)] == [(6,)] * 3
    times = np.array([0.0, 0.1, 0.17, motion.duration_s, 99.0])
    together = motion.at(times)
    assert [part.shape for part in together] == [(5, 6)] * 3
    for n, t in enumerate(times):
        for one, of_many in zip(motion.at(t), together, strict=True):
            np.testing.assert_allclose(one, of_many[n], atol=1e-11)
    with pytest.raises(AttributeError):
        motion.duration_s = 2.0
    with pytest.raises(InputError, match="t_s is nan"):
        motion.at(float("nan"))


@pytest.mark.parametrize("member", MEMBERS)
@pytest.mark.parametrize(
    ("q", "said"),
    [
        (np.zeros(5), r"shape \(5,\)"),
        (np.full(6, np.nan), "NaN"),
        (["up"] * 6, "must be numbers"),
        (np.full(6, 90.0), "degrees"),
        (
            [0, -1.5, 1.5, -1.4, -1.5, 6.5],
            r"q_start: joint 6 at 372.423 deg is outside its limits -360.000 to 360.000 deg",
        ),
    ],
)
def test_bad_starts_are_rejected(member, q, said):
    with pytest.raises(InputError, match=said):
        ordinary(member, "ur5", q)
