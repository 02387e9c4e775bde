"""AprilTag 3's families (tagStandard41h12, ..): a bright square ring inside a dark one, with data within and without.

In: a grey image. Out: identities and rough corners of the inner square, where the bright ring meets the dark one: its side
is the tag's size (5 of the 9 cells of tagStandard41h12). In the negative of an image that square is an ordinary dark
marker, so OpenCV finds its outline; the cells are then read and compared with all codes (Krogius et al., IROS 2019).

The codes are facts of the families, read from pyapriltags 3.4.3 (AprilTag, BSD 2-clause). ``apriltag3.npz`` holds them as
the steps of the generator that found them: code k is code k - 1 + step_k * 982451653, modulo 2^bits, byte by byte.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array


class FamilyLayout(NamedTuple):
    """Where a family has its data: cells along the inner square and the whole tag, least Hamming ``distance`` of two codes.

    ``quarter``: data cells of the first quarter, in order, as rows of columns "row:first-last"; the others are the same
    rotated by 90, 180, 270 degrees, and a cell in the middle comes last.
    """

    square: int
    cells: int
    distance: int
    quarter: str


#: Every family, by its own name.
LAYOUTS = {
    "tagStandard41h12": FamilyLayout(5, 9, 12, "0:0-7 3:3-4"),
    "tagStandard52h13": FamilyLayout(6, 10, 13, "0:0-8 3:3-5 4:4-4"),
    "tagCircle21h7": FamilyLayout(5, 9, 7, "0:3-5 3:3-4"),
    "tagCircle49h12": FamilyLayout(5, 11, 12, "0:4-6 1:2-8 4:4-5"),
    "tagCustom48h12": FamilyLayout(6, 10, 12, "0:0-8 3:3-5"),
}
_PRIME = np.uint64(982451653)
#: The bright ring exceeds the dark one by this many grey levels at least.
_STEP = 10.0  # half: noise is read; double: tags in the dark are missed
_SAMPLES = 4  # along a cell; half: noisy cells; double: four times the time


@lru_cache(maxsize=8)
def codes(family: str) -> NDArray[np.uint64]:
    """Return the codes (M,) of a family, the first data cell in the highest bit."""
    with np.load(Path(__file__).with_suffix(".npz")) as stored:
        planes = stored[family].astype(np.uint64)
    steps = (planes << (np.arange(len(planes), dtype=np.uint64) * np.uint64(8))[:, None]).sum(axis=0, dtype=np.uint64)
    steps[1:] *= _PRIME
    out = np.cumsum(steps, dtype=np.uint64) & np.uint64(2 ** len(data_cells(family)) - 1)
    out.flags.writeable = False
    return out


@lru_cache(maxsize=8)
def data_cells(family: str) -> NDArray[np.intp]:
    """Return row and column (n, 2) of a family's data cells, in the order of their bits."""
    layout = LAYOUTS[family]
    first = [
        (int(row), column)
        for row, _, columns in (part.partition(":") for part in layout.quarter.split())
        for column in range(int(columns.split("-")[0]), int(columns.split("-")[1]) + 1)
    ]
    cells, quarter = list(first), first
    for _ in range(3):
        quarter = [(column, layout.cells - 1 - row) for row, column in quarter]
        cells += quarter
    odd = int("".join(c for c in family.partition("h")[0] if c.isdigit())) - len(cells)
    return np.array(cells + [(layout.cells // 2,) * 2] * odd)


def printed(family: str, identity: int) -> NDArray[np.int8]:
    """Return a whole tag's cells (N, N), upright: 1 bright, -1 dark; what is no data outside of the rings is bright."""
    layout = LAYOUTS[family]
    out = np.ones((layout.cells, layout.cells), np.int8)
    rim = (layout.cells - layout.square) // 2
    out[rim - 1 : layout.cells - rim + 1, rim - 1 : layout.cells - rim + 1] = -1
    out[rim : layout.cells - rim, rim : layout.cells - rim] = 1
    at, code = data_cells(family), int(codes(family)[identity])
    out[at[:, 0], at[:, 1]] = [1 if code >> bit & 1 else -1 for bit in range(len(at) - 1, -1, -1)]
    return out


def negative_square(family: str, identity: int) -> NDArray[np.int8]:
    """Return the cells of the inner square in the negative of an image, as :func:`~.aruco.cells` has those of others."""
    layout = LAYOUTS[family]
    rim = (layout.cells - layout.square) // 2
    return np.ascontiguousarray(-printed(family, identity)[rim : layout.cells - rim, rim : layout.cells - rim])


def read_tag(image: NDArray[np.uint8], quad: Array, family: str) -> tuple[int, Array] | None:
    """Return identity and upright corners (4, 2) of the tag whose inner square a quadrilateral (4, 2) is, if it is one."""
    layout = LAYOUTS[family]
    rim, n = (layout.cells - layout.square) // 2, layout.cells
    ends = np.array([[rim, rim], [n - rim, rim], [n - rim, n - rim], [rim, n - rim]], np.float32) * _SAMPLES - 0.5
    H = cv2.getPerspectiveTransform(quad.astype(np.float32), ends.astype(np.float32))
    fine = cv2.warpPerspective(image, H, (_SAMPLES * n, _SAMPLES * n), borderMode=cv2.BORDER_REPLICATE)
    inner = fine.reshape(n, _SAMPLES, n, _SAMPLES)[:, 1:-1, :, 1:-1]  # neighbours blur into a cell's edges
    seen = inner.mean(axis=(1, 3), dtype=np.float32)
    bright, dark = _rings(layout)
    low, high = float(seen[dark].max()), float(seen[bright].min())
    if high - low < _STEP:
        return None
    bits = seen > 0.5 * (float(seen[dark].mean()) + float(seen[bright].mean()))
    at, known = data_cells(family), codes(family)
    weights = np.uint64(1) << np.arange(len(at) - 1, -1, -1, dtype=np.uint64)
    allowed = layout.distance // 6  # cells that are read wrong, of those in which two codes differ
    for rotation in range(4):
        code = weights[np.rot90(bits, rotation)[at[:, 0], at[:, 1]]].sum(dtype=np.uint64)
        wrong = _POPULATION[(known ^ code).view(np.uint8)].reshape(len(known), 8).sum(axis=1)
        best = int(wrong.argmin())
        if wrong[best] <= allowed:
            return best, np.roll(quad, -rotation, axis=0)
    return None


_POPULATION = np.array([bin(byte).count("1") for byte in range(256)], np.uint8)


@lru_cache(maxsize=8)
def _rings(layout: FamilyLayout) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return where a tag's cells are the bright ring, and where the dark one, without its corners."""
    rows, columns = np.mgrid[: layout.cells, : layout.cells] - (layout.cells - 1) / 2
    far = np.maximum(np.abs(rows), np.abs(columns))
    half = layout.square / 2
    return np.abs(far - (half - 0.5)) < 0.25, np.abs(far - (half + 0.5)) < 0.25
