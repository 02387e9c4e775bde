"""From one set of joint angles to another: jerk-limited, all joints arriving together, as fast as their limits allow."""

from __future__ import annotations

from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from armsight.robot.trajectories.limits import check_limits, inside, start_state
from armsight.robot.trajectories.profile import Profile, plan_profile
from armsight.robot.trajectories.trajectory import check_duration

if TYPE_CHECKING:
    from armsight.robot.kinematics.arm import Arm


def point_to_point(
    arm: Arm,
    q_start: ArrayLike,
    q_goal: ArrayLike,
    *,
    qd_start: ArrayLike | None = None,
    qdd_start: ArrayLike | None = None,
    duration_s: float | None = None,
) -> Profile:
    """Plan a motion in joints that ends at rest.

    From rest the joints move in proportion, straight in joint space; from a moving state they only arrive together.

    ``q_start``: (n,) angles to start from, rad. ``q_goal``: (n,) angles to end at, rad. ``qd_start``: (n,) speeds to start
    with, rad/s; None for rest. ``qdd_start``: (n,) accelerations to start with, rad/s^2; None for none. ``duration_s``: how
    long it is to take, s; None for as short as the limits allow. Raises MotionRejected: a moving start carries a joint
    through its limit before it can reverse; InputError: a state outside the limits, or a duration that cannot be met.
    """
    start = start_state(arm, q_start, qd_start, qdd_start)
    goal = inside(arm, q_goal, "q_goal")
    planned = plan_profile(start, goal, arm.qd_max, arm.qdd_max, arm.qddd_max, check_duration(duration_s))
    check_limits(arm, planned)
    return planned
