"""The servo bus of an SO-101, emulated: registers and packets of six STS3215 servos, and what their mechanics do.

A servo drives its output shaft through a gear with backlash; its sensor is on the output shaft, 4096 counts a revolution.
Its position controller is proportional with a dead zone, so that a load pulls the shaft away from its goal. Default numbers
are what TheRobotStudio/SO-ARM100 issue 134 measured on one servo: about 1 degree of backlash, 1.8 to 2.6 degrees of droop
with 1.5 kg on 10 cm at 45 degrees (1.04 N m), 15 degrees Celsius of warming; and 100 to 130 ms from a command to the state.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from armsight.data import Array
from armsight.robot.boards.feetech.registers import COUNTS, MIDDLE, RAD_PER_COUNT, STS3215
from armsight.sim.boards.device import STEP_S, Wired

SERVOS = 6
_BROADCAST = 0xFE
#: Seconds of a byte on the wire at 1 Mbaud, and until a servo answers.
_BYTE_S, _DELAY_S = 1e-5, 2e-5
_TABLE = 86


@dataclass(frozen=True)
class So101Mechanics:
    """What is wrong with an SO-101's joints; six numbers each are the five joints and the gripper."""

    backlash_rad: float = float(np.radians(1.0))  #: of the gear, between motor and output shaft
    #: torque of the controller for an error of position: its inverse is the droop
    stiffness_n_m_rad: float = float(1.04 / np.radians(2.1))
    friction_n_m: float = 0.05  #: dry friction at the motor
    dead_counts: float = 1.0  #: an error of so many counts is left alone
    delay_s: float = 0.085  #: until a goal is acted on
    lag_s: float = 0.03  #: time constant of the motor
    zero_rad: tuple[float, ...] = (0.0,) * SERVOS  #: true joint angle where the sensor says 0
    torque_n_m: float = 2.9  #: the greatest


def arm_load(q: Array) -> Array:
    """Return the gravity torques (6,), N m, of an SO-101 with 0.2 kg in its gripper, at joint angles (6,), rad."""
    upper, fore, hand = np.cos(q[1]), np.cos(q[1] + q[2]), np.cos(q[1] + q[2] + q[3])
    return np.array([0.0, 0.55 * upper + 0.45 * fore + 0.25 * hand, 0.45 * fore + 0.25 * hand, 0.25 * hand, 0.0, 0.0])


class So101Servos:
    """The mechanics of six servos.

    Args:
        mechanics: what is wrong with them.
        load: returns the torques (6,) that pull the joints towards smaller angles, N m, at their angles (6,), rad.
        q: (6,) where the joints are, rad by the sensors.

    Attributes:
        rate: (6,) how fast the shafts move, rad/s; ``shaft_speed`` is the same as a servo measures it, filtered.
    """

    def __init__(self, mechanics: So101Mechanics, load: Callable[[Array], Array], q: Array) -> None:
        self.mechanics, self._load = mechanics, load
        self.shaft = np.array(q, float)  #: (6,) angles of the output shafts, rad
        self._motor = self.shaft.copy()
        self._setpoint, self._speed = self.shaft.copy(), np.zeros(SERVOS)
        self._goal, self._most = self.shaft.copy(), np.full(SERVOS, 5.0)
        self._waiting: deque[tuple[int, int, float, float]] = deque()
        self._ticks = 0
        self.on = np.zeros(SERVOS, bool)  #: (6,) whether the torque is on
        self.effort = np.zeros(SERVOS)
        self.shaft_speed, self.rate = np.zeros(SERVOS), np.zeros(SERVOS)
        self.celsius = np.full(SERVOS, 30.0)  #: (6,) temperatures

    @property
    def true_q(self) -> Array:
        """(6,) true joint angles, rad."""
        return np.asarray(self.shaft + self.mechanics.zero_rad)

    def goal(self, servo: int, angle: float, speed: float) -> None:
        """Give a servo a goal, rad, and a speed limit, rad/s."""
        due = self._ticks + round(self.mechanics.delay_s / STEP_S)
        self._waiting.append((due, servo, angle, speed))

    def switch(self, servo: int, on: bool) -> None:
        """Switch a servo's torque on, at its present position, or off."""
        if on and not self.on[servo]:
            self._setpoint[servo] = self._goal[servo] = self.shaft[servo]
            self._speed[servo] = 0.0
        self.on[servo] = on

    def push(self, servo: int, angle: float) -> None:
        """Move a joint by hand, rad: within the backlash where its torque is on."""
        half = self.mechanics.backlash_rad / 2
        there = self.shaft[servo] + angle
        if self.on[servo]:
            there = float(np.clip(there, self._motor[servo] - half, self._motor[servo] + half))
        else:
            self._motor[servo] += there - self.shaft[servo]
        self.shaft[servo] = there

    def step(self) -> None:
        """Let STEP_S pass."""
        self._ticks += 1
        while self._waiting and self._waiting[0][0] <= self._ticks:
            _, servo, angle, speed = self._waiting.popleft()
            self._goal[servo], self._most[servo] = angle, speed
        load = self._load(self.true_q).tolist()
        for k in range(SERVOS):
            self._step_servo(k, load[k])
        if self._ticks % _SLOW == 0:
            warm = 30.0 + 15.0 * (self.effort / 1.04) ** 2
            self.celsius += _SLOW * STEP_S / 200.0 * (warm - self.celsius)

    def _step_servo(self, k: int, load: float) -> None:
        """Let STEP_S pass for one servo that ``load``, N m, pulls to smaller angles; in plain numbers: called often."""
        mechanics, h = self.mechanics, STEP_S
        shaft, motor, half = float(self.shaft[k]), float(self._motor[k]), mechanics.backlash_rad / 2
        pulls = math.copysign(1.0, load) if abs(load) > mechanics.friction_n_m else 0.0
        effort = 0.0
        if self.on[k]:
            # The controller sees counts; what it asks for goes into friction, load and motion of the motor.
            error = self._advance(k) - round(shaft / RAD_PER_COUNT) * RAD_PER_COUNT
            if abs(error) > mechanics.dead_counts * RAD_PER_COUNT:
                effort = mechanics.stiffness_n_m_rad * error
                effort = min(max(effort, -mechanics.torque_n_m), mechanics.torque_n_m)
        carried = pulls != 0.0 and abs(shaft - motor + pulls * half) < 1e-4
        free = effort - (load if carried else 0.0)
        moving = math.copysign(max(0.0, abs(free) - mechanics.friction_n_m), free)
        motor += min(max(moving / (mechanics.stiffness_n_m_rad * mechanics.lag_s), -_MOST_RAD_S), _MOST_RAD_S) * h
        # The shaft falls to the side of the backlash that its load pulls to; without load it stays until it is pushed.
        fall = motor - pulls * half - shaft if pulls else 0.0
        moved = shaft + min(max(fall, -_FALL_RAD_S * h), _FALL_RAD_S * h)
        moved = min(max(moved, motor - half), motor + half)
        self.rate[k] = (moved - shaft) / h
        self.shaft_speed[k] += 0.05 * (self.rate[k] - self.shaft_speed[k])
        self.shaft[k], self._motor[k], self.effort[k] = moved, motor, effort

    def _advance(self, k: int) -> float:
        """Move a servo's setpoint towards its goal, with limited speed and acceleration, and return it, rad."""
        away = float(self._goal[k] - self._setpoint[k])
        if away:
            gain = _ACCELERATION * STEP_S
            speed = math.copysign(min(float(self._most[k]), math.sqrt(2 * _ACCELERATION * abs(away))), away)
            now = float(self._speed[k])
            now += min(max(speed - now, -gain), gain)
            there = abs(away) <= max(abs(now) * STEP_S, 1e-6)
            self._setpoint[k] = self._goal[k] if there else self._setpoint[k] + now * STEP_S
            self._speed[k] = 0.0 if there else now
        return float(self._setpoint[k])


#: Acceleration of a setpoint, rad/s^2; how fast a motor is, and how fast a shaft falls through its backlash, rad/s.
_ACCELERATION, _MOST_RAD_S, _FALL_RAD_S = 25.0, 5.0, 2.0
_SLOW = 100  # steps between two of the temperatures


@dataclass
class So101Bus(Wired):
    """The servos' registers on a wire: a ``Device``."""

    servos: So101Servos  #: the mechanics
    #: id of each servo; two the same answer at the same time, an id that nobody has is silent
    ids: list[int] = field(default_factory=lambda: list(range(1, SERVOS + 1)))
    powered: bool = True  #: whether the servos' own supply is on
    tables: list[bytearray] = field(init=False)  #: (6,) registers of each servo

    def __post_init__(self) -> None:
        """Fill the registers as a servo leaves LeRobot's setup."""
        self.tables = [bytearray(_TABLE) for _ in range(SERVOS)]
        for table in self.tables:
            table[0:5] = bytes((3, 10, 0, *STS3215.to_bytes(2, "little")))
            table[9:13] = (0).to_bytes(2, "little") + (COUNTS - 1).to_bytes(2, "little")
            table[55] = 1
        for servo, identity in enumerate(self.ids):
            self.tables[servo][5] = identity
        self._refresh()

    @classmethod
    def made(
        cls,
        mechanics: So101Mechanics | None = None,
        load: Callable[[Array], Array] = arm_load,
        q: Array | None = None,
        **options: object,
    ) -> So101Bus:
        """Return a bus of six servos; by default as issue 134 measured them, half folded.

        ``mechanics``: what is wrong with the joints; ``load``: returns the torques (6,), N m, at angles (6,), rad; ``q``:
        (6,) where the joints are, rad by the sensors.
        """
        q = np.radians([5.0, -40.0, 60.0, 20.0, 0.0, 10.0]) if q is None else q
        return cls(So101Servos(mechanics or So101Mechanics(), load, q), **options)  # type: ignore[arg-type]

    @property
    def truth(self) -> tuple[Array, Array]:
        """(5,) angles of the arm's shafts as its sensors have them, and its true joint angles, rad."""
        return self.servos.shaft[: SERVOS - 1], self.servos.true_q[: SERVOS - 1]

    def write(self, data: bytes) -> None:
        """Take bytes from the host."""
        if self.powered:
            super().write(data)
            self._take()

    def step(self) -> None:
        """Let STEP_S pass."""
        self.t_s += STEP_S
        self.servos.step()

    def _take(self) -> None:
        """Carry out the instructions that are complete; what is none is skipped."""
        while True:
            at = self._in.find(b"\xff\xff")
            if at < 0:
                del self._in[: max(0, len(self._in) - 1)]
                return
            del self._in[:at]
            if len(self._in) < 6:
                return
            if self._in[2] == 0xFF or not 2 <= self._in[3] <= 250:
                del self._in[0]
                continue
            end = self._in[3] + 4
            if len(self._in) < end:
                return
            body, check = bytes(self._in[2 : end - 1]), self._in[end - 1]
            if sum(body) + check & 0xFF != 0xFF:
                del self._in[0]
                continue
            del self._in[:end]
            self._free_s = max(self.t_s, self._free_s) + _BYTE_S * end
            self._do(body[0], body[2], body[3:])

    def _do(self, to: int, instruction: int, parameters: bytes) -> None:
        servos = [k for k, own in enumerate(self.ids) if to in (own, _BROADCAST)]
        self._refresh()
        if instruction == 1 and to != _BROADCAST:
            self._answer([(k, b"") for k in servos])
        elif instruction == 2 and len(parameters) == 2:
            self._answer([(k, self._bytes(k, *parameters)) for k in servos])
        elif instruction == 3 and parameters:
            for k in servos:
                self._store(k, parameters[0], parameters[1:])
            self._answer([(k, b"") for k in servos if to != _BROADCAST])
        elif instruction == 0x82 and len(parameters) > 2:
            self._read_each(parameters)
        elif instruction == 0x83 and len(parameters) > 2:
            self._write_each(parameters)

    def _read_each(self, parameters: bytes) -> None:
        """Answer SYNC READ: one servo after the other, with what it measures then."""
        for each in parameters[2:]:
            self._refresh(max(self.t_s, self._free_s) - self.t_s)
            self._answer([(k, self._bytes(k, *parameters[:2])) for k, own in enumerate(self.ids) if own == each])

    def _write_each(self, parameters: bytes) -> None:
        address, count = parameters[:2]
        for at in range(2, len(parameters) - count, count + 1):
            for k in (k for k, own in enumerate(self.ids) if own == parameters[at]):
                self._store(k, address, parameters[at + 1 : at + 1 + count])

    def _bytes(self, servo: int, address: int, count: int) -> bytes:
        return bytes(self.tables[servo][address : address + count])

    def _answer(self, answers: list[tuple[int, bytes]]) -> None:
        """Send answers: where two servos answer to one id, the line is low where either pulls it low."""
        texts = []
        for servo, data in answers:
            body = bytes((self.ids[servo], len(data) + 2, 0)) + data
            texts.append(b"\xff\xff" + body + bytes((~sum(body) & 0xFF,)))
        if texts:
            text = texts[0]
            for late, begun in enumerate(texts[1:], 1):  # no two servos begin within a byte's time of 10 us
                other = b"\xff" * late + begun
                length = max(len(text), len(other))
                pairs = zip(text.ljust(length, b"\xff"), other.ljust(length, b"\xff"), strict=True)
                text = bytes(one & two for one, two in pairs)
            begin = max(self.t_s, self._free_s) + _DELAY_S
            self._free_s = begin + _BYTE_S * len(text)
            self._out.append((self._free_s, text))

    def _word(self, servo: int, address: int) -> int:
        return int.from_bytes(self.tables[servo][address : address + 2], "little")

    def _offset(self, servo: int) -> int:
        word = self._word(servo, 31)
        return -(word & 0x7FF) if word & 0x800 else word & 0x7FF

    def _store(self, servo: int, address: int, data: bytes) -> None:
        """Write registers; stored ones only while they are unlocked, states never."""
        table = self.tables[servo]
        for at, byte in enumerate(data, address):
            if 40 <= at < 56 or (5 <= at < 40 and table[55] == 0):
                table[at] = byte
        if address <= 40 < address + len(data):
            self.servos.switch(servo, table[40] == 1)
        if address <= 42 < address + len(data):
            goal = (self._word(servo, 42) + self._offset(servo) - MIDDLE) * RAD_PER_COUNT
            self.servos.goal(servo, goal, (self._word(servo, 46) or 3400) * RAD_PER_COUNT)

    def _refresh(self, ahead_s: float = 0.0) -> None:
        """Write the states into the registers, as they will be after less than some steps."""
        servos = self.servos
        for k, table in enumerate(self.tables):
            count = round((servos.shaft[k] + ahead_s * servos.rate[k]) / RAD_PER_COUNT) + MIDDLE - self._offset(k)
            speed = round(servos.shaft_speed[k] / RAD_PER_COUNT)
            load = round(1000 * servos.effort[k] / servos.mechanics.torque_n_m)
            drop_v = 0.04 * float(np.abs(servos.effort).sum())
            words = [_magnitude(count, 15), _magnitude(speed, 15), _magnitude(load, 10)]
            table[56:62] = b"".join(word.to_bytes(2, "little") for word in words)
            table[62:64] = bytes((round(10 * (12.1 - drop_v)), round(servos.celsius[k])))


def _magnitude(value: int, bit: int) -> int:
    return value if value >= 0 else -value | 1 << bit
