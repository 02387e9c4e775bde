"""Kalibr's grids of AprilTags: ``aprilgrid:6x6:88mm:0.3``, tags columns x rows, side of a tag, gap as a share of the side.

As Kalibr prints and counts them: family 36h11 with a dark border of two cells, tags numbered row by row from the lower
left, a small dark square where four tags meet. Points are all tags' corners, row by row from the lower left; x runs
along the columns to the right, y up, z out of the board. Every tag carries its number, so no order is ambiguous and a
part of the board is enough.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Ids, Record
from armsight.vision.markers.aruco import cells, family_size, find_squares
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.markers.spec import Fields, first_id
from armsight.vision.markers.square import SquareFit, fit_square

FAMILY = "tag36h11"
#: Widths of the dark border, cells, in the order they are tried: Kalibr's own, then that of single AprilTags.
BORDERS = (2, 1)
#: Fewest tags of a grid of unknown size; half: four tags of several grids fit, double: small grids are not named.
_LEAST_TAGS = 4
#: The gap from which that of a grid of unknown size is fitted; half, double: outlines that were missed are predicted worse.
_USUAL_SPACING = 0.3
#: Tags of a grid lie so near to its steps, in these; half: wide lenses bend it more, double: other columns nearly fit.
OFF_GRID = 0.2


@dataclass(frozen=True, eq=False)
class AprilGrid(Record, CalibrationBoard):
    """A grid of AprilTags."""

    columns: int  #: tags along x
    rows: int  #: tags along y
    tag_m: float  #: side of a tag, m
    spacing: float  #: gap between tags as a share of their side
    first: int = 0  #: number of its first tag; the others follow

    form = "aprilgrid:COLUMNSxROWS:TAG:SPACING[:first=ID] (tags; gap as a share of the tag), such as aprilgrid:6x6:88mm:0.3"

    @staticmethod
    def from_fields(fields: Fields) -> AprilGrid:
        """Build the board a spec names."""
        columns, rows = fields.counts(0, least=1)
        tag_m, spacing = fields.length_m(1), fields.ratio(2)
        return AprilGrid(columns, rows, tag_m, spacing, fields.first(columns * rows, FAMILY, family_size(FAMILY)))

    @staticmethod
    def in_view(image: NDArray[np.uint8], tag_m: float) -> AprilGrid | None:
        """Return the grid that a grey image shows whole, its first tag 0; None where there is none.

        Columns and gap are those with which the tags lie on a plane.
        """
        found = max((find_squares(image, FAMILY, border) for border in BORDERS), key=len)
        if len(found) < _LEAST_TAGS:
            return None
        ids, middles = np.array([each for each, _ in found]), np.array([uv.mean(axis=0) for _, uv in found])
        count, fitting = int(ids.max()) + 1, []
        for columns in (c for c in range(2, count // 2 + 1) if count % c == 0):
            steps = np.stack([ids % columns, ids // columns], axis=1).astype(float)
            fitting.append((_off_plane(steps, middles), columns))
        off, columns = min(fitting, default=(np.inf, 1))
        if off > OFF_GRID:
            return None
        board = AprilGrid(columns, count // columns, tag_m, _USUAL_SPACING)
        seen = board.detect(image)

        def error(spacing: float) -> float:
            return _off_plane(replace(board, spacing=spacing).body.points[seen.ids, :2] / tag_m, seen.uv)

        return replace(board, spacing=min((k / 100 for k in range(5, 101)), key=error))

    @property
    def y_up(self) -> bool:
        """Whether its y axis runs up."""
        return True

    @property
    def codes(self) -> tuple[str, range]:
        """Family and numbers of its tags."""
        return FAMILY, range(self.first, self.first + self.columns * self.rows)

    @cached_property
    def body(self) -> Body:
        """The corners of all tags, m, z = 0, named by their number."""
        steps = [
            (np.arange(count)[:, None] * (1.0 + self.spacing) + np.array([0.0, 1.0])).ravel() * self.tag_m
            for count in (self.columns, self.rows)
        ]
        y, x = np.meshgrid(steps[1], steps[0], indexing="ij")
        points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        name = f"aprilgrid:{self.columns}x{self.rows}:{self.tag_m * 1e3:g}mm:{self.spacing:g}{first_id(self.first)}"
        return Body(name, tuple(str(i) for i in range(len(points))), points)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the board in one grey image; see :class:`~armsight.vision.markers.marker.Target`."""
        found: list[tuple[int, Array]] = []
        others: set[int] = set()
        border = BORDERS[0]
        for border in BORDERS:
            seen = find_squares(image, FAMILY, border, self.codes[1])
            found = [(identity - self.first, corners) for identity, corners in seen if identity in self.codes[1]]
            others |= {identity for identity, _ in seen if identity not in self.codes[1]}
            if found:
                break
        identities = [identity for identity, _ in found]
        fitted: dict[int, SquareFit] = {}
        for identity, corners in found:
            if identities.count(identity) == 1:
                self._fit(image, identity, corners, border, fitted)
        for identity, corners in self._missed(fitted, image.shape):
            self._fit(image, identity, corners, border, fitted)
        if not fitted:
            own, beside = self.codes[1], ""
            if others:
                beside = (
                    f"; {len(others)} tags of {FAMILY} in view have ids {min(others)} to {max(others)}, it has "
                    f"{own[0]} to {own[-1]}: if its ids begin elsewhere, add first=ID"
                )
            return Detections.none(f"no tag of {self.body.name} found{beside}")
        ids = np.concatenate([self._corner_ids(identity) for identity in fitted])
        order = np.argsort(ids)
        uv, cov = (np.concatenate([getattr(fit, key) for fit in fitted.values()])[order] for key in ("uv", "cov_uv"))
        return Detections(ids[order], uv, cov)

    def _fit(
        self, image: NDArray[np.uint8], identity: int, corners: Array, border: int, fitted: dict[int, SquareFit]
    ) -> None:
        """Fit one tag and add it to ``fitted`` if the fit is good."""
        fit = fit_square(image, corners, cells(FAMILY, identity + self.first, border), diagonal=-1)
        if fit.problem is None:
            fitted[identity] = fit

    def _missed(self, fitted: dict[int, SquareFit], shape: tuple[int, ...]) -> list[tuple[int, Array]]:
        """Predict the corners of tags in the image that were not found: touching dark squares hide outlines."""
        missing = [identity for identity in range(self.columns * self.rows) if identity not in fitted]
        if not fitted or not missing:
            return []
        seen = np.concatenate([self.body.points[self._corner_ids(identity), :2] for identity in fitted])
        H, _ = cv2.findHomography(seen, np.concatenate([fit.uv for fit in fitted.values()]))
        if H is None:
            return []
        out = []
        for identity in missing:
            p = np.column_stack([self.body.points[self._corner_ids(identity), :2], np.ones(4)]) @ H.T.astype(np.float64)
            corners: Array = p[:, :2] / p[:, 2:]
            if (p[:, 2] > 0).all() and (corners > 0).all() and (corners < np.array(shape[1::-1]) - 1).all():
                out.append((identity, corners))
        return out

    def _corner_ids(self, identity: int) -> Ids:
        """Return (4,) the points that are a tag's upper left, upper right, lower right and lower left corner."""
        row, column = divmod(identity, self.columns)
        low = 2 * row * 2 * self.columns + 2 * column
        high = low + 2 * self.columns
        return np.array([high, high + 1, low + 1, low])


def _off_plane(xy: Array, uv: Array) -> float:
    """Return by how much points uv (N, 2), px, are off those of a plane, xy (N, 2), RMS in its units."""
    H, _ = cv2.findHomography(uv, xy)
    if H is None:
        return np.inf
    off = cv2.perspectiveTransform(uv[None].astype(np.float64), H)[0] - xy
    return float(np.sqrt(np.mean(off**2)))
