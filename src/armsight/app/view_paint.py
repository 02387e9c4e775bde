"""Strokes and letters on a BGR image, with OpenCV.

Its letters are ASCII on some versions: other characters are spelt out, or become a question mark.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.app.report.plotting import plain
from armsight.data import Array

Canvas = NDArray[np.uint8]
Colour = tuple[int, int, int]

PAPER: Colour = (255, 255, 255)
INK: Colour = (41, 32, 26)
MUTED: Colour = (124, 110, 97)
RED: Colour = (40, 40, 200)
BLANK = 200  # grey of what no image covers
LINE = 24  # height of a line of text, px
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4  # OpenCV takes coordinates in sixteenths of a pixel
_FAR = 1e5  # px: what lies further off is not drawn
_SPELT = str.maketrans({"±": "+-", "…": "...", "°": " deg", "σ": "sigma", "µ": "u", "×": "x"})


def ascii_text(text: str) -> str:
    """Return a text in ASCII, on one line."""
    return plain(text, 10_000).translate(_SPELT).encode("ascii", "replace").decode()


def wrapped(text: str, size: float, width: int) -> list[str]:
    """Break a text into lines of at most ``width`` px, between words where that is possible."""
    lines = [""]
    for word in ascii_text(text).split():
        if text_width(f"{lines[-1]} {word}", size) > width and lines[-1]:
            lines.append("")
        while text_width(word, size) > width:
            fits = max(n for n in range(1, len(word)) if n == 1 or text_width(word[:n], size) <= width)
            lines[-1], word = word[:fits], word[fits:]
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def text_width(text: str, size: float) -> int:
    """Return the width of a text, px."""
    text = ascii_text(text)
    return int(cv2.getTextSize(text, _FONT, size, 1)[0][0])


def write(
    canvas: Canvas, text: str, at: tuple[int, int], colour: Colour, size: float, *, rim: Colour | None = None
) -> None:
    """Write one line from its lower left corner on, with a rim of another colour where it stands on an image."""
    text = ascii_text(text)
    if rim is not None:
        for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            cv2.putText(canvas, text, (at[0] + x, at[1] + y), _FONT, size, rim, 1, cv2.LINE_AA)
    cv2.putText(canvas, text, at, _FONT, size, colour, 1, cv2.LINE_AA)


def paragraph(lines: Sequence[str], colour: Colour, size: float, width: int, edge: int = 0) -> Canvas:
    """Return lines of text on white, broken where they are too long, ``edge`` px from the left."""
    broken = [part for line in lines for part in wrapped(line, size, width - 2 * edge)]
    canvas = paper(LINE * len(broken), width)
    for row, text in enumerate(broken):
        write(canvas, text, (edge, LINE * row + 17), colour, size)
    return canvas


def paper(height: int, width: int) -> Canvas:
    """Return a white canvas."""
    return np.full((height, width, 3), 255, np.uint8)


def beside(parts: Sequence[Canvas], width: int, gap: int) -> Canvas:
    """Put canvases beside one another on white, with gaps before and between them."""
    out = paper(max(part.shape[0] for part in parts), width)
    x = gap
    for part in parts:
        out[: part.shape[0], x : x + part.shape[1]] = part
        x += part.shape[1] + gap
    return out


def ellipse(packed: Array) -> Array:
    """Return (64, 2) rim of an ellipse x^T S^-1 x = 1 about the origin, from its S11, S12, S22; NaN where it is none."""
    values, axes = np.linalg.eigh(np.nan_to_num(packed[[0, 1, 1, 2]]).reshape(2, 2))
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rim = np.stack([np.cos(turn), np.sin(turn)], axis=1) * np.sqrt(np.maximum(values, 0)) @ axes.T
    return rim if np.isfinite(packed).all() else np.full_like(rim, np.nan)


def outline(canvas: Canvas, points: Array, colour: Colour, width: int = 1) -> None:
    """Draw a closed line through points (N, 2), px; nothing where a point is far off or none."""
    if (np.abs(points) < _FAR).all():
        fixed = np.rint(points * 2**_SHIFT).astype(np.int32)
        cv2.polylines(canvas, [fixed], True, colour, width, cv2.LINE_AA, _SHIFT)


def segment(canvas: Canvas, a: Array, b: Array, colour: Colour, width: int = 1) -> None:
    """Draw a line between two places (2,), px."""
    outline(canvas, np.array([a, b]), colour, width)


def cross(canvas: Canvas, at: Array, size: float, colour: Colour) -> None:
    """Draw an upright cross with arms of ``size`` px."""
    for arm in (np.array([size, 0.0]), np.array([0.0, size])):
        segment(canvas, at - arm, at + arm, colour)


def arrow(canvas: Canvas, a: Array, b: Array, colour: Colour, width: int = 1) -> None:
    """Draw an arrow from a to b (2,), px, its head never longer than itself."""
    segment(canvas, a, b, colour, width)
    length = float(np.linalg.norm(b - a))
    if length > 1.0:
        along = (b - a) / length * min(9.0, 0.5 * length)
        for side in (1, -1):
            segment(canvas, b, b - along + side * 0.45 * np.array([-along[1], along[0]]), colour, width)
