"""Two shutters: when each observation of a moving body was exposed, and how to move all of them to one time.

In: the correspondences of shots with their times. Out: by how much the right camera exposes later than the left (skew), how
long a rolling shutter takes from the first row to the last (readout), both with covariance, and poses in which every
observation was moved to the shot's time by the body's own motion.

A pixel of row v of camera c (0 left, 1 right) is exposed at t + c (apart + skew) + ((v + 1/2) / H - 1/2) readout. The
motion of the body is a cubic through the poses of up to five shots around each. The residuals of a shot depend on both
parameters through the velocity; what a wrong pose explains as well is projected out, so no more than the epipolar residual
and the shape of the body remain. Gauss-Newton over all shots with Cauchy weights. The curvature is taken less what noise
of the velocity adds to it (Fuller, "Measurement Error Models", 1987, section 1.2); the covariance grows where the scores of
the shots scatter more than their curvature predicts (Birge ratio). Where the skews of the shots differ by more than chance,
the skew of each is a normal random effect.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armsight.data import Array, Body, Correspondences, Missed, PoseEstimate, Record
from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3, transform
from armsight.vision.bundle import CAUCHY_SCALE
from armsight.vision.locate import locate, misfit_limit
from armsight.vision.match import gate
from armsight.vision.posefit import PixelObservations, fit_pose, whitened
from armsight.vision.rig import Shutters, StereoRig
from armsight.vision.triangulate import triangulate

#: Shots on each side whose poses give the motion of one, and the largest gap between two of them in median intervals.
_BESIDE, _GAP = 2, 2.5
#: Fewest moving shots, and the largest sigma that counts as found, as a share of the time between shots: without any
#: estimate, frames paired by time have one of 0.29.
_SHOTS_MIN, _SIGMA_MOST = 5, 0.05
_STEPS, _DONE_S = 12, 1e-7
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
    """The motion of a body about the time of a shot: exp(twist t + acceleration t^2 / 2), in its own axes.

    Attributes:
        twist: (6,) velocity, m/s and rad/s.
        acceleration: (6,) m/s^2 and rad/s^2.
        cov: (6, 6) covariance of the twist.
        centred: whether shots on both sides were there.
    """

    twist: Array
    acceleration: Array
    cov: Array
    centred: bool

    def moved(self, T: Array, dt_s: Array) -> Array:
        """Return the poses (N, 4, 4) at N times after that of pose T (4, 4), s."""
        dt = dt_s[:, None]
        return np.asarray(T @ exp_se3(self.twist * dt + self.acceleration * dt**2 / 2))


def motions(t_s: Array, Ts: Array, covs: Array) -> list[Motion | None]:
    """Fit the motion about each of N poses to those around it; None where there are fewer than three.

    Args:
        t_s: (N,) rising times, s.
        Ts: (N, 4, 4) T_left_body.
        covs: (N, 6, 6) covariance of each, perturbation on the right.
    """
    found: list[Motion | None] = []
    widest = _GAP * float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
    for k in range(len(t_s)):
        first = last = k
        while first > max(k - _BESIDE, 0) and t_s[first] - t_s[first - 1] <= widest:
            first -= 1
        while last < min(k + _BESIDE, len(t_s) - 1) and t_s[last + 1] - t_s[last] <= widest:
            last += 1
        if last - first < 2:
            found.append(None)
            continue
        rows, centred = np.arange(first, last + 1), first < k < last
        xi, tau = log_se3(inverse(Ts[k]) @ Ts[rows]), t_s[rows] - t_s[k]
        degree = min(len(rows) - 1, 3 if centred else 2)
        X = tau[:, None] ** np.arange(degree + 1)
        fit = np.linalg.pinv(X)
        cov = np.einsum("n,nij->ij", fit[1] ** 2, covs[rows])
        found.append(Motion(fit[1] @ xi, 2 * fit[2] @ xi, cov, centred))
    return found


def estimate_shutters(
    rig: StereoRig, body: Body, shots: Sequence[TimedShot], *, known: Shutters | None = None, readout: bool = False
) -> Shutters | Missed:
    """Estimate the skew of two cameras, and the readout time of their rolling shutters, from a moving body.

    Args:
        rig: the calibrated pair.
        body: what moves.
        shots: in the order of their time.
        known: the readout that is given, and where to begin; nothing by default.
        readout: estimate the readout too.

    Returns:
        Both with covariance, or why they cannot be found: too few shots that move, or too slow.

    Raises:
        InputError: the times do not rise.
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
        scores, curvatures, noises, distances, rows = [], [], [], [], []
        for k, (o, motion) in enumerate(zip(observed, moving, strict=True)):
            if motion is None or not motion.centred:
                continue
            score, curvature, noise, d2 = _linear(rig, body, o, Ts[k], motion, exposed[k], count, scale2)
            rows.append(k)
            scores.append(score + curvature[:, 0] * (apart[k] - stamped[k]))
            curvatures.append(curvature)
            noises.append(noise)
            distances.append(d2)
        if len(scores) < _SHOTS_MIN:
            return Missed(f"{len(scores)} shots have neighbours on both sides, {_SHOTS_MIN} are needed")
        jitter2 = _jitter2(np.array(scores), np.array(curvatures))
        shares = [jitter2 / (1.0 + jitter2 * h[0, 0]) for h in curvatures]
        marginal = np.array(
            [s - share * h[:, 0] * s[0] for s, h, share in zip(scores, curvatures, shares, strict=True)]
        )
        H = np.sum([h - share * np.outer(h[0], h[0]) for h, share in zip(curvatures, shares, strict=True)], axis=0)
        noise = np.sum(
            [n * (1 - share * h[0, 0]) for n, h, share in zip(noises, curvatures, shares, strict=True)], axis=0
        )
        d2 = np.concatenate(distances)
        scale2 = max(float(np.median(d2)) / (2 * math.log(2)) * 2 * len(d2) / (2 * len(d2) - 6 * len(scores)), 1e-6)
        if np.linalg.eigvalsh(H - noise / _NOISE_MOST)[0] <= 0:
            return Missed("the body does not move, or too slowly: when each camera exposes is not observable")
        step = np.linalg.solve(H - noise, marginal.sum(axis=0))
        theta[:count] += step
        for k, s, h, share in zip(rows, scores, curvatures, shares, strict=True):
            apart[k] = stamped[k] + share * (s[0] - h[0] @ step)
        if abs(theta).max() > 1.0:
            return Missed("the shots do not agree with one skew: are times and order of the shots right?")
        moved_uv = [
            _at_one_time(rig, body, o, T, motion, _exposed(rig, o, a, theta)[0])
            for o, T, motion, a in zip(observed, Ts, moving, apart, strict=True)
        ]
        Ts, covs = _poses(rig, body, moved_uv, Ts, moving)
        if np.abs(step).max() < _DONE_S:
            break
    cov = np.zeros((2, 2))
    inverted = np.linalg.inv(H - noise)
    cov[:count, :count] = _birge(marginal - step @ H / len(marginal), H) * inverted @ H @ inverted
    sigma = np.sqrt(np.diag(cov))
    for name, value, s in zip(("skew", "readout"), theta[:count], sigma, strict=False):
        if s > _SIGMA_MOST * float(np.median(np.diff(t_s))):
            return Missed(
                f"the motion is too slow or too short to find the {name}: {1e3 * value:.2f} ± {1e3 * s:.2f} ms; move "
                "the body faster, or longer"
            )
    return Shutters(float(theta[0]), float(theta[1]), cov, math.sqrt(jitter2))


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
    p_body, uv = body.points[o.point], np.array(o.uv)
    p_then = np.einsum("nij,nj->ni", motion.moved(T, dt_s)[:, :3], np.column_stack([p_body, np.ones(len(p_body))]))
    p_now = transform(T, p_body)
    T_right_left = inverse(rig.T_left_right)
    for side, camera in enumerate(rig.cameras):
        rows = o.camera == side
        now, then = p_now[rows], p_then[rows]
        if side == 1:
            now, then = transform(T_right_left, now), transform(T_right_left, then)
        uv[rows] -= camera.project(then) - camera.project(now)
    return replace(o, uv=uv)


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
    W, A, _ = whitened(rig.cameras, rig.T_left_right, body.points, o, T)
    now = _at_one_time(rig, body, o, T, motion, dt)
    fit = fit_pose(rig.cameras, rig.T_left_right, body.points, now, T, robust=False, steps=0)
    if fit is None:
        zero = np.zeros((count, count))
        return np.zeros(count), zero, zero, np.zeros(0)
    weight = 1.0 / (1.0 + fit.distance2 / (CAUCHY_SCALE**2 * scale2))
    root = np.repeat(np.sqrt(weight / scale2), 2)
    r, A = (W @ fit.residuals_px[..., None]).ravel() * root, A * root[:, None]
    rates = (A.reshape(len(dt), 2, 6) @ (motion.twist + dt[:, None] * motion.acceleration)[..., None])[..., 0]
    M = (rates[:, :, None] * by[:, None, :count]).reshape(-1, count)
    Q = np.linalg.qr(A)[0]
    across = M - Q @ (Q.T @ M)
    D = [A * np.repeat(by[:, i], 2)[:, None] for i in range(count)]
    D = [d - Q @ (Q.T @ d) for d in D]
    noise = np.array([[np.trace(a.T @ b @ motion.cov) for b in D] for a in D])
    return across.T @ r, across.T @ across, noise, fit.distance2


@dataclass(frozen=True, eq=False)
class Alignment(Record):
    """How the observations of one shot come to its time.

    Attributes:
        T_left_body: (4, 4) pose at the shot's time.
        motion: of the body; None where too few neighbours show it.
        apart_s: by how much the right exposure is later than the left, beyond the mean skew, s.
        variance: what is not known of it, s^2.
    """

    T_left_body: Array
    motion: Motion | None
    apart_s: float
    variance: float


def aligned(rig: StereoRig, body: Body, shots: Sequence[TimedShot], shutters: Shutters) -> list[Alignment]:
    """Find pose, motion and, where the skew varies, the skew of every shot.

    Args:
        rig: the calibrated pair.
        body: what moves.
        shots: in the order of their time.
        shutters: when the cameras expose.

    Raises:
        InputError: the times do not rise.
    """
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

    Args:
        rig: the calibrated pair.
        body: what moves.
        shots: in the order of their time.
        shutters: when the cameras expose.

    Returns:
        Of each shot the pose at its own time, or why there is none, and whether its observations were moved: not where
        too few neighbours show the motion. The covariance holds that of the shutters, common to all shots, and of the
        motion.

    Raises:
        InputError: the times do not rise.
    """
    return [
        (_measured(rig, body, shot.seen, alignment, shutters), alignment.motion is not None)
        for shot, alignment in zip(shots, aligned(rig, body, shots, shutters), strict=True)
    ]


def measure_with_motion(
    rig: StereoRig, body: Body, shot: TimedShot, motion: Motion, shutters: Shutters
) -> PoseEstimate | Missed:
    """Measure one shot of a body whose motion is known otherwise, such as from an arm's joints.

    Args:
        rig: the calibrated pair.
        body: what moves.
        shot: of the body.
        motion: of the body at the shot's time.
        shutters: when the cameras expose.

    Returns:
        The pose at the shot's time, with the covariance of shutters and motion in its own, or why there is none.
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
        extra = _by_timing(rig, body, seen, result.T_left_body, alignment, shutters)
        result = replace(result, cov=result.cov + extra, cov_noise=result.cov_noise + extra)
    return result


def _by_timing(
    rig: StereoRig, body: Body, seen: Correspondences, T: Array, alignment: Alignment, shutters: Shutters
) -> Array:
    """Return the (6, 6) covariance of a pose that comes from what is not known of the exposures and of the motion."""
    assert alignment.motion is not None
    o = PixelObservations.of(seen, rig.sigma_px)
    dt, by = _exposed(rig, o, alignment.apart_s, np.array([shutters.skew_s, shutters.readout_s]))
    _, A, _ = whitened(rig.cameras, rig.T_left_right, body.points, o, T)
    gain, rates = np.linalg.pinv(A).reshape(6, len(dt), 2), A.reshape(len(dt), 2, 6)
    by_twist = np.einsum("inj,njk,n->ik", gain, rates, dt)
    by_theta = np.einsum("inj,njk,k,np->ip", gain, rates, alignment.motion.twist, by)
    cov = np.array(shutters.cov)
    if shutters.jitter_s > 0:  # each shot's own skew is estimated, the mean is only its prior
        cov[0, :] = cov[:, 0] = 0.0
        cov[0, 0] = alignment.variance
    return np.asarray(by_theta @ cov @ by_theta.T + by_twist @ alignment.motion.cov @ by_twist.T)
