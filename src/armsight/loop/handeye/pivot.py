"""Pivot calibration: where a tool's tip is, from rotating the tool about the tip while the tip stands still.

In: poses of what is tracked (the flange in the base, or the body in the rig). Out: :class:`Pivot`. R_i p_tip + t_i =
p_pivot is linear in both unknown points (Yaniv, "Which pivot calibration?", SPIE Medical Imaging 2015).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.data import Array, Record
from armsight.errors import CalibrationError, InputError
from armsight.estimate.linear import Linear
from armsight.estimate.solve import Solved, by_chance, left_out, solve
from armsight.geometry.check import checked

MIN_POSES, CHANCE = 4, 1e-4  # fewest poses, and the chance below which one is taken for a mistake
#: Largest share of the scatter with which the tip may be known, along its worst axis: more rotation lowers it.
MAX_AMPLIFICATION = 20.0
ROUNDS = 10  # rounds of leaving out mistakes


@dataclass(frozen=True, eq=False)
class Pivot(Record):
    """A tool's tip."""

    p_body: Array  #: (3,) the tip in what is tracked, m
    p_pivot: Array  #: (3,) where it stood, m
    cov: Array  #: (6, 6) covariance of both, in this order
    #: (N,) distance of the tip from where it stood, each pose by a fit to the others; NaN where not used
    held_out_m: Array
    used: NDArray[np.bool_]  #: (N,) whether a pose was used


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
    linear = _linear(poses)
    for _ in range(ROUNDS):
        s = _solved(linear, used)
        sane = by_chance(np.sum((linear.e + linear.J @ s.x) ** 2, axis=1), 3, CHANCE, 1e-18)
        if (sane == used).all() or sane.sum() < MIN_POSES:
            break
        used = sane
    for k in np.flatnonzero(used):  # no single pose may decide
        _solved(linear, used & (np.arange(len(used)) != k))
    s = _solved(linear, used)
    cov = s.root @ s.root.T * float((s.left**2).sum() / max(s.left.size - 6, 1))
    held_out = np.full(len(poses), np.nan)
    held_out[used] = np.linalg.norm(left_out(s)[0], axis=1)
    return Pivot(s.x[:3], s.x[3:], cov, held_out, used)


def _linear(Ts: Array) -> Linear:
    """Return where the tip is, less where it should be, by tip and pivot (6,), from both at zero."""
    J = np.concatenate([Ts[:, :3, :3], np.broadcast_to(-np.eye(3), (len(Ts), 3, 3))], axis=2)
    given = np.broadcast_to(np.eye(3), (len(Ts), 3, 3))
    return Linear(Ts[:, :3, 3], J, given, {}, {}, np.zeros(6), np.zeros(6))


def _solved(linear: Linear, used: NDArray[np.bool_]) -> Solved:
    """Return tip and pivot (6,) by the poses used, for a scatter of 1."""
    s = solve(linear.rows(np.flatnonzero(used)), np.zeros(0))
    if np.sqrt(float(np.linalg.eigvalsh(s.root @ s.root.T)[-1]) * used.sum()) > MAX_AMPLIFICATION:
        why = "the tool was rotated too little, or about one axis only, to determine its tip"
        raise CalibrationError(f"{why}: rotate it by 30 degrees and more to all sides while the tip stands still")
    return s
