"""A board's joint readings beside the shots of live cameras, on their clock; a board that is lost is opened again.

A board that is not homed gives none. Its port is left alone between two looks, so that `armsight board home` gets it.
Nothing is commanded: the drives stay as they are, and so does the arm, also when the readings end.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable

import numpy as np

from armsight.app.board.command import not_homed, open_any
from armsight.app.options import BOARD
from armsight.data import JointStates
from armsight.errors import DeviceError, InputError
from armsight.loop.running.data import Datum, JointsDatum, NoteDatum
from armsight.loop.running.setup import HostClock
from armsight.robot.board_registry import check_board, is_real
from armsight.robot.boards.contract import MotionBoard

#: s of readings in a datum; half: twice as many, double: they come later.
_BATCH_S = 0.1
#: s, first and longest pause before a lost board is opened again; half: more tries, double: it is back later.
_PAUSE_S, _LONGEST_S = 0.25, 2.0


def _check_homed(board: MotionBoard, name: str) -> None:
    if missing := not_homed(board):
        raise InputError(f"{name}: {missing}")


class BoardReadings:
    """Reads the joints of a board from :meth:`start` on; an InputError: no such kind; a missing port is waited for."""

    def __init__(self, name: str) -> None:
        with contextlib.suppress(DeviceError):
            check_board(name)
        self._name, self._ended = name, threading.Event()
        self._thread = threading.Thread(target=self._run, name="board", daemon=True)
        self._newest_s, self._faults = -np.inf, tuple[str, ...]()
        self._lost: type[Exception] | None = None  # by what kind of error

    def start(self, put: Callable[[Datum], None], say: Callable[[str], None]) -> None:
        """Begin: hand readings and notes to ``put``, and the notes to ``say`` as lines."""
        self._put, self._say = put, say
        self._thread.start()

    def _run(self) -> None:
        pause_s = 0.0
        while not self._ended.wait(pause_s):
            pause_s = min(max(2 * pause_s, _PAUSE_S), _LONGEST_S)
            try:
                with open_any(self._name) as board:
                    _check_homed(board, self._name)
                    self._lost, pause_s = None, _PAUSE_S
                    self._note("connected", "info")
                    self._read(board)
            except Exception as error:  # noqa: BLE001 - nobody else watches this thread; the board is read again
                if self._lost is not type(error):  # each kind of reason is said once
                    self._note(f"{error}; trying again", "error")
                self._lost = type(error)

    def _read(self, board: MotionBoard) -> None:
        """Publish what a board reads until the end; its readings are on the clock of live cameras."""
        clock, real = HostClock(), is_real(self._name)
        while not self._ended.wait(0.0 if real else _BATCH_S):  # an emulated board's time passes at once
            states = board.receive(_BATCH_S)
            _check_homed(board, self._name)  # an encoder that missed counts has lost its zero
            if len(states.t_s):
                clock.heard(states.t_s[-1])
                t_s = states.t_s + clock.offset_s
                late = t_s > self._newest_s
                if late.any():
                    self._newest_s = t_s[-1]
                    self._put(JointsDatum(JointStates(t_s[late], states.q[late])))
            if (faults := tuple(map(str, board.status.faults))) != self._faults:
                self._faults = faults
                self._note("; ".join(faults) or "no fault any more", "warning" if faults else "info")

    def _note(self, text: str, level: str) -> None:
        self._say(BOARD + text)
        self._put(NoteDatum(time.monotonic(), BOARD + text, level))

    def close(self) -> None:
        """Stop reading, and close the port."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join(1.0)  # it may be waiting for an answer of the board
