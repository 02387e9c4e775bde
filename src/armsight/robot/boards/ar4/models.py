"""What differs between the AR4's models, and what its firmware does with it: steps, limits, homing.

Numbers of firmware 2.1.0 and of the driver's ``joint_offsets`` (source: see ``lines``). The encoder of a joint is set at
its limit switch; its zero lies at the joint's lower limit, that of joint 1, whose encoder counts backwards, at the upper
one. So the driver's joint angle is the position that the Teensy reports plus the lower limit (joint 1: the upper one).

Joint angles here are those of armsight's ``ar4``, the maker's table: joint 1 has the opposite sense of the driver's, whose
URDF has its axis downwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Record
from armsight.errors import InputError

ENCODER_DIRECTION = np.array([-1, 1, 1, 1, 1, 1])  # sense of the encoders
#: Sense of the driver's joints in armsight's ``ar4``.
SENSE = np.array([-1, 1, 1, 1, 1, 1])
#: Where a joint's limit switch is: -1 at its lower limit, +1 at its upper one.
SWITCH_AT = np.array([-1, -1, 1, -1, -1, 1])
COUNTS_PER_STEP = np.array([10, 10, 10, 10, 5, 10])  # encoder counts of a motor step
#: What the firmware moves with: degrees/s, degrees/s^2.
MOST_SPEED_DEG_S, MOST_ACCELERATION_DEG_S2 = 60.0, 30.0
DEAD_STEPS = 2  # a goal closer than this is reached, motor steps
#: Homing: all joints at once, then in groups of three, of two, one after the other: the first digit.
HOMING_GROUPS = {1: "3", 2: "2", 3: "1", 6: "0"}


@dataclass(frozen=True, eq=False)
class Ar4Model(Record):
    """A model of the AR4."""

    name: str  #: as the firmware knows it
    steps_per_deg: Array  #: (6,) motor steps of a degree
    low_deg: Array  #: (6,) lower limits; joint 1 has the same to either side
    high_deg: Array  #: (6,) upper limits

    @property
    def offset_deg(self) -> Array:
        """(6,) what is added to a reported position to have the driver's joint angle."""
        return np.where(ENCODER_DIRECTION > 0, self.low_deg, self.high_deg)

    def angles_deg(self, reported: Array) -> Array:
        """Return the joint angles (6,) at positions (6,) that the Teensy reports."""
        return SENSE * (reported + self.offset_deg)

    def reported_deg(self, angles: Array) -> Array:
        """Return the positions (6,) that the Teensy reports at joint angles (6,)."""
        return SENSE * angles - self.offset_deg


def _model(name: str, fourth: float, low: tuple[float, ...], high: tuple[float, ...]) -> Ar4Model:
    steps = np.array([44.44444444, 55.55555556, 55.55555556, fourth, 21.86024888, 22.22222222])
    return Ar4Model(name, steps, np.array(low), np.array(high))


_NARROW = ((-170.0, -42.0, -89.0, -165.0, -105.0, -155.0), (170.0, 90.0, 52.0, 165.0, 105.0, 155.0))
_WIDE = ((-170.0, -42.0, -89.0, -180.0, -105.0, -180.0), (170.0, 90.0, 52.0, 180.0, 105.0, 180.0))
MODELS = {
    "mk1": _model("mk1", 42.72664356, *_NARROW),
    "mk2": _model("mk2", 49.77777777, *_NARROW),
    "mk3": _model("mk3", 49.77777777, *_WIDE),
}


def ar4_model(name: str) -> Ar4Model:
    """Return a model by its name, or InputError."""
    if name not in MODELS:
        raise InputError(f"no AR4 {name!r}; there are {', '.join(MODELS)}")
    return MODELS[name]
