"""What an emulated controller is, and the two ways to reach it: in step with the host, or at a port in real time.

In: a :class:`Device`. Out: :class:`SteppedLink`, whose time passes in ``read`` only, so that a test repeats; or
:func:`serve`, a pseudo-terminal that any program opens as a serial port.
"""

from __future__ import annotations

import contextlib
import os
import select
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol

from armsight.errors import DeviceError, InputError

STEP_S = 0.001


class Device(Protocol):
    """A controller with an arm: bytes go in, bytes come out, time passes in ``step``; all that :class:`Wired` has."""

    @property
    def t_s(self) -> float: ...  # noqa: D102
    def write(self, data: bytes) -> None: ...  # noqa: D102
    def read(self) -> bytes: ...  # noqa: D102
    def step(self) -> None: ...  # noqa: D102


@dataclass(kw_only=True)
class Wired:
    """What emulated controllers have in common: a :class:`Device` behind a wire that takes its time."""

    t_s: float = 0.0  #: how much time has passed, s
    _in: bytearray = field(default_factory=bytearray)
    _out: list[tuple[float, bytes]] = field(default_factory=list)  # when they have left for the host, s
    _free_s: float = 0.0  # from when on the wire is free

    def write(self, data: bytes) -> None:
        """Take bytes from the host."""
        self._in += data

    def read(self) -> bytes:
        """Return the bytes that have left for the host."""
        gone = b"".join(data for due, data in self._out if due <= self.t_s)
        self._out = [(due, data) for due, data in self._out if due > self.t_s]
        return gone

    def step(self) -> None:
        """Let STEP_S pass."""
        raise NotImplementedError


class SteppedLink:
    """A wire to a device whose time passes in :meth:`read` only; fulfils ``robot.boards.link.Link``."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._left_s = 0.0
        self.pulled = False

    def now(self) -> float:
        """Return the device's time, s, and what is left over of the last wait."""
        return self._device.t_s + self._left_s

    def write(self, data: bytes) -> None:
        """Send bytes."""
        self._check()
        self._device.write(data)

    def read(self, wait_s: float = 0.0) -> bytes:
        """Let time pass and return what came."""
        self._check()
        self._left_s += wait_s
        while self._left_s >= STEP_S - 1e-12:
            self._left_s -= STEP_S
            self._device.step()
        return self._device.read()

    def close(self) -> None:
        """Close the wire."""
        self.pulled = True

    def _check(self) -> None:
        if self.pulled:
            raise DeviceError("the emulated port is gone: was the cable pulled, or the board switched off?")


@contextlib.contextmanager
def serve(device: Device, baud: int) -> Iterator[PtyPort]:
    """Serve a device at a pseudo-terminal, in real time, within the block; InputError where the system has none.

    Bytes of a host that sets another baud rate arrive as noise.
    """
    if sys.platform == "win32":
        raise InputError("Windows has no pseudo-terminals: emulated controllers need Linux or macOS")
    port = PtyPort(device, baud)
    try:
        yield port
    finally:
        port.pull()


class PtyPort:
    """A device at a pseudo-terminal, held by ``lock`` while it runs; a thread lets its time pass in real time at most."""

    def __init__(self, device: Device, baud: int) -> None:
        import pty
        import tty

        self._device, self._baud = device, baud
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.name = os.ttyname(self._slave)
        self.lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def pull(self) -> None:
        """Pull the cable: the port is gone."""
        if not self._ended.is_set():
            self._ended.set()
            self._thread.join()
            os.close(self._slave)
            os.close(self._master)

    def change(self, action: Callable[[], None]) -> None:
        """Do something to the device between two steps."""
        with self.lock:
            action()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._ended.is_set():
            due = max(
                due + STEP_S, time.monotonic() - 0.1
            )  # a loaded computer loses time, at most 0.1 s of it is made up
            ready, _, _ = select.select([self._master], [], [], max(0.0, due - time.monotonic()))
            with contextlib.suppress(OSError), self.lock:  # nobody has opened the port
                if ready:
                    self._device.write(self._heard(os.read(self._master, 4096)))
                    due -= STEP_S
                else:
                    self._device.step()
                if said := self._device.read():
                    os.write(self._master, self._heard(said))

    def _heard(self, data: bytes) -> bytes:
        """Return what arrives of some bytes: garbage where host and device have different baud rates."""
        import termios

        speed = termios.tcgetattr(self._slave)[5]
        return data if speed == getattr(termios, f"B{self._baud}", speed) else bytes(each ^ 0xA5 for each in data[::2])
