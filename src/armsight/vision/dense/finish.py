"""From what was found to a result: what cannot be believed goes, the rest is smoothed, gaps are filled, sigma is added.

All methods end here, so that they differ in how they match and in nothing else.
"""

from __future__ import annotations

import cv2
import numpy as np

from armsight.data import Image
from armsight.vision.dense.fill import filled
from armsight.vision.dense.method import MEASURED, Disparity, Search
from armsight.vision.dense.smooth import smoothed
from armsight.vision.dense.winner import Found, Singles

#: A patch of one disparity that is not larger than the pixels one match looks at (7 x 7) is one mistake, not a surface.
_SPECKLE_PX = 50
#: Disparities are told apart to this, px, when patches are found.
_FINE = 16


def without_speckles(disparity: Singles) -> Singles:
    """Return disparities (H, W) with NaN where a patch is too small to be believed."""
    coarse = np.where(np.isnan(disparity), -_FINE, disparity * _FINE).astype(np.int16)
    cv2.filterSpeckles(coarse, -_FINE, _SPECKLE_PX, _FINE)
    return np.where(coarse == -_FINE, np.float32(np.nan), disparity)


def finished(found: Found, left: Image, search: Search) -> Disparity:
    """Turn what was found into a result."""
    good = found.agreed & (found.curvature > 0)
    sure = without_speckles(np.where(good, found.disparity, np.float32(np.nan)))
    if np.isnan(sure).all():
        return Disparity.none(left.shape, search, "no pixel was matched in both images: is there any texture?")
    surface, share = smoothed(sure, left)
    full, state = filled(surface)
    sigma = np.where(state == MEASURED, np.float32(0.3), np.float32(np.nan))
    return Disparity(full, state, sigma, np.where(state == MEASURED, share, np.float32(0)), search)
