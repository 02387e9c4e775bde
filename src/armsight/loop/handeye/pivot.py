"""Pivot calibration: where a tool's tip is, from rotating the tool about the tip while the tip stands still.

In: poses of what is tracked (the flange in the base, or the body in the rig). Out: :class:`Pivot`. R_i p_tip + t_i =
p_pivot is linear in both unknown points (Yaniv, "Which pivot calibration?", SPIE Medical Imaging 2015).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.geometry.check import checked

#: Fewest poses, and the chance below which one is taken for a mistake.
MIN_POSES, CHANCE = 4, 1e-4
#: Largest share of the scatter with which the tip may be known, along its worst axis: more rotation lowers it.
MAX_AMPLIFICATION = 20.0
#: Rounds of leaving out mistakes.
ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Pivot(Record):
    """A tool's tip.

    Attributes:
        p_body: (3,) the tip in what is tracked, m.
        p_pivot: (3,) where it stood, m.
        cov: (6, 6) covariance of both, in this order.
        held_out_m: (N,) distance of the tip from where it stood, each pose by a fit to the others; NaN where not used.
        used: (N,) whether a pose was used.
    """

    p_body: Array
    p_pivot: Array
    cov: Array
    held_out_m: Array
    used: NDArray[np.bool_]


def calibrate_pivot(Ts: ArrayLike) -> Pivot:
    """Find a tool's tip.

    Args:
        Ts: (N, 4, 4) poses of what is tracked while the tip stands still, m; rotated by 30 degrees and more, all ways.

    Raises:
        InputError: wrong shape, NaN, fewer than four poses.
        CalibrationError: the tool was rotated too little.
    """
    poses = checked(Ts, (None, 4, 4), "Ts")
    if len(poses) < MIN_POSES:
        raise InputError(
            f"pivot calibration needs {MIN_POSES} or more poses, got {len(poses)}; 30 and more are advised"
        )
    used = np.ones(len(poses), bool)
    for _ in range(ROUNDS):
        x, H = _solved(poses[used])
        e = _residuals(poses, x)
        scale = float(np.median(np.sum(e**2, axis=1)) / chdtri(3, 0.5))
        sane = np.sum(e**2, axis=1) <= chdtri(3, CHANCE) * max(scale, 1e-18)
        if (sane == used).all() or sane.sum() < MIN_POSES:
            break
        used = sane
    x, H = _solved(poses[used])
    e = _residuals(poses, x)[used]
    cov = np.asarray(np.linalg.inv(H)) * float((e**2).sum() / max(e.size - 6, 1))
    return Pivot(x[:3], x[3:], cov, _held_out(poses, used), used)


def _solved(Ts: Array) -> tuple[Array, Array]:
    """Return tip and pivot (6,), and the normal matrix (6, 6)."""
    M = np.concatenate([Ts[:, :3, :3], np.broadcast_to(-np.eye(3), (len(Ts), 3, 3))], axis=2).reshape(-1, 6)
    H = M.T @ M
    if np.sqrt(len(Ts) / max(float(np.linalg.eigvalsh(H)[0]), 1e-300)) > MAX_AMPLIFICATION:
        raise CalibrationError(
            "the tool was rotated too little, or about one axis only, to determine its tip: rotate it by 30 degrees and "
            "more to all sides while the tip stands still"
        )
    return np.asarray(np.linalg.solve(H, -M.T @ Ts[:, :3, 3].ravel())), H


def _residuals(Ts: Array, x: Array) -> Array:
    """Return where the tip is, less where it should be, (N, 3)."""
    return np.asarray(Ts[:, :3, :3] @ x[:3] + Ts[:, :3, 3] - x[3:])


def _held_out(Ts: Array, used: NDArray[np.bool_]) -> Array:
    """Return the distances of every used pose under a fit to the others."""
    out = np.full(len(Ts), np.nan)
    rows = np.flatnonzero(used)
    for k in rows:
        out[k] = float(np.linalg.norm(_residuals(Ts[k : k + 1], _solved(Ts[rows[rows != k]])[0])))
    return out
