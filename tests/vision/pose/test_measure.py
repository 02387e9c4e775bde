from dataclasses import replace

import numpy as np
import pytest

from armsight.data import Detections, Missed, PoseEstimate, Shot
from armsight.geometry.pose import inverse, log_se3, pose, transform
from armsight.sim.example_rig import example_rig
from armsight.vision.detections import SeenShot
from armsight.vision.discs.bias import project_discs
from armsight.vision.markers.board import open_board
from armsight.vision.markers.marker import Target
from armsight.vision.match import renamed
from armsight.vision.pose.measure import measure, measure_detections, measure_seen, size_problem
from board_views import SIZE, board_pairs, detections, rig_and_board

SIGMA = 0.1


class Scripted(Target):
    """A target that says it detects what the test asks for."""

    def __init__(self, body, left, right, symmetries=(), radius_m=None):
        self._body, self._symmetries, self._rest = body, symmetries, [left, right]
        self._radius_m = radius_m

    @property
    def body(self):
        return self._body

    @property
    def symmetries(self):
        return self._symmetries

    @property
    def disc_radius_m(self):
        return self._radius_m

    def detect(self, image):
        return self._rest.pop(0)


def known(spec="chessboard:9x6:25mm"):
    """A true rig that knows the detector's noise, the board, one pose and what is seen of it."""
    rig, board, Ts = rig_and_board(spec=spec)
    rig = replace(rig, sigma_px=SIGMA)
    (pair,) = board_pairs(rig, board.body.points, Ts[:1], sigma=SIGMA)
    return rig, board, Ts[0], pair


def grey_shot(width=SIZE[0]):
    return Shot("s", *(np.full((SIZE[1], width), 80, np.uint8) for _ in "lr"))


def test_a_shot_without_images_is_missed_with_its_reason():
    rig, board, _, pair = known()
    target = Scripted(board.body, pair.left, pair.right)
    assert measure(rig, target, Shot("s", None, None, problem="unplugged")).reason == "unplugged"
    assert measure(rig, target, Shot("s", None, None)).reason == "no image"
    wrong = measure(rig, target, grey_shot(width=320))
    assert "the left image is 320x360" in wrong.reason
    assert size_problem(SIZE, np.zeros((360, 640, 3)), "left") is None


def test_what_was_not_detected_is_named_by_side():
    rig, board, _, pair = known()
    nothing = Detections.none("no board")
    assert measure(rig, Scripted(board.body, nothing, pair.right), grey_shot()).reason == "left: no board"
    assert measure(rig, Scripted(board.body, nothing, nothing), grey_shot()).reason == "left: no board; right: no board"


def test_images_in_the_dark_are_named():
    rig, board, _, pair = known()
    nothing = Detections.none("no board")
    night = replace(grey_shot(), right=np.full(SIZE[::-1], 5, np.uint8))
    missed = measure(rig, Scripted(board.body, pair.left, nothing), night)
    assert isinstance(missed, Missed)
    assert missed.reason.startswith("right: no board; right: the image is dark")
    assert "left" not in missed.reason


@pytest.mark.parametrize(
    ("given_mm", "radius_px", "moved_px", "right"),
    [
        (38.0, 30.0, 0.0, True),
        (44.5, 30.0, 0.0, False),
        (48.0, 4.5, 0.0, False),
        (52.0, 3.0, 0.0, False),
        (40.0, 4.5, 0.65, True),  # a rim that blur and a tone curve moved
        (40.0, 3.0, -0.65, True),
    ],
)
def test_a_given_radius_of_discs_that_contradicts_the_images_names_both(given_mm, radius_px, moved_px, right):
    """Discs of 40 mm, radius_px in the images."""
    rig, T = example_rig(SIZE, focal_px=300.0), pose(np.eye(3), np.array([-0.1, -0.1, 12.0 / radius_px]))
    board = open_board(f"circles:4x3:120mm:radius={given_mm}mm")
    points, seen = board.body.points, []
    for camera, T_camera in zip(rig.cameras, (T, inverse(rig.T_left_right) @ T), strict=True):
        normals = np.tile(T_camera[:3, 2], (len(points), 1))
        uv, shape, _, _ = project_discs(camera, transform(T_camera, points), normals, np.full(len(points), 0.04))
        shape *= (1 + moved_px / radius_px) ** 2
        seen.append(Detections(np.arange(len(points)), uv, np.tile(1e-4 * np.eye(2), (len(points), 1, 1)), shape=shape))
    result = measure(rig, Scripted(board.body, *seen, radius_m=board.disc_radius_m), grey_shot())
    assert isinstance(result, PoseEstimate) is right
    assert right or f"a radius of {given_mm:.4g} mm is given, and the images show 40" in result.reason


def test_exchanged_cameras_are_reported():
    rig, board, _, pair = known()
    exchanged = measure_detections(rig, board.body, pair.right, pair.left)
    assert isinstance(exchanged, Missed)
    assert exchanged.reason.startswith("left and right are exchanged")


def test_detections_of_nothing_are_not_called_exchanged():
    rig, board, _, pair = known()
    rng = np.random.default_rng(3)
    left, right = (detections(pair.left.ids, rng.uniform(0, 360, pair.left.uv.shape)) for _ in "lr")
    result = measure_detections(rig, board.body, left, right)
    assert isinstance(result, Missed)
    assert "exchanged" not in result.reason


def test_a_symmetric_board_read_from_the_other_end_is_measured_all_the_same():
    rig, board, T, pair = known("chessboard:9x7:25mm")
    straight = measure_detections(rig, board.body, pair.left, pair.right, symmetries=board.symmetries)
    rotated = measure_detections(
        rig, board.body, pair.left, renamed(pair.right, board.symmetries[0]), symmetries=board.symmetries
    )
    assert rotated.T_left_body == pytest.approx(straight.T_left_body, abs=1e-12)
    assert np.linalg.norm(rotated.T_left_body[:3, 3] - T[:3, 3]) < 5 * np.sqrt(np.trace(rotated.cov[:3, :3]))


def test_one_wrong_point_is_dropped_by_name_and_changes_little():
    rig, board, _, pair = known()
    uv = np.array(pair.right.uv)
    uv[20] += (25.0, 0.3)  # along the epipolar line, where the gate is blind
    uv[31] += (0.0, 25.0)  # across it
    best = measure_detections(rig, board.body, pair.left, pair.right)
    spoilt = measure_detections(rig, board.body, pair.left, detections(pair.right.ids, uv))
    assert {d.point for d in spoilt.dropped} == {board.body.point_names[i] for i in (20, 31)}
    gap = log_se3(inverse(best.T_left_body) @ spoilt.T_left_body)
    # Without 2 of 54 points the estimate moves by about sqrt(2 / 52) of its own sigma; three times that.
    assert gap @ np.linalg.solve(best.cov, gap) < 9 * 6 * 2 / 52


def test_detections_of_a_file_are_measured_as_those_of_images():
    rig, board, _, pair = known()
    order = np.random.default_rng(0).permutation(54)
    shot = SeenShot("1", (pair.left.ids[order], pair.right.ids), (pair.left.uv[order], pair.right.uv))
    from_file, from_images = (
        measure_seen(rig, board.body, shot),
        measure_detections(rig, board.body, pair.left, pair.right),
    )
    assert from_file.T_left_body == pytest.approx(from_images.T_left_body, abs=1e-12)


def test_markers_that_stand_twice_and_agree_with_nothing_are_a_miss():
    rig, board, _, _ = known()
    rng = np.random.default_rng(2)
    ids = np.array([7, 7, 40, 40])
    shot = SeenShot("1", (ids, ids), tuple(rng.uniform(0, 360, (4, 2)) for _ in "lr"))
    assert "occur twice" in measure_seen(rig, board.body, shot).reason
