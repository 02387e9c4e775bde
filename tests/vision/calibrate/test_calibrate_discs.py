"""Calibration from boards of discs and from images of one camera alone; detections without images."""

from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Detections
from armsight.errors import CalibrationError
from armsight.geometry.pose import inverse, transform
from armsight.sim.example_rig import board_poses, example_rig
from armsight.sim.render.scene import circle_grid
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.discs.bias import project_discs
from armsight.vision.markers.board import open_board
from armsight.vision.pose.projection import BundleModel, BundleState, Observations, moved, of_middles, predict
from asserts import assert_jacobian
from board_views import SIZE, SIZES, board_pairs, rig_and_board

RADIUS_M = 0.04


def ellipses(camera, T, points, rng, sigma=0.02):
    """Detections of the discs' ellipses, their centres with noise."""
    normals = np.tile(T[:3, 2], (len(points), 1))
    uv, shape, _, _ = project_discs(camera, transform(T, points), normals, np.full(len(points), RADIUS_M))
    cov = np.tile(sigma**2 * np.eye(2), (len(points), 1, 1))
    return Detections(np.arange(len(points)), uv + sigma * rng.normal(size=uv.shape), cov, shape=shape)


def disc_pairs(count=12):
    """Return the true rig, the board and pairs of large discs close by."""
    rig, board = example_rig(SIZE, focal_px=300.0, model="brown4"), open_board("circles:4x3:90mm")
    Ts, rng = board_poses(np.random.default_rng(5), rig, circle_grid(4, 3, 0.09), count), np.random.default_rng(1)
    pairs = []
    for n, T in enumerate(Ts):
        poses = T, inverse(rig.T_left_right) @ T
        seen = [ellipses(camera, T, board.body.points, rng) for camera, T in zip(rig.cameras, poses, strict=True)]
        pairs.append(Pair(f"p{n:02d}", *seen))
    return rig, board, pairs


def test_large_discs_calibrate_without_bias_and_show_their_radius():
    true, board, pairs = disc_pairs()
    c = calibrate_boards(board, pairs, SIZES, models=("brown4",), folds=3)
    for camera, known in zip(c.rig.cameras, true.cameras, strict=True):
        np.testing.assert_allclose(camera.intrinsics[:2], known.intrinsics[:2], rtol=1e-3)
    assert c.disc_radius_m == pytest.approx(RADIUS_M, rel=1e-3)
    assert c.rig.baseline_m == pytest.approx(true.baseline_m, rel=1e-3)
    assert c.held_out.epipolar_rms_px < 0.05
    assert c.reprojection_rms_px < 0.04
    points = [replace(pair, left=replace(pair.left, shape=np.zeros((0, 3)))) for pair in pairs]
    points = [replace(pair, right=replace(pair.right, shape=np.zeros((0, 3)))) for pair in points]
    biased = calibrate_boards(board, points, SIZES, models=("brown4",), folds=3)
    assert biased.disc_radius_m is None
    assert abs(biased.rig.baseline_m / true.baseline_m - 1) > 2e-3  # so there was a bias to model


def test_a_radius_that_contradicts_the_images_names_both():
    _, _, pairs = disc_pairs(6)
    with pytest.raises(CalibrationError, match=r"radius of 30 mm is given, and the images show 40 mm"):
        calibrate_boards(open_board("circles:4x3:90mm:radius=30mm"), pairs, SIZES, models=("brown4",), folds=2)


@pytest.mark.parametrize("motion", [False, True])
def test_derivatives_of_ellipses(motion):
    rig = example_rig(SIZE, focal_px=300.0, model="none")
    points = open_board("circles:4x3:90mm").body.points
    Ts = board_poses(np.random.default_rng(2), rig, circle_grid(4, 3, 0.09), 2)
    motions = np.full((2, 6), 1e-3) if motion else np.zeros((0, 6))
    model = BundleModel(points, np.zeros((0, len(points), 3)), 1.0, True, np.ones_like(motions), RADIUS_M)
    state = BundleState(rig.cameras, rig.T_left_right, Ts, np.zeros(0), motions)
    seen = Observations(
        np.repeat([0, 1], 4), np.tile([0, 0, 1, 1], 2), np.tile([0, 7], 4), np.zeros((8, 2)), np.zeros((8, 2, 2)), 2
    )
    _, J_shared, J_shot = predict(model, state, seen)
    shots, shared = np.zeros((2, J_shot.shape[2])), np.zeros(J_shared.shape[2])
    # The bias itself hardly depends on the focal length; what it does is left out of the derivatives by the camera.
    assert_jacobian(
        J_shared[:, :, 8:].reshape(16, -1),
        lambda x: predict(model, moved(state, np.concatenate([shared[:8], x]), shots), seen)[0].ravel(),
        shared[8:], 1e-4, rtol=1e-5,
    )  # fmt: skip
    first = np.zeros((16, 6))
    first[:8] = J_shot[:4, :, :6].reshape(8, 6)
    assert_jacobian(
        first,
        lambda x: predict(model, moved(state, shared, np.stack([np.r_[x, shots[0, 6:]], shots[1]])), seen)[0].ravel(),
        np.zeros(6), 1e-6, rtol=1e-5,
    )  # fmt: skip
    flat = replace(seen, uv=predict(model, state, seen)[0])
    np.testing.assert_allclose(
        of_middles(model, state, flat).uv, predict(replace(model, disc_radius_m=0.0), state, seen)[0], atol=1e-9
    )


def test_images_of_one_camera_alone_determine_what_is_inside_it():
    true, board, Ts = rig_and_board()
    pairs = board_pairs(true, board.body.points, Ts)
    few, nothing = pairs[:5], Detections.none("of the left camera alone")
    singles = [replace(pair, name=f"alone {pair.name}", right=nothing) for pair in pairs[5:]]
    singles += [Pair("blank", nothing, Detections.none("too dark"))]
    without = calibrate_boards(board, few, SIZES, models=("brown5",), flat=True, folds=2)
    c = calibrate_boards(board, few, SIZES, models=("brown5",), flat=True, folds=2, singles=singles)
    assert c.pairs == without.pairs
    assert c.pairs_found == 5
    assert [r.pair for r in c.rejected] == ["blank"]
    # Four times as many views of the left camera halve the sigma of what is inside it.
    sigma, before = (np.sqrt(np.diag(each.solution.cov_shared)[:4]) / each.solution.sigma_px for each in (c, without))
    assert (sigma < 0.8 * before).all()
    assert (np.abs(c.rig.left.intrinsics - true.left.intrinsics) < 4 * np.sqrt(np.diag(c.rig.cov)[:4])).all()
