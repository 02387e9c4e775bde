"""Where bundle adjustment begins: a lens that imitates another, and when no other start is tried."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from armsight.geometry.pose import transform
from armsight.geometry.rigid import fit_rigid
from armsight.geometry.rotation import skew
from armsight.vision.calibrate.heldout import _normalised
from armsight.vision.calibrate.start import imitated
from armsight.vision.camera import DISTORTION_MODELS, Camera

SIZE = (640, 480)
LENSES = {
    "brown4": np.array([-0.12, 0.05, 0.0, 0.0]),
    "brown8": np.array([-0.1, 0.04, 0.0, 0.0, 0.01, 0.02, 0.0, 0.0]),
    "fisheye": np.array([0.03, -0.01, 0.002, -0.001]),
}


def grid():
    u, v = np.meshgrid(np.linspace(0, SIZE[0] - 1, 25), np.linspace(0, SIZE[1] - 1, 19))
    return np.stack([u.ravel(), v.ravel()], axis=1)


@pytest.mark.parametrize(("lens", "other"), [("brown4", "fisheye"), ("brown8", "fisheye"), ("fisheye", "brown8")])
def test_a_lens_without_decentring_is_imitated_to_a_fifth_of_a_pixel(lens, other):
    camera = Camera(SIZE, lens, np.array([500.0, 505.0, 320.0, 240.0]), LENSES[lens])
    found = imitated(camera, other, grid())
    assert found is not None
    assert found.model == other
    off = found.project(camera.unproject(grid())) - grid()
    assert np.abs(off).max() < 0.2  # both families are even polynomials of the angle up to its ninth power and beyond


def test_a_lens_that_sees_behind_itself_is_not_imitated_by_one_that_cannot():
    camera = Camera(SIZE, "fisheye", np.array([150.0, 150.0, 320.0, 240.0]), np.zeros(DISTORTION_MODELS["fisheye"]))
    assert imitated(camera, "brown4", grid()) is None


def test_predicted_sigmas_are_those_of_the_full_covariance():
    rng = np.random.default_rng(4)
    n, parameters = 20, 9
    body = np.column_stack([rng.uniform(-0.1, 0.1, (n, 2)), np.zeros(n)])
    p = body + np.array([0.02, 0.01, 0.8]) + 1e-4 * rng.standard_normal((n, 3))
    root = 1e-4 * rng.standard_normal((n, 3, 3))
    cov, by_rig = root @ root.transpose(0, 2, 1), rng.standard_normal((n, 3, parameters))
    half = 1e-5 * rng.standard_normal((parameters, parameters))
    cov_rig, fitted = half @ half.T, transform(fit_rigid(body, p), body)
    A = np.concatenate([np.tile(np.eye(3), (n, 1, 1)), -skew(fitted - fitted.mean(axis=0))], axis=2).reshape(3 * n, 6)
    P, G, gap = np.eye(3 * n) - A @ np.linalg.pinv(A), by_rig.reshape(3 * n, -1), (p - fitted).ravel()
    expected = [
        np.sqrt((gap**2 / np.diag(P @ (block_diag(*cov) + G @ some @ G.T) @ P)).mean())
        for some in (cov_rig, 0 * cov_rig)
    ]
    np.testing.assert_allclose(_normalised(fitted, p, cov, by_rig, cov_rig), expected, rtol=1e-10)
