"""What the shots of a body say of the cameras: residuals and their derivatives by all that a calibration fixes.

In: measured poses with the detections they came from. Out: rows, in standard deviations,

    r = A dT + B y + L beta + n

with the pose dT eliminated shot by shot; y the K parameters: those of the rig, the size of the body, its points, the skew
(by how much the right camera exposes late, seen in the body's motion; each shot has one of its own besides); L polynomials
of the position in an image, M coefficients beta of what the camera models lack.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from armsight.data import Array, Body, Ids, PoseEstimate
from armsight.estimate.change import Sums
from armsight.geometry.matrix import product, solved
from armsight.geometry.pose import inverse, pose
from armsight.kernels import kernel
from armsight.vision.camera import pair_arguments
from armsight.vision.pose.posefit import differentiate
from armsight.vision.rig import StereoRig

#: Tolerance of a body that was built and measured with care: of each point, m, and of its scale.
SHAPE_M, SCALE = 5e-5, 3e-4
#: Points of a body that are used, at most: those of a large board would cost more than they say.
MOST_POINTS = 24
#: Shots that differ less than this share their errors (where a point is within its pixels, how it is lit) and count as one:
#: translation over distance, and rotation, rad.
_SAME = 0.01
_SAME_COSINE = float(np.cos(_SAME))
#: A point that a pose was measured without is another thing also where its two detections disagree by more than chance
#: explains once in so many shots; and one that is displaced by more, m.
_PAIRED, FURTHEST_M = float(chdtri(1, 1e-4)), 5e-3
#: Fewer points than this say nothing; shots further apart in time than this give no speed, s.
_LEAST_POINTS, _APART_S = 4, 0.5
#: Residuals are not linear in the size of a body that is off by more than this share of it.
_LINEAR = 0.005
#: The polynomials of the position in an image are all products of x and y up to this degree; their count.
_DEGREE = 4
_POLYNOMIALS = (_DEGREE + 1) * (_DEGREE + 2) // 2
#: Numbers of what the camera models lack: of two cameras, along u and v.
LENS = 4 * _POLYNOMIALS

#: The velocity of measured poses is off by this share of the speed in any direction; half: rig and body are blamed for what
#: is left of late images, double: less of them is seen.
UNKNOWN_SHARE = 0.2
#: The body's motion at a shot is that of so many newest ones, if these are of so short a time, s.
TRACK, _LONGEST_S = 5, 1.0
#: An acceleration moves the body like so many seconds of it, where times are of a second.
_BENT_S = 0.1


def velocity(before: Array, after: Array, seconds: float) -> Array:
    """Return the velocity (6,) in the body's axes, 1/s, that takes a pose (4, 4) to another, by a small angle."""
    R = before[:3, :3].T @ after[:3, :3]
    rotation = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    shift = after[:3, :3].T @ (after[:3, 3] - before[:3, 3])
    return np.asarray(np.concatenate([shift, rotation]) / seconds)


class ExposedShot(NamedTuple):
    """By how much the times of exposure move the residuals of a shot.

    Attributes:
        A: (n, 6) derivative of the residuals by the pose, in standard deviations; rows u, v of the left image and of the
            right one, point by point.
        roll: (n,) the row of the image, from -1 at its top to 1.
        track: times, s, and poses T_left_body (4, 4) of the newest shots up to this one.
    """

    A: Array
    roll: Array
    track: tuple[tuple[float, Array], ...]

    def of(self, rows: NDArray[np.bool_]) -> ExposedShot:
        """Return that of some rows."""
        return self._replace(A=self.A[rows], roll=self.roll[rows])

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

    def without_pose(self) -> Array:
        """Return the same (n, 10) with the pose eliminated."""
        Q, moved = np.linalg.qr(self.A)[0], self.moved()
        return np.asarray(moved - Q @ (Q.T @ moved))

    def response(self) -> Array:
        """Return what (6, 10) these do to the pose."""
        return np.asarray(np.linalg.lstsq(self.A, self.moved(), rcond=None)[0])


class ShotResiduals(NamedTuple):
    """What a shot says, its pose eliminated, of K parameters and M coefficients of what the camera models lack.

    Attributes:
        t_s: its time.
        rows: (n, 1 + K + M) residuals and their derivatives; points that do not fit, but may be displaced, included.
        response: (6, K + M) of its pose to these.
        response_with_all: the same of a pose measured with all points.
        exposed: by how much the times of the exposures would move each row.
    """

    t_s: float
    rows: Array
    response: Array
    response_with_all: Array
    exposed: ExposedShot

    @property
    def misfit(self) -> float:
        """By how much the squared residuals exceed their number."""
        return float(self.rows[:, 0] @ self.rows[:, 0]) - len(self.rows)


class ShotModel:
    """Makes residuals of measured poses.

    Args:
        rig: the calibrated pair.
        body: the body that is measured.
        sync_s: standard deviation of the time between the two exposures of a shot, s.

    Attributes:
        size: K.
        points: rows of the body's points that have parameters.
        prior: (K, K) square root of the covariance of all parameters. The skew's is zero: what is not known of it changed.
        noise_px: standard deviation of a coordinate in the newest shot, px.
        used_s: (N,) when a pose was measured with each of the points, s.
    """

    def __init__(self, rig: StereoRig, body: Body, sync_s: float) -> None:
        self.rig, self._sync_s = rig, sync_s
        self.points = np.unique(np.linspace(0, len(body.points) - 1, MOST_POINTS).astype(int))
        count = rig.parameter_count
        self.size = count + 1 + 3 * len(self.points) + 1
        self.prior = np.zeros((self.size, self.size))
        values, vectors = np.linalg.eigh(rig.cov)
        self.prior[:count, :count] = vectors * np.sqrt(np.maximum(values, 0.0))
        rest = np.arange(count, self.size - 1)
        self.prior[rest, rest] = np.append(SCALE, np.full(3 * len(self.points), SHAPE_M))
        self._row_of = np.full(len(body.points), -1)
        self._row_of[self.points] = np.arange(len(self.points))
        self.used_s, self.noise_px = np.full(len(self.points), -np.inf), 0.0
        self._last = (-np.inf, np.eye(4))
        self._track: deque[tuple[float, Array]] = deque(maxlen=TRACK)
        counts = np.array([camera.distortion.size for camera in rig.cameras])
        self._pair = (*pair_arguments(rig.cameras), counts, inverse(rig.T_left_right))
        self._p_body = np.array(body.points, float, order="C")
        self._half_px = np.array([camera.image_size_px for camera in rig.cameras]) / 2.0
        #: Half of an image, over the focal lengths (2, 2).
        self.half_views = self._half_px / np.array([camera.intrinsics[:2] for camera in rig.cameras])

    def passed(self, T: Array, now_s: float) -> None:
        """Take a pose (4, 4) whose shot is not used."""
        self._last = (now_s, T)
        self._track.append((now_s, T))

    def residuals(self, estimate: PoseEstimate, now_s: float, *, timed: bool = True) -> ShotResiduals | None:
        """Return what one shot says; None where too few of its points were measured."""
        speed = self._velocity(estimate.T_left_body, now_s) if timed else np.zeros(6)
        self.passed(estimate.T_left_body, now_s)
        seen, good = estimate.points.seen, np.zeros(len(self._p_body), bool)
        good[estimate.points.ids] = True
        rows = np.flatnonzero(seen.paired & (self._row_of >= 0)[seen.ids])
        ids = seen.ids[rows]
        fits = good[ids]
        if np.count_nonzero(fits) < _LEAST_POINTS:
            return None
        A, whole = np.empty((4 * len(ids), 6)), np.zeros((4 * len(ids), 1 + self.size + LENS))
        size, T = self.linear_about(estimate)
        uv = np.ascontiguousarray(seen.uv[rows])
        noise_px2 = _differentiate(
            *self._pair, self._half_px, size * self._p_body, self._row_of, np.asarray(ids, np.int64),
            uv, np.ascontiguousarray(seen.cov_uv[rows]),
            max(self.rig.sigma_px, 1e-6), np.array(T, order="C"), speed, A, whole,
        )  # fmt: skip
        if not np.isfinite(noise_px2):
            return None
        if size != 1.0:  # the residuals of a body as its file says, were they linear
            by_size = 1 + self.rig.parameter_count
            whole[:, by_size] /= size
            whole[:, 0] += (size - 1.0) * whole[:, by_size]
        self.noise_px = float(np.sqrt(noise_px2))
        self.used_s[self._row_of[ids[fits]]] = now_s
        exposed = ExposedShot(A, (uv[:, :, 1] / self._half_px[:, 1] - 1.0).repeat(2), tuple(self._track))
        alone = None
        if not fits.all():
            alone = _response(A[np.repeat(fits, 4)], whole[np.repeat(fits, 4)])
            kept = np.repeat(fits | _displaced(A, whole[:, 0]), 4)
            A, whole, exposed = A[kept], whole[kept], exposed.of(kept)
        response = np.empty((6, whole.shape[1]))
        _eliminate(A, whole, self.size, self._sync_s, response)
        with_all = response[:, 1:]
        return ShotResiduals(now_s, whole, with_all if alone is None else alone, with_all, exposed)

    def moved(self, shot: ShotResiduals) -> Array:
        """Return what (n, 10) the times of its exposures do to a shot's rows, pose and own skew eliminated as in these."""
        moved, u = shot.exposed.without_pose(), shot.rows[:, self.size]
        square = float(u @ u)
        if square == 0.0:
            return moved
        kept = math.sqrt(max(1.0 - self._sync_s**2 * square, 0.0))
        return np.asarray(moved - np.outer(u, (1.0 - kept) / square * (u @ moved)))

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

    def _velocity(self, T: Array, now_s: float) -> Array:
        """Return the velocity (6,) of the body between the shot before and this one, 1/s; zero where it is unknown."""
        before_s, before = self._last
        return velocity(before, T, now_s - before_s) if 0.0 < now_s - before_s < _APART_S else np.zeros(6)

    def information(self, estimates: Sequence[PoseEstimate]) -> tuple[Sums, int]:
        """Return the sums of measured poses, and how many of these differ: consecutive ones that are alike count as one."""
        stays, began = list[list[ShotResiduals]](), np.zeros((4, 4))
        for k, estimate in enumerate(estimates):
            found = self.residuals(estimate, float(k), timed=False)
            if found is None:
                continue
            if not stays or differ(began, estimate.T_left_body):
                began = estimate.T_left_body
                stays.append([])
            stays[-1].append(found)
        sums = Sums.empty(self.size + LENS)
        for stay in stays:
            summed(sums, ((each.rows, len(each.rows)) for each in stay), len(stay))
        return sums.of(self.size), len(stays)


def summed(sums: Sums, shots: Iterable[tuple[Array, int]], count: int) -> None:
    """Add the mean of a stay's shots: whitened rows, and how many numbers they are of."""
    for rows, numbers in shots:
        sums.take(rows if count == 1 else rows / np.sqrt(count), (numbers - 6.0) / count)


def _response(A: Array, rows: Array) -> Array:
    """Return the response (6, K) of a pose, of derivatives A (n, 6), to the columns of rows (n, 1 + K)."""
    return np.asarray(-np.linalg.solve(A.T @ A, A.T @ rows[:, 1:]))


def _displaced(A: Array, residuals: Array) -> NDArray[np.bool_]:
    """Return (N,) whether a point may be the body's, displaced on it: what its four residuals say of the pose (4 N, 6).

    Not one that is too far off, nor one of which the two cameras see different things.
    """
    J, r = A[:, :3].reshape(-1, 4, 3), residuals.reshape(-1, 4)
    H, b = np.einsum("nki,nkj->nij", J, J), np.einsum("nki,nk->ni", J, r)
    d = np.linalg.solve(H, b[..., None])[..., 0]
    left = np.einsum("ni,ni->n", r, r) - np.einsum("ni,ni->n", b, d)
    return np.asarray((left < _PAIRED) & (np.linalg.norm(d, axis=1) < FURTHEST_M))


def free_directions(rig: StereoRig) -> Array:
    """Return (P, 5) of a rig's parameters: translation of the right camera across the baseline (2), its rotation (3)."""
    free, begin = np.zeros((rig.parameter_count, 5)), rig.parameter_count - 6
    baseline = rig.T_left_right[:3, :3].T @ rig.T_left_right[:3, 3]
    free[begin : begin + 3, :2] = np.linalg.svd(baseline[None])[2][1:].T
    free[begin + 3 :, 2:] = np.eye(3)
    return free


def differ(T: Array, other: Array) -> bool:
    """Return whether two poses (4, 4) are so far apart that their errors count as independent."""
    by = T[:3, 3] - other[:3, 3]
    cosine = (float(np.vdot(T[:3, :3], other[:3, :3])) - 1.0) / 2.0
    return float(by @ by) > (_SAME * float(T[2, 3])) ** 2 or cosine < _SAME_COSINE


@kernel
def _polynomials(x: float, y: float, values: Array) -> None:
    """Fill values (P,) of the products of Chebyshev polynomials of a position in an image with edges at -1 and 1."""
    T = np.empty((2, _DEGREE + 1))
    T[:, 0], T[0, 1], T[1, 1] = 1.0, min(max(x, -1.0), 1.0), min(max(y, -1.0), 1.0)
    for i in range(2, _DEGREE + 1):
        for axis in range(2):
            T[axis, i] = 2.0 * T[axis, 1] * T[axis, i - 1] - T[axis, i - 2]
    n = 0
    for i in range(_DEGREE + 1):
        for k in range(_DEGREE + 1 - i):
            values[n] = T[0, i] * T[1, k]
            n += 1


@kernel(
    "b1[::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], f8[:, ::1], const f8[:, ::1], i8[::1], const i8[::1], "
    "const f8[:, :, ::1], const f8[:, :, :, ::1], f8, f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1]"
)
def _differentiate(
    fisheye: NDArray[np.bool_], k: Array, d: Array, counts: Ids, T_right_left: Array, half_px: Array, points: Array,
    row_of: Ids, ids: Ids, uv: Array, cov: Array, sigma_px: float, T: Array, velocity: Array, A: Array, rows: Array,
) -> float:  # fmt: skip
    """Fill the derivatives A (4 N, 6) by the pose, and rows (4 N, 1 + K + M), of N points in both images; they hold zeros.

    Return the mean variance of a coordinate, px^2; NaN where a point is behind a camera.
    """
    n, P = 2 * len(ids), 14 + counts[0] + counts[1]
    p, side, seen, covs = np.empty((n, 3)), np.empty(n, np.int64), np.empty((n, 2)), np.empty((n, 2, 2))
    variance = 0.0
    for i in range(n):
        side[i] = i % 2
        p[i], seen[i], covs[i] = points[ids[i // 2]], uv[i // 2, i % 2], cov[i // 2, i % 2]
        for axis in range(2):
            covs[i, axis, axis] += sigma_px * sigma_px
            variance += covs[i, axis, axis] / (2.0 * n)
    W, left, B, values = np.zeros((n, 2, 2)), np.empty((n, 2)), np.zeros((2 * n, P)), np.empty(_POLYNOMIALS)
    if not differentiate(fisheye, k, d, counts, T_right_left, p, side, seen, covs, T, W, left, A, B):
        return np.nan
    lens = rows.shape[1] - LENS
    for i in range(n):
        c, first = side[i], 2 + P + 3 * row_of[ids[i // 2]]
        _polynomials((seen[i, 0] + 0.5) / half_px[c, 0] - 1.0, (seen[i, 1] + 0.5) / half_px[c, 1] - 1.0, values)
        for axis in range(2):
            row, J = rows[2 * i + axis], A[2 * i + axis]
            row[0] = W[i, axis, 0] * left[i, 0] + W[i, axis, 1] * left[i, 1]
            row[1 : 1 + P] = B[2 * i + axis]
            for j in range(3):
                row[1 + P] += J[j] * p[i, j]
                row[first + j] = J[j]
            if c == 1:  # what the body's motion of a second does to the right image: one of a later exposure
                for j in range(6):
                    row[lens - 1] += J[j] * velocity[j]
            for along in range(2):
                begin = lens + (2 * c + along) * _POLYNOMIALS
                for j in range(_POLYNOMIALS):
                    row[begin + j] = W[i, axis, along] * values[j]
    return variance


@kernel("f8[:, ::1], f8[:, ::1], i8, f8, f8[:, ::1]")
def _eliminate(A: Array, rows: Array, skew: int, sync_s: float, response: Array) -> None:
    """Eliminate the pose, of derivatives A (n, 6), and the shot's own skew from rows (n, K); fill its response (6, K).

    The skew, of column ``skew`` and standard deviation ``sync_s``, s, is eliminated by a symmetric factor of what Sherman
    and Morrison give: (1 - g u u^T)^2 = 1 - u u^T / (1 / sync_s^2 + u^T u).
    """
    gain = solved(product(A.T, A), product(A.T, rows))
    for i in range(len(rows)):
        for j in range(6):
            for c in range(rows.shape[1]):
                rows[i, c] -= A[i, j] * gain[j, c]
    response[:, :] = -gain
    u, square = rows[:, skew].copy(), 0.0
    for i in range(len(u)):
        square += u[i] * u[i]
    share = sync_s * sync_s / (1.0 + sync_s * sync_s * square)
    along = np.zeros(rows.shape[1])
    for i in range(len(u)):
        for c in range(len(along)):
            along[c] += u[i] * rows[i, c]
    along *= share / (1.0 + np.sqrt(1.0 - share * square))
    for i in range(len(u)):
        for c in range(len(along)):
            rows[i, c] -= u[i] * along[c]
