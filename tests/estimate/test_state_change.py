"""A change of the unknowns between two measurements: found where it is, and hardly ever where there is none."""

import numpy as np
import pytest

from armsight.estimate.change import changed, matters

COUNT, FROM = 40, 24
WAYS = {"first": np.array([0, 1]), "second": np.array([2])}


def fitted(seed, *, step=(0, 0, 0, 0), correlated=0.0, missing=0.0, ordered=False):
    """Whitened residuals of a fit to 40 measurements of 3 numbers, their derivative, what it may depend on, and the fit."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(COUNT, 2))
    poses = poses[np.argsort(poses[:, 0])] if ordered else poses
    J, noise = rng.normal(size=(COUNT, 3, 4)), rng.normal(size=(COUNT, 3))
    for k in range(1, COUNT):
        noise[k] = correlated * noise[k - 1] + np.sqrt(1 - correlated**2) * noise[k]
    true = np.zeros((COUNT, 4))
    true[FROM:] = step
    e = (J @ true[..., None])[..., 0] + noise + missing * np.sign(poses[:, :1]) * J[:, :, 0]
    flat = J.reshape(-1, 4)
    x = np.linalg.lstsq(flat, e.ravel())[0]
    return e - J @ x, J, poses, x, np.linalg.inv(flat.T @ flat)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("way", WAYS)
def test_a_change_is_found_where_it_is_and_both_states_are_within_the_covariance(seed, way):
    step = np.where(np.isin(np.arange(4), WAYS[way]), 2.5, 0.0)
    e, J, poses, x, cov = fitted(seed, step=step)
    change = changed(e, J, WAYS, poses)
    assert change is not None
    assert (change.way, change.sure) == (way, True)
    assert abs(change.row - FROM) <= 2
    assert matters(change, cov)
    wide = cov + change.off.T @ change.off
    for state in (0 * step, step):
        assert (x - state) @ np.linalg.solve(wide, x - state) < 4 * len(x)
    assert np.abs(change.step - step)[WAYS[way]].max() < 0.8


@pytest.mark.parametrize("correlated", [0.0, 0.3])
def test_noise_is_hardly_ever_named(correlated):
    found = [changed(*fitted(seed, correlated=correlated)[:2], WAYS, fitted(seed)[2]) for seed in range(100, 140)]
    assert sum(change is not None for change in found) <= 3


@pytest.mark.parametrize("seed", range(5))
def test_what_depends_on_the_pose_is_never_sure_where_the_poses_are_in_order(seed):
    e, J, poses, _, _ = fitted(seed, missing=1.0, ordered=True)
    change = changed(e, J, WAYS, poses)
    assert change is not None
    assert not change.sure


def test_few_measurements_and_no_way_are_no_change():
    e, J, poses, _, _ = fitted(0, step=(2, 2, 0, 0))
    assert changed(e[20:25], J[20:25], WAYS, poses[20:25]) is None
    assert changed(e, J, {}, poses) is None


def test_a_wide_way_is_sure_though_ways_of_one_number_vary_more_by_chance():
    """A change of six numbers explains nearly all; orders explain several times the usual by a way of one number."""
    rng = np.random.default_rng(3)
    ways = {"six": np.arange(6)} | {f"one {k}": np.array([6 + k]) for k in range(6)}
    sure = 0
    for _ in range(8):
        J, e = rng.normal(size=(COUNT, 3, 12)), 0.05 * rng.normal(size=(COUNT, 3))
        e[20:] += 5 * J[20:, :, 0]
        flat = J.reshape(-1, 12)
        change = changed(e - J @ np.linalg.lstsq(flat, e.ravel())[0], J, ways, rng.normal(size=(COUNT, 6)))
        sure += change is not None and (change.way, change.sure) == ("six", True)
    assert sure == 8


def test_a_prior_pulls_where_the_fit_is_from_it():
    """An unknown that is hardly seen does not move back to the residuals' optimum because another one changed."""
    rng = np.random.default_rng(3)
    J, known = rng.normal(size=(COUNT, 3, 4)), np.array([0, 0, 0, 4.0])
    J[..., 3] *= 0.05
    e = 4.0 * J[..., 3] + rng.normal(size=(COUNT, 3))
    e[FROM:] += 2 * J[FROM:, :, 0]
    flat = J.reshape(-1, 4)
    at = np.linalg.solve(flat.T @ flat + np.diag(known), flat.T @ e.ravel())
    change = changed(e - J @ at, J, {"first": np.array([0])}, rng.normal(size=(COUNT, 2)), known=known, at=at)
    after = np.where(np.arange(COUNT) >= change.row, 1.0, 0.0)[:, None, None] * J[..., :1]
    both = np.concatenate([J, after], axis=2).reshape(-1, 5)
    refit = np.linalg.solve(both.T @ both + np.diag([*known, 0]), both.T @ e.ravel())
    assert np.allclose(change.off[0], refit[:4] - at, atol=1e-6)
    assert np.isclose(change.step[0], refit[4], atol=1e-6)
