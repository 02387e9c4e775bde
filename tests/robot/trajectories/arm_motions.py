"""What the tests of motions share: an ordinary start and goal of every arm, and the limits held by finite differences."""

import numpy as np

from armsight.geometry.pose import pose
from armsight.geometry.rotation import exp_so3
from armsight.robot.models import MODELS
from armsight.robot.trajectories import TRAJECTORIES
from armsight.robot.trajectories.line import LinePath
from armsight.robot.trajectories.trajectory import check_times

#: Joint angles, deg, away from limits and singularities, around which the tool has room.
START_DEG = {
    "six_r": (10, -100, 100, -20, -70, 5),
    "puma560": (0, 60, -150, 20, 60, 10),
    "ur5": (0, -90, 90, -80, -90, 20),
    "ur10": (0, -90, 90, -80, -90, 20),
    "irb120": (10, 0, 0, 10, 60, 0),
    "franka": (0, -30, 10, -110, 5, 90, 30),
}


def start(name):
    return np.radians(START_DEG[name])


def shifted(T, step, rotation=(0.0, 0.0, 0.0)):
    """A pose moved in base axes, and rotated about them where it is."""
    return pose(exp_so3(np.array(rotation)) @ T[:3, :3], T[:3, 3] + step)


def ordinary(member, name, q_start=None):
    """An ordinary motion of every member of the registry on every arm; from elsewhere where asked."""
    arm, q = MODELS[name], start(name)
    T = arm.forward(q)
    goal = shifted(T, [0.03, 0.04, -0.03], [0.1, -0.2, 0.15])
    rest = {
        "point_to_point": (q + 0.3,),
        "line": (goal,),
        "circle": (T[:3, 3] + [0.03, 0, 0], [0, 0.3, 1.0], -4.0),
        "arc": (T[:3, 3] + [0.0, 0.03, 0.01], goal),
        "waypoints": ([shifted(T, [0.0, 0.05, 0.0]), shifted(T, [0.0, 0.05, -0.05], [0, 0, 0.2]), goal],),
        "resolved_rate": (LinePath.between(T, goal),),
    }[member]
    options = {"blend_m": 0.01} if member == "waypoints" else {}
    return TRAJECTORIES[member](arm, q if q_start is None else q_start, *rest, **options)


def within(arm, motion):
    """Hold a motion against every limit, by its own derivatives and by finite differences of its angles."""
    t = check_times(motion.duration_s)
    q, qd, qdd = motion.at(t)
    assert (q >= arm.q_min - 1e-9).all()
    assert (q <= arm.q_max + 1e-9).all()
    assert (np.abs(qd) <= arm.qd_max * (1 + 1e-8)).all()
    assert (np.abs(qdd) <= arm.qdd_max * (1 + 1e-8)).all()
    h = np.diff(t)[:, None]
    full = h[:, 0] > 5e-4
    assert (np.abs(np.diff(qdd, axis=0))[full] <= (h * arm.qddd_max * (1 + 1e-6) + 1e-9)[full]).all()
    # Over a step the angles move by the mean of the speeds, but for what a jerk within its limit adds: h^3 j / 12; and the
    # speeds by the mean of the accelerations, but for what a jerk that changes once in between adds: h^2 j / 2.
    moved = np.diff(q, axis=0) - h * (qd[1:] + qd[:-1]) / 2
    assert (np.abs(moved) <= h**3 * arm.qddd_max / 6 + 1e-11).all()
    gained = np.diff(qd, axis=0) - h * (qdd[1:] + qdd[:-1]) / 2
    assert (np.abs(gained) <= h**2 * arm.qddd_max / 2 + 1e-9).all()
