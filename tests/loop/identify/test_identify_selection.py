"""Forward selection: its scores against a slow oracle, and how many parameters it keeps."""

from dataclasses import replace

import numpy as np
import pytest
from worn_arm import distance_m, poses, worn

from armsight.estimate.select import Folds, Removal
from armsight.loop.identify.identify import identify
from armsight.loop.identify.measured import Measured

PARAMETERS, FOLDS, ROWS = 9, 4, 15


@pytest.fixture
def problem():
    """Folds of a random linear problem, and its Jacobian, residuals, priors and nominal values."""
    rng = np.random.default_rng(3)
    J, e = rng.normal(size=(FOLDS, ROWS, PARAMETERS)), rng.normal(size=(FOLDS, ROWS))
    prior = np.where(np.arange(PARAMETERS) < 3, np.inf, rng.uniform(0.1, 1.0, PARAMETERS))
    home = np.where(np.isfinite(prior), rng.normal(size=PARAMETERS), 0.0)
    H, g = J.swapaxes(1, 2) @ J, (J.swapaxes(1, 2) @ e[..., None])[..., 0]
    numbers = np.full(FOLDS, float(ROWS))
    return Folds(H, g, (e**2).sum(axis=1), numbers, prior**-2.0, home), J, e, prior, home


def slow_losses(free, J, e, prior, home):
    """Fit the rows of the other folds, with the priors as rows of their own, and evaluate the rows of each."""
    out = []
    for fold in range(FOLDS):
        others = np.arange(FOLDS) != fold
        A, b = J[others].reshape(-1, PARAMETERS), e[others].ravel()
        pull = np.diag(1 / prior)
        delta = np.where(free, 0.0, home)
        rows = np.concatenate([A[:, free], pull[:, free]])
        right = np.concatenate([-b - A @ delta, (pull @ np.where(free, home, 0.0))])
        delta[free] = np.linalg.lstsq(rows, right, rcond=None)[0]
        out.append(np.mean((e[fold] + J[fold] @ delta) ** 2))
    return np.array(out)


def mask(*at):
    return np.isin(np.arange(PARAMETERS), at)


def test_all_candidates_of_a_step_are_scored_as_if_each_were_fitted(problem):
    folds, *rest = problem
    kept, groups = mask(0, 1, 2, 5), {"one": mask(3), "two": mask(4, 8), "overlapping": mask(4, 5, 6)}
    np.testing.assert_allclose(folds.losses(kept), slow_losses(kept, *rest), rtol=1e-9)
    for name, losses in folds.losses_with(kept, groups).items():
        np.testing.assert_allclose(losses, slow_losses(kept | groups[name], *rest), rtol=1e-9)


def test_removals_are_scored_as_if_each_were_fitted(problem):
    folds, *rest = problem
    now, groups = Removal(folds, mask(0, 1, 2, 3, 4, 5, 7)), [mask(3), mask(4, 5), mask(7)]
    for _ in range(2):
        for group, losses in zip(groups, now.losses_without(groups), strict=True):
            np.testing.assert_allclose(losses, slow_losses(now.kept & ~group, *rest), rtol=1e-9)
        now.remove(groups.pop(0))
        np.testing.assert_allclose(now.losses(), slow_losses(now.kept, *rest), rtol=1e-9)


def test_few_numbers_leave_few_parameters():
    """200 positions: no more than one parameter for ten numbers, though 222 may be off; and the error is that of so many.

    k parameters fitted to n numbers of noise sigma predict to sigma sqrt(3 k / n) in position, 0.05 mm here. What else
    there is (links' loads and harmonics too small to show) may double it.
    """
    w, rng = worn(0), np.random.default_rng(100)
    q, approach = poses(w.nominal, 200, rng)
    seen = w.seen(q, approach, rng)
    found = identify(w.nominal, replace(Measured(q, seen.p_rig), approach=approach))
    fitted, numbers = int(found.solution.free.sum()), 3 * len(q)
    assert fitted <= numbers / 10
    q, approach = poses(w.nominal, 200, rng)
    sigma_m = 5e-5 * np.sqrt((1 + 1 + 9) / 3)
    off = distance_m(found.model, found.solution.x, w.T_rig_body(q, approach), q, approach)
    assert np.sqrt(np.mean(off**2)) < 2 * sigma_m * np.sqrt(3 * fitted / numbers)
