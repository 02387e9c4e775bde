"""From a wanted pose to checked, polished and ordered joint angles; and to the nearest pose where there are none.

Where the arm has a closed form, its solutions are measured against the true table and polished if rounding, or a table
that has the structure only nearly, left them off. Where it has none, damped least squares starts from many places.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from armsight.data import Array, Ids
from armsight.robot.kinematics.chain import Frame, after, before, tool_frame
from armsight.robot.kinematics.closed import DOUBT, SHOULDER, WRIST, closed_form
from armsight.robot.kinematics.descent import WORK, descend, pose_error
from armsight.robot.kinematics.batch import errors, frames, thetas
from armsight.robot.kinematics.rigid import rigid
from armsight.robot.kinematics.rows import (
    ANGLE,
    CONFIGURATION,
    KEY,
    MOST,
    OUTSIDE,
    POSITION,
    STATE,
    known,
    place,
    placed,
    sort,
    wrap,
)
from armsight.robot.kinematics.table import KIND, UNBASE, UNTOOL
from armsight.robot.kinematics.trig import angle_of_each, sincos_each

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

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})


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
