"""One shot as a picture: what was measured, both images side by side, and below them the points enlarged.

A disc is shown by its image ellipse. A measurement corrects the detected centre for the perspective bias; here it is added
again, so that the detection lies in its ellipse. Text is ASCII: other characters are spelt out, or a question mark.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.app.show import plotting
from armsight.app.show.plotting import bgr, nice, plain
from armsight.data import SIDES, Array, Body, Image, PoseEstimate, Record
from armsight.geometry.pose import transform
from armsight.vision.discs.bias import expect
from armsight.vision.image import grey
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.pose.shot_pose import ANGLES, ShotPose
from armsight.vision.rig import StereoRig

Canvas = NDArray[np.uint8]
Colour = tuple[int, int, int]

PAPER, INK, MUTED, RED, _PALE = map(bgr, ("#ffffff", plotting.INK, plotting.MUTED, plotting.RED, "#ffa0a0"))
BLANK = 200  # grey value where there is no image
LINE = 24  # height of a line of text, px
_FONT = cv2.FONT_HERSHEY_SIMPLEX
#: OpenCV takes coordinates in sixteenths of a pixel; points further away, px, are not drawn; half,
#: double: nothing, no canvas is a tenth as large.
_SHIFT, _FAR = 4, 1e5
_SPELT = str.maketrans({"±": "+-", "…": "...", "°": " deg", "σ": "sigma", "µ": "u", "×": "x"})


#: What is printed behind the angles at their singularity.
SINGULAR = " (ry is +-90: only rz and rx together are determined)"
#: Width of a picture, height of its two images at the most, side of an enlarged detail: px.
WIDTH, _TALLEST, _TILE, _GAP = 1640, 760, 264, 12
_HALF = (WIDTH - 3 * _GAP) // 2
_PER_ROW = (WIDTH - _GAP) // (2 * _TILE + _GAP)
_MIDDLE = np.full(2, (_TILE - 1) / 2)
#: Up to this many points are all shown enlarged; of more only the worst few.
_ALL, _WORST = 12, 6
#: Enlargement of a detail; less where its disc would not fit; arms of a cross in an image, px.
_ZOOM, _CROSS_PX = 8.0, 3.0
#: Enlargement of a residual at the most; half: residuals below 8e-4 px are drawn shorter, double: below 2e-4 px.
_MOST = 1e5
#: Length of the longest residual, px of the picture: in an enlarged detail, where sigma counts as well, and in the images.
_REACH, _LONGEST = 0.42 * _TILE, 40.0
_RIM, _CROSS, _ARROW, _SIGMA = (255, 200, 40), (70, 220, 70), (30, 110, 255), (235, 70, 225)


@dataclass(frozen=True, eq=False)
class Marks(Record):
    """The N points of a body in a measured shot; camera 0 is left, 1 right. NaN where there is none."""

    names: tuple[str, ...]  #: names of the points
    #: (N, 2, 2) projection of a point, or of its ellipse's centre, at the measured pose, raw px; NaN where it faces
    #: away
    at: Array
    shape: Array  #: (N, 2, 3) S11, S12, S22 of a disc's ellipse at the measured pose, px^2
    found: Array  #: (N, 2, 2) detected position, raw px; of a disc the centre of its ellipse
    cov: Array  #: (N, 2, 2, 2) its covariance, px^2
    dropped: NDArray[np.bool_]  #: (N, 2) whether the detection was dropped
    reasons: tuple[str, ...]  #: why; empty where neither was
    others: tuple[str, ...]  #: what else was dropped, and why

    @property
    def residual(self) -> Array:
        """(N, 2, 2) detection minus projection, px."""
        return np.asarray(self.found - self.at)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(N, 2) whether a point was detected."""
        return np.asarray(np.isfinite(self.found[..., 0]))

    def worst(self, most: int) -> list[int]:
        """Return the rows to show enlarged: all if there are at most ``most``, else the dropped and the worst."""
        if len(self.names) <= most:
            return list(range(len(self.names)))
        length = np.nan_to_num(np.linalg.norm(self.residual, axis=2)).max(axis=1)
        worst_first: list[int] = np.lexsort([-length, ~self.dropped.any(axis=1)]).tolist()
        return worst_first[:most]


def marks_of(rig: StereoRig, body: Body, discs: DiscTarget | None, estimate: PoseEstimate) -> Marks:
    """Return the marks of a measured shot."""
    T, count, seen = estimate.T_left_body, len(body.points), estimate.points.seen
    at = np.stack(rig.project(transform(T, body.points)), axis=1)
    shape, bias, away = np.full((count, 2, 3), np.nan), np.zeros((count, 2, 2)), np.zeros((count, 2), bool)
    if discs is not None:
        first, expected = count - len(discs.radii_m), expect(rig, discs, T)
        at[first:] = np.where(np.isfinite(expected.uv), expected.uv, at[first:])
        shape[first:], bias[first:], away[first:] = expected.shape, expected.bias, expected.facing <= 0.0
    found, cov = np.full_like(at, np.nan), np.zeros((count, 2, 2, 2))
    found[seen.ids] = seen.uv + np.nan_to_num(bias[seen.ids])
    cov[seen.ids] = seen.cov_uv + rig.sigma_px**2 * np.eye(2)
    hidden = away & ~np.isfinite(found[..., 0])
    at[hidden], shape[hidden] = np.nan, np.nan
    reasons = {name: dict[str, None]() for name in body.point_names}
    for drop in estimate.dropped:
        reasons.get(drop.point, {})[drop.reason] = None
    others = tuple(f"{drop.point}: {drop.reason}" for drop in estimate.dropped if drop.point not in reasons)
    dropped = np.array([_sides(list(each)) for each in reasons.values()], bool)
    why = tuple(_together(list(each)) for each in reasons.values())
    return Marks(body.point_names, at, shape, found, cov, dropped, why, others)


def _sides(reasons: list[str]) -> list[bool]:
    named = [[bool(re.search(rf"\b{side}\b", reason)) for side in SIDES] for reason in reasons]
    return [any(sides[side] or not any(sides) for sides in named) for side in (0, 1)]


def _together(reasons: list[str]) -> str:
    """Join reasons; ``left: why; right: why`` becomes ``both: why``."""
    whys = [reason.removeprefix(f"{side}: ") for side, reason in zip(SIDES, reasons, strict=False)]
    same = len(reasons) == 2 and whys[0] == whys[1] and [f"{side}: {whys[0]}" for side in SIDES] == reasons
    return f"both: {whys[0]}" if same else "; ".join(reasons)


def ascii_text(text: str) -> str:
    """Return a text in ASCII, on one line."""
    return plain(text, 10_000).translate(_SPELT).encode("ascii", "replace").decode()


def wrapped(text: str, size: float, width: int) -> list[str]:
    """Return a text as lines of at most ``width`` px, wrapped at spaces where that is possible."""
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
    """Write one line from its lower left corner, px; ``rim`` is the colour of an outline, for text on an image."""
    text = ascii_text(text)
    if rim is not None:
        for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            cv2.putText(canvas, text, (at[0] + x, at[1] + y), _FONT, size, rim, 1, cv2.LINE_AA)
    cv2.putText(canvas, text, at, _FONT, size, colour, 1, cv2.LINE_AA)


def paragraph(lines: Sequence[str], colour: Colour, size: float, width: int, edge: int = 0) -> Canvas:
    """Return lines of text on white, wrapped where they are too long, ``edge`` px from the left."""
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
    canvas, x = paper(max(part.shape[0] for part in parts), width), gap
    for part in parts:
        canvas[: part.shape[0], x : x + part.shape[1]] = part
        x += part.shape[1] + gap
    return canvas


def ellipse(packed: Array) -> Array:
    """Return (64, 2) rim of an ellipse x^T S^-1 x = 1 about the origin, from its S11, S12, S22; NaN where it is none."""
    values, axes = np.linalg.eigh(np.nan_to_num(packed[[0, 1, 1, 2]]).reshape(2, 2))
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.sqrt(np.maximum(values, 0)) @ axes.T
    return rim if np.isfinite(packed).all() else np.full_like(rim, np.nan)


def outline(canvas: Canvas, points: Array, colour: Colour, width: int = 1) -> None:
    """Draw a closed line through points (N, 2), px; nothing where a point is far outside or NaN."""
    if (np.abs(points) < _FAR).all():
        fixed = np.rint(points * 2**_SHIFT).astype(np.int32)
        cv2.polylines(canvas, [fixed], True, colour, width, cv2.LINE_AA, _SHIFT)


def arrow(canvas: Canvas, a: Array, b: Array, colour: Colour, width: int = 1) -> None:
    """Draw an arrow from a to b (2,), px, its head never longer than itself."""
    outline(canvas, np.array([a, b]), colour, width)
    if (length := float(np.linalg.norm(b - a))) > 1.0:
        along = (b - a) / length * min(9.0, 0.5 * length)
        for side in (0.45, -0.45):
            outline(canvas, np.array([b, b - along + side * np.array([-along[1], along[0]])]), colour, width)


def header(shot: ShotPose) -> list[str]:
    """Return the lines above a shot's picture, mm and degrees, one sigma after each +-."""
    took = f"{shot.way}, {shot.took_ms:.1f} ms" if shot.way is not None and shot.took_ms is not None else shot.way
    at = None if shot.t_s is None else f"t {shot.t_s:.3f} s"
    first = ", ".join(each for each in (f"shot {shot.shot}", at, took, shot.jump) if each)
    if not shot.ok:
        return [first]
    position = _pairs(("x", "y", "z"), 1e3 * shot.position_m, 1e3 * np.sqrt(np.diag(shot.cov_left)[:3]))
    rotation, dropped = _pairs(ANGLES, shot.euler_zyx_deg, shot.angle_sigmas_deg), len(shot.dropped)
    _, precision, calibration = (1e3 * sigma for sigma in shot.position_sigmas_m)
    return [
        first,
        f"{position} mm; {rotation} deg{SINGULAR if shot.pitch_singular else ''}",
        f"precision {precision:.3f} mm, calibration {calibration:.3f} mm; "
        f"reprojection {shot.reprojection_rms_px:.3f} px RMS, misfit {shot.misfit:.1f}, {len(shot.points_m)} points"
        f"{f', {dropped} dropped' if dropped else ''}",
    ]


def _pairs(names: tuple[str, ...], values: Array, sigmas: Array) -> str:
    return ", ".join(
        f"{name} {value:.3f}" + (f" +- {sigma:.3f}" if np.isfinite(sigma) else "")
        for name, value, sigma in zip(names, values, sigmas, strict=True)
    )


def draw_shot(
    header: Sequence[str],
    problem: str | None,
    images: tuple[Image | None, Image | None],
    sizes: tuple[tuple[int, int], tuple[int, int]],
    marks: Marks | None,
) -> Canvas:
    """Draw a shot: (H, WIDTH, 3) BGR; ``header``: lines above; ``sizes``: (width, height) of missing images, px."""
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
        below = [*_details(marks, shown, panels, factor), *_unshown(marks, shown)]
    parts += [beside([panel.titled() for panel in panels], WIDTH, _GAP), *below]
    return np.vstack([paper(_GAP, WIDTH), *(canvas for part in parts for canvas in (part, paper(_GAP, WIDTH)))])


def _point(
    canvas: Canvas, marks: Marks, which: tuple[int, int], at: Array, scale: float, factor: float, arm: float
) -> None:
    """Draw a point and side at a position (2,), px, where there is one: its rim, a cross with such arms, its residual."""
    bad, residual = marks.dropped[which], marks.residual[which]
    outline(canvas, ellipse(marks.shape[which]) * scale + at, RED if bad else _RIM)
    enlarged = arm > _CROSS_PX
    if enlarged and np.isfinite(residual).all():
        outline(canvas, ellipse(marks.cov[which].ravel()[[0, 1, 3]]) * factor + at, _SIGMA)
    for ends in (np.array([[-arm, 0.0], [arm, 0.0]]), np.array([[0.0, -arm], [0.0, arm]])):
        outline(canvas, at + scale * residual + ends, RED if bad and not enlarged else _CROSS)
    arrow(canvas, at, at + factor * residual, RED if bad else _ARROW, 2 if enlarged else 1)


class _Panel:
    def __init__(self, side: str, image: Image | None, size: tuple[int, int]) -> None:
        self.image = None if image is None else cv2.cvtColor(grey(image), cv2.COLOR_GRAY2BGR)
        self.title = side if image is not None else f"{side}: no image"
        width, height = size if self.image is None else (self.image.shape[1], self.image.shape[0])
        self.scale = min(_HALF / width, _TALLEST / height)
        shown = (max(round(width * self.scale), 1), max(round(height * self.scale), 1))
        self.canvas: Canvas = np.full((shown[1], shown[0], 3), BLANK, np.uint8)
        if self.image is not None:
            how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_LINEAR
            self.canvas = np.asarray(cv2.resize(self.image, shown, interpolation=how), np.uint8)

    def draw(self, marks: Marks, side: int, named: list[int], factor: float) -> None:
        """Draw every point, its residual ``factor`` times as long, and the names of some."""
        positions = (marks.at[:, side] + 0.5) * self.scale - 0.5
        for i, at in enumerate(positions):
            _point(self.canvas, marks, (i, side), at, self.scale, factor, _CROSS_PX)
        good = np.asarray((np.abs(np.nan_to_num(positions, nan=np.inf)) < 2 * WIDTH).all(axis=1))
        middle = positions[good].mean(axis=0) if good.any() else np.zeros(2)
        for i in (i for i in named if good[i]):
            # Away from the middle of the body, where the other names are.
            away = (positions[i] - middle) / max(float(np.linalg.norm(positions[i] - middle)), 1.0)
            wide = float(np.sqrt(np.nan_to_num(marks.shape[i, side, 0]))) * self.scale
            text, at = plain(marks.names[i], 24), positions[i] + (wide + 10.0) * away
            left = round(float(at[0])) - (text_width(text, 0.5) if away[0] < 0 else 0)
            colour = _PALE if marks.dropped[i, side] else PAPER
            write(self.canvas, text, (left, round(float(at[1])) + 5), colour, 0.5, rim=INK)

    def titled(self) -> Canvas:
        write(self.canvas, self.title, (8, 20), PAPER, 0.55, rim=INK)
        return self.canvas

    def detail(self, centre: Array, zoom: float) -> Canvas:
        """Return an enlarged square around a position (2,), raw px, pixels as squares; grey where there is no image."""
        if self.image is None or not np.isfinite(centre).all():
            return np.full((_TILE, _TILE, 3), BLANK, np.uint8)
        to_image = np.column_stack([np.eye(2) / zoom, centre - _MIDDLE / zoom])
        how = (cv2.INTER_NEAREST if zoom > 1 else cv2.INTER_LINEAR) | cv2.WARP_INVERSE_MAP
        beyond: Any = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": (BLANK, BLANK, BLANK)}
        return np.asarray(cv2.warpAffine(self.image, to_image, (_TILE, _TILE), flags=how, **beyond), np.uint8)


def _factor(lengths: Array, reach: float) -> float:
    """Return a round factor that makes the longest of lengths at most ``reach``; 1 where all are zero."""
    longest = float(np.nan_to_num(lengths).max(initial=0.0))
    return nice(min(reach / longest, _MOST)) if longest > 0 else 1.0


def _details(marks: Marks, shown: list[int], panels: list[_Panel], in_images: float) -> list[Canvas]:
    if not shown:
        return []
    wide = float(np.sqrt(np.nan_to_num(marks.shape[shown][..., [0, 2]]).max()))
    zoom = min(_ZOOM, _TILE / (2.6 * wide)) if wide > 0 else _ZOOM
    used, sigma = ~marks.dropped[shown], np.sqrt(np.linalg.eigvalsh(marks.cov[shown])[..., 1])
    lengths = np.maximum(np.nan_to_num(np.linalg.norm(marks.residual[shown], axis=2)), 1.2 * sigma)
    factor = _factor(lengths[used] if used.any() else lengths, _REACH)
    blocks = [_block(marks, i, panels, zoom, factor) for i in shown]
    rows = [beside(blocks[k : k + _PER_ROW], WIDTH, _GAP) for k in range(0, len(blocks), _PER_ROW)]
    return [*rows, _legend(marks, zoom, factor, in_images)]


def _block(marks: Marks, i: int, panels: list[_Panel], zoom: float, factor: float) -> Canvas:
    """Return one point enlarged, left and right: its name and residuals above, why it was dropped below."""
    tiles, name, caption = [], plain(marks.names[i], 40), paper(2 * LINE, 2 * _TILE)
    for side, panel in enumerate(panels):
        tile, bad = panel.detail(marks.at[i, side], zoom), marks.dropped[i, side]
        _point(tile, marks, (i, side), _MIDDLE, zoom, factor, 3 * _CROSS_PX)
        cv2.rectangle(tile, (0, 0), (_TILE - 1, _TILE - 1), RED if bad else MUTED, 1)
        tiles.append(tile)
        length = float(np.linalg.norm(marks.residual[i, side]))
        value = f"residual {length:.3f} px" if np.isfinite(length) else "not used" if bad else "not detected"
        write(caption, f"{SIDES[side]}: {value}", (2 + side * _TILE, LINE + 17), MUTED, 0.5)
    if lost := [side for side, bad in zip(SIDES, marks.dropped[i], strict=True) if bad]:
        name += ", dropped" if len(lost) == 2 else f", dropped in the {lost[0]} image"
    write(caption, name, (2, 17), RED if lost else INK, 0.6)
    reason = wrapped(marks.reasons[i], 0.5, 2 * _TILE - 4)[:2] if marks.reasons[i] else []
    return np.vstack([caption, np.hstack(tiles), paragraph(reason, RED, 0.5, 2 * _TILE, 2)])


def _legend(marks: Marks, zoom: float, factor: float, in_images: float) -> Canvas:
    discs = bool(np.isfinite(marks.shape).any())
    found = "centre of its ellipse (the position used plus the perspective bias)" if discs else "position"
    entries: list[tuple[Colour, str]] = [
        *([(_RIM, "predicted rim of a disc at the measured pose")] if discs else []),
        (_CROSS, f"detected {found}"),
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
    outline(canvas, np.array([[_GAP, y - 5.0], [_GAP + bar * factor, y - 5.0]]), INK, 2)
    text = f"{bar:g} px of residual and sigma; details enlarged {zoom:.3g}x"
    write(canvas, text, (round(_GAP + bar * factor) + 10, y), INK, 0.5)
    return canvas[: y + 7]


def _unshown(marks: Marks, shown: list[int]) -> list[Canvas]:
    dropped, lines = marks.dropped.any(axis=1), list[str]()
    if len(shown) < len(marks.names):
        lines.append(f"enlarged: the worst {len(shown)} of {len(marks.names)} points, dropped ones first")
    unseen = [marks.names[i] for i in np.flatnonzero(~marks.seen.any(axis=1) & ~dropped)]
    rest = [f"{marks.names[i]} ({marks.reasons[i]})" for i in np.flatnonzero(dropped) if i not in shown]
    for what, names, most in (("seen by neither camera", unseen, 20), ("also dropped", [*rest, *marks.others], 8)):
        if names:
            more = f" and {len(names) - most} more" if len(names) > most else ""
            lines.append(f"{what}: {', '.join(names[:most])}{more}")
    return [paragraph(lines, MUTED, 0.5, WIDTH, _GAP)] if lines else []
