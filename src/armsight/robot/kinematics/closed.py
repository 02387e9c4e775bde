"""All joint angles that bring the tool to a pose, in closed form, for the two structures that ``structure`` knows.

Both begin alike: axis 2's direction h rotates with joint 1, and the wrist point's distance along h is a constant of the
arm, which gives joint 1 (two shoulders). Seen from link 1, what remains is a planar arm of two links and three rotations
about axes at right angles:

- SPHERICAL: the wrist point is the planar arm's end (two elbows), then the wrist's three angles follow (two wrists);
- PARALLEL: joints 2 + 3 + 4, 5 and 6 rotate the tool (two wrists), then the end of the planar arm is known (two elbows).

Each step solves exactly what the steps before have left, so that an angle which is badly determined near a singularity
does not spoil the pose. Where an angle is not determined at all, it is given the value in ``near``, or 0. Pieper,
"The kinematics of manipulators under computer control", 1968; the arm ``six_r`` is a PARALLEL one.

Angles are carried as points (cosine, sine); a solution is one of the eight slots of a batch (see ``chain``), so that the
angles of all solutions are computed together afterwards. Letters: c and s are a cosine and a sine, n o a the columns of the
requested rotation, w the wrist point.
"""

from __future__ import annotations

import math

import numpy as np

from armsight.data import Array
from armsight.kernels import kernel
from armsight.robot.kinematics.chain import Frame, angle_of, sincos
from armsight.robot.kinematics.structure import PARALLEL
from armsight.robot.kinematics.table import ACROSS, BEND, FOREARM, KIND

Point = tuple[float, float]

#: Bits of a solution's state, and of what kept the pose out of reach. OUTSIDE: a joint is beyond its limits; DOUBT: what
#: the arm missed may be what rounding did to badly determined angles.
SHOULDER, ELBOW, WRIST, OUTSIDE, DOUBT = (1 << bit for bit in range(5))

#: Below this distance, m, or sine, a joint is not determined: what it moves stays below 1e-12 m or rad.
_FREE = 1e-12
#: A rotation that moves the tool by less than this, m or rad, may bring the arm within reach; the polish undoes it.
_UNFELT = 1e-10  # where rounding moves the planar arm's end by more, m, a miss is in doubt
#: Reach may be missed by so much, m: rounding, not distance.
_TOLERANCE_M = 1e-11
#: What rounding does to a wrist point, m, or an axis: divided by a sine or a distance that is an error of an angle.
_ROUNDING = 1e-14
#: How many angles are tried for joint 1 where the wrist point lies on axis 1, and how far apart, rad.
_TRIES, _TRY_RAD = 144, 2.0 * np.pi / 144.0
#: Two solutions whose half difference, or the sine of it, is below this are one: rounding alone parts a double one by 2e-8.
SAME = 1e-7


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _in_link1(x: float, y: float, z: float, c1: float, s1: float, sa: float) -> tuple[float, float, float]:
    """Return a vector of frame 0 in the axes of link 1, whose z axis is perpendicular to frame 0's."""
    return c1 * x + s1 * y, sa * z, sa * (s1 * x - c1 * y)


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _at(table: Array, i: int, near: Array) -> Point:
    """Return joint i's theta at ``near`` as a point."""
    s, c = sincos(table[6 * i + 5] * near[i] + table[6 * i + 4])
    return c, s


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _put(y: Array, x: Array, i: int, slot: int, c: float, s: float) -> None:
    """Write joint i's angle into a slot of the batch."""
    x[8 * i + slot], y[8 * i + slot] = c, s


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _tag(tags: Array, slot: int, front: float, up: float, wrist: float, state: int) -> None:
    tags[slot], tags[8 + slot] = front, 1.0 if up >= 0.0 else -1.0
    tags[16 + slot], tags[24 + slot] = 1.0 if wrist >= 0.0 else -1.0, state


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _bend(table: Array, tx: float, ty: float, tolerance: float) -> tuple[bool, float, float]:
    """Return whether the planar arm reaches a point within a tolerance, m, and the angle between its links, s >= 0."""
    upper, fore = table[6], table[FOREARM]
    far2 = tx * tx + ty * ty
    far, most, least = math.sqrt(far2), abs(upper) + fore, abs(abs(upper) - fore)
    c = (far2 - upper * upper - fore * fore) / (2.0 * upper * fore)
    c = min(1.0, max(-1.0, c))
    return least - tolerance <= far <= most + tolerance, c, math.sqrt((1.0 - c) * (1.0 + c))


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _upper_arm(table: Array, tx: float, ty: float, c: float, s: float, near: Array) -> Point:
    """Return theta2 for the planar arm's end and the angle between its links."""
    along, across = table[6] + table[FOREARM] * c, table[FOREARM] * s
    x, y = along * tx + across * ty, along * ty - across * tx
    length = math.sqrt(x * x + y * y)
    if length < _FREE * abs(table[6]):  # folded back onto the shoulder: any direction will do
        return _at(table, 1, near)
    return x / length, y / length


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _lower_arm(table: Array, c2: float, s2: float, c: float, s: float) -> tuple[float, float, float, float]:
    """Return theta3, and theta2 + theta3, as points: the angle between the links less the forearm's own bend."""
    cb, sb = table[BEND + 1], table[BEND + 2]
    c3, s3 = c * cb + s * sb, s * cb - c * sb
    return c3, s3, c2 * c3 - s2 * s3, s2 * c3 + c2 * s3


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _spherical(
    table: Array,
    B: Frame,
    near: Array,
    tolerance: float,
    front: float,
    state: int,
    y: Array,
    x: Array,
    tags: Array,
    slot: int,
) -> tuple[int, int]:
    """Fill the slots of one shoulder of a SPHERICAL arm; B is the wrist in link 1. Returns the next slot, what missed."""
    nx, ny, nz, ox, oy, oz, ax, ay, az, tx, ty, _ = B
    reached, c, s = _bend(table, tx, ty, tolerance)
    if not reached:
        return slot, ELBOW
    ways = 1 if s < SAME else 2
    state |= ELBOW if ways == 1 else 0
    ca, sa, sa4, sa5 = table[14], table[15], table[21], table[27]
    for way in range(ways):
        s = -s if way else s
        c2, s2 = _upper_arm(table, tx, ty, c, s, near)
        c3, s3, c23, s23 = _lower_arm(table, c2, s2, c, s)
        # The requested rotation in frame 3: rotated back by theta2 + theta3, then by alpha3.
        n0, n1 = c23 * nx + s23 * ny, ca * (c23 * ny - s23 * nx) + sa * nz
        o0, o1 = c23 * ox + s23 * oy, ca * (c23 * oy - s23 * ox) + sa * oz
        a0, across = c23 * ax + s23 * ay, c23 * ay - s23 * ax
        a1, a2 = ca * across + sa * az, ca * az - sa * across
        size = math.sqrt(a0 * a0 + a1 * a1)
        free = size < _FREE
        c4, s4 = _at(table, 3, near) if free else (sa5 * a0 / size, sa5 * a1 / size)
        for flip in range(1 if free else 2):
            c4, s4 = (-c4, -s4) if flip else (c4, s4)
            s5 = sa5 * (c4 * a0 + s4 * a1)
            _put(y, x, 1, slot, c2, s2)
            _put(y, x, 2, slot, c3, s3)
            _put(y, x, 3, slot, c4, s4)
            _put(y, x, 4, slot, -sa4 * sa5 * a2, s5)
            _put(y, x, 5, slot, sa4 * sa5 * (s4 * o0 - c4 * o1), sa4 * sa5 * (s4 * n0 - c4 * n1))
            _tag(tags, slot, front, -front * table[3] * table[6] * s, s5, state | (WRIST if free else 0))
            slot += 1
    return slot, 0


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _helpful_rotation(table: Array, wx: float, wy: float, c: float, s: float) -> float:
    """Return the least change of theta2 + theta3 + theta4 that brings a PARALLEL arm's planar end within reach; 10 if none.

    The end lies at the wrist point (wx, wy) less a lever that rotates with that sum.
    """
    upper, fore = abs(table[6]), table[FOREARM]
    across = table[25] * table[21]
    lx, ly = table[18] * c + across * s, table[18] * s - across * c
    far2, lever2 = wx * wx + wy * wy, lx * lx + ly * ly
    product = 2.0 * math.sqrt(far2 * lever2)
    now = angle_of(wx * ly - wy * lx, wx * lx + wy * ly)  # from the wrist point's direction to the lever's
    reach2 = far2 + lever2 - 2.0 * (wx * lx + wy * ly)
    edge = upper + fore if reach2 > upper * upper + fore * fore else upper - fore
    cosine = far2 + lever2 - edge * edge
    if abs(cosine) > product or product == 0.0:
        return 10.0
    cosine /= product
    edge_angle = angle_of(math.sqrt((1.0 - cosine) * (1.0 + cosine)), cosine)
    return (-edge_angle if now < 0.0 else edge_angle) - now


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _parallel(
    table: Array,
    B: Frame,
    near: Array,
    tolerance: float,
    front: float,
    state: int,
    y: Array,
    x: Array,
    tags: Array,
    slot: int,
) -> tuple[int, int]:
    """Fill the slots of one shoulder of a PARALLEL arm; B is the wrist in link 1. Returns the next slot, what missed."""
    nx, ny, _, ox, oy, _, ax, ay, az, wx, wy, _ = B
    a4, d5, sa4, sa5 = table[18], table[25], table[21], table[27]
    missed, size = 0, math.sqrt(ax * ax + ay * ay)
    free = size < _FREE
    c, s = (1.0, 0.0) if free else (sa5 * ax / size, sa5 * ay / size)  # of theta2 + theta3 + theta4
    if free:
        c6, s6 = _at(table, 5, near)
        c, s = -sa4 * sa5 * (s6 * ny + c6 * oy), sa4 * sa5 * (s6 * nx + c6 * ox)
    for flip in range(1 if free else 2):
        c, s = (-c, -s) if flip else (c, s)
        cs, ss = c, s
        tx, ty = wx - a4 * cs - d5 * sa4 * ss, wy - a4 * ss + d5 * sa4 * cs
        # An uncertain sum moves the planar end: the polish corrects afterwards what rounding did.
        loose = tolerance + (abs(a4) + abs(d5)) * _ROUNDING / max(size, _FREE)
        reached, ce, se = _bend(table, tx, ty, 0.0 if free else loose)
        if not reached:
            # Near the wrist's singularity the sum is free to change, as far as the tool does not move.
            change = _helpful_rotation(table, wx, wy, cs, ss)
            if change < 10.0 and (free or size * abs(change) < _UNFELT):
                st, ct = sincos(change)
                cs, ss = cs * ct - ss * st, ss * ct + cs * st
                tx, ty = wx - a4 * cs - d5 * sa4 * ss, wy - a4 * ss + d5 * sa4 * cs
            reached, ce, se = _bend(table, tx, ty, loose)
            if not reached:
                missed |= ELBOW | (DOUBT if loose > _UNFELT else 0)
                continue
        ways = 1 if se < SAME else 2
        s5 = sa5 * (cs * ax + ss * ay)
        for way in range(ways):
            se = -se if way else se
            c2, s2 = _upper_arm(table, tx, ty, ce, se, near)
            c3, s3, c23, s23 = _lower_arm(table, c2, s2, ce, se)
            _put(y, x, 1, slot, c2, s2)
            _put(y, x, 2, slot, c3, s3)
            _put(y, x, 3, slot, cs * c23 + ss * s23, ss * c23 - cs * s23)
            _put(y, x, 4, slot, -sa4 * sa5 * az, s5)
            _put(y, x, 5, slot, sa4 * sa5 * (ss * ox - cs * oy), sa4 * sa5 * (ss * nx - cs * ny))
            now = state | (WRIST if free else 0) | (ELBOW if ways == 1 else 0)
            _tag(tags, slot, front, -front * table[3] * table[6] * se, s5, now)
            slot += 1
    return slot, missed


@kernel(nogil=True, fastmath={"contract", "nsz"})
def _one_shoulder(
    table: Array,
    M: Frame,
    c1: float,
    s1: float,
    near: Array,
    tolerance: float,
    front: float,
    state: int,
    y: Array,
    x: Array,
    tags: Array,
    first: int,
) -> tuple[int, int]:
    """Fill the slots of one theta1. Returns the next slot, and what missed."""
    sa = table[3]
    nx, ny, nz = _in_link1(M[0], M[1], M[2], c1, s1, sa)
    ox, oy, oz = _in_link1(M[3], M[4], M[5], c1, s1, sa)
    ax, ay, az = _in_link1(M[6], M[7], M[8], c1, s1, sa)
    px, py, pz = _in_link1(M[9], M[10], M[11] - table[1], c1, s1, sa)
    B = (nx, ny, nz, ox, oy, oz, ax, ay, az, px - table[0], py, pz)
    if table[KIND] == PARALLEL:
        slot, missed = _parallel(table, B, near, tolerance, front, state, y, x, tags, first)
    else:
        slot, missed = _spherical(table, B, near, tolerance, front, state, y, x, tags, first)
    for k in range(first, slot):
        _put(y, x, 0, k, c1, s1)
    return slot, missed


@kernel(nogil=True, fastmath={"contract", "nsz"})
def closed_form(table: Array, M: Frame, near: Array, clamp: bool, y: Array, x: Array, tags: Array) -> tuple[int, int]:
    """Write the thetas of all solutions into a batch, one after the other.

    Args:
        table: (102,) a packed table whose KIND is PARALLEL or SPHERICAL.
        M: the requested frame just after joint 6's rotation, in frame 0 of the table.
        near: (6,) joint angles, rad: what an undetermined joint is given.
        clamp: write the closest that a step can come where a pose is out of reach.
        y: (48,) batch of the angles' sines.
        x: (48,) batch of their cosines.
        tags: (32,) batch of shoulder, elbow, wrist (+-1) and state.

    Returns:
        how many slots were filled, and bits of what kept solutions out of reach.
    """
    offset, wx, wy = table[ACROSS], M[9], M[10]
    r = math.sqrt(wx * wx + wy * wy)
    if r < abs(offset) - _TOLERANCE_M and not clamp:
        return 0, SHOULDER
    e = math.sqrt(max((r - abs(offset)) * (r + abs(offset)), 0.0))
    free = r < _FREE
    single = free or e < SAME * r
    tolerance = (
        np.inf if clamp else _TOLERANCE_M + (abs(table[18]) + abs(table[25])) * _ROUNDING / max(e, 1e-6 * r, _FREE)
    )
    state = SHOULDER if single else 0
    missed, slot = 0, 0
    for way in range(1 if single else 2):
        e = -e if way else e
        c1, s1 = wx * e - wy * offset, wy * e + wx * offset
        length = math.sqrt(c1 * c1 + s1 * s1)
        c1, s1 = _at(table, 0, near) if free else (c1 / length, s1 / length)
        first, out = slot, 0
        # With the wrist point on axis 1, joint 1 is free as far as the rest then reaches: near, and on either side of it.
        for k in range(_TRIES if free else 1):
            st, ct = sincos((k + 1) // 2 * (1.0 if k & 1 else -1.0) * _TRY_RAD)
            ck, sk = c1 * ct - s1 * st, s1 * ct + c1 * st
            front = -1.0 if way else 1.0
            slot, out = _one_shoulder(table, M, ck, sk, near, tolerance, front, state, y, x, tags, slot)
            if slot > first:
                break
        missed |= out
    return slot, missed
