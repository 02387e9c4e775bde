"""A body's markers, or a calibration board, on paper, to scale: ``armsight body draw``.

In: a body's layout, or a board's spec. Out: a page for each plane of the body, seen from outside, as PDF, SVG or PNG; one
that is larger than the paper is split over several sheets where that is requested.

First the markers are sorted by plane. The coordinates of a ``Page`` are millimetres, x to the right and y down, the body's
origin projected to (0, 0). Then each page is put on paper: a figure of the paper's size whose only axes cover it and count
millimetres from its upper left corner.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from armsight.app.body import PAPERS
from armsight.app.show.plotting import drawing, plain
from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.files import read_bytes, replacing
from armsight.geometry.pose import transform
from armsight.sim.render.scene import CLEAR, Pattern, aprilgrid, charuco, chessboard, circle_grid, tag
from armsight.vision.markers.aprilgrid import AprilGrid
from armsight.vision.markers.apriltag3 import LAYOUTS, printed
from armsight.vision.markers.aruco import cells
from armsight.vision.markers.board import BOARDS, KALIBR, open_board
from armsight.vision.markers.body_layout import Layout, read_layout
from armsight.vision.markers.charuco import Charuco
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.circles import CircleGrid
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.pose.predict import face_axes, look_direction

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: A bright disc's dark surround reaches to so many radii; where another marker is in the way, to fewer.
RING, RING_MIN = 2.0, 1.5
#: Two markers are on one plane within this angle (cosine) and this distance, mm.
_PARALLEL, _LEVEL_MM = float(np.cos(np.radians(0.5))), 0.2

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
    """One marker on its page, mm.

    Attributes:
        name: what is written beside it.
        circles: (K, 3) x, y, radius of its discs.
        dark: whether its discs are dark; then they are printed, else their surround is.
        reach: of the dark surround of a bright disc from its middle, mm; 0 for others.
        square: whether that surround is a square, else a circle.
        polygons: (N, 4, 2) its dark squares.
        box: (2, 2) low and high corner of what it needs for itself, margins included.
        holes: (H, 3) x, y, radius of the white discs printed over all that.
    """

    name: str
    circles: Array
    dark: bool
    reach: float
    square: bool
    polygons: Array
    box: Array
    holes: Array = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Page(Record):
    """One plane of a body.

    Attributes:
        normal: (3,) out of the plane, body frame.
        axes: (3, 3) its axes as columns: right, down, into it, body frame.
        marks: what is on it.
    """

    normal: Array
    axes: Array
    marks: tuple[Mark, ...]

    @property
    def names(self) -> list[str]:
        """The names of its markers."""
        return [mark.name for mark in self.marks]


@dataclass(frozen=True, eq=False)
class _PosedMarker(Record):
    """A marker before it is on a page: its name, middle (3,) and normal (3,), and the function that marks it on a page."""

    name: str
    middle: Array
    normal: Array
    mark: Callable[[Array], Mark]


def pages(path: str | Path, layout: Layout) -> tuple[tuple[Page, ...], list[str]]:
    """Sort a body's markers by the plane they lie in.

    Args:
        path: of the body file, for messages.
        layout: the body.

    Returns:
        The pages, and what should be said about them.

    Raises:
        InputError: a disc has no normal and lies in no plane that others define.
    """
    notes: list[str] = []
    markers = [*_patterns(layout), *_discs(path, layout, notes)]
    groups: list[list[_PosedMarker]] = []
    for one in markers:
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
        marks = [one.mark(axes) for one in group]
        out.append(Page(group[0].normal, axes, tuple(_surrounded(mark, marks, notes) for mark in marks)))
    if len(out) > 1:
        notes.append(f"the body is not flat: {len(out)} planes, a page each")
    return tuple(out), notes


def _flat(axes: Array, p_body: Array) -> Array:
    """Return points (..., 3), m, on a page: (..., 2), mm."""
    return np.asarray(1e3 * p_body @ axes[:, :2])


def _discs(path: str | Path, layout: Layout, notes: list[str]) -> list[_PosedMarker]:
    """Return the discs; one without a normal takes that of the plane it lies in."""
    discs = layout.discs
    if discs is None:
        return []
    normals = np.array(discs.normals)
    unknown = np.isnan(normals[:, 0])
    if unknown.any():
        normals[unknown] = _face(path, layout, discs, unknown)
        notes.append(
            f"{', '.join(np.array(discs.body.point_names)[unknown][:4])}: no normal given; plotted as seen from "
            f"({', '.join(f'{c + 0.0:.2g}' for c in normals[unknown][0])}), the other side is the mirror image"
        )
    return [
        _PosedMarker(name, p, normal, _disc(name, p, 1e3 * radius, bool(bright)))
        for name, p, normal, radius, bright in zip(
            discs.body.point_names, discs.body.points, normals, discs.radii_m, discs.bright, strict=True
        )
    ]


def _face(path: str | Path, layout: Layout, discs: DiscTarget, unknown: NDArray[np.bool_]) -> Array:
    """Return the normal (3,) of the one plane in which all markers lie, those whose normal is unknown included."""
    normal, points = look_direction(layout.body.points, layout.normals), layout.body.points
    known = layout.normals[np.isfinite(layout.normals[:, 0])]
    level = 1e3 * (points - points.mean(axis=0)) @ normal
    if np.abs(level).max() > _LEVEL_MM or (len(known) and (known @ normal).min() < _PARALLEL):
        name = discs.body.point_names[int(np.flatnonzero(unknown)[0])]
        raise InputError(f"{path}: the body is not flat, so {name} needs its normal to be plotted: normal = [x, y, z]")
    return normal


def _disc(name: str, p: Array, radius: float, bright: bool) -> Callable[[Array], Mark]:
    """Return how one disc is marked on a page."""

    def mark(axes: Array) -> Mark:
        x, y = _flat(axes, p)
        box = np.array([[x, y], [x, y]]) + np.array([[-1.0], [1.0]]) * RING * radius
        reach = RING * radius if bright else 0.0
        return Mark(name, np.array([[x, y, radius]]), not bright, reach, True, np.zeros((0, 4, 2)), box)

    return mark


def _patterns(layout: Layout) -> list[_PosedMarker]:
    """Return tags and boards."""
    markers = []
    for one in () if layout.tags is None else layout.tags.tags:
        whole = one.family in LAYOUTS
        bits = printed(one.family, one.identity) if whole else cells(one.family, one.identity)
        side_m = one.size_m * (len(bits) / LAYOUTS[one.family].square if whole else 1.0)
        pattern = tag(bits > 0, side_m, black=0.0, white=1.0)
        T = one.T_body_tag
        markers.append(_PosedMarker(one.name, T[:3, 3], -T[:3, 2], _pattern(one.name, pattern, T)))
    for two in () if layout.boards is None else layout.boards.boards:
        pattern = BOARD_PATTERNS[type(two.board)](two.board)
        T = two.T_body_board
        mark = _pattern(two.name, pattern, T @ pattern.T_body_pattern)
        markers.append(_PosedMarker(two.name, T[:3, 3], two.normal, mark))
    return markers


def _pattern(name: str, pattern: Pattern, T_body_pattern: Array) -> Callable[[Array], Mark]:
    """Return how a pattern is marked on a page: runs of dark squares as quadrangles."""

    def mark(axes: Array) -> Mark:
        def on_page(xy: Array) -> Array:
            return _flat(axes, transform(T_body_pattern, np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1)))

        xs, ys = pattern.x_edges, pattern.y_edges
        outer = on_page(np.array([[xs[0], ys[0]], [xs[-1], ys[0]], [xs[-1], ys[-1]], [xs[0], ys[-1]]]))
        circles = np.column_stack([on_page(pattern.discs[:, :2]), 1e3 * pattern.discs[:, 2]])
        quads = np.array(_runs(pattern)).reshape(-1, 4, 2)
        box, dark = np.stack([outer.min(axis=0), outer.max(axis=0)]), pattern.discs[:, 3] < 0.5
        return Mark(name, circles[dark], True, 0.0, False, on_page(quads), box, circles[~dark])

    return mark


def _runs(pattern: Pattern) -> list[list[tuple[float, float]]]:
    """Return the dark squares of a pattern, those side by side as one, as corners in its own frame."""
    quads = []
    xs, ys = pattern.x_edges.tolist(), pattern.y_edges.tolist()
    dark = (pattern.values < 0.5) & (pattern.values != CLEAR)
    for j, row in enumerate(dark):
        ends = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
        for a, b in ends.reshape(-1, 2).tolist():
            quads.append([(xs[a], ys[j]), (xs[b], ys[j]), (xs[b], ys[j + 1]), (xs[a], ys[j + 1])])
    return quads


def _surrounded(mark: Mark, marks: list[Mark], notes: list[str]) -> Mark:
    """Return a mark whose dark surround leaves the others alone: a smaller circle where a square would not."""
    if not mark.reach:
        return mark
    x, y, radius = mark.circles[0]
    free, square = np.inf, True
    for other in marks:
        if other.reach:  # dark surrounds may run into each other, but not over a bright disc
            continue
        gap = np.maximum(0.0, np.maximum(other.box[0] - (x, y), (x, y) - other.box[1]))
        free = min(free, float(np.hypot(*gap)))
        square = square and bool((gap >= mark.reach).any())
    if square:
        return mark
    reach = float(np.clip(free, radius, mark.reach))
    if reach < RING_MIN * radius:
        notes.append(f"{mark.name} has only {reach - radius:.1f} mm of dark surround: a marker beside it is too near")
    box = np.array([[x, y], [x, y]]) + np.array([[-reach], [reach]])
    return Mark(mark.name, mark.circles, mark.dark, reach, False, mark.polygons, box)


#: White edge that printers need, height of what stands below the drawing, and the least width of that, mm.
_EDGE, _FOOT, _FOOT_WIDTH = 10.0, 30.0, 130.0
_BAR = 100.0
#: How far sheets of a split drawing overlap, and from where to where in the margin their marks reach, mm.
_OVERLAP, _MARK = 10.0, (4.5, 9.0)
_ARROW = 8.0
_TEXT, _SMALL = 3.2, 2.4  # height of letters, mm
_POINT = 25.4 / 72
_MOST_PIXELS = 150_000_000
_PLAIN: dict[str, Any] = {"linewidth": 0.0, "antialiased": True, "snap": False}


@dataclass(frozen=True, eq=False)
class Drawing(Record):
    """A drawing that was written.

    Attributes:
        files: the files written.
        pages: what is on each page.
        of: the body or board of each page.
        notes: what should be said about it.
    """

    files: tuple[str, ...]
    pages: tuple[Page, ...]
    of: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Sheet:
    """One of the sheets that a drawing is split over; mm.

    Attributes:
        paper: its width and height.
        low: x and y of the drawing at the upper left corner of its printed part.
        cuts: (x of the upright, y of the level) lines of the drawing along which sheets are joined.
        label: which one it is.
    """

    paper: tuple[float, float]
    low: tuple[float, float]
    cuts: tuple[tuple[float, ...], tuple[float, ...]]
    label: str


def is_board_spec(path: str | Path) -> bool:
    """Say whether what is to be drawn is a board: a spec, or Kalibr's target file."""
    if Path(path).suffix.lower() in KALIBR:
        return True
    return str(path).strip().split(":")[0] in BOARDS or (":" in str(path) and not Path(path).exists())


def draw_body(
    paths: Sequence[str | Path], output: str | Path, *, paper: str = "a4", dpi: int = 600, split: bool = False
) -> Drawing:
    """Draw bodies' markers and boards to scale.

    Args:
        paths: TOML body files, and boards' specs such as ``chessboard:9x6:20mm``.
        output: .pdf (a page for each plane), .svg or .png (a file for each, numbered from the second on).
        paper: a key of PAPERS; rotated where that fits better.
        dpi: pixels an inch of a .png.
        split: draw a plane that does not fit the paper on several sheets that overlap.

    Raises:
        InputError: no body file and no board, an unknown suffix, a plane that does not fit the paper, no matplotlib,
            or the file cannot be written.
    """
    suffix = Path(output).suffix.lower()
    if suffix not in _SAVERS:
        raise InputError(f"{output}: a drawing is a {', '.join(_SAVERS)} file, by its suffix")
    if importlib.util.find_spec("matplotlib") is None:
        raise InputError('drawing a body needs matplotlib, which is not installed: pip install "armsight[report]"')
    planes, of, heads, notes = list[Page](), list[str](), list[tuple[str, str]](), list[str]()
    for path in paths:
        its_own, head, foot = _pages_of(path, notes)
        many = len(its_own) > 1
        heads += [(head + (f", plane {k} of {len(its_own)}" if many else ""), foot) for k in range(1, len(its_own) + 1)]
        planes, of = [*planes, *its_own], [*of, *([str(path)] * len(its_own))]
    sizes = [_paper(path, page, paper, split) for path, page in zip(of, planes, strict=True)]
    parts = [_sheets(size, PAPERS[paper]) if split and paper != "fit" else [] for size in sizes]
    if suffix == ".png":
        _check_pixels(output, [each[0].paper if each else size for each, size in zip(parts, sizes, strict=True)], dpi)
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
    """Return the pages of a body or a board, their head and foot; what is odd about them is added to ``notes``."""
    if is_board_spec(path):
        return (_board_page(str(path)),), plain(str(path)), "drawn by armsight body draw"
    layout = read_layout(path)
    planes, odd = pages(path, layout)
    notes += odd
    return (
        planes,
        plain(layout.name),
        f"{plain(Path(path).name)}   sha256 {hashlib.sha256(read_bytes(path)).hexdigest()[:16]}",
    )


def _board_page(spec: str) -> Page:
    """Return the page of a board by itself, its white margin left to the paper."""
    board = open_board(spec)
    if next(iter(board.codes[1]), 0):
        raise InputError(f"{spec}: boards are drawn with ids from 0 on only; leave out first={board.codes[1][0]}")
    pattern = BOARD_PATTERNS[type(board)](board)
    axes = np.diag([1.0, -1.0, -1.0]) if board.y_up else np.eye(3)
    mark = _pattern("", pattern, pattern.T_body_pattern)(axes)
    corners = [mark.polygons.reshape(-1, 2)]
    corners += [mark.circles[:, :2] + sign * mark.circles[:, 2:] for sign in (-1.0, 1.0)]
    dark = np.concatenate(corners)
    whole = Mark(
        "", mark.circles, True, 0.0, False, mark.polygons, np.array([dark.min(axis=0), dark.max(axis=0)]), mark.holes
    )
    return Page(-axes[:, 2], axes, (whole,))


def _sheets(size: tuple[float, float], paper: tuple[float, float]) -> list[_Sheet]:
    """Return the sheets that a drawing is split over, row by row, on upright or rotated paper, whichever are fewer."""
    if _rotated(paper, np.array(size)) is not None:
        return []
    counts = {}
    for form in (paper, paper[::-1]):
        inner = np.array(form) - 2 * _EDGE
        counts[form] = np.ceil((np.array(size) - _OVERLAP) / (inner - _OVERLAP)).astype(int)
    form = min(counts, key=lambda each: int(counts[each].prod()))
    (columns, rows), step = counts[form], np.array(form) - 2 * _EDGE - _OVERLAP
    cuts = tuple(tuple(float(k * step[i] + _OVERLAP / 2) for k in range(1, counts[form][i])) for i in (0, 1))
    return [
        _Sheet(
            form,
            (float(column * step[0]), float(row * step[1])),
            (cuts[0], cuts[1]),
            f"sheet {row * columns + column + 1} of {rows * columns}: row {row + 1}, column {column + 1}",
        )
        for row in range(rows)
        for column in range(columns)
    ]


def _content(page: Page) -> Array:
    """Return (2, 2) low and high corner of what is on a page, names included, mm."""
    boxes = np.array([mark.box for mark in page.marks])
    if not any(page.names):
        return np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
    names = [0.6 * _TEXT * len(plain(mark.name, 24)) / 2 for mark in page.marks]
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    middle = boxes[:, :, 0].mean(axis=1)
    low[0], high[0] = min(low[0], (middle - names).min()), max(high[0], (middle + names).max())
    return np.array([low - 2 * _TEXT, high + 2 * _TEXT])


def _paper(path: str | Path, page: Page, paper: str, split: bool) -> tuple[float, float]:
    """Return the width and height of the paper, upright or rotated, mm; of the drawing where it is to be split."""
    needed = _needed(page)
    if paper == "fit":
        return float(np.ceil(needed[0])), float(np.ceil(needed[1]))
    larger = [name for name, size in PAPERS.items() if name != "fit" and _rotated(size, needed) is not None]
    size = _rotated(PAPERS[paper], needed)
    if size is None and split:
        return float(np.ceil(needed[0])), float(np.ceil(needed[1]))
    if size is None:
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
    """Whether a board fits a paper."""
    return _rotated(PAPERS[paper], _needed(_board_page(spec))) is not None


def _rotated(size: tuple[float, float], needed: Array) -> tuple[float, float] | None:
    """Return a paper's size upright or, where that does not fit, rotated; None where neither does."""
    return next((s for s in (size, size[::-1]) if needed[0] <= s[0] and needed[1] <= s[1]), None)


def _check_pixels(output: str | Path, sizes: list[tuple[float, float]], dpi: int) -> None:
    """Raise InputError where an image would be too large to hold."""
    most = max(width * height for width, height in sizes) * (dpi / 25.4) ** 2
    if most > _MOST_PIXELS:
        allowed = int(dpi * np.sqrt(_MOST_PIXELS / most))
        raise InputError(
            f"{output}: {most / 1e6:.0f} million pixels are too many: take --dpi {allowed} or less, or a .pdf or .svg"
        )


def _figure(page: Page, size: tuple[float, float], head: str, foot: str, sheet: _Sheet | None = None) -> Figure:
    """Draw one page, or one sheet of it."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width, height = size
    paper = size if sheet is None else sheet.paper
    figure = Figure(figsize=(paper[0] / 25.4, paper[1] / 25.4))
    FigureCanvasAgg(figure)
    if sheet is None:
        axes = _window(figure, size, (0.0, 0.0), 0.0)
    else:
        _joints(_window(figure, paper, (0.0, 0.0), 0.0), sheet)
        axes = _window(figure, paper, sheet.low, _EDGE)
    low, high = _content(page)
    room = np.array([width, height - _FOOT])
    shift = (room - (high - low)) / 2 - low
    for mark in page.marks:
        _surround(axes, mark, shift)
    for mark in page.marks:
        _print(axes, mark, shift)
    taken = [mark.box + shift for mark in page.marks]
    at = shift
    if not _free(np.array([at - 5.0, at + 17.0]), taken) or (at < _EDGE).any() or (at > room - _EDGE).any():
        at = np.array([width - _EDGE - 14.0, height - _EDGE - 9.0])
    taken.append(np.array([at - 5.0, at + 17.0]))
    _arrows(axes, page, at, "" if at is shift else "body's axes")
    for mark in page.marks:
        _name(axes, mark, shift, taken)
    seen = f"seen from ({', '.join(f'{c + 0.0:.3g}' for c in page.normal.round(6))})"
    _footer(axes, height, [f"{head}, {seen}", foot])
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
    """Draw in a sheet's margins where it is cut, and which one it is."""
    style: Any = {"color": "black", "lw": 0.4, "solid_capstyle": "butt"}
    width, height = sheet.paper
    for i, size, across in ((0, width, height), (1, height, width)):
        for cut in sheet.cuts[i]:
            at = _EDGE + cut - sheet.low[i]
            if not _EDGE < at < size - _EDGE:
                continue
            for ends in (_MARK, (across - _MARK[1], across - _MARK[0])):
                axes.plot(*(((at, at), ends) if i == 0 else (ends, (at, at))), **style)
    _write(axes, np.array([_EDGE + 30.0, height - 6.5]), sheet.label, _SMALL, va="center")


def _surround(axes: Axes, mark: Mark, shift: Array) -> None:
    """Draw the dark surround of a bright disc."""
    from matplotlib.patches import Circle, Rectangle

    if not mark.reach:
        return
    x, y = mark.circles[0, :2] + shift
    side = 2 * mark.reach
    if mark.square:
        axes.add_patch(Rectangle((x - mark.reach, y - mark.reach), side, side, facecolor="black", **_PLAIN))
    else:
        axes.add_patch(Circle((x, y), mark.reach, facecolor="black", **_PLAIN))


def _print(axes: Axes, mark: Mark, shift: Array) -> None:
    """Draw a marker: its discs, and its dark squares as one path, so that no seam shows between them."""
    from matplotlib.patches import Circle, PathPatch
    from matplotlib.path import Path as Outline

    for x, y, radius in mark.circles:
        axes.add_patch(
            Circle((x + shift[0], y + shift[1]), radius, facecolor="black" if mark.dark else "white", **_PLAIN)
        )
    if len(mark.polygons):
        corners = np.concatenate([mark.polygons, mark.polygons[:, :1]], axis=1) + shift
        codes = np.tile([Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY], len(corners))
        axes.add_patch(PathPatch(Outline(corners.reshape(-1, 2), codes), facecolor="black", **_PLAIN))
    for x, y, radius in mark.holes:
        axes.add_patch(Circle((x + shift[0], y + shift[1]), radius, facecolor="white", zorder=2, **_PLAIN))


def _name(axes: Axes, mark: Mark, shift: Array, taken: list[Array]) -> None:
    """Write a marker's name beside it, where nothing else is."""
    low, high = mark.box + shift
    name = plain(mark.name, 24)
    if not name:
        return
    half = np.array([0.3 * _TEXT * len(name), 0.6 * _TEXT])
    middle, beyond = (low + high) / 2, (high - low) / 2 + half + 1.0
    positions = [middle + beyond * step for step in np.array([[0, 1], [0, -1], [1, 0], [-1, 0]])]
    at = next((p for p in positions if _free(np.array([p - half, p + half]), taken)), positions[0])
    taken.append(np.array([at - half, at + half]))
    _write(axes, at, name, _TEXT, ha="center", va="center")


def _free(box: Array, taken: list[Array]) -> bool:
    """Whether a box (2, 2) touches none of others."""
    return not any((box[0] < other[1]).all() and (box[1] > other[0]).all() for other in taken)


def _write(axes: Axes, at: Array, text: str, height_mm: float, **more: str) -> None:
    """Write text of a height; a dollar sign is a dollar sign."""
    style: Any = {"fontsize": height_mm / _POINT / 0.72, "color": "black", "parse_math": False, "clip_on": True, **more}
    axes.text(float(at[0]), float(at[1]), text, **style)


def _arrows(axes: Axes, page: Page, at: Array, title: str) -> None:
    """Draw the body's axes as seen on the page."""
    on_page = page.axes.T
    away = []
    for k, letter in enumerate("xyz"):
        along = on_page[:2, k]
        if np.linalg.norm(along) > 0.2:
            end = at + _ARROW * along
            line: Any = {"arrowstyle": "-|>", "color": "black", "lw": 0.8, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", xy=tuple(end), xytext=tuple(at), arrowprops=line)
            _write(axes, at + (_ARROW + 2.5) * along, letter, _SMALL, ha="center", va="center")
        if abs(on_page[2, k]) > 0.2:
            away.append(f"{letter} {'into' if on_page[2, k] > 0 else 'out of'} the page")
    note = ", ".join([*([title] if title else []), *away])
    beside = np.array([-_ARROW - 4.5, 0.0]) if title else np.array([-2.0, -1.5])
    _write(axes, at + beside, note, _SMALL, ha="right" if title else "left", va="center" if title else "bottom")


def _footer(axes: Axes, height: float, lines: list[str]) -> None:
    """Draw the bar that checks the printer, and what this is."""
    x, y = _EDGE, height - _EDGE - 12.0
    axes.plot([x, x + _BAR], [y, y], color="black", lw=0.8, solid_capstyle="butt")
    for mm in range(0, int(_BAR) + 1, 10):
        tall = 3.0 if mm % 50 == 0 else 1.8
        axes.plot([x + mm, x + mm], [y, y - tall], color="black", lw=0.6, solid_capstyle="butt")
    _write(axes, np.array([x, y - 4.0]), "this bar is 100 mm long: print at 100%, then measure it", _SMALL, va="bottom")
    for row, line in enumerate(lines):
        _write(axes, np.array([x, y + 5.0 + 4.5 * row]), line, _SMALL, va="center")


def _save_pdf(figures: list[Figure], output: Path, dpi: int) -> list[Path]:
    """Write one file of all pages."""
    from matplotlib.backends.backend_pdf import PdfPages

    nothing: dict[str, Any] = {"CreationDate": None, "Creator": "armsight", "Producer": None}
    with replacing(output, "wb") as file, PdfPages(file, metadata=nothing) as book:
        for figure in figures:
            book.savefig(figure, dpi=dpi)
    return [output]


def _save_each(kind: str, metadata: dict[str, Any]) -> Callable[[list[Figure], Path, int], list[Path]]:
    """Return what writes a file for each page: all of them, or none."""

    def save(figures: list[Figure], output: Path, dpi: int) -> list[Path]:
        files = [output, *(output.with_stem(f"{output.stem}-{n}") for n in range(2, len(figures) + 1))]
        with contextlib.ExitStack() as stack:
            opened: list[IO[Any]] = [stack.enter_context(replacing(file, "wb")) for file in files]
            for figure, file in zip(figures, opened, strict=True):
                figure.savefig(file, format=kind, dpi=dpi, metadata=metadata)
        return files

    return save


_SAVERS: dict[str, Callable[[list[Figure], Path, int], list[Path]]] = {
    ".pdf": _save_pdf,
    ".svg": _save_each("svg", {"Date": None}),
    ".png": _save_each("png", {"Software": None}),
}
