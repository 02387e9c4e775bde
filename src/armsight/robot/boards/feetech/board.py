"""An SO-100 or SO-101 on its servo bus, as a board: goals go out, positions come back.

In: :class:`~armsight.data.JointCommand`. Out: :class:`~armsight.data.JointStates`, on the host's clock: the bus has none.
A servo keeps its own position controller; it takes no duty and has no watchdog: without a host it holds its last goal. The
gripper's servo is left alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np

from armsight.data import Array, JointCommand, JointStates
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.codes import BoardState, Command, Limited
from armsight.robot.boards.contract import Abilities, checked_goals
from armsight.robot.boards.feetech.bus import ServoBus
from armsight.robot.boards.feetech.calibration import NAMES, ServoCalibration, uncalibrated
from armsight.robot.boards.feetech.registers import (
    ACCELERATION,
    ALARMS,
    GOAL_POSITION,
    GOAL_SPEED,
    HOMING_OFFSET,
    MAX_POSITION,
    MIN_POSITION,
    MODE,
    POSITION_MODE,
    RAD_PER_COUNT,
    TORQUE,
    ServoStates,
)
from armsight.robot.boards.reports import BoardStatus, JointFault, JointReport, Welcome, plain_status

#: Readings a second: a sync read of five servos takes 1 ms on the wire, and USB adapters add 1 to 4 ms.
RATE_HZ = 200.0
#: From a command to the state that shows it (SO-ARM100 issue 134).
LATENCY_S = 0.115
#: Until a joint has made a step of a count or two at rest: near its goal a servo creeps against its friction.
_RESPONSE_S = 0.25
#: A goal further from the present position than this is a mistake, not a step of a motion.
MOST_STEP_RAD = float(np.radians(20.0))
#: Speed and acceleration of the servos towards a goal: 2.6 rad/s, 25 rad/s^2 (100 counts/s^2 a unit).
_GOAL_SPEED, _ACCELERATION = 1700, 164
#: What they follow with LATENCY_S, rad/s and rad/s^2.
_MOST_SPEED, _MOST_ACCELERATION = 1.5, 10.0
#: A count that comes and goes between two readings looks like a speed of up to this, rad/s.
_REST_RAD_S = 0.35
#: The torque goes off so many times: a disturbed byte must not swallow it.
_STOPS = 3
ABILITIES = Abilities(
    len(NAMES),
    RATE_HZ,
    LATENCY_S,
    _RESPONSE_S,
    (RAD_PER_COUNT,) * len(NAMES),
    _REST_RAD_S,
    _MOST_SPEED,
    _MOST_ACCELERATION,
    takes_duty=False,
    own_controller=True,
    rounded_rad=RAD_PER_COUNT,
)


class FeetechBoard:
    """The joints of an arm on a servo bus; :meth:`connect` makes one.

    Args:
        bus: the servos, each of which answers.
        calibration: which counts are which angles.
        enabled: whether the torque of all is on.
        begin_s: when its own time begins, on the bus's clock, s; now by default.
    """

    def __init__(
        self, bus: ServoBus, calibration: ServoCalibration, *, enabled: bool, begin_s: float | None = None
    ) -> None:
        self._bus, self.calibration = bus, calibration
        count = len(calibration.ids)
        self.abilities = replace(ABILITIES, joints=count, steps_rad=(RAD_PER_COUNT,) * count)
        self.welcome = Welcome("feetech: " + ", ".join(calibration.names), "STS3215", 0, bus.baud, None)
        self._begin_s = bus.now() if begin_s is None else begin_s
        self._sent = 0
        self._enabled = enabled
        self._states = bus.states(calibration.ids)
        self._t_s = 0.0
        self._goal = self._q()
        self._goal_speed = np.zeros(count)

    @property
    def bus(self) -> ServoBus:
        """The bus, for registers."""
        return self._bus

    @classmethod
    def connect(
        cls, bus: ServoBus, calibration: ServoCalibration | None = None, *, begin_s: float | None = None
    ) -> Self:
        """Meet the servos of an arm; nothing is written.

        Args:
            bus: closed where this raises.
            calibration: which counts are which angles; without, 0 rad is count 2048.
            begin_s: when its own time begins, on the bus's clock, s; now by default.

        Raises:
            DeviceError: one does not answer, is of another model, is not a position servo, or has another homing offset
                than the calibration.
        """
        try:
            ids = tuple(range(1, len(NAMES) + 1)) if calibration is None else calibration.ids
            bus.meet(ids)
            for id in ids:
                if (mode := bus.read(id, MODE)) != POSITION_MODE:
                    raise DeviceError(f"{bus.name}: id {id} is in mode {mode}; 0 is needed, a position servo")
            if calibration is None:
                limits = [np.array([bus.read(id, each) for id in ids], float) for each in (MIN_POSITION, MAX_POSITION)]
                calibration = uncalibrated(*limits)
            elif calibration.offsets is not None:
                _same_offsets(bus, calibration)
            return cls(bus, calibration, enabled=all(bus.read(id, TORQUE) == 1 for id in ids), begin_s=begin_s)
        except BaseException:
            bus.close()
            raise

    @property
    def status(self) -> BoardStatus:
        """The newest status; the supply is the lowest that a servo measures."""
        faults = tuple(
            JointFault(alarm, joint)
            for joint, bits in enumerate(self._states.errors)
            for bit, alarm in ALARMS.items()
            if bits & bit
        )
        state = BoardState.FAULTED if faults else BoardState.ENABLED if self._enabled else BoardState.DISABLED
        return plain_status(self._t_s, state, faults, float(self._states.volts.min()), self._sent)

    @property
    def joints(self) -> JointReport:
        """The newest report: speeds, loads (as duties) and temperatures are the servos' own."""
        states = self._states
        none = (Limited(0),) * self.abilities.joints
        return JointReport(
            self._t_s,
            states.speed * RAD_PER_COUNT,
            self._goal,
            self._goal_speed,
            states.load,
            none,
            states.celsius,
        )

    @property
    def broken_messages(self) -> int:
        """Number of answers that were broken or did not come."""
        return self._bus.broken

    def soft_limits(self) -> tuple[Array, Array]:
        """Return the joint angles (n,) that the calibration allows, rad."""
        return self.calibration.angles(self.calibration.lowest), self.calibration.angles(self.calibration.highest)

    def send(self, command: JointCommand) -> int:
        """Send goals; the servos go there at once, the command's duration and duty are not used.

        Raises:
            InputError: a goal outside the limits, or more than 20 degrees from where the joint is; nothing was sent.
            DeviceError: the bus is gone.
        """
        q_ref = checked_goals(command, self.abilities.joints)
        goal, names = self.calibration.counts(q_ref), self.calibration.names
        beyond = (goal < self.calibration.lowest) | (goal > self.calibration.highest)
        far = np.abs(q_ref - self._q()) > MOST_STEP_RAD
        if beyond.any():
            k = int(np.argmax(beyond))
            low, high = (np.degrees(each[k]) for each in self.soft_limits())
            raise InputError(
                f"joint {k + 1} ({names[k]}) is to go to {np.degrees(q_ref[k]):.1f} deg; its servo is allowed {low:.1f} to"
                f" {high:.1f}"
            )
        if far.any():
            k = int(np.argmax(far))
            raise InputError(
                f"joint {k + 1} ({names[k]}) is at {np.degrees(self._q()[k]):.1f} deg and is to go to"
                f" {np.degrees(q_ref[k]):.1f} at once; {np.degrees(MOST_STEP_RAD):.0f} at most: send goals step by step"
            )
        self._write_goals(goal)
        self._goal, self._goal_speed = q_ref, np.asarray(command.qd_ref, float)
        self._sent += 1
        return self._sent

    def command(self, command: Command) -> int:
        """Switch the torque on or off, or read whether an alarm still stands.

        Raises:
            InputError: servos have no such command.
        """
        if command in (Command.ENABLE, Command.ENABLE_INWARD):
            self._switch_on()
        elif command is Command.DISABLE:
            self._torque(0)
        elif command is Command.CLEAR_FAULTS:
            self._read()
        else:
            raise InputError(f"{self._bus.name}: servos know no {command.name}: enable them again")
        self._sent += 1
        return self._sent

    def confirm(self, sequence: int, wait_s: float = 0.5) -> None:
        """Do nothing: a servo acknowledges as it is asked, or :meth:`command` raises."""

    def enable(self, *, inward: bool = False) -> None:
        """Switch the torque on at the present position.

        Raises:
            DeviceError: an alarm stands.
        """
        self.command(Command.ENABLE)

    def stop(self) -> None:
        """Switch the torque off at once: the arm sinks."""
        for _ in range(_STOPS):
            self._bus.write_all(TORQUE, {id: TORQUE.encode(0) for id in self.calibration.ids})
        self._enabled = False

    def receive(self, wait_s: float = 0.0) -> JointStates:
        """Read the servos, as often as ``RATE_HZ`` allows and once at least, and let the rest of ``wait_s`` pass.

        Raises:
            DeviceError: a servo does not answer any more.
        """
        begin, bus = self._bus.now(), self._bus
        times, read = [], []
        for k in range(1 + int(wait_s * RATE_HZ)):
            ahead_s = begin + k / RATE_HZ - bus.now()
            if k and ahead_s > 0:
                bus.wait(ahead_s)
            if k and bus.now() - begin >= wait_s:
                break
            self._read()
            times.append(self._t_s)
            read.append(self._q())
        if (left_s := begin + wait_s - bus.now()) > 0:
            bus.wait(left_s)
        return JointStates(np.array(times), np.array(read))

    def close(self) -> None:
        """Close the port; servos whose torque is on hold their last goal."""
        self._bus.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _q(self) -> Array:
        """Return the newest joint angles (n,), rad."""
        return self.calibration.angles(self._states.counts)

    def _read(self) -> ServoStates:
        """Read all servos; their time is the middle of the question and the answers."""
        asked = self._bus.now()
        self._states = self._bus.states(self.calibration.ids)
        self._t_s = (asked + self._bus.now()) / 2 - self._begin_s
        return self._states

    def _switch_on(self) -> None:
        """Make the present position the goal, then switch the torque on."""
        states = self._read()
        if faults := self.status.faults:
            raise DeviceError(f"{self._bus.name} cannot be enabled: {'; '.join(map(str, faults))}")
        self._write_goals(np.clip(states.counts, self.calibration.lowest, self.calibration.highest))
        self._goal = self._q()
        self._torque(1)

    def _write_goals(self, counts: Array) -> None:
        time = bytes(GOAL_SPEED.address - GOAL_POSITION.address - GOAL_POSITION.width)
        ahead, behind = ACCELERATION.encode(_ACCELERATION), time + GOAL_SPEED.encode(_GOAL_SPEED)
        goals = zip(self.calibration.ids, counts.tolist(), strict=True)
        self._bus.write_all(ACCELERATION, {id: ahead + GOAL_POSITION.encode(int(goal)) + behind for id, goal in goals})

    def _torque(self, on: int) -> None:
        for id in self.calibration.ids:
            self._bus.write(id, TORQUE, on)
        self._enabled = bool(on)


def _same_offsets(bus: ServoBus, calibration: ServoCalibration) -> None:
    assert calibration.offsets is not None
    for id, name, theirs in zip(calibration.ids, calibration.names, calibration.offsets, strict=True):
        if (own := bus.read(id, HOMING_OFFSET)) != theirs:
            raise DeviceError(
                f"{bus.name}: {name} (id {id}) has homing offset {own}, its calibration {theirs}: is it another arm's file?"
            )
