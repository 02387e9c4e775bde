"""The contract of a source: it returns one :class:`~armsight.data.Shot` after another.

To add a kind of source: write one file with a class that derives from :class:`Source`, and add one line to the registry in
``sources/__init__.py``.
"""

from __future__ import annotations

import contextlib
import itertools
import threading
from collections.abc import Callable, Generator, Iterator
from typing import Protocol, Self

from armsight.data import Shot
from armsight.vision.image import DEPTH_IMAGES, BitDepth, images_of

#: A shot that is younger by its own stamp was stamped by a live camera, s; half: a slow start passes for a recording,
#: double: a recording that was just made passes for live.
LIVE_S = 10.0


class Source(Protocol):
    """Two cameras, or a recording of them.

    Derive from this class to inherit what goes around ``count``, ``read`` and ``close``: ``for shot in source``,
    ``len(source)``, and ``with``, which closes it.
    """

    #: whether it is a recording whose shots have times
    timed: bool = False

    @property
    def count(self) -> int | None:
        """How many shots there are in all; None where that is not known, as of live cameras."""

    def read(self) -> Shot | None:
        """Return the next shot, or None at the end.

        A shot that was taken and cannot be used (a truncated file, a frame that did not decode) is a Shot with a
        ``problem``; a device that is gone raises :class:`~armsight.errors.DeviceError`.
        """

    def close(self) -> None:
        """Release files and devices; a second call has no effect."""

    def __iter__(self) -> Iterator[Shot]:
        """Read the shots that are left, one after another; a folder of images begins anew each time."""
        while (shot := self.read()) is not None:
            yield shot

    def __len__(self) -> int:
        """Return how many shots there are in all; a TypeError where that is not known."""
        if self.count is None:
            raise TypeError("how many shots a video or live cameras have is not known before they end")
        return self.count

    def __repr__(self) -> str:
        """Return its kind, and how many shots it has."""
        return f"{type(self).__name__}({self.count} shots)" if self.count is not None else f"{type(self).__name__}()"

    def __bool__(self) -> bool:
        """Return True: a source without a shot, or of unknown length, is a source."""
        return True

    def __enter__(self) -> Self:
        """Return the source; ``with`` closes it at its end."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Close it."""
        self.close()


#: Bytes. Once a block of so many was freed, glibc gives none of its size or less back to the system at once, and new images
#: take old ones' memory: new pages take longer than to read them. Half, double: the same up to 4 Mpx in colour.
_REUSED = 16_000_000


class PlayedSource(Source):
    """A recording of ``count`` shots; ``shots`` reads every so many of them. Its 16-bit images have one depth."""

    count: int | None = None
    timed = True

    def __init__(
        self,
        shots: Callable[[int], Generator[Shot]],
        count: int,
        notes: tuple[str, ...] = (),
        depth: BitDepth | None = None,
    ) -> None:
        bytes(_REUSED)
        self.count, self._notes, self._shots, self._done = count, notes, shots, 0
        self._left, self._reading, self._closed = self._rest(), threading.Lock(), False
        every = max(1, -(-2 * count // DEPTH_IMAGES))  # from its whole length: it may begin in the dark
        self._depth = depth or BitDepth(lambda: images_of(shots(every)))

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out, or is odd, a line each."""
        return self._notes + self._depth.notes

    def _rest(self) -> Generator[Shot]:
        """Yield the shots that were not returned yet."""
        with contextlib.closing(self._shots(1)) as shots:
            yield from itertools.islice(shots, self._done, None)

    def read(self) -> Shot | None:
        """Return the next shot, or None at the end; one whose reading was interrupted is read by the next call."""
        with self._reading:
            try:
                shot = None if self._closed else next(self._left, None)
                shot = None if shot is None else self._depth.shot(shot)
            except KeyboardInterrupt:  # it has ended the generator
                self._left = self._rest()
                raise
            self._done += 1
        if self._closed:
            self.close()
        return shot

    def close(self) -> None:
        """Hand out no more shots, and close what is open; where another thread reads, its shot is the last."""
        self._closed = True
        if self._reading.acquire(blocking=False):
            try:
                self._left.close()
            finally:
                self._reading.release()
