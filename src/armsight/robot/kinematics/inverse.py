"""Inverse kinematics of six joints: a requested pose to checked, polished and sorted joint angles, or the nearest pose.

In: the packed table (102,), the table of its closed form, limits and T_base_tool. Out: rows of joint angles with what is
left of the error, their configuration and their state. In this order:

1. The requested pose: whether it is a rigid motion; its rotation is made orthonormal to the last digit.
2. Damped least squares: from a start to the joint angles whose pose comes closest. The error is [position, m; rotation
   vector, rad], so that 1 mm counts as much as 1 mrad. Levenberg and Marquardt's method (Nocedal and Wright, "Numerical
   Optimization", 2006, chapter 10) with the joints held within bounds: a joint that stands at a bound and is pulled beyond
   it is left out of the step.
3. The rows: their columns, joint limits, whole revolutions, doubles and order.
4. The solutions. Where the arm has a closed form, its solutions are measured against the true table and polished if
   rounding, or a table that has the structure only nearly, left an error. Where it has none, damped least squares starts
   from many configurations.
"""

from __future__ import annotations

import math

import numpy as np

from armsight.data import Array, Ids
from armsight.kernels import kernel
from armsight.robot.kinematics.chain import (
    Frame,
    after,
    angle_of_each,
    before,
    errors,
    frames,
    jacobian_six,
    sincos_each,
    thetas,
    tool_six,
)
from armsight.robot.kinematics.closed import DOUBT, OUTSIDE, SAME, SHOULDER, WRIST, closed_form
from armsight.robot.kinematics.table import KIND, UNBASE, UNTOOL

#: The validity of a pose, beside 0.
NOT_FINITE, NOT_RIGID = -1, -2
#: A rotation may be this far from orthonormal and is then corrected.
_NEARLY_RIGID = 1e-6
#: Rows of the workspace (20, 6): Jacobian, normal matrix, then error, gradient, step and trial.
WORK = 20
#: An error of this squared length is as good as none.
_NONE = 1e-30
#: A step that takes off less than this share of the error ends the descent; so does this much damping.
_SLOW, STIFF = 1e-9, 1e6


@kernel(nogil=True, fastmath={"contract", "nsz"})
def rigid(T: Array) -> tuple[int, Frame]:
    """Return the validity of a transform (4, 4), and its frame with the rotation made orthonormal."""
    total = 0.0
    for i in range(4):
        for j in range(4):
            total += T[i, j] * 0.0
    xx, xy, xz, yx, yy, yz = T[0, 0], T[1, 0], T[2, 0], T[0, 1], T[1, 1], T[2, 1]
    zx, zy, zz, px, py, pz = T[0, 2], T[1, 2], T[2, 2], T[0, 3], T[1, 3], T[2, 3]
    validity = 0
    if total != 0.0:
        validity = NOT_FINITE
    else:
        handed = (xy * yz - xz * yy) * zx + (xz * yx - xx * yz) * zy + (xx * yy - xy * yx) * zz
        if handed < 0.0 or T[3, 0] != 0.0 or T[3, 1] != 0.0 or T[3, 2] != 0.0 or T[3, 3] != 1.0:
            validity = NOT_RIGID
    for _ in range(2):
        a, b = (0.5 * (xx * xx + xy * xy + xz * xz - 1.0), 0.5 * (yx * yx + yy * yy + yz * yz - 1.0))
        c, d = (0.5 * (zx * zx + zy * zy + zz * zz - 1.0), 0.5 * (xx * yx + xy * yy + xz * yz))
        e, f = 0.5 * (xx * zx + xy * zy + xz * zz), 0.5 * (yx * zx + yy * zy + yz * zz)
        off = max(max(abs(a), abs(b), abs(c)), max(abs(d), abs(e), abs(f)))
        if off > _NEARLY_RIGID and validity == 0:
            validity = NOT_RIGID
        if off < 1e-15 or validity != 0:
            break
        # R (3 I - R^T R) / 2 has the same rotation and the square of the error (Bjorck and Bowie, 1971).
        xx, yx, zx = (xx - a * xx - d * yx - e * zx, yx - d * xx - b * yx - f * zx, zx - e * xx - f * yx - c * zx)
        xy, yy, zy = (xy - a * xy - d * yy - e * zy, yy - d * xy - b * yy - f * zy, zy - e * xy - f * yy - c * zy)
        xz, yz, zz = (xz - a * xz - d * yz - e * zz, yz - d * xz - b * yz - f * zz, zz - e * xz - f * yz - c * zz)
    return validity, (xx, xy, xz, yx, yy, yz, zx, zy, zz, px, py, pz)


@kernel(nogil=True, fastmath={"contract", "nsz"})
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
    elif c < 0.0:  # half a revolution exactly: any axis of it will do to start with
        x, scale = np.pi, 1.0
    error[0], error[1], error[2] = G[9] - F[9], G[10] - F[10], G[11] - F[11]
    error[3], error[4], error[5] = scale * x, scale * y, scale * z
    total = 0.0
    for i in range(6):
        total += error[i] * error[i]
    return total


@kernel(nogil=True, fastmath={"contract", "nsz"}, forceinline=True)
def solve(A: Array, g: Array, m: int, damping: float, root: Array) -> bool:
    """Solve (A + damping I) x = g of m unknowns by Cholesky, x in place of g; False where that cannot be done.

    A's upper half is read; the factor goes below its diagonal, its own diagonal into ``root``.
    """
    for i in range(m):
        for j in range(i + 1):
            total = A[j, i]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if j < i:
                A[i, j] = total / root[j]
            elif total + damping > 0.0:
                root[i] = math.sqrt(total + damping)
            else:
                return False
        total = g[i]
        for k in range(i):
            total -= A[i, k] * g[k]
        g[i] = total / root[i]
    for i in range(m - 1, -1, -1):
        total = g[i]
        for k in range(i + 1, m):
            total -= A[k, i] * g[k]
        g[i] = total / root[i]
    return True


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _normal(J: Array, e: Array, q: Array, low: Array, high: Array, A: Array, g: Array) -> None:
    """Write the upper half of J^T J (6, 6), and J^T e (6,); a joint at a bound and pulled beyond it is left out."""
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


@kernel(nogil=True, fastmath={"contract", "nsz"})
def descend(table: Array, G: Frame, q: Array, low: Array, high: Array, most: int, work: Array) -> float:
    """Move joint angles (6,) in-place towards a requested frame, within bounds.

    Args:
        table: (102,) packed table.
        G: the requested frame of the tool.
        q: (6,) where to start, within the bounds; where it ends.
        low: (6,) lower bounds, rad.
        high: (6,) upper bounds, rad.
        most: how many steps at most.
        work: (20, 6) workspace.

    Returns:
        the squared length of the error that is left.
    """
    J, A, e, g, root, trial = work[0:6], work[6:12], work[12], work[13], work[14], work[15]
    cost = np.inf
    damping, better = 0.0, True
    for _ in range(most):
        if better:
            cost = pose_error(jacobian_six(table, q, J), G, e)
            if cost < _NONE:
                break
            damping = 0.1 * damping if damping > 0.0 else 1e-6 * min(1.0, cost)
        _normal(J, e, q, low, high, A, g)
        size = 0.0
        after = np.inf
        if solve(A, g, 6, damping + 1e-18, root):
            for i in range(6):
                size = max(size, abs(g[i]))
            for i in range(6):
                trial[i] = min(high[i], max(low[i], q[i] + g[i] / max(1.0, size)))
            after = pose_error(tool_six(table, trial), G, g)
        better = after < cost
        if better:
            q[:] = trial
            slow = cost - after < _SLOW * cost
            cost = after
            if slow:
                break
        else:
            damping = max(10.0 * damping, 1e-12)
            if damping > STIFF:
                break
    return cost


#: Most solutions that are looked for: eight where there is a closed form; a general arm has up to sixteen.
MOST = 16
#: Columns of a row: six joint angles, position error, orientation error, shoulder, elbow, wrist (+-1, or 0 where the arm
#: has no structure), state, and the key by which rows are ordered.
POSITION, ANGLE, CONFIGURATION = range(6, 9)
STATE, KEY, WIDTH = range(CONFIGURATION + 3, CONFIGURATION + 6)

_REVOLUTION = 2.0 * np.pi
#: More than any angle, rad, and any distance: a joint without bounds has it; a row outside the limits stands behind it.
_FAR = 1e9


@kernel(nogil=True, fastmath={"contract", "nsz"})
def wrap(q: float) -> float:
    """Bring an angle into (-pi, pi]."""
    revolutions: float = np.ceil((q - np.pi) / _REVOLUTION)
    return q - _REVOLUTION * revolutions


@kernel(nogil=True, fastmath={"contract", "nsz"})
def unwrapped(q: float, low: float, high: float, goal: float) -> tuple[float, bool]:
    """Return the angle, whole revolutions from q, within the limits and nearest a goal; and whether there is one."""
    least, most = (np.ceil((low - q) / _REVOLUTION - 1e-13), np.floor((high - q) / _REVOLUTION + 1e-13))
    nearest_goal = np.floor((goal - q) / _REVOLUTION + 0.5)
    inside = least <= most
    held = min(most, max(least, nearest_goal))
    angle = q + _REVOLUTION * (held if inside else nearest_goal)
    # A joint that rounding put over its limit is put on it.
    return (min(high, max(low, angle)) if inside else angle), inside


@kernel(nogil=True, fastmath={"contract", "nsz"})
def known(rows: Array, count: int) -> bool:
    """Return whether row ``count`` stands among the rows before it."""
    for k in range(count):
        same = True
        for i in range(6):
            apart = abs(wrap(rows[k, i] - rows[count, i]))
            if apart > SAME:
                same = False
                break
        if same:
            return True
    return False


@kernel(nogil=True, fastmath={"contract", "nsz"})
def bring_within(limits: Array, near: Array, ordered: bool, row: Array) -> None:
    """Move a row's joints by whole revolutions into the limits, and write its state and key."""
    outside, distance = False, 0.0
    for i in range(6):
        row[i], inside = unwrapped(row[i], limits[0, i], limits[1, i], near[i])
        outside = outside or not inside
        distance += (row[i] - near[i]) ** 2
    if outside:
        row[STATE] += OUTSIDE
    row[KEY] = (distance if ordered else 0.0) + (_FAR if outside else 0.0)


@kernel(nogil=True, fastmath={"contract", "nsz"})
def sort(rows: Array, count: int) -> None:
    """Sort rows by their keys; equal ones keep their order."""
    for k in range(1, count):
        j = k
        while j > 0 and rows[j - 1, KEY] > rows[j, KEY]:
            for i in range(WIDTH):
                rows[j - 1, i], rows[j, i] = rows[j, i], rows[j - 1, i]
            j -= 1


#: Size of a call's workspace: the batch's sines, cosines, angles, thetas, frames, tags, errors; and that of the descent.
SCRATCH = 4 * 48 + 96 + 32 + 16 + 6 * WORK
_BATCH = SCRATCH - 6 * WORK
#: A solution is polished where its pose is off by more than this, m or rad, and dropped where the polish leaves more.
_POLISHED, REACHED = 1e-12, 3e-10
#: How many configurations damped least squares starts from: for an arm without structure, and for the nearest pose beside
#: the closed form's; how many steps it takes at most, in a polish and from afar.
_STARTS, _NEAREST_STARTS, _STEPS, _LONG_STEPS = 64, 8, 20, 200


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _polish(table: Array, F: Frame, row: Array, steps: int, work: Array) -> bool:
    """Move a row onto the pose, measure what is left, and return whether it brings the tool there."""
    q, e = work[16], work[12]
    for i in range(6):
        q[i], work[17, i], work[18, i] = row[i], -_FAR, _FAR
    descend(table, F, q, work[17], work[18], steps, work)
    for i in range(6):
        row[i] = wrap(q[i])
    pose_error(tool_six(table, row), F, e)
    row[POSITION] = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    row[ANGLE] = math.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
    return bool(max(row[POSITION], row[ANGLE]) < REACHED)


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _start(n: int, near: Array, q: Array) -> None:
    """Write the n-th configuration to start from: ``near``, then points spread evenly over a revolution of every joint."""
    # The fractional parts of n times powers of the root of x^7 = x + 1 spread best (Roberts, 2018).
    for i in range(6):
        spread = (0.5 + n * 1.1127756842787055 ** -(i + 1.0)) % 1.0
        q[i] = near[i] if n == 0 else np.pi * (2.0 * spread - 1.0)


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _from_everywhere(table: Array, F: Frame, near: Array, most: int, rows: Array, work: Array) -> int:
    """Write what damped least squares finds from many starts, at most so many; returns how many rows."""
    count = 0
    for n in range(_STARTS):
        if count == most:
            break
        rows[count] = 0.0
        _start(n, near, rows[count])
        if _polish(table, F, rows[count], _LONG_STEPS, work) and not known(rows, count):
            count += 1
    return count


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _to_rows(batch: Array, found: int, rows: Array) -> None:
    """Copy angles, errors and tags of the batch into rows."""
    q, tags, off = batch[96:144], batch[288:320], batch[320:336]
    for k in range(found):
        for i in range(6):
            rows[k, i] = q[8 * i + k]
        rows[k, POSITION], rows[k, ANGLE] = off[k], off[8 + k]
        for i in range(4):
            rows[k, CONFIGURATION + i] = tags[8 * i + k]


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _batch_angles(closed: Array, limits: Array, near: Array, batch: Array, n: int) -> None:
    """Convert the batch's points (cosine, sine) into joint angles, within the limits where that can be."""
    y, x, q, theta = batch[:48], batch[48:96], batch[96:144], batch[144:192]
    angle_of_each(y, x, theta, 6 * n)
    for i in range(6):
        way, offset, low, high, goal = (closed[6 * i + 5], closed[6 * i + 4], limits[0, i], limits[1, i], near[i])
        for k in range(n):
            q[8 * i + k], _ = unwrapped(way * (theta[8 * i + k] - offset), low, high, goal)


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _from_closed_form(
    table: Array,
    closed: Array,
    limits: Array,
    F: Frame,
    near: Array,
    clamp: bool,
    rows: Array,
    already: int,
    batch: Array,
    work: Array,
    n: int,
) -> tuple[int, int]:
    """Add what the closed form finds, measured and polished; returns how many rows there are, and what missed.

    Clamped, it is where the steps of the closed form come closest, which a longer descent makes solutions of or not.
    """
    y, x, q, theta = batch[:48], batch[48:96], batch[96:144], batch[144:192]
    M = after(closed, UNTOOL, before(closed, UNBASE, F))
    found, missed = closed_form(closed, M, near, clamp, y, x, batch[288:320])
    _batch_angles(closed, limits, near, batch, n)
    thetas(table, q, theta, n)
    sincos_each(theta, y, x, 6 * n)
    frames(table, y, x, batch[192:288], n)
    errors(batch[192:288], F, batch[320:328], batch[328:336], n)
    _to_rows(batch, found, rows[already:])
    count, moved = already, already > 0
    for k in range(already, min(already + found, MOST)):
        if k != count:
            rows[count] = rows[k]
        good = max(rows[count, POSITION], rows[count, ANGLE]) <= _POLISHED
        if not good:
            good, moved = _polish(table, F, rows[count], _LONG_STEPS if clamp else _STEPS, work), True
        # Only solutions that were moved can come upon each other.
        if good and count < n and not (moved and known(rows, count)):
            count += 1
    return count, missed


@kernel(
    "const f8[::1], const f8[::1], const f8[:, ::1], f8[:, ::1], f8[::1], b1, f8[:, ::1], f8[::1], i8",
    nogil=True,
    fastmath={"contract", "nsz"},
)
def inverse(
    table: Array,
    closed: Array,
    limits: Array,
    T: Array,
    near: Array,
    ordered: bool,
    rows: Array,
    scratch: Array,
    n: int,
) -> tuple[int, int, int]:
    """Write all joint angles that bring the tool to a pose.

    Args:
        table: (102,) packed table; its KIND is not 0 where ``closed`` is the same arm exactly.
        closed: (102,) the table that the closed form works on, KIND 0 where there is none.
        limits: (2, 6) lower and upper limits of the joints, rad.
        T: (4, 4) T_base_tool, m.
        near: (6,) joint angles, rad: what an undetermined joint is given, and which of several revolutions is taken.
        ordered: whether the rows are sorted by their distance from ``near``; those outside the limits come last anyway.
        rows: (16, 13) is written: joint angles, errors, configuration, state and key.
        scratch: (SCRATCH,) workspace of finite numbers.
        n: 8, the size of the batch.

    Returns:
        how many rows were written, or the validity of T; bits of what kept solutions out of reach; and those of all rows'
        states together, OUTSIDE only where every row is.
    """
    validity, F = rigid(T)
    if validity != 0:
        return validity, 0, 0
    batch, work = scratch[:_BATCH], scratch[_BATCH:].reshape((WORK, 6))
    count = missed = 0
    irregular = closed[KIND] == 0.0
    exact = table[KIND] != 0.0
    # Where rounding may be to blame for what was missed, a second time from as close as the closed form comes.
    for again in range(0 if irregular else 2):
        clamp = again == 1 or not exact
        if again == 0 or missed & DOUBT:
            count, out = _from_closed_form(table, closed, limits, F, near, clamp, rows, count, batch, work, n)
            missed |= out
    if count == 0 and (not exact or missed & DOUBT):
        most = 1 if exact else MOST if irregular else n
        count = _from_everywhere(table, F, near, most, rows, work)
        rows[:count, STATE] = 1.0 * (SHOULDER | WRIST) if exact else 0.0
    bits = 0
    for k in range(count):
        bits |= int(rows[k, STATE])
        bring_within(limits, near, ordered, rows[k])
    sort(rows, count)
    if count > 0 and rows[0, STATE] >= OUTSIDE:
        bits |= OUTSIDE
    return count, missed, bits


@kernel(
    "const f8[::1], const f8[::1], const f8[:, ::1], f8[:, :, ::1], f8[::1], f8[:, ::1], f8[::1], i8, "
    "f8[:, :, ::1], i8[::1]",
    nogil=True,
    fastmath={"contract", "nsz"},
)
def inverse_batch(
    table: Array,
    closed: Array,
    limits: Array,
    Ts: Array,
    near: Array,
    row: Array,
    scratch: Array,
    n: int,
    rows: Array,
    counts: Ids,
) -> int:
    """Write all joint angles for poses (N, 4, 4) into rows (N, most, 12) and counts (N,); return the worst validity."""
    worst = 0
    for k in range(Ts.shape[0]):
        count, _, _ = inverse(table, closed, limits, Ts[k], near, False, row, scratch, n)
        worst = min(worst, count)
        counts[k] = max(0, min(count, rows.shape[1]))
        for j in range(counts[k]):
            for i in range(KEY):
                rows[k, j, i] = row[j, i]
    return worst


@kernel(
    "const f8[::1], const f8[::1], const f8[:, ::1], f8[:, ::1], f8[::1], f8[::1], f8[:, ::1], f8[::1], i8",
    nogil=True,
    fastmath={"contract", "nsz"},
)
def nearest(
    table: Array, closed: Array, limits: Array, T: Array, near: Array, q: Array, rows: Array, scratch: Array, n: int
) -> None:
    """Write the joint angles (6,) within the limits whose pose comes closest to T, as far as descent finds them."""
    _, F = rigid(T)
    count, batch, work = 0, scratch[:_BATCH], scratch[_BATCH:].reshape((WORK, 6))
    if closed[KIND] != 0.0:
        M = after(closed, UNTOOL, before(closed, UNBASE, F))
        count, _ = closed_form(closed, M, near, True, batch[:48], batch[48:96], batch[288:320])
        _batch_angles(closed, limits, near, batch, n)
        _to_rows(batch, count, rows)
    best, trial = np.inf, work[16]
    for k in range(count + _NEAREST_STARTS):
        if k < count:
            trial[:] = rows[k, :6]
        else:
            _start(k - count, near, trial)
        for i in range(6):
            angle, _ = unwrapped(trial[i], limits[0, i], limits[1, i], near[i])
            trial[i] = min(limits[1, i], max(limits[0, i], angle))
        cost = descend(table, F, trial, limits[0], limits[1], _LONG_STEPS, work)
        if k == 0 or cost < best:  # the first anyway: a pose may be so far off that every cost is infinite
            best = cost
            q[:] = trial
