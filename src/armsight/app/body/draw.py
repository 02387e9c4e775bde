"""A body's markers, or a calibration board, on paper, to scale: ``armsight body draw``.

Markers are sorted by plane. The coordinates of a ``Page`` are millimetres, x to the right and y down, the body's
origin projected to (0, 0). Then each page is put on paper: a figure of the paper's size whose only axes cover it and count
millimetres from its upper left corner.
"""

from __future__ import annotations

import contextlib
import hashlib
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import numpy as np

from armsight.app.body import PAPERS
from armsight.app.show.messages import require
from armsight.app.show.plotting import Axes, Figure, drawing, plain
from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_bytes, replacing
from armsight.geometry.pose import transform
from armsight.sim.render.scene import CLEAR, Pattern, aprilgrid, charuco, chessboard, circle_grid, tag
from armsight.vision.markers.aprilgrid import AprilGrid
from armsight.vision.markers.apriltag3 import LAYOUTS, printed
from armsight.vision.markers.aruco import cells
from armsight.vision.markers.board import BOARDS, KALIBR, open_board
from armsight.vision.markers.charuco import Charuco
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.circles import CircleGrid
from armsight.vision.markers.targets import Composite, read_layout
from armsight.vision.pose.predict import face_axes, look_direction

#: A bright disc's dark surround reaches to so many radii; where another marker is in the way, to fewer.
RING, RING_MIN = 2.0, 1.5
#: Two markers are on one plane within this angle (cosine) and this distance, mm.
_PARALLEL, _LEVEL_MM = float(np.cos(np.radians(0.5))), 0.2
#: White edge that printers need, height of what stands below the drawing, and the least width of that, mm.
_EDGE, _FOOT, _FOOT_WIDTH = 10.0, 30.0, 130.0
#: Lengths of the bar and of the body's axes, mm; heights of letters, mm.
_BAR, _ARROW, _TEXT, _SMALL = 100.0, 8.0, 3.2, 2.4
#: How far sheets of a split drawing overlap, and from where to where in the margin their marks reach, mm.
_OVERLAP, _MARK = 10.0, (4.5, 9.0)
_MOST_PIXELS = 150_000_000
_PLAIN: dict[str, Any] = {"linewidth": 0.0, "antialiased": True, "snap": False}

#: Kind of board -> its print.
BOARD_PATTERNS: dict[type, Callable[[Any], Pattern]] = {
    Chessboard: lambda b: chessboard(b.columns, b.rows, b.square_m, black=0.0, white=1.0),
    Charuco: lambda b: charuco(b.columns, b.rows, b.square_m, b.marker_m, b.family, black=0.0, white=1.0),
    CircleGrid: lambda b: circle_grid(
        b.columns,
        b.rows,
        b.pitch_m,
        asymmetric=b.staggered,
        radius_m=b.disc_radius_m,
        rings=b.rings,
        black=float(bool(b.light)),
        white=float(not b.light),
    ),
    AprilGrid: lambda b: aprilgrid(b.columns, b.rows, b.tag_m, b.spacing, black=0.0, white=1.0),
}


@dataclass(frozen=True, eq=False)
class Mark(Record):
    """One marker on its page, mm; before it is on a page, in the body's frame, m, with a third coordinate before radii."""

    name: str  #: what is written beside it
    circles: Array  #: (K, 4) x, y, radius of its discs, and whether they are dark; white ones are printed over all else
    polygons: Array  #: (N, 4, 2) its dark squares
    corners: Array  #: (C, 2) of what it needs for itself, margins included
    middle: Array  #: (3,) its middle, body frame, m
    normal: Array  #: (3,) out of its plane, body frame
    reach: float = 0.0  #: of the dark surround of a bright disc from its middle, mm; 0 for others
    square: bool = True  #: whether that surround is a square, else a circle

    @property
    def box(self) -> Array:
        """(2, 2) low and high corner."""
        return np.stack([self.corners.min(axis=0), self.corners.max(axis=0)])

    def on_page(self, axes: Array) -> Mark:
        """Return it on a page whose axes (3, 3) are right, down and into it."""

        def flat(p_body: Array) -> Array:
            return np.asarray(1e3 * p_body @ axes[:, :2])

        circles = np.column_stack([flat(self.circles[:, :3]), 1e3 * self.circles[:, 3], self.circles[:, 4]])
        corners = flat(self.corners)
        if not len(self.corners):  # a disc
            corners = circles[:, :2] + np.array([[-1.0], [1.0]]) * RING * circles[0, 2]
        return replace(self, circles=circles, polygons=flat(self.polygons), corners=corners)


@dataclass(frozen=True, eq=False)
class Page(Record):
    """One plane of a body."""

    normal: Array  #: (3,) out of the plane, body frame
    axes: Array  #: (3, 3) its axes as columns: right, down, into it, body frame
    marks: tuple[Mark, ...]  #: what is on it

    @property
    def names(self) -> list[str]:
        """The names of its markers."""
        return [mark.name for mark in self.marks]


def pages(path: str | Path, layout: Composite) -> tuple[tuple[Page, ...], list[str]]:
    """Sort a body's markers by the plane they lie in."""
    notes, groups = list[str](), list[list[Mark]]()
    for one in [*_patterns(layout), *_discs(path, layout, notes)]:
        for group in groups:
            level = abs(1e3 * group[0].normal @ (one.middle - group[0].middle))
            if group[0].normal @ one.normal > _PARALLEL and level < _LEVEL_MM:
                group.append(one)
                break
        else:
            groups.append([one])
    out = []
    for group in groups:
        axes = face_axes(group[0].normal)
        marks = [one.on_page(axes) for one in group]
        out.append(Page(group[0].normal, axes, tuple(_surrounded(mark, marks, notes) for mark in marks)))
    if len(out) > 1:
        notes.append(f"the body is not flat: {len(out)} planes, a page each")
    return tuple(out), notes


def _discs(path: str | Path, layout: Composite, notes: list[str]) -> list[Mark]:
    """Return the discs; one without a normal takes that of the one plane in which all markers lie."""
    if (discs := layout.discs) is None:
        return []
    normals, names = np.array(discs.normals), np.array(discs.body.point_names)
    unknown = np.isnan(normals[:, 0])
    if unknown.any():
        normal, points = look_direction(layout.body.points, layout.normals), layout.body.points
        known = layout.normals[np.isfinite(layout.normals[:, 0])]
        level = 1e3 * (points - points.mean(axis=0)) @ normal
        if np.abs(level).max() > _LEVEL_MM or (len(known) and (known @ normal).min() < _PARALLEL):
            raise InputError(
                f"{path}: the body is not flat, so {names[unknown][0]} needs its normal to be plotted: normal = [x, y, z]"
            )
        normals[unknown] = normal
        notes.append(
            f"{', '.join(names[unknown][:4])}: no normal given; plotted as seen from "
            f"({', '.join(f'{c + 0.0:.2g}' for c in normal)}), the other side is the mirror image"
        )
    nothing = np.zeros((0, 3))
    return [
        Mark(
            discs.body.point_names[i],
            np.array([[*p, discs.radii_m[i], not discs.bright[i]]]),
            np.zeros((0, 4, 3)),
            nothing,
            p,
            normals[i],
            RING * 1e3 * discs.radii_m[i] if discs.bright[i] else 0.0,
        )
        for i, p in enumerate(discs.body.points)
    ]


def _patterns(layout: Composite) -> list[Mark]:
    markers = []
    for one in () if layout.tags is None else layout.tags.tags:
        whole = one.family in LAYOUTS
        bits = printed(one.family, one.identity) if whole else cells(one.family, one.identity)
        side_m = one.size_m * (len(bits) / LAYOUTS[one.family].square if whole else 1.0)
        T = one.T_body_tag
        markers.append(_of_pattern(one.name, tag(bits > 0, side_m, black=0.0, white=1.0), T, T[:3, 3], -T[:3, 2]))
    for two in () if layout.boards is None else layout.boards.boards:
        pattern, T = BOARD_PATTERNS[type(two.board)](two.board), two.T_body_board
        markers.append(_of_pattern(two.name, pattern, T @ pattern.T_body_pattern, T[:3, 3], two.normal))
    return markers


def _of_pattern(name: str, pattern: Pattern, T_body_pattern: Array, middle: Array, normal: Array) -> Mark:
    """Return a pattern as a marker; its dark squares side by side are one."""

    def in_body(xy: Array) -> Array:
        return np.asarray(transform(T_body_pattern, np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1)))

    xs, ys, quads = pattern.x_edges, pattern.y_edges, []
    for j, row in enumerate((pattern.values < 0.5) & (pattern.values != CLEAR)):
        ends = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
        quads += [_corners(xs[[a, b]], ys[[j, j + 1]]) for a, b in ends.reshape(-1, 2)]
    outer, discs = _corners(xs[[0, -1]], ys[[0, -1]]), pattern.discs
    circles = np.column_stack([in_body(discs[:, :2]), discs[:, 2], discs[:, 3] < 0.5])
    return Mark(name, circles, in_body(np.array(quads).reshape(-1, 4, 2)), in_body(outer), middle, normal)


def _corners(x: Array, y: Array) -> Array:
    return np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])])


def _surrounded(mark: Mark, marks: list[Mark], notes: list[str]) -> Mark:
    """Return a mark whose dark surround leaves the others alone: a smaller circle where a square would not."""
    if not mark.reach:
        return mark
    at, radius = mark.circles[0, :2], mark.circles[0, 2]
    # Dark surrounds may run into each other, but not over a bright disc.
    boxes = [other.box for other in marks if not other.reach]
    gaps = [np.maximum(0.0, np.maximum(low - at, at - high)) for low, high in boxes]
    if all((gap >= mark.reach).any() for gap in gaps):
        return mark
    reach = float(np.clip(min(np.hypot(*gap) for gap in gaps), radius, mark.reach))
    if reach < RING_MIN * radius:
        notes.append(f"{mark.name} has only {reach - radius:.1f} mm of dark surround: a marker beside it is too near")
    return replace(mark, corners=np.stack([at - reach, at + reach]), reach=reach, square=False)


@dataclass(frozen=True, eq=False)
class Drawing(Record):
    """A drawing that was written."""

    files: tuple[str, ...]  #: the files written
    pages: tuple[Page, ...]  #: what is on each page
    of: tuple[str, ...]  #: the body or board of each page
    notes: tuple[str, ...]  #: what should be said about it


@dataclass(frozen=True)
class _Sheet:
    """One of the sheets that a drawing is split over; mm."""

    paper: tuple[float, float]  #: its width and height
    low: tuple[float, float]  #: x and y of the drawing at the upper left corner of its printed part
    cuts: tuple[Array, Array]  #: x of the upright, y of the level lines of the drawing along which sheets are joined
    label: str  #: which one it is


def is_board_spec(path: str | Path) -> bool:
    """Say whether what is to be drawn is a board: a spec, or Kalibr's target file."""
    if Path(path).suffix.lower() in KALIBR:
        return True
    return str(path).strip().split(":")[0] in BOARDS or (":" in str(path) and not Path(path).exists())


def draw_body(
    paths: Sequence[str | Path], output: str | Path, *, paper: str = "a4", dpi: int = 600, split: bool = False
) -> Drawing:
    """Draw bodies' markers and boards to scale.

    ``paths``: TOML body files, and boards' specs such as ``chessboard:9x6:20mm``. ``paper``: a key of PAPERS; rotated
    where that fits better. ``dpi``: pixels an inch of a .png. ``split``: draw a plane that does not fit the paper on
    several sheets that overlap.
    """
    suffix = Path(output).suffix.lower()
    if suffix not in _SAVERS:
        raise InputError(f"{output}: a drawing is a {', '.join(_SAVERS)} file, by its suffix")
    require("drawing a body", "report", "matplotlib")
    planes, of, heads, notes = list[Page](), list[str](), list[tuple[str, str]](), list[str]()
    for path in paths:
        its_own, head, foot = _pages_of(path, notes)
        many = len(its_own) > 1
        heads += [(head + (f", plane {k} of {len(its_own)}" if many else ""), foot) for k in range(1, len(its_own) + 1)]
        planes, of = [*planes, *its_own], [*of, *([str(path)] * len(its_own))]
    sizes = [_paper(path, page, paper, split) for path, page in zip(of, planes, strict=True)]
    parts = [_sheets(size, PAPERS[paper]) if split and paper != "fit" else [] for size in sizes]
    papers = [each[0].paper if each else size for each, size in zip(parts, sizes, strict=True)]
    most = max(width * height for width, height in papers) * (dpi / 25.4) ** 2
    if suffix == ".png" and most > _MOST_PIXELS:
        allowed = int(dpi * np.sqrt(_MOST_PIXELS / most))
        raise InputError(
            f"{output}: {most / 1e6:.0f} million pixels are too many: take --dpi {allowed} or less, or a .pdf or .svg"
        )
    with drawing():
        figures = []
        for number, (page, size, sheets, texts) in enumerate(zip(planes, sizes, parts, heads, strict=True), start=1):
            figures += [_figure(page, size, *texts, sheet) for sheet in (*sheets,) or (None,)]
            if sheets:
                notes.append(
                    f"page {number} is split over {len(sheets)} sheets that overlap by {_OVERLAP:g} mm: cut each along the "
                    "marks in its margins and join them edge to edge"
                )
        files = _SAVERS[suffix](figures, Path(output), dpi)
    return Drawing(tuple(str(file) for file in files), tuple(planes), tuple(of), tuple(notes))


def _pages_of(path: str | Path, notes: list[str]) -> tuple[tuple[Page, ...], str, str]:
    if is_board_spec(path):
        return (_board_page(str(path)),), plain(str(path)), "drawn by armsight body draw"
    layout = read_layout(path)
    planes, odd = pages(path, layout)
    notes += odd
    foot = f"{plain(Path(path).name)}   sha256 {hashlib.sha256(read_bytes(path)).hexdigest()[:16]}"
    return planes, plain(layout.name), foot


def _board_page(spec: str) -> Page:
    board = open_board(spec)
    if next(iter(board.codes[1]), 0):
        raise InputError(f"{spec}: boards are drawn with ids from 0 on only; leave out first={board.codes[1][0]}")
    pattern = BOARD_PATTERNS[type(board)](board)
    axes = np.diag([1.0, -1.0, -1.0]) if board.y_up else np.eye(3)
    mark = _of_pattern("", pattern, pattern.T_body_pattern, np.zeros(3), -axes[:, 2]).on_page(axes)
    dark = mark.circles[mark.circles[:, 3] > 0]
    ink = [mark.polygons.reshape(-1, 2), *(dark[:, :2] + sign * dark[:, 2:3] for sign in (-1.0, 1.0))]
    return Page(-axes[:, 2], axes, (replace(mark, corners=np.concatenate(ink)),))


def _sheets(size: tuple[float, float], paper: tuple[float, float]) -> list[_Sheet]:
    """Return the sheets that a drawing is split over, row by row, on upright or rotated paper, whichever are fewer."""
    if _rotated(paper, np.array(size)) is not None:
        return []
    steps = {form: np.array(form) - 2 * _EDGE - _OVERLAP for form in (paper, paper[::-1])}
    counts = {form: np.ceil((np.array(size) - _OVERLAP) / step).astype(int) for form, step in steps.items()}
    form = min(counts, key=lambda each: int(counts[each].prod()))
    (columns, rows), (wide, tall) = counts[form].tolist(), steps[form]
    cuts = np.arange(1, columns) * wide + _OVERLAP / 2, np.arange(1, rows) * tall + _OVERLAP / 2
    parts = [(row, column) for row in range(rows) for column in range(columns)]
    label = "sheet {} of {}: row {}, column {}"
    return [
        _Sheet(form, (column * wide, row * tall), cuts, label.format(n, len(parts), row + 1, column + 1))
        for n, (row, column) in enumerate(parts, 1)
    ]


def _content(page: Page) -> Array:
    boxes = np.array([mark.box for mark in page.marks])
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    if not any(page.names):
        return np.array([low, high])
    half = [0.6 * _TEXT * len(plain(name, 24)) / 2 for name in page.names]
    middle = boxes[:, :, 0].mean(axis=1)
    low[0], high[0] = min(low[0], (middle - half).min()), max(high[0], (middle + half).max())
    return np.array([low - 2 * _TEXT, high + 2 * _TEXT])


def _paper(path: str | Path, page: Page, paper: str, split: bool) -> tuple[float, float]:
    needed = _needed(page)
    size = None if paper == "fit" else _rotated(PAPERS[paper], needed)
    if paper == "fit" or (size is None and split):
        return float(np.ceil(needed[0])), float(np.ceil(needed[1]))
    if size is None:
        larger = [name for name, each in PAPERS.items() if name != "fit" and _rotated(each, needed) is not None]
        hint = f"--paper {larger[0]}, or " if larger else ""
        if smaller := next((each for each in _smaller(str(path)) if _fits(each, paper)), ""):
            hint = f"{smaller}, the largest that fits, or {hint}"
        what = f"the plane of {', '.join(page.names[:3])}" if any(page.names) else "the board"
        raise InputError(
            f"{path}: {what} needs {needed[0]:.0f} x {needed[1]:.0f} mm of paper, and "
            f"{paper} is {PAPERS[paper][0]:g} x {PAPERS[paper][1]:g} mm: take {hint}--paper fit for a plotter, or "
            "--split for several sheets to join"
        )
    return size


def _needed(page: Page) -> Array:
    """Return the width and height that a page needs (2,), mm."""
    low, high = _content(page)
    needed = high - low + [2 * _EDGE, 2 * _EDGE + _FOOT]
    needed[0] = max(needed[0], _FOOT_WIDTH + 2 * _EDGE)
    return np.asarray(needed)


def _smaller(spec: str) -> Iterator[str]:
    """Yield a board's spec with its first length in whole millimetres less and less, the others in proportion."""
    lengths = [float(each) for each in re.findall(r"(?<=[:=])(\d+(?:\.\d+)?)mm", spec)]
    for first in range(int(np.ceil(lengths[0])) - 1 if lengths and is_board_spec(spec) else 0, 0, -1):
        shrunk = [f"{round(each * first / lengths[0], 1):g}mm" for each in lengths]
        parts = re.split(r"(?<=[:=])\d+(?:\.\d+)?mm", spec)
        yield "".join(part + length for part, length in zip(parts, [*shrunk, ""], strict=True))


def _fits(spec: str, paper: str) -> bool:
    return _rotated(PAPERS[paper], _needed(_board_page(spec))) is not None


def _rotated(size: tuple[float, float], needed: Array) -> tuple[float, float] | None:
    """Return a paper's size upright or, where that does not fit, rotated; None where neither does."""
    return next((s for s in (size, size[::-1]) if needed[0] <= s[0] and needed[1] <= s[1]), None)


def _figure(page: Page, size: tuple[float, float], head: str, foot: str, sheet: _Sheet | None = None) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    paper = size if sheet is None else sheet.paper
    figure = Figure(figsize=(paper[0] / 25.4, paper[1] / 25.4))
    FigureCanvasAgg(figure)
    axes = _window(figure, paper, (0.0, 0.0), 0.0)
    if sheet is not None:
        _joints(axes, sheet)
        axes = _window(figure, paper, sheet.low, _EDGE)
    (width, height), (low, high) = size, _content(page)
    room = np.array([width, height - _FOOT])
    shift = (room - (high - low)) / 2 - low
    _print(axes, page.marks, shift)
    taken = [mark.box + shift for mark in page.marks]
    at, title = shift, ""
    if not _free(np.array([at - 5.0, at + 17.0]), taken) or (at < _EDGE).any() or (at > room - _EDGE).any():
        at, title = np.array([width - _EDGE - 14.0, height - _EDGE - 9.0]), "body's axes"
    taken.append(np.array([at - 5.0, at + 17.0]))
    _arrows(axes, page, at, title)
    for mark in page.marks:
        _name(axes, mark, shift, taken)
    x, y = _EDGE, height - _EDGE - 12.0  # the bar that checks the printer, and what this is
    axes.plot([x, x + _BAR], [y, y], color="black", lw=0.8, solid_capstyle="butt")
    for mm in range(0, int(_BAR) + 1, 10):
        axes.plot([x + mm] * 2, [y, y - (1.8 if mm % 50 else 3.0)], color="black", lw=0.6, solid_capstyle="butt")
    _write(axes, np.array([x, y - 4.0]), "this bar is 100 mm long: print at 100%, then measure it", _SMALL, va="bottom")
    seen = f"seen from ({', '.join(f'{c + 0.0:.3g}' for c in page.normal.round(6))})"
    for row, line in enumerate([f"{head}, {seen}", foot]):
        _write(axes, np.array([x, y + 5.0 + 4.5 * row]), line, _SMALL, va="center")
    return figure


def _window(figure: Figure, paper: tuple[float, float], low: tuple[float, float], edge: float) -> Axes:
    """Return axes in mm on a paper less its edges, whose upper left corner is ``low``."""
    (width, height), (x, y) = paper, low
    axes = figure.add_axes((edge / width, edge / height, 1.0 - 2 * edge / width, 1.0 - 2 * edge / height))
    axes.set_axis_off()
    axes.set_xlim(x, x + width - 2 * edge)
    axes.set_ylim(y + height - 2 * edge, y)
    return axes


def _joints(axes: Axes, sheet: _Sheet) -> None:
    width, height = sheet.paper
    for i, size, across in ((0, width, height), (1, height, width)):
        cuts = _EDGE + sheet.cuts[i] - sheet.low[i]
        for at in cuts[(cuts > _EDGE) & (cuts < size - _EDGE)]:
            for ends in (_MARK, (across - _MARK[1], across - _MARK[0])):
                line = ((at, at), ends) if i == 0 else (ends, (at, at))
                axes.plot(*line, color="black", lw=0.4, solid_capstyle="butt")
    _write(axes, np.array([_EDGE + 30.0, height - 6.5]), sheet.label, _SMALL, va="center")


def _print(axes: Axes, marks: tuple[Mark, ...], shift: Array) -> None:
    """Draw markers: dark surrounds, discs, dark squares as one path, so that no seam shows between them, white discs."""
    from matplotlib.patches import Circle, PathPatch, Rectangle
    from matplotlib.path import Path as Outline

    for mark in marks:
        if mark.reach:
            x, y = mark.circles[0, :2] + shift
            corner, side = (x - mark.reach, y - mark.reach), 2 * mark.reach
            surround = Rectangle(corner, side, side) if mark.square else Circle((x, y), mark.reach)
            surround.set(facecolor="black", **_PLAIN)
            axes.add_patch(surround)
    for mark in marks:
        for x, y, radius, dark in mark.circles:
            colour = {"facecolor": "black"} if dark else {"facecolor": "white", "zorder": 2}
            axes.add_patch(Circle((x + shift[0], y + shift[1]), radius, **colour, **_PLAIN))
        if len(mark.polygons):
            corners = np.concatenate([mark.polygons, mark.polygons[:, :1]], axis=1) + shift
            codes = np.tile([Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY], len(corners))
            axes.add_patch(PathPatch(Outline(corners.reshape(-1, 2), codes), facecolor="black", **_PLAIN))


def _name(axes: Axes, mark: Mark, shift: Array, taken: list[Array]) -> None:
    low, high = mark.box + shift
    if not (name := plain(mark.name, 24)):
        return
    half = np.array([0.3 * _TEXT * len(name), 0.6 * _TEXT])
    middle, beyond = (low + high) / 2, (high - low) / 2 + half + 1.0
    positions = [middle + beyond * step for step in np.array([[0, 1], [0, -1], [1, 0], [-1, 0]])]
    at = next((p for p in positions if _free(np.array([p - half, p + half]), taken)), positions[0])
    taken.append(np.array([at - half, at + half]))
    _write(axes, at, name, _TEXT, ha="center", va="center")


def _free(box: Array, taken: list[Array]) -> bool:
    return not any((box[0] < other[1]).all() and (box[1] > other[0]).all() for other in taken)


def _write(axes: Axes, at: Array, text: str, height_mm: float, **more: str) -> None:
    """Write text of a height; a dollar sign is a dollar sign."""
    style: Any = {
        "fontsize": height_mm * 72 / 25.4 / 0.72,
        "color": "black",
        "parse_math": False,
        "clip_on": True,
        **more,
    }
    axes.text(float(at[0]), float(at[1]), text, **style)


def _arrows(axes: Axes, page: Page, at: Array, title: str) -> None:
    line: Any = {"arrowstyle": "-|>", "color": "black", "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
    away = [title] if title else []
    for letter, (right, down, into) in zip("xyz", page.axes, strict=True):
        along = np.array([right, down])
        if np.linalg.norm(along) > 0.2:
            axes.annotate("", xy=tuple(at + _ARROW * along), xytext=tuple(at), arrowprops=line)
            _write(axes, at + (_ARROW + 2.5) * along, letter, _SMALL, ha="center", va="center")
        if abs(into) > 0.2:
            away.append(f"{letter} {'into' if into > 0 else 'out of'} the page")
    beside = np.array([-_ARROW - 4.5, 0.0]) if title else np.array([-2.0, -1.5])
    how = {"ha": "right", "va": "center"} if title else {"ha": "left", "va": "bottom"}
    _write(axes, at + beside, ", ".join(away), _SMALL, **how)


def _save_pdf(figures: list[Figure], output: Path, dpi: int) -> list[Path]:
    from matplotlib.backends.backend_pdf import PdfPages

    nothing: dict[str, Any] = {"CreationDate": None, "Creator": "armsight", "Producer": None}
    with replacing(output, "wb") as file, PdfPages(file, metadata=nothing) as book:
        for figure in figures:
            book.savefig(figure, dpi=dpi)
    return [output]


def _save_each(figures: list[Figure], output: Path, dpi: int) -> list[Path]:
    """Write a file for each page: all of them, or none."""
    kind = output.suffix.lower()[1:]
    files = [output, *(output.with_stem(f"{output.stem}-{n}") for n in range(2, len(figures) + 1))]
    with contextlib.ExitStack() as stack:
        opened: list[IO[Any]] = [stack.enter_context(replacing(file, "wb")) for file in files]
        for figure, file in zip(figures, opened, strict=True):
            figure.savefig(file, format=kind, dpi=dpi, metadata={"Date" if kind == "svg" else "Software": None})
    return files


_SAVERS = {".pdf": _save_pdf, ".svg": _save_each, ".png": _save_each}
