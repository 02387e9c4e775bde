"""Metrics of paths (ISO 9283, clause 8) and circles (ISO 230-4): accuracy, repeatability, reversals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, stdtrit

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.loop.iso9283.poses import repeatability
from armsight.loop.iso9283.statistic import (
    HIGH,
    SAMPLES,
    WIDE,
    Metric,
    beyond_noise,
    lengths,
    mean_errors,
    sampled_errors,
)

#: Degrees beside a reversal that are left out (backlash up to 1 % of the radius), and that its step is estimated from.
NEAR_DEG, FAR_DEG = 8.0, 32.0
#: Fewest positions on either side of a reversal; fewest of a whole circle; and the largest gap between them, deg.
_SIDE, _MIN_POINTS, _GAP_DEG = 5, 72, 15.0
#: Positions of a circle this close are averaged, deg.
_BIN_DEG = 4.0
#: How often a scatter is tried again.
_TRIALS = 200


@dataclass(frozen=True, eq=False)
class PathMetrics(Record):
    """A path followed several times."""

    count: int  #: how many times
    AT_m: Metric  #: the largest distance of the mean path from the commanded one
    RT_m: Metric  #: that of the path point with the largest as measured
    off_m: Array  #: (S,) distance of the mean path from it at every path point


def path_metrics(attained: Array, command: Array, cov: Array, common: Array | None = None) -> PathMetrics:
    """Evaluate a path (8.2, 8.3).

    Args:
        attained: (n, S, 3) positions at S points of the path, n times, base, m.
        command: (S, 3) commanded positions, in their order.
        cov: (n, S, 3, 3) covariance by the instrument, m^2: what differs from position to position.
        common: (3, 3) that of its constant error; none of it where it is not given.

    Raises:
        InputError: fewer than three times or points, or two points of the path in a row are equal.
    """
    n, points = attained.shape[:2]
    if n < 3 or points < 3:
        raise InputError(f"a path followed {n} times at {points} points; 3 of both are needed, 10 times are usual")
    across = square_to(command)
    seen = (across @ (attained - command)[..., None])[..., 0]
    middle, rng = seen.mean(axis=0), np.random.default_rng(0)
    errors = mean_errors(seen, rng)
    if common is not None:
        errors = errors + (across @ sampled_errors(common[None], rng)[..., None])[..., 0]
    limits = _limits(seen - middle)
    worst = int(np.argmax(limits))
    RT = repeatability(seen[:, worst], across[worst] @ cov[:, worst] @ across[worst])
    AT, RT = beyond_noise(lengths, middle, errors), _picked(RT, _chosen(seen - middle, rng))
    return PathMetrics(n, AT, RT, np.linalg.norm(middle, axis=1))


def square_to(command: Array) -> Array:
    """Return projections (S, 3, 3) onto the planes square to a path at its points (S, 3).

    Raises:
        InputError: two points of the path in a row are equal.
    """
    along = np.gradient(command, axis=0)
    length = np.linalg.norm(along, axis=1)
    if not length.all():
        raise InputError(
            f"at its point {np.argmin(length) + 1} the commanded path does not advance: its points must follow each other"
        )
    along /= length[:, None]
    return np.asarray(np.eye(3) - along[:, :, None] * along[:, None])


def _limits(off: Array) -> Array:
    """Return RP (..., S) at every path point, of offsets (..., n, S, 3) from the mean path."""
    length = np.linalg.norm(off, axis=-1)
    return np.asarray(length.mean(axis=-2) + 3 * length.std(axis=-2, ddof=1))


def _chosen(off: Array, rng: np.random.Generator) -> float:
    """Return the factor by which the largest RP of all path points is biased, by trial with the same scatter."""
    n = len(off)
    largest = float(_limits(off).max())
    weights = rng.normal(0, 1 / np.sqrt(n - 1), (_TRIALS, n, n))
    again = np.einsum("bni,isk->bnsk", weights, off)
    tried = _limits(again - again.mean(axis=1, keepdims=True)).max(axis=-1)
    return max(float(tried.mean()) / largest, 1.0) if largest > 0 else 1.0


def _picked(metric: Metric, factor: float) -> Metric:
    """Return a metric that was picked as the largest, divided by its bias; the upper end stays."""
    clean, low = (None if each is None else each / factor for each in (metric.clean, metric.low))
    return replace(metric, clean=clean, low=low)


class CircleMetrics(NamedTuple):
    """A circle run both ways."""

    centre_m: Array  #: (3,) of the fitted circle
    radius_m: float  #: of the fitted circle
    circularity_m: Metric  #: G, the largest less the smallest radius of either way, the larger of the two
    hysteresis_m: Metric  #: H, the largest difference of the radii of the two ways at one angle
    #: (2, 4) jump of the radius at 0, 90, 180, 270 degrees, counter-clockwise and clockwise, outwards positive
    steps_m: Array
    #: along the circle's first and second axis: the mean of the four jumps where that axis reverses
    backlash_m: tuple[Metric, Metric]
    jumps_m: tuple[Metric, ...]  #: of the radius at each of the reversals asked for
    angle_deg: Array  #: (B,) angles of the curves
    radii_m: Array  #: (2, B) mean radii about each, less ``radius_m``, counter-clockwise and clockwise


def circle_metrics(
    ccw: Array, cw: Array, axes: Array, cov: Array | None = None, reversals: Sequence[tuple[float, float]] = ()
) -> CircleMetrics:
    """Evaluate a circle, and estimate backlash where an axis reverses.

    Where the path crosses an axis of the circle, the motion along that axis reverses: it lagged by half the backlash
    before, and lags by half of it the other way after, so the radius jumps outwards by the backlash.

    Args:
        ccw: (N, 3) positions counter-clockwise, base, m.
        cw: (M, 3) positions clockwise, base, m.
        axes: (2, 3) unit vectors of the circle's plane along which angles count from the first to the second.
        cov: (3, 3) covariance of a position by the instrument, m^2. The noise is that of the scatter from position to
            position, or this where it is more.
        reversals: where else the radius may jump: angles, deg, and the way, 1 counter-clockwise, -1 clockwise.

    Raises:
        InputError: a way does not go all around, or a reversal has too few positions beside it.
    """
    flat = [p @ axes.T for p in (ccw, cw)]
    centre, radius = _fitted(np.concatenate(flat))
    ways = [(np.degrees(np.arctan2(*(p - centre).T[::-1])) % 360, np.linalg.norm(p - centre, axis=1)) for p in flat]
    for (angle, _), name in zip(ways, ("counter-clockwise", "clockwise"), strict=True):
        gap = float(np.diff(np.sort(np.append(angle, angle.min() + 360))).max())
        if len(angle) < _MIN_POINTS or gap > _GAP_DEG:
            raise InputError(
                f"the circle {name} has {len(angle)} positions, up to {gap:.1f} degrees apart: {_MIN_POINTS} are "
                f"needed at least, all around, none further apart than {_GAP_DEG:.0f} degrees"
            )
    steps, variances = np.zeros((2, 4)), np.zeros((2, 4))
    for w, (angle, r) in enumerate(ways):
        for k in range(4):
            steps[w, k], variances[w, k] = _step(angle, r, 90.0 * k, 1.0 if w == 0 else -1.0)
    # At 0 and 180 degrees the motion along the second axis is fastest and that along the first reverses.
    x, y = (_backlash(steps[:, k::2], variances[:, k::2]) for k in (0, 1))
    grid, radii, counts = _binned(ways)
    along = np.stack([np.cos(np.radians(grid)), np.sin(np.radians(grid))], axis=1) @ axes
    known = np.zeros(len(grid)) if cov is None else np.einsum("ki,ij,kj->k", along, cov, along)
    seen = np.array([[_neighbour_variance(angle, r)] for angle, r in ways])
    sigma = np.sqrt(np.maximum(seen, known) / counts)
    errors = sigma * np.random.default_rng(0).normal(size=(SAMPLES, *sigma.shape))
    return CircleMetrics(
        axes.T @ centre + (np.eye(3) - axes.T @ axes) @ np.concatenate([ccw, cw]).mean(axis=0),
        radius,
        _widest(lambda r: np.asarray(np.ptp(r, axis=-1).max(axis=-1)), radii, errors),
        _widest(lambda r: np.asarray(np.abs(r[:, 0] - r[:, 1]).max(axis=-1)), radii, errors),
        steps,
        (x, y),
        tuple(_backlash(*(np.array([v]) for v in _step(*ways[int(way < 0)], at, way))) for at, way in reversals),
        grid,
        radii - radius,
    )


def _widest(statistic: Callable[[Array], Array], radii: Array, errors: Array) -> Metric:
    """Return a largest difference of radii (2, B), with samples (D, 2, B) of their errors.

    The largest of many is picked where the error is large too; but no error makes it larger by more than its own
    difference.
    """
    metric = beyond_noise(statistic, radii, errors)
    return metric if metric.clean is None else replace(metric, low=metric.raw - float(metric.resolvable or 0.0))


def _neighbour_variance(angle: Array, r: Array) -> float:
    """Return the variance of radii (N,) at angles (N,), deg, m^2: how far each is off the line through its neighbours.

    What comes slowly along the way is its form (Gasser, Sroka and Jennen-Steinmetz, Biometrika 73, 1986).
    """
    order = np.argsort(angle, kind="stable")
    at, r = angle[order], r[order]
    before, after = (at - np.roll(at, 1)) % 360, (np.roll(at, -1) - at) % 360
    span = before + after
    share = np.where(span > 0, before / np.where(span > 0, span, 1.0), 0.5)
    off = r - (1 - share) * np.roll(r, 1) - share * np.roll(r, -1)
    return float((off**2 / (1 + share**2 + (1 - share) ** 2)).mean())


def _binned(ways: list[tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """Return angles (B,), deg, mean radii (2, B), m, of both ways, and counts (2, B); empty bins are interpolated."""
    grid = np.arange(0, 360, _BIN_DEG)
    radii, counts = np.zeros((2, len(grid))), np.ones((2, len(grid)))
    for w, (angle, r) in enumerate(ways):
        at = np.round(angle / _BIN_DEG).astype(int) % len(grid)
        number = np.bincount(at, minlength=len(grid))
        counts[w] = np.maximum(number, 1)
        filled = number > 0
        radii[w] = np.interp(grid, grid[filled], (np.bincount(at, r, len(grid)) / counts[w])[filled], period=360)
    return grid, radii, counts


def _backlash(steps: Array, variances: Array) -> Metric:
    """Return the mean of jumps (1, k) of variances (1, k) with its interval; negative where the radius falls.

    Where jumps differ by more than their sigmas the interval is that of their scatter (Birge, Phys. Rev. 40, 1932).
    """
    value, freedom = float(steps.mean()), steps.size - 1
    apart = float(((steps - value) ** 2 / variances).sum()) if np.all(variances > 0) else 0.0
    if freedom and apart > chdtri(freedom, 1 - HIGH):
        sigma, wide = float(steps.std(ddof=1)) / np.sqrt(steps.size), float(stdtrit(freedom, HIGH))
    else:
        sigma, wide = float(np.sqrt(variances.sum())) / steps.size, WIDE
    resolvable = wide * sigma
    resolved = abs(value) > resolvable
    return Metric(value, value if resolved else None, value - resolvable, value + resolvable, resolvable)


def _fitted(p: Array) -> tuple[Array, float]:
    """Return centre and radius of the circle through positions (N, 2), by algebraic least squares: enough if full."""
    A = np.column_stack([2 * p, np.ones(len(p))])
    x = np.linalg.lstsq(A, (p**2).sum(axis=1), rcond=None)[0]
    return x[:2], float(np.sqrt(x[2] + x[:2] @ x[:2]))


def _step(angle: Array, r: Array, at: float, way: float) -> tuple[float, float]:
    """Return the jump of the radius at an angle, in the sense of motion, m, and its variance: lines through both sides."""
    from_it = way * ((angle - at + 180) % 360 - 180)
    sides = []
    for side in (-1.0, 1.0):
        rows = (side * from_it > NEAR_DEG) & (side * from_it < FAR_DEG)
        if rows.sum() < _SIDE or np.ptp(from_it[rows]) < _SIDE:
            raise InputError(
                f"the circle {'counter-clockwise' if way > 0 else 'clockwise'} has {rows.sum()} positions between "
                f"{NEAR_DEG:.0f} and {FAR_DEG:.0f} degrees to one side of {at:.0f} degrees: {_SIDE} and more are needed, "
                f"over {_SIDE} degrees and more, as positions every 4 degrees have"
            )
        A = np.column_stack([np.ones(rows.sum()), from_it[rows] / FAR_DEG])
        x = np.linalg.lstsq(A, r[rows], rcond=None)[0]
        left = r[rows] - A @ x
        variance = float(left @ left) / max(len(left) - 2, 1) * float(np.linalg.inv(A.T @ A)[0, 0])
        sides.append((float(x[0]), variance))
    return sides[1][0] - sides[0][0], sides[0][1] + sides[1][1]


def plane_axes(normal: Array) -> Array:
    """Return axes (2, 3) of a plane with a unit normal (3,): the base's that lies nearest, and the one square to it."""
    n = normal * np.sign(normal[np.argmax(np.round(np.abs(normal), 6))])
    first = np.eye(3)[np.argmin(np.round(np.abs(n), 6))]
    first = first - (first @ n) * n
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(n, first)])
