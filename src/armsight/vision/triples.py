"""Three pairs of discs whose distances are those of three discs of the body: where the body may be.

Every pair of discs (:mod:`~armsight.vision.discs.pairing`) with every name that fits it is a node; two nodes are joined where
their distance is that of the two discs on the body, within what noise and calibration allow; every triangle of nodes
gives a pose by a rigid fit.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from armsight.data import Array, Ids, Record
from armsight.vision.disc_view import DiscView
from armsight.vision.discs.pairing import Pairs

#: Distances that differ by more standard deviations than this are different.
DISTANCE_SIGMAS = 4.5
#: Three discs whose height is less than this share of their longest side fix no pose.
SLIM = 0.05
#: More edges than these are not looked at, and no more triples are listed.
MOST_EDGES, MOST_TRIPLES = 500_000, 5_000
_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Triples(Record):
    """Triples of pairs that may be three discs of the body, those of the largest bodies first, then those that fit best.

    Attributes:
        ids: (T, 3) rows of the body's discs.
        rows: (T, 3) rows of the pairs.
        Ts_left_body: (T, 4, 4) the rigid fits.
        most: (T,) how many of the body's discs can be seen at most where this triple is right.
        left_out: the same for the triples that were too many to be listed; 0 where none were.
    """

    ids: Ids
    rows: Ids
    Ts_left_body: Array
    most: Ids
    left_out: int


def triples(view: DiscView, pairs: Pairs) -> Triples | None:
    """Find the triples of pairs with the body's distances; None where there are too many pairs alone."""
    edges = _edges(view, pairs)
    if edges is None:
        return None
    nodes, first, second, chi2 = edges
    key = first * len(nodes) + second
    order = np.argsort(key)
    first, second, chi2 = first[order], second[order], chi2[order]
    start = np.searchsorted(first, np.arange(len(nodes) + 1))
    shared = np.zeros(len(nodes), np.int64)
    _triangles(start, second, shared, 0, np.empty((0, 5), np.int64))
    # A triple's least shared node; the most shared are listed. One node of n that fit together is in C(n - 1, 2) triples.
    enough = 1
    while (
        count := _triangles(start, second, shared, enough, found := np.empty((MOST_TRIPLES, 5), np.int64))
    ) > MOST_TRIPLES:
        enough = 2 * enough
    found = found[:count]
    ids, rows = nodes[found[:, :3], 1], nodes[found[:, :3], 0]
    good = spread(view.target.body.points[ids])
    found, ids, rows = found[good], ids[good], rows[good]
    support = shared[found[:, :3]].min(axis=1, initial=np.iinfo(np.int64).max)
    third = np.searchsorted(first * len(nodes) + second, found[:, 1] * len(nodes) + found[:, 2])
    order = np.lexsort([chi2[found[:, 3]] + chi2[found[:, 4]] + chi2[third], -support])
    ids, rows = ids[order], rows[order]
    Ts = _rigid(view.target.body.points[ids], pairs.p_left[rows])
    return Triples(ids, rows, Ts, _most(support[order]), int(_most(np.array([enough - 1]))[0]))


def _most(support: Ids) -> Ids:
    """Return the most nodes that can all be joined where each is in so many triangles: (n - 1)(n - 2) / 2 at the least."""
    return np.where(support > 0, (3 + np.sqrt(1 + 8 * support)) // 2, 0).astype(np.int64)


def _edges(view: DiscView, pairs: Pairs) -> tuple[Ids, Ids, Ids, Array] | None:
    """Return nodes (V, 2) of pair and disc, the first and second node (E,) of every edge, and its chi-square (E,)."""
    points, slack = view.target.body.points, view.unmade_m
    sides = np.linalg.norm(points[:, None] - points[None], axis=2)
    pair, disc = np.nonzero(pairs.fits)
    node = np.full(pairs.fits.shape, -1)
    node[pair, disc] = np.arange(len(pair))
    nodes = np.column_stack([pair, disc])
    if not len(pair):
        return nodes, pair, pair, np.zeros(0)
    # No two discs lie farther apart than this, the least certain pairs included.
    sigma = np.sqrt(np.linalg.eigvalsh(pairs.cov)[:, -1].max() * 2)
    tree = cKDTree(pairs.p_left)
    reach = sides.max() + DISTANCE_SIGMAS * (sigma + slack)
    if tree.count_neighbors(tree, reach) > 2 * MOST_EDGES:
        return None
    i, j = tree.query_pairs(reach, output_type="ndarray").T
    apart = (pairs.left[i] != pairs.left[j]) & (pairs.right[i] != pairs.right[j])
    i, j = i[apart], j[apart]
    along = pairs.p_left[i] - pairs.p_left[j]
    distance = np.linalg.norm(along, axis=1)
    along /= np.maximum(distance, 1e-12)[:, None]
    by_rig = np.einsum("ni,nir->nr", along, pairs.by_rig[i] - pairs.by_rig[j])
    variance = np.einsum("ni,nij,nj->n", along, pairs.cov[i] + pairs.cov[j], along) + (by_rig**2).sum(axis=1) + slack**2
    order = np.argsort(distance)
    i, j, distance, variance = i[order], j[order], distance[order], variance[order]
    widest = DISTANCE_SIGMAS * np.sqrt(variance.max(initial=0.0))
    first, second, chi2 = [_NONE], [_NONE], [np.zeros(0)]
    for a, b in itertools.combinations(range(len(points)), 2):
        low, high = np.searchsorted(distance, [sides[a, b] - widest, sides[a, b] + widest])
        off = (distance[low:high] - sides[a, b]) ** 2 / variance[low:high]
        close = low + np.flatnonzero(off <= DISTANCE_SIGMAS**2)
        for u, v in ((i[close], j[close]), (j[close], i[close])):
            fit = pairs.fits[u, a] & pairs.fits[v, b]
            ends = node[u[fit], a], node[v[fit], b]
            first.append(np.minimum(*ends))
            second.append(np.maximum(*ends))
            chi2.append(off[close[fit] - low])
        if sum(map(len, first)) > MOST_EDGES:
            return None
    return nodes, np.concatenate(first), np.concatenate(second), np.concatenate(chi2)


@numba.njit(cache=True, error_model="numpy")
def _triangles(start: Ids, second: Ids, shared: Ids, enough: int, found: Ids) -> int:
    """List triangles of nodes a < b < c that are all shared by ``enough`` of them; return how many there are.

    Args:
        start: (V + 1,) where each node's edges to higher nodes begin.
        second: (E,) the higher nodes, rising from each.
        shared: (V,) in how many triangles each node is; with ``enough`` zero it is counted here.
        enough: least of ``shared``.
        found: (T, 5) is filled with nodes a, b, c and the edges ab and ac, as far as it reaches.
    """
    count = 0
    for a in range(len(start) - 1):
        if enough and shared[a] < enough:
            continue
        for e in range(start[a], start[a + 1]):
            b = second[e]
            if enough and shared[b] < enough:
                continue
            i, k = e + 1, start[b]
            while i < start[a + 1] and k < start[b + 1]:
                if second[i] < second[k]:
                    i += 1
                elif second[i] > second[k]:
                    k += 1
                else:
                    c = second[i]
                    if not enough:
                        shared[a] += 1
                        shared[b] += 1
                        shared[c] += 1
                    elif shared[c] >= enough:
                        if count < len(found):
                            found[count, 0], found[count, 1], found[count, 2] = a, b, c
                            found[count, 3], found[count, 4] = e, i
                        count += 1
                    i += 1
                    k += 1
    return count


def spread(p: Array) -> NDArray[np.bool_]:
    """(T,) whether triangles (T, 3, 3) are no lines."""
    u, v, w = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], p[:, 2] - p[:, 1]
    longest2 = np.max([(s**2).sum(axis=1) for s in (u, v, w)], axis=0)
    return np.asarray(np.linalg.norm(np.cross(u, v), axis=1) >= SLIM * longest2)


def _rigid(p_b: Array, p_a: Array) -> Array:
    """Lay triangles p_b (T, 3, 3) on p_a (T, 3, 3): (T, 4, 4) transforms; as :func:`~armsight.geometry.rigid.fit_rigid`."""
    mean_b, mean_a = p_b.mean(axis=1), p_a.mean(axis=1)
    U, _, Vt = np.linalg.svd(np.swapaxes(p_a - mean_a[:, None], 1, 2) @ (p_b - mean_b[:, None]))
    flip = np.ones((len(U), 1, 3))
    flip[:, 0, 2] = np.linalg.det(U) * np.linalg.det(Vt)
    T = np.tile(np.eye(4), (len(U), 1, 1))
    T[:, :3, :3] = (U * flip) @ Vt
    T[:, :3, 3] = mean_a - np.einsum("nij,nj->ni", T[:, :3, :3], mean_b)
    return T
