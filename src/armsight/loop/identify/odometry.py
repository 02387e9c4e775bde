"""Odometry: the joints alone, added up from a known pose; a peer and a baseline of what fuses vision.

In: joint angles and the poses that were measured with them. Out: how far odometry is off after so much travel of the
tool, and how far by the arm's prior. From the known pose T0 at joint angles q0 it is T0 F(q0)^-1 F(q), F the nominal
forward kinematics; of encoders without an index q0 is by the inverse kinematics of T0. An error x of the arm
(``armerror``) shows as H(q) x - Ad(F(q)^-1 F(q0)) H(q0) x in the tool's right tangent: it grows with travel as the two
derivatives become different, and is bounded, as nothing but the joints is added up.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.geometry.pose import adjoint, inverse
from armsight.loop.estimators.armerror import Prior
from armsight.loop.estimators.errormodel import ErrorModel
from armsight.robot.kinematics.arm import Arm

#: Its error is said after travels of the tool, m, begun anew each step of so many m; half, double: as many numbers.
TRAVELS_M, STEP_M = (0.1, 0.3, 1.0, 3.0), 0.02


class Odometry(NamedTuple):
    """How far odometry is off: root mean square of the position, m, after travels, m; by measurement, and by the prior."""

    travel_m: tuple[float, ...]
    error_rms_m: tuple[float, ...]
    predicted_rms_m: tuple[float, ...]

    @property
    def line(self) -> str:
        """It as a line for people."""
        each = (
            f"{1e3 * error:.2f} mm after {travel:g} m ({1e3 * predicted:.2f} predicted)"
            for travel, error, predicted in zip(*self, strict=True)
        )
        return f"odometry, joints alone from a known pose: off by {', '.join(each)}"


def odometry(arm: Arm, q: Array, Ts_base_tool: Array, prior: Prior | None = None) -> Odometry | None:
    """Return how far odometry is off; None where the tool travelled less than the least of ``TRAVELS_M``.

    ``arm``: the nominal arm. ``q``: (N, n) joint angles by their sensors, rad, in order of time; rows that are no
    numbers are left out. ``Ts_base_tool``: (N, 4, 4) poses of the tool then, by what is taken for the truth. ``prior``:
    how far the arm may be off.
    """
    prior = prior or Prior()
    kept, points = list[int](), Ts_base_tool[:, :3, 3].tolist()
    for row in np.flatnonzero(np.isfinite(Ts_base_tool).all(axis=(1, 2)) & np.isfinite(q).all(axis=1)).tolist():
        if not kept or math.dist(points[row], points[kept[-1]]) >= STEP_M:  # a step that noise does not make
            kept.append(row)
    p = Ts_base_tool[kept, :3, 3]
    way = np.cumsum(np.linalg.norm(np.diff(p, axis=0, prepend=p[:1]), axis=1))
    rows = np.array(kept, int)[np.searchsorted(way, np.arange(0.0, way[-1] if len(way) else 0.0, STEP_M))]
    q, T, F = np.ascontiguousarray(q[rows]), Ts_base_tool[rows], arm.forward(q[rows])
    model = ErrorModel(arm, prior, 0.0)
    # Links are on the side of the backlash where friction holds them as their joints move; gravity keeps its side.
    unseen = np.stack(
        [np.sign(np.gradient(q, axis=0)) if len(q) > 1 else q, np.ones(q.shape), np.zeros(q.shape)], axis=1
    )
    _, H = model.poses(np.zeros(model.layout.size), q, unseen)
    own, lasting = H[:, :, model.layout.zeros] * prior.rest_rad, (H * model.sigmas)[:, :, : model.layout.rest]
    found = list[tuple[float, float, float]]()
    for travel in TRAVELS_M:
        if (steps := round(travel / STEP_M)) >= len(rows):
            break
        begin, end = slice(0, len(rows) - steps), slice(steps, None)
        back = inverse(F[end]) @ F[begin]
        error = (T[begin] @ inverse(back) - T[end])[:, :3, 3]
        moved = adjoint(back)
        apart = np.concatenate([lasting[end] - moved @ lasting[begin], own[end], moved @ own[begin]], axis=2)
        found.append((travel, _rms(error), _rms(apart[:, :3].reshape(len(error), -1))))
    return Odometry(*map(tuple, zip(*found, strict=True))) if found else None


def _rms(rows: Array) -> float:
    return float(np.sqrt((rows**2).sum(axis=1).mean()))
