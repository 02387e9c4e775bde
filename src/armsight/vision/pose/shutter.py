"""Two shutters: when each observation of a moving body was exposed, and how to move all of them to one time.

In: the correspondences of shots with their times. Out: by how much the right camera exposes later than the left (skew), how
long a rolling shutter takes from the first row to the last (readout), both with covariance, and poses in which every
observation was moved to the shot's time by the body's own motion.

A pixel of row v of camera c (0 left, 1 right) is exposed at t + c (apart + skew) + ((v + 1/2) / H - 1/2) readout. The
motion of the body is a cubic through the poses of up to five shots around each. The residuals of a shot depend on both
parameters through the velocity; what a wrong pose explains as well is projected out, so no more than the epipolar residual
and the shape of the body remain. Gauss-Newton over all shots with Cauchy weights. The curvature is taken less what noise
of the velocity adds to it (Fuller, "Measurement Error Models", 1987, section 1.2); the covariance grows where the scores of
the shots scatter more than their curvature predicts (Birge ratio), and where the errors of a point's detections persist:
a body moves little between two shots, so what shifts a detection shifts the next one, too. Where the skews of the shots
differ by more than chance, the skew of each is a normal random effect.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Body, Correspondences, ExposureErrors, Ids, Missed, PoseEstimate, Record
from armsight.errors import InputError
from armsight.geometry.matrix import product, solved
from armsight.geometry.pose import inverse, log_se3
from armsight.kernels import kernel
from armsight.vision.camera import distort, pair_arguments
from armsight.vision.match import gate
from armsight.vision.pose.bundle import CAUCHY_SCALE
from armsight.vision.pose.locate import locate, misfit_limit
from armsight.vision.pose.posefit import PixelObservations, fit_pose, whitened
from armsight.vision.rig import Shutters, StereoRig
from armsight.vision.triangulate import triangulate

#: Shots on each side whose poses give the motion of one, and the largest gap between two of them in median intervals.
_BESIDE, _GAP = 2, 2.5
#: Fewest moving shots, and the largest sigma that counts as found, as a share of the time between shots: without any
#: estimate, frames paired by time have one of 0.29.
_SHOTS_MIN, _SIGMA_MOST = 5, 0.05
_STEPS = 12
#: The last step of the estimate is smaller than this, s, or than this share of the estimate's sigma.
_DONE_S, _DONE_SIGMAS = 1e-7, 0.01
#: Sigma of every detection while the shutters are unknown, px: a few px of gap pass, and names of discs stay unambiguous.
LOOSE_PX = 1.0
#: Largest share of H that may be noise of the velocity.
_NOISE_MOST = 0.3


@dataclass(frozen=True, eq=False)
class TimedShot(Record):
    """What both cameras saw of a body in one shot, and when.

    Attributes:
        t_s: time of the left exposure's middle row, s.
        seen: the correspondences as detected; pairs that a wrong skew takes off their epipolar lines included.
        T_left_body: (4, 4) pose to begin with, m.
        apart_s: by how much the right stamp is later than the left, s.
    """

    t_s: float
    seen: Correspondences
    T_left_body: Array
    apart_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Motion(Record):
    """The motion of a body about the time of a shot: exp(twist t + acceleration t^2 / 2), in its own axes."""

    twist: Array  #: (6,) velocity, m/s and rad/s
    acceleration: Array  #: (6,) m/s^2 and rad/s^2
    cov: Array  #: (6, 6) covariance of the twist
    centred: bool  #: whether shots on both sides were there


def motions(t_s: Array, Ts: Array, covs: Array) -> list[Motion | None]:
    """Fit the motion about each of N poses to those around it; None where there are fewer than three.

    ``t_s``: (N,) rising times, s; ``Ts``: (N, 4, 4) T_left_body; ``covs``: (N, 6, 6) covariance of each, perturbation on
    the right.
    """
    found: list[Motion | None] = [None] * len(t_s)
    widest = _GAP * float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
    alike: dict[tuple[int, int, bool], list[int]] = {}  # where in a window of how many shots, and on both sides
    for k in range(len(t_s)):
        first = last = k
        while first > max(k - _BESIDE, 0) and t_s[first] - t_s[first - 1] <= widest:
            first -= 1
        while last < min(k + _BESIDE, len(t_s) - 1) and t_s[last + 1] - t_s[last] <= widest:
            last += 1
        if last - first >= 2:
            alike.setdefault((k - first, last - first + 1, first < k < last), []).append(k)
    for (before, count, centred), some in alike.items():
        rows = np.array(some)[:, None] - before + np.arange(count)
        xi, tau = log_se3(inverse(Ts[some])[:, None] @ Ts[rows]), t_s[rows] - t_s[some][:, None]
        X = tau[..., None] ** np.arange(min(count - 1, 3 if centred else 2) + 1)
        fit = np.linalg.pinv(X)
        twists, accelerations = (fit @ xi)[:, 1], 2 * (fit @ xi)[:, 2]
        twist_covs = np.einsum("gn,gnij->gij", fit[:, 1] ** 2, covs[rows])
        for k, twist, acceleration, cov in zip(some, twists, accelerations, twist_covs, strict=True):
            found[k] = Motion(twist, acceleration, cov, centred)
    return found


def estimate_shutters(
    rig: StereoRig,
    body: Body,
    shots: Sequence[TimedShot],
    *,
    known: Shutters | None = None,
    readout: bool = False,
    sigma_most: float = _SIGMA_MOST,
    calibrated: bool = True,
) -> Shutters | Missed:
    """Estimate the skew of two cameras, and the readout time of their rolling shutters, from a moving body.

    ``shots``: in the order of their time; InputError where their times do not rise. ``known``: the readout that is given,
    and where to begin; nothing by default. ``readout``: estimate the readout too. ``sigma_most``: largest sigma that counts
    as found, as a share of the median time between shots. ``calibrated``: whether the rig is; residuals of one that is not
    yet are its own errors, not those of the detections, and what persists of them is in no sigma. Returns both with
    covariance, or why they cannot be found: too few shots that move, or too slow.
    """
    start = known or Shutters(0.0, 0.0, np.zeros((2, 2)))
    t_s = _times(shots)
    count = 2 if readout else 1
    theta, Ts = np.array([start.skew_s, start.readout_s], dtype=float), np.array([s.T_left_body for s in shots])
    observed = [PixelObservations.of(shot.seen, rig.sigma_px) for shot in shots]
    Ts, covs = _poses(rig, body, observed, Ts, [None] * len(shots))
    scale2, apart, jitter2 = 1.0, np.array([shot.apart_s for shot in shots]), 0.0
    stamped = apart.copy()
    for _ in range(_STEPS):
        moving = motions(t_s, Ts, covs)
        exposed = [_exposed(rig, o, a, theta) for o, a in zip(observed, apart, strict=True)]
        centred = {k: motion for k, motion in enumerate(moving) if motion is not None and motion.centred}
        rows = list(centred)
        if len(rows) < _SHOTS_MIN:
            return Missed(f"{len(rows)} shots have neighbours on both sides, {_SHOTS_MIN} are needed")
        terms = [_linear(rig, body, observed[k], Ts[k], centred[k], exposed[k], count, scale2) for k in rows]
        firsts, seconds, noises, distances = zip(*terms, strict=True)
        curvatures = np.array(seconds)
        scores = np.array(firsts) + curvatures[:, :, 0] * (apart - stamped)[rows][:, None]
        jitter2 = _jitter2(scores, curvatures)
        shares = jitter2 / (1.0 + jitter2 * curvatures[:, 0, 0])
        marginal = scores - (shares * scores[:, 0])[:, None] * curvatures[:, :, 0]
        H = curvatures.sum(axis=0) - np.einsum("n,ni,nj->ij", shares, curvatures[:, 0], curvatures[:, 0])
        noise = np.einsum("n,nij->ij", 1 - shares * curvatures[:, 0, 0], np.array(noises))
        d2 = np.concatenate(distances)
        scale2 = max(float(np.median(d2)) / (2 * math.log(2)) * 2 * len(d2) / (2 * len(d2) - 6 * len(scores)), 1e-6)
        if np.linalg.eigvalsh(H - noise / _NOISE_MOST)[0] <= 0:
            return Missed("the body does not move, or too slowly: when each camera exposes is not observable")
        step = np.linalg.solve(H - noise, marginal.sum(axis=0))
        theta[:count] += step
        apart[rows] = stamped[rows] + shares * (scores[:, 0] - curvatures[:, 0] @ step)
        if abs(theta).max() > 1.0:
            return Missed("the shots do not agree with one skew: are times and order of the shots right?")
        moved_uv = [
            _at_one_time(rig, body, o, T, motion, _exposed(rig, o, a, theta)[0])
            for o, T, motion, a in zip(observed, Ts, moving, apart, strict=True)
        ]
        Ts, covs = _poses(rig, body, moved_uv, Ts, moving)
        sigmas = np.sqrt(np.diag(np.linalg.inv(H - noise)))
        if (np.abs(step) < np.maximum(_DONE_S, _DONE_SIGMAS * sigmas)).all():
            break
    inverted, scatter = np.linalg.inv(H - noise), _birge(marginal - step @ H / len(marginal), H) * H
    if calibrated:
        scored = [
            _scored(
                rig, body, observed[k], Ts[k], centred[k], _exposed(rig, observed[k], apart[k], theta), share, scale2
            )
            for k, share in zip(rows, shares, strict=True)
        ]
        scatter += _persistent(scored, count, len(body.points))
    cov = np.zeros((2, 2))
    cov[:count, :count] = inverted @ scatter @ inverted
    if (
        slow := _too_slow(theta[:count], np.sqrt(np.diag(cov)), sigma_most * float(np.median(np.diff(t_s))))
    ) is not None:
        return slow
    # Of global shutters the noise makes half of the readouts negative; no camera's is.
    return Shutters(float(theta[0]), max(float(theta[1]), 0.0), cov, math.sqrt(jitter2))


def _too_slow(theta: Array, sigma: Array, most_s: float) -> Missed | None:
    """Return why skew and readout are not found; None where both sigmas are at most ``most_s``."""
    for name, value, s in zip(("skew", "readout"), theta, sigma, strict=False):
        if s > most_s:
            return Missed(
                f"the motion is too slow or too short to find the {name}: {1e3 * value:.2f} ± {1e3 * s:.2f} ms; move "
                "the body faster, or longer"
            )
    return None


def _jitter2(scores: Array, curvatures: Array) -> float:
    """Return the variance of the skew between shots, s^2, from scores (S, P) and curvatures (S, P, P); 0 within chance.

    By moments (DerSimonian and Laird, "Meta-analysis in clinical trials", 1986).
    """
    w = np.maximum(curvatures[:, 0, 0], 1e-12)
    skews = scores[:, 0] / w
    Q, freedom = float(w @ (skews - w @ skews / w.sum()) ** 2), len(w) - 1
    return (Q - freedom) / float(w.sum() - w @ w / w.sum()) if misfit_limit(freedom) < Q else 0.0


def _times(shots: Sequence[TimedShot]) -> Array:
    """Return the times (S,) of shots, s, which must rise."""
    t_s = np.array([shot.t_s for shot in shots])
    if (np.diff(t_s) <= 0).any():
        k = int(np.argmax(np.diff(t_s) <= 0))
        raise InputError(f"the times of the shots must rise; {t_s[k + 1]:g} s comes after {t_s[k]:g} s")
    return t_s


def _birge(scores: Array, H: Array) -> float:
    """Return how many times the scatter of the shots' scores (S, P) exceeds what their curvature H predicts, 1 at least."""
    count, size = scores.shape
    ratio = np.einsum("si,ij,sj", scores, np.linalg.inv(H), scores) / size * count / (count - size)
    return max(1.0, float(ratio))


@dataclass(frozen=True, eq=False)
class _Scored(Record):
    """What the N observations of one shot add to the score."""

    row: Ids  #: (N,) 2 point + camera
    residual: Array  #: (N, 2) whitened residuals, weighted
    #: (N, 2, 2) whitened derivatives by skew and readout, less what a wrong pose and the shot's own skew explain
    by: Array
    weight: Array  #: (N,) of robust loss, 1 for a residual of zero


def _scored(
    rig: StereoRig,
    body: Body,
    o: PixelObservations,
    T: Array,
    motion: Motion,
    exposed: tuple[Array, Array],
    share: float,
    scale2: float,
) -> _Scored | None:
    """Return what each observation of a shot adds to the score; None where they fit no pose."""
    dt, by = exposed
    moved = _at_one_time(rig, body, o, T, motion, dt)
    fit = fit_pose(rig.cameras, rig.T_left_right, body.points, moved, T, robust=True)
    if fit is None:
        return None
    W, A, _ = whitened(rig.cameras, rig.T_left_right, body.points, o, fit.T_left_body)
    weight = 1.0 / (1.0 + fit.distance2 / (CAUCHY_SCALE**2 * scale2))
    rates = motion.twist + np.outer(dt, motion.acceleration)
    M = (np.einsum("nij,nj->ni", A.reshape(len(dt), 2, 6), rates)[..., None] * by[:, None]).reshape(-1, 2)
    weighted = np.repeat(weight / scale2, 2)[:, None]
    M -= A @ np.linalg.solve(A.T @ (weighted * A), A.T @ (weighted * M))
    M -= share * np.outer(M[:, 0], (weighted * M).T @ M[:, 0])
    residual = (weight / scale2)[:, None] * np.einsum("nij,nj->ni", W, fit.residuals_px)
    return _Scored(2 * o.point + o.camera, residual, M.reshape(-1, 2, 2), weight)


def _persistent(every: Sequence[_Scored | None], count: int, points: int) -> Array:
    """Return the (P, P) covariance that errors of detections which persist from shot to shot add to that of the score.

    Of each lag between shots the covariance of a point's residuals, in the same camera and in the other, is estimated from
    all points together: the errors of a body's points are in both. That of the other camera in the same shot is taken from
    the next one, where a pose that follows the noise has no part in it. The sandwich of an M-estimator has the mean weight
    over that of its square (Huber, "Robust Statistics", 1981, section 6.3, for Cauchy's loss in two dimensions).
    """
    scored = [each for each in every if each is not None]
    shots = len(scored)
    by, residual = np.zeros((shots, 2 * points, 2, count)), np.zeros((shots, 2 * points, 2, 1))
    seen, weights = np.zeros((shots, 2 * points, 1, 1)), np.concatenate([each.weight for each in scored])
    for k, each in enumerate(scored):
        by[k, each.row], residual[k, each.row] = each.by[..., :count], each.residual[..., None]
        seen[k, each.row] = 1.0
    freedom = 2 * len(weights) / (2 * len(weights) - 6 * shots) * (weights.sum() / (weights**2).sum()) ** 2
    added = np.zeros((count, count))
    for other in (False, True):
        partner = np.arange(2 * points) ^ int(other)
        pairs = 2 * _lagged(seen, seen[:, partner])[:, 0, 0]
        covs = freedom * _lagged(residual, residual[:, partner])[:, 0, 0] / np.maximum(pairs, 1.0)
        products = _lagged(by, by[:, partner])
        later = np.einsum("l,lpq->pq", covs[1:], products[1:])
        added += later + later.T
        if other:
            added += covs[1] * products[0]
    values, axes = np.linalg.eigh(added)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)


def _lagged(a: Array, b: Array) -> Array:
    """Return the sums of a[k] b[k + l] (S, P, Q) for each lag l from zero on, of (S, N, 2, P) and (S, N, 2, Q)."""
    length = 2 * len(a)
    A, B = (np.fft.rfft(x.reshape(len(x), -1, x.shape[-1]), length, axis=0) for x in (a, b))
    return np.asarray(np.fft.irfft(np.swapaxes(A.conj(), 1, 2) @ B, length, axis=0)[: len(a)])


def _exposed(rig: StereoRig, o: PixelObservations, apart_s: float, theta: Array) -> tuple[Array, Array]:
    """Return when N observations were exposed, after the shot's time (N,), s, and its derivative (N, 2) by theta."""
    heights = np.array([camera.image_size_px[1] for camera in rig.cameras])[o.camera]
    by = np.column_stack([o.camera.astype(float), (o.uv[:, 1] + 0.5) / heights - 0.5])
    return by @ theta + o.camera * apart_s, by


def _at_one_time(
    rig: StereoRig, body: Body, o: PixelObservations, T: Array, motion: Motion | None, dt_s: Array
) -> PixelObservations:
    """Move N observations that were exposed dt_s (N,) after the shot's time to that time."""
    if motion is None:
        return o
    uv = np.array(o.uv)
    arguments = (*_known(rig, body, o, T, motion), dt_s, uv)
    _shift(*arguments)
    return replace(o, uv=uv)


def _known(rig: StereoRig, body: Body, o: PixelObservations, T: Array, motion: Motion) -> tuple[Any, ...]:
    """Return what the kernels take: two cameras, T_right_left, points, their cameras; pose, twist, acceleration."""
    p = np.ascontiguousarray(body.points[o.point])
    pair = (*pair_arguments(rig.cameras), inverse(rig.T_left_right))
    return (*pair, p, o.camera, np.ascontiguousarray(T), motion.twist, motion.acceleration)


@kernel
def _pixel(fisheye: bool, k: Array, d: Array, M: Array, p: Array, uv: Array, J: Array) -> bool:
    """Fill the pixel uv (2,) of a body's point p (3,) in the camera with T_camera_body M (4, 4); return whether it is seen.

    J (2, 6) becomes its derivative by the tangent of the pose, on the right.
    """
    q, xy, J_p, J_d = np.empty(3), np.empty(2), np.empty((2, 3)), np.empty((2, 8))
    for i in range(3):
        q[i] = M[i, 0] * p[0] + M[i, 1] * p[1] + M[i, 2] * p[2] + M[i, 3]
    if q[2] <= 0.0 and not fisheye:
        return False
    distort(fisheye, d, q, xy, J_p, J_d)
    for i in range(2):
        uv[i] = k[i] * xy[i] + k[2 + i]
        for j in range(3):
            J[i, j] = k[i] * (J_p[i, 0] * M[0, j] + J_p[i, 1] * M[1, j] + J_p[i, 2] * M[2, j])
        J[i, 3] = J[i, 2] * p[1] - J[i, 1] * p[2]
        J[i, 4] = J[i, 0] * p[2] - J[i, 2] * p[0]
        J[i, 5] = J[i, 1] * p[0] - J[i, 0] * p[1]
    return True


@kernel
def _both(T_right_left: Array, T: Array) -> Array:
    """Return (2, 4, 4) T_camera_body of both cameras."""
    Ts = np.empty((2, 4, 4))
    Ts[0], Ts[1] = T, product(T_right_left, T)
    return Ts


@kernel
def _carried(xi: Array, p: Array, out: Array) -> None:
    """Fill a point p (3,) moved by exp of a tangent (6,), [translation; rotation]."""
    a, b, c = xi[3], xi[4], xi[5]
    u = a * a + b * b + c * c
    angle = math.sqrt(u)
    s, g, h = 1.0 - u / 6, 0.5 - u / 24, 1 / 6 - u / 120
    if u > 1e-8:
        s, g, h = math.sin(angle) / angle, (1.0 - math.cos(angle)) / u, (angle - math.sin(angle)) / (u * angle)
    kx, ky, kz = b * p[2] - c * p[1], c * p[0] - a * p[2], a * p[1] - b * p[0]
    mx, my, mz = b * xi[2] - c * xi[1], c * xi[0] - a * xi[2], a * xi[1] - b * xi[0]
    out[0] = p[0] + s * kx + g * (b * kz - c * ky) + xi[0] + g * mx + h * (b * mz - c * my)
    out[1] = p[1] + s * ky + g * (c * kx - a * kz) + xi[1] + g * my + h * (c * mx - a * mz)
    out[2] = p[2] + s * kz + g * (a * ky - b * kx) + xi[2] + g * mz + h * (a * my - b * mx)


_KNOWN = (
    "const b1[::1], const f8[:, ::1], const f8[:, ::1], f8[:, ::1], const f8[:, ::1], const i8[::1], "
    "const f8[:, ::1], const f8[::1], const f8[::1]"
)


@kernel(f"{_KNOWN}, const f8[::1], f8[:, ::1]")
def _shift(
    fisheye: NDArray[np.bool_], k: Array, d: Array, T_right_left: Array, p: Array, camera: Ids, T: Array, twist: Array,
    acceleration: Array, dt: Array, uv: Array,
) -> None:  # fmt: skip
    """Move pixels uv (N, 2) of points p (N, 3), exposed dt (N,) after the time of pose T, to that time; NaN out of view."""
    Ts, xi, then = _both(T_right_left, T), np.empty(6), np.empty(3)
    uv_now, uv_then, J = np.empty(2), np.empty(2), np.empty((2, 6))
    for n in range(len(p)):
        c = camera[n]
        for i in range(6):
            xi[i] = twist[i] * dt[n] + 0.5 * acceleration[i] * dt[n] * dt[n]
        _carried(xi, p[n], then)
        seen = _pixel(fisheye[c], k[c], d[c], Ts[c], p[n], uv_now, J)
        if not (_pixel(fisheye[c], k[c], d[c], Ts[c], then, uv_then, J) and seen):
            uv[n, 0] = uv[n, 1] = np.nan
            continue
        uv[n, 0] -= uv_then[0] - uv_now[0]
        uv[n, 1] -= uv_then[1] - uv_now[1]


def _poses(
    rig: StereoRig, body: Body, observed: Sequence[PixelObservations], Ts: Array, moving: Sequence[Motion | None]
) -> tuple[Array, Array]:
    """Fit every shot's pose (S, 4, 4), with its covariance (S, 6, 6), which holds the misfit."""
    fitted, covs = np.array(Ts), np.empty((len(Ts), 6, 6))
    for k, o in enumerate(observed):
        fit = fit_pose(rig.cameras, rig.T_left_right, body.points, o, Ts[k], robust=True)
        if fit is None:
            covs[k] = np.eye(6)
            continue
        fitted[k] = fit.T_left_body
        covs[k] = np.linalg.inv(fit.information) * max(1.0, float(np.median(fit.distance2)) / (2 * math.log(2)))
    return fitted, covs


def _linear(
    rig: StereoRig,
    body: Body,
    o: PixelObservations,
    T: Array,
    motion: Motion,
    exposed: tuple[Array, Array],
    count: int,
    scale2: float,
) -> tuple[Array, Array, Array, Array]:
    """Return one shot's score (P,), curvature (P, P), what noise adds to it (P, P), and squared distances (N,)."""
    dt, by = exposed
    uv = np.array(_at_one_time(rig, body, o, T, motion, dt).uv)
    score, curvature, noise, d2 = np.zeros(count), np.zeros((count, count)), np.zeros((count, count)), np.empty(len(dt))
    weighting = o.cov_uv, motion.cov, CAUCHY_SCALE**2 * scale2, scale2
    arguments = (
        *_known(rig, body, o, T, motion),
        dt,
        by[:, :count].copy(),
        uv,
        *weighting,
        score,
        curvature,
        noise,
        d2,
    )
    if not _score(*arguments):
        return np.zeros(count), np.zeros((count, count)), np.zeros((count, count)), np.zeros(0)
    return score, curvature, noise, d2


@kernel(
    f"{_KNOWN}, const f8[::1], f8[:, ::1], f8[:, ::1], const f8[:, :, ::1], const f8[:, ::1], f8, f8, f8[::1], "
    "f8[:, ::1], f8[:, ::1], f8[::1]"
)
def _score(
    fisheye: NDArray[np.bool_], k: Array, d: Array, T_right_left: Array, p: Array, camera: Ids, T: Array, twist: Array,
    acceleration: Array, dt: Array, by: Array, uv: Array, cov: Array, cov_twist: Array, cauchy2: float, scale2: float,
    score: Array, curvature: Array, noise: Array, d2: Array,
) -> bool:  # fmt: skip
    """Fill what :func:`_linear` returns from pixels uv (N, 2) that were moved to the time of pose T; False if it is none.

    With A the derivatives by the pose and M those by the P parameters, whitened and weighted, what A explains is taken off
    by the normal equations: M'M - M'A (A'A)^-1 A'M.
    """
    P = by.shape[1]
    Ts, uv_now, J, rate = _both(T_right_left, T), np.empty(2), np.empty((2, 6)), np.empty(6)
    S = np.zeros((1 + P + P * P, 6, 6))  # sums of A'A: plain, times each column of by, times each two
    right = np.zeros((6, 1 + P))  # A'r, A'M
    for n in range(len(p)):
        c = camera[n]
        if not _pixel(fisheye[c], k[c], d[c], Ts[c], p[n], uv_now, J):
            return False
        first = math.sqrt(cov[n, 0, 0])  # the Cholesky factor of the covariance, inverted
        across = cov[n, 1, 0] / first
        second = math.sqrt(cov[n, 1, 1] - across * across)
        for i in range(6):
            rate[i] = twist[i] + dt[n] * acceleration[i]
            J[1, i] = (J[1, i] - across * (J[0, i] / first)) / second
            J[0, i] /= first
        r0 = (uv[n, 0] - uv_now[0]) / first
        r1 = (uv[n, 1] - uv_now[1] - across * r0) / second
        d2[n] = r0 * r0 + r1 * r1
        weight = 1.0 / (1.0 + d2[n] / cauchy2) / scale2
        m0 = m1 = 0.0
        for i in range(6):
            m0 += J[0, i] * rate[i]
            m1 += J[1, i] * rate[i]
        for i in range(6):
            right[i, 0] += weight * (J[0, i] * r0 + J[1, i] * r1)
            for a in range(P):
                right[i, 1 + a] += weight * by[n, a] * (J[0, i] * m0 + J[1, i] * m1)
            for j in range(6):
                entry = weight * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
                S[0, i, j] += entry
                for a in range(P):
                    S[1 + a, i, j] += entry * by[n, a]
                    for b in range(P):
                        S[1 + P + P * a + b, i, j] += entry * by[n, a] * by[n, b]
        for a in range(P):
            score[a] += weight * by[n, a] * (m0 * r0 + m1 * r1)
            for b in range(P):
                curvature[a, b] += weight * by[n, a] * by[n, b] * (m0 * m0 + m1 * m1)
    explained = solved(S[0], right)
    for a in range(P):
        for i in range(6):
            score[a] -= right[i, 1 + a] * explained[i, 0]
            for b in range(P):
                curvature[a, b] -= right[i, 1 + a] * explained[i, 1 + b]
    for b in range(P):
        back = solved(S[0], S[1 + b])
        for a in range(P):
            for i in range(6):
                for j in range(6):
                    entry = S[1 + P + P * a + b, i, j]
                    for m in range(6):
                        entry -= S[1 + a, i, m] * back[m, j]
                    noise[a, b] += entry * cov_twist[j, i]
    return not math.isnan(score[0])


@dataclass(frozen=True, eq=False)
class Alignment(Record):
    """How the observations of one shot come to its time."""

    T_left_body: Array  #: (4, 4) pose at the shot's time
    motion: Motion | None  #: of the body; None where too few neighbours show it
    apart_s: float  #: by how much the right exposure is later than the left, beyond the mean skew, s
    variance: float  #: what is not known of it, s^2


def aligned(rig: StereoRig, body: Body, shots: Sequence[TimedShot], shutters: Shutters) -> list[Alignment]:
    """Find pose, motion and, where the skew varies, the skew of every shot; InputError where the times do not rise."""
    t_s, theta, jitter2 = _times(shots), np.array([shutters.skew_s, shutters.readout_s]), shutters.jitter_s**2
    observed = [PixelObservations.of(shot.seen, rig.sigma_px) for shot in shots]
    Ts, covs = _poses(rig, body, observed, np.array([shot.T_left_body for shot in shots]), [None] * len(shots))
    moving = motions(t_s, Ts, covs)
    stamped = np.array([shot.apart_s for shot in shots])
    apart, variances = stamped.copy(), np.full(len(shots), jitter2)
    for _ in range(2 if jitter2 == 0 else _STEPS):
        for k, motion in enumerate(moving):
            if motion is None or jitter2 == 0:
                continue
            last = (stamped[k], apart[k])
            apart[k], variances[k] = _own_skew(rig, body, observed[k], Ts[k], motion, last, theta, jitter2)
        moved = [
            _at_one_time(rig, body, o, T, motion, _exposed(rig, o, a, theta)[0])
            for o, T, motion, a in zip(observed, Ts, moving, apart, strict=True)
        ]
        Ts, covs = _poses(rig, body, moved, Ts, moving)
        moving = motions(t_s, Ts, covs)
    return [Alignment(*each) for each in zip(Ts, moving, apart, variances, strict=True)]


def at_one_time(
    rig: StereoRig, body: Body, seen: Correspondences, alignment: Alignment, shutters: Shutters
) -> Correspondences:
    """Return a shot's correspondences moved to its time; unchanged where the motion is unknown."""
    o = PixelObservations.of(seen, rig.sigma_px)
    dt, _ = _exposed(rig, o, alignment.apart_s, np.array([shutters.skew_s, shutters.readout_s]))
    uv = np.array(seen.uv)
    uv[seen.seen] = _at_one_time(rig, body, o, alignment.T_left_body, alignment.motion, dt).uv
    return replace(seen, uv=uv)


def measure_moving(
    rig: StereoRig, body: Body, shots: Sequence[TimedShot], shutters: Shutters
) -> list[tuple[PoseEstimate | Missed, bool]]:
    """Measure a moving body with every observation moved to its shot's time.

    ``shots``: in the order of their time; ``shutters``: when the cameras expose. Returns of each shot the pose at its own
    time, or why there is none, and whether its observations were moved: not where too few neighbours show the motion. The
    covariance holds that of the shutters, common to all shots, and of the motion. Raises InputError: the times do not rise.
    """
    return [
        (_measured(rig, body, shot.seen, alignment, shutters), alignment.motion is not None)
        for shot, alignment in zip(shots, aligned(rig, body, shots, shutters), strict=True)
    ]


def measure_with_motion(
    rig: StereoRig, body: Body, shot: TimedShot, motion: Motion, shutters: Shutters
) -> PoseEstimate | Missed:
    """Measure one shot of a body whose motion is known otherwise, such as from an arm's joints, at the shot's time.

    The covariance of shutters and motion is in that of the pose.
    """
    observed = PixelObservations.of(shot.seen, rig.sigma_px)
    jitter2 = shutters.jitter_s**2
    T, apart, variance = shot.T_left_body, shot.apart_s, jitter2
    theta = np.array([shutters.skew_s, shutters.readout_s])
    for _ in range(2):
        if jitter2 > 0:
            apart, variance = _own_skew(rig, body, observed, T, motion, (shot.apart_s, apart), theta, jitter2)
        now = _at_one_time(rig, body, observed, T, motion, _exposed(rig, observed, apart, theta)[0])
        fit = fit_pose(rig.cameras, rig.T_left_right, body.points, now, T, robust=True)
        if fit is None:
            return Missed("its detections do not fit the body at one time")
        T = fit.T_left_body
    return _measured(rig, body, shot.seen, Alignment(T, motion, apart, variance), shutters)


def _own_skew(
    rig: StereoRig,
    body: Body,
    o: PixelObservations,
    T: Array,
    motion: Motion,
    apart_s: tuple[float, float],
    theta: Array,
    jitter2: float,
) -> tuple[float, float]:
    """Return a shot's own skew beyond the mean, s, and its variance, s^2; ``apart_s`` is the stamped one and the last."""
    stamped, last = apart_s
    score, H, _, _ = _linear(rig, body, o, T, motion, _exposed(rig, o, last, theta), 1, 1.0)
    variance = jitter2 / (1.0 + jitter2 * H[0, 0])
    return stamped + variance * (score[0] + H[0, 0] * (last - stamped)), variance


def _measured(
    rig: StereoRig, body: Body, seen: Correspondences, alignment: Alignment, shutters: Shutters
) -> PoseEstimate | Missed:
    """Locate a body by correspondences that are moved to the shot's time; the covariance holds that of the timing."""
    moved = at_one_time(rig, body, seen, alignment, shutters)
    result = locate(rig, body, triangulate(rig, body, gate(rig, body, moved)))
    if isinstance(result, PoseEstimate) and alignment.motion is not None:
        result = _with_timing(rig, body, seen, result, alignment, shutters)
    return result


def _with_timing(
    rig: StereoRig, body: Body, seen: Correspondences, result: PoseEstimate, alignment: Alignment, shutters: Shutters
) -> PoseEstimate:
    """Return a pose with what is not known of the exposures and of the motion in its covariance."""
    assert alignment.motion is not None
    o, motion = PixelObservations.of(seen, rig.sigma_px), alignment.motion
    dt, by = _exposed(rig, o, alignment.apart_s, np.array([shutters.skew_s, shutters.readout_s]))
    _, A, _ = whitened(rig.cameras, rig.T_left_right, body.points, o, result.T_left_body)
    gain, rates = np.linalg.pinv(A), A.reshape(len(dt), 2, 6)
    late, cov = by[:, None, :] * motion.twist[:, None], np.array(shutters.cov)
    if shutters.jitter_s > 0:  # each shot's own skew is estimated, the mean is only its prior
        cov[0, :] = cov[:, 0] = 0.0
    values, axes = np.linalg.eigh(motion.cov)
    own = np.zeros((*seen.seen.shape, 6, 7))
    own[seen.seen, :, 0] = math.sqrt(alignment.variance) * late[:, :, 0]
    own[seen.seen, :, 1:] = dt[:, None, None] * (axes * np.sqrt(np.maximum(values, 0.0)))
    by_own, by_shared = (gain @ (rates @ each).reshape(len(A), -1) for each in (own[seen.seen], late))
    extra = by_own @ by_own.T + by_shared @ cov @ by_shared.T
    exposures = ExposureErrors(own[np.isin(seen.ids, result.points.seen.ids)], cov)
    return replace(result, cov=result.cov + extra, cov_noise=result.cov_noise + extra, exposures=exposures)
