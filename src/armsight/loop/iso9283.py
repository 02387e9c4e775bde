"""What robots are judged by (ISO 9283): pose accuracy and repeatability, several directions, distance, drift.

In: poses attained again and again at a few commanded ones, and the instrument's covariance. Out: the standard's figures,
and beside each the figure without the instrument's own noise, with its uncertainty; what cannot be told from the noise is
called not resolvable, with the figure that could be. Clauses are those of ISO 9283:1998.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.pose import mean_pose
from armsight.geometry.rotation import log_so3

#: Fewest attained poses of which a scatter is told.
LEAST = 3
#: A scatter is resolvable where it is over the noise by so many of its own sigmas (one side, 2.3 % by chance).
RESOLVED = 2.0
#: The bound given for what is not resolvable: one side, 95 %.
BOUND = 1.645


@dataclass(frozen=True)
class Figure:
    """One figure of the standard.

    Attributes:
        raw: as the standard computes it, m or rad.
        clean: without the instrument's noise; None where it cannot be resolved.
        sigma: of ``clean``, or of ``raw`` where there is no clean one.
        resolvable: the smallest figure that this test could have told from the instrument's noise.
    """

    raw: float
    clean: float | None
    sigma: float
    resolvable: float


@dataclass(frozen=True, eq=False)
class PoseFigures(Record):
    """Clause 7.2: one commanded pose.

    Attributes:
        count: how many attained poses.
        accuracy: AP of the place, m: distance of the attained poses' barycentre from the command.
        accuracy_xyz: (3,) its parts, m.
        accuracy_turn: (3,) the turn from the command to the mean, rad, about the command's axes.
        repeatability: RP of the place, m: mean distance from the barycentre plus three of its standard deviations.
        repeatability_turn: (3,) RP of the turn about the command's axes, rad: three standard deviations.
    """

    count: int
    accuracy: Figure
    accuracy_xyz: Array
    accuracy_turn: Array
    repeatability: Figure
    repeatability_turn: Array


def pose_figures(attained: Array, command: Array, cov: Array) -> PoseFigures:
    """Judge one commanded pose (7.2.1 and 7.2.2).

    Args:
        attained: (n, 4, 4) poses, base.
        command: (4, 4) the pose commanded.
        cov: (n, 3, 3) covariance of the attained places by the instrument, base's axes, m^2.

    Raises:
        InputError: fewer than three poses.
    """
    n = len(attained)
    if n < LEAST:
        raise InputError(f"a pose was attained {n} times; {LEAST} times and more are needed, 30 are the standard's")
    p = attained[:, :3, 3]
    middle = p.mean(axis=0)
    mean = mean_pose(attained)
    off = middle - command[:3, 3]
    turns = log_so3(np.ascontiguousarray(mean[:3, :3].T @ attained[:, :3, :3]))
    return PoseFigures(
        n,
        _accuracy(off, p, cov),
        off,
        log_so3(command[:3, :3].T @ mean[:3, :3]),
        repeatability(p, cov),
        3 * turns.std(axis=0, ddof=1),
    )


def _accuracy(off: Array, p: Array, cov: Array) -> Figure:
    """Return AP: its square holds the variance of the barycentre, which is taken off."""
    raw = float(np.linalg.norm(off))
    variance = np.atleast_2d(np.cov(p.T)) / len(p)  # scatter of arm and instrument together, in the barycentre
    floor = float(np.sqrt(np.trace(variance)))
    along = off / raw if raw > 0 else np.array([1.0, 0.0, 0.0])
    sigma = float(np.sqrt(max(float(along @ variance @ along), 0.0)))
    clean = float(np.sqrt(max(raw**2 - floor**2, 0.0)))
    resolvable = RESOLVED * floor
    return Figure(raw, clean if raw > resolvable else None, sigma, resolvable)


def repeatability(p: Array, cov: Array) -> Figure:
    """Return RP of places (7.2.2): mean distance from the barycentre plus three standard deviations of the distances.

    The instrument's covariance is taken off the scatter's; what is left scales the figure by what mean and deviation of the
    distance are in a normal scatter of that covariance.

    Args:
        p: (n, 3) places attained, m.
        cov: (n, 3, 3) their covariance by the instrument, m^2.
    """
    distance = np.linalg.norm(p - p.mean(axis=0), axis=1)
    raw = float(distance.mean() + 3 * distance.std(ddof=1))
    S, C = np.atleast_2d(np.cov(p.T)), cov.mean(axis=0)
    if not np.any(S):
        return Figure(raw, 0.0, 0.0, 0.0)
    spread = float(np.sqrt(2 * np.trace(S @ S) / (len(p) - 1)))  # sigma of the trace of S
    noise = float(np.sqrt(2 * np.trace(C @ C) / (len(p) - 1)))  # the same of a scatter by the instrument alone
    ratio = raw / distance_limit(S)
    resolvable = ratio * distance_limit(C * (RESOLVED * noise / max(float(np.trace(C)), 1e-300)))
    excess = float(np.trace(S) - np.trace(C))
    sigma = raw * spread / (2 * float(np.trace(S)))
    if excess <= RESOLVED * noise:
        return Figure(raw, None, sigma, max(resolvable, ratio * _limit_of_trace(max(excess, 0.0) + BOUND * spread)))
    clean = ratio * distance_limit(_positive(S - C))
    return Figure(raw, clean, clean * spread / (2 * excess), resolvable)


def distance_limit(S: Array) -> float:
    """Return E l + 3 sd l of the length l of a normal vector of covariance S (3, 3), from its first two moments."""
    square, variance = float(np.trace(S)), 2 * float(np.trace(S @ S))
    if square <= 0:
        return 0.0
    mean = np.sqrt(square) * (1 - variance / (8 * square**2))
    return float(mean + 3 * np.sqrt(max(square - mean**2, 0.0)))


def _limit_of_trace(trace: float) -> float:
    return distance_limit(np.eye(3) * trace / 3)


def _positive(S: Array) -> Array:
    values, vectors = np.linalg.eigh(S)
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)


def multi_directional(attained: list[Array]) -> Figure:
    """Return vAP (7.2.3): the largest distance between the barycentres of one pose come to from several directions.

    Args:
        attained: (n, 3) places for every direction.

    Raises:
        InputError: fewer than two directions.
    """
    if len(attained) < 2:
        raise InputError("a pose was come to from one direction only; two and more are needed")
    middles = np.array([p.mean(axis=0) for p in attained])
    variances = [float(np.trace(np.cov(p.T))) / len(p) if len(p) > 1 else 0.0 for p in attained]
    apart = np.linalg.norm(middles[:, None] - middles, axis=2)
    i, j = divmod(int(np.argmax(apart)), len(apart))
    raw = float(apart[i, j])
    floor = float(np.sqrt(variances[i] + variances[j]))
    clean = float(np.sqrt(max(raw**2 - floor**2, 0.0))) if raw > RESOLVED * floor else None
    return Figure(raw, clean, floor / np.sqrt(3), RESOLVED * floor)


def distance_figures(from_m: Array, to_m: Array, commanded_m: float, cov: Array) -> tuple[Figure, Figure]:
    """Return AD and RD (7.3): error of the mean distance between two poses, and three deviations of it.

    Args:
        from_m: (n, 3) places attained at the first pose.
        to_m: (n, 3) at the second, in the same cycles.
        commanded_m: distance of the commands, m.
        cov: (n, 3, 3) covariance of either place by the instrument, m^2.
    """
    along = to_m - from_m
    d = np.linalg.norm(along, axis=1)
    ray = along / d[:, None]
    noise = 2 * float(np.einsum("ni,nij,nj->n", ray, cov, ray).mean())
    n, variance = len(d), float(d.var(ddof=1))
    sigma = float(np.sqrt(variance / n))
    accuracy = abs(float(d.mean()) - commanded_m)
    AD = Figure(accuracy, accuracy if accuracy > RESOLVED * sigma else None, sigma, RESOLVED * sigma)
    chance = np.sqrt(2 / (n - 1))
    least = 3 * float(np.sqrt(RESOLVED * chance * noise))
    left = variance - noise
    clean = 3 * float(np.sqrt(left)) if left > RESOLVED * chance * noise else None
    raw = 3 * float(np.sqrt(variance))
    return AD, Figure(raw, clean, raw * chance / 2, least)


def drift(t_s: Array, p: Array, groups: int = 5) -> tuple[Array, Array]:
    """Return how the place of one pose wanders (7.5).

    Args:
        t_s: (n,) times, s.
        p: (n, 3) places attained, m.
        groups: parts of equal count in order of time.

    Returns:
        (groups,) middle times, s; (groups,) distances of each group's barycentre from the first one's, m.
    """
    order = np.array_split(np.argsort(t_s, kind="stable"), min(groups, len(p)))
    middles = np.array([p[rows].mean(axis=0) for rows in order])
    times = np.array([t_s[rows].mean() for rows in order])
    return times, np.linalg.norm(middles - middles[0], axis=1)
