"""Resolved-rate tracking: the tool's reference velocity becomes joint speeds through the Jacobian, step by step.

qd = J# (V_ref + K e), e being how far the tool is behind its reference (Whitney, "Resolved motion rate control of
manipulators and human prostheses", 1969). J# is the inverse, damped where the smallest singular value is small (Nakamura
and Hanafusa, 1986; here with a damping that sets in smoothly): the tool then leaves the path a little, and the joint speeds
stay bounded, so this tracker passes singularities at which exact motions are rejected. Fewer than six joints move the
position along the path and the orientation as near to its reference as that leaves it (:func:`position_first`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.rotation import log_so3
from armsight.robot.trajectories.law import ROUNDS
from armsight.robot.trajectories.limits import ROUNDING, Worst, outside, start_state, worst
from armsight.robot.trajectories.lookahead import behind
from armsight.robot.trajectories.path import Path, PathPoints
from armsight.robot.trajectories.profile import Profile, plan_profile
from armsight.robot.trajectories.trajectory import CHECK_RATE_HZ, Joints, MotionRejected, check_duration, clamped

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm

GAIN = 30.0  # how fast the tool returns to its reference, 1/s: what is left of an error falls to a third in 1/GAIN
#: Damping sets in below this singular value (linear rows over the arm's size) and reaches its square's share of DAMPING.
SOFT, DAMPING = 0.04, 0.03
#: After the reference stands, the tool settles until the joints are slower than this share of their limits, or this long.
#: A speed that is left is taken off within the last step of 1 ms: by a jerk some 1e7 times as large.
SETTLED, SETTLE_S = 2e-6, 2.0
LONGEST_S = 300.0  # the longest motion that may be asked for, s: each second of it is a thousand steps
#: How far from the path a start's speeds may point, of their limits, and its accelerations, rad/s^2 at the arm's size.
ALONG = 1e-5
_RANK = 1e-9  # a singular value below this is none
#: How the share of the way moves, in units of its duration: limits of speed, acceleration and jerk.
SHAPE = (1.6, 8.0, 80.0)


@dataclass(frozen=True, eq=False)
class TrackedMotion:
    """The joints as the tracker moved them, between its steps as a cubic spline."""

    duration_s: float  #: how long the motion takes, the settling at its end included, s
    deviation_m: float  #: the furthest the tool is from its reference at any step, m
    deviation_rad: float  #: the furthest its orientation is from the reference's, rad
    least_singular: float  #: the smallest singular value met; damping sets in below :data:`SOFT`
    least_singular_t_s: float  #: when, s
    spline: CubicSpline  #: the joints over time

    def at(self, t_s: float | Array) -> Joints:
        """Return the joints, (n,) or (N, n), ``t_s`` seconds after the start."""
        times = clamped(t_s, self.duration_s)
        return Joints(*(np.asarray(self.spline(times, order)) for order in range(3)))


class _Run(NamedTuple):
    """One run of the tracker at N instants: times, joints, distance m and rad from the reference, singular value."""

    t_s: Array
    q: Array
    off_m: Array
    off_rad: Array
    least: Array


def resolved_rate(
    arm: Arm,
    q_start: ArrayLike,
    path: Path,
    *,
    qd_start: ArrayLike | None = None,
    qdd_start: ArrayLike | None = None,
    duration_s: float | None = None,
    tolerance_m: float = 1e-3,
) -> TrackedMotion:
    """Track a path of the tool through the Jacobian, past singularities too.

    Args:
        arm: the arm.
        q_start: (n,) angles to start from, rad; they put the tool at the path's start.
        path: the path: a LinePath, an ArcPath, a BlendedPath, or anything with their ``at``.
        qd_start: (n,) speeds to start with, rad/s; they must carry the tool along the path. None for rest.
        qdd_start: (n,) accelerations to start with, rad/s^2, as ``qd_start``.
        duration_s: how long the reference is to take, s; None for about as short as the limits allow.
        tolerance_m: how far the tool may leave the path where damping sets in, m.

    Raises:
        MotionRejected: a joint limit is passed, or the tool leaves the path further than allowed.
        InputError: bad numbers, or a duration within which the limits cannot be kept.
    """
    check_duration(duration_s, LONGEST_S)
    if not tolerance_m > 0:
        raise InputError(f"tolerance_m is {tolerance_m}; it must be a positive length in m")
    start = start_state(arm, q_start, qd_start, qdd_start)
    T_begin, T_now = path.at(np.zeros(1)).T_base_tool[0], arm.forward(start.q)
    gap_m = np.linalg.norm(T_begin[:3, 3] - T_now[:3, 3])
    gap_rad = np.linalg.norm(log_so3(np.ascontiguousarray(T_begin[:3, :3].T @ T_now[:3, :3])))
    if max(gap_m, gap_rad) > tolerance_m:
        raise InputError(
            f"q_start does not put the tool at the start of the path: it is {1e3 * gap_m:.3f} mm and "
            f"{np.degrees(gap_rad):.3f} deg away"
        )
    share = _share_state(arm, start, path)
    reference_s = duration_s if duration_s is not None else _first_guess_s(arm, start.q, path)
    tried: list[tuple[float, float]] = []
    while True:
        law = _law(share, reference_s, duration_s)
        run = _track(arm, start.q, path, law)
        motion = _motion(run, start.qd)
        # At the spline's own instants, 1 kHz or a little more: between them the jerk is constant.
        most = worst(arm, run.t_s, motion.at(run.t_s))
        if most.ratio <= 1 + ROUNDING or run.off_m[-1] > tolerance_m:  # no slower motion mends a goal that is missed
            _check(arm, path, law, run, tolerance_m)
            return motion
        if duration_s is not None or len(tried) == ROUNDS:
            raise _rejection(path, law, most.what, most.t_s)
        tried.append((reference_s, most.ratio))
        reference_s *= _slower(tried, most)


def _slower(tried: list[tuple[float, float]], most: Worst) -> float:
    """Return by how much to slow down after durations and ratios that were tried.

    Away from singularities all goes with a power of the duration. Close to them the damping keeps its own time, and the
    power is taken from the last two tries.
    """
    factor = most.time_scale
    if len(tried) > 1:
        (s_a, ratio_a), (s_b, ratio_b) = tried[-2:]
        power = np.log(ratio_a / ratio_b) / np.log(s_b / s_a)
        factor = most.ratio ** (1 / np.clip(power, 0.5, 3.0))
    return float(min(factor, 4.0)) * 1.01


def _law(start: Joints, reference_s: float, duration_s: float | None) -> Profile:
    """Return the share of the way over time: in ``reference_s``, or from a moving start in about that.

    InputError: a moving start cannot stop at the end of the path so gently.
    """
    speed, acceleration, jerk = (np.array([limit / reference_s**order]) for order, limit in enumerate(SHAPE, start=1))
    exact_s = duration_s if start.qd.any() else reference_s
    law = plan_profile(start, np.ones(1), speed, acceleration, jerk, exact_s)
    low, high = law.extrema(0)
    if low < -ROUNDING or high > 1 + ROUNDING:
        raise InputError("from this moving start the tool cannot stop at the end of the path within the arm's limits")
    return law


def _share_state(arm: Arm, start: Joints, path: Path) -> Joints:
    """Return the start as share of the way, its speed and acceleration (1,); InputError where it is not along the path."""
    _, twist, bend = (part[0] for part in path.at(np.zeros(1)))
    scale = _scale(arm)
    J, along = arm.jacobian(start.q), twist / scale
    speed = float(along @ (J @ start.qd / scale) / (along @ along))
    gained = J @ start.qdd + arm.jacobian_rate(start.q, start.qd) @ start.qd - bend * speed**2
    acceleration = float(along @ (gained / scale) / (along @ along))
    off = np.abs(start.qd - _speeds(J, twist * speed, scale)[0]) / arm.qd_max
    if max(off.max(), np.abs(gained / scale - along * acceleration).max()) > ALONG or speed < 0:
        raise InputError("qd_start and qdd_start do not carry the tool along the path: give ones that do, or none")
    return Joints(np.zeros(1), np.array([speed]), np.array([acceleration]))


def _first_guess_s(arm: Arm, q: Array, path: Path) -> float:
    """Return a duration that the speeds and accelerations of the joints at the start would allow."""
    q1 = np.abs(_speeds(arm.jacobian(q), path.at(np.zeros(1)).twist[0], _scale(arm))[0])
    slowest = max(float((SHAPE[0] * q1 / arm.qd_max).max()), float(np.sqrt((SHAPE[1] * q1 / arm.qdd_max).max())))
    return max(slowest, 1e-2)


def position_first(J: Array, V: Array, inverted: Callable[[Array], Array]) -> tuple[Array, float]:
    """Return the joints' speeds (n,) for a velocity V (6,): the position first, then the orientation as far as possible.

    For arms of fewer than six joints, which cannot have both: the second level is solved in the null space of the first
    (Nakamura, Hanafusa and Yoshikawa, 1987). J (6, n) and V: linear rows first, over the arm's size; ``inverted``
    returns what stands for the inverses of singular values (k,), 0 where a direction is not to be used. Also return the
    smallest singular value of the position's rows.
    """
    U, s, Vt = np.linalg.svd(J[:3], full_matrices=False)
    qd = (inverted(s) * (V[:3] @ U)) @ Vt
    used = Vt[s > _RANK]
    U_free, s_free, Vt_free = np.linalg.svd(J[3:] - (J[3:] @ used.T) @ used, full_matrices=False)
    qd += (inverted(np.where(s_free > _RANK, s_free, 0.0)) * ((V[3:] - J[3:] @ qd) @ U_free)) @ Vt_free
    return qd, float(s[-1])


def _damped(s: Array) -> Array:
    """Return the damped inverses of singular values (k,): 0 of 0."""
    soft = np.maximum(0.0, 1 - (s / SOFT) ** 2)
    return np.asarray(s / np.maximum(s**2 + (DAMPING * soft) ** 2, 1e-12))


def _speeds(J: Array, V: Array, scale: Array) -> tuple[Array, float]:
    """Return joint speeds (n,) for a tool velocity (6,), damped, and the smallest singular value."""
    if J.shape[1] < 6:
        return position_first(J / scale[:, None], V / scale, _damped)
    U, s, Vt = np.linalg.svd(J / scale[:, None], full_matrices=False)
    soft = max(0.0, 1 - (s[-1] / SOFT) ** 2)
    return (s / (s**2 + (DAMPING * soft) ** 2) * ((V / scale) @ U)) @ Vt, float(s[-1])


def _scale(arm: Arm) -> Array:
    """Return what the rows of the Jacobian (6,) are divided by: the arm's size for the linear ones."""
    return np.array([arm.size_m] * 3 + [1, 1, 1])


def _track(arm: Arm, q_start: Array, path: Path, law: Profile) -> _Run:
    """Run the tracker in steps of 1 ms, by the midpoint rule."""
    steps = int(np.ceil(law.duration_s * CHECK_RATE_HZ))
    most = steps + int(SETTLE_S * CHECK_RATE_HZ)
    dt = law.duration_s / steps
    moved = law.at(np.arange(2 * most + 1) * dt / 2)
    points = path.at(moved.q[:, 0])
    V_ref, scale = points.twist * moved.qd, _scale(arm)
    rows: list[tuple[Array, Array, float]] = []
    q = q_start
    for k in range(most):
        qd, off, least = _step(arm, q, points, V_ref, 2 * k, scale)
        rows.append((q, off, least))
        if k >= steps and (np.abs(qd) < SETTLED * arm.qd_max).all():
            break
        q = q + dt * _step(arm, q + dt / 2 * qd, points, V_ref, 2 * k + 1, scale)[0]
    qs, offs, leasts = (np.array(part) for part in zip(*rows, strict=True))
    off_m, off_rad = (np.asarray(np.linalg.norm(part, axis=1)) for part in (offs[:, :3], offs[:, 3:]))
    return _Run(np.linspace(0, (len(qs) - 1) * dt, len(qs)), qs, off_m, off_rad, leasts)


def _step(arm: Arm, q: Array, points: PathPoints, V_ref: Array, row: int, scale: Array) -> tuple[Array, Array, float]:
    """Return the joint speeds (n,) commanded now, how far the tool is behind (6,), and the smallest singular value."""
    off = behind(points.T_base_tool[row], arm.forward(q))
    qd, least = _speeds(arm.jacobian(q), V_ref[row] + GAIN * off, scale)
    return qd, off, least


def _motion(run: _Run, qd_start: Array) -> TrackedMotion:
    row = int(np.argmin(run.least))
    spline = CubicSpline(run.t_s, run.q, bc_type=((1, qd_start), (1, np.zeros_like(qd_start))))
    return TrackedMotion(
        float(run.t_s[-1]),
        float(run.off_m.max()),
        float(run.off_rad.max()),
        float(run.least[row]),
        float(run.t_s[row]),
        spline,
    )


def _check(arm: Arm, path: Path, law: Profile, run: _Run, tolerance_m: float) -> None:
    """Reject a run that leaves the joint limits or the path."""
    beyond = np.maximum(arm.q_min - run.q, run.q - arm.q_max).max(axis=1) > ROUNDING
    if beyond.any():
        row = int(np.argmax(beyond))
        raise _rejection(path, law, str(outside(arm, run.q[row])), float(run.t_s[row]))
    off = run.off_m > tolerance_m
    if off.any():
        reason = (
            f"near a singularity the tool would leave the path, by {1e3 * run.off_m.max():.3f} mm in the end where "
            f"{1e3 * tolerance_m:.3f} mm are allowed"
        )
        raise _rejection(path, law, reason, float(run.t_s[int(np.argmax(off))]))


def _rejection(path: Path, law: Profile, reason: str, t_s: float) -> MotionRejected:
    share = float(law.at(t_s).q[0])
    return MotionRejected(reason, share=share, t_s=t_s, p_base=path.at(np.array([share])).T_base_tool[0, :3, 3])
