"""Laws of poses and their tangent vectors; scipy.linalg.expm is the oracle."""

import numpy as np
import scipy.linalg
from hypothesis import given

from armsight.geometry.pose import (
    adjoint,
    exp_se3,
    inverse,
    left_jacobian,
    log_se3,
    mean_pose,
    pose,
    small_adjoint,
    transform,
)
from armsight.geometry.rotation import exp_so3, log_so3, skew
from asserts import assert_jacobian, assert_rotation
from strategies import poses, rotation_vectors, vectors

TIGHT = 1e-14


def hat(xi):
    """The (4, 4) matrix whose exponential is exp_se3."""
    out = np.zeros((4, 4))
    out[:3, :3], out[:3, 3] = skew(xi[3:]), xi[:3]
    return out


@given(vectors(-2, 2), rotation_vectors())
def test_exp_is_the_matrix_exponential(rho, phi):
    xi = np.concatenate([rho, phi])
    np.testing.assert_allclose(exp_se3(xi), scipy.linalg.expm(hat(xi)), atol=8 * TIGHT)


@given(vectors(-2, 2), rotation_vectors(np.pi - 1e-3))
def test_log_undoes_exp(rho, phi):
    # V^-1 grows without bound only towards 2 pi; up to pi it loses less than two digits.
    xi = np.concatenate([rho, phi])
    np.testing.assert_allclose(log_se3(exp_se3(xi)), xi, atol=1e-12)


@given(poses())
def test_exp_undoes_log(T):
    np.testing.assert_allclose(exp_se3(log_se3(T)), T, atol=1e-12)


@given(poses(), poses(), poses())
def test_poses_form_a_group(A, B, C):
    np.testing.assert_allclose(inverse(A) @ A, np.eye(4), atol=TIGHT)
    np.testing.assert_allclose(inverse(A @ B), inverse(B) @ inverse(A), atol=8 * TIGHT)
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=8 * TIGHT)


@given(poses(), poses(), vectors(-2, 2))
def test_inner_letters_cancel(T_a_b, T_b_c, p_c):
    np.testing.assert_allclose(transform(T_a_b @ T_b_c, p_c), transform(T_a_b, transform(T_b_c, p_c)), atol=8 * TIGHT)


@given(poses(), vectors(-2, 2))
def test_perturbation_on_the_right(T, p):
    # d (T exp(xi) p) / d xi at 0 is R [I, -skew(p)].
    J = T[:3, :3] @ np.hstack([np.eye(3), -skew(p)])
    assert_jacobian(J, lambda xi: transform(T @ exp_se3(xi), p), np.zeros(6), 1e-3)


@given(poses(), vectors(-2, 2), rotation_vectors())
def test_the_adjoint_carries_a_tangent(T, rho, phi):
    xi = np.concatenate([rho, phi])
    np.testing.assert_allclose(T @ hat(xi) @ inverse(T), hat(adjoint(T) @ xi), atol=16 * TIGHT)


@given(vectors(-1, 1), rotation_vectors(1.0))
def test_the_small_adjoint_generates_the_adjoint(rho, phi):
    xi = np.concatenate([rho, phi])
    np.testing.assert_allclose(adjoint(exp_se3(xi)), scipy.linalg.expm(small_adjoint(xi)), atol=8 * TIGHT)


@given(rotation_vectors())
def test_the_left_jacobian_is_that_of_exp(phi):
    # exp(phi + d) exp(phi)^T = exp(V d) to first order; log is the identity to first order about no rotation.
    assert_jacobian(left_jacobian(phi), lambda v: log_so3(exp_so3(v) @ exp_so3(phi).T), phi, 1e-3)


def test_leading_axes():
    xi = np.random.default_rng(2).normal(size=(5, 6))
    Ts = exp_se3(xi)
    np.testing.assert_allclose(Ts[3], exp_se3(xi[3]), atol=TIGHT)
    np.testing.assert_allclose(inverse(Ts)[3], inverse(Ts[3]), atol=TIGHT)
    for f in (adjoint, log_se3):
        np.testing.assert_allclose(f(Ts)[3], f(Ts[3]), atol=TIGHT)
    for g in (small_adjoint, lambda x: left_jacobian(x[..., 3:])):
        np.testing.assert_allclose(g(xi)[3], g(xi[3]), atol=TIGHT)
    p = np.random.default_rng(3).normal(size=(7, 3))
    np.testing.assert_allclose(transform(Ts[:, None], p)[3, 4], transform(Ts[3], p[4]), atol=TIGHT)


@given(poses(), rotation_vectors(1.0), vectors(-1, 1))
def test_mean_of_a_symmetric_pair_is_its_middle(T, phi, rho):
    pair = np.stack([T @ pose(exp_so3(s * phi), s * rho) for s in (1, -1)])
    middle = mean_pose(pair)
    assert_rotation(middle[:3, :3])
    np.testing.assert_allclose(middle, T, atol=1e-13)


def test_mean_pose_is_a_rotation_even_of_many():
    Ts = exp_se3(np.random.default_rng(4).normal(size=(50, 6)))
    assert_rotation(mean_pose(Ts)[:3, :3])
