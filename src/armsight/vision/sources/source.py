"""The contract of a source: it returns one :class:`~armsight.data.Shot` after another.

To add a kind of source: write one file with a class that fulfils :class:`Source`, and add one line to the registry in
``__init__.py``.
"""

from __future__ import annotations

from typing import Protocol

from armsight.data import Shot


class Source(Protocol):
    """Two cameras, or a recording of them."""

    @property
    def count(self) -> int | None:
        """How many shots there are in all; None where that is not known, as of live cameras."""
        ...

    def read(self) -> Shot | None:
        """Return the next shot, or None at the end.

        A shot that was taken and cannot be used (a truncated file, a frame that did not decode) is a Shot with a
        ``problem``; a device that is gone raises :class:`~armsight.errors.DeviceError`.
        """
        ...

    def close(self) -> None:
        """Release files and devices; a second call has no effect."""
        ...
