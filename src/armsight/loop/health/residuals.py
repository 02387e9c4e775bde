"""Residuals of single shots, and the sums of several: what they say of all that may be wrong, poses eliminated.

Residuals are those of a body as its file says, about the pose that was measured; of one that is far off in size, about the
pose of the triangulated points (Umeyama, 1991). Sums are of their outer products: what changed among the shots is a step
or a ramp.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Ids, PoseEstimate
from armsight.estimate.chance import chi_square_limit, squares_of
from armsight.geometry.pose import inverse, pose
from armsight.loop.health.rows import LENS, differentiated, eliminate_pose
from armsight.vision.camera import pair_arguments
from armsight.vision.rig import StereoRig

#: Points of a body that are used, at most: those of a large board would cost more than they say.
MOST_POINTS = 24
#: A displacement may be so large, m: what is further off is another thing.
FURTHEST_M = 5e-3
#: Shots that differ less than this share their errors and count as one: translation over distance, and rotation, rad.
_SAME = 0.01
_SAME_COSINE = float(np.cos(_SAME))
#: A point left out is another thing also where its two detections disagree by more than chance, once in so many shots.
_PAIRED = chi_square_limit(1, 1e-4)
#: Fewer points than this say nothing of these numbers; shots further apart in time than this give no speed, s.
_LEAST_POINTS, _APART_S = 4, 0.5
#: Residuals are not linear in the size of a body that is off by more than this share of it.
_LINEAR = 0.005
#: The body's motion at a shot is that of so many newest ones, if these are of so short a time, s.
TRACK, _LONGEST_S = 5, 1.0
#: The measured velocity is off by this share in any direction; half: late images blame rig and body, double: hide.
UNKNOWN_SHARE = 0.2
#: An acceleration moves the body like so many seconds of it, where times are of a second.
_BENT_S = 0.1
#: Newest tests kept; half: the comparison is forgotten sooner, double: 2 MB more. Older ones fade so, in tests.
KEPT, _SETTLED = 30, 30.0
#: So many newest tests together may follow a change; one that goes on is looked for in more than STEPS.
#: half: steps are taken for it, double: it is found later.
_AFTER, STEPS = (1, 2, 4, 8, 16), 4
#: Beginnings that are tried first, and then all between the best one's neighbours.
_BEGINS = 8
#: The newest test agrees with all together unless chance explains their difference more rarely than this.
UNLIKE = 0.01
#: A change matters that moves one of so many newest poses by so many of its claimed sigmas: a skew does so in motion alone.
MATTERS, POSES = 2.0, 60
#: One is needed besides others beyond this chance; in so many tests after an alarm it is dated anew.
NECESSARY, FRESH = 1e-4, 6


def velocity(before: Array, after: Array, seconds: float) -> Array:
    """Return the velocity (6,) in the body's axes, 1/s, that takes a pose (4, 4) to another, by a small angle."""
    R = before[:3, :3].T @ after[:3, :3]
    rotation = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    shift = after[:3, :3].T @ (after[:3, 3] - before[:3, 3])
    return np.asarray(np.concatenate([shift, rotation]) / seconds)


def moved_by(A: Array, own: Array) -> Array:
    """Return what (4 N, K) errors of exposures (N, 2, 6, K) do to residuals of derivatives A (4 N, 6) by the pose."""
    return np.asarray(A.reshape(-1, 2, 2, 6) @ own).reshape(len(A), -1)


def noisier(rows: Array, J: Array) -> Array:
    """Return rows (n, M) with more errors in their noise, J (n, K) by a sigma each: (I + J J^T)^-1/2 times them."""
    squares, axes = np.linalg.eigh(J.T @ J)
    squares = np.maximum(squares, 1e-12)
    J = J @ axes
    return np.asarray(rows - J @ (((1.0 - 1.0 / np.sqrt(1.0 + squares)) / squares)[:, None] * (J.T @ rows)))


def differ(T: Array, other: Array) -> bool:
    """Return whether two poses (4, 4) are so far apart that their errors count as independent."""
    by = T[:3, 3] - other[:3, 3]
    cosine = (float(np.vdot(T[:3, :3], other[:3, :3])) - 1.0) / 2.0
    return float(by @ by) > (_SAME * float(T[2, 3])) ** 2 or cosine < _SAME_COSINE


class ExposedShot(NamedTuple):
    """By how much the times of exposure move the residuals of a shot."""

    #: (n, 6) derivative of the residuals by the pose, in standard deviations; rows u, v of the left image and of the
    #: right one, point by point
    A: Array
    roll: Array  #: (n,) the row of the image, from -1 at its top to 1
    #: times, s, and poses T_left_body (4, 4) of the newest shots up to this one
    track: tuple[tuple[float, Array], ...]
    #: (n, K) what is not known of these times, where the detections were moved to one, does to the residuals, by a
    #: sigma each; K is 0 else
    own: Array

    def of(self, rows: NDArray[np.bool_]) -> ExposedShot:
        """Return that of some rows."""
        return self._replace(A=self.A[rows], roll=self.roll[rows], own=self.own[rows])

    def motion(self) -> tuple[Array, Array]:
        """Return velocity and acceleration (6,) of the body in its axes, 1/s and 1/s^2; zero where they are unknown."""
        if len(self.track) < TRACK:
            return np.zeros(6), np.zeros(6)
        (first_s, first), (middle_s, middle), (last_s, last) = self.track[0], self.track[TRACK // 2], self.track[-1]
        if not first_s < middle_s < last_s < first_s + _LONGEST_S:
            return np.zeros(6), np.zeros(6)
        early, late = velocity(first, middle, middle_s - first_s), velocity(middle, last, last_s - middle_s)
        return 1.5 * late - 0.5 * early, (late - early) * 2.0 / (last_s - first_s)

    def moved(self) -> Array:
        """Return what (n, 10) moves the residuals.

        1 s later in the right image, other motions there (6), 1 s at the edge of the right and of the left one; and what
        the first lacks of a body that accelerates.
        """
        right = np.arange(len(self.A)) % 4 >= 2
        by_right, (along, acceleration) = self.A * right[:, None], self.motion()
        speeds = np.repeat(np.linalg.norm(along.reshape(2, 3), axis=1) / math.sqrt(3.0), 3)
        rolled = self.roll * (self.A @ along)
        skew, bent = by_right @ along, _BENT_S * (by_right @ acceleration)
        return np.column_stack([skew, UNKNOWN_SHARE * speeds * by_right, rolled * right, rolled * ~right, bent])

    def without_pose(self, moved: Array) -> Array:
        """Return what moves the residuals (n, K) with the pose eliminated."""
        Q = np.linalg.qr(self.A)[0]
        return np.asarray(moved - Q @ (Q.T @ moved))

    def whitened(self) -> Array:
        """Return the same (n, 10) with the pose eliminated, and with what is not known of the times in the noise."""
        return noisier(self.without_pose(self.moved()), self.without_pose(self.own))

    def response(self) -> Array:
        """Return what (6, 10) these do to the pose."""
        return np.asarray(np.linalg.lstsq(self.A, self.moved(), rcond=None)[0])


class ShotResiduals(NamedTuple):
    """What a shot says, its pose eliminated, of K parameters and M coefficients of what the camera models lack."""

    t_s: float
    rows: Array  #: (n, 1 + K + M) residuals and their derivatives, in standard deviations
    response: Array  #: (6, K + M) of its pose to these
    every: Array  #: as ``rows``, with points that do not fit, which may be displaced
    response_with_all: Array  #: (6, K + M) of a pose measured with these
    #: by how much the times of the exposures would move each row of ``rows``, and of ``every``
    exposed: tuple[ExposedShot, ExposedShot]


class ShotReader:
    """Reads what single shots say of the parameters of a rig, a body and their times.

    Args:
        rig: the calibrated pair.
        body: the body that is measured.
        sync_s: standard deviation of the time between the two exposures of a shot, s.

    Attributes:
        noise_px: standard deviation of a coordinate of the newest shot, px.
    """

    def __init__(self, rig: StereoRig, body: Body, sync_s: float) -> None:
        held = len(body.points)
        #: (M,) rows of the body's points that are used
        self.points = np.linspace(0, held - 1, min(held, MOST_POINTS)).astype(int)
        #: K, count of the parameters: the rig's, size and points of the body, readout and skew
        self.size = rig.parameter_count + 1 + 3 * len(self.points) + 2
        self._rig, self._sync_s, self.noise_px = rig, sync_s, 0.0
        self._row_of = np.full(held, -1)
        self._row_of[self.points] = np.arange(len(self.points))
        #: times, s, and poses T_left_body (4, 4) of the newest shots
        self.track: deque[tuple[float, Array]] = deque(maxlen=TRACK)
        self.used_s = np.full(len(self.points), -np.inf)  #: (M,) when a pose was measured with each point
        counts = np.array([camera.distortion.size for camera in rig.cameras])
        self._pair = (*pair_arguments(rig.cameras), counts, inverse(rig.T_left_right))
        self._p_body = np.array(body.points, float, order="C")
        #: (2, 2) half of the sizes of the images, px
        self.half_px = np.array([camera.image_size_px for camera in rig.cameras]) / 2.0

    def read(self, estimate: PoseEstimate, now_s: float) -> ShotResiduals | None:
        """Return what the newest shot, or one without a track, says; None where too few of its points were measured."""
        seen = estimate.points.seen
        good = np.zeros(len(self._p_body), bool)
        good[estimate.points.ids] = True
        rows = np.flatnonzero(seen.paired & (self._row_of >= 0)[seen.ids])
        ids = seen.ids[rows]
        fits = good[ids]
        if np.count_nonzero(fits) < _LEAST_POINTS:
            return None
        A, whole = np.empty((4 * len(ids), 6)), np.zeros((4 * len(ids), 1 + self.size + LENS))
        size, T = self.linear_about(estimate)
        uv = np.ascontiguousarray(seen.uv[rows])
        noise_px2 = differentiated(
            *self._pair, self.half_px, size * self._p_body, self._row_of, np.asarray(ids, np.int64),
            uv, np.ascontiguousarray(seen.cov_uv[rows]),
            max(self._rig.sigma_px, 1e-6), np.array(T, order="C"),
            self.velocity(), A, whole,
        )  # fmt: skip
        if not np.isfinite(noise_px2):
            return None
        if size != 1.0:  # the residuals of a body as its file says, were they linear
            by_size = 1 + self._rig.parameter_count
            whole[:, by_size] /= size
            whole[:, 0] += (size - 1.0) * whole[:, by_size]
        self.noise_px = float(np.sqrt(noise_px2))
        self.used_s[self._row_of[ids[fits]]] = now_s
        roll = (uv[:, :, 1] / self.half_px[:, 1] - 1.0).repeat(2)
        own = np.zeros((len(A), 0)) if estimate.exposures is None else moved_by(A, estimate.exposures.own[rows])
        exposed = ExposedShot(A, roll, tuple(self.track), own)
        if fits.all():
            response = self._eliminated(exposed, whole)
            return ShotResiduals(now_s, whole, response, whole, response, (exposed, exposed))
        kept, every = np.repeat(fits, 4), np.repeat(fits | self._displaced(A, whole[:, 0]), 4)
        found, with_all = whole[kept], whole[every]
        both = exposed.of(kept), exposed.of(every)
        response, response_with_all = self._eliminated(both[0], found), self._eliminated(both[1], with_all)
        return ShotResiduals(now_s, found, response, with_all, response_with_all, both)

    def linear_about(self, estimate: PoseEstimate) -> tuple[float, Array]:
        """Return the size of the body over that of its file, and the pose (4, 4), about which residuals are linear.

        Those of the file and of the estimate, unless the triangulated points are of another size (Umeyama, 1991).
        """
        p_body, p_left = self._p_body[estimate.points.ids], estimate.points.p_left
        middle_body, middle_left = p_body.mean(axis=0), p_left.mean(axis=0)
        from_body, from_left = p_body - middle_body, p_left - middle_left
        size = float(np.sqrt(np.vdot(from_left, from_left) / np.vdot(from_body, from_body)))
        if abs(size - 1.0) <= _LINEAR:
            return 1.0, estimate.T_left_body
        U, _, Vt = np.linalg.svd(from_left.T @ from_body)
        R = (U * [1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
        return size, pose(R, middle_left - size * (R @ middle_body))

    def _eliminated(self, shot: ExposedShot, rows: Array) -> Array:
        """Eliminate pose and times of a shot's own from rows (n, 1 + K + M); return the pose's response (6, K + M)."""
        response, known = np.empty((6, rows.shape[1])), shot.own.size > 0
        eliminate_pose(shot.A, rows, self.size, 0.0 if known else self._sync_s, response)
        if known:
            rows[:] = noisier(rows, shot.without_pose(shot.own))
        return response[:, 1:]

    @staticmethod
    def _displaced(A: Array, residuals: Array) -> NDArray[np.bool_]:
        """Return (N,) whether a point may be the body's, displaced on it, by its four residuals and the pose's (4 N, 6)."""
        J, r = A[:, :3].reshape(-1, 4, 3), residuals.reshape(-1, 4)
        H, b = np.einsum("nki,nkj->nij", J, J), np.einsum("nki,nk->ni", J, r)
        d = np.linalg.solve(H, b[..., None])[..., 0]
        left = np.einsum("ni,ni->n", r, r) - np.einsum("ni,ni->n", b, d)
        return np.asarray((left < _PAIRED) & (np.linalg.norm(d, axis=1) < FURTHEST_M))

    def velocity(self) -> Array:
        """Return the velocity (6,) of the body between the two newest shots, 1/s; zero where it is unknown."""
        if len(self.track) < 2 or not 0.0 < self.track[-1][0] - self.track[-2][0] < _APART_S:
            return np.zeros(6)
        (before_s, before), (now_s, now) = list(self.track)[-2:]
        return velocity(before, now, now_s - before_s)


@dataclass(frozen=True, eq=False)
class ResidualSums:
    """What whitened residuals say of K parameters, whose priors have variance 1 where they are explained or eliminated."""

    M: Array  #: (1 + K, 1 + K) sum of the outer products of rows [residual; derivatives]
    freedom: float = 0.0  #: degrees of freedom
    begin_s: float = 0.0  #: when the first shot was, s

    @property
    def H(self) -> Array:
        """(K, K) information."""
        return self.M[1:, 1:]

    @property
    def b(self) -> Array:
        """(K,) right side."""
        return self.M[1:, 0]

    @property
    def square(self) -> float:
        """Sum of squares of the residuals."""
        return float(self.M[0, 0])

    def plus(self, other: ResidualSums, weight: float = 1.0) -> ResidualSums:
        """Return these with another's."""
        return replace(self, M=self.M + weight * other.M, freedom=self.freedom + weight * other.freedom)

    def gain(self, rows: Ids | None = None) -> float:
        """Return what parameters, those of some rows or all, explain of the sum of squares."""
        H, b = (self.H, self.b) if rows is None else (self.H[np.ix_(rows, rows)], self.b[rows])
        return float(b @ np.linalg.solve(H + np.eye(len(b)), b))

    def excess(self, gain: float) -> float:
        """Return by how much the variance of what is left exceeds the noise (Birge ratio), 1 at the least."""
        return max((self.square - gain) / max(self.freedom, 1.0), 1.0)

    def reduced(self, count: int) -> ResidualSums:
        """Return those of the others, with the first parameters eliminated."""
        return replace(self, M=eliminated(self.M, slice(1, 1 + count)))

    def among(self, rows: Ids) -> ResidualSums:
        """Return those of some parameters, the others being zero."""
        kept = np.append(0, 1 + rows)
        return replace(self, M=self.M[np.ix_(kept, kept)])

    def of(self, size: int) -> ResidualSums:
        """Return those of the first parameters alone."""
        return replace(self, M=self.M[: 1 + size, : 1 + size].copy())

    def by(self, T: Array) -> ResidualSums:
        """Return those of P other parameters, of which these K are T (K, P) times."""
        M = np.empty((1 + T.shape[1], 1 + T.shape[1]))
        M[0, 0], M[0, 1:] = self.square, self.b @ T
        M[1:, 0], M[1:, 1:] = M[0, 1:], T.T @ self.H @ T
        return replace(self, M=M)

    def over(self, variance: float) -> ResidualSums:
        """Return these of residuals whose noise has a variance."""
        return replace(self, M=self.M / variance)

    def without(self, row: int, cov: Array) -> ResidualSums:
        """Return these where D parameters, from a row on, vary besides by a covariance (D, D): that is eliminated."""
        varied = slice(1 + row, 1 + row + len(cov))
        inner = np.eye(len(cov)) + cov @ self.M[varied, varied]
        return replace(self, M=self.M - self.M[varied].T @ np.linalg.solve(inner, cov @ self.M[varied]))


def eliminated(M: Array, rows: slice) -> Array:
    """Return sums M (N, N) with parameters eliminated, of which each has a prior of variance 1."""
    kept = np.delete(np.arange(len(M)), rows)
    across, inner = M[rows][:, kept], M[rows, rows].copy()
    inner.flat[:: len(inner) + 1] += 1.0
    return np.asarray(M[np.ix_(kept, kept)] - across.T @ np.linalg.solve(inner, across))


def largest_square(effects: Sequence[tuple[Array, Array]], by: Array) -> float:
    """Return by how much a change of the first parameters moves a pose at most, in its sigmas, squared.

    ``effects``: responses (6, K) of poses to all parameters, and their covariances (6, 6).
    """
    responses, covs = map(np.array, zip(*effects, strict=True))
    return float(squares_of(responses[..., : len(by)] @ by, covs).max())


def evidence_of_scales(M: Array, scales: Array) -> Array:
    """Return (N,) the log-evidence against none of sums M (1 + K, 1 + K) for priors of some standard deviations (N,)."""
    values, V = np.linalg.eigh(M[1:, 1:])
    variances = np.square(scales)[:, None]
    ratio = 1.0 + variances * np.maximum(values, 0.0)
    return np.asarray(0.5 * (variances * np.square(V.T @ M[1:, 0]) / ratio - np.log(ratio)).sum(axis=1))


class Onset(NamedTuple):
    """A change that grew from nothing to what it is."""

    begin_s: float  #: when it began, s
    end_s: float = np.inf  #: when it ended, s: of a step when it began, infinite of what goes on

    @property
    def goes_on(self) -> bool:
        """Whether it grows still."""
        return self.end_s == np.inf


class History:
    """The sums of the newest tests, and what older ones say.

    A change grows from nothing at the time of one test to what it is at another one, and stays; a step does at once. What
    the tests before it say of the first parameters, which do not change, counts with those after it. The test just before
    it may be of both times: it is left out. What it holds is replaced, never changed: a copy (:mod:`copy`) goes on alone.
    """

    def __init__(self, size: int, columns: int) -> None:
        self._size, self._settled = size, ResidualSums(np.zeros((1 + columns, 1 + columns)))
        self.kept, self.count = tuple[ResidualSums, ...](), 0
        self._added: tuple[Array, ...] | None = None  # up, since each test that is kept
        self._reduced = dict[Onset, ResidualSums]()

    def keep(self, newest: ResidualSums, changed_s: float, *, again: bool = False) -> None:
        """Keep a test, or the newest one ``again``; the oldest settles, unless it or the next is after a change, s."""
        self._added, self._reduced = None, {}
        if again:
            self.kept = (*self.kept[:-1], newest)
            return
        self.kept = (*self.kept, newest)
        if not self.count:
            self._settled = replace(self._settled, begin_s=newest.begin_s)
        self.count += 1
        if len(self.kept) > KEPT:
            oldest, *_ = self.kept
            self.kept = self.kept[1:]
            if self.kept[0].begin_s < changed_s:
                share = math.exp(-1.0 / _SETTLED)
                faded = replace(self._settled, M=share * self._settled.M, freedom=share * self._settled.freedom)
                self._settled = faded.plus(oldest)

    def forget(self, begins: Sequence[float]) -> None:
        """Forget tests, by when they began, s."""
        self.kept = tuple(each for each in self.kept if each.begin_s not in begins)
        self._added, self._reduced = None, {}

    def before_s(self, begin_s: float) -> float:
        """Return when the test before that of a time began, s."""
        return max((each.begin_s for each in self.kept if each.begin_s < begin_s), default=begin_s)

    @property
    def always(self) -> Onset:
        """What was so before all tests."""
        return Onset(self._settled.begin_s, self._settled.begin_s)

    def windows(self, *, every: bool) -> list[Onset]:
        """Return when a change may have begun, and ended."""
        tests = len(self.kept)
        counts = [*(count for count in _AFTER if count < tests), tests]
        due = [(count, self.kept[-count].begin_s) for count in counts if every or self.count % min(count, STEPS) == 0]
        found = [Onset(t_s, t_s) for _, t_s in due] + [Onset(t_s) for count, t_s in due if count > STEPS]
        return [*found, self.always] if due and due[-1][0] == tests and self._settled.freedom else found

    def _sums(self) -> tuple[Array, ...]:
        """Return times (N,) against the newest test, and sums since each: plain, times the time once, twice; freedom."""
        if self._added is None:
            tests, rest = len(self.kept), slice(1 + self._size, None)
            newest = self.kept[-1].M
            plain, freedom = np.empty((tests, *newest.shape)), np.empty(tests)
            once, twice = np.empty((tests, *newest[rest].shape)), np.empty((tests, *newest[rest, rest].shape))
            ages_s = np.array([each.begin_s for each in self.kept]) - self.kept[-1].begin_s
            for k in reversed(range(tests)):  # a cumulated sum of large arrays takes five times as long
                M, by_age = self.kept[k].M, ages_s[k] * self.kept[k].M[rest]
                plain[k], once[k], twice[k], freedom[k] = M, by_age, ages_s[k] * by_age[:, rest], self.kept[k].freedom
                for each in (plain, once, twice, freedom) if k < tests - 1 else ():
                    each[k] += each[k + 1]
            self._added = ages_s, plain, once, twice, freedom
        return self._added

    def since(self, onset: Onset, count: int | None = None) -> ResidualSums:
        """Return the sums since a change began; all but the first parameters are what they were when it ended."""
        size = self._size + count if count is not None else len(self._settled.b)
        if onset.end_s <= self._settled.begin_s:
            parts = [each.of(size) for each in (self._settled, *self.kept)]
            return reduce(ResidualSums.plus, parts)
        ages_s, plain, once, twice, freedom = self._sums()
        plain, once, twice = plain[:, : 1 + size, : 1 + size], once[:, :count, : 1 + size], twice[:, :count, :count]
        begin, end = np.minimum(np.searchsorted(ages_s, np.array(onset) - self.kept[-1].begin_s), len(ages_s) - 1)
        first, rest = slice(0, 1 + self._size), slice(1 + self._size, None)
        found, counted = plain[end].copy(), float(freedom[begin]) + self._settled.freedom
        found[first, first] = self._settled.M[first, first] + plain[0, first, first]
        if begin:
            mixed = self.kept[begin - 1]
            found[first, first] -= mixed.M[first, first]
            counted += float(freedom[0] - freedom[begin]) - mixed.freedom
        if end > begin:
            began_s = onset.begin_s - self.kept[-1].begin_s
            span_s, M = ages_s[end] - began_s, plain[begin, rest] - plain[end, rest]
            by = once[begin] - once[end] - began_s * M
            more = twice[begin] - twice[end] - began_s * (once[begin] - once[end] + by)[:, rest]
            found[rest, first] += by[:, first] / span_s
            found[first, rest] += by[:, first].T / span_s
            found[rest, rest] += more / span_s**2
        return ResidualSums(found, counted, onset.begin_s)

    def reduced(self, onset: Onset) -> ResidualSums:
        """Return the same of all but the first parameters, which are eliminated."""
        if onset not in self._reduced:
            self._reduced = {**self._reduced, onset: self.since(onset).reduced(self._size)}
        return self._reduced[onset]

    def dated(self, count: int, oldest_s: float | None = None) -> tuple[float, Onset]:
        """Return the least that a change of the next parameters leaves, and when that began and ended.

        The test before its beginning, which may be of both times, counts as noise.

        Args:
            count: of these parameters.
            oldest_s: when it may have begun before all tests that are kept, s; before all tests if None.
        """
        settled_s, tests, times_s = self._settled.begin_s, len(self.kept), [each.begin_s for each in self.kept]
        times_s.insert(0, settled_s if oldest_s is None or oldest_s >= times_s[0] else oldest_s)
        ages = np.geomspace(1.0, tests, _BEGINS).round().astype(int)
        coarse = sorted({0 if times_s[0] < times_s[1] else 1, *(tests + 1 - ages).tolist()})

        @cache
        def left(begin: int, end: int) -> tuple[float, int, int]:
            if begin != end and (end - begin < STEPS or times_s[begin] <= settled_s < times_s[1]):
                return np.inf, begin, end
            sums = self.since(Onset(times_s[begin], times_s[end]), count).reduced(self._size)
            return sums.square - sums.gain() + (self.kept[begin - 2].freedom if begin > 1 else 0.0), begin, end

        def best(window: Callable[[int], tuple[int, int]]) -> tuple[float, int, int]:
            row = coarse.index(min((*left(*window(k)), k) for k in coarse)[3])
            return min(
                left(*window(k)) for k in range(coarse[max(row - 1, 0)], coarse[min(row + 1, len(coarse) - 1)] + 1)
            )

        ramp = best(lambda k: (k, tests))
        ramp = min(ramp, best(lambda k: (ramp[1], k)))
        ramp = min(left(k, ramp[2]) for k in range(max(ramp[1] - 1, 0), ramp[1] + 2))
        least, begin, end = min(best(lambda k: (k, k)), ramp)
        return least, Onset(times_s[begin], np.inf if begin < end == tests else times_s[end])
