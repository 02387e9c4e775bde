"""The link to an emulated board: one frame a millisecond carries the board's readings, duties and bytes in and out.

In: bytes of the host. Out: bytes of the board. Every tick the plant is sensed, the firmware runs once on an emulator, and
the plant moves on with the duties it gave. Bytes to the board arrive at the modelled baud rate (8N1: ten bits each),
those from it leave at the rate the firmware keeps to by itself. Time passes by ``read`` and ``step`` alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from armsight.data import Array
from armsight.errors import DeviceError, InputError
from armsight.robot.boards.contract import WRAP
from armsight.robot.boards.frames import (
    ANSWER,
    ANSWER_FIELDS,
    ANSWER_MAGIC,
    BYTES_AT,
    DUTY_AT,
    JOINTS,
    REQUEST_FIELDS,
    REQUEST_MAGIC,
    RESTART_POWER,
    RESTART_WATCHDOG,
    VERSION,
    WIRE_BYTES,
)
from armsight.robot.boards.link import TICK_S, Emulator, Plant

_BITS_PER_BYTE = 10
_FLOAT = np.dtype("<f4")


class Faults(Protocol):
    """What goes wrong on the wire of an emulated board; handed to :class:`EmulatedLink`."""

    def to_board(self, tick: int, data: bytes) -> bytes:
        """Return what arrives at the board of what the host sent in this tick."""

    def to_host(self, tick: int, data: bytes) -> bytes:
        """Return what arrives at the host of what the board sent in this tick."""


class EmulatedLink:
    """A board in lock-step, behind the contract of :class:`~armsight.robot.boards.link.Link`; it closes its emulator.

    ``emulator``: runs the firmware; ``baud``: bits a second towards the board, as its own wire has: it gives a message up
    that comes much slower; ``faults``: what goes wrong on the wire; ``advance``: lets seconds pass instead, calling
    ``step`` once a millisecond: for a simulation that owns the time; ``watch``: called with every answer frame
    (``pil_answer`` as bytes), for traces.
    """

    def __init__(
        self,
        emulator: Emulator,
        plant: Plant,
        baud: int = 921600,
        faults: Faults | None = None,
        *,
        advance: Callable[[float], None] | None = None,
        watch: Callable[[bytes], None] | None = None,
    ) -> None:
        if baud <= 0:
            raise InputError(f"the baud rate is {baud}; it must be positive")
        self._emulator, self._plant, self._faults = emulator, plant, faults
        self._advance, self._watch = advance, watch
        self._bytes_per_tick = baud / _BITS_PER_BYTE * TICK_S
        self._credit = 0.0
        self._ticks = 0
        self._to_board, self._to_host = bytearray(), bytearray()
        self._overrun, self._restart = False, 0
        self._duty: Array = np.zeros(JOINTS)
        self._awake, self._braked = False, True
        self._closed = False
        self._reply = bytes(ANSWER.itemsize)
        #: Whether the sync LED is on in the millisecond that each tick begins; tick 0 is before the first.
        self.sync_led = bytearray(1)

    @property
    def answer(self) -> Any:  # noqa: ANN401 - a structured scalar
        """The newest answer of the firmware (``pil_answer``): its whole output, not only what the wire carries."""
        return np.frombuffer(self._reply, ANSWER)[0]

    @property
    def t_s(self) -> float:
        """How much time has passed, s."""
        return self._ticks * TICK_S

    def write(self, data: bytes) -> None:
        """Send bytes; they arrive with the next ticks."""
        self._check_open()
        self._to_board += data

    def read(self, wait_s: float = 0.0) -> bytes:
        """Let ``wait_s`` pass, to the nearest tick, and return what came meanwhile and before."""
        self._check_open()
        if self._advance is None:
            self.step(round(wait_s / TICK_S))
        elif wait_s > 0:
            self._advance(wait_s)
        data = bytes(self._to_host)
        self._to_host.clear()
        return data

    def step(self, ticks: int = 1) -> None:
        """Run the board and the plant for so many milliseconds."""
        self._check_open()
        for _ in range(ticks):
            self._tick()

    def overrun(self) -> None:
        """Report to the board that its last tick took longer than its period."""
        self._overrun = True

    def restart(self, *, watchdog: bool = False) -> None:
        """Restart the board with the next tick, as after a power cut or by its watchdog; what it stored stays."""
        self._restart = RESTART_WATCHDOG if watchdog else RESTART_POWER
        self._to_board.clear()

    def miss(self, ticks: int) -> None:
        """Let time pass in which the board does not run: the last duties stay on, and what is sent to it is lost."""
        for _ in range(ticks):
            self._ticks += 1
            self.sync_led.append(self.sync_led[-1])
            self._arriving()
            self._plant.sense()
            self._plant.step(self._duty, self._awake, self._braked)

    def close(self) -> None:
        """End the emulation."""
        if not self._closed:
            self._closed = True
            self._emulator.close()

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceError("the emulated board is closed")

    def _arriving(self) -> bytes:
        self._credit += self._bytes_per_tick
        if not self._to_board:
            self._credit = 0.0
            return b""
        count = min(int(self._credit), len(self._to_board), WIRE_BYTES)
        self._credit -= count
        data = bytes(self._to_board[:count])
        del self._to_board[:count]
        return data if self._faults is None else self._faults.to_board(self._ticks, data)[:WIRE_BYTES]

    def _request(self) -> bytes:
        sensed, data = self._plant.sense(), self._arriving()
        request = REQUEST_FIELDS.pack(
            REQUEST_MAGIC,
            VERSION,
            self._ticks % WRAP,
            self._restart,
            self._overrun,
            bool(sensed.stop_pressed),
            int(sensed.supply_mv),
            *sensed.counts.tolist(),
            *sensed.current_ma.tolist(),
            len(data),
            data,
        )
        self._overrun, self._restart = False, 0
        return request

    def _tick(self) -> None:
        self._ticks += 1
        reply = self._emulator.tick(self._request())
        fields = ANSWER_FIELDS.unpack_from(reply) if len(reply) == ANSWER.itemsize else (0,) * 8
        magic, version, tick, drives_on, shorted, brakes_open, led, length = fields
        if magic != ANSWER_MAGIC or version != VERSION or tick != self._ticks % WRAP:
            raise DeviceError(
                f"the emulated board did not answer tick {self._ticks} with a frame of version {VERSION}: its image and"
                " this armsight do not belong together; build it anew with `armsight board build`"
            )
        self._reply = reply
        if self._watch is not None:
            self._watch(reply)
        self.sync_led.append(1 if led else 0)
        self._duty = np.frombuffer(reply, _FLOAT, JOINTS, DUTY_AT)
        self._awake, self._braked = bool(drives_on or shorted), not brakes_open
        self._plant.step(self._duty, self._awake, self._braked)
        if length:
            said = reply[BYTES_AT : BYTES_AT + length]
            self._to_host += said if self._faults is None else self._faults.to_host(self._ticks, said)
