"""A table that is grossly wrong is rejected and its mistake named; an arm with ordinary errors is not."""

from dataclasses import replace

import numpy as np
import pytest
from arm_rig import ARM, MIDDLE, mounts, seen, worn

from armsight.errors import CalibrationError
from armsight.loop.identify.misread import require_fitting

JOINT = np.arange(6)


def checked(arm, seed):
    """Calibrate hand and eye of a worn arm with a table, and check it."""
    rng = np.random.default_rng(seed)
    true, _ = mounts(rng)
    real = worn(rng)
    q = MIDDLE + np.radians(25.0) * rng.uniform(-1, 1, (20, 6))
    Ts = np.array([seen(rng, T, true).T_left_body for T in real.tool(q)])
    require_fitting(arm, q, Ts)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"alpha": np.where(JOINT == 3, -1, 1) * ARM.alpha}, "alpha of joint4 has the other sign"),
        ({"direction": np.where(JOINT == 1, -1.0, 1.0)}, "joint2 rotates the other way"),
        ({"offset": ARM.offset + np.radians(90.0) * (JOINT == 4)}, "the zero of joint5 is off by -90 deg"),
        ({"a": ARM.a[[0, 2, 1, 3, 4, 5]]}, "a of joint2 and a of joint3 are exchanged"),
    ],
)
def test_a_single_mistake_of_the_table_is_named_and_no_loop_is_closed(wrong, named):
    with pytest.raises(CalibrationError, match=f"no loop is closed.*{named}"):
        checked(replace(ARM, **wrong), 11)


def test_two_mistakes_are_rejected_without_a_name():
    with pytest.raises(CalibrationError, match="no single sign"):
        checked(replace(ARM, direction=np.where(JOINT % 3 == 1, -1.0, 1.0)), 12)


@pytest.mark.parametrize("seed", range(20, 23))
def test_a_worn_arm_passes(seed):
    checked(ARM, seed)
