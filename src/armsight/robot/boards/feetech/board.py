"""An SO-100 or SO-101 on its servo bus, as a board: goals go out, positions come back.

In: :class:`~armsight.data.JointCommand`. Out: :class:`~armsight.data.JointStates`, on the host's clock: the bus has none.
A servo keeps its own position controller; it takes no duty and has no watchdog: without a host it holds its last goal. The
gripper's servo is left alone.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np

from armsight.data import Array, JointCommand
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.codes import BoardState, Command
from armsight.robot.boards.contract import STOPS, Abilities, PolledBoard
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
from armsight.robot.boards.reports import BoardStatus, JointFault, JointReport, Welcome

RATE_HZ = 200.0  # readings a second: a sync read of five servos takes 1 ms on the wire, and USB adapters add 1 to 4 ms
LATENCY_S = 0.115  # from a command to the state that shows it (SO-ARM100 issue 134)
#: Until a joint has made a step of a count or two at rest: near its goal a servo creeps against its friction.
_RESPONSE_S = 0.25
#: Speed and acceleration of the servos towards a goal: 2.6 rad/s, 25 rad/s^2 (100 counts/s^2 a unit).
_GOAL_SPEED, _ACCELERATION = 1700, 164
#: What they follow with LATENCY_S, rad/s and rad/s^2.
_MOST_SPEED, _MOST_ACCELERATION = 1.5, 10.0
_REST_RAD_S = 0.35  # a count that comes and goes between two readings looks like a speed of up to this, rad/s
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


class FeetechBoard(PolledBoard):
    """The joints of an arm on a servo bus; :meth:`connect` makes one."""

    def __init__(
        self, bus: ServoBus, calibration: ServoCalibration, *, enabled: bool, begin_s: float | None = None
    ) -> None:
        count = len(calibration.ids)
        welcome = Welcome("feetech: " + ", ".join(calibration.names), "STS3215", 0, bus.baud, None)
        abilities = replace(ABILITIES, joints=count, steps_rad=(RAD_PER_COUNT,) * count)
        super().__init__(bus.name, abilities, welcome, bus.now)
        self.bus, self.calibration, self._enabled = bus, calibration, enabled  #: the bus, for registers
        self._begin_s = bus.now() if begin_s is None else begin_s
        self._states = bus.states(calibration.ids)
        self._goal = self._q()

    @classmethod
    def connect(
        cls, bus: ServoBus, calibration: ServoCalibration | None = None, *, begin_s: float | None = None
    ) -> Self:
        """Meet the servos of an arm; nothing is written. The bus is closed where this raises.

        Without calibration 0 rad is count 2048; ``begin_s``: when its own time begins, on the bus's clock, s, by
        default now.

        Raises DeviceError: one does not answer, is of another model, is not a position servo, or has another homing offset
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
        return self._status(state, faults, float(self._states.volts.min()))

    @property
    def joints(self) -> JointReport:
        """The newest report: speeds, loads (as duties) and temperatures are the servos' own."""
        states = self._states
        return self._report(states.speed * RAD_PER_COUNT, states.load, states.celsius)

    @property
    def broken_messages(self) -> int:
        """Number of answers that were broken or did not come."""
        return self.bus.broken

    def soft_limits(self) -> tuple[Array, Array]:
        """Return the joint angles (n,) that the calibration allows, rad."""
        return self.calibration.angles(self.calibration.lowest), self.calibration.angles(self.calibration.highest)

    def send(self, command: JointCommand) -> int:
        """Send goals; the servos go there at once, the command's duration and duty are not used.

        InputError: a goal outside the limits, or more than 20 degrees from where the joint is; nothing was sent.
        """
        # The margin is what rounds to a count that is allowed.
        goal = self._checked_goal(command, "its servo", self.calibration.names, margin_rad=RAD_PER_COUNT / 2)
        self._write_goals(self.calibration.counts(goal[0]))
        self._goal, self._goal_speed = goal
        return self._count()

    def command(self, command: Command) -> int:
        """Switch the torque on or off, or read whether an alarm still stands; InputError for other commands."""
        if command in (Command.ENABLE, Command.ENABLE_INWARD):
            self._switch_on()
        elif command is Command.DISABLE:
            self._torque(0)
        elif command is Command.CLEAR_FAULTS:
            self._read()
        else:
            raise InputError(f"{self.bus.name}: servos know no {command.name}: enable them again")
        return self._count()

    def stop(self) -> None:
        """Switch the torque off at once: the arm sinks."""
        for _ in range(STOPS):
            self.bus.write_all(TORQUE, {id: TORQUE.encode(0) for id in self.calibration.ids})
        self._enabled = False

    def close(self) -> None:
        """Close the port; servos whose torque is on hold their last goal."""
        self.bus.close()

    def _wait(self, wait_s: float) -> None:
        self.bus.wait(wait_s)

    def _q(self) -> Array:
        """Return the newest joint angles (n,), rad."""
        return self.calibration.angles(self._states.counts)

    def _read(self) -> ServoStates:
        """Read all servos; their time is the middle of the question that was answered and the answers."""
        self._states = self.bus.states(self.calibration.ids)
        self._t_s = (self.bus.asked_s + self.bus.now()) / 2 - self._begin_s
        return self._states

    def _switch_on(self) -> None:
        """Make the present position the goal, then switch the torque on."""
        states = self._read()
        if faults := self.status.faults:
            raise DeviceError(f"{self.bus.name} cannot be enabled: {'; '.join(map(str, faults))}")
        self._write_goals(np.clip(states.counts, self.calibration.lowest, self.calibration.highest))
        self._goal = self._q()
        self._torque(1)

    def _write_goals(self, counts: Array) -> None:
        time = bytes(GOAL_SPEED.address - GOAL_POSITION.address - GOAL_POSITION.width)
        ahead, behind = ACCELERATION.encode(_ACCELERATION), time + GOAL_SPEED.encode(_GOAL_SPEED)
        goals = zip(self.calibration.ids, counts.tolist(), strict=True)
        self.bus.write_all(ACCELERATION, {id: ahead + GOAL_POSITION.encode(int(goal)) + behind for id, goal in goals})

    def _torque(self, on: int) -> None:
        for id in self.calibration.ids:
            self.bus.write(id, TORQUE, on)
        self._enabled = bool(on)


def _same_offsets(bus: ServoBus, calibration: ServoCalibration) -> None:
    assert calibration.offsets is not None
    for id, name, theirs in zip(calibration.ids, calibration.names, calibration.offsets, strict=True):
        if (own := bus.read(id, HOMING_OFFSET)) != theirs:
            raise DeviceError(
                f"{bus.name}: {name} (id {id}) has homing offset {own}, its calibration {theirs}: is it another arm's file?"
            )
