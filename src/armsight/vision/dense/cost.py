"""Matching costs of two pixels: census and Birchfield and Tomasi's dissimilarity, a row at a time.

A pair goes in; one byte comes out for every pixel of a row and every disparity, the disparities of a pixel side by
side. The right image's rows are kept mirrored: the pixels that a left pixel is compared with, one further left for each
step in disparity, then follow one another in memory, and the compiler uses vectors.

Zabih and Woodfill, "Non-parametric local transforms for computing visual correspondence", ECCV 1994; Birchfield and
Tomasi, "A pixel dissimilarity measure that is insensitive to image sampling", PAMI 20(4), 1998.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.kernels import kernel, kernel_types

Bytes = NDArray[np.uint8]
Words32 = NDArray[np.uint32]
ONE, TWO = np.uintp(1), np.uintp(2)
#: Disparities are processed in blocks of so many, the width of a vector; a search is padded to whole blocks.
BLOCK = np.uintp(64)
#: The census window is 5 x 5 pixels: 24 bits, one for each neighbour that is darker than the middle.
_CENSUS_REACH = 2
#: Beyond this many grey levels the difference is cut off: a glint must not cost more than a wrong surface.
_BT_CUT = np.uint8(20)
#: Cost of a match beyond the right image's edge, where nothing can be compared: about that of an undecided pixel.
_OUTSIDE = np.uint8(13)
#: The largest raw cost: 24 bits and half of the cut; smoothing adds three rows.
_RAW_MAX = np.uint8(34)


@kernel_types("u1[:, ::1], u1[:, ::1], u1[:, ::1], u4[:, ::1], u1[:, ::1], u1[:, ::1], u1[:, ::1], u4[:, ::1]")
class CensusPair(NamedTuple):
    """A pair as the costs need it; the planes of the right image are mirrored and padded by the search."""

    left: Bytes  #: (H, W) grey
    left_low: Bytes  #: (H, W) least grey level within half a pixel to either side
    left_high: Bytes  #: (H, W) greatest
    left_census: Words32  #: (H, W) census words
    right: Bytes  #: (H, W + pad) grey, mirrored
    right_low: Bytes  #: (H, W + pad) mirrored
    right_high: Bytes  #: (H, W + pad) mirrored
    right_census: Words32  #: (H, W + pad) mirrored


_ODD, _PAIRS, _NIBBLES, _BYTES = (np.uint32(x) for x in (0x55555555, 0x33333333, 0x0F0F0F0F, 0x01010101))


@kernel(inline="always")
def popcount(x: np.uint32) -> np.uint32:
    """Count the bits that are set: sums of neighbours (Warren, "Hacker's Delight", 5-1); LLVM makes it one instruction."""
    x = x - ((x >> np.uint32(1)) & _ODD)
    x = (x & _PAIRS) + ((x >> np.uint32(2)) & _PAIRS)
    x = (x + (x >> np.uint32(4))) & _NIBBLES
    return (x * _BYTES) >> np.uint32(24)


@kernel("u1[:, ::1], u4[:, ::1]", nogil=True)
def _census(padded: Bytes, out: Words32) -> None:
    """Write the census words (H, W) of an image that is padded by the window's reach on every side."""
    height, width = out.shape
    for y in range(height):
        row = out[y]
        middle = padded[y + _CENSUS_REACH]
        for j in range(2 * _CENSUS_REACH + 1):
            other = padded[y + j]
            for i in range(2 * _CENSUS_REACH + 1):
                if i == _CENSUS_REACH and j == _CENSUS_REACH:
                    continue
                for x in range(width):
                    row[x] = (row[x] << np.uint32(1)) | np.uint32(other[x + i] < middle[x + _CENSUS_REACH])


@kernel("u1[:, ::1], u1[:, ::1], u1[:, ::1]", nogil=True)
def _half_way(padded: Bytes, low: Bytes, high: Bytes) -> None:
    """Write the extreme grey levels (H, W) within half a pixel to either side, by linear interpolation."""
    height, width = low.shape
    for y in range(height):
        row = padded[y + _CENSUS_REACH]
        for x in range(width):
            c = np.uint16(row[x + 2])
            a = np.uint16(c + row[x + 1]) >> np.uint16(1)
            b = np.uint16(c + row[x + 3]) >> np.uint16(1)
            low[y, x] = min(c, min(a, b))
            high[y, x] = max(c, max(a, b))


def _census_planes(image: Image) -> tuple[Bytes, Bytes, Bytes, Words32]:
    """Return an image (H, W), its least and greatest levels half way to the neighbours, and its census words."""
    reach = _CENSUS_REACH
    padded = np.pad(image, reach, mode="edge")
    low, high, words = (
        np.empty(image.shape, np.uint8),
        np.empty(image.shape, np.uint8),
        np.zeros(image.shape, np.uint32),
    )
    _half_way(padded, low, high)
    _census(padded, words)
    return np.ascontiguousarray(padded[reach:-reach, reach:-reach]), low, high, words


def prepare(left: Image, right: Image, pad: int) -> CensusPair:
    """Compute the planes of both images (H, W) of a pair; ``pad``: first disparity of the search and how many there are."""

    def mirrored(a: NDArray[Any]) -> NDArray[Any]:
        out = np.zeros((a.shape[0], a.shape[1] + pad), a.dtype)
        out[:, : a.shape[1]] = a[:, ::-1]
        return out

    return CensusPair(*_census_planes(left), *(mirrored(a) for a in _census_planes(right)))


@kernel(nogil=True, inline="always")
def _above(a: np.uint8, b: np.uint8) -> np.uint8:
    """Return a - b where that is above zero, else zero."""
    return np.uint8(max(a, b) - b)


@kernel(nogil=True, inline="always")
def _bt(g: np.uint8, g_low: np.uint8, g_high: np.uint8, r: np.uint8, r_low: np.uint8, r_high: np.uint8) -> np.uint8:
    """Return half of Birchfield and Tomasi's dissimilarity (their equation 3) of two pixels, cut off."""
    to_left = max(_above(g, r_high), _above(r_low, g))
    to_right = max(_above(r, g_high), _above(g_low, r))
    return np.uint8(min(min(to_left, to_right), _BT_CUT) >> np.uint8(1))


@kernel(nogil=True)
def raw_row(pair: CensusPair, y: int, first: int, count: int, size: np.uintp, out: Bytes, base: np.uintp) -> None:
    """Write the raw costs of one row into ``out`` from ``base`` on: W times ``size`` bytes.

    Census distance plus half of Birchfield and Tomasi's dissimilarity, cut off; disparities from ``count`` on cost the
    most.
    """
    width = pair.left.shape[1]
    words, right, low, high = pair.right_census[y], pair.right[y], pair.right_low[y], pair.right_high[y]
    for x in range(width):
        word, g, g_low, g_high = pair.left_census[y, x], pair.left[y, x], pair.left_low[y, x], pair.left_high[y, x]
        inside = np.uintp(min(max(x - first + 1, 0), count))
        o, k = base + np.uintp(x) * size, np.uintp(width - 1 - x + first)
        whole = inside - inside % BLOCK
        for d in range(inside):
            out[o + d] = np.uint8(popcount(word ^ words[k + d]))
        for block in range(np.uintp(0), whole, BLOCK):
            for e in range(BLOCK):  # a fixed count: unrolled into whole vectors
                d = block + e
                out[o + d] += _bt(g, g_low, g_high, right[k + d], low[k + d], high[k + d])
        for d in range(whole, inside):
            out[o + d] += _bt(g, g_low, g_high, right[k + d], low[k + d], high[k + d])
        for d in range(inside, np.uintp(count)):
            out[o + d] = _OUTSIDE
        for d in range(np.uintp(count), size):
            out[o + d] = _RAW_MAX


@kernel(nogil=True)
def _add_rows(raw: Bytes, above: np.uintp, at: np.uintp, below: np.uintp, out: Bytes) -> None:
    """Add three rows of raw costs."""
    for i in range(np.uintp(out.shape[0])):
        out[i] = np.uint8(np.uint8(raw[above + i] + raw[at + i]) + raw[below + i])


@kernel(nogil=True, inline="always")
def _mean(a: np.uint8, b: np.uint8) -> np.uint8:
    """Return the mean, rounded up: one instruction."""
    return np.uint8((np.uint16(a) + np.uint16(b) + np.uint16(1)) >> np.uint16(1))


@kernel(nogil=True)
def _blur_along(a: Bytes, size: np.uintp, out: Bytes, base: np.uintp) -> None:
    """Blur a row of costs over three pixels with weights 1 2 1."""
    n = np.uintp(a.shape[0])
    for i in range(size, n - size):
        out[base + i] = _mean(_mean(a[i - size], a[i + size]), a[i])
    for i in range(size):
        last = n - size + i
        out[base + i] = _mean(_mean(a[i], a[i + size]), a[i])
        out[base + last] = _mean(_mean(a[last - size], a[last]), a[last])


@kernel(nogil=True)
def smooth_row(y: int, height: int, size: np.uintp, raw: Bytes, mixed: Bytes, out: Bytes, base: np.uintp) -> None:
    """Write the costs of row y, smoothed over 3 x 3 pixels, into ``out`` from ``base`` on.

    raw (3 * W * size,): of the rows y - 1, y and y + 1, each at its number modulo 3; mixed (W * size,): scratch.
    """
    n = np.uintp(mixed.shape[0])
    above, below = max(y - 1, 0) % 3, min(y + 1, height - 1) % 3
    _add_rows(raw, np.uintp(above) * n, np.uintp(y % 3) * n, np.uintp(below) * n, mixed)
    _blur_along(mixed, size, out, base)
