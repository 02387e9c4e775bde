"""Charuco boards: ``charuco:8x11:15mm:11mm:DICT_5X5_100``, squares columns x rows, sides of square and marker, family.

As OpenCV prints them, in both layouts it has had, black on white or inverted. Points are the inner corners of the
chessboard, row by row from the upper left; x runs along the columns, y down, z into the board. OpenCV finds them through
the markers, so no order is ambiguous and a part of the board is enough; :mod:`~armsight.vision.markers.corner` fits them to
a fraction of a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Record
from armsight.errors import InputError
from armsight.vision.markers.aprilgrid import OFF_GRID
from armsight.vision.markers.aruco import charuco_detector, detect_markers, family_name, family_size, marker_corners
from armsight.vision.markers.chessboard import fit_grid, misfits
from armsight.vision.markers.grid import completed, grid_points
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.markers.spec import Fields, first_id

#: Markers from whose neighbours the image's scale at one follows, it included, and how far they may be from it, squares;
#: of more, or of those further off, the perspective bends the fit. Fewest markers that have such neighbours.
_NEIGHBOURS, _REACH, _FITS = 5, 2.1, 3
#: OpenCV's outline of a marker runs through the middles of its outermost pixels: it is this much smaller, px.
_OUTLINE_PX = 1.0
#: A given side of the markers that differs from the image's by more than this share, and by more than so many pixels
#: (blur and tone curves shift the edges), is a mistake.
_SIDE_SHARE, _SIDE_PX = 0.08, 1.5
#: So far outside and inside of its outline, px, a marker's grey differs by more than this share of the range within it.
_GAP_PX, _STEP = 1.5, 0.4
#: Families of unknown boards, by their markers' cells, each with the sizes of its dictionaries, which begin alike.
_USUAL = {f"DICT_{cells}_": (50, 100, 250, 1000) for cells in ("4X4", "5X5", "6X6", "7X7")}
_TO_M = 5e-4  # m; sides of unknown markers are given to this; half: digits that mean nothing, double: too coarse


@dataclass(frozen=True, eq=False)
class Charuco(Record, CalibrationBoard):
    """A chessboard with markers in its bright squares."""

    columns: int  #: squares along x
    rows: int  #: squares along y
    square_m: float  #: side of a square, m
    marker_m: float  #: side of a marker, m
    family: str  #: the markers' family
    first: int = 0  #: number of its first marker; the others follow

    form = "charuco:COLUMNSxROWS:SQUARE:MARKER:FAMILY[:first=ID] (squares), such as charuco:8x11:15mm:11mm:DICT_5X5_100"

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
        first = fields.first(columns * rows // 2, family, family_size(family))
        return Charuco(columns, rows, square_m, marker_m, family, first)

    @staticmethod
    def in_view(image: NDArray[np.uint8], square_m: float) -> Charuco | None:
        """Return the board of the usual families that a grey image shows whole, its first marker 0; None without one.

        The markers' ids give the number of squares, where they lie the columns, and their sides in squares their own.
        """
        seen = {name: detect_markers(image, f"{name}{sizes[-2]}") for name, sizes in _USUAL.items()}
        name = max(seen, key=lambda name: len(seen[name][0]))
        corners, identities = seen[name]
        if len(corners) < _NEIGHBOURS:
            return None
        count, outlined = int(identities.max()) + 1, _outlined(image, corners)
        family = next(f"{name}{size}" for size in _USUAL[name] if count <= size)
        fitting: list[tuple[float, float, Charuco]] = []
        for squares in (2 * count, 2 * count + 1):
            for columns in (c for c in range(3, squares // 3 + 1) if squares % c == 0):
                board = Charuco(columns, squares // columns, square_m, 0.75 * square_m, family)
                off, side_m, _ = min(board._sides(corners, outlined, identities, legacy) for legacy in (False, True))
                fitting.append((off, side_m, board))
        if not fitting or min(fitting, key=lambda each: each[0])[0] > OFF_GRID:
            return None
        _, side_m, board = min(fitting, key=lambda each: each[0])
        marker_m = round(side_m / _TO_M) * _TO_M if np.isfinite(side_m) else board.marker_m
        return replace(board, marker_m=min(marker_m, square_m - _TO_M))

    @property
    def codes(self) -> tuple[str, range]:
        """Family and numbers of its tags."""
        return self.family, range(self.first, self.first + self.columns * self.rows // 2)

    @cached_property
    def body(self) -> Body:
        """The inner corners, m, z = 0, named by their number."""
        points = grid_points(self.columns - 1, self.rows - 1, self.square_m)
        lengths = f"{self.square_m * 1e3:g}mm:{self.marker_m * 1e3:g}mm"
        name = f"charuco:{self.columns}x{self.rows}:{lengths}:{self.family}{first_id(self.first)}"
        return Body(name, tuple(str(i) for i in range(len(points))), points)

    @property
    def _absent(self) -> str:
        """What is said of an image in which nothing of the board was seen."""
        return f"no {self.body.name} found, or fewer than 4 of its corners"

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the board in one grey image; see :class:`~armsight.vision.markers.marker.Target`.

        Where it is not found black on white, it is looked for white on black.
        """
        found = self._found(image)
        if found.problem is not None:
            inverted = self._found(255 - image)
            return found if inverted.problem is not None and found.problem != self._absent else inverted
        return found

    def _found(self, image: NDArray[np.uint8]) -> Detections:
        """Find the board with dark markers on light squares."""
        corners, identities = detect_markers(image, self.family)
        markers = corners, identities - self.first
        if (wrong := self._contradiction(image, *markers)) is not None:
            return Detections.none(wrong)
        layouts = [self._rough(image, *markers, legacy) for legacy in (False, True)]
        rough = max(layouts, key=lambda uv: np.isfinite(uv).sum())
        if np.isfinite(rough[..., 0]).sum() < 4:
            return Detections.none(self._absent)
        plain = 0.5 * (1.0 - self.marker_m / self.square_m)
        fits = fit_grid(image, completed(rough), arm=plain)  # a marker that was not read hides corners that are there
        y, x = np.mgrid[: self.rows - 1, : self.columns - 1]
        colours = np.sign(fits.contrast) * np.where((x + y) % 2 == 0, 1.0, -1.0).ravel()
        kept = fits.kept & (colours == np.sign(np.sum(colours[fits.kept]))) & ~misfits(fits)
        if kept.sum() < 4:
            return Detections.none(f"{self.body.name} was found but only {kept.sum()} of its corners fit")
        return Detections(np.flatnonzero(kept), fits.uv[kept], fits.cov_uv[kept])

    def _rough(self, image: NDArray[np.uint8], corners: Array, identities: NDArray[np.int32], legacy: bool) -> Array:
        """Return (rows - 1, columns - 1, 2) rough corners in one of OpenCV's two layouts; NaN where not seen."""
        rough = np.full(((self.rows - 1) * (self.columns - 1), 2), np.nan)
        detector = charuco_detector((self.columns, self.rows), self.square_m, self.marker_m, self.family, legacy)
        ours = (identities >= 0) & (identities < len(self.codes[1]))
        if ours.any():
            markers = list(corners[ours, None].astype(np.float32))
            uv, ids, _, _ = detector.detectBoard(image, markerCorners=markers, markerIds=identities[ours, None])
            if ids is not None and uv is not None:
                rough[np.ravel(ids)] = uv.reshape(-1, 2)
        return rough.reshape(self.rows - 1, self.columns - 1, 2)

    def _contradiction(self, image: NDArray[np.uint8], corners: Array, identities: NDArray[np.int32]) -> str | None:
        """Return a message where an image's markers do not lie as the board has them, or have another side, in squares."""
        outlined = _outlined(image, corners)
        sides = [self._sides(corners, outlined, identities, legacy) for legacy in (False, True)]
        off, seen_m, px = min(sides, key=lambda found: found[0])
        if off > OFF_GRID:
            if (first := self._other_first(corners, outlined, identities)) is not None:
                last = first + len(self.codes[1]) - 1
                return (
                    f"{len(corners)} markers of {self.family} in view have the ids {first} to {last} of such a board, and "
                    f"{self.body.name} has {self.first} to {self.codes[1][-1]}: if this is the board, give "
                    f"{replace(self, first=first).body.name}"
                )
            if max(sides)[0] == np.inf:
                return None  # nothing is known of one layout
            return (
                f"{len(corners)} markers of {self.family} are in view, but not where {self.body.name} has them: check its "
                "counts of squares (columns x rows)"
            )
        if not abs(seen_m - self.marker_m) > max(_SIDE_SHARE * seen_m, _SIDE_PX / px):
            return None
        return (
            f"{self.body.name}: the image shows markers of {seen_m * 1e3:.3g} mm in squares of {self.square_m * 1e3:g} mm, "
            f"not of {self.marker_m * 1e3:g} mm: measure the squares and the markers (with their dark border) again"
        )

    def _other_first(self, corners: Array, outlined: NDArray[np.bool_], identities: NDArray[np.int32]) -> int | None:
        """Return the first id with which the markers in view lie as the board has them; None where there is none."""
        ids, count = identities + self.first, len(self.codes[1])
        if len(ids) < _NEIGHBOURS:
            return None
        low, high = max(0, int(ids.max()) - count + 1), min(int(ids.min()), family_size(self.family) - count)
        for first in range(high, low - 1, -1):
            shifted = (identities + self.first) - first
            if min(self._sides(corners, outlined, shifted, legacy)[0] for legacy in (False, True)) <= OFF_GRID:
                return first
        return None

    def _sides(
        self, corners: Array, outlined: NDArray[np.bool_], identities: NDArray[np.int32], legacy: bool
    ) -> tuple[float, float, float]:
        """Compare the markers with where one of OpenCV's layouts has them; infinite and NaN where too few are.

        Return how far off their middles are, squares; the side of a marker, m, of those that are outlined; pixels a
        metre: medians.
        """
        layout = marker_corners((self.columns, self.rows), self.square_m, self.marker_m, self.family, legacy)
        known = [k for k, identity in enumerate(identities) if 0 <= identity < len(layout)]
        if len(known) < _NEIGHBOURS:
            return np.inf, np.nan, np.nan
        corners, outlined = corners[known], outlined[known]
        middles = corners.mean(axis=1)
        board = layout[identities[known]].mean(axis=1)
        found = []
        for p in board:
            apart = np.linalg.norm(board - p, axis=1)
            near = np.argsort(apart, kind="stable")[:_NEIGHBOURS]
            if apart[near[-1]] > _REACH * self.square_m:
                continue
            X = np.column_stack([np.ones(_NEIGHBOURS), board[near] - p])
            if np.linalg.matrix_rank(X, tol=0.5 * self.square_m) < 3:
                continue  # in one line
            fit, *_ = np.linalg.lstsq(X, middles[near], rcond=None)
            scale = np.sqrt(abs(np.linalg.det(fit[1:])))
            off = np.sqrt(np.mean((X @ fit - middles[near]) ** 2)) / max(scale * self.square_m, 1e-9)
            (x, y), (z, w) = np.diff(corners[near[0]][[0, 2, 1, 3]], axis=0)[::2]
            side_px = np.sqrt(0.5 * abs(x * w - y * z)) + _OUTLINE_PX
            found.append((off, side_px / max(scale, 1e-9), scale, outlined[near[0]]))
        if len(found) < _FITS:
            return np.inf, np.nan, np.nan
        offs, sides, scales, has = np.transpose(found)
        side = float(np.median(sides[has > 0])) if has.sum() >= _FITS else np.nan
        return float(np.median(offs)), side, float(np.median(scales))


def _outlined(image: NDArray[np.uint8], corners: Array) -> NDArray[np.bool_]:
    """Return which markers' corners (n, 4, 2) are those of their outlines (n,): bright just outside, dark just inside.

    Where cells are larger than OpenCV's threshold reaches, it may give the inner edge of the dark rim that this leaves.
    """
    if not len(corners):
        return np.zeros(0, bool)
    middles, share = corners.mean(axis=1, keepdims=True), np.linspace(0.0, 1.0, 9)[:, None]
    following = np.roll(corners, -1, axis=1)
    edges = (corners[:, :, None] + share[1:-1] * (following - corners)[:, :, None]).reshape(len(corners), -1, 2)
    across = corners[:, [0]] + share * (corners[:, [1]] - corners[:, [0]])
    down = corners[:, [3]] + share * (corners[:, [2]] - corners[:, [3]])
    cells = (across[:, :, None] + share * (down - across)[:, :, None]).reshape(len(corners), -1, 2)
    gap = (_GAP_PX / np.linalg.norm(following - corners, axis=2).mean(axis=1))[:, None, None]

    def grey(uv: Array) -> Array:
        uv = uv.astype(np.float32)
        return cv2.remap(image, uv[..., 0], uv[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)

    outside, inside = (
        np.median(grey(middles + (1.0 + sign * gap) * (edges - middles)), axis=1) for sign in (1.0, -1.0)
    )
    return np.asarray(outside - inside > _STEP * np.ptp(grey(cells), axis=1))
