"""Depth's uncertainty against Monte Carlo over rigs and disparities."""

import numpy as np

from armsight.vision.dense.depth import calibration_share, depth_of
from armsight.vision.dense.method import MEASURED, Disparity, Search
from armsight.vision.rig import StereoRig
from armsight.vision.triangulate import midpoints
from strategies import ordinary_rig


def small_rig():
    rig = ordinary_rig("brown5")
    sigma = np.concatenate([np.full(4, 0.3), np.full(5, 1e-4)] * 2 + [np.full(3, 1e-4), np.full(3, 2e-4)])
    return StereoRig(rig.left, rig.right, rig.T_left_right, np.diag(sigma**2), 0.1)


def test_the_calibrations_share_is_the_spread_over_rigs():
    rig = small_rig()
    form = rig.rectify()
    uv, d = np.array([[500.0, 300.0], [700.0, 500.0]]), np.array([150.0, 300.0])
    raw = form.to_raw(uv, "left"), form.to_raw(uv - np.column_stack([d, 0 * d]), "right")
    rng, axis = np.random.default_rng(0), form.T_left_rectleft[:3, 2]
    sigma = np.sqrt(np.diag(rig.cov))
    z = np.array([midpoints(rig.perturbed(sigma * rng.normal(size=len(sigma))), *raw) @ axis for _ in range(2000)])
    share = calibration_share(form, uv, d)
    # A spread of 2000 draws is known to 1.6%; five of these.
    np.testing.assert_allclose(share, z.std(axis=0) / z.mean(axis=0), rtol=0.08)


def test_sigma_of_depth_holds_both_shares():
    rig = small_rig()
    form = rig.rectify()
    height, width = 720, 1280
    u = np.broadcast_to(np.arange(width), (height, width))
    d = (150 + 100 * u / width).astype(np.float32)
    state = np.full(d.shape, MEASURED, np.uint8)
    result = Disparity(d, state, np.full(d.shape, 0.2, np.float32), np.ones(d.shape, np.float32), Search(0, 300))
    depth = depth_of(form, result)
    where = form.seen("left")
    assert np.isnan(depth.depth_m[~where]).all()
    z = form.focal_px * rig.baseline_m / d
    np.testing.assert_allclose(depth.depth_m[where], z[where], rtol=1e-5)
    matching = z**2 / (form.focal_px * rig.baseline_m) * 0.2
    np.testing.assert_allclose(depth.sigma_m[where] ** 2, (matching**2 + depth.calibration_m**2)[where], rtol=1e-5)
    positions = np.array([[640.0, 360.0], [300.0, 200.0], [1000.0, 600.0]])
    exact = calibration_share(
        form, positions, d[positions[:, 1].astype(int), positions[:, 0].astype(int)].astype(float)
    )
    found = (depth.calibration_m / depth.depth_m)[positions[:, 1].astype(int), positions[:, 0].astype(int)]
    np.testing.assert_allclose(found, exact, rtol=0.05)  # linear between 7 x 5 x 4 positions


def test_a_rig_of_unknown_uncertainty_adds_nothing():
    rig = ordinary_rig("none")
    form = StereoRig(rig.left, rig.right, rig.T_left_right, np.zeros_like(rig.cov), 0.1).rectify()
    d = np.full((720, 1280), 200, np.float32)
    result = Disparity(d, np.full(d.shape, MEASURED, np.uint8), d * 0 + 0.2, d * 0 + 1, Search(0, 300))
    depth = depth_of(form, result)
    assert (depth.calibration_m[form.seen("left")] == 0).all()
