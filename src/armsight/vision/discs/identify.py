"""Identify a body's discs with no prior pose: both cameras and the distances on the body determine which disc is which.

Pairs of discs that the epipolar planes, the depth and their size allow are triangulated
(:mod:`~armsight.vision.discs.pairing`). Every pair with every name that fits it is a node; two nodes are joined where
their distance is that of the two discs on the body, within what noise and calibration allow; every triangle of nodes
gives a pose by a rigid fit (:func:`triples`). Every pose is extended over all discs and weighted against clutter
(:mod:`~armsight.vision.discs.hypothesis`). The best is accepted only where the odds against everything else, clutter
and all other namings together, are those of ERROR_ODDS: an ambiguous answer is a miss and never a guess.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from armsight.data import SIDES, Array, Correspondences, Discs, Ids, Missed, Record
from armsight.geometry.near import pairs_within
from armsight.geometry.rigid import fit_rigid
from armsight.kernels import kernel
from armsight.vision.discs.hypothesis import Hypothesis, hypothesis
from armsight.vision.discs.pairing import MOST_PAIRS, DiscView, Pairs, pair, wrong_size
from armsight.vision.markers.discs import MOST_REPORTED, DiscTarget
from armsight.vision.rig import StereoRig

#: Distances that differ by more standard deviations than this are different.
DISTANCE_SIGMAS = 4.5
#: Three discs whose height is less than this share of their longest side do not determine a pose.
SLIM = 0.05
#: With more edges than this none is examined; no more triples than this are listed.
MOST_EDGES, MOST_TRIPLES = 500_000, 5_000


@dataclass(frozen=True, eq=False)
class Triples(Record):
    """Triples of pairs that may be three discs of the body, those of the largest bodies first, then those that fit best.

    Attributes:
        ids: (T, 3) rows of the body's discs.
        rows: (T, 3) rows of the pairs.
        Ts_left_body: (T, 4, 4) the rigid fits.
        most: (T,) how many of the body's discs can be visible at most if this triple is right.
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
    # The triples with the most shared nodes are listed. One node of n that fit together is in C(n - 1, 2) triples.
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
    Ts = fit_rigid(view.target.body.points[ids], pairs.p_left[rows])
    return Triples(ids, rows, Ts, _most(support[order]), int(_most(np.array([enough - 1]))[0]))


def _most(support: Ids) -> Ids:
    """Return the most nodes that can all be joined where each is in so many triangles: (n - 1)(n - 2) / 2 at the least."""
    return np.where(support > 0, (3 + np.sqrt(1 + 8 * support)) // 2, 0).astype(np.int64)


def _edges(view: DiscView, pairs: Pairs) -> tuple[Ids, Ids, Ids, Array] | None:
    """Return nodes (V, 2) of pair and disc, the first and second node (E,) of every edge, and its chi-square (E,)."""
    points, tolerance = view.target.body.points, view.made_sigma_m
    sides = np.linalg.norm(points[:, None] - points[None], axis=2)
    pair, disc = np.nonzero(pairs.fits)
    node = np.full(pairs.fits.shape, -1)
    node[pair, disc] = np.arange(len(pair))
    nodes = np.column_stack([pair, disc])
    if not len(pair):
        return nodes, pair, pair, np.zeros(0)
    # No two discs lie farther apart than this, the least certain pairs included.
    sigma = np.sqrt(np.trace(pairs.cov, axis1=1, axis2=2).max() * 2)
    near = pairs_within(pairs.p_left, sides.max() + DISTANCE_SIGMAS * (sigma + tolerance), MOST_EDGES + 1)
    if len(near) > MOST_EDGES:
        return None
    i, j = near.T
    apart = (pairs.left[i] != pairs.left[j]) & (pairs.right[i] != pairs.right[j])
    i, j = i[apart], j[apart]
    along = pairs.p_left[i] - pairs.p_left[j]
    distance = np.linalg.norm(along, axis=1)
    along /= np.maximum(distance, 1e-12)[:, None]
    by_rig = np.einsum("ni,nir->nr", along, pairs.by_rig[i] - pairs.by_rig[j])
    variance = (
        np.einsum("ni,nij,nj->n", along, pairs.cov[i] + pairs.cov[j], along) + (by_rig**2).sum(axis=1) + tolerance**2
    )
    ends, chi2 = np.empty((MOST_EDGES, 2), np.int64), np.empty(MOST_EDGES)
    count = _joined(i, j, distance, variance, sides, np.ascontiguousarray(pairs.fits), node, ends, chi2)
    return None if count > MOST_EDGES else (nodes, ends[:count, 0], ends[:count, 1], chi2[:count])


@kernel("i8[::1], i8[::1], f8[::1], f8[::1], f8[:, ::1], const b1[:, ::1], i8[:, ::1], i8[:, ::1], f8[::1]")
def _joined(
    first: Ids, second: Ids, distance: Array, variance: Array, sides: Array, fits: NDArray[np.bool_], node: Ids, ends: Ids,
    chi2: Array,
) -> int:  # fmt: skip
    """Join the nodes of two pairs, ``distance`` (E,) apart, that are discs as far from each other: ``sides`` (M, M).

    fits, node (K, M): which disc a pair may be, and that node. Fill ``ends`` (L, 2), the lower node first, and ``chi2``
    (L,); return their number, at most L + 1.
    """
    count, n = 0, len(sides)
    for e in range(len(first)):
        i, j = first[e], second[e]
        for a in range(n):
            for b in range(n):
                off = (distance[e] - sides[a, b]) ** 2
                if a == b or not (fits[i, a] and fits[j, b] and off <= DISTANCE_SIGMAS**2 * variance[e]):
                    continue
                if count == len(ends):
                    return count + 1
                ends[count, 0], ends[count, 1] = min(node[i, a], node[j, b]), max(node[i, a], node[j, b])
                chi2[count] = off / variance[e]
                count += 1
    return count


@kernel("i8[::1], i8[::1], i8[::1], i8, i8[:, ::1]")
def _triangles(start: Ids, second: Ids, shared: Ids, enough: int, found: Ids) -> int:
    """List triangles of nodes a < b < c that are all shared by ``enough`` of them; return how many there are.

    start (V + 1,) where each node's edges to higher nodes, second (E,), rising, begin; shared (V,) in how many triangles
    each node is, counted here where ``enough`` is zero; found (T, 5) receives nodes a, b, c and the edges ab and ac.
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
    """(T,) whether triangles (T, 3, 3) are not degenerate to lines."""
    u, v, w = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], p[:, 2] - p[:, 1]
    longest2 = np.max([(s**2).sum(axis=1) for s in (u, v, w)], axis=0)
    return np.asarray(np.linalg.norm(np.cross(u, v), axis=1) >= SLIM * longest2)


#: A naming is accepted only where it is so many times likelier than all others together, and than clutter.
ERROR_ODDS = 1e6
#: No more poses of the body than this are weighted against each other.
MOST_HYPOTHESES = 64
#: A triple is skipped where a rough rigid fit rotates one of its discs away by more than this (cosine).
_ROUGHLY_AWAY = -0.3
#: How many times more a disc may contribute elsewhere: nearer to the cameras, or with less clutter around it.
_ALLOWANCE = 1.5


@dataclass(frozen=True, eq=False)
class IdentifiedDiscs(Record):
    """The discs of a body, detected and identified.

    Attributes:
        T_left_body: (4, 4) pose of the body, the perspective bias of the discs taken into account.
        cov: (6, 6) covariance of its tangent, wide: it includes what neither noise nor calibration explain.
        seen: ellipse centres by rows of the target's body, the perspective bias still in them.
        rows: (M, 2) rows of the left and the right camera's discs, -1 where a disc was not seen.
        log_odds: natural logarithm of the odds against the next best explanation.
    """

    T_left_body: Array
    cov: Array
    seen: Correspondences
    rows: Ids
    log_odds: float


def identify(rig: StereoRig, target: DiscTarget, left: Discs, right: Discs) -> IdentifiedDiscs | Missed:
    """Find a body by its discs, pose and names, or why there are none.

    Too few discs, none with the body's distances, all facing away, or more than one way to name them.
    """
    body = target.body
    if len(body.points) < 3 or not spread(body.points[list(combinations(range(len(body.points)), 3))]).any():
        return Missed(f"the discs of {body.name} do not determine a pose: three that are not on one line are needed")
    discs = (left, right)
    if min(len(seen.uv) for seen in discs) < 3:
        return Missed(_too_few(target, discs))
    view = DiscView.of(rig, target, left, right)
    pairs = pair(view)
    if pairs is None:
        return Missed(f"{_counts(discs)} make more than {MOST_PAIRS} pairs: too many to identify those of {body.name}")
    found = triples(view, pairs)
    if found is None:
        return Missed(f"ambiguous: {_counts(discs)} fit {body.name} in too many ways to examine")
    hypotheses = _hypotheses(view, pairs, found)
    return hypotheses if isinstance(hypotheses, Missed) else _decided(view, hypotheses)


def _hypotheses(view: DiscView, pairs: Pairs, found: Triples) -> list[Hypothesis] | Missed:
    """Extend every triple to a hypothesis, except those that an earlier hypothesis contains."""
    target, discs, count = view.target, view.discs, len(view.target.radii_m)
    reasons: Counter[str] = Counter()
    accepted: list[Hypothesis] = []
    both = np.stack([pairs.left, pairs.right], axis=1)
    possible = np.flatnonzero(_facing_cameras(view, found)).tolist()
    many = Missed(f"ambiguous: {_counts(discs)} show {target.body.name} at more than {MOST_HYPOTHESES} poses")
    if len(possible) > MOST_HYPOTHESES * comb(count, 3):  # each body has so many triples, and no more
        return many
    tried, contained = 0, np.zeros(len(found.ids), bool)
    for n in possible:
        if _settled(accepted, int(found.most[n])):
            return accepted
        if contained[n]:
            continue
        ids, detections = found.ids[n], both[found.rows[n]]
        if tried == MOST_HYPOTHESES:
            return many
        tried += 1
        rows = np.full((count, 2), -1)
        rows[ids] = detections
        result = hypothesis(view, pairs, found.Ts_left_body[n], rows)
        if isinstance(result, str):
            reasons[result] += 1
        elif not any((h.rows == result.rows).all() for h in accepted):
            accepted.append(result)
            contained |= (result.rows[found.ids] == both[found.rows]).all(axis=(1, 2))
    if found.left_out and not _settled(accepted, found.left_out):
        return many
    if accepted:
        return accepted
    what = f"{len(pairs.left)} pairs of discs may be of {target.body.name}"
    if reasons:
        return Missed(f"{what}, and three have its distances, but {reasons.most_common(1)[0][0]}")
    if len(found.ids):
        return Missed(f"{what}, but three with its distances would be seen from behind")
    hint = wrong_size(view.rig, target, *discs)
    return Missed(hint or f"{what}, but no three have its distances; {_too_few(target, discs)}")


def _settled(accepted: list[Hypothesis], most: int) -> bool:
    """Whether no hypothesis of at most so many discs can come near the best one, by half as much again.

    A score is about proportional to the number of discs, less a constant for the pose.
    """
    best = max(accepted, key=lambda h: h.score, default=None)
    if best is None:
        return False
    count = int((best.rows >= 0).all(axis=1).sum())
    return bool((1 - _ALLOWANCE * most / count) * best.score > np.log(ERROR_ODDS))


def _facing_cameras(view: DiscView, found: Triples) -> Array:
    """(T,) whether no disc of a triple clearly faces away from a camera."""
    points, normals = view.target.body.points[found.ids], view.target.normals[found.ids]
    R, t = found.Ts_left_body[:, :3, :3], found.Ts_left_body[:, :3, 3]
    p, n = np.einsum("tij,tmj->tmi", R, points) + t[:, None], np.einsum("tij,tmj->tmi", R, normals)
    good = np.ones(len(p), bool)
    for eye in (np.zeros(3), view.rig.T_left_right[:3, 3]):
        ray = p - eye
        good &= ~(np.einsum("tmi,tmi->tm", ray, n) / np.linalg.norm(ray, axis=2) > -_ROUGHLY_AWAY).any(axis=1)
    return good


def _decided(view: DiscView, hypotheses: list[Hypothesis]) -> IdentifiedDiscs | Missed:
    """Accept the best hypothesis where no other comes near it and no second body of its kind is in view."""
    best = max(hypotheses, key=lambda h: h.score)
    others = [h for h in hypotheses if best.contradicts(h)]
    scores = [0.0, *(h.score for h in others)]
    odds = best.score - float(np.logaddexp.reduce(scores))
    rival = max(others, key=lambda h: h.score, default=None)
    twin = any(h.score >= np.log(ERROR_ODDS) and not best.shares_with(h) for h in others)
    if odds >= np.log(ERROR_ODDS) and not twin:
        return IdentifiedDiscs(best.T_left_body, best.cov, best.seen, best.rows, odds)
    if rival is None or rival.score < 0:
        return Missed(
            f"ambiguous: {int((best.rows >= 0).all(axis=1).sum())} discs fit {view.target.body.name}, but with so many in "
            f"view it may be chance; {_counts(view.discs)}"
        )
    return Missed(_ambiguous(view.target, best, rival))


def _ambiguous(target: DiscTarget, best: Hypothesis, rival: Hypothesis) -> str:
    """Return the message that names two explanations which are equally likely."""
    name, names = target.body.name, target.body.point_names
    here, there = ({tuple(pair) for pair in h.rows if (pair >= 0).all()} for h in (best, rival))
    if here == there:
        order = [names[m] for row in best.rows for m in np.flatnonzero((rival.rows == row).all(axis=1)) if row[0] >= 0]
        given = [names[m] for m, row in enumerate(best.rows) if row[0] >= 0 and row[1] >= 0]
        return f"ambiguous: the same discs may be {' '.join(given)} of {name}, or {' '.join(order)}"
    positions = " and at ".join(
        "({:.0f} {:.0f} {:.0f}) mm".format(*(1e3 * h.T_left_body[:3, 3])) for h in (best, rival)
    )
    return f"ambiguous: {name} may be at {positions}"


def _counts(discs: tuple[Discs, Discs]) -> str:
    return (
        " and ".join(f"{len(seen.uv)} discs in the {side}" for side, seen in zip(SIDES, discs, strict=True)) + " image"
    )


def _too_few(target: DiscTarget, discs: tuple[Discs, Discs]) -> str:
    """Return the number of discs found and of candidates rejected in each image, as text."""
    parts = []
    for side, seen in zip(SIDES, discs, strict=True):
        text = f"{side}: {len(seen.uv)} disc{'' if len(seen.uv) == 1 else 's'} found"
        if seen.rejected:
            many, first = len(seen.rejected), seen.rejected[0].reason  # the one that looks most like a disc
            count = f"{many} or more" if many >= MOST_REPORTED else f"{many}"
            text += f" ({count} other candidate{'' if many == 1 else 's'} rejected; the most likely: {first})"
        parts.append(text)
    return f"{'; '.join(parts)}; {target.body.name} has {len(target.radii_m)}"
