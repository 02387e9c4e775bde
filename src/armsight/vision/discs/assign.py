"""Identify discs where the pose is known approximately: chi-square gates, and an assignment only where it is unique.

A disc's two detections are tested together: an error of the pose moves both images of a disc together, so the epipolar
distance and the disparity are tested independently of it. Every assignment reduces the covariance of the pose, and with
it the other gates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import SIDES, Array, Correspondences, Discs, Dropped, Ids, Missed, Record
from armsight.estimate.chance import MISTAKE, chi_square_limit
from armsight.geometry.pose import exp_se3
from armsight.vision.discs.bias import Expected, expect, visible
from armsight.vision.discs.pairing import DiscView
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.rig import StereoRig

#: Squared distance, in covariances, of a detection that is not of this disc, of one camera and of both.
_GATE_ONE, _GATE_BOTH = (chi_square_limit(n, MISTAKE) for n in (2, 4))
_NONE = np.zeros(0, np.int64)
#: Rows of the left and of the right camera's discs that may be one disc of the body.
Claim = tuple[Ids, Ids]


@dataclass(frozen=True, eq=False)
class Assigned(Record):
    """Detections identified by a pose: rows (M, 2) of the left and the right camera's discs, -1 where one was not seen.

    ``T_left_body`` (4, 4) is updated by the assigned detections; detections compete for the discs that are ``dropped``.
    """

    rows: Ids
    T_left_body: Array
    dropped: tuple[Dropped, ...]


def assign(
    rig: StereoRig, target: DiscTarget, T_left_body: Array, cov: Array, left: Discs, right: Discs
) -> Correspondences | Missed:
    """Identify the discs of a body whose pose is known approximately.

    ``T_left_body``: (4, 4) approximate pose: predicted, or from its coded markers; ``cov``: (6, 6) covariance of its
    tangent; ``left``: the discs detected in the left image; ``right``: the discs detected in the right image. Returns
    ellipse centres by rows of the target's body; discs for which detections compete are dropped by name. Missed where
    nothing is left.
    """
    view = DiscView.of(rig, target, left, right)
    found = settle(view, T_left_body, cov, np.full((len(target.radii_m), 2), -1))
    seen = correspondences(view, found)
    if len(seen.ids):
        return seen
    if found.dropped:
        return Missed(f"ambiguous: {'; '.join(f'{d.point}: {d.reason}' for d in found.dropped)}")
    return Missed(f"no disc is where {target.body.name} should show one")


def correspondences(view: DiscView, found: Assigned) -> Correspondences:
    """Return the assigned detections as correspondences of ellipse centres."""
    ids = np.flatnonzero((found.rows >= 0).any(axis=1))
    uv, cov = np.full((len(ids), 2, 2), np.nan), np.zeros((len(ids), 2, 2, 2))
    for side, seen in enumerate(view.discs):
        rows = found.rows[ids, side]
        there = rows >= 0
        uv[there, side], cov[there, side] = seen.uv[rows[there]], seen.cov_uv[rows[there]]
    return Correspondences(ids, uv, cov, found.dropped, np.stack([seen.common for seen in view.discs]))


def settle(view: DiscView, T_left_body: Array, cov: Array, rows: Ids) -> Assigned:
    """Assign detections to discs by a pose, the unambiguous ones first.

    ``view``: the discs that both cameras detected. ``T_left_body``: (4, 4) approximate pose. ``cov``: (6, 6) covariance of
    its tangent. ``rows``: (M, 2) detections already assigned, which the pose includes; -1 elsewhere.
    """
    T, rows = T_left_body, rows.copy()
    while True:
        expected = expect(view.rig, view.target, T)
        see = np.asarray(visible(view.rig, expected) & (rows < 0).all(axis=1, keepdims=True))
        free = [np.bincount(rows[:, s] + 1, minlength=1 + len(seen.uv))[1:] == 0 for s, seen in enumerate(view.discs)]
        near = [_near(view, expected, cov, s, see[:, s, None] & free[s]) for s in (0, 1)]
        claims = _claims(view, expected, cov, *near)
        unique = _unambiguous(claims)
        if not len(unique):
            break
        rows[unique[:, 0]] = unique[:, 1:]
        T, cov = _improved(view, expected, T, cov, unique)
    names = view.target.body.point_names
    return Assigned(rows, T, tuple(Dropped(names[m], _competing(claim)) for m, claim in claims.items()))


def _near(view: DiscView, expected: Expected, cov: Array, side: int, free: NDArray[np.bool_]) -> tuple[Ids, Ids]:
    """Return discs (K,) and detections (K,) of one camera that may be these, of those that are ``free`` (M, N)."""
    m, rows = np.nonzero(free & view.alike(expected, side))
    gap = view.discs[side].uv[rows] - expected.uv[m, side]
    J = expected.J[:, side]
    S = (J @ cov @ J.swapaxes(1, 2))[m] + view.covariances(expected, m, side, rows)
    good = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(S), gap) <= _GATE_ONE
    return m[good], rows[good]


def _claims(
    view: DiscView, expected: Expected, cov: Array, left: tuple[Ids, Ids], right: tuple[Ids, Ids]
) -> dict[int, Claim]:
    """Return, by disc, those of its detections with which both cameras agree; all where only one camera has any."""
    i, j = np.nonzero(left[0][:, None] == right[0])
    m, a, b = left[0][i], left[1][i], right[1][j]
    J = expected.J.reshape(-1, 4, 6)
    S = (J @ cov @ J.swapaxes(1, 2))[m]
    S[:, :2, :2] += view.covariances(expected, m, 0, a)
    S[:, 2:, 2:] += view.covariances(expected, m, 1, b)
    gap = np.concatenate([view.discs[0].uv[a] - expected.uv[m, 0], view.discs[1].uv[b] - expected.uv[m, 1]], axis=1)
    good = np.einsum("ni,nij,nj->n", gap, np.linalg.inv(S), gap) <= _GATE_BOTH
    both, claims = set(m.tolist()), dict[int, Claim]()
    for disc in np.union1d(left[0], right[0]).tolist():
        agreed = good & (m == disc)
        once = left[1][left[0] == disc], right[1][right[0] == disc]
        claims[disc] = (np.unique(a[agreed]), np.unique(b[agreed])) if disc in both else once
    return claims


def _unambiguous(claims: dict[int, Claim]) -> Ids:
    """Return (K, 3) disc, left and right row of every disc that has one candidate and shares it with no other disc."""
    claimed = [np.concatenate([claim[side] for claim in claims.values()] or [_NONE]) for side in (0, 1)]
    unique = []
    for m, claim in claims.items():
        alone = all((claimed[s] == claim[s]).sum() == 1 for s in (0, 1) if len(claim[s]) == 1)
        if max(map(len, claim)) == 1 and alone:
            unique.append((m, *(rows[0] if len(rows) else -1 for rows in claim)))
    return np.array(unique, np.int64).reshape(-1, 3)


def _improved(view: DiscView, expected: Expected, T: Array, cov: Array, unique: Ids) -> tuple[Array, Array]:
    """Return the pose and its covariance with discs (K, 3) more, by a Kalman update."""
    J, gap, noises = [], [], []
    for side in (0, 1):
        m, rows = unique[unique[:, 1 + side] >= 0][:, [0, 1 + side]].T
        J.append(expected.J[m, side].reshape(-1, 6))
        gap.append((view.discs[side].uv[rows] - expected.uv[m, side]).ravel())
        noises += list(view.covariances(expected, m, side, rows))
    by_pose = np.concatenate(J)
    S, rows = by_pose @ cov @ by_pose.T, np.arange(len(by_pose)).reshape(-1, 2)
    S[rows[:, :, None], rows[:, None, :]] += noises
    gain = np.linalg.solve(S, by_pose @ cov).T
    return T @ exp_se3(gain @ np.concatenate(gap)), cov - gain @ by_pose @ cov


def _competing(claim: Claim) -> str:
    """Return which detections compete for a disc, as text."""
    if not any(map(len, claim)):
        return "the detections of the two cameras at its position do not agree"
    counts = ", ".join(f"{len(rows)} in the {side} image" for side, rows in zip(SIDES, claim, strict=True))
    return f"several detections may be it: {counts}"
