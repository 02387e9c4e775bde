"""A sensor's readings as they come, as JSON lines over UDP or a serial port, on the board's clock."""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import time
from collections.abc import Callable

import numpy as np

from armsight.data import Array
from armsight.errors import DeviceError, InputError
from armsight.loop.references.file import INERTIAL_COLUMNS, Entry
from armsight.loop.running.setup import HostClock

BAUD = 921_600
#: A first reading is waited for so long, s; half: slow sensors are missed, double: a wrong port is said late.
FIRST_S = 3.0
_WAIT_S = 0.1  # for a line: so soon a thread sees that it is to end
_LINES_BYTES = 65_536


class LiveReadings:
    """Reads a sensor in a thread. Its clock is converted as the board's is: by what came fastest.

    Args:
        entry: its table, which says where it is: ``udp:[HOST:]PORT`` or ``serial:PORT[,BAUD]``.
        clock: that converts the board's times to the computer's.
        now: the computer's clock, s.

    Raises:
        InputError: the table does not say, or what comes is not its readings.
        DeviceError: the port cannot be opened, or nothing comes.
    """

    def __init__(self, entry: Entry, clock: HostClock, now: Callable[[], float] = time.monotonic) -> None:
        self._where = f"[{entry.reference.name}]: live"
        self._board, self._own, self._now = clock, HostClock(now), now
        self._lock, self._ended, self._problem = threading.Lock(), threading.Event(), ""
        self._rows: list[tuple[float, list[float]]] = []  # time, s, on the computer's clock; values
        self._newest_s = self._stamp_s = -np.inf  # the newest time, board's clock, and stamp
        self._closing = contextlib.ExitStack()
        self._read = self._opened(entry.live or "")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        begun = now()
        while not self._rows and now() - begun < FIRST_S:
            time.sleep(0.01)
        if not self._rows:
            self.close()
            if self._problem:
                raise InputError(f"{self._where}: {self._problem}")
            raise DeviceError(
                f"{self._where}: nothing came from {entry.live} within {FIRST_S:g} s; is it sending there?"
            )

    def _opened(self, spec: str) -> Callable[[], bytes]:
        """Return what reads some lines, empty where none came in time."""
        if match := re.fullmatch(r"udp:(?:(.+):)?(\d{1,5})", spec):
            receiver = self._closing.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            receiver.settimeout(_WAIT_S)
            try:
                receiver.bind((match[1] or "127.0.0.1", int(match[2])))
            except (OSError, OverflowError) as error:
                raise DeviceError(f"{self._where}: {spec} cannot be opened: {error}") from None
            return lambda: receiver.recv(_LINES_BYTES) + b"\n"
        if match := re.fullmatch(r"serial:([^,]+)(?:,(\d+))?", spec):
            try:
                import serial
            except ImportError:
                raise InputError(f"{self._where}: {spec} needs pyserial: pip install 'armsight[board]'") from None
            try:
                port = self._closing.enter_context(serial.Serial(match[1], int(match[2] or BAUD), timeout=_WAIT_S))
            except (OSError, ValueError) as error:
                raise DeviceError(f"{self._where}: {spec} cannot be opened: {error}") from None
            return lambda: bytes(port.readline())
        raise InputError(f"{self._where} is {spec!r}; expected udp:[HOST:]PORT or serial:PORT[,BAUD]")

    def _run(self) -> None:
        rest = b""
        while not self._ended.is_set():
            try:
                rest += self._read()
            except TimeoutError:
                continue
            except OSError as error:  # it was disconnected: a run goes on without it
                self._problem = f"ended: {error}"
                return
            *lines, rest = rest.split(b"\n")
            for line in filter(bytes.strip, lines):
                self._take(line)
            rest = rest[-_LINES_BYTES:]

    def _take(self, line: bytes) -> None:
        try:
            record = json.loads(line)
            t_s, *values = (float(record[name]) for name in ("t_s", *INERTIAL_COLUMNS))
        except (ValueError, TypeError, KeyError) as error:  # the first line of a port may be cut
            kind = f"{error.args[0]} is missing" if isinstance(error, KeyError) else "is no JSON object of numbers"
            self._problem = f"expected lines of JSON with t_s, {', '.join(INERTIAL_COLUMNS)}; {line[:40]!r} {kind}"
            return
        if np.isfinite(values).all() and t_s > self._stamp_s:  # repeated ones, and NaN, are left out
            with self._lock:
                self._stamp_s = t_s
                self._own.heard(t_s)
                self._rows.append((t_s + self._own.offset_s, values))

    def __call__(self, end_s: float) -> tuple[Array, Array]:
        """Return times (N,), s, on the board's clock, and readings (N, 6) that came since the last call."""
        with self._lock:
            rows, self._rows = self._rows, []
        t_s = np.array([t for t, _ in rows]) - (self._board.offset_s if rows else 0.0)
        rising = t_s > np.maximum.accumulate(np.append(self._newest_s, t_s))[:-1]
        self._newest_s = max(self._newest_s, t_s.max(initial=-np.inf))
        return t_s[rising], np.array([values for _, values in rows]).reshape(-1, 6)[rising]

    def close(self) -> None:
        """Stop reading."""
        self._ended.set()
        self._thread.join(1.0)
        self._closing.close()
