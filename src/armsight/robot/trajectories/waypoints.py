"""A path of the tool through way-points: straight lines whose corners are blended, so that it does not stop at them.

Near a corner the motion before it fades out while the one after it fades in: with the way s measured from the corner and
a blend that reaches r to both sides, position = corner + a f(s) + b g(s) and orientation = corner exp(alpha f) exp(beta g),
a, alpha and b, beta being what the lines before and after travel and rotate in a unit of way. g' rises from 0 to 1 as the
cubic step 3x^2 - 2x^3 and f' = 1 - g', so that speed and acceleration join the lines without a step. The tool passes a
corner at 3/16 r |b - a|: 0.27 r at a right angle.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.rotation import exp_so3, skew
from armsight.robot.trajectories.cartesian import PathMotion, follow
from armsight.robot.trajectories.path import PathPoints, checked_pose, way

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm


@dataclass(frozen=True, eq=False)
class BlendedPath(Record):
    """Straight lines through corners that are blended."""

    Ts_base_corner: Array  #: (C, 4, 4) poses of the corners, without start and goal
    #: (C + 1, 6) what each line travels and rotates in a unit of its way: [m/m base axes; rad/m tool's axes]
    rates: Array
    corners_m: Array  #: (C,) where the corners lie on the way, m
    blends_m: Array  #: (C,) how far each blend reaches to both sides, m
    length_m: float  #: the whole way

    def at(self, share: Array) -> PathPoints:
        """Return the path at shares (N,)."""
        s = share * self.length_m
        nearest = np.searchsorted((self.corners_m[1:] + self.corners_m[:-1]) / 2, s)
        f, g, g1, g2 = _fade(s - self.corners_m[nearest], self.blends_m[nearest])
        f1, f2 = 1 - g1, -g2
        before, after = self.rates[nearest], self.rates[nearest + 1]
        corner = self.Ts_base_corner[nearest]
        T = corner.copy()
        T[:, :3, 3] += before[:, :3] * f + after[:, :3] * g
        faded = exp_so3(after[:, 3:] * g)
        T[:, :3, :3] = corner[:, :3, :3] @ exp_so3(before[:, 3:] * f) @ faded
        # The rotation before, seen in the axes that the rotation after has already rotated.
        alpha = (np.swapaxes(faded, -1, -2) @ before[:, 3:, None])[..., 0]
        omega = alpha * f1 + after[:, 3:] * g1
        omega1 = alpha * f2 + after[:, 3:] * g2 - (skew(after[:, 3:] * g1) @ alpha[..., None])[..., 0] * f1
        R = T[:, :3, :3]
        twist = np.hstack([before[:, :3] * f1 + after[:, :3] * g1, (R @ omega[..., None])[..., 0]])
        bend = np.hstack([before[:, :3] * f2 + after[:, :3] * g2, (R @ omega1[..., None])[..., 0]])
        return PathPoints(T, twist * self.length_m, bend * self.length_m**2)


def _fade(s: Array, reach: Array) -> tuple[Array, Array, Array, Array]:
    """Return f, g, g', g'' (N, 1) of the module's formulas, ``s`` (N,) being the way from the corner."""
    x = np.clip((s + reach) / (2 * reach), 0.0, 1.0)
    g = np.where(s > reach, s, 2 * reach * (x**3 - x**4 / 2))
    g1, g2 = x * x * (3 - 2 * x), 6 * x * (1 - x) / (2 * reach)
    return (s - g)[:, None], g[:, None], g1[:, None], g2[:, None]


def waypoints(
    arm: Arm, q_start: ArrayLike, Ts_base_way: ArrayLike, *, blend_m: float, duration_s: float | None = None
) -> PathMotion:
    """Plan a path of the tool from where it is past way-points to the last of them, without stopping.

    ``q_start``: (n,) angles to start from, rad; their configuration is kept. ``Ts_base_way``: (M, 4, 4) poses of the tool,
    M >= 2; all but the last are passed at a distance (see the module). ``blend_m``: how far before a way-point its blend
    begins, m; shortened to half the lines beside it. On lines that mostly rotate, a radian counts as 0.25 m.
    ``duration_s``: how long it is to take, s; None for as short as the limits allow. Raises MotionRejected: the path leaves
    the reach or the joint limits, or meets a singularity; InputError: bad numbers, a way-point that repeats the one before,
    or a duration that cannot be met.
    """
    try:
        given = list(np.asarray(Ts_base_way, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise InputError(f"Ts_base_way must be poses (M, 4, 4): {error}") from None
    if len(given) < 2:
        raise InputError(f"Ts_base_way holds {len(given)} poses; 2 or more are needed, and for one there is the line")
    if not (np.isfinite(blend_m) and blend_m > 0):
        raise InputError(
            f"blend_m is {blend_m}; it must be a positive length in m (to stop at a corner, plan two motions)"
        )
    Ts = [arm.forward(q_start), *(checked_pose(T, f"way-point {i + 1}") for i, T in enumerate(given))]
    path = blended(np.array(Ts), blend_m)
    cruises = (path.corners_m[:, None] + path.blends_m[:, None] * [-1.0, 1.0]) / path.length_m
    return follow(arm, path, q_start, cruises=cruises, duration_s=duration_s)


def blended(Ts_base_tool: Array, blend_m: float) -> BlendedPath:
    """Return the path from the first of poses (M, 4, 4), M >= 3, past others to the last; InputError: one repeats."""
    ways = [way(a, b) for a, b in pairwise(Ts_base_tool)]
    for i, (_, _, length) in enumerate(ways):
        if length == 0:
            raise InputError(f"way-point {i + 1} is where the tool already is: leave it out")
    lengths = np.array([length for _, _, length in ways])
    return BlendedPath(
        Ts_base_tool[1:-1],
        np.array([np.concatenate([step, rotation]) / length for step, rotation, length in ways]),
        np.cumsum(lengths)[:-1],
        np.minimum(blend_m, np.minimum(lengths[:-1], lengths[1:]) / 2),
        float(lengths.sum()),
    )
