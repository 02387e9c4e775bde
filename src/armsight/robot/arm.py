"""Arm: a Denavit-Hartenberg table that knows where its tool is, how it moves, and which joints bring it to a pose.

In: joint angles, rad, or a requested pose T_base_tool, m. Out: poses ``T_base_tool``, Jacobians, :class:`Solutions`. The
functions in ``kinematics`` do the work; here is what is checked once at the public door: joint angles and poses are copied
into new arrays, so that the kernels see one type only, and rejected with the reason. The kernels look at every number.
Conventions: the documentation's page on the arm.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, fields
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.rotation import log_so3
from armsight.robot.kinematics import chain, inverse
from armsight.robot.kinematics.closed import ELBOW, SHOULDER, WRIST
from armsight.robot.kinematics.inverse import ANGLE, CONFIGURATION, KEY, MOST, OUTSIDE, POSITION, STATE, WIDTH
from armsight.robot.kinematics.structure import NEITHER, PARALLEL, recognised
from armsight.robot.kinematics.table import BASE, KIND, link, packed
from armsight.robot.solutions import ManySolutions, Nearest, Solutions

#: Axes further apart than this, rad, are not meant to be parallel.
TILT_RAD = np.deg2rad(3.0)
_A, _D, _COS, _SIN, _OFFSET, _DIRECTION = range(6)
#: What an error adds where angles are too large for radians.
DEGREES = "are these degrees? give radians: numpy.deg2rad(...)"
Convention = Literal["standard", "modified"]
Axes = Literal["base", "tool"]
_AXES = {"base": False, "tool": True}


def _six(value: float) -> Array:
    return np.full(6, value)


@dataclass(frozen=True, eq=False)
class Arm(Record):
    """An arm of six revolute joints: its Denavit-Hartenberg table, its limits and its names.

    Joint i rotates by ``theta_i = direction_i * q_i + offset_i``. The tool is at
    ``T_base_tool = T_base_0 @ A_1 @ ... @ A_6 @ T_flange_tool``; the flange is frame 6 of the table.

    Attributes:
        name: what the arm is called.
        a: (6,) link lengths, m.
        d: (6,) link offsets, m.
        alpha: (6,) link twists, rad.
        q_min: (6,) lower limits of the joints, rad.
        q_max: (6,) upper limits, rad.
        qd_max: (6,) greatest speeds, rad/s.
        qdd_max: (6,) greatest accelerations, rad/s^2.
        qddd_max: (6,) greatest jerks, rad/s^3.
        offset: (6,) added to the joint angles, rad.
        direction: (6,) +1 or -1, by which the joint angles are multiplied.
        home: (6,) the joint angles to start from, rad.
        convention: "standard", Rz(theta) Tz(d) Tx(a) Rx(alpha) a row, or "modified", Rx(alpha) Tx(a) Rz(theta) Tz(d).
        T_base_0: (4, 4) where the table's frame 0 sits in the base.
        T_flange_tool: (4, 4) where the tool sits on the flange.
        joint_names: six names.
        source: where the numbers come from.
    """

    name: str
    a: Array
    d: Array
    alpha: Array
    q_min: Array
    q_max: Array
    qd_max: Array
    qdd_max: Array
    qddd_max: Array
    offset: Array = field(default_factory=lambda: _six(0.0))
    direction: Array = field(default_factory=lambda: _six(1.0))
    home: Array = field(default_factory=lambda: _six(0.0))
    convention: Convention = "standard"
    T_base_0: Array = field(default_factory=lambda: np.eye(4))
    T_flange_tool: Array = field(default_factory=lambda: np.eye(4))
    joint_names: tuple[str, ...] = tuple(f"joint{i}" for i in range(1, 7))
    source: str = ""
    table: Array = field(init=False, repr=False)
    _closed: Array = field(init=False, repr=False)
    _limits: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the numbers and pack them for the kernels.

        Raises:
            InputError: a wrong shape, a value that is not finite, or a limit that is not positive.
        """
        for at in fields(self):
            if at.type == "Array" and at.init:
                shape = (4, 4) if at.name.startswith("T_") else (6,)
                value = checked(getattr(self, at.name), shape, f"{self.name}: {at.name}").copy()
                object.__setattr__(self, at.name, value)
        self._check()
        table = packed(
            self.a,
            self.d,
            self.alpha,
            self.offset,
            self.direction,
            self.T_base_0,
            self.T_flange_tool,
            modified=self.convention == "modified",
        )
        closed, exact = recognised(table)
        if not exact:
            closed, _ = recognised(untilted(table))
        table[KIND] = closed[KIND] if exact else NEITHER
        object.__setattr__(self, "table", table)
        object.__setattr__(self, "_closed", closed)
        object.__setattr__(self, "_limits", np.stack([self.q_min, self.q_max]))
        super().__post_init__()

    def _check(self) -> None:
        if self.convention not in ("standard", "modified"):
            raise InputError(f"{self.name}: convention {self.convention!r} is unknown; known are standard, modified")
        if len(self.joint_names) != 6:
            raise InputError(f"{self.name}: {len(self.joint_names)} joint names; an arm here has six joints")
        if len(set(self.joint_names)) != 6:
            raise InputError(f"{self.name}: joint names are {', '.join(self.joint_names)}; no two joints may share one")
        if not np.isin(self.direction, (-1.0, 1.0)).all():
            raise InputError(f"{self.name}: direction is {self.direction.tolist()}; each must be 1 or -1")
        for name in ("alpha", "offset", "q_min", "q_max", "home"):
            if np.abs(getattr(self, name)).max() > chain.MOST_RADIANS:
                raise InputError(f"{self.name}: {name} has an angle of more than {chain.MOST_RADIANS:g} rad; {DEGREES}")
        for name in ("q_max - q_min", "qd_max", "qdd_max", "qddd_max"):
            value = self.q_max - self.q_min if " " in name else getattr(self, name)
            if not (value > 0).all():
                raise InputError(f"{self.name}: {name} must be more than 0 for every joint, is {value.tolist()}")
        for name in ("T_base_0", "T_flange_tool"):
            T = getattr(self, name)
            if np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-9 or np.linalg.det(T[:3, :3]) < 0:
                raise InputError(f"{self.name}: {name} is no rigid motion: its 3x3 part is no rotation")
            if (T[3] != (0, 0, 0, 1)).any():
                raise InputError(f"{self.name}: {name} is no rigid motion: its last row is not 0 0 0 1")

    @cached_property
    def size_m(self) -> float:
        """The length of all links together, m: it makes rotation and translation of the tool comparable."""
        rows = untilted(self.table)[:BASE].reshape(6, 6)
        return float(np.hypot(rows[:, 0], rows[:, 1]).sum())

    def forward(self, q: ArrayLike) -> Array:
        """Return the pose T_base_tool of the tool.

        Args:
            q: (6,) joint angles, rad, or (N, 6) of them.

        Returns:
            (4, 4) T_base_tool, m, or (N, 4, 4).

        Raises:
            InputError: wrong shape, NaN, or angles that are no radians.
        """
        angles = angles_of(q)
        if angles.ndim == 1:
            T = np.empty((4, 4))
            if chain.forward(self.table, angles, T):
                raise angle_rejection(angles)
            return T
        Ts = np.empty((len(angles), 4, 4))
        if chain.forward_batch(self.table, angles, Ts, np.empty(chain.BATCH_WORK), chain.BATCH):
            raise angle_rejection(angles)
        return Ts

    def links(self, q: ArrayLike) -> Array:
        """Return the frames of all links.

        Args:
            q: (6,) joint angles, rad.

        Returns:
            (8, 4, 4) in the base, m: the table's frame 0, the frames of links 1 to 6 by the arm's own convention, the tool.
        """
        angles = angles_of(q, batch=False)
        Ts = np.empty((8, 4, 4))
        if chain.links(self.table, angles, Ts):
            raise angle_rejection(angles)
        Ts[0] = self.T_base_0  # the packed table of a modified convention begins behind its first alpha and a
        return Ts

    def jacobian(self, q: ArrayLike, frame: Axes = "base") -> Array:
        """Return the geometric Jacobian: [velocity of the tool's point, m/s; angular velocity, rad/s] = J @ qd.

        Args:
            q: (6,) joint angles, rad, or (N, 6) of them.
            frame: the axes in which the velocities are given, "base" or "tool".

        Returns:
            (6, 6) J_base or J_tool, or (N, 6, 6).
        """
        angles, in_tool_axes = angles_of(q), _in_tool_axes(frame)
        if angles.ndim == 1:
            J = np.empty((6, 6))
            if chain.jacobian(self.table, angles, in_tool_axes, J):
                raise angle_rejection(angles)
            return J
        Js = np.empty((len(angles), 6, 6))
        if chain.jacobian_batch(self.table, angles, in_tool_axes, Js):
            raise angle_rejection(angles)
        return Js

    def jacobian_rate(self, q: ArrayLike, qd: ArrayLike, frame: Axes = "base") -> Array:
        """Return the time derivative of :meth:`jacobian`.

        Args:
            q: (6,) joint angles, rad.
            qd: (6,) joint speeds, rad/s.
            frame: as in :meth:`jacobian`.

        Returns:
            (6, 6) the derivative of each entry by time, 1/s.
        """
        angles, speeds = angles_of(q, batch=False), checked(qd, (6,), "qd").copy()
        J = np.empty((6, 6))
        if chain.jacobian_rate(self.table, angles, speeds, _in_tool_axes(frame), J):
            raise angle_rejection(angles)
        return J

    def manipulability(self, q: ArrayLike) -> Array:
        """Return Yoshikawa's sqrt(det(J J^T)), m^3: 0 where the arm is singular.

        Args:
            q: (6,) joint angles, rad, or (N, 6) of them.

        Returns:
            () or (N,).
        """
        return np.asarray(np.abs(np.linalg.det(self.jacobian(q))))

    def inverse(self, T_base_tool: ArrayLike, near: ArrayLike | None = None) -> Solutions:
        """Return all joint angles that bring the tool to a pose.

        All of up to eight, exact to rounding, where the table has a closed form (``kinematics.structure`` says which do);
        else those that damped least squares finds from many starts. Nothing is raised for a pose out of reach or
        singular: the result says so.

        Args:
            T_base_tool: (4, 4) where the tool shall be, m. A rotation off by up to 1e-6 is made orthonormal.
            near: (6,) joint angles, rad: solutions are sorted by their distance from these (the root of the sum of
                squares), the revolution nearest to them is taken, and a joint that is not determined gets its value
                of these. Without: the revolution nearest 0, and 0.

        Raises:
            InputError: not a rigid motion, wrong shape, NaN, or ``near`` in what are no radians.
        """
        T = poses_of(T_base_tool, 2)
        goal = _NO_ANGLES if near is None else near_angles(near)
        rows, scratch = np.empty((MOST, WIDTH)), np.zeros(inverse.SCRATCH)
        count, missed, bits = inverse.inverse(
            self.table, self._closed, self._limits, T, goal, near is not None, rows, scratch, chain.BATCH
        )
        if count < 0:
            raise pose_rejection(T[None])
        if count and not bits:
            return Solutions(rows[:count])
        lost = count == 0 or bits >= OUTSIDE
        reason = self._reason(bits, near is not None) if count else _out_of_reach(missed)
        return Solutions(rows[:count], reason, partial(self._nearest, T, goal) if lost else None)

    def inverse_batch(self, Ts_base_tool: ArrayLike, near: ArrayLike | None = None) -> ManySolutions:
        """Return all joint angles for many poses, without reasons and nearest poses.

        Args:
            Ts_base_tool: (N, 4, 4) where the tool shall be, m.
            near: (6,) joint angles, rad: what a joint that is not determined is given, 0 by default; the order stays.
        """
        Ts = poses_of(Ts_base_tool, 3)
        most = MOST if self._closed[KIND] == NEITHER else chain.BATCH
        rows, counts = np.zeros((len(Ts), most, KEY)), np.zeros(len(Ts), np.int64)
        row, scratch = np.empty((MOST, WIDTH)), np.zeros(inverse.SCRATCH)
        goal = _NO_ANGLES if near is None else near_angles(near)
        if inverse.inverse_batch(
            self.table, self._closed, self._limits, Ts, goal, row, scratch, chain.BATCH, rows, counts
        ):
            raise pose_rejection(Ts)
        state = rows[:, :, STATE]
        there = np.arange(most) < counts[:, None]
        return ManySolutions(
            counts,
            rows[:, :, :6],
            rows[:, :, POSITION],
            rows[:, :, ANGLE],
            (state < OUTSIDE) & there,
            state % OUTSIDE > 0,
            rows[:, :, CONFIGURATION:STATE],
        )

    def _reason(self, bits: int, given: bool) -> str:
        """Return why solutions are singular or outside the limits, in words."""
        value = "its value in near" if given else "0"
        texts = _SINGULAR[self._closed[KIND] == PARALLEL]
        parts = ["singular: " + text.format(value=value) for bit, text in texts.items() if bits & bit]
        if bits & OUTSIDE:
            parts.append("outside limits: every solution has a joint beyond its limits")
        return "; ".join(parts)

    def _nearest(self, T: Array, near: Array) -> Nearest:
        """Return the pose within the limits that comes closest to one that cannot be reached."""
        q, rows, scratch = np.empty(6), np.empty((MOST, WIDTH)), np.zeros(inverse.SCRATCH)
        inverse.nearest(self.table, self._closed, self._limits, T, near, q, rows, scratch, chain.BATCH)
        T_base_tool = self.forward(q)
        off = log_so3(T_base_tool[:3, :3].T @ T[:3, :3])
        return Nearest(q, T_base_tool, math.dist(T_base_tool[:3, 3], T[:3, 3]), float(np.linalg.norm(off)))

    def within_limits(self, q: ArrayLike) -> NDArray[np.bool_]:
        """Return whether joint angles (6,) or (N, 6), rad, are within the limits; () or (N,)."""
        angles = angles_of(q)
        return np.asarray(((angles >= self.q_min) & (angles <= self.q_max)).all(axis=-1))


#: The value of ``near`` where none is given; shared, so it is not to be written to.
_NO_ANGLES = np.zeros(6)
#: What keeps a pose out of reach.
_OUT_OF_REACH = {
    SHOULDER: "the wrist would be nearer to axis 1 than the arm's offset from it allows",
    ELBOW: "upper arm and forearm are too short for it, or cannot fold up so far",
}
#: What is singular, for an arm whose axes 2, 3 and 4 are parallel, and for one with a spherical wrist.
_SINGULAR = {
    False: {
        SHOULDER: "shoulder: the wrist is as near to axis 1 as it can be; joint 1 is {value} if the wrist is on axis 1",
        ELBOW: "elbow: the arm is straight or folded, elbow up and down are one",
        WRIST: "wrist: axes 4 and 6 are one, joints 4 and 6 are determined together only; joint 4 is {value}",
    },
    True: {
        SHOULDER: "shoulder: the wrist is as near to axis 1 as it can be; joint 1 is {value} if the wrist is on axis 1",
        ELBOW: "elbow: the arm is straight or folded, elbow up and down are one",
        WRIST: "wrist: axis 6 is parallel to axes 2, 3 and 4, which are not determined one by one; joint 6 is {value}, or "
        "as close as the arm's reach lets it",
    },
}


def _out_of_reach(missed: int) -> str:
    """Return why there is no solution, in words."""
    parts = [text for bit, text in _OUT_OF_REACH.items() if missed & bit]
    return "unreachable: " + (" and ".join(parts) or "damped least squares found no joint angles")


def _in_tool_axes(frame: str) -> bool:
    if frame not in _AXES:
        raise InputError(f"frame {frame!r} is unknown; known are {', '.join(_AXES)}")
    return _AXES[frame]


def angles_of(q: ArrayLike, *, batch: bool = True, name: str = "q") -> Array:
    """Return joint angles, rad, as a new array (6,) or (N, 6), so that kernels see one type only."""
    try:
        angles = np.array(q, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numbers: {error}") from None
    if angles.shape != (6,) and not (batch and angles.ndim == 2 and angles.shape[1] == 6):
        raise InputError(f"{name} has shape {angles.shape}, must be {'(6,) or (N, 6)' if batch else '(6,)'}")
    return angles


def near_angles(near: ArrayLike) -> Array:
    """Return the joint angles (6,), rad, that solutions shall be near to."""
    angles = angles_of(near, batch=False, name="near")
    if chain.validity(angles):
        raise InputError(str(angle_rejection(angles)).replace("q", "near", 1))
    return angles


def poses_of(T: ArrayLike, dimensions: int) -> Array:
    """Return poses, (4, 4) or (N, 4, 4), as a new array, so that kernels see one type only."""
    try:
        poses = np.array(T, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"T_base_tool must be numbers: {error}") from None
    if poses.ndim != dimensions or poses.shape[-2:] != (4, 4):
        want = "(4, 4)" if dimensions == 2 else "(N, 4, 4)"
        raise InputError(f"T_base_tool has shape {poses.shape}, must be {want}")
    return poses


def pose_rejection(Ts: Array) -> InputError:
    """Return the error that says what is wrong with poses (N, 4, 4) that a kernel rejected."""
    if not np.isfinite(Ts).all():
        return InputError("T_base_tool contains NaN or infinity; every entry must be a finite number")
    R = Ts[:, :3, :3]
    off = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max()
    if (Ts[:, 3] != (0, 0, 0, 1)).any():
        return InputError("T_base_tool is no rigid motion: its last row must be 0 0 0 1")
    if off < 1e-6:
        return InputError("T_base_tool is no rigid motion: its 3x3 part is a mirror image, its determinant is -1")
    return InputError(
        f"T_base_tool is no rigid motion: its columns are off from orthonormal by {off:.2g}; allowed is 1e-6"
    )


def angle_rejection(angles: Array) -> InputError:
    """Return the error that says what is wrong with joint angles, (6,) or (N, 6), that a kernel rejected."""
    if not np.isfinite(angles).all():
        return InputError("q contains NaN or infinity; every joint angle must be a finite number")
    row, joint = divmod(int(np.argmax(np.abs(angles) > chain.MOST_RADIANS)), 6)
    where = f"joint {joint + 1}" + (f" of row {row}" if angles.ndim == 2 else "")
    return InputError(f"q: {where} is at {angles.ravel()[6 * row + joint]:g} rad; {DEGREES}")


def untilted(table: Array) -> Array:
    """Return a packed table (96,) with axes that are nearly parallel made parallel, and the rest as near as may be.

    The common normal of two nearly parallel axes is far away: such a row holds a d of many metres, and the next row takes
    it back. Here d is moved to where the normal is near, and the tilt is left out. The closed form of the result gives the
    starts of the iterative inverse.
    """
    out = table.copy()
    rows = out[:BASE].reshape(6, 6)
    for row, after in itertools.pairwise(rows):
        if abs(row[_SIN]) > np.sin(TILT_RAD) or row[_SIN] == 0.0:
            continue
        along = -row[_D] / row[_COS]  # on the next axis, as far up as this joint stands
        R = np.array([[np.cos(row[_OFFSET]), -np.sin(row[_OFFSET])], [np.sin(row[_OFFSET]), np.cos(row[_OFFSET])]])
        at = link(*row[:4]) @ [0.0, 0.0, along, 1.0]
        x, y = R @ at[:2]
        facing = row[_OFFSET]  # where the next frame's x points; the tilt rotates it by its square only
        row[_A], row[_D] = np.hypot(x, y), 0.0
        row[_OFFSET] = np.arctan2(y, x)
        row[_COS], row[_SIN] = np.sign(row[_COS]), 0.0
        after[_D] -= along
        after[_OFFSET] += row[_COS] * (facing - row[_OFFSET])
    return out
