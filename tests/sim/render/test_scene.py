"""Patterns against the conventions of the detectors' bodies and against OpenCV's own drawings."""

import cv2
import numpy as np
import pytest

from armsight.errors import InputError
from armsight.sim.render.scene import (
    BLACK,
    WHITE,
    Pattern,
    aprilgrid,
    charuco,
    chessboard,
    circle_grid,
    marker_bits,
    plate,
    tag,
)

pytestmark = pytest.mark.opencv


def at(pattern, x, y):
    """Reflectance of the cell at a point of the pattern's own plane."""
    return pattern.values[np.searchsorted(pattern.y_edges, y) - 1, np.searchsorted(pattern.x_edges, x) - 1]


def raster(pattern, x0, y0, step, columns, rows):
    """Sample cells at the centres of square pixels."""
    x, y = x0 + (np.arange(columns) + 0.5) * step, y0 + (np.arange(rows) + 0.5) * step
    return pattern.values[np.ix_(np.searchsorted(pattern.y_edges, y) - 1, np.searchsorted(pattern.x_edges, x) - 1)]


def test_chessboard_starts_at_its_first_inner_corner_with_black_towards_minus_x_minus_y():
    board = chessboard(9, 6, 0.025)
    assert at(board, -0.01, -0.01) == BLACK
    assert at(board, 0.01, 0.01) == BLACK
    assert at(board, 0.01, -0.01) == WHITE
    assert at(board, -0.03, -0.03) == WHITE  # the margin
    np.testing.assert_allclose(board.x_edges[[0, 1, -2, -1]], np.array([-2, -1, 9, 10]) * 0.025)
    np.testing.assert_allclose(board.y_edges[[0, 1, -2, -1]], np.array([-2, -1, 6, 7]) * 0.025)
    inner = board.values[1:-1, 1:-1]
    assert (inner[:, 1:] != inner[:, :-1]).all()
    assert (inner[1:] != inner[:-1]).all()


@pytest.mark.parametrize("asymmetric", [False, True])
def test_circles_lie_as_opencv_counts_them(asymmetric):
    grid = circle_grid(4, 5, 0.02, asymmetric=asymmetric)
    expected = [((2 * j + i % 2 if asymmetric else j) * 0.02, i * 0.02) for i in range(5) for j in range(4)]
    np.testing.assert_allclose(grid.discs[:, :2], expected, atol=1e-12)
    spread = np.linalg.norm(grid.discs[:, None, :2] - grid.discs[None, :, :2], axis=2)
    assert 2 * grid.discs[0, 2] < spread[spread > 0].min()


@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (6, 4), (5, 8)])
def test_charuco_is_the_board_of_opencv(columns, rows):
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    raster_image = cv2.aruco.CharucoBoard((columns, rows), 0.08, 0.06, dictionary).generateImage(
        (columns * 80, rows * 80)
    )
    board = charuco(columns, rows, 0.08, 0.06, "DICT_4X4_50")
    ours = raster(board, -0.08, -0.08, 0.001, columns * 80, rows * 80) > 0.5
    assert ((raster_image > 127) != ours).mean() < 1e-3  # OpenCV rounds some cells by a pixel


@pytest.mark.parametrize(("family", "dictionary"), [("4X4_50", "DICT_4X4_50"), ("DICT_5X5_100", "DICT_5X5_100")])
def test_a_tag_reads_as_its_number(family, dictionary):
    marker = tag(marker_bits(family, 7), 0.04)
    side = int(np.ptp(marker.x_edges) / 0.0004)
    image = (raster(marker, marker.x_edges[0], marker.y_edges[0], 0.0004, side, side) * 255).astype(np.uint8)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)))
    corners, ids, _ = detector.detectMarkers(image)
    assert ids.ravel().tolist() == [7]
    first = np.asarray(corners).reshape(4, 2)[0] * 0.0004 + marker.x_edges[0]
    np.testing.assert_allclose(first, [-0.02, -0.02], atol=0.001)


def test_apriltags_own_upright_is_opencvs_upside_down():
    np.testing.assert_array_equal(marker_bits("tag36h11", 3), np.rot90(marker_bits("DICT_APRILTAG_36h11", 3), 2))
    assert marker_bits("tag36h11", 3, border=2).shape == (10, 10)


def test_aprilgrid_counts_from_the_lower_left_and_puts_squares_between():
    grid = aprilgrid(3, 2, 0.05, 0.2)
    step, columns, rows = 0.0005, 420, 300
    raster_image = raster(grid, grid.x_edges[0], grid.y_edges[0], step, columns, rows)
    image = (cv2.copyMakeBorder(raster_image, 20, 20, 20, 20, cv2.BORDER_CONSTANT, value=WHITE) * 255).astype(np.uint8)
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = 2
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = cv2.aruco.ArucoDetector(known, parameters).detectMarkers(image)
    assert sorted(ids.ravel().tolist()) == list(range(6))
    T_pattern_body = np.linalg.inv(grid.T_body_pattern)
    for k, uv in zip(ids.ravel(), corners, strict=True):
        low = np.array([k % 3 * 0.06, k // 3 * 0.06, 0, 1])  # the tag's lower left corner on the body
        middle = (T_pattern_body @ (low + np.array([0.025, 0.025, 0, 0])))[:2]
        found = (uv.reshape(4, 2).mean(axis=0) - 20 + 0.5) * step + [grid.x_edges[0], grid.y_edges[0]]
        np.testing.assert_allclose(found, middle, atol=step)
    x0, y0 = (T_pattern_body @ [-0.005, -0.005, 0, 1])[:2]
    assert at(grid, x0, y0) == BLACK


@pytest.mark.parametrize(
    "make",
    [
        lambda: marker_bits("5X5_9", 0),
        lambda: marker_bits("4X4_50", 50),
        lambda: plate(0.1, 0.1, 0.5, [(0, 0, 0.0, 1.0)]),
        lambda: Pattern(np.array([0.0, 0.0]), np.array([0.0, 1.0]), np.array([[0.5]])),
        lambda: Pattern(np.array([0.0, 1.0]), np.array([0.0, 1.0]), np.array([[0.5, 0.5]])),
    ],
)
def test_impossible_patterns_are_rejected(make):
    with pytest.raises(InputError):
        make()
