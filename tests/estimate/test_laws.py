"""Laws that every subject of estimation keeps: derivatives, honest covariance, order of rows, gauge, a planted blunder.

A subject is a function in SUBJECTS: it draws a truth and measurements of it, and returns its residuals as a function of how
far the unknowns are from the truth. A new subject is one more function there.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

from armsight.data import Array
from armsight.estimate.linear import Linear
from armsight.estimate.solve import left_out, solve
from armsight.estimate.variance import most_probable, restricted
from armsight.geometry.pose import exp_se3, inverse
from armsight.loop.handeye.handeye import _Guess, _Problem
from armsight.loop.handeye.poses import Poses
from armsight.loop.identify.fit import MAX_NOISE, MIN_NOISE, linear_of, prior_sigma
from armsight.loop.identify.measured import Measured
from armsight.loop.identify.model import Model
from armsight.robot.arm_file import open_arm
from asserts import assert_jacobian

N, BLUNDER, SEEDS = 40, 11, 30
ARM = open_arm("six_r")
Z, X = exp_se3(np.array([0.4, 0.3, 0.9, 2.0, 0.3, 0.2])), exp_se3(np.array([0.02, 0.01, 0.1, 0.1, 0.2, 0.3]))
STILL = np.eye(4)
MOVED = exp_se3(np.array([0.5, -0.2, 0.3, 0.0, 0.0, 0.7]))  # about the rig's z, along which depth is more uncertain


class Drawn(NamedTuple):
    """Residuals (N, m) at a step (P,) of the unknowns from the truth; and the subject's way to the variances."""

    linear: Callable[[Array], Linear]
    variances: Callable[[Linear], Array]
    unknowns: int

    def estimated(self) -> tuple[Array, Array, Linear]:
        """Return where the estimate is from the truth (P,), the variances, and the residuals there."""
        x = np.zeros(self.unknowns)
        for _ in range(3):
            linear = self.linear(x)
            variances = self.variances(linear)
            x = x + solve(linear, variances).x[: self.unknowns]
        return x, variances, self.linear(x)


def handeye(seed, displaced=STILL, blunder=0.0, in_hand=False):
    """Both transforms, from an arm and cameras of which each scatters."""
    rng = np.random.default_rng(seed)
    A = said = ARM.forward(ARM.home + rng.uniform(-0.6, 0.6, (N, 6)))
    seen = exp_se3(rng.normal(size=(N, 6)) * np.repeat([5e-5, 2e-4], 3))
    A = A @ exp_se3(rng.normal(0, 5e-4, (N, 6)))
    B = inverse(A @ X) @ Z if in_hand else inverse(Z) @ A @ X
    B = displaced @ B @ seen
    B[BLUNDER, :3, 3] += blunder
    truth = _Guess(Z, X @ inverse(displaced)) if in_hand else _Guess(Z @ inverse(displaced), X)
    problem = _Problem(
        Poses(said, B, np.zeros((N, 6, 6)), in_hand, np.array([0.0, 0.0, 0.03])), None, None, (False, False)
    )

    def variances(linear):
        return most_probable(linear, problem.means(linear, truth))

    return Drawn(lambda x: problem.linear(truth.moved(x, problem.free)), variances, 12)


def identify(seed, displaced=STILL, blunder=0.0):
    """Base, tool and a part of the table, drawn from its priors, from full poses with a covariance and more noise."""
    rng = np.random.default_rng(seed)
    q = ARM.home + rng.uniform(-1.0, 1.0, (N, 6))
    cov = np.tile(np.diag(np.repeat([1e-5, 1e-4], 3) ** 2), (N, 1, 1))
    empty = Measured(q, np.zeros((N, 1, 3)), np.tile(np.eye(3), (N, 1, 1)), cov)
    T_rig_base = displaced @ inverse(Z)
    model = Model(ARM, 1, True, (), R_start=T_rig_base[:3, :3], R_tool=X[:3, :3])
    free = np.array(
        [p.kind in ("base", "tool") or p.name in ("a2", "a3", "offset2", "alpha3") for p in model.parameters]
    )
    prior = prior_sigma(model, {"a2": 3e-5, "a3": 3e-5, "offset2": 1e-4, "alpha3": 1e-4})  # about as the data show them
    truth = model.nominal() + np.where(free & np.isfinite(prior), rng.normal(size=len(prior)) * prior, 0.0)
    truth[:3], truth[model.tool_at : model.tool_at + 3] = T_rig_base[:3, 3], X[:3, 3]
    m = model.motion(truth, q, model.feature_values(q, None))
    body = np.tile(np.eye(4), (N, 1, 1))
    body[:, :3, :3], body[:, :3, 3] = m.R, m.o
    noise = np.sqrt(np.repeat([1e-5**2 + 5e-5**2, 1e-4**2 + 2e-4**2], 3))
    B = body @ X @ exp_se3(rng.normal(size=(N, 6)) * noise)
    B[BLUNDER, :3, 3] += blunder
    measured = Measured(empty.q, B[:, None, :3, 3], B[:, :3, :3], cov)

    def linear(x):
        at = truth.copy()
        at[free] += x
        return linear_of(model, at, measured, free, prior)

    return Drawn(linear, lambda of: restricted(of, np.full(2, 1e-8), MIN_NOISE, MAX_NOISE), int(free.sum()))


SUBJECTS = {"handeye": handeye, "eye_in_hand": partial(handeye, in_hand=True), "identify": identify}
each_subject = pytest.mark.parametrize("subject", SUBJECTS.values(), ids=SUBJECTS)


@each_subject
def test_derivatives(subject):
    drawn, here = subject(1), np.zeros(subject(1).unknowns)
    linear = drawn.linear(here)
    # Exact to the square of the residual, where that is a logarithm.
    assert_jacobian(linear.J, lambda x: drawn.linear(x).e, here, 1e-4, rtol=1e-7 + float(np.abs(linear.e).max()) ** 2)


@each_subject
def test_the_covariance_holds_the_error(subject):
    squares, unknowns = 0.0, 0
    for seed in range(SEEDS):
        x, variances, linear = subject(seed).estimated()
        root = solve(linear, variances).root[: len(x)]
        squares += float(x @ np.linalg.solve(root @ root.T, x))
        unknowns += len(x)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], unknowns)
    assert low < squares < high


@each_subject
def test_the_order_of_the_rows_changes_nothing(subject):
    drawn, order = subject(2), np.random.default_rng(0).permutation(N)
    other = drawn._replace(linear=lambda x: drawn.linear(x).rows(order))
    (x, variances, linear), (y, *_) = drawn.estimated(), other.estimated()
    sigma = np.linalg.norm(solve(linear, variances).root[: len(x)], axis=1)
    assert np.abs((x - y) / sigma).max() < 0.01


@each_subject
def test_a_displaced_rig_changes_nothing_but_the_rig(subject):
    (x, variances, here), (y, others, there) = (subject(3, at).estimated() for at in (STILL, MOVED))
    np.testing.assert_allclose(variances, others, rtol=0.05)
    costs = [solve(linear, variances).cost for linear in (here, there)]
    assert abs(costs[0] - costs[1]) < 1e-3
    assert np.linalg.norm(x[:3] - y[:3]) > 0  # of the same errors, in other axes
    np.testing.assert_allclose(np.linalg.norm(here.e, axis=1), np.linalg.norm(there.e, axis=1), rtol=0.02, atol=1e-7)


@each_subject
def test_a_planted_blunder_is_the_furthest_from_what_the_others_predict(subject):
    _, variances, linear = subject(4, blunder=0.005).estimated()
    left, cov = left_out(solve(linear, variances))
    far = np.einsum("ni,ni->n", left, np.linalg.solve(cov, left[..., None])[..., 0])
    assert far.argmax() == BLUNDER
    assert far[BLUNDER] > chi2.isf(1e-4, 6)
    _, variances, linear = subject(4).estimated()
    left, cov = left_out(solve(linear, variances))
    assert np.einsum("ni,ni->n", left, np.linalg.solve(cov, left[..., None])[..., 0]).max() < chi2.isf(1e-7, 6)
