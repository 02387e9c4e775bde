"""What is predicted of a body: covariance against OpenCV's derivatives and Monte Carlo, separation against scipy."""

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from armsight.geometry.pose import exp_se3, inverse, log_se3, transform
from armsight.sim.example_rig import example_rig
from armsight.vision.discs.symmetry import symmetries
from armsight.vision.pose.posefit import PixelObservations, fit_pose
from armsight.vision.pose.predict import look_direction, plain_rig, pose_covariance, separation, view
from armsight.vision.rig import StereoRig

PLATE = np.array([[-55, 0, 0], [55, 0, 0], [0, 85, 0.0]]) * 1e-3
FACE = np.tile([0.0, 0.0, -1.0], (3, 1))
NO_FACE = np.full((3, 3), np.nan)


def seen_by_opencv(rig, T_left_body, points):
    """(2N, 2) positions in both images."""
    out = []
    for camera, T in ((rig.left, T_left_body), (rig.right, inverse(rig.T_left_right) @ T_left_body)):
        fx, fy, cx, cy = camera.intrinsics
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        rotation = Rotation.from_matrix(T[:3, :3]).as_rotvec()
        out.append(cv2.projectPoints(points, rotation, T[:3, 3], K, camera.distortion)[0].reshape(-1, 2))
    return np.concatenate(out)


def test_the_body_faces_the_cameras_at_its_distance():
    for normal in ([0, 0, -1], [0, 0, 1], [1, 0, 0], [0.6, 0, -0.8]):
        R = Rotation.align_vectors([normal], [[0, 0, -1]])[0].as_matrix()
        points, normals = PLATE @ R.T, FACE @ R.T
        seen = view(plain_rig(), points, normals, 0.8)
        middle = transform(seen.T_left_body, points.mean(axis=0))
        np.testing.assert_allclose(middle, [0.1, 0.0, 0.8], atol=1e-12)
        np.testing.assert_allclose(seen.T_left_body[:3, :3] @ normal, [0, 0, -1], atol=1e-12)
        assert seen.seen.all()


def test_a_face_rotated_away_or_outside_the_image_is_not_seen():
    rig = plain_rig()
    normals = np.array([[0, 0, -1.0], [0, 0, -1], [0, 0, 1]])
    assert view(rig, PLATE, normals, 0.8).seen.tolist() == [[True, True], [True, True], [False, False]]
    seen = view(rig, 10 * PLATE, FACE, 0.8).seen
    assert not seen.all()


def test_the_direction_to_look_from():
    np.testing.assert_allclose(look_direction(PLATE, FACE), [0, 0, -1])
    np.testing.assert_allclose(look_direction(PLATE, NO_FACE), [0, 0, -1], atol=1e-12)
    cube = np.concatenate([PLATE - [0, 0, 0.1], PLATE @ [[0, 0, 1.0], [1, 0, 0], [0, 1, 0]], PLATE[:1] + 0.1])
    normals = np.array([[0, 0, -1.0]] * 3 + [[1.0, 0, 0]] * 3 + [[0, 1.0, 0]])
    direction = look_direction(cube, normals)
    assert (normals[:6] @ direction > 0.5).all()


def test_covariance_is_that_of_opencvs_derivatives():
    rig, sigma = plain_rig(), 0.05
    seen = view(rig, PLATE, FACE, 0.9, (0.4, -0.3))
    step, columns = 1e-6, []
    for k in range(6):
        ends = [seen_by_opencv(rig, seen.T_left_body @ exp_se3(s * step * np.eye(6)[k]), PLATE) for s in (1, -1)]
        columns.append((ends[0] - ends[1]).ravel() / (2 * step))
    J = np.stack(columns, axis=1) / sigma
    expected = np.linalg.inv(J.T @ J)
    cov = pose_covariance(rig, PLATE, seen, sigma)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(cov / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-5)


def test_covariance_with_an_uncertain_rig_is_that_of_monte_carlo():
    plain, sigma, draws = example_rig(), 0.05, 400
    rng = np.random.default_rng(7)
    spread = np.zeros(plain.parameter_count)
    spread[[0, 1, 2, 3, -6, -5, -4, -3, -2, -1]] = [0.3, 0.3, 0.4, 0.4, 2e-5, 2e-5, 2e-5, 2e-4, 2e-4, 1e-4]
    rig = StereoRig(plain.left, plain.right, plain.T_left_right, np.diag(spread**2), 0.0)
    seen = view(rig, PLATE, FACE, 0.8, (0.3, 0.2))
    cov = pose_covariance(rig, PLATE, seen, sigma)
    errors = []
    for _ in range(draws):
        true = rig.perturbed(rng.normal(0, 1, len(spread)) * spread)
        uv = seen_by_opencv(true, seen.T_left_body, PLATE) + rng.normal(0, sigma, (6, 2))
        observations = PixelObservations(
            np.repeat([0, 1], 3), np.tile(np.arange(3), 2), uv, np.tile(sigma**2 * np.eye(2), (6, 1, 1))
        )
        fit = fit_pose(rig.cameras, rig.T_left_right, PLATE, observations, seen.T_left_body, robust=False)
        errors.append(log_se3(inverse(seen.T_left_body) @ fit.T_left_body))
    nees = float(np.einsum("ni,ij,nj->", errors, np.linalg.inv(cov), errors))
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 6 * draws)
    assert low < nees < high


def test_too_few_points_in_view_fix_no_pose():
    rig = plain_rig()
    assert pose_covariance(rig, PLATE, view(rig, 10 * PLATE, FACE, 0.8), 0.1) is None


@pytest.mark.parametrize("distance", [0.6, 1.2])
def test_separation_is_the_least_that_scipy_finds_over_the_rotations(distance):
    rig, sigma = plain_rig(), 0.2
    points = PLATE + np.array([[0, 0, 0], [0.004, 0, 0], [0, 0, 0]])
    (one, *_) = symmetries(points, np.ones((3, 3), bool), np.arange(3), 0.006)
    least = np.inf
    for rotation in ((0, 0), (np.pi / 4, 0), (-np.pi / 4, 0), (0, np.pi / 4), (0, -np.pi / 4)):
        T = view(rig, points, NO_FACE, distance, rotation).T_left_body
        uv, start = seen_by_opencv(rig, T, points), T @ inverse(one.T)

        def residuals(xi, uv=uv, start=start):
            return (seen_by_opencv(rig, start @ exp_se3(xi), points[one.taken_for]) - uv).ravel() / sigma

        least = min(least, 2 * least_squares(residuals, np.zeros(6), x_scale=1e-2, xtol=1e-12, ftol=1e-12).cost)
    assert separation(rig, points, NO_FACE, one, distance, sigma) == pytest.approx(np.sqrt(least), rel=1e-4)
    assert separation(rig, points, FACE, one, distance, sigma) == np.inf  # it shows the other side
    assert np.isnan(separation(rig, points, FACE, one, 0.02, sigma))  # both cameras look at it edge-on
    assert np.isnan(separation(rig, points, -FACE * [[1], [1], [-1]], one, distance, sigma))  # never seen together
