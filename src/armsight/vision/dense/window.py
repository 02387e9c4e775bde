"""Costs summed over square windows, by running sums: the work for a pixel does not grow with the window."""

from __future__ import annotations

import numba
import numpy as np

from armsight.vision.dense.cost import Bytes, Pair, raw_row
from armsight.vision.dense.winner import Counts, Found, choose_row


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _slide(columns: Counts, raw: Bytes, new: np.uintp, old: np.uintp) -> None:
    """Let the sums over columns move down by one row."""
    for i in range(np.uintp(columns.shape[0])):
        columns[i] += np.uint16(raw[new + i]) - np.uint16(raw[old + i])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _start(columns: Counts, raw: Bytes, row: np.uintp) -> None:
    """Add one row to the sums over columns."""
    for i in range(np.uintp(columns.shape[0])):
        columns[i] += np.uint16(raw[row + i])


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _along(columns: Counts, add: np.uintp, take: np.uintp, total: Counts, at: np.uintp, size: np.uintp) -> None:
    """Let the sum over a window move right by one pixel."""
    for d in range(size):
        total[at + d] = np.uint16(total[at - size + d] + np.uint16(columns[add + d] - columns[take + d]))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sum_row(columns: Counts, reach: int, size: np.uintp, total: Counts) -> None:
    """Sum the columns (W * size,) over 2 ``reach`` + 1 pixels; beyond the image's edge it is its last column."""
    width = columns.shape[0] // int(size)
    total[: int(size)] = 0
    for i in range(-reach, reach + 1):
        c = np.uintp(min(max(i, 0), width - 1)) * size
        for d in range(size):
            total[d] += columns[c + d]
    for x in range(1, width):
        add, take = min(x + reach, width - 1), max(x - reach - 1, 0)
        _along(columns, np.uintp(add) * size, np.uintp(take) * size, total, np.uintp(x) * size, size)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def match_windows(
    pair: Pair, begin: int, end: int, reach: int, first: int, count: int, size: np.uintp, found: Found
) -> None:
    """Choose the disparities of the rows from ``begin`` to ``end`` by the least sum over a window."""
    height, width = pair.left.shape
    n = np.uintp(width) * size
    held = 2 * reach + 2  # rows of raw costs, each at its number modulo this
    raw = np.empty(held * int(n), np.uint8)
    columns, total = np.zeros(int(n), np.uint16), np.empty(int(n), np.uint16)
    best_right = np.empty(width + first + int(size), np.uint16)
    known = max(begin - reach, 0)
    for row in range(known, min(begin + reach, height - 1) + 1):
        raw_row(pair, row, first, count, size, raw, np.uintp(row % held) * n)
    for y in range(begin - reach, begin + reach + 1):
        _start(columns, raw, np.uintp(min(max(y, 0), height - 1) % held) * n)
    for y in range(begin, end):
        if y > begin:
            new, old = min(y + reach, height - 1), max(y - reach - 1, 0)
            if new == y + reach:
                raw_row(pair, new, first, count, size, raw, np.uintp(new % held) * n)
            _slide(columns, raw, np.uintp(new % held) * n, np.uintp(old % held) * n)
        _sum_row(columns, reach, size, total)
        choose_row(total, np.uintp(0), best_right, y, first, count, size, found)
