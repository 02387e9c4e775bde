"""Triangulation: OpenCV, a slow general minimiser, finite differences and Monte Carlo are the oracles."""

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from armsight.data import Correspondences
from armsight.vision.triangulate import midpoints, optimal_points, triangulate
from asserts import assert_jacobian
from strategies import CAMERAS, SIZE, folding_rig, ordinary_rig
from views import body_of, both_pixels

MODELS = list(CAMERAS)
SIGMA_PX = 0.3


def points_in_view(n, seed=0, near=0.4, far=3.0):
    """Points (n, 3) that both cameras of an ordinary rig see, left frame, m."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(near, far, n)
    return np.column_stack([rng.uniform(-0.3, 0.4, n) * z, rng.uniform(-0.3, 0.3, n) * z, z])


def ones(n):
    """(n, 2, 2, 2) covariances of one pixel."""
    return np.tile(np.eye(2), (n, 2, 1, 1))


def ellipses(n, seed=1):
    """(n, 2, 2, 2) covariances, each another ellipse, axes of about SIGMA_PX."""
    root = SIGMA_PX * (np.eye(2) + 0.5 * np.random.default_rng(seed).normal(size=(n, 2, 2, 2)))
    return root @ root.transpose(0, 1, 3, 2)


def opencv_points(rig, normalised):
    """Triangulate undistorted points (N, 2, 2), focal length one, with OpenCV."""
    R, t = rig.T_left_right[:3, :3], rig.T_left_right[:3, 3]
    P_right = np.column_stack([R.T, -R.T @ t])
    x = cv2.triangulatePoints(np.eye(3, 4), P_right, normalised[:, 0].T.copy(), normalised[:, 1].T.copy())
    return (x[:3] / x[3]).T


def undistorted(camera, uv):
    d = np.array(camera.distortion) if camera.distortion.size else np.zeros(4)
    undistort = cv2.fisheye.undistortPoints if camera.model == "fisheye" else cv2.undistortPoints
    return undistort(uv.reshape(-1, 1, 2).copy(), camera.matrix, d).reshape(-1, 2)


def costs(rig, p, uv, cov_uv):
    """(N,) covariance-weighted squared pixel distance of points p in both images, by OpenCV's projection."""
    r = uv - both_pixels(rig, p)
    return np.einsum("nci,ncij,ncj->n", r, np.linalg.inv(cov_uv), r)


@pytest.mark.parametrize("model", MODELS)
def test_without_noise_it_is_opencvs_point_and_the_truth(model):
    rig, p = ordinary_rig(model), points_in_view(300)
    R, t = rig.T_left_right[:3, :3], rig.T_left_right[:3, 3]
    q = (p - t) @ R
    found, _, _ = optimal_points(rig, both_pixels(rig, p), ones(len(p)))
    np.testing.assert_allclose(found, p, rtol=0, atol=1e-12)
    theirs = opencv_points(rig, np.stack([p[:, :2] / p[:, 2:], q[:, :2] / q[:, 2:]], axis=1))
    np.testing.assert_allclose(found, theirs, rtol=0, atol=1e-9)
    np.testing.assert_allclose(midpoints(rig, *both_pixels(rig, p).transpose(1, 0, 2)), p, rtol=0, atol=1e-11)


@pytest.mark.parametrize("model", MODELS)
def test_with_noise_no_other_method_comes_closer_to_the_pixels(model):
    rig, p = ordinary_rig(model), points_in_view(300)
    rng = np.random.default_rng(2)
    uv = both_pixels(rig, p) + SIGMA_PX * rng.normal(size=(len(p), 2, 2))
    found, _, _ = optimal_points(rig, uv, ones(len(p)))
    ours = costs(rig, found, uv, ones(len(p)))
    rays = np.stack([undistorted(camera, uv[:, c]) for c, camera in enumerate(rig.cameras)], axis=1)
    for theirs in (opencv_points(rig, rays), midpoints(rig, uv[:, 0], uv[:, 1])):
        others = costs(rig, theirs, uv, ones(len(p)))
        assert (ours <= others + 1e-12).all()
        assert (ours < others - 1e-6).any()


@pytest.mark.parametrize("model", MODELS)
def test_it_is_the_minimum_that_a_slow_minimiser_finds(model):
    rig, p, cov_uv = ordinary_rig(model), points_in_view(12), ellipses(12)
    rng = np.random.default_rng(3)
    uv = both_pixels(rig, p) + 3 * SIGMA_PX * rng.normal(size=(len(p), 2, 2))
    found, cov, _ = optimal_points(rig, uv, cov_uv)
    root = np.linalg.inv(np.linalg.cholesky(cov_uv))
    for i in range(len(p)):

        def whitened(x, i=i):
            return (root[i] @ (uv[i] - both_pixels(rig, x[None])[0])[..., None]).ravel()

        slow = least_squares(whitened, p[i], x_scale=np.sqrt(np.diag(cov[i])), xtol=1e-15, ftol=1e-15, gtol=1e-15).x
        ours, theirs = (whitened(found[i]) ** 2).sum(), (whitened(slow) ** 2).sum()
        # Pixels of 1e3 are good to 1e-12 or so, the cost to r times that, its minimum to the root of that.
        rounding = 1e-11 * (1 + np.sqrt(theirs))
        assert ours <= theirs + rounding
        off = found[i] - slow
        assert off @ np.linalg.solve(cov[i], off) < rounding


@pytest.mark.parametrize("model", MODELS)
def test_covariance_is_that_of_monte_carlo(model):
    rig, p, n = ordinary_rig(model), points_in_view(5, seed=4), 2000
    cov_uv = ellipses(len(p))
    rng = np.random.default_rng(5)
    noise = np.einsum("pcij,npcj->npci", np.linalg.cholesky(cov_uv), rng.normal(size=(n, len(p), 2, 2)))
    uv = both_pixels(rig, p) + noise
    found, _, _ = optimal_points(rig, uv.reshape(-1, 2, 2), np.tile(cov_uv, (n, 1, 1, 1)))
    errors = found.reshape(n, len(p), 3) - p
    _, claimed, _ = optimal_points(rig, both_pixels(rig, p), cov_uv)
    for i in range(len(p)):
        sample = errors[:, i].T @ errors[:, i] / n
        # In standard deviations of the claim, the axes of the sample's ellipsoid; 10% is three standard errors of 2000.
        L = np.linalg.inv(np.linalg.cholesky(claimed[i]))
        ratio = np.linalg.eigvalsh(L @ sample @ L.T)
        assert (np.abs(ratio - 1) < 0.1).all(), ratio


@pytest.mark.parametrize("model", MODELS)
def test_derivative_by_the_calibration(model):
    rig, p = ordinary_rig(model), points_in_view(6)
    uv, cov_uv = both_pixels(rig, p), ellipses(6)
    _, _, by_rig = optimal_points(rig, uv, cov_uv)
    lens = np.concatenate([np.full(4, 0.1), np.full(rig.left.distortion.size, 1e-4)])
    assert_jacobian(
        by_rig,
        lambda x: optimal_points(rig.perturbed(x), uv, cov_uv)[0],
        np.zeros(rig.parameter_count),
        np.concatenate([lens, lens, np.full(6, 1e-4)]),
        rtol=1e-6,
    )


@pytest.mark.parametrize("model", MODELS)
def test_points_of_any_pixels_lie_on_their_side_and_are_minima(model):
    rig, n = ordinary_rig(model), 3000
    uv = np.random.default_rng(6).uniform(0, 1, (n, 2, 2)) * SIZE
    p, cov, by_rig = optimal_points(rig, uv, ones(n))
    found = np.isfinite(p).all(axis=1)
    assert 0.2 * n < found.sum() < 0.8 * n
    for array in (p, cov, by_rig):
        assert np.isfinite(array[found]).all()
        assert np.isnan(array[~found]).all()
    R, t = rig.T_left_right[:3, :3], rig.T_left_right[:3, 3]
    for side, q in enumerate((p, (p - t) @ R)):
        rays = rig.cameras[side].unproject(uv[:, side])
        assert (np.einsum("ni,ni->n", rays, q)[found] > 0).all()
    here = costs(rig, p[found], uv[found], ones(found.sum()))
    axes, directions = np.linalg.eigh(cov[found])
    for k in range(3):
        for sign in (-1e-2, 1e-2):
            step = sign * np.sqrt(axes[:, k, None]) * directions[:, :, k]
            # A step of a hundredth of a standard deviation costs 1e-4 at a minimum of a parabola.
            assert (costs(rig, p[found] + step, uv[found], ones(found.sum())) > here).mean() > 0.99


def test_rays_that_part_or_are_parallel_meet_nowhere():
    for model in MODELS:
        rig = ordinary_rig(model)
        directions = points_in_view(50) * [0.5, 1, 1] - [0.1, 0, 0]
        for angle in (0.0, 1e-5, 1e-3, 0.1, 0.3):
            # Rotated by up to 0.3 rad more they are still well within the right image, where no lens here folds.
            away = directions + angle * np.linalg.norm(directions, axis=1, keepdims=True) * [1.0, 0, 0]
            origin = rig.T_left_right[:3, 3]
            uv = np.stack([both_pixels(rig, directions)[:, 0], both_pixels(rig, away + origin)[:, 1]], axis=1)
            inside = ((uv >= 0) & (uv <= SIZE)).all(axis=(1, 2))
            assert np.isnan(optimal_points(rig, uv[inside], ones(inside.sum()))[0]).all()
            if angle > 1e-9:  # whether parallel rays meet at the end of the world is a matter of rounding
                assert np.isnan(midpoints(rig, uv[inside, 0], uv[inside, 1])).all()


def test_what_does_not_lie_before_both_cameras_is_dropped_by_name():
    rig, p = ordinary_rig(), points_in_view(6)
    uv = both_pixels(rig, p)
    uv[1, 1] = both_pixels(rig, p[1:2] + np.array([0.4, 0, 0]))[0, 1]  # its rays part
    uv[4, 1] = np.nan  # seen by the left camera alone
    rows = np.array([2, 3, 5, 7, 11, 13])
    seen = Correspondences(rows, uv, np.zeros((6, 2, 2, 2)), ())
    points = triangulate(rig, body_of(np.zeros((20, 3))), seen)
    np.testing.assert_array_equal(points.ids, [2, 5, 7, 13])
    np.testing.assert_allclose(points.p_left, p[[0, 2, 3, 5]], atol=1e-12)
    assert [(d.point, d.reason) for d in points.dropped] == [("P3", "its rays do not meet before both cameras")]
    # What is dropped is not used any more; what one camera saw is kept for locate.
    np.testing.assert_array_equal(points.seen.ids, [2, 5, 7, 11, 13])
    np.testing.assert_array_equal(points.seen.paired, [True, True, True, False, True])
    assert points.seen.dropped == points.dropped


def test_the_rigs_noise_adds_to_the_images():
    rig, p, cov_uv = ordinary_rig(), points_in_view(4), ellipses(4)
    uv = both_pixels(rig, p)
    points = triangulate(rig, body_of(np.zeros((4, 3))), Correspondences(np.arange(4), uv, cov_uv))
    _, cov, by_rig = optimal_points(rig, uv, cov_uv + rig.sigma_px**2 * np.eye(2))
    np.testing.assert_array_equal(points.cov, cov)
    np.testing.assert_array_equal(points.calibration, by_rig)


def test_nothing_in_nothing_out():
    rig = ordinary_rig()
    nothing = Correspondences(np.zeros(0, np.int64), np.zeros((0, 2, 2)), np.zeros((0, 2, 2, 2)))
    points = triangulate(rig, body_of(np.zeros((4, 3))), nothing)
    assert points.p_left.shape == (0, 3)
    assert points.calibration.shape == (0, 3, rig.parameter_count)


def test_a_pixel_without_a_ray_has_no_point():
    rig = folding_rig()
    uv = np.array([[[640 + 500 * 0.71, 360], [900.0, 360]], [[700.0, 360], [680.0, 360]]])
    p, _, _ = optimal_points(rig, uv, ones(2))
    assert np.isnan(p[0]).all()
    assert np.isfinite(p[1]).all()
