"""What is known of a body's motion between two shots: where it should be next."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from armsight.data import Array, Record
from armsight.vision.posefit import moved

#: A prediction older than so many shots, or so many times the time between the last two poses, is none; poses nearer to
#: each other than so many seconds tell no velocity.
_OLDEST_SHOTS, _OLDEST_STEPS, LEAST_S = 3, 4.0, 1e-6


@dataclass(frozen=True, eq=False)
class Track(Record):
    """What is known of a body's motion.

    Attributes:
        T_left_body: (4, 4) last pose.
        twist: (6,) its velocity in the body's axes, per second, or per shot where shots carry no time.
        t_s: time of the last pose, or the number of its shot.
        shots: how many shots ago it was seen.
        margin_px: how far off predictions may be.
        step_s: from the pose before to the last; infinite where the twist is not known.
        proven: whether the motion has foretold a pose before; what is far from it then is a jump.
    """

    T_left_body: Array
    twist: Array
    t_s: float
    shots: int
    margin_px: float
    step_s: float
    proven: bool

    def foretells(self, t_s: float) -> bool:
        """Whether it is known where to look at a time: not before the last pose, nor too long after."""
        since = t_s - self.t_s
        return self.shots < _OLDEST_SHOTS and LEAST_S <= since < math.inf and since <= _OLDEST_STEPS * self.step_s

    def predicted(self, t_s: float) -> Array:
        """Return the pose (4, 4) at a time."""
        T = np.empty((4, 4))
        moved(self.T_left_body, self.twist * (t_s - self.t_s), T)
        return T
