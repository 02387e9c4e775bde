"""The printed equations 18.18 (pose) and 18.20 (Jacobian) of the 6R arm, written out element by element.

An oracle for tests: nothing here is shared with the library. ``printed=True`` gives the equations with the print's
misprints.
"""

from __future__ import annotations

import numpy as np

A1, A2, A3, A4, D1, D6 = 0.0365, 0.2515, 0.125, 0.092, 0.438, 0.1528


def _parts(q):
    s, c = np.sin(q), np.cos(q)
    return c, s, np.cos(q[1] + q[2]), np.sin(q[1] + q[2]), np.cos(q[1] + q[2] + q[3]), np.sin(q[1] + q[2] + q[3])


def pose(q):
    """Equation 18.18: T_base_tool, m; printed without a misprint."""
    (c1, c2, _, _, c5, c6), (s1, s2, _, _, s5, s6), c23, s23, c234, s234 = _parts(q)
    T = np.eye(4)
    T[0, 0] = c1 * (c234 * c5 * c6 - s234 * s6) - s1 * s5 * c6
    T[1, 0] = s1 * (c234 * c5 * c6 - s234 * s6) + c1 * s5 * c6
    T[2, 0] = -s234 * c5 * c6 - c234 * s6
    T[0, 1] = -c1 * (c234 * c5 * s6 + s234 * c6) + s1 * s5 * s6
    T[1, 1] = -s1 * (c234 * c5 * s6 + s234 * c6) - c1 * s5 * s6
    T[2, 1] = s234 * c5 * s6 - c234 * c6
    T[0, 2] = -c1 * c234 * s5 - s1 * c5
    T[1, 2] = -s1 * c234 * s5 + c1 * c5
    T[2, 2] = s234 * s5
    out = A1 + A2 * c2 + A3 * c23 + A4 * c234 - D6 * c234 * s5
    T[0, 3] = c1 * out - D6 * s1 * c5
    T[1, 3] = s1 * out + D6 * c1 * c5
    T[2, 3] = D1 - A2 * s2 - A3 * s23 - A4 * s234 + D6 * s234 * s5
    return T


def jacobian(q, *, printed=False):
    """Equation 18.20 with the elements of 18.21: rows [linear; angular], base axes."""
    (c1, c2, _, _, c5, _), (s1, s2, _, _, s5, _), c23, s23, c234, s234 = _parts(q)
    T = pose(q)
    end = A4 - D6 * s5
    up2, out2 = A2 * s2 + A3 * s23 + end * s234, A2 * c2 + A3 * c23 + end * c234
    up3, out3 = A3 * s23 + end * s234, A3 * c23 + end * c234
    up4, out4 = end * s234, end * c234
    J = np.zeros((6, 6))
    J[:, 0] = -T[1, 3], T[0, 3], 0, 0, 0, 1
    J[:, 1] = -c1 * up2, -s1 * up2, -out2, -s1, c1, 0
    J[:, 2] = -c1 * up3, -s1 * up3, -out3, -s1, c1, 0
    J[:, 3] = -c1 * up4, -s1 * up4, -out4, -s1, c1, 0
    J[:3, 4] = D6 * (s1 * s5 - c1 * c234 * c5), -D6 * (c1 * s5 + s1 * c234 * c5), D6 * s234 * c5
    J[3:, 4] = c1 * s234, s1 * s234, c234
    J[3:, 5] = T[:3, 2]
    if printed:
        J[0, 1] = -c1 * (A2 * s2 + A3 * s23 + (A4 - D6 * s2) * s234)  # j12: s2 where s5 belongs
        J[3, 4] = c2 * s234  # j45: c2 where c1 belongs
    return J
