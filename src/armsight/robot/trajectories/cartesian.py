"""Travel a path of the tool: a jerk-limited share of the way over time, joints by inverse kinematics, limits at 1 kHz.

In: an arm and a path, at whose begin it rests. Out: a :class:`PathMotion`, checked; or :class:`MotionRejected`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from armsight.data import Array
from armsight.errors import InputError
from armsight.robot.trajectories.law import CLOSE, Law, fit_chain, fit_law, time_of
from armsight.robot.trajectories.limits import ROUNDING, Worst, inside, outside, worst
from armsight.robot.trajectories.lookahead import Obstacle, Walk, derivatives, refined, walk
from armsight.robot.trajectories.path import Path
from armsight.robot.trajectories.trajectory import Joints, MotionRejected, check_duration, check_times, clamped, pieces

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm


@dataclass(frozen=True, eq=False)
class PathMotion:
    """A path of the tool over time."""

    arm: Arm  #: the arm that travels it
    path: Path  #: the path
    law: Law  #: share of the way over time
    guide: Walk  #: the joints along the path, near which the inverse kinematics takes its solution

    @property
    def duration_s(self) -> float:
        """How long the motion takes, s."""
        return self.law.duration_s

    def at(self, t_s: float | Array) -> Joints:
        """Return the joints, (n,) or (N, n), ``t_s`` seconds after the start."""
        times = clamped(t_s, self.duration_s)
        share, speed, acceleration = (part[:, :1] for part in self.law.at(times.ravel()))
        points = self.path.at(share[:, 0])
        q = refined(self.arm, points.T_base_tool, self.guide.near(share[:, 0]))
        q1, q2 = derivatives(self.arm, q, points)
        joints = (q, q1 * speed, q1 * acceleration + q2 * speed**2)
        return Joints(*(part.reshape(*times.shape, self.arm.joints) for part in joints))


def follow(
    arm: Arm, path: Path, q_start: ArrayLike, *, duration_s: float | None = None, cruises: Array | None = None
) -> PathMotion:
    """Plan to travel a path of the tool that begins where ``q_start`` puts it, in the configuration of the start.

    ``q_start``: (n,) angles to start from, rad. ``duration_s``: how long it is to take, s; None for as short as the limits
    allow. ``cruises``: (C, 2) shares between which the pace is to be steady: the bends of the path. None for none. Raises
    MotionRejected: the path leaves the reach or the joint limits, or meets a singularity; InputError: bad numbers, or a
    duration that cannot be met.
    """
    check_duration(duration_s)
    guide, obstacle = walk(arm, path, inside(arm, q_start, "q_start"), np.zeros((0, 2)) if cruises is None else cruises)
    if obstacle is not None and obstacle.share == 0:
        raise _rejection(path, obstacle, 0.0)
    law: Law
    if obstacle is not None:
        clear = Walk(*(part[: obstacle.clear] for part in guide))
        law = fit_law(arm, clear) if cruises is None else fit_chain(arm, clear, cruises)
        scale = 1.0 if duration_s is None else duration_s / law.duration_s
        raise _rejection(path, obstacle, scale * time_of(law, obstacle.share))
    law = fit_law(arm, guide) if cruises is None else fit_chain(arm, guide, cruises)
    motion = PathMotion(arm, path, law, guide)
    while (most := _check_whole(motion)).ratio > 1 + ROUNDING:
        motion = replace(motion, law=motion.law.slower(most.time_scale * (1 + CLOSE / 10)))
    return motion if duration_s is None else _lasting(motion, duration_s)


def _lasting(shortest: PathMotion, duration_s: float) -> PathMotion:
    """Return a motion from rest slowed down to a duration, or raise InputError: that is shorter than the shortest."""
    k = duration_s / shortest.duration_s
    motion = replace(shortest, law=shortest.law.slower(k)) if k >= 1 else shortest
    if k < 1 or _check_whole(motion).ratio > 1 + ROUNDING:
        # Rounded up, so that what is read here can be asked for.
        shortest_s = np.ceil(1e4 * (1 + CLOSE / 10) * shortest.duration_s) / 1e4
        raise InputError(
            f"duration_s is {duration_s:.6g}; within the arm's limits this motion takes {shortest_s:.6g} s"
        )
    return motion


def _rejection(path: Path, obstacle: Obstacle, t_s: float) -> MotionRejected:
    p_base = path.at(np.array([obstacle.share])).T_base_tool[0, :3, 3]
    return MotionRejected(obstacle.reason, share=obstacle.share, t_s=t_s, p_base=p_base)


def _check_whole(motion: PathMotion) -> Worst:
    """Return where a motion comes nearest to a limit of speed, acceleration or jerk at 1 kHz.

    MotionRejected: its joints leave their limits or jump from one configuration to another.
    """
    return max(
        (_check_piece(motion, t_s) for t_s in pieces(check_times(motion.duration_s))), key=lambda w: w.time_scale
    )


def _check_piece(motion: PathMotion, t_s: Array) -> Worst:
    """Do for times (N,) what :func:`_check_whole` does for the whole."""
    arm, joints = motion.arm, motion.at(t_s)
    steps = np.diff(t_s)[:, None]
    moved = np.diff(joints.q, axis=0) - steps * (joints.qd[1:] + joints.qd[:-1]) / 2
    jumps = np.append((np.abs(moved) > steps**2 * arm.qdd_max + ROUNDING).any(axis=1), False)
    beyond = np.maximum(arm.q_min - joints.q, joints.q - arm.q_max).max(axis=1) > ROUNDING
    if (bad := beyond | jumps).any():
        row = int(np.argmax(bad))
        reason = outside(arm, joints.q[row]) or "the arm would have to change its configuration"
        at_s = float(t_s[row])
        raise _rejection(motion.path, Obstacle(float(motion.law.at(at_s).q[0]), reason), at_s)
    return worst(arm, t_s, joints)
