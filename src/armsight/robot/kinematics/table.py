"""A Denavit-Hartenberg table in the one packed form that the kernels read.

Standard: ``A_i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)``. Modified: ``A_i = Rx(alpha_i) Tx(a_i) Rz(theta_i) Tz(d_i)``
(with Craig's alpha_{i-1}, a_{i-1} standing in row i). A modified table is a standard one whose a and alpha sit one row
earlier, after a constant first ``Rx(alpha_1) Tx(a_1)``, so the kernels know the standard form only. In both,
``theta_i = direction_i * q_i + offset_i``.

A packed table (102,) holds, in this order:

- 0 to 41: a row of a, d, cos alpha, sin alpha, offset, direction for each joint, and room for seven;
- 42 (BASE), 54 (TOOL): T_base_0 and T_n_tool, twelve numbers each, row by row;
- 66 (MODIFIED): 1 for the modified convention, where a link's frame sits on its own joint's axis; 0 for the standard one;
- 67 (KIND) to 69: the structure the closed-form inverse works on, and its forearm (see ``structure``);
- 70 (UNBASE), 82 (UNTOOL): the inverses of T_base_0, and of everything that comes after the last joint's rotation;
- 94 (BEND) to 96: the forearm's angle (see ``structure``);
- 97 (JOINTS): how many joints there are; the rest is free.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array
from armsight.geometry.pose import inverse

#: How many revolute joints an arm may have.
FEWEST_JOINTS, MOST_JOINTS = 4, 7
BASE, TOOL, MODIFIED, KIND, FOREARM, ACROSS, UNBASE, UNTOOL, BEND, JOINTS, SIZE = (
    *(42, 54, 66, 67, 68, 69),
    *(70, 82, 94, 97, 102),
)


def exact_cos_sin(angle: Array) -> tuple[Array, Array]:
    """Return cosines and sines of angles (N,), rad, exactly 0 or +-1 where a multiple of 90 degrees is meant."""
    quarter = np.rint(angle / (np.pi / 2))
    exact = np.abs(angle - quarter * (np.pi / 2)) < 1e-12
    cos, sin = np.cos(angle), np.sin(angle)
    return np.where(exact, np.rint(cos), cos), np.where(exact, np.rint(sin), sin)


def rows_of(table: Array) -> Array:
    """Return the rows (n, 6) of a packed table, one for each joint: a view of it."""
    joints = int(table[JOINTS])
    return table[: 6 * joints].reshape(joints, 6)


def link(a: float, d: float, cos: float, sin: float) -> Array:
    """Return the constant part of a standard row, ``Tz(d) Tx(a) Rx(alpha)``, (4, 4)."""
    return np.array([[1, 0, 0, a], [0, cos, -sin, 0], [0, sin, cos, d], [0, 0, 0, 1.0]])


def packed(
    a: Array,
    d: Array,
    alpha: Array,
    offset: Array,
    direction: Array,
    T_base_0: Array,
    T_n_tool: Array,
    *,
    modified: bool,
) -> Array:
    """Pack a table for the kernels.

    Args:
        a: (n,) link lengths, m.
        d: (n,) link offsets, m.
        alpha: (n,) twists, rad.
        offset: (n,) added to the joint angles, rad.
        direction: (n,) +1 or -1, by which the joint angles are multiplied.
        T_base_0: (4, 4) frame 0 of the table in the base.
        T_n_tool: (4, 4) the tool in the last frame of the table.
        modified: whether the table follows the modified convention.

    Returns:
        (102,) the packed table.
    """
    cos, sin = exact_cos_sin(alpha)
    if modified:
        T_base_0 = T_base_0 @ link(a[0], 0.0, cos[0], sin[0])
        a, cos, sin = np.append(a[1:], 0.0), np.append(cos[1:], 1.0), np.append(sin[1:], 0.0)
    table = np.zeros(SIZE)
    joints = len(a)
    table[: 6 * joints] = np.stack([a, d, cos, sin, offset, direction], axis=1).ravel()
    table[JOINTS] = joints
    table[BASE : BASE + 12] = T_base_0[:3].ravel()
    table[TOOL : TOOL + 12] = T_n_tool[:3].ravel()
    table[MODIFIED] = modified
    table[UNBASE : UNBASE + 12] = inverse(T_base_0)[:3].ravel()
    table[UNTOOL : UNTOOL + 12] = inverse(link(a[-1], d[-1], cos[-1], sin[-1]) @ T_n_tool)[:3].ravel()
    return table
