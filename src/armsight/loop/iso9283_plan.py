"""Which poses to go to for ISO 9283: five in the diagonal plane of a cube (clause 6.8), or a hundred all over it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.robot.arm import Arm

#: The poses sit this part of the diagonal from the cube's corners (6.8.1).
INSIDE = 0.1
#: Sizes of cubes that are tried, m, largest first: the standard's, and smaller ones for small arms (6.8.2).
CUBES_M = (1.0, 0.63, 0.4, 0.25, 0.16, 0.1)
#: Poses of the wider test, and cycles of the standard one.
MANY, CYCLES = 100, 30
#: Centres that are tried: at these parts of the home's distance from axis 1.
NEARER = (1.0, 0.85, 0.7, 0.55)
#: How far the tool turns from its turn at home in the wider test, rad.
TURNED = 0.3


class CheckPlan(NamedTuple):
    """Poses to go to.

    Attributes:
        names: of the poses.
        Ts_base_tool: (N, 4, 4).
        q: (N, 6) joint angles, rad.
        side_m: of the cube.
        centre: (3,) of the cube, base, m.
    """

    names: tuple[str, ...]
    Ts_base_tool: Array
    q: Array
    side_m: float
    centre: Array


def plan_check(arm: Arm, *, centre: Array | None = None, wide: bool = False, seed: int = 0) -> CheckPlan:
    """Choose the poses of a test in the largest cube that the arm reaches.

    Args:
        arm: the arm.
        centre: (3,) of the cube in the base, m; None: between the tool at home and axis 1, where the cube is largest.
        wide: a hundred poses all over the cube, turned too, instead of the standard's five.
        seed: of the hundred.

    Raises:
        InputError: not even the smallest cube is within reach.
    """
    home = arm.forward(arm.home)
    axis = arm.T_base_0[:3, 3]
    out = (home[:3, 3] - axis) * [1, 1, 0]  # nearer to axis 1 there is more room than at the rim of the reach
    centres = [home[:3, 3] - (1 - share) * out for share in NEARER] if centre is None else [centre]
    for side in CUBES_M:
        for middle in centres:
            Ts = _wide(home, middle, side, seed) if wide else _five(home, middle, side)
            q = [arm.inverse(T, near=arm.home).best for T in Ts]
            reached = [k for k, angles in enumerate(q) if angles is not None]
            if len(reached) == len(Ts) or (wide and len(reached) >= MANY):
                rows = reached[:MANY] if wide else reached
                found = np.array([angles for k in rows if (angles := q[k]) is not None])
                return CheckPlan(tuple(f"P{k + 1}" for k in range(len(rows))), Ts[rows], found, side, middle)
    raise InputError(f"{arm.name}: no cube of {1e3 * CUBES_M[-1]:.0f} mm is within reach there; give another centre")


def _five(home: Array, middle: Array, side: float) -> Array:
    """Return the centre and four places in a diagonal plane, all with the turn of home."""
    far = side / 2 * (1 - 2 * INSIDE)
    corners = np.array([[0, 0, 0], [1, -1, 1], [1, 1, 1], [-1, 1, -1], [-1, -1, -1]])  # of the plane x = z
    return np.array([pose(home[:3, :3], middle + far * corner) for corner in corners])


def _wide(home: Array, middle: Array, side: float, seed: int) -> Array:
    """Return twice as many poses as are wanted, at random over the cube and turned at random."""
    rng = np.random.default_rng(seed)
    places = middle + rng.uniform(-side / 2, side / 2, (2 * MANY, 3))
    turns = exp_so3(rng.uniform(-TURNED, TURNED, (2 * MANY, 3)))
    return np.array([pose(home[:3, :3] @ R, p) for R, p in zip(turns, places, strict=True)])
