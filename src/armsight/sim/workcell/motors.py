"""The solids an arm is made of, their gravity torque and inertia; and its motors, chosen by a rule that suits any table.

Solids are capsules along the rows of the table, with mass. A row's frame is the one that rotates with its joint: frame
i-1 of the table after ``Rz(theta_i)``. Link i's capsules are given in row frame i, row frame 0 is the base. The gravity
torque is the sum over all solids beyond a joint of ``z . (c - p) x m g`` (Siciliano et al., "Robotics", 2009, section
7.1.2).

Motors are direct-current motors with gears. What each joint needs is evaluated over many poses of the nominal arm: the
greatest gravity torque, the greatest inertia. A gear and a motor are then chosen so that a 24 V supply gives a speed and a
torque to spare. Current ``i = (duty U - k n w) / R`` within its limit, torque ``n k i`` less friction, at the joint's
speed w.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Ids, Record
from armsight.geometry.pose import transform
from armsight.kernels import kernel
from armsight.robot.kinematics.arm import Arm
from armsight.robot.kinematics.chain import after_link, after_rotation, first_frame, sincos, store
from armsight.robot.kinematics.table import rows_of

GRAVITY_M_S2 = 9.81
#: Radii of the links, share of the arm's whole length; of a joint's housing, share of its link's; density, kg/m^3.
_RADII = np.array([0.052, 0.040, 0.034, 0.029, 0.026, 0.022])
_HOUSING, _DENSITY = 1.2, 900.0
#: Mass of the tool and the body on it, share of the arm; radius of a ball of their inertia, share of the last link's.
_TOOL_SHARE, _TOOL_RADIUS = 0.03, 2.0
_SHORTEST_M = 1e-3


@dataclass(frozen=True, eq=False)
class Solids(Record):
    """Capsules that move with an arm's links."""

    link: Ids  #: (K,) 0 for the base, 1 to n
    ends: Array  #: (K, 2, 3) their axes' ends, m, row frame of the link
    radius: Array  #: (K,) m
    mass: Array  #: (K,) kg
    housing: NDArray[np.bool_]  #: (K,) whether it is a joint's housing


def solids(arm: Arm) -> Solids:
    """Return what an arm is made of: a capsule along each d and a, housings about its joints, last the load at its tool."""
    rows = rows_of(arm.table)
    whole = float(np.abs(rows[:, :2]).sum())
    last = len(rows) - 1
    radii = np.interp(np.linspace(0.0, 5.0, last + 1), np.arange(6), _RADII) * whole
    first = arm.T_base_0[:3, 3]
    if np.linalg.norm(first) < 0.02 * whole:
        first = np.array([0.0, 0.0, 0.02 * whole])
    parts: list[tuple[int, Array, Array, float, bool]] = [(0, np.zeros(3), first, 1.5 * radii[0], True)]
    for i, (a, d) in enumerate(rows[:, :2]):
        foot, knee, hand = np.zeros(3), np.array([0.0, 0.0, d]), np.array([a, 0.0, d])
        if i == last:  # the round end stays behind the tool's plate
            knee[2] = np.sign(d) * max(abs(d) - radii[i], 0.0)
        if abs(d) > _SHORTEST_M:
            parts.append((i + 1, foot, knee, radii[i], False))
        if abs(a) > _SHORTEST_M:
            parts.append((i + 1, knee, hand, radii[i], False))
        if 0 < i < last or max(abs(a), abs(d)) <= _SHORTEST_M:
            axle = np.array([0.0, 0.0, radii[i]])
            parts.append((i + 1, -axle, axle, _HOUSING * radii[i], True))
    link, foot, hand, radius, housing = (np.array(column) for column in zip(*parts, strict=True))
    length = np.linalg.norm(hand - foot, axis=1)
    mass = _DENSITY * np.pi * radius**2 * (length + 4 / 3 * radius)
    tool = np.array([[rows[last, 0], 0.0, rows[last, 1]]])
    return Solids(
        np.append(link, last + 1),
        np.append(np.stack([foot, hand], axis=1), np.stack([tool, tool], axis=1), axis=0),
        np.append(radius, _TOOL_RADIUS * radii[last]),
        np.append(mass, _TOOL_SHARE * mass[link > 0].sum()),
        np.append(housing, True),
    )


@kernel("const f8[::1], const f8[::1], f8[:, :, ::1]")
def _row_frames(table: Array, q: Array, Ts: Array) -> None:
    """Write the row frames at joint angles q (n,) into Ts (n + 1, 4, 4)."""
    Ts[0] = np.eye(4)
    F = first_frame(table)
    for i in range(q.size):
        s, c = sincos(table[6 * i + 5] * q[i] + table[6 * i + 4])
        F = after_rotation(table, i, c, s, F)
        store(F, Ts[i + 1])
        d = table[6 * i + 1]
        for k in range(3):
            Ts[i + 1, k, 3] -= d * Ts[i + 1, k, 2]
        F = after_link(table, i, F)


def row_frames(arm: Arm, q: Array) -> Array:
    """Return where the row frames (n + 1, 4, 4) are in the base, m, at joint angles (n,), rad."""
    Ts = np.empty((arm.joints + 1, 4, 4))
    _row_frames(arm.table, np.ascontiguousarray(q), Ts)
    return Ts


@kernel("f8[:, :, ::1], const i8[::1], f8[:, ::1], const f8[::1], f8[::1]")
def _gravity(Ts: Array, link: Ids, centre: Array, mass: Array, out: Array) -> None:
    """Add the gravity torque of solids at centre (K, 3) of their row frames about the joints' axes, N m, to out (n,)."""
    for k in range(link.size):
        T = Ts[link[k]]
        x = T[0, 0] * centre[k, 0] + T[0, 1] * centre[k, 1] + T[0, 2] * centre[k, 2] + T[0, 3]
        y = T[1, 0] * centre[k, 0] + T[1, 1] * centre[k, 1] + T[1, 2] * centre[k, 2] + T[1, 3]
        for i in range(link[k]):
            # z . (r x f) with f = (0, 0, -m g)
            z, rx, ry = Ts[i + 1, :3, 2], x - Ts[i + 1, 0, 3], y - Ts[i + 1, 1, 3]
            out[i] += -mass[k] * GRAVITY_M_S2 * (z[0] * ry - z[1] * rx)


def gravity_torque(arm: Arm, parts: Solids, q: Array) -> Array:
    """Return the torque (n,), N m, with which gravity acts on the joints through an arm's solids at angles q (n,), rad."""
    out = np.zeros(arm.joints)
    _gravity(row_frames(arm, q), parts.link, parts.ends.mean(axis=1), parts.mass, out)
    return np.asarray(arm.direction * out)


def inertia(arm: Arm, parts: Solids, q: Array) -> Array:
    """Return the inertia (n,), kg m^2, of all that each joint rotates, as points, at angles q (n,), rad."""
    Ts, out = row_frames(arm, q), np.zeros(arm.joints)
    centres = transform(Ts[parts.link], parts.ends.mean(axis=1))
    for i in range(arm.joints):
        beyond = parts.link > i
        r = centres[beyond] - Ts[i + 1, :3, 3]
        off_axis = (r**2).sum(axis=1) - (r @ Ts[i + 1, :3, 2]) ** 2
        out[i] = parts.mass[beyond] @ (off_axis + 0.4 * parts.radius[beyond] ** 2)
    return out


SUPPLY_V = 24.0
#: No-load speed over the joint's greatest; greatest torque and stall torque over what is needed.
_SPEED_SPARE, _TORQUE_SPARE, _STALL_SPARE = 1.7, 2.5, 6.0
ACCELERATION_SPARE = 2.0  # a joint could accelerate so many times as hard as it may
_TIME_CONSTANT_S = 0.012  # of the motor alone, unloaded
_TORQUE_CONSTANT = 0.04  # N m/A: of the whole family
#: Friction: dry, of the torque needed; viscous, of the motor's own damping; of the bearing, of the torque needed.
_COULOMB, _VISCOUS, _BEARING = 0.10, 0.05, 0.01
_LEAST = 0.03  # a joint needs no less than this share of what the strongest needs
_BRAKE = 5.0  # holding torque of the brakes, of the torque needed
_POSES = 400  # at which the arm is looked at


@dataclass(frozen=True, eq=False)
class Motors(Record):
    """Six geared motors; inertia and friction are given at the joint."""

    gear_ratio: Array  #: (6,) revolutions of the motor for one of the joint
    torque_constant: Array  #: (6,) N m/A, also V s/rad, at the motor
    resistance_ohm: Array  #: (6,) of the winding
    rotor_inertia: Array  #: (6,) kg m^2, of rotor and gear, at the joint
    current_max_a: Array  #: (6,) the driver's own limit
    coulomb_nm: Array  #: (6,) dry friction of motor and gear, N m
    viscous: Array  #: (6,) friction that grows with speed, N m s/rad
    bearing_nm: Array  #: (6,) dry friction of the link's own bearing, N m
    brake_nm: Array  #: (6,) what the brake holds, N m; closed until the board opens it
    needed_nm: Array  #: (6,) torque that the joint needs, N m: of gravity and of its greatest acceleration
    gravity_nm: Array  #: (6,) greatest gravity torque, N m

    @property
    def stall_nm(self) -> Array:
        """(6,) torque at full duty and at rest if nothing limited the current, N m."""
        return np.asarray(self.gear_ratio * self.torque_constant * SUPPLY_V / self.resistance_ohm)

    @property
    def emf_damping(self) -> Array:
        """(6,) torque lost per speed, N m s/rad: the motor's own voltage drives current back."""
        return np.asarray((self.gear_ratio * self.torque_constant) ** 2 / self.resistance_ohm)

    @property
    def no_load_rad_s(self) -> Array:
        """(6,) speed at full duty without load or friction, rad/s."""
        return np.asarray(SUPPLY_V / (self.gear_ratio * self.torque_constant))


def chosen(model: Arm, parts: Solids, friction: float = 1.0) -> Motors:
    """Choose motors and gears for a nominal arm; ``friction``: dry and viscous, of what is usual."""
    rng = np.random.default_rng(0)
    poses = rng.uniform(model.q_min, model.q_max, (_POSES, 6))
    gravity = np.max([np.abs(gravity_torque(model, parts, q)) for q in poses], axis=0)
    load = np.max([inertia(model, parts, q) for q in poses], axis=0)
    needed = gravity + ACCELERATION_SPARE * load * model.qdd_max
    needed = np.maximum(needed, _LEAST * needed.max())
    constant = np.full(6, _TORQUE_CONSTANT)
    gear = SUPPLY_V / (constant * _SPEED_SPARE * model.qd_max)
    resistance = gear * constant * SUPPLY_V / (_STALL_SPARE * needed)
    emf = (gear * constant) ** 2 / resistance
    return Motors(
        gear,
        constant,
        resistance,
        _TIME_CONSTANT_S * emf,
        _TORQUE_SPARE * needed / (gear * constant),
        friction * _COULOMB * needed,
        friction * _VISCOUS * emf,
        friction * _BEARING * needed,
        _BRAKE * needed,
        needed,
        gravity,
    )
