"""The six_r model against its source's own equations, printed and put right."""

import numpy as np
import pytest
from printed_equations import D6, jacobian, pose

from armsight.robot.models import MODELS

ARM = MODELS["six_r"]
ANGLES = np.random.default_rng(18).uniform(-np.pi, np.pi, (200, 6))
#: Some thirty products and sums of numbers below 1 m.
ROUNDING = 2e-15


def test_the_printed_pose_agrees_in_all_twelve_elements():
    for q in ANGLES:
        np.testing.assert_allclose(ARM.forward(q), pose(q), rtol=0, atol=ROUNDING)


def test_home_and_zero_are_where_the_source_has_them():
    home = ARM.forward(ARM.home)
    np.testing.assert_allclose(home[:3, :3].T, [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=ROUNDING)
    np.testing.assert_allclose(home[:3, 3], [0.6578, 0, 0.438], atol=ROUNDING)
    np.testing.assert_allclose(ARM.forward(np.zeros(6))[:3, 3], [0.505, 0.1528, 0.438], atol=ROUNDING)


def test_the_jacobian_put_right_agrees_in_all_thirty_six():
    for q in ANGLES:
        np.testing.assert_allclose(ARM.jacobian(q), jacobian(q), rtol=0, atol=ROUNDING)


def test_each_misprint_of_the_jacobian_is_wrong_by_what_it_says():
    for q in ANGLES:
        s, c, s234 = np.sin(q), np.cos(q), np.sin(q[1] + q[2] + q[3])
        wrong = jacobian(q, printed=True) - ARM.jacobian(q)
        expected = np.zeros((6, 6))
        expected[0, 1] = c[0] * D6 * (s[1] - s[4]) * s234
        expected[3, 4] = (c[1] - c[0]) * s234
        np.testing.assert_allclose(wrong, expected, rtol=0, atol=2 * ROUNDING)


@pytest.mark.parametrize(("row", "column", "worst"), [(0, 1, 0.2), (3, 4, 1.5)])
def test_a_misprint_matters(row, column, worst):
    # j12 misses by up to 2 D6 = 0.31 m/rad, j45 by up to 2.
    assert max(abs(jacobian(q, printed=True) - ARM.jacobian(q))[row, column] for q in ANGLES) > worst


def test_the_printed_steps_give_each_solution():
    """theta_5 of either sign from c5, theta_234 and theta_6 by the source's formulas, of every solution found."""
    for q in ANGLES[:40]:
        T = ARM.forward(q)
        for s in ARM.inverse(T).q:
            n, o, a = T[:3, 0], T[:3, 1], T[:3, 2]
            w = T[:3, 3] - D6 * a
            s1, c1, s5 = np.sin(s[0]), np.cos(s[0]), np.sin(s[4])
            assert abs(-s1 * w[0] + c1 * w[1]) < 1e-13  # the wrist point is in the arm's plane
            assert abs(-s1 * a[0] + c1 * a[1] - np.cos(s[4])) < 1e-13
            assert abs(np.sin(s[1] + s[2] + s[3]) - a[2] / s5) < 1e-13 / abs(s5)
            assert abs(-s1 * n[0] + c1 * n[1] - np.cos(s[5]) * s5) < 1e-13
            assert abs(-s1 * o[0] + c1 * o[1] + np.sin(s[5]) * s5) < 1e-13
