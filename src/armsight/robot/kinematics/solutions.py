"""The result of inverse kinematics: all joint angles of a pose, or the nearest pose.

A pose out of reach, or one where a joint is not determined, is a result with a reason, not an error.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.robot.kinematics.closed import OUTSIDE
from armsight.robot.kinematics.inverse import ANGLE, CONFIGURATION, POSITION, STATE, WIDTH

#: Columns of a row after its joint angles, and where they stand counted from its end.
ROW_END = WIDTH - POSITION
_POSITION, _ANGLE, _CONFIGURATION, _STATE = (column - WIDTH for column in (POSITION, ANGLE, CONFIGURATION, STATE))


@dataclass(frozen=True)
class Configuration:
    """Which of the up to eight ways an arm takes to a pose; see the documentation's page on the arm."""

    #: "front" where the wrist is ahead of axis 1 along link 1's x axis, "back" where the arm reaches over
    shoulder: Literal["front", "back"]
    #: "up" where the elbow is above the line from shoulder to wrist, seen with the wrist ahead
    elbow: Literal["up", "down"]
    wrist: Literal["noflip", "flip"]  #: "noflip" where sin(theta_5) is positive or 0, "flip" where it is negative


@dataclass(frozen=True, eq=False)
class Nearest(Record):
    """The pose within the joints' limits that comes closest to one that cannot be reached.

    1 mm of position counts as much as 1 mrad of orientation.
    """

    q: Array  #: (n,) joint angles, rad
    T_base_tool: Array  #: (4, 4) where they bring the tool, m
    off_m: float  #: how far that is from the requested position, m
    off_rad: float  #: how far it is rotated from the requested orientation, rad


@dataclass(frozen=True, eq=False)
class Solutions:
    """All joint angles that bring the tool to a pose; none of them twice.

    Those within limits come first; then by distance from ``near`` where that was given. The columns of one table, which
    is the quick way to make a record.
    """

    #: (N, n + 7) a row for each solution: its joint angles, then the columns that ``kinematics.inverse`` names; the
    #: properties return them
    rows: Array
    #: what is special about the result: "singular: ...", "outside limits: ...", "unreachable: ..."; None where nothing
    #: does
    reason: str | None = None
    #: how to find ``nearest``; None where a solution is within limits
    find_nearest: Callable[[], Nearest] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Make the table read-only."""
        self.rows.flags.writeable = False

    @cached_property
    def nearest(self) -> Nearest | None:
        """Where no solution is within limits, the closest pose that is; found when first asked for, in milliseconds."""
        return self.find_nearest() if self.find_nearest else None

    def __repr__(self) -> str:
        """Return how many there are, and the joint angles of each, degrees."""
        said = [f"{len(self)} solutions", *([self.reason] if self.reason else [])]
        rows = ["  ".join(f"{angle:8.3f}" for angle in np.degrees(q)) for q in self.q]
        return (
            f"Solutions({'; '.join(said)}{'; q in degrees:' if rows else ''}{''.join(f'{chr(10)}  {r}' for r in rows)})"
        )

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.rows)

    @property
    def q(self) -> Array:
        """(N, n) joint angles, rad, moved by whole revolutions into the joint's limits where that can be."""
        return self.rows[:, :_POSITION]

    @property
    def residual_m(self) -> Array:
        """(N,) distance of the tool from the requested position, m."""
        return self.rows[:, _POSITION]

    @property
    def residual_rad(self) -> Array:
        """(N,) angle between the tool and the requested orientation, rad."""
        return self.rows[:, _ANGLE]

    @property
    def signs(self) -> Array:
        """(N, 3) shoulder, elbow, wrist as +-1 (front, up, noflip: +1); 0 where the arm has no such structure."""
        return self.rows[:, _CONFIGURATION:_STATE]

    @property
    def within_limits(self) -> NDArray[np.bool_]:
        """(N,) whether every joint is within its limits."""
        return np.asarray(self.rows[:, _STATE] < OUTSIDE)

    @property
    def singular(self) -> NDArray[np.bool_]:
        """(N,) whether a joint is not determined, or two solutions are one."""
        return np.asarray(self.rows[:, _STATE] % OUTSIDE > 0)

    @property
    def best(self) -> Array | None:
        """(n,) the first solution, rad, if it is within limits; else None, for then none is."""
        return self.rows[0, :_POSITION] if len(self.rows) and self.rows[0, _STATE] < OUTSIDE else None

    @property
    def configurations(self) -> tuple[Configuration | None, ...]:
        """One for each solution; None where the arm has no such structure."""
        return tuple(_configuration(*signs) for signs in self.signs.tolist())


def _configuration(shoulder: float, elbow: float, wrist: float) -> Configuration | None:
    if shoulder == 0:
        return None
    return Configuration(
        "front" if shoulder > 0 else "back", "up" if elbow > 0 else "down", "noflip" if wrist > 0 else "flip"
    )


@dataclass(frozen=True, eq=False)
class ManySolutions(Record):
    """The solutions of many poses; what stands beyond a pose's count is 0."""

    count: Ids  #: (N,) how many solutions each pose has
    q: Array  #: (N, M, n) joint angles, rad, those within limits first
    residual_m: Array  #: (N, M) as in :class:`Solutions`
    residual_rad: Array  #: (N, M) likewise
    within_limits: NDArray[np.bool_]  #: (N, M) likewise
    singular: NDArray[np.bool_]  #: (N, M) likewise
    signs: Array  #: (N, M, 3) likewise

    @staticmethod
    def of(counts: Ids, rows: Array) -> ManySolutions:
        """Return the solutions of counts (N,) and rows (N, M, n + 6): those of :class:`Solutions`, without the key."""
        joints = rows.shape[2] - ROW_END + 1
        there = np.arange(rows.shape[1]) < counts[:, None]
        by = rows[:, :, joints:]
        state = by[:, :, STATE - POSITION]
        return ManySolutions(
            counts,
            rows[:, :, :joints],
            by[:, :, 0],
            by[:, :, ANGLE - POSITION],
            (state < OUTSIDE) & there,
            state % OUTSIDE > 0,
            by[:, :, CONFIGURATION - POSITION : STATE - POSITION],
        )


def many_solutions(found: list[Array], joints: int) -> ManySolutions:
    """Return the solutions of many poses from the rows of each."""
    out = np.zeros((len(found), max((len(rows) for rows in found), default=0), joints + ROW_END - 1))
    for k, rows in enumerate(found):
        out[k, : len(rows)] = rows[:, :-1]
    return ManySolutions.of(np.array([len(rows) for rows in found], dtype=np.int64), out)
