"""Eight joint configurations side by side, so that the compiler turns their kinematics into vector instructions.

A lane array holds number i of configuration l at place ``8 * i + l``: angles, sines and cosines (48,), frames (96,) as the
twelve numbers of ``chain``. The count n of lanes in use is a variable on purpose: a loop whose length is known is unrolled
instead.
"""

from __future__ import annotations

import numba
import numpy as np

from armsight.data import Array
from armsight.robot.kinematics.chain import Frame, after, after_link, after_rotation, first_frame, verdict
from armsight.robot.kinematics.table import TOOL
from armsight.robot.kinematics.trig import sincos_each

LANES = 8
#: Size of forward_batch's workspace.
WORK = 240

_kernel = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})


@_kernel
def _joint(table: Array, i: int, sines: Array, cosines: Array, lane: int, F: Frame) -> Frame:
    """Carry one lane's frame over joint i and its link."""
    return after_link(table, i, after_rotation(table, i, cosines[8 * i + lane], sines[8 * i + lane], F))


@_kernel
def frames(table: Array, sines: Array, cosines: Array, out: Array, n: int) -> None:
    """Write the tool's frames (96,) for sines and cosines (48,) of theta."""
    first = first_frame(table)
    for k in range(n):
        F = _joint(table, 0, sines, cosines, k, first)
        F = _joint(table, 1, sines, cosines, k, F)
        F = _joint(table, 2, sines, cosines, k, F)
        F = _joint(table, 3, sines, cosines, k, F)
        F = _joint(table, 4, sines, cosines, k, F)
        F = _joint(table, 5, sines, cosines, k, F)
        F = after(table, TOOL, F)
        out[k], out[8 + k], out[16 + k] = F[0], F[1], F[2]
        out[24 + k], out[32 + k], out[40 + k] = F[3], F[4], F[5]
        out[48 + k], out[56 + k], out[64 + k] = F[6], F[7], F[8]
        out[72 + k], out[80 + k], out[88 + k] = F[9], F[10], F[11]


@_kernel
def thetas(table: Array, q: Array, theta: Array, n: int) -> None:
    """Write theta (48,) of joint angles (48,), rad."""
    for i in range(6):
        way, offset = table[6 * i + 5], table[6 * i + 4]
        for k in range(n):
            theta[8 * i + k] = way * q[8 * i + k] + offset


@_kernel
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


@_kernel
def forward_batch(table: Array, q: Array, Ts: Array, work: Array, n: int) -> int:
    """Write the tool's poses at joint angles (N, 6) into (N, 4, 4); work is (240,), n is 8. Returns the worst verdict."""
    worst, count = 0, q.shape[0]
    theta, sines, cosines, out = work[:48], work[48:96], work[96:144], work[144:240]
    theta[:] = 0.0
    for start in range(0, count, n):
        used = min(n, count - start)
        for k in range(used):
            worst = max(worst, verdict(q[start + k]))
            for i in range(6):
                theta[8 * i + k] = table[6 * i + 5] * q[start + k, i] + table[6 * i + 4]
        sincos_each(theta, sines, cosines, 6 * n)
        frames(table, sines, cosines, out, n)
        for k in range(used):
            T = Ts[start + k]
            for j in range(4):
                for i in range(3):
                    T[i, j] = out[8 * (3 * j + i) + k]
                T[3, j] = 1.0 if j == 3 else 0.0
    return worst
