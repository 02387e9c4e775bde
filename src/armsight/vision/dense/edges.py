"""Depth breaks drawn where the image has its edges.

A window that matches sees both sides of a break, so that the nearer surface comes out a few pixels too wide, and what
is filled beside it is a guess. Near breaks and gaps every pixel takes the weighted median of its neighbourhood,
neighbours that look like it and are near counting more: the surface that its looks belong to (Ma, He, Wei, Sun and Wu,
"Constant time weighted median filtering for stereo matching and beyond", ICCV 2013). A measured pixel that finds itself
on another surface is measured no more.
"""

from __future__ import annotations

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.vision.dense.method import FILLED, MEASURED
from armsight.vision.dense.strips import on_strips
from armsight.vision.dense.winner import Singles

#: Half the window, of which every other row and column counts, px; the spread of its weights, px and grey levels.
_REACH, _NEAR_PX, _ALIKE = 8, 6.0, 10.0
#: A step in disparity that is a break, px, and how near to one a pixel is drawn again, px.
_BREAK, _BESIDE = 1.5, 3
#: A measured disparity stays if it is so near to the median, px.
_SAME = np.float32(1.0)
_STRIP_ROWS = 64


def _doubtful(disparity: Singles, state: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return where (H, W) a pixel is drawn again: near breaks, and in gaps that a window bridges."""
    three = np.ones((3, 3), np.uint8)
    broken = cv2.dilate(disparity, three) - cv2.erode(disparity, three) > _BREAK
    size = 2 * _BESIDE + 1
    near = cv2.dilate(broken.astype(np.uint8), np.ones((size, size), np.uint8)) > 0
    measured = (state == MEASURED).astype(np.uint8)
    bridged = cv2.dilate(measured, np.ones((2 * _REACH + 1, 2 * _REACH + 1), np.uint8)) > measured
    return np.asarray(near | bridged).astype(np.uint8)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _redraw(
    disparity: Singles,
    image: Image,
    doubtful: NDArray[np.uint8],
    alike: Singles,
    near: Singles,
    begin: int,
    end: int,
    out: Singles,
) -> None:
    """Write weighted medians of doubtful pixels; the rest is copied."""
    height, width = disparity.shape
    votes = np.zeros(int(disparity.max()) + 2, np.float32)
    for y in range(begin, end):
        for x in range(width):
            out[y, x] = disparity[y, x]
            if not doubtful[y, x]:
                continue
            low, high, total = votes.shape[0], 0, np.float32(0)
            for j in range(-_REACH, _REACH + 1, 2):
                for i in range(-_REACH, _REACH + 1, 2):
                    v, u = y + j, x + i
                    if 0 <= v < height and 0 <= u < width:
                        weight = alike[abs(np.int32(image[v, u]) - np.int32(image[y, x]))] * near[abs(j)] * near[abs(i)]
                        k = int(disparity[v, u] + np.float32(0.5))
                        votes[k] += weight
                        total += weight
                        low, high = min(low, k), max(high, k)
            middle, below = low, votes[low]
            while below < total / 2 and middle < high:
                middle += 1
                below += votes[middle]
            votes[low : high + 1] = 0
            out[y, x] = _mean_of(disparity, image, alike, near, y, x, middle)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mean_of(
    disparity: Singles, image: Image, alike: Singles, near: Singles, y: int, x: int, middle: int
) -> np.float32:
    """Return the weighted mean of the neighbours within a pixel of the median."""
    height, width = disparity.shape
    up, down = np.float32(0), np.float32(0)
    for j in range(-_REACH, _REACH + 1, 2):
        for i in range(-_REACH, _REACH + 1, 2):
            v, u = y + j, x + i
            if 0 <= v < height and 0 <= u < width and abs(disparity[v, u] - middle) <= 1:
                weight = alike[abs(np.int32(image[v, u]) - np.int32(image[y, x]))] * near[abs(j)] * near[abs(i)]
                up += weight * disparity[v, u]
                down += weight
    return up / down if down > 0 else np.float32(middle)


def redrawn(disparity: Singles, state: NDArray[np.uint8], image: Image) -> tuple[Singles, NDArray[np.uint8]]:
    """Draw breaks and gaps again.

    Args:
        disparity: (H, W) px, filled.
        state: (H, W) what each is.
        image: (H, W) uint8, the left image.

    Returns:
        The same two, drawn again; what was measured and moves to another surface is FILLED.
    """
    doubtful, median = _doubtful(disparity, state), np.empty_like(disparity)
    alike = np.exp(-np.arange(256) / _ALIKE).astype(np.float32)
    near = np.exp(-((np.arange(_REACH + 1) / _NEAR_PX) ** 2) / 2).astype(np.float32)

    def work(begin: int, end: int) -> None:
        _redraw(disparity, image, doubtful, alike, near, begin, end, median)

    on_strips(disparity.shape[0], _STRIP_ROWS, work)
    stays = (state == MEASURED) & (np.abs(median - disparity) <= _SAME)
    moved = (state == MEASURED) & ~stays
    return np.where(stays, disparity, median), np.where(moved, np.uint8(FILLED), state)
