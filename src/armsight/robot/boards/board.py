"""The host's end of a board: joint commands become messages, telemetry becomes records.

In: :class:`~armsight.data.JointCommand`. Out: :class:`~armsight.data.JointStates` and what the board says of itself. The
messages are ``firmware/wire/armsight.xml``'s. Commands are numbered; the board names the last one it acknowledged and the
last one it rejected, so that the host learns what became of each. Time passes only in :meth:`Board.connect`,
:meth:`Board.receive` and the methods that wait. An error of the link says what the arm does without a host.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Self, TypeVar

import numpy as np

from armsight.data import Array, JointCommand, JointStates
from armsight.errors import DeviceError, InputError
from armsight.firmware import dialect
from armsight.robot.boards import reports
from armsight.robot.boards.codes import Command, Reaction, Rejection, SensorKind
from armsight.robot.boards.configuration import (
    CONFIG,
    CONFIG_VERSION,
    JOINTS,
    Configuration,
    check_configuration,
    check_gains,
    check_pin,
)
from armsight.robot.boards.contract import STOPS, WRAP, Abilities, Closing
from armsight.robot.boards.link import Link
from armsight.robot.boards.wire import BOARD_COMPONENT, BOARD_SYSTEM, Message, Wire

#: A board that sends nothing for so long is gone: its slowest message comes every few hundredths of a second.
SILENT_S = 1.0
STEP_S = 0.01
_Answer = TypeVar("_Answer")
_HELLOS = 20
_STEPS = 5  # between one hello and the next
_TELEMETRY_STEPS = 300  # the rarest message comes once a second at 9600 baud
_LONGEST_TICKS = 10000
_STORE_S = 3.0  # a flash memory takes its time
_PART = 200  # bytes of a CONFIG_PART
_FIELDS = CONFIG.fields
assert _FIELDS is not None
_SILENCE_AT: int = _FIELDS["silence_ticks"][1]  # bytes; silence_reaction follows
#: By how much readings are older than the tick that reports them, and its standard deviation, s: half of the sixteen scans
#: that are added up; what the potentiometers' wires and filters add is not known.
_READING_AGE_S = {"nucleo-f446re": (4e-4, 1e-4)}
_SET_MESSAGE_INTERVAL, _REBOOT = 511, 246  # MAV_CMD_
_SLOW_ANGLES_US = 20000


class Board(Closing):
    """A board behind a link, connected by :meth:`connect`; the link is closed with it."""

    welcome: reports.Welcome  #: who it is
    status: reports.BoardStatus  #: its newest status
    joints: reports.JointReport  #: its newest report of how the joints are driven
    abilities: Abilities  #: what it can do

    def __init__(self, link: Link, name: str) -> None:
        self.name, self._link, self._wire = name, link, Wire(link)
        self._angles: list[tuple[float, list[float]]] = []
        self._sensed: list[tuple[Message, float]] = []
        self._ticks_per_s, self._number = 1000, 0  # number: of the session, which commands carry
        self._tick = self._sequence = 0
        self._started, self._quiet_s, self._reaction = False, 0.0, ""
        self._greeting: Message | None = None
        self._parts: dict[int, bytes] = {}
        self._answers: dict[int, int] = {}

    @classmethod
    def connect(cls, link: Link, *, name: str = "the board") -> Self:
        """Say hello to the board behind a link, and wait for the first telemetry; the link is closed where this raises.

        DeviceError: it does not answer, or is of another version.
        """
        board = cls(link, name)
        try:
            board._open()
        except BaseException:
            link.close()
            raise
        return board

    def _open(self) -> None:
        self._hello()
        self._first_telemetry()
        self._reaction = self._ask_reaction()
        age_s = _READING_AGE_S.get(self.welcome.board, (0.0, 0.0))
        self.abilities = Abilities(JOINTS, self._ticks_per_s, reading_age_s=age_s)
        # The board may remember commands of an earlier host: ours are newer than all of them.
        self._sequence = max(self.status.acknowledged_sequence, self.status.rejected_sequence)

    def _say(self, kind: str, *values: object) -> None:
        """Send a message of the dialect; an error of the link then says what the arm does without a host."""
        with self._reached():
            self._wire.send(kind, *values)

    @contextmanager
    def _reached(self) -> Iterator[None]:
        try:
            yield
        except DeviceError as error:
            raise DeviceError(f"{error}{self._reaction}") from None

    def _ask(self, answers: Mapping[int, _Answer], key: int, kind: str, *values: object) -> _Answer | None:
        """Send a message until an answer of this key is among ``answers``; None where none comes."""
        for _ in range(_HELLOS):
            self._say(kind, *values)
            for _ in range(_STEPS):
                self._pump(STEP_S)
                if key in answers:
                    return answers[key]
        return None

    def _command_long(self, kind: int, param1: float, param2: float = 0.0) -> None:
        """Send one of MAVLink's own commands until the board answers it."""
        self._answers.clear()
        sent = (BOARD_SYSTEM, BOARD_COMPONENT, kind, 0, param1, param2, 0, 0, 0, 0, 0)
        if (result := self._ask(self._answers, kind, "command_long", *sent)) is None:
            raise DeviceError(f"{self.name} does not answer MAVLink command {kind}")
        if result:
            raise DeviceError(f"{self.name} rejected MAVLink command {kind} with result {result}")

    def _pump(self, wait_s: float) -> None:
        """Let ``wait_s`` pass and take the messages that come."""
        with self._reached():
            messages = self._wire.receive(wait_s)
        self._quiet_s = 0.0 if messages else self._quiet_s + wait_s
        for message in messages:
            try:
                self._take(message)
            except ValueError:  # a code nobody knows: broken, though its CRC fits by chance
                self._wire.broken += 1
        if self._started and self._quiet_s >= SILENT_S:
            raise DeviceError(
                f"{self.name} has sent nothing for {self._quiet_s:.1f} s: is it off, or its cable pulled?{self._reaction}"
            )

    def _config_part(self, offset: int) -> bytes:
        """Return the configuration in use from a byte on, as many bytes as one message holds."""
        self._parts.clear()
        if (part := self._ask(self._parts, offset, "config_read", offset)) is None:
            raise DeviceError(f"{self.name} does not report its configuration")
        return part

    def _take(self, message: Message) -> None:
        match message.get_type():
            case "ANGLES":
                self._angles.append((self._time_s(message.tick), message.angle_rad))
            case "JOINTS":
                self.joints = reports.joints_of(message, self._time_s(message.tick))
            case "BOARD_STATUS":
                self._take_status(reports.status_of(message, self._time_s(message.tick)))
            case "WELCOME":
                self._greeting = message
            case "SENSED":
                self._sensed.append((message, self._time_s(message.tick)))
            case "COMMAND_ACK":
                self._answers[message.command] = message.result
            case "CONFIG_PART":
                self._parts[message.offset] = bytes(message.bytes[: message.length])

    def _take_status(self, status: reports.BoardStatus) -> None:
        """Keep a status; where it newly rejects commands because no hello came, the board has restarted."""
        if self._started and status.rejection == Rejection.NO_HELLO:
            before = self.status
            if (before.rejected_count, before.rejected_sequence) != (status.rejected_count, status.rejected_sequence):
                raise self._restarted()
        self.status = status

    def _restarted(self) -> DeviceError:
        return DeviceError(f"{self.name} has restarted: its drives are off; connect to it again")

    def _time_s(self, tick: int) -> float:
        """Return the time of a tick, s: ticks wrap, and messages of neighbouring ticks may come in any order."""
        ahead = (tick - self._tick + WRAP // 2) % WRAP - WRAP // 2
        if self._started and ahead < -self._ticks_per_s:
            raise self._restarted()
        self._tick += ahead
        return self._tick / self._ticks_per_s

    def _hello(self) -> None:
        ours = dialect().ARMSIGHT_DIALECT_VERSION
        for nonce in range(1, _HELLOS + 1):
            self._say("hello", ours, CONFIG_VERSION, nonce)
            for _ in range(_STEPS):
                self._pump(STEP_S)
                if self._greeting is not None:
                    self._meet(self._greeting, ours)
                    return
        heard = "bytes come, but no answer to the hello" if self._wire.heard else "nothing comes"
        raise DeviceError(
            f"{self.name}: no board answers ({heard}): is it the right port and baud rate, and is the firmware on the board"
            " (`armsight board flash`)?"
        )

    def _meet(self, message: Message, ours: int) -> None:
        self.welcome = welcome = reports.welcome_of(message)
        theirs, config = message.dialect_version, message.config_version
        if (theirs, config) != (ours, CONFIG_VERSION):
            raise DeviceError(
                f"{self.name}: board {welcome.board} with firmware {welcome.firmware} speaks dialect {theirs},"
                f" configuration {config}; this armsight speaks dialect {ours}, configuration {CONFIG_VERSION}: put this"
                " version's firmware on it with `armsight board flash`, or install the armsight it came with; it was sent"
                " no command"
            )
        self._ticks_per_s, self._tick = welcome.ticks_per_s, message.tick
        self._number = message.session

    def _first_telemetry(self) -> None:
        for _ in range(_TELEMETRY_STEPS):
            self._pump(STEP_S)
            if hasattr(self, "status") and hasattr(self, "joints"):
                self._angles.clear()
                self._started = True
                return
        raise DeviceError(f"{self.name}: board {self.welcome.board} answers the hello, but sends no telemetry")

    def _ask_reaction(self) -> str:
        """Return in words what the arm does by itself without a host, as its configuration has it."""
        ticks, reaction = struct.unpack_from("<II", self._config_part(_SILENCE_AT))
        does = "holds the arm where it comes to rest" if reaction == Reaction.HOLD else "switches the drives off"
        slows = "slows down and " if reaction == Reaction.HOLD else ""
        return f"; without commands the board {slows}{does} after {ticks / self._ticks_per_s * 1e3:.0f} ms"

    @property
    def homed(self) -> bool:
        """Whether all encoders that count know their zeros; one that missed counts does not any more."""
        return not self.status.not_homed

    @property
    def broken_messages(self) -> int:
        """Number of broken or missing messages from the board."""
        return self._wire.broken + self._wire.lost

    def send(self, command: JointCommand) -> int:
        """Send a motion command and return its number; :attr:`status` says whether it was acknowledged.

        Raises InputError: a shape, a number that is not finite, or a duration that is no whole number of ticks;
        DeviceError: the board is gone.
        """
        ticks = command.duration_s * self._ticks_per_s
        if not 0.5 <= ticks <= _LONGEST_TICKS or abs(ticks - round(ticks)) > 1e-6 * ticks:
            raise InputError(
                f"duration_s is {command.duration_s}; a whole number of the board's ticks is needed,"
                f" of 1/{self._ticks_per_s} s, {_LONGEST_TICKS} at most"
            )
        q_ref, qd_ref = _six("q_ref", command.q_ref), _six("qd_ref", command.qd_ref)
        return self._send("move", round(ticks), q_ref, qd_ref, _six("gravity_duty", command.gravity_duty))

    def command(self, command: Command) -> int:
        """Send a command and return its number; :meth:`confirm` waits until the board acknowledges or rejects it."""
        return self._send("command", int(command))

    def stop(self) -> None:
        """Stop in an emergency: the drives go off until ``Command.CLEAR_STOP``."""
        sequence = self._next()
        for _ in range(STOPS):
            self._say("stop", sequence)

    def set_gains(self, gains: Array, *, checked: bool = True) -> int:
        """Send a gain set (6, 8), a row per joint of kp, ki, kd, kv, ka, kf, filter, anti-windup; return its number.

        InputError: a gain is outside its range, and nothing was sent, unless ``checked`` is False, which leaves it to
        the board.
        """
        values = check_gains(gains) if checked else np.asarray(gains, dtype=float)
        return self._send("gains", values.ravel().tolist())

    def confirm(self, sequence: int, wait_s: float = 0.5) -> None:
        """Wait until the board acknowledged the command of this number; DeviceError where it was rejected, or is silent."""
        for _ in range(max(1, round(wait_s / STEP_S))):
            self._pump(STEP_S)
            status = self.status
            if status.rejected_sequence == sequence and status.rejected_count:
                raise DeviceError(f"{self.name} rejected the command: {status.rejection.text}")
            # Numbers wrap: what is not older than this one.
            if status.acknowledged_count and (status.acknowledged_sequence - sequence) % WRAP < WRAP // 2:
                return
        raise DeviceError(
            f"{self.name} did not say within {wait_s:g} s whether it acknowledged; it is {self.status.state.name}"
        )

    def enable(self, *, inward: bool = False) -> None:
        """Switch the drives on, or raise DeviceError; ``inward`` where a joint is outside its soft limits."""
        self.confirm(self.command(Command.ENABLE_INWARD if inward else Command.ENABLE))

    def receive(self, wait_s: float = 0.0) -> JointStates:
        """Let ``wait_s`` pass and return all readings of the potentiometers since the last call.

        DeviceError: the board is gone or has restarted; the message says what its arm does.
        """
        self._pump(wait_s)
        taken, self._angles = self._angles, []
        t_s = np.array([t for t, _ in taken])
        return JointStates(t_s, np.array([q for _, q in taken], dtype=float).reshape(-1, JOINTS))

    def watch_sensors(self, every_s: float) -> None:
        """Let the board report so often what its converters read; 0 ends it. :meth:`sensed` returns it.

        Raises DeviceError: it does not answer.
        """
        ask = self._command_long
        ask(_SET_MESSAGE_INTERVAL, dialect().MAVLINK_MSG_ID_SENSED, 1e6 * every_s)
        # Both at full rate would fill the wire.
        ask(_SET_MESSAGE_INTERVAL, dialect().MAVLINK_MSG_ID_ANGLES, _SLOW_ANGLES_US if every_s else 0)

    def sensed(self, wait_s: float = 0.0) -> reports.SensorReadings:
        """Let ``wait_s`` pass and return what the converters read since the last call.

        Raises DeviceError: the board is gone or has restarted.
        """
        self._pump(wait_s)
        self._angles.clear()
        taken, self._sensed = self._sensed, []
        return reports.readings_of([message for message, _ in taken], [t_s for _, t_s in taken])

    def restart(self) -> None:
        """Start the board anew, with the drives off or DeviceError, and say hello again: what was stored is in use."""
        self._command_long(_REBOOT, 1)
        anew = Board(self._link, self.name)
        anew._open()
        vars(self).update(vars(anew))

    def soft_limits(self) -> tuple[Array, Array]:
        """Return the soft limits (6,) of its configuration, rad."""
        joints = self.configuration()["joint"]
        return joints["soft_min_rad"].astype(float), joints["soft_max_rad"].astype(float)

    def configuration(self) -> Configuration:
        """Return the configuration in use, to be changed and given to :meth:`store`."""
        data = b""
        while len(data) < CONFIG.itemsize:
            data += self._config_part(len(data))
        return np.frombuffer(bytearray(data[: CONFIG.itemsize]), CONFIG).reshape(())

    def store(self, config: Configuration) -> None:
        """Store a configuration on the board, with the drives off; it is in use after the board's next start.

        InputError: a value is outside its range; nothing was changed. DeviceError: the board rejected it.
        """
        check_configuration(config)
        check_pin(config, self.welcome.board)
        _check_abilities(config, self.welcome)
        data = config.tobytes()
        for offset in range(0, len(data), _PART):
            part = data[offset : offset + _PART]
            self._say("config_part", offset, len(data), len(part), list(part.ljust(_PART, b"\0")))
            self._pump(STEP_S)  # no faster than a slow wire and the board take it
        self._say("config_store", self._next(), zlib.crc32(data), self._number)
        self.confirm(self._sequence, _STORE_S)

    def close(self) -> None:
        """Close the link; a driven arm then does what its board does without commands."""
        self._link.close()

    def _send(self, kind: str, *values: object) -> int:
        self._say(kind, self._next(), self._number, *values)
        return self._sequence

    def _next(self) -> int:
        self._sequence = (self._sequence + 1) % WRAP
        return self._sequence


def _check_abilities(config: Configuration, welcome: reports.Welcome) -> None:
    """Raise InputError where a configuration asks for more than the board has."""
    has = welcome.abilities
    if has is None:
        return
    count = int(config["joint_count"])
    if count > has.joints:
        raise InputError(f"joint_count is {count}; {welcome.board} has {has.joints} joints; nothing was changed")
    for number, encoder in enumerate(config["joint"]["encoder"][:count], start=1):
        kind = SensorKind(int(encoder["sensor"]))
        if kind not in has.sensors:
            read = ", ".join(each.name.lower() for each in has.sensors)
            raise InputError(
                f"joint {number}: sensor is {kind.name.lower()}; {welcome.board} reads {read}; nothing was changed"
            )
        if kind == SensorKind.QUADRATURE and encoder["input"] > has.quadrature_inputs:
            raise InputError(
                f"joint {number}: encoder input is {encoder['input']}; {welcome.board} has 1 to {has.quadrature_inputs};"
                " nothing was changed"
            )


def _six(name: str, values: Array) -> list[float]:
    numbers = np.asarray(values, dtype=float)
    if numbers.shape != (JOINTS,):
        raise InputError(f"{name} is of shape {numbers.shape}; six numbers are needed")
    six: list[float] = numbers.tolist()
    if not all(map(math.isfinite, six)):
        joint = int(np.argmin(np.isfinite(numbers)))
        raise InputError(f"{name} of joint {joint + 1} is {numbers[joint]}; it must be finite")
    return six
