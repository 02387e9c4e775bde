"""Bodies that are rejected everywhere; discs that may be taken for others; boards as markers of a body."""

import itertools

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from armsight.data import Detections
from armsight.errors import InputError
from armsight.geometry.pose import transform
from armsight.vision.discs.symmetry import flat, other_side, symmetries
from armsight.vision.markers.board import open_board
from armsight.vision.markers.body_file import read_body_file
from armsight.vision.markers.discs import DiscTarget
from armsight.vision.markers.targets import open_target, read_layout
from asserts import one_line

TRIANGLE = ((-55, 0, 0), (55, 0, 0), (0, 85, 0))


def disc(name, position, *, normal="normal = [0, 0, -1]", radius=8.0):
    return (
        f'[[markers]]\nname = "{name}"\nposition_mm = {list(position)}\n{normal}\ndisc = {{ radius_mm = {radius} }}\n'
    )


def written(tmp_path, positions, more="", **looks):
    path = tmp_path / "plate.toml"
    path.write_text("".join(disc(f"P{i + 1}", p, **looks) for i, p in enumerate(positions)) + more)
    return str(path)


@pytest.mark.parametrize(
    ("positions", "looks", "texts"),
    [
        (TRIANGLE[:1], {}, ["1 disc cannot", "3 or more"]),
        (TRIANGLE[:2], {}, ["2 discs cannot", "3 or more"]),
        (((-55, 0, 0), (0, 0, 0), (65, 0, 0)), {}, ["P1, P2, P3", "one line"]),
        (((-55, 0, 0), (-55, 0, 0), (0, 85, 0)), {}, ["marker 2 (P2)", "same position as P1"]),
        (((-0.055, 0, 0), (0.055, 0, 0), (0, 0.085, 0)), {}, ["(P2)", "0.11 mm from P1", "mm?"]),
        (((-55e3, 0, 0), (55e3, 0, 0), (0, 85e3, 0)), {}, ["(P2)", "110 m from P1", "mm?"]),
        (TRIANGLE, {"radius": 0.0}, ["(P1)", "radius_mm", "0.0"]),
        (TRIANGLE, {"radius": "8, bright = 1"}, ["(P1)", "bright", "true or false"]),
        (TRIANGLE, {"radius": -8.0}, ["(P1)", "radius_mm", "-8.0"]),
        (TRIANGLE, {"radius": 8000.0}, ["(P1)", "8000", "16 m across", "mm?"]),
    ],
)
def test_what_no_body_may_be_is_rejected_when_it_is_opened(tmp_path, positions, looks, texts):
    path = written(tmp_path, positions, **looks)
    for opened in (open_target, read_layout):
        with one_line(*["plate.toml", *texts]):
            opened(path)


def test_five_thousand_discs_are_compared_with_their_neighbours_only(tmp_path):
    positions = np.random.default_rng(0).uniform(-2000, 2000, (5000, 3)).tolist()
    path = tmp_path / "cloud.toml"
    path.write_text("".join(disc(f"P{i}", p, radius=0.1) for i, p in enumerate(positions)))
    target = DiscTarget.from_markers(*read_body_file(path, ("disc",)))
    assert target.radii_m.shape == (5000,)


def test_the_two_faces_of_a_thin_plate_may_share_a_position(tmp_path):
    faces = written(tmp_path, TRIANGLE)
    back = "".join(disc(f"B{i}", (x, y, 1), normal="normal = [0, 0, 1]") for i, (x, y, _) in enumerate(TRIANGLE))
    both = tmp_path / "both.toml"
    both.write_text((tmp_path / "plate.toml").read_text() + back)
    assert len(read_layout(faces).body.points) == 3
    assert len(read_layout(both).body.points) == 6


def rotations_of(points, seen, tolerance, mirrored=False):
    """All ways to take the discs in view for others by trying every one: the slow oracle."""
    found = set()
    a = points[seen] - points[seen].mean(axis=0)
    for taken in itertools.permutations(range(len(points)), len(seen)):
        b = points[list(taken)] - points[list(taken)].mean(axis=0)
        if np.abs(pdist(a) - pdist(b)).max() > tolerance or (list(taken) == list(seen) and not mirrored):
            continue
        # A flat body is its own mirror image; any other is rotated where the linear map of the two has det > 0.
        if np.linalg.matrix_rank(a, 1e-9) == 2 or (np.linalg.det(np.linalg.lstsq(a, b)[0]) < 0) == mirrored:
            found.add(taken)
    return found


def regular(count, radius=0.06):
    angle = 2 * np.pi * np.arange(count) / count
    return radius * np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)


SHAPES = {
    "the published plate": np.array(TRIANGLE) * 1e-3,
    "equilateral": regular(3),
    "square": regular(4),
    "hexagon": regular(6),
    "tetrahedron": np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]]) * 0.04,
    "chiral": np.array([[0, 0, 0], [100, 0, 0], [0, 60, 0], [30, 20, 45], [80, -10, 70]]) * 1e-3,
    "mirror": np.array([[-50, 0, 0], [50, 0, 0], [0, 60, 0], [0, 20, 45.0]]) * 1e-3,
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("hidden", [False, True])
def test_symmetries_are_those_that_trying_everything_finds(name, mirrored, hidden):
    points = Rotation.from_rotvec([0.3, -0.2, 0.9]).apply(SHAPES[name])
    seen = np.arange(len(points))[1:] if hidden and len(points) > 3 else np.arange(len(points))
    alike = np.ones((len(points), len(points)), bool)
    found = symmetries(points, alike, seen, 1e-6, mirrored=mirrored)
    assert {tuple(one.taken_for.tolist()) for one in found} == rotations_of(points, seen, 1e-6, mirrored)
    for one in found:
        source = points * [1, 1, -1] if mirrored else points
        np.testing.assert_allclose(transform(one.T, source[seen]), points[one.taken_for], atol=1e-9)
        assert np.linalg.det(one.T[:3, :3]) == pytest.approx(1.0)


def test_discs_that_look_different_are_not_taken_for_each_other():
    points = regular(3)
    bright = np.array([True, True, False])
    found = symmetries(points, bright[:, None] == bright[None], np.arange(3), 1e-6)
    assert [one.taken_for.tolist() for one in found] == [[1, 0, 2]]


def test_the_tolerance_decides_what_is_alike():
    points = np.array(TRIANGLE) * 1e-3
    alike = np.ones((3, 3), bool)
    off = 0.110 - np.hypot(0.055, 0.085)
    assert len(symmetries(points, alike, np.arange(3), 0.99 * off)) == 1
    found = symmetries(points, alike, np.arange(3), 1.01 * off)
    assert len(found) == 5  # every order of three
    assert found[0].off_m == pytest.approx(0.0, abs=1e-15)
    assert [one.off_m for one in found[1:]] == pytest.approx([off] * 4)


def test_a_symmetry_about_its_axis_shows_the_other_side_and_a_rotation_within_the_plane_does_not():
    alike = np.ones((3, 3), bool)
    for one in symmetries(regular(3), alike, np.arange(3), 1e-6):
        exchanged = (one.taken_for == np.arange(3)).any()
        assert other_side(one, regular(3)) == exchanged
    assert flat(SHAPES["hexagon"], 1e-9)
    assert not flat(SHAPES["mirror"], 1e-3)


BOARD = '[[markers]]\nname = "B"\nposition_mm = [10, 20, 30]\n{rotation}\nboard = {{ spec = "{spec}" }}\n'


def boarded(tmp_path, spec, rotation="normal = [0, 0, -1]\nx_axis = [1, 0, 0]", more=""):
    path = tmp_path / "board.toml"
    path.write_text(BOARD.format(spec=spec, rotation=rotation) + more)
    return str(path)


@pytest.mark.parametrize(
    "spec", ["chessboard:9x6:25.4mm", "charuco:8x5:15mm:11mm:DICT_5X5_100", "aprilgrid:3x2:20mm:0.3"]
)
def test_a_boards_points_sit_where_the_body_file_says(tmp_path, spec):
    # Its face looks along +x, its columns run along +y: so its rows run along +z x ... = x into the face.
    body = open_target(boarded(tmp_path, spec, "normal = [1, 0, 0]\nx_axis = [0, 1, 0]")).body
    board = open_board(spec).body
    assert body.point_names[:2] == ("B.0", "B.1")
    right, into = np.array([0.0, 1, 0]), np.array([-1.0, 0, 0])
    down = np.cross(into, right)
    rows = -down if spec.startswith("aprilgrid") else down  # Kalibr's y runs up
    expected = np.array([0.01, 0.02, 0.03]) + board.points[:, :1] * right + board.points[:, 1:2] * rows
    np.testing.assert_allclose(body.points, expected, atol=1e-12)
    np.testing.assert_allclose(read_layout(str(tmp_path / "board.toml")).normals, [[1.0, 0, 0]] * len(body.points))


def test_a_board_on_a_body_is_found_under_its_names(tmp_path, monkeypatch):
    seen = Detections(np.array([0, 5]), np.array([[1.0, 2], [3, 4]]), np.tile(np.eye(2), (2, 1, 1)))
    image = np.zeros((64, 64), np.uint8)
    two = BOARD.format(spec="charuco:8x5:15mm:11mm:DICT_5X5_100", rotation="quaternion_wxyz = [1, 0, 0, 0]")
    path = boarded(tmp_path, "chessboard:9x6:25mm", more=two.replace('"B"', '"C"'))
    target = open_target(path)
    assert "B: no chessboard" in target.detect(image).problem
    assert "C: no charuco" in target.detect(image).problem
    monkeypatch.setattr(type(target.boards[1].board), "detect", lambda self, image: seen)
    found = target.detect(image)
    assert [target.body.point_names[i] for i in found.ids] == ["C.0", "C.5"]


@pytest.mark.parametrize(
    ("spec", "texts"),
    [
        ("chessboard:8x6:25mm", ["(B)", "same when it is rotated", "9x6", "charuco"]),
        ("circles:4x3:20mm", ["(B)", "same when it is rotated"]),
        ("chessboard:9x6:25", ["(B)", "no unit"]),
        ("chess", ["(B)", "unknown board"]),
    ],
)
def test_a_board_that_cannot_be_named_on_a_body_is_rejected(tmp_path, spec, texts):
    with one_line(*["board.toml", *texts]):
        open_target(boarded(tmp_path, spec))


@pytest.mark.parametrize(
    ("one", "other", "good"),
    [
        ("chessboard:9x6:25mm", "chessboard:7x4:10mm", False),
        ("charuco:8x5:15mm:11mm:DICT_5X5_100", "charuco:4x3:20mm:15mm:5X5_100", False),
        ("charuco:4x3:20mm:15mm:tag36h11", "aprilgrid:3x2:20mm:0.3", False),
        ("charuco:8x5:15mm:11mm:DICT_5X5_100", "charuco:4x3:20mm:15mm:4X4_50", True),
        ("chessboard:9x6:25mm", "aprilgrid:3x2:20mm:0.3", True),
    ],
)
def test_two_boards_of_a_body_that_look_alike_are_rejected(tmp_path, one, other, good):
    more = BOARD.format(spec=other, rotation="quaternion_wxyz = [1, 0, 0, 0]").replace('"B"', '"C"')
    path = boarded(tmp_path, one, more=more)
    if good:
        assert len(open_target(path).boards) == 2
    else:
        with pytest.raises(InputError, match=r"marker 2 \(C\).*may be taken for 'B'"):
            open_target(path)


def test_a_tag_that_is_on_a_board_too_is_rejected(tmp_path):
    tag = (
        '[[markers]]\nname = "T"\nposition_mm = [200, 0, 0]\nnormal = [0, 0, -1]\nx_axis = [1, 0, 0]\n'
        'tag = { family = "tag36h11", id = 5, size_mm = 40 }\n'
    )
    for opened in (open_target, read_layout):
        for board in ("aprilgrid:3x2:20mm:0.3", "charuco:4x3:20mm:15mm:DICT_APRILTAG_36h11"):
            with pytest.raises(InputError, match=r"marker 2 \(T\).*id 5.*'B'"):
                opened(boarded(tmp_path, board, more=tag))
            opened(boarded(tmp_path, board, more=tag.replace("id = 5", "id = 6")))
