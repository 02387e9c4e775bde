"""What stands before the cameras: flat patterns on rigid bodies.

A pattern is planar geometry and nothing else: a grid of rectangular cells, each of one reflectance, and discs painted
over it. Its plane is z = 0 of its own frame, x right, y down and z away from the viewer when it is seen frontally, the
frame the detectors' bodies use. Boards, tags and plates are all made of that, so the painter knows two shapes only.
Reflectance is the grey a sensor of unit gain would read, 0 black to 1 white; more than 1 is a lamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.check import checked

#: Reflectance of a cell where nothing is: what stands behind shows.
CLEAR = -1.0
BLACK, WHITE = 0.08, 0.85
#: Radius of the hole of a ring on a board of discs, as a share of the disc's.
RING_HOLE = 0.4


@dataclass(frozen=True, eq=False)
class Pattern(Record):
    """One flat pattern; seen from its face only (the side its z axis points away from)."""

    x_edges: Array  #: (nx + 1,) rising borders of the cells' columns, m, pattern frame
    y_edges: Array  #: (ny + 1,) rising borders of the cells' rows, m, pattern frame
    values: Array  #: (ny, nx) reflectance of each cell; CLEAR lets the background through
    #: (K, 4) centre x, y and radius, m, pattern frame, and reflectance; painted over the cells in this order
    discs: Array = field(default_factory=lambda: np.zeros((0, 4)))
    T_body_pattern: Array = field(default_factory=lambda: np.eye(4))  #: (4, 4) where the pattern sits on its body

    def __post_init__(self) -> None:
        """Check shapes, and that borders rise."""
        super().__post_init__()
        checked(self.values, (self.y_edges.size - 1, self.x_edges.size - 1), "pattern values")
        checked(self.discs, (None, 4), "pattern discs")
        checked(self.T_body_pattern, (4, 4), "T_body_pattern")
        if (np.diff(self.x_edges) <= 0).any() or (np.diff(self.y_edges) <= 0).any() or (self.discs[:, 2] <= 0).any():
            raise InputError("a pattern's cell borders must rise and its disc radii must be above zero")

    def on_body(self, T_body_pattern: Array) -> Pattern:
        """Return the same pattern at another pose (4, 4) on its body."""
        return Pattern(self.x_edges, self.y_edges, self.values, self.discs, T_body_pattern)


@dataclass(frozen=True, eq=False)
class PosedBody(Record):
    """A rigid body in front of a camera."""

    #: what is on the body, painted in this order: a tag comes after the plate it is stuck on
    patterns: tuple[Pattern, ...]
    T_camera_body: Array  #: (4, 4) pose in the camera's frame in the middle of the exposure of the middle row, m
    twist: Array = field(default_factory=lambda: np.zeros(6))  #: (6,) velocity [m/s; rad/s] in the body's axes
    #: (6,) its change, m/s^2 and rad/s^2: at time t the pose is T_camera_body @ exp_se3(t twist + t^2 acceleration /
    #: 2)
    acceleration: Array = field(default_factory=lambda: np.zeros(6))

    def seen_from(self, T_other_camera: Array) -> PosedBody:
        """Return the body in another camera's frame; its motion is the body's own and stays."""
        return replace(self, T_camera_body=T_other_camera @ self.T_camera_body)


def plate(
    width_m: float, height_m: float, value: float = WHITE, discs: Sequence[tuple[float, float, float, float]] = ()
) -> Pattern:
    """Return a plain rectangle about its origin with discs (x, y, radius, all m, and reflectance) on it."""
    return Pattern(
        np.array([-width_m / 2, width_m / 2]),
        np.array([-height_m / 2, height_m / 2]),
        np.array([[value]]),
        np.array(discs, dtype=np.float64).reshape(-1, 4),
    )


def chessboard(
    columns: int, rows: int, square_m: float, *, border: float = 1.0, black: float = BLACK, white: float = WHITE
) -> Pattern:
    """Return a chessboard of columns x rows inner corners; its origin is corner 0, whose square towards (-x, -y) is black.

    ``border``: width of the white margin, squares.
    """
    black_squares = np.add.outer(np.arange(rows + 1), np.arange(columns + 1)) % 2 == 0
    return Pattern(
        _with_margin(np.arange(-1.0, columns + 1), border) * square_m,
        _with_margin(np.arange(-1.0, rows + 1), border) * square_m,
        np.pad(np.where(black_squares, black, white), 1, constant_values=white),
    )


def circle_grid(
    columns: int,
    rows: int,
    pitch_m: float,
    *,
    asymmetric: bool = False,
    radius_m: float | None = None,
    rings: Sequence[tuple[int, int]] = (),
    black: float = BLACK,
    white: float = WHITE,
) -> Pattern:
    """Return a grid of dark discs on a white plate; its origin is the centre of disc 0.

    In an asymmetric grid rows are a pitch apart, discs in a row two, and odd rows are shifted by one, as OpenCV has it.
    The radius is a quarter of the distance to the nearest neighbour by default; ``rings``: (column, row) of discs with
    a hole of RING_HOLE of their radius.
    """
    row, column = (index.ravel() for index in np.mgrid[:rows, :columns])
    x = (2.0 * column + row % 2 if asymmetric else column) * pitch_m
    y = row * pitch_m
    radius = radius_m if radius_m is not None else pitch_m * (np.sqrt(2) if asymmetric else 1.0) / 4
    margin = 1.5 * pitch_m
    discs = np.stack([x, y, np.full(x.size, radius), np.full(x.size, black)], axis=1)
    holes = discs[[row * columns + column for column, row in rings]] * [1.0, 1.0, RING_HOLE, 0.0] + [
        0.0,
        0.0,
        0.0,
        white,
    ]
    return Pattern(
        np.array([-margin, x.max() + margin]),
        np.array([-margin, y.max() + margin]),
        np.array([[white]]),
        np.concatenate([discs, holes]),
    )


def marker_bits(family: str, marker: int, border: int = 1) -> NDArray[np.bool_]:
    """Return the cells (n, n) of a marker with its dark border, upright; True is bright. InputError: there is none.

    ``family``: OpenCV's name of a dictionary, with or without DICT_, or AprilTag's own, whose upright is OpenCV's
    upside down; ``border``: of the dark border, cells.
    """
    name = family.removeprefix("DICT_")
    name = f"DICT_APRILTAG_{name.removeprefix('tag')}" if name.startswith("tag") else f"DICT_{name}"
    if not hasattr(cv2.aruco, name):
        raise InputError(
            f"unknown marker family {family!r}; known are tag36h11 and the like, and OpenCV's: 4X4_50, ..."
        )
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    if not 0 <= marker < len(known.bytesList):
        raise InputError(f"family {family} has markers 0 to {len(known.bytesList) - 1}, not {marker}")
    cells = known.markerSize + 2 * border
    bits = np.asarray(cv2.aruco.generateImageMarker(known, marker, cells, borderBits=border) > 127)
    return np.rot90(bits, 2) if family.startswith("tag") else bits


def tag(
    bits: NDArray[np.bool_], size_m: float, *, quiet: float = 1.0, black: float = BLACK, white: float = WHITE
) -> Pattern:
    """Return a tag of bits (n, n), the black rim included, True is white; its origin is its centre.

    ``size_m``: side of the black rim's outer edge; ``quiet``: width of the white margin around it, cells.
    """
    edges = _with_margin(np.arange(len(bits) + 1.0) - len(bits) / 2, quiet) * (size_m / len(bits))
    return Pattern(edges, edges, np.pad(np.where(bits, white, black), 1, constant_values=white))


def charuco(
    columns: int,
    rows: int,
    square_m: float,
    marker_m: float,
    family: str,
    *,
    black: float = BLACK,
    white: float = WHITE,
) -> Pattern:
    """Return a ChArUco board as OpenCV (4.6 and later) draws it, with a white margin of one square.

    Args:
        columns: squares along x.
        rows: squares along y.
        square_m: side of a square, m.
        marker_m: side of a marker, m.
        family: of the markers, as in :func:`marker_bits`.
        black: reflectance of black squares and cells.
        white: reflectance of white squares and cells, and of the margin.

    Returns:
        The board; its origin is the inner corner of the square at the upper left, which is black.
    """
    bits = [marker_bits(family, k) for k in range(columns * rows // 2)]
    cells = len(bits[0])
    inside = (square_m - marker_m) / 2 + np.arange(cells + 1) * (marker_m / cells)
    x_edges, y_edges = (
        np.append(np.add.outer(np.arange(-1, n - 1) * square_m, np.append(0.0, inside)).ravel(), (n - 1) * square_m)
        for n in (columns, rows)
    )
    step = cells + 2
    values = np.full((rows * step, columns * step), white)
    marker = 0
    for j in range(rows):
        for i in range(columns):
            square = values[j * step : (j + 1) * step, i * step : (i + 1) * step]
            if (i + j) % 2 == 0:
                square[:] = black
            else:
                square[1:-1, 1:-1] = np.where(bits[marker], white, black)
                marker += 1
    return Pattern(
        _with_margin(x_edges, square_m), _with_margin(y_edges, square_m), np.pad(values, 1, constant_values=white)
    )


def aprilgrid(
    columns: int, rows: int, tag_m: float, spacing: float, *, black: float = BLACK, white: float = WHITE
) -> Pattern:
    """Return a grid of AprilTags as Kalibr prints it: tag36h11, dark border of two cells, a dark square between tags.

    ``spacing``: gap as a share of a tag's side. The body's origin is the lower left corner of tag 0, at the lower left;
    x runs to the right, y up and z out of the board.
    """
    cells, gap = marker_bits("tag36h11", 0, 2).shape[0], spacing * tag_m
    inside = gap + np.arange(cells + 1) * (tag_m / cells)
    x_edges, y_edges = (
        np.append(np.add.outer(np.arange(n) * (tag_m + gap), np.append(0.0, inside[:-1])).ravel(), n * (tag_m + gap))
        for n in (columns, rows)
    )
    step = cells + 1
    values = np.full((rows * step + 1, columns * step + 1), white)
    values[::step, ::step] = black
    for k in range(columns * rows):
        row, column = rows - 1 - k // columns, k % columns
        below, right = row * step + 1, column * step + 1
        values[below : below + cells, right : right + cells] = np.where(marker_bits("tag36h11", k, 2), white, black)
    T_body_pattern = np.diag([1.0, -1.0, -1.0, 1.0])
    T_body_pattern[:2, 3] = -gap, rows * (tag_m + gap)
    return Pattern(
        _with_margin(np.append(x_edges, x_edges[-1] + gap), gap),
        _with_margin(np.append(y_edges, y_edges[-1] + gap), gap),
        np.pad(values, 1, constant_values=white),
        T_body_pattern=T_body_pattern,
    )


def _with_margin(edges: Array, margin: float) -> Array:
    """Add a cell of width ``margin`` on both ends of rising borders (n,)."""
    return np.concatenate([[edges[0] - margin], edges, [edges[-1] + margin]])
