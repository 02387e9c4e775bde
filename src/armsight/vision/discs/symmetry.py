"""Symmetries of a body of discs: the rotations and reflections that map the body, or a part of it, onto itself.

Three points not on one line determine a rigid motion, so every triple of discs that three chosen ones may be taken for
is tried, and the others must then coincide with discs too.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.geometry.pose import transform
from armsight.geometry.rigid import fit_rigid

#: A position extrapolated from three others may be off by so many times more than they are.
_LEVER = 3.0


@dataclass(frozen=True, eq=False)
class Symmetry(Record):
    """One way to take discs for others."""

    seen: Ids  #: (V,) the discs in view, rows of the body's points
    taken_for: Ids  #: (V,) what each may be taken for
    #: (4, 4) the motion that maps the former onto the latter, p_taken_for ~ T @ p_seen; of the body's mirror image in z
    #: = 0 where ``mirrored``
    T: Array
    mirrored: bool  #: whether it is a reflection
    off_m: float  #: largest difference of two discs' distance from that of the discs they are taken for, m


def symmetries(
    points: Array, alike: NDArray[np.bool_], seen: Ids, tolerance_m: float, *, mirrored: bool = False
) -> list[Symmetry]:
    """Find the ways in which discs in view may be taken for others of the same body.

    ``points``: (M, 3) positions of all discs, m. ``alike``: (M, M) whether two discs look alike; discs that do not are
    never taken for each other. ``seen``: (V,) the discs in view, V >= 3, not all on one line. ``tolerance_m``: largest
    difference of two distances that counts as equal, m. ``mirrored``: find reflections instead of rotations. Returns each
    once, without the identity, the closest first.
    """
    p = points * [1.0, 1.0, -1.0] if mirrored else points
    base = _widest(points, seen)
    sides = [np.linalg.norm(points[base[a]] - points[base[b]]) for a, b in ((0, 1), (0, 2), (1, 2))]
    all_ids = range(len(points))
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    own = distance[seen][:, list(base)]
    found: dict[tuple[int, ...], Symmetry] = {}
    for a, b in permutations(all_ids, 2):
        if abs(distance[a, b] - sides[0]) > tolerance_m:
            continue
        for c in all_ids:
            triple = (a, b, c)
            if (
                c in (a, b)
                or abs(distance[a, c] - sides[1]) > tolerance_m
                or abs(distance[b, c] - sides[2]) > tolerance_m
                or not alike[list(base), list(triple)].all()
            ):
                continue
            # Every disc in view needs one whose distances from the three are right: a cheap test that few triples pass.
            fits = np.abs(own[:, None] - distance[:, triple]).max(axis=2) <= tolerance_m
            if not (fits & alike[seen]).any(axis=1).all():
                continue
            T = fit_rigid(p[list(base)], points[list(triple)])
            taken = _nearest(transform(T, p[seen]), points, alike, seen, _LEVER * tolerance_m)
            if taken is None or tuple(taken) in found or (np.array_equal(taken, seen) and not mirrored):
                continue
            off = float(np.abs(distance[np.ix_(taken, taken)] - distance[np.ix_(seen, seen)]).max())
            if off <= tolerance_m:
                found[tuple(taken)] = Symmetry(seen, taken, fit_rigid(p[seen], points[taken]), mirrored, off)
    return sorted(found.values(), key=lambda r: r.off_m)


def flat(points: Array, tolerance_m: float) -> bool:
    """Whether points (N, 3), N >= 3, lie in one plane."""
    middle = points - points.mean(axis=0)
    return bool(np.abs(middle @ np.linalg.svd(middle)[2][2]).max() <= tolerance_m)


def other_side(symmetry: Symmetry, points: Array) -> bool:
    """Whether the motion shows the other side of the flat body (M, 3): a normal of its plane changes its sign."""
    seen = points[symmetry.seen]
    normal = np.linalg.svd(seen - seen.mean(axis=0))[2][2]
    return bool(normal @ symmetry.T[:3, :3] @ normal < 0)


def _widest(points: Array, seen: Ids) -> tuple[int, int, int]:
    """Return three of the discs in view that span much: two far apart, and the one farthest from their line."""
    p = points[seen]
    distance = np.linalg.norm(p[:, None] - p[None], axis=2)
    i, j = np.unravel_index(int(distance.argmax()), distance.shape)
    off = np.linalg.norm(np.cross(p - p[i], p[j] - p[i]), axis=1)
    return int(seen[i]), int(seen[j]), int(seen[int(off.argmax())])


def _nearest(p: Array, points: Array, alike: NDArray[np.bool_], seen: Ids, tolerance_m: float) -> Ids | None:
    """Return (V,) the disc at each position p (V, 3), or None where one has none or two have the same."""
    gap = np.linalg.norm(p[:, None] - points[None], axis=2)
    gap[~alike[seen]] = np.inf
    taken = gap.argmin(axis=1)
    if gap.min(axis=1).max() > tolerance_m or len(set(taken.tolist())) < len(taken):
        return None
    return np.asarray(taken, np.int64)
