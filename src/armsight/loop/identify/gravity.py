"""An arm that carries a reference: what a sensor on its tool shows of the arm's own errors, and what it leaves open.

In: joint angles at rests, readings of a calibrated inertial unit. Out: the base's tilt, and of each set of joints with
parallel axes the sum of their zeros: of such joints gravity sees only the sum. The arm's other errors (links, linearity,
compliance) are unknowns too, by their prior, so that they are in the sigmas.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.loop.estimators.armerror import Prior, offsets_by
from armsight.loop.estimators.errormodel import ErrorModel
from armsight.loop.references.calibrate import OPEN, Carrier, ReferenceCalibration, calibrate
from armsight.loop.references.inertial import ACCELEROMETER, Inertial
from armsight.loop.references.reference import Reading, ToolMotion
from armsight.robot.kinematics.arm import Arm

#: Axes within this angle of each other at the table's values are parallel, rad; half, double: no common arm has such ones.
_PARALLEL = 1e-3
#: Rests that are needed at least.
LEAST_RESTS = 8


class ArmRests(Carrier):
    """An arm at rests.

    Args:
        q: (N, n) readings of the joints at the rests, rad; the time of a rest is its row.
    """

    def __init__(self, arm: Arm, prior: Prior, q: Array) -> None:
        self._model, self._q = ErrorModel(arm, prior, 0.0), np.array(q)
        at = self._at = self._model.layout
        free = np.ones(at.size, np.bool_)
        free[:5] = free[at.linearity - 6 : at.linearity] = False  # base and tool frames are where they are: a gauge
        free[at.backlash : at.compliance] = free[at.rest :] = False
        self._free, self._x, self.sigma = np.flatnonzero(free), np.zeros(at.size), self._model.sigmas[free]
        # Each rest is elsewhere in the backlash, and by the rest that no function of the joint explains.
        own = np.sqrt(0.25 * (prior.backlash_rad**2 + prior.float_rad**2) + prior.rest_rad**2)
        self.scatter = own * np.isin(self._free, at.zeros)
        self._direction, self._table, self._between = arm.direction, arm.table, between(arm)

    def at(self, t_s: float) -> tuple[ToolMotion, Array]:
        """Return the tool's pose at a rest, and its derivative by the errors."""
        (T,), (H,) = self._model.poses(self._x, self._q[[int(t_s)]], np.zeros((1, 3, self._at.joints)))
        return ToolMotion(T), H[:, self._free]

    def moved(self, step: Array) -> Self:
        """Return it with errors moved by a step."""
        other = copy(self)
        other._x = self._x.copy()
        other._x[self._free] += step
        return other

    def zeros(self, cov: Array) -> tuple[Array, Array]:
        """Return how far the joints (n,) are beyond their readings, rad, the mean of the rests, and its covariance (n, n).

        That is the zero with what linearity and compliance add to it where the arm rested: a wave of the one cannot be
        distinguished from the other there. A link's frame that is bent about y is rotated about the axes of the joints
        before and after it, unless these are parallel: Denavit and Hartenberg's zeros hold that.
        """
        n, at = self._at.joints, self._at
        each = np.empty((len(self._q), n, at.size))
        for q, by in zip(self._q, each, strict=True):
            offsets_by(self._table, q, np.zeros((3, n)), by)
        by = each.mean(axis=0)
        by[np.arange(n), at.zeros] = self._direction
        i = np.flatnonzero(np.abs(np.sin(self._between)) >= _PARALLEL)
        bent, twist = at.zeros[i + 1] - 1, self._between[i]
        by[i, bent] += self._direction[i] / np.sin(twist)
        by[i + 1, bent] -= self._direction[i + 1] / np.tan(twist)
        return by @ self._x, by[:, self._free] @ cov @ by[:, self._free].T


class Shown(NamedTuple):
    """What gravity shows of one quantity.

    ``joints``: whose zeros it is the sum of, from 1; empty for the tilt. ``value`` and ``sigma``: rad. ``open``: whether
    gravity leaves it as unknown as it was.
    """

    name: str
    joints: tuple[int, ...]
    value: float
    sigma: float
    open: bool


def between(arm: Arm) -> Array:
    """Return the angles (n - 1,) from each joint's axis to the next one's, rad."""
    return arm.alpha[:-1] if arm.convention == "standard" else arm.alpha[1:]


def parallel(arm: Arm) -> list[list[int]]:
    """Return the joints, from 0, in sets whose axes are parallel at all angles."""
    sets = [[0]]
    for joint, twist in enumerate(between(arm), 1):
        if abs(np.sin(twist)) < _PARALLEL:
            sets[-1].append(joint)
        else:
            sets.append([joint])
    return sets


def check_rests(where: str, count: int) -> None:
    """Raise an InputError about what ``where`` says if rests are too few."""
    if count < LEAST_RESTS:
        raise InputError(f"{where}: {count} rests were given; gravity shows zeros from {LEAST_RESTS} on, 30 are good")


def gravity_shows(
    arm: Arm, sensor: Inertial, q: Array, readings: Sequence[Reading]
) -> tuple[list[Shown], ReferenceCalibration[Inertial]]:
    """Return the base's tilt about x and y and the zeros, by gravity at rests.

    ``arm``: as its table says it is. ``sensor``: calibrated; its ``cov`` says how far it may be off. ``q``: (N, n)
    readings of the joints at the rests, rad. ``readings``: N of the accelerometer, the mean of each rest; their times
    are the rests' rows.

    Raises:
        InputError: too few rests.
    """
    check_rests(sensor.name, len(q))
    if any(reading.channel != ACCELEROMETER for reading in readings):
        raise InputError(f"{sensor.name}: rests need readings of the accelerometer only")
    carrier = ArmRests(arm, Prior(), q)
    sensor = replace(sensor, delay_s=0.0, sigma_delay_s=0.0)  # a rest's time is its row
    found = calibrate(sensor, readings, carrier)
    assert isinstance(found.carrier, ArmRests)
    before = np.sqrt(np.diag(sensor.cov)[-2:])
    tilt, sigma = found.reference.values[-2:], np.sqrt(np.diag(found.reference.cov)[-2:])
    shown = [
        Shown(f"base tilt about {axis}", (), float(v), float(s), bool(s > OPEN * b))
        for axis, v, s, b in zip("xy", tilt, sigma, before, strict=True)
    ]
    zeros, cov = found.carrier.zeros(found.cov_carrier)
    _, cov_before = carrier.zeros(np.diag(carrier.sigma**2))
    for joints in parallel(arm):
        for some in [[joint] for joint in joints] + ([joints] if len(joints) > 1 else []):
            s, b = (float(np.sqrt(C[np.ix_(some, some)].sum())) for C in (cov, cov_before))
            names = "+".join(str(joint + 1) for joint in some)
            shown.append(Shown(f"zero {names}", tuple(j + 1 for j in some), float(zeros[some].sum()), s, s > 0.5 * b))
    return shown, found
