import numpy as np
import pytest
from scipy.optimize import least_squares

from armsight.geometry.pose import exp_se3, inverse, log_se3, transform
from armsight.vision.pose import posefit
from armsight.vision.pose.bundle import CAUCHY_SCALE
from armsight.vision.pose.posefit import PixelObservations, fit_pose
from asserts import assert_jacobian, numeric_jacobian
from strategies import ordinary_rig
from views import pixels, seen, somewhere

SIGMA_PX = 0.4


def shot(model, seed):
    """A rig, a body of 12 points, its pose, and noisy detections: some of one camera only, each with a covariance."""
    rng, rig = np.random.default_rng(seed), ordinary_rig(model)
    points = 0.05 * rng.uniform(-1, 1, (12, 3))
    T = somewhere(rng)
    found = seen(rig, points, T, sigma=SIGMA_PX, rng=rng, hidden=((3, 0), (7, 1), (8, 1)))
    A = 0.2 * rng.normal(size=(12, 2, 2, 2))
    return rig, points, T, PixelObservations.of(type(found)(found.ids, found.uv, A @ A.swapaxes(-1, -2)), SIGMA_PX), rng


def whitened(rig, points, observations, T):
    """(N, 2) distances in standard deviations by OpenCV's projection."""
    r = np.empty((len(observations.uv), 2))
    for side, (camera, T_camera_left) in enumerate(((rig.left, np.eye(4)), (rig.right, inverse(rig.T_left_right)))):
        rows = observations.camera == side
        p = transform(T_camera_left @ T, points[observations.point[rows]])
        r[rows] = observations.uv[rows] - pixels(camera, p)
    L = np.linalg.cholesky(np.linalg.inv(observations.cov_uv))
    return np.einsum("nji,nj->ni", L, r)


@pytest.mark.parametrize("model", ["brown4", "brown8", "fisheye"])
@pytest.mark.parametrize("robust", [False, True])
def test_the_minimum_is_that_of_scipy(model, robust):
    rig, points, T_true, observations, rng = shot(model, 1)
    start = T_true @ exp_se3(np.r_[0.01, 0.02, 0.03, 0.1, 0.1, 0.1] * rng.normal(size=6))

    def residuals(xi, at):
        d = whitened(rig, points, observations, at @ exp_se3(xi))
        if not robust:
            return d.ravel()
        d2 = (d**2).sum(axis=1)
        return CAUCHY_SCALE * np.sqrt(np.log1p(d2 / CAUCHY_SCALE**2))

    T = start
    for _ in range(3):  # each time the tangent is taken at the newest pose
        slow = least_squares(
            residuals, np.zeros(6), args=(T,), xtol=1e-15, ftol=1e-15, gtol=1e-15, jac="3-point", x_scale="jac"
        )
        T = T @ exp_se3(slow.x)
    fast = fit_pose(rig.cameras, rig.T_left_right, points, observations, start, robust=robust)
    assert fast is not None
    assert fast.cost == pytest.approx(2 * slow.cost, rel=1e-8)
    # A step ends the iterations once it lowers the cost by less than a share of 1e-8: the pose is then off by at most
    # sqrt(1e-8 * cost) of its standard deviations, and by far less where the convergence is quadratic.
    gap = log_se3(inverse(T) @ fast.T_left_body)
    assert gap @ fast.information @ gap < 1e-8 * fast.cost
    d = whitened(rig, points, observations, fast.T_left_body)
    assert fast.distance2 == pytest.approx((d**2).sum(axis=1), rel=1e-9)


def test_the_information_is_that_of_the_minimum():
    rig, points, _, observations, _ = shot("brown4", 4)
    fit = fit_pose(rig.cameras, rig.T_left_right, points, observations, shot("brown4", 4)[2], robust=False)
    J = numeric_jacobian(
        lambda xi: whitened(rig, points, observations, fit.T_left_body @ exp_se3(xi)).ravel(),
        np.zeros(6),
        np.r_[[1e-6] * 3, [1e-5] * 3],
    )
    scale = np.sqrt(np.diag(fit.information))
    assert fit.information / np.outer(scale, scale) == pytest.approx(J.T @ J / np.outer(scale, scale), abs=1e-6)


def test_a_body_behind_the_camera_is_no_start():
    rig, points, T_true, observations, _ = shot("brown4", 5)
    behind = np.array(T_true)
    behind[2, 3] = -0.6
    assert fit_pose(rig.cameras, rig.T_left_right, points, observations, behind, robust=True) is None


def test_too_few_observations_determine_no_pose_or_keep_to_the_data():
    rig, points, T_true, observations, _ = shot("brown4", 6)
    two = observations.select(np.arange(len(observations.uv)) < 2)
    fit = fit_pose(rig.cameras, rig.T_left_right, points, two, T_true, robust=False)
    assert fit is None or np.linalg.matrix_rank(fit.information) <= 4


@pytest.mark.parametrize("model", ["brown4", "brown5", "brown8", "fisheye"])
def test_derivatives_by_pose_and_rig_are_those_of_finite_differences(model):
    rig, points, T, observations, _ = shot(model, 4)
    W, by_pose, by_rig = posefit.whitened(rig.cameras, rig.T_left_right, points, observations, T)
    assert np.einsum("nji,njk->nik", W, W) == pytest.approx(np.linalg.inv(observations.cov_uv), rel=1e-12)

    def projected(rig_, T_):
        uv = np.empty((len(observations.uv), 2))
        for side, T_camera_body in enumerate((T_, inverse(rig_.T_left_right) @ T_)):
            rows = observations.camera == side
            uv[rows] = rig_.cameras[side].project(transform(T_camera_body, points[observations.point[rows]]))
        return np.einsum("nij,nj->ni", W, uv).ravel()

    assert_jacobian(by_pose, lambda xi: projected(rig, T @ exp_se3(xi)), np.zeros(6), 1e-4)
    scale = np.maximum(np.abs(np.r_[rig.left.parameters, rig.right.parameters, np.ones(6)]), 0.1)
    assert_jacobian(by_rig, lambda delta: projected(rig.perturbed(delta), T), np.zeros(len(scale)), 1e-4 * scale)
