"""Boards of discs in rendered images: found at any size and polarity, numbered by their rings, their middles located."""

from functools import lru_cache

import numpy as np
import pytest

from armsight.data import PoseEstimate, Shot
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.sim.example_rig import example_rig
from armsight.sim.render.optics import Optics, Sensor
from armsight.sim.render.render import render, render_pair
from armsight.sim.render.scene import BLACK, WHITE, PosedBody, circle_grid
from armsight.vision.camera import Camera
from armsight.vision.discs.bias import disc_bias
from armsight.vision.markers.board import open_board
from armsight.vision.markers.circle_grid import skips_line
from armsight.vision.markers.circles import unseen_row
from armsight.vision.markers.grid import grid_points
from armsight.vision.pose.measure import measure

SIZE = (640, 480)
WIDE = Camera(SIZE, "brown4", np.array([230.0, 231.0, 322.0, 236.0]), np.array([-0.02, 0.004, 3e-4, -2e-4]))
FISHEYE = Camera(SIZE, "fisheye", np.array([210.0, 211.0, 322.0, 236.0]), np.array([-0.01, 0.005, -0.003, 5e-4]))
LONG = Camera(SIZE, "brown4", np.array([800.0, 801.0, 317.0, 242.0]), np.array([-0.1, 0.05, 3e-4, -2e-4]))
RINGS = ((1, 1), (5, 1), (1, 4))


def posed(pattern, rotation, distance, shift=(0.0, 0.0)):
    """Pose a grid so that its middle is before the camera, rotated by a vector (3,), rad."""
    middle = np.array(
        [0.5 * (pattern.x_edges[0] + pattern.x_edges[-1]), 0.5 * (pattern.y_edges[0] + pattern.y_edges[-1]), 0]
    )
    R = exp_so3(np.array(rotation))
    return pose(R, np.array([*shift, distance]) - R @ middle)


def picture(camera, pattern, T, seed=0):
    """Render a grid in uneven light."""
    optics = Optics(psf_sigma_px=0.8, vignetting=0.3, light_gradient=(0.3, -0.2))
    return render(camera, [PosedBody((pattern,), T)], optics=optics, sensor=Sensor(), rng=np.random.default_rng(seed))


def off_middles(board, found, camera, T, radius_m):
    """Errors (N, 2) of the discs' middles, px, in the numbering of those that look the same that fits best."""
    errors = []
    for order in (np.arange(len(board.body.points)), *board.symmetries):
        points = board.body.points[order[found.ids]]
        errors.append(found.uv - disc_bias(camera, T, points, radius_m) - camera.project(transform(T, points)))
    return min(errors, key=lambda error: np.abs(error).sum())


CASES = {
    "few large discs before a wide lens": (WIDE, "circles:4x3:90mm", {"radius_m": 0.035}, (0.5, -0.4, 0.2), 0.3, 0.2),
    "a fisheye": (FISHEYE, "circles:7x5:40mm", {"radius_m": 0.014}, (-0.4, 0.4, 1.8), 0.25, 0.1),
    "small dense dots": (LONG, "circles:16x11:4mm", {"radius_m": 0.0013}, (0.3, 0.3, -0.4), 0.17, 0.0),
    "staggered, light on dark": (
        LONG, "acircles:4x9:8mm", {"radius_m": 0.004, "asymmetric": True, "black": WHITE, "white": BLACK}, (0.6, 0.1, 3.0),
        0.25, 0.02,
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_every_disc_is_found_and_its_middle_is_where_the_disc_has_it(case):
    camera, spec, kind, rotation, distance, least_bias_px = CASES[case]
    columns, rows = (int(n) for n in spec.split(":")[1].split("x"))
    board = open_board(spec)
    pattern = circle_grid(columns, rows, board.pitch_m, **kind)
    T = posed(pattern, rotation, distance)
    found = board.detect(picture(camera, pattern, T))
    assert found.problem is None
    assert len(found.ids) == columns * rows
    assert found.shape.shape == (columns * rows, 3)
    error = off_middles(board, found, camera, T, kind["radius_m"])
    assert np.sqrt((error**2).mean()) < 0.03
    normalised = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.cov_uv), error)
    assert np.sqrt(normalised.mean() / 2) < 1.4
    bias = disc_bias(camera, T, board.body.points, kind["radius_m"])
    assert np.sqrt((bias**2).mean()) > least_bias_px


@lru_cache
def ringed():
    """Return a board with rings and its print."""
    spec = "circles:7x6:12mm:rings=" + ",".join(f"{x}x{y}" for x, y in RINGS)
    return open_board(spec), circle_grid(7, 6, 0.012, radius_m=0.004, rings=RINGS)


@pytest.mark.parametrize("rotation", [0.1, 1.7, 3.2, -1.5])
def test_rings_number_a_part_of_the_board(rotation):
    board, pattern = ringed()
    assert not board.symmetries
    T = posed(pattern, (0.2 * np.cos(rotation), 0.2 * np.sin(rotation), rotation), 0.13, (0.012, 0.02))
    image = picture(LONG, pattern, T)
    found = board.detect(image)
    assert found.problem is None
    assert 15 < len(found.ids) < 42
    assert set(found.ids) & {y * 7 + x for x, y in RINGS}
    error = found.uv - disc_bias(LONG, T, board.body.points[found.ids], 0.004)
    error -= LONG.project(transform(T, board.body.points[found.ids]))
    assert np.abs(error).max() < 0.1
    # Without rings a part has no numbers, unless one end of the rows and of the columns is in view.
    plain = open_board("circles:7x6:12mm")
    same = plain.detect(image)
    if len(same.ids):
        assert np.abs(off_middles(plain, same, LONG, T, 0.004)).max() < 0.1
    else:
        assert "which ones they are is unknown" in (same.problem or "")


def test_rings_in_wrong_positions_are_a_reason():
    _, pattern = ringed()
    image = picture(LONG, pattern, posed(pattern, (0.2, 0.1, 0.3), 0.2))
    problem = open_board("circles:7x6:12mm:rings=2x2,4x2,2x4").detect(image).problem
    assert "the rings among them are not where the board has them" in (problem or "")


def test_the_other_polarity_is_found_unless_the_spec_says_which():
    pattern = circle_grid(7, 6, 0.012, radius_m=0.004)
    image = picture(LONG, pattern, posed(pattern, (0.2, 0.1, 0.3), 0.2))
    for pixels, right, wrong in ((image, "dark", "light"), (255 - image, "light", "dark")):
        assert len(open_board("circles:7x6:12mm").detect(pixels).ids) == 42
        assert len(open_board(f"circles:7x6:12mm:{right}").detect(pixels).ids) == 42
        problem = open_board(f"circles:7x6:12mm:{wrong}").detect(pixels).problem or ""
        assert f"the discs in the image are {right}, and the board is said to have {wrong} ones" in problem


def test_a_covered_disc_is_left_out_and_dirt_is_no_disc():
    board, pattern = open_board("circles:7x6:12mm"), circle_grid(7, 6, 0.012, radius_m=0.004)
    T = posed(pattern, (0.2, 0.1, 0.1), 0.2)
    image = picture(LONG, pattern, T)
    clean = board.detect(image)
    at = np.rint(clean.uv[16]).astype(int)
    image[at[1] - 3 : at[1] + 25, at[0] - 22 : at[0] + 6] = 140
    dirt = np.rint(0.5 * (clean.uv[24] + clean.uv[32])).astype(int)
    image[dirt[1] - 3 : dirt[1] + 4, dirt[0] - 3 : dirt[0] + 4] = 30
    found = board.detect(image)
    assert set(clean.ids) - set(found.ids) == {16}
    assert np.abs(off_middles(board, found, LONG, T, 0.004)).max() < 0.1


@pytest.mark.parametrize(
    ("columns", "rows", "skipped"),
    [
        ((0, 1, 2), (0, 1, 2), False),
        ((0, 2, 3), (0, 1, 2), True),
        ((0, 1, 3), (0, 1, 2), True),
        ((1, 2, 3, 4), (0, 1, 2), False),
        ((0, 1, 2), (0, 2, 4), True),
        ((0, 1), (0, 2), True),
        ((0, 1), (0, 1), False),
    ],
)
def test_a_line_that_is_missing_between_others_is_noticed(columns, rows, skipped):
    cells = np.array([(x, y) for x in range(len(columns)) for y in range(len(rows))])
    theta = np.zeros((len(cells), 10))
    x, y = np.array(columns)[cells[:, 0]], np.array(rows)[cells[:, 1]]
    depth = 1.0 + 0.1 * x  # in perspective the discs shrink as their distances do
    theta[:, 0], theta[:, 1] = 100.0 * x / depth, 100.0 * y / depth
    theta[:, 2], theta[:, 4] = (depth**2 / 35.0) ** 2, (depth / 35.0) ** 2
    assert skips_line(cells, theta) is skipped


@pytest.mark.parametrize("spec", ["circles:6x6:12mm", "circles:7x5:12mm", "circles:8x6:12mm", "circles:7x3:12mm"])
def test_a_board_of_another_size_is_not_found_and_its_size_is_said(spec):
    pattern = circle_grid(7, 6, 0.012, radius_m=0.004)
    problem = open_board(spec).detect(picture(LONG, pattern, posed(pattern, (0.2, 0.1, 0.3), 0.2))).problem
    assert "a grid of 7x6" in problem or "a grid of 6x7" in problem  # it looks the same on its side


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("acircles:4x8:8mm", "a grid of 4x9: count columns x rows"),
        ("acircles:3x9:8mm", "a grid of 4x9: count columns x rows"),
        ("acircles:5x9:8mm", "which ones they are is unknown"),
        ("circles:4x9:8mm", "a staggered grid (acircles) of 4x9"),
        ("acircles:4x9:8mm", None),
    ],
)
def test_a_staggered_board_of_another_size_is_not_found_and_its_size_is_said(spec, said):
    pattern = circle_grid(4, 9, 0.008, radius_m=0.003, asymmetric=True)
    problem = open_board(spec).detect(picture(LONG, pattern, posed(pattern, (0.3, 0.1, 0.5), 0.25))).problem
    assert said in problem if said else problem is None


def test_a_row_that_no_image_shows_is_said():
    board, of_first = open_board("acircles:4x9:8mm"), np.arange(32)
    (said,) = unseen_row(board, [of_first, of_first[:30], of_first])
    assert said.startswith("row 9 of acircles:4x9:8mm is in none of 3 images: if the board has 4x8 discs")
    assert unseen_row(board, [of_first, of_first]) == unseen_row(board, [of_first, of_first, of_first + 4]) == ()
    assert unseen_row(open_board("chessboard:4x9:8mm"), [of_first] * 3) == ()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("rings", ["1x1", "0x0,3x0,0x2"])
def test_a_board_without_the_rings_of_its_spec_is_not_found(rings):
    pattern = circle_grid(4, 3, 0.09, radius_m=0.035)
    image = picture(WIDE, pattern, posed(pattern, (0.5, -0.4, 0.2), 0.3, (0.2, 0.0)))
    assert open_board(f"circles:4x3:90mm:rings={rings}").detect(image).problem is not None
    few = image.copy()
    few[:, image.shape[1] // 2 :] = 120
    assert open_board(f"circles:5x5:9mm:rings={rings}").detect(few).problem is not None


def test_a_few_dots_in_line_with_the_board_do_not_hide_it():
    pattern = circle_grid(8, 6, 0.012, radius_m=0.004)
    T = posed(pattern, (0.2, -0.1, 0.05), 0.25)
    image = picture(LONG, pattern, T)
    board = open_board("circles:7x6:12mm")
    assert "8x6" in board.detect(image).problem
    light = int(np.median(image[image > 128]))
    at = LONG.project(transform(T, grid_points(8, 6, 0.012)))
    u, v = at[7].astype(int)
    image[v - 20 : v + 21, u - 20 : u + 21] = light  # a dot less in the eighth column
    found = board.detect(image)
    assert found.problem is None
    assert len(found.ids) == 42


def test_a_larger_grid_of_smaller_dots_is_not_taken_for_the_board():
    board = open_board("circles:4x3:90mm")
    pattern, perforated = circle_grid(4, 3, 0.09, radius_m=0.035), circle_grid(8, 14, 0.03, radius_m=0.01)
    large = posed(pattern, (0.3, -0.2, 0.1), 0.45, (-0.2, 0.0))
    bodies = [
        PosedBody((pattern,), large),
        PosedBody((perforated,), posed(perforated, (0.0, 0.1, 0.05), 0.5, (0.3, 0.0))),
    ]
    image = render(WIDE, bodies, optics=Optics(psf_sigma_px=0.8), sensor=Sensor(), rng=np.random.default_rng(2))
    found = board.detect(image)
    assert found.problem is None
    assert len(found.ids) == 12
    off = np.abs(off_middles(board, found, WIDE, large, 0.035))
    assert off.max() < 0.3


@pytest.mark.parametrize("option", ["", ":radius=20mm"])
def test_measuring_subtracts_the_bias(option):
    rig = example_rig(SIZE, focal_px=300.0, baseline_m=0.08, model="brown4")
    pattern = circle_grid(4, 3, 0.05, radius_m=0.02)
    T = posed(pattern, (0.6, 0.3, 0.1), 0.35, (0.03, 0.0))
    images = render_pair(rig.cameras, rig.T_left_right, [PosedBody((pattern,), T)], rng=np.random.default_rng(1))
    board = open_board("circles:4x3:50mm" + option)
    result = measure(rig, board, Shot("one", *images))
    assert isinstance(result, PoseEstimate)
    flipped = pose(np.diag([-1.0, -1.0, 1.0]), board.body.points[-1])
    error = min((log_se3(inverse(T @ same) @ result.T_left_body) for same in (np.eye(4), flipped)), key=np.linalg.norm)
    # Without it the middles would be off by a pixel, which is a millimetre here.
    assert np.linalg.norm(error[:3]) < 1e-4
    assert np.linalg.norm(error[3:]) < 5e-4
    assert np.abs(disc_bias(rig.left, T @ exp_se3(np.zeros(6)), board.body.points, 0.02)).max() > 0.3
