"""Inverse kinematics of four, five and seven joints, by damped least squares from many starts within the joint limits.

In: the packed table (102,), limits and T_base_tool. Out: joint angles, and how far the tool is off the pose there.

Seven joints leave one motion free that does not move the tool. Once the pose is met, the arm slides along it by Newton's
method to where :func:`_crowded` is least: near a goal, and away from the limits.

Fewer than six joints reach few poses exactly. The order of priority is fixed: the position, then the direction of the
tool's z axis, then the rotation about it. Descents with weights in that order find where to begin; then every level is
solved in what the levels before leave free (Nakamura, Hanafusa and Yoshikawa, "Task-priority based redundancy control of
robot manipulators", 1987), so that the position is exact where it can be reached at all.
"""

from __future__ import annotations

import math

import numpy as np

from armsight.data import Array
from armsight.kernels import kernel
from armsight.robot.kinematics.chain import Frame, jacobian_base, tool_frame
from armsight.robot.kinematics.inverse import STIFF, pose_error, rigid, solve

#: Size of a call's workspace: rows of seven numbers.
_ROWS = 34
SCRATCH = 7 * _ROWS
#: A descent ends with an error of this squared length, or where a step takes off less than this share of it.
_NONE, _SLOW = 1e-26, 1e-4
#: Steps of a descent at most, and starts; no joint moves further in a step, rad.
_STEPS, _STARTS, _FURTHEST = 40, 200, 1.0
#: Weights of the direction of the tool's z axis and of the rotation about it, for fewer than six joints: m for 1 rad.
_AXIS, _ROLL = 0.3, 0.1
#: Fractional parts of multiples of its powers spread evenly in seven dimensions: the root of x^8 = x + 1 (Roberts, 2018).
_SPREAD = 1.0969815577985598
#: Steps along the free motion, the furthest of them and of those of the levels, rad, the share of a joint's range from its
#: middle from which on it is pushed back, and how strongly.
_SLIDES, _SLIDE_RAD, _EDGE, _PUSH = 8, 0.3, 0.85, 100.0
#: Steps of the levels of priority, the least that is taken, rad, and the damping of the position.
_LEVEL_STEPS, _STILL, _FIRM = 60, 1e-13, 1e-14
#: Motions that change a direction less than this, squared, rad per rad, are not used for it: to gain a hundredth of a
#: radian the wrist would rotate by half a revolution.
_WEAK = 1e-2


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _weigh(F: Frame, joints: int, J: Array, e: Array) -> float:
    """Give the rotation's rows of J and e their weights, for fewer than six joints; return the error's squared length."""
    if joints < 6:
        zx, zy, zz = F[6], F[7], F[8]
        more = _ROLL - _AXIS
        for i in range(joints):
            along = more * (zx * J[3, i] + zy * J[4, i] + zz * J[5, i])
            J[3, i] = _AXIS * J[3, i] + along * zx
            J[4, i] = _AXIS * J[4, i] + along * zy
            J[5, i] = _AXIS * J[5, i] + along * zz
        along = more * (zx * e[3] + zy * e[4] + zz * e[5])
        e[3], e[4], e[5] = _AXIS * e[3] + along * zx, _AXIS * e[4] + along * zy, _AXIS * e[5] + along * zz
    total = 0.0
    for k in range(6):
        total += e[k] * e[k]
    return total


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _step(
    J: Array, e: Array, q: Array, low: Array, high: Array, damping: float, A: Array, g: Array, step: Array
) -> bool:
    """Write the damped step (n,) towards an error; a joint at a bound and pulled beyond it is left out of J."""
    n = q.shape[0]
    for i in range(n):
        total = 0.0
        for k in range(6):
            total += J[k, i] * e[k]
        if (q[i] <= low[i] and total < 0.0) or (q[i] >= high[i] and total > 0.0):
            total = 0.0
            for k in range(6):
                J[k, i] = 0.0
        g[i] = total
    if n < 6:
        for i in range(n):
            for j in range(i, n):
                total = 0.0
                for k in range(6):
                    total += J[k, i] * J[k, j]
                A[i, j] = total
        good = solve(A, g, n, damping, step)
        for i in range(n):
            step[i] = g[i]
        return good
    for i in range(6):
        for j in range(i, 6):
            total = 0.0
            for k in range(n):
                total += J[i, k] * J[j, k]
            A[i, j] = total
        g[i] = e[i]
    good = solve(A, g, 6, damping, step)
    for i in range(n):
        total = 0.0
        for k in range(6):
            total += J[k, i] * g[k]
        step[i] = total
    return good


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _descend(table: Array, G: Frame, q: Array, low: Array, high: Array, work: Array) -> float:
    """Move joint angles (n,) in-place towards a frame, within bounds; return the weighted squared error that is left."""
    n = q.shape[0]
    J, A, e, g, step, trial = work[0:6], work[6:13], work[13], work[14], work[15], work[16, :n]
    F = jacobian_base(table, q, J)
    pose_error(F, G, e)
    cost = _weigh(F, n, J, e)
    damping = 1e-3 * min(1.0, cost)
    for _ in range(_STEPS):
        if cost < _NONE or damping > STIFF:
            break
        after, size = np.inf, 0.0
        if _step(J, e, q, low, high, damping + 1e-15, A, g, step):
            for i in range(n):
                size = max(size, abs(step[i]))
            shorter = _FURTHEST / max(_FURTHEST, size)
            for i in range(n):
                trial[i] = min(high[i], max(low[i], q[i] + shorter * step[i]))
            F = jacobian_base(table, trial, J)
            pose_error(F, G, e)
            after = _weigh(F, n, J, e)
        if after < cost:
            slow = cost - after < _SLOW * cost
            q[:] = trial
            cost = after
            damping = 0.05 * damping
            if slow:
                break
        else:
            damping = max(10.0 * damping, 1e-9)
            F = jacobian_base(table, q, J)
            pose_error(F, G, e)
            _weigh(F, n, J, e)
    return cost


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _off(table: Array, G: Frame, q: Array, e: Array, off: Array) -> None:
    """Write how far the tool is off a frame: position, m, rotation, rad, and the direction of its z axis, rad."""
    F = tool_frame(table, q)
    pose_error(F, G, e)
    off[0] = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    off[1] = math.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
    x, y, z = F[7] * G[8] - F[8] * G[7], F[8] * G[6] - F[6] * G[8], F[6] * G[7] - F[7] * G[6]
    off[2] = math.atan2(math.sqrt(x * x + y * y + z * z), F[6] * G[6] + F[7] * G[7] + F[8] * G[8])


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _crowded(limits: Array, goal: Array, q: Array, i: int) -> tuple[float, float]:
    """Return the first and second derivative, by joint i, of what the free motion makes small.

    It is half the sum of squares of the joints' distances from the goal, as shares of their ranges, and for a joint near a
    limit of how far it is beyond the edge from which it is pushed back.
    """
    half = 0.5 * (limits[1, i] - limits[0, i])
    first, second = (q[i] - goal[i]) / (half * half), 1.0 / (half * half)
    share = (q[i] - limits[0, i]) / half - 1.0
    if abs(share) > _EDGE:
        first += _PUSH * (share - (_EDGE if share > 0.0 else -_EDGE)) / half
        second += _PUSH / (half * half)
    return first, second


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _added(row: Array, rows: Array, count: int) -> int:
    """Make a row (n,) perpendicular to orthonormal ones and add it to them where something is left; return their number."""
    n, size = row.shape[0], 0.0
    for i in range(n):
        size += row[i] * row[i]
    for _ in range(2):
        for k in range(count):
            along = 0.0
            for i in range(n):
                along += rows[k, i] * row[i]
            for i in range(n):
                row[i] -= along * rows[k, i]
    left = 0.0
    for i in range(n):
        left += row[i] * row[i]
    if left <= 1e-12 * size or count >= n:
        return count
    for i in range(n):
        rows[count, i] = row[i] / math.sqrt(left)
    return count + 1


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _slide(table: Array, limits: Array, G: Frame, goal: Array, q: Array, work: Array) -> None:
    """Move seven joints in-place along the motion that leaves the tool where it is, towards a goal, away from limits."""
    n = q.shape[0]
    J, rows, free, kept = work[0:6], work[20:27, :n], work[27, :n], work[28, :n]
    low, high = limits[0], limits[1]
    for _ in range(_SLIDES):
        kept[:] = q
        jacobian_base(table, q, J)
        count = 0
        for k in range(6):
            free[:] = J[k, :n]
            count = _added(free, rows, count)
        if count != n - 1:
            return  # singular: more than one motion is free
        # What is left of the unit vector that the rows hold least of is the free motion.
        least, at = np.inf, 0
        for i in range(n):
            held = 0.0
            for k in range(count):
                held += rows[k, i] * rows[k, i]
            if held < least:
                least, at = held, i
        free[:] = 0.0
        free[at] = 1.0
        if _added(free, rows, count) != n:
            return
        first = second = 0.0
        for i in range(n):
            slope, bend = _crowded(limits, goal, q, i)
            first += slope * rows[count, i]
            second += bend * rows[count, i] * rows[count, i]
        by = min(_SLIDE_RAD, max(-_SLIDE_RAD, -first / second))
        for i in range(n):
            q[i] = min(high[i], max(low[i], q[i] + by * rows[count, i]))
        if _descend(table, G, q, low, high, work) >= _NONE:
            q[:] = kept
            return
        if abs(by) < 1e-3:
            return


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _free_part(row: Array, rows: Array, count: int) -> None:
    """Take out of a row (n,) what lies in orthonormal rows."""
    for k in range(count):
        along = 0.0
        for i in range(row.shape[0]):
            along += rows[k, i] * row[i]
        for i in range(row.shape[0]):
            row[i] -= along * rows[k, i]


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _position_level(J: Array, e: Array, n: int, step: Array, work: Array) -> int:
    """Write the least step (n,) that meets the position, and orthonormal rows of the motions used; return their number."""
    A, rows, g, y, row = work[6:13], work[20:27, :n], work[14], work[18], work[28, :n]
    for k in range(3):
        g[k] = e[k]
        for j in range(k, 3):
            total = 0.0
            for i in range(n):
                total += J[k, i] * J[j, i]
            A[k, j] = total
    good, count = solve(A, g, 3, _FIRM, y), 0
    for i in range(n):
        step[i] = g[0] * J[0, i] + g[1] * J[1, i] + g[2] * J[2, i] if good else 0.0
    for k in range(3):
        row[:] = J[k, :n]
        count = _added(row, rows, count)
    return count


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _row_level(J: Array, e: Array, k: int, n: int, step: Array, count: int, work: Array) -> int:
    """Add to a step (n,) what row k of J still needs of the motions left free; not where those hardly change it."""
    rows, row = work[20:27, :n], work[28, :n]
    left, size = e[k], 0.0
    for i in range(n):
        left -= J[k, i] * step[i]
    row[:] = J[k, :n]
    _free_part(row, rows, count)
    for i in range(n):
        size += row[i] * row[i]
    if size < _WEAK:
        return count
    for i in range(n):
        step[i] += left / size * row[i]
    return _added(row, rows, count)


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _part_axis_rows(J: Array, e: Array, n: int, count: int, work: Array) -> None:
    """Rotate rows 3 and 4 of J, and their errors, so that what is left free of them is perpendicular: strong and weak."""
    rows, one, two = work[20:27, :n], work[28, :n], work[29, :n]
    one[:], two[:] = J[3, :n], J[4, :n]
    _free_part(one, rows, count)
    _free_part(two, rows, count)
    a = b = m = 0.0
    for i in range(n):
        a, b, m = a + one[i] * one[i], b + two[i] * two[i], m + one[i] * two[i]
    angle = 0.5 * math.atan2(2.0 * m, a - b)
    c, s = math.cos(angle), math.sin(angle)
    for i in range(n):
        J[3, i], J[4, i] = c * J[3, i] + s * J[4, i], c * J[4, i] - s * J[3, i]
    e[3], e[4] = c * e[3] + s * e[4], c * e[4] - s * e[3]


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _errors_by_level(F: Frame, G: Frame, J: Array, n: int, e: Array) -> None:
    """Write the error: position, direction of the z axis about the tool's x and y, rotation about z; J's rows likewise."""
    kx, ky, kz = F[7] * G[8] - F[8] * G[7], F[8] * G[6] - F[6] * G[8], F[6] * G[7] - F[7] * G[6]
    s = math.sqrt(kx * kx + ky * ky + kz * kz)
    c = F[6] * G[6] + F[7] * G[7] + F[8] * G[8]
    angle = math.atan2(s, c)
    if s > 1e-12:
        kx, ky, kz = kx / s, ky / s, kz / s
    else:
        kx, ky, kz = F[0], F[1], F[2]
    # The tool's x axis, rotated with its z axis onto the requested one, and how far it has still to rotate.
    along = (kx * F[0] + ky * F[1] + kz * F[2]) * (1.0 - c)
    x = c * F[0] + s * (ky * F[2] - kz * F[1]) + along * kx
    y = c * F[1] + s * (kz * F[0] - kx * F[2]) + along * ky
    z = c * F[2] + s * (kx * F[1] - ky * F[0]) + along * kz
    across = (y * G[2] - z * G[1]) * G[6] + (z * G[0] - x * G[2]) * G[7] + (x * G[1] - y * G[0]) * G[8]
    e[0], e[1], e[2] = G[9] - F[9], G[10] - F[10], G[11] - F[11]
    e[3] = angle * (kx * F[0] + ky * F[1] + kz * F[2])
    e[4] = angle * (kx * F[3] + ky * F[4] + kz * F[5])
    e[5] = math.atan2(across, x * G[0] + y * G[1] + z * G[2])
    for i in range(n):
        x, y, z = J[3, i], J[4, i], J[5, i]
        J[3, i] = F[0] * x + F[1] * y + F[2] * z
        J[4, i] = F[3] * x + F[4] * y + F[5] * z
        J[5, i] = F[6] * x + F[7] * y + F[8] * z


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _by_priority(table: Array, G: Frame, q: Array, low: Array, high: Array, work: Array) -> None:
    """Move joint angles (n,) in-place: the position first, then the direction of the z axis, then the rotation about it."""
    n = q.shape[0]
    J, e, step = work[0:6], work[13], work[15, :n]
    for _ in range(_LEVEL_STEPS):
        F = jacobian_base(table, q, J)
        _errors_by_level(F, G, J, n, e)
        for _ in range(n):
            count = _position_level(J, e, n, step, work)
            _part_axis_rows(J, e, n, count, work)
            for k in range(3, 6):
                count = _row_level(J, e, k, n, step, count, work)
            again = False
            for i in range(n):
                if (q[i] <= low[i] and step[i] < 0.0) or (q[i] >= high[i] and step[i] > 0.0):
                    again = True
                    for k in range(6):
                        J[k, i] = 0.0
            if not again:
                break
        size = 0.0
        for i in range(n):
            size = max(size, abs(step[i]))
        for i in range(n):
            q[i] = min(high[i], max(low[i], q[i] + step[i] * _SLIDE_RAD / max(_SLIDE_RAD, size)))
        if size < _STILL:
            return


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _start(k: int, limits: Array, goal: Array, q: Array) -> None:
    """Write the k-th angles (n,) to start from: the goal, then points spread evenly within the limits."""
    for i in range(q.shape[0]):
        low, high = limits[0, i], limits[1, i]
        if k == 0:
            q[i] = min(high, max(low, goal[i]))
        else:
            middle, half = 0.5 * (low + high), min(np.pi, 0.5 * (high - low))
            q[i] = middle + half * (2.0 * ((0.5 + k * _SPREAD ** -(i + 1.0)) % 1.0) - 1.0)


@kernel(
    "const f8[::1], const f8[:, ::1], f8[:, ::1], const f8[::1], f8[::1], f8[::1], f8[::1]",
    nogil=True,
    fastmath={"contract", "nsz"},
)
def inverse(table: Array, limits: Array, T: Array, goal: Array, q: Array, off: Array, scratch: Array) -> int:
    """Write joint angles within the limits that bring the tool to a pose, or as near as descent finds.

    Args:
        table: (102,) packed table of four, five or seven joints.
        limits: (2, n) lower and upper limits of the joints, rad.
        T: (4, 4) T_base_tool, m.
        goal: (n,) angles to start from and, with seven joints, to stay near to, rad.
        q: (n,) is written, rad.
        off: (3,) is written: what is left of the error: position, m, rotation, rad, direction of the z axis, rad.
        scratch: (SCRATCH,) workspace of finite numbers.

    Returns:
        the validity of T.
    """
    validity, G = rigid(T)
    if validity != 0:
        return validity
    n = q.shape[0]
    work = scratch.reshape((_ROWS, 7))
    trial, best, exact = work[31, :n], np.inf, False
    for k in range(_STARTS):
        _start(k, limits, goal, trial)
        cost = _descend(table, G, trial, limits[0], limits[1], work)
        if k == 0 or cost < best:
            best = cost
            q[:] = trial
        if cost < _NONE:
            exact = True
            break
        if n < 6 and k >= _STARTS // 2:
            break
    if exact and n > 6:
        _slide(table, limits, G, goal, q, work)
    if not exact and n < 6:
        _by_priority(table, G, q, limits[0], limits[1], work)
    _off(table, G, q, work[13], off)
    return 0


@kernel(
    "const f8[::1], const f8[:, ::1], f8[:, :, ::1], const f8[::1], f8[:, ::1], f8[:, ::1], f8[::1]",
    nogil=True,
    fastmath={"contract", "nsz"},
)
def inverse_batch(table: Array, limits: Array, Ts: Array, goal: Array, q: Array, off: Array, scratch: Array) -> int:
    """Write joint angles (N, n) and what is left of the error (N, 3) for poses (N, 4, 4); return the worst validity."""
    worst = 0
    for k in range(Ts.shape[0]):
        worst = min(worst, inverse(table, limits, Ts[k], goal, q[k], off[k], scratch))
    return worst
