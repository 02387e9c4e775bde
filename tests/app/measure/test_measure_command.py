import csv
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from armsight.app.measure.run import MeasureRun
from armsight.app.measure.shots import _detected, board_notes, reversed_notes
from armsight.files import read_table
from armsight.geometry.pose import exp_se3, inverse, log_se3, pose, transform
from armsight.sim.render.render import render
from armsight.sim.render.scene import PosedBody, chessboard
from armsight.vision.markers.body_file import save_body_csv
from armsight.vision.markers.calibrated_board import save_board_file
from armsight.vision.markers.targets import open_body, open_target
from armsight.vision.pose.shot_pose import CSV_COLUMNS
from armsight.vision.rig import StereoRig
from cli_runs import assert_has, assert_rejected

KEYS = {
    "shot", "status", "reason", "t_s", "position_m", "quaternion_wxyz", "euler_zyx_deg", "covariance",
    "residual_rms_m", "reprojection_rms_px", "points_m",
}  # fmt: skip


@pytest.fixture(scope="module")
def measured(rendered, tmp_path_factory):
    """The arm's recording measured once, as a program reads it: JSON lines and the CSV."""
    out = tmp_path_factory.mktemp("measured") / "poses.csv"
    script = "from armsight.app.main import main; main()"
    arguments = [
        "measure",
        rendered.rig,
        "--target",
        rendered.plate,
        "--source",
        rendered.folder / "arm",
        "--json",
        "-o",
        out,
    ]
    done = subprocess.run([sys.executable, "-c", script, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

    def reject(text):
        raise AssertionError(f"{text} is not JSON")

    records = [json.loads(line, parse_constant=reject) for line in done.stdout.splitlines()]
    with open(out, newline="", encoding="utf-8") as file:
        return records, list(csv.DictReader(file)), done.stderr


def test_a_reader_that_leaves_does_not_cut_the_file(rendered, measured, tmp_path):
    """As with ``| head``: what is printed goes nowhere, the file has every shot."""
    script, out = "from armsight.app.main import main; main()", tmp_path / "poses.csv"
    arguments = ["measure", rendered.rig, "--target", rendered.plate, "--source", rendered.folder / "arm", "-o", out]
    process = subprocess.Popen(
        [sys.executable, "-c", script, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    _, said = process.communicate()
    assert process.returncode == 0, said
    with open(out, newline="", encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(measured[1]) > 3


#: What no pair needs, and a process that measures one would wait for.
SLOW = ("scipy", "numpy.ma", "matplotlib", "pyarrow", "zenoh", "yaml", "sqlite3", "tempfile", "hashlib", "html")
SLOW_OURS = ("sim", "robot.kinematics.arm", "loop.estimators.kalman", "loop.references", "app.stream.cell_file")


@pytest.mark.parametrize("of", ["board", "arm"])
def test_a_measure_of_one_pair_imports_nothing_slow(rendered, of):
    left, right = (min(rendered.folder.glob(f"{of}/{side}*.png")) for side in ("left", "right"))
    target = rendered.plate if of == "arm" else rendered.board[-1]
    missing = (*SLOW, *(f"armsight.{name}" for name in SLOW_OURS))
    code = f"import sys; sys.modules.update(dict.fromkeys({missing})); from armsight.app.main import main; main()"
    arguments = ["measure", rendered.rig, "--target", target, "--source", f"pairs:{left},{right}"]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def tangents(rendered, records):
    """Errors (N, 6) and covariances (N, 6, 6) in the body's axes."""
    errors, covs = [], []
    for record, true in zip(records, rendered.of_arm.Ts_left_body, strict=True):
        w, x, y, z = record["quaternion_wxyz"]
        T = pose(Rotation.from_quat([x, y, z, w]).as_matrix(), np.array(record["position_m"]))
        errors.append(log_se3(inverse(T) @ true))
        covs.append(record["covariance_body"])
    return np.array(errors), np.array(covs)


@pytest.mark.opencv
def test_every_shot_is_measured_within_its_uncertainty(rendered, measured):
    records, _, complained = measured
    assert [r["shot"] for r in records] == list(rendered.of_arm.shots)
    assert {r["status"] for r in records} == {"ok"}
    assert "measured 16 of 16 shots" in complained
    errors, covs = tangents(rendered, records)
    sigma = np.sqrt(np.einsum("nii->ni", covs))
    assert (np.abs(errors) < 4 * sigma).all(), np.abs(errors / sigma).max(axis=0)
    nees = np.array([e @ np.linalg.solve(c, e) for e, c in zip(errors, covs, strict=True)])
    # The calibration's share is common to all shots, so they are fewer than 16 independent samples: the band is that of
    # one shot in a thousand below and above for four.
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 6 * 4) / 4
    assert low < nees.mean() < high, nees


def test_a_record_has_what_was_promised(rendered, measured):
    body = open_body(str(rendered.plate))
    for record in measured[0]:
        assert set(record) >= KEYS
        assert record["reason"] is None
        assert np.shape(record["covariance"]) == np.shape(record["covariance_body"]) == (6, 6)
        assert np.linalg.norm(record["quaternion_wxyz"]) == pytest.approx(1, abs=1e-12)
        assert set(record["points_m"]) <= set(body.point_names)
        assert len(record["points_m"]) + len(record["dropped"]) >= 3
        w, x, y, z = record["quaternion_wxyz"]
        R = Rotation.from_quat([x, y, z, w]).as_matrix()
        by_angles = Rotation.from_euler("ZYX", record["euler_zyx_deg"], degrees=True).as_matrix()
        assert pytest.approx(by_angles, abs=1e-12) == R


def test_the_covariance_is_that_of_the_body_rotated_to_the_left_cameras_axes(measured):
    for record in measured[0]:
        w, x, y, z = record["quaternion_wxyz"]
        both = block_diag(*[Rotation.from_quat([x, y, z, w]).as_matrix()] * 2)
        body, left = np.array(record["covariance_body"]), np.array(record["covariance"])
        assert left == pytest.approx(both @ body @ both.T, abs=1e-12 * np.trace(body))
        assert (np.linalg.eigvalsh(left) > 0).all()


def test_the_csv_says_the_same(measured):
    records, rows, _ = measured
    assert tuple(rows[0]) == CSV_COLUMNS
    for record, row in zip(records, rows, strict=True):
        assert (row["shot"], row["status"], row["reason"]) == (record["shot"], "ok", "")
        said = [record["t_s"], *record["position_m"], *record["quaternion_wxyz"], *record["euler_zyx_deg"]]
        names = ["t_s", "x_m", "y_m", "z_m", "qw", "qx", "qy", "qz", "euler_z_deg", "euler_y_deg", "euler_x_deg"]
        assert [float(row[name]) for name in names] == said
        cov = np.array(record["covariance"])
        for i in range(6):
            for j in range(i, 6):
                assert float(row[f"cov_{i}{j}"]) == cov[i, j]
        sigmas = [float(row[f"sigma_{a}"]) for a in ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")]
        assert sigmas == pytest.approx(np.sqrt(np.diag(cov)), rel=1e-15)
        shares = [np.array(record[f"covariance_{share}"]) for share in ("precision", "calibration")]
        assert sum(shares) == pytest.approx(cov, abs=1e-15)
        for share, part in zip(("precision", "calibration"), shares, strict=True):
            assert (np.linalg.eigvalsh(part) > -1e-9 * np.trace(part)).all()
            assert float(row[f"sigma_{share}_z_m"]) == pytest.approx(np.sqrt(part[2, 2]), rel=1e-12)
            assert float(row[f"sigma_{share}_rz_rad"]) == pytest.approx(np.sqrt(part[5, 5]), rel=1e-12)
        assert float(row["residual_rms_m"]) == record["residual_rms_m"]
        assert float(row["reprojection_rms_px"]) == record["reprojection_rms_px"]
        assert int(row["points"]) == len(record["points_m"])


@pytest.fixture
def arm(rendered, tmp_path):
    """A folder of its own with three shots of the arm, to be spoilt."""
    folder = tmp_path / "arm"
    folder.mkdir()
    for n in (0, 5, 10):
        for side in ("left", "right"):
            shutil.copy(rendered.folder / "arm" / f"{side}{n:03d}.png", folder)
    return folder


@pytest.fixture
def start(rendered):
    """How every measurement of the arm begins."""
    return "measure", rendered.rig, "--target", rendered.plate


def images(folder):
    return "--source", f"pairs:{folder}/left*.png,{folder}/right*.png"


def test_people_read_millimetres_and_a_sigma(start, arm, armsight):
    said = armsight(*start, *images(arm)).done()
    head, *lines = said.out.splitlines()
    names = "shot x mm ± y mm ± z mm ± rz deg ry deg rx deg ± prec. pts"
    assert head.split() == names.split()
    assert [line.split()[0] for line in lines] == ["left000", "left005", "left010"]
    assert max(map(len, said.out.splitlines())) <= 100
    for line, shot in zip(
        lines, map(json.loads, armsight(*start, *images(arm), "--json").out.splitlines()), strict=True
    ):
        sigma = np.sqrt(np.diag(shot["covariance"]))
        expected = [
            *(1e3 * v for pair in zip(shot["position_m"], sigma, strict=False) for v in pair),
            *shot["euler_zyx_deg"],
            np.degrees(np.linalg.norm(sigma[3:])),
            1e3 * np.sqrt(np.trace(np.array(shot["covariance_precision"])[:3, :3])),
            len(shot["points_m"]),
        ]
        np.testing.assert_allclose([float(word) for word in line.split()[1:]], expected, atol=5.1e-4)
    assert said.err.startswith("measured 3 of 3 shots")


@pytest.mark.opencv
def test_a_board_is_a_target(rendered, armsight):
    said = armsight(
        "measure", rendered.rig, "--target", "chessboard:9x6:25mm", *rendered.images("board"), "--json"
    ).done()
    for record, true in zip(said.lines, rendered.of_board.Ts_left_body, strict=True):
        gap = np.array(record["position_m"]) - true[:3, 3]
        assert gap @ np.linalg.solve(np.array(record["covariance"])[:3, :3], gap) < chi2.ppf(1 - 1e-5, 3)


# Bad input, one by one.


@pytest.mark.parametrize("what", ["missing", "truncated", "garbage", "another size"])
def test_a_shot_that_cannot_be_read_is_missed_and_the_rest_measured(start, arm, armsight, tmp_path, what):
    path = arm / "right005.png"
    if what == "missing":
        path.unlink()
        path.mkdir()  # the name is there, a file is not: a glob of files does not see it
        assert_rejected(armsight(*start, *images(arm)), "do not pair up")
        return
    if what == "another size":
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (320, 180)))
    else:
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2] if what == "truncated" else b"garbage")
    said = armsight(*start, *images(arm), "--json", "-o", tmp_path / "poses.csv").done()
    records = said.lines
    assert [r["status"] for r in records] == ["ok", "missed", "ok"]
    assert set(records[1]) == {"shot", "t_s", "status", "reason"}
    assert ("320x180" if what == "another size" else "right005.png") in records[1]["reason"]
    assert "1 missed" in said.err
    with open(tmp_path / "poses.csv", newline="", encoding="utf-8") as file:
        assert [row["status"] for row in csv.DictReader(file)] == ["ok", "missed", "ok"]


def test_nothing_in_view_is_an_error_after_its_lines(start, tmp_path, armsight):
    for name in [f"{side}{k}" for side in ("left", "right") for k in range(4)]:
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((360, 640), 90, np.uint8))
    said = armsight(*start, *images(tmp_path))
    assert said.code == 2
    assert len(said.out.splitlines()) == 2
    assert said.out.startswith("left0: missed: ")
    assert said.out.splitlines()[1] == "left1 to left3: missed: for the same reason (3 in all)"
    assert len(said.err.splitlines()) == 1
    assert "none of 4 shots could be measured" in said.err


@pytest.mark.parametrize(
    ("code", "sides", "what"),
    [
        (-1, ("left", "right"), "images are rotated by 180 degrees"),
        (-1, ("right",), "right images are rotated by 180 degrees"),
        (1, ("left", "right"), "images are mirrored"),
        (0, ("left", "right"), "images are upside down and mirrored"),
    ],
)
def test_images_that_a_driver_flipped_are_named(start, arm, armsight, tmp_path, code, sides, what):
    for side in ("left", "right"):
        image = cv2.imread(str(next(arm.glob(f"{side}*.png"))), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / f"{side}0.png"), cv2.flip(image, code) if side in sides else image)
    said = armsight(*start, "--source", f"pairs:{tmp_path}/left*.png,{tmp_path}/right*.png")
    assert said.code == 2
    assert f"none of 1 shots could be measured: the {what} against those of the calibration" in said.err


def test_a_print_of_the_other_polarity_is_named(start, arm, armsight, tmp_path):
    for side in ("left", "right"):
        image = cv2.imread(str(next(arm.glob(f"{side}*.png"))), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / f"{side}0.png"), 255 - image)
    said = armsight(*start, "--source", f"pairs:{tmp_path}/left*.png,{tmp_path}/right*.png")
    assert said.code == 2
    assert "none of 1 shots could be measured: it is in view inverted" in said.err


def test_left_and_right_exchanged_is_the_reason(start, arm, armsight):
    said = armsight(*start, "--source", f"pairs:{arm}/right00[0-3].png,{arm}/left00[0-3].png", "--json")
    assert said.code == 2
    assert all("left and right are exchanged" in record["reason"] for record in said.lines)
    assert "left and right are exchanged" in said.err
    assert "rotated" not in said.err  # which parallel cameras' images nearly are, too


@pytest.mark.parametrize("target", ["", "plate", "nowhere.toml", "nowhere.csv", "chessboard:9x6", "tag:1:2"])
def test_a_target_that_is_none(rendered, arm, armsight, target):
    assert_rejected(armsight("measure", rendered.rig, "--target", target, *images(arm)))


def test_a_csv_body_cannot_be_found_in_images(rendered, arm, tmp_path, armsight):
    save_body_csv(open_body(str(rendered.plate)), tmp_path / "plate.csv")
    assert_rejected(armsight("measure", rendered.rig, "--target", tmp_path / "plate.csv", *images(arm)), "detections")


def test_a_full_disk(start, arm, armsight, full_disk):
    out = full_disk / "poses.csv"
    said = armsight(*start, *images(arm), "-o", out)
    assert said.code == 2
    assert len(said.out.splitlines()) == 4, "what was measured was printed before, below its head"
    warned, *_, last = said.err.splitlines()
    assert warned.endswith(f"{out}: cannot be written: No space left on device; measuring goes on")
    assert last == f"armsight: error: {out}: 3 of 3 rows could not be written"
    assert os.listdir(full_disk) == ["ballast"]


def test_a_killed_run_keeps_its_rows_and_its_memory_is_bounded(start, arm, tmp_path, monkeypatch, armsight):
    """Rows are in the file as they are measured; of many shots the counts are kept, not the records."""
    out, seen = tmp_path / "poses.csv", []
    monkeypatch.setattr("armsight.app.measure.run._KEPT", 2)

    def watched(self, record):
        keep(self, record)
        seen.append((len(read_table(out)) - 1, len(self.records), self.total))

    keep = MeasureRun._keep
    monkeypatch.setattr(MeasureRun, "_keep", watched)
    said = armsight(*start, *images(arm), "-o", out).done()
    assert seen == [(1, 1, 1), (2, 2, 2), (3, 2, 3)]
    assert "measured 3 of 3 shots" in said.err


# Detections instead of images.


@pytest.fixture
def seen(rendered, tmp_path):
    """The plate's corners as a CSV body and their true pixels in two shots; shot 9 has only two."""
    body = open_body(str(rendered.plate))
    save_body_csv(body, tmp_path / "plate.csv")
    rig, lines = StereoRig.load(rendered.rig), ["shot,camera,marker,u_px,v_px"]
    for shot, names in (("3", 16), ("7", 16), ("9", 2)):
        T = rendered.of_arm.Ts_left_body[int(shot)]
        p = body.points[:names] @ T[:3, :3].T + T[:3, 3]
        T_right_left = inverse(rig.T_left_right)
        for side, camera, q in (("left", rig.left, p), ("right", rig.right, transform(T_right_left, p))):
            for name, (u, v) in zip(body.point_names, camera.project(q), strict=False):
                lines.append(f"{shot},{side},{name},{u:.6f},{v:.6f}")
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n")
    return tmp_path


def by_detections(rendered, folder):
    return "measure", rendered.rig, "--target", folder / "plate.csv", "--source", f"detections:{folder}/d.csv"


def test_detections_are_measured_and_too_few_points_missed(rendered, seen, armsight):
    said = armsight(*by_detections(rendered, seen), "--json").done()
    assert [(r["shot"], r["status"]) for r in said.lines] == [("3", "ok"), ("7", "ok"), ("9", "missed")]
    assert "2" in said.lines[2]["reason"]
    for record in said.lines[:2]:
        # Pixels are written to a millionth: 1e-6 px is below a nanometre here, three decimals of room.
        assert record["position_m"] == pytest.approx(rendered.of_arm.Ts_left_body[int(record["shot"])][:3, 3], abs=1e-6)


@pytest.mark.parametrize(
    ("shots", "off_px", "code", "health"),
    [
        ("7", 4, 0, ""),
        ("37", 4, 3, "do not trust this result: rig: did the cameras move? "),
        (
            "37",
            60,
            3,
            "do not trust this result: rig: in 2 of 2 shots that were measured most points contradict each other",
        ),
    ],
)
def test_a_shot_of_which_most_points_contradict_each_other_is_named(
    rendered, seen, armsight, shots, off_px, code, health
):
    """The right image shows the body higher, but for four points: in most shots it is no shot's fault."""
    lines = (seen / "d.csv").read_text().splitlines()
    for shot in shots:
        for row in [k for k, line in enumerate(lines) if line.startswith(f"{shot},right,")][:12]:
            *start, v = lines[row].split(",")
            lines[row] = ",".join([*start, str(float(v) - off_px)])
    (seen / "d.csv").write_text("\n".join(lines) + "\n")
    said = armsight(*by_detections(rendered, seen))
    assert "12 points dropped" in next(line for line in said.out.splitlines() if line.startswith("7 "))
    assert f"in {', '.join(shots)} most points contradict each other: do not use it" in said.err
    assert said.code == code, said.err
    assert health in said.err


def test_a_board_of_which_detections_are_given_is_known_to_be_a_print(rendered, tmp_path):
    """Its shape is a calibration's: the test of single points leaves it out, however few they are."""
    for target, printed in (("chessboard:4x3:30mm", True), (str(rendered.plate), False)):
        name = open_body(target).point_names[0]
        rows = [f"1,{side},{name},100,100" for side in ("left", "right")]
        (tmp_path / "d.csv").write_text("\n".join(["shot,camera,marker,u_px,v_px", *rows]) + "\n")
        assert _detected(str(tmp_path / "d.csv"), target)[2] is printed


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("d.csv", "3,left,T0.0", "3,left,T9.9", "line 2: unknown marker 'T9.9'"),
        ("plate.csv", "x_m", "left_m", "line 1"),
    ],
)
def test_a_wrong_line_in_a_table(rendered, seen, armsight, file, old, new, said):
    text = (seen / file).read_text()
    assert old in text
    (seen / file).write_text(text.replace(old, new, 1))
    result = armsight(*by_detections(rendered, seen), "-o", seen / "poses.csv")
    assert_rejected(result, seen / file, said)
    assert not (seen / "poses.csv").exists()


def test_a_bowed_board_is_measured_as_its_calibration_found_it(data_dir, armsight, tmp_path):
    """OpenCV's own recording: a print 0.13 mm off its drawing, which every shot of 13 shows as a misfit."""
    folder = data_dir / "stereo" / "opencv-480p"
    given = ("--source", f"pairs:{folder}/left*.jpg,{folder}/right*.jpg")
    rig, board, spec = tmp_path / "rig.json", tmp_path / "rig.board.toml", "chessboard:9x6:25mm"
    said = armsight("calibrate", *given, "--target", spec, "-o", rig)
    assert f"--target {board}" in said.out
    drawn = armsight("measure", rig, *given, "--target", spec, "--json")
    found = armsight("measure", rig, *given, "--target", board, "--json")
    misfits = [[shot["misfit"] for shot in run.lines if shot["status"] == "ok"] for run in (drawn, found)]
    assert f"measure with --target {board}" in drawn.err
    assert "measure with --target" not in found.err
    assert len(misfits[0]) == len(misfits[1]) == 13
    # Where the shape is known, what is left is the noise: a misfit by chance, and the recording's one bad pair.
    assert sum(misfit > 1 for misfit in misfits[0]) == 13
    assert sum(misfit > 1 for misfit in misfits[1]) <= 3


def test_a_board_of_another_calibration_and_exchanged_counts_are_noted(rendered, tmp_path):
    spec, files = "chessboard:9x6:25mm", [tmp_path / "rig.board.toml", tmp_path / "other.board.toml"]
    points = open_body(spec).points
    for k, file in enumerate(files):
        save_board_file(file, spec, points + 1e-4 * k)
    rig = replace(StereoRig.load(rendered.rig), provenance={"target": spec, "board": files[0].name})

    def notes(target):
        options = SimpleNamespace(rig=tmp_path / "rig.json", target=str(target))
        return board_notes(options, rig, open_target(target))

    assert not notes(spec)
    assert not notes(files[0])
    assert not notes("chessboard:8x6:25mm")
    assert "has its counts exchanged" in notes("chessboard:6x9:25mm")[0]
    assert "is of another calibration" in notes(files[1])[0]


def test_a_rig_whose_camera_moved_is_named_and_the_exit_code_says_so(rendered, tmp_path, armsight):
    rig = StereoRig.load(rendered.rig)
    path = tmp_path / "moved.json"
    replace(rig, T_left_right=rig.T_left_right @ exp_se3(np.radians([0.0, 0.0, 0.0, 0.0, 0.3, 0.0]))).save(path)
    given = ("--target", rendered.plate, "--source", rendered.folder / "arm", "--json")
    assert armsight("measure", rendered.rig, *given).code == 0
    said = armsight("measure", path, *given)
    (found,) = said.lines[-1]["health"]
    assert said.code == 3, said.err
    assert found["cause"] == "rig"
    assert found.keys() == {
        "cause", "what", "since_s", "size", "sigma", "unit", "advice", "alternatives", "corrected_s", "cost_mm",
        "pose_sigma_mm",
    }  # fmt: skip
    assert found["cost_mm"] > 1.0
    assert abs(found["size"] - 0.3) < 4 * found["sigma"]
    assert "do not trust this result: rig: " in said.err


@pytest.mark.parametrize(("rows", "code"), [((6, 6, 5), 3), ((6, 6), 2), ((5, 5, 6), 0)])
def test_a_board_of_other_counts_is_named(rendered, tmp_path, armsight, rows, code):
    """Of ``rows``, 5 is the board that is given; the others leave no pose to be trusted where they are more."""
    rig, rng = StereoRig.load(rendered.rig), np.random.default_rng(3)
    for k, row in enumerate(rows):
        T = pose(Rotation.from_rotvec([0.2, -0.1, 0.1 * k]).as_matrix(), np.array([-0.07, -0.04, 0.5]))
        for side, camera, T_left in zip(("left", "right"), rig.cameras, (np.eye(4), rig.T_left_right), strict=True):
            board = PosedBody((chessboard(8, row, 0.02),), inverse(T_left) @ T)
            cv2.imwrite(str(tmp_path / f"{side}{k}.png"), render(camera, [board], rng=rng))
    said = armsight("measure", rendered.rig, "--target", "chessboard:8x5:20mm", *images(tmp_path))
    assert said.code == code, said.err
    assert ("the board has 8x6 (chessboard), not 8x5" in said.err) == (code > 0)
    assert ("do not trust this result: body: the board" in said.err) == (code == 3)


def test_a_fixed_body_that_moves_is_named(rendered, armsight, tmp_path):
    post = tmp_path / "post.toml"
    plate = tmp_path / "half.toml"
    head, *tags = rendered.plate.read_text().split("[[markers]]")
    plate.write_text("[[markers]]".join([head, *tags[::2]]))
    post.write_text("[[markers]]".join([head, *tags[1::2]]))
    given = [rendered.rig, "--target", plate, "--source", rendered.folder / "arm", "--fixed"]
    said = armsight("measure", *given, post, "--json")
    (found,) = said.lines[-1]["health"]
    assert said.code == 3, said.err
    assert found["cause"] == "fixed"
    assert "with one alone the two look alike" in found["what"]


def test_fixed_bodies_that_cannot_be_watched(rendered, armsight, tmp_path):
    given = ["measure", rendered.rig, "--target", rendered.plate, "--source", rendered.folder / "arm", "--fixed"]
    copied = tmp_path / "copied.toml"
    shutil.copy(rendered.plate, copied)
    assert_rejected(armsight(*given, rendered.plate), "both have the marker")
    assert_rejected(armsight(*given, copied), "copied.toml and --target")
    assert_rejected(armsight(*given, "points.csv"), "--fixed points.csv")
    assert_rejected(armsight(*given, "chessboard:9x6:25mm", "--fixed", "chessboard:9x6:25mm"), "at the same distances")
    for count in (50, 100):  # the first markers of one are those of the other
        marker = f'tag = {{ family = "DICT_4X4_{count}", id = 3, size_mm = 40 }}'
        pose = "position_mm = [0, 0, 0]\nquaternion_wxyz = [1, 0, 0, 0]"
        (tmp_path / f"d{count}.toml").write_text(
            f'version = 2\nname = "d"\n[[markers]]\nname = "t"\n{pose}\n{marker}\n'
        )
    both = "both have the marker DICT_4X4 3"
    assert_rejected(armsight(*given, tmp_path / "d50.toml", "--fixed", tmp_path / "d100.toml"), both)
    assert_rejected(armsight(*given, tmp_path / "none.toml"), "none.toml")
    seen = [*given[:4], "--source", "detections:d.csv", "--fixed", rendered.plate]
    assert_rejected(armsight(*seen), "--fixed needs images")


def test_cameras_that_moved_so_far_that_most_shots_are_missed_are_asked_about(rendered, seen, armsight):
    rig, lines = StereoRig.load(rendered.rig), ["shot,camera,marker,u_px,v_px"]
    body, moved = open_body(str(rendered.plate)), exp_se3(np.radians([0.0, 0.0, 0.0, 0.3, 0.0, 0.0]))
    for shot, T in enumerate(rendered.of_arm.Ts_left_body):
        p = transform(T, body.points)
        for side, camera, T_left in (
            ("left", rig.left, np.eye(4)),
            ("right", rig.right, rig.T_left_right @ (moved if shot else np.eye(4))),
        ):
            uv = camera.project(transform(inverse(T_left), p))
            lines += [f"{shot},{side},{name},{u},{v}" for name, (u, v) in zip(body.point_names, uv, strict=True)]
    (seen / "d.csv").write_text("\n".join(lines) + "\n")
    said = armsight(*by_detections(rendered, seen), "--json")
    (found,) = said.lines[-1]["health"]
    assert [record["status"] for record in said.lines[:-1]] == ["ok"] + 15 * ["missed"]
    assert (said.code, found["cause"]) == (3, "rig")
    assert abs(found["size"] - 0.3) < 0.02
    assert "did the cameras move? 15 of 16 shots" in found["what"]
    (seen / "d.csv").write_text("\n".join(line for line in lines if not line.startswith("0,")) + "\n")
    said = armsight(*by_detections(rendered, seen))
    assert said.code == 2
    assert_has(said.err, "none of 15 shots could be measured: ", "did the cameras move?")


def test_a_board_that_looks_the_same_upside_down_is_noted_where_it_flips():
    ways = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
    shots = [SimpleNamespace(ok=True, shot=f"s{k}", quaternion_wxyz=ways[k in (2, 3)]) for k in range(5)]
    shots.insert(1, SimpleNamespace(ok=False, shot="missed"))
    assert reversed_notes(SimpleNamespace(symmetries=()), shots) == []
    same = open_target("circles:4x3:30mm")
    (note,) = reversed_notes(same, shots)
    assert note.startswith("s2, s4: rotated by 180 degrees or so")
    assert reversed_notes(same, shots[:2]) == reversed_notes(same, []) == []


def test_shots_that_no_file_needs_are_counted_and_forgotten(armsight, rendered, monkeypatch, tmp_path):
    monkeypatch.setattr("armsight.app.measure.run._KEPT", 3)
    arguments = ("measure", rendered.rig, "--target", rendered.plate, "--source", rendered.folder / "arm")
    assert "measured 16 of 16 shots" in armsight(*arguments).err
    armsight(*arguments, "-o", tmp_path / "poses.csv")
    assert len((tmp_path / "poses.csv").read_text().splitlines()) == 17
