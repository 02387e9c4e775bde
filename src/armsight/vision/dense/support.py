"""Matching costs and supports that work on one disparity at a time.

A strip of rows and a disparity go in, a plane of costs comes out; a support then gathers each pixel's neighbours.
Planes are rounded to whole numbers and judged as the totals of the other methods are.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.vision.dense.cost import BLOCK, prepare, raw_row
from armsight.vision.dense.method import Search
from armsight.vision.dense.winner import Counts, Found, Singles, choose_row, make_found, on_strips

#: Steps a unit of cost is cut into before it is rounded.
_FINE = 32.0
#: Grey levels beyond which absolute differences are just different.
_SAD_CUT = 40.0
#: The guided filter's regularisation: variance of grey levels that still counts as flat (Hosni et al. use 0.01^2 of
#: full scale), and the step in grey that ends an arm of a shaped window, with the shorter one it keeps anyway.
_FLAT_VARIANCE = (0.01 * 255) ** 2
_ARM_STEP = 15
_STRIP_ROWS = 64


def _shifted(right: Image, d: int) -> Image:
    """Return the right image moved to the right by d; its first column fills the gap."""
    return np.asarray(np.pad(right, ((0, 0), (d, 0)), mode="edge")[:, : right.shape[1]])


def _sad(left: Image, right: Image, d: int, reach: int) -> Singles:
    """Absolute differences, cut off."""
    return np.asarray(np.minimum(cv2.absdiff(left, _shifted(right, d)), _SAD_CUT), np.float32)


def _zncc(left: Image, right: Image, d: int, reach: int) -> Singles:
    """One less the correlation over a window, zero-mean and normalised, times 20; a flat window correlates with nothing."""
    a, b = left.astype(np.float32), _shifted(right, d).astype(np.float32)
    window = (2 * reach + 1, 2 * reach + 1)

    def mean(x: Singles) -> Singles:
        return np.asarray(cv2.blur(x, window, borderType=cv2.BORDER_REPLICATE))

    mean_a, mean_b = mean(a), mean(b)
    variance = np.maximum(mean(a * a) - mean_a**2, 0) * np.maximum(mean(b * b) - mean_b**2, 0)
    r = (mean(a * b) - mean_a * mean_b) / np.sqrt(np.maximum(variance, 1.0))
    return np.asarray(20 * (1 - np.clip(r, -1, 1)), np.float32)


def _census(left: Image, right: Image, d: int, reach: int) -> Singles:
    """Census and Birchfield and Tomasi's dissimilarity, as the fast path has it."""
    pair = prepare(left, right, d + 1)
    out = np.empty((left.shape[0], left.shape[1]), np.uint8)
    for y in range(left.shape[0]):
        raw_row(pair, y, d, 1, np.uintp(1), out[y], np.uintp(0))
    return out.astype(np.float32)


def _box(plane: Singles, guide: Image, reach: int) -> Singles:
    """Mean over a square."""
    return np.asarray(cv2.blur(plane, (2 * reach + 1, 2 * reach + 1), borderType=cv2.BORDER_REPLICATE))


def _guided(plane: Singles, guide: Image, reach: int) -> Singles:
    """Guided filter (He, Sun and Tang, PAMI 35(6), 2013): mean over a square, along edges of the image and not across."""
    g = guide.astype(np.float32)
    mean_g, mean_p = _box(g, guide, reach), _box(plane, guide, reach)
    a = (_box(g * plane, guide, reach) - mean_g * mean_p) / (_box(g * g, guide, reach) - mean_g**2 + _FLAT_VARIANCE)
    b = mean_p - a * mean_g
    return np.asarray(_box(a, guide, reach) * g + _box(b, guide, reach))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _arms(image: Image, reach: int, dy: int, dx: int) -> NDArray[np.int32]:
    """Return how far (H, W) each pixel's arm in one direction goes before the grey level changes."""
    height, width = image.shape
    out = np.zeros((height, width), np.int32)
    for y in range(height):
        for x in range(width):
            for k in range(1, reach + 1):
                v, u = y + k * dy, x + k * dx
                if not (0 <= v < height and 0 <= u < width):
                    break
                if k > 1 and abs(np.int32(image[v, u]) - np.int32(image[y, x])) > _ARM_STEP:
                    break
                out[y, x] = k
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _over_arms(plane: Singles, before: NDArray[np.int32], after: NDArray[np.int32], down: bool) -> Singles:
    """Mean (H, W) over each pixel's arms along rows, or along columns."""
    height, width = plane.shape
    out = np.empty_like(plane)
    for y in range(height):
        for x in range(width):
            total = np.float32(0)
            for k in range(-before[y, x], after[y, x] + 1):
                total += plane[y + k, x] if down else plane[y, x + k]
            out[y, x] = total / np.float32(before[y, x] + after[y, x] + 1)
    return out


def _cross(plane: Singles, guide: Image, reach: int) -> Singles:
    """Mean over a window shaped by arms of alike pixels, along rows and then along columns."""
    across = _over_arms(plane, _arms(guide, reach, 0, -1), _arms(guide, reach, 0, 1), False)
    return np.asarray(_over_arms(across, _arms(guide, reach, -1, 0), _arms(guide, reach, 1, 0), True))


#: Name -> cost plane (H, W) of a left and a right strip at a disparity, for windows of a reach.
COSTS: dict[str, Callable[[Image, Image, int, int], Singles]] = {"sad": _sad, "zncc": _zncc}
#: Name -> how a cost plane is gathered under a guide.
SUPPORTS: dict[str, Callable[[Singles, Image, int], Singles]] = {"box": _box, "cross": _cross, "guided": _guided}


def match_planes(left: Image, right: Image, search: Search, cost: str, support: str, reach: int) -> Found:
    """Choose disparities by a cost and a support, one disparity at a time, a strip of rows at a time."""
    height, width = left.shape
    size = -(-search.count // int(BLOCK)) * int(BLOCK)
    found = make_found(height, width)
    plane_of = {**COSTS, "census": _census}[cost]

    def work(begin: int, end: int) -> None:
        top, bottom = max(0, begin - 2 * reach - 2), min(height, end + 2 * reach + 2)
        a, b = np.ascontiguousarray(left[top:bottom]), np.ascontiguousarray(right[top:bottom])
        total: Counts = np.full((end - begin, width, size), 65535, np.uint16)
        for k in range(search.count):
            plane = plane_of(a, b, search.first + k, reach)
            if cost != "zncc" or support != "box":  # correlation over a square is gathered already
                plane = SUPPORTS[support](plane, a, reach)
            total[:, :, k] = np.rint(np.clip(plane, 0, None) * _FINE)[begin - top : end - top]
        flat, best_right = total.reshape(-1), np.empty(width + search.first + size, np.uint16)
        for y in range(begin, end):
            at = np.uintp((y - begin) * width * size)
            choose_row(flat, at, best_right, y, search.first, search.count, np.uintp(size), found)

    on_strips(height, _STRIP_ROWS, work)
    return found
