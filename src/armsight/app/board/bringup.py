"""``armsight board bringup``: from a board, motors and potentiometers or encoders that nobody knows to an arm that follows.

In: a board with factory values, and an :class:`Operator` who moves joints, reads angles and answers. Out: a configuration,
stored on the board and written as ``board.toml``, what was found as ``bringup.json``, and a page of figures. The steps:

    readings         every potentiometer at rest: its noise; an open or short one by name; encoders without sound readings
    potentiometers   each joint moved by hand: its table, direction, range, dead spots; or counts of a revolution and zero
    motors           each motor by a pulse of at most 3 degrees: which joint it moves, which way, from which duty on
    swing            each joint by 10 degrees, after a yes: R, K, inertia, friction, backlash
    verify           all joints by 2 degrees with the gains computed of it
    store            the configuration and the files

What a step found is kept at once. While a step runs, a silent host makes the board release the motors.
"""

from __future__ import annotations

import contextlib
import queue
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Protocol

import numpy as np

from armsight.app.board.command import STEPS
from armsight.app.board.found import Found, JointFound, put_gentle, report
from armsight.data import Array, JointCommand
from armsight.errors import ArmsightError, DeviceError, InputError
from armsight.files import write_text
from armsight.robot.boards.board import Board
from armsight.robot.boards.board_file import configuration_text
from armsight.robot.boards.codes import Command, Reaction, SensorKind
from armsight.robot.boards.configuration import ENCODER_REV, JOINTS, POT_NODES, Configuration, gains_array
from armsight.robot.boards.identification import DITHER_HZ, dead_spots, fit_drum, fit_spring, fit_swing
from armsight.robot.boards.reports import SensorReadings
from armsight.robot.boards.tuning import MotorFigures, elastic_gains, quiet_bandwidth, tuned_gains

FOUND_FILE, CONFIG_FILE = "bringup.json", "board.toml"
_EVERY_S, _PERIOD_S = 0.002, 0.01
_ASK_S, _PATIENCE_S = 0.02, 900.0
#: First letters of the answers to each kind of question.
_ANSWERS = {"yes": ("y", "n"), "problem": ("r", "s")}
_SHORT_COUNTS, _OPEN_COUNTS = 300, 65000
_MOST_NOISE_COUNTS = 200.0
_HAND_COUNTS, _HAND_ENCODER_COUNTS = 1500.0, 40.0  # a hand that moves a joint changes its reading by more
_UNEVEN_RAD = 0.1
_MOST_ANGLE_RAD = 13.0  # of a joint, as config.c holds it
#: Beside an absolute encoder's angle (ENCODER_... of types.h): what is wrong with it.
_ENCODER_FLAGS = {
    0x4000: "gives no sound reading. Are its six leads in, and its chip select this joint's?",
    0x8000: "reports its magnet as too weak or too strong. Is it 0.5 to 3 mm away, and centred?",
}
_JOG_RAD, _JOG_DUTY, _JOG_DUTY_PER_S = 0.010, 0.6, 0.15
_DEAD_DUTY, _DEAD_A = 0.25, 0.02
_RESTS = 0.25  # of what counts as a motion
#: A swing: amplitudes, rad, and frequencies, Hz, that add up, and how far a joint may get away from where it began.
_SWING_RAD, _SWING_HZ, _SWING_MOST_RAD = (0.12, 0.04), (0.5, 2.0), 0.26
#: Duties on top of it, at all of DITHER_HZ together (Schroeder's phases): they separate resistance from back-EMF.
_DITHER_DUTY = 0.15
_FIRST_SWING_S, _SWING_S, _GROW_S = 3.0, 5.0, 0.5
_VERIFY_RAD, _VERIFY_HZ, _VERIFY_S, _VERIFY_MOST_RAD = 0.035, 0.5, 4.0, 0.01
_GENTLE_RAD_S, _GENTLE_NOISE = 12.0, 0.02  # bandwidth of the second swing, and the noise of its duty
_TRAVEL_RAD, _TRAVEL_S = 1.6, 6.0  # way and time of the travel that shows an uneven transmission
#: Twist of a spring by its load, rad: more gives way and swings; half: joints that hold are warned of, double: none is.
_SOFT_TWIST_RAD = 0.2
#: Time -> offsets, speeds and duties (6,).
_Way = Callable[[float], tuple[Array, Array, Array]]


class Operator(Protocol):
    """Who answers."""

    def say(self, line: str) -> None:
        """Hear a line."""

    def ask(self, kind: str, joint: int | None, text: str) -> None:
        """Hear a question: ``yes``, ``mark`` (an angle in degrees, or nothing at the end), ``problem`` (r or s)."""

    def answer(self) -> str | None:
        """Return the answer, None while there is none; q, to any question, ends the bring-up."""


class _Mistake(Exception):
    """Something a person must mend: named, with what to do."""


class _Quit(Exception):
    """The person has had enough."""


class TerminalOperator:
    """A person at this terminal: lines come from stdin while the board's time goes on; its end is a q."""

    def __init__(self, echo: Callable[[str], None]) -> None:
        self.say, self._ended = echo, False
        self._lines: queue.Queue[str] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in sys.stdin:
            self._lines.put(line.rstrip("\n"))
        self._ended = True

    def ask(self, kind: str, joint: int | None, text: str) -> None:
        """Print a question; what was typed before it answers nothing: a yes lets joints move."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._lines.get_nowait()
        self.say(f"{text}: ")

    def answer(self) -> str | None:
        """Return the next line, if there is one."""
        with contextlib.suppress(queue.Empty):
            return self._lines.get_nowait()
        return "q" if self._ended else None


class Bringup:
    """A bring-up of one board."""

    def __init__(
        self,
        board: Board,
        person: Operator,
        folder: Path,
        joints: Sequence[int] = range(JOINTS),
        *,
        encoders: Mapping[int, tuple[SensorKind, int]] | None = None,
        again: bool = False,
        most_current_a: float = 2.0,
    ) -> None:
        abilities, name, path = board.welcome.abilities, board.welcome.board, folder / FOUND_FILE
        count = JOINTS if abilities is None else abilities.joints
        self._board, self._person, self._folder = board, person, folder
        self._goes_on = f"what was found is kept in {folder}: the same command goes on there"
        self._joints, self._again, self._current_a = [j for j in joints if j < count], again, most_current_a
        self.found = Found.read(path) if path.exists() else Found(name, [JointFound() for _ in range(JOINTS)])
        if self.found.board != name:
            raise InputError(f"{path} is of board {self.found.board}; this one is {name}: name another folder with -o")
        self.found.joint_count = count
        for j, (kind, which) in (encoders or {}).items():
            known = self.found.joints[j]
            if (known.kind, known.encoder_input) != (kind, which):
                self.found.joints[j] = JointFound(sensor=kind.name.lower(), encoder_input=which)
        self._last: dict[int, float] = {}  # newest counts of encoders, going on where a reading wraps
        self._bias: dict[int, float] = {}
        self._flags = np.zeros(JOINTS, dtype=int)
        self._skipped: set[tuple[str, int]] = set()
        self._motion: list[SensorReadings] = []

    def run(self, steps: Sequence[str] = tuple(STEPS)) -> None:
        """Do the steps, in their order; what was found is kept whatever happens."""
        try:
            self._board.watch_sensors(_EVERY_S)
            self.found.supply_v = round(self._board.status.supply_v, 1)
            self._meet_encoders()
            for step in STEPS:
                if step in steps:
                    self._person.say(f"== {step}")
                    getattr(self, f"_{step}")()
                    self._keep()
        except _Quit:
            self._person.say("ended; what was found is kept")
        except KeyboardInterrupt:
            self._off()
            self._person.say(f"motors off; {self._goes_on}")
            raise
        except DeviceError as error:
            raise DeviceError(f"{error}; {self._goes_on}") from None
        finally:
            self._off()
            with contextlib.suppress(ArmsightError):
                self._board.watch_sensors(0.0)  # its messages come as often as before
            self._keep()

    # ---- talking ----

    def _keep(self) -> None:
        self.found.write(self._folder / FOUND_FILE)

    def _say(self, joint: int, line: str) -> None:
        self._person.say(f"joint {joint + 1}: {line}")

    def _wait(self, kind: str, joint: int | None, said: str) -> str:
        """Ask, and let the board's time pass until there is an answer; readings meanwhile are kept in ``_motion``."""
        self._person.ask(kind, joint, said)
        waited_s = 0.0
        while waited_s <= _PATIENCE_S:
            if (answer := self._person.answer()) is not None:
                short = answer.strip().lower()
                if short.startswith("q"):
                    raise _Quit
                if kind not in _ANSWERS or short[:1] in _ANSWERS[kind]:
                    return short
                self._person.say(f"{answer!r} is not understood; {', '.join(_ANSWERS[kind])} or q is")
                self._person.ask(kind, joint, said)
            self._take(self._sensed(_ASK_S))
            waited_s += _ASK_S
        raise InputError(f"no answer for {_PATIENCE_S / 60:.0f} minutes; {self._goes_on}")

    def _yes(self, question: str) -> bool:
        return self._wait("yes", None, f"{question} [y/n]").startswith("y")

    def _each(self, step: str, action: Callable[[int], None]) -> None:
        for joint in self._joints:
            found = self.found.joints[joint]
            missing = [each for each in list(STEPS)[: list(STEPS).index(step)] if not found.done(each)]
            if found.done(step) and not self._again:
                self._say(joint, "found before (--again does it again)")
            elif missing:
                self._say(joint, f"left out, as {missing[0]} found nothing")
            else:
                self._mended(step, joint, action)
                self._keep()

    def _mended(self, step: str, joint: int, action: Callable[[int], None]) -> None:
        while True:
            try:
                action(joint)
                return
            except _Mistake as problem:
                self._off()
                self.found.joints[joint].problems.append(str(problem))
                answer = self._wait("problem", joint, f"{problem} [r]epeat, [s]kip, [q]uit")
            if step in ("motors", "swing", "verify") and self._counting():
                self._use(self._board.configuration())  # a fault took a quadrature encoder's zero away
            if not answer.startswith("r"):
                self._skipped.add((step, joint))
                return

    def _todo(self, step: str) -> list[int]:
        return [j for j in self._joints if self._again or not self.found.joints[j].done(step)]

    # ---- the board ----

    def _off(self) -> None:
        """Switch the drives off, whatever was last heard of them, and clear faults; a board that is gone does so itself."""
        with contextlib.suppress(ArmsightError):
            self._board.confirm(self._board.command(Command.DISABLE))
            if self._board.status.faults:
                self._board.confirm(self._board.command(Command.CLEAR_FAULTS))

    def _use(self, config: Configuration) -> None:
        self._off()
        counting = self._counting()
        for j in counting:
            found = self.found.joints[j]
            home = found.angles(np.array([self._last.get(j, 0.0)])) if found.range_counts else np.zeros(1)
            config["joint"][j]["encoder"]["home_rad"] = home[0]
        self._board.store(config)
        self._board.restart()
        self._board.watch_sensors(_EVERY_S)
        counts = self._board.sensed(0.05).counts
        for j in counting:
            if j in self._last and len(counts):
                self._bias[j] = self._last[j] - counts[-1, j]
        if counting:
            self._board.confirm(self._board.command(Command.HOME))

    def _counting(self) -> list[int]:
        joints = self.found.joints[: self.found.joint_count]
        return [j for j, each in enumerate(joints) if each.kind == SensorKind.QUADRATURE]

    def _meet_encoders(self) -> None:
        config, count = self._configuration(Reaction.RELEASE, gains=False), self.found.joint_count
        requested, has = (each["joint"]["encoder"][:count] for each in (config, self._board.configuration()))
        elsewhere = (requested["input"] != has["input"]) & (requested["sensor"] == SensorKind.QUADRATURE)
        if (requested["sensor"] != has["sensor"]).any() or elsewhere.any():
            self._use(config)
        unknown = [j for j in self._counting() if j not in self._last]
        if unknown:
            self._collect(0.1)
        for j in unknown:
            found = self.found.joints[j]
            if found.range_counts is None or found.counts_per_rev is None:
                continue
            question = f"joint {j + 1}: its encoder counts from where it was switched on. At which angle is it, degrees"
            while (angle := _angle(self._wait("angle", j, question))) is None:
                pass
            zero = self._last[j] - angle * found.counts_per_rev / (2 * np.pi)
            shift, found.zero_counts = zero - found.zero_counts, zero
            found.range_counts = [each + shift for each in found.range_counts]
            found.marks = [[counts + shift, at] for counts, at in found.marks]

    def _sensed(self, seconds: float) -> SensorReadings:
        """Return what was read in the next seconds; encoders' counts go on where their readings wrap."""
        readings = self._board.sensed(seconds)
        if not len(readings.t_s):
            return readings
        counts = readings.counts.copy()
        for j, found in enumerate(self.found.joints):
            if found.kind == SensorKind.POTENTIOMETER:
                continue
            raw, period = counts[:, j].astype(int), 65536
            if found.kind == SensorKind.ABSOLUTE:
                self._flags[j] |= np.bitwise_or.reduce(raw) & ~(ENCODER_REV - 1)
                raw, period = raw & (ENCODER_REV - 1), ENCODER_REV
            shown = raw + self._bias.get(j, 0.0)
            last = self._last.get(j, shown[0])
            steps = np.diff(shown, prepend=last)
            counts[:, j] = last + np.cumsum((steps + period / 2) % period - period / 2)
            self._last[j] = float(counts[-1, j])
        return replace(readings, counts=counts)

    def _take(self, readings: SensorReadings) -> None:
        if len(readings.t_s):
            self._motion.append(readings)
            self.found.arm_time_s += float(readings.t_s[-1] - readings.t_s[0]) + _EVERY_S

    def _taken(self) -> list[SensorReadings]:
        taken, self._motion = self._motion, []
        return taken

    def _collect(self, seconds: float) -> SensorReadings:
        self._motion.clear()
        for _ in range(max(1, round(seconds / _ASK_S))):
            self._take(self._sensed(_ASK_S))
        return _joined(self._taken())

    def _move(self, q_ref: Array, qd_ref: Array, duty: Array) -> SensorReadings:
        """Command a step of ``_PERIOD_S`` and return what was read in it."""
        self._board.send(JointCommand(q_ref, qd_ref, duty, _PERIOD_S))
        readings = self._sensed(_PERIOD_S)
        self._take(readings)
        status = self._board.status
        if status.faults:
            raise _Mistake(f"the board stopped: {status.first_fault or status.faults[0]}.")
        return readings

    def _moved(self, seconds: float, way: _Way, joint: int = 0, most_rad: float = np.inf) -> SensorReadings:
        """Move from where the arm is along a way, time -> offsets (6,), speeds (6,), duties (6,); return what was read."""
        start = self._board.joints.reference_rad.copy()
        self._motion.clear()
        for k in range(round(seconds / _PERIOD_S)):
            offset, speed, duty = way((k + 1) * _PERIOD_S)
            readings = self._move(start + offset, speed, duty)
            near = not len(readings.t_s) or abs(self._q(readings)[-1, joint] - start[joint]) <= most_rad
            _must(joint, near, "it swings further than it is to: is its load loose?")
        return _joined(self._taken())

    def _q(self, readings: SensorReadings) -> Array:
        return np.stack([self.found.joints[j].angles(readings.counts[:, j]) for j in range(JOINTS)], axis=1)

    def _configuration(self, reaction: Reaction, *, gains: bool) -> Configuration:
        return self.found.configuration(self._current_a, reaction, gains=gains)

    # ---- the steps: each is the method of its name ----

    def _readings(self) -> None:
        self._person.say("leave the arm alone for a second")
        self._each("readings", self._reading)

    def _reading(self, joint: int) -> None:
        found, self._flags[joint] = self.found.joints[joint], 0
        counts = self._collect(0.5).counts[:, joint]
        if found.kind == SensorKind.POTENTIOMETER:
            middle, noise = _pot_at_rest(joint, counts)
            self._say(joint, f"{middle:.0f} counts, noise {noise:.1f}")
        else:
            flags, noise = self._flags[joint], max(float(np.std(counts)), 0.5)
            for flag, wrong in _ENCODER_FLAGS.items():
                _must(joint, not flags & flag, f"its encoder {wrong}")
            self._say(joint, f"{found.sensor} encoder, noise {noise:.1f} counts")
        found.noise_counts = round(noise, 2)

    def _potentiometers(self) -> None:
        self._each("potentiometers", self._by_hand)

    def _by_hand(self, joint: int) -> None:
        self._say(
            joint,
            "move it slowly by hand from one end of its range to the other, and stop at 3 to"
            f" {POT_NODES - 2} angles that you can measure; then leave it where it stays by itself",
        )
        self._collect(0.1)
        every, marks = list[SensorReadings](), list[list[float]]()
        while answer := self._wait("mark", joint, f"joint {joint + 1}: angle in degrees, or nothing at the other end"):
            if (angle := _angle(answer)) is None:
                self._person.say(f"{answer!r} is no angle in degrees")
                continue
            every += self._taken()
            marks.append([float(np.median(self._collect(0.1).counts[:, joint])), angle])
        self._check_hand(joint, _joined(every + self._taken()).counts, marks)
        counts, angles, direction = self.found.joints[joint].pot_table()
        ends = f"{np.degrees(angles[0]):.1f} to {np.degrees(angles[-1]):.1f} deg over {counts[0]} to {counts[-1]}"
        self._say(joint, f"{ends} counts, direction {direction}")

    def _check_hand(self, joint: int, counts: Array, marks: list[list[float]]) -> None:
        found = self.found.joints[joint]
        encoded = np.array([each.kind != SensorKind.POTENTIOMETER for each in self.found.joints])
        good = np.where(encoded | (counts > _SHORT_COUNTS) & (counts < _OPEN_COUNTS), counts, np.nan)
        way = np.array([np.ptp(each[np.isfinite(each)]) if np.isfinite(each).sum() > 10 else 0.0 for each in good.T])
        way /= np.where(encoded, _HAND_ENCODER_COUNTS, _HAND_COUNTS)
        other = int(np.argmax(way)) + 1
        swapped = f"the {found.sensor}s of joints {joint + 1} and {other} are swapped. Swap their plugs."
        _must(joint, not way[joint] < 1 < way.max(), f"moving it moves the reading of joint {other}: {swapped}")
        lines = found.kind == SensorKind.QUADRATURE
        hint = "Are both its lines in, A and B?" if lines else "Does its shaft go along?"
        _must(joint, way[joint] >= 1, f"its reading does not follow the hand. {hint}")
        spots = []
        if not encoded[joint]:
            spots = dead_spots(counts[:, joint], found.noise_counts or 10.0, _SHORT_COUNTS, _OPEN_COUNTS)
        few = f"{len(marks)} angles were measured; 2 to {POT_NODES - 2} are needed."
        _must(joint, 2 <= len(marks) <= POT_NODES - 2, few)
        ordered = np.array(sorted(marks))
        apart, rises = np.diff(ordered, axis=0).T
        even = ((rises > 0).all() or (rises < 0).all()) and (apart >= (4 if encoded[joint] else 100)).all()
        pairs = _pairs(ordered)
        _must(joint, even, f"the angles measured do not rise or fall with the reading: {pairs}. Measure again.")
        found.marks, found.range_counts = marks, [float(np.nanmin(good[:, joint])), float(np.nanmax(good[:, joint]))]
        if encoded[joint]:
            self._fit_encoder(joint)
        if spots:
            around = [(max(first - 3, 0), min(last + 3, len(counts) - 1)) for first, last in spots]
            where = [np.degrees(found.angles(counts[list(ends), joint])) for ends in around]
            spans = ", ".join(f"{min(each):.1f} to {max(each):.1f} deg" for each in where)
            found.range_counts = None
            raise _mistake(joint, f"its potentiometer has a dead spot at {spans}. Clean or replace it.")

    def _fit_encoder(self, joint: int) -> None:
        found = self.found.joints[joint]
        try:
            if (off := found.fit_encoder()) > _UNEVEN_RAD:
                far = f"{np.degrees(off):.1f} degrees: {_pairs(np.array(sorted(found.marks)))}"
                lost = "Are counts lost, or was an angle misread? Measure again."
                raise InputError(f"the angles measured are off an even count by up to {far}. {lost}")
        except InputError as error:
            found.range_counts = found.counts_per_rev = None
            raise _mistake(joint, str(error)) from None
        self._say(joint, f"{abs(found.counts_per_rev or 0):.0f} counts a revolution")

    def _motors(self) -> None:
        if self._todo("motors"):
            moves = "the drives go on; each motor moves its joint by at most 3 degrees. Is the arm supported?"
            if not self._yes(moves):
                return
            self._use(self._configuration(Reaction.RELEASE, gains=False))
        self._each("motors", self._jog)
        self._off()

    def _jog(self, joint: int) -> None:
        self._board.enable(inward=True)
        ways, found = list[float](), self.found.joints[joint]
        for sign in (1.0, -1.0):
            enough = np.array([max(_JOG_RAD, 4 * each.noise_rad) for each in self.found.joints])
            start = self._at_rest(joint, enough)
            moved, duty, readings = self._ramp(joint, sign, start, enough)
            current = float(np.abs(np.median(readings.current_a[-25:, joint])))
            if way := _check_jog(joint, moved / enough, duty, current, last=sign < 0 and not ways):
                ways.append(np.sign(way) * sign)
                found.breakaway_duty = round(duty, 4)
        self._hold_still(0.2)
        self._board.confirm(self._board.command(Command.DISABLE))
        same = "it moves the same way whichever way its motor is driven. Support its load."
        _must(joint, len(set(ways)) == 1, same)
        found.motor_direction = int(ways[0])
        self._say(joint, f"moves from {found.breakaway_duty:.0%} duty on, motor direction {found.motor_direction}")

    def _at_rest(self, joint: int, enough: Array) -> Array:
        """Return where all joints (6,) have come to rest; ``enough`` is what counts as a motion later."""
        for _ in range(10):
            q = self._q(self._hold_still(0.3))
            last = q[-(len(q) // 3) :]
            sunk = np.abs(np.median(last, axis=0) - np.median(q[: len(q) // 3], axis=0)) / enough
            if sunk.max() < _RESTS:
                return np.asarray(last.mean(axis=0))
        known = np.array([each.done("potentiometers") for each in self.found.joints])
        restless = ~(sunk < _RESTS)
        if not restless[known].any():  # open inputs of joints without a table
            enough[restless] = np.inf
            return np.asarray(last.mean(axis=0))
        other = int(np.argmax(sunk)) + 1
        raise _mistake(joint, f"meanwhile joint {other} moves by itself: leave it where it stays, or support it.")

    def _hold_still(self, seconds: float) -> SensorReadings:
        return self._moved(seconds, lambda t: (np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS)))

    def _ramp(self, joint: int, sign: float, start: Array, enough: Array) -> tuple[Array, float, SensorReadings]:
        """Raise the duty until something moved; returns by how much all joints did, the duty, and the readings."""
        here, zeros = self._board.joints.reference_rad, np.zeros(JOINTS)
        duty, moved = 0.0, np.zeros(JOINTS)
        direction = self.found.joints[joint].motor_direction or 1  # the board multiplies it
        while duty < _JOG_DUTY:
            duty += _JOG_DUTY_PER_S * _PERIOD_S
            readings = self._move(here, zeros, _only(joint, sign * direction * duty))
            if len(readings.t_s):
                moved = np.median(self._q(readings), axis=0) - start
            if (np.abs(moved) > enough).any():
                break
            if duty >= _DEAD_DUTY and np.abs(np.median(readings.current_a[:, joint])) < _DEAD_A:
                break
        taken = _joined(self._taken())
        self._move(here, zeros, zeros)
        return moved, duty, taken

    def _swing(self) -> None:
        if self._todo("swing") and (ready := [j for j in self._joints if self.found.joints[j].done("motors")]):
            config = self._configuration(Reaction.RELEASE, gains=False)
            for j in ready:
                put_gentle(config["joint"][j], self.found.joints[j])
            self._use(config)
        self._each("swing", self._swing_joint)
        self._off()

    def _swing_joint(self, joint: int) -> None:
        degrees, travel = np.degrees(sum(_SWING_RAD)), self._travel_rad(joint)
        free = self._yes(f"joint {joint + 1} will swing by {degrees:.0f} degrees either way. Is it free to?")
        _must(joint, free, "it was not allowed to swing.")
        found = self.found.joints[joint]
        even = self._yes(
            f"joint {joint + 1} will then travel by {np.degrees(travel):+.0f} degrees and back, slowly, to show an uneven"
            " transmission. Is it free to?"
        )
        self._board.enable(inward=True)
        gains = gains_array(self._board.configuration())
        first = self._identify(joint, self._swung(joint, _FIRST_SWING_S))
        if found.elastic is None:  # else those that move it already are gentle enough
            better = gains.copy()
            gentle = min(_GENTLE_RAD_S, quiet_bandwidth(first, self.found.supply_v, found.noise_rad, _GENTLE_NOISE))
            better[joint] = tuned_gains(first, self.found.supply_v, gentle)
            self._board.confirm(self._board.set_gains(better))
        readings = self._swung(joint, _SWING_S)
        there_and_back = _way(joint, travel, 1 / _TRAVEL_S)
        travelled = self._moved(_TRAVEL_S, there_and_back) if even else None
        self._board.confirm(self._board.command(Command.DISABLE))
        self._board.confirm(self._board.set_gains(gains))
        motor = self._identify(joint, readings)
        self._say(
            joint,
            f"R {motor.resistance_ohm:.2f} ohm, K {motor.constant_v_s:.3f} V s/rad, inertia"
            f" {1e3 * motor.inertia_kg_m2:.1f} g m^2, friction {motor.dry_n_m:.2f} N m,"
            f" backlash {1e3 * (found.backlash_rad or 0):.1f} mrad",
        )
        self._check_spring(joint, motor)
        if travelled is not None:
            self._check_drum(joint, motor, travelled)

    def _travel_rad(self, joint: int) -> float:
        ends = self._board.configuration()["joint"][joint]
        here = float(self._board.joints.reference_rad[joint])
        low, high = float(ends["soft_min_rad"]) - here, float(ends["soft_max_rad"]) - here
        return float(np.clip(high if high > -low else low, -_TRAVEL_RAD, _TRAVEL_RAD))

    def _swung(self, joint: int, seconds: float) -> SensorReadings:

        def way(t_s: float) -> tuple[Array, Array, Array]:
            angle, speed = _swing_at(t_s, seconds)
            dither = _DITHER_DUTY * _dither_at(t_s - _PERIOD_S)
            return _only(joint, angle), _only(joint, speed), _only(joint, dither)

        return self._moved(seconds, way, joint, _SWING_MOST_RAD)

    def _of_motor(self, joint: int, readings: SensorReadings) -> tuple[Array, Array, Array, Array]:
        sign = float(self.found.joints[joint].motor_direction or 1)
        volts, amperes = sign * readings.duty[:, joint] * self.found.supply_v, sign * readings.current_a[:, joint]
        return readings.t_s, volts, amperes, self.found.joints[joint].angles(readings.counts[:, joint])

    def _check_drum(self, joint: int, motor: MotorFigures, readings: SensorReadings) -> None:
        found = self.found.joints[joint]
        twist = 0.0 if found.stiffness_n_m is None else motor.constant_v_s / found.stiffness_n_m
        drum = fit_drum(*self._of_motor(joint, readings), motor, twist)
        found.uneven = 0.0 if drum is None else drum[0] * drum[1]
        if drum is not None:
            by = f"{1e3 * drum[0]:.0f} mrad, {drum[1]:g} times a revolution (an eccentric drum?)"
            self._say(joint, f"its transmission is uneven: the joint leads and lags its motor by {by}")

    def _check_spring(self, joint: int, motor: MotorFigures) -> None:
        found, hz = self.found.joints[joint], self.found.joints[joint].resonance_hz
        if found.elastic is None or hz is None:
            return
        swings = f"it swings about its motor at {hz:.1f} Hz"
        if elastic_gains(motor, self.found.supply_v, found.elastic, found.noise_rad) is None:
            found.resistance_ohm = None
            mend = "Tighten its belt or cable, or put the sensor on the motor's side."
            raise _mistake(joint, f"it is too soft to be held: {swings}, and no gains are stable. {mend}")
        twist_rad = (found.gravity_n_m or 0.0) / found.elastic.stiffness_n_m
        soft = f". Its load twists it by {twist_rad:.2f} rad: it is too soft to be held well, and swings when a hand"
        soft = f"{soft} lets go. Take load off, or tighten its belt or cable" if twist_rad > _SOFT_TWIST_RAD else ""
        self._say(joint, f"it is elastic: {swings}; it is damped by its motor's speed{soft}")

    def _identify(self, joint: int, readings: SensorReadings) -> MotorFigures:
        found = self.found.joints[joint]
        keep = readings.t_s > readings.t_s[0] + _GROW_S
        t_s, volts, amperes, angles = (each[keep] for each in self._of_motor(joint, readings))
        sprung = fit_spring(t_s, volts, amperes, angles)
        try:
            fit, elastic = (fit_swing(t_s, volts, amperes, angles), None) if sprung is None else sprung
        except InputError as error:
            raise _mistake(joint, f"{error}.") from None
        found.stiffness_n_m = None if elastic is None else elastic.stiffness_n_m
        found.spring_damping_n_m_s = None if elastic is None else elastic.damping_n_m_s
        found.link_share = None if elastic is None else elastic.link_share
        for each in fields(MotorFigures):
            setattr(found, each.name, getattr(fit.motor, each.name))
        found.backlash_rad, found.gravity_n_m = fit.backlash_rad, fit.gravity_n_m
        found.fit_rms_v = float(np.sqrt(np.mean((fit.voltage_v - fit.predicted_v) ** 2)))
        volts = {"swing_voltage_v": fit.voltage_v, "swing_predicted_v": fit.predicted_v}
        found.traces |= _traces(swing_t_s=fit.t_s, swing_rad=angles, **volts)
        return fit.motor

    def _verify(self) -> None:
        ready = [j for j in self._joints if self.found.joints[j].done("swing")]
        moves = f"all joints found move by {np.degrees(_VERIFY_RAD):.0f} degrees with the gains computed."
        if not ready:
            self._person.say("left out: no joint was identified")
        elif not self._yes(f"{moves} Is the arm free to?"):
            self._person.say("left out: it was not allowed to move")
        else:
            self.found.verified = False
            for j in ready:
                self.found.joints[j].following_rms_rad = None
            self._use(self._configuration(Reaction.RELEASE, gains=True))
            self._mended("verify", ready[0], lambda _: self._follow(ready))
            self._off()

    def _follow(self, joints: list[int]) -> None:
        self._board.enable(inward=True)
        refs, all_of_them = list[Array](), _way(joints, _VERIFY_RAD, _VERIFY_HZ)

        def way(t_s: float) -> tuple[Array, Array, Array]:
            refs.append(np.r_[self._board.joints.t_s, self._board.joints.reference_rad])
            return all_of_them(t_s)

        readings = self._moved(_VERIFY_S, way)
        refs.append(np.r_[self._board.joints.t_s, self._board.joints.reference_rad])
        self._board.confirm(self._board.command(Command.DISABLE))
        at = np.array(refs)
        at = at[np.concatenate([[True], np.diff(at[:, 0]) > 0])]
        last = (readings.t_s > readings.t_s[0] + 1.0) & (readings.t_s < at[-1, 0])
        q = self._q(readings)[last]
        for j in joints:
            found = self.found.joints[j]
            error = np.interp(readings.t_s[last], at[:, 0], at[:, j + 1]) - q[:, j]
            rms, noise = float(np.sqrt(np.mean(error**2))), found.noise_rad
            follows = rms <= np.hypot(_VERIFY_MOST_RAD + found.friction_twist_rad, noise)
            _must(j, follows, f"it follows a small swing with an error of {np.degrees(rms):.2f} degrees RMS.")
            found.following_rms_rad = rms
            found.traces |= _traces(verify_t_s=readings.t_s[last] - readings.t_s[0], verify_error_rad=error)
            self._say(j, f"follows to {1e3 * rms:.2f} mrad RMS as read; its sensor's noise is {1e3 * noise:.2f}")
        self.found.verified = True

    @property
    def refuted(self) -> bool:
        """Whether the arm did not follow the small swing with what was found."""
        return any(step == "verify" for step, _ in self._skipped)

    def _store(self) -> None:
        if self.refuted:
            self._use(self._configuration(Reaction.RELEASE, gains=False))
            self._person.say(
                "nothing is stored, and the board has no gains: the arm did not follow with what was found. Is"
                f" {self._folder / FOUND_FILE} of another arm (-o another folder), or was the arm changed since (--again)?"
            )
            return
        if not any(each.done("swing") for each in self.found.joints):
            self._person.say("nothing is stored: no joint was identified")
            return
        config = self._configuration(Reaction.HOLD, gains=True)
        self._use(config)
        write_text(self._folder / CONFIG_FILE, configuration_text(config, self.found.board))
        page = report(self.found, gains_array(config)).write(self._folder)
        for j in self._counting():
            home = np.degrees(float(config["joint"][j]["encoder"]["home_rad"]))
            after = "mark it; after each start bring it there and give armsight board home"
            self._say(j, f"its home is where it stands now, {home:.1f} deg: {after}")
        joints = self.found.joints[: self.found.joint_count]
        missing = [str(j + 1) for j, each in enumerate(joints) if not each.done("swing")]
        if missing:
            self._person.say(f"joints {', '.join(missing)} were not identified: they are stored without gains")
        self._person.say(f"stored, and written to {self._folder / CONFIG_FILE}; figures: {page}")


def _mistake(joint: int, text: str) -> _Mistake:
    return _Mistake(f"joint {joint + 1}: {text}")


def _must(joint: int, holds: bool, text: str) -> None:
    if not holds:
        raise _mistake(joint, text)


def _joined(parts: list[SensorReadings]) -> SensorReadings:
    if not parts:
        raise DeviceError("the board reports no sensor readings")
    return SensorReadings(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(SensorReadings)))


def _pot_at_rest(joint: int, counts: Array) -> tuple[float, float]:
    """Return the median and the noise of a potentiometer's counts (n,) at rest, where it is whole."""
    middle, name = float(np.median(counts)), "its potentiometer is"
    mend = "Is its plug in, and its wiper connected?"
    _must(joint, middle <= _OPEN_COUNTS, f"{name} open: it reads {middle:.0f} of 65535. {mend}")
    mend = "Look for a bridge or a lead without supply."
    _must(joint, middle >= _SHORT_COUNTS, f"{name} shorted to ground: it reads {middle:.0f}. {mend}")
    noise = 1.4826 * float(np.median(np.abs(counts - middle)))
    noise = max(noise, float(np.std(counts[np.abs(counts - middle) <= 6 * max(noise, 4.0)])), 1.0)
    mend = "Is its lead beside the motor's, its ground good?"
    _must(joint, noise <= _MOST_NOISE_COUNTS, f"{name} noisy: {noise:.0f} counts at rest. {mend}")
    return middle, noise


def _check_jog(joint: int, moved: Array, duty: float, current_a: float, *, last: bool) -> float:
    """Return how far the joint moved in thresholds; 0 where it is held on this side only."""
    most = int(np.argmax(np.abs(moved)))
    swapped = f"the motors of joints {joint + 1} and {most + 1} are swapped. Swap their leads."
    own = most == joint or abs(moved[most]) < 1
    _must(joint, own, f"its motor output moves joint {most + 1}: {swapped}")
    if abs(moved[joint]) >= 1:
        measured = current_a >= 0.25 * _DEAD_A
        _must(joint, measured, "it moves, but no current is measured. Look at its current sensor's lead.")
        return float(moved[joint])
    mend = "Is its lead broken or out, or its driver off?"
    _must(joint, current_a >= _DEAD_A, f"its motor is dead: no current at {duty:.0%} duty. {mend}")
    mend = "Is the joint blocked, or the motor loose on its gear?"
    stuck = f"its motor draws {current_a:.2f} A at {duty:.0%} duty and nothing moves. {mend}"
    _must(joint, not last, stuck)
    return 0.0  # an end stop, or a load, may hold it on this side


def _angle(answer: str) -> float | None:
    """Return an angle typed in degrees, rad; None where it is none that a joint can have."""
    try:
        angle = float(np.radians(float(answer)))
    except ValueError:
        return None
    return angle if abs(angle) <= _MOST_ANGLE_RAD else None


def _only(joint: int | list[int], value: float) -> Array:
    values = np.zeros(JOINTS)
    values[joint] = value
    return values


def _way(joint: int | list[int], far_rad: float, hz: float) -> _Way:
    """Return the way of joints that go so far and back, so often a second, from rest to rest; as ``_moved`` takes it."""
    rate = 2 * np.pi * hz

    def way(t_s: float) -> tuple[Array, Array, Array]:
        offset, speed = 0.5 * far_rad * (1 - np.cos(rate * t_s)), 0.5 * far_rad * np.sin(rate * t_s) * rate
        return _only(joint, offset), _only(joint, speed), np.zeros(JOINTS)

    return way


def _swing_at(t_s: float, seconds: float) -> tuple[float, float]:
    def angle(t: float) -> float:
        grow = float(np.clip(min(t, seconds - t) / _GROW_S, 0.0, 1.0))
        swing = sum(a * np.sin(2 * np.pi * f * t) for a, f in zip(_SWING_RAD, _SWING_HZ, strict=True))
        return float(grow * grow * (3 - 2 * grow) * swing)

    return angle(t_s), (angle(t_s + 1e-4) - angle(t_s - 1e-4)) / 2e-4


def _dither_at(t_s: float) -> float:
    """Return the sum of sines at DITHER_HZ, each of the same power, all together that of a sine of amplitude 1."""
    phases = np.pi * np.arange(len(DITHER_HZ)) ** 2 / len(DITHER_HZ)
    return float(np.sin(2 * np.pi * DITHER_HZ * t_s + phases).sum() / np.sqrt(len(DITHER_HZ)))


def _traces(**lines: Array) -> dict[str, list[float]]:
    return {name: [round(float(v), 5) for v in each[:: max(1, len(each) // 400)]] for name, each in lines.items()}


def _pairs(marks: Array) -> str:
    return ", ".join(f"{np.degrees(angle):.1f} deg at {counts:.0f}" for counts, angle in marks)
