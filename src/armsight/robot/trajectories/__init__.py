"""Motions: joint angles over time, known and checked against every limit before the first step.

In: an arm, joint angles to start from, rad, and a goal, path or way-points. Out: a :class:`Trajectory`; or
:class:`MotionRejected`, which says where and why it cannot be made.

- ``trajectory``: the contract; ``limits``: the check against the arm's limits; ``profile``: jerk-limited profiles;
- ``point_to_point``: in joints; ``tabled``: another trajectory as a table, quick to look up;
- ``path``, ``line``, ``circle``, ``waypoints``: paths of the tool in space;
- ``cartesian``: travels such a path exactly, by ``lookahead`` (the joints along it) and ``law`` (how fast);
- ``resolved_rate``: travels it through the Jacobian, past singularities too.
"""

from __future__ import annotations

from collections.abc import Callable

from armsight.robot.trajectories.circle import arc, circle
from armsight.robot.trajectories.line import line
from armsight.robot.trajectories.point_to_point import point_to_point
from armsight.robot.trajectories.resolved_rate import resolved_rate
from armsight.robot.trajectories.tabled import Tabled
from armsight.robot.trajectories.trajectory import Joints, MotionRejected, Trajectory
from armsight.robot.trajectories.waypoints import waypoints

__all__ = [
    "TRAJECTORIES",
    "Joints",
    "MotionRejected",
    "Tabled",
    "Trajectory",
    "arc",
    "circle",
    "line",
    "point_to_point",
    "resolved_rate",
    "waypoints",
]

#: Every way to make a trajectory; each takes the arm and the joint angles to start from, and then what it needs.
TRAJECTORIES: dict[str, Callable[..., Trajectory]] = {
    "arc": arc,
    "circle": circle,
    "line": line,
    "point_to_point": point_to_point,
    "resolved_rate": resolved_rate,
    "waypoints": waypoints,
}
