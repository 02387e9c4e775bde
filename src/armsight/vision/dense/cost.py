"""Matching costs of two pixels: census and Birchfield and Tomasi's dissimilarity, a row at a time.

A pair goes in; one byte comes out for every pixel of a row and every disparity, the disparities of a pixel side by
side. The right image's rows are kept mirrored: the pixels that a left pixel is compared with, one further left for each
step in disparity, then follow one another in memory, and the compiler uses vectors.

Zabih and Woodfill, "Non-parametric local transforms for computing visual correspondence", ECCV 1994; Birchfield and
Tomasi, "A pixel dissimilarity measure that is insensitive to image sampling", PAMI 20(4), 1998.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.kernels import kernel, kernel_types

Bytes = NDArray[np.uint8]
ONE, TWO = np.uintp(1), np.uintp(2)
#: Disparities are processed in blocks of so many, the width of a vector; a search is padded to whole blocks.
BLOCK = np.uintp(64)
#: The census window is 5 x 5 pixels: 24 bits, one for each neighbour that is darker than the middle.
CENSUS_REACH = 2
#: Beyond this many grey levels the difference is cut off: a glint must not cost more than a wrong surface.
_BT_CUT = np.uint8(20)
#: Cost of a match beyond the right image's edge, where nothing can be compared: about that of an undecided pixel.
_OUTSIDE = np.uint8(13)
#: The largest raw cost: 24 bits and half of the cut; smoothing adds three rows.
_RAW_MAX = np.uint8(34)


@kernel_types("u1[:, ::1], u1[:, ::1], u1[:, ::1], u1[:, :, ::1], u1[:, ::1], u1[:, ::1], u1[:, ::1], u1[:, :, ::1]")
class CensusPair(NamedTuple):
    """A pair as the costs need it; the planes of the right image are mirrored and padded by the search."""

    left: Bytes  #: (H, W) grey
    left_low: Bytes  #: (H, W) least grey level within half a pixel to either side
    left_high: Bytes  #: (H, W) greatest
    left_census: Bytes  #: (3, H, W) census words, byte by byte
    right: Bytes  #: (H, W + pad) grey, mirrored
    right_low: Bytes  #: (H, W + pad) mirrored
    right_high: Bytes  #: (H, W + pad) mirrored
    right_census: Bytes  #: (3, H, W + pad) mirrored


_TWO, _FOUR = np.uint8(2), np.uint8(4)
_ODD, _PAIRS, _NIBBLE = np.uint8(0x55), np.uint8(0x33), np.uint8(0x0F)


@kernel(inline="always")
def _bits_set(a: np.uint8, b: np.uint8, c: np.uint8) -> np.uint8:
    """Count the bits set in three bytes: a full adder, then sums of neighbours (Warren, "Hacker's Delight", 5-1)."""
    odd = np.uint8(a ^ b)
    ones, twos = np.uint8(odd ^ c), np.uint8((a & b) | (odd & c))
    ones = np.uint8(ones - ((ones >> np.uint8(1)) & _ODD))
    twos = np.uint8(twos - ((twos >> np.uint8(1)) & _ODD))
    ones = np.uint8((ones & _PAIRS) + ((ones >> _TWO) & _PAIRS))
    twos = np.uint8((twos & _PAIRS) + ((twos >> _TWO) & _PAIRS))
    both = np.uint8(ones + np.uint8(twos + twos))
    return np.uint8((both & _NIBBLE) + (both >> _FOUR))


@kernel("u1[:, ::1], i8, u1[:, :, ::1]", nogil=True)
def census(padded: Bytes, step: int, out: Bytes) -> None:
    """Write the census words (N, H, W), by bytes, of an image that is padded by the window's reach on every side.

    Of the window every pixel counts (N = 3), or with a ``step`` of 2 every other one (N = 1).
    """
    _, height, width = out.shape
    for y in range(height):
        middle, bit = padded[y + CENSUS_REACH], 0
        for j in range(0, 2 * CENSUS_REACH + 1, step):
            other = padded[y + j]
            for i in range(0, 2 * CENSUS_REACH + 1, step):
                if i == CENSUS_REACH and j == CENSUS_REACH:
                    continue
                row = out[bit >> 3, y]
                for x in range(np.uintp(width)):
                    row[x] = (row[x] << np.uint8(1)) | np.uint8(other[x + np.uintp(i)] < middle[x + TWO])
                bit += 1


@kernel("u1[:, ::1], u1[:, ::1], u1[:, ::1]", nogil=True)
def _half_way(padded: Bytes, low: Bytes, high: Bytes) -> None:
    """Write the extreme grey levels (H, W) within half a pixel to either side, by linear interpolation."""
    height, width = low.shape
    for y in range(height):
        row = padded[y + CENSUS_REACH]
        for x in range(width):
            c = np.uint16(row[x + 2])
            a = np.uint16(c + row[x + 1]) >> np.uint16(1)
            b = np.uint16(c + row[x + 3]) >> np.uint16(1)
            low[y, x] = min(c, min(a, b))
            high[y, x] = max(c, max(a, b))


def _census_planes(image: Image) -> tuple[Bytes, Bytes, Bytes, Bytes]:
    """Return an image (H, W), its least and greatest levels half way to the neighbours, and its census words."""
    reach = CENSUS_REACH
    padded = np.pad(image, reach, mode="edge")
    low, high = np.empty(image.shape, np.uint8), np.empty(image.shape, np.uint8)
    words = np.zeros((3, *image.shape), np.uint8)
    _half_way(padded, low, high)
    census(padded, 1, words)
    return np.ascontiguousarray(padded[reach:-reach, reach:-reach]), low, high, words


def prepare(left: Image, right: Image, pad: int) -> CensusPair:
    """Compute the planes of both images (H, W) of a pair; ``pad``: first disparity of the search and how many there are."""

    def mirrored(a: Bytes) -> Bytes:
        out = np.zeros((*a.shape[:-1], a.shape[-1] + pad), np.uint8)
        out[..., : a.shape[-1]] = a[..., ::-1]
        return out

    return CensusPair(*_census_planes(left), *(mirrored(a) for a in _census_planes(right)))


@kernel(nogil=True, inline="always")
def _above(a: np.uint8, b: np.uint8) -> np.uint8:
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
    right, low, high = pair.right[y], pair.right_low[y], pair.right_high[y]
    one, two, three = pair.right_census[0, y], pair.right_census[1, y], pair.right_census[2, y]
    for x in range(width):
        g, g_low, g_high = pair.left[y, x], pair.left_low[y, x], pair.left_high[y, x]
        a, b, c = pair.left_census[0, y, x], pair.left_census[1, y, x], pair.left_census[2, y, x]
        inside = np.uintp(min(max(x - first + 1, 0), count))
        o, k = base + np.uintp(x) * size, np.uintp(width - 1 - x + first)
        for block in range(np.uintp(0), inside, BLOCK):  # what is beyond the image is written anew
            for e in range(BLOCK):  # a fixed count: unrolled into whole vectors
                d = block + e
                bits = _bits_set(np.uint8(a ^ one[k + d]), np.uint8(b ^ two[k + d]), np.uint8(c ^ three[k + d]))
                out[o + d] = np.uint8(bits + _bt(g, g_low, g_high, right[k + d], low[k + d], high[k + d]))
        for d in range(inside, np.uintp(count)):
            out[o + d] = _OUTSIDE
        for d in range(np.uintp(count), size):
            out[o + d] = _RAW_MAX


@kernel(nogil=True)
def _add_rows(raw: Bytes, above: np.uintp, at: np.uintp, below: np.uintp, out: Bytes) -> None:
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
