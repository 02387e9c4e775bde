"""From a chain of axes to a Denavit-Hartenberg table.

Between two axes in space there is always Rz(beta) Tz(d) Tx(a) Rx(alpha) Tz(e) Rz(gamma): along the first to the foot of
their common normal, over it, and along the second. Rz(gamma) Tz(e) stands at the next joint's own axis and goes into its
offset and d. What is free (either sense of the normal, its place between parallel axes) is chosen so that gamma and e
vanish where they can, which gives a table back that was written as URDF.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.robot.arm import Arm

#: Two frames differ by rounding below this, m and rad: numbers written with ten digits.
EXACT = 1e-9
#: A common normal further away than this many times the chain's length leaves no digits to hold the chain exactly. Nearer
#: ones do: an identified arm's axes are a little off parallel, and are meant to be.
FAR = 1e6
#: Random poses at which the table is held against the chain.
PROBES = 16


class Link(NamedTuple):
    """A joint of the chain, or its end.

    Attributes:
        T_before: (4, 4) where the joint stands in the frame that turns with the joint before.
        axis: (3,) its unit axis there; zero for the chain's end.
    """

    T_before: Array
    axis: Array


class Rows(NamedTuple):
    """A standard table with what stands before and after it, as in :class:`Arm`."""

    a: Array
    d: Array
    alpha: Array
    offset: Array
    direction: Array
    T_base_0: Array
    T_flange_tool: Array


class Step(NamedTuple):
    """Rz(beta) Tz(d) Tx(a) Rx(alpha) Tz(e) Rz(gamma)."""

    beta: float
    d: float
    a: float
    alpha: float
    e: float
    gamma: float


def arm_rows(where: str, names: list[str], links: list[Link], first_fixed: Array) -> Rows:
    """Find the table of a chain.

    Args:
        where: what to name in an error.
        names: six names of the joints.
        links: seven: the joints and the end.
        first_fixed: (4, 4) the first fixed joint after the last one that turns: the flange, where it can be row 6.

    Raises:
        InputError: two axes are so nearly parallel that no sensible table holds them.
    """
    size_m = float(sum(np.linalg.norm(link.T_before[:3, 3]) for link in links)) + EXACT
    turned = [_upright(link.axis) for link in links]
    between = [np.linalg.inv(turned[i][0]) @ links[i + 1].T_before @ turned[i + 1][0] for i in range(5)]
    steps = []
    for i, C in enumerate(between):
        steps.append(decompose(C))
        if max(abs(steps[-1].d), abs(steps[-1].e)) > FAR * size_m:
            apart = abs(np.degrees(np.arctan2(np.hypot(C[0, 2], C[1, 2]), abs(C[2, 2]))))
            raise InputError(
                f"{where}: the axes of joints {names[i]!r} and {names[i + 1]!r} are {apart:.2g} deg from parallel, "
                "which no table holds sensibly; were angles rounded? write pi/2 as 1.5707963267948966"
            )
    after = np.linalg.inv(turned[5][0])
    last = decompose(after @ first_fixed)
    if abs(last.e) > EXACT or abs(last.gamma) > EXACT:
        last = Step(0, 0, 0, 0, 0, 0)
    steps.append(last)
    carried = [0.0, *(step.gamma for step in steps[:5])], [0.0, *(step.e for step in steps[:5])]
    flange = after @ links[6].T_before
    return Rows(
        np.array([step.a for step in steps]),
        np.array([step.d for step in steps]) + carried[1],
        np.array([step.alpha for step in steps]),
        _wrapped(np.array([step.beta for step in steps]) + carried[0]),
        np.array([way for _, way in turned[:6]]),
        links[0].T_before @ turned[0][0],
        np.linalg.inv(_motion(last)) @ flange,
    )


def check_same(where: str, arm: Arm, links: list[Link]) -> None:
    """Hold an arm against the chain it was read from.

    Raises:
        InputError: they differ by more than rounding.
    """
    rng = np.random.default_rng(0)
    for q in rng.uniform(-np.pi, np.pi, (PROBES, 6)):
        T = np.eye(4)
        for link, angle in zip(links, [*q, 0.0], strict=True):
            T = T @ link.T_before @ pose(exp_so3(link.axis * angle), np.zeros(3))
        off = float(np.abs(arm.forward(q) - T).max())
        if off > EXACT:
            raise InputError(
                f"{where}: no table holds this chain exactly: the nearest is {off:.2g} m or rad off; are angles such "
                "as pi/2 rounded? write them as 1.5707963267948966"
            )


def decompose(C: Array) -> Step:
    """Split a transform (4, 4) between two joints whose axes are z."""
    x, y, z = C[:3, 3]
    sine = float(np.hypot(C[0, 2], C[1, 2]))
    if sine < EXACT:
        return _parallel(C)
    options = []
    for sense in (1.0, -1.0):
        beta = float(np.arctan2(sense * C[0, 2], -sense * C[1, 2]))
        c, s = np.cos(beta), np.sin(beta)
        alpha = float(np.arctan2(sense * sine, C[2, 2]))
        e = float((s * x - c * y) / (sense * sine))
        gamma = _turn_after(C, beta, alpha)
        options.append(Step(beta, float(z - e * C[2, 2]), float(c * x + s * y), alpha, e, gamma))
    return min(options, key=lambda step: (abs(step.gamma) > EXACT, abs(step.beta)))


def _parallel(C: Array) -> Step:
    """Split a transform between parallel axes; e is chosen as 0."""
    x, y, z = C[:3, 3]
    alpha = 0.0 if C[2, 2] > 0 else np.pi
    whole = float(np.arctan2(C[1, 0], C[0, 0]))  # what stays when gamma is 0
    foot = float(np.arctan2(y, x))
    for beta in (whole, foot, foot - np.copysign(np.pi, foot)):
        c, s = np.cos(beta), np.sin(beta)
        if abs(c * y - s * x) < EXACT:
            break
    return Step(beta, float(z), float(c * x + s * y), alpha, 0.0, _turn_after(C, beta, alpha))


def _turn_after(C: Array, beta: float, alpha: float) -> float:
    """Return gamma."""
    step = _motion(Step(beta, 0, 0, alpha, 0, 0))
    R = step[:3, :3].T @ C[:3, :3]
    return float(np.arctan2(R[1, 0], R[0, 0]))


def _motion(step: Step) -> Array:
    """Return Rz(beta) Tz(d) Tx(a) Rx(alpha), without what comes after."""
    turn = exp_so3(np.array([[0, 0, step.beta], [step.alpha, 0, 0]]))
    return pose(turn[0] @ turn[1], turn[0] @ np.array([step.a, 0, 0]) + np.array([0, 0, step.d]))


def _upright(axis: Array) -> tuple[Array, float]:
    """Return a rotation (4, 4) W and a direction with W z direction = axis; none where the axis is z or -z, or zero."""
    if not axis.any() or np.hypot(axis[0], axis[1]) < EXACT**1.5:
        return np.eye(4), -1.0 if axis[2] < 0 else 1.0
    turn = np.array([-axis[1], axis[0], 0.0])
    size = np.linalg.norm(turn)
    angle = np.arctan2(size, axis[2])
    return pose(exp_so3(turn / size * angle), np.zeros(3)), 1.0


def _wrapped(angle: Array) -> Array:
    """Return angles within (-pi, pi], a half turn as +pi."""
    wrapped = np.remainder(angle + np.pi, 2 * np.pi) - np.pi
    return np.where(np.abs(wrapped + np.pi) < EXACT, np.pi, wrapped)
