"""The noise of discs from the poses of a body that moves: detections with known errors."""

from dataclasses import replace

import numpy as np

from armsight.data import Correspondences
from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.vision.markers.targets import Composite
from armsight.vision.pose.locate import locate
from armsight.vision.pose.noise import DiscNoise
from armsight.vision.rig import CameraNoise
from armsight.vision.triangulate import triangulate
from disc_views import discs_of

TARGET = Composite("body", (), discs_of(np.random.default_rng(3).uniform(-0.06, 0.06, (9, 3)) * [1, 1, 0.3]))
RIG = replace(example_rig(), disc_noise=(CameraNoise(1.5, 100.0), CameraNoise(0.7, 100.0)))
SIGMA_PX, TRUE = 0.02, (2.0, 0.6)


def found(shots, *, moves=True):
    """The noise found from shots of a body printed 0.1 mm wrongly, whose errors have TRUE times the image's variance."""
    rng, body, noise = np.random.default_rng(5), TARGET.body, DiscNoise(RIG, TARGET)
    points = body.points + rng.normal(0, 1e-4, body.points.shape)
    cov = np.tile(SIGMA_PX**2 * np.eye(2), (len(points), 2, 1, 1)) * np.array(RIG.disc_variance_factors)[:, None, None]
    for _ in range(shots):
        at = np.array([*rng.uniform(-0.1, 0.1, 2) * moves, 0.8])
        T = pose(exp_so3(rng.uniform(-0.4, 0.4, 3) * moves), at)
        both = zip(RIG.cameras, (T, inverse(RIG.T_left_right) @ T), strict=True)
        uv = np.stack([camera.project(transform(X, points)) for camera, X in both], axis=1)
        uv += rng.normal(0, SIGMA_PX, uv.shape) * np.sqrt(TRUE)[:, None]
        noise.add(locate(RIG, body, triangulate(RIG, body, Correspondences(np.arange(len(points)), uv, cov))))
    return noise.found()


def test_each_cameras_factor_is_found_of_a_body_that_deviates_from_its_file():
    for noise, factor in zip(found(30), TRUE, strict=True):
        assert abs(noise.variance_factor / factor - 1) < 4 * np.sqrt(2 / noise.freedom) < 0.4


def test_a_body_at_rest_and_few_shots_show_no_noise():
    assert found(12, moves=False) is None
    assert found(4) is None
    assert found(0) is None
