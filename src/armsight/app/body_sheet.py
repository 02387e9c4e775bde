"""Where a body's markers lie on paper: one page for each plane, millimetres, seen from outside.

A page's frame has the body's origin projected to (0, 0), x to the right and y down; whole and to scale, not yet put on
paper.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.pose import transform
from armsight.sim.render.scene import (CLEAR, Pattern, aprilgrid, charuco, chessboard, circle_grid, tag)
from armsight.vision.discs.predict import face_axes, look_direction
from armsight.vision.markers.aprilgrid import AprilGrid
from armsight.vision.markers.aruco import cells
from armsight.vision.markers.body_layout import Layout
from armsight.vision.markers.charuco import Charuco
from armsight.vision.markers.chessboard import Chessboard
from armsight.vision.markers.circles import CircleGrid
from armsight.vision.markers.disc.target import DiscTarget

#: A bright disc's dark surround reaches to so many radii; where another marker is in the way, to fewer.
RING, RING_MIN = 2.0, 1.5
#: Two markers are on one plane within this angle (cosine) and this distance, mm.
_PARALLEL, _LEVEL_MM = float(np.cos(np.radians(0.5))), 0.2

#: Kind of board -> its print.
BOARD_PATTERNS: dict[type, Callable[[Any], Pattern]] = {
    Chessboard: lambda b: chessboard(b.columns, b.rows, b.square_m, black=0.0, white=1.0),
    Charuco: lambda b: charuco(b.columns, b.rows, b.square_m, b.marker_m, b.family, black=0.0, white=1.0),
    CircleGrid: lambda b: circle_grid(b.columns, b.rows, b.pitch_m, asymmetric=b.staggered, black=0.0, white=1.0),
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
        polygons: (N, 4, 2) its dark cells.
        box: (2, 2) low and high corner of what it needs for itself, margins included.
    """

    name: str
    circles: Array
    dark: bool
    reach: float
    square: bool
    polygons: Array
    box: Array


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
class _Placed(Record):
    """A marker before it is on a page: its name, middle (3,) and normal (3,), and how it is marked with a page's axes."""

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
        InputError: a disc has no normal and lies in no plane that others tell.
    """
    notes: list[str] = []
    placed = [*_patterns(layout), *_discs(path, layout, notes)]
    groups: list[list[_Placed]] = []
    for one in placed:
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


def _discs(path: str | Path, layout: Layout, notes: list[str]) -> list[_Placed]:
    """Return the discs; one without a normal takes that of the plane it lies in."""
    discs = layout.discs
    if discs is None:
        return []
    normals = np.array(discs.normals)
    unknown = np.isnan(normals[:, 0])
    if unknown.any():
        normals[unknown] = _face(path, layout, discs, unknown)
        notes.append(
            f"{', '.join(np.array(discs.body.point_names)[unknown][:4])}: no normal given; drawn as seen from "
            f"({', '.join(f'{c + 0.0:.2g}' for c in normals[unknown][0])}), the other side is the mirror image"
        )
    return [
        _Placed(name, p, normal, _disc(name, p, 1e3 * radius, bool(bright)))
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
        raise InputError(f"{path}: the body is not flat, so {name} needs its normal to be drawn: normal = [x, y, z]")
    return normal


def _disc(name: str, p: Array, radius: float, bright: bool) -> Callable[[Array], Mark]:
    """Return how one disc is marked on a page."""

    def mark(axes: Array) -> Mark:
        x, y = _flat(axes, p)
        box = np.array([[x, y], [x, y]]) + np.array([[-1.0], [1.0]]) * RING * radius
        reach = RING * radius if bright else 0.0
        return Mark(name, np.array([[x, y, radius]]), not bright, reach, True, np.zeros((0, 4, 2)), box)

    return mark


def _patterns(layout: Layout) -> list[_Placed]:
    """Return tags and boards."""
    placed = []
    for one in () if layout.tags is None else layout.tags.tags:
        pattern = tag(cells(one.family, one.identity) > 0, one.size_m, black=0.0, white=1.0)
        T = one.T_body_tag
        placed.append(_Placed(one.name, T[:3, 3], -T[:3, 2], _pattern(one.name, pattern, T)))
    for two in () if layout.boards is None else layout.boards.boards:
        pattern = BOARD_PATTERNS[type(two.board)](two.board)
        T = two.T_body_board
        mark = _pattern(two.name, pattern, T @ pattern.T_body_pattern)
        placed.append(_Placed(two.name, T[:3, 3], two.normal, mark))
    return placed


def _pattern(name: str, pattern: Pattern, T_body_pattern: Array) -> Callable[[Array], Mark]:
    """Return how a pattern is marked on a page: runs of dark cells as quadrangles."""

    def mark(axes: Array) -> Mark:
        def place(xy: Array) -> Array:
            return _flat(axes, transform(T_body_pattern, np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1)))

        xs, ys = pattern.x_edges, pattern.y_edges
        outer = place(np.array([[xs[0], ys[0]], [xs[-1], ys[0]], [xs[-1], ys[-1]], [xs[0], ys[-1]]]))
        circles = np.column_stack([place(pattern.discs[:, :2]), 1e3 * pattern.discs[:, 2]])
        quads = np.array(_runs(pattern)).reshape(-1, 4, 2)
        return Mark(name, circles, True, 0.0, False, place(quads), np.stack([outer.min(axis=0), outer.max(axis=0)]))

    return mark


def _runs(pattern: Pattern) -> list[list[tuple[float, float]]]:
    """Return the dark cells of a pattern, those side by side as one, as corners in its own frame."""
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
