"""Charuco boards: ``charuco:8x11:15mm:11mm:DICT_5X5_100``, squares columns x rows, sides of square and marker, family.

As OpenCV prints them, in both layouts it has had, black on white or inverted. Points are the inner corners of the
chessboard, row by row from the upper left; x runs along the columns, y down, z into the board. OpenCV finds them through
the markers, so no order is ambiguous and a part of the board is enough; :mod:`~armsight.vision.markers.corner` fits them to
a fraction of a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Record
from armsight.errors import InputError
from armsight.vision.markers.aruco import charuco_detector, detect_markers, family_name, family_size
from armsight.vision.markers.chessboard import fit_grid, misfits
from armsight.vision.markers.grid import completed, grid_points
from armsight.vision.markers.marker import Target
from armsight.vision.markers.spec import Fields


@dataclass(frozen=True, eq=False)
class Charuco(Record, Target):
    """A chessboard with markers in its bright squares.

    Attributes:
        columns: squares along x.
        rows: squares along y.
        square_m: side of a square, m.
        marker_m: side of a marker, m.
        family: the markers' family.
    """

    columns: int
    rows: int
    square_m: float
    marker_m: float
    family: str

    form = "charuco:COLUMNSxROWS:SQUARE:MARKER:FAMILY (squares), such as charuco:8x11:15mm:11mm:DICT_5X5_100"

    @staticmethod
    def from_fields(fields: Fields) -> Charuco:
        """Build the board a spec names."""
        columns, rows = fields.counts(0, least=3)
        square_m, marker_m = fields.length_m(1), fields.length_m(2)
        if not marker_m < square_m:
            raise fields.error("has markers that do not fit into its squares")
        try:
            family = family_name(fields.values[3])
        except InputError as error:
            raise fields.error(f"has an {error}") from None
        if columns * rows // 2 > family_size(family):
            raise fields.error(f"needs {columns * rows // 2} markers, and {family} has {family_size(family)}")
        return Charuco(columns, rows, square_m, marker_m, family)

    @property
    def y_up(self) -> bool:
        """Whether its y axis runs up."""
        return False

    @property
    def codes(self) -> tuple[str, int]:
        """Family and number of its tags."""
        return self.family, self.columns * self.rows // 2

    @cached_property
    def body(self) -> Body:
        """The inner corners, m, z = 0, named by their number."""
        points = grid_points(self.columns - 1, self.rows - 1, self.square_m)
        lengths = f"{self.square_m * 1e3:g}mm:{self.marker_m * 1e3:g}mm"
        name = f"charuco:{self.columns}x{self.rows}:{lengths}:{self.family}"
        return Body(name, tuple(str(i) for i in range(len(points))), points)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the board in one grey image; see :class:`~armsight.vision.markers.marker.Target`.

        Where it is not found black on white, it is looked for white on black.
        """
        found = self._found(image)
        if found.problem is not None:
            inverted = self._found(255 - image)
            return found if inverted.problem is not None else inverted
        return found

    def _found(self, image: NDArray[np.uint8]) -> Detections:
        """Find the board with dark markers on light squares."""
        markers = detect_markers(image, self.family)
        layouts = [self._rough(image, *markers, legacy) for legacy in (False, True)]
        rough = max(layouts, key=lambda uv: np.isfinite(uv).sum())
        if np.isfinite(rough[..., 0]).sum() < 4:
            return Detections.none(f"no {self.body.name} found, or fewer than 4 of its corners")
        plain = 0.5 * (1.0 - self.marker_m / self.square_m)
        fits = fit_grid(image, completed(rough), arm=plain)  # a marker that was not read hides corners that are there
        y, x = np.mgrid[: self.rows - 1, : self.columns - 1]
        colours = np.sign(fits.contrast) * np.where((x + y) % 2 == 0, 1.0, -1.0).ravel()
        agree = colours == np.sign(np.sum(colours[fits.kept]))
        kept = fits.kept & agree & ~misfits(fits)
        if kept.sum() < 4:
            return Detections.none(f"{self.body.name} was found but only {kept.sum()} of its corners fit")
        return Detections(np.flatnonzero(kept), fits.uv[kept], fits.cov_uv[kept])

    def _rough(
        self, image: NDArray[np.uint8], markers: Sequence[NDArray[Any]], identities: NDArray[Any], legacy: bool
    ) -> Array:
        """Return (rows - 1, columns - 1, 2) rough corners in one of OpenCV's two layouts; NaN where not seen."""
        rough = np.full(((self.rows - 1) * (self.columns - 1), 2), np.nan)
        size = (self.columns, self.rows)
        detector = charuco_detector(size, self.square_m, self.marker_m, self.family, legacy)
        uv, ids = None, None
        if len(markers):
            uv, ids, _, _ = detector.detectBoard(image, markerCorners=markers, markerIds=identities)
        if ids is not None and uv is not None:
            rough[np.ravel(ids)] = uv.reshape(-1, 2)
        return rough.reshape(self.rows - 1, self.columns - 1, 2)
