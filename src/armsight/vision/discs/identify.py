"""Which of a body's discs each detection is, with nothing known beforehand: both cameras and the body's distances tell.

Pairs of discs that the epipolar planes, the depth and their size allow are triangulated
(:mod:`~armsight.vision.discs.pairing`); three of them with three of the body's distances give a pose
(:mod:`~armsight.vision.triples`); every pose is grown over all discs and weighed against clutter
(:mod:`~armsight.vision.discs.hypothesis`). The best is the answer only where the odds against everything else, clutter and all
other namings together, are those of ERROR_ODDS: an ambiguous answer is a miss and never a guess.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np

from armsight.data import SIDES, Array, Correspondences, Discs, Ids, Missed, Record
from armsight.vision.discs.assign import assign
from armsight.vision.disc_size import wrong_size
from armsight.vision.disc_view import DiscView
from armsight.vision.expected import centred
from armsight.vision.discs.hypothesis import Hypothesis, hypothesis
from armsight.vision.markers.disc.target import MOST_TOLD, DiscTarget
from armsight.vision.discs.pairing import MOST_PAIRS, Pairs, pair
from armsight.vision.rig import StereoRig
from armsight.vision.triples import Triples, spread, triples

__all__ = ["Identified", "assign", "centred", "identify"]

#: A naming is given only where it is so many times likelier than all others together, and than clutter.
ERROR_ODDS = 1e6
#: More ways than these to lay the body on the discs are not weighed.
MOST_HYPOTHESES = 64
#: A triple whose discs a rough rigid fit turns away by more than this (cosine) is not looked at more closely.
_ROUGHLY_AWAY = -0.3
#: How many times more a disc may count elsewhere: nearer to the cameras, or with less clutter about it.
_ALLOWANCE = 1.5


@dataclass(frozen=True, eq=False)
class Identified(Record):
    """The discs of a body, found and named.

    Attributes:
        T_left_body: (4, 4) pose of the body, the perspective bias of the discs taken into account.
        cov: (6, 6) covariance of its tangent, wide: it holds what neither noise nor calibration explain.
        seen: ellipse centres by rows of the target's body, the perspective bias still in them.
        rows: (M, 2) rows of the left and the right camera's discs, -1 where a disc was not seen.
        log_odds: natural logarithm of the odds against the next best explanation.
    """

    T_left_body: Array
    cov: Array
    seen: Correspondences
    rows: Ids
    log_odds: float


def identify(rig: StereoRig, target: DiscTarget, left: Discs, right: Discs) -> Identified | Missed:
    """Find a body by its discs.

    Args:
        rig: the calibrated pair.
        target: the discs.
        left: what the left camera saw.
        right: what the right camera saw.

    Returns:
        Pose and names, or why there are none: too few discs, none with the body's distances, all turned away, or more
        than one way to name them.
    """
    body = target.body
    if len(body.points) < 3 or not spread(body.points[list(combinations(range(len(body.points)), 3))]).any():
        return Missed(f"the discs of {body.name} fix no pose: three that are not on one line are needed")
    discs = (left, right)
    if min(len(seen.uv) for seen in discs) < 3:
        return Missed(_too_few(target, discs))
    view = DiscView.of(rig, target, left, right)
    pairs = pair(view)
    if pairs is None:
        return Missed(f"{_counts(discs)} make more than {MOST_PAIRS} pairs: too many to tell which are of {body.name}")
    found = triples(view, pairs)
    if found is None:
        return Missed(f"ambiguous: {_counts(discs)} fit {body.name} in too many ways to look at")
    weighed = _weighed(view, pairs, found)
    return weighed if isinstance(weighed, Missed) else _decided(view, weighed)


def _weighed(view: DiscView, pairs: Pairs, found: Triples) -> list[Hypothesis] | Missed:
    """Grow every triple into a hypothesis, those that another has grown into already left out."""
    target, discs, count = view.target, view.discs, len(view.target.radii_m)
    reasons: Counter[str] = Counter()
    grown: list[Hypothesis] = []
    both = np.stack([pairs.left, pairs.right], axis=1)
    possible = np.flatnonzero(_turned_to(view, found)).tolist()
    many = Missed(f"ambiguous: {_counts(discs)} show {target.body.name} in more than {MOST_HYPOTHESES} places or turns")
    if len(possible) > MOST_HYPOTHESES * comb(count, 3):  # each body has so many triples, and no more
        return many
    tried = 0
    for n in possible:
        if _settled(grown, int(found.most[n])):
            return grown
        ids, detections = found.ids[n], both[found.rows[n]]
        if any((h.rows[ids] == detections).all() for h in grown):
            continue
        if tried == MOST_HYPOTHESES:
            return many
        tried += 1
        rows = np.full((count, 2), -1)
        rows[ids] = detections
        result = hypothesis(view, pairs, found.Ts_left_body[n], rows)
        if isinstance(result, str):
            reasons[result] += 1
        elif not any((h.rows == result.rows).all() for h in grown):
            grown.append(result)
    if found.left_out and not _settled(grown, found.left_out):
        return many
    if grown:
        return grown
    what = f"{len(pairs.left)} pairs of discs may be of {target.body.name}"
    if reasons:
        return Missed(f"{what}, and three have its distances, but {reasons.most_common(1)[0][0]}")
    if len(found.ids):
        return Missed(f"{what}, but three with its distances would be seen from behind")
    hint = wrong_size(view.rig, target, *discs)
    return Missed(hint or f"{what}, but no three have its distances; {_too_few(target, discs)}")


def _settled(grown: list[Hypothesis], most: int) -> bool:
    """Whether no hypothesis of at most so many discs can come near the best one.

    A score is about proportional to the number of discs, less what the pose costs; half as much again is allowed for.
    """
    best = max(grown, key=lambda h: h.score, default=None)
    if best is None:
        return False
    count = int((best.rows >= 0).all(axis=1).sum())
    return bool((1 - _ALLOWANCE * most / count) * best.score > np.log(ERROR_ODDS))


def _turned_to(view: DiscView, found: Triples) -> Array:
    """(T,) whether no disc of a triple is turned well away from a camera."""
    points, normals = view.target.body.points[found.ids], view.target.normals[found.ids]
    R, t = found.Ts_left_body[:, :3, :3], found.Ts_left_body[:, :3, 3]
    p, n = np.einsum("tij,tmj->tmi", R, points) + t[:, None], np.einsum("tij,tmj->tmi", R, normals)
    good = np.ones(len(p), bool)
    for eye in (np.zeros(3), view.rig.T_left_right[:3, 3]):
        ray = p - eye
        good &= ~(np.einsum("tmi,tmi->tm", ray, n) / np.linalg.norm(ray, axis=2) > -_ROUGHLY_AWAY).any(axis=1)
    return good


def _decided(view: DiscView, weighed: list[Hypothesis]) -> Identified | Missed:
    """Take the best hypothesis where nothing else comes near it, and no second body of the kind is there."""
    best = max(weighed, key=lambda h: h.score)
    others = [h for h in weighed if best.contradicts(h)]
    scores = [0.0, *(h.score for h in others)]
    odds = best.score - float(np.logaddexp.reduce(scores))
    rival = max(others, key=lambda h: h.score, default=None)
    twin = any(h.score >= np.log(ERROR_ODDS) and not best.shares_with(h) for h in others)
    if odds >= np.log(ERROR_ODDS) and not twin:
        return Identified(best.T_left_body, best.cov, best.seen, best.rows, odds)
    if rival is None or rival.score < 0:
        return Missed(
            f"ambiguous: {int((best.rows >= 0).all(axis=1).sum())} discs fit {view.target.body.name}, but with so many in "
            f"view it may be chance; {_counts(view.discs)}"
        )
    return Missed(_ambiguous(view.target, best, rival))


def _ambiguous(target: DiscTarget, best: Hypothesis, rival: Hypothesis) -> str:
    """Say between which two explanations there is nothing to choose."""
    name, names = target.body.name, target.body.point_names
    here, there = ({tuple(pair) for pair in h.rows if (pair >= 0).all()} for h in (best, rival))
    if here == there:
        order = [names[m] for row in best.rows for m in np.flatnonzero((rival.rows == row).all(axis=1)) if row[0] >= 0]
        given = [names[m] for m, row in enumerate(best.rows) if row[0] >= 0 and row[1] >= 0]
        return f"ambiguous: the same discs may be {' '.join(given)} of {name}, or {' '.join(order)}"
    places = " and at ".join("({:.0f} {:.0f} {:.0f}) mm".format(*(1e3 * h.T_left_body[:3, 3])) for h in (best, rival))
    return f"ambiguous: {name} may be at {places}"


def _counts(discs: tuple[Discs, Discs]) -> str:
    """Say how many discs each camera saw."""
    return (
        " and ".join(f"{len(seen.uv)} discs in the {side}" for side, seen in zip(SIDES, discs, strict=True)) + " image"
    )


def _too_few(target: DiscTarget, discs: tuple[Discs, Discs]) -> str:
    """Say how many discs each camera found and what it threw away."""
    parts = []
    for side, seen in zip(SIDES, discs, strict=True):
        text = f"{side}: {len(seen.uv)} disc{'' if len(seen.uv) == 1 else 's'} found"
        if seen.rejected:
            many, first = len(seen.rejected), seen.rejected[0].reason  # the one that looks most like a disc
            count = f"{many} or more" if many >= MOST_TOLD else f"{many}"
            text += f" ({count} other place{'' if many == 1 else 's'} looked at; the most likely: {first})"
        parts.append(text)
    return f"{'; '.join(parts)}; {target.body.name} has {len(target.radii_m)}"
