"""The outer loop: corrects the joints' commands until the tool, as vision measures it, follows its reference.

In: a motion, an estimator, the time. Out: a :class:`JointCommand` for the joints' own controllers and how it came about.
The command is the motion's joints plus a correction c (n,), with the motion's speeds fed forward. While the arm moves, c
is the joint error, by the estimator's model, that must be made up for at the next pose to be reached; at rest, c integrates
the tool's error itself, or, over controllers that move joints by steps, is changed by whole steps now and then. Tool errors
become joint errors through the Jacobian, except in directions in which the arm is near a singularity. Gain, its margin, and
what happens when vision is lost: docs/concepts/loop.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.data import Array, JointCommand, Record
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse, log_se3
from armsight.kernels import kernel
from armsight.loop.estimators.estimator import ArmEstimate, Estimator
from armsight.loop.finding import Trust
from armsight.robot.kinematics.arm import Arm
from armsight.robot.trajectories import Joints, Trajectory
from armsight.robot.trajectories.lookahead import behind
from armsight.robot.trajectories.resolved_rate import position_first

#: A tool less well known than this is not corrected: sigma of its worst direction, m.
MAX_SIGMA_M = 1e-3
#: The correction moves no faster than this share of each joint's speed limit, so that nothing jumps.
RATE_SHARE = 0.1
#: At rest a joint is taken through its backlash, with this time constant, s, for a lasting error of so much, m.
CROSS_S, CROSS_M = 0.3, 3e-5
#: Over joints that move by steps the error is averaged for so long, s, and so long at most, before a change that lowers
#: it by this share of a step's largest displacement: less would hunt.
LOOK_S, LOOK_MOST_S, WORTH_STEPS = 0.25, 1.0, 0.25
#: Backlash to cross is known to the first share, what a joint displaces to the second: the Jacobian is the table's.
GAP_SHARE, MOVE_SHARE = 0.5, 0.02
#: In a choice between whole steps an error of 1 rad counts as much as one of this, m.
STEP_LEVER_M = 0.05
#: How fast the servo learns by how much joints rest off their commands, s; that changes with the load from pose to pose.
DROOP_S = 0.2
#: In motion the correction comes to what is asked for with this time constant, s: backlash would keep it twitching.
FOLLOW_S = 0.08
#: A direction is corrected from this singular value of the Jacobian on (linear rows over the arm's size), then fully.
UNCORRECTED_BELOW, CORRECTED_ABOVE = 0.02, 0.04
#: The correction is at most this, rad, and displaces the tool by at most so much, m: beyond is another arm.
MAX_CORRECTION_RAD = np.deg2rad(5.0)
MAX_CORRECTION_M = 0.02
#: Joints are at rest when measured slower than this (four sigma of a smoothed speed) and commanded slower than that, rad/s.
REST_RAD_S, STANDING_RAD_S = 0.055, 1e-6
#: Sigma of what joints cannot explain of a measured pose, m and rad; sigma of the error of a joint, rad.
_EXPLAINED, _JOINT_RAD = (3e-4, 5e-4), float(np.radians(1.0))


class Mode(Enum):
    """What closes the loop."""

    VISION = "vision"
    BRIDGED = "bridged: no measurement lately, the joint sensors carry on with what was learned"
    POTENTIOMETERS = "joint sensors alone: vision is lost, the last correction is held"
    HELD = "held: vision contradicts what was learned; the correction stays until the cause is known"
    DISTRUSTED = "what vision measures is wrong: the joint sensors, with what was learned before that, if anything was"


@dataclass(frozen=True)
class LoopTiming:
    """How long everything in the loop takes."""

    period_s: float
    vision_period_s: float
    latency_s: float  #: from the middle of an exposure to the command that knows of it, s, as measured
    response_s: float = 0.05  #: from a command to the joints being there, s: the time constant of their own loop

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name, value in vars(self).items():
            least = 0.0
            if not (np.isfinite(value) and value > least):
                raise InputError(f"{name} is {value}; it must be a positive number of seconds")

    @property
    def gain(self) -> float:
        """The share of an error that is taken away per command.

        c[k+1] = c[k] - g e[k-d] comes to rest without overshoot up to g = d^d / (d+1)^(d+1), where the roots of
        z^(d+1) - z^d + g meet on the real axis; it is stable up to 2 sin(pi / (4d + 2)) (Levin and May, 1976): 2 times as
        much at d = 0, 4 at 1, pi e / 2 = 4.27 in the limit. The age of what is held between measurements counts as delay.
        """
        return self.gain_at(0.0)

    def gain_at(self, age_s: float) -> float:
        """Return the same where the newest measurement is so old, s; 0 before the first, whose age is infinite."""
        d = self.arrived_s(age_s) / self.period_s
        share = 1.0 / (d + 1.0)
        return float(share * (1.0 - share) ** d)

    def arrived_s(self, age_s: float) -> float:
        """Return how long after a command its effect is in the estimate, s, the newest measurement being so old, s."""
        return max(self.latency_s + self.vision_period_s, age_s) + self.response_s


@dataclass(frozen=True)
class JointLoops:
    """Controllers of the joints that armsight cannot tune, and which do not reach what they are commanded."""

    steps_rad: tuple[float, ...]  #: (n,) the smallest step that each joint makes
    rest_rad_s: float  #: a joint at rest is measured slower than this


@dataclass(frozen=True, eq=False)
class Aim(Record):
    """The reference of the next command, as far as no measurement changes it: computed while an image is on its way."""

    ahead: Joints  #: the joints a period from now, as the motion has them
    q: Array  #: (2, n) angles now and ahead, rad
    qd: Array  #: (2, n) their speeds, rad/s
    Ts_base_tool: Array  #: (2, 4, 4) where they put the tool
    most: Array  #: (n,) by how much the correction of each joint may change in the period, rad
    duty: Array  #: (n,) that holds the arm against gravity ahead
    jacobian: Array  #: (6, n) at the goal
    #: (6, k) of its k = min(6, n) singular values, linear rows over the arm's size, and so are ``s`` and ``Vt``
    U: Array
    s: Array  #: (k,)
    Vt: Array
    passed_s: float  #: since the last command, s; the period where that is not known
    left_s: float  #: until the arm moves on, s


@dataclass(frozen=True, eq=False)
class ServoStep(Record):
    """One command and how it came about."""

    command: JointCommand
    mode: Mode  #: what the loop is closed on
    correction: Array  #: (n,) what is added to the motion's joints, rad
    error: Array  #: (6,) from the estimated tool to its reference now, [m; rad] in base axes
    limited: tuple[str, ...] = ()  #: what kept a joint from being corrected further, one text each


class PoseServo:
    """Corrects the joints' commands by what is seen of the tool."""

    def __init__(self, arm: Arm, timing: LoopTiming, joints: JointLoops | None = None) -> None:
        self.timing, self._joint_loops = timing, joints
        self._rest_rad_s = REST_RAD_S if joints is None else joints.rest_rad_s
        self._droop = np.zeros(arm.joints)
        self._arm, self._scale = arm, np.array([arm.size_m] * 3 + [1.0, 1.0, 1.0])
        self._follow = min(timing.period_s / max(FOLLOW_S, timing.vision_period_s), 1.0)
        self._correction = np.zeros(arm.joints)
        self._goal: Joints | None = None
        self._rest_s, self._lasting = 0.0, np.zeros(6)
        self._look_s, self._looks, self._stepped_to = 0.0, 0, np.zeros(arm.joints)
        self._last: tuple[Trajectory, float] | None = None  # the motion and its time at the last aim

    def aim(
        self,
        motion: Trajectory,
        t_s: float,
        gravity: Callable[[Array], ArrayLike] = np.zeros_like,
        *,
        rest_s: float = math.inf,
    ) -> Aim:
        """Return the reference of the next command.

        Args:
            motion: the motion under way; a next one must start where the last one ended.
            t_s: time since its start, on the clock of the estimator's newest reading, s.
            gravity: returns the duty (n,) that holds the arm against gravity at joint angles (n,), passed on.
            rest_s: how long the arm rests after the motion, s, where that is known.
        """
        passed_s = t_s - self._last[1] if self._last is not None and self._last[0] is motion else 0.0
        self._last = motion, t_s
        ahead = motion.at(t_s + self.timing.period_s)
        goal = self._goal or motion.at(t_s)
        duty = checked(gravity(ahead.q), (self._arm.joints,), "gravity")
        jacobian = self._arm.jacobian(goal.q)
        U, s, Vt = map(np.ascontiguousarray, np.linalg.svd(jacobian / self._scale[:, None], full_matrices=False))
        q, qd = np.stack([goal.q, ahead.q]), np.stack([goal.qd, ahead.qd])
        fastest = self._arm.qd_max * self.timing.period_s
        most = np.minimum(RATE_SHARE * fastest, np.maximum(fastest - np.abs(q[1] - q[0]), 0.0))
        passed_s = passed_s if passed_s > 0.0 else self.timing.period_s
        left_s = motion.duration_s + rest_s - t_s
        return Aim(ahead, q, qd, self._arm.forward(q), most, duty, jacobian, U, s, Vt, passed_s, left_s)

    def step(
        self, aim: Aim, estimator: Estimator, trust: Trust = Trust.FULL, before: Estimator | None = None
    ) -> ServoStep:
        """Make the next command.

        ``before``: where vision is not trusted at all, an estimator that knows what was learned before; None for none.
        """
        estimate = estimator.estimate()
        error = behind(aim.Ts_base_tool[0], estimate.T_base_tool)
        mode = self._mode(estimate, trust)
        resting = self._resting(estimate, aim)
        distrusted = mode is Mode.DISTRUSTED
        change = -self._correction if distrusted else np.zeros(self._arm.joints)
        source = before if distrusted else estimator
        closed = mode in (Mode.VISION, Mode.BRIDGED)
        gain = self.timing.gain_at(estimate.vision_age_s)
        if source is not None and (closed or distrusted):
            last, following = self._missing(source, aim)
            push = following - last + (gain * error if resting and closed else self._follow * last)
            change = self._joints(aim, push)
        if closed and resting:
            if self._joint_loops is None:
                change += self._crossing(estimator, aim, error, gain)
            else:
                change = self._stepped(estimator, aim, error, self.timing.arrived_s(estimate.vision_age_s))
                self._droops(estimate, aim)
        else:
            self._look_s, self._looks = 0.0, 0
        return self._command(aim, change, mode, error)

    def _mode(self, estimate: ArmEstimate, trust: Trust) -> Mode:
        if trust is not Trust.FULL:
            return Mode.HELD if trust is Trust.DOUBTED else Mode.DISTRUSTED
        cov = estimate.cov_own[:3, :3]
        # The greatest variance is not above the sum of three; only where that is too much is it worth looking for.
        sigma_m = math.sqrt(cov[0, 0] + cov[1, 1] + cov[2, 2])
        if sigma_m > MAX_SIGMA_M:
            sigma_m = math.sqrt(np.linalg.eigvalsh(cov)[-1])
        if sigma_m > MAX_SIGMA_M:
            return Mode.POTENTIOMETERS
        usual_s = self.timing.latency_s + 2 * self.timing.vision_period_s  # one measurement may be missed
        return Mode.VISION if estimate.vision_age_s <= usual_s else Mode.BRIDGED

    def _missing(self, estimator: Estimator, aim: Aim) -> Array:
        """Return how far the tool would be behind (2, 6) now and ahead with this correction."""
        return behind(aim.Ts_base_tool, estimator.tool(aim.q + self._correction + self._droop, aim.qd))

    def _joints(self, aim: Aim, error: Array) -> Array:
        """Return the joint angles (n,) that make up for an error of the tool (6,).

        What a singular arm cannot do is not asked of it: damping alone would let the integral wind up in that direction.
        """
        if self._arm.joints < 6:
            return position_first(aim.jacobian / self._scale[:, None], error / self._scale, _corrected)[0]
        joints = np.empty(self._arm.joints)
        _by_tool(aim.U, aim.s, aim.Vt, self._scale, error, joints)
        return joints

    def _crossing(self, estimator: Estimator, aim: Aim, error: Array, gain: float) -> Array:
        """Return a step (n,) through the backlash of joints that rest on its wrong side for what is to be corrected."""
        self._lasting += gain * (error - self._lasting)
        requested = self._joints(aim, self._lasting)
        worth = np.abs(requested) * np.linalg.norm(aim.jacobian[:3], axis=0) > CROSS_M
        return self._crossed(estimator, aim, requested, worth) * min(self.timing.period_s / CROSS_S, 1.0)

    def _crossed(self, estimator: Estimator, aim: Aim, requested: Array, worth: NDArray[np.bool_]) -> Array:
        """Return what (n,) takes joints through the backlash before requested changes (n,), of those that are worth it."""
        sides, q = np.zeros((2, len(requested))), np.empty((2, len(requested)))
        sides[1], q[:] = worth * np.sign(requested), aim.q[0] + self._correction
        here, there = estimator.tool(q, sides, pressed=True)
        return self._joints(aim, behind(here, there))

    def _gaps(self, estimator: Estimator, aim: Aim) -> Array:
        """Return the backlash (2, n), rad, that each joint is to be taken through before it moves the tool up, and down."""
        n = self._arm.joints
        sides = np.concatenate([np.zeros((1, n)), np.eye(n), -np.eye(n)])
        here, *there = estimator.tool(aim.q[0] + self._correction + 0.0 * sides, sides, pressed=True)
        columns = (aim.jacobian / self._scale[:, None]).T
        missing = np.array([behind(here, T) / self._scale for T in there]).reshape(2, n, 6)
        by_joint = (missing * columns).sum(axis=2) / np.maximum((columns**2).sum(axis=1), UNCORRECTED_BELOW**2)
        return np.asarray(np.maximum(np.array([[1.0], [-1.0]]) * by_joint, 0.0))

    def _stepped(self, estimator: Estimator, aim: Aim, error: Array, arrived_s: float) -> Array:
        """Return the change (n,) over joints that move by steps: look, move by whole steps, let the joints arrive.

        Some joints go away from their goal first, to come to it from one side: no change is begun after which there is no
        time left to look.
        """
        assert self._joint_loops is not None
        if self._look_s == 0.0:
            self._stepped_to = self._correction
        self._look_s += aim.passed_s
        if self._look_s > arrived_s:
            self._looks = min(self._looks + 1, math.ceil(LOOK_MOST_S / aim.passed_s))
            self._lasting += (error - self._lasting) / self._looks
        if self._look_s > arrived_s + LOOK_S:
            requested = self._joints(aim, self._lasting)
            change = whole_steps(
                aim.jacobian, requested, np.array(self._joint_loops.steps_rad), self._gaps(estimator, aim)
            )
            takes_s = float((np.abs(change) / (RATE_SHARE * self._arm.qd_max)).max())
            if takes_s + arrived_s + LOOK_S > aim.left_s:
                change[:], takes_s = 0.0, 0.0
            self._stepped_to, self._look_s = self._correction + change, arrived_s
            if change.any():  # what the rate lets it take comes on top
                self._look_s, self._looks, self._lasting = -takes_s, 0, np.zeros(6)
        return self._stepped_to - self._correction

    def _droops(self, estimate: ArmEstimate, aim: Aim) -> None:
        """Learn how far the joints rest from what they are commanded, as far as their own sensors show it."""
        off = estimate.q - aim.q[0] - self._correction
        self._droop += min(self.timing.period_s / DROOP_S, 1.0) * (off - self._droop)

    def _resting(self, estimate: ArmEstimate, aim: Aim) -> bool:
        """Return whether the arm has been at rest for as long as the newest measurement is old."""
        requested = np.abs(aim.qd).max()
        stepping = self._joint_loops is not None and self._rest_s > 0.0  # its own steps are not a motion
        still = bool(requested < STANDING_RAD_S and (stepping or np.abs(estimate.qd).max() < self._rest_rad_s))
        self._rest_s = self._rest_s + aim.passed_s if still else 0.0
        if not still:
            self._lasting = np.zeros(6)
        return still and self._rest_s > estimate.vision_age_s

    def _command(self, aim: Aim, change: Array, mode: Mode, error: Array) -> ServoStep:
        """Return the command with a change of the correction, as far as the limits allow."""
        arm, n = self._arm, self._arm.joints
        q_ref, qd_ref, wished, correction = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
        limits = arm.q_min, arm.q_max, arm.qd_max, aim.most
        numbers = float(MAX_CORRECTION_RAD), MAX_CORRECTION_M, self.timing.period_s
        asked = self._correction, change
        bounded = _bounded(aim.q, aim.qd, aim.jacobian, *limits, *numbers, *asked, wished, correction, q_ref, qd_ref)
        self._correction, self._goal = correction, aim.ahead
        said: tuple[str, ...] = ()
        if bounded:
            names = arm.joint_names
            said = (
                *(("tool: largest correction",) if bounded > n else ()),
                *(f"{names[i]}: limit of its angle" for i in np.flatnonzero(q_ref != aim.q[1] + wished)),
                *(f"{names[i]}: largest correction" for i in np.flatnonzero(np.abs(wished) >= MAX_CORRECTION_RAD)),
            )
        return ServoStep(JointCommand(q_ref, qd_ref, aim.duty, self.timing.period_s), mode, correction, error, said)


@kernel(
    "const f8[:, ::1], const f8[:, ::1], const f8[:, ::1], const f8[::1], const f8[::1], const f8[::1], const f8[::1], f8, "
    "f8, f8, const f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1]"
)
def _bounded(
    q: Array,
    qd: Array,
    J: Array,
    q_min: Array,
    q_max: Array,
    qd_max: Array,
    most: Array,
    most_rad: float,
    most_m: float,
    period_s: float,
    correction: Array,
    change: Array,
    wished: Array,
    now: Array,
    q_ref: Array,
    qd_ref: Array,
) -> int:
    """Write a command with a changed correction, as far as the limits allow.

    Args:
        q: (2, n) the motion's joints now and ahead, rad.
        qd: (2, n) their speeds, rad/s.
        J: (6, n) Jacobian.
        q_min: (n,) least angles, rad.
        q_max: (n,) largest angles, rad.
        qd_max: (n,) largest speeds, rad/s.
        most: (n,) largest change of the correction, rad.
        most_rad: largest correction, rad.
        most_m: largest displacement of the tool by it, m.
        period_s: in which the joints are to be there, s.
        correction: (n,) correction before, rad.
        change: (n,) change asked of it, rad.
        wished: (n,) written: the correction without limits of the angles, rad.
        now: (n,) written: the correction, rad.
        q_ref: (n,) written: the command, rad.
        qd_ref: (n,) written: its speeds, rad/s.

    Returns:
        Number of joints that a limit keeps from being corrected further; beyond n where the tool's displacement is bounded.
    """
    joints = q.shape[1]
    square, limited = 0.0, 0
    for i in range(joints):
        step = min(max(-most[i], change[i]), most[i])
        wished[i] = min(max(-most_rad, correction[i] + step), most_rad)
    for row in range(3):
        moved = 0.0
        for i in range(joints):
            moved += J[row, i] * wished[i]
        square += moved * moved
    displaced_m = math.sqrt(square)
    if displaced_m > most_m:
        limited = joints + 1
        for i in range(joints):
            wished[i] *= most_m / displaced_m
    for i in range(joints):
        q_ref[i] = min(max(q_min[i], q[1, i] + wished[i]), q_max[i])
        now[i] = q_ref[i] - q[1, i]
        qd_ref[i] = min(max(-qd_max[i], qd[1, i] + (now[i] - correction[i]) / period_s), qd_max[i])
        held = q_ref[i] != q[1, i] + wished[i]
        if held:
            qd_ref[i] = 0.0
        if held or abs(wished[i]) >= most_rad:
            limited += 1
    return limited


def whole_steps(J: Array, requested: Array, steps: Array, gaps: Array | None = None) -> Array:
    """Return the whole steps that displace the tool most nearly as requested angles would; none where that gains little.

    The nearest combination, not each joint rounded: steps of several joints make up for each other. It is a local minimum
    of the search over one joint or two by one step (the nearest point of a lattice: Babai, 1986), from rounded angles and
    from none. A joint that is first to be taken through backlash displaces the tool by what its steps leave of that. What
    is not known of backlash and displacement counts as error: joints that move on, and short ways, are preferred.

    Args:
        J: (6, n) Jacobian, m/rad and rad/rad.
        requested: (n,) angles by which the joints would have to move the tool, rad.
        steps: (n,) the joints' steps, rad; 0 has no step.
        gaps: (2, n) backlash that each joint is taken through first, upwards and downwards, rad; None for none.

    Returns:
        (n,) changes of the joints, rad.
    """
    n = len(steps)
    gaps = np.zeros((2, n)) if gaps is None else gaps
    lever, whole = np.repeat([1.0, STEP_LEVER_M], 3)[:, None] * J, steps > 0
    by = np.where(whole, steps, 1.0)
    requested_m = lever @ np.where(whole, requested, 0.0)
    weight = (lever**2).sum(axis=0)
    unsure = (GAP_SHARE * gaps) ** 2
    stiff = lever.T @ lever + np.diag(MOVE_SHARE**2 * weight + 1e-12)
    shortest = np.linalg.solve(stiff, lever.T @ requested_m)

    def counts(index: Array) -> tuple[Array, Array]:
        """Return steps (..., n) and the error (...,), m^2, that the index-th effective steps (..., n) leave."""
        gap = np.where(index > 0, gaps[0], gaps[1])
        count = np.sign(index) * (np.abs(index) + np.floor(gap / by))
        moved = np.where(whole, count * by - np.sign(index) * gap, 0.0)
        variance = np.where(index > 0, unsure[0], unsure[1]) * (index != 0) + (MOVE_SHARE * moved) ** 2
        return count, ((requested_m - moved @ lever.T) ** 2).sum(axis=-1) + variance @ weight

    ones = np.eye(n)
    pairs = [a * ones[i] + b * ones[j] for i in range(n) for j in range(i) for a in (-1, 1) for b in (-1, 1)]
    moves = np.concatenate([ones, -ones, 2 * ones, -2 * ones, np.reshape(pairs, (-1, n))]) * whole
    found = []
    for index in (np.where(whole, np.rint(shortest / by), 0.0), np.zeros(n)):
        while True:
            after = counts(index + moves)[1]
            best = int(np.argmin(after))
            if after[best] > counts(index)[1] - 1e-18:
                break
            index = index + moves[best]
        found.append((float(counts(index)[1]), index))
    left, index = min(found, key=lambda each: each[0])
    worth = WORTH_STEPS * float(np.linalg.norm((lever * by)[:3] * whole, axis=0).max())
    gains = float(np.linalg.norm(requested_m)) - math.sqrt(left) > worth
    continuous = requested + np.where(requested > 0, gaps[0], -gaps[1] * (requested < 0))
    return np.where(whole, counts(index)[0] * by if gains else 0.0, continuous)


@kernel("const f8[:, ::1], const f8[::1], const f8[:, ::1], f8[::1], f8[::1], f8[::1]")
def _by_tool(U: Array, s: Array, Vt: Array, scale: Array, error: Array, joints: Array) -> None:
    """Write the joint angles (n,) that make up for an error of the tool (6,): U (6, k), s (k,) and Vt (k, n) of an aim."""
    joints[:] = 0.0
    for k in range(len(s)):
        along = 0.0
        for row in range(6):
            along += error[row] / scale[row] * U[row, k]
        along *= _share(s[k])
        for i in range(len(joints)):
            joints[i] += along * Vt[k, i]


@kernel("f8")
def _share(s: float) -> float:
    """Return the inverse of a singular value, as far as its direction is corrected; 0 where it is not."""
    able = (s - UNCORRECTED_BELOW) / (CORRECTED_ABOVE - UNCORRECTED_BELOW)
    return min(max(able, 0.0), 1.0) / max(s, UNCORRECTED_BELOW)


def _corrected(s: Array) -> Array:
    """Return the same of singular values (k,)."""
    return np.array([_share(float(each)) for each in s])


def likely_joint_errors(arm: Arm, q: Array, T_base_tool: Array) -> Array:
    """Return the errors of joint readings q (n,), rad, that most likely explain a measured pose (4, 4) of the tool.

    The maximum a posteriori about zero: near a singular pose an exact inverse would take tens of degrees.
    """
    weights = np.repeat(1.0 / np.square(_EXPLAINED), 3)
    J, xi = arm.jacobian(q, "tool"), log_se3(inverse(arm.forward(q)) @ T_base_tool)
    JW = J.T * weights
    return np.asarray(np.linalg.solve(JW @ J + np.eye(len(q)) / _JOINT_RAD**2, JW @ xi))
