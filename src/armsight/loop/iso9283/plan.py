"""Which poses to go to for ISO 9283: five in the diagonal plane of a cube (clause 6.8), or a hundred all over it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.robot.kinematics.arm import Arm

#: Smallest singular value of the Jacobian at a pose of the test: the outer loop still corrects every direction.
MIN_SINGULAR_VALUE = 0.02
#: The poses are this part of the diagonal from the cube's corners (6.8.1).
INSIDE = 0.1
#: Sizes of cubes that are tried, m, largest first: the standard's, and smaller ones for small arms (6.8.2).
CUBES_M = (1.0, 0.63, 0.4, 0.25, 0.16, 0.1)
#: Poses of the wider test.
MANY = 100
#: Centres that are tried: so far from axis 1 and above the base, in sizes of the arm, nearest to the tool at home first.
AWAY, ABOVE = np.arange(0.35, 0.86, 0.05), np.arange(-0.1, 0.61, 0.05)
#: How far joints stay from their limits, rad.
CLEAR_RAD = float(np.radians(5.0))
#: Largest rotation of the tool about each axis from its orientation at home in the wider test, rad.
MAX_ROTATION_RAD = 0.3


class CheckPlan(NamedTuple):
    """Poses to go to."""

    names: tuple[str, ...]  #: of the poses
    Ts_base_tool: Array  #: (N, 4, 4)
    q: Array  #: (N, n) joint angles, rad
    side_m: float  #: of the cube
    centre: Array  #: (3,) of the cube, base, m


def everywhere(Ts_base_tool: Array) -> NDArray[np.bool_]:
    """Allow all poses (N, 4, 4)."""
    return np.ones(len(Ts_base_tool), bool)


def plan_check(
    arm: Arm,
    *,
    centre: Array | None = None,
    wide: bool = False,
    allowed: Callable[[Array], NDArray[np.bool_]] = everywhere,
    feasible: Callable[[CheckPlan], bool] = lambda plan: True,
) -> CheckPlan:
    """Choose the poses of a test in the largest cube that the arm reaches, clear of its limits and of singularities.

    Args:
        arm: the arm.
        centre: (3,) of the cube in the base, m; None: on the side where the tool is at home, where the cube is largest.
        wide: a hundred poses all over the cube, rotated too, instead of the standard's five.
        allowed: returns which poses (N, 4, 4) may be used, such as those that the cameras see.
        feasible: returns whether a plan can be carried out; if not, the next cube is tried.

    Raises:
        InputError: not even the smallest cube will do.
    """
    if centre is not None and not np.isfinite(centre).all():
        raise InputError("the cube's centre must be three finite numbers")
    home = arm.forward(arm.home)
    centres = _centres(arm, home[:3, 3]) if centre is None else centre[None]
    for side in CUBES_M:
        for middle in centres:
            Ts = _wide(home, middle, side) if wide else _five(home, middle, side)
            for q in _reached(arm, Ts, allowed):
                rows = np.flatnonzero(np.isfinite(q).all(axis=1))[: MANY if wide else len(Ts)]
                if len(rows) < (MANY if wide else len(Ts)):
                    continue
                plan = CheckPlan(tuple(f"P{k + 1}" for k in range(len(rows))), Ts[rows], q[rows], side, middle)
                if feasible(plan):
                    return plan
    raise InputError(
        f"{arm.name}: not even a cube of {1e3 * CUBES_M[-1]:.0f} mm there is within reach, clear of limits and, where "
        "cameras are given, seen; give another centre"
    )


def _centres(arm: Arm, p_home: Array) -> Array:
    """Return centres (N, 3) in the upright plane of axis 1 and the tool at home (3,), base, m, nearest to that first."""
    axis = arm.T_base_0[:3, 3]
    out = (p_home - axis) * [1, 1, 0]
    out = out / np.linalg.norm(out) if np.linalg.norm(out) > 0.1 * arm.size_m else np.array([1.0, 0.0, 0.0])
    away, above = (g.ravel() for g in np.meshgrid(AWAY * arm.size_m, ABOVE * arm.size_m))
    centres = axis + away[:, None] * out + above[:, None] * np.array([0.0, 0.0, 1.0])
    return np.vstack([p_home, centres[np.argsort(np.linalg.norm(centres - p_home, axis=1), kind="stable")]])


def _reached(arm: Arm, Ts: Array, allowed: Callable[[Array], NDArray[np.bool_]]) -> Iterator[Array]:
    """Yield joint angles (N, n) of poses, rad, for each configuration; NaN where not reached, clear or allowed."""
    rows_m = np.array([arm.size_m] * 3 + [1.0] * 3)[:, None]
    low, high = arm.q_min + CLEAR_RAD, arm.q_max - CLEAR_RAD
    may = allowed(Ts)
    first = arm.inverse(Ts[0], near=arm.home)
    for signs, start in zip(first.signs, first.q, strict=True):
        q = np.full((len(Ts), arm.joints), np.nan)
        if not may[0] or np.any((start < low) | (start > high)):
            continue
        for k in np.flatnonzero(may):
            found = arm.inverse(Ts[k], near=start)
            clear = (found.signs == signs).all(axis=1) & ((found.q >= low) & (found.q <= high)).all(axis=1)
            for angles in found.q[clear][:1]:
                if np.linalg.svd(arm.jacobian(angles) / rows_m, compute_uv=False)[-1] > MIN_SINGULAR_VALUE:
                    q[k] = angles
        yield q


def _five(home: Array, middle: Array, side: float) -> Array:
    """Return poses (5, 4, 4): the centre (3,) and four points of a diagonal plane, all oriented as home (4, 4)."""
    far = side / 2 * (1 - 2 * INSIDE)
    corners = np.array([[0, 0, 0], [1, -1, 1], [1, 1, 1], [-1, 1, -1], [-1, -1, -1]])  # of the plane x = z
    return np.array([pose(home[:3, :3], middle + far * corner) for corner in corners])


def _wide(home: Array, middle: Array, side: float) -> Array:
    """Return twice as many random poses (N, 4, 4) as are needed, over the cube about its middle (3,), and rotated so."""
    rng = np.random.default_rng(0)
    positions = middle + rng.uniform(-side / 2, side / 2, (2 * MANY, 3))
    positions[0] = middle  # sets the configuration of all
    rotations = exp_so3(rng.uniform(-MAX_ROTATION_RAD, MAX_ROTATION_RAD, (2 * MANY, 3)))
    return np.array([pose(home[:3, :3] @ R, p) for R, p in zip(rotations, positions, strict=True)])
