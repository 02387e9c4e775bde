"""Grids of discs: ``circles:7x6:20mm`` and, staggered, ``acircles:4x11:20mm``; discs columns x rows, pitch.

Laid out as OpenCV's ``findCirclesGrid`` takes them; the points are the discs' middles, row by row, z = 0. In the staggered
grid rows are one pitch apart, discs of a row two pitches, and every other row is shifted by one pitch. Discs are dark on a
light board or light on a dark one. Options follow the pitch: ``radius=5mm``; ``dark`` or ``light``, by default whichever is
found; ``rings=2x7,11x7,2x2``, the discs (column x row, from 0) that have a hole, by which a part of the board is known.

A disc's pixel position is the centre of the ellipse that fits its rim (:mod:`~armsight.vision.markers.disc.fit`). That is
not the image of its middle (:mod:`~armsight.vision.discs.bias`): a disc of radius r at distance z, tilted by t, is off by
about ``f r^2 sin(t) cos(t) / z^2`` pixels. Calibration and measurement know the pose and model what is measured. For that
they need the radius, which the sizes of the ellipses give where the spec does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Detections, Ids, Record
from armsight.vision.markers import circle_blobs, circle_grid
from armsight.vision.markers.chessboard import KEPT_SHARE
from armsight.vision.markers.disc.search import Grey
from armsight.vision.markers.grid import grid_points, rightwards, rotations
from armsight.vision.markers.marker import CalibrationBoard, Target
from armsight.vision.markers.spec import Fields

#: The share of a board's discs that must be measured where it has rings; a smaller part is enough then.
_KEPT_WITH_RINGS = 0.2
#: Grids in one image that may be the board, the best first.
_GRIDS = 4
#: A disc that the search missed is there if its contrast is at least this share of the others'.
_LOST_CONTRAST = 0.4
#: An outline may have so many times the area that the others let expect.
_ODD_OUTLINE = 1.3
#: How far an outline may be from where its neighbours put it, in radii.
_DISPLACED = 0.35
#: Halfway to the next disc a grid's grey differs from that between four by less than this share of a disc's contrast, at a
#: chessboard's corner by half; half: blurred discs are no grid, double: chessboards are.
_CORNER = 0.25
#: Whether a grid is staggered -> columns and rows as OpenCV's documentation has them: the reading nearest to them is taken.
_USUAL = {False: (7, 6), True: (4, 11)}
#: Images from which on a row that is in none of them is said.
_IMAGES = 3
#: Whether discs are light -> how the spec says so.
POLARITIES = {False: "dark", True: "light"}


@dataclass(frozen=True, eq=False)
class CircleGrid(Record, CalibrationBoard):
    """A grid of discs."""

    columns: int  #: discs in a row
    rows: int  #: rows
    pitch_m: float  #: distance of the grid's lines, m
    staggered: bool  #: whether every other row is shifted by a pitch
    disc_radius_m: float | None = None  #: radius of a disc, m; None where the spec does not give it
    light: bool | None = None  #: whether the discs are light on a dark board; None where the spec does not say
    rings: tuple[tuple[int, int], ...] = ()  #: (column, row) of the discs that have a hole

    form = "circles:COLUMNSxROWS:PITCH[:OPTION...], such as circles:7x6:20mm or circles:7x6:20mm:radius=5mm:light"
    staggered_form = "acircles:COLUMNSxROWS:PITCH[:OPTION...] (staggered), such as acircles:4x11:20mm"

    @staticmethod
    def from_fields(fields: Fields, staggered: bool) -> CircleGrid:
        """Build the grid a spec names."""
        columns, rows = fields.counts(0, least=2)
        pitch_m, options = fields.length_m(1), fields.options("radius=", "dark", "light", "rings=")
        radius_m = fields.length_of(options["radius"]) if "radius" in options else None
        if radius_m is not None and not 2 * radius_m < pitch_m * (np.sqrt(2) if staggered else 1.0):
            raise fields.error("has discs that overlap")
        if "dark" in options and "light" in options:
            raise fields.error("has discs both dark and light")
        rings = tuple(
            fields.pair(text, "column x row such as 2x7") for text in options.get("rings", "").split(",") if text
        )
        if any(column >= columns or row >= rows for column, row in rings) or len(set(rings)) < len(rings):
            raise fields.error("has rings beside the grid or twice: columns and rows are counted from 0")
        light = "light" in options if options.keys() & {"dark", "light"} else None
        return CircleGrid(columns, rows, pitch_m, staggered, radius_m, light, rings)

    @staticmethod
    def in_view(image: Grey, pitch_m: float) -> CircleGrid | None:
        """Return the grid of discs that a grey image shows whole, square or staggered; None where there is none."""
        best: list[tuple[int, CircleGrid]] = []
        for sign, blobs in zip((-1, 1), circle_blobs.find_blobs(image, True, True), strict=True):
            for grid in circle_grid.grow_lattices(blobs, len(blobs.theta))[:_GRIDS]:
                size = (image.shape[1], image.shape[0])
                cells, theta, _ = _completed(image, grid.cells, blobs.theta[grid.blobs], sign, size, rings=False)
                if not _are_apart(image, cells, theta[:, :2]):
                    continue
                for staggered, like in _USUAL.items():
                    shown = circle_grid.shown_size(cells, staggered=staggered, like=like)
                    if shown is not None and min(shown) >= 3:
                        best.append((len(cells), CircleGrid(*shown, pitch_m, staggered)))
        return max(best, key=lambda each: each[0], default=(0, None))[1]

    @cached_property
    def spec(self) -> str:
        """The spec that describes it."""
        parts = [f"{'acircles' if self.staggered else 'circles'}:{self.columns}x{self.rows}:{self.pitch_m * 1e3:g}mm"]
        if self.disc_radius_m is not None:
            parts.append(f"radius={self.disc_radius_m * 1e3:.6g}mm")
        if self.light is not None:
            parts.append(POLARITIES[self.light])
        if self.rings:
            parts.append("rings=" + ",".join(f"{column}x{row}" for column, row in self.rings))
        return ":".join(parts)

    @cached_property
    def body(self) -> Body:
        """The discs' middles, m, z = 0, named by their number."""
        points = grid_points(self.columns, self.rows, self.pitch_m)
        if self.staggered:
            points[:, 0] = 2.0 * points[:, 0] + ((np.arange(len(points)) // self.columns) % 2) * self.pitch_m
        return Body(self.spec, tuple(str(i) for i in range(len(points))), points)

    @cached_property
    def _ring(self) -> NDArray[np.bool_]:
        """(M,) whether a disc is a ring."""
        ring = np.zeros(self.columns * self.rows, bool)
        ring[[row * self.columns + column for column, row in self.rings]] = True
        return ring

    @cached_property
    def symmetries(self) -> tuple[Ids, ...]:
        """Permutations (M,) under which the board looks the same, without identity: disc i may as well be perm[i]."""
        ring = self._ring
        return tuple(perm for _, perm in rotations(self.body.points) if (ring[perm] == ring).all())

    @cached_property
    def _layout(self) -> circle_grid.GridLayout:
        """The discs on a square lattice; that of a staggered grid lies diagonally."""
        x, y = np.rint(self.body.points[:, :2] / self.pitch_m).astype(np.int64).T
        cells = np.stack([(x + y) // 2, (y - x) // 2] if self.staggered else [x, y], axis=1)
        return circle_grid.GridLayout(cells, self._ring, self.symmetries)

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        """Find the board in one grey image; see :class:`~armsight.vision.markers.marker.Target`."""
        found = self._found(image, self.light is not True, self.light is not False)
        if found.problem is None or self.light is None:
            return found
        if self._found(image, self.light, not self.light).problem is None:
            return Detections.none(
                f"{self.body.name}: the discs in the image are {POLARITIES[not self.light]}, and the board is said to have "
                f"{POLARITIES[self.light]} ones"
            )
        return found

    def _found(self, image: Grey, dark: bool, light: bool) -> Detections:
        """Find the board by its dark discs, its light ones, or whichever make the board."""
        least = max(4, int((_KEPT_WITH_RINGS if self.rings else KEPT_SHARE) * len(self._ring)))
        grids: list[tuple[float, bool, circle_blobs.Blobs, circle_grid.Lattice]] = []
        for polarity, blobs in zip((False, True), circle_blobs.find_blobs(image, light, dark), strict=True):
            lattices = circle_grid.grow_lattices(blobs, len(self._ring))
            grids += [(g.weight, polarity, blobs, g) for g in lattices if len(g.blobs) >= least]
        problem = f"no {self.body.name} found"
        for n, (_, polarity, blobs, grid) in enumerate(sorted(grids, key=lambda g: -g[0])[:_GRIDS]):
            found = self._measured(image, blobs, grid, polarity, least)
            if isinstance(found, Detections):
                return found
            problem = problem if n else f"{self.body.name}: {found}"
        return Detections.none(problem)

    def _measured(
        self, image: Grey, blobs: circle_blobs.Blobs, grid: circle_grid.Lattice, light: bool, least: int
    ) -> Detections | str:
        """Number the discs of a grid and fit them; the reason where they do not make the board."""
        sign, size = (1 if light else -1), (image.shape[1], image.shape[0])
        cells, starts, hollow = _completed(
            image, grid.cells, blobs.theta[grid.blobs], sign, size, rings=bool(self.rings)
        )
        if len(cells) < least:
            return f"{len(cells)} of its discs were found"
        if circle_grid.skips_line(cells, starts):
            return f"{len(cells)} of its discs were found, but between them a whole row or column was not"
        own = (self.columns, self.rows)
        shown = circle_grid.shown_size(cells, staggered=self.staggered, like=own)
        if shown is not None and (shown[0] > own[0] or shown[1] > own[1]):
            return f"its discs make a grid of {shown[0]}x{shown[1]}: count columns x rows"
        placement = circle_grid.number_cells(cells, starts, hollow, self._layout, size)
        if isinstance(placement, str):
            return placement + self._other_grid(cells, shown)
        seen = placement.ids >= 0
        starts, hollow = starts[seen], hollow[seen]
        ids = self._upright(placement.ids[seen], starts[:, :2])
        fits = circle_blobs.fit_discs(circle_blobs.without_holes(image, starts[hollow]), starts)
        good = fits.kept()
        if good.sum() < least:
            return f"{len(ids)} of its discs were found, but only {good.sum()} can be measured{fits.why_not()}"
        rows = np.flatnonzero(good)[np.argsort(ids[good])]
        return Detections(ids[rows], fits.uv[rows], fits.cov[rows], shape=fits.shape[rows], common=fits.common)

    def _other_grid(self, cells: Ids, shown: tuple[int, int] | None) -> str:
        """Return "; they make a grid of 7x6" where a lattice (N, 2) that is not the board fills another grid."""
        own, kind = (self.columns, self.rows), "grid"
        if shown is None:
            shown = circle_grid.shown_size(cells, staggered=not self.staggered, like=own)
            kind = "square grid (circles)" if self.staggered else "staggered grid (acircles)"
        same = shown is None or (shown == own and kind == "grid")
        return "" if same or shown is None else f"; they make a {kind} of {shown[0]}x{shown[1]}"

    def _upright(self, ids: Ids, uv: Array) -> Ids:
        """Return the numbering, of those that look the same, whose rows run most to the right."""
        orders = [ids, *(perm[ids] for perm in self.symmetries)]
        return max(orders, key=lambda order: rightwards(self.body.points[order], uv))


def unseen_row(target: Target, seen: Sequence[Ids]) -> tuple[str, ...]:
    """Note which outer row of a grid of discs no image shows: the board may have a row less than its spec says."""
    if not isinstance(target, CircleGrid) or len(seen) < _IMAGES:
        return ()
    rows = np.unique(np.concatenate(list(seen)) // target.columns)
    missing = [1 + row for row in (0, target.rows - 1) if row not in rows]
    if not missing:
        return ()
    which = " and ".join(map(str, missing))
    return (
        f"row {which} of {target.spec} is in none of {len(seen)} images: if the board has {target.columns}x"
        f"{target.rows - len(missing)} discs, its origin is not where it seems; correct --target",
    )


def _completed(
    image: Grey, cells: Ids, theta: Array, sign: int, size_px: tuple[int, int], *, rings: bool
) -> tuple[Ids, Array, NDArray[np.bool_]]:
    """Replace the odd outlines of a grid by what their neighbours let expect, and add discs that the search missed.

    In and out: cells (N, 2), outlines ``theta`` (N, 10), and whether a disc has a hole (N,). ``sign``: 1 for light
    discs; ``rings``: whether the board has rings, of which a part may have been taken for a disc.
    """
    kept = ~circle_blobs.odd_sized(theta, _ODD_OUTLINE)
    if rings:
        kept &= ~_displaced(cells, theta)
    cells, theta = cells[kept], theta[kept]
    contrast, hollow = circle_blobs.contrasts(image, theta, sign)
    while len(cells):
        more, uv = circle_grid.expected(cells, theta, size_px)
        like = circle_blobs.like_neighbours(uv, theta)
        there, ring = circle_blobs.contrasts(image, like, sign)
        found = there > _LOST_CONTRAST * np.median(contrast)
        if not found.any():
            break
        cells, theta = np.concatenate([cells, more[found]]), np.concatenate([theta, like[found]])
        contrast, hollow = np.concatenate([contrast, there[found]]), np.concatenate([hollow, ring[found]])
    return cells, theta, hollow


def _are_apart(image: Grey, cells: Ids, uv: Array) -> bool:
    """Return whether what lies at the cells (N, 2) of a lattice, at uv (N, 2), px, are discs: a chessboard's squares touch.

    Halfway to the next disc a grid of discs is as between four of them; a chessboard has a corner there.
    """
    at = circle_grid.positions(cells, uv)
    squares = [
        (p, at[x + 1, y], at[x, y + 1], at[x + 1, y + 1])
        for (x, y), p in at.items()
        if {(x + 1, y), (x, y + 1), (x + 1, y + 1)} <= at.keys()
    ]
    if not squares:
        return False
    corner, beside, *_ = corners = np.array(squares).T
    grey = [
        float(np.median(image[np.rint(p.imag).astype(int), np.rint(p.real).astype(int)]))
        for p in (corner, (corner + beside) / 2, np.mean(corners, axis=0))
    ]
    return abs(grey[1] - grey[2]) < _CORNER * abs(grey[0] - grey[2])


def _displaced(cells: Ids, theta: Array) -> NDArray[np.bool_]:
    """(N,) which outlines, theta (N, 10), are not where those around their cells (N, 2) put them: of a part of a ring."""
    seen, out = circle_grid.positions(cells, theta[:, :2]), np.zeros(len(cells), bool)
    radius = (theta[:, 2] * theta[:, 4] - theta[:, 3] ** 2) ** -0.25
    for i, (x, y) in enumerate(cells.tolist()):
        own = seen.pop((x, y))
        guess = circle_grid.extrapolated((x, y), seen)
        out[i] = guess is not None and abs(guess[0] - own) > _DISPLACED * radius[i]
        seen[x, y] = own
    return out
