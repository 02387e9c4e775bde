"""Paths (ISO 9283, 8) and circles (ISO 230-4): how far off a path is, how it scatters, how it reverses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.iso9283 import Figure, repeatability

#: Degrees on either side of a reversal that are left out, and that are used, where its step is read off.
NEAR_DEG, FAR_DEG = 3.0, 25.0


class PathFigures(NamedTuple):
    """A path followed several times.

    Attributes:
        accuracy: AT, m: the largest distance of the mean path from the commanded one.
        repeatability: RT: the largest over the stations.
        off: (S,) distance of the mean path from the commanded one at every station, m.
    """

    accuracy: float
    repeatability: Figure
    off: Array


def path_figures(attained: Array, command: Array, cov: Array) -> PathFigures:
    """Judge a path (8.2, 8.3).

    Args:
        attained: (n, S, 3) places, n times along the path, base, m.
        command: (S, 3) commanded places, in their order.
        cov: (n, S, 3, 3) covariance by the instrument, m^2.

    Raises:
        InputError: fewer than three times or stations.
    """
    n, stations = attained.shape[:2]
    if n < 3 or stations < 3:
        raise InputError(f"a path followed {n} times at {stations} stations; 3 of both are needed, 10 times are usual")
    along = np.gradient(command, axis=0)
    along /= np.linalg.norm(along, axis=1)[:, None]
    across = np.eye(3) - along[:, :, None] * along[:, None]  # only what is square to the path counts
    seen = (across @ (attained - command)[..., None])[..., 0]
    off = np.linalg.norm(seen.mean(axis=0), axis=1)
    each = [repeatability(seen[:, s], across[s] @ cov[:, s] @ across[s]) for s in range(stations)]
    return PathFigures(float(off.max()), max(each, key=lambda figure: figure.raw), off)


class CircleFigures(NamedTuple):
    """A circle run both ways.

    Attributes:
        centre: (3,) of the fitted circle, m.
        radius_m: of the fitted circle.
        circularity_m: G, the largest less the smallest radius of either way, the larger of the two.
        hysteresis_m: H, the largest difference of the radii of the two ways at one angle.
        steps_m: (2, 4) jump of the radius at 0, 90, 180, 270 degrees, counter-clockwise and clockwise, outwards positive.
        backlash_m: (2,) play along the circle's first and second axis: the mean of the four jumps where it turns back.
        sigma_backlash_m: its sigma.
    """

    centre: Array
    radius_m: float
    circularity_m: float
    hysteresis_m: float
    steps_m: Array
    backlash_m: Array
    sigma_backlash_m: float


def circle_figures(ccw: Array, cw: Array, axes: Array) -> CircleFigures:
    """Judge a circle, and read play off where an axis turns back.

    Where the path crosses an axis of the circle, the motion along that axis turns back: it lagged by half the play before,
    and lags by half of it the other way after, so the radius jumps outwards by the play.

    Args:
        ccw: (N, 3) places counter-clockwise, m.
        cw: (M, 3) clockwise.
        axes: (2, 3) unit vectors of the circle's plane along which angles count from the first to the second.

    Raises:
        InputError: a way does not go all around.
    """
    flat = [p @ axes.T for p in (ccw, cw)]
    centre, radius = _fitted(np.concatenate(flat))
    ways = [(np.degrees(np.arctan2(*(p - centre).T[::-1])) % 360, np.linalg.norm(p - centre, axis=1)) for p in flat]
    for (angle, _), name in zip(ways, ("counter-clockwise", "clockwise"), strict=True):
        gaps = np.diff(np.sort(np.append(angle, angle.min() + 360)))
        if len(angle) < 72 or gaps.max() > 15:
            raise InputError(f"the circle {name} has gaps: places every 5 degrees, all around, are needed")
    steps, scatter = np.zeros((2, 4)), []
    for w, (angle, r) in enumerate(ways):
        for k in range(4):
            steps[w, k], sigma = _step(angle, r, 90.0 * k, 1.0 if w == 0 else -1.0)
            scatter.append(sigma)
    grid = np.arange(0, 360, 2.0)
    both = [np.interp(grid, np.sort(a), r[np.argsort(a)], period=360) for a, r in ways]
    # At 0 and 180 degrees the motion along the second axis is fastest and that along the first turns back.
    play = np.array([steps[:, 0::2].mean(), steps[:, 1::2].mean()])
    off = axes.T @ centre + (np.eye(3) - axes.T @ axes) @ np.concatenate([ccw, cw]).mean(axis=0)
    return CircleFigures(
        off,
        radius,
        max(float(np.ptp(r)) for _, r in ways),
        float(np.abs(both[0] - both[1]).max()),
        steps,
        play,
        float(np.sqrt(np.mean(np.square(scatter)) / 4)),
    )


def _fitted(p: Array) -> tuple[Array, float]:
    """Return centre and radius of the circle through places (N, 2) in algebraic least squares, enough for a full circle."""
    A = np.column_stack([2 * p, np.ones(len(p))])
    x = np.linalg.lstsq(A, (p**2).sum(axis=1), rcond=None)[0]
    return x[:2], float(np.sqrt(x[2] + x[:2] @ x[:2]))


def _step(angle: Array, r: Array, at: float, way: float) -> tuple[float, float]:
    """Return the jump of the radius at an angle, in the sense of motion, and its sigma: two lines through its sides."""
    from_it = way * ((angle - at + 180) % 360 - 180)
    sides = []
    for side in (-1.0, 1.0):
        rows = (side * from_it > NEAR_DEG) & (side * from_it < FAR_DEG)
        A = np.column_stack([np.ones(rows.sum()), from_it[rows] / FAR_DEG])
        x = np.linalg.lstsq(A, r[rows], rcond=None)[0]
        left = r[rows] - A @ x
        variance = float(left @ left) / max(len(left) - 2, 1) * float(np.linalg.inv(A.T @ A)[0, 0])
        sides.append((float(x[0]), variance))
    return sides[1][0] - sides[0][0], float(np.sqrt(sides[0][1] + sides[1][1]))
