"""The contract of a link: bytes to a board and back. To add one: one file with a class that fulfils :class:`Link`."""

from __future__ import annotations

from typing import Protocol


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
        """Let go of the device; harmless when called twice."""
        ...
