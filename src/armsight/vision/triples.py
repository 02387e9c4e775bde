"""Three pairs of discs whose distances are those of three discs of the body: where the body may be.

Every pair of discs (:mod:`~armsight.vision.pairing`) with every name that fits it is a node; two nodes are joined where
their distance is that of the two discs on the body, within what noise and calibration allow; every triangle of nodes
gives a pose by a rigid fit.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from armsight.data import Array, Ids, Record
from armsight.vision.disc_view import DiscView
from armsight.vision.pairing import Pairs

#: Distances that differ by more standard deviations than this are different.
DISTANCE_SIGMAS = 4.5
#: Three discs whose height is less than this share of their longest side fix no pose.
SLIM = 0.05
#: More edges, corners or triangles than these are not looked at.
MOST_EDGES, MOST_CORNERS, MOST_TRIPLES = 500_000, 2_000_000, 20_000
_NONE = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class Triples(Record):
    """Triples of pairs that may be three discs of the body, those of the largest bodies first, then those that fit best.

    Attributes:
        ids: (T, 3) rows of the body's discs.
        rows: (T, 3) rows of the pairs.
        Ts_left_body: (T, 4, 4) the rigid fits.
    """

    ids: Ids
    rows: Ids
    Ts_left_body: Array


def triples(view: DiscView, pairs: Pairs) -> Triples | None:
    """Find every triple of pairs with the body's distances; None where there are too many."""
    target = view.target
    edges = _edges(view, pairs)
    if edges is None:
        return None
    nodes, first, second, chi2 = edges
    found = _triangles(first, second, len(nodes))
    if found is None:
        return None
    a, b, c, e = found
    ids, rows = nodes[np.stack([a, b, c], axis=1), 1], nodes[np.stack([a, b, c], axis=1), 0]
    good = spread(target.body.points[ids])
    ids, rows, cost = ids[good], rows[good], chi2[e[good]].sum(axis=1)
    Ts = _rigid(target.body.points[ids], pairs.p_left[rows])
    shared = np.bincount(
        np.stack([a, b, c]).ravel(), minlength=len(nodes)
    )  # of a body's discs, each is in many triples
    support = np.min([shared[a], shared[b], shared[c]], axis=0)[good]
    order = np.lexsort([cost, -support])
    return Triples(ids[order], rows[order], Ts[order]) if len(order) <= MOST_TRIPLES else None


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


def _triangles(first: Ids, second: Ids, count: int) -> tuple[Ids, Ids, Ids, Ids] | None:
    """Return nodes a < b < c (T,) of every triangle and its edges (T, 3); None where there are too many to look at."""
    key = first.astype(np.int64) * count + second
    order = np.argsort(key)
    first, second, key = first[order], second[order], key[order]
    after = np.searchsorted(first, first, side="right")
    place = np.arange(len(first))
    more = after - place - 1  # edges of the same first node that follow
    if more.sum() > MOST_CORNERS:
        return None
    e1 = np.repeat(place, more)
    e2 = e1 + 1 + np.arange(len(e1)) - np.repeat(np.cumsum(more) - more, more)
    want = second[e1] * count + second[e2]
    e3 = np.minimum(np.searchsorted(key, want), max(len(key) - 1, 0))
    closed = key[e3] == want if len(key) else np.zeros(0, bool)
    e1, e2, e3 = e1[closed], e2[closed], e3[closed]
    return first[e1], second[e1], second[e2], order[np.stack([e1, e2, e3], axis=1)]


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
