"""Pictures of disparity maps: colours with a scale, what was not measured set apart; and where a map is wrong."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Image
from armsight.vision.dense.evaluate import Truth
from armsight.vision.dense.method import FILLED, MEASURED, NOTHING, OCCLUDED, Disparity

_BAR_PX, _MARGIN_PX, _CAPTION_PX = 18, 62, 26
_INK, _PAPER = (41, 31, 31), (255, 255, 255)
_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.42
#: Colours (BGR) of an error map: right, off by more than each threshold, and no truth.
_RIGHT, _OFF_1, _OFF_2, _OFF_4, _UNKNOWN = (225, 225, 225), (120, 200, 250), (40, 130, 235), (30, 30, 170), (90, 60, 40)
#: How much darker what only the left camera sees is drawn, and what is right there.
_DARKER = 0.75
_HIDDEN = (169, 169, 169)


def _colours(values: NDArray[np.floating[Any]], low: float, high: float) -> Image:
    """Return colours (..., 3) BGR for values between low and high."""
    share = np.nan_to_num((values.astype(np.float32) - np.float32(low)) * np.float32(255 / max(high - low, 1e-9)))
    return np.asarray(cv2.applyColorMap(np.clip(share, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO))


def _write(canvas: Image, text: str, place: tuple[int, int]) -> None:
    """Put a line of text on a canvas; it is plain ASCII, for OpenCV's font has nothing else."""
    cv2.putText(canvas, text, place, _FONT, _SIZE, _INK, 1, cv2.LINE_AA)


def paint_disparity(result: Disparity) -> Image:
    """Return a picture (BGR) of a disparity map with its scale; what was filled is paler, in stripes."""
    height, width = result.disparity.shape
    canvas = np.full((height + _CAPTION_PX, width + _BAR_PX + _MARGIN_PX, 3), _PAPER, np.uint8)
    some = np.isfinite(result.disparity) & (result.state != NOTHING)
    if not some.any():
        canvas[:height, :width] = (200, 200, 200)
        _write(canvas, "nothing measured", (4, height + 17))
        return canvas
    low, high = (float(q) for q in np.percentile(result.disparity[some], (0.5, 99.5)))
    picture = _colours(result.disparity, low, high)
    diagonal = np.add.outer(np.arange(height, dtype=np.int16), np.arange(width, dtype=np.int16))
    pale = some & (result.state != MEASURED) & (diagonal % 6 < 3)
    picture[pale] = (0.35 * picture[pale] + 0.65 * 255).astype(np.uint8)
    picture[~some] = (200, 200, 200)
    canvas[:height, :width] = picture
    _bar(canvas, height, width, low, high)
    names = ((MEASURED, "measured"), (OCCLUDED, "hidden"), (FILLED, "filled"))
    shares = [f"{100 * np.mean(result.state == state):.0f}% {name}" for state, name in names]
    _write(canvas, ", ".join(shares), (4, height + 17))
    return canvas


def _bar(canvas: Image, height: int, width: int, low: float, high: float) -> None:
    """Draw the scale with round numbers beside the picture."""
    left = width + 10
    values = np.linspace(high, low, height)[:, None]
    canvas[:height, left : left + _BAR_PX] = np.repeat(_colours(values, low, high), _BAR_PX, axis=1)
    for value in _round_values(low, high):
        y = round((high - value) / max(high - low, 1e-9) * (height - 1))
        canvas[y, left + _BAR_PX : left + _BAR_PX + 3] = _INK
        _write(canvas, f"{value:g} px", (left + _BAR_PX + 5, min(max(y + 4, 10), height - 2)))


def _round_values(low: float, high: float) -> list[float]:
    """Return three to seven round numbers between low and high, or their middle where they are the same."""
    span = high - low
    if span < 1e-6:
        return [float(f"{(low + high) / 2:.3g}")]
    power = 10 ** np.floor(np.log10(span / 3))
    step = next(float(power * k) for k in (10, 5, 2, 1) if span / (power * k) >= 3)
    return [float(k * step) for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def paint_errors(disparity: NDArray[np.float32], truth: Truth) -> Image:
    """Return a picture (BGR) of where a map is off by more than 1, 2 and 4 px; what only the left camera sees is darker."""
    height, width = disparity.shape
    error = np.abs(disparity - truth.disparity)
    picture = np.full((height, width, 3), _RIGHT, np.uint8)
    for threshold, colour in ((1.0, _OFF_1), (2.0, _OFF_2), (4.0, _OFF_4)):
        picture[~(error <= threshold)] = colour
    hidden = truth.known & ~truth.seen
    picture[hidden] = (_DARKER * picture[hidden]).astype(np.uint8)
    picture[~truth.known] = _UNKNOWN
    canvas = np.full((height + _CAPTION_PX, width, 3), _PAPER, np.uint8)
    canvas[:height] = picture
    x = 4
    for name, colour in (
        ("right", _RIGHT),
        ("> 1 px", _OFF_1),
        ("> 2", _OFF_2),
        ("> 4", _OFF_4),
        ("no truth", _UNKNOWN),
        ("seen by one", _HIDDEN),
    ):
        cv2.rectangle(canvas, (x, height + 8), (x + 10, height + 18), colour, -1)
        cv2.rectangle(canvas, (x, height + 8), (x + 10, height + 18), _INK, 1)
        _write(canvas, name, (x + 14, height + 17))
        x += 24 + 8 * len(name)
    return canvas
