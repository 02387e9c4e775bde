"""Rectification against OpenCV's projections, for every camera model, and back."""

import cv2
import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.vision.rig import StereoRig
from strategies import CAMERAS, ordinary_rig
from views import both_pixels

OPENCV = int(cv2.__version__.split(".")[0])


def scene_points(count=200):
    return np.array([0.1, 0.0, 0.7]) + np.random.default_rng(0).uniform(-1, 1, (count, 3)) * [0.2, 0.15, 0.2]


@pytest.mark.parametrize("model", CAMERAS)
def test_rows_are_common_and_disparity_is_depth(model):
    rig, p_left = ordinary_rig(model), scene_points()
    form = rig.rectify()
    uv = both_pixels(rig, p_left)
    left, right = form.to_rect(uv[:, 0], "left"), form.to_rect(uv[:, 1], "right")
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-8)
    d = left[:, 0] - right[:, 0]
    assert (d > 0).all()
    np.testing.assert_allclose(form.points(left, d), p_left, atol=1e-10)
    np.testing.assert_allclose(form.depth(d), p_left @ form.T_left_rectleft[:3, 2], atol=1e-10)
    for side, rect, raw in (("left", left, uv[:, 0]), ("right", right, uv[:, 1])):
        np.testing.assert_allclose(form.to_raw(rect, side), raw, atol=1e-8)


@pytest.mark.opencv
@pytest.mark.parametrize("model", ["none", "brown5", "fisheye"])
def test_images_show_at_each_pixel_what_the_map_says(model):
    rig = ordinary_rig(model)
    form = rig.rectify()
    width, height = rig.left.image_size_px
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    ramp = (u / 8 + v / 16).astype(np.float32)
    left, _ = form.images(ramp, ramp)
    inside = form.seen("left")
    inside[:, [0, -1]], inside[[0, -1]] = False, False
    position = form.map_left
    within = inside & (position > 2).all(axis=2) & (position < np.array([width, height]) - 3).all(axis=2)
    # OpenCV 4's remap rounds positions to 1/32 px, half a step along each axis; 5's does not, but for float32.
    bound = (1 / 8 + 1 / 16) * (1 / 64 if OPENCV < 5 else 5e-4)
    assert np.abs(left - (position[..., 0] / 8 + position[..., 1] / 16))[within].max() <= bound
    assert within.mean() > 0.5


def test_a_rectified_pair_stays_as_it_is():
    camera = CAMERAS["none"].with_parameters(np.array([900.0, 900.0, 639.5, 359.5]))
    rig = StereoRig(camera, camera, pose(np.eye(3), np.array([0.1, 0, 0])), np.zeros((14, 14)), 0.1)
    form = rig.rectify()
    assert form.focal_px == 900
    assert form.principal_px == (639.5, 359.5)
    u, v = np.meshgrid(np.arange(1280), np.arange(720))
    np.testing.assert_allclose(form.map_left, np.stack([u, v], axis=2), atol=1e-3)
    assert form.seen("left")[1:-1, 1:-1].all()


def test_rigs_that_cannot_be_rectified_are_rejected():
    camera = CAMERAS["none"]
    for t, word in (([-0.1, 0, 0], "exchange"), ([0.001, 0, 0.3], "behind the other")):
        with pytest.raises(InputError, match=word):
            StereoRig(camera, camera, pose(exp_so3(np.zeros(3)), np.array(t)), np.zeros((14, 14)), 0.1).rectify()


def test_images_of_another_size_are_rejected():
    form = ordinary_rig().rectify()
    good = np.zeros((720, 1280), np.uint8)
    with pytest.raises(InputError, match="right image: 640x480"):
        form.images(good, np.zeros((480, 640), np.uint8))


@pytest.mark.opencv
def test_a_verging_rig_agrees_with_opencv():
    rig, p_left = example_rig(), scene_points()
    form, uv = rig.rectify(), both_pixels(example_rig(), scene_points())
    T = inverse(rig.T_left_right)
    K = [np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]) for fx, fy, cx, cy in (c.intrinsics for c in rig.cameras)]
    bent, size = [c.distortion for c in rig.cameras], rig.left.image_size_px
    rotations = cv2.stereoRectify(K[0], bent[0], K[1], bent[1], size, T[:3, :3].copy(), T[:3, 3:].copy())[:2]
    # Both rotate the cameras until the rows are the same planes through the baseline; about the baseline they may choose
    # another rotation. OpenCV's own rows agree to its undistortion's last step.
    P = np.array([[form.focal_px, 0, form.principal_px[0]], [0, form.focal_px, form.principal_px[1]], [0, 0, 1.0]])
    for k, (side, ours) in enumerate((("left", form.T_left_rectleft), ("right", form.T_right_rectright))):
        between = rotations[k] @ ours[:3, :3]
        np.testing.assert_allclose(between[0], [1, 0, 0], atol=1e-9)
        undistort = cv2.undistortPoints if OPENCV >= 5 else cv2.undistortPointsIter  # the one with criteria
        position = undistort(
            uv[:, k][:, None], K[k], bent[k], R=ours[:3, :3].T, P=P,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12),
        )[:, 0]  # fmt: skip
        np.testing.assert_allclose(form.to_rect(uv[:, k], side), position, atol=1e-6)
        maps = cv2.initUndistortRectifyMap(K[k], bent[k], ours[:3, :3].T, P, size, cv2.CV_32FC2)[0]
        here = form.map_left if side == "left" else form.map_right
        high = np.array(size) - 1
        theirs = ((maps >= 0) & (maps <= high)).all(axis=2)
        np.testing.assert_array_equal(form.seen(side), theirs)
        np.testing.assert_allclose(here[theirs], maps[theirs], atol=1e-3)
    left, right = (form.to_rect(uv[:, k], side) for k, side in enumerate(("left", "right")))
    assert np.abs(left[:, 1] - right[:, 1]).max() < 1e-8
    np.testing.assert_allclose(form.points(left, left[:, 0] - right[:, 0]), p_left, atol=1e-9)
