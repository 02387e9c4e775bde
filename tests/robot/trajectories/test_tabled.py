"""Trajectories looked up in a table are those they were made of."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.robot.arm_file import open_arm
from armsight.robot.trajectories import Tabled, line, point_to_point
from armsight.robot.trajectories.tabled import STEP_S

ARM = open_arm("six_r")
HERE = np.radians([-33.4, -50.0, 57.7, 10.9, -48.3, -31.6])
GOAL = ARM.forward(HERE) + np.array([[0, 0, 0, 0.02], [0, 0, 0, 0.15], [0, 0, 0, -0.02], [0, 0, 0, 0]])
MOTIONS = {"joints": point_to_point(ARM, ARM.home, HERE), "line": line(ARM, HERE, GOAL, duration_s=1.0)}


@pytest.mark.parametrize("name", MOTIONS)
def test_it_is_the_motion_it_was_made_of(name):
    motion = MOTIONS[name]
    tabled = Tabled(motion)
    t_s = np.random.default_rng(0).uniform(-0.1, motion.duration_s + 0.1, 2000)
    want, got = motion.at(t_s), tabled.at(t_s)
    # The jerk may jump by twice the most that the arm allows: h^3 / 48 of that is the most by which a quintic misses it.
    jump = 2 * ARM.qddd_max
    assert (np.abs(got.q - want.q).max(axis=0) < STEP_S**3 / 48 * jump).all()
    assert (np.abs(got.qd - want.qd).max(axis=0) < STEP_S**2 / 8 * jump).all()
    one = tabled.at(0.37)
    assert one.q.shape == (6,)
    assert np.array_equal(one.q, tabled.at(np.array([0.37])).q[0])


@pytest.mark.parametrize("name", MOTIONS)
def test_at_its_samples_it_is_exact_and_beyond_its_ends_it_stands(name):
    motion = MOTIONS[name]
    tabled = Tabled(motion)
    t_s = STEP_S * np.arange(3, 40)
    assert np.allclose(tabled.at(t_s).q, motion.at(t_s).q, rtol=0, atol=1e-15)
    for part, at_end in zip(tabled.at(motion.duration_s + 1.0), motion.at(motion.duration_s), strict=True):
        assert np.allclose(part, at_end, rtol=0, atol=1e-9)
    assert np.array_equal(tabled.at(-1.0).q, motion.at(0.0).q)


def test_a_motion_to_where_it_begins_stands():
    motion = point_to_point(ARM, HERE, HERE)
    assert motion.duration_s == 0.0
    for t_s in (-1.0, 0.0, 0.002, 1.0):
        assert np.array_equal(Tabled(motion).at(t_s).q, HERE)


def test_a_time_that_is_none_is_rejected():
    with pytest.raises(InputError, match="t_s is nan"):
        Tabled(MOTIONS["joints"]).at(float("nan"))
