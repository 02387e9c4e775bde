"""Damped least squares: from a start to the joint angles whose pose comes closest to a wanted one.

The error is [position, m; rotation vector, rad], so that 1 mm counts as much as 1 mrad. Levenberg and Marquardt's method
(Nocedal and Wright, "Numerical Optimization", 2006, chapter 10) with the joints held within bounds: a joint that stands at
a bound and is pulled beyond it is left out of the step.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from armsight.data import Array
from armsight.robot.kinematics.chain import Frame, jacobian_base, tool_frame

#: Rows of the workspace (20, 6): Jacobian, normal matrix, then error, gradient, step and trial.
WORK = 20
#: An error of this squared length is as good as none.
_NONE = 1e-30
#: A step that takes off less than this share of the error ends the descent; so does this much damping.
_SLOW, _STIFF = 1e-9, 1e6

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})


@_kernel
def pose_error(F: Frame, G: Frame, error: Array) -> float:
    """Write what moves F onto G, [translation; rotation vector] in base axes; return its squared length."""
    x = 0.5 * (F[1] * G[2] - F[2] * G[1] + F[4] * G[5] - F[5] * G[4] + F[7] * G[8] - F[8] * G[7])
    y = 0.5 * (F[2] * G[0] - F[0] * G[2] + F[5] * G[3] - F[3] * G[5] + F[8] * G[6] - F[6] * G[8])
    z = 0.5 * (F[0] * G[1] - F[1] * G[0] + F[3] * G[4] - F[4] * G[3] + F[6] * G[7] - F[7] * G[6])
    s = math.sqrt(x * x + y * y + z * z)
    c = 0.5 * (F[0] * G[0] + F[1] * G[1] + F[2] * G[2] + F[3] * G[3] + F[4] * G[4] + F[5] * G[5])
    c += 0.5 * (F[6] * G[6] + F[7] * G[7] + F[8] * G[8] - 1.0)
    angle = math.atan2(s, c)
    scale = 1.0
    if s > 1e-9:
        scale = angle / s
    elif c < 0.0:  # half a turn exactly: any axis of it will do to start with
        x, scale = np.pi, 1.0
    error[0], error[1], error[2] = G[9] - F[9], G[10] - F[10], G[11] - F[11]
    error[3], error[4], error[5] = scale * x, scale * y, scale * z
    total = 0.0
    for i in range(6):
        total += error[i] * error[i]
    return total


@_kernel
def _solve(A: Array, g: Array, damping: float, step: Array) -> bool:
    """Solve (A + damping I) step = g by Cholesky; False where that cannot be done.

    A's upper half and g are read; the factor goes below A's diagonal, its own diagonal into ``step`` until the end.
    """
    for i in range(6):
        for j in range(i + 1):
            total = A[j, i]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if j < i:
                A[i, j] = total / step[j]
            elif total + damping > 0.0:
                step[i] = math.sqrt(total + damping)
            else:
                return False
    for i in range(6):
        total = g[i]
        for k in range(i):
            total -= A[i, k] * g[k]
        g[i] = total / step[i]
    for i in range(5, -1, -1):
        total = g[i]
        for k in range(i + 1, 6):
            total -= A[k, i] * g[k]
        g[i] = total / step[i]
    for i in range(6):
        step[i] = g[i]
    return True


@_kernel
def _normal(J: Array, e: Array, q: Array, low: Array, high: Array, A: Array, g: Array) -> None:
    """Write the upper half of J^T J, and J^T e; a joint at a bound and pulled beyond it is left out."""
    for i in range(6):
        total = 0.0
        for k in range(6):
            total += J[k, i] * e[k]
        g[i] = total
    for i in range(6):
        if (q[i] <= low[i] and g[i] < 0.0) or (q[i] >= high[i] and g[i] > 0.0):
            g[i] = 0.0
            for k in range(6):
                J[k, i] = 0.0
    for i in range(6):
        for j in range(i, 6):
            total = 0.0
            for k in range(6):
                total += J[k, i] * J[k, j]
            A[i, j] = total


@_kernel
def descend(table: Array, G: Frame, q: Array, low: Array, high: Array, most: int, work: Array) -> float:
    """Move joint angles (6,) in place towards a wanted frame, within bounds.

    Args:
        table: (96,) packed table.
        G: the wanted frame of the tool.
        q: (6,) where to start, within the bounds; where it ends.
        low: (6,) lower bounds, rad.
        high: (6,) upper bounds, rad.
        most: how many steps at most.
        work: (20, 6) workspace.

    Returns:
        the squared length of the error that is left.
    """
    J, A, e, g, step, trial = work[0:6], work[6:12], work[12], work[13], work[14], work[15]
    cost = np.inf
    damping, better = 0.0, True
    for _ in range(most):
        if better:
            cost = pose_error(jacobian_base(table, q, J), G, e)
            if cost < _NONE:
                break
            damping = 0.1 * damping if damping > 0.0 else 1e-6 * min(1.0, cost)
        _normal(J, e, q, low, high, A, g)
        size = 0.0
        after = np.inf
        if _solve(A, g, damping + 1e-18, step):
            for i in range(6):
                size = max(size, abs(step[i]))
            for i in range(6):
                trial[i] = min(high[i], max(low[i], q[i] + step[i] / max(1.0, size)))
            after = pose_error(tool_frame(table, trial), G, g)
        better = after < cost
        if better:
            q[:] = trial
            slow = cost - after < _SLOW * cost
            cost = after
            if slow:
                break
        else:
            damping = max(10.0 * damping, 1e-12)
            if damping > _STIFF:
                break
    return cost
