"""Grids of discs from outlines: by topology, from a seed outwards.

The ellipse of a disc shows how the board lies there: in the coordinates that make the ellipse a circle the four neighbours
are equally far away, at right angles. From such a seed the grid grows disc by disc; each next position is extrapolated from
the known ones nearby, so neither perspective nor the distortion of a wide lens matters (as corners of chessboards in Geiger
et al., "Automatic camera and range sensor calibration using a single shot", ICRA 2012). Blobs that do not fit stay outside,
and single discs may be missing. A staggered grid is a square lattice too, rotated by 45 degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from statistics import median
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.vision.markers.circle_blobs import Blobs

#: Neighbours of a disc have up to this many times its area or contrast.
_ALIKE = 3.0
#: Neighbours examined, and seeds from which grids grow.
_NEIGHBOURS, _SEEDS = 12, 60
#: A disc of the grid is this near to where its neighbours put it, as a share of the step.
_NEAR = 0.3
#: Unevenness that halves a lattice's weight; share of the weight of a whole, even board that ends the search.
_UNEVEN, _ENOUGH = 0.1, 0.8
#: Sides of the grid, rotated by 90 degrees from each to the next.
_SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))

Cell: TypeAlias = tuple[int, int]


@dataclass(frozen=True, eq=False)
class Lattice(Record):
    """Discs that hang together as a square lattice, right-handed in the image (x to the right, y down).

    ``cells`` (N, 2) integer positions, ``blobs`` (N,) rows of the outlines; ``weight``: the number of discs, less the
    more unevenly they stand and the more they are than the board has. Texture may be large, but not even.
    """

    cells: Ids
    blobs: Ids
    weight: float


def grow_lattices(blobs: Blobs, count: int) -> list[Lattice]:
    """Assemble lattices from outlines, best first; none after one has nearly the weight of the board's ``count`` discs."""
    if len(blobs.theta) < 4:
        return []
    beside = _neighbours(blobs)
    regular = np.array([_regularity(blobs, i, js) for i, js in enumerate(beside)])
    found: list[Lattice] = []
    taken = np.zeros(len(beside), bool)
    tried = 0
    for i in np.argsort(-regular, kind="stable"):
        if taken[i] or regular[i] < 1:
            continue
        tried += 1
        if tried > _SEEDS:
            break
        sides = _sides(blobs, int(i), beside[i])
        if sides is None:
            continue
        cells = _spread(blobs, int(i), sides)
        even = 1.0 / (1.0 + (_unevenness(blobs, cells) / _UNEVEN) ** 2)
        weight = even * min(len(cells), count**2 / len(cells))
        lattice = Lattice(np.array(list(cells)), np.array(list(cells.values())), weight)
        taken[lattice.blobs if even > 0.5 else i] = True
        found.append(lattice)
        if weight >= _ENOUGH * count:
            break
    return sorted(found, key=lambda lattice: -lattice.weight)


def _unevenness(blobs: Blobs, cells: dict[Cell, int]) -> float:
    """Return how far discs are from the middle of the two beside them: median, as a share of the step; 1 if unknown."""
    at = {cell: complex(*blobs.theta[i, :2]) for cell, i in cells.items()}
    off = []
    for (x, y), here in at.items():
        for dx, dy in _SIDES[:2]:
            before, after = at.get((x - dx, y - dy)), at.get((x + dx, y + dy))
            if before is not None and after is not None:
                off.append(abs(before + after - 2 * here) / abs(after - before))
    return median(off) if off else 1.0


def _neighbours(blobs: Blobs) -> list[Ids]:
    """Return for every outline the nearest ones of its size and contrast."""
    from scipy.spatial import KDTree  # not above: SciPy takes longer than a pair of images

    uv, size = blobs.theta[:, :2], np.log(blobs.radius_px)
    span, out = 0.5 * np.log(_ALIKE), [np.zeros(0, np.int64)] * len(uv)
    for band in np.arange(size.min(), size.max() + span, span):
        mine = np.flatnonzero((size >= band) & (size < band + span))
        pool = np.flatnonzero((size >= band - span) & (size < band + 2 * span))
        if not len(mine) or len(pool) < 2:
            continue
        _, rows = KDTree(uv[pool]).query(uv[mine], k=min(_NEIGHBOURS + 1, len(pool)))
        for i, js in zip(mine.tolist(), pool[rows], strict=True):
            out[i] = js[(js != i) & _alike(blobs, i, js)]
    return out


def _alike(blobs: Blobs, i: int, js: Ids) -> NDArray[np.bool_]:
    """Whether outlines js have about the area and the contrast of outline i."""
    area = (blobs.radius_px[js] / blobs.radius_px[i]) ** 2
    contrast = blobs.contrast[js] / blobs.contrast[i]
    return np.asarray((np.maximum(area, 1 / area) < _ALIKE) & (np.maximum(contrast, 1 / contrast) < _ALIKE))


def _flattened(blobs: Blobs, i: int, js: Ids) -> Array:
    """Return the offsets (n, 2) from outline i to outlines js in coordinates in which outline i is the unit circle."""
    m11, m12, m22 = blobs.theta[i, 2:5]
    a = np.sqrt(m11)
    U = np.array([[a, m12 / a], [0.0, np.sqrt(max(m22 - m12 * m12 / m11, 1e-12))]])  # U^T U = M
    return np.asarray((blobs.theta[js, :2] - blobs.theta[i, :2]) @ U.T)


def _regularity(blobs: Blobs, i: int, js: Ids) -> int:
    """Count the neighbours of an outline that have another one opposite or at a right angle, equally far away."""
    if len(js) < 2:
        return 0
    z = _flattened(blobs, i, js)
    length = np.hypot(*z.T)
    count = 0
    for rotated in (-z, np.column_stack([-z[:, 1], z[:, 0]])):
        count += int((np.linalg.norm(z[:, None] - rotated[None], axis=2).min(axis=0) < _NEAR * length).sum())
    return count


def _sides(blobs: Blobs, i: int, js: Ids) -> tuple[int, int] | None:
    """Return two neighbours of an outline that span the lattice, the second one a right angle from the first."""
    z = _flattened(blobs, i, js)
    length = np.hypot(*z.T)
    for a in np.argsort(length):
        gap = np.linalg.norm(z - np.array([-z[a, 1], z[a, 0]]), axis=1)
        b = int(np.argmin(gap))
        if length[a] > 1.8 and gap[b] < 1.5 * _NEAR * length[a]:
            return int(js[a]), int(js[b])
    return None


def _spread(blobs: Blobs, seed: int, sides: tuple[int, int]) -> dict[Cell, int]:
    """Grow a lattice from an outline and two of its neighbours: cell -> outline."""
    from scipy.spatial import KDTree  # not above: SciPy takes longer than a pair of images

    uv = blobs.theta[:, :2]
    tree = KDTree(uv)
    cells = {(0, 0): seed, (1, 0): sides[0], (0, 1): sides[1]}
    at = {cell: complex(*uv[i]) for cell, i in cells.items()}
    used, front, all_round = set(cells.values()), list(cells), False
    while front:
        claims: dict[int, tuple[float, Cell]] = {}
        for cell in sorted({n for c in front for n in _beside(c)} - cells.keys()):
            expected = extrapolated(cell, at)
            if expected is None:
                continue
            (u, v), step = (expected[0].real, expected[0].imag), expected[1]
            known = next(cells[n] for n in _beside(cell) if n in cells)
            js = np.array(tree.query_ball_point((u, v), _NEAR * step), dtype=np.int64)
            js = js[_alike(blobs, known, js)] if len(js) else js
            if len(js):
                off = np.hypot(uv[js, 0] - u, uv[js, 1] - v)
                j = int(js[np.argmin(off)])
                if j not in used and off.min() / step < claims.get(j, (np.inf, cell))[0]:
                    claims[j] = float(off.min() / step), cell
        for j, (_, cell) in claims.items():
            cells[cell], at[cell] = j, complex(*uv[j])
            used.add(j)
        # With more of the grid known, discs may be found where they were not before.
        front, all_round = [cell for _, cell in claims.values()], not claims and not all_round
        if all_round:
            front = list(cells)
    return cells


def _beside(cell: Cell) -> list[Cell]:
    return [(cell[0] + dx, cell[1] + dy) for dx, dy in _SIDES]


def extrapolated(cell: Cell, known: Mapping[Cell, complex]) -> tuple[complex, float] | None:
    """Predict where a cell of a lattice is from the positions of cells nearby.

    ``known``: positions u + iv, px, of cells. Returns the position, px, and the step from its neighbours, px; None where
    nothing beside it is known.
    """
    x, y = cell
    guesses: list[complex] = []
    steps: list[float] = []
    for dx, dy in _SIDES:
        a = known.get((x - dx, y - dy))
        if a is None:
            continue
        b = known.get((x - 2 * dx, y - 2 * dy))
        if b is not None:
            guesses.append(_continued(a, b, known.get((x - 3 * dx, y - 3 * dy))))
            steps.append(abs(a - b))
        for ex, ey in ((dy, dx), (-dy, -dx)):
            corner = known.get((x + ex - dx, y + ey - dy))
            # The same step in the next row, or where that is not known either, the one before it.
            last, first = (x + ex, y + ey), (x + ex - 2 * dx, y + ey - 2 * dy)
            if corner is not None and (last in known or (b is None and first in known)):
                step = known[last] - corner if last in known else corner - known[first]
                guesses.append(a + step)
                steps.append(abs(step))
    if not guesses:
        return _any_step(cell, known)
    middle = complex(median(g.real for g in guesses), median(g.imag for g in guesses))
    return middle, median(steps)


def _any_step(cell: Cell, known: Mapping[Cell, complex]) -> tuple[complex, float] | None:
    """Extrapolate by any step known along the same direction: so it is beside a seed."""
    x, y = cell
    for dx, dy in _SIDES:
        a = known.get((x - dx, y - dy))
        if a is None:
            continue
        for c, p in known.items():
            q = known.get((c[0] + dx, c[1] + dy))
            if q is not None:
                return a + q - p, abs(q - p)
    return None


def _continued(a: complex, b: complex, c: complex | None) -> complex:
    """Continue a line of equally spaced points c, b, a by one; in perspective where all three are known.

    A pinhole maps index t on a line to p t / (1 + q t): of steps in the ratio k the next one has (k + 1) / (3 k - 1) of
    the length of the last.
    """
    step = a - b
    if c is None:
        return a + step
    k = min(max(abs(b - c) / abs(step), 0.7), 1.4)
    return a + step * (k + 1.0) / (3.0 * k - 1.0)


#: How far, in cells, missing discs are predicted from the ones that are seen.
_PREDICTED_CELLS = 3
#: Largest share of the discs in view that may be missing or too many; how much worse the next best placement must be, as
#: a ring in the wrong position makes it.
_MOST_WRONG, _WORSE = 0.25, 2
#: A grid of a size is shown where at least this share of its discs was found, and of each outer line's.
_FILLED = 0.9
#: A step across a missing line is twice as long as others; from this on it is one.
_SKIPPED = 1.5


@dataclass(frozen=True, eq=False)
class GridLayout(Record):
    """The ``cells`` (M, 2) of a board's discs on a square lattice, in its points' order, and which are ``rings`` (M,).

    ``symmetries``: permutations (M,) under which the board looks the same, without identity.
    """

    cells: Ids
    rings: NDArray[np.bool_]
    symmetries: tuple[Ids, ...]


@dataclass(frozen=True, eq=False)
class Placement(Record):
    """Which discs of a board a lattice shows: ``ids`` (N,), -1 beside the board; ``lost``: discs in view but not found.

    ``wrong`` counts discs missing or too many and, weighted, rings in the wrong position.
    """

    ids: Ids
    lost: int
    wrong: int
    rings_wrong: int


def number_cells(
    cells: Ids, theta: Array, hollow: NDArray[np.bool_], layout: GridLayout, size_px: tuple[int, int]
) -> Placement | str:
    """Find which part of a board a lattice shows: the placement that explains most, or the reason why there is none.

    ``cells`` (N, 2) with discs ``theta`` (N, 10), ``hollow`` (N,) those with a hole. Of placements that are equivalent
    under the board's symmetries any one is returned.
    """
    predicted, _ = expected(cells, theta, size_px)
    origin = layout.cells.min(axis=0) - 1
    table = np.full(tuple(np.ptp(layout.cells, axis=0) + 3), -1)
    table[tuple((layout.cells - origin).T)] = np.arange(len(layout.cells))

    def at(cells: Ids) -> Ids:
        return np.asarray(table[tuple(np.clip(cells - origin, 0, np.array(table.shape) - 1).T)])

    placements, rotation = [], np.eye(2, dtype=np.int64)
    for _ in range(4):
        rotated = cells @ rotation
        shifts = (layout.cells[None] - rotated[:, None]).reshape(-1, 2)
        low, span = shifts.min(axis=0), int(np.ptp(shifts[:, 1])) + 1
        counts = np.bincount((shifts - low) @ [span, 1])
        for code in np.flatnonzero(counts >= 0.5 * counts.max()).tolist():
            shift = low + np.array(divmod(code, span))
            ids, lost = at(rotated + shift), int((at(predicted @ rotation + shift) >= 0).sum())
            matched = ids >= 0
            ring_errors = int((hollow[matched] != layout.rings[ids[matched]]).sum()) if layout.rings.any() else 0
            wrong = int((~matched).sum()) + lost + _WORSE * ring_errors
            placements.append(Placement(ids, lost, wrong, ring_errors))
        rotation = rotation @ np.array([[0, 1], [-1, 0]])
    return _unambiguous(placements, layout)


def _unambiguous(placements: list[Placement], layout: GridLayout) -> Placement | str:
    """Return the placement with the least wrong, or the reason why it is none."""
    best = min(placements, key=lambda p: (p.wrong, -int((p.ids >= 0).sum())))
    matched = int((best.ids >= 0).sum())
    if best.wrong - _WORSE * best.rings_wrong > _MOST_WRONG * (matched + best.lost):
        return f"{len(best.ids)} discs in a grid were found, which do not make the board"
    if best.rings_wrong > 1:
        return "its discs were found, but the rings among them are not where the board has them"
    same = [best.ids, *(np.where(best.ids >= 0, perm[best.ids], -1) for perm in layout.symmetries)]
    others = [p.wrong for p in placements if not any((p.ids == ids).all() for ids in same)]
    if min(others, default=best.wrong + _WORSE) < best.wrong + _WORSE:
        return (
            f"{matched} of its {len(layout.cells)} discs were found, and which ones they are is unknown: show all of it"
            + ("" if layout.rings.any() else ", or use a board with rings")
        )
    return best


def skips_line(cells: Ids, theta: Array) -> bool:
    """Return whether a whole row or column of discs between others was not found.

    Three lines left of four fit a projection as well, one numbered wrongly. Steps are measured by the discs they lead to:
    in coordinates in which these are unit circles, one across a line that is missing is twice as long as others.

    ``cells``: (N, 2) the lattice's cells; ``theta``: (N, 10) its discs, as in
    :class:`~armsight.vision.markers.circle_blobs.Blobs`.
    """
    at = {(x, y): i for i, (x, y) in enumerate(cells.tolist())}
    steps: dict[tuple[int, int], list[float]] = {}
    for (x, y), i in at.items():
        for axis, (dx, dy) in enumerate(_SIDES[:2]):
            j = at.get((x + dx, y + dy))
            if j is not None:
                u, v = theta[j, :2] - theta[i, :2]
                both = [m11 * u * u + 2.0 * m12 * u * v + m22 * v * v for m11, m12, m22 in theta[[i, j], 2:5]]
                steps.setdefault((axis, (x, y)[axis]), []).append(float(np.sqrt(both[0] * both[1])))
    squares = [median(each) for each in steps.values()]
    sure = [median(each) for each in steps.values() if len(each) > 1]  # one step alone may be short by chance
    return bool(sure) and max(squares) > _SKIPPED**2 * min(sure)


def shown_size(cells: Ids, *, staggered: bool, like: tuple[int, int]) -> tuple[int, int] | None:
    """Return the columns and rows of the grid that a lattice fills; of several readings, the one nearest to a board's.

    Outer lines that lack more than a tenth of the discs of the next ones (in a staggered grid the next but one) are not of
    the grid.

    ``cells``: (N, 2) the lattice's cells; ``staggered``: whether the lattice lies diagonally in the grid; ``like``: columns
    and rows of the board. Returns None where the lattice fills no grid.
    """
    x, y = cells.T
    at, step = np.stack([x - y, x + y] if staggered else [x, y], axis=1), 2 if staggered else 1
    while len(at):
        low, kept = at.min(axis=0), np.ones(len(at), bool)
        for axis in (0, 1):
            counts = np.bincount(at[:, axis] - low[axis])
            for end, inner in ((0, step), (len(counts) - 1, len(counts) - 1 - step)):
                if 0 <= inner < len(counts) and counts[end] < _FILLED * counts[inner]:
                    kept &= at[:, axis] - low[axis] != end
        if kept.all():
            break
        at = at[kept]
    if len(at) < (1.0 - _MOST_WRONG) * len(cells):
        return None
    wide, tall = (np.ptp(at, axis=0) + 1).tolist()
    sizes = [(wide // 2, tall), (tall // 2, wide)] if staggered else [(wide, tall), (tall, wide)]
    whole = [size for size in sizes if _FILLED * size[0] * size[1] <= len(at) <= size[0] * size[1]]
    return min(whole, key=lambda size: abs(size[0] - like[0]) + abs(size[1] - like[1]), default=None)


def positions(cells: Ids, uv: Array) -> dict[Cell, complex]:
    """Return the positions uv (N, 2) of cells (N, 2) as :func:`extrapolated` takes them."""
    return {(x, y): complex(u, v) for (x, y), (u, v) in zip(cells.tolist(), uv.tolist(), strict=True)}


def expected(cells: Ids, theta: Array, size_px: tuple[int, int]) -> tuple[Ids, Array]:
    """Predict where discs next to those of a lattice would be, as far as they would be in the image.

    ``cells``: (N, 2) the lattice's cells; ``theta``: (N, 10) its discs; ``size_px``: width and height of the image. Returns
    (K, 2) further cells; (K, 2) where they would be, px.
    """
    seen = positions(cells, theta[:, :2])
    radius_px = float(np.median(theta[:, 2] * theta[:, 4] - theta[:, 3] ** 2) ** -0.25)
    known, front = dict(seen), set(seen)
    for _ in range(_PREDICTED_CELLS):
        fresh: dict[Cell, complex] = {}
        for cell in sorted({n for c in front for n in _beside(c)} - known.keys()):
            guess = extrapolated(cell, known)
            if guess is not None:
                u, v = guess[0].real, guess[0].imag
                if radius_px < min(u, v, size_px[0] - 1 - u, size_px[1] - 1 - v):
                    fresh[cell] = guess[0]
        known.update(fresh)
        front = set(fresh)
    more = {cell: (p.real, p.imag) for cell, p in known.items() if cell not in seen}
    return np.array(list(more), np.int64).reshape(-1, 2), np.array(list(more.values())).reshape(-1, 2)
