"""Board files: what a calibration found is read back, and stands for the board in every way."""

import numpy as np
import pytest

from armsight.errors import InputError
from armsight.vision.markers.board import open_board
from armsight.vision.markers.calibrated_board import load_board_file, save_board_file
from armsight.vision.markers.targets import open_body, open_target

SPEC = "chessboard:9x6:25mm"


@pytest.fixture
def file(tmp_path):
    """A board file with a bow of a millimetre, and its points."""
    drawn = open_board(SPEC).body.points
    points = drawn + np.outer(np.sin(20 * drawn[:, 0]), [0.0, 1e-4, 1e-3])
    save_board_file(tmp_path / "rig.board.toml", SPEC, points)
    return tmp_path / "rig.board.toml", points


def test_what_is_written_is_read_back(file):
    path, points = file
    found = load_board_file(path)
    np.testing.assert_allclose(found.body.points, points, atol=5.1e-10)  # written to the nanometre
    drawing = open_board(SPEC)
    assert found.body.point_names == drawing.body.point_names
    assert [s.tolist() for s in found.symmetries] == [s.tolist() for s in drawing.symmetries]
    assert found.discs is None
    assert found.detect(np.zeros((48, 64), np.uint8)).problem == drawing.detect(np.zeros((48, 64), np.uint8)).problem


def test_a_board_file_is_a_target_and_a_body(file):
    path, points = file
    assert open_target(str(path)).body.name == f"{SPEC}, as calibrated"
    np.testing.assert_allclose(open_body(str(path)).points, points, atol=5.1e-10)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"chessboard:9x6', '"chessboard:9x7', r"rig\.board\.toml: points_mm of chessboard:9x7:25mm"),
        ('"chessboard', '"dartboard', r"rig\.board\.toml: unknown board"),
        ('"chessboard:9x6:25mm"', "3", "board must be a spec in quotes"),
        ("version = 2", "version = 3", "version 3; this program reads board files of version 1 to 2"),
        ("points_mm", "points_m", "unknown key 'points_m'"),
        (":25mm", ":25cm", r"point 53 is 2.12e\+03 mm from its position .* are points_mm in mm"),
        ("[0.000000, ", "[nan, ", "finite"),
    ],
)
def test_a_damaged_file_is_reported(file, old, new, said):
    path, _ = file
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=said):
        open_target(str(path))
