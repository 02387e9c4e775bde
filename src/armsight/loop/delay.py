"""How late the camera's stamps are on the joints' clock, from a sweep of the arm that both watched.

In: potentiometer readings and pose measurements of a few seconds of motion with changing speed. Out: :class:`Delay`
with its sigma. First the lag at which the rotations between successive measurements are those of the joints (rotation
angles do not depend on where the cameras are); then the filter that also runs the loop, with the delay in its state
beside all that makes an arm's potentiometers wrong. That matters: backlash at constant speed looks like a delay (0.2
deg at 30 deg/s like 7 ms), and only a changing speed distinguishes the two.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from armsight.data import Array, JointStates
from armsight.errors import CalibrationError, InputError
from armsight.estimate.chance import chi_square_limit
from armsight.geometry.check import checked
from armsight.geometry.pose import transform
from armsight.geometry.rigid import fit_rigid
from armsight.geometry.rotation import log_so3, skew
from armsight.loop.estimators import Delay, KalmanEstimator, Outcome, PoseMeasurement, Prior
from armsight.loop.estimators.clock import SYSTEMATIC_S
from armsight.robot.kinematics.arm import Arm
from armsight.tables.poses import PoseTable

#: Lags that are tried, s: stamps may be early by a clock's offset, and late by a slow camera's buffers.
LAGS_S = np.arange(-0.1, 0.6, 2e-3)
#: Fewest measurements.
MIN_MEASUREMENTS = 20
#: How far the first step may be off, s, and how often the filter is run from its own answer.
FIRST_SIGMA_S, PASSES = 5e-3, 2
#: A delay worse known than this, s, is none: at 0.5 m/s it is 1 mm.
MAX_SIGMA_S = 2e-3
#: A stamp that is further off than this, in sigma, is no jitter but a hiccup.
_OUTLIER = 4.0
#: Readings given to the filter ahead of a measurement, s.
_AHEAD_S = 0.1
#: Of two rigs' paths: blocks left out; lags tried; steps of each; gaps bridged; a lag so little worse is as likely.
_BLOCKS, _CANDIDATES, _STEPS, _BRIDGED, _ALIKE = 8, 3, 6, 3.0, 2.0


def estimate_delay(
    arm: Arm,
    states: JointStates,
    measurements: Sequence[PoseMeasurement],
    *,
    prior: Prior | None = None,
    sync_s: float = 0.0,
) -> Delay:
    """Find how late the camera's stamps are, and how far they scatter.

    Args:
        arm: the arm, as its table says it is.
        states: readings from before the first measurement to after the last.
        measurements: of the tool's pose meanwhile, in order of time; 20 or more, while the joints moved to and fro.
        prior: how far the arm may be off.
        sync_s: standard deviation of the time between a shot's two exposures, s.

    Raises:
        InputError: too few measurements, or readings that do not cover them.
        CalibrationError: the motion does not determine the delay.
    """
    t, q = checked(states.t_s, (None,), "states.t_s"), checked(states.q, (len(states.t_s), None), "states.q")
    stamps = np.array([pose_measurement.t_s for pose_measurement in measurements])
    if len(stamps) < MIN_MEASUREMENTS or not (np.diff(stamps) > 0).all():
        raise InputError(
            f"a delay needs {MIN_MEASUREMENTS} or more pose measurements in order of time, got {len(stamps)}"
        )
    inside = LAGS_S[(stamps[0] - LAGS_S >= t[0]) & (stamps[-1] - LAGS_S <= t[-1])] if len(t) else LAGS_S[:0]
    if len(inside) < 3:
        raise InputError(
            "the joint readings do not cover the pose measurements; log them from a second before to a second after"
        )
    jitter_s = float(np.hypot(_jitter(stamps), 0.5 * sync_s))  # of the middle between the two exposures
    delay = Delay(_coarse(arm, t, q, measurements, inside), FIRST_SIGMA_S, jitter_s)
    for _ in range(PASSES):
        delay = _filtered(arm, states, measurements, Delay(delay.delay_s, FIRST_SIGMA_S, jitter_s), prior)
    if delay.sigma_s > MAX_SIGMA_S:
        raise CalibrationError(
            f"the sweep determines the camera's delay to {1e3 * delay.sigma_s:.1f} ms only, {1e3 * MAX_SIGMA_S:.0f} are "
            "needed: move all joints to and fro, faster and with changing speed"
        )
    return Delay(delay.delay_s, float(np.hypot(delay.sigma_s, SYSTEMATIC_S)), jitter_s)


def _jitter(stamps: Array) -> float:
    """Return by how much stamps (N,) of a camera that keeps its rate scatter, standard deviation, s.

    A shot more or less between two of them does not count: their distance is compared with whole periods.
    """
    apart = np.diff(stamps)
    periods = np.maximum(np.round(apart / np.median(apart)), 1.0)
    off = np.abs(apart - periods * (apart.sum() / periods.sum()))
    usual = off[off <= _OUTLIER * np.median(off) / np.sqrt(chi_square_limit(1, 0.5))]
    return float(np.sqrt(np.mean(usual**2) / 2))


def _coarse(arm: Arm, t: Array, q: Array, measurements: Sequence[PoseMeasurement], lags: Array) -> float:
    """Return the lag, s, at which the tool's rotation angles by the joints fit the measured ones best (least squares)."""
    stamps = np.array([pose_measurement.t_s for pose_measurement in measurements])
    seen = _rotation_angles(np.array([pose_measurement.T_base_tool for pose_measurement in measurements]))
    cost = np.empty(len(lags))
    for n, lag in enumerate(lags):
        at = np.stack([np.interp(stamps - lag, t, q[:, i]) for i in range(q.shape[1])], axis=1)
        cost[n] = np.square(_rotation_angles(arm.forward(at)) - seen).sum()
    best = int(np.clip(np.argmin(cost), 1, len(lags) - 2))
    before, here, after = cost[best - 1 : best + 2]
    bend = before - 2 * here + after
    return float(lags[best] + (0.5 * (before - after) / bend * (lags[1] - lags[0]) if bend > 0 else 0.0))


def _rotation_angles(Ts: Array) -> Array:
    """Return the angles (N - 1,) between successive poses (N, 4, 4), rad."""
    R = Ts[:, :3, :3]
    return np.asarray(np.linalg.norm(log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:]), axis=1))


def _filtered(
    arm: Arm, states: JointStates, measurements: Sequence[PoseMeasurement], delay: Delay, prior: Prior | None
) -> Delay:
    """Return the delay as a filter that runs over the sweep knows it at the end."""
    estimator = KalmanEstimator(arm, prior=prior, delay=delay)
    given = used = 0
    for pose_measurement in measurements:
        upto = int(np.searchsorted(states.t_s, pose_measurement.t_s - delay.delay_s + _AHEAD_S))
        if upto > given:
            estimator.joints(JointStates(states.t_s[given:upto], states.q[given:upto]))
            given = upto
        used += estimator.vision(pose_measurement) is Outcome.USED
    if used < len(measurements) / 2:
        raise CalibrationError(
            f"vision and the joint readings do not describe the same motion: {used} of {len(measurements)} measurements "
            "fit; is the hand-eye calibration this arm's, and are both stamped by one clock?"
        )
    return estimator.learned().delay


def time_between(first: PoseTable, second: PoseTable) -> Delay:
    """Find how late one rig's stamps are on another's clock, from a motion of a body that both measured.

    Each rig's poses are in its own frame; where the rigs are to each other is fitted beside. Speeds do not depend on it:
    their correlation says where to begin.

    Args:
        first: poses of the body with times, by the rig whose clock is the measure.
        second: the same, by the other rig; its clock may have any zero.

    Returns:
        The delay; its sigma is by leaving out blocks of time in turn (Kunsch, Ann. Statist. 17, 1989), and so holds for
        errors that last for a while.

    Raises:
        InputError: tables without times, or too few poses.
        CalibrationError: the motion does not determine the delay, or repeats itself; the body was at rest.
    """
    (t_a, p_a), (t_b, p_b) = (_positions(each) for each in (first, second))
    path, fits = CubicSpline(t_a, p_a), list[tuple[float, float, float]]()
    for lag in _likely_lags(t_a, p_a, t_b, p_b):
        at = t_b - lag
        rows = np.flatnonzero((at > t_a[0] + _AHEAD_S) & (at < t_a[-1] - _AHEAD_S))
        after = np.searchsorted(t_a, at[rows])
        rows = rows[t_a[after] - t_a[after - 1] < _BRIDGED * np.median(np.diff(t_a))]
        if len(rows) >= MIN_MEASUREMENTS:
            blocks = np.array_split(rows, _BLOCKS)
            others = [_aligned(path, t_b, p_b, np.setdiff1d(rows, each), lag)[0] for each in blocks]
            delay, rms = _aligned(path, t_b, p_b, rows, lag)
            spread = float(np.sum(np.square(np.array(others) - np.mean(others))))
            fits.append((rms, delay, float(np.sqrt((_BLOCKS - 1) / _BLOCKS * spread))))
    if not fits:
        raise InputError(f"the two rigs have fewer than {MIN_MEASUREMENTS} poses of one motion in common")
    (rms, delay, sigma), *rest = sorted(fits)
    if (moved := float(np.sqrt(np.square(p_b - p_b.mean(axis=0)).sum(axis=1).mean()))) < _ALIKE * rms:
        raise CalibrationError(
            f"the body moved by {1e3 * moved:.3g} mm RMS, and at no lag do the rigs agree to half of that: it was at rest, "
            "or they saw different motions: move it by centimetres before both"
        )
    if any(other < _ALIKE * rms and abs(late - delay) > _AHEAD_S for other, late, _ in rest):
        raise CalibrationError("the motion repeats itself: move to and fro at different speeds and over different ways")
    if not sigma < MAX_SIGMA_S:
        raise CalibrationError(f"the motion determines the delay to {1e3 * sigma:.1f} ms only: move faster, or longer")
    return Delay(delay, sigma)


def _positions(table: PoseTable) -> tuple[Array, Array]:
    """Return the times (N,) and the positions (N, 3) of the poses of a table."""
    if table.t_s is None:
        raise InputError(f"{table.path}: a column t_s is needed")
    t, p = table.t_s, table.Ts[:, :3, 3]
    if len(t) < MIN_MEASUREMENTS or not (np.diff(t) > 0).all():
        raise InputError(f"{table.path}: {MIN_MEASUREMENTS} or more poses in order of time are needed, it has {len(t)}")
    return t, p


def _likely_lags(t_a: Array, p_a: Array, t_b: Array, p_b: Array) -> list[float]:
    """Return the lags, s, at which the speeds of two paths are most alike, the best first."""
    from scipy.signal import correlate, find_peaks  # takes 25 MB, which who only runs or shows an arm does not need

    step = float(min(np.median(np.diff(t_a)), np.median(np.diff(t_b))))
    speeds = []
    for t, p in ((t_a, p_a), (t_b, p_b)):
        middle, speed = 0.5 * (t[1:] + t[:-1]), np.linalg.norm(np.diff(p, axis=0), axis=1) / np.diff(t)
        at = np.interp(np.arange(middle[0], middle[-1], step), middle, speed)
        speeds.append(at - at.mean())
    a, b = speeds
    shared = correlate(np.ones(len(b)), np.ones(len(a)))
    energy = correlate(b**2, np.ones(len(a))) * correlate(np.ones(len(b)), a**2)
    alike = correlate(b, a) / np.sqrt(np.maximum(energy, 1e-9 * energy.max()))
    alike[shared < 0.5 * min(len(a), len(b))] = -1.0
    peaks = find_peaks(alike, distance=max(1, round(_AHEAD_S / step)))[0]
    best = peaks[np.argsort(-alike[peaks])][:_CANDIDATES]
    return [float((k - len(a) + 1) * step + t_b[0] - t_a[0]) for k in best]


def _aligned(path: CubicSpline, t_b: Array, p_b: Array, rows: NDArray[np.int64], lag: float) -> tuple[float, float]:
    """Return the lag, s, and the RMS, m, at which a path, moved rigidly, fits positions best (Gauss-Newton)."""
    t, p = t_b[rows], p_b[rows]
    for _ in range(_STEPS):
        at = path(t - lag)
        T = fit_rigid(at, p)
        e = p - transform(T, at)
        v = path(t - lag, 1) @ T[:3, :3].T
        # Of the velocity only what no rigid motion does shows the lag.
        by = np.concatenate([np.tile(np.eye(3), (len(t), 1, 1)), -skew(p - p.mean(axis=0)), -v[:, :, None]], axis=2)
        lag += float(np.linalg.lstsq(by.reshape(-1, 7), e.reshape(-1), rcond=None)[0][6])
    return lag, float(np.sqrt((e**2).sum(axis=1).mean()))
