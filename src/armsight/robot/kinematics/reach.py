"""How far an arm's tool gets within its joint limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.robot.kinematics.arm import Arm

#: Random poses looked at, and how many of the best are improved.
POSES, IMPROVED = 20_000, 4


class Reach(NamedTuple):
    """The workspace of the tool's point, m."""

    radius_m: float  #: furthest from joint 1's axis
    low_m: float  #: lowest along that axis, counted from the base
    high_m: float  #: highest along it


def reach(arm: Arm) -> Reach:
    """Find the extremes by improving the best of seeded random joint angles."""
    axis, foot = arm.T_base_0[:3, 2], arm.T_base_0[:3, 3]
    axis = -axis if axis[2] < 0 else axis  # up, whichever way the table has it
    across = np.eye(3) - np.outer(axis, axis)
    q = np.random.default_rng(0).uniform(arm.q_min, arm.q_max, (POSES, arm.joints))
    p_base = arm.forward(q)[:, :3, 3]
    heights = p_base @ axis

    def radius(p: Array) -> tuple[float, Array]:
        out = across @ (p - foot)
        length = float(np.linalg.norm(out))
        return length, out / max(length, 1e-12)

    return Reach(
        _most(arm, q, np.linalg.norm((p_base - foot) @ across, axis=1), radius),
        -_most(arm, q, -heights, lambda p: (-float(axis @ p), -axis)),
        _most(arm, q, heights, lambda p: (float(axis @ p), axis)),
    )


def _most(arm: Arm, q: Array, values: Array, measure: Callable[[Array], tuple[float, Array]]) -> float:
    """Return the largest value of a measure of the tool's point, which also gives its gradient by that point."""
    from scipy.optimize import minimize

    def cost(angles: Array) -> tuple[float, Array]:
        value, gradient = measure(arm.forward(angles)[:3, 3])
        return -value, -gradient @ arm.jacobian(angles)[:3]

    bounds = list(zip(arm.q_min, arm.q_max, strict=True))
    starts = q[np.argsort(values)[-IMPROVED:]]
    return max(-float(minimize(cost, start, jac=True, bounds=bounds).fun) for start in starts)
