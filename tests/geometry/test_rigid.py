"""The rigid fit against scipy's align_vectors, and its laws."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from armsight.errors import InputError
from armsight.geometry.pose import transform
from armsight.geometry.rigid import fit_rigid, fit_scale
from asserts import assert_rotation
from strategies import poses

SEEDS = st.integers(0, 2**31)


def points(seed, n=6):
    return np.random.default_rng(seed).uniform(-0.1, 0.1, size=(n, 3))


@given(poses(), SEEDS)
def test_exact_points_give_the_pose(T_a_b, seed):
    p_b = points(seed)
    np.testing.assert_allclose(fit_rigid(p_b, transform(T_a_b, p_b)), T_a_b, atol=1e-12)


@given(poses(), SEEDS, st.integers(3, 12))
def test_same_as_scipy(T_a_b, seed, n):
    rng = np.random.default_rng(seed)
    p_b = points(seed, n)
    p_a = transform(T_a_b, p_b) + 1e-3 * rng.normal(size=(n, 3))
    T = fit_rigid(p_b, p_a)
    mean_b, mean_a = p_b.mean(axis=0), p_a.mean(axis=0)
    R, _ = Rotation.align_vectors(p_a - mean_a, p_b - mean_b)
    assert_rotation(T[:3, :3])
    # Nearly collinear samples condition the rotation badly, so the cost is compared, which has a minimum there.
    cost = [((p_a - mean_a - (p_b - mean_b) @ M.T) ** 2).sum() for M in (T[:3, :3], R.as_matrix())]
    assert cost[0] <= cost[1] * (1 + 1e-9) + 1e-18
    np.testing.assert_allclose(transform(T, mean_b), mean_a, atol=1e-14 * 8)


def test_mirrored_points_still_give_a_rotation():
    p_b = points(5, 8)
    assert_rotation(fit_rigid(p_b, p_b * [1, 1, -1])[:3, :3])


def test_points_in_a_plane_are_enough():
    p_b = points(6, 5) * [1, 1, 0]
    np.testing.assert_allclose(fit_rigid(p_b, p_b), np.eye(4), atol=1e-13)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_points(n):
    with pytest.raises(InputError, match=f"needs 3 or more matched points, got {n}"):
        fit_rigid(np.zeros((n, 3)), np.zeros((n, 3)))


def test_unequal_numbers_of_points():
    with pytest.raises(InputError, match="got 3 and 4"):
        fit_rigid(np.zeros((3, 3)), np.zeros((4, 3)))


@given(poses(), SEEDS)
def test_residuals_are_orthogonal_to_every_rigid_motion(T_a_b, seed):
    p_b = points(seed)
    p_a = transform(T_a_b, p_b) + 1e-3 * np.random.default_rng(seed).normal(size=p_b.shape)
    r = p_a - transform(fit_rigid(p_b, p_a), p_b)
    np.testing.assert_allclose(r.sum(axis=0), 0, atol=1e-14 * 16)
    # At the minimum the residuals exert no moment about the centroid.
    np.testing.assert_allclose(np.cross(p_a - p_a.mean(axis=0), r).sum(axis=0), 0, atol=1e-14)


@given(poses(), SEEDS, st.floats(0.5, 2.0))
def test_scale_comes_back(T_a_b, seed, scale):
    p_b = points(seed)
    assert fit_scale(p_b, scale * transform(T_a_b, p_b)) == pytest.approx(scale, rel=1e-11)
