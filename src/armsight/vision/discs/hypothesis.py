"""How likely it is that given discs are those of a body at one pose, rather than discs of something else.

The score is the logarithm of a Bayes factor: the body at some pose, with no prior knowledge of it, against the better
of two other explanations: discs of the same appearance spread as densely over each image as it shows them, and real
discs spread in space as densely as there are pairs that the body does not explain (Bar-Shalom and Li,
"Multitarget-Multisensor Tracking", 1995, 6: association likelihoods). The free parameters of each explanation, a pose
or positions, are integrated out by Laplace's approximation. The score combines how well the discs fit, how many there
are, how precisely they could have contradicted, and how easily something else would produce the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Correspondences, Ids, Record
from armsight.estimate.chance import MISTAKE, chi_square_limit
from armsight.geometry.pose import exp_se3, transform
from armsight.vision.discs.assign import correspondences, settle
from armsight.vision.discs.bias import LEAST_FACING, Expected, expect, visible
from armsight.vision.discs.pairing import DEPTHS_M, SIZE_TOLERANCE, DiscView, Pairs
from armsight.vision.match import SIGMAS
from armsight.vision.triangulate import pixels_by_rig

#: A disc in view is found with this probability.
FOUND = 0.9
#: One standard deviation of an ellipse's size about the disc's, as a share, beside its noise.
SIZE_SHARE = SIZE_TOLERANCE / 3
_STEPS, _DONE = 12, 1e-4
#: Per camera (M, N) which detections have the shape of which disc's ellipse.
Congruent: TypeAlias = tuple[NDArray[np.bool_], NDArray[np.bool_]]


@dataclass(frozen=True, eq=False)
class Hypothesis(Record):
    """A naming of detections and the pose that follows."""

    rows: Ids  #: (M, 2) rows of the left and the right camera's discs, -1 where a disc was not seen
    T_left_body: Array  #: (4, 4) the pose
    cov: Array  #: (6, 6) covariance of its tangent, noise and calibration
    seen: Correspondences  #: ellipse centres by rows of the target's body
    score: float  #: logarithm of the Bayes factor against clutter

    def contradicts(self, other: Hypothesis) -> bool:
        """Whether one disc is two detections, or one detection two discs."""
        for side in (0, 1):
            mine, theirs = self.rows[:, side], other.rows[:, side]
            both = (mine >= 0) & (theirs >= 0)
            if (mine[both] != theirs[both]).any():
                return True
            ids = {row: m for m, row in enumerate(mine) if row >= 0}
            if any(ids.get(row, m) != m for m, row in enumerate(theirs) if row >= 0):
                return True
        return False

    def shares_with(self, other: Hypothesis) -> bool:
        """Whether one detection is used by both."""
        return any(bool(np.isin(self.rows[self.rows[:, s] >= 0, s], other.rows[:, s]).any()) for s in (0, 1))


@dataclass(frozen=True, eq=False)
class _Fit(Record):
    """A least-squares pose, the covariance of its tangent, chi-square, and the inverse covariance of the residuals."""

    T_left_body: Array
    cov: Array
    chi2: float
    weight: Array


def hypothesis(view: DiscView, pairs: Pairs, T_left_body: Array, rows: Ids) -> Hypothesis | str:
    """Extend a few named detections to a hypothesis over all discs.

    ``view``: the discs that both cameras detected; ``pairs``: all pairs of discs that may be one disc of the body;
    ``T_left_body``: (4, 4) the approximate pose; ``rows``: (M, 2) detections of three discs or more, -1 elsewhere. Returns
    the hypothesis, or the reason why it is rejected.
    """
    fit = _fit(view, T_left_body, rows)
    if fit is None:
        return "no pose fits"
    found = settle(view, fit.T_left_body, fit.cov, rows)
    if (found.rows != rows).any():
        fit = _fit(view, found.T_left_body, found.rows)
        if fit is None:
            return "no pose fits"
    if fit.chi2 > _limit(2 * int((found.rows >= 0).sum()) - 6):
        return "the discs do not fit the body"
    expected = expect(view.rig, view.target, fit.T_left_body)
    tilt_rad = 3.0 * np.sqrt(np.linalg.eigvalsh(fit.cov[3:, 3:])[-1])
    if (expected.facing[found.rows >= 0] + tilt_rad < LEAST_FACING).any():
        return "its discs would be seen from behind"
    congruent = view.congruent(expected, 0), view.congruent(expected, 1)
    sizes = _size_chi2(view, expected, congruent, found.rows)
    if sizes is None:
        return "the discs do not have the shape that the body's would have"
    score = _score(view, pairs, expected, congruent, found.rows, fit) - sizes / 2
    return Hypothesis(found.rows, fit.T_left_body, fit.cov, correspondences(view, found), score)


@lru_cache(maxsize=256)
def _limit(freedom: int) -> float:
    """Chi-square above which a fit is rejected."""
    return chi_square_limit(freedom, MISTAKE)


def _fit(view: DiscView, T: Array, rows: Ids) -> _Fit | None:
    """Fit a pose to named ellipse centres; the rig's errors count as noise that all detections share."""
    side, m = np.nonzero(rows.T >= 0)
    uv = np.concatenate([view.discs[s].uv[rows[m[side == s], s]] for s in (0, 1)])
    for _ in range(_STEPS):
        expected = expect(view.rig, view.target, T)
        gap = (uv - expected.uv[m, side]).ravel()
        if not np.isfinite(gap).all():
            return None
        by_rig = pixels_by_rig(view.rig, transform(T, view.target.body.points)).reshape(-1, 2, 2, len(view.rig_root))
        by_rig = by_rig[m, side].reshape(len(gap), -1) @ view.rig_root
        S = by_rig @ by_rig.T
        for s in (0, 1):
            here = np.flatnonzero(side == s)
            at = 2 * here[:, None] + [0, 1]
            S[at[:, :, None], at[:, None, :]] += view.covariances(expected, m[here], s, rows[m[here], s])
        J, W = expected.J[m, side].reshape(-1, 6), np.linalg.inv(S)
        information = J.T @ W @ J
        if not np.linalg.cond(information) < 1e15:
            return None
        cov = np.asarray(np.linalg.inv(information), np.float64)
        step = cov @ (J.T @ W @ gap)
        left = float(step @ information @ step)
        if left < _DONE:
            return _Fit(T, cov, float(gap @ W @ gap) - left, np.asarray(W, np.float64))
        T = T @ exp_se3(step)
    return None


def _size_chi2(view: DiscView, expected: Expected, congruent: Congruent, rows: Ids) -> float | None:
    """Return the chi-square of the ellipses' sizes, or None where one does not fit at all."""
    total = 0.0
    for s in (0, 1):
        m = np.flatnonzero(rows[:, s] >= 0)
        row, long = rows[m, s], expected.radius_px[m, s]
        if not congruent[s][m, row].all():
            return None
        sigma2 = (SIZE_SHARE * long) ** 2 + (view.tolerance_px[s][row] / SIGMAS) ** 2
        total += float(((view.radius_px[s][row] - long) ** 2 / sigma2).sum())
    return total


def _score(view: DiscView, pairs: Pairs, expected: Expected, congruent: Congruent, rows: Ids, fit: _Fit) -> float:
    """Return the logarithm of the Bayes factor of the centres; see the module."""
    side, m = np.nonzero(rows.T >= 0)
    lost = int((visible(view.rig, expected) & (rows < 0)).sum())
    # Any direction, anywhere in view, and no distance likelier than another on a logarithmic scale.
    z = max(float(fit.T_left_body[2, 3]), DEPTHS_M[0])
    prior = -np.log(8 * np.pi**2 * 3 * _volume(view, z) * np.log(DEPTHS_M[1] / DEPTHS_M[0]))
    pose = 3 * np.log(2 * np.pi) + np.linalg.slogdet(fit.cov)[1] / 2 + prior
    seen = len(m) * np.log(FOUND) + lost * np.log(1 - FOUND)
    in_image = np.log(np.concatenate([_density(view, expected, congruent[s], rows[:, s], s) for s in (0, 1)]))
    flat = _integrated(fit.weight, np.eye(2 * len(m))) + in_image.sum()
    both = np.asarray((rows >= 0).all(axis=1))
    ids = np.flatnonzero(both)
    # Derivative of the pixels by the positions of the discs seen in both images.
    by_position = np.zeros((len(m), 2, 3 * len(ids)))
    for n, i in enumerate(ids):
        by_position[m == i, :, 3 * n : 3 * n + 3] = expected.J[i, side[m == i], :, :3]
    J = np.hstack([by_position.reshape(2 * len(m), -1), np.eye(2 * len(m)).compress(np.repeat(~both[m], 2), axis=1)])
    solid = (
        _integrated(fit.weight, J)
        + in_image[~both[m]].sum()
        + len(ids) * np.log(_pairs_density(view, pairs, rows, fit))
    )
    return float(pose + seen - fit.chi2 / 2 - max(flat, solid))


def _integrated(weight: Array, J: Array) -> float:
    """Return the logarithm of what integrating over parameters with Jacobian J (N, K) gives, at their optimum."""
    return float(J.shape[1] * np.log(2 * np.pi) - np.linalg.slogdet(J.T @ weight @ J)[1]) / 2


def _volume(view: DiscView, z: float) -> float:
    """Return the volume that the left camera sees up to a distance, m^3, without lens distortion."""
    camera = view.rig.left
    width, height = camera.image_size_px
    return float(width * height / (camera.intrinsics[0] * camera.intrinsics[1]) * z**3 / 3)


def _pairs_density(view: DiscView, pairs: Pairs, rows: Ids, fit: _Fit) -> float:
    """Return the number of pairs of discs per cubic metre that the body does not explain.

    Counted in view, to twice the body's distance at the least, plus one; or about the body where they are denser.
    """
    points = view.target.body.points
    middle = points.mean(axis=0)
    reach = float(np.linalg.norm(points - middle, axis=1).max())
    other = ~(np.isin(pairs.left, rows[:, 0]) | np.isin(pairs.right, rows[:, 1]))
    near = np.linalg.norm(pairs.p_left - transform(fit.T_left_body, middle), axis=1) <= reach
    about = int((other & near).sum()) / (4 / 3 * np.pi * reach**3)
    farthest = max(2 * float(fit.T_left_body[2, 3]), float(pairs.p_left[other, 2].max(initial=0.0)))
    return max((int(other.sum()) + 1) / _volume(view, farthest), about)


def _density(view: DiscView, expected: Expected, alike: NDArray[np.bool_], rows: Ids, s: int) -> Array:
    """Return (K,) the number per square pixel of discs that may be each disc that camera s saw.

    In the image, or about the body where they are denser.
    """
    seen = rows >= 0
    uv = expected.uv[np.isfinite(expected.uv[:, s, 0]), s]
    middle = uv.mean(axis=0)
    reach = float(np.linalg.norm(uv - middle, axis=1).max()) + 2 * expected.radius_px[seen, s]
    near = np.linalg.norm(view.discs[s].uv - middle, axis=1) <= reach[:, None]
    near[:, rows[seen]] = False
    width, height = view.rig.cameras[s].image_size_px
    about = (alike[seen] & near).sum(axis=1) / (np.pi * reach**2)
    return np.asarray(np.maximum(alike[seen].sum(axis=1) / (width * height), about))
