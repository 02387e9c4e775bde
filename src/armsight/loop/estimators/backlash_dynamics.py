"""Dynamics of links inside their backlash: where gravity and inertia press them, step by step.

In: angles, speeds and accelerations of the gears' shafts. Out: where each link is in its backlash. A joint's gear can only
push: where gravity and acceleration press its link one way, the link is at that end of the backlash; where they change
sign it leaves, coasts, and comes to the other end some time later. Potentiometers on the shafts see none of it. Of a link's
angle beyond its shaft's e, a small one, the links' own equation of motion leaves

    M(q) e'' = contact - tau(q, q', q'') - friction,    |e_i| <= w_i / 2,

tau the torque that the links would need to follow their shafts, contact the push of the ends of the backlash. It is
stepped at the level of speeds, the contacts solved row by row (Moreau's scheme; Acary and Brogliato, "Numerical methods
for nonsmooth dynamical systems", 2008, ch. 10). Masses are not known: links are rods of one mass per length along the
table's d and a. That does, as only ratios count: of one torque to another, and to the friction of the links' bearings.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.kernels import kernel
from armsight.loop.estimators.parabola import fit, span, window
from armsight.robot.kinematics.arm import Arm
from armsight.robot.kinematics.chain import after_link, after_rotation, first_frame, sincos
from armsight.robot.kinematics.table import rows_of

GRAVITY_M_S2 = 9.81
#: Friction of a link's bearing over the greatest torque that gravity and acceleration need: typical of rolling bearings.
BEARING = 0.01
#: A rod is as thick as this share of the arm's length: what rotates about its own axis has inertia, too.
_THICK = 0.03
#: Random poses of which the greatest torque is taken.
_POSES = 64
#: Friction grows up to this speed of the link, rad/s; a step that would jump over standstill does not.
_SLOW_RAD_S = 0.01
#: Sweeps over the contacts in a step; the last step's result starts them.
_SWEEPS = 8

#: A longer time than this between two readings counts as so much, s.
_LONGEST_STEP_S = 0.01


def rods(arm: Arm) -> Array:
    """Return points with mass (K, 5) that stand for an arm's links: link, mass, position in the frame after the joint.

    Two points at the half-length's root third move as a rod does. Masses are of 1 kg/m. A last link without length is
    a disc as long as it is thick.
    """
    rows, points, last = rows_of(arm.table), [], arm.joints - 1
    for i, (a, d) in enumerate(rows[:, :2]):
        for along in (-1, 1):
            u = 0.5 + along / np.sqrt(12)
            points += [(i, 0.5 * abs(d), 0.0, 0.0, (u - 1) * d), (i, 0.5 * abs(a), u * a, 0.0, 0.0)]
    tip = arm.T_flange_tool[:3, 3]
    c, s = rows[last, 2:4]
    tip = np.array([rows[last, 0] + tip[0], c * tip[1] - s * tip[2], s * tip[1] + c * tip[2]])
    points.append((last, float(np.linalg.norm(arm.T_flange_tool[:3, 3])), *(0.5 * tip)))
    points = [point for point in points if point[1] > 0.0]
    if points[-1][0] != last:
        points.append((last, _thickness(arm), 0.0, 0.0, 0.0))
    return np.array(points)


def masses(arm: Arm) -> tuple[Array, Array]:
    """Return the points (K, 5) that stand for an arm's links; and (3, n) inertia, kg m^2, friction, N m, 1/N to a lever."""
    points = rods(arm)
    beyond = np.array([points[points[:, 0] >= i, 1].sum() for i in range(arm.joints)])
    own = beyond * 0.5 * _thickness(arm) ** 2
    n = arm.joints
    M, tau, gravity, inertia = np.empty((n, n)), np.empty((2, n)), np.zeros(n), np.zeros(n)
    rng, still = np.random.default_rng(0), np.zeros(n)
    for q in rng.uniform(arm.q_min, arm.q_max, (_POSES, n)):
        _dynamics(arm.table, points, own, q, still, still, M, tau)
        gravity, inertia = np.maximum(gravity, np.abs(tau[0])), np.maximum(inertia, np.diag(M))
    return points, np.stack([own, BEARING * (gravity + inertia * arm.qdd_max), 1 / (beyond * GRAVITY_M_S2)])


def _thickness(arm: Arm) -> float:
    """Return how thick the rods are that stand for an arm's links, m."""
    return float(_THICK * np.abs(rows_of(arm.table)[:, :2]).sum())


@kernel("const f8[::1], f8[:, ::1], f8[::1], const f8[::1], f8[::1], f8[::1], f8[:, ::1], f8[:, ::1]")
def _dynamics(table: Array, points: Array, own: Array, q: Array, qd: Array, qdd: Array, M: Array, tau: Array) -> None:
    """Write the inertia (n, n) of the links, and the torques that they need against gravity and to move so, (2, n).

    Speeds and accelerations go out from the base, link by link (Siciliano et al., "Robotics", 2009, section 7.5.2).
    """
    joints = q.shape[0]
    axes, J = np.empty((joints, 6)), np.empty((joints, 3))
    M[:], tau[:] = 0.0, 0.0
    wx = wy = wz = bx = by = bz = ax = ay = az = (
        0.0  # angular velocity, its rate, and the acceleration of the axis' point
    )
    F, n = first_frame(table), 0
    for i in range(joints):
        way = table[6 * i + 5]
        zx, zy, zz = way * F[6], way * F[7], way * F[8]
        ox, oy, oz = F[9], F[10], F[11]
        axes[i] = np.array([zx, zy, zz, ox, oy, oz])
        bx += zx * qdd[i] + qd[i] * (wy * zz - wz * zy)
        by += zy * qdd[i] + qd[i] * (wz * zx - wx * zz)
        bz += zz * qdd[i] + qd[i] * (wx * zy - wy * zx)
        wx, wy, wz = wx + zx * qd[i], wy + zy * qd[i], wz + zz * qd[i]
        s, c = sincos(table[6 * i + 5] * q[i] + table[6 * i + 4])
        F = after_rotation(table, i, c, s, F)
        while n < len(points) and points[n, 0] == i:
            mass, x, y, z = points[n, 1], points[n, 2], points[n, 3], points[n, 4]
            px = F[9] + F[0] * x + F[3] * y + F[6] * z
            py = F[10] + F[1] * x + F[4] * y + F[7] * z
            pz = F[11] + F[2] * x + F[5] * y + F[8] * z
            fx, fy, fz = _beyond(wx, wy, wz, bx, by, bz, px - ox, py - oy, pz - oz)
            for j in range(i + 1):
                rx, ry, rz = px - axes[j, 3], py - axes[j, 4], pz - axes[j, 5]
                J[j, 0] = axes[j, 1] * rz - axes[j, 2] * ry
                J[j, 1] = axes[j, 2] * rx - axes[j, 0] * rz
                J[j, 2] = axes[j, 0] * ry - axes[j, 1] * rx
                tau[0, j] += mass * GRAVITY_M_S2 * J[j, 2]
                tau[1, j] += mass * (J[j, 0] * (ax + fx) + J[j, 1] * (ay + fy) + J[j, 2] * (az + fz))
                for k in range(j + 1):
                    M[j, k] += mass * (J[j, 0] * J[k, 0] + J[j, 1] * J[k, 1] + J[j, 2] * J[k, 2])
            n += 1
        F = after_link(table, i, F)
        fx, fy, fz = _beyond(wx, wy, wz, bx, by, bz, F[9] - ox, F[10] - oy, F[11] - oz)
        ax, ay, az = ax + fx, ay + fy, az + fz
    for j in range(joints):
        M[j, j] += own[j]
        tau[1, j] += own[j] * qdd[j]
        for k in range(j):
            M[k, j] = M[j, k]


@kernel
def _beyond(
    wx: float, wy: float, wz: float, bx: float, by: float, bz: float, rx: float, ry: float, rz: float
) -> tuple[float, float, float]:
    """Return the acceleration of a point at r of a body beyond that of its origin, for angular velocity w, its rate b."""
    vx, vy, vz = wy * rz - wz * ry, wz * rx - wx * rz, wx * ry - wy * rx
    return (
        by * rz - bz * ry + wy * vz - wz * vy,
        bz * rx - bx * rz + wz * vx - wx * vz,
        bx * ry - by * rx + wx * vy - wy * vx,
    )


@kernel
def _step(
    table: Array, points: Array, beside: Array, motion: Array, dt: float, half: Array, position: Array, speed: Array,
    lever: Array,
) -> None:  # fmt: skip
    """Step links in half their backlash by a time dt: position and speed (n,) off their shafts, rad, rad/s; write levers.

    The shafts' motion (3, n) is angles, speeds and accelerations.
    """
    joints = half.shape[0]
    M, tau, b = np.empty((joints, joints)), np.empty((2, joints)), np.empty(joints)
    _dynamics(table, points, beside[0], motion[0], motion[1], motion[2], M, tau)
    for i in range(joints):
        slip = min(max((motion[1, i] + speed[i]) / _SLOW_RAD_S, -1.0), 1.0)
        lever[i] = -tau[1, i] * beside[2, i]
        b[i] = -dt * (tau[0, i] + tau[1, i] + beside[1, i] * slip)
        for j in range(joints):
            b[i] += M[i, j] * speed[j]
    for _ in range(_SWEEPS):
        for i in range(joints):
            x = b[i]
            for j in range(joints):
                if j != i:
                    x -= M[i, j] * speed[j]
            speed[i] = min(max(x / M[i, i], (-half[i] - position[i]) / dt), (half[i] - position[i]) / dt)
    for i in range(joints):
        position[i] += dt * speed[i]


@kernel("const f8[::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[::1]")
def loose(table: Array, points: Array, beside: Array, q: Array, out: Array) -> None:
    """Write 1 where the bearing of a link holds it against gravity at angles q (n,), else 0, to out (n,)."""
    joints = q.shape[0]
    M, tau, none = np.empty((joints, joints)), np.empty((2, joints)), np.zeros(joints)
    _dynamics(table, points, beside[0], q, none, none, M, tau)
    for i in range(joints):
        out[i] = 1.0 if abs(tau[0, i]) <= beside[1, i] else 0.0


@kernel
def float_on(
    t: Array, q: Array, memory: Array, first: int, begin: int, end: int, table: Array, points: Array, beside: Array,
    still: float, gap: Array,
) -> None:  # fmt: skip
    """Step links inside their backlash from row to row of readings.

    ``t``: (N,) times of the readings, s. ``q``: (N, n) readings, rad. ``memory``: (N, 4, n) to be written: position and
    speed in half gaps, how far the links have come in that, and lever of the torque of inertia, m. ``first``: first row
    there is. ``begin``: first row to be written. ``end``: the row after the last. ``table``: of the arm. ``points``:
    what stands for its links (K, 5). ``beside``: what each joint has beside them (3, n). ``still``: an arm none of
    whose joints is faster stands, rad/s: its links stand as well, and what is loose stays where it is while its shaft
    creeps. ``gap``: (n,) the backlash, rad.
    """
    joints = gap.shape[0]
    motion, position, speed, half = np.empty((3, joints)), np.empty(joints), np.empty(joints), 0.5 * gap
    free, stood, was = np.empty(joints), False, np.empty(joints)
    begin = max(begin, first + 1)
    for k in range(begin - 1, end):
        was[:] = motion[0]
        low, high = window(t, first, end - first, t[k], span(t[k], t[end - 1]))
        fit(t, q, low, high, t[k], motion)
        stands = np.abs(motion[1]).max() <= still
        if stands and not stood:  # as long as it stands gravity presses the same links
            loose(table, points, beside, motion[0], free)
            was[:] = motion[0]
        stood = stands
        if k < begin:
            continue
        before, now = memory[k - 1], memory[k]
        position[:], speed[:] = before[0] * half, before[1] * half
        if stands:
            for i in range(joints):
                position[i] = min(max(position[i] - free[i] * (motion[0, i] - was[i]), -half[i]), half[i])
            speed[:], now[3] = 0.0, 0.0
        else:
            _step(table, points, beside, motion, min(t[k] - t[k - 1], _LONGEST_STEP_S), half, position, speed, now[3])
        now[0], now[1] = position / half, speed / half
        now[2] = before[2] + np.abs(now[0] - before[0])
