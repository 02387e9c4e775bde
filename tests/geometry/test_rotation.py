"""Laws of rotations, near nothing and near pi; scipy.linalg.expm is the oracle."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given

from armsight.geometry.rotation import (
    SINGULAR_COS_PITCH,
    euler_zyx,
    exp_so3,
    from_euler_zyx,
    from_quaternion_wxyz,
    log_so3,
    nearest_rotation,
    quaternion_wxyz,
    skew,
)
from asserts import assert_jacobian, assert_rotation
from strategies import finite, rotation_vectors, rotations, vectors

TIGHT = 1e-14  # a few dozen roundings of numbers near 1


@given(vectors(-3, 3), vectors(-3, 3))
def test_skew_is_the_cross_product(v, w):
    np.testing.assert_allclose(skew(v) @ w, np.cross(v, w), atol=4e-15)
    np.testing.assert_array_equal(skew(v), -skew(v).T)


def test_skew_takes_leading_axes():
    v = np.arange(12.0).reshape(2, 2, 3)
    np.testing.assert_array_equal(skew(v)[1, 0], skew(v[1, 0]))


@given(rotation_vectors())
def test_exp_is_the_matrix_exponential(phi):
    R = exp_so3(phi)
    assert_rotation(R)
    np.testing.assert_allclose(R, scipy.linalg.expm(skew(phi)), atol=TIGHT)


@given(rotation_vectors())
def test_log_undoes_exp(phi):
    back = log_so3(exp_so3(phi))
    assert np.linalg.norm(back) <= np.pi * (1 + 1e-15)
    # At pi, phi and -phi are one rotation and either may come back.
    off = min(np.abs(back - phi).max(), np.abs(back + phi).max() if np.linalg.norm(phi) > np.pi - 1e-7 else np.inf)
    assert off <= 1e-13


@given(rotations())
def test_exp_undoes_log(R):
    np.testing.assert_allclose(exp_so3(log_so3(R)), R, atol=TIGHT)


@given(rotation_vectors())
def test_the_inverse_is_the_transpose(phi):
    np.testing.assert_allclose(exp_so3(-phi), exp_so3(phi).T, atol=TIGHT)


def test_exp_and_log_take_leading_axes():
    phi = np.random.default_rng(1).normal(size=(2, 4, 3)) * 0.5
    R = exp_so3(phi)
    assert R.shape == (2, 4, 3, 3)
    np.testing.assert_allclose(log_so3(R), phi, atol=TIGHT)


def test_exp_differs_by_skew_at_nothing():
    J = np.stack([skew(e) for e in np.eye(3)], axis=-1)
    assert_jacobian(J, exp_so3, np.zeros(3), 1e-3)


@given(rotations())
def test_quaternion_comes_back_with_w_first_and_positive(R):
    q = quaternion_wxyz(R)
    assert q[0] >= 0
    assert abs(np.linalg.norm(q) - 1) <= 1e-15 * 4
    np.testing.assert_allclose(from_quaternion_wxyz(q), R, atol=TIGHT)
    np.testing.assert_allclose(from_quaternion_wxyz(-3.0 * q), R, atol=TIGHT)


def test_quaternion_of_90_degrees_about_z():
    half = np.sqrt(0.5)
    R = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(quaternion_wxyz(R), [half, 0, 0, half], atol=1e-15)


@given(finite(-np.pi, np.pi), finite(-np.pi / 2, np.pi / 2), finite(-np.pi, np.pi))
def test_roll_pitch_yaw_is_z_y_x(roll, pitch, yaw):
    Rz, Ry, Rx = (scipy.linalg.expm(skew(a * e)) for a, e in zip((roll, pitch, yaw), np.eye(3)[::-1], strict=True))
    R = from_euler_zyx(roll, pitch, yaw)
    np.testing.assert_allclose(R, Rz @ Ry @ Rx, atol=TIGHT)


@given(rotations())
def test_roll_pitch_yaw_comes_back(R):
    (roll, pitch, yaw), singular = euler_zyx(R)
    assert abs(pitch) <= np.pi / 2
    # Taken as singular, the remaining cos(pitch) is left out of the matrix: at most that much is lost.
    atol = 2 * SINGULAR_COS_PITCH if singular else 1e-13
    np.testing.assert_allclose(from_euler_zyx(roll, pitch, yaw), R, atol=atol)


@pytest.mark.parametrize("sign", [1, -1])
def test_singular_pitch_is_reported_and_roll_carries_what_is_left(sign):
    roll, yaw = 0.7, -0.4
    (found, pitch, zero), singular = euler_zyx(from_euler_zyx(roll, sign * np.pi / 2, yaw))
    assert singular
    assert zero == 0
    assert pitch == pytest.approx(sign * np.pi / 2, abs=1e-12)
    assert found == pytest.approx(roll - sign * yaw, abs=1e-12)
    assert not euler_zyx(from_euler_zyx(roll, sign * (np.pi / 2 - 1e-5), yaw))[1]


@given(rotations(), vectors(0.5, 2.0), rotation_vectors())
def test_the_nearest_rotation_undoes_a_scaling(R, scale, phi):
    """R times a symmetric positive matrix is nearest to R (polar decomposition)."""
    Q = exp_so3(phi)
    found = nearest_rotation(R @ Q @ np.diag(scale) @ Q.T)
    assert_rotation(found)
    np.testing.assert_allclose(found, R, atol=1e-13)


def test_the_nearest_rotation_is_the_nearest_and_mirrored_is_a_reflection():
    rng = np.random.default_rng(6)
    for M in rng.normal(size=(50, 3, 3)):
        found, mirrored = nearest_rotation(M), nearest_rotation(M, mirrored=True)
        assert_rotation(found)
        assert_rotation(-mirrored)
        for small in exp_so3(rng.normal(0, 0.05, (20, 3))):
            assert np.linalg.norm(found - M) <= np.linalg.norm(small @ found - M)
            assert np.linalg.norm(mirrored - M) <= np.linalg.norm(small @ mirrored - M)
