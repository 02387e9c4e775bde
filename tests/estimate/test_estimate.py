"""Laws of estimation: derivatives, honest covariance, order of rows, measurements left out, what sources are found."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.estimate.linear import Linear, factor, spread
from armsight.estimate.solve import gradient, left_out, log_density, regression, solve
from armsight.estimate.variance import integrate, most_probable, scores
from asserts import numeric_jacobian

MEANS = {"a": 1.0, "b": 0.5, "slow": 1.0}
TRUE = np.array([0.7, 0.3, 1.2])
N = 30


def made(seed, sigmas=TRUE, n=N):
    """Measurements of four unknowns whose errors are independent (two maps), and slow over the rows; the truth is zero."""
    rng = np.random.default_rng(seed)
    J, own = rng.normal(size=(n, 3, 4)), {"a": rng.normal(size=(n, 3, 3)), "b": rng.normal(size=(n, 3, 1))}
    t = np.arange(n) / n
    F = factor(np.exp(-0.5 * ((t[:, None] - t) / 0.2) ** 2))
    slow = spread(F, np.tile(np.eye(3), (n, 1, 1)))
    e = sum(
        s * np.einsum("nmk,nk->nm", M, rng.normal(size=M.shape[::2]))
        for s, M in zip(sigmas, own.values(), strict=False)
    )
    e = e + sigmas[2] * slow @ rng.normal(size=slow.shape[2])
    e = e + 0.1 * rng.normal(size=e.shape)
    return Linear(e, J, np.tile(0.01 * np.eye(3), (n, 1, 1)), own, {"slow": slow}, np.zeros(4), np.zeros(4))


def dense(linear, variances):
    """The same by its whole covariance: step, covariance, minus the restricted log-likelihood."""
    n, m = linear.e.shape
    C = np.zeros((n * m, n * m))
    for i in range(n):
        rows = slice(m * i, m * i + m)
        C[rows, rows] = linear.given[i] + sum(
            v * M[i] @ M[i].T for v, M in zip(variances, linear.own.values(), strict=False)
        )
    F = linear.shared["slow"].reshape(n * m, -1)
    C += variances[-1] * F @ F.T
    J, e, W = linear.J.reshape(n * m, -1), linear.e.ravel(), np.linalg.inv(C)
    cov = np.linalg.inv(J.T @ W @ J)
    x = -cov @ J.T @ W @ e
    left = e + J @ x
    return x, cov, 0.5 * (np.linalg.slogdet(C)[1] - np.linalg.slogdet(cov)[1] + left @ W @ left)


def test_shared_errors_as_unknowns_are_the_whole_covariance():
    linear, one, two = made(1), TRUE**2, 1.7 * TRUE**2
    x, cov, cost = dense(linear, one)
    s = solve(linear, one)
    np.testing.assert_allclose(s.x[:4], x, rtol=1e-6)
    np.testing.assert_allclose((s.root @ s.root.T)[:4, :4], cov, rtol=1e-6)
    assert s.cost - solve(linear, two).cost == pytest.approx(cost - dense(linear, two)[2], rel=1e-6)


def test_the_gradient_of_the_restricted_likelihood():
    linear, logs = made(2, n=8), np.array([-0.5, -2.0, 0.3])
    numeric = numeric_jacobian(lambda x: np.array([solve(linear, np.exp(x)).cost]), logs, 1e-3)[0]
    np.testing.assert_allclose(
        gradient(linear, np.exp(logs), solve(linear, np.exp(logs))), numeric, rtol=1e-5, atol=1e-7
    )


def test_what_is_left_out_is_predicted_by_the_others():
    linear, v = made(3, n=12), TRUE**2
    left, cov = left_out(solve(linear, v))
    for k in (0, 5, 11):
        others = np.delete(np.arange(12), k)
        s = solve(linear.rows(others), v)
        A = np.concatenate([linear.J[k], linear.shared["slow"][k]], axis=1)
        np.testing.assert_allclose(left[k], linear.e[k] + A @ s.x, rtol=1e-5, atol=1e-7)
        own = linear.given[k] + sum(x * M[k] @ M[k].T for x, M in zip(v, linear.own.values(), strict=False))
        np.testing.assert_allclose(cov[k], own + A @ s.root @ s.root.T @ A.T, rtol=1e-5, atol=1e-7)
    assert log_density(left, cov).shape == (12,)


def test_the_covariance_holds_the_error_where_the_variances_are_drawn_as_expected():
    rng, squares = np.random.default_rng(7), []
    for seed in range(40):
        linear = made(seed, rng.exponential(list(MEANS.values())), n=8)
        x, cov, _ = integrate(linear, most_probable(linear, MEANS), MEANS)
        squares.append(float(x @ np.linalg.solve(cov, x)))
    inside = np.mean(np.array(squares) < chi2.isf(0.05, 4))
    assert inside > 0.95 - 3 * np.sqrt(0.05 * 0.95 / 40)
    assert chi2.ppf(1e-3, 160) / 1.3 < sum(
        squares
    )  # and is not worthless: mixtures have heavier tails than one ellipsoid


def test_the_variances_are_found_and_the_order_of_the_rows_changes_nothing():
    linear = made(4, n=150)
    found = most_probable(linear, MEANS)
    np.testing.assert_allclose(np.sqrt(found), TRUE, rtol=0.35)
    order = np.random.default_rng(0).permutation(150)
    np.testing.assert_allclose(most_probable(linear.rows(order), MEANS), found, rtol=1e-2)


def test_a_change_of_the_unknowns_coordinates_changes_nothing():
    linear = made(5)
    T = np.random.default_rng(1).normal(size=(4, 4))
    one, other = (solve(each, TRUE**2) for each in (linear, replace(linear, J=linear.J @ T)))
    np.testing.assert_allclose(T @ other.x[:4], one.x[:4], rtol=1e-6)
    np.testing.assert_allclose(other.cost, one.cost - np.linalg.slogdet(T)[1] * -1, rtol=1e-9)


def test_the_score_speaks_for_a_source_that_is_there_and_seldom_for_one_that_is_not():
    there, absent = [], []
    for seed in range(30):
        for sigma, of in ((1.0, there), (0.0, absent)):
            linear = made(seed, np.array([0.7, 0.3, sigma]))
            without = linear.of(("a", "b"))
            of.append(scores(linear, solve(without, TRUE[:2] ** 2), ["slow"])["slow"])
    assert min(there) > 3
    assert abs(np.mean(absent)) < 3 / np.sqrt(30)  # of mean 0 and sigma 1
    assert 0.4 < np.std(absent) < 1.8


def test_a_factor_is_its_kernel():
    t = np.linspace(0, 1, 80)
    K = np.minimum(t[:, None], t)
    F = factor(K)
    assert F.shape[1] <= 24
    assert np.trace(K - F @ F.T) < 0.02 * np.trace(K)


def test_the_sigma_of_a_droop_allows_for_what_all_visits_of_a_pose_have_in_common():
    rng, z = np.random.default_rng(5), []
    visits = list(np.arange(80).reshape(20, 4))
    for _ in range(300):
        lever, own = (np.repeat(drawn, 4) for drawn in (rng.uniform(-0.2, 0.3, 20), rng.normal(0.0, 1.0, 20)))
        A = np.column_stack([np.ones(80), rng.choice([-1.0, 1.0], 80), lever])
        x, sigma = regression(A, A @ [0.1, 0.2, 3.0] + own + rng.normal(0.0, 0.3, 80), visits)
        z.append((x[2] - 3.0) / sigma[2])
    # Squares of 20 poses weighted by those of a uniform lever (kurtosis 1.8) are worth 20 / 1.8 = 11 degrees of freedom:
    # Student's t of so many scatters by 1.11, and 300 draws know it to 5 % (its kurtosis is 3.9): three of these either
    # way. Rests taken as independent give 2.1.
    assert 0.94 < np.std(z) < 1.28


def test_the_sigma_of_a_slope_without_groups_is_the_classical_one():
    A, y = np.column_stack([np.ones(6), np.arange(6.0)]), np.array([0.0, 1.2, 1.9, 3.1, 3.8, 9.0])
    x, sigma = regression(A, y, None)
    left = y - A @ x
    assert sigma[1] == pytest.approx(np.sqrt(left @ left / 4 / 17.5))  # 17.5: squares of the times from their mean
    alone = regression(A, y, list(np.arange(6)[:, None]))[1]
    assert alone[1] > 1.1 * sigma[1]  # what a group for each row gave
