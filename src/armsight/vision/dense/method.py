"""The contract of a dense method: a rectified pair goes in, a disparity for every pixel of the left image comes out.

To add a method: write one file with a class that fulfils :class:`Method`, and add one line to the registry in
``methods.py``. The laws in tests/vision/dense are parametrised over that registry, so the new member inherits them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from armsight.data import Image, Record
from armsight.errors import InputError

#: State of a pixel's disparity: nothing, measured, filled because the right camera cannot see it, or filled because the
#: measurement there was rejected.
NOTHING, MEASURED, OCCLUDED, FILLED = range(4)


@dataclass(frozen=True)
class Search:
    """The range of disparities that are tried."""

    first: int  #: the least, px
    count: int  #: how many, one pixel apart

    def __post_init__(self) -> None:
        """Reject an invalid range."""
        if self.first < 0 or self.count < 2:
            raise InputError(
                f"a search must hold two disparities or more, none below 0 px; got {self.count} from {self.first} px on"
            )

    @property
    def last(self) -> int:
        """The greatest, px."""
        return self.first + self.count - 1


@dataclass(frozen=True, eq=False)
class Disparity(Record):
    """A disparity for every pixel of the left image."""

    #: (H, W) px, column in the left image less column in the right one; filled where it was not measured; NaN
    #: everywhere where nothing at all was
    disparity: NDArray[np.float32]
    state: NDArray[np.uint8]  #: (H, W) NOTHING, MEASURED, OCCLUDED or FILLED
    sigma_px: NDArray[np.float32]  #: (H, W) standard deviation where it was measured; NaN elsewhere
    #: (H, W) of 0 to 1: share of the neighbourhood that measured the same surface; 0 elsewhere
    confidence: NDArray[np.float32]
    search: Search  #: which disparities were tried
    problem: str | None = None  #: why nothing was measured; None where something was

    @property
    def measured(self) -> NDArray[np.bool_]:
        """(H, W) whether a pixel's disparity was measured."""
        return np.asarray(self.state == MEASURED)

    @staticmethod
    def none(shape: tuple[int, int], search: Search, problem: str) -> Disparity:
        """Return an empty result with the reason."""
        empty = np.full(shape, np.nan, np.float32)
        return Disparity(empty, np.zeros(shape, np.uint8), empty, np.zeros(shape, np.float32), search, problem)


class Method(Protocol):
    """A way to find disparities."""

    def match(self, left: Image, right: Image, search: Search) -> Disparity:
        """Match a rectified pair.

        ``left``: (H, W) uint8. ``right``: (H, W) uint8; what is at column u - d in row v here is at column u in row v of
        the left image. ``search``: which disparities to try. Returns a disparity for every pixel, measured or filled. It is
        the same for any number of threads. What cannot be matched is ``Disparity.none(reason)``, never an exception.
        """
        ...
