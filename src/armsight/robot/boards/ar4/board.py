"""An AR4 as a board: goals go out, the motors' encoders come back.

In: :class:`~armsight.data.JointCommand`. Out: :class:`~armsight.data.JointStates`, on the host's clock: the Teensy sends
none. It keeps its own controller (steppers with ramps), takes no duty, and holds the arm as long as it has power; there is
no watchdog. Its encoders sit on the motors: what belts and gears lose is not in the readings.

The lines have no checksum. A disturbed reading is found by its limits and by how fast a joint can move; a disturbed
command is not found.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import NoReturn, Self, TypeVar

import numpy as np

from armsight.data import Array, JointCommand
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.ar4 import lines, models
from armsight.robot.boards.ar4.lines import JOINTS, Ar4Start, Ar4Stopped, Ar4Text, Ar4Values, Heading, LineReader
from armsight.robot.boards.codes import Alarm, BoardState, Command
from armsight.robot.boards.contract import STOPS, Abilities, PolledBoard
from armsight.robot.boards.link import Link
from armsight.robot.boards.reports import BoardStatus, JointFault, JointReport, Welcome

BAUD = 115200
#: The firmware's version that this codec was written for; others of the same first number are spoken to as well.
VERSION = "2.1.0"
RATE_HZ = 50.0  # readings a second: a position line takes 7 ms at 115200 baud
#: Steppers slow down towards every goal as if it were the last: they follow goals that move with v at a distance of
#: v^2 / (2 a). At 20 degrees/s and 30 degrees/s^2 that is 6.7 degrees, or 0.33 s, and as much again from and to rest.
MOST_SPEED_RAD_S, LATENCY_S = float(np.radians(20.0)), 0.7
#: The firmware leaves goals within DEAD_STEPS alone. A joint at rest steps back from such a goal first, by one step more,
#: and comes to it from there: each way takes so long, s; at rest goal and joint are slower than this, rad/s.
_BACK_S, _STILL_RAD_S = 0.25, 0.02
#: The longer way, of up to 2 DEAD_STEPS + 1 steps or 0.23 degree, takes 2 sqrt(0.23 / 30) s.
_RESPONSE_S = 2 * _BACK_S
_ANSWER_S, _START_S, _TRIES = 0.2, 0.6, 4
_POLL_S, _DRAIN_S = 0.001, 0.05
#: Homing of a group of joints: to the switches, away from them, to the rest position.
_HOMING_S = 60.0
_MARGIN_DEG = 5.0  # what an encoder may show beyond the limits and beyond the fastest motion, degrees
_Answer = TypeVar("_Answer", Ar4Start, Ar4Values, Ar4Stopped)
ABILITIES = Abilities(
    JOINTS,
    RATE_HZ,
    LATENCY_S,
    _RESPONSE_S,
    tuple(np.radians(1 / models.MODELS["mk3"].steps_per_deg).tolist()),
    0.055,
    MOST_SPEED_RAD_S,
    float(np.radians(models.MOST_ACCELERATION_DEG_S2)),
    takes_duty=False,
    own_controller=True,
    releases=False,
)


class Ar4Board(PolledBoard):
    """The joints of an AR4; :meth:`connect` makes one."""

    def __init__(
        self, link: Link, name: str, model: models.Ar4Model, now: Callable[[], float] = time.monotonic
    ) -> None:
        abilities = replace(ABILITIES, steps_rad=tuple(np.radians(1 / model.steps_per_deg).tolist()))
        super().__init__(name, abilities, Welcome(f"ar4 {model.name}", VERSION, 0, BAUD, None), now)
        self.model, self._link = model, link
        self._reader, self._broken, self._stopped = LineReader(), 0, False
        self._begin_s = self._heard_s = now()  # heard: the first byte after the newest question
        self._reported: Array = np.zeros(JOINTS)  # degrees of the encoders
        self._speed_rad_s: Array = np.zeros(JOINTS)
        self._written_s = self._back_s = -np.inf
        self._back = np.zeros(JOINTS)  # motor steps from which a goal is approached
        self._near = np.zeros(JOINTS, bool)  # the joints that are on the way there
        self._approached: Array | None = None  # the goal that was approached so, motor steps

    @classmethod
    def connect(
        cls, link: Link, *, name: str = "the AR4", model: str = "mk3", now: Callable[[], float] = time.monotonic
    ) -> Self:
        """Read the joints behind a link, which is closed where this raises; nothing moves.

        ``now``: the clock that passes while the link is read, s; ``model``: mk1, mk2 or mk3, else InputError.
        DeviceError: nothing answers, or a firmware of another kind.
        """
        try:
            board = cls(link, name, models.ar4_model(model), now)
            board._start(VERSION)
            board._read_positions()
            board._goal = board._q()
            return board
        except BaseException:
            link.close()
            raise

    @property
    def homed(self) -> bool:
        """Whether the encoders were set since power-on: they begin at 0, which no homed arm shows in all joints."""
        return bool(np.any(self._reported != 0.0))

    @property
    def status(self) -> BoardStatus:
        """The newest status; nobody measures the supply."""
        faults = (JointFault(Alarm.EMERGENCY_STOP),) if self._stopped else ()
        state = BoardState.ENABLED if self._enabled else BoardState.DISABLED
        return self._status(BoardState.STOPPED if self._stopped else state, faults, float("nan"))

    @property
    def joints(self) -> JointReport:
        """The newest report; duties are not known and 0."""
        return self._report(self._speed_rad_s, np.zeros(JOINTS))

    @property
    def broken_messages(self) -> int:
        """Number of answers that were disturbed or did not come."""
        return self._broken + self._reader.broken

    def soft_limits(self) -> tuple[Array, Array]:
        """Return the joints' limits (6,), rad."""
        return np.radians(self.model.low_deg), np.radians(self.model.high_deg)

    def send(self, command: JointCommand) -> int:
        """Send goals, at most ``RATE_HZ`` times a second: the newest counts; duration and duty are not used.

        InputError: the arm is not homed, a goal is outside the limits, or more than 20 degrees away.
        """
        self._require_homed()
        self._goal, self._goal_speed = self._checked_goal(command, f"the AR4 {self.model.name}")
        if self._now() - self._written_s >= 1 / RATE_HZ:
            self._write_goal()
        return self._count()

    def command(self, command: Command) -> int:
        """Take the arm over, or reset the emergency stop, DeviceError while pressed; InputError for other commands."""
        if command in (Command.ENABLE, Command.ENABLE_INWARD):
            self._take_over()
        elif command is Command.CLEAR_STOP:
            self._enabled = False
            self._wait(_DRAIN_S)  # answers to goals say what was before
            self._ask(lines.RESET_STOP, Ar4Stopped)
            if self._stopped:
                raise DeviceError(f"{self.name}: the emergency stop is still pressed")
        elif command is Command.CLEAR_FAULTS:
            self._read_positions()
        else:
            raise InputError(f"{self.name}: an AR4's drives stay on; switch its supply off")
        return self._count()

    def stop(self) -> None:
        """Slow all joints down to rest, where the drives hold them; they cannot be switched off by the host."""
        for _ in range(STOPS):
            self._link.write(lines.move([0.0] * JOINTS, speeds=True))
        self._enabled = False

    def home(self, *, at_once: int = JOINTS) -> None:
        """Drive 1, 2, 3 or 6 joints at a time to their limit switches, set the encoders, and go to the rest position.

        DeviceError: a switch was not reached; the Teensy's words.
        """
        if at_once not in models.HOMING_GROUPS:
            raise InputError(f"{at_once} joints at once are not possible; 1, 2, 3 or 6 are")
        question = lines.home(models.HOMING_GROUPS[at_once] + "012345")
        self._ask(question, Ar4Values, wait_s=_HOMING_S * JOINTS / at_once, tries=1, heading=Heading.HOMED)
        self._t_s = -np.inf  # the encoders were set anew: a jump
        self._read_positions()
        self._require_homed()
        self._goal = self._q()

    def close(self) -> None:
        """Close the port; the arm goes to its last goal and is held there."""
        self._link.close()

    def _q(self) -> Array:
        """Return the newest joint angles (6,), rad."""
        return np.radians(self.model.angles_deg(self._reported))

    def _start(self, version: str) -> None:
        """Name version and model; a firmware of another version of the same kind is asked again in its own."""
        answer = self._ask(lines.start(version, self.model.name), Ar4Start, wait_s=_START_S)
        self.welcome = Welcome(f"ar4 {self.model.name}", answer.version, 0, BAUD, None)
        if not answer.version_matches:
            if answer.version.partition(".")[0] != VERSION.partition(".")[0] or answer.version == version:
                raise DeviceError(
                    f"{self.name}: the Teensy's firmware is version {answer.version}; this armsight knows {VERSION}:"
                    " put the firmware of ar4_ros_driver on it"
                )
            self._start(answer.version)
        elif not answer.model_matches:
            raise DeviceError(f"{self.name}: the Teensy's firmware {answer.version} knows no {self.model.name}")

    def _require_homed(self) -> None:
        if not self.homed:
            raise InputError(
                f"{self.name}: all encoders read 0: the arm was not homed since it was switched on; `armsight board home`"
            )

    def _take_over(self) -> None:
        """Make the present position the goal; the answer says whether the emergency stop was pressed."""
        self._read_positions()
        self._require_homed()
        self._goal = self._q()
        self._ask(lines.move(self._reported.tolist()), Ar4Stopped)
        if self._stopped:
            raise DeviceError(f"{self.name}: the emergency stop was pressed: release it, then `armsight board clear`")
        self._enabled = True

    def _write_goal(self) -> None:
        """Write the goal, in whole motor steps; at rest, one within the dead steps is approached from behind, once.

        The last movement is then in the sense of the change: a joint that was moved in that sense before stays on the same
        side of its backlash.
        """
        now = self._now()
        goal = np.rint(self.model.reported_deg(np.degrees(self._goal)) * self.model.steps_per_deg)
        moves = np.abs(self._goal_speed).max() >= _STILL_RAD_S
        if not moves and now < self._back_s + 2 * _BACK_S:  # on the way back, or forth
            goal = np.where(self._near, self._back, goal) if now < self._back_s + _BACK_S else goal
        elif moves or np.abs(self._speed_rad_s).max() >= _STILL_RAD_S:
            self._approached, self._back_s = None, -np.inf
        else:
            here = np.rint(self._reported * self.model.steps_per_deg)
            off = goal - here
            near = (off != 0) & (np.abs(off) <= models.DEAD_STEPS)
            if self._approached is not None:
                near &= goal != self._approached
            if near.any():
                ends = [self.model.reported_deg(np.degrees(end)) for end in self.soft_limits()]
                low, high = (each * self.model.steps_per_deg for each in (np.minimum(*ends), np.maximum(*ends)))
                back = here - np.sign(off) * (models.DEAD_STEPS + 1)
                # At a limit there is no way back, and the goal is approached from beyond.
                back = np.where((back < low) | (back > high), goal + np.sign(off) * (models.DEAD_STEPS + 1), back)
                self._approached, self._near, self._back, self._back_s = goal, near, back, now
                goal = np.where(near, back, goal)
        # Half a step more, as the firmware cuts off what is not a whole one.
        self._link.write(lines.move(((goal + 0.5 * np.sign(goal)) / self.model.steps_per_deg).tolist()))
        self._written_s = now

    def _read(self) -> None:
        homed = self.homed
        self._read_positions()
        if homed and not self.homed:
            raise DeviceError(f"{self.name}: all encoders read 0: the Teensy has restarted; home the arm again")

    def _read_positions(self) -> None:
        """Read the positions; a reading that no joint can have is a disturbed one.

        The Teensy reads its encoders after the question and before the answer's first byte: the stamp is between. The last
        byte comes 6 ms later at 115200 baud, and at once over USB.
        """
        for _ in range(_TRIES):
            asked = self._now()
            answer = self._ask(lines.POSITIONS, Ar4Values, heading=Heading.POSITIONS)
            t_s, reported = (asked + self._heard_s) / 2 - self._begin_s, np.array(answer.values)
            if self._possible(reported, t_s):
                passed = t_s - self._t_s
                if 0 < passed < 1.0:
                    self._speed_rad_s = np.radians(models.SENSE * (reported - self._reported) / passed)
                self._t_s, self._reported = t_s, reported
                return
            self._broken += 1
        joint = int(np.argmax(np.abs(reported - self._reported)))
        raise DeviceError(
            f"{self.name}: joint {joint + 1} jumped from {self._reported[joint]:.1f} to {reported[joint]:.1f} deg of its"
            " encoder: is the line disturbed, or was the arm homed by another program? Connect again"
        )

    def _possible(self, reported: Array, t_s: float) -> bool:
        """Return whether the encoders may read so, degrees, after what they read before."""
        if not np.any(reported):
            return True  # a Teensy that has restarted
        if np.any(np.abs(reported) > (self.model.high_deg - self.model.low_deg) + 2 * _MARGIN_DEG):
            return False
        if not self._t_s > 0.0:  # the first reading, or the first after homing
            return True
        passed = t_s - self._t_s
        return bool(np.all(np.abs(reported - self._reported) <= 2 * models.MOST_SPEED_DEG_S * passed + _MARGIN_DEG))

    def _ask(
        self,
        question: bytes,
        kind: type[_Answer],
        *,
        wait_s: float = _ANSWER_S,
        tries: int = _TRIES,
        heading: Heading | None = None,
    ) -> _Answer:
        """Ask and return the answer of this kind; what else comes meanwhile is taken. DeviceError: none, or an error."""
        heard = 0
        for _ in range(tries):
            self._link.write(question)
            silent = True
            for _ in range(
                round(wait_s / _POLL_S)
            ):  # polls: a host that is late itself takes nothing from the arm's time
                data = self._link.read(_POLL_S)
                if silent and data:
                    silent, self._heard_s = False, self._now()
                heard += len(data)
                for answer in self._taken(data):
                    if isinstance(answer, kind) and heading in (None, getattr(answer, "heading", None)):
                        return answer
            self._broken += 1
        self._silent(question, heard)

    def _wait(self, wait_s: float) -> None:
        """Let time pass and take what comes; a goal that had to wait is written when its time has come."""
        until = self._now() + wait_s
        while True:
            self._taken(self._link.read(min(_POLL_S, max(0.0, until - self._now()))))
            if self._enabled and self._now() - self._written_s >= 1 / RATE_HZ:
                self._write_goal()
            if self._now() >= until - 1e-9:
                return

    def _taken(self, data: bytes) -> list[Ar4Start | Ar4Values | Ar4Stopped]:
        """Return the answers in these bytes; errors raise, the state of the emergency stop is kept."""
        found: list[Ar4Start | Ar4Values | Ar4Stopped] = []
        for line in self._reader.take(data):
            answer = lines.read_line(line)
            if answer is None:
                self._broken += 1
            elif not isinstance(answer, Ar4Text):
                if isinstance(answer, Ar4Stopped):
                    self._stopped = answer.pressed
                    self._enabled = self._enabled and not answer.pressed
                found.append(answer)
            elif answer.heading is Heading.ERROR:
                raise DeviceError(f"{self.name}: the Teensy reports: {answer.text}")
        return found

    def _silent(self, question: bytes, heard: int) -> NoReturn:
        asked = question[:2].decode()
        if heard:
            raise DeviceError(
                f"{self.name}: bytes come, but no answer to {asked}: is it the right port and {BAUD} baud, and does the"
                " Teensy have the firmware of ar4_ros_driver?"
            )
        raise DeviceError(
            f"{self.name}: nothing answers {asked}: is the Teensy switched on, is it the right port, and does it have the"
            " firmware of ar4_ros_driver?"
        )
