"""Forward kinematics of a packed table: tool and link frames, the geometric Jacobian and its rate, one or many at once.

In: a table (102,) packed by :func:`armsight.robot.kinematics.table.packed` and joint angles, rad. Out: poses in the base
frame, m, and Jacobians. Three parts: sine, cosine and angle without calls into the system's library; one configuration;
a batch of eight configurations.

A frame is carried as twelve numbers: the columns x, y, z of its rotation and its origin p, all in base axes. Jacobian:
column i is [z_i x (p_tool - p_i); z_i] (Siciliano et al., "Robotics", 2009, section 3.1.3). Its rate follows from its
own columns: d(J_i)/d(q_j) is z_j x J_i for j <= i and z_i x Jv_j for j > i (Bruyninckx and De Schutter, 1996).

How many joints an arm has stands in its table. Six, the usual number, has loops of its own: the compiler unrolls them.

A batch array holds number i of configuration k at index ``8 * i + k``: angles, sines and cosines (8 n,), frames (96,) as
the twelve numbers above. The compiler makes vector instructions of the loops over k. The count n of configurations in use
is a variable on purpose: a loop whose length is known is unrolled instead.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.kernels import kernel
from armsight.robot.kinematics.table import BASE, JOINTS, MODIFIED, MOST_JOINTS, TOOL

Frame = tuple[float, float, float, float, float, float, float, float, float, float, float, float]

#: The validity of joint angles, as the kernels return it.
GOOD, NOT_FINITE, NOT_RADIANS = range(3)
#: No joint rotates further than this, rad; an angle beyond it is most likely in degrees.
MOST_RADIANS = 20.0
#: Configurations in a batch, and the size of forward_batch's workspace.
BATCH, BATCH_WORK = 8, 3 * 8 * MOST_JOINTS + 96

#: 2 / pi, and pi / 2 in three parts of which the first two have zeros for their last bits, so that the product with a
#: small whole number is exact (Cody and Waite, "Software Manual for the Elementary Functions", 1980).
_QUARTERS = 2.0 / np.pi
_P1, _P2, _P3 = 1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21
#: tan(pi / 8), and what pi / 4 and pi / 2 are beyond their nearest doubles.
_TAN_8TH = np.sqrt(2.0) - 1.0
_BEYOND_4TH, _BEYOND_HALF = 3.061616997868383e-17, 6.123233995736766e-17

# Kernels of some microseconds keep the interpreter: to get it back from a busy thread takes longer.


@kernel("f8", fastmath={"contract", "nsz"})
def sincos(x: float) -> tuple[float, float]:
    """Return sin(x), cos(x), x in rad."""
    k = np.floor(x * _QUARTERS + 0.5)
    r = ((x - k * _P1) - k * _P2) - k * _P3
    z = r * r
    # Taylor's series: what is left out is below 1e-19 for |r| <= pi / 4.
    s = 1.0 / 6227020800.0 + z * (-1.0 / 1307674368000.0 + z * (1.0 / 355687428096000.0))
    s = -1.0 / 6.0 + z * (1.0 / 120.0 + z * (-1.0 / 5040.0 + z * (1.0 / 362880.0 + z * (-1.0 / 39916800.0 + z * s))))
    s = r + r * z * s
    c = -1.0 / 87178291200.0 + z * (1.0 / 20922789888000.0)
    c = 1.0 / 24.0 + z * (-1.0 / 720.0 + z * (1.0 / 40320.0 + z * (-1.0 / 3628800.0 + z * (1.0 / 479001600.0 + z * c))))
    c = 1.0 - 0.5 * z + z * z * c
    quarter = np.int32(k) & 3
    sin = c if quarter & 1 else s
    cos = s if quarter & 1 else c
    return (-sin if quarter & 2 else sin), (-cos if (quarter + 1) & 2 else cos)


@kernel("f8, f8", fastmath={"contract", "nsz"})
def angle_of(y: float, x: float) -> float:
    """Return the angle of the point (x, y), rad in [-pi, pi]; 0 at the origin."""
    across, along = abs(y), abs(x)
    high = across if across > along else along
    low = along if across > along else across
    # The angle of low / high, at most pi / 4; beyond pi / 8 that of the same point rotated back by pi / 4.
    rotated = low > _TAN_8TH * high
    over = low - high if rotated else low
    under = low + high if rotated else high
    t = over / (under if under > 0.0 else 1.0)
    z = t * t
    # Taylor's series: what is left out is below 1e-18 for |t| <= tan(pi / 8).
    p = 1.0 / 37.0 - z * (1.0 / 39.0 - z * (1.0 / 41.0 - z * (1.0 / 43.0)))
    p = 1.0 / 29.0 - z * (1.0 / 31.0 - z * (1.0 / 33.0 - z * (1.0 / 35.0 - z * p)))
    p = 1.0 / 21.0 - z * (1.0 / 23.0 - z * (1.0 / 25.0 - z * (1.0 / 27.0 - z * p)))
    p = 1.0 / 13.0 - z * (1.0 / 15.0 - z * (1.0 / 17.0 - z * (1.0 / 19.0 - z * p)))
    p = 1.0 / 5.0 - z * (1.0 / 7.0 - z * (1.0 / 9.0 - z * (1.0 / 11.0 - z * p)))
    angle = t - t * z * (1.0 / 3.0 - z * p)
    angle = (angle + _BEYOND_4TH) + 0.25 * np.pi if rotated else angle
    angle = (0.5 * np.pi - angle) + _BEYOND_HALF if across > along else angle
    angle = (np.pi - angle) + 2.0 * _BEYOND_HALF if x < 0.0 else angle
    return -angle if y < 0.0 else angle


@kernel(fastmath={"contract", "nsz"})
def sincos_each(angles: Array, sines: Array, cosines: Array, n: int) -> None:
    """Write the sines and cosines of the first n angles, rad."""
    for k in range(n):
        sines[k], cosines[k] = sincos(angles[k])


@kernel(fastmath={"contract", "nsz"})
def angle_of_each(y: Array, x: Array, angles: Array, n: int) -> None:
    """Write the angles of the first n points (x, y), rad."""
    for k in range(n):
        angles[k] = angle_of(y[k], x[k])


@kernel("f8[::1]", fastmath={"contract", "nsz"})
def validity(q: Array) -> int:
    """Return whether joint angles (n,) are finite and can be radians: GOOD, NOT_FINITE or NOT_RADIANS."""
    largest = 0.0
    for i in range(q.shape[0]):
        if not abs(q[i]) < np.inf:
            return NOT_FINITE
        largest = max(largest, abs(q[i]))
    return NOT_RADIANS if largest > MOST_RADIANS else GOOD


@kernel(fastmath={"contract", "nsz"})
def first_frame(table: Array) -> Frame:
    """Return frame 0 in the base."""
    t, k = table, BASE
    xx, xy, xz, yx, yy, yz = t[k], t[k + 4], t[k + 8], t[k + 1], t[k + 5], t[k + 9]
    return (xx, xy, xz, yx, yy, yz, t[k + 2], t[k + 6], t[k + 10], t[k + 3], t[k + 7], t[k + 11])


@kernel(fastmath={"contract", "nsz"})
def after_rotation(table: Array, i: int, c: float, s: float, F: Frame) -> Frame:
    """Carry a frame over joint i's rotation and its shift d along the axis: Rz(theta) Tz(d)."""
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


@kernel(fastmath={"contract", "nsz"})
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


@kernel(fastmath={"contract", "nsz"})
def after(table: Array, k: int, F: Frame) -> Frame:
    """Carry a frame over the constant transform that stands at index k of the table: F @ T."""
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


@kernel(fastmath={"contract", "nsz"})
def before(table: Array, k: int, F: Frame) -> Frame:
    """Carry a frame into where the constant transform at index k of the table maps to: T @ F."""
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


@kernel(fastmath={"contract", "nsz"})
def store(F: Frame, T: Array) -> None:
    """Write a frame into a transform (4, 4)."""
    T[0, 0], T[1, 0], T[2, 0], T[3, 0] = F[0], F[1], F[2], 0.0
    T[0, 1], T[1, 1], T[2, 1], T[3, 1] = F[3], F[4], F[5], 0.0
    T[0, 2], T[1, 2], T[2, 2], T[3, 2] = F[6], F[7], F[8], 0.0
    T[0, 3], T[1, 3], T[2, 3], T[3, 3] = F[9], F[10], F[11], 1.0


@kernel(fastmath={"contract", "nsz"}, forceinline=True)
def _tool_frame(table: Array, q: Array, joints: int) -> Frame:
    """Return the tool's frame at so many joint angles."""
    F = first_frame(table)
    for i in range(joints):
        s, c = sincos(table[6 * i + 5] * q[i] + table[6 * i + 4])
        F = after_link(table, i, after_rotation(table, i, c, s, F))
    return after(table, TOOL, F)


@kernel(fastmath={"contract", "nsz"})
def tool_six(table: Array, q: Array) -> Frame:
    """Return the tool's frame at joint angles (6,)."""
    return _tool_frame(table, q, 6)


@kernel(fastmath={"contract", "nsz"})
def tool_frame(table: Array, q: Array) -> Frame:
    """Return the tool's frame at joint angles (n,)."""
    return tool_six(table, q) if q.shape[0] == 6 else _tool_frame(table, q, q.shape[0])


@kernel("const f8[::1], f8[::1], f8[:, ::1]", fastmath={"contract", "nsz"})
def forward(table: Array, q: Array, T: Array) -> int:
    """Write the tool's pose at joint angles (n,) into T_base_tool (4, 4); returns the validity of q."""
    store(tool_frame(table, q), T)
    return validity(q)


@kernel("const f8[::1], f8[::1], f8[:, :, ::1]", fastmath={"contract", "nsz"})
def links(table: Array, q: Array, Ts: Array) -> int:
    """Write frame 0, the frames of links 1 to n and the tool's into (n + 2, 4, 4); returns the validity of q."""
    modified = table[MODIFIED] != 0.0
    F = first_frame(table)
    store(F, Ts[0])
    for i in range(q.shape[0]):
        s, c = sincos(table[6 * i + 5] * q[i] + table[6 * i + 4])
        rotated = after_rotation(table, i, c, s, F)
        F = after_link(table, i, rotated)
        store(rotated if modified else F, Ts[i + 1])
    store(after(table, TOOL, F), Ts[q.shape[0] + 1])
    return validity(q)


@kernel(fastmath={"contract", "nsz"}, forceinline=True)
def _jacobian_base(table: Array, q: Array, J: Array, joints: int) -> Frame:
    """Write the Jacobian (6, n) of so many joints in base axes; return the tool's frame."""
    F = first_frame(table)
    for i in range(joints):
        way = table[6 * i + 5]
        # A point on the joint's axis, and the axis itself.
        J[0, i], J[1, i], J[2, i] = F[9], F[10], F[11]
        J[3, i], J[4, i], J[5, i] = way * F[6], way * F[7], way * F[8]
        s, c = sincos(way * q[i] + table[6 * i + 4])
        F = after_link(table, i, after_rotation(table, i, c, s, F))
    F = after(table, TOOL, F)
    for i in range(joints):
        rx, ry, rz = F[9] - J[0, i], F[10] - J[1, i], F[11] - J[2, i]
        zx, zy, zz = J[3, i], J[4, i], J[5, i]
        J[0, i], J[1, i], J[2, i] = zy * rz - zz * ry, zz * rx - zx * rz, zx * ry - zy * rx
    return F


@kernel(fastmath={"contract", "nsz"})
def jacobian_six(table: Array, q: Array, J: Array) -> Frame:
    """Write the Jacobian (6, 6) in base axes; return the tool's frame."""
    return _jacobian_base(table, q, J, 6)


@kernel(fastmath={"contract", "nsz"})
def jacobian_base(table: Array, q: Array, J: Array) -> Frame:
    """Write the Jacobian (6, n) in base axes; return the tool's frame."""
    return jacobian_six(table, q, J) if q.shape[0] == 6 else _jacobian_base(table, q, J, q.shape[0])


@kernel(fastmath={"contract", "nsz"})
def _into_tool_axes(F: Frame, J: Array) -> None:
    """Express the columns of J, given in base axes, in the axes of a frame."""
    for i in range(J.shape[1]):
        for k in (0, 3):
            x, y, z = J[k, i], J[k + 1, i], J[k + 2, i]
            J[k, i] = F[0] * x + F[1] * y + F[2] * z
            J[k + 1, i] = F[3] * x + F[4] * y + F[5] * z
            J[k + 2, i] = F[6] * x + F[7] * y + F[8] * z


@kernel("const f8[::1], f8[::1], b1, f8[:, ::1]", fastmath={"contract", "nsz"})
def jacobian(table: Array, q: Array, in_tool_axes: bool, J: Array) -> int:
    """Write the Jacobian (6, n) of the tool's point, [linear; angular] rows; returns the validity of q."""
    F = jacobian_base(table, q, J)
    if in_tool_axes:
        _into_tool_axes(F, J)
    return validity(q)


@kernel("const f8[::1], f8[:, ::1], b1, f8[:, :, ::1]", fastmath={"contract", "nsz"})
def jacobian_batch(table: Array, q: Array, in_tool_axes: bool, J: Array) -> int:
    """Write the Jacobians at joint angles (N, n) into (N, 6, n); returns the worst validity."""
    worst = GOOD
    for n in range(q.shape[0]):
        worst = max(worst, jacobian(table, q[n], in_tool_axes, J[n]))
    return worst


@kernel(fastmath={"contract", "nsz"}, forceinline=True)
def _jacobian_rate(F: Frame, qd: Array, in_tool_axes: bool, J: Array, joints: int) -> None:
    """Write the time derivative of the Jacobian (6, n) of so many joints in place of the Jacobian in base axes."""
    vx = vy = vz = ox = oy = oz = 0.0  # the tool's whole velocity
    for i in range(joints):
        vx, vy, vz = vx + J[0, i] * qd[i], vy + J[1, i] * qd[i], vz + J[2, i] * qd[i]
        ox, oy, oz = ox + J[3, i] * qd[i], oy + J[4, i] * qd[i], oz + J[5, i] * qd[i]
    # In tool axes the columns are seen from a frame that rotates with the tool, so its rotation is subtracted.
    wx, wy, wz = (-ox, -oy, -oz) if in_tool_axes else (0.0, 0.0, 0.0)
    for i in range(joints):
        lx, ly, lz, zx, zy, zz = J[0, i], J[1, i], J[2, i], J[3, i], J[4, i], J[5, i]
        # w: what rotates the axis (joints up to i; axis i does not rotate itself); v: what moves the tool beyond joint i.
        vx, vy, vz = vx - lx * qd[i], vy - ly * qd[i], vz - lz * qd[i]
        J[3, i], J[4, i], J[5, i] = wy * zz - wz * zy, wz * zx - wx * zz, wx * zy - wy * zx
        wx, wy, wz = wx + zx * qd[i], wy + zy * qd[i], wz + zz * qd[i]
        J[0, i] = wy * lz - wz * ly + zy * vz - zz * vy
        J[1, i] = wz * lx - wx * lz + zz * vx - zx * vz
        J[2, i] = wx * ly - wy * lx + zx * vy - zy * vx
    if in_tool_axes:
        _into_tool_axes(F, J)


@kernel("const f8[::1], f8[::1], f8[::1], b1, f8[:, ::1]", fastmath={"contract", "nsz"})
def jacobian_rate(table: Array, q: Array, qd: Array, in_tool_axes: bool, J: Array) -> int:
    """Write the time derivative of the Jacobian (6, n); returns the validity of q."""
    F = jacobian_base(table, q, J)
    if q.shape[0] == 6:
        _jacobian_rate(F, qd, in_tool_axes, J, 6)
    else:
        _jacobian_rate(F, qd, in_tool_axes, J, q.shape[0])
    return validity(q)


@kernel(fastmath={"contract", "nsz"})
def _joint(table: Array, i: int, sines: Array, cosines: Array, k: int, F: Frame) -> Frame:
    """Carry the frame of the batch's configuration k over joint i and its link."""
    return after_link(table, i, after_rotation(table, i, cosines[8 * i + k], sines[8 * i + k], F))


@kernel(fastmath={"contract", "nsz"})
def _to_batch(F: Frame, out: Array, k: int) -> None:
    out[k], out[8 + k], out[16 + k] = F[0], F[1], F[2]
    out[24 + k], out[32 + k], out[40 + k] = F[3], F[4], F[5]
    out[48 + k], out[56 + k], out[64 + k] = F[6], F[7], F[8]
    out[72 + k], out[80 + k], out[88 + k] = F[9], F[10], F[11]


@kernel(fastmath={"contract", "nsz"})
def frames(table: Array, sines: Array, cosines: Array, out: Array, n: int) -> None:
    """Write the tool's frames (96,) for sines and cosines (8 n,) of theta."""
    first = first_frame(table)
    if table[JOINTS] != 6.0:
        for k in range(n):
            F = first
            for i in range(int(table[JOINTS])):
                F = _joint(table, i, sines, cosines, k, F)
            _to_batch(after(table, TOOL, F), out, k)
        return
    for k in range(n):
        F = _joint(table, 0, sines, cosines, k, first)
        F = _joint(table, 1, sines, cosines, k, F)
        F = _joint(table, 2, sines, cosines, k, F)
        F = _joint(table, 3, sines, cosines, k, F)
        F = _joint(table, 4, sines, cosines, k, F)
        F = _joint(table, 5, sines, cosines, k, F)
        _to_batch(after(table, TOOL, F), out, k)


@kernel(fastmath={"contract", "nsz"})
def thetas(table: Array, q: Array, theta: Array, n: int) -> None:
    """Write theta (48,) of six joints' angles (48,), rad."""
    for i in range(6):
        way, offset = table[6 * i + 5], table[6 * i + 4]
        for k in range(n):
            theta[8 * i + k] = way * q[8 * i + k] + offset


@kernel(fastmath={"contract", "nsz"})
def errors(out: Array, G: Frame, position: Array, angle: Array, n: int) -> None:
    """Write how far frames (96,) are off a frame: position, m, and the sine of the angle, or 1 beyond 90 degrees."""
    for k in range(n):
        xx, xy, xz, yx, yy, yz = out[k], out[8 + k], out[16 + k], out[24 + k], out[32 + k], out[40 + k]
        zx, zy, zz = out[48 + k], out[56 + k], out[64 + k]
        dx, dy, dz = out[72 + k] - G[9], out[80 + k] - G[10], out[88 + k] - G[11]
        ex = xy * G[2] - xz * G[1] + yy * G[5] - yz * G[4] + zy * G[8] - zz * G[7]
        ey = xz * G[0] - xx * G[2] + yz * G[3] - yx * G[5] + zz * G[6] - zx * G[8]
        ez = xx * G[1] - xy * G[0] + yx * G[4] - yy * G[3] + zx * G[7] - zy * G[6]
        trace = xx * G[0] + xy * G[1] + xz * G[2] + yx * G[3] + yy * G[4] + yz * G[5]
        trace += zx * G[6] + zy * G[7] + zz * G[8]
        position[k] = np.sqrt(dx * dx + dy * dy + dz * dz)
        angle[k] = 0.5 * np.sqrt(ex * ex + ey * ey + ez * ez) if trace > 1.0 else 1.0


@kernel("const f8[::1], f8[:, ::1], f8[:, :, ::1], f8[::1], i8", fastmath={"contract", "nsz"})
def forward_batch(table: Array, q: Array, Ts: Array, work: Array, n: int) -> int:
    """Write the tool's poses at joint angles (N, n) into (N, 4, 4); returns the worst validity.

    ``work`` is (BATCH_WORK,), ``n`` is 8.
    """
    worst, count, joints = 0, q.shape[0], q.shape[1]
    theta, sines, cosines, out = work[:56], work[56:112], work[112:168], work[168:264]
    theta[:] = 0.0
    for start in range(0, count, n):
        used = min(n, count - start)
        for k in range(used):
            worst = max(worst, validity(q[start + k]))
            for i in range(joints):
                theta[8 * i + k] = table[6 * i + 5] * q[start + k, i] + table[6 * i + 4]
        sincos_each(theta, sines, cosines, joints * n)
        frames(table, sines, cosines, out, n)
        for k in range(used):
            T = Ts[start + k]
            for j in range(4):
                for i in range(3):
                    T[i, j] = out[8 * (3 * j + i) + k]
                T[3, j] = 1.0 if j == 3 else 0.0
    return worst
