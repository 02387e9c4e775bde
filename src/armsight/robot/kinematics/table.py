"""A Denavit-Hartenberg table in the one packed form that the kernels read.

Standard: ``A_i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)``. Modified: ``A_i = Rx(alpha_i) Tx(a_i) Rz(theta_i) Tz(d_i)``
(with Craig's alpha_{i-1}, a_{i-1} standing in row i). A modified table is a standard one whose a and alpha sit one row
earlier, after a constant first ``Rx(alpha_1) Tx(a_1)``, so the kernels know the standard form only. In both,
``theta_i = direction_i * q_i + offset_i``.
"""

from __future__ import annotations

import numpy as np

from armsight.data import Array

#: Places in a packed table (64,): six rows of a, d, cos alpha, sin alpha, offset, direction; then two 3x4 transforms, row by
#: row; then 1 for the modified convention, 0 for the standard one (where a link's frame sits); the rest is free.
BASE, TOOL, MODIFIED, SIZE = 36, 48, 60, 64


def exact_cos_sin(angle: Array) -> tuple[Array, Array]:
    """Return cosines and sines of angles (N,), rad, exactly 0 or +-1 where a multiple of 90 degrees is meant."""
    quarter = np.rint(angle / (np.pi / 2))
    exact = np.abs(angle - quarter * (np.pi / 2)) < 1e-12
    cos, sin = np.cos(angle), np.sin(angle)
    return np.where(exact, np.rint(cos), cos), np.where(exact, np.rint(sin), sin)


def packed(
    a: Array,
    d: Array,
    alpha: Array,
    offset: Array,
    direction: Array,
    T_base_0: Array,
    T_6_tool: Array,
    *,
    modified: bool,
) -> Array:
    """Pack a table for the kernels.

    Args:
        a: (6,) link lengths, m.
        d: (6,) link offsets, m.
        alpha: (6,) twists, rad.
        offset: (6,) added to the joint angles, rad.
        direction: (6,) +1 or -1, by which the joint angles are multiplied.
        T_base_0: (4, 4) frame 0 of the table in the base.
        T_6_tool: (4, 4) the tool in frame 6 of the table.
        modified: whether the table follows the modified convention.

    Returns:
        (64,) the packed table.
    """
    cos, sin = exact_cos_sin(alpha)
    if modified:
        first = np.array([[1, 0, 0, a[0]], [0, cos[0], -sin[0], 0], [0, sin[0], cos[0], 0], [0, 0, 0, 1]])
        T_base_0 = T_base_0 @ first
        a, cos, sin = np.append(a[1:], 0.0), np.append(cos[1:], 1.0), np.append(sin[1:], 0.0)
    table = np.zeros(SIZE)
    table[:BASE] = np.stack([a, d, cos, sin, offset, direction], axis=1).ravel()
    table[BASE:TOOL] = T_base_0[:3].ravel()
    table[TOOL:MODIFIED] = T_6_tool[:3].ravel()
    table[MODIFIED] = modified
    return table
