"""What is wrong with data that fit an arm far too badly: units, order or signs of the joints; and what to do.

The linear placement (``place``) needs no start and gives a scale for free; it is tried for every order and sign of the
joints on a few poses. A cheap arm is off by 10 to 15 mm; data that are off by a tenth of the space they span are of
another arm, or another order.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.place import linear_placement
from armsight.robot.arm import Arm
from armsight.robot.kinematics import chain

#: Worse than this part of the space that the points span (RMS about their middle), and this many m, is another arm.
BAD_SHARE, BAD_M = 0.08, 0.015
#: A proposal must be this many times better than what was given.
BETTER = 4.0
#: A scale off by more than this is a unit.
SCALE_OFF = 0.2
#: Poses looked at.
POSES = 80
#: What joint angles may have been multiplied by.
_ANGLES = (
    (np.pi / 180, "degrees; name the columns q1_deg .. q6_deg"),
    (180 / np.pi, "radians; name the columns q1_rad .. q6_rad"),
)
#: Orders whose signs are tried, best first.
ORDERS = 40
_SCALES = {1e-3: "m, not mm", 1e3: "mm, not m", 1e-1: "dm or cm", 10.0: "cm", 1 / 25.4: "inches", 25.4: "inches"}


def check_plausible(arm: Arm, measured: Measured) -> None:
    """Refuse data that cannot be of this arm, with what would make them fit.

    Raises:
        InputError: with the unit, the order or the signs that fit, or that none does.
    """
    if np.abs(measured.q).max() > chain.MOST_RADIANS:
        row, joint = divmod(int(np.argmax(np.abs(measured.q))), 6)
        raise InputError(
            f"joint {joint + 1} of row {row + 1} is at {measured.q[row, joint]:g} rad, further than any joint turns: are "
            "the angles in degrees? name the columns q1_deg .. q6_deg"
        )
    rows = np.linspace(0, len(measured) - 1, min(POSES, len(measured))).astype(int)
    q, p = measured.q[rows], measured.p_rig[rows]
    off, scale = misfit(arm, q, p)
    span = float(np.sqrt(np.mean(np.sum((p - p.mean(axis=0)) ** 2, axis=2))))
    scaled = abs(np.log(scale)) > np.log1p(SCALE_OFF)
    good = off < max(BAD_SHARE * span, BAD_M * (scale if scaled else 1.0))
    if good and not scaled:
        return
    told = _angles(arm, q, p, off)
    if told is None:
        told = _unit(scale) if good else _proposal(arm, q, p, off, max(BAD_SHARE * span, BAD_M))
    raise InputError(told or _no_arm(off))


def misfit(arm: Arm, q: Array, p_rig: Array) -> tuple[float, float]:
    """Return the RMS distance of points from an arm placed freely, m as measured, and the scale of the points."""
    T = arm.forward(q) @ np.linalg.inv(arm.T_flange_tool)
    R, o = T[:, :3, :3], T[:, :3, 3]
    M, _, t = linear_placement(R, o, p_rig)
    scale = float(np.cbrt(abs(np.linalg.det(M))))
    if not scale > 1e-12:
        return np.inf, 1.0
    U, _, Vt = np.linalg.svd(M)
    turn = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt * scale
    e = p_rig @ turn.T - (o[:, None] + (R @ t.T).swapaxes(1, 2))
    e -= e.mean(axis=(0, 1))
    return float(np.sqrt(np.mean(np.sum(e**2, axis=2)))) / scale, 1 / scale


def _unit(scale: float) -> str:
    near = min(_SCALES, key=lambda s: abs(np.log(scale / s)))
    if abs(np.log(scale / near)) < np.log1p(SCALE_OFF):
        return (
            f"the points are {scale:.4g} times as large as the arm's motions: are they in {_SCALES[near]}? "
            "name the columns by their unit: p1_x_m or p1_x_mm"
        )
    return f"the points are {scale:.3g} times as large as this arm's motions: is it the right model, in the right unit?"


def _angles(arm: Arm, q: Array, p: Array, off: float) -> str | None:
    """Return the unit of the joint angles that makes the data fit, scale and all, or None."""
    for factor, what in _ANGLES:
        if np.abs(q * factor).max() < chain.MOST_RADIANS:
            better, scale = misfit(arm, q * factor, p)
            if abs(np.log(scale)) < np.log1p(SCALE_OFF) and better < off / BETTER:
                return (
                    f"the arm's motions fit if the joint angles are in {what} (off by {1e3 * off:.0f} mm as they are)"
                )
    return None


def _proposal(arm: Arm, q: Array, p: Array, off: float, bad: float) -> str | None:
    """Return the order and the signs that make the data fit, or None."""
    order, signs, best = _search(arm, q, p)
    if best > min(off / BETTER, bad):
        return None
    told = []
    if order != tuple(range(6)):
        told.append("the joints' order is " + ", ".join(f"q{i + 1}" for i in order))
    if (signs < 0).any():
        told.append("the sign is turned of joint " + ", ".join(str(i + 1) for i in np.flatnonzero(signs < 0)))
    return (
        f"the data fit this arm if {' and '.join(told)} (off by {1e3 * off:.0f} mm as they are, {1e3 * best:.1f} mm so): "
        "put the columns right"
    )


def _search(arm: Arm, q: Array, p: Array) -> tuple[tuple[int, ...], Array, float]:
    """Return the order and the signs that fit best: signs in the given order, then every order, then both."""
    signs = [np.array(s, float) for s in itertools.product((1.0, -1.0), repeat=6)]
    few = np.linspace(0, len(q) - 1, min(24, len(q))).astype(int)

    def off(order: tuple[int, ...], sign: Array, rows: NDArray[np.int64]) -> float:
        return misfit(arm, q[rows][:, order] * sign, p[rows])[0]

    same = tuple(range(6))
    best = min((off(same, s, few), 0, same, i) for i, s in enumerate(signs))
    orders = sorted((off(order, signs[0], few), order) for order in itertools.permutations(range(6)))
    tried = [best, (orders[0][0], 1, orders[0][1], 0)]
    every = np.arange(len(q))
    _, _, order, i = min(tried, key=lambda t: t[0])
    found = off(order, signs[i], every)
    if found > off(same, signs[0], every) / BETTER:
        both = min((off(order, s, few), order, i) for _, order in orders[:ORDERS] for i, s in enumerate(signs))
        order, i, found = both[1], both[2], off(both[1], signs[both[2]], every)
    return order, signs[i], found


def _no_arm(off: float) -> str:
    return (
        f"these data are not of this arm: placed as well as can be it is off by {1e3 * off:.0f} mm; no unit, order or sign "
        "of the joints mends it. Is it the right model, with the table's right convention?"
    )


def without_tool(arm: Arm) -> Arm:
    """Return the arm with its tool at the flange: where it is on the flange is found from the data."""
    return replace(arm, T_flange_tool=np.eye(4))
