"""measure --view: the pictures show what was measured, all of them are there, and nothing else is touched."""

import os
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from armsight.app.measure import shots as measure_module
from armsight.app.measure import view as view_module
from armsight.app.measure.picture import RED, WIDTH, _Panel, ascii_text, draw_shot, ellipse, header, marks_of, wrapped
from armsight.app.measure.view import (
    CHART,
    EACH_UP_TO,
    SHOT,
    TIME,
    PictureFolder,
    _intervals,
    chart,
    chart_data,
    view_folder,
)
from armsight.data import SIDES, Detections, Dropped, Missed, PoseEstimate, Shot
from armsight.geometry.pose import inverse, transform
from armsight.geometry.rotation import euler_zyx, exp_so3
from armsight.vision.discs.bias import expect
from armsight.vision.markers.targets import open_body
from armsight.vision.pose.measure import locate_composite
from armsight.vision.pose.shot_pose import ShotPose, shot_pose
from armsight.vision.rig import StereoRig
from cli_runs import assert_has, assert_rejected
from disc_views import PLATE, SIZE, discs_of, hd_rig, someplace, views

matplotlib = pytest.importorskip("matplotlib", reason="the chart needs matplotlib: pip install armsight[report]")

FIVE = discs_of([[-0.055, 0, 0], [0.055, 0, 0], [0, 0.085, 0], [-0.03, 0.05, 0], [0.02, -0.06, 0]])


def located(target=PLATE, hidden=(), seed=5):
    """A rig, and a pose measured on exact ellipses with noise."""
    rng, rig = np.random.default_rng(seed), hd_rig()
    left, right, _ = views(rig, target, [someplace(rng)], rng, hidden=hidden)
    nothing = Detections.none("no codes")
    result = locate_composite(rig, target.body, target, (nothing, nothing), (left, right))
    assert isinstance(result, PoseEstimate), result
    return rig, result


def record_of(result, name="007", t_s=0.25, **more):
    return replace(shot_pose(name, t_s, PLATE.body, result), **more)


def blank(value=90):
    return np.full(SIZE[::-1], value, np.uint8)


# The picture of a shot.


def test_residuals_are_those_of_the_freed_centres_against_opencvs_projection():
    rig, result = located()
    marks = marks_of(rig, PLATE.body, PLATE, result)
    assert marks.names == ("P1", "P2", "P3")
    worlds = (result.T_left_body, inverse(rig.T_left_right) @ result.T_left_body)
    for side, (camera, T) in enumerate(zip(rig.cameras, worlds, strict=True)):
        fx, fy, cx, cy = camera.intrinsics
        K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        uv, _ = cv2.projectPoints(PLATE.body.points, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3], K, camera.distortion)
        # Two ways of the same arithmetic on numbers of a thousand.
        np.testing.assert_allclose(marks.residual[:, side], result.points.seen.uv[:, side] - uv[:, 0], atol=1e-8)
    rms = np.sqrt((marks.residual**2).sum(axis=2).mean())
    assert rms == pytest.approx(result.reprojection_rms_px, rel=1e-6)
    np.testing.assert_array_equal(marks.at, expect(rig, PLATE, result.T_left_body).uv)


def test_a_rim_is_that_of_its_quadratic_form():
    rim = ellipse(np.array([30.0, 8.0, 12.0]))
    S = np.array([[30.0, 8.0], [8.0, 12.0]])
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", rim, np.linalg.inv(S), rim), 1.0, rtol=1e-12)
    assert np.isnan(ellipse(np.full(3, np.nan))).all()


def test_a_detail_is_centred_to_the_pixel_and_its_pixels_are_squares():
    image = np.zeros((60, 80), np.uint8)
    image[21, 33] = 255
    tile = _Panel("left", image, (80, 60)).detail(np.array([33.0, 21.0]), 8.0)
    v, u = np.nonzero(tile[..., 0])
    assert len(u) == 64
    assert (u.min() + u.max(), v.min() + v.max()) == (tile.shape[1] - 1, tile.shape[0] - 1)
    assert (_Panel("left", None, (80, 60)).detail(np.array([33.0, 21.0]), 8.0) == tile[0, 0]).sum() == 0


@pytest.mark.opencv
def test_a_disc_that_one_camera_does_not_see_is_shown_with_its_reason():
    rig, result = located(FIVE, hidden=[(0, 1, 0)])
    dropped = (Dropped("P2", "left: not where it should be"), Dropped("somebody", "is no point"))
    marks = marks_of(rig, FIVE.body, FIVE, replace(result, dropped=dropped))
    row = marks.names.index("P2")
    assert marks.dropped[row].tolist() == [True, False]
    assert marks.reasons[row] == "left: not where it should be"
    assert marks.others == ("somebody: is no point",)
    assert np.isnan(marks.found[row, 0]).all()
    assert np.isfinite(marks.found[row, 1]).all()
    assert np.isfinite(marks.at[row]).all(), "where it should be is known all the same"
    assert marks.dropped.sum() == 1
    canvas = draw_shot(["P2 is hidden"], None, (blank(), blank()), (SIZE, SIZE), marks)
    assert canvas.shape[1] == WIDTH
    assert (canvas == RED).all(axis=2).any(), "something is red"


def test_what_neither_camera_sees_is_shown_too_but_not_on_the_far_side():
    rig, result = located(FIVE, hidden=[(0, 1, 0), (0, 1, 1)])
    marks = marks_of(rig, FIVE.body, FIVE, result)
    assert marks.names == FIVE.body.point_names
    assert marks.seen.tolist() == [[True, True], [False, False], [True, True], [True, True], [True, True]]
    assert np.isfinite(marks.shape[1]).all()
    mirrored = replace(FIVE, normals=FIVE.normals * np.array([[1], [-1], [1], [1], [1]]))
    assert np.isnan(marks_of(rig, FIVE.body, mirrored, result).shape[1]).all()
    assert draw_shot([], None, (blank(), blank()), (SIZE, SIZE), marks).shape[1] == WIDTH


@pytest.mark.parametrize(
    ("reasons", "sides", "said"),
    [
        (["left: outside the image", "right: outside the image"], [True, True], "both: outside the image"),
        (["right: facing away"], [False, True], "right: facing away"),
        (["7.0 px off its epipolar line (gate 2.0 px)"], [True, True], "7.0 px off its epipolar line (gate 2.0 px)"),
        (["3.1 px off the body in the left image"], [True, False], "3.1 px off the body in the left image"),
        (["left: a", "right: b"], [True, True], "left: a; right: b"),
    ],
)
def test_reasons_name_the_image(reasons, sides, said):
    rig, result = located()
    marks = marks_of(rig, PLATE.body, PLATE, replace(result, dropped=tuple(Dropped("P3", r) for r in reasons)))
    assert marks.dropped[2].tolist() == sides
    assert marks.reasons[2] == said


def test_of_many_points_the_dropped_and_the_worst_are_enlarged():
    rig, result = located(FIVE)
    marks = marks_of(rig, FIVE.body, FIVE, replace(result, dropped=(Dropped("P4", "left: cut"),)))
    assert marks.worst(5) == [0, 1, 2, 3, 4]
    off = np.linalg.norm(marks.residual, axis=2).max(axis=1)
    off[3] = np.inf
    assert marks.worst(3) == np.argsort(-off)[:3].tolist()


def test_a_missed_shot_is_shown_with_its_reason_in_red_and_without_images_too():
    for pictures in ((blank(), blank()), (None, None), (blank(), None)):
        canvas = draw_shot(["shot 3"], "the plate is not there", pictures, (SIZE, SIZE), None)
        assert canvas.dtype == np.uint8
        assert canvas.shape[1] == WIDTH
        # OpenCV 4 blends letters with the ground, and none of their pixels is quite as red.
        blended = 0 if int(cv2.__version__.split(".")[0]) >= 5 else 39
        assert (np.abs(canvas.astype(int) - RED).max(axis=2) <= blended).any()


@pytest.mark.opencv
@pytest.mark.parametrize("shape", [(120, 160), (120, 160, 3), (3000, 4000), (900, 90), (1, 1)])
def test_images_of_any_kind_and_size(shape):
    rig, result = located()
    image = np.full(shape, 30000, np.uint16)
    canvas = draw_shot([], None, (image, image), (SIZE, SIZE), marks_of(rig, PLATE.body, PLATE, result))
    assert canvas.shape[1] == WIDTH
    assert canvas.shape[0] < 3000


# What is written above.


def test_the_header_says_what_was_measured_and_how_it_was_found():
    _, result = located()
    record = record_of(result, way="followed", jump="jumped 40 mm", took_ms=2.34)
    first, second, third = header(record)
    assert first == "shot 007, t 0.250 s, followed, 2.3 ms, jumped 40 mm"
    x, sigma = 1e3 * record.position_m[0], 1e3 * np.sqrt(record.cov_left[0, 0])
    assert second.startswith(f"x {x:.3f} +- {sigma:.3f}, y ")
    assert " mm; rz " in second
    assert second.endswith(" deg")
    noise = 1e3 * np.sqrt(np.trace(result.cov_noise[:3, :3]))
    assert third.startswith(f"precision {noise:.3f} mm, calibration ")
    assert third.endswith(f" mm; reprojection {result.reprojection_rms_px:.3f} px RMS, misfit 1.0, 3 points")
    assert header(ShotPose("a", None, "gone")) == ["shot a"]


def test_the_sigmas_of_the_angles_are_those_of_random_rotations():
    _, result = located()
    record = record_of(result)
    rng, count = np.random.default_rng(1), 4000
    rotations = rng.multivariate_normal(np.zeros(3), record.cov_left[3:, 3:], count)
    R = result.T_left_body[:3, :3]
    angles = np.degrees([euler_zyx(exp_so3(w) @ R)[0] for w in rotations])
    # A sample's standard deviation has a relative error of 1/sqrt(2 n): four of them.
    np.testing.assert_allclose(angles.std(axis=0), record.angle_sigmas_deg, rtol=4 / np.sqrt(2 * count))
    assert np.isnan(replace(record, pitch_singular=True).angle_sigmas_deg).all()
    assert "only rz and rx together" in header(replace(record, pitch_singular=True))[1]


def test_text_is_ascii_and_wrapped_at_spaces():
    assert ascii_text("±3° naïve\nσ") == "+-3 deg na?ve sigma"
    lines = wrapped("one two three " * 20 + "x" * 300, 0.5, 200)
    assert "".join(lines).replace(" ", "") == "onetwothree" * 20 + "x" * 300
    assert all(cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)[0][0] <= 200 for line in lines)


# A run.


@pytest.fixture
def stub(monkeypatch):
    """Draw next to nothing."""
    monkeypatch.setattr(view_module, "draw_shot", lambda *_: np.zeros((1, 1, 3), np.uint8))
    monkeypatch.setattr(view_module, "chart", lambda _: b"chart")


def run_of_shots(folder, total, count, odd=(), way=None):
    rig, result = located()
    view, good = PictureFolder(view_folder(folder), rig, PLATE.body, PLATE, total), record_of(result)
    for n in range(count):
        shot = Shot(f"{n:04d}", None, None)
        if n in odd and way is None:
            view.add(shot, Missed("gone"), ShotPose(shot.name, None, "gone"))
        else:
            view.add(shot, result, replace(good, way=way if n in odd else "followed", took_ms=1.0))
    return view, {int(path.stem.removeprefix("view-")) for path in folder.glob("view-*.png")}


@pytest.mark.opencv
def test_a_short_run_is_shown_whole_and_a_long_one_in_part(stub, tmp_path):
    assert run_of_shots(tmp_path / "a", EACH_UP_TO, EACH_UP_TO)[1] == set(range(60))
    view, pictures = run_of_shots(tmp_path / "b", 150, 150, odd={7, 8, 100})
    assert pictures == {*range(0, 150, 3), 7, 8, 100}
    assert "53 of 150 shots" in view.summary()
    assert "one in 3 of the others" in view.summary()
    assert run_of_shots(tmp_path / "c", 150, 150, odd={7, 8}, way="searched")[1] == {*range(0, 150, 3), 7, 8}
    # Without an end in sight: all of 60, then every 2nd up to 120, every 4th up to 240.
    assert run_of_shots(tmp_path / "d", None, 200)[1] == {*range(60), *range(60, 120, 2), *range(120, 200, 4)}


def test_a_camera_that_sees_nothing_for_hours_does_not_fill_the_disk(stub, tmp_path):
    _, pictures = run_of_shots(tmp_path / "a", None, 2100, odd=set(range(2100)))
    assert pictures >= set(range(500))
    assert len(pictures) <= 500 + 250 * 2 + 13, "250 for every doubling, and every 32nd of all at most"


def test_names_of_shots_become_names_of_files(stub, tmp_path):
    rig, _ = located()
    view = PictureFolder(tmp_path, rig, PLATE.body, PLATE)
    names = ["a/b", "a:b", "../../etc", "é" * 200, "run", "\udcff", "a/b"]
    for name in names:
        view.add(Shot(name, None, None), Missed("gone"), ShotPose(name, None, "gone"))
    files = sorted(os.listdir(tmp_path))
    assert len(files) == len(names)
    assert {"view-a_b.png", "view-a_b~2.png", "view-a_b~3.png", "view-.._.._etc.png", "view-run.png"} <= set(files)


def test_no_shot_no_chart(stub, tmp_path):
    rig, _ = located()
    PictureFolder(tmp_path, rig, PLATE.body).finish([])
    assert os.listdir(tmp_path) == []


# The chart.


def shots(angles_deg, times):
    """Records of a body that rotates about z; None was missed."""
    cov, position = 1e-8 * np.eye(6), np.array([0.1, 0.2, 0.7])
    return [
        ShotPose(str(n), t, "gone")
        if angle is None
        else ShotPose(
            str(n), t, None, position, euler_zyx_deg=np.array([angle, 10.0, 0.0]), cov_left=cov, reprojection_rms_px=0.1
        )
        for n, (angle, t) in enumerate(zip(angles_deg, times, strict=True))
    ]


def test_the_chart_shows_the_records_without_steps_of_360_degrees():
    run = chart_data(shots([170.0, 178.0, None, -174.0, -170.0], [5.0, 5.1, 5.2, 5.3, 5.4]))
    np.testing.assert_allclose(run.pose[:, 3], [170.0, 178.0, np.nan, 186.0, 190.0])
    np.testing.assert_allclose(run.pose[0, :3], [100.0, 200.0, 700.0])
    np.testing.assert_allclose(run.pose_sigma[0, :3], 0.1)
    np.testing.assert_allclose(run.rotation_sigma[0], np.degrees(1e-4))
    assert run.way == ("measured", "measured", "missed", "measured", "measured")
    assert run.label == TIME
    np.testing.assert_allclose(run.along, [0.0, 0.1, 0.2, 0.3, 0.4])


@pytest.mark.parametrize("times", [[1.0, None, 2.0], [1.0, 1.0, 2.0], [3.0, 2.0, 1.0], [None] * 3])
def test_without_times_that_rise_shots_are_counted(times):
    run = chart_data(shots([0.0, 1.0, 2.0], times))
    assert run.label == SHOT
    assert run.along.tolist() == [1.0, 2.0, 3.0]


def test_intervals_end_where_the_way_changes_and_at_gaps_in_time():
    times = [0.0, 1.0, 2.0, 3.0, 10.0, 11.0]
    run = chart_data(shots([0.0, 0.0, None, 0.0, 0.0, 0.0], times))
    expected = [(-0.5, 1.5, "measured"), (1.5, 2.5, "missed"), (2.5, 3.5, "measured"), (9.5, 11.5, "measured")]
    assert list(_intervals(run)) == expected


@pytest.mark.parametrize(
    "records",
    [
        shots([3.0], [None]),
        shots([None], [None]),
        shots([None] * 5, [1.0, 2.0, 3.0, 4.0, 5.0]),
        shots([1.0, None] * 40, [None] * 80),
        [replace(r, pitch_singular=True, way="searched", jump="jumped") for r in shots([1.0, 2.0], [1.0, 2.0])],
        [replace(r, cov_left=np.zeros((6, 6))) for r in shots([1.0, 2.0], [1.0, 2.0])],
    ],
    ids=["one", "one missed", "all missed", "every other", "singular", "certain"],
)
def test_a_chart_of_any_run(records):
    picture = cv2.imdecode(np.frombuffer(chart(records), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[1] == 1500


# From the command line.


@pytest.fixture
def start(rendered):
    """How every measurement of the arm begins."""
    return "measure", rendered.rig, "--target", rendered.plate


def images(folder):
    return "--source", f"pairs:{folder}/left*.png,{folder}/right*.png"


@pytest.fixture
def arm(rendered, tmp_path):
    """Two shots of the arm."""
    folder = tmp_path / "arm"
    folder.mkdir()
    for n in (0, 5):
        for side in ("left", "right"):
            (folder / f"{side}{n:03d}.png").symlink_to(rendered.folder / "arm" / f"{side}{n:03d}.png")
    return folder


def test_every_shot_has_its_picture_and_foreign_files_stay(start, arm, armsight, tmp_path):
    out = tmp_path / "new" / "view"
    (out).mkdir(parents=True)
    (out / "notes.txt").write_text("mine")
    (out / "view-left999.png").write_bytes(b"old")
    (out / "view-left000.png").write_bytes(b"old")
    (arm / "left005.png").unlink()
    (arm / "left005.png").write_bytes(b"garbage")
    said = armsight(*start, *images(arm), "--view", out, "-o", out / "poses.csv").done()
    assert_has(said.err, "pictures of 2 of 2 shots", "of an earlier run there are left: 1")
    names = {"notes.txt", "view-left999.png", "poses.csv", CHART, "view-left000.png", "view-left005.png"}
    assert set(os.listdir(out)) == names
    assert (out / "notes.txt").read_text() == "mine"
    for name in (CHART, "view-left000.png", "view-left005.png"):
        picture = cv2.imread(str(out / name))
        assert picture.shape[1] in (WIDTH, 1500)
        assert picture.std() > 1


def test_nothing_measured_has_pictures_too(rendered, start, armsight, tmp_path):
    where = f"{rendered.folder}/board/left00[01].png", f"{rendered.folder}/board/right00[01].png"
    said = armsight(*start, "--source", f"pairs:{where[0]},{where[1]}", "--view", tmp_path / "v")
    assert said.code == 2
    assert set(os.listdir(tmp_path / "v")) == {CHART, "view-left000.png", "view-left001.png"}


def test_detections_are_shown_on_empty_images(rendered, start, armsight, tmp_path):
    rig, body, T = StereoRig.load(rendered.rig), open_body(str(rendered.plate)), rendered.of_arm.Ts_left_body[3]
    lines = ["shot,camera,marker,u_px,v_px"]
    for side, camera, to in zip(SIDES, rig.cameras, (T, inverse(rig.T_left_right) @ T), strict=True):
        for name, (u, v) in zip(body.point_names, camera.project(transform(to, body.points)), strict=True):
            lines += [f"3,{side},{name},{u:.6f},{v:.6f}"]
    lines += ["9" + line[1:] for line in lines[1:3]]  # too few points
    (tmp_path / "d.csv").write_text("\n".join(lines) + "\n")
    armsight(*start, "--source", f"detections:{tmp_path}/d.csv", "--view", tmp_path / "v").done()
    assert set(os.listdir(tmp_path / "v")) == {CHART, "view-3.png", "view-9.png"}


def test_an_interrupt_keeps_the_pictures(start, arm, armsight, tmp_path, monkeypatch):
    measure, calls = measure_module.measure, []

    def interrupted(*arguments):
        calls.append(1)
        if len(calls) > 1:
            raise KeyboardInterrupt
        return measure(*arguments)

    monkeypatch.setattr(measure_module, "measure", interrupted)
    said = armsight(*start, *images(arm), "--view", tmp_path / "v", "-o", tmp_path / "poses.csv")
    assert said.code == 130
    assert set(os.listdir(tmp_path / "v")) == {CHART, "view-left000.png"}
    assert (tmp_path / "poses.csv").exists()


# Bad input.


def test_without_matplotlib_nothing_is_begun(start, arm, armsight, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert_rejected(
        armsight(*start, *images(arm), "--view", tmp_path / "v"), "pip install", "armsight[report]", "--view"
    )
    assert not (tmp_path / "v").exists()


def test_a_full_disk_leaves_nothing_by_half(start, arm, armsight, full_disk):
    said = armsight(*start, *images(arm), "--view", full_disk)
    assert said.code == 2
    assert "No space left on device" in said.err
    assert len(said.err.splitlines()) == 1
    assert os.listdir(full_disk) == ["ballast"]
