"""Travel a path of the tool: a jerk-limited share of the way over time, joints by inverse kinematics, limits at 1 kHz."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.trajectories.law import CLOSE, ROUNDS, fit_law, share_law, slower, time_of
from armsight.robot.trajectories.limits import ROUNDING, outside, start_state, worst
from armsight.robot.trajectories.path import Path
from armsight.robot.trajectories.profile import Profile
from armsight.robot.trajectories.trajectory import Joints, MotionRefused, check_duration, check_times, clamped
from armsight.robot.trajectories.walk import Obstacle, Walk, derivatives, refined, walk

if TYPE_CHECKING:
    from armsight.robot.arm import Arm

#: How far from the path a start's speeds and accelerations may point, as a share of the limits.
ALONG = 1e-6


@dataclass(frozen=True, eq=False)
class PathMotion:
    """A path of the tool over time.

    Attributes:
        arm: the arm that travels it.
        path: the path.
        law: share of the way over time.
        guide: the joints along the path, by which the right solution is told.
    """

    arm: Arm
    path: Path
    law: Profile
    guide: Walk

    @property
    def duration_s(self) -> float:
        """How long the motion takes, s."""
        return self.law.duration_s

    def at(self, t_s: float | Array) -> Joints:
        """Return the joints, (6,) or (N, 6), ``t_s`` seconds after the start."""
        times = clamped(t_s, self.duration_s)
        share, speed, acceleration = (part[:, :1] for part in self.law.at(times.ravel()))
        places = self.path.at(share[:, 0])
        q = refined(self.arm, places.T_base_tool, self.guide.near(share[:, 0]))
        q1, q2 = derivatives(self.arm, q, places)
        joints = (q, q1 * speed, q1 * acceleration + q2 * speed**2)
        return Joints(*(part.reshape(*times.shape, 6) for part in joints))


def follow(
    arm: Arm,
    path: Path,
    q_start: ArrayLike,
    *,
    qd_start: ArrayLike | None = None,
    qdd_start: ArrayLike | None = None,
    duration_s: float | None = None,
) -> PathMotion:
    """Plan to travel a path of the tool, in the configuration of the start.

    Args:
        arm: the arm.
        path: the path; its start is where ``q_start`` puts the tool.
        q_start: (6,) angles to start from, rad.
        qd_start: (6,) speeds to start with, rad/s; they must carry the tool along the path. None for rest.
        qdd_start: (6,) accelerations to start with, rad/s^2, as ``qd_start``.
        duration_s: how long it is to take, s; None for as short as the limits allow.

    Raises:
        MotionRefused: the path leaves the reach or the joint limits, or meets a singularity.
        InputError: bad numbers, a start that does not move along the path, or a duration that cannot be met.
    """
    check_duration(duration_s)
    start = start_state(arm, q_start, qd_start, qdd_start)
    guide, obstacle = walk(arm, path, start.q)
    if obstacle is not None and obstacle.share == 0:
        raise _refused(path, obstacle, 0.0)
    share = _share_state(start, guide, arm)
    if obstacle is not None:
        law, _ = fit_law(arm, Walk(*(part[: obstacle.clear] for part in guide)), share, None)
        scale = 1.0 if duration_s is None else duration_s / law.duration_s
        raise _refused(path, obstacle, scale * time_of(law, obstacle.share))
    law, limits = fit_law(arm, guide, share, duration_s)
    for _ in range(ROUNDS):
        motion = PathMotion(arm, path, law, guide)
        t_s = check_times(law.duration_s)
        joints = motion.at(t_s)
        _check_whole(arm, path, motion, t_s, joints)
        most = worst(arm, t_s, joints)
        if most.ratio <= 1 + ROUNDING:
            return motion
        if duration_s is not None or start.qd.any():
            at_s = float(t_s[most.row])
            raise _refused(path, Obstacle(float(law.at(at_s).q[0]), most.what), at_s)
        limits = slower(limits, most.stretch * (1 + CLOSE / 10))
        law = share_law(share, limits)
    raise InputError("the motion could not be brought within the arm's limits of speed, acceleration and jerk")


def _refused(path: Path, obstacle: Obstacle, t_s: float) -> MotionRefused:
    """Return the refusal of a motion at an obstacle."""
    p_base = path.at(np.array([obstacle.share])).T_base_tool[0, :3, 3]
    return MotionRefused(obstacle.reason, share=obstacle.share, t_s=t_s, p_base=p_base)


def _share_state(start: Joints, guide: Walk, arm: Arm) -> Joints:
    """Return the start as share, its speed and its acceleration (1,)."""
    along, bend = guide.q1[0], guide.q2[0]
    speed = float(along @ start.qd / (along @ along))
    acceleration = float(along @ (start.qdd - bend * speed**2) / (along @ along))
    for name, value, wanted, limit in (
        ("qd_start", start.qd, along * speed, arm.qd_max),
        ("qdd_start", start.qdd, along * acceleration + bend * speed**2, arm.qdd_max),
    ):
        if (np.abs(value - wanted) > ALONG * limit).any():
            raise InputError(f"{name} does not carry the tool along the path: give speeds that do, or start from rest")
    if speed < 0:
        raise InputError("qd_start carries the tool backwards on the path")
    return Joints(np.zeros(1), np.array([speed]), np.array([acceleration]))


def _check_whole(arm: Arm, path: Path, motion: PathMotion, t_s: Array, joints: Joints) -> None:
    """Refuse a motion whose joints leave their limits or jump from one configuration to another."""
    steps = np.diff(t_s)[:, None]
    moved = np.diff(joints.q, axis=0) - steps * (joints.qd[1:] + joints.qd[:-1]) / 2
    jumps = np.append((np.abs(moved) > steps**2 * arm.qdd_max + ROUNDING).any(axis=1), False)
    reasons = [outside(arm, row) for row in joints.q]
    row = next((i for i, reason in enumerate(reasons) if reason is not None or jumps[i]), None)
    if row is not None:
        reason = reasons[row] or "the arm would have to change its configuration"
        share = float(motion.law.at(float(t_s[row])).q[0])
        raise _refused(path, Obstacle(share, reason), float(t_s[row]))
