"""The input of an identification: joint angles, and where an instrument measured the tool.

The instrument's frame is called rig whatever it is (a stereo rig, a laser tracker). Either K points of the tool were
tracked, or one body's full pose, or how far one point is from a fixed anchor (a draw-wire's length), which then is
the rig's origin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from armsight.data import Array, Record
from armsight.errors import InputError, require
from armsight.geometry.check import checked

Rows = NDArray[np.bool_] | NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Measured(Record):
    """Joint angles, and where the tool was measured at them.

    Attributes:
        q: (N, n) joint angles as the joints' sensors read them, rad.
        p_rig: (N, K, 3) tracked points, m; K is 1 with full poses (the body's origin).
        R_rig_body: (N, 3, 3) rotation of the body in the rig, with full poses; None with points only.
        cov: (N, M, M) covariance of what was seen; None where not known. Points: M = 3 K, along the rig's axes, m^2.
            Poses: M = 6, of the right tangent [translation; rotation], as ``PoseEstimate.cov``.
        approach: (N, n) from which side each joint came to rest: +1 while its angle grew, -1 while it fell, 0 unknown;
            None where nothing is known.
        angles_deg: (N, 3) rx, ry, rz as in the file, degrees, where the rotations came as angles; None else.
        rotation: the convention that these were read in, such as "zyx"; "" else.
        length_m: (N,) distance of the one point from the rig's origin, m, where only that was measured; ``p_rig`` is
            then unused.
    """

    q: Array
    p_rig: Array
    R_rig_body: Array | None = None
    cov: Array | None = None
    approach: Array | None = None
    angles_deg: Array | None = None
    rotation: str = ""
    length_m: Array | None = None

    def __post_init__(self) -> None:
        """Check shapes.

        Raises:
            InputError: shapes that do not belong together, or NaN.
        """
        n = len(checked(self.q, (None, None), "q"))
        k = checked(self.p_rig, (n, None, 3), "p_rig").shape[1]
        if self.R_rig_body is not None:
            checked(self.R_rig_body, (n, 3, 3), "R_rig_body")
            if k != 1:
                raise InputError(f"with full poses p_rig holds one point a row, the body's origin; got {k}")
        if self.length_m is not None:
            checked(self.length_m, (n,), "length_m")
            if k != 1 or self.R_rig_body is not None:
                raise InputError(f"a length is of one point without a pose; p_rig has {k} points")
        if self.cov is not None:
            checked(self.cov, (n, self.size, self.size), "cov")
        if self.approach is not None:
            checked(self.approach, self.q.shape, "approach")
        super().__post_init__()

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.q)

    @property
    def points(self) -> int:
        """K, how many points were tracked."""
        return int(self.p_rig.shape[1])

    @property
    def size(self) -> int:
        """M, how many numbers were measured at each pose."""
        return 1 if self.length_m is not None else 6 if self.R_rig_body is not None else 3 * self.points

    def rows(self, rows: Rows) -> Measured:
        """Return a part of the poses."""
        own = (self.R_rig_body, self.cov, self.approach, self.angles_deg, self.length_m)
        R, cov, approach, angles, length = (None if a is None else a[rows] for a in own)
        return Measured(self.q[rows], self.p_rig[rows], R, cov, approach, angles, self.rotation, length)


SAME_RAD = 5e-3  # poses whose joints all read within this, rad, of each other's are one pose, visited again


def visits(q: Array) -> NDArray[np.int64]:
    """Return the pose (N,) that each row of joint angles (N, n) is a visit of, from 0 in the order of the rows.

    What is left out to evaluate a fit is left out with all of its visits: one that stays in would give it away.
    """
    near = cKDTree(q).query_pairs(SAME_RAD, p=np.inf, output_type="ndarray")
    graph = coo_array((np.ones(len(near)), (near[:, 0], near[:, 1])), shape=(len(q), len(q)))
    _, first, which = np.unique(connected_components(graph, directed=False)[1], return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(first))[which], np.int64)


class Read(NamedTuple):
    """The contents of a file.

    Attributes:
        measured: its good rows.
        lines: (N,) the line of the file that each row comes from.
        notes: what was left out, and why, as text.
    """

    measured: Measured
    lines: Array
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        """Return how many poses of how many joints there are, and the notes."""
        seen = "points" if self.measured.R_rig_body is None else "full poses"
        return f"Read({len(self.measured)} {seen} of {self.measured.q.shape[1]} joints; notes={self.notes!r})"


def measured_of(call: str, poses: Measured | Read, name: str = "measured") -> Measured:
    """Return the poses of what was read.

    Raises:
        InputError: it is neither.
    """
    poses = poses.measured if isinstance(poses, Read) else poses
    require(call, name, poses, isinstance(poses, Measured), 'read_poses("poses.csv")')
    return poses
