"""The main jobs on real recordings, with the figures that are written down for them."""

import json

import numpy as np
import pytest

from armsight.data import Missed, PoseEstimate
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.bodies import calibrate_bodies
from armsight.vision.calibrate.heldout import pair_errors, summary
from armsight.vision.camera_file import read_cameras
from armsight.vision.detections import read_detections
from armsight.vision.image import grey, read_image
from armsight.vision.markers.board import open_board
from armsight.vision.markers.body_file import load_body_csv
from armsight.vision.match import join
from armsight.vision.pose.bundle import Observations
from armsight.vision.pose.measure import measure_seen
from cli_runs import run


def folder_of(data_dir, *names):
    path = data_dir.joinpath(*names)
    if not path.is_dir():
        pytest.skip(f"no recording at {path}")
    return path


@pytest.mark.parametrize(
    ("name", "epipolar_px", "rigid_m"), [("opencv-480p", 0.11, 0.30e-3), ("stereopi-240p", 0.06, None)]
)
def test_a_rig_fitted_on_even_pairs_measures_the_odd_ones(data_dir, name, epipolar_px, rigid_m):
    folder, board = folder_of(data_dir, "stereo", name), open_board("chessboard:9x6:25mm")
    pairs = []
    for left in sorted(folder.glob("left*")):
        images = [grey(read_image(path)) for path in (left, folder / left.name.replace("left", "right"))]
        pairs.append(Pair(left.stem, *(board.detect(image) for image in images)))
    h, w = images[0].shape
    c = calibrate_boards(board, pairs[::2], ((w, h), (w, h)), models=("brown4", "brown5"), folds=2)
    seen = [join(p.left, p.right) for p in pairs[1::2] if p.left.problem is None and p.right.problem is None]
    assert len(seen) >= len(pairs) // 2 - 1
    errors = summary(pair_errors(c.rig, board.body.points, Observations.from_shots(seen)), 1)
    assert errors.epipolar_rms_px < epipolar_px
    assert rigid_m is None or errors.rigid_rms_m < rigid_m


def test_no_shot_of_the_motoman_is_dropped_silently(data_dir, tmp_path, capsys):
    folder = folder_of(data_dir, "arm", "motoman", "right_hand_6x6x6")
    body, cameras = load_body_csv(folder / "markers.csv"), read_cameras(folder / "cameras.json")
    shots = [s for s in read_detections(folder / "detections.csv", body) if len(np.intersect1d(*s.ids)) >= 3]
    assert len(shots) == 43
    rig = calibrate_bodies(body, [s for s in shots if int(s.name) % 2 == 0], cameras).rig
    rig.save(tmp_path / "rig.json")
    results = {s.name: measure_seen(rig, body, s) for s in shots if int(s.name) % 2}
    assert all(isinstance(r, PoseEstimate) or (isinstance(r, Missed) and r.reason) for r in results.values())
    assert all(isinstance(r, PoseEstimate) for r in results.values())
    capsys.readouterr()
    arguments = ["--target", folder / "markers.csv", "--source", f"detections:{folder}/detections.csv", "--json"]
    assert run("measure", tmp_path / "rig.json", *arguments) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    every = read_detections(folder / "detections.csv", body)
    assert [line["shot"] for line in lines] == [s.name for s in every]
    assert all(line["reason"] for line in lines if line["status"] == "missed")
    said = {line["shot"]: line for line in lines}
    for name, result in results.items():
        assert said[name]["position_m"] == pytest.approx(result.T_left_body[:3, 3], abs=1e-12)
