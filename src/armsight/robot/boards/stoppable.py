"""The arm's board for several threads: one drives it, and a stop of any other goes before everything else.

In: any :class:`~armsight.robot.boards.contract.MotionBoard`. Out: the same contract. Whoever drives the board holds it for
the length of one call, which is a period of the loop at most; a stop waits for no more than that, whatever the loop does
beside: it waits for an image, searches one, or fits a calibration.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from armsight.data import Array, JointCommand, JointStates
from armsight.errors import DeviceError
from armsight.robot.boards.codes import BoardState, Command
from armsight.robot.boards.contract import Abilities, Closing, MotionBoard
from armsight.robot.boards.reports import BoardStatus, JointReport, Welcome

#: How long a stop waits for the board's answer, and how often the board is asked meanwhile, s.
ANSWER_S, _ASK_S = 1.0, 0.002
#: A call that lasts longer, such as one that waits for an acknowledgement, does not keep a stop from being sent, s.
_PATIENCE_S = 0.1
#: A longer wait for readings is made of waits of this length, s, between which a stop comes.
_SLICE_S = 0.004
#: States in which a board with another controller, which knows no emergency stop, follows no command any more.
_ENDED = (BoardState.STOPPED, BoardState.DISABLED, BoardState.FAULTED)


def _of_board(name: str) -> Any:  # noqa: ANN401 - a property
    """Return the property of that name of the board inside, which is read without waiting."""
    return property(lambda self: getattr(self._board, name))


class StoppableBoard(Closing):
    """A board that any thread can stop; ``stopped`` says whether a person did, until :meth:`clear_stop`."""

    def __init__(self, board: MotionBoard) -> None:
        self._board, self.stopped = board, False
        self._lock, self._stopping = threading.Lock(), threading.Lock()
        self._free = threading.Event()
        self._free.set()
        self._kept: list[JointStates] = []

    abilities: Abilities = _of_board("abilities")
    welcome: Welcome = _of_board("welcome")
    status: BoardStatus = _of_board("status")
    joints: JointReport = _of_board("joints")
    broken_messages: int = _of_board("broken_messages")
    homed: bool = _of_board("homed")

    @contextmanager
    def _held(self) -> Iterator[MotionBoard]:
        """Yield the board to whoever does not stop it: a stop goes first."""
        self._free.wait()
        with self._lock:
            yield self._board

    def soft_limits(self) -> tuple[Array, Array]:
        """Return the limits (n,) that it keeps the joints within, rad."""
        with self._held() as board:
            return board.soft_limits()

    def send(self, command: JointCommand) -> int:
        """Send a motion command and return its number."""
        with self._held() as board:
            return board.send(command)

    def command(self, command: Command) -> int:
        """Send another command and return its number."""
        with self._held() as board:
            if command in (Command.ENABLE, Command.ENABLE_INWARD):
                self._require_not_stopped()
            return board.command(command)

    def confirm(self, sequence: int, wait_s: float = 0.5) -> None:
        """Wait until it acknowledged the command of this number."""
        with self._held() as board:
            board.confirm(sequence, wait_s)

    def enable(self, *, inward: bool = False) -> None:
        """Switch the drives on."""
        with self._held() as board:
            self._require_not_stopped()
            board.enable(inward=inward)

    def _require_not_stopped(self) -> None:
        """Reject after a stop: also of a board that knows no such state the drives stay off."""
        if self.stopped:
            raise DeviceError("stopped by a person: allow the drives again first")

    def clear_stop(self) -> None:
        """Allow the drives again after a stop; they stay off until they are enabled."""
        with self._held() as board:
            if board.status.state is BoardState.STOPPED:
                board.confirm(board.command(Command.CLEAR_STOP))
            self.stopped = False

    def receive(self, wait_s: float = 0.0) -> JointStates:
        """Let ``wait_s`` pass and return all readings since the last call, those too that came during a stop."""
        parts: list[JointStates] = []
        slices = max(math.ceil(wait_s / _SLICE_S - 1e-9) - 1, 0)
        for part_s in (*[_SLICE_S] * slices, max(wait_s - slices * _SLICE_S, 0.0)):
            with self._held() as board:
                states, kept, self._kept = board.receive(part_s), self._kept, []
                parts += [*kept, states]
        if len(parts) == 1:
            return parts[0]
        return JointStates(np.concatenate([each.t_s for each in parts]), np.concatenate([each.q for each in parts]))

    def stop(self) -> None:
        """Stop in an emergency, from any thread, and wait until the board says that it did, ``ANSWER_S`` at most."""
        with self._stopping:
            self._free.clear()
            held = self._lock.acquire(timeout=_PATIENCE_S)
            try:
                self.stopped = True
                self._board.stop()
                end = time.monotonic() + ANSWER_S
                while not self.rests and time.monotonic() < end:
                    held = held or self._lock.acquire(timeout=_ASK_S)
                    if held:
                        states = self._board.receive(_ASK_S)
                        self._kept += [states] if len(states.t_s) else []
            finally:
                if held:
                    self._lock.release()
                self._free.set()

    @property
    def rests(self) -> bool:
        """Whether it says that it stopped."""
        ended = _ENDED if self._board.abilities.own_controller else (BoardState.STOPPED,)
        return self._board.status.state in ended

    def close(self) -> None:
        """Close the link."""
        with self._held() as board:
            board.close()
