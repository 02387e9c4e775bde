"""Chessboards: ``chessboard:9x6:25mm``, inner corners columns x rows and the side of a square.

OpenCV finds the grid, :mod:`~armsight.vision.markers.corner` fits its corners to a fraction of a pixel. Their order is
made canonical in each image by itself: right-handed as seen from the front (x along the columns, y along the rows, so z
points into the board), and starting at the corner whose first square, the one between corners (0, 0) and (1, 1), is
dark. The colours determine this unless columns + rows is even. The ambiguities that they leave are in
:attr:`Chessboard.symmetries`; then the corner most to the upper left in the image comes first, and
:func:`~armsight.vision.match.match` resolves the ambiguity with both images.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from statistics import median

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Ids, Record
from armsight.vision.markers.corner import OUTCOMES, WINDOW_MAX_PX, CornerFits, crossing_signs, refine_corners
from armsight.vision.markers.grid import grid_points, local_squares, rightwards, rotations
from armsight.vision.markers.marker import CalibrationBoard
from armsight.vision.markers.spec import Fields

#: Above this many pixels a side the grid is looked for in a smaller copy first; corners are fitted in the full image.
SEARCH_SIDE_PX = 1600
#: OpenCV's finders raise errors on images smaller than their filters.
IMAGE_SIDE_MIN_PX = 32
#: A chessboard of another size is named only if it has at least this many inner corners a side: fewer may be a part.
OTHER_SIDE_MIN = 4
#: Fewer corners than this share of the board do not count as the board.
KEPT_SHARE = 0.5
#: A board is larger than its spec if at least this share of a further row consists of corners too.
MORE_SHARE = 0.7
#: A residual this many times the median residual of the board's corners, both relative to the contrast, marks a
#: disturbed corner: a glint, a finger, a staple.
MISFIT_RATIO = 4.0
COPY_BLUR_PX = 0.75  # in a smaller copy; half: few images are reduced, double: sharp ones are
#: The four outermost lines of a grid (rows, columns), each with the two next to it.
_ENDS = (
    (np.s_[0], np.s_[1], np.s_[2]),
    (np.s_[-1], np.s_[-2], np.s_[-3]),
    (np.s_[:, 0], np.s_[:, 1], np.s_[:, 2]),
    (np.s_[:, -1], np.s_[:, -2], np.s_[:, -3]),
)


@dataclass(frozen=True, eq=False)
class Chessboard(Record, CalibrationBoard):
    """A chessboard; its points are the inner corners, row by row."""

    columns: int  #: inner corners along x
    rows: int  #: inner corners along y
    square_m: float  #: side of a square, m

    form = "chessboard:COLUMNSxROWS:SQUARE (inner corners), such as chessboard:9x6:25mm"

    @staticmethod
    def from_fields(fields: Fields) -> Chessboard:
        """Build the board a spec names."""
        columns, rows = fields.counts(0, least=3)
        return Chessboard(columns, rows, fields.length_m(1))

    @cached_property
    def body(self) -> Body:
        """The inner corners, m, z = 0, named by their number."""
        points = grid_points(self.columns, self.rows, self.square_m)
        name = f"chessboard:{self.columns}x{self.rows}:{self.square_m * 1e3:g}mm"
        return Body(name, tuple(str(i) for i in range(len(points))), points)

    @cached_property
    def _rotations(self) -> tuple[tuple[int, Ids], ...]:
        """The rotations that map the board onto itself, colours ignored: multiple of 90 degrees, and permutation."""
        return rotations(self.body.points)

    @cached_property
    def symmetries(self) -> tuple[Ids, ...]:
        """Permutations (M,) under which the board looks the same, without identity: corner i may as well be perm[i]."""
        return tuple(perm for rot90, perm in self._rotations if not self._exchanges_colours(rot90))

    def _exchanges_colours(self, rot90: int) -> bool:
        """Whether a rotation by so many times 90 degrees exchanges dark and bright."""
        return (self.columns + self.rows if rot90 == 2 else self.columns) % 2 == 1

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the board in one grey image; see :class:`~armsight.vision.markers.marker.Target`."""
        rough = find_grid(image, self.columns, self.rows)
        if rough is None:
            return Detections.none(
                f"no chessboard of {self.columns}x{self.rows} inner corners found{self._other_size(image)}"
            )
        fits = fit_grid(image, rough)
        colours = np.sign(fits.contrast * self._parity)
        first = np.sign(colours[fits.kept].sum())  # -1 where the first square is dark
        kept = fits.kept & ~misfits(fits) & (colours == first)
        if kept.sum() < max(4, KEPT_SHARE * kept.size):
            return Detections.none(_why_not(fits, int(kept.sum())))
        if extends_beyond(image, fits, kept, first * self._parity, (self.rows, self.columns)):
            return Detections.none(
                f"the chessboard extends beyond {self.columns}x{self.rows} inner corners: count those where two dark "
                "squares touch, columns x rows"
            )
        order = self._canonical_order(fits, first < 0)
        kept = kept[order]
        return Detections(np.flatnonzero(kept), fits.uv[order][kept], fits.cov_uv[order][kept])

    @staticmethod
    def in_view(image: NDArray[np.uint8], square_m: float) -> Chessboard | None:
        """Return the chessboard that a grey image shows, or a part of it; None where there is none."""
        if min(image.shape) < IMAGE_SIDE_MIN_PX:
            return None
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER
        found, _, meta = cv2.findChessboardCornersSBWithMeta(_search_copy(image)[0], (3, 3), flags=flags)
        if not found or min(meta.shape) < OTHER_SIDE_MIN:
            return None
        return Chessboard(max(meta.shape), min(meta.shape), square_m)

    def _other_size(self, image: NDArray[np.uint8]) -> str:
        """Return ", but corners of 8x6: ..." where an image shows a chessboard of another size or a part of one."""
        other = self.in_view(image, self.square_m)
        if other is None or {other.columns, other.rows} == {self.columns, self.rows}:
            return ""
        return f", but corners of {other.columns}x{other.rows}: a board of that size, or not the whole board"

    @cached_property
    def _parity(self) -> Array:
        """(M,) +1 where the square right and below of a corner has the colour of the first square, else -1."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return np.where((x + y) % 2 == 0, 1.0, -1.0).ravel()

    def _canonical_order(self, fits: CornerFits, first_is_dark: bool) -> Ids:
        """Return (M,) the permutation that sorts the fits into the board's order."""
        orders = [np.arange(self.columns * self.rows), *(perm for _, perm in self._rotations)]
        dark = [first_is_dark, *(first_is_dark != self._exchanges_colours(n) for n, _ in self._rotations)]
        if any(dark):
            orders = [order for order, is_dark in zip(orders, dark, strict=True) if is_dark]
        points, kept = self.body.points, fits.kept
        return max(orders, key=lambda order: rightwards(points[kept[order]], fits.uv[order][kept[order]]))


def find_grid(image: NDArray[np.uint8], columns: int, rows: int) -> Array | None:
    """Find the inner corners of a chessboard roughly, (rows, columns, 2), px, right-handed; None where there is none.

    The quadrangle finder copes with low contrast and small squares, the saddle-point finder with glints, blur and
    uneven light.
    """
    if min(image.shape) < IMAGE_SIDE_MIN_PX:
        return None
    small, scale = _search_copy(image)
    size, flags = (columns, rows), cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(small, size, flags=flags)
    if not found:
        found, corners = cv2.findChessboardCornersSB(small, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found and scale < 1:
        scale = 1.0
        found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    uv = (corners.reshape(rows, columns, 2).astype(np.float64) + 0.5) / scale - 0.5
    across, down = (uv[0, -1] - uv[0, 0]).tolist(), (uv[-1, 0] - uv[0, 0]).tolist()
    return uv if across[0] * down[1] - across[1] * down[0] > 0 else np.ascontiguousarray(uv[:, ::-1])


def _search_copy(image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
    """Return the copy of an image in which a board is looked for first, and its scale."""
    scale = min(1.0, SEARCH_SIDE_PX / max(image.shape))
    if scale == 1.0:
        return image, scale
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), scale  # type: ignore[return-value]


def fit_grid(image: NDArray[np.uint8], rough: Array, arm: float = 1.0) -> CornerFits:
    """Fit the corners of a grid from rough pixel positions (rows, columns, 2), NaN where none: roughly, then from there.

    Each window is shaped by its neighbours; ``arm`` as in :func:`~armsight.vision.markers.corner.refine_corners`.
    """
    rough_uv = rough.reshape(-1, 2)
    first = refine_corners(image, rough_uv, local_squares(rough)[0].reshape(-1, 2, 2), arm=arm, rough=True)
    uv = np.where(first.kept[:, None], first.uv, rough_uv)
    squares, bows = (array.reshape(-1, 2, 2) for array in local_squares(uv.reshape(rough.shape)))
    return _in_smaller_copy(image, refine_corners(image, uv, squares, bows, arm=arm, like=first), squares, bows, arm)


def _in_smaller_copy(image: NDArray[np.uint8], fits: CornerFits, squares: Array, bows: Array, arm: float) -> CornerFits:
    """Return the fits again in a copy in which the blur is about a pixel, where it is larger.

    A window ends so many pixels from a corner (:data:`~armsight.vision.markers.corner.WINDOW_MAX_PX`); of an image that is
    out of focus, or enlarged, it shows little but blur.
    """
    if not fits.kept.any():
        return fits
    blur_px = float(median(np.sqrt(fits.models[fits.kept, 4:6]).flat))
    side_px = float(median(np.linalg.norm(squares[fits.kept], axis=2).flat))
    factor = int(min(blur_px / COPY_BLUR_PX, side_px / WINDOW_MAX_PX))
    if factor < 2:
        return fits
    height, width = (side // factor for side in image.shape)
    small = cv2.resize(image[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA)
    uv = (fits.uv + 0.5) / factor - 0.5
    again = refine_corners(np.asarray(small, np.uint8), uv, squares / factor, bows * factor, arm=arm)
    models = again.models.copy()
    models[:, :2] = (models[:, :2] + 0.5) * factor - 0.5
    models[:, 4:6] *= factor**2
    models[:, 8:] /= factor
    return CornerFits(models, again.cov_uv * factor**2, again.residual, again.outcome)


def extends_beyond(
    image: NDArray[np.uint8], fits: CornerFits, kept: NDArray[np.bool_], colours: Array, shape: tuple[int, int]
) -> bool:
    """Return whether a further row or column of corners follows where the board should end: the board exceeds its spec.

    ``kept`` (M,): which of the fits, row by row of ``shape``, are good; ``colours`` (M,): +1 and -1, the signs of the
    contrast.
    """
    uv = np.where(kept[:, None], fits.uv, np.nan).reshape(*shape, 2)
    squares = local_squares(uv)[0]
    signs = colours.reshape(shape)
    for end, second, third in _ENDS:
        step, sides, colour = uv[end] - uv[second], squares[end], -signs[end]
        change = step - (uv[second] - uv[third])  # of steps, by perspective and lens
        beyond = uv[end] + step + np.nan_to_num(change)
        least = max(3.0, MORE_SHARE * np.count_nonzero(np.isfinite(beyond[:, 0])))
        if np.count_nonzero(crossing_signs(image, beyond, sides) == colour) < least:
            continue
        more = refine_corners(image, beyond, sides, rough=True)
        if np.count_nonzero(more.kept & (np.sign(more.contrast) == colour)) >= least:
            return True
    return False


def misfits(fits: CornerFits) -> NDArray[np.bool_]:
    """(N,) whether a corner's residual, relative to its contrast, is far above the others'."""
    relative = fits.residual / np.maximum(np.abs(fits.contrast), 1e-9)
    good = np.sort(relative[fits.kept])
    usual = float(good[len(good) // 2]) if len(good) else 0.0
    return np.asarray(relative > MISFIT_RATIO * usual)


def _why_not(fits: CornerFits, kept: int) -> str:
    """Return the reason why a grid that was found is not used."""
    counts = np.bincount(fits.outcome, minlength=len(OUTCOMES))
    worst = int(counts[1:].argmax()) + 1
    reason = f", mostly: {OUTCOMES[worst]}" if counts[worst] else ""
    return f"a chessboard was found but only {kept} of {len(fits.uv)} corners fit{reason}"
