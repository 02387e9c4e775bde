"""Forward kinematics, link frames, the geometric Jacobian and its rate, of a packed table.

A frame is carried as twelve numbers: the columns x, y, z of its rotation and its origin p, all in base axes. Jacobian:
column i is [z_i x (p_tool - p_i); z_i] (Siciliano et al., "Robotics", 2009, section 3.1.3). Its rate follows from its
own columns: d(J_i)/d(q_j) is z_j x J_i for j <= i and z_i x Jv_j for j > i (Bruyninckx and De Schutter, 1996).
"""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.robot.kinematics.trig import sincos

Frame = tuple[float, float, float, float, float, float, float, float, float, float, float, float]

#: Verdicts of the kernels that look at what they are given.
GOOD, NOT_FINITE, NOT_RADIANS = 0, 1, 2
#: No joint turns further than this, rad; an angle beyond it is most likely in degrees.
MOST_RADIANS = 20.0

# Kernels of some microseconds keep the interpreter: to get it back from a busy thread takes longer.
_kernel = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})


@_kernel
def verdict(q: Array) -> int:
    """Say whether joint angles (6,) are finite and can be radians: GOOD, NOT_FINITE or NOT_RADIANS."""
    largest = 0.0
    for i in range(6):
        if not abs(q[i]) < np.inf:
            return NOT_FINITE
        largest = max(largest, abs(q[i]))
    return NOT_RADIANS if largest > MOST_RADIANS else GOOD


@_kernel
def first_frame(table: Array) -> Frame:
    """Return frame 0 in the base."""
    t = table
    return (t[36], t[40], t[44], t[37], t[41], t[45], t[38], t[42], t[46], t[39], t[43], t[47])


@_kernel
def after_rotation(table: Array, i: int, c: float, s: float, F: Frame) -> Frame:
    """Carry a frame over joint i's turn and its shift d along the axis: Rz(theta) Tz(d)."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz = F
    d = table[6 * i + 1]
    return (
        c * xx + s * yx,
        c * xy + s * yy,
        c * xz + s * yz,
        c * yx - s * xx,
        c * yy - s * xy,
        c * yz - s * xz,
        zx,
        zy,
        zz,
        px + d * zx,
        py + d * zy,
        pz + d * zz,
    )


@_kernel
def after_link(table: Array, i: int, F: Frame) -> Frame:
    """Carry a frame over link i's length and twist: Tx(a) Rx(alpha)."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz = F
    a, ca, sa = table[6 * i], table[6 * i + 2], table[6 * i + 3]
    return (
        xx,
        xy,
        xz,
        ca * yx + sa * zx,
        ca * yy + sa * zy,
        ca * yz + sa * zz,
        ca * zx - sa * yx,
        ca * zy - sa * yy,
        ca * zz - sa * yz,
        px + a * xx,
        py + a * xy,
        pz + a * xz,
    )


@_kernel
def after(table: Array, k: int, F: Frame) -> Frame:
    """Carry a frame over the constant transform that stands at place k of the table."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz = F
    r00, r01, r02, t0 = table[k], table[k + 1], table[k + 2], table[k + 3]
    r10, r11, r12, t1 = table[k + 4], table[k + 5], table[k + 6], table[k + 7]
    r20, r21, r22, t2 = table[k + 8], table[k + 9], table[k + 10], table[k + 11]
    return (
        xx * r00 + yx * r10 + zx * r20,
        xy * r00 + yy * r10 + zy * r20,
        xz * r00 + yz * r10 + zz * r20,
        xx * r01 + yx * r11 + zx * r21,
        xy * r01 + yy * r11 + zy * r21,
        xz * r01 + yz * r11 + zz * r21,
        xx * r02 + yx * r12 + zx * r22,
        xy * r02 + yy * r12 + zy * r22,
        xz * r02 + yz * r12 + zz * r22,
        px + xx * t0 + yx * t1 + zx * t2,
        py + xy * t0 + yy * t1 + zy * t2,
        pz + xz * t0 + yz * t1 + zz * t2,
    )


@_kernel
def before(table: Array, k: int, F: Frame) -> Frame:
    """See a frame from where the constant transform at place k of the table maps to."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz = F
    r00, r01, r02, t0 = table[k], table[k + 1], table[k + 2], table[k + 3]
    r10, r11, r12, t1 = table[k + 4], table[k + 5], table[k + 6], table[k + 7]
    r20, r21, r22, t2 = table[k + 8], table[k + 9], table[k + 10], table[k + 11]
    return (
        r00 * xx + r01 * xy + r02 * xz,
        r10 * xx + r11 * xy + r12 * xz,
        r20 * xx + r21 * xy + r22 * xz,
        r00 * yx + r01 * yy + r02 * yz,
        r10 * yx + r11 * yy + r12 * yz,
        r20 * yx + r21 * yy + r22 * yz,
        r00 * zx + r01 * zy + r02 * zz,
        r10 * zx + r11 * zy + r12 * zz,
        r20 * zx + r21 * zy + r22 * zz,
        r00 * px + r01 * py + r02 * pz + t0,
        r10 * px + r11 * py + r12 * pz + t1,
        r20 * px + r21 * py + r22 * pz + t2,
    )


@_kernel
def store(F: Frame, T: Array) -> None:
    """Write a frame into a transform (4, 4)."""
    T[0, 0], T[1, 0], T[2, 0], T[3, 0] = F[0], F[1], F[2], 0.0
    T[0, 1], T[1, 1], T[2, 1], T[3, 1] = F[3], F[4], F[5], 0.0
    T[0, 2], T[1, 2], T[2, 2], T[3, 2] = F[6], F[7], F[8], 0.0
    T[0, 3], T[1, 3], T[2, 3], T[3, 3] = F[9], F[10], F[11], 1.0


@_kernel
def tool_frame(table: Array, q: Array) -> Frame:
    """Return the tool's frame at joint angles (6,)."""
    F = first_frame(table)
    for i in range(6):
        s, c = sincos(table[6 * i + 5] * q[i] + table[6 * i + 4])
        F = after_link(table, i, after_rotation(table, i, c, s, F))
    return after(table, 48, F)


@_kernel
def forward(table: Array, q: Array, T: Array) -> int:
    """Write the tool's pose at joint angles (6,) into T_base_tool (4, 4); returns the verdict on q."""
    store(tool_frame(table, q), T)
    return verdict(q)


@_kernel
def links(table: Array, q: Array, Ts: Array) -> int:
    """Write frame 0, the frames of links 1 to 6 and the tool's into (8, 4, 4); returns the verdict on q."""
    modified = table[60] != 0.0
    F = first_frame(table)
    store(F, Ts[0])
    for i in range(6):
        s, c = sincos(table[6 * i + 5] * q[i] + table[6 * i + 4])
        turned = after_rotation(table, i, c, s, F)
        F = after_link(table, i, turned)
        store(turned if modified else F, Ts[i + 1])
    store(after(table, 48, F), Ts[7])
    return verdict(q)


@_kernel
def _axes(table: Array, q: Array, J: Array) -> Frame:
    """Write the joints' axes into rows 3 to 5 of J and points on them into rows 0 to 2; return the tool's frame."""
    F = first_frame(table)
    for i in range(6):
        way = table[6 * i + 5]
        J[0, i], J[1, i], J[2, i] = F[9], F[10], F[11]
        J[3, i], J[4, i], J[5, i] = way * F[6], way * F[7], way * F[8]
        s, c = sincos(way * q[i] + table[6 * i + 4])
        F = after_link(table, i, after_rotation(table, i, c, s, F))
    return after(table, 48, F)


@_kernel
def jacobian_base(table: Array, q: Array, J: Array) -> Frame:
    """Write the Jacobian (6, 6) in base axes; return the tool's frame."""
    F = _axes(table, q, J)
    for i in range(6):
        rx, ry, rz = F[9] - J[0, i], F[10] - J[1, i], F[11] - J[2, i]
        zx, zy, zz = J[3, i], J[4, i], J[5, i]
        J[0, i], J[1, i], J[2, i] = zy * rz - zz * ry, zz * rx - zx * rz, zx * ry - zy * rx
    return F


@_kernel
def _into_tool_axes(F: Frame, J: Array) -> None:
    """Turn the columns of J from base axes into the axes of a frame."""
    for i in range(6):
        for k in (0, 3):
            x, y, z = J[k, i], J[k + 1, i], J[k + 2, i]
            J[k, i] = F[0] * x + F[1] * y + F[2] * z
            J[k + 1, i] = F[3] * x + F[4] * y + F[5] * z
            J[k + 2, i] = F[6] * x + F[7] * y + F[8] * z


@_kernel
def jacobian(table: Array, q: Array, in_tool_axes: bool, J: Array) -> int:
    """Write the Jacobian (6, 6) of the tool's point, [linear; angular] rows; returns the verdict on q."""
    F = jacobian_base(table, q, J)
    if in_tool_axes:
        _into_tool_axes(F, J)
    return verdict(q)


@_kernel
def jacobian_batch(table: Array, q: Array, in_tool_axes: bool, J: Array) -> int:
    """Write the Jacobians at joint angles (N, 6) into (N, 6, 6); returns the worst verdict."""
    worst = GOOD
    for n in range(q.shape[0]):
        worst = max(worst, jacobian(table, q[n], in_tool_axes, J[n]))
    return worst


@_kernel
def jacobian_rate(table: Array, q: Array, qd: Array, in_tool_axes: bool, J: Array) -> int:
    """Write the time derivative of the Jacobian (6, 6); returns the verdict on q."""
    F = jacobian_base(table, q, J)
    vx = vy = vz = ox = oy = oz = 0.0  # the tool's whole velocity
    for i in range(6):
        vx, vy, vz = vx + J[0, i] * qd[i], vy + J[1, i] * qd[i], vz + J[2, i] * qd[i]
        ox, oy, oz = ox + J[3, i] * qd[i], oy + J[4, i] * qd[i], oz + J[5, i] * qd[i]
    # In tool axes the columns are seen from a frame that turns with the tool, so its turning is taken off.
    wx, wy, wz = (-ox, -oy, -oz) if in_tool_axes else (0.0, 0.0, 0.0)
    for i in range(6):
        lx, ly, lz, zx, zy, zz = J[0, i], J[1, i], J[2, i], J[3, i], J[4, i], J[5, i]
        # w: what turns the axis (joints up to i; axis i does not turn itself); v: what moves the tool beyond joint i.
        vx, vy, vz = vx - lx * qd[i], vy - ly * qd[i], vz - lz * qd[i]
        J[3, i], J[4, i], J[5, i] = wy * zz - wz * zy, wz * zx - wx * zz, wx * zy - wy * zx
        wx, wy, wz = wx + zx * qd[i], wy + zy * qd[i], wz + zz * qd[i]
        J[0, i] = wy * lz - wz * ly + zy * vz - zz * vy
        J[1, i] = wz * lx - wx * lz + zz * vx - zx * vz
        J[2, i] = wx * ly - wy * lx + zx * vy - zy * vx
    if in_tool_axes:
        _into_tool_axes(F, J)
    return verdict(q)
