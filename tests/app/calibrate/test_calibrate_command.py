import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from armsight.app.calibrate import run
from armsight.geometry.pose import pose
from armsight.sim.example_rig import example_rig
from armsight.sim.render.background import plain
from armsight.sim.render.render import render
from armsight.sim.render.scene import PosedBody, charuco
from armsight.vision.rig import StereoRig
from board_views import rig_error
from cli_runs import assert_has, assert_rejected, listening

QUICK = ("--lens-model", "brown5", "--folds", "3", "--flat-target")


@pytest.fixture
def few(rendered, tmp_path):
    """A folder of its own with five pairs of the board, to be spoilt."""
    folder = tmp_path / "few"
    folder.mkdir()
    for n in range(0, 10, 2):
        for side in ("left", "right"):
            shutil.copy(rendered.folder / "board" / f"{side}{n:03d}.png", folder)
    return folder


def images(folder):
    return "--source", f"pairs:{folder}/left*.png,{folder}/right*.png"


CHESS = ("--target", "chessboard:9x6:25mm")
DETECTED = ("--source", "detections:d.csv", "--target", "b.csv", "--cameras", "c.json")


def test_the_rendered_rig_is_recovered(rendered):
    true, rig = rendered.of_board.rig, StereoRig.load(rendered.rig)
    # The truth's middle coefficient order is brown5, the model asked for.
    error, sigma = rig_error(rig, true), np.sqrt(np.diag(rig.cov))
    assert (np.abs(error) < 4 * sigma).all(), error / sigma
    along = true.T_left_right[:3, 3] / true.baseline_m
    J = np.zeros(len(sigma))
    J[-6:-3] = along @ true.T_left_right[:3, :3]
    assert abs(rig.baseline_m - true.baseline_m) < 4 * np.sqrt(J @ rig.cov @ J)
    assert rig.provenance["pairs_used"] == 12
    assert rig.provenance["heldout_epipolar_rms_px"] < 0.05


def test_json_has_what_was_promised(rendered, armsight, tmp_path):
    out = tmp_path / "rig.json"
    summary = armsight("calibrate", *rendered.board, *QUICK, "-o", out, "--json").one
    promised = {
        "pairs_found", "pairs_used", "rejected", "fit", "heldout", "baseline_m", "convergence_deg",
        "distortion_model", "rig",
    }  # fmt: skip
    assert promised <= set(summary)
    assert set(summary["fit"]) == {"epipolar_rms_px", "reprojection_rms_px"}
    assert {"folds", "epipolar_rms_px", "rigid_rms_m", "scale_error"} <= set(summary["heldout"])
    assert (summary["pairs_found"], summary["pairs_used"], summary["rejected"]) == (12, 12, [])
    assert summary["heldout"]["epipolar_rms_px"] < 0.05
    assert summary["distortion_model"] == "brown5"
    assert summary["rig"] == str(out)
    rig = StereoRig.load(out)
    assert summary["baseline_m"] == pytest.approx(rig.baseline_m, rel=1e-12)
    assert summary["convergence_deg"] == pytest.approx(rig.convergence_deg, rel=1e-9)


def test_images_of_one_camera_alone_in_another_resolution_are_used(few, armsight, tmp_path):
    alone = tmp_path / "alone"
    alone.mkdir()
    for path in sorted(few.glob("left*.png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(alone / path.name), cv2.resize(image, None, fx=1.5, fy=1.5, interpolation=cv2.INTER_CUBIC))
    more = ("--alone", f"{alone}/*.png,")
    out = tmp_path / "rig.json"
    summary = armsight("calibrate", *images(few), *more, *CHESS, *QUICK, "-o", out, "--json").one
    assert (summary["pairs_found"], summary["pairs_used"], summary["rejected"]) == (5, 5, [])
    assert summary["heldout"]["epipolar_rms_px"] < 0.1
    assert StereoRig.load(out).provenance["left_intrinsics"] == str(more[1]).rstrip(",")
    square = np.zeros((300, 300), np.uint8)
    cv2.imwrite(str(alone / "square.png"), square)
    for options, words in (
        (("--alone", f"{alone}/*.png,"), ("square.png", "300x300", "same ratio")),
        (("--alone", f",{alone}/*.jpg"), ("*.jpg", "no such file")),
    ):
        assert_rejected(armsight("calibrate", *images(few), *options, *CHESS, *QUICK, "-o", out), *words)
    known = ("--source", "detections:d.csv", "--cameras", "c.json", "--target", "b.csv")
    assert_rejected(armsight("calibrate", *more, *known, "-o", out), "--alone")


def test_people_read_the_held_out_table_first(few, armsight, tmp_path):
    said = armsight("calibrate", *images(few), *CHESS, *QUICK, "-o", tmp_path / "rig.json").done()
    assert said.out.index("Held-out errors") < said.out.index("fit:") < said.out.index("rig written to")
    assert "weak: only 5 pairs were used" in said.out
    assert said.err == ""


def test_a_report_is_written_where_it_is_asked_for(few, armsight, tmp_path, monkeypatch):
    written = []  # its pages have their own tests
    monkeypatch.setattr(
        "armsight.app.show.report.Report.write", lambda report, folder: written.append((report, folder))
    )
    said = armsight(
        "calibrate", *images(few), *CHESS, *QUICK, "-o", tmp_path / "rig.json", "--report", tmp_path / "r", "--json"
    ).done()
    assert Path(said.lines[0]["report"]) == tmp_path / "r" / "report.html"
    ((report, folder),) = written
    assert folder == tmp_path / "r"
    assert report.sub.startswith("chessboard:9x6:25mm · 5 of 5 pairs of images used")


# Bad input, one by one.


def test_a_missing_file(few, armsight, tmp_path):
    (few / "left004.png").unlink()
    assert_rejected(
        armsight("calibrate", *images(few), *CHESS, "-o", tmp_path / "rig.json"), "4 left and 5 right", "004"
    )
    assert not (tmp_path / "rig.json").exists()


def test_no_image_can_be_read(few, armsight, tmp_path):
    for path in few.glob("*.png"):
        path.write_bytes(b"not an image")
    assert_rejected(
        armsight("calibrate", *images(few), *CHESS, "-o", tmp_path / "rig.json"), "none of 5 pairs can be read"
    )
    assert not (tmp_path / "rig.json").exists()


@pytest.mark.parametrize("keep", [0, 40, 0.5])
def test_one_truncated_image_is_a_rejected_pair(few, armsight, tmp_path, keep):
    path = few / "right004.png"
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if keep < 1 else keep])
    summary = armsight("calibrate", *images(few), *CHESS, *QUICK, "-o", tmp_path / "rig.json", "--json").one
    assert (summary["pairs_found"], summary["pairs_used"]) == (5, 4)
    ((pair, reason),) = [(r["pair"], r["reason"]) for r in summary["rejected"]]
    assert pair == "left004"
    assert reason.startswith(f"right: {path}")


def test_the_wrong_board(few, armsight, tmp_path):
    for path in few.glob("*00[4-8].png"):
        path.unlink()
    said = armsight("calibrate", *images(few), "--target", "chessboard:8x5:25mm", "-o", tmp_path / "rig.json")
    assert_rejected(said, "0 of 2 pairs are usable", "Is --target the board in the images")
    assert not (tmp_path / "rig.json").exists()


def test_the_wrong_square_size_cannot_be_seen_but_scales_the_baseline(few, armsight, tmp_path):
    sizes = []
    for square in ("25mm", "50mm"):
        said = armsight(
            "calibrate", *images(few), "--target", f"chessboard:9x6:{square}", *QUICK, "-o", tmp_path / "r", "--json"
        )
        sizes.append(said.lines[0]["baseline_m"])
    # The same images at twice the size: what is left is where the iterations stop.
    assert sizes[1] == pytest.approx(2 * sizes[0], rel=1e-6)


def test_two_image_sizes(few, armsight, tmp_path):
    path = few / "right006.png"
    cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path)), (320, 180)))
    said = armsight("calibrate", *images(few), *CHESS, "-o", tmp_path / "rig.json")
    assert_rejected(said, path, "320x180", "640x360")


def test_the_same_images_on_both_sides(few, armsight, tmp_path):
    said = armsight(
        "calibrate", "--source", f"pairs:{few}/left*.png,{few}/left*.png", *CHESS, "-o", tmp_path / "rig.json"
    )
    assert_rejected(said, "both a left and a right image")


def test_copies_of_one_cameras_images_are_no_pair(few, armsight, tmp_path):
    for left in few.glob("left*.png"):
        shutil.copy(left, few / left.name.replace("left", "right"))
    said = armsight("calibrate", *images(few), *CHESS, "-o", tmp_path / "rig.json")
    assert_rejected(said, few / "left000.png", few / "right000.png", "are the same")


def test_one_camera_opened_twice_has_no_baseline(few, armsight, tmp_path):
    rng = np.random.default_rng(3)
    for left in sorted(few.glob("left*.png")):
        image = cv2.imread(str(left), cv2.IMREAD_GRAYSCALE)
        noisy = np.clip(np.rint(image + rng.normal(0, 2, image.shape)), 0, 255).astype(np.uint8)
        cv2.imwrite(str(few / left.name.replace("left", "right")), noisy)
    said = armsight("calibrate", *images(few), *CHESS, *QUICK, "-o", tmp_path / "rig.json")
    assert_rejected(said, "which is no baseline", "one camera")


def test_images_of_one_camera_that_are_rotated_are_named(few, armsight, tmp_path):
    for right in few.glob("right*.png"):
        cv2.imwrite(str(right), cv2.rotate(cv2.imread(str(right)), cv2.ROTATE_90_CLOCKWISE))
    said = armsight("calibrate", *images(few), *CHESS, *QUICK, "-o", tmp_path / "rig.json", "--json").done()
    assert any("rotated against each other by 90 degrees" in weak for weak in said.lines[0]["weaknesses"])


def test_a_camera_in_the_dark_is_named(few, armsight, tmp_path):
    rng = np.random.default_rng(4)
    for right in few.glob("right*.png"):
        cv2.imwrite(str(right), np.clip(rng.normal(3, 3, (360, 640)), 0, 255).astype(np.uint8))
    said = armsight("calibrate", *images(few), *CHESS, "-o", tmp_path / "rig.json")
    assert_rejected(said, "0 of 5 pairs are usable", "right images without the target: the image is dark")
    assert "left images without" not in said.err


@pytest.fixture
def charuco_image():
    pattern, rng = charuco(4, 5, 0.05, 0.037, "DICT_4X4_50"), np.random.default_rng(1)
    T = pose(np.eye(3), np.array([-0.1, -0.1, 0.6]))
    return render(example_rig((640, 360)).left, [PosedBody((pattern,), T)], plain((640, 360), rng), rng=rng)


def test_a_board_that_is_not_its_own_mirror_image_shows_a_driver_that_mirrors(armsight, tmp_path, charuco_image):
    for n in range(3):
        cv2.imwrite(str(tmp_path / f"left{n}.png"), np.roll(charuco_image, n, axis=1)[:, ::-1])
        cv2.imwrite(str(tmp_path / f"right{n}.png"), np.roll(charuco_image, n + 9, axis=1))
    spec = "charuco:4x5:50mm:37mm:DICT_4X4_50"
    said = armsight("calibrate", *images(tmp_path), "--target", spec, "-o", tmp_path / "rig.json")
    assert_rejected(said, "left images without the target: the target is found once they are mirrored")
    assert "right images without" not in said.err


@pytest.mark.parametrize(
    ("spec", "named"),
    [
        ("charuco:4x5:50mm:37mm:DICT_5X5_50", "markers of DICT_4X4_50, not of DICT_5X5_50"),
        ("charuco:4x5:50mm:25mm:DICT_4X4_50", "in squares of 50 mm, not of 25 mm"),
        ("charuco:5x4:50mm:37mm:DICT_4X4_50", "check its counts of squares"),
    ],
)
def test_a_charuco_board_of_another_family_size_or_counts_is_named(armsight, tmp_path, charuco_image, spec, named):
    cv2.imwrite(str(tmp_path / "left0.png"), charuco_image)
    cv2.imwrite(str(tmp_path / "right0.png"), np.roll(charuco_image, 9, axis=1))
    said = armsight("calibrate", *images(tmp_path), "--target", spec, "-o", tmp_path / "rig.json")
    assert_rejected(said, named)


def test_images_that_contradict_each_other_are_not_to_be_trusted(rendered, armsight, tmp_path):
    for path in (rendered.folder / "board").glob("*.png"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(tmp_path / path.name), image[:, ::-1] if path.name.startswith("right") else image)
    said = armsight("calibrate", *images(tmp_path), *CHESS, *QUICK, "-o", tmp_path / "rig.json")
    assert said.code == 3, said.err
    assert_has(said.out, "contradict each other", "mirror")
    assert_rejected(
        armsight("measure", tmp_path / "rig.json", *images(tmp_path), *CHESS), "rig.json", "contradict each other by"
    )


def test_left_and_right_exchanged_is_an_error(few, armsight, tmp_path):
    said = armsight(
        "calibrate", "--source", f"pairs:{few}/right*.png,{few}/left*.png", *CHESS, *QUICK,
        "-o", tmp_path / "rig.json", "--json",
    )  # fmt: skip
    assert_rejected(said, "left and right are exchanged")
    assert not (tmp_path / "rig.json").exists()


def test_a_video_is_named_with_what_to_do(armsight, tmp_path):
    for side in ("left", "right"):
        (tmp_path / f"{side}.mp4").write_bytes(b"")
    videos = ("--source", f"pairs:{tmp_path}/left.mp4,{tmp_path}/right.mp4")
    said = armsight("calibrate", *videos, *CHESS, "-o", tmp_path / "rig.json")
    assert_rejected(said, "left.mp4", "is a video", "--source video:LEFT,RIGHT")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ((), ""),
        (CHESS, ""),
        (("--source", "pairs:a,b", *CHESS, "--cameras", "c.json"), "images show the intrinsics"),
        (("--source", "pairs:a,b", *CHESS, "--refine-body", "d.csv"), "--refine-body goes with detections"),
        (("--source", "detections:d.csv", "--target", "b.csv"), "need --cameras CAMERAS.json"),
        ((*DETECTED, "--lens-model", "fisheye"), "--lens-model goes with images"),
        ((*DETECTED, "--flat-target"), "--flat-target goes with images"),
        ((*DETECTED, "--alone", "a,b"), "--alone goes with images"),
        (("--source", "s"), ""),
    ],
)
def test_options_that_do_not_go_together(armsight, tmp_path, options, said):
    assert_rejected(armsight("calibrate", *options, "-o", tmp_path / "rig.json"), said)


def test_a_table_given_as_cameras_is_named(armsight, tmp_path):
    table = tmp_path / "joints.csv"
    table.write_text("pose,q1,q2\n0,0.1,0.2\n")
    said = armsight("calibrate", *DETECTED[:-1], table, "-o", tmp_path / "rig.json")
    assert_rejected(said, f"--cameras: {table}: holds text, or a table (CSV)")


# Where a real process, or a real file system, matters.


#: Runs the command line, and says on stdout that it is there when a function is called.
INTERRUPTED = """
import sys, time
from unittest import mock
import {module}
from armsight.app.main import main
real = {module}.{name}
def waiting(*arguments, **options):
    print("there", flush=True)
    {wait}
    return real(*arguments, **options)
with mock.patch("{module}.{name}", waiting):
    main()
"""


@pytest.mark.parametrize(
    ("module", "name", "wait"),
    [
        ("armsight.app.calibrate.run", "calibrate_boards", "time.sleep(60)"),
        ("armsight.vision.sources.pairs", "read_image", "time.sleep(60)"),
        ("armsight.files", "os.replace", "time.sleep(60)"),
    ],
    ids=["adjusting", "reading", "writing"],
)
def test_an_interrupt_leaves_nothing(rendered, tmp_path, module, name, wait):
    out, before = tmp_path / "rig.json", rendered.rig.read_text()
    out.write_text(before)
    script = INTERRUPTED.format(module=module, name=name, wait=wait)
    process = subprocess.Popen(
        [sys.executable, "-c", script, "calibrate", *rendered.board, *QUICK, "-o", out],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=listening,
    )  # fmt: skip
    assert process.stdout.readline() == "there\n"
    process.send_signal(signal.SIGINT)
    printed, complained = process.communicate(timeout=60)
    assert process.returncode == 130, complained
    assert complained.splitlines() == ["armsight: interrupted"]
    assert printed == ""
    assert out.read_text() == before
    assert os.listdir(tmp_path) == ["rig.json"]


@pytest.mark.parametrize(("read", "kept"), [(3, True), (2, False)])
def test_an_interrupted_reading_is_calibrated_from_what_was_read(few, armsight, tmp_path, monkeypatch, read, kept):
    real, calls = run.open_board(CHESS[1]), iter(range(100))

    def detect(image):
        if next(calls) == 2 * read + 1:  # between the two images of a pair
            raise KeyboardInterrupt
        return real.detect(image)

    monkeypatch.setattr(
        run,
        "open_board",
        lambda spec: SimpleNamespace(body=real.body, codes=real.codes, detect=detect, symmetries=real.symmetries),
    )
    said = armsight("calibrate", *images(few), *CHESS, *QUICK, "-o", tmp_path / "rig.json", "--json")
    assert said.code == 130
    assert (tmp_path / "rig.json").exists() == kept
    if kept:
        (found,) = said.lines
        assert found["pairs_used"] == read
        assert f"interrupted after {read} of 5: made from these" in found["notes"]
        assert "Ctrl-C again ends it" in said.err
    else:
        assert said.err.splitlines() == ["armsight: interrupted"]


def test_a_full_disk(few, armsight, full_disk):
    out = full_disk / "rig.json"
    assert_rejected(armsight("calibrate", *images(few), *CHESS, *QUICK, "-o", out), out, "No space left on device")
    assert os.listdir(full_disk) == ["ballast"]


def test_the_rig_is_json_that_others_can_read(rendered):
    document = json.loads(rendered.rig.read_text())
    assert document["format"] == "armsight-rig"
    assert np.shape(document["covariance"]) == (len(document["parameters"]),) * 2


def test_figures_that_look_like_contradictions_are_explained(data_dir, armsight, tmp_path):
    """Two webcams that are not synchronised: the board moved between their exposures, and stayed away from the edges."""
    folder = data_dir / "stereo" / "webcams-360p"
    images = ("--source", f"pairs:{folder}/left*.jpg,{folder}/right*.jpg", "--target", "chessboard:9x6:24.23mm")
    said = armsight("calibrate", *images, "--lens-model", "brown4", "-o", tmp_path / "rig.json", "--report", tmp_path)
    (fit,) = [line for line in said.out.splitlines() if line.startswith("fit: ")]
    epipolar, reprojection = (float(number) for number in re.findall(r"(\d\.\d+) px", fit)[:2])
    assert epipolar > 2 * reprojection
    assert "the reprojection follows the board, which moved between the two exposures" in fit
    assert "pairs dropped as gross errors; most in left" in said.out
    assert re.search(r"the board moved between the two exposures of a pair.* px, left\d+ by \d\.\d mm", said.out)
    (share,) = re.findall(r"weak: (\d+%) of the left image never saw the board \(counted in 8 x 8 cells\)", said.out)
    rig = StereoRig.load(tmp_path / "rig.json")
    assert rig.provenance["board"] == "rig.board.toml"
    assert (rig.provenance["left"], rig.provenance["right"]) == (f"{folder}/left*.jpg", f"{folder}/right*.jpg")
    page = (tmp_path / "report.html").read_text()
    assert f"{share} of the left image never saw the board" in page
    assert "The percentages are counted in 8 x 8 cells, larger than those of the map." in page
    assert "The reprojection follows the board, which moved" in page


def test_nothing_is_recorded_for_options_that_do_not_work(armsight, tmp_path):
    (tmp_path / "report").write_text("a file of mine")
    given = ("calibrate", "--source", "sim:", *CHESS, "-o", tmp_path / "rig.json")
    for wrong in (("--report", tmp_path / "report"), ("--alone", f"{tmp_path}/none*.png,")):
        said = armsight(*given, *wrong)
        assert_rejected(said, str(wrong[1]).rstrip(","))
        assert "recording" not in said.err
    said = armsight("calibrate", "--source", "sim:", "--target", "circles:7x5:30mm", "-o", tmp_path / "rig.json")
    assert_rejected(said, "circles:7x5:30mm: simulated cameras show a chessboard or a charuco board")
    assert "recording" not in said.err
    assert "shots are in" not in said.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report"]
