"""The contract of a trajectory: joint angles over time, known and checked before the first step is taken.

A member of this family is a function ``(arm, q_start, ...) -> Trajectory``. It checks the whole motion first, at 1 kHz,
and raises :class:`MotionRejected` with the position and the time where a limit of the arm would be passed, so that the
trajectory that it returns can be run as it is. To write a new one: return a frozen object with ``duration_s`` and ``at``,
hand it to :func:`armsight.robot.trajectories.limits.check_limits`, and add it to the registry in ``__init__``.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from armsight.data import Array
from armsight.errors import InputError

CHECK_RATE_HZ = 1000.0  # every trajectory is checked at this rate when it is made, Hz
LONGEST_S = 3600.0  # the longest motion that may be asked for, s: it is looked through at that rate
PIECE = 20_000  # how many instants are looked at together


class Joints(NamedTuple):
    """The joints at an instant, or at N of them with a leading axis."""

    q: Array  #: (n,) or (N, n) angles, rad
    qd: Array  #: the same of the speeds, rad/s
    qdd: Array  #: the same of the accelerations, rad/s^2


class Trajectory(Protocol):
    """Joint angles over time; ends at rest."""

    @property
    def duration_s(self) -> float:
        """How long the motion takes, s."""

    def at(self, t_s: float | Array) -> Joints:
        """Return the joints ``t_s`` seconds after the start, at one time or at (N,) of them.

        Before the start the first state stands, after the end the last.
        """


class MotionRejected(InputError):
    """A motion that cannot be made, found before it starts.

    Attributes:
        reason: what is in the way.
        share: how much of the way lies before it, 0 to 1: of the path in space, of the time for motions in joints.
        t_s: when the motion would be there, s.
        p_base: (3,) where the tool would be, m, base frame.
    """

    def __init__(self, reason: str, *, share: float, t_s: float, p_base: Array) -> None:
        self.reason, self.share, self.t_s, self.p_base = reason, share, t_s, p_base
        x, y, z = 1e3 * p_base
        super().__init__(
            f"the motion cannot be made: {reason}; {100 * share:.1f} % of the way, {t_s:.3f} s after the start, "
            f"tool at ({x:.1f}, {y:.1f}, {z:.1f}) mm"
        )


def clamped(t_s: float | Array, duration_s: float) -> Array:
    """Return times, () or (N,), within the motion, or raise InputError: not a number."""
    times = np.asarray(t_s, dtype=np.float64)
    if not np.isfinite(times).all():
        raise InputError(f"t_s is {t_s}; it must be a finite number of seconds")
    return np.clip(times, 0.0, duration_s)


def check_duration(duration_s: float | None, longest_s: float = LONGEST_S) -> float | None:
    """Return a duration that was asked for; None stands for none.

    Raises InputError: no positive number, or too long to be looked through.
    """
    if duration_s is not None and not (np.isfinite(duration_s) and duration_s > 0):
        raise InputError(
            f"duration_s is {duration_s}; it must be a positive number of seconds, or None for the shortest"
        )
    if duration_s is not None and duration_s > longest_s:
        raise InputError(f"duration_s is {duration_s:g}; a motion of more than {longest_s:g} s is not planned in one")
    return duration_s


def check_times(duration_s: float) -> Array:
    """Return (N,) the times at which a motion is checked, s: 1 kHz, its first and its last instant."""
    return np.append(np.arange(0.0, duration_s, 1 / CHECK_RATE_HZ), duration_s)


def pieces(t_s: Array) -> list[Array]:
    """Split times (N,) into pieces of about :data:`PIECE`, each beginning with the last instant of the one before."""
    edges = np.linspace(0, len(t_s) - 1, max(1, len(t_s) // PIECE) + 1).astype(int)
    return [t_s[begin : end + 1] for begin, end in pairwise(edges.tolist())]
