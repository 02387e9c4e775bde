"""What is wrong with the images of a camera: focus, exposure, flicker, and whether two views are of one camera.

In: grey images (H, W). Out: figures. The edge spread is the standard deviation, px, of the blur that the sharpest edges of
an image show: contrast over sqrt(2 pi) times the steepest slope of an edge's profile. The flicker of lamps at twice the
mains frequency is a wave over the rows of a rolling shutter, or over the images of a global one; from image to image its
phase advances by the lamp's frequency over the camera's rate, which distinguishes 100 from 120 Hz.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array

Grey = NDArray[np.uint8]
#: An edge spread up to this is sharp, px; beyond the second it costs accuracy.
SHARP_PX, BLURRED_PX = 1.3, 2.2
_CELLS = (6, 8)  # rows and columns of cells, of each of which the steepest pixel is looked at
_REACH_PX, _STEP_PX = 7.0, 0.25
_LEAST_CONTRAST = 25.0  # grey levels of an edge that is looked at
_SATURATED, SATURATED_SHARE = 254, 0.01
DARK_MEAN = 35.0
_BANDS = 40  # rows into which an image is averaged for the flicker
_FLICKER_IMAGES, _FLICKER_SHARE, _LINE_SHARE = 12, 0.008, 0.4
_SAME_DIFFERENCE = 4.0  # mean grey levels by which two views of one camera differ at most


@dataclass(frozen=True)
class ImageQuality:
    """Figures of one image."""

    edge_px: float | None  # edge spread; None where no edge has contrast enough
    mean: float  # grey level
    saturated: float  # share of the pixels


def image_quality(image: Grey) -> ImageQuality:
    """Return the figures of a grey image (H, W)."""
    saturated = float((image >= _SATURATED).mean())
    return ImageQuality(edge_spread_px(image), float(image.mean()), saturated)


def edge_spread_px(image: Grey) -> float | None:
    """Return the spread of the sharper half of an image's edges, px; None where fewer than four have contrast."""
    smooth = cv2.GaussianBlur(image, (3, 3), 0.8)
    dx, dy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    slope = cv2.magnitude(dx, dy)
    rows, columns = _CELLS
    border = int(_REACH_PX) + 2
    h, w = (image.shape[0] - 2 * border) // rows, (image.shape[1] - 2 * border) // columns
    if min(h, w) < 4:
        return None
    cells = slope[border : border + rows * h, border : border + columns * w].reshape(rows, h, columns, w)
    at = cells.transpose(0, 2, 1, 3).reshape(rows * columns, h * w).argmax(axis=1)
    r = border + np.repeat(np.arange(rows), columns) * h + at // w
    c = border + np.tile(np.arange(columns), rows) * w + at % w
    along = np.stack([dx[r, c], dy[r, c]], axis=1) / np.maximum(slope[r, c], 1e-6)[:, None]
    t = np.arange(-_REACH_PX, _REACH_PX + 1e-9, _STEP_PX)
    across = (np.stack([c, r], axis=1)[:, None] + t[:, None] * along[:, None]).astype(np.float32)
    profile = cv2.remap(image, across[..., 0], across[..., 1], cv2.INTER_LINEAR)
    profile = cv2.blur(profile.astype(np.float32), (5, 1))
    n = len(t)
    # The plateaus nearest to the edge: further away the profile may meet the next edge.
    contrast = profile.max(axis=1) - profile.min(axis=1)
    steepest = np.abs(np.diff(profile[:, n // 4 : 3 * n // 4], axis=1)).max(axis=1) / _STEP_PX
    good = contrast > _LEAST_CONTRAST
    if good.sum() < 4:
        return None
    spread = contrast[good] / (np.sqrt(2 * np.pi) * np.maximum(steepest[good], 1e-6))
    # Bilinear reading and the mean over five samples widen an edge by themselves.
    own = 1 / 6 + (5 * _STEP_PX) ** 2 / 12
    sharper = np.sort(spread)[: max(len(spread) // 2, 2)]
    return float(np.sqrt(max(float(np.median(sharper)) ** 2 - own, 0.05)))


def same_camera(left: Grey, right: Grey) -> bool:
    """Return whether two images look like two deliveries of one camera."""
    if left.shape != right.shape:
        return False
    small = [cv2.resize(image, (160, 90), interpolation=cv2.INTER_AREA).astype(np.float32) for image in (left, right)]
    contrast = float(np.std(small[0]))
    return contrast > 3 * _SAME_DIFFERENCE and float(np.abs(small[0] - small[1]).mean()) < _SAME_DIFFERENCE


class FlickerWatch:
    """Looks for the flicker of lamps in the images, rate_hz a second, of a camera that stands still."""

    def __init__(self, rate_hz: float) -> None:
        self._rate_hz = rate_hz
        self._rows: deque[Array] = deque(maxlen=_FLICKER_IMAGES)

    def take(self, image: Grey) -> None:
        """Take the next image; none may be missing in between."""
        self._rows.append(cv2.resize(image, (1, _BANDS), interpolation=cv2.INTER_AREA)[:, 0].astype(float))

    def found(self) -> tuple[float, float] | None:
        """Return the amplitude of the flicker, a share, and the lamp's frequency, Hz; None where none is found."""
        if len(self._rows) < _FLICKER_IMAGES:
            return None
        rows = np.log(np.maximum(np.array(self._rows), 1.0))
        change = rows - rows.mean(axis=0)
        # A wave over rows and images has one line; what moves before the camera has many.
        waves = np.fft.fft(np.fft.rfft(change, axis=1), axis=0) / (change.size / 2)
        power = np.abs(waves) ** 2
        k_image, k_row = np.unravel_index(int(power.argmax()), power.shape)
        amplitude = float(np.sqrt(power[k_image, k_row]))
        if amplitude < _FLICKER_SHARE or power[k_image, k_row] < _LINE_SHARE * power.sum():
            return None
        advance = k_image / _FLICKER_IMAGES
        apart = [
            min(_circle(advance, hz / self._rate_hz), _circle(-advance, hz / self._rate_hz)) for hz in (100.0, 120.0)
        ]
        return amplitude, (100.0, 120.0)[int(np.argmin(apart))]


def _circle(a: float, b: float) -> float:
    """Return how far apart two phases are, in cycles."""
    apart = (a - b) % 1.0
    return min(apart, 1.0 - apart)
