"""A magnetometer on the tool: a witness of joint 1's zero, and of a base that was rotated.

With R the sensor's attitude in the base and m the field there, it reads z = S R^T m + b: S is the soft iron, symmetric, b
the hard iron, both of what rotates with the sensor. The field of a motor is in neither. Along m's horizontal part, and
upwards, it shows, as a rotation about the vertical changes nothing there; what shows there is as large across, on average,
where it is taken for a heading.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.linalg import polar

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.rotation import exp_so3, log_so3, skew
from armsight.loop.references.reference import ExpectedReading, Reading, Reference, ToolMotion

#: The Earth's field, T, is 22e-6 to 67e-6 (IGRF); half, double: the soft iron is as much too small, no heading differs.
EARTH_T = 45e-6
#: One reading of a consumer's chip, one sigma, T; half, double: nothing, as motors are louder.
NOISE_T = 0.5e-6
#: A field that rotates with the tool by less, T, is none; half: dead sensors pass, double: weak fields are rejected.
LEAST_T = 5e-6
#: No field is larger, T, as ranges of chips end there; half, double: nothing.
MOST_T = 5e-3
#: Attitudes so near to each other, rad, show one field; half: an arm that creeps counts often, double: sweeps seldom.
_NEAR_RAD = 0.1
#: Fields are compared so far apart, s; half: a motor counts twice, double: sweeps are short of attitudes.
FIELDS_S = 0.2
#: Readings are averaged over so long, s; half: twice the time, double: fast sweeps are cut (0.5 mm at 60 mm).
AVERAGED_S = 0.02
#: One sigma before a calibration: soft iron, relative; hard iron and field, T; half, double: nothing.
_SOFT, _HARD_T, _FIELD_T = 0.3, 200e-6, 30e-6
#: Attitudes for 10 unknowns a row at least; singular value, last over first, below which they do not span the space.
_ATTITUDES, _SPANS = 12, 1e-2
#: Symmetric matrices: the rows and columns of their upper triangle, and the matrix (6, 3, 3) of each of its numbers.
_UPPER = np.triu_indices(3)
_SYMMETRIC = np.array([np.eye(3)[[i]].T * np.eye(3)[j] for i, j in zip(*_UPPER, strict=True)])
_SYMMETRIC = np.maximum(_SYMMETRIC, _SYMMETRIC.transpose(0, 2, 1))


@dataclass(frozen=True, eq=False, kw_only=True)
class Magnetometer(Reference):
    """A magnetometer."""

    R_tool_sensor: Array  #: (3, 3) its mounting
    soft: Array  #: (3, 3) soft iron and scale, symmetric
    hard_t: Array  #: (3,) hard iron, T
    field_t: Array  #: (3,) the field in the base, T

    @staticmethod
    def of(name: str) -> Magnetometer:
        """Return one of which nothing is known."""
        cov = np.diag(np.repeat([np.pi, _SOFT, _HARD_T, _FIELD_T], [3, 6, 3, 3]) ** 2)
        eye, field = np.eye(3), EARTH_T * np.eye(3)[0]
        given = Magnetometer(name=name, cov=cov, R_tool_sensor=eye, soft=eye, hard_t=np.zeros(3), field_t=field)
        return replace(given, sigma_delay_s=0.02)

    @property
    def channels(self) -> tuple[str, ...]:
        """The field."""
        return ("field",)

    @property
    def parameters(self) -> dict[str, float]:
        """Rotation vector of the mounting, soft iron, hard iron and field."""
        names = [f"rotation_{a}_rad" for a in "xyz"]
        names += [f"soft_{'xyz'[i]}{'xyz'[j]}" for i, j in zip(*_UPPER, strict=True)]
        names += [f"{what}_{a}_t" for what in ("hard", "field") for a in "xyz"]
        values = [*log_so3(self.R_tool_sensor[None])[0], *self.soft[_UPPER], *self.hard_t, *self.field_t]
        return dict(zip(names, map(float, values), strict=True))

    def expected(self, motion: ToolMotion, channel: int) -> ExpectedReading:
        """Return the field (3,), T, as the sensor reads it."""
        to_sensor = self.soft @ self.R_tool_sensor.T
        in_tool = motion.T_base_tool[:3, :3].T @ self.field_t
        f = self.R_tool_sensor.T @ in_tool
        by_soft, by_field = (_SYMMETRIC @ f).T, to_sensor @ motion.T_base_tool[:3, :3].T
        by = np.hstack([self.soft @ skew(f), by_soft, np.eye(3), by_field])
        by_tool = np.hstack([np.zeros((3, 3)), to_sensor @ skew(in_tool)])
        return ExpectedReading(self.soft @ f + self.hard_t, by_tool, by)

    def moved(self, step: Array) -> Self:
        """Return it with a mounting rotated on the right by ``step[:3]``, the other parameters added."""
        rotation, soft, hard, field = np.split(step, [3, 9, 12])
        R, soft = self.R_tool_sensor @ exp_so3(rotation), self.soft + np.tensordot(soft, _SYMMETRIC, 1)
        return replace(self, R_tool_sensor=R, soft=soft, hard_t=self.hard_t + hard, field_t=self.field_t + field)

    def begun(self, readings: Sequence[Reading], motion: Callable[[float], ToolMotion]) -> Self:
        """Return it with parameters near the truth, in closed form, for ``calibrate``.

        z = A R^T m + b is linear in the products of A and m, which one singular value makes two of again; A is soft iron
        times rotation.

        Raises:
            InputError: too few attitudes, or all about one axis.
        """
        check_unit(self.name, np.array([each.z for each in readings]))
        if len(readings) < _ATTITUDES:
            raise InputError(f"{self.name}: {len(readings)} attitudes; {_ATTITUDES} at least are needed")
        R = np.array([motion(each.t_s - self.delay_s).T_base_tool[:3, :3] for each in readings])
        z, by = np.array([each.z for each in readings]), R.transpose(0, 2, 1).reshape(-1, 9)
        spread = np.linalg.svd(by - by.mean(axis=0), compute_uv=False)
        if spread[-1] < _SPANS * spread[0]:
            raise InputError(f"{self.name}: the tool rotates about one axis alone: give it attitudes about two axes")
        found = np.linalg.lstsq(np.column_stack([by, np.ones(len(z))]), z, rcond=None)[0]
        U, s, Vt = np.linalg.svd(found[:9].T.reshape(9, 3))
        if s[0] < LEAST_T or s[0] < 3.0 * s[1]:
            raise InputError(
                f"{self.name}: its readings do not follow the tool's attitude: is it a magnetometer, in T?"
            )
        A, m = U[:, 0].reshape(3, 3), s[0] * Vt[0]
        sign = np.sign(np.linalg.det(A))
        size = np.linalg.norm(m) / EARTH_T
        rotation, soft = polar(sign * size * A, side="left")
        return replace(self, R_tool_sensor=rotation.T, soft=soft, hard_t=found[9], field_t=sign * m / size)


def check_unit(where: str, z: Array) -> None:
    """Raise an InputError where fields (N, 3) are so large that they are no tesla."""
    size = float(np.median(np.linalg.norm(z, axis=1))) if len(z) else 0.0
    if size > MOST_T:
        raise InputError(f"{where}: the field is {size:.3g} T, as if in uT, mG or gauss; give T (1 G is 1e-4 T)")


@dataclass(frozen=True, eq=False)
class HeadingOff(Record):
    """By how much the field says that the arm's heading is off: joint 1's zero, or the base was rotated."""

    angle_rad: float  #: rotation of the base about its z since the calibration
    sigma_rad: float  #: standard deviation, disturbances and calibration included; infinite at one attitude alone
    disturbance_t: Array  #: (N,) field of motors and iron at each reading, T, as far as it shows


def _attitudes(R: Array) -> Array:
    """Return which attitude each of the rotations (N, 3, 3) shows, from 0: the first that is near it, or a new one."""
    of = np.full(len(R), -1)
    while len(left := np.flatnonzero(of < 0)):
        near = np.tensordot(R[left], R[left[0]]) > 1.0 + 2.0 * np.cos(_NEAR_RAD)  # the trace of one by the other
        of[left[near]] = of.max() + 1
    return of


def heading_off(sensor: Magnetometer, readings: Sequence[Reading], motion: Callable[[float], ToolMotion]) -> HeadingOff:
    """Compare the heading of the arm with that of the field.

    Args:
        sensor: calibrated, as :func:`~armsight.loop.references.calibrate.calibrate` does it.
        readings: at two attitudes or more; with drives as they are in use.
        motion: returns where the arm believes its tool at a time, s.

    Raises:
        InputError: fewer than two readings, or a field so steep that it has no heading.
    """
    m = sensor.field_t
    level = float(np.hypot(m[0], m[1]))
    if len(readings) < 2 or level < 0.05 * np.linalg.norm(m):
        raise InputError(f"{sensor.name}: expected two readings, and a field with a horizontal part")
    angles, shown, noise, by, R = [], [], [], [], []
    for each in readings:
        at = motion(each.t_s - sensor.delay_s)
        expected = sensor.expected(at, each.channel)
        R.append(at.T_base_tool[:3, :3])
        to_base = R[-1] @ sensor.R_tool_sensor @ np.linalg.inv(sensor.soft)
        f = m + to_base @ (each.z - expected.z)
        across = np.array([-m[1], m[0], 0.0]) @ to_base / level**2
        angles.append(np.arctan2(m[0] * f[1] - m[1] * f[0], m[0] * f[0] + m[1] * f[1]))
        shown.append([np.hypot(f[0], f[1]) - level, f[2] - m[2]])
        noise.append(across @ each.cov @ across)
        by.append(across @ expected.by_parameters)
    squares = np.square(shown).mean(axis=1) / level**2
    # What drifts, as a chip that warms up, is no other field at an attitude where the arm rests: each counts once.
    of = _attitudes(np.array(R))
    counts = np.bincount(of)
    weights = 1.0 / (np.array(noise) + squares + np.median(squares)) / counts[of]
    weights /= weights.sum()
    begin = float(np.angle(weights @ np.exp(1j * np.array(angles))))
    apart = np.angle(np.exp(1j * (np.array(angles) - begin)))
    angle, shared = float(weights @ apart), weights @ np.array(by)
    whole, off, shows = (np.bincount(of, weights * each) for each in (np.ones(len(of)), apart - angle, squares))
    scatter = np.inf  # one attitude does not show what motors do
    if len(counts) > 1:
        scatter = np.maximum(off**2, whole * shows).sum() * len(counts) / (len(counts) - 1)
    sigma = float(np.sqrt(scatter + shared @ sensor.cov @ shared))
    return HeadingOff(-(begin + angle), sigma, level * np.sqrt(squares))
