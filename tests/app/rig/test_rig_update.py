"""armsight rig update: a run's folder in, a new rig and a page out; what is rejected leaves nothing behind."""

import json

import numpy as np
import pytest

from armsight.data import Correspondences
from armsight.sim.workcell.body import body_text
from armsight.vision.detections import detection_times, detections_text, read_detections
from armsight.vision.rig import StereoRig
from moved_rig import BODY, calibrated, moved, shots_of


def found_since(folder, since_s):
    (folder / "summary.json").write_text(json.dumps({"health": [{"cause": "rig", "since_s": since_s}]}))


@pytest.fixture
def run_folder(tmp_path):
    """A run in which the right camera is rotated by 0.1 deg from 5 s on."""
    rng = np.random.default_rng(7)
    folder = tmp_path / "run"
    folder.mkdir()
    calibrated(rng).save(folder / "rig.json")
    (folder / "body.toml").write_text(body_text())
    xi = np.array([0.0, 0.0, 0.0, 0.0, np.radians(0.1), 0.0])
    shots = [*shots_of(rng, moved(np.zeros(6)), 10), *shots_of(rng, moved(xi), 30)]
    covs = np.zeros((len(BODY.points), 2, 2, 2))
    rows = [
        (f"shot{k}", 0.5 * k, Correspondences(shot.ids[0], np.stack(shot.uv, axis=1), covs))
        for k, shot in enumerate(shots)
    ]
    (folder / "detections.csv").write_text(detections_text(rows, BODY))
    found_since(folder, 5.0)
    return folder


def test_a_written_file_of_detections_reads_back(run_folder):
    shots = read_detections(run_folder / "detections.csv", BODY)
    assert len(shots) == 40
    times = detection_times(run_folder / "detections.csv")
    assert times[shots[7].name] == 3.5


def test_the_rotation_since_the_finding_is_put_right(armsight, run_folder, tmp_path):
    done = armsight("rig", "update", run_folder, "-o", tmp_path / "rig2.json", "--report", tmp_path / "page", "--json")
    found = json.loads(done.out)
    assert (found["since_s"], found["shots"]) == (5.0, 30)
    assert found["rotation_changed_deg"] == pytest.approx(0.1, abs=0.006)
    # The error of the calibration stays: what changed is estimated, with the shots from before.
    assert found["epipolar_rms_after_px"] <= 1.2 * found["epipolar_rms_before_px"]
    assert found["rotation_sigma_deg"] < 0.003
    assert list(found["depth_error_of_old_rig_m"]) == ["0.5", "1", "2"]
    assert StereoRig.load(tmp_path / "rig2.json").cov.any()
    assert "Old and new rig" in (tmp_path / "page" / "report.html").read_text()
    shown = armsight("rig", "update", run_folder, "-o", tmp_path / "rig3.json", "--since", "5").out
    assert "right camera: rotated by" in shown


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda run: (run / "detections.csv").unlink(), "detections.csv: no such file"),
        (lambda run: found_since(run, 17.0), "are needed"),
        (lambda run: found_since(run, 99), "no shot from 99 s on"),
    ],
)
def test_what_cannot_be_updated_is_rejected_and_nothing_written(armsight, run_folder, tmp_path, change, expected):
    change(run_folder)
    done = armsight("rig", "update", run_folder, "-o", tmp_path / "rig2.json")
    assert done.code == 2
    assert expected in done.err
    assert not (tmp_path / "rig2.json").exists()


def test_the_run_s_own_rig_is_not_overwritten(armsight, run_folder):
    assert armsight("rig", "update", run_folder, "-o", run_folder / "rig.json").code == 2
