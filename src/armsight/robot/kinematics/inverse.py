"""From a wanted pose to checked, polished and ordered joint angles; and to the nearest pose where there are none.

Where the arm has a closed form, its solutions are measured against the true table and polished if rounding, or a table
that has the structure only nearly, left them off. Where it has none, damped least squares starts from many places.

A wanted pose as it comes in: whether it is a rigid motion, and its rotation put right to the last place.

Rows of the inverse's answer: what their columns are, limits, whole turns, doubles and order.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from armsight.data import Array, Ids
from armsight.robot.kinematics.batch import errors, frames, thetas
from armsight.robot.kinematics.chain import Frame, after, before, tool_frame
from armsight.robot.kinematics.closed import DOUBT, SHOULDER, WRIST, closed_form
from armsight.robot.kinematics.descent import WORK, descend, pose_error
from armsight.robot.kinematics.table import KIND, UNBASE, UNTOOL
from armsight.robot.kinematics.trig import angle_of_each, sincos_each

#: Verdicts on a pose, beside 0.
NOT_FINITE, NOT_RIGID = -1, -2
#: A rotation may be off by this much and is then put right.
_NEARLY_RIGID = 1e-6

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})


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


#: Most solutions that are looked for: eight where there is a closed form; a general arm has up to sixteen.
MOST = 16
#: Columns of a row: six joint angles, position error, orientation error, shoulder, elbow, wrist (+-1, or 0 where the arm
#: has no structure), state, and the key by which rows are ordered.
POSITION, ANGLE, CONFIGURATION, STATE, KEY, WIDTH = 6, 7, 8, 11, 12, 13
#: Bit of a row's state beside those of ``closed``: a joint is beyond its limits.
OUTSIDE = 8

#: Two solutions that differ less than this in every joint, rad, are one.
_SAME_RAD = 1e-7
_TURN = 2.0 * np.pi
#: Added to the key of a row outside the limits: more than any distance.
_LAST = 1e9


@_kernel
def wrap(q: float) -> float:
    """Bring an angle into (-pi, pi]."""
    turns: float = np.ceil((q - np.pi) / _TURN)
    return q - _TURN * turns


@_kernel
def placed(q: float, low: float, high: float, goal: float) -> tuple[float, bool]:
    """Return the angle, whole turns apart, that lies within the limits and nearest a goal; and whether there is one."""
    least, most = (np.ceil((low - q) / _TURN - 1e-13), np.floor((high - q) / _TURN + 1e-13))
    wanted = np.floor((goal - q) / _TURN + 0.5)
    inside = least <= most
    held = min(most, max(least, wanted))
    turned = q + _TURN * (held if inside else wanted)
    # A joint that rounding put over its limit is put on it.
    return (min(high, max(low, turned)) if inside else turned), inside


@_kernel
def known(rows: Array, count: int) -> bool:
    """Say whether row ``count`` stands among the rows before it."""
    for k in range(count):
        same = True
        for i in range(6):
            apart = abs(wrap(rows[k, i] - rows[count, i]))
            if apart > _SAME_RAD:
                same = False
                break
        if same:
            return True
    return False


@_kernel
def place(limits: Array, near: Array, ordered: bool, row: Array) -> None:
    """Turn a row's joints within the limits, and write its state and key."""
    outside, distance = False, 0.0
    for i in range(6):
        row[i], inside = placed(row[i], limits[0, i], limits[1, i], near[i])
        outside = outside or not inside
        distance += (row[i] - near[i]) ** 2
    if outside:
        row[STATE] += OUTSIDE
    row[KEY] = (distance if ordered else 0.0) + (_LAST if outside else 0.0)


@_kernel
def sort(rows: Array, count: int) -> None:
    """Order rows by their keys; equal ones keep their order."""
    for k in range(1, count):
        j = k
        while j > 0 and rows[j - 1, KEY] > rows[j, KEY]:
            for i in range(WIDTH):
                rows[j - 1, i], rows[j, i] = rows[j, i], rows[j - 1, i]
            j -= 1


#: Size of a call's workspace: the lanes' sines, cosines, angles, thetas, frames, tags, errors; and that of the descent.
SCRATCH = 4 * 48 + 96 + 32 + 16 + 6 * WORK
_LANES = SCRATCH - 6 * WORK
#: A solution is polished where its pose is off by more than this, m or rad, and dropped where the polish leaves more.
_POLISHED, _WRONG = 1e-12, 3e-10
#: How many places damped least squares starts from for an arm without structure, and for the nearest pose beside the
#: closed form's; how many steps it takes at most, in a polish and from afar.
_STARTS, _NEAREST_STARTS, _STEPS, _LONG_STEPS = 64, 8, 20, 200
#: Bounds of a joint that has none, rad.
_FAR = 1e9


@_kernel
def _polish(table: Array, F: Frame, row: Array, steps: int, work: Array) -> bool:
    """Move a row onto the pose, measure what is left, and say whether it brings the tool there."""
    q, e = work[16], work[12]
    for i in range(6):
        q[i], work[17, i], work[18, i] = row[i], -_FAR, _FAR
    descend(table, F, q, work[17], work[18], steps, work)
    for i in range(6):
        row[i] = wrap(q[i])
    pose_error(tool_frame(table, row), F, e)
    row[POSITION] = math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])
    row[ANGLE] = math.sqrt(e[3] * e[3] + e[4] * e[4] + e[5] * e[5])
    return bool(max(row[POSITION], row[ANGLE]) < _WRONG)


@_kernel
def _start(n: int, near: Array, q: Array) -> None:
    """Write the n-th place to start from: ``near``, then points spread evenly over all turns."""
    # The fractional parts of n times powers of the root of x^7 = x + 1 spread best (Roberts, 2018).
    for i in range(6):
        spread = (0.5 + n * 1.1127756842787055 ** -(i + 1.0)) % 1.0
        q[i] = near[i] if n == 0 else np.pi * (2.0 * spread - 1.0)


@_kernel
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


@_kernel
def _to_rows(lanes: Array, found: int, rows: Array) -> None:
    """Copy angles, errors and tags of the lanes into rows."""
    q, tags, off = lanes[96:144], lanes[288:320], lanes[320:336]
    for k in range(found):
        for i in range(6):
            rows[k, i] = q[8 * i + k]
        rows[k, POSITION], rows[k, ANGLE] = off[k], off[8 + k]
        for i in range(4):
            rows[k, CONFIGURATION + i] = tags[8 * i + k]


@_kernel
def _lane_angles(closed: Array, limits: Array, near: Array, lanes: Array, n: int) -> None:
    """Turn the lanes' points into joint angles within the limits where that can be."""
    y, x, q, theta = lanes[:48], lanes[48:96], lanes[96:144], lanes[144:192]
    angle_of_each(y, x, theta, 6 * n)
    for i in range(6):
        way, offset, low, high, goal = (closed[6 * i + 5], closed[6 * i + 4], limits[0, i], limits[1, i], near[i])
        for k in range(n):
            q[8 * i + k], _ = placed(way * (theta[8 * i + k] - offset), low, high, goal)


@_kernel
def _from_closed_form(
    table: Array,
    closed: Array,
    limits: Array,
    F: Frame,
    near: Array,
    clamp: bool,
    rows: Array,
    already: int,
    lanes: Array,
    work: Array,
    n: int,
) -> tuple[int, int]:
    """Add what the closed form finds, measured and polished; returns how many rows there are, and what missed.

    Clamped, it is where the steps of the closed form come closest, which a longer descent makes solutions of or not.
    """
    y, x, q, theta = lanes[:48], lanes[48:96], lanes[96:144], lanes[144:192]
    M = after(closed, UNTOOL, before(closed, UNBASE, F))
    found, missed = closed_form(closed, M, near, clamp, y, x, lanes[288:320])
    _lane_angles(closed, limits, near, lanes, n)
    thetas(table, q, theta, n)
    sincos_each(theta, y, x, 6 * n)
    frames(table, y, x, lanes[192:288], n)
    errors(lanes[192:288], F, lanes[320:328], lanes[328:336], n)
    _to_rows(lanes, found, rows[already:])
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


@_kernel
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
        table: (96,) packed table; its KIND is not 0 where ``closed`` is the same arm exactly.
        closed: (96,) the table that the closed form works on, KIND 0 where there is none.
        limits: (2, 6) lower and upper limits of the joints, rad.
        T: (4, 4) T_base_tool, m.
        near: (6,) joint angles, rad: what an undetermined joint is given, and which of several whole turns is taken.
        ordered: whether the rows are ordered by their distance from ``near``; those outside the limits come last anyway.
        rows: (16, 13) is written: joint angles, errors, configuration, state and key.
        scratch: (SCRATCH,) workspace of finite numbers.
        n: 8, the lanes' number.

    Returns:
        how many rows were written, or a verdict on T; bits of what kept solutions out of reach; and those of all rows'
        states together, OUTSIDE only where every row is.
    """
    verdict, F = rigid(T)
    if verdict != 0:
        return verdict, 0, 0
    lanes, work = scratch[:_LANES], scratch[_LANES:].reshape((WORK, 6))
    count = missed = 0
    irregular = closed[KIND] == 0.0
    exact = table[KIND] != 0.0
    # Where rounding may be to blame for what was missed, a second time from as close as the closed form comes.
    for again in range(0 if irregular else 2):
        clamp = again == 1 or not exact
        if again == 0 or missed & DOUBT:
            count, out = _from_closed_form(table, closed, limits, F, near, clamp, rows, count, lanes, work, n)
            missed |= out
    if count == 0 and (not exact or missed & DOUBT):
        most = 1 if exact else MOST if irregular else n
        count = _from_everywhere(table, F, near, most, rows, work)
        rows[:count, STATE] = 1.0 * (SHOULDER | WRIST) if exact else 0.0
    bits = 0
    for k in range(count):
        bits |= int(rows[k, STATE])
        place(limits, near, ordered, rows[k])
    sort(rows, count)
    if count > 0 and rows[0, STATE] >= OUTSIDE:
        bits |= OUTSIDE
    return count, missed, bits


@_kernel
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
    """Write all joint angles for poses (N, 4, 4) into rows (N, most, 12) and counts (N,); return the worst verdict."""
    worst = 0
    for k in range(Ts.shape[0]):
        count, _, _ = inverse(table, closed, limits, Ts[k], near, False, row, scratch, n)
        worst = min(worst, count)
        counts[k] = max(0, min(count, rows.shape[1]))
        for j in range(counts[k]):
            for i in range(KEY):
                rows[k, j, i] = row[j, i]
    return worst


@_kernel
def nearest(
    table: Array, closed: Array, limits: Array, T: Array, near: Array, q: Array, rows: Array, scratch: Array, n: int
) -> None:
    """Write the joint angles (6,) within the limits whose pose comes closest to T, as far as descent finds them."""
    _, F = rigid(T)
    count, lanes, work = 0, scratch[:_LANES], scratch[_LANES:].reshape((WORK, 6))
    if closed[KIND] != 0.0:
        M = after(closed, UNTOOL, before(closed, UNBASE, F))
        count, _ = closed_form(closed, M, near, True, lanes[:48], lanes[48:96], lanes[288:320])
        _lane_angles(closed, limits, near, lanes, n)
        _to_rows(lanes, count, rows)
    best, trial = np.inf, work[16]
    for k in range(count + _NEAREST_STARTS):
        if k < count:
            trial[:] = rows[k, :6]
        else:
            _start(k - count, near, trial)
        for i in range(6):
            turned, _ = placed(trial[i], limits[0, i], limits[1, i], near[i])
            trial[i] = min(limits[1, i], max(limits[0, i], turned))
        cost = descend(table, F, trial, limits[0], limits[1], _LONG_STEPS, work)
        if k == 0 or cost < best:  # the first anyway: a pose may be so far off that every cost is infinite
            best = cost
            q[:] = trial
