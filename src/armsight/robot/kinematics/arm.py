"""Arm: a Denavit-Hartenberg table that knows where its tool is, how it moves, and which joints bring it to a pose.

In: joint angles, rad, or a requested pose T_base_tool, m. Out: poses ``T_base_tool``, Jacobians, :class:`Solutions`. The
functions in ``kinematics`` do the work; here is what is checked once at the public door: joint angles and poses are copied
into new arrays, so that the kernels see one type only, and rejected with the reason. The kernels look at every number.
Conventions: the documentation's page on the arm.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from statistics import mode
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.rotation import log_so3
from armsight.robot.kinematics import chain, inverse, numeric
from armsight.robot.kinematics.closed import ELBOW, OUTSIDE, SHOULDER, WRIST
from armsight.robot.kinematics.inverse import KEY, MOST, STATE, WIDTH
from armsight.robot.kinematics.solutions import ROW_END, ManySolutions, Nearest, Solutions, many_solutions
from armsight.robot.kinematics.structure import NEITHER, PARALLEL, recognised
from armsight.robot.kinematics.table import FEWEST_JOINTS, KIND, MOST_JOINTS, link, packed, rows_of

#: Axes further apart than this, rad, are not meant to be parallel.
TILT_RAD = np.deg2rad(3.0)
_A, _D, _COS, _SIN, _OFFSET, _DIRECTION = range(6)
_SINGULAR_COUPLING = 1e6  # a coupling of a greater condition number is taken for singular
#: What an error adds where angles are too large for radians.
DEGREES = "are these degrees? give radians: numpy.deg2rad(...)"
Convention = Literal["standard", "modified"]
Axes = Literal["base", "tool"]
_AXES = {"base": False, "tool": True}

_DEFAULTS = {"offset": 0.0, "direction": 1.0, "home": 0.0}  # attribute -> what every joint has where it is not given


def _not_given() -> Array:
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class Arm(Record):
    """An arm of n revolute joints, four to seven: its Denavit-Hartenberg table, its limits and its names.

    Joint i rotates by ``theta_i = direction_i * (coupling @ q)_i + offset_i``. The tool is at
    ``T_base_tool = T_base_0 @ A_1 @ ... @ A_n @ T_flange_tool``; the flange is frame n of the table.

    Attributes:
        name: what the arm is called.
        a: (n,) link lengths, m.
        d: (n,) link offsets, m.
        alpha: (n,) link twists, rad.
        q_min: (n,) lower limits of the joints, rad.
        q_max: (n,) upper limits, rad.
        qd_max: (n,) greatest speeds, rad/s.
        qdd_max: (n,) greatest accelerations, rad/s^2.
        qddd_max: (n,) greatest jerks, rad/s^3.
        offset: (n,) added to the joint angles, rad.
        direction: (n,) +1 or -1, by which the joint angles are multiplied.
        home: (n,) the joint angles to start from, rad.
        convention: "standard", Rz(theta) Tz(d) Tx(a) Rx(alpha) a row, or "modified", Rx(alpha) Tx(a) Rz(theta) Tz(d).
        T_base_0: (4, 4) where the table's frame 0 sits in the base.
        T_flange_tool: (4, 4) where the tool sits on the flange.
        joint_names: n names.
        coupling: (n, n) by which the controller's angles q are multiplied to give those of the joints; the identity where
            each motor moves one joint only. ``J3' = J3 + J2`` is a 1 in row 3, column 2. Limits and home are those of q.
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
    offset: Array = field(default_factory=_not_given)
    direction: Array = field(default_factory=_not_given)
    home: Array = field(default_factory=_not_given)
    convention: Convention = "standard"
    T_base_0: Array = field(default_factory=lambda: np.eye(4))
    T_flange_tool: Array = field(default_factory=lambda: np.eye(4))
    joint_names: tuple[str, ...] = ()
    coupling: Array = field(default_factory=_not_given)
    source: str = ""
    table: Array = field(init=False, repr=False)
    _closed: Array = field(init=False, repr=False)
    _limits: Array = field(init=False, repr=False)
    _coupled: bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check the numbers and pack them for the kernels.

        Raises InputError: a wrong shape, a value that is not finite, or a limit that is not positive.
        """
        joints = mode(np.size(getattr(self, name)) for name in ("a", "d", "alpha", "q_min", "q_max"))
        if not FEWEST_JOINTS <= joints <= MOST_JOINTS:
            raise InputError(f"{self.name}: {joints} joints; an arm here has {FEWEST_JOINTS} to {MOST_JOINTS}")
        given = {name: np.full(joints, value) for name, value in _DEFAULTS.items()} | {"coupling": np.eye(joints)}
        for at in fields(self):
            if at.type == "Array" and at.init:
                square = (4, 4) if at.name.startswith("T_") else (joints, joints)
                shape = square if at.name.startswith("T_") or at.name == "coupling" else (joints,)
                value = getattr(self, at.name)
                value = given[at.name] if at.name in given and np.size(value) == 0 else value
                object.__setattr__(self, at.name, checked(value, shape, f"{self.name}: {at.name}").copy())
        if not self.joint_names:
            object.__setattr__(self, "joint_names", tuple(f"joint{i + 1}" for i in range(joints)))
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
        closed, exact = recognised(table) if joints == 6 else (table.copy(), False)
        if not exact and joints == 6:
            closed, _ = recognised(untilted(table))
        table[KIND] = closed[KIND] if exact else NEITHER
        object.__setattr__(self, "table", table)
        object.__setattr__(self, "_closed", closed)
        object.__setattr__(self, "_coupled", bool((self.coupling != np.eye(joints)).any()))
        object.__setattr__(self, "_limits", self._joint_limits())
        super().__post_init__()

    def _check(self) -> None:
        if self.convention not in ("standard", "modified"):
            raise InputError(f"{self.name}: convention {self.convention!r} is unknown; known are standard, modified")
        if len(self.joint_names) != self.joints:
            raise InputError(f"{self.name}: {len(self.joint_names)} joint names; the arm has {self.joints} joints")
        if len(set(self.joint_names)) != self.joints:
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

        if np.linalg.cond(self.coupling) > _SINGULAR_COUPLING:
            raise InputError(f"{self.name}: coupling is singular: some motors together move no joint")

    def _joint_limits(self) -> Array:
        """Return the limits (2, n) of the joints themselves, rad: those of q, or what the coupling makes of their box."""
        box = np.stack([self.q_min, self.q_max])
        if not self._coupled:
            return box
        ends = self.coupling[:, :, None] * box.T[None]
        return np.stack([ends.min(axis=2).sum(axis=1), ends.max(axis=2).sum(axis=1)])

    @property
    def joints(self) -> int:
        """How many joints there are."""
        return len(self.a)

    @cached_property
    def size_m(self) -> float:
        """The length of all links together, m: it makes rotation and translation of the tool comparable."""
        rows = rows_of(untilted(self.table))
        return float(np.hypot(rows[:, 0], rows[:, 1]).sum())

    def forward(self, q: ArrayLike) -> Array:
        """Return the pose T_base_tool of the tool.

        ``q``: (n,) joint angles, rad, or (N, n) of them. Returns (4, 4) T_base_tool, m, or (N, 4, 4). Raises InputError:
        wrong shape, NaN, or angles that are no radians.
        """
        angles = self._angles(q)
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

        ``q``: (n,) joint angles, rad. Returns (n + 2, 4, 4) in the base, m: the table's frame 0, the frames of links 1 to n
        by the arm's own convention, the tool.
        """
        angles = self._angles(q, batch=False)
        Ts = np.empty((self.joints + 2, 4, 4))
        if chain.links(self.table, angles, Ts):
            raise angle_rejection(angles)
        Ts[0] = self.T_base_0  # the packed table of a modified convention begins behind its first alpha and a
        return Ts

    def jacobian(self, q: ArrayLike, frame: Axes = "base") -> Array:
        """Return the geometric Jacobian: [velocity of the tool's point, m/s; angular velocity, rad/s] = J @ qd.

        ``q``: (n,) joint angles, rad, or (N, n) of them; ``frame``: the axes in which the velocities are given, "base" or
        "tool". Returns (6, n) J_base or J_tool, or (N, 6, n).
        """
        angles, in_tool_axes = self._angles(q), _in_tool_axes(frame)
        if angles.ndim == 1:
            J = np.empty((6, len(angles)))
            if chain.jacobian(self.table, angles, in_tool_axes, J):
                raise angle_rejection(angles)
            return J @ self.coupling if self._coupled else J
        Js = np.empty((len(angles), 6, self.joints))
        if chain.jacobian_batch(self.table, angles, in_tool_axes, Js):
            raise angle_rejection(angles)
        return Js @ self.coupling if self._coupled else Js

    def jacobian_rate(self, q: ArrayLike, qd: ArrayLike, frame: Axes = "base") -> Array:
        """Return the time derivative of :meth:`jacobian`.

        ``q``: (n,) joint angles, rad; ``qd``: (n,) joint speeds, rad/s; ``frame``: as in :meth:`jacobian`. Returns (6, n)
        the derivative of each entry by time, 1/s.
        """
        angles, speeds = self._angles(q, batch=False), self.coupling @ checked(qd, (self.joints,), "qd")
        J = np.empty((6, self.joints))
        if chain.jacobian_rate(self.table, angles, speeds, _in_tool_axes(frame), J):
            raise angle_rejection(angles)
        return J @ self.coupling if self._coupled else J

    def manipulability(self, q: ArrayLike) -> Array:
        """Return Yoshikawa's sqrt(det(J J^T)), m^3: 0 where the arm is singular.

        For fewer than six joints it is sqrt(det(J^T J)): 0 where some joints together do not move the tool.

        ``q``: (n,) joint angles, rad, or (N, n) of them. Returns () or (N,).
        """
        if self.joints == 6:
            return np.asarray(np.abs(np.linalg.det(self.jacobian(q))))
        return np.asarray(np.linalg.svd(self.jacobian(q), compute_uv=False).prod(axis=-1))

    def inverse(self, T_base_tool: ArrayLike, near: ArrayLike | None = None) -> Solutions:
        """Return all joint angles that bring the tool to a pose.

        Of six joints: all of up to eight, exact to rounding, where the table has a closed form (``kinematics.structure``
        says which do); else those that damped least squares finds from many starts. Of another number of joints: one
        solution within the limits, the first that is found from ``near`` and then from other starts
        (``kinematics.numeric``). Seven joints leave a motion free: it keeps near ``near``, or the middle of the limits, and
        away from the limits. Fewer than six reach few poses exactly: the position comes first, then the direction of the
        tool's z axis, then the rotation about it; ``residual_rad`` says what is left. Nothing is raised for a pose out of
        reach or singular: the result says so.

        ``T_base_tool``: (4, 4) where the tool shall be, m. A rotation off by up to 1e-6 is made orthonormal. ``near``: (n,)
        joint angles, rad: solutions are sorted by their distance from these (the root of the sum of squares), the
        revolution nearest to them is taken, and a joint that is not determined gets its value of these. Without: the
        revolution nearest 0, and 0. Raises InputError: not a rigid motion, wrong shape, NaN, or ``near`` in what are no
        radians.
        """
        T = poses_of(T_base_tool, 2)
        if self.joints != 6 or self._coupled:
            return self._numeric_inverse(T, near) if self.joints != 6 else self._coupled_inverse(T, near)
        goal = _NO_ANGLES if near is None else near_angles(near, 6)
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

        ``Ts_base_tool``: (N, 4, 4) where the tool shall be, m. ``near``: (n,) joint angles, rad: what a joint that is not
        determined is given, 0 by default; the order stays.
        """
        Ts = poses_of(Ts_base_tool, 3)
        if self.joints != 6:
            return self._numeric_batch(Ts, near)
        if self._coupled:
            return many_solutions([self._coupled_inverse(T, near).rows for T in Ts], 6)
        most = MOST if self._closed[KIND] == NEITHER else chain.BATCH
        rows, counts = np.zeros((len(Ts), most, KEY)), np.zeros(len(Ts), np.int64)
        row, scratch = np.empty((MOST, WIDTH)), np.zeros(inverse.SCRATCH)
        goal = _NO_ANGLES if near is None else near_angles(near, 6)
        if inverse.inverse_batch(
            self.table, self._closed, self._limits, Ts, goal, row, scratch, chain.BATCH, rows, counts
        ):
            raise pose_rejection(Ts)
        return ManySolutions.of(counts, rows)

    def _numeric_inverse(self, T: Array, near: ArrayLike | None) -> Solutions:
        """Return the solution of one pose (4, 4) for an arm of other than six joints."""
        goal = self._goal(near)
        q, off = np.empty(self.joints), np.empty(3)
        if numeric.inverse(self.table, self._limits, T, goal, q, off, np.zeros(numeric.SCRATCH)):
            raise pose_rejection(T[None])
        q = self._controller_angles(q)
        position, angle, axis = off
        reached = position < inverse.REACHED and (self.joints < 6 or angle < inverse.REACHED)
        inside = bool(self.within_limits(q))
        if not reached:
            return Solutions(np.empty((0, self.joints + ROW_END)), _out_of_reach(0), partial(self._there, T, q))
        row = np.array([[*q, position, angle, 0, 0, 0, 0 if inside else OUTSIDE, 0]])
        reason = "outside limits: a joint is beyond its limits" if not inside else self._left(angle, axis)
        return Solutions(row, reason, None if inside else partial(self._there, T, np.clip(q, self.q_min, self.q_max)))

    def _left(self, angle: float, axis: float) -> str | None:
        """Return what of an orientation fewer than six joints leave, in words; None where nothing is left."""
        if angle < inverse.REACHED:
            return None
        met = (
            f"the tool's z axis is off by {np.degrees(axis):.3g} deg" if axis > inverse.REACHED else "its z axis is met"
        )
        return (
            f"orientation not met: {self.joints} joints bring the tool to the position; {met}, the orientation is off by "
            f"{np.degrees(angle):.3g} deg in all"
        )

    def _numeric_batch(self, Ts: Array, near: ArrayLike | None) -> ManySolutions:
        """Return the solutions of many poses (N, 4, 4) for an arm of other than six joints."""
        goal = self._goal(near)
        q, off = np.empty((len(Ts), self.joints)), np.empty((len(Ts), 3))
        if numeric.inverse_batch(self.table, self._limits, Ts, goal, q, off, np.zeros(numeric.SCRATCH)):
            raise pose_rejection(Ts)
        q = self._controller_angles(q)
        reached = (off[:, 0] < inverse.REACHED) & ((off[:, 1] < inverse.REACHED) | (self.joints < 6))
        state = np.where(self.within_limits(q), 0.0, OUTSIDE)
        rows = np.column_stack([q, off[:, :2], np.zeros((len(Ts), 3)), state]) * reached[:, None]
        return ManySolutions.of(reached.astype(np.int64), rows[:, None])

    def _goal(self, near: ArrayLike | None) -> Array:
        """Return the joints' angles (n,) that solutions shall be near to, rad: the middle of the limits by default."""
        if near is None:
            return np.asarray(self._limits.mean(axis=0))
        return np.asarray(self.coupling @ near_angles(near, self.joints))

    def _controller_angles(self, angles: Array) -> Array:
        """Return q of the joints' own angles, (n,) or (N, n), rad."""
        return np.asarray(np.linalg.solve(self.coupling, angles.T).T, np.float64) if self._coupled else angles

    def _coupled_inverse(self, T: Array, near: ArrayLike | None) -> Solutions:
        """Return the solutions of an arm of six joints whose motors are coupled, from those of the same arm without."""
        goal = np.zeros(6) if near is None else near_angles(near, 6)
        found = self._uncoupled.inverse(T, None if near is None else self.coupling @ goal)
        if not len(found):
            nearest = found.nearest
            q = self._controller_angles(nearest.q if nearest else goal)
            return Solutions(
                found.rows.copy(), found.reason, partial(self._there, T, np.clip(q, self.q_min, self.q_max))
            )
        rows, q = found.rows.copy(), self._controller_angles(found.q)
        # A revolution of a motor brings every joint to where it was only where the coupling consists of whole numbers.
        if np.array_equal(self.coupling, np.rint(self.coupling)):
            least = np.ceil((self.q_min - q) / (2 * np.pi) - 1e-13)
            most = np.floor((self.q_max - q) / (2 * np.pi) + 1e-13)
            whole = np.rint((goal - q) / (2 * np.pi))
            q = q + 2 * np.pi * np.where(least <= most, np.clip(whole, least, most), whole)
        outside = ~np.asarray(((q >= self.q_min - 1e-12) & (q <= self.q_max + 1e-12)).all(axis=1))
        rows[:, :6], rows[:, STATE] = q, rows[:, STATE] % OUTSIDE + OUTSIDE * outside
        distance = np.linalg.norm(q - goal, axis=1) if near is not None else np.zeros(len(q))
        rows = rows[np.lexsort((distance, outside))]
        if not outside.all():
            return Solutions(rows, found.reason if found.singular.any() else None)
        closest = np.clip(rows[0, :6], self.q_min, self.q_max)
        return Solutions(
            rows, "outside limits: every solution has a joint beyond its limits", partial(self._there, T, closest)
        )

    @cached_property
    def _uncoupled(self) -> Arm:
        """The same arm by the angles of its joints themselves."""
        low, high = self._limits
        return replace(self, coupling=np.eye(self.joints), q_min=low, q_max=high, home=self.coupling @ self.home)

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
        return self._there(T, q)

    def _there(self, T: Array, q: Array) -> Nearest:
        """Return how far the tool is off a pose (4, 4) at joint angles (n,)."""
        T_base_tool = self.forward(q)
        off = log_so3(T_base_tool[:3, :3].T @ T[:3, :3])
        return Nearest(q, T_base_tool, math.dist(T_base_tool[:3, 3], T[:3, 3]), float(np.linalg.norm(off)))

    def within_limits(self, q: ArrayLike) -> NDArray[np.bool_]:
        """Return whether joint angles (n,) or (N, n), rad, are within the limits; () or (N,)."""
        angles = angles_of(q, self.joints)
        return np.asarray(((angles >= self.q_min) & (angles <= self.q_max)).all(axis=-1))

    def _angles(self, q: ArrayLike, *, batch: bool = True) -> Array:
        """Return the angles of the joints themselves, (n,) or (N, n), rad, as a new array."""
        angles = angles_of(q, len(self.a), batch=batch)
        return np.ascontiguousarray(angles @ self.coupling.T) if self._coupled else angles


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


def angles_of(q: ArrayLike, joints: int, *, batch: bool = True, name: str = "q") -> Array:
    """Return joint angles, rad, as a new array (n,) or (N, n), so that kernels see one type only."""
    try:
        angles = np.array(q, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numbers: {error}") from None
    if angles.shape != (joints,) and not (batch and angles.ndim == 2 and angles.shape[1] == joints):
        want = f"({joints},) or (N, {joints})" if batch else f"({joints},)"
        raise InputError(f"{name} has shape {angles.shape}, must be {want}")
    return angles


def near_angles(near: ArrayLike, joints: int) -> Array:
    """Return the joint angles (n,), rad, that solutions shall be near to."""
    angles = angles_of(near, joints, batch=False, name="near")
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
    """Return the error that says what is wrong with joint angles, (n,) or (N, n), that a kernel rejected."""
    if not np.isfinite(angles).all():
        return InputError("q contains NaN or infinity; every joint angle must be a finite number")
    row, joint = divmod(int(np.argmax(np.abs(angles) > chain.MOST_RADIANS)), angles.shape[-1])
    where = f"joint {joint + 1}" + (f" of row {row}" if angles.ndim == 2 else "")
    return InputError(f"q: {where} is at {angles.reshape(-1, angles.shape[-1])[row, joint]:g} rad; {DEGREES}")


def untilted(table: Array) -> Array:
    """Return a packed table (102,) with axes that are nearly parallel made parallel, and the rest as near as may be.

    The common normal of two nearly parallel axes is far away: such a row holds a d of many metres, and the next row takes
    it back. Here d is moved to where the normal is near, and the tilt is left out. The closed form of the result gives the
    starts of the iterative inverse.
    """
    out = table.copy()
    for row, after in itertools.pairwise(rows_of(out)):
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
