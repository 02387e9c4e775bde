"""Grids of dark discs on white: ``circles:7x6:20mm`` and, staggered, ``acircles:4x11:20mm``; discs columns x rows, pitch.

As OpenCV's ``findCirclesGrid`` takes them, which finds the discs; the points are the discs' middles, row by row, z = 0.
In the staggered grid rows are one pitch apart, discs of a row two pitches, and every other row is shifted by one pitch.

The pixel positions are the centroids of darkness, with the covariance of the image's noise. The centroid of a tilted
disc's image is not the image of its middle (perspective bias): for a disc of radius r at distance z, tilted by t, it is
off by about ``f r^2 sin(t) cos(t) / z^2`` pixels, some hundredths on a board of many small discs and more on large
ones. The bias is not corrected here. Chessboards have no such bias.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Ids, Record
from armsight.vision.markers.grid import grid_points, local_squares, rotations
from armsight.vision.markers.marker import Target
from armsight.vision.markers.spec import Fields

#: The window reaches this many radii out; white is read between its two ends.
_WHITE_RADII = (1.4, 1.8)
_CONTRAST_MIN = 8.0  # grey levels


@dataclass(frozen=True, eq=False)
class CircleGrid(Record, Target):
    """A grid of discs.

    Attributes:
        columns: discs in a row.
        rows: rows.
        pitch_m: distance of the grid's lines, m.
        staggered: whether every other row is shifted by a pitch.
    """

    columns: int
    rows: int
    pitch_m: float
    staggered: bool

    form = "circles:COLUMNSxROWS:PITCH, such as circles:7x6:20mm"
    staggered_form = "acircles:COLUMNSxROWS:PITCH (staggered), such as acircles:4x11:20mm"

    @staticmethod
    def from_fields(fields: Fields) -> CircleGrid:
        """Build the square grid a spec names."""
        columns, rows = fields.counts(0, least=2)
        return CircleGrid(columns, rows, fields.length_m(1), False)

    @staticmethod
    def staggered_from_fields(fields: Fields) -> CircleGrid:
        """Build the staggered grid a spec names."""
        columns, rows = fields.counts(0, least=2)
        return CircleGrid(columns, rows, fields.length_m(1), True)

    @property
    def y_up(self) -> bool:
        """Whether its y axis runs up."""
        return False

    @property
    def codes(self) -> tuple[str, int]:
        """Family and number of its tags."""
        return "", 0

    @cached_property
    def body(self) -> Body:
        """The discs' middles, m, z = 0, named by their number."""
        points = grid_points(self.columns, self.rows, self.pitch_m)
        if self.staggered:
            row = np.arange(len(points)) // self.columns
            points[:, 0] = 2.0 * points[:, 0] + (row % 2) * self.pitch_m
        name = f"{'acircles' if self.staggered else 'circles'}:{self.columns}x{self.rows}:{self.pitch_m * 1e3:g}mm"
        return Body(name, tuple(str(i) for i in range(len(points))), points)

    @cached_property
    def symmetries(self) -> tuple[Ids, ...]:
        """Permutations (M,) under which the board looks the same, without identity: disc i may as well be perm[i]."""
        return tuple(perm for _, perm in rotations(self.body.points))

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the board in one grey image; see :class:`~armsight.vision.markers.marker.Target`."""
        kind = cv2.CALIB_CB_ASYMMETRIC_GRID if self.staggered else cv2.CALIB_CB_SYMMETRIC_GRID
        for extra in (0, cv2.CALIB_CB_CLUSTERING):
            found, rough = cv2.findCirclesGrid(image, (self.columns, self.rows), flags=kind | extra)
            if found and rough is not None:
                break
        else:
            return Detections.none(f"no {self.body.name} found")
        uv = rough.reshape(self.rows, self.columns, 2).astype(np.float64)
        if not self.staggered:
            uv = _upright(uv)
        squares, _ = local_squares(uv)
        nearest = np.linalg.norm(squares, axis=-1).min(axis=-1).ravel()  # of the next disc, in the row or the next row
        centroids = [centroid(image, start, gap) for start, gap in zip(uv.reshape(-1, 2), nearest, strict=True)]
        kept = np.array([found_centroid is not None for found_centroid in centroids])
        if kept.sum() < 4:
            return Detections.none(
                f"{self.body.name} was found but its discs are too faint or too near the image border"
            )
        good = [found_centroid for found_centroid in centroids if found_centroid is not None]
        return Detections(np.flatnonzero(kept), np.array([p for p, _ in good]), np.array([c for _, c in good]))


def _upright(uv: Array) -> Array:
    """Return the square grid (rows, columns, 2) in the right-handed order whose rows run most to the right."""
    across, down = (uv[:, -1] - uv[:, 0]).sum(axis=0), (uv[-1] - uv[0]).sum(axis=0)
    if across[0] * down[1] - across[1] * down[0] < 0:
        uv, across = uv[:, ::-1], -across
    return np.ascontiguousarray(uv if across[0] >= 0 else uv[::-1, ::-1])


def centroid(image: NDArray[np.uint8], start: Array, pitch_px: float) -> tuple[Array, Array] | None:
    """Measure the centroid of one dark disc on white.

    Args:
        image: (H, W) grey image.
        start: (2,) rough middle, px.
        pitch_px: distance of the next disc's middle, px.

    Returns:
        (2,) the centroid of darkness and (2, 2) its covariance, px^2; None where the disc is faint or cut by the
        border.
    """
    c, radius = start, 0.3 * pitch_px
    for _ in range(3):
        reach = min(_WHITE_RADII[1] * radius, 0.55 * pitch_px)
        low, high = np.floor(c - reach).astype(int), np.ceil(c + reach).astype(int)
        if (low < 0).any() or (high >= np.array(image.shape[::-1])).any() or reach < 2.0:
            return None
        v, u = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1].reshape(2, -1)
        d = np.stack([u, v], axis=1) - c
        distance = np.linalg.norm(d, axis=1)
        inside = distance <= reach
        grey, d, distance = image[v[inside], u[inside]].astype(np.float64), d[inside], distance[inside]
        white = distance > max(reach - 2.0, _WHITE_RADII[0] / _WHITE_RADII[1] * reach)
        basis = np.column_stack([np.ones(len(d)), d])
        plane, *_ = np.linalg.lstsq(basis[white], grey[white], rcond=None)
        dark = np.where(white, 0.0, basis @ plane - grey)
        depth = float(np.percentile(dark, 90))
        mass = float(dark.sum())
        if depth < _CONTRAST_MIN or mass <= 0:
            return None
        shift = dark @ d / mass
        c, radius = c + shift, float(np.sqrt(mass / depth / np.pi))
    noise = float(np.sum((grey[white] - basis[white] @ plane) ** 2) / (white.sum() - 3)) + 1.0 / 12.0
    lever = (d - shift)[~white]
    carried = lever.T @ basis[~white]  # how the white's uncertain plane moves the centroid
    spread = lever.T @ lever + carried @ np.linalg.inv(basis[white].T @ basis[white]) @ carried.T
    return c, noise * spread / mass**2
