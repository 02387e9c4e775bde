"""From what was found to a result: what cannot be believed goes, the rest is smoothed, gaps are filled, sigma is added.

All methods end here, so that they differ in how they match and in nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.vision.dense.edges import redrawn
from armsight.vision.dense.fill import filled
from armsight.vision.dense.method import MEASURED, Disparity, Search
from armsight.vision.dense.smooth import smoothed
from armsight.vision.dense.strips import on_strips
from armsight.vision.dense.winner import Found, Singles

#: A patch of one disparity that is not larger than the pixels one match looks at (7 x 7) is one mistake, not a surface.
_SPECKLE_PX = 50
#: Disparities are told apart to this, px, when patches are found.
_FINE = 16
#: With less than this share of the image measured, there is no result: chance alone gives some.
_LEAST_SHARE = 0.005
_STRIP_ROWS = 192


@dataclass(frozen=True)
class Trust:
    """How sure a method is: sigma^2 = floor^2 + (gain * least / curvature)^2.

    The second term is the noise of a minimum: what a match still costs is noise, and the bend of the costs turns it
    into pixels. The first is what no cost tells: the pull towards whole disparities, slants, the smoothing. Both are
    set so that 1.96 sigma holds about 95% of the errors on four rendered scenes; others, and real ones, then check it.

    Attributes:
        floor_px: px.
        gain: of a method's own costs.
    """

    floor_px: float
    gain: float = 0.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _coarse(found: Found, begin: int, end: int, out: NDArray[np.int16]) -> None:
    """Write disparities in steps of a pixel's sixteenth, below zero where the two images do not agree."""
    for y in range(begin, end):
        for x in range(out.shape[1]):
            good = found.agreed[y, x] and found.curvature[y, x] > 0
            out[y, x] = np.int16(found.disparity[y, x] * np.float32(_FINE)) if good else np.int16(-_FINE)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sure(found: Found, kept: NDArray[np.int16], begin: int, end: int, out: Singles) -> None:
    """Write the disparities that are kept, NaN elsewhere."""
    for y in range(begin, end):
        for x in range(kept.shape[1]):
            out[y, x] = found.disparity[y, x] if kept[y, x] >= 0 else np.float32(np.nan)


def without_speckles(found: Found) -> Singles:
    """Return the disparities (H, W) that the images agree on, NaN where a patch is too small to be believed."""
    height, width = found.disparity.shape
    coarse, out = np.empty((height, width), np.int16), np.empty((height, width), np.float32)
    on_strips(height, _STRIP_ROWS, lambda begin, end: _coarse(found, begin, end, coarse))
    cv2.filterSpeckles(coarse, -_FINE, _SPECKLE_PX, _FINE)
    on_strips(height, _STRIP_ROWS, lambda begin, end: _sure(found, coarse, begin, end, out))
    return out


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _judge(
    found: Found,
    state: NDArray[np.uint8],
    floor: float,
    gain: float,
    begin: int,
    end: int,
    sigma: Singles,
    share: Singles,
) -> None:
    """Write sigmas; what was not measured has neither sigma nor confidence."""
    low, slope = np.float32(floor), np.float32(gain)
    for y in range(begin, end):
        for x in range(state.shape[1]):
            noise = slope * found.least[y, x] / max(found.curvature[y, x], np.float32(1))
            measured = state[y, x] == MEASURED
            sigma[y, x] = np.sqrt(low * low + noise * noise) if measured else np.float32(np.nan)
            share[y, x] = share[y, x] if measured else np.float32(0)


def finished(found: Found, left: Image, search: Search, trust: Trust, *, edges: bool = False) -> Disparity:
    """Turn what was found into a result.

    Args:
        found: what a method found.
        left: (H, W) uint8, the left image.
        search: which disparities were tried.
        trust: how sure the method is.
        edges: whether depth breaks are drawn again where the image has its edges.
    """
    sure = without_speckles(found)
    if np.count_nonzero(sure == sure) < _LEAST_SHARE * sure.size:  # NaN is not even itself
        return Disparity.none(
            (left.shape[0], left.shape[1]),
            search,
            "nothing in the left image was found in the right one: too little texture, not the same scene, or "
            f"disparities beyond {search.first} to {search.last} px",
        )
    surface, share = smoothed(sure, left)
    full, state = filled(surface)
    if edges:
        full, state = redrawn(full, state, left)
    sigma = np.empty_like(full)
    on_strips(
        left.shape[0],
        _STRIP_ROWS,
        lambda begin, end: _judge(found, state, trust.floor_px, trust.gain, begin, end, sigma, share),
    )
    return Disparity(full, state, sigma, share, search)
