"""A wanted pose as it comes in: whether it is a rigid motion, and its rotation put right to the last place."""

from __future__ import annotations

import numba

from armsight.data import Array
from armsight.robot.kinematics.chain import Frame

#: Verdicts on a pose, beside 0.
NOT_FINITE, NOT_RIGID = -1, -2
#: A rotation may be off by this much and is then put right.
_NEARLY_RIGID = 1e-6

_kernel = numba.njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})


@_kernel
def rigid(T: Array) -> tuple[int, Frame]:
    """Return the verdict on a transform (4, 4), and its frame with the rotation put right."""
    total = 0.0
    for i in range(4):
        for j in range(4):
            total += T[i, j] * 0.0
    xx, xy, xz, yx, yy, yz = T[0, 0], T[1, 0], T[2, 0], T[0, 1], T[1, 1], T[2, 1]
    zx, zy, zz, px, py, pz = T[0, 2], T[1, 2], T[2, 2], T[0, 3], T[1, 3], T[2, 3]
    verdict = 0
    if total != 0.0:
        verdict = NOT_FINITE
    else:
        handed = (xy * yz - xz * yy) * zx + (xz * yx - xx * yz) * zy + (xx * yy - xy * yx) * zz
        if handed < 0.0 or T[3, 0] != 0.0 or T[3, 1] != 0.0 or T[3, 2] != 0.0 or T[3, 3] != 1.0:
            verdict = NOT_RIGID
    for _ in range(2):
        a, b = (0.5 * (xx * xx + xy * xy + xz * xz - 1.0), 0.5 * (yx * yx + yy * yy + yz * yz - 1.0))
        c, d = (0.5 * (zx * zx + zy * zy + zz * zz - 1.0), 0.5 * (xx * yx + xy * yy + xz * yz))
        e, f = 0.5 * (xx * zx + xy * zy + xz * zz), 0.5 * (yx * zx + yy * zy + yz * zz)
        off = max(max(abs(a), abs(b), abs(c)), max(abs(d), abs(e), abs(f)))
        if off > _NEARLY_RIGID and verdict == 0:
            verdict = NOT_RIGID
        if off < 1e-15 or verdict != 0:
            break
        # R (3 I - R^T R) / 2 has the same rotation and the square of the error (Bjorck and Bowie, 1971).
        xx, yx, zx = (xx - a * xx - d * yx - e * zx, yx - d * xx - b * yx - f * zx, zx - e * xx - f * yx - c * zx)
        xy, yy, zy = (xy - a * xy - d * yy - e * zy, yy - d * xy - b * yy - f * zy, zy - e * xy - f * yy - c * zy)
        xz, yz, zz = (xz - a * xz - d * yz - e * zz, yz - d * xz - b * yz - f * zz, zz - e * xz - f * yz - c * zz)
    return verdict, (xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz)
