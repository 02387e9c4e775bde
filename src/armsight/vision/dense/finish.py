"""From what was found to a result: what cannot be believed goes, the rest is smoothed, gaps are filled, sigma is added.

All methods end here, so that they differ in how they match and in nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.vision.dense.edges import redrawn
from armsight.vision.dense.fill import filled
from armsight.vision.dense.method import MEASURED, Disparity, Search
from armsight.vision.dense.smooth import smoothed
from armsight.vision.dense.winner import Found, Singles

#: A patch of one disparity that is not larger than the pixels one match looks at (7 x 7) is one mistake, not a surface.
_SPECKLE_PX = 50
#: Disparities are told apart to this, px, when patches are found.
_FINE = 16
#: With less than this share of the image measured, there is no result: chance alone gives some.
_LEAST_SHARE = 0.005


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

    def sigma_px(self, found: Found) -> NDArray[np.float32]:
        """Return the standard deviation (H, W) of what was found, px."""
        noise = self.gain * found.least / np.maximum(found.curvature, 1)
        return np.hypot(np.float32(self.floor_px), noise).astype(np.float32)


def without_speckles(disparity: Singles) -> Singles:
    """Return disparities (H, W) with NaN where a patch is too small to be believed."""
    coarse = np.where(np.isnan(disparity), -_FINE, disparity * _FINE).astype(np.int16)
    cv2.filterSpeckles(coarse, -_FINE, _SPECKLE_PX, _FINE)
    return np.where(coarse == -_FINE, np.float32(np.nan), disparity)


def finished(found: Found, left: Image, search: Search, trust: Trust, *, edges: bool = False) -> Disparity:
    """Turn what was found into a result.

    Args:
        found: what a method found.
        left: (H, W) uint8, the left image.
        search: which disparities were tried.
        trust: how sure the method is.
        edges: whether depth breaks are drawn again where the image has its edges.
    """
    good = found.agreed & (found.curvature > 0)
    sure = without_speckles(np.where(good, found.disparity, np.float32(np.nan)))
    if np.count_nonzero(np.isfinite(sure)) < _LEAST_SHARE * sure.size:
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
    measured = state == MEASURED
    sigma = np.where(measured, trust.sigma_px(found), np.float32(np.nan))
    return Disparity(full, state, sigma, np.where(measured, share, np.float32(0)), search)
