"""The host's end of a board: joint commands become messages, telemetry becomes records.

In: :class:`~armsight.data.JointCommand`. Out: :class:`~armsight.data.JointStates` and what the board says of itself. The
messages are ``firmware/wire/armsight.xml``'s. Commands are numbered; the board names the last one it obeyed and the last
one it refused, so that the fate of each is known. Time passes only in :meth:`Board.receive` and in the methods that wait.
"""

from __future__ import annotations

import math
import zlib
from typing import Self

import numpy as np

from armsight.data import Array, JointCommand, JointStates
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.codes import REFUSAL_TEXTS, Order
from armsight.robot.boards.configuration import CONFIG, JOINTS, Configuration, check_configuration, check_gains
from armsight.robot.boards.link import Link
from armsight.robot.boards.reports import BoardStatus, JointReport, Welcome
from armsight.robot.boards.session import STEP_S, Session

_LONGEST_TICKS = 10000
#: An emergency stop goes out so many times: a disturbed byte must not swallow it.
_STOPS = 3
_WRAP = 1 << 32
_STORE_S = 3.0  # a flash memory takes its time
_PART = 200  # bytes of a CONFIG_PART


class Board:
    """A board behind a link; says hello and refuses boards of other versions.

    Args:
        link: the wire to it; closed with the board, also where this raises.
        name: what errors call it, such as its port.

    Attributes:
        welcome: who it is.

    Raises:
        DeviceError: it does not answer, or is of another version.
    """

    def __init__(self, link: Link, *, name: str = "the board") -> None:
        self._link = link
        try:
            self._session = Session(link, name)
        except BaseException:
            link.close()
            raise
        self.welcome: Welcome = self._session.welcome
        # The board may remember commands of an earlier host: ours are newer than all of them.
        status = self._session.status
        self._sequence = max(status.obeyed_sequence, status.refused_sequence)

    @property
    def status(self) -> BoardStatus:
        """The newest status."""
        return self._session.status

    @property
    def joints(self) -> JointReport:
        """The newest report of how the joints are driven."""
        return self._session.joints

    @property
    def broken_messages(self) -> int:
        """How often what came from the board was no message, or one was missing."""
        return self._session.wire.broken + self._session.wire.lost

    def send(self, command: JointCommand) -> int:
        """Send a motion command and return its number; whether it was obeyed, :attr:`status` tells.

        Raises:
            InputError: a shape, a number that is not finite, or a duration that is no whole number of ticks.
            DeviceError: the board is gone.
        """
        ticks = command.duration_s * self._session.ticks_per_s
        if not 0.5 <= ticks <= _LONGEST_TICKS or abs(ticks - round(ticks)) > 1e-6 * ticks:
            raise InputError(
                f"duration_s is {command.duration_s}; a whole number of the board's ticks is needed,"
                f" of 1/{self._session.ticks_per_s} s, {_LONGEST_TICKS} at most"
            )
        fields = [_six(name, getattr(command, name)) for name in ("q_ref", "qd_ref", "gravity_duty")]
        return self._numbered("move", round(ticks), *fields)

    def order(self, order: Order) -> int:
        """Send an order and return its number; :meth:`confirm` waits for its fate."""
        return self._numbered("order", int(order))

    def stop(self) -> None:
        """Stop in an emergency: the drives go off until ``Order.CLEAR_STOP``."""
        self._sequence = (self._sequence + 1) % _WRAP
        for _ in range(_STOPS):
            self._session.transmit("stop", self._sequence)

    def set_gains(self, gains: Array, *, checked: bool = True) -> int:
        """Send a gain set and return its number.

        Args:
            gains: (6, 6) a row per joint of kp, ki, kd, kv, derivative filter, anti-windup.
            checked: False leaves it to the board alone to refuse what is out of range.

        Raises:
            InputError: a gain is outside its range; nothing was sent.
        """
        values = check_gains(gains) if checked else np.asarray(gains, dtype=float)
        return self._numbered("gains", values.ravel().tolist())

    def confirm(self, sequence: int, wait_s: float = 0.5) -> None:
        """Wait until the board obeyed the command of this number.

        Raises:
            DeviceError: it was refused (and why), or nothing was heard of it.
        """
        for _ in range(max(1, round(wait_s / STEP_S))):
            self._session.pump(STEP_S)
            status = self.status
            if status.refused_sequence == sequence and status.refused_count:
                raise DeviceError(f"{self._session.name} refused the command: {REFUSAL_TEXTS[status.refusal]}")
            if status.obeyed_count and not _older(status.obeyed_sequence, sequence):
                return
        raise DeviceError(
            f"{self._session.name} did not say within {wait_s:g} s whether it obeyed; it is {self.status.state.name}"
        )

    def enable(self, *, inward: bool = False) -> None:
        """Switch the drives on and wait until they are; ``inward`` where a joint is outside its soft limits.

        Raises:
            DeviceError: it was refused, and why.
        """
        self.confirm(self.order(Order.ENABLE_INWARD if inward else Order.ENABLE))

    def receive(self, wait_s: float = 0.0) -> JointStates:
        """Let ``wait_s`` pass and return all readings of the potentiometers since the last call.

        Raises:
            DeviceError: the board is gone or started anew; the message tells what its arm does.
        """
        self._session.pump(wait_s)
        taken, self._session.angles = self._session.angles, []
        t_s = np.array([t for t, _ in taken])
        return JointStates(t_s, np.array([q for _, q in taken], dtype=float).reshape(-1, JOINTS))

    def configuration(self) -> Configuration:
        """Return the configuration in use, to be changed and given to :meth:`store`."""
        data = b""
        while len(data) < CONFIG.itemsize:
            data += self._session.config_part(len(data))
        return np.frombuffer(bytearray(data[: CONFIG.itemsize]), CONFIG).reshape(())

    def store(self, config: Configuration) -> None:
        """Store a configuration on the board, with the drives off; it is in use after the board's next start.

        Raises:
            InputError: a value is outside its range; nothing was changed.
            DeviceError: the board refused it.
        """
        check_configuration(config)
        data, session = config.tobytes(), self._session
        for offset in range(0, len(data), _PART):
            part = data[offset : offset + _PART]
            session.transmit("config_part", offset, len(data), len(part), list(part.ljust(_PART, b"\0")))
            session.pump(STEP_S)  # no faster than a slow wire and the board take it
        self.confirm(self._numbered("config_store", zlib.crc32(data)), _STORE_S)

    def close(self) -> None:
        """Let go of the link; a driven arm then does what its board does without commands."""
        self._link.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _numbered(self, kind: str, *fields: object) -> int:
        self._sequence = (self._sequence + 1) % _WRAP
        self._session.transmit(kind, self._sequence, *fields)
        return self._sequence


def _six(name: str, values: Array) -> list[float]:
    numbers = np.asarray(values, dtype=float)
    if numbers.shape != (JOINTS,):
        raise InputError(f"{name} is of shape {numbers.shape}; six numbers are needed")
    six: list[float] = numbers.tolist()
    if not all(map(math.isfinite, six)):
        joint = int(np.argmin(np.isfinite(numbers)))
        raise InputError(f"{name} of joint {joint + 1} is {numbers[joint]}; it must be finite")
    return six


def _older(sequence: int, other: int) -> bool:
    """Tell whether a number is older than another; they wrap."""
    return (sequence - other) % _WRAP >= _WRAP // 2
