"""Arm: a table of numbers that knows where its tool is, how it moves, and which joints bring it somewhere.

In: joint angles, rad, or a wanted pose. Out: poses ``T_base_tool``, Jacobians, :class:`Solutions`. The work is done by
the functions in ``kinematics``; here stands what is checked once at the public door. Conventions: docs/arm.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from armsight.data import Array, Record
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.robot.kinematics import chain
from armsight.robot.kinematics.table import packed

Convention = Literal["standard", "modified"]
Axes = Literal["base", "tool"]
_AXES = {"base": False, "tool": True}


def _six(value: float) -> Array:
    return np.full(6, value)


@dataclass(frozen=True, eq=False)
class Arm(Record):
    """An arm of six turning joints: its Denavit-Hartenberg table, its limits and its names.

    Joint i turns by ``theta_i = direction_i * q_i + offset_i``. The tool is at
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
        home: (6,) the pose to start from, rad.
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

    def __post_init__(self) -> None:
        """Check the numbers and pack them for the kernels.

        Raises:
            InputError: a wrong shape, a number that is none, or limits that leave nothing.
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
        object.__setattr__(self, "table", table)
        super().__post_init__()

    def _check(self) -> None:
        if self.convention not in ("standard", "modified"):
            raise InputError(f"{self.name}: convention {self.convention!r} is unknown; known are standard, modified")
        if len(self.joint_names) != 6:
            raise InputError(f"{self.name}: {len(self.joint_names)} joint names; an arm here has six joints")
        if not np.isin(self.direction, (-1.0, 1.0)).all():
            raise InputError(f"{self.name}: direction is {self.direction.tolist()}; each must be 1 or -1")
        for name in ("alpha", "offset", "q_min", "q_max", "home"):
            if np.abs(getattr(self, name)).max() > chain.MOST_RADIANS:
                raise InputError(
                    f"{self.name}: {name} has an angle of more than {chain.MOST_RADIANS:g} rad; {_DEGREES}"
                )
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

    def forward(self, q: ArrayLike) -> Array:
        """Return where the tool is.

        Args:
            q: (6,) joint angles, rad, or (N, 6) of them.

        Returns:
            (4, 4) T_base_tool, m, or (N, 4, 4).

        Raises:
            InputError: wrong shape, NaN, or angles that are no radians.
        """
        angles = _angles(q)
        if angles.ndim == 1:
            T = np.empty((4, 4))
            if chain.forward(self.table, angles, T):
                raise _refusal(angles)
            return T
        Ts = np.empty((len(angles), 4, 4))
        if chain.forward_batch(self.table, angles, Ts):
            raise _refusal(angles)
        return Ts

    def links(self, q: ArrayLike) -> Array:
        """Return where every link is.

        Args:
            q: (6,) joint angles, rad.

        Returns:
            (8, 4, 4) in the base, m: the table's frame 0, the frames of links 1 to 6 by the arm's own convention, the tool.
        """
        angles = _angles(q, batch=False)
        Ts = np.empty((8, 4, 4))
        if chain.links(self.table, angles, Ts):
            raise _refusal(angles)
        return Ts

    def jacobian(self, q: ArrayLike, frame: Axes = "base") -> Array:
        """Return the geometric Jacobian: [velocity of the tool's point, m/s; angular velocity, rad/s] = J @ qd.

        Args:
            q: (6,) joint angles, rad, or (N, 6) of them.
            frame: the axes in which the velocities are given, "base" or "tool".

        Returns:
            (6, 6) J_base or J_tool, or (N, 6, 6).
        """
        angles, in_tool_axes = _angles(q), _in_tool_axes(frame)
        if angles.ndim == 1:
            J = np.empty((6, 6))
            if chain.jacobian(self.table, angles, in_tool_axes, J):
                raise _refusal(angles)
            return J
        Js = np.empty((len(angles), 6, 6))
        if chain.jacobian_batch(self.table, angles, in_tool_axes, Js):
            raise _refusal(angles)
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
        angles, speeds = _angles(q, batch=False), checked(qd, (6,), "qd").copy()
        J = np.empty((6, 6))
        if chain.jacobian_rate(self.table, angles, speeds, _in_tool_axes(frame), J):
            raise _refusal(angles)
        return J

    def manipulability(self, q: ArrayLike) -> Array:
        """Return Yoshikawa's sqrt(det(J J^T)), m^3: 0 where the arm is singular.

        Args:
            q: (6,) joint angles, rad, or (N, 6) of them.

        Returns:
            () or (N,).
        """
        return np.asarray(np.abs(np.linalg.det(self.jacobian(q))))

    def within_limits(self, q: ArrayLike) -> NDArray[np.bool_]:
        """Say whether joint angles (6,) or (N, 6), rad, are within the limits; () or (N,)."""
        angles = _angles(q)
        return np.asarray(((angles >= self.q_min) & (angles <= self.q_max)).all(axis=-1))


_DEGREES = "are these degrees? give radians: numpy.deg2rad(...)"


def _angles(q: ArrayLike, *, batch: bool = True) -> Array:
    """Return joint angles as a new array, so that kernels see one type only."""
    try:
        angles = np.array(q, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"q must be numbers: {error}") from None
    if angles.shape != (6,) and not (batch and angles.ndim == 2 and angles.shape[1] == 6):
        raise InputError(f"q has shape {angles.shape}, must be {'(6,) or (N, 6)' if batch else '(6,)'}")
    return angles


def _refusal(angles: Array) -> InputError:
    """Tell what is wrong with joint angles that a kernel refused."""
    if not np.isfinite(angles).all():
        return InputError("q contains NaN or infinity; every joint angle must be a finite number")
    row, joint = divmod(int(np.argmax(np.abs(angles) > chain.MOST_RADIANS)), 6)
    where = f"joint {joint + 1}" + (f" of row {row}" if angles.ndim == 2 else "")
    return InputError(f"q: {where} is at {angles.ravel()[6 * row + joint]:g} rad; {_DEGREES}")


def _in_tool_axes(frame: str) -> bool:
    if frame not in _AXES:
        raise InputError(f"frame {frame!r} is unknown; known are {', '.join(_AXES)}")
    return _AXES[frame]
