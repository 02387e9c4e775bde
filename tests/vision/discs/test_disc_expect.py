"""What cameras should see of discs at a pose, its derivatives, and the perspective bias, against rims sampled by OpenCV."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from armsight.data import Correspondences
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.vision.discs.bias import centred, expect, visible
from armsight.vision.pose.measure import locate_discs
from armsight.vision.triangulate import pixels_by_rig
from asserts import assert_jacobian
from disc_rims import disc_ellipses
from disc_views import PLATE, SHAPE_NOISE, discs_of, hd_rig, someplace, views
from views import both_pixels, pixels

SOLID = discs_of([[0, 0, 0], [0.06, 0, 0], [0.06, 0.05, 0.01], [-0.02, 0.07, 0.03]])


def ellipse_centres(rig, target, T, normals):
    """(M, 2, 2) centres of the ellipses through rims that OpenCV projects."""
    out = np.empty((len(normals), 2, 2))
    for side, camera in enumerate(rig.cameras):
        T_camera_body = T if side == 0 else inverse(rig.T_left_right) @ T
        p, n = transform(T_camera_body, target.body.points), normals @ T_camera_body[:3, :3].T
        out[:, side], _ = disc_ellipses(partial(pixels, camera), p, n, target.radii_m)
    return out


def test_centres_and_bias_are_those_of_sampled_rims():
    rig, rng = hd_rig(), np.random.default_rng(0)
    for _ in range(10):
        T = someplace(rng)
        e = expect(rig, PLATE, T)
        # Second order in the ellipse where the lens distorts: 15 px rims leave under 1e-4 px.
        np.testing.assert_allclose(e.uv, ellipse_centres(rig, PLATE, T, PLATE.normals), atol=2e-4)
        np.testing.assert_allclose(e.uv - e.bias, both_pixels(rig, transform(T, PLATE.body.points)), atol=1e-9)


def test_derivatives():
    rig, T = hd_rig(), someplace(np.random.default_rng(1))
    e = expect(rig, SOLID, T)

    def moved(xi):
        return expect(rig, SOLID, T @ exp_se3(xi))

    # The derivative of an ellipse's centre leaves out how the lens' curvature over the ellipse changes: 2e-4 of it.
    assert_jacobian(e.J, lambda xi: moved(xi).uv, np.zeros(6), 1e-4, rtol=5e-4)
    by_rig = pixels_by_rig(rig, transform(T, SOLID.body.points)).reshape(-1, 2, 2, 22)
    assert_jacobian(by_rig, lambda d: expect(rig.perturbed(d), SOLID, T).uv, np.zeros(22), 1e-5, rtol=1e-2)


def test_bias_of_a_large_disc_nearby_and_what_correcting_leaves():
    """The requirement: R = 15 mm at 0.5 m and 45 degrees, 0.3 px without, under 0.005 px with correction."""
    rig = hd_rig()
    target = discs_of([[0, 0, 0], [0.08, 0, 0], [0, 0.08, 0]], radius=0.015)
    T = pose(exp_so3(np.array([0, np.radians(45), 0])), np.array([0.1, 0.0, 0.5]))
    true = both_pixels(rig, transform(T, target.body.points))
    seen = Correspondences(
        np.arange(3), ellipse_centres(rig, target, T, target.normals), np.tile(1e-4 * np.eye(2), (3, 2, 1, 1))
    )
    off = np.linalg.norm(seen.uv - true, axis=2)
    assert 0.25 < off[0].max() < 0.45
    left = centred(rig, target, T, seen).uv - true
    assert np.linalg.norm(left, axis=2).max() < 0.005


def test_the_error_of_a_pose_is_what_the_centres_noise_makes_of_it_wherever_the_estimate_began():
    rig, rng, sigma_px, nees = hd_rig(known=True), np.random.default_rng(5), 0.003, []
    target = discs_of([[0, 0, 0], [0.08, 0, 0], [0, 0.08, 0], [0.07, 0.06, 0]], radius=0.015)
    nothing = Correspondences(np.zeros(0, np.int64), np.zeros((0, 2, 2)), np.zeros((0, 2, 2, 2)))
    for _ in range(40):
        T = someplace(rng, z=(0.5, 0.6))
        uv = ellipse_centres(rig, target, T, target.normals)
        cov = np.tile(sigma_px**2 * np.eye(2), (4, 2, 1, 1))
        seen = Correspondences(np.arange(4), uv + rng.normal(0, sigma_px, uv.shape), cov)
        near, far = (
            locate_discs(rig, target.body, target, nothing, seen, T @ exp_se3(by * np.array([1, -1, 2, 10, -10, 10])))
            for by in (1e-6, 1e-3)
        )
        scale = np.sqrt(np.outer(np.diag(near.cov), np.diag(near.cov)))
        np.testing.assert_allclose(far.cov / scale, near.cov / scale, atol=1e-3)
        xi = log_se3(inverse(near.T_left_body) @ T)
        nees.append(xi @ np.linalg.solve(near.cov, xi) / 6)
    # Chi-square of six degrees over them, 40 times: 1 within sqrt(2 / 240) = 0.09.
    assert abs(np.mean(nees) - 1) < 4 * 0.09


def test_normals_nobody_gave():
    flat, solid = discs_of(PLATE.body.points, normal=None), discs_of(SOLID.body.points, normal=None)
    assert np.abs(flat.bias_normals[:, 2]) == pytest.approx(1)
    assert np.isnan(solid.bias_normals).all()
    some = replace(solid, normals=np.array([[0, 0, 1.0], *np.full((3, 3), np.nan)]))
    assert np.isfinite(some.bias_normals[:, 0]).tolist() == [True, False, False, False]
    rig, T = hd_rig(), someplace(np.random.default_rng(2))
    np.testing.assert_allclose(expect(rig, flat, T).uv, expect(rig, PLATE, T).uv, atol=1e-9)
    assert np.isnan(expect(rig, flat, T).facing).all()


def test_a_bias_that_cannot_be_known_is_in_the_covariance():
    rig, T, rng = hd_rig(), someplace(np.random.default_rng(3)), np.random.default_rng(0)
    straight = [replace(camera, model="none", distortion=np.zeros(0)) for camera in rig.cameras]  # a lens adds its own
    rig = replace(rig, left=straight[0], right=straight[1], cov=np.zeros((14, 14)))
    solid = discs_of(SOLID.body.points, normal=None)
    unknown = expect(rig, solid, T)
    assert (unknown.bias == 0).all()
    biases = []
    for _ in range(3000):
        n = rng.normal(size=(4, 3))
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        biases.append(expect(rig, replace(solid, normals=n), T).bias)
    second = np.nanmean(np.einsum("...i,...j->...ij", biases, biases), axis=0)
    # 3000 draws: of variances 5%, at three sigma 15% of the largest.
    np.testing.assert_allclose(unknown.cov_bias, second, atol=0.15 * second.max())


def test_what_is_visible():
    rig = hd_rig()
    T = pose(np.eye(3), np.array([0.1, 0.0, 0.8]))
    assert visible(rig, expect(rig, PLATE, T)).all()
    assert visible(rig, expect(rig, discs_of(PLATE.body.points, normal=None), T)).all()
    back = T @ pose(exp_so3(np.array([0.0, np.pi, 0.0])), np.zeros(3))
    assert not visible(rig, expect(rig, PLATE, back)).any()
    aside = pose(np.eye(3), np.array([-0.6, 0.0, 0.8]))
    see = visible(rig, expect(rig, PLATE, aside))
    for side, camera in enumerate(rig.cameras):
        p = transform(aside if side == 0 else inverse(rig.T_left_right) @ aside, PLATE.body.points)
        uv = pixels(camera, p)
        inside = ((uv > 12) & (uv < np.array([1280, 720]) - 12)).all(axis=1)
        assert see[:, side].tolist() == inside.tolist()
    assert not see.all()
    behind = expect(rig, PLATE, pose(np.eye(3), np.array([0.0, 0.0, -0.5])))
    assert np.isnan(behind.uv).all()
    assert not visible(rig, behind).any()


def test_hand_made_views_are_what_is_expected():
    rig, T = hd_rig(), someplace(np.random.default_rng(6))
    left, right, owner = views(rig, PLATE, [T], sigma=0.0)
    e = expect(rig, PLATE, T)
    for side, found in enumerate((left, right)):
        np.testing.assert_allclose(found.uv, e.uv[owner[side][:, 1], side], atol=2e-4)
        np.testing.assert_allclose(found.shape, e.shape[owner[side][:, 1], side], rtol=4 * SHAPE_NOISE)
    assert cv2.norm(left.uv - right.uv) > 0
