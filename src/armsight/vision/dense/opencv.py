"""OpenCV's semi-global matching behind the same contract, as a reference and a fallback."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from armsight.data import Image
from armsight.vision.dense.method import Disparity, Search
from armsight.vision.dense.postprocess import SigmaModel, finished
from armsight.vision.dense.winner import Singles, Winners

#: What OpenCV's samples recommend: a window, px; penalties of a slant and of a jump a pixel of it; a uniqueness, %.
_WINDOW, _P1, _P2, _UNIQUENESS = 3, 8, 32, 10
#: See postprocess.py.
_SIGMA_MODEL = SigmaModel(0.36)


@dataclass(frozen=True)
class OpenCV:
    """OpenCV's StereoSGBM."""

    def match(self, left: Image, right: Image, search: Search) -> Disparity:
        """Match a pair; see :class:`~armsight.vision.dense.method.Method`."""
        d = self.disparity(left, right, search)
        good = d >= search.first
        none = np.zeros(d.shape, np.float32)
        return finished(Winners(d, good, good.astype(np.float32), none), left, search, _SIGMA_MODEL)

    def disparity(self, left: Image, right: Image, search: Search) -> Singles:
        """Return what OpenCV finds (H, W), px; below the search where it finds nothing.

        The images are widened to the left, or columns that have less than the whole search to their left stay empty.
        """
        count = -(-search.count // 16) * 16
        wide = [cv2.copyMakeBorder(i, 0, 0, search.first + count, 0, cv2.BORDER_REPLICATE) for i in (left, right)]
        area = _WINDOW**2
        matcher = cv2.StereoSGBM.create(search.first, count, _WINDOW, _P1 * area, _P2 * area, 1, 0, _UNIQUENESS)
        found = matcher.compute(*wide)[:, search.first + count :]
        return np.ascontiguousarray(found.astype(np.float32) / 16)
