"""The report of a calibration: every section, reason and figure is there, nothing is written in part."""

import base64
import errno
import os
import re
import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from armsight.app.calibrate.assessment import advice, assess, predicted_sigmas, volume_slice
from armsight.app.calibrate.figures import (
    MOST_BARS,
    STANDS_OUT,
    coverage_figure,
    grid_counts,
    mean_residuals,
    pairs_figure,
    round_steps,
)
from armsight.app.calibrate.report import FIGURES, calibration_report, pose_table
from armsight.app.show import page
from armsight.app.show.plotting import drawing, nice, plain, png
from armsight.app.show.report import figure_files
from armsight.data import Body, Detections
from armsight.errors import InputError
from armsight.geometry.pose import inverse, pose, transform
from armsight.geometry.rotation import exp_so3
from armsight.vision.calibrate.boards import Pair, calibrate_boards
from armsight.vision.calibrate.motion import CameraChange
from armsight.vision.calibrate.result import RejectedPair
from armsight.vision.calibrate.weak import weaknesses
from armsight.vision.camera import Camera
from armsight.vision.markers.board import open_board
from armsight.vision.rig import StereoRig
from cli_runs import assert_has

matplotlib = pytest.importorskip("matplotlib", reason="the report needs matplotlib: pip install armsight[report]")

SIZE = (640, 480)
SECTIONS = {
    "result": "Assessment",
    "coverage": "Coverage of the images",
    "residuals": "Residuals of the fit",
    "pairs": "Held-out errors by pair",
    "volume": "Predicted uncertainty of a measurement",
    "target": "Shape of the target",
    "parameters": "Parameters of the cameras",
    "provenance": "Provenance",
}
NO_BOARD = "no chessboard of 7x5 inner corners found <script>alert('here')</script>"


@pytest.fixture(scope="module")
def calibration():
    """Eleven pairs of a chessboard with noise; one of them with wrong corners, one without a board."""
    rng = np.random.default_rng(20240612)
    board = open_board("chessboard:7x5:30mm")
    points = board.body.points
    camera = Camera(SIZE, "brown4", np.array([520.0, 522.0, 318.0, 243.0]), np.array([-0.12, 0.03, 1e-3, -5e-4]))
    T_left_right = pose(exp_so3(np.array([0.01, -0.15, 0.02])), np.array([0.15, 0.002, 0.01]))
    pairs = []
    for k in range(11):
        R = exp_so3(rng.uniform(-0.45, 0.45, 3))
        middle = np.array([0.06 + rng.uniform(-0.08, 0.08), rng.uniform(-0.08, 0.08), rng.uniform(0.5, 0.8)])
        T = pose(R, middle - R @ points.mean(axis=0))
        found = []
        for T_camera_left in (np.eye(4), inverse(T_left_right)):
            uv = camera.project(transform(T_camera_left @ T, points)) + rng.normal(0, 0.1, (len(points), 2))
            seen = np.flatnonzero(((uv > 0) & (uv < np.array(SIZE) - 1)).all(axis=1))
            found.append(Detections(seen, uv[seen], np.zeros((len(seen), 2, 2))))
        if k == 4:
            found[1] = replace(found[1], uv=found[1].uv + rng.normal(0, 15, found[1].uv.shape))
        pairs.append(Pair(f"pair <{k}> & $x$.png", *found))
    pairs.append(Pair("dark\udcff.png", pairs[0].left, Detections.none(NO_BOARD)))
    calibration = calibrate_boards(board, pairs, (SIZE, SIZE), models=("brown4",), folds=3)
    assert [r.pair for r in calibration.rejected] == ["dark\udcff.png", "pair <4> & $x$.png"]
    provenance = {"made_by": "armsight <test>", "fit": {"epipolar_rms_px": 0.1}}
    return replace(calibration, rig=replace(calibration.rig, provenance=provenance), notes=("pair <3>: mended",))


def report_of(calibration):
    """Return its Report."""
    return calibration_report(calibration, Path("rig.json"), None, None, 0.0)


@pytest.fixture(scope="module")
def written(calibration, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "new" / "folder"
    page = report_of(calibration).write(folder)
    assert page == folder / "report.html"
    return folder


@pytest.fixture
def undrawn(monkeypatch):
    """Spare the rendering where a test is not about the pictures."""
    for made in ("png", "svg", "data_csv"):
        monkeypatch.setattr(f"armsight.app.show.report.{made}", lambda figure, made=made: made.encode())


class Page:
    """What a browser makes of a page: its text by section, its tags and attributes; every tag is closed."""

    def __init__(self, text):
        root = ET.fromstring(
            re.sub(r"<((?:meta|img)[^>]*)>", r"<\1/>", f"<all>{text.replace('<!DOCTYPE html>', '')}</all>")
        )
        self.tags = [each.tag for each in root.iter()]
        self.attributes = [(each.tag, *pair) for each in root.iter() for pair in each.items()]
        self.text = {"": "".join(root.itertext())}
        self.text |= {each.get("id"): "".join(each.itertext()) for each in root.iter("section")}


def page_of(folder):
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def test_every_section_is_there_in_order_and_says_something(written):
    page = page_of(written)
    assert list(page.text) == ["", *SECTIONS]
    for anchor, title in SECTIONS.items():
        assert page.text[anchor].strip().startswith(title)
        assert len(page.text[anchor]) > len(title) + 20
        assert ("a", "href", f"#{anchor}") in page.attributes
    assert "10 of 12 pairs of images used" in page.text[""]


def test_the_held_out_metrics_stand_beside_the_fits_in_mm_and_px(written, calibration):
    text, h = page_of(written).text["result"], calibration.held_out
    for figure in (
        f"{1e3 * h.rigid_rms_m:.3g} mm",
        f"{h.epipolar_rms_px:.3g} px",
        f"{100 * h.scale_error:+.3f} %",
        f"{h.normalised_rms:.2f}",
        f"{calibration.epipolar_rms_px:.3g} px",
        f"{calibration.reprojection_rms_px:.3g} px",
        "held out, 3 folds",
        "Rely on the held-out column",
    ):
        assert figure in text


def test_every_rejected_pair_reason_note_and_weakness_is_said_as_it_is(written, calibration):
    text = page_of(written).text["result"]
    for pair in calibration.rejected:
        assert plain(pair.pair) in text
        assert pair.reason in text
    for line in (*calibration.notes, *calibration.weaknesses):
        assert line in text
    assert calibration.weaknesses, "ten pairs are few, and that must be said"


def test_nothing_from_outside_gets_into_the_page_as_html(written):
    page = page_of(written)
    assert not {"script", "link", "iframe", "object", "form"} & set(page.tags)
    assert "<test>" in page.text["provenance"]
    assert {value.split(":")[0] for _, key, value in page.attributes if key == "src"} == {"data"}
    assert all(value.startswith("#") for _, key, value in page.attributes if key == "href")
    assert not re.search(r"url\(|@import", (written / "report.html").read_text(encoding="utf-8"))


def test_every_figure_is_in_the_page_and_beside_it_and_not_blank(written):
    assert sorted(path.name for path in written.iterdir()) == sorted(["report.html", *figure_files("report", FIGURES)])
    embedded = [base64.b64decode(v.split(",")[1]) for _, key, v in page_of(written).attributes if key == "src"]
    assert embedded == [(written / f"report-{name}.png").read_bytes() for name in FIGURES]
    for data in embedded:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image.shape[1] == 1500
        assert image.shape[0] > 300
        assert (image != 255).any(axis=2).mean() > 0.02  # ink, not an empty canvas
        assert len(np.unique(image.astype(int) @ [1, 256, 65536])) > 50  # colours


def test_the_parameters_are_shown_with_their_sigmas(written, calibration):
    text, rig = page_of(written).text["parameters"].replace("\u00a0", " "), calibration.rig
    sigma = np.sqrt(np.diag(rig.cov))
    found = re.search(r"fx, px(\d+\.\d+) ± (\d+\.\d+)(\d{3}\.\d+) ± ", text)
    assert float(found[1]) == pytest.approx(rig.left.intrinsics[0], abs=0.06)
    assert float(found[2]) == pytest.approx(sigma[0], rel=0.06)
    assert_has(text, f"baseline, mm{1e3 * rig.baseline_m:.1f}", "brown4", "chosen")


def test_the_pose_tables_sigmas_are_along_the_left_cameras_axes():
    camera = Camera(SIZE, "none", np.array([500.0, 500, 320, 240]), np.zeros(0))
    cov = np.zeros((14, 14))
    cov[8, 8] = 2e-3**2  # along the right camera's x, which is the left one's -z
    cov[12, 12] = np.radians(0.25) ** 2  # about y, which both share
    T = pose(exp_so3(np.array([0, np.pi / 2, 0])), np.array([0.1, 0.0, 0.2]))
    text = Page(pose_table(StereoRig(camera, camera, T, cov, 0.1))).text[""].replace("\u00a0", " ")
    assert_has(text, "X, mm100 given", "Z, mm200.0 ± 2.0", "rotation vector Y, degrees90.00 ± 0.25")
    along = 0.2 / np.hypot(0.1, 0.2)
    assert f"baseline, mm{1e3 * np.hypot(0.1, 0.2):.1f} ± {2 * along:.1f}" in text


def test_without_an_estimated_target_its_picture_is_left_out_and_an_old_one_goes(calibration, tmp_path, undrawn):
    report_of(calibration).write(tmp_path)
    assert (tmp_path / "report-target.png").exists()
    (tmp_path / "mine.png").write_bytes(b"kept")
    flat = replace(calibration, deviation_m=0.0)
    hand = replace(calibration, body=Body("hand", calibration.body.point_names, calibration.body.points + 0.01))
    for other in (flat, hand):
        report_of(other).write(tmp_path)
        assert not (tmp_path / "report-target.png").exists()
        assert "target" not in page_of(tmp_path).text
    assert "points of the body" in page_of(tmp_path).text["coverage"]
    assert (tmp_path / "mine.png").read_bytes() == b"kept"


def test_a_given_camera_and_an_unknown_uncertainty_are_said(calibration, tmp_path, undrawn):
    given = replace(calibration, rig=replace(calibration.rig, cov=np.zeros_like(calibration.rig.cov)), models={})
    report_of(given).write(tmp_path)
    text = page_of(tmp_path).text
    assert "± " not in text["parameters"].replace("± one sigma", "").replace("± is", "")
    assert text["parameters"].count("given") == given.rig.parameter_count + 1  # and the baseline
    assert "uncertainty of this calibration is unknown" in text["volume"]
    held = replace(given, deviation_m=0.0, change=CameraChange(3, "", np.zeros((2, 1)), 0.0))
    assert any("Check the intrinsics that were given" in weak for weak in weaknesses(held))
    assert any("another --lens-model" in weak for weak in weaknesses(replace(held, rig=calibration.rig)))
    assert "the body differs" not in str(report_of(held).sections["printed"])
    assert "the body differs" in str(report_of(calibration).sections["printed"])


def test_a_hundred_pairs_and_a_hundred_rejected_ones_still_make_a_page(calibration, tmp_path, undrawn, capsys):
    times = 10
    e = calibration.errors
    errors = replace(e, **{name: np.tile(getattr(e, name), times) for name in ("pair", *FIELDS)})
    rejected = tuple(RejectedPair(f"bad{k:03d}", f"reason {k % 50}") for k in range(100))
    notes = tuple(f"note {k}" for k in range(100))
    many = replace(calibration, errors=errors, rejected=rejected, notes=notes)
    report = report_of(many)
    report.write(tmp_path)
    report.echo(as_json=False)
    printed = capsys.readouterr().out
    assert_has(printed, "rejected 2 pairs bad000 to bad050: reason 0", "and 42 more reasons: --json, --report")
    assert "bad009" not in printed
    page = page_of(tmp_path)
    assert all(f"bad{k:03d}" in page.text["result"] for k in range(100))
    assert page.text["result"].count("reason 13") == 1
    assert f"The {MOST_BARS} with the largest rigid error are shown" in page.text["pairs"]
    assert pairs_figure(many).get_figheight() < 2 + 0.2 * 4 / 3 * MOST_BARS


FIELDS = ("epipolar_px", "rigid_m", "scale", "weight", "normalised")


def test_the_users_own_matplotlib_settings_neither_matter_nor_change(calibration):
    with drawing():
        expected = png(coverage_figure(calibration))
    with matplotlib.rc_context({"text.usetex": True, "font.size": 30.0, "axes.facecolor": "red"}):
        with drawing():
            assert png(coverage_figure(calibration)) == expected
        assert matplotlib.rcParams["font.size"] == 30.0


def test_without_matplotlib_there_is_one_clear_error_and_no_folder(calibration, tmp_path, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError) as caught:
        report_of(calibration).write(tmp_path / "a")
    assert 'pip install "armsight[report]"' in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_permission_is_one_clear_error(forbidden):
    with pytest.raises(InputError, match="no report can be written here: Permission denied"):
        page.writable_folder(forbidden, "no report")


def test_a_disk_that_fills_leaves_nothing_half_written(calibration, tmp_path, monkeypatch, undrawn):
    replacing = page.replacing

    def failing(path, mode="w"):
        if path.name == "report.html":
            raise InputError(f"{path}: cannot be written: {os.strerror(errno.ENOSPC)}")
        return replacing(path, mode)

    with monkeypatch.context() as patch:
        patch.setattr(page, "replacing", failing)
        with pytest.raises(InputError, match=r"report.html: cannot be written: No space left on device"):
            report_of(calibration).write(tmp_path / "a")
    assert list((tmp_path / "a").iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "grade", "said"),
    [
        ({}, "good", "Leave mount, focus and zoom"),
        ({"epipolar_rms_px": 0.7}, "fair", "hold the target still"),
        ({"epipolar_rms_px": 3.0}, "poor", "hold the target still"),
        ({"scale_error": -0.003}, "fair", "check the size given for the target"),
        ({"scale_error": 0.02}, "poor", "check the size given for the target"),
        ({"normalised_rms": 1.5}, "fair", "held-out errors are larger than predicted"),
        ({"normalised_rms": 0.7}, "good", "Leave mount"),
        ({"normalised_rms": float("nan")}, "poor", ""),
    ],
)
def test_the_assessment_follows_the_held_out_metrics(calibration, changes, grade, said):
    sound = {"epipolar_rms_px": 0.1, "scale_error": 0.0002, "normalised_rms": 1.0}
    fit = changes.get("epipolar_rms_px", 0.1)
    changed = replace(
        calibration, held_out=replace(calibration.held_out, **{**sound, **changes}), epipolar_rms_px=fit, weaknesses=()
    )
    (graded, headline), meaning = assess(changed)
    assert graded == grade
    assert headline.startswith({"good": "Good", "fair": "Usable", "poor": "Do not rely"}[grade])
    assert said in " ".join([meaning, *advice(changed)])
    printed = report_of(changed).json()
    assert (printed["grade"], bool(printed["poor"])) == (grade, grade == "poor")


def test_overfitting_is_reported(calibration):
    sound = replace(calibration.held_out, epipolar_rms_px=0.28, scale_error=0.0, normalised_rms=1.0)
    overfitted = replace(calibration, held_out=sound, epipolar_rms_px=0.1, weaknesses=())
    assert assess(overfitted)[0][0] == "fair"
    assert "take more pairs" in advice(overfitted)[0]


def parallel_rig(cov=None, baseline=0.2, focal=800.0):
    camera = Camera(SIZE, "none", np.array([focal, focal, 319.5, 239.5]), np.zeros(0))
    T = pose(np.eye(3), np.array([baseline, 0.0, 0.0]))
    return StereoRig(camera, camera, T, np.zeros((14, 14)) if cov is None else cov, 0.1)


def test_predicted_sigmas_are_the_textbooks_on_parallel_cameras():
    """On the middle axis z = f B / d with a disparity variance of 2 sigma^2; across, two views are averaged."""
    f, B, sigma = 800.0, 0.2, 0.3
    z = np.array([0.8, 1.0, 2.5])
    p = np.stack([np.full(3, B / 2), np.zeros(3), z], axis=1)
    cov = np.zeros((14, 14))
    cov[8, 8] = 1e-4**2  # the baseline's length: z is proportional to it
    depth, lateral = predicted_sigmas(parallel_rig(cov), p, np.array([sigma**2, sigma**2]))
    noise, calibrated = z**2 / (f * B) * np.sqrt(2) * sigma, z / B * 1e-4
    np.testing.assert_allclose(depth, [noise, calibrated, np.hypot(noise, calibrated)], rtol=1e-9)
    np.testing.assert_allclose(lateral[0], z / f * sigma / np.sqrt(2), rtol=1e-9)


def test_a_point_outside_either_image_or_behind_has_no_sigma():
    p = np.array([[0.1, 0, 1.0], [-0.25, 0, 1.0], [0.45, 0, 1.0], [0.1, 0.4, 1.0], [0.1, 0, -1.0]])
    depth, lateral = predicted_sigmas(parallel_rig(), p, np.array([0.01, 0.01]))
    for sigma in (*depth, *lateral):
        assert np.isfinite(sigma).tolist() == [True, False, False, False, False]


def test_the_slice_spans_the_boards_and_is_sideways_along_the_baseline(calibration):
    shown = volume_slice(calibration)
    z = transform(calibration.solution.state.Ts_left_body[:, None], calibration.body.points)[..., 2]
    assert shown.axis == 0
    assert shown.depth_m[0] == pytest.approx(0.85 * z.min())
    assert shown.depth_m[-1] == pytest.approx(1.15 * z.max())
    assert (shown.seen == np.isfinite(shown.sigma_depth_m).all(axis=0)).all()
    assert shown.seen.mean() > 0.3
    noise, share, both = shown.sigma_depth_m[:, shown.seen]
    np.testing.assert_allclose(both, np.hypot(noise, share), rtol=1e-9)
    T_upright = pose(exp_so3(np.array([0, 0, np.pi / 2])), np.zeros(3))
    upright = replace(
        calibration,
        rig=replace(calibration.rig, T_left_right=T_upright @ calibration.rig.T_left_right @ inverse(T_upright)),
    )
    assert volume_slice(upright).axis == 1


def test_coverage_counts_every_point_once(calibration):
    for side in (0, 1):
        counts, u, v = grid_counts(calibration, side)
        assert counts.shape == (12, 16)
        assert counts.sum() == (calibration.observations.camera == side).sum()
        assert (u[0], u[-1], v[0], v[-1]) == (-0.5, 639.5, -0.5, 479.5)


def test_a_common_direction_of_residuals_stands_out_in_its_region(calibration):
    observations = calibration.observations
    noise = np.random.default_rng(5).normal(0, 0.1, (len(observations.shot), 2))
    cell, middle = 640 / 9, float(np.median(observations.uv[observations.camera == 0, 0]))
    left_half = (observations.camera == 0) & (observations.uv[:, 0] < middle)
    for shift in (0.0, 0.5):
        values = noise + np.where(left_half[:, None], [shift, 0.0], 0.0)
        changed = replace(calibration, solution=replace(calibration.solution, residuals_px=values))
        at, mean, errors = mean_residuals(changed, 0)
        left, right = at[:, 0] < middle - cell, at[:, 0] > middle + cell  # no cell is of both
        assert left.any()
        assert right.any()
        assert ((errors > STANDS_OUT) == (shift > 0))[left].all()
        assert not (errors > STANDS_OUT)[right].any()
        # A cell holds five points or more: four sigma of their mean.
        assert np.abs(mean[left] - [shift, 0.0]).max() < 4 * 0.1 / np.sqrt(5)


def test_names_are_made_printable_and_round_numbers_round():
    assert plain("a\udcff\nb\tc\xa0d") == "a� b c d"
    assert plain("x" * 100, 20) == "x" * 9 + "…" + "x" * 10
    assert [nice(v) for v in (0.034, 0.05, 1.0, 9.9, 199.0)] == [0.02, 0.05, 1.0, 5.0, 100.0]
    np.testing.assert_allclose(round_steps(0.15, 3.0), [0.2, 0.5, 1.0, 2.0])
    np.testing.assert_allclose(round_steps(0.1, 900.0), [0.1, 1, 10, 100])
