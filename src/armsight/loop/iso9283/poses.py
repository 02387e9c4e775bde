"""Metrics of poses (ISO 9283): accuracy and repeatability, several directions, distance, drift.

In: poses attained again and again at a few commanded ones, and the instrument's covariance. Out: the standard's metrics,
and beside each the metric without the instrument's own noise, with its uncertainty; one that cannot be distinguished from
the noise is called not resolvable, with the smallest that could be. Clauses are those of ISO 9283:1998.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.pose import mean_pose
from armsight.geometry.rotation import log_so3
from armsight.loop.iso9283.statistic import (
    Metric,
    beyond_noise,
    group_errors,
    lengths,
    mean_errors,
    sampled_errors,
    scatter,
)

#: Fewest attained poses for a scatter.
MIN_POSES = 3
_GROUPS = 5  # of equal count, in order of time, whose means show a drift
#: Where an integral is summed: beyond its ends lie 1e-6 of it.
_U = np.linspace(-28.0, 28.0, 113)


@dataclass(frozen=True, eq=False)
class PoseMetrics(Record):
    """Clause 7.2: one commanded pose."""

    count: int
    AP_m: Metric  #: AP of the position: distance of the attained poses' barycentre from the command
    AP_xyz_m: Array  #: (3,) its parts
    #: (3,) the rotation from the command to the mean about the command's axes; None if unknown
    AP_rotation_rad: Array | None
    RP_m: Metric  #: RP of the position: mean distance from the barycentre plus three of its standard deviations
    #: (3,) RP of the rotation about the command's axes: three standard deviations; None likewise
    RP_rotation_rad: Array | None


def pose_metrics(
    attained: Array, command: Array, cov: Array, common: Array | None = None, way: NDArray[np.int64] | None = None
) -> PoseMetrics:
    """Evaluate one commanded pose (7.2.1 and 7.2.2).

    Args:
        attained: (n, 4, 4) poses, base.
        command: (4, 4) the pose commanded.
        cov: (n, 3, 3) covariance of the attained positions by the instrument, base's axes, m^2: what differs between them.
        common: (3, 3) that of the instrument's constant error; none of it where it is not given.
        way: (n,) by which approach each was attained, from 0; None: by one. The scatter is that about each approach's own
            barycentre: the standard's repeatability is of one direction, and vAP of several.

    Raises:
        InputError: fewer than three poses.
    """
    n = len(attained)
    if n < MIN_POSES:
        raise InputError(f"a pose was attained {n} times; {MIN_POSES} times and more are needed, 30 are the standard's")
    p = attained[:, :3, 3]
    off = p.mean(axis=0) - command[:3, 3]
    mean = mean_pose(attained)
    rotations = log_so3(np.ascontiguousarray(mean[:3, :3].T @ attained[:, :3, :3]))
    rng = np.random.default_rng(0)  # the same test gives the same metrics
    errors = mean_errors(p[:, None], rng)
    if common is not None:
        errors = errors + sampled_errors(common[None], rng)
    return PoseMetrics(
        n,
        beyond_noise(lengths, off[None], errors),
        off,
        log_so3(command[:3, :3].T @ mean[:3, :3]),
        repeatability(p, cov, way),
        3 * np.sqrt((_within(rotations, way)[0] ** 2).sum(axis=0) / _within(rotations, way)[1]),
    )


def repeatability(p: Array, cov: Array, way: NDArray[np.int64] | None = None) -> Metric:
    """Return RP of positions (7.2.2): mean distance from the barycentre plus three standard deviations of the distances.

    Args:
        p: (n, 3) positions attained, m.
        cov: (n, 3, 3) their covariance by the instrument, m^2.
        way: (n,) see :func:`pose_metrics`.
    """
    off, freedom = _within(p, way)
    distance = np.linalg.norm(off, axis=1)
    raw = float(distance.mean() + 3 * np.sqrt(((distance - distance.mean()) ** 2).sum() / freedom))
    S = off.T @ off / freedom
    ratio = raw / float(distance_limit(S)) if np.any(S) else 0.0
    return scatter(S, cov.mean(axis=0), freedom + 1, distance_limit, ratio)


def _within(values: Array, way: NDArray[np.int64] | None) -> tuple[Array, int]:
    """Return values (n, d) less the means of their groups, and the degrees of freedom left."""
    groups = np.zeros(len(values), np.int64) if way is None else way
    means = np.array([values[groups == k].mean(axis=0) for k in range(int(groups.max()) + 1)])
    return values - means[groups], len(values) - len(means)


def distance_limit(S: Array) -> Array:
    """Return E l + 3 sd l of the length l of normal vectors of covariances S (..., 3, 3).

    E l is the integral over u of (1 - prod_i (1 + 2 v_i e^u)^-1/2) e^(-u/2) / (2 sqrt pi), v_i the eigenvalues (Mathai and
    Provost, "Quadratic forms in random variables", 1992, 3.2).
    """
    square = np.einsum("...ii->...", S)
    share = np.maximum(np.linalg.eigvalsh(S), 0.0) / np.maximum(square, 1e-300)[..., None]
    fallen = 1 / np.sqrt(np.prod(1 + 2 * share[..., None] * np.exp(_U), axis=-2))
    mean = np.sqrt(square) * ((1 - fallen) * np.exp(-_U / 2)).sum(axis=-1) * (_U[1] - _U[0]) / (2 * np.sqrt(np.pi))
    return np.asarray(mean + 3 * np.sqrt(np.maximum(square - mean**2, 0.0)))


def anywhere(off: Array, cov: Array, common: Array) -> tuple[Metric, Metric]:
    """Return the mean and the largest error over many poses, each attained once or twice: accuracy over the workspace.

    Args:
        off: (N, 3) attained positions less the commanded ones, m.
        cov: (N, 3, 3) covariance by the instrument, m^2: what differs from pose to pose. Where it is zero it is not
            known, and what was attained once does not show it: the metrics have no interval.
        common: (3, 3) that of its constant error.
    """
    if not np.any(cov):
        each = np.linalg.norm(off, axis=1)
        mean, largest = (Metric(raw, raw, None, None, None) for raw in (float(each.mean()), float(each.max())))
        return mean, largest
    rng = np.random.default_rng(0)
    errors = sampled_errors(cov, rng) + sampled_errors(common[None], rng)
    mean = beyond_noise(lambda x: np.asarray(np.linalg.norm(x, axis=-1).mean(axis=-1)), off, errors)
    return mean, beyond_noise(lengths, off, errors)


def multi_directional(attained: list[Array]) -> Metric:
    """Return vAP (7.2.3): the largest distance between the barycentres of one pose come to from several directions.

    Args:
        attained: (n, 3) positions for every direction.

    Raises:
        InputError: fewer than two directions.
    """
    if len(attained) < 2:
        raise InputError("a pose was come to from one direction only; two and more are needed")
    i, j = np.triu_indices(len(attained), 1)
    middles = np.array([p.mean(axis=0) for p in attained])
    errors = _errors_of_means(attained)
    return beyond_noise(lengths, middles[i] - middles[j], errors[:, i] - errors[:, j])


def _errors_of_means(groups: list[Array]) -> Array:
    """Sample errors (B, k, 3) of the barycentres of k groups of positions (n, 3)."""
    rng = np.random.default_rng(0)
    return np.stack([mean_errors(p, rng) for p in groups], axis=1)


def distance_metrics(from_m: Array, to_m: Array, commanded_m: float, cov: Array) -> tuple[Metric, Metric]:
    """Return AD and RD (7.3): error of the mean distance between two poses, and three deviations of it.

    Args:
        from_m: (n, 3) positions attained at the first pose.
        to_m: (n, 3) at the second, in the same cycles.
        commanded_m: distance of the commands, m.
        cov: (n, 3, 3) covariance of either position by the instrument, m^2.
    """
    along = to_m - from_m
    d = np.linalg.norm(along, axis=1)
    ray = along / d[:, None]
    noise = 2 * float(np.einsum("ni,nij,nj->n", ray, cov, ray).mean())
    errors = mean_errors(d[:, None, None], np.random.default_rng(0))
    AD = beyond_noise(lengths, np.array([[d.mean() - commanded_m]]), errors)
    S = np.atleast_2d(np.var(d, ddof=1))
    return AD, scatter(S, np.atleast_2d(noise), len(d), lambda S: 3 * np.sqrt(S[..., 0, 0]), 1.0)


def drift(t_s: Array, p: Array) -> tuple[Array, Array, Metric]:
    """Return the drift of one pose's position (7.5).

    Args:
        t_s: (n,) times, s.
        p: (n, 3) positions attained, m.

    Returns:
        (G,) middle times of the groups, s; (G,) distances of each group's barycentre from the first one's, m; the largest.
    """
    order = np.array_split(np.argsort(t_s, kind="stable"), min(_GROUPS, len(p)))
    middles = np.array([p[rows].mean(axis=0) for rows in order])
    times = np.array([t_s[rows].mean() for rows in order])
    within = np.concatenate([p[rows] - p[rows].mean(axis=0) for rows in order])  # one scatter for all: groups are small
    counts = np.array([len(rows) for rows in order])
    errors = group_errors(within, counts, np.random.default_rng(0))
    off = middles - middles[0]
    metric = beyond_noise(lengths, off, errors - errors[:, :1])
    return times, np.linalg.norm(off, axis=1), metric
