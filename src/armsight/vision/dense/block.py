"""Local matching over square windows: the least cost summed over a window, winner takes all.

A byte per pixel and disparity holds the cost of a match: twice the number of bits in which two census words of eight
neighbours differ (Zabih and Woodfill, ECCV 1994; every other pixel of a 5 x 5 window), and half of the absolute difference
of the grey levels, cut off: the order of grey levels is robust to light, their values help where the order is ambiguous
(Mei et al., "On building an accurate stereo matching system on graphics hardware", 2011). Costs are summed along the row,
and then by a running sum down the columns, so that the work for a pixel does not grow with the window's height. Pixels of a
row lie side by side, and the loop over disparities is outside: the least so far, of the left pixel and of the right one,
needs no search across a vector. No cost volume is kept, only the sums of as many rows as the window is high.

First the planes of a pair and the compiled kernels, then the method :class:`Block`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from armsight.data import Image
from armsight.kernels import kernel, kernel_types
from armsight.vision.dense.cost import CENSUS_REACH, Bytes, census
from armsight.vision.dense.method import Disparity, Search
from armsight.vision.dense.postprocess import SigmaModel, finished
from armsight.vision.dense.winner import NOWHERE, Counts, Winners, for_each_strip, make_winners

ONE, TWO, THREE, SIX = (np.uintp(n) for n in (1, 2, 3, 6))
#: Rows are filled to whole vectors of the processor, so that no pixel is left to be done alone.
_VECTOR = 32
#: Beyond this many grey levels the difference is cut off; cost of a match beyond the right image's edge: about that of
#: an ambiguous pixel.
_CUT, _OUTSIDE = np.uint8(20), np.uint8(10)
#: Pixels of a window to either side of its middle; half: noisy; double: breaks are blurred, and sums along a row no longer
#: fit a byte.
REACH = 4


@kernel_types("u1[::1], u1[::1], u1[::1], u1[::1], u8, u8")
class PairPlanes(NamedTuple):
    """A pair as the costs need it, grey levels and census words: rows of bytes, widened so that all windows lie inside."""

    left: Bytes
    left_census: Bytes
    right: Bytes
    right_census: Bytes
    left_stride: np.uintp
    right_stride: np.uintp


def prepare_planes(left: Image, right: Image, further: int) -> PairPlanes:
    """Compute the planes of both images (H, W) of a pair; matches lie less than ``further`` to the left in the right."""

    def widened(image: Image, before: int) -> Bytes:
        return np.asarray(
            cv2.copyMakeBorder(image, REACH, REACH, before + REACH, REACH + 2 * _VECTOR, cv2.BORDER_REPLICATE)
        )

    def words(image: Image) -> Bytes:
        out = np.zeros((1, *image.shape), np.uint8)
        census(np.pad(image, CENSUS_REACH, mode="edge"), 2, out)
        return np.asarray(out[0])

    planes = (widened(left, 0), widened(words(left), 0), widened(right, further), widened(words(right), further))
    a, b, c, d = (plane.reshape(-1) for plane in planes)
    return PairPlanes(a, b, c, d, np.uintp(planes[0].shape[1]), np.uintp(planes[2].shape[1]))


@kernel(inline="always")
def _bits_set(x: np.uint8) -> np.uint8:
    """Count the bits that are set in a byte: sums of neighbours (Warren, "Hacker's Delight", 5-1)."""
    x = np.uint8(x - ((x >> np.uint8(1)) & np.uint8(0x55)))
    x = np.uint8((x & np.uint8(0x33)) + ((x >> np.uint8(2)) & np.uint8(0x33)))
    return np.uint8((x + (x >> np.uint8(4))) & np.uint8(0x0F))


class StripBuffers(NamedTuple):
    """The buffers of a strip."""

    raw: Bytes  #: one row's costs at one disparity, with the windows' reach to either side
    threes: Bytes  #: sums of three of them, from each on: windows are made of these
    along: Bytes  #: (T,) sums along the row
    #: sums along rows: as many rows as a window is high, each (count, T), the oldest replaced by the newest
    kept: Bytes
    total: Counts  #: (count, T) sums over windows
    least: Counts  #: (T,) least total of each left pixel so far
    where: Counts  #: (T,) and at which disparity, from the search's first on
    right: Counts  #: (T + pad,) least total of each right pixel so far; pixel u is at u + pad


def make_buffers(width: int, further: int, count: int) -> StripBuffers:
    """Return buffers for strips of images of a width."""
    wide = -(-width // _VECTOR) * _VECTOR
    return StripBuffers(
        np.zeros(wide + 2 * REACH + 2 * _VECTOR, np.uint8),
        np.zeros(wide + 2 * REACH + 2 * _VECTOR, np.uint8),
        np.zeros(wide, np.uint8),
        np.zeros((2 * REACH + 1) * count * wide, np.uint8),
        np.zeros(count * wide, np.uint16),
        np.zeros(wide, np.uint16),
        np.zeros(wide, np.uint16),
        np.zeros(wide + further, np.uint16),
    )


@kernel(nogil=True)
def _cost_row(planes: PairPlanes, row: int, d: int, pad: int, width: int, raw: Bytes) -> None:
    """Write the costs of a row at disparity d, from REACH pixels before it to as many after it."""
    size = (width + 2 * REACH + _VECTOR - 1) // _VECTOR * _VECTOR
    left, right = row * np.int64(planes.left_stride), row * np.int64(planes.right_stride) + pad - d
    grey, word = planes.left[left : left + size], planes.left_census[left : left + size]
    r_grey, r_word = planes.right[right : right + size], planes.right_census[right : right + size]
    for j in range(np.uintp(size)):
        apart = np.uint8(max(grey[j], r_grey[j]) - min(grey[j], r_grey[j]))
        bits = _bits_set(np.uint8(word[j] ^ r_word[j]))
        raw[j] = np.uint8(np.uint8(bits + bits) + (min(apart, _CUT) >> np.uint8(1)))
    raw[: min(d, width) + REACH] = _OUTSIDE if d > 0 else raw[REACH]
    raw[width + REACH : width + 2 * REACH] = raw[width + REACH - 1]


@kernel(nogil=True)
def _sum_along(raw: Bytes, threes: Bytes, along: Bytes) -> None:
    """Write sums over the nine pixels of a window along a row; they fit a byte."""
    size = np.uintp(len(along))
    for x in range(size + np.uintp(2 * REACH)):
        threes[x] = np.uint8(np.uint8(raw[x] + raw[x + ONE]) + raw[x + TWO])
    for x in range(size):
        along[x] = threes[x] + threes[x + THREE] + threes[x + SIX]


@kernel(nogil=True)
def _add_row(
    planes: PairPlanes, row: int, choose: bool, first: int, count: int, width: int, pad: int, buffers: StripBuffers
) -> None:
    """Move the windows down by a row of the widened images; with ``choose`` find the least totals.

    Pixels from which a disparity leads out of the right image do not choose it, nor do columns beyond the left one's end.
    """
    stride, along = len(buffers.least), buffers.along
    slot = row % (2 * REACH + 1) * count * stride
    for k in range(count):
        d = first + k
        _cost_row(planes, row, d, pad, width, buffers.raw)
        _sum_along(buffers.raw, buffers.threes, along)
        total, kept = buffers.total[k * stride :], buffers.kept[slot + k * stride :]
        for x in range(np.uintp(stride)):
            total[x] = np.uint16(total[x] + np.uint16(np.uint16(along[x]) - np.uint16(kept[x])))
        for x in range(np.uintp(stride)):
            kept[x] = along[x]
        if choose:
            here, right = np.uint16(k), buffers.right[pad - d :]
            least, where = buffers.least, buffers.where
            for x in range(np.uintp(d), np.uintp(width)):
                before, t = where[x], total[x]
                where[x] = here if t < least[x] else before
            for x in range(np.uintp(d), np.uintp(width)):
                least[x] = min(total[x], least[x])
                right[x] = min(total[x], right[x])


@kernel(nogil=True)
def _write_row(y: int, first: int, count: int, pad: int, buffers: StripBuffers, found: Winners) -> None:
    """Write the winners of row y: sub-pixel disparities, curvatures, and whether the right image agrees."""
    stride, total = np.uintp(buffers.least.shape[0]), buffers.total
    width = found.disparity.shape[1]
    for x in range(min(first, width)):  # nothing of the search lies in the right image
        found.disparity[y, x], found.agreed[y, x], found.curvature[y, x] = first, False, 0
    for x in range(first, width):
        k, reached = np.uintp(buffers.where[x]), np.uintp(min(x - first + 1, count))
        at = k * stride + np.uintp(x)
        around = total[at]
        low, offset, curvature = np.float32(around), np.float32(0), np.float32(0)
        if k > 0:
            around = min(around, total[at - stride - ONE])
            if k + ONE < reached:
                below, beyond = np.float32(total[at - stride]) - low, np.float32(total[at + stride]) - low
                curvature = below + beyond
                if curvature > 0:  # two lines of equal slope, not a parabola: these are sums of absolute differences
                    offset = np.float32(0.5) * (below - beyond) / max(below, beyond)
        if k + ONE < np.uintp(count) and x + 1 < width:
            around = min(around, total[at + stride + ONE])
        found.disparity[y, x] = np.float32(first) + np.float32(k) + offset
        found.least[y, x], found.curvature[y, x] = low, curvature
        found.agreed[y, x] = around <= buffers.right[np.uintp(x - first + pad) - k]


@kernel(
    "PairPlanes, i8, i8, i8, i8, i8, "
    "StripBuffers(u1[::1], u1[::1], u1[::1], u1[::1], u2[::1], u2[::1], u2[::1], u2[::1]), Winners",
    nogil=True,
)
def match_windows(
    planes: PairPlanes, begin: int, end: int, first: int, count: int, pad: int, buffers: StripBuffers, found: Winners
) -> None:
    """Choose the disparities of the rows from ``begin`` to ``end`` by the least sum over a window."""
    width = found.disparity.shape[1]
    buffers.kept[:] = 0
    buffers.total[:] = 0
    for row in range(begin, end + 2 * REACH):
        y = row - 2 * REACH  # the row whose window this one completes
        buffers.least[:] = NOWHERE
        buffers.right[:] = NOWHERE
        _add_row(planes, row, y >= begin, first, count, width, pad, buffers)
        if y >= begin:
            _write_row(y, first, count, pad, buffers, found)


#: See postprocess.py.
_SIGMA_MODEL = SigmaModel(0.17, 0.09)


@dataclass(frozen=True)
class Block:
    """Local matching over windows of 9 x 9 pixels."""

    def match(self, left: Image, right: Image, search: Search) -> Disparity:
        """Match a pair; see :class:`~armsight.vision.dense.method.Method`."""
        return finished(self.search(left, right, search), left, search, _SIGMA_MODEL)

    def search(self, left: Image, right: Image, search: Search) -> Winners:
        """Find disparities, without rejecting, smoothing or filling any."""
        pad = search.last + 1
        planes, found = prepare_planes(left, right, pad), make_winners(*left.shape)

        def work(begin: int, end: int) -> None:
            buffers = make_buffers(left.shape[1], pad, search.count)
            match_windows(planes, begin, end, search.first, search.count, pad, buffers, found)

        for_each_strip(left.shape[0], work)
        return found
