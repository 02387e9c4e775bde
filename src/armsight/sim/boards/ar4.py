"""The Teensy of an AR4, emulated: its lines of text, its steppers with ramps, and what belts, gears and switches do.

The encoders are on the motors. Gearbox backlash, a homing that is off because a switch is, and steps that encoder and
stepper lose together (ar4_ros_driver issue 53: the arm drifts while the encoders read home) are not in what it reports.
The behaviour follows firmware 2.1.0 (source: see ``robot.boards.ar4.lines``); lines are read by own rules here.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from armsight.data import Array
from armsight.robot.boards.ar4.models import (
    COUNTS_PER_STEP,
    DEAD_STEPS,
    ENCODER_DIRECTION,
    MODELS,
    MOST_ACCELERATION_DEG_S2,
    MOST_SPEED_DEG_S,
    SENSE,
    SWITCH_AT,
    Ar4Model,
)
from armsight.sim.boards.device import STEP_S, Wired

_JOINTS = 6
_BYTE_S = 10 / 115200
#: Lengths of the arm, and the lever from which on a joint's load keeps its backlash on one side, m.
_UPPER_ARM_M, _FOREARM_M, _LOADED_M = 0.305, 0.223, 0.05


@dataclass(frozen=True)
class Ar4Mechanics:
    """What is wrong with an AR4; six numbers each."""

    backlash_deg: tuple[float, ...] = (0.05, 0.1, 0.1, 0.15, 0.2, 0.1)  #: of the gearboxes
    #: true angle less reported one after homing: the switches are off by this
    homing_deg: tuple[float, ...] = (1.0, -0.6, 0.8, -1.0, 0.5, 0.9)
    scatter_deg: float = 0.02  #: sigma of a switch, from one homing to the next


@dataclass
class Ar4Teensy(Wired):
    """An AR4 with its Teensy: a ``Device``."""

    model: Ar4Model = field(default_factory=lambda: MODELS["mk3"])  #: which AR4
    mechanics: Ar4Mechanics = field(default_factory=Ar4Mechanics)  #: what is wrong with it
    version: str = "2.1.0"  #: of its firmware
    homing_s: float = 20.0  #: how long homing takes, s
    stuck: int | None = None  #: a joint whose switch is never reached, from 0; None without
    seed: int = 0  #: of the switches' scatter
    #: (6,) true joint angles at power-on
    q_deg: Array = field(default_factory=lambda: np.array([10.0, 5.0, -20.0, 15.0, 30.0, -10.0]))
    stop_pressed: bool = False  #: whether the emergency stop button is in
    _name: str = ""
    _homing: tuple[float, str] | None = None

    def __post_init__(self) -> None:
        """Switch it on: the encoders read 0 wherever the arm is."""
        self._rng = np.random.default_rng(self.seed)
        self._motor = SENSE * np.array(self.q_deg, float)  # degrees of the driver's joint at the motor
        self._joint = self._motor.copy()
        self._speed = np.zeros(_JOINTS)
        self._target = self._motor.copy()
        self._whole = self._motor.copy()  # where a motor makes whole steps from
        self._most = np.full(_JOINTS, MOST_SPEED_DEG_S)
        self._encoder_zero = self._motor.copy()  # where an encoder reads 0
        self._stopped = self.stop_pressed

    @property
    def true_deg(self) -> Array:
        """(6,) true joint angles."""
        return np.asarray(SENSE * self._joint)

    @property
    def truth(self) -> tuple[Array, Array]:
        """(6,) true angles of the motors, where the encoders sit, and of the joints, rad."""
        return np.radians(SENSE * self._motor), np.radians(SENSE * self._joint)

    def lose(self, joint: int, degrees: float) -> None:
        """Let a joint slip against its motor, as a belt does: the encoder does not see it."""
        degrees *= float(SENSE[joint])
        self._encoder_zero[joint] += degrees
        self._whole[joint] += degrees
        self._motor[joint] += degrees
        self._target[joint] += degrees
        self._joint[joint] += degrees

    def lose_steps(self, joint: int, steps: float) -> None:
        """Let a motor miss steps: its encoder sees it, and the next goal makes up for it."""
        degrees = SENSE[joint] * steps / self.model.steps_per_deg[joint]
        self._motor[joint] += degrees
        self._target[joint] += degrees

    def press(self, pressed: bool) -> None:
        """Press the emergency stop, or release it: it stays in force until it is reset."""
        self.stop_pressed = pressed
        self._stopped = self._stopped or pressed

    def restart(self) -> None:
        """Switch it off and on: encoders at 0, no model."""
        self._name, self._homing = "", None
        self._target, self._encoder_zero = self._motor.copy(), self._motor.copy()
        self._speed[:] = 0.0

    def step(self) -> None:
        """Let STEP_S pass: one line at most, then the steppers."""
        self.t_s += STEP_S
        if self._homing is not None:
            if self.t_s >= self._homing[0]:
                self._homed(self._homing[1])
        elif (end := self._in.find(b"\n")) >= 0:
            line = bytes(self._in[:end]).decode("latin1")
            del self._in[: end + 1]
            self._do(line[:2], line[2:])
        if not self._stopped and self._homing is None:
            self._move()

    def _move(self) -> None:
        away = self._target - self._motor
        most = np.minimum(self._most, np.sqrt(2 * MOST_ACCELERATION_DEG_S2 * np.abs(away)))
        gain = MOST_ACCELERATION_DEG_S2 * STEP_S
        self._speed += np.clip(np.sign(away) * most - self._speed, -gain, gain)
        step = self._speed * STEP_S
        there = (np.abs(away) <= np.abs(step)) | (np.abs(away) < 1e-4)
        self._motor += np.where(there, away, step)
        self._speed[there] = 0.0
        self._follow()

    def _follow(self) -> None:
        """Let the joints follow their motors: loaded ones lean to the side that gravity pulls to, the others stay."""
        half = np.array(self.mechanics.backlash_deg) / 2
        upper, fore = np.radians(self._motor[1]), np.radians(self._motor[1] + self._motor[2])
        reach_m = _FOREARM_M * np.cos(fore)
        for joint, lever_m in ((1, _UPPER_ARM_M * np.sin(upper) + reach_m), (2, reach_m)):
            if abs(lever_m) > _LOADED_M:
                self._joint[joint] = self._motor[joint] + np.sign(lever_m) * half[joint]
        self._joint = np.clip(self._joint, self._motor - half, self._motor + half)

    def _steps(self) -> Array:
        """Return the encoders in whole motor steps, as the firmware computes with."""
        counts = (self._pulsed() - self._encoder_zero) * ENCODER_DIRECTION * self.model.steps_per_deg * COUNTS_PER_STEP
        return np.asarray(np.trunc(np.trunc(counts + np.copysign(1e-6, counts)) / COUNTS_PER_STEP))

    def _pulsed(self) -> Array:
        """Return where the motors are by the pulses they got: a stepper moves by whole steps."""
        steps = self.model.steps_per_deg
        return np.asarray(self._whole + np.rint((self._motor - self._whole) * steps) / steps)

    def _do(self, word: str, rest: str) -> None:
        if word == "ST":
            version, model = rest[rest.find("A") + 1 : rest.find("B")], rest[rest.find("B") + 1 :]
            known = model in MODELS
            if known:
                self._name = model
            self._say(f"STA{int(version == self.version)}B{self.version}C{int(known)}D{self._name}")
        elif not self._name:
            return
        elif word == "JP":
            reported = self._steps() / self.model.steps_per_deg * ENCODER_DIRECTION
            self._say("JP" + "".join(f"{'ABCDEF'[k]}{reported[k]:.6f}" for k in range(_JOINTS)))
        elif word == "JV":
            self._say("JV" + "".join(f"{'ABCDEF'[k]}{self._speed[k]:.6f}" for k in range(_JOINTS)))
        elif word in ("MT", "MV"):
            if (values := self._values(rest)) is not None:
                (self._move_to if word == "MT" else self._move_with)(values)
            self._say(f"ES{int(self._stopped)}")
        elif word == "RE":
            if not self.stop_pressed:
                self._stopped, self._target = False, self._motor.copy()
                self._speed[:] = 0.0
            self._say(f"ES{int(self._stopped)}")
        elif word == "JC":
            if len(rest) != 7:
                self._say("ER: Invalid sequence length.")
            else:
                self._homing = (self.t_s + self.homing_s, rest)

    def _values(self, rest: str) -> Array | None:
        """Return six values behind their letters; what is no number is 0, as in the firmware."""
        values = np.zeros(_JOINTS)
        for k, letter in enumerate("ABCDEF"):
            begin, end = rest.find(letter), rest.find("ABCDEF"[k + 1]) if k < 5 else len(rest)
            if begin < 0:
                self._say(f"ER: panic, missing joint {letter}")
                return None
            try:
                values[k] = float(rest[begin + 1 : end])
            except ValueError:
                values[k] = 0.0
        return values

    def _move_to(self, degrees: Array) -> None:
        if (beyond := degrees > 380.0).any():
            k = int(np.argmax(beyond))
            self._say(f"ER: panic, joint {'ABCDEF'[k]} value {degrees[k]:f} out of range")
            return
        self._most[:] = MOST_SPEED_DEG_S
        steps = np.trunc(degrees * self.model.steps_per_deg * ENCODER_DIRECTION) - self._steps()
        far = np.abs(steps) > DEAD_STEPS
        there = self._pulsed() + steps * ENCODER_DIRECTION / self.model.steps_per_deg
        self._target = np.where(far, there, self._target)

    def _move_with(self, degrees_s: Array) -> None:
        if (beyond := np.abs(degrees_s) > MOST_SPEED_DEG_S).any():
            k = int(np.argmax(beyond))
            self._say(f"DB: joint {'ABCDEF'[k]} speed {degrees_s[k]:f} > {MOST_SPEED_DEG_S:f}, clipping.")
        self._most = np.minimum(np.abs(degrees_s), MOST_SPEED_DEG_S)
        self._target = self._motor + np.sign(degrees_s) * 1e6

    def _homed(self, sequence: str) -> None:
        self._homing = None
        if self.stuck is not None and str(self.stuck) in sequence[1:]:
            self._say("ER: Failed to move to limit switches.")
            return
        model = self.model
        counts = np.trunc((self._motor - self._encoder_zero) * model.steps_per_deg * COUNTS_PER_STEP).astype(int)
        for k in sorted({int(each) for each in sequence[1:]}):
            # At the switch the encoder is set to the limit; the joint really is beside it.
            beside = SENSE[k] * self.mechanics.homing_deg[k] + self.mechanics.scatter_deg * self._rng.standard_normal()
            self._encoder_zero[k] = beside + model.offset_deg[k]
            self._motor[k] = self._target[k] = self._whole[k] = beside
            self._joint[k] = beside + SENSE[k] * SWITCH_AT[k] * self.mechanics.backlash_deg[k] / 2
        self._follow()
        self._say("JC" + "".join(f"{'ABCDEF'[k]}{counts[k]}" for k in range(_JOINTS)))

    def _say(self, line: str) -> None:
        data = line.encode() + b"\r\n"
        begin = max(self.t_s, self._free_s)
        self._free_s = begin + _BYTE_S * len(data)
        self._out += [(begin + _BYTE_S * k, data[k - 1 : k]) for k in range(1, len(data) + 1)]
