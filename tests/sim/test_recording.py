"""Recordings: their files, their truth, and that OpenCV finds the board where the truth says it is."""

import json

import cv2
import numpy as np
import pytest

from armsight.errors import InputError
from armsight.geometry.pose import exp_se3, inverse, log_se3, transform
from armsight.sim.example_rig import board_poses, demo_recording, example_rig, in_view, path, tag_plate
from armsight.sim.recording import Look, Truth, record, shot_names
from armsight.sim.render.scene import aprilgrid, chessboard
from armsight.vision.sources.folder import FolderSource


@pytest.fixture(scope="module")
def rig():
    return example_rig((640, 360), 450.0)


@pytest.fixture(scope="module")
def board():
    return chessboard(9, 6, 0.025)


@pytest.fixture(scope="module")
def recording(tmp_path_factory, rig, board):
    folder = tmp_path_factory.mktemp("recording")
    Ts = board_poses(np.random.default_rng(4), rig, board, 4)
    truth = Truth(rig, "chessboard:9x6:25mm", shot_names(4), np.arange(4.0), Ts)
    record(folder, truth, [board], seed=7)
    return folder, truth


def test_truth_comes_back(recording):
    folder, truth = recording
    back = Truth.load(folder)
    assert (back.target, back.shots) == (truth.target, truth.shots)
    np.testing.assert_array_equal(back.Ts_left_body, truth.Ts_left_body)
    np.testing.assert_array_equal(back.times_s, truth.times_s)
    np.testing.assert_array_equal(back.rig.T_left_right, truth.rig.T_left_right)
    np.testing.assert_array_equal(back.rig.left.parameters, truth.rig.left.parameters)


def test_a_recording_is_a_source(recording):
    folder, truth = recording
    source = FolderSource.open(folder)
    shots = [source.read() for _ in truth.shots]
    assert source.read() is None
    assert [shot.name for shot in shots] == list(truth.shots)
    assert [shot.t_s for shot in shots] == truth.times_s.tolist()
    assert all(shot.left.shape == shot.right.shape == (360, 640) for shot in shots)


@pytest.mark.opencv
def test_opencv_puts_the_corners_where_they_are(recording):
    """Noise of 2 grey levels on a contrast of 190 moves cornerSubPix by 0.025 px, the mean of 54 by a seventh of it."""
    folder, truth = recording
    y, x = np.mgrid[:6, :9]
    points = np.stack([x.ravel() * 0.025, y.ravel() * 0.025, np.zeros(54)], axis=1)
    T_right_left = inverse(truth.rig.T_left_right)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-5)
    for shot, T in zip(truth.shots, truth.Ts_left_body, strict=True):
        for side, camera, T_camera_body in (("left", truth.rig.left, T), ("right", truth.rig.right, T_right_left @ T)):
            image = cv2.imread(str(folder / f"{side}{shot}.png"), cv2.IMREAD_GRAYSCALE)
            true = camera.project(transform(T_camera_body, points))
            start = (true + np.array([0.8, -0.6])).astype(np.float32).reshape(-1, 1, 2)
            error = cv2.cornerSubPix(image, start, (4, 4), (-1, -1), stop).reshape(-1, 2) - true
            assert np.sqrt(np.mean(error**2)) < 0.04
            assert np.abs(error.mean(axis=0)).max() < 0.012


def test_the_images_depend_on_the_seed_and_not_on_the_threads(tmp_path, rig, board):
    truth = Truth(rig, "chessboard:9x6:25mm", ("a",), np.zeros(1), board_poses(np.random.default_rng(0), rig, board, 1))
    for name, threads, seed in (("one", 1, 0), ("two", 2, 0), ("other", 1, 1)):
        record(tmp_path / name, truth, [board], look=Look(background="plain"), seed=seed, threads=threads)
    one, two, other = ((tmp_path / name / "righta.png").read_bytes() for name in ("one", "two", "other"))
    assert one == two
    assert one != other


@pytest.mark.parametrize("make", [lambda: chessboard(9, 6, 0.025), lambda: aprilgrid(5, 4, 0.04, 0.3)])
@pytest.mark.parametrize("model", ["none", "brown4", "brown5", "fisheye"])
def test_board_poses_are_in_view_spread_and_tilted(make, model):
    pattern, rig = make(), example_rig(model=model)
    Ts = board_poses(np.random.default_rng(1), rig, pattern, 24)
    assert in_view(rig, Ts @ pattern.T_body_pattern, pattern).all()
    middles = rig.left.project(Ts[:, :3, 3])
    assert (np.ptp(middles, axis=0) > np.array([0.4, 0.4]) * rig.left.image_size_px).all()
    slants = np.degrees(np.arccos(np.abs(Ts[:, 2, 2])))
    assert slants.max() > 35
    assert slants.min() < 15
    assert Ts[:, 2, 3].max() > 1.4 * Ts[:, 2, 3].min()


def test_a_board_that_is_in_view_of_neither_is_rejected():
    with pytest.raises(InputError, match="no pose of the board"):
        board_poses(np.random.default_rng(0), example_rig(convergence_deg=100.0), chessboard(9, 6, 0.025), 1)


def test_a_path_stays_in_view_and_knows_its_velocity(rig):
    patterns, _ = tag_plate()
    times = np.arange(0, 6, 0.05)
    Ts, twists = path(rig, patterns, times)
    assert all(in_view(rig, Ts @ p.T_body_pattern, p).all() for p in patterns)
    later, _ = path(rig, patterns, times + 1e-3)
    np.testing.assert_allclose(log_se3(inverse(Ts) @ later) / 1e-3, twists, atol=2e-3)
    np.testing.assert_allclose(Ts[1:], Ts[:-1] @ exp_se3(0.025 * (twists[1:] + twists[:-1])), atol=2e-4)


def test_the_example_rig_is_what_it_says():
    rig = example_rig(baseline_m=0.22, convergence_deg=5.0)
    assert rig.baseline_m == pytest.approx(0.22)
    assert rig.convergence_deg == pytest.approx(5.0, abs=0.1)
    assert rig.T_left_right[0, 2] < 0  # the right camera looks towards the left one's axis
    with pytest.raises(InputError, match="brown7"):
        example_rig(model="brown7")


def test_the_demo_makes_two_recordings_and_a_body(tmp_path):
    board, arm = demo_recording(tmp_path, image_size_px=(480, 270), boards=2, shots=3)
    assert (tmp_path / "plate.toml").read_text().count("[[markers]]") == 4
    assert len(list((tmp_path / "board").glob("left*.png"))) == len(board.shots) == 2
    assert len(list((tmp_path / "arm").glob("right*.png"))) == len(arm.shots) == 3
    assert Truth.load(tmp_path / "arm").times_s[1] == pytest.approx(1 / 15)


def test_a_truth_that_is_none_is_rejected_by_name(tmp_path, recording):
    with pytest.raises(InputError, match=r"truth\.json: no such file"):
        Truth.load(tmp_path)
    good = json.loads((recording[0] / "truth.json").read_text())
    (tmp_path / "truth_rig.json").write_text((recording[0] / "truth_rig.json").read_text())
    for bad in ("", "[]", '{"format": "x"}', json.dumps(good | {"version": 2}), json.dumps(good | {"shots": [{}]})):
        (tmp_path / "truth.json").write_text(bad)
        with pytest.raises(InputError, match=r"truth\.json"):
            Truth.load(tmp_path)


def test_a_folder_that_cannot_be_made_is_reported(tmp_path, recording, board):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        record(tmp_path / "file" / "below", recording[1], [board])
