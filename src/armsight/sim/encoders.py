"""Joints read by encoders in place of potentiometers, behind the contract :class:`~armsight.robot.boards.link.Plant`.

In: a :class:`~armsight.sim.joints.JointPlant`. Out: the same joints, whose quadrature encoders (at the motor, before the
backlash) count from where they were switched on, and whose absolute ones (AS5047, at the joint) answer with two frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.robot.boards.codes import SensorKind
from armsight.robot.boards.link import Sensed
from armsight.sim.joints import JointPlant

#: DIAAGC of a good magnet (offsets compensated, gain in its middle), and of none: the field is too low.
_DIAGNOSIS, _NO_MAGNET = 0x0180, 0x09FF


class EncoderFault(IntEnum):
    """What can be wrong with an encoder."""

    NONE = 0
    #: Nobody drives the line: all bits read 0, or 1; a quadrature one counts no more.
    LOW = 1
    HIGH = 2
    #: One bit of an absolute one's frames is wrong.
    PARITY = 3
    #: An absolute one's error bit stands.
    ERROR_BIT = 4
    #: An absolute one's magnet has come off.
    MAGNET = 5


@dataclass(frozen=True, eq=False)
class Encoders(Record):
    """What reads six joints."""

    kind: NDArray[np.int64]  #: (6,) of :class:`~armsight.robot.boards.codes.SensorKind`.
    counts_per_rev: Array  #: (6,) of a revolution of the joint, negative where counts fall with the angle
    zero_counts: NDArray[np.int64]  #: (6,) reading of an absolute one at 0 rad


def as5047_frame(data: int, *, error: bool = False) -> int:
    """Return the 16 bits that an AS5047 answers with: even parity, error bit EF, 14 bits of data (its datasheet)."""
    frame = (data & 0x3FFF) | error << 14
    return frame | (frame.bit_count() & 1) << 15


class EncodedPlant:
    """Joints with encoders; those without keep their potentiometer. ``fault`` (6,): what is wrong with each encoder."""

    def __init__(self, plant: JointPlant, encoders: Encoders) -> None:
        self.plant, self._encoders = plant, encoders
        self.fault = [EncoderFault.NONE] * len(plant.q)
        self._switched_on = plant.q.copy()
        self._last = [0] * len(plant.q)

    def sense(self) -> Sensed:
        """Return what the converters, the timers and the encoders' wire read now."""
        sensed = self.plant.sense()
        for j in map(int, np.flatnonzero(self._encoders.kind)):
            sensed.counts[j] = self.reading(j)
        return sensed

    def reading(self, j: int) -> int:
        """Return what the encoder of joint j, which has one, reads now."""
        return self._quadrature(j) if self._encoders.kind[j] == SensorKind.QUADRATURE else self._absolute(j)

    def step(self, duty: Array, awake: bool, braked: bool = False) -> None:
        """Let 1 ms pass with these duties (6,)."""
        self.plant.step(duty, awake, braked)

    def _counts(self, j: int, angle_rad: float) -> int:
        return int(np.floor(self._encoders.counts_per_rev[j] / (2 * np.pi) * angle_rad))

    def _quadrature(self, j: int) -> int:
        if self.fault[j] == EncoderFault.NONE:
            self._last[j] = self._counts(j, self.plant.q[j] - self._switched_on[j]) % (1 << 32)
        return self._last[j]

    def _absolute(self, j: int) -> int:
        fault = self.fault[j]
        if fault in (EncoderFault.LOW, EncoderFault.HIGH):
            return 0xFFFFFFFF if fault == EncoderFault.HIGH else 0
        counts = self._counts(j, self.plant.link[j]) + int(self._encoders.zero_counts[j])
        angle = as5047_frame(counts, error=fault == EncoderFault.ERROR_BIT) ^ (fault == EncoderFault.PARITY)
        return angle | as5047_frame(_NO_MAGNET if fault == EncoderFault.MAGNET else _DIAGNOSIS) << 16
