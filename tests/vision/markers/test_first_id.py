"""Boards whose ids begin elsewhere, and Kalibr's target files: OpenCV's own board and hand-painted tags as oracles."""

import cv2
import numpy as np
import pytest

from armsight.errors import InputError
from armsight.vision.markers.aruco import cells
from armsight.vision.markers.board import open_board
from armsight.vision.markers.board_marker import board_codes
from armsight.vision.markers.targets import open_target
from asserts import one_line

SPEC = "charuco:6x5:30mm:22mm:DICT_4X4_50"


def charuco(first):
    """OpenCV's own drawing of the board with ids from ``first`` on."""
    known = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((6, 5), 0.03, 0.022, known, np.arange(first, first + 15))
    return cv2.GaussianBlur(board.generateImage((480, 400), marginSize=30), (0, 0), 0.8)


@pytest.mark.parametrize("first", [0, 10, 35])
def test_a_charuco_board_is_found_by_its_own_ids(first):
    found = open_board(f"{SPEC}:first={first}").detect(charuco(first))
    assert found.problem is None
    assert len(found.ids) == 20
    plain = open_board(SPEC).detect(charuco(0))
    np.testing.assert_allclose(found.uv, plain.uv, atol=0.05)  # the grids are the same, the markers beside them are not


@pytest.mark.parametrize(("given", "there"), [(0, 10), (10, 0), (20, 27)])
def test_other_ids_are_named_with_the_spec_that_has_them(given, there):
    problem = open_board(f"{SPEC}:first={given}").detect(charuco(there)).problem
    assert f"have the ids {there} to {there + 14} of such a board" in problem
    assert f"has {given} to {given + 14}" in problem
    assert problem.endswith(f"give {SPEC}" + (f":first={there}" if there else ""))


def aprilgrid(first):
    """Two by two tags of 10 cells of 12 px, dark squares where four of them would meet."""
    image = np.full((400, 400), 255, np.uint8)
    for y in (slice(0, 40), slice(160, 220), slice(340, 400)):
        for x in (slice(0, 40), slice(160, 220), slice(340, 400)):
            image[y, x] = 0
    for k in range(4):
        row, column = 1 - k // 2, k % 2
        bits = np.kron(cells("tag36h11", first + k, 2) > 0, np.ones((12, 12))) * 255
        image[40 + row * 180 : 160 + row * 180, 40 + column * 180 : 160 + column * 180] = bits
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def test_an_aprilgrid_is_found_by_its_own_ids():
    found = open_board("aprilgrid:2x2:30mm:0.5:first=48").detect(aprilgrid(48))
    np.testing.assert_array_equal(found.ids, np.arange(16))
    np.testing.assert_allclose(found.uv[0], [39.5, 339.5], atol=0.2)  # lower left of the first tag
    other = open_board("aprilgrid:2x2:30mm:0.5").detect(aprilgrid(48)).problem
    assert (
        "4 tags of tag36h11 in view have ids 48 to 51, it has 0 to 3: if its ids begin elsewhere, add first=ID" in other
    )


def test_the_first_id_belongs_to_what_the_board_is_called():
    board = open_board(f"{SPEC}:first=10")
    assert open_board(board.body.name).first == 10
    assert board_codes(board) == ("DICT_4X4", range(10, 25))


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        (f"{SPEC}:first=36", "needs 15 tags from id 36 on, and DICT_4X4_50 has 50"),
        (f"{SPEC}:first=-1", "has first=-1 where the id"),
        (f"{SPEC}:last=3", "an option .first=., each once"),
        ("aprilgrid:2x2:30mm:0.5:first=584", "needs 4 tags from id 584 on, and tag36h11 has 587"),
    ],
)
def test_first_ids_that_cannot_be(spec, said):
    with pytest.raises(InputError, match=said):
        open_board(spec)


CHECKER = "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\n"
APRIL = "target_type: 'aprilgrid'\ntagRows: 6\ntagSpacing: 0.3\n"
TARGETS = {
    # kalibr, wiki "calibration targets", with its comments
    "april": (
        "target_type: 'aprilgrid' #gridtype\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3\n",
        "aprilgrid:6x6:88mm:0.3",
    ),
    "checker": (CHECKER + "rowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n", "chessboard:6x7:60mm"),
    "circles": (
        "target_type: 'circlegrid'\ntargetCols: 6\ntargetRows: 7\nspacingMeters: 0.02\nasymmetricGrid: False\n",
        "circles:6x7:20mm",
    ),
    "asymmetric": (
        "target_type: 'circlegrid'\ntargetCols: 3\ntargetRows: 7\nspacingMeters: 2e-2\nasymmetricGrid: True\n",
        "acircles:3x7:20mm",
    ),
    "header": (
        "%YAML:1.0\n---\ntarget_type: aprilgrid\ntagCols: 4\ntagRows: 3\ntagSize: 5e-2\ntagSpacing: .25\n",
        "aprilgrid:4x3:50mm:0.25",
    ),
}


@pytest.mark.parametrize("name", TARGETS)
def test_kalibr_targets_are_boards(tmp_path, name):
    text, spec = TARGETS[name]
    (tmp_path / "target.yaml").write_text(text)
    found, expected = open_target(str(tmp_path / "target.yaml")), open_board(spec)
    np.testing.assert_allclose(found.body.points, expected.body.points, atol=1e-12)
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (CHECKER + "rowSpacingMeters: 0.06\ncolSpacingMeters: 0.05\n", "squares are 50 x 60 mm"),
        (
            "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\n",
            "checkerboard has no rowSpacingMeters; needed are targetCols",
        ),
        (APRIL + "tagCols: 6\ntagSize: 88\n", "tagSize is 88 m; Kalibr's lengths are in metres: is it in mm"),
        (APRIL + "tagCols: 6.5\ntagSize: 0.08\n", "must be whole numbers, got 6.5 and 6"),
        (APRIL + "tagCols: six\ntagSize: 0.08\n", "must be numbers"),
        ("target_type: 'assymetric'\n", "target_type is 'assymetric'; expected Kalibr's target_type, one of aprilgrid"),
        ("cam0:\n  camera_model: pinhole\n", "no target: there are cam0; expected"),
        ("camera_matrix: [[500, 0, 320], [0, 500, 240], [0, 0, 1]]\n", "no target: the calibration of one camera"),
        ("a: [1\n", "line 2: not YAML"),
    ],
)
def test_what_is_no_target(tmp_path, text, said):
    (tmp_path / "target.yaml").write_text(text)
    with one_line("target.yaml", match=said):
        open_target(str(tmp_path / "target.yaml"))
