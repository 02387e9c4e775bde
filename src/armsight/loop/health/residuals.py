"""Residuals of single shots, and the sums of several: what they say of all that may be wrong, poses eliminated.

Residuals are those of a body as its file says, about the pose that was measured; of one that is far off in size, about the
pose of the triangulated points (Umeyama, 1991). Sums are of their outer products: what changed among the shots is a step
or a ramp.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Ids, PoseEstimate
from armsight.estimate.chance import chi_square_limit
from armsight.geometry.pose import inverse, pose
from armsight.loop.health.rows import LENS, differentiated, eliminate_pose
from armsight.vision.camera import pair_arguments
from armsight.vision.rig import StereoRig

#: Points of a body that are used, at most: those of a large board would cost more than they say.
MOST_POINTS = 24
#: A displacement may be so large, m: what is further off is another thing.
FURTHEST_M = 5e-3
#: Shots that differ less than this share their errors (where a point is within its pixels, how it is lit) and count as one:
#: translation over distance, and rotation, rad.
_SAME = 0.01
_SAME_COSINE = float(np.cos(_SAME))
#: A point that a pose was measured without is another thing also where its two detections disagree by more than chance
#: explains once in so many shots.
_PAIRED = chi_square_limit(1, 1e-4)
#: Fewer points than this say nothing of these numbers; shots further apart in time than this give no speed, s.
_LEAST_POINTS, _APART_S = 4, 0.5
#: Residuals are not linear in the size of a body that is off by more than this share of it.
_LINEAR = 0.005
#: The body's motion at a shot is that of so many newest ones, if these are of so short a time, s.
TRACK, _LONGEST_S = 5, 1.0
#: The velocity of measured poses is off by this share of the speed in any direction; half: rig and body are blamed for what
#: is left of late images, double: less of them is seen.
UNKNOWN_SHARE = 0.2
#: An acceleration moves the body like so many seconds of it, where times are of a second.
_BENT_S = 0.1
#: A change that goes on is looked for in more tests than this; half: steps are taken for it, double: it is found later.
STEPS = 4
#: What goes on is as large as a line through so many of the newest tests says; half: its sigma is 1.4 times as large,
#: double: what came to rest, or bends, is off by more for longer.
_NEWEST = 8
#: The newest test agrees with all together unless chance explains their difference more rarely than this.
UNLIKE = 0.01


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
    """By how much the times of exposure move the residuals of a shot.

    Attributes:
        A: (n, 6) derivative of the residuals by the pose, in standard deviations; rows u, v of the left image and of the
            right one, point by point.
        roll: (n,) the row of the image, from -1 at its top to 1.
        track: times, s, and poses T_left_body (4, 4) of the newest shots up to this one.
        own: (n, K) what is not known of these times, where the detections were moved to one, does to the residuals, by a
            sigma each; K is 0 else.
    """

    A: Array
    roll: Array
    track: tuple[tuple[float, Array], ...]
    own: Array

    def of(self, rows: NDArray[np.bool_]) -> ExposedShot:
        """Return that of some rows."""
        return self._replace(A=self.A[rows], roll=self.roll[rows], own=self.own[rows])

    def motion(self) -> tuple[Array, Array]:
        """Return velocity and acceleration (6,) of the body in its axes, 1/s and 1/s^2; zero where they are unknown.

        They are those of each second shot: what a shot has of its own and the next one not leaves them right.
        """
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
    """What a shot says, its pose eliminated, of K parameters and M coefficients of what the camera models lack.

    Attributes:
        t_s: its time.
        rows: (n, 1 + K + M) residuals and their derivatives, in standard deviations.
        response: (6, K + M) of its pose to these.
        every: as ``rows``, with points that do not fit, which may be displaced.
        response_with_all: (6, K + M) of a pose measured with these.
        exposed: by how much the times of the exposures would move each row of ``rows``, and of ``every``.
    """

    t_s: float
    rows: Array
    response: Array
    every: Array
    response_with_all: Array
    exposed: tuple[ExposedShot, ExposedShot]


class ShotReader:
    """Reads what single shots say of the parameters of a rig, a body and their times.

    Args:
        rig: the calibrated pair.
        body: the body that is measured.
        sync_s: standard deviation of the time between the two exposures of a shot, s.

    Attributes:
        points: (M,) rows of the body's points that are used.
        size: K, count of the parameters: the rig's, size and points of the body, readout and skew.
        track: times, s, and poses T_left_body (4, 4) of the newest shots.
        used_s: (M,) when a pose was measured with each point.
        noise_px: standard deviation of a coordinate of the newest shot, px.
        half_px: (2, 2) half of the sizes of the images, px.
    """

    def __init__(self, rig: StereoRig, body: Body, sync_s: float) -> None:
        held = len(body.points)
        self.points = np.linspace(0, held - 1, min(held, MOST_POINTS)).astype(int)
        self.size = rig.parameter_count + 1 + 3 * len(self.points) + 2
        self._rig, self._sync_s, self.noise_px = rig, sync_s, 0.0
        self._row_of = np.full(held, -1)
        self._row_of[self.points] = np.arange(len(self.points))
        self.track: deque[tuple[float, Array]] = deque(maxlen=TRACK)
        self.used_s = np.full(len(self.points), -np.inf)
        counts = np.array([camera.distortion.size for camera in rig.cameras])
        self._pair = (*pair_arguments(rig.cameras), counts, inverse(rig.T_left_right))
        self._p_body = np.array(body.points, float, order="C")
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
        """Return (N,) whether a point may be the body's, displaced on it: what its four residuals say of the pose (4 N, 6).

        Not one that is too far off, nor one of which the two cameras see different things.
        """
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


class ResidualSums:
    """What whitened residuals say of K parameters: sums over their rows, degrees of freedom, and when they began.

    Attributes:
        M: (1 + K, 1 + K) sum of the outer products of rows [residual; derivatives].
        freedom: degrees of freedom.
        begin_s: when the first shot was, s.
    """

    def __init__(self, size: int, begin_s: float) -> None:
        self.M, self.freedom, self.begin_s = np.zeros((1 + size, 1 + size)), 0.0, begin_s

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

    def add(self, other: ResidualSums, weight: float) -> None:
        """Add another's."""
        self.M += other.M if weight == 1.0 else weight * other.M
        self.freedom += weight * other.freedom

    def take(self, rows: Array, freedom: float) -> None:
        """Add rows (N, 1 + K)."""
        self.M += rows.T @ rows
        self.freedom += freedom

    def scale(self, weight: float) -> None:
        """Weigh down what there is."""
        self.M *= weight
        self.freedom *= weight

    def besides(self, before: ResidualSums, size: int) -> ResidualSums:
        """Return these with what sums from before say of the first parameters, the others being zero then."""
        found = ResidualSums(len(self.b), self.begin_s)
        found.M, found.freedom = self.M.copy(), self.freedom + before.freedom
        found.M[: 1 + size, : 1 + size] += before.M[: 1 + size, : 1 + size]
        return found

    def of(self, size: int) -> ResidualSums:
        """Return those of the first parameters alone."""
        found = ResidualSums(size, self.begin_s)
        found.M, found.freedom = self.M[: 1 + size, : 1 + size].copy(), self.freedom
        return found

    def by(self, T: Array) -> ResidualSums:
        """Return those of P other parameters, of which these K are T (K, P) times."""
        found = ResidualSums(T.shape[1], self.begin_s)
        found.M[0, 0], found.M[0, 1:], found.freedom = self.square, self.b @ T, self.freedom
        found.M[1:, 0], found.M[1:, 1:] = found.M[0, 1:], T.T @ self.H @ T
        return found

    def over(self, variance: float) -> ResidualSums:
        """Return these of residuals whose noise has a variance."""
        found = self.of(len(self.b))
        found.M /= variance
        return found

    def without(self, row: int, variance: float = 1.0) -> ResidualSums:
        """Return these with a parameter eliminated, which has a prior of a variance; its row is of no use."""
        rest, column = self.of(len(self.b)), self.M[1 + row]
        rest.M -= np.outer(column, column) * (variance / (1.0 + variance * column[1 + row]))
        return rest

    def less(self, other: ResidualSums) -> ResidualSums:
        """Return these sums without another's."""
        rest = ResidualSums(len(self.b), self.begin_s)
        rest.add(self, 1.0)
        rest.add(other, -1.0)
        return rest


def eliminated(M: Array, rows: slice) -> Array:
    """Return sums M (N, N) with parameters eliminated, of which each has a prior of variance 1."""
    across = np.delete(M[rows], rows, axis=1)
    kept = np.delete(np.delete(M, rows, axis=0), rows, axis=1)
    return np.asarray(kept - across.T @ np.linalg.solve(M[rows, rows] + np.eye(len(across)), across))


def total(tests: Sequence[ResidualSums]) -> ResidualSums:
    """Return the sums of tests."""
    found = tests[0].of(len(tests[0].b))
    for each in tests[1:]:
        found.add(each, 1.0)
    return found


class Since:
    """The sums of some tests since each one of them, all added up in one pass.

    Args:
        tests: in the order of time.
        size: count of the first parameters, which never grow.
    """

    def __init__(self, tests: Sequence[ResidualSums], size: int) -> None:
        self._begins_s, self._size = np.array([each.begin_s for each in tests]), size
        M = np.array([each.M for each in tests])
        ages_s = (self._begins_s - self._begins_s[-1])[:, None, None]
        by_age = ages_s * M[:, 1 + size :]
        self._M, self._once, self._twice, self._freedom = (
            np.cumsum(each[::-1], axis=0)[::-1]
            for each in (M, by_age, ages_s * by_age[:, :, 1 + size :], np.array([each.freedom for each in tests]))
        )

    def plain(self, k: int) -> ResidualSums:
        """Return the sums of the tests from one on."""
        found = ResidualSums(self._M.shape[1] - 1, float(self._begins_s[k]))
        found.M, found.freedom = self._M[k].copy(), float(self._freedom[k])
        return found

    def ramped(self, k: int) -> ResidualSums:
        """Return the same where all but the first parameters grow with time, from zero to what they are now."""
        found, rest = self.plain(k), slice(1 + self._size, None)
        span_s = float(self._begins_s[-1] - self._begins_s[k])
        if span_s > 0.0:  # else all are of now
            once, twice = self._once[k] / span_s, self._twice[k] / span_s**2
            found.M[rest] += once
            found.M[:, rest] += once.T
            found.M[rest, rest] += twice
        return found


def lined(tests: Sequence[ResidualSums], before: Array, columns: Ids) -> tuple[Array, Array]:
    """Return what the newest tests say of parameters that are on a line in time, and the covariance (2 C, 2 C).

    Args:
        tests: since these began to change, in units of the priors.
        before: (1 + K, 1 + K) what those before say of the first parameters, which are constant.
        columns: (C,) rows of the others.

    Returns:
        (2 C,) what they are at the newest test, and by how much they grew since the first of the newest; covariance.
    """
    newest = tests[-_NEWEST:]
    size, count, last_s = len(before), len(columns), newest[-1].begin_s
    span_s, kept = max(last_s - newest[0].begin_s, 1e-9), np.append(np.arange(size), 1 + columns)
    M, by = np.zeros((size + 2 * count, size + 2 * count)), np.eye(size + count, size + 2 * count)
    M[:size, :size] = before
    for each in newest:
        by[size:, size + count :] = np.eye(count) * (each.begin_s - last_s) / span_s
        M += by.T @ each.M[np.ix_(kept, kept)] @ by
    M = eliminated(M, slice(1, size))
    cov = np.asarray(np.linalg.inv(M[1:, 1:] + np.eye(2 * count)))
    return cov @ M[1:, 0], cov


def grows(line: Array, cov: Array) -> bool:
    """Return whether a line of :func:`lined` grew by more than chance, its covariance (2 C, 2 C) that of the noise."""
    count = len(line) // 2
    by = line[count:]
    return float(by @ np.linalg.solve(cov[count:, count:], by)) > chi_square_limit(count, UNLIKE)
