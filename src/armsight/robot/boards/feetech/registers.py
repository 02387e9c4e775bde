"""The registers of an STS3215 that are used here: addresses, widths, and what their numbers mean.

Source: Feetech's memory table of the STS series, as LeRobot lists it (``motors/feetech/tables.py``, Apache-2.0).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from armsight.data import Array
from armsight.robot.boards.codes import Alarm
from armsight.robot.boards.feetech.packets import sign_magnitude, signed

#: Counts of a revolution of the output shaft: 0.088 degree each.
COUNTS = 4096
RAD_PER_COUNT = 2 * np.pi / COUNTS
MIDDLE = COUNTS // 2  # count that is 0 rad without a calibration: the middle
#: What MODEL reads on an STS3215.
STS3215 = 777
POSITION_MODE = 0
MOST_OFFSET = 2047  # largest size of a homing offset: its sign is bit 11


class Register(NamedTuple):
    """A register."""

    address: int  #: of its first byte
    width: int  #: how many bytes it has, 1 or 2
    sign_bit: int | None = None  #: which bit is the sign of a sign-and-magnitude number; None of one without a sign

    def decode(self, data: bytes) -> int:
        """Return the number that its bytes are."""
        word = int.from_bytes(data[: self.width], "little")
        return word if self.sign_bit is None else signed(word, self.sign_bit)

    def encode(self, value: int) -> bytes:
        """Return the bytes of a number, or raise OverflowError: it does not fit."""
        if self.sign_bit is not None:
            if abs(value) >= 1 << self.sign_bit:
                raise OverflowError(f"{value} has more than {self.sign_bit} bits")
            value = sign_magnitude(value, self.sign_bit)
        return value.to_bytes(self.width, "little")


MODEL = Register(3, 2)
MIN_POSITION, MAX_POSITION = Register(9, 2), Register(11, 2)
HOMING_OFFSET = Register(31, 2, 11)
MODE = Register(33, 1)
TORQUE = Register(40, 1)
#: From here on a command: acceleration, goal position, time (unused), goal speed.
ACCELERATION = Register(41, 1)
GOAL_POSITION = Register(42, 2, 15)
GOAL_SPEED = Register(46, 2, 15)
LOCK = Register(55, 1)  # 0 while the stored registers (below 40) may be written
#: From here on a state.
POSITION = Register(56, 2, 15)
SPEED = Register(58, 2, 15)
LOAD = Register(60, 2, 10)
VOLTAGE = Register(62, 1)
TEMPERATURE = Register(63, 1)
STATE_BYTES = TEMPERATURE.address + 1 - POSITION.address

#: Units: of LOAD (share of the full duty) and VOLTAGE.
LOAD_UNIT, VOLTS = 1e-3, 0.1

#: Bit of a status packet's error -> alarm.
ALARMS = {
    0x01: Alarm.VOLTAGE,
    0x02: Alarm.ANGLE_SENSOR,
    0x04: Alarm.OVERHEAT,
    0x08: Alarm.OVERCURRENT,
    0x20: Alarm.OVERLOAD,
}


class ServoStates(NamedTuple):
    """The states of some servos at one time."""

    counts: Array  #: (n,) positions of the output shafts, homing offsets subtracted, counts
    speed: Array  #: (n,) counts/s
    load: Array  #: (n,) duty of the motors, -1 to 1
    volts: Array  #: (n,) supply, V
    celsius: Array  #: (n,) temperatures, degrees Celsius
    errors: tuple[int, ...]  #: (n,) error bits


def states_of(blocks: list[bytes], errors: tuple[int, ...]) -> ServoStates:
    """Return the states that STATE_BYTES from POSITION on of each servo say."""

    def column(register: Register) -> Array:
        at = register.address - POSITION.address
        return np.array([register.decode(block[at:]) for block in blocks], dtype=float)

    return ServoStates(
        column(POSITION), column(SPEED), LOAD_UNIT * column(LOAD), VOLTS * column(VOLTAGE), column(TEMPERATURE), errors
    )
