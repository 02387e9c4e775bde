"""The contract of a link: bytes to a board and back. To add one: one file with a class that fulfils :class:`Link`.

The contracts on the far side of an emulated board: the :class:`Emulator` that runs the firmware, and the :class:`Plant`,
the arm that the board drives.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array

TICK_S = 1e-3  # of a board's control loop, which the firmware fixes


class Sensed(NamedTuple):
    """What a board's converters read at the beginning of a tick; a tuple, as one is made every millisecond."""

    counts: NDArray[np.uint32]  #: (6,) potentiometers, 16-bit fractions of their supply, uint32
    current_ma: NDArray[np.int32]  #: (6,) motor currents, mA, positive where a positive duty drives them, int32
    supply_mv: int = 24000  #: motor supply, mV
    stop_pressed: bool = False  #: whether the emergency stop button is pressed


class Plant(Protocol):
    """The arm at a board's motors: duties go in, readings come out. Steps are 1 ms."""

    def sense(self) -> Sensed:
        """Return what the converters read now."""
        ...

    def step(self, duty: Array, awake: bool, braked: bool = False) -> None:
        """Let 1 ms pass with these duties (6,), -1 to 1, held.

        ``duty``: zeros brake the motors, by their own windings; ``awake``: False: the drivers are switched off, and the
        motors' circuits are open; ``braked``: whether the board closes the brakes, where there are any.
        """
        ...


class Emulator(Protocol):
    """Runs the firmware's ``pil`` board in lock-step: one frame in, one tick, one frame out."""

    def tick(self, request: bytes) -> bytes:
        """Run one tick on a request frame (``pil_request``) and return the answer frame (``pil_answer``)."""
        ...

    def close(self) -> None:
        """End the emulation; harmless when called twice."""
        ...


class Link(Protocol):
    """The wire to a board, a real one or an emulated one."""

    def write(self, data: bytes) -> None:
        """Send bytes; returns at once. Raises :class:`~armsight.errors.DeviceError` where the board is gone."""
        ...

    def read(self, wait_s: float = 0.0) -> bytes:
        """Return what has come, after waiting ``wait_s``.

        Real boards: real time passes. Emulated ones: the board and everything around it run on by as much; this is the
        only way their time passes. Raises :class:`~armsight.errors.DeviceError` where the board is gone.
        """
        ...

    def close(self) -> None:
        """Close the device; harmless when called twice."""
        ...
