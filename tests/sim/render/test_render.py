"""The renderer against brute force, closed forms and OpenCV."""

import itertools

import numpy as np
import pytest
from render_oracle import brute, displacement_px

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.render.render import Shutter, radiance, render, render_pair
from armsight.sim.render.scene import (
    BLACK,
    CLEAR,
    WHITE,
    Pattern,
    PosedBody,
    charuco,
    chessboard,
    marker_bits,
    plate,
    tag,
)
from armsight.vision.camera import Camera

#: The issue's bound on a displaced corner or centre, and one grey level of a sensor of unit gain.
SHIFT_PX, LEVEL = 0.002, 1 / 255

DISTORTIONS = {
    "none": [],
    "brown4": [-0.2, 0.05, 0.0008, -0.0006],
    "brown5": [-0.25, 0.08, 0.0008, -0.0006, 0.01],
    "brown8": [0.3, 0.1, 0.0008, -0.0006, 0.01, 0.6, 0.05, 0.0],
    "fisheye": [0.05, -0.01, 0.002, 0.0],
}


def camera(model="none", size=(640, 480), focal=600.0):
    width, height = size
    intrinsics = np.array([focal, 1.005 * focal, width / 2 - 2.7, height / 2 + 2.2])
    return Camera(size, model, intrinsics, np.array(DISTORTIONS[model]))


def at_pose(x, y, z, *rotation):
    return pose(exp_so3(np.array(rotation or (0.0, 0.0, 0.0))), np.array([x, y, z]))


def window(cam, T, p_body, half):
    u, v = np.round(cam.project(transform(T, np.array(p_body, dtype=float))[None])[0]).astype(int)
    return u - half, v - half, u + half + 1, v + half + 1


def compare(cam, layers, win, psf_sigma_px, samples=32, background=0.4):
    """Render, brute-force and return (shift, largest difference) in a window."""
    bodies = [PosedBody((pattern,), T) for pattern, T in layers]
    u0, v0, u1, v1 = win
    light = radiance(cam, bodies, background, psf_sigma_px=psf_sigma_px)[v0:v1, u0:u1]
    reference = brute(cam, layers, win, psf_sigma_px, background, samples)
    return np.abs(displacement_px(light, reference)).max(), np.abs(light - reference).max()


@pytest.mark.parametrize("model", DISTORTIONS)
def test_chessboard_corners_are_where_brute_force_puts_them(model):
    rng = np.random.default_rng(1)
    cam, board = camera(model), chessboard(9, 6, 0.025)
    T = at_pose(-0.1, -0.06, 0.4, *rng.uniform(-0.5, 0.5, 3))
    for corner in (0, 53):
        win = window(cam, T, [corner % 9 * 0.025, corner // 9 * 0.025, 0], 5)
        shift, difference = compare(cam, [(board, T)], win, 0.7)
        assert shift < SHIFT_PX
        assert difference < LEVEL


@pytest.mark.parametrize(("model", "radius_m"), list(zip(DISTORTIONS, itertools.cycle([0.002, 0.005]))))
def test_discs_are_where_brute_force_puts_them(model, radius_m):
    rng = np.random.default_rng(2)
    cam, pattern = camera(model), plate(0.05, 0.05, 0.1, [(0.001, 0.002, radius_m, 0.9)])
    T = at_pose(0.12, -0.08, 0.4, *rng.uniform(-0.8, 0.8, 3))
    win = window(cam, T, [0.001, 0.002, 0], int(radius_m / 0.4 * 600) + 4)
    shift, difference = compare(cam, [(pattern, T)], win, 0.7)
    assert shift < SHIFT_PX
    assert difference < LEVEL


@pytest.mark.parametrize("psf_sigma_px", [0.5, 1.0, 1.5])
def test_the_blur_is_that_of_the_continuous_image(psf_sigma_px):
    cam, board = camera(), chessboard(3, 3, 0.02)
    T = at_pose(0.01, 0.02, 0.4, 0.3, -0.2, 0.4)
    shift, difference = compare(cam, [(board, T)], window(cam, T, [0.02, 0.02, 0], 4), psf_sigma_px)
    assert shift < SHIFT_PX
    assert difference < LEVEL


@pytest.mark.parametrize(
    ("pattern", "point"),
    [
        (chessboard(4, 3, 0.02), (0.02, 0.02, 0)),
        (tag(marker_bits("tag36h11", 5), 0.02), (-0.006, 0.004, 0)),
        (charuco(5, 4, 0.02, 0.014, "4X4_50"), (0.01, 0.005, 0)),
        (plate(0.02, 0.02, 0.1, [(0.0, 0.001, 0.0007, 0.9), (0.004, 0.001, 0.002, 0.6)]), (0.001, 0.001, 0)),
    ],
)
def test_areas_are_exact_without_blur(pattern, point):
    """128 samples a pixel side measure a straight edge's area to half a sample's width at worst."""
    cam, T = camera("brown5"), at_pose(0.05, 0.04, 0.4, 0.4, -0.3, 0.2)
    _, difference = compare(cam, [(pattern, T)], window(cam, T, point, 4), 0.0, samples=128)
    assert difference < 0.5 / 128 * (WHITE - BLACK) + 1e-3


@pytest.mark.parametrize("rotation", [(1.35, 0.2, 0.0), (0.1, -1.4, 0.3)])
def test_a_plane_that_reaches_behind_the_camera(rotation):
    """A floor and a wall: hundreds of cells in a pixel far off, and what is behind the camera stays out of it."""
    cam, board = camera(size=(40, 30), focal=30.0), chessboard(60, 60, 0.4)
    T = at_pose(0, 0, 1.5, *rotation) @ at_pose(-12.0, -12.0, 0)
    light = radiance(cam, [PosedBody((board,), T)], psf_sigma_px=0.0)
    assert light.std() > 0.1
    difference = np.abs(light - brute(cam, [(board, T)], (0, 0, 40, 30), 0.0, samples=24))
    assert np.median(difference) < LEVEL
    assert difference.max() < 0.05  # pixels at the horizon hold more cells than 24 x 24 samples can count


def test_a_board_larger_than_the_image_covers_it_all_in_spite_of_a_folding_polynomial():
    cam = Camera((160, 120), "brown4", np.array([140.0, 140.0, 80.0, 60.0]), np.array([-0.25, 0.0, 0.0, 0.0]))
    light = radiance(cam, [PosedBody((plate(3.0, 3.0, 0.7),), at_pose(0, 0, 0.5, 0.1, 0.1, 0.0))], 0.1)
    np.testing.assert_allclose(light, 0.7, atol=1e-6)


def test_a_straight_edge_has_its_closed_form():
    """An upright edge at u = e: the mean of the normal distribution function over a pixel."""
    from scipy.integrate import quad
    from scipy.stats import norm

    cam = camera(size=(24, 8), focal=100.0)
    u = np.arange(24)
    for sigma in (0.5, 0.7, 1.5):
        for edge_px in (11.0, 11.13, 11.25, 11.5, 11.8):
            x = (edge_px - cam.intrinsics[2]) / cam.intrinsics[0]
            half_plane = Pattern(np.array([x, 2.0]), np.array([-2.0, 2.0]), np.array([[0.9]]))
            light = radiance(cam, [PosedBody((half_plane,), at_pose(0, 0, 1.0))], 0.1, psf_sigma_px=sigma)[4]
            share = [quad(norm.cdf, k - 0.5, k + 0.5, args=(edge_px, sigma), epsabs=1e-10)[0] for k in u]
            np.testing.assert_allclose(light, 0.1 + 0.8 * np.array(share), atol=LEVEL)


def test_a_disc_has_its_area_and_its_middle():
    cam = Camera((40, 40), "none", np.array([100.0, 100.0, 19.3, 20.1]), np.zeros(0))
    v, u = np.mgrid[:40, :40]
    for x, y in np.random.default_rng(0).uniform(-0.005, 0.005, (10, 2)):
        wall = Pattern(np.array([-1.0, 1.0]), np.array([-1.0, 1.0]), np.array([[0.1]]), np.array([[x, y, 0.033, 0.9]]))
        light = radiance(cam, [PosedBody((wall,), at_pose(0, 0, 1.0))], psf_sigma_px=0.7).astype(float) - 0.1
        assert light.sum() == pytest.approx(0.8 * np.pi * 3.3**2, rel=1e-4)
        middle = np.array([(light * u).sum(), (light * v).sum()]) / light.sum()
        np.testing.assert_allclose(middle, [19.3 + 100 * x, 20.1 + 100 * y], atol=3e-4)


def test_the_nearer_body_covers_and_the_order_of_the_list_does_not_matter():
    cam = camera(size=(60, 40), focal=60.0)
    near, far = (
        PosedBody((plate(0.1, 0.1, 0.8),), at_pose(0, 0, 0.3)),
        PosedBody((plate(0.4, 0.4, 0.2),), at_pose(0, 0, 0.6)),
    )
    for bodies in ([near, far], [far, near]):
        assert radiance(cam, bodies)[22, 28] == pytest.approx(0.8)


def test_a_tag_covers_the_plate_it_is_stuck_on_wherever_it_sits():
    cam = camera(size=(120, 80), focal=120.0)
    small = plate(0.02, 0.02, 0.9)
    for x in (-0.03, 0.03):
        body = PosedBody((plate(0.1, 0.1, 0.2), small.on_body(at_pose(x, 0, 0))), at_pose(0, 0, 0.4, 0, 0.5, 0))
        u, v = cam.project(transform(body.T_camera_body, np.array([[x, 0, 0]])))[0].round().astype(int)
        assert radiance(cam, [body], psf_sigma_px=0.0)[v, u] == pytest.approx(0.9)


def test_a_pattern_is_not_seen_from_behind():
    cam = camera(size=(60, 40), focal=60.0)
    light = radiance(cam, [PosedBody((plate(0.1, 0.1, 0.8),), at_pose(0, 0, 0.3, 0, np.pi, 0))], 0.25)
    np.testing.assert_allclose(light, 0.25, atol=1e-6)


def test_clear_cells_let_the_background_through():
    cam = camera(size=(60, 40), focal=60.0)
    background = np.random.default_rng(0).uniform(0.2, 0.8, (40, 60)).astype(np.float32)
    hollow = Pattern(np.array([-1.0, -0.02, 0.02, 1.0]), np.array([-1.0, 1.0]), np.array([[0.5, CLEAR, 0.5]]))
    light = radiance(cam, [PosedBody((hollow,), at_pose(0, 0, 0.3))], background, psf_sigma_px=0.0)
    np.testing.assert_allclose(light[:, 26:29], background[:, 26:29], rtol=1e-6)
    np.testing.assert_allclose(light[:, :20], 0.5)


def test_motion_blur_is_the_mean_over_the_exposure():
    cam, pattern = camera("brown5"), plate(0.05, 0.05, 0.1, [(0.0, 0.0, 0.004, 0.9)])
    T, twist = at_pose(0.05, 0.03, 0.4, 0.3, -0.4, 0.1), np.array([0.25, 0.1, 0.2, 0.5, 0.3, 4.0])
    exposure = 0.01  # about 4 px
    u0, v0, u1, v1 = win = window(cam, T, [0, 0, 0], 12)
    shutter = Shutter(exposure_s=exposure)
    light = radiance(cam, [PosedBody((pattern,), T, twist)], psf_sigma_px=0.7, shutter=shutter)[v0:v1, u0:u1]
    times = ((np.arange(48) + 0.5) / 48 - 0.5) * exposure
    still = [brute(cam, [(pattern, T @ exp_se3(t * twist))], win, 0.7, samples=8) for t in times]
    assert np.abs(displacement_px(light, np.mean(still, axis=0))).max() < SHIFT_PX
    assert np.abs(light - np.mean(still, axis=0)).max() < LEVEL


def test_each_row_of_a_rolling_shutter_sees_its_own_moment():
    cam, board = camera("brown5", (120, 90), 110.0), chessboard(4, 3, 0.03)
    T, twist = at_pose(-0.04, -0.02, 0.3, 0.1, 0.2, 0.1), np.array([0.8, 0.0, 0.1, 0.0, 1.0, 2.0])
    acceleration = np.array([20.0, -30.0, 0.0, 0.0, 0.0, 40.0])
    row_s = 1e-3
    light = radiance(
        cam,
        [PosedBody((board,), T, twist, acceleration)],
        psf_sigma_px=0.0,
        shutter=Shutter(exposure_s=0.0, row_s=row_s),
    )
    for v in (10, 44, 70):
        time = (v - 44.5) * row_s
        at = T @ exp_se3(time * twist + 0.5 * time**2 * acceleration)
        row = brute(cam, [(board, at)], (0, v, 120, v + 1), 0.0, samples=64)[0]
        np.testing.assert_allclose(light[v], row, atol=0.5 / 64 + 1e-3)


def test_a_pair_sees_the_body_from_both_sides():
    """The right image is the image of the body in the right camera's frame."""
    left, right = camera("brown5"), camera("fisheye")
    T_left_right, T = at_pose(0.2, 0.01, 0.0, 0.01, -0.1, 0.02), at_pose(0.05, 0.0, 0.5, 0.2, 0.1, 0.0)
    body = PosedBody((chessboard(4, 3, 0.02),), T)
    images = render_pair((left, right), T_left_right, [body], rng=None)
    alone = PosedBody(body.patterns, np.linalg.inv(T_left_right) @ T)
    np.testing.assert_array_equal(images[0], render(left, [body]))
    assert (images[1] != render(right, [alone])).mean() < 1e-3  # two ways to invert a pose


def test_the_same_seed_gives_the_same_image():
    cam, body = camera(size=(80, 60), focal=80.0), PosedBody((chessboard(4, 3, 0.02),), at_pose(-0.02, 0, 0.3))
    first, second = (render(cam, [body], rng=np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert first.dtype == np.uint8


def test_a_background_of_another_size_is_rejected():
    with pytest.raises(InputError, match=r"must be a number or \(60, 80\)"):
        render(camera(size=(80, 60), focal=80.0), [], np.zeros((80, 60)))
