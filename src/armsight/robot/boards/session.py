"""A session with a board: the hello, the clock, and the newest of everything it said.

Whatever goes wrong with the link is told together with what the board's arm does now by itself.
"""

from __future__ import annotations

import struct

from armsight.errors import DeviceError
from armsight.firmware import dialect
from armsight.robot.boards.codes import Reaction, Refusal
from armsight.robot.boards.configuration import CONFIG, CONFIG_VERSION
from armsight.robot.boards.link import Link
from armsight.robot.boards.reports import BoardStatus, JointReport, Welcome, joints_of, status_of, welcome_of
from armsight.robot.boards.wire import Message, Wire

#: A board that sends nothing for so long is gone: its slowest message comes every few hundredths of a second.
SILENT_S = 1.0
STEP_S = 0.01
_HELLOS = 20
_STEPS = 5  # between one hello and the next
_TELEMETRY_STEPS = 300  # the rarest message comes once a second at 9600 baud
_WRAP = 1 << 32


class Session:
    """A board that answered.

    Args:
        link: the wire to it.
        name: what errors call it.

    Attributes:
        welcome: who it is.
        status: its newest status.
        joints: its newest report of how the joints are driven.
        angles: readings since they were last taken, (s, six angles).

    Raises:
        DeviceError: it does not answer, or is of another version.
    """

    welcome: Welcome
    status: BoardStatus
    joints: JointReport

    def __init__(self, link: Link, name: str) -> None:
        self.name = name
        self.wire = Wire(link)
        self.angles: list[tuple[float, list[float]]] = []
        self.ticks_per_s = 1000
        self._tick = 0
        self._started = False
        self._quiet_s = 0.0
        self._reaction = ""
        self._greeting: Message | None = None
        self._parts: dict[int, bytes] = {}
        self._hello()
        self._first_telemetry()
        self._reaction = self._ask_reaction()

    def transmit(self, kind: str, *fields: object) -> None:
        """Send a message."""
        try:
            self.wire.send(kind, *fields)
        except DeviceError as error:
            raise DeviceError(f"{error}{self._reaction}") from None

    def pump(self, wait_s: float) -> None:
        """Let time pass and take what comes."""
        try:
            messages = self.wire.receive(wait_s)
        except DeviceError as error:
            raise DeviceError(f"{error}{self._reaction}") from None
        self._quiet_s = 0.0 if messages else self._quiet_s + wait_s
        for message in messages:
            try:
                self._take(message)
            except ValueError:  # a code nobody knows: broken, though its CRC fits by chance
                self.wire.broken += 1
        if self._started and self._quiet_s >= SILENT_S:
            raise DeviceError(
                f"{self.name} has sent nothing for {self._quiet_s:.1f} s: is it off, or its cable pulled?{self._reaction}"
            )

    def config_part(self, offset: int) -> bytes:
        """Ask for the configuration in use from this byte on; returns as much of it as one message holds."""
        self._parts.clear()
        for _ in range(_HELLOS):
            self.transmit("config_read", offset)
            for _ in range(_STEPS):
                self.pump(STEP_S)
                if offset in self._parts:
                    return self._parts[offset]
        raise DeviceError(f"{self.name} does not tell its configuration")

    def _take(self, message: Message) -> None:
        kind = message.get_type()
        if kind == "ANGLES":
            self.angles.append((self._time_s(message.tick), message.angle_rad))
        elif kind == "JOINTS":
            self.joints = joints_of(message, self._time_s(message.tick))
        elif kind == "BOARD_STATUS":
            self._take_status(status_of(message, self._time_s(message.tick)))
        elif kind == "WELCOME":
            self._greeting = message
        elif kind == "CONFIG_PART":
            self._parts[message.offset] = bytes(message.bytes[: message.length])

    def _take_status(self, status: BoardStatus) -> None:
        """Keep a status; one that newly refuses us for want of a hello is of a board that forgot ours."""
        if self._started and status.refusal == Refusal.NO_HELLO:
            before = self.status
            if (before.refused_count, before.refused_sequence) != (status.refused_count, status.refused_sequence):
                raise self._anew()
        self.status = status

    def _anew(self) -> DeviceError:
        return DeviceError(f"{self.name} has started anew: its drives are off; connect to it again")

    def _time_s(self, tick: int) -> float:
        """Return the time of a tick: they wrap, and messages of neighbouring ticks may come in any order."""
        ahead = (tick - self._tick + _WRAP // 2) % _WRAP - _WRAP // 2
        if self._started and ahead < -self.ticks_per_s:
            raise self._anew()
        self._tick += ahead
        return self._tick / self.ticks_per_s

    def _hello(self) -> None:
        ours = dialect().ARMSIGHT_DIALECT_VERSION
        for nonce in range(1, _HELLOS + 1):
            self.transmit("hello", ours, CONFIG_VERSION, nonce)
            for _ in range(_STEPS):
                self.pump(STEP_S)
                if self._greeting is not None:
                    self._meet(self._greeting, ours)
                    return
        heard = "bytes come, but no answer to the hello" if self.wire.heard else "nothing comes"
        raise DeviceError(
            f"{self.name}: no board answers ({heard}): is it the right port and baud rate, and is the firmware on the board"
            " (`armsight board flash`)?"
        )

    def _meet(self, message: Message, ours: int) -> None:
        self.welcome = welcome = welcome_of(message)
        theirs, config = message.dialect_version, message.config_version
        if (theirs, config) != (ours, CONFIG_VERSION):
            raise DeviceError(
                f"{self.name}: board {welcome.board} with firmware {welcome.firmware} speaks dialect {theirs},"
                f" configuration {config}; this armsight speaks dialect {ours}, configuration {CONFIG_VERSION}: put this"
                " version's firmware on it with `armsight board flash`, or install the armsight it came with; it was sent"
                " no command"
            )
        self.ticks_per_s, self._tick = welcome.ticks_per_s, message.tick

    def _first_telemetry(self) -> None:
        for _ in range(_TELEMETRY_STEPS):
            self.pump(STEP_S)
            if hasattr(self, "status") and hasattr(self, "joints"):
                self.angles.clear()
                self._started = True
                return
        raise DeviceError(f"{self.name}: board {self.welcome.board} answers the hello, but sends no telemetry")

    def _ask_reaction(self) -> str:
        """Return the words on what the arm does by itself without a host, from the end of the configuration."""
        ticks, reaction = struct.unpack("<II", self.config_part(CONFIG.itemsize - 8))
        does = "holds the arm where it comes to rest" if reaction == Reaction.HOLD else "switches the drives off"
        slows = "slows down and " if reaction == Reaction.HOLD else ""
        return f"; without commands the board {slows}{does} after {ticks / self.ticks_per_s * 1e3:.0f} ms"
