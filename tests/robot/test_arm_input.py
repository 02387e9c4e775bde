"""What an arm rejects, and how it says so; the models that come along."""

import dataclasses

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.robot.arm_file import open_arm
from armsight.robot.models import MODELS

ARM = MODELS["ur5"]
T = ARM.forward(ARM.home)


@pytest.mark.parametrize(
    ("q", "said"),
    [
        ([0, 90, 0, 0, 0, 0], r"joint 2 is at 90 rad; are these degrees\? give radians"),
        ([[0] * 6, [0, 0, 0, 0, 0, -45]], r"joint 6 of row 1 is at -45 rad; are these degrees\?"),
        ([0, np.nan, 0, 0, 0, 0], "NaN or infinity"),
        ([0, np.inf, 0, 0, 0, 0], "NaN or infinity"),
        ([0, 0, 0], r"q has shape \(3,\), must be \(6,\) or \(N, 6\)"),
        ([[[0] * 6]], r"q has shape \(1, 1, 6\)"),
        (["a"] * 6, "q must be numbers"),
        ([[0, 1], [2]], "q must be numbers"),
    ],
)
def test_joint_angles_that_are_none_are_rejected(q, said):
    for call in (ARM.forward, ARM.jacobian, ARM.manipulability):
        with pytest.raises(InputError, match=said):
            call(q)


def test_one_configuration_is_needed_where_only_one_makes_sense():
    for call in (ARM.links, lambda q: ARM.inverse(T, near=q), lambda q: ARM.jacobian_rate(q, np.zeros(6))):
        with pytest.raises(InputError, match=r"must be \(6,\)$"):
            call(np.zeros((2, 6)))
    with pytest.raises(InputError, match=r"qd has shape \(5,\)"):
        ARM.jacobian_rate(np.zeros(6), np.zeros(5))
    with pytest.raises(InputError, match=r"frame 'world' is unknown; known are base, tool"):
        ARM.jacobian(np.zeros(6), "world")


@pytest.mark.parametrize("bad", [np.full(6, 90.0), np.full(6, np.nan)])
def test_near_is_looked_at_too(bad):
    with pytest.raises(InputError, match=r"near.*(degrees|NaN)"):
        ARM.inverse(T, near=bad)
    with pytest.raises(InputError, match=r"near.*(degrees|NaN)"):
        ARM.inverse_batch(T[None], near=bad)


def test_what_is_wrong_with_near_is_said_of_near():
    for bad, said in ((np.zeros(5), r"near has shape \(5,\)"), ("a", "near must be numbers")):
        with pytest.raises(InputError, match=said):
            ARM.inverse(T, near=bad)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda T: T[:3], r"shape \(3, 4\), must be \(4, 4\)"),
        (lambda T: T * np.nan, "NaN or infinity"),
        (lambda T: np.where(np.arange(4) == 3, 1e400, T), "NaN or infinity"),
        (lambda T: T + 1e-3, r"last row must be 0 0 0 1"),
        (lambda T: T @ np.diag([1.1, 1, 1, 1]), "off from orthonormal by 0.21; allowed is 1e-6"),
        (lambda T: T @ np.diag([1, 1, -1, 1]), "mirror image"),
        (lambda T: "T", "must be numbers"),
    ],
)
def test_a_pose_that_is_none_is_rejected(change, said):
    with pytest.raises(InputError, match=said):
        ARM.inverse(change(T))
    batch = change(T)
    with pytest.raises(InputError, match=said.replace(r"\(3, 4\), must be \(4, 4\)", r"\(1, 3, 4\)")):
        ARM.inverse_batch(batch if isinstance(batch, str) else batch[None])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"a": np.zeros(5)}, r"ur5: a has shape \(5,\)"),
        ({"d": np.full(6, np.nan)}, "ur5: d contains NaN"),
        ({"alpha": np.full(6, 90.0)}, "ur5: alpha has an angle of more than 20 rad; are these degrees"),
        ({"q_max": np.full(6, 360.0)}, "ur5: q_max has an angle of more than 20 rad; are these degrees"),
        ({"q_max": ARM.q_min}, "ur5: q_max - q_min must be more than 0"),
        ({"qd_max": np.zeros(6)}, "ur5: qd_max must be more than 0"),
        ({"direction": np.full(6, 0.5)}, "each must be 1 or -1"),
        ({"convention": "craig"}, "convention 'craig' is unknown; known are standard, modified"),
        ({"joint_names": ("one",)}, "1 joint names"),
        ({"joint_names": ("one", "two", "one", "four", "five", "six")}, "no two joints may share one"),
        ({"T_base_0": 2 * np.eye(4)}, "T_base_0 is no rigid motion: its 3x3"),
        ({"T_flange_tool": np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * 0.1}, "T_flange_tool is no rigid motion"),
    ],
)
def test_a_table_that_is_none_is_rejected(change, said):
    with pytest.raises(InputError, match=said):
        dataclasses.replace(ARM, **change)


def test_an_arm_keeps_its_numbers_to_itself():
    a = np.array(ARM.a)
    arm = dataclasses.replace(ARM, a=a)
    a[1] = 9.0
    assert arm.a[1] == ARM.a[1]
    with pytest.raises(ValueError, match="read-only"):
        arm.a[1] = 9.0
    with pytest.raises(ValueError, match="read-only"):
        arm.inverse(T).q[0] = 0.0


def test_an_unknown_model_lists_the_known():
    with pytest.raises(InputError, match="arm 'kuka' is unknown; known are six_r, puma560, ur5, ur10, irb120"):
        open_arm("kuka")
    assert open_arm("ur5") is MODELS["ur5"]


@pytest.mark.parametrize("name", MODELS)
def test_a_model_is_whole(name):
    arm = MODELS[name]
    assert arm.name == name
    assert arm.within_limits(arm.home)
    assert arm.source
    assert (arm.qdd_max > arm.qd_max).all()
    assert (arm.qddd_max > arm.qdd_max).all()
