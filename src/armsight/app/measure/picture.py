"""One shot as a picture: what was measured, both images side by side, and below them the points enlarged."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from armsight.app.report.plotting import nice, plain
from armsight.app.view_marks import Marks
from armsight.app.view_paint import (
    BLANK,
    INK,
    LINE,
    MUTED,
    PAPER,
    RED,
    Canvas,
    Colour,
    arrow,
    beside,
    cross,
    ellipse,
    outline,
    paper,
    paragraph,
    segment,
    text_width,
    wrapped,
    write,
)
from armsight.data import SIDES, Array, Image
from armsight.vision.image import grey

#: Width of a picture, height of its two images at the most, side of an enlarged place: px.
WIDTH, _TALLEST, _TILE, _GAP = 1640, 760, 264, 12
_HALF = (WIDTH - 3 * _GAP) // 2
_PER_ROW = (WIDTH - _GAP) // (2 * _TILE + _GAP)
_MIDDLE = np.full(2, (_TILE - 1) / 2)
#: Up to so many points are all shown enlarged; of more only the worst few.
_ALL, _WORST = 12, 6
#: How many times larger a place is shown: less where its disc would not fit.
_ZOOM = 8.0
#: Length of the longest residual, px of the picture: in an enlarged place, where sigma counts as well, and in the images.
_REACH, _LONGEST = 0.42 * _TILE, 40.0
_MOST = 1e5
_RIM, _CROSS, _ARROW, _SIGMA = (255, 200, 40), (70, 220, 70), (30, 110, 255), (235, 70, 225)
_PALE = (160, 160, 255)


def draw_shot(
    header: Sequence[str],
    problem: str | None,
    images: tuple[Image | None, Image | None],
    sizes: tuple[tuple[int, int], tuple[int, int]],
    marks: Marks | None,
) -> Canvas:
    """Draw a shot.

    Args:
        header: lines above the images.
        problem: why nothing was measured; None where something was.
        images: left and right; None where there is none.
        sizes: (width, height) of the images that are not there, px.
        marks: the body's points; None where nothing was measured.

    Returns:
        (H, WIDTH, 3) BGR picture.
    """
    panels = [_Panel(side, image, size) for side, image, size in zip(SIDES, images, sizes, strict=True)]
    parts = [paragraph(header, INK, 0.6, WIDTH, _GAP)]
    if problem is not None:
        parts.append(paragraph([f"missed: {problem}"], RED, 0.6, WIDTH, _GAP))
    below: list[Canvas] = []
    if marks is not None:
        shown = marks.worst(_ALL if len(marks.names) <= _ALL else _WORST)
        factor = _factor(np.linalg.norm(marks.residual, axis=2)[~marks.dropped], _LONGEST)
        for side, panel in enumerate(panels):
            panel.draw(marks, side, shown, factor)
        below = [*_places(marks, shown, panels, factor), *_unshown(marks, shown)]
    parts += [beside([panel.titled() for panel in panels], WIDTH, _GAP), *below]
    return np.vstack([paper(_GAP, WIDTH), *(canvas for part in parts for canvas in (part, paper(_GAP, WIDTH)))])


class _Panel:
    """One camera's image as it stands in the picture."""

    def __init__(self, side: str, image: Image | None, size: tuple[int, int]) -> None:
        self.image = None if image is None else cv2.cvtColor(grey(image), cv2.COLOR_GRAY2BGR)
        self.title = side if image is not None else f"{side}: no image"
        width, height = size if self.image is None else (self.image.shape[1], self.image.shape[0])
        self.scale = min(_HALF / width, _TALLEST / height)
        shown = (max(round(width * self.scale), 1), max(round(height * self.scale), 1))
        how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR
        blank: Canvas = np.full((shown[1], shown[0], 3), BLANK, np.uint8)
        self.canvas: Canvas = (
            blank if self.image is None else np.asarray(cv2.resize(self.image, shown, interpolation=how), np.uint8)
        )

    def draw(self, marks: Marks, side: int, named: list[int], factor: float) -> None:
        """Draw every point, its residual ``factor`` times as long, and the names of some."""
        places = (marks.at[:, side] + 0.5) * self.scale - 0.5
        for i, at in enumerate(places):
            bad = marks.dropped[i, side]
            outline(self.canvas, ellipse(marks.shape[i, side]) * self.scale + at, RED if bad else _RIM)
            if np.isfinite(marks.found[i, side]).all():
                cross(self.canvas, at + self.scale * marks.residual[i, side], 3.0, RED if bad else _CROSS)
            arrow(self.canvas, at, at + factor * marks.residual[i, side], RED if bad else _ARROW)
        good = np.asarray((np.abs(np.nan_to_num(places, nan=np.inf)) < 2 * WIDTH).all(axis=1))
        middle = places[good].mean(axis=0) if good.any() else np.zeros(2)
        for i in (i for i in named if good[i]):
            # Away from the middle of the body, where the other names are.
            away = (places[i] - middle) / max(float(np.linalg.norm(places[i] - middle)), 1.0)
            wide = float(np.sqrt(np.nan_to_num(marks.shape[i, side, 0]))) * self.scale
            text, at = plain(marks.names[i], 24), places[i] + (wide + 10.0) * away
            left = round(float(at[0])) - (text_width(text, 0.5) if away[0] < 0 else 0)
            colour = _PALE if marks.dropped[i, side] else PAPER
            write(self.canvas, text, (left, round(float(at[1])) + 5), colour, 0.5, rim=INK)

    def titled(self) -> Canvas:
        """Return the image with the name of its side in the corner."""
        write(self.canvas, self.title, (8, 20), PAPER, 0.55, rim=INK)
        return self.canvas

    def place(self, centre: Array, zoom: float) -> Canvas:
        """Return a square around a place (2,), raw px, pixels as squares; grey where there is no image."""
        if self.image is None or not np.isfinite(centre).all():
            return np.full((_TILE, _TILE, 3), BLANK, np.uint8)
        to_image = np.column_stack([np.eye(2) / zoom, centre - _MIDDLE / zoom])
        how = (cv2.INTER_NEAREST if zoom > 1 else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
        edge = (BLANK, BLANK, BLANK)
        tile = cv2.warpAffine(
            self.image, to_image, (_TILE, _TILE), flags=how, borderMode=cv2.BORDER_CONSTANT, borderValue=edge
        )
        return np.asarray(tile, np.uint8)


def _factor(lengths: Array, reach: float) -> float:
    """Return a round factor that makes the longest of lengths at most ``reach``; 1 where all are nothing."""
    longest = float(np.nan_to_num(lengths).max(initial=0.0))
    return nice(min(reach / longest, _MOST)) if longest > 0 else 1.0


def _places(marks: Marks, shown: list[int], panels: list[_Panel], in_images: float) -> list[Canvas]:
    """Return the enlarged places, row by row, and the legend below them."""
    if not shown:
        return []
    wide = float(np.sqrt(np.nan_to_num(marks.shape[shown][..., [0, 2]]).max()))
    zoom = min(_ZOOM, _TILE / (2.6 * wide)) if wide > 0 else _ZOOM
    used = ~marks.dropped[shown]
    sigma = np.sqrt(np.linalg.eigvalsh(marks.cov[shown])[..., 1])
    lengths = np.maximum(np.nan_to_num(np.linalg.norm(marks.residual[shown], axis=2)), 1.2 * sigma)
    factor = _factor(lengths[used] if used.any() else lengths, _REACH)
    blocks = [_block(marks, i, panels, zoom, factor) for i in shown]
    rows = [beside(blocks[k : k + _PER_ROW], WIDTH, _GAP) for k in range(0, len(blocks), _PER_ROW)]
    return [*rows, _legend(marks, zoom, factor, in_images)]


def _block(marks: Marks, i: int, panels: list[_Panel], zoom: float, factor: float) -> Canvas:
    """Return one point enlarged, left and right: its name above, its residuals and its fate below."""
    tiles, name = [], plain(marks.names[i], 40)
    for side, panel in enumerate(panels):
        tile, residual, bad = panel.place(marks.at[i, side], zoom), marks.residual[i, side], marks.dropped[i, side]
        outline(tile, ellipse(marks.shape[i, side]) * zoom + _MIDDLE, RED if bad else _RIM)
        if np.isfinite(residual).all():
            outline(tile, ellipse(marks.cov[i, side].ravel()[[0, 1, 3]]) * factor + _MIDDLE, _SIGMA)
            cross(tile, _MIDDLE + zoom * residual, 9.0, _CROSS)
            arrow(tile, _MIDDLE, _MIDDLE + factor * residual, RED if bad else _ARROW, 2)
        cv2.rectangle(tile, (0, 0), (_TILE - 1, _TILE - 1), RED if bad else MUTED, 1)
        tiles.append(tile)
    words = paper(2 * LINE, 2 * _TILE)
    lost = [side for side, bad in zip(SIDES, marks.dropped[i], strict=True) if bad]
    if lost:
        name += ", dropped" if len(lost) == 2 else f", dropped in the {lost[0]} image"
    write(words, name, (2, 17), RED if lost else INK, 0.6)
    for side, off in enumerate(np.linalg.norm(marks.residual[i], axis=1)):
        unseen = "not used" if marks.dropped[i, side] else "not seen"
        told = f"{off:.3f} px off" if np.isfinite(off) else unseen
        write(words, f"{SIDES[side]}: {told}", (2 + side * _TILE, LINE + 17), MUTED, 0.5)
    reason = wrapped(marks.reasons[i], 0.5, 2 * _TILE - 4)[:2] if marks.reasons[i] else []
    return np.vstack([words, np.hstack(tiles), paragraph(reason, RED, 0.5, 2 * _TILE, 2)])


def _legend(marks: Marks, zoom: float, factor: float, in_images: float) -> Canvas:
    """Say what is drawn, with a bar for the length of the enlarged vectors."""
    discs = bool(np.isfinite(marks.shape).any())
    detected = (
        "detected centre of its ellipse (the place used plus the perspective bias)" if discs else "detected place"
    )
    entries: list[tuple[Colour, str]] = [
        *([(_RIM, "rim a disc should have at the located pose")] if discs else []),
        (_CROSS, detected),
        (_ARROW, f"residual, from the pose's projection to the detection, {factor:g}x; in the images {in_images:g}x"),
        (_SIGMA, f"1 sigma of the detection, {factor:g}x"),
        *([(RED, "dropped")] if marks.dropped.any() else []),
    ]
    canvas, x, y = paper(3 * LINE, WIDTH), _GAP, 17
    for colour, text in entries:
        width = text_width(text, 0.5)
        if x + 26 + width > WIDTH - _GAP:
            x, y = _GAP, y + LINE
        cv2.rectangle(canvas, (x, y - 11), (x + 16, y - 1), colour, -1)
        write(canvas, text, (x + 24, y), INK, 0.5)
        x += width + 54
    y += LINE
    bar = nice(0.6 * _TILE / factor)
    segment(canvas, np.array([_GAP, y - 5.0]), np.array([_GAP + bar * factor, y - 5.0]), INK, 2)
    text = f"{bar:g} px of residual and sigma; places enlarged {zoom:.3g}x"
    write(canvas, text, (round(_GAP + bar * factor) + 10, y), INK, 0.5)
    return canvas[: y + 7]


def _unshown(marks: Marks, shown: list[int]) -> list[Canvas]:
    """Say in words what is not shown enlarged."""
    count, lines = len(marks.names), []
    if len(shown) < count:
        lines.append(f"enlarged: the worst {len(shown)} of {count} points, dropped ones first")
    unseen = [marks.names[i] for i in np.flatnonzero(~marks.seen.any(axis=1) & ~marks.dropped.any(axis=1))]
    if unseen:
        more = f" and {len(unseen) - 20} more" if len(unseen) > 20 else ""
        lines.append(f"seen by neither camera: {', '.join(unseen[:20])}{more}")
    rest = [
        f"{marks.names[i]} ({marks.reasons[i]})" for i in np.flatnonzero(marks.dropped.any(axis=1)) if i not in shown
    ]
    rest += marks.others
    if rest:
        more = f" and {len(rest) - 8} more" if len(rest) > 8 else ""
        lines.append(f"also dropped: {', '.join(rest[:8])}{more}")
    return [paragraph(lines, MUTED, 0.5, WIDTH, _GAP)] if lines else []
