"""Check a rectified pair before any matching; every message says what to do.

The two images must have one size, their rows must show the same rows of the scene, and points must lie further left in
the right image than in the left one. The last two are tested with a few hundred corners that look alike in both images.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import SIDES, Array, Image
from armsight.errors import InputError
from armsight.vision.dense.method import Disparity, Method, Search
from armsight.vision.image import grey

_CORNERS = 1500
#: A corner's match must be this much better than its next best, and there must be so many before anything is concluded.
_RATIO, _ENOUGH = 0.75, 30
#: Rows that the images may be apart, px: at the first the matching suffers, beyond the second the pair is not
#: rectified.
_VERTICAL_NOTE_PX, VERTICAL_MAX_PX = 1.0, 2.5
#: Share of corners that must lie on the wrong side before the images count as exchanged.
_EXCHANGED = 0.8
#: An image that, with its pixel noise smoothed away, stays within so many grey levels of its surroundings almost
#: everywhere has no texture to match.
_TEXTURE, _TEXTURED_SHARE = 1.5, 0.002


def plain_grey(image: NDArray[np.generic], side: str) -> Image:
    """Return an image as 8-bit grey, floats of 0 to 255 included; InputError where it is none, or has NaN."""
    if image.dtype.kind != "f":
        return grey(image)
    if not np.isfinite(image).all():
        bad = int(np.count_nonzero(~np.isfinite(image)))
        raise InputError(f"{side} image: {bad} values are NaN or infinite; every pixel must be a finite number")
    if image.min() < 0 or image.max() > 255:
        raise InputError(
            f"{side} image: floats must lie in 0 to 255, got {image.min():g} to {image.max():g}; scale them first"
        )
    return grey(np.rint(image).astype(np.uint8))


def alike(left: Image, right: Image) -> Array:
    """Return (N, 4) columns and rows of corners that look alike in both images: u and v left, u and v right."""
    finder = cv2.ORB.create(_CORNERS, 1.2, 4, fastThreshold=8)
    corners, descriptors = zip(*(finder.detectAndCompute(image, None) for image in (left, right)), strict=True)
    if any(w is None or len(w) < 2 for w in descriptors):
        return np.zeros((0, 4))
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors[0], descriptors[1], k=2)
    good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < _RATIO * p[1].distance]
    return np.array([[*corners[0][m.queryIdx].pt, *corners[1][m.trainIdx].pt] for m in good]).reshape(-1, 4)


def vertical_offset_px(corners: Array) -> Array:
    """Return the vertical offset (N,), px: a plane through the corners' vertical differences, outliers rejected."""
    A = np.column_stack([np.ones(len(corners)), corners[:, :2] - corners[:, :2].mean(axis=0)])
    off = corners[:, 3] - corners[:, 1]
    kept = np.abs(off - np.median(off)) <= 3 + 3 * np.median(np.abs(off - np.median(off)))
    for _ in range(3):
        plane = np.linalg.lstsq(A[kept], off[kept], rcond=None)[0]
        gap = np.abs(off - A @ plane)
        kept = gap <= 1 + 3 * np.median(gap[kept])
    return np.asarray(A @ plane)


def check_rectified(left: Image, right: Image) -> str | None:
    """Check by corners whether two images (H, W) are a rectified pair; InputError where exchanged or not rectified.

    Return a remark where they are a little off; None where nothing is.
    """
    corners = alike(left, right)
    if len(corners) < _ENOUGH:
        return None
    apart = vertical_offset_px(corners)
    size = float(np.sqrt((apart**2).mean()))
    if size > VERTICAL_MAX_PX:
        raise InputError(
            f"the images are not rectified: what is in one row of the left image is {size:.1f} px off that row "
            f"in the right one (median {np.median(apart):+.1f}); rectify them first, or give the rig they were taken with"
        )
    level = np.abs(corners[:, 3] - corners[:, 1] - apart) <= 3
    if level.sum() >= _ENOUGH and (corners[level, 2] > corners[level, 0] + 1).mean() > _EXCHANGED:
        raise InputError(
            "left and right image are exchanged: what is near lies further right in the right one; exchange them"
        )
    if size > _VERTICAL_NOTE_PX:
        return f"the rows of the two images are {size:.1f} px apart: matching suffers; calibrate again"
    return None


def check_sizes(left: Image, right: Image) -> None:
    """Reject images of two sizes (InputError)."""
    if left.shape != right.shape:
        (h, w), (k, m) = left.shape, right.shape
        raise InputError(f"the left image is {w}x{h} px and the right one {m}x{k}; both must be of one size")


def untextured(image: Image, side: str) -> str | None:
    """Return the reason why an image has nothing to match, or None."""
    smooth, surround = (cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma) for sigma in (1.5, 6.0))
    if float((np.abs(smooth - surround) > _TEXTURE).mean()) > _TEXTURED_SHARE:
        return None
    return f"the {side} image has no texture: its grey levels are the same everywhere, to {_TEXTURE:g}"


def match_pair(
    method: Method,
    left: NDArray[np.generic],
    right: NDArray[np.generic],
    search: Search,
    note: Callable[[str], None] = lambda line: None,
) -> Disparity:
    """Check a rectified pair and match it.

    ``left``: (H, W) or (H, W, 3) BGR; uint8, uint16, or floats of 0 to 255. ``right``: the same. ``search``: which
    disparities to try. ``note``: called with a remark on a pair that is slightly off. Returns the disparities; empty, with
    the reason, where there is nothing to match. Raises InputError: not images, not of one size, exchanged, not rectified,
    or a search that leaves the image.
    """
    a, b = plain_grey(left, "left"), plain_grey(right, "right")
    check_sizes(a, b)
    if search.last >= (width := a.shape[1]):
        raise InputError(
            f"disparities up to {search.last} px are outside an image {width} px wide; the greatest must be below its width"
        )
    for image, side in zip((a, b), SIDES, strict=True):
        if (problem := untextured(image, side)) is not None:
            return Disparity.none((image.shape[0], image.shape[1]), search, problem)
    remark = check_rectified(a, b)
    if remark is not None:
        note(remark)
    return method.match(a, b, search)
