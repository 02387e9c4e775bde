"""The public names: what completion shows, what a result prints, and the whole way from pictures to a table."""

import inspect
import json
import pickle
import pydoc
import re
import sys
from pathlib import Path

import numpy as np
import pinocchio
import pyarrow
import pytest
from scipy.spatial.transform import RigidTransform

import armsight
from armsight import (
    ArmsightError,
    Missed,
    PoseEstimate,
    Shot,
    calibrate,
    measure,
    measure_all,
    open_source,
    open_target,
)
from armsight.data import Correspondences, Points
from armsight.geometry.pose import exp_se3, inverse, pose
from armsight.geometry.rotation import euler_zyx, from_euler_zyx
from armsight.sim.example_rig import BOARD, demo_recording
from armsight.vision.pose.shot_pose import CSV_COLUMNS, ShotPoses
from armsight.vision.source import Source
from made_once import made_once
from strategies import ordinary_rig

ROOT = Path(__file__).parents[1]
#: A word that may be a constant's name; video:FILE and NAME=THEIRS are what one types.
CONSTANT = re.compile(r"(?<![:,=\w])[A-Z][A-Z_]{3,}\b(?!=)")
#: What a pose measured alone and a row of a table have alike.
SHARED = ("T_left_body", "position_mm", "sigma_mm", "angles_deg", "sigma_deg", "cov_left", "quaternion_wxyz")


@pytest.fixture(scope="module")
def boards():
    """Return a folder with twelve pairs of a board."""
    return made_once("public", lambda into: demo_recording(into, image_size_px=(480, 270), boards=12, shots=1))


def estimate(T, cov):
    seen = Correspondences(np.arange(4), np.zeros((4, 2, 2)), np.zeros((4, 2, 2, 2)))
    points = Points(np.arange(4), np.zeros((4, 3)), np.zeros((4, 3, 3)), np.zeros((4, 3, 24)), seen)
    return PoseEstimate(T, cov, cov, 1e-4, 0.05, 1.0, points)


def test_completion_and_help_show_the_public_names():
    assert dir(armsight) == sorted([*armsight.__all__, "__version__"])
    text = pydoc.plain(pydoc.render_doc(armsight))
    for name in armsight.__all__:
        assert name in armsight.__doc__
        assert inspect.getdoc(getattr(armsight, name)), name
        assert re.search(rf"^    (class )?{name}( =|\()", text, re.MULTILINE), name


def test_help_names_nothing_that_cannot_be_typed():
    """No default is a function's address, and no constant of a module is named that is not public."""
    constants = {
        name
        for path in (ROOT / "src" / "armsight").rglob("*.py")
        if "app" not in path.parts  # nothing public is there, and JSON is a word
        for name in re.findall(r"^([A-Z][A-Z_]{3,})\b *[:=]", path.read_text(), re.MULTILINE)
    } - {"JSON"}  # the format's own name
    for name in armsight.__all__:
        found = getattr(armsight, name)
        text = pydoc.plain(pydoc.render_doc(found))
        assert "<function" not in text, name
        named = {*CONSTANT.findall(inspect.getdoc(found))} & constants
        for each in vars(found).values() if inspect.isclass(found) else ():
            if inspect.isfunction(each) and not each.__name__.startswith("_") and each.__doc__:
                named |= {*CONSTANT.findall(each.__doc__)} & constants
        assert not named, (name, named)


def test_the_sigmas_of_a_pose_are_those_of_what_it_prints():
    """Against the scatter of poses that are drawn from the covariance, 1.5 % for 20,000 of them (4 sigma: 2 %)."""
    rng = np.random.default_rng(5)
    A = rng.normal(size=(6, 6))
    cov = 1e-8 * A @ A.T
    T = pose(from_euler_zyx(0.4, -0.9, 2.0), np.array([0.1, -0.25, 0.8]))
    Ts = T @ exp_se3(rng.multivariate_normal(np.zeros(6), cov, 20_000))
    found = estimate(T, cov)
    np.testing.assert_allclose(found.position_mm, [100.0, -250.0, 800.0])
    np.testing.assert_allclose(found.angles_deg, np.degrees([0.4, -0.9, 2.0]))
    np.testing.assert_allclose(found.sigma_mm, 1e3 * Ts[:, :3, 3].std(axis=0), rtol=0.02)
    angles = np.array([euler_zyx(each[:3, :3])[0] for each in Ts])
    np.testing.assert_allclose(found.sigma_deg, np.degrees(angles.std(axis=0)), rtol=0.02)


def test_a_pose_prints_mm_degrees_and_sigma():
    found = estimate(pose(from_euler_zyx(0.1, 0.0, 0.0), np.array([0.1, -0.25, 0.8])), 1e-8 * np.eye(6))
    assert repr(found) == (
        "PoseEstimate(x 100.000 +- 0.100, y -250.000 +- 0.100, z 800.000 +- 0.100 mm; "
        "rz 5.7296 +- 0.0057, ry 0.0000 +- 0.0057, rx 0.0000 +- 0.0057 deg; 4 points)"
    )
    assert "<td>-250.000 +- 0.100</td><td>mm</td>" in found._repr_html_()
    assert found.to_dict()["position_mm"] == pytest.approx([100.0, -250.0, 800.0])
    assert np.isnan(estimate(pose(from_euler_zyx(0.1, np.pi / 2, 0.0), np.zeros(3)), np.eye(6)).sigma_deg).all()


def test_a_hand_eye_calibration_prints_its_error_and_sigma():
    """The sigmas that it prints are those along the base's axes, within which the truth is (4 of them)."""
    rng = np.random.default_rng(3)
    A = exp_se3(rng.normal(size=(12, 6)) * [0.2, 0.2, 0.2, 1, 1, 1])
    Z, X = (exp_se3(x) for x in np.array([[0.5, 0.2, 0.1, 0.3, -1.2, 2.0], [0.01, 0.02, 0.1, 0.1, 0.5, -0.3]]))
    cov = np.diag([1e-3, 1e-4, 3e-4, 1e-3, 1e-3, 1e-3]) ** 2
    B = inverse(Z) @ A @ X @ exp_se3(rng.multivariate_normal(np.zeros(6), cov, 12))
    text = repr(armsight.handeye(A, B, np.tile(cov, (12, 1, 1)), quick=True))
    assert text.startswith("HandEye(to_hand, 12 of 12 poses; held out ")
    flange, seen = [pinocchio.SE3(T) for T in A], RigidTransform.from_matrix(B)
    assert repr(armsight.handeye(flange, seen, np.tile(cov, (12, 1, 1)), quick=True)) == text
    with pytest.raises(ArmsightError, match=r"Ts_base_flange is a str; expected poses .*read_pose_table"):
        armsight.handeye("robot.csv", B)
    with pytest.raises(ArmsightError, match="are the same numbers"):
        armsight.handeye(A, A.copy())
    still = np.array(re.findall(r"(-?[\d.]+) \+- ([\d.]+)", text), float)[:3]
    assert (np.abs(still[:, 0] - 1e3 * Z[:3, 3]) < 4 * still[:, 1] + 0.005).all()


def test_one_decisive_pose_is_said_and_a_calibration_is_saved_and_drawn(tmp_path):
    """All poses but the fifth rotate about one axis alone: without it the translation along that axis is open."""
    rng = np.random.default_rng(4)
    rotated = np.zeros((9, 6))
    rotated[:, :3], rotated[:, 5] = rng.normal(size=(9, 3)) * 0.2, rng.normal(size=9)
    rotated[4, 3] = 0.8
    A, cov = exp_se3(rotated), np.diag([1e-4, 1e-4, 3e-4, 1e-3, 1e-3, 1e-3]) ** 2
    B = A @ exp_se3(np.array([0.01, 0.02, 0.1, 0.1, 0.5, -0.3])) @ exp_se3(rng.multivariate_normal(np.zeros(6), cov, 9))
    found = armsight.handeye(A, B, np.tile(cov, (9, 1, 1)), quick=True)
    assert int(np.argmax(found.leverage)) == 4
    assert "one pose decides: without pose 4 a direction is" in repr(found)
    found.save(tmp_path / "handeye.json")
    kept = json.loads((tmp_path / "handeye.json").read_text())
    assert kept == found.to_dict()
    np.testing.assert_array_equal(kept["T_flange_body"], found.T_flange_body)
    assert len(found.plot().axes[0].patches) == 9


def test_public_functions_go_to_other_processes():
    for name in ("measure", "handeye", "identify"):
        assert pickle.loads(pickle.dumps(getattr(armsight, name))) is getattr(armsight, name)


def test_errors_name_arguments_and_not_options(tmp_path):
    """A table of joints is no table of what cameras saw; a folder is no board."""
    path = tmp_path / "joints.csv"
    path.write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n1,2,3,4,5,6\n")
    with pytest.raises(ArmsightError, match="give arm, a name"):
        armsight.read_pose_table(path)
    with pytest.raises(ArmsightError, match="no poses that cameras saw"):
        armsight.read_pose_table(path, arm=armsight.open_arm("six_r"), side="seen")
    (tmp_path / "poses.csv").write_text("0.1,0.2,0.3,1,0,0,0\n")
    with pytest.raises(ArmsightError, match=r"give rotation=wxyz or rotation=xyzw") as raised:
        armsight.read_pose_table(tmp_path / "poses.csv")
    assert "--" not in str(raised.value)
    with pytest.raises(ArmsightError, match=r"board is the folder .*: are the two exchanged"):
        calibrate(str(tmp_path), BOARD)


def test_a_source_is_iterated_counted_and_indexed(boards):
    with open_source(boards / "board") as source:
        assert len(source) == 12
        assert source[3].name == "003"
        for _ in range(2):  # each time from the first
            assert [shot.name for shot in source] == [f"{k:03d}" for k in range(12)]
        assert source
        assert [shot.name for shot in source[2:8:3]] == ["002", "005"]
        assert repr(source) == "FolderSource(12 shots)"
        with pytest.raises(IndexError, match="shot 12 of 12"):
            source[12]
        figure = source[0].plot()
        assert [ax.get_title() for ax in figure.axes] == ["left", "right"]
        with pytest.raises(ArmsightError, match="no such folder"):
            open_source(boards / "none")


def test_pictures_to_a_rig_to_a_table(boards):
    found = calibrate(BOARD, boards / "board", models=("brown5",))
    assert re.match(r"Calibration\(12 of 12 pairs; held out 0\.\d+ px epipolar, 0\.\d+ mm; brown5, ", repr(found))
    rig = found.rig
    rig.save(boards / "found.json")
    assert rig.baseline_m == pytest.approx(0.2, abs=1e-4)
    table = measure_all(boards / "found.json", BOARD, str(boards / "board"))
    assert repr(table).startswith("ShotPoses(12 of 12 shots measured, sigma 0.")
    columns = table.columns()
    assert tuple(columns) == CSV_COLUMNS
    assert columns["shot"] == [shot.shot for shot in table]
    assert pyarrow.table(table).column("z_m").to_pylist() == columns["z_m"].tolist()
    in_mm = table.columns("mm")
    np.testing.assert_allclose(in_mm["sigma_z_mm"], 1e3 * columns["sigma_z_m"])
    assert (set(in_mm) & set(columns), in_mm["shot"]) == ({n for n in columns if not n.endswith("_m")}, columns["shot"])
    with pytest.raises(ArmsightError, match="lengths are in"):
        table.columns("cm")
    with pytest.raises(
        ArmsightError, match=r"found\.json: is a calibration of cameras \(T_left_right_m\), no table of poses"
    ):
        armsight.read_pose_table(boards / "found.json")
    table.write_csv(boards / "poses.csv")
    assert (boards / "poses.csv").read_text().splitlines()[0] == ",".join(CSV_COLUMNS)
    again = armsight.read_pose_table(boards / "poses.csv")
    np.testing.assert_allclose(again.Ts, [each.T_left_body for each in table], atol=1e-9)
    assert table.to_pandas()["x_m"].tolist() == columns["x_m"].tolist()
    assert table.to_pandas("mm")["x_mm"].tolist() == table.columns("mm")["x_mm"].tolist()
    one = measure(rig, open_target(BOARD), open_source(str(boards / "board"))[0])
    np.testing.assert_allclose(one.position_mm, 1e3 * np.array([columns[f"{axis}_m"][0] for axis in "xyz"]), atol=1e-9)
    for name in SHARED:
        np.testing.assert_allclose(getattr(one, name), getattr(table[0], name), rtol=1e-9, atol=1e-15, err_msg=name)
    x, rz, _, _, z, _ = table.plot().axes
    np.testing.assert_allclose(rz.lines[0].get_ydata(), columns["euler_z_deg"], atol=1e-9)
    np.testing.assert_allclose(x.lines[0].get_ydata(), 1e3 * columns["x_m"], atol=1e-9)
    low, high = z.collections[0].get_paths()[0].get_extents().intervaly  # the band has two sigmas to either side
    wide = 2e3 * columns["sigma_z_m"]
    assert (low, high) == pytest.approx(((1e3 * columns["z_m"] - wide).min(), (1e3 * columns["z_m"] + wide).max()))
    mm, _ = found.plot().axes
    assert [bar.get_height() for bar in mm.patches] == pytest.approx((1e3 * found.errors.rigid_m).tolist())


def test_a_plot_without_matplotlib_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ArmsightError, match=r'pip install "armsight\[report\]"'):
        ShotPoses(()).plot()


class Lost(Source):
    """The least that a source is; it is not closed by whom it is lent to."""

    count = None

    def __init__(self, shots):
        self.count, self.rest, self.closed = len(shots), list(shots), False

    def read(self):
        return self.rest.pop() if self.rest else None

    def close(self):
        self.closed = True


def test_a_missed_shot_stays_in_the_table():
    source = Lost([Shot("a", None, None, None, "lost")])
    table = measure_all(ordinary_rig(), BOARD, source)
    assert (table[0].reason, len(table), source.closed) == ("lost", 1, False)
    assert np.isnan(table.columns()["x_m"][0])
    assert np.isnan(table[0].position_mm).all()
    assert repr(table) == "ShotPoses(0 of 1 shots measured; missed 1 times: lost)"
    with pytest.raises(ArmsightError, match="nothing to draw: ShotPoses"):
        table.plot()
    with pytest.raises(ArmsightError, match="no shot left"):
        measure_all(ordinary_rig(), BOARD, source)
    with pytest.raises(ArmsightError, match="no pair of images: shot a: lost"):
        calibrate(BOARD, Lost([Shot("a", None, None, None, "lost")]))


@pytest.mark.parametrize(
    "call",
    [
        "measure(target, rig, shot)",
        "measure('rig.json', target, shot)",
        "measure(rig, 'board', shot)",
        "measure(rig, target, None)",
        "measure_all(rig, target.body, source)",
        "measure_all(target, target, source)",
        "measure_all(rig, target, shot)",
        "calibrate(target.body, source)",
        "calibrate(target, rig)",
    ],
)
def test_wrong_arguments_are_named(call):
    given = {"rig": ordinary_rig(), "target": open_target(BOARD), "shot": Shot("a", None, None, None, "lost")}
    missed = measure(**given)
    assert missed == Missed("lost")
    assert not missed
    with pytest.raises(AttributeError, match="position_mm: nothing was measured: lost"):
        missed.position_mm  # noqa: B018
    names = {"measure": measure, "measure_all": measure_all, "calibrate": calibrate, "source": Lost([given["shot"]])}
    with pytest.raises(ArmsightError, match=r"^\w+\([a-z, ]+\): (rig|target|board|shot|source) is a \w+; expected \w+"):
        eval(call, names | given)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ({"models": ("brown",)}, "models is .'brown',.: expected some of"),
        ({"models": "brown5"}, "models is 'brown5': expected some of"),
        ({"models": ()}, "models is ..: expected some of"),
        ({"folds": 1}, "folds is 1: expected 2 or more"),
    ],
)
def test_a_wrong_choice_of_models_or_folds_is_rejected_before_working(choice, message):
    with pytest.raises(ArmsightError, match=message):
        armsight.calibrate_boards(armsight.open_board(BOARD), [], ((480, 270), (480, 270)), **choice)


def test_paths_are_taken_wherever_texts_are(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("marker,x_m,y_m,z_m\nA,0,0,0\nB,0.1,0,0\nC,0,0.1,0\n")
    assert armsight.open_body(path).point_names == ("A", "B", "C")
    with pytest.raises(ArmsightError, match="a CSV body has points"):
        open_target(path)
    with pytest.raises(ArmsightError, match="unknown board"):
        armsight.open_board(path)
