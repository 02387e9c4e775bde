"""Where the tool is and how it moves: against products of matrices and against differences."""

import dataclasses

import arms
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armsight.geometry.rotation import log_so3
from armsight.robot.kinematics.chain import angle_of, sincos
from asserts import numeric_jacobian
from strategies import vectors

EVERY = [*arms.ALL, *arms.OTHERS, arms.FOUR, arms.COUPLED]
every = pytest.mark.parametrize("arm", EVERY, ids=arms.names(EVERY))
#: Rounding of some hundred products and sums of numbers below 4 (m or 1).
ROUNDING = 1e-14


def draw(seed, n=50, joints=6):
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (n, joints))


@every
def test_forward_and_links_are_the_products_of_the_table(arm):
    for q in draw(1, joints=arm.joints):
        expected = arms.frames(arm, q)
        np.testing.assert_allclose(arm.forward(q), expected[-1], rtol=0, atol=ROUNDING)
        np.testing.assert_allclose(arm.links(q), expected, rtol=0, atol=ROUNDING)


def test_frame_0_of_a_modified_table_is_before_its_first_twist_and_length():
    base = arms.odd(arms.CRAIG, "odd_craig", 3)
    arm = dataclasses.replace(base, a=base.a + 0.04, alpha=base.alpha + 0.3)
    for q in draw(7, 5):
        np.testing.assert_allclose(arm.links(q), arms.frames(arm, q), rtol=0, atol=ROUNDING)


@given(st.sampled_from(arms.ALL), vectors(-20, 20, 6))
def test_forward_holds_for_any_angles(arm, q):
    # An angle of 20 rad is rounded 16 times coarser than one of 1, and moves the tool by up to 3 m/rad.
    np.testing.assert_allclose(arm.forward(q), arms.forward(arm, q), rtol=0, atol=6 * ROUNDING)


@every
def test_a_batch_is_its_single_calls(arm):
    for n in (0, 1, 7, 8, 9, 33):
        q = draw(2, n, arm.joints)
        single = np.array([arm.forward(row) for row in q]).reshape(n, 4, 4)
        np.testing.assert_allclose(arm.forward(q), single, rtol=0, atol=ROUNDING)
        for frame in ("base", "tool"):
            single = np.array([arm.jacobian(row, frame) for row in q]).reshape(n, 6, arm.joints)
            np.testing.assert_array_equal(arm.jacobian(q, frame), single)


@every
def test_jacobian_is_the_derivative_of_forward(arm):
    for q in draw(3, 10, arm.joints):
        T = arms.forward(arm, q)

        def moved(p, T=T):
            Tp = arms.forward(arm, p)
            return np.concatenate([Tp[:3, 3], log_so3(Tp[:3, :3] @ T[:3, :3].T)])

        # Richardson's error is of order step^4 = 1e-12; rounding leaves 1e-15 / 1e-3 times a few.
        expected = numeric_jacobian(moved, q, 1e-3)
        np.testing.assert_allclose(arm.jacobian(q), expected, rtol=0, atol=3e-11)
        rotate = np.kron(np.eye(2), T[:3, :3].T)
        np.testing.assert_allclose(arm.jacobian(q, "tool"), rotate @ arm.jacobian(q), rtol=0, atol=ROUNDING)


@every
def test_jacobian_rate_is_its_derivative_by_time(arm):
    for q, qd, frame in zip(draw(4, 10, arm.joints), draw(5, 10, arm.joints), 5 * ["base", "tool"], strict=True):

        def at(t, q=q, qd=qd, frame=frame):
            return arm.jacobian(q + t[0] * qd, frame)

        expected = numeric_jacobian(at, np.zeros(1), 3e-4)[..., 0]
        # Richardson's error: step^4 times the fifth derivative, below (6 pi)^5 x 3 m.
        np.testing.assert_allclose(arm.jacobian_rate(q, qd, frame), expected, rtol=0, atol=1e-8)


@every
def test_manipulability_is_the_volume_of_the_velocity_ellipsoid(arm):
    q = draw(6, 20, arm.joints)
    expected = [np.prod(np.linalg.svd(J)[1]) for J in arm.jacobian(q)]
    np.testing.assert_allclose(arm.manipulability(q), expected, rtol=0, atol=1e-13)
    assert arm.manipulability(q[0]) == arm.manipulability(q)[0]


@given(st.floats(-4000, 4000))
def test_sine_and_cosine_are_within_two_units_of_the_last_digit(x):
    s, c = sincos(x)
    assert abs(s - np.sin(x)) <= 2 * np.spacing(max(abs(np.sin(x)), 1e-300)) + 1e-19
    assert abs(c - np.cos(x)) <= 2 * np.spacing(max(abs(np.cos(x)), 1e-300)) + 1e-19


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3))
def test_the_angle_of_a_point_is_within_two_units_of_the_last_digit(y, x):
    y, x = (0.0 if abs(v) < 1e-150 else v for v in (y, x))
    assert abs(angle_of(y, x) - np.arctan2(y + 0.0, x + 0.0)) <= 2 * np.spacing(abs(np.arctan2(y, x)))
