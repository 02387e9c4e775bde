"""A trajectory read from a table, for loops that ask every few milliseconds: inverse kinematics is paid for at once."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PPoly

from armsight.data import Array
from armsight.robot.trajectories.trajectory import Joints, Trajectory, clamped

#: Samples are so far apart, s. Between them runs the polynomial of fifth degree through angles, speeds and accelerations on
#: both sides: of motions that arms make it is off by some ten nanoradians, where the jerk jumps.
STEP_S = 0.004


class Tabled:
    """Another trajectory, looked up. A trajectory."""

    def __init__(self, motion: Trajectory) -> None:
        """Fill the table."""
        self.duration_s = motion.duration_s  #: how long the motion takes, s
        last = max(self.duration_s, STEP_S)  # a motion that takes no time stands
        t_s = np.append(np.arange(0.0, last - 1e-9, STEP_S), last)
        q, qd, qdd = motion.at(t_s)
        h = np.diff(t_s)[:, None]
        rise = q[1:] - q[:-1] - h * qd[:-1] - 0.5 * h**2 * qdd[:-1]
        gain = (qd[1:] - qd[:-1] - h * qdd[:-1]) * h
        bend = (qdd[1:] - qdd[:-1]) * h**2
        cubic, quartic = 10 * rise - 4 * gain + 0.5 * bend, -15 * rise + 7 * gain - bend
        quintic = 6 * rise - 3 * gain + 0.5 * bend
        parts = (quintic / h**5, quartic / h**4, cubic / h**3, 0.5 * qdd[:-1], qd[:-1], q[:-1])
        self._pieces = PPoly(np.stack(parts), t_s)

    def at(self, t_s: float | Array) -> Joints:
        """Return the joints, (n,) or (N, n), ``t_s`` seconds after the start."""
        times = clamped(t_s, self.duration_s)
        return Joints(*(self._pieces(times, order) for order in range(3)))
