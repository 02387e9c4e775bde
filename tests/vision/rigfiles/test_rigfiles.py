"""Foreign rig files: exact round trips, OpenCV's own projection as the oracle of every import, every damage reported."""

import errno
import io
import itertools
import json
import os

import cv2
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from program_files import (
    K_LEFT,
    K_RIGHT,
    SIZE,
    T_RIGHT_LEFT,
    YML,
    R,
    T,
    camera_info,
    chain,
    named,
    rectified,
    storage,
    write,
)

from armsight.app.rig.command import command
from armsight.errors import InputError
from armsight.geometry.pose import inverse, transform
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles import EXPORTED, FORMATS, export_rig, import_rig
from asserts import one_line
from strategies import CAMERAS, ordinary_rig

FILES = {
    "opencv": ["intrinsics.yml", "extrinsics.yml"],
    "ros": ["left.yaml", "right.yaml"],
    "kalibr": ["camchain.yaml"],
}
#: What each format can hold, and what comes back.
HELD = {
    "opencv": {model: model for model in CAMERAS},
    "ros": {"none": "brown5", "brown4": "brown5", "brown5": "brown5", "brown8": "brown8", "fisheye": "fisheye"},
    "kalibr": {"none": "none", "brown4": "brown4", "fisheye": "fisheye"},
}


def paths(tmp_path, name):
    return [tmp_path / file for file in FILES[name]]


def points():
    rng = np.random.default_rng(21)
    z = rng.uniform(0.4, 2.0, 60)
    return np.column_stack([rng.uniform(-0.3, 0.3, 60) * z, rng.uniform(-0.25, 0.25, 60) * z, z])


def oracle(K, d, R, t, fisheye=False):
    """OpenCV's projection of the points (left frame) from original matrices, none of our code."""
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    rvec, _ = cv2.Rodrigues(R)
    return project(points().reshape(-1, 1, 3), rvec, np.asarray(t, dtype=float), K, np.asarray(d, dtype=float))[0][:, 0]


def assert_projects_like(rig, left, right, t=T, R=R, fisheye=False, atol=1e-9):
    """Both cameras of a rig put the points where OpenCV puts them from (K, d) of each."""
    p_right = transform(inverse(rig.T_left_right), points())
    np.testing.assert_allclose(rig.left.project(points()), oracle(*left, np.eye(3), np.zeros(3), fisheye), atol=atol)
    np.testing.assert_allclose(rig.right.project(p_right), oracle(*right, R, t, fisheye), atol=atol)


def test_every_exported_format_is_tried_here():
    assert set(FILES) == set(HELD) == set(EXPORTED) <= set(FORMATS)


@pytest.mark.opencv
@pytest.mark.parametrize(("name", "model"), [(name, model) for name in HELD for model in HELD[name]])
def test_round_trip(tmp_path, name, model):
    rig = ordinary_rig(model)
    lost = export_rig(rig, name, paths(tmp_path, name))
    back = import_rig(name, paths(tmp_path, name))
    for mine, other in zip(rig.cameras, back.cameras, strict=True):
        assert other.image_size_px == mine.image_size_px
        assert other.model == HELD[name][model]
        np.testing.assert_array_equal(other.intrinsics, mine.intrinsics)
        np.testing.assert_array_equal(other.distortion[: mine.distortion.size], mine.distortion)
        assert not other.distortion[mine.distortion.size :].any()
    # ROS holds the pose as a product of three matrices; the others print it, inverted once each way.
    np.testing.assert_allclose(back.T_left_right, rig.T_left_right, rtol=0, atol=2e-15)
    assert any("covariance" in line for line in lost)
    assert any("sigma_px" in line for line in lost)
    assert (model != HELD[name][model]) == any("plumb_bob" in line for line in lost)


@pytest.mark.parametrize("name", EXPORTED)
def test_uncertainty_of_an_import_is_unknown_and_says_so(tmp_path, name):
    export_rig(ordinary_rig("brown4"), name, paths(tmp_path, name))
    rig = import_rig(name, paths(tmp_path, name))
    assert not rig.cov.any()
    assert "imported, uncertainty unknown" in rig.provenance["uncertainty"]
    assert rig.sigma_px == 0.2
    assert "assumed" in rig.provenance["sigma_px"]
    rig.save(tmp_path / "rig.json")
    assert StereoRig.load(tmp_path / "rig.json").provenance == rig.provenance
    assert import_rig(name, paths(tmp_path, name), sigma_px=0.07).sigma_px == 0.07


@pytest.mark.parametrize("name", EXPORTED)
def test_missing_files_are_named(tmp_path, name):
    with pytest.raises(InputError, match=f"{FILES[name][0]}: no such file"):
        import_rig(name, paths(tmp_path, name), unit_m=1.0, image_size_px=(640, 480))


@pytest.mark.parametrize("name", EXPORTED)
def test_the_number_of_files_is_checked(tmp_path, name):
    for given in ([], [tmp_path / "a"] * 3):
        with pytest.raises(InputError, match=f"got {len(given)} file"):
            export_rig(ordinary_rig("brown4"), name, given)


def test_unknown_format_lists_the_known():
    with pytest.raises(InputError, match=r"unknown rig format 'matlab'; known are .*kalibr, ros, opencv"):
        import_rig("matlab", ["a"])


@pytest.mark.parametrize("name", EXPORTED)
def test_an_export_that_cannot_be_written_leaves_nothing(tmp_path, name):
    targets = [tmp_path / "nowhere" / path.name for path in paths(tmp_path, name)]
    targets[0] = tmp_path / targets[0].name if len(targets) > 1 else targets[0]
    with pytest.raises(InputError, match="cannot be written"):
        export_rig(ordinary_rig("brown4"), name, targets)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("full", [0, 1])
def test_a_full_disk_replaces_neither_file_of_a_pair(tmp_path, monkeypatch, full):
    targets = paths(tmp_path, "ros")
    export_rig(ordinary_rig("brown5"), "ros", targets)
    before = [path.read_bytes() for path in targets]
    real, count = io.FileIO.write, itertools.count()

    def write(file, data):
        if next(count) == full:  # the disk is found to be full only when the buffer is written out
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), file.name)
        return real(file, data)

    monkeypatch.setattr("armsight.files._NamedFile.write", write)
    with pytest.raises(InputError, match=rf"{targets[full].name}: cannot be written: No space left"):
        export_rig(ordinary_rig("brown5", seed=9), "ros", targets)
    assert [path.read_bytes() for path in targets] == before
    assert sorted(os.listdir(tmp_path)) == sorted(path.name for path in targets)


@pytest.mark.opencv
def test_vertical_pairs_survive_rectification(tmp_path):
    rig = ordinary_rig("brown5")
    T = rig.T_left_right.copy()
    T[:3, 3] = [0.004, 0.21, 0.01]
    export_rig(StereoRig(rig.left, rig.right, T, rig.cov, 0.1), "ros", paths(tmp_path, "ros"))
    np.testing.assert_allclose(import_rig("ros", paths(tmp_path, "ros")).T_left_right, T, atol=2e-15)


# --- OpenCV ----------------------------------------------------------------------------------------------------------

D_LEFT, D_RIGHT = np.array([[-0.31, 0.11, 8e-4, -6e-4, -0.02]]), np.array([[-0.29, 0.1, -7e-4, 5e-4, -0.01]])


def stereo_calib(tmp_path, header="%YAML:1.0", files=2, **changes):
    """Files as OpenCV's sample writes them, from OpenCV's own writer; a value of None leaves an entry out."""
    rest = {"R1": np.eye(3), "R2": np.eye(3), "P1": np.eye(3, 4), "P2": np.eye(3, 4), "Q": np.eye(4)}
    entries = named("M1", "D1", "M2", "D2", scale=1.0) | {"D1": D_LEFT, "D2": D_RIGHT} | rest | changes
    parts = [{key: entries.pop(key) for key in ("M1", "D1", "M2", "D2")}] if files == 2 else []
    texts = [storage(YML, **{k: v for k, v in part.items() if v is not None}) for part in (*parts, entries)]
    bodies = [header + text[text.index("\n") :] for text in texts]
    return write(tmp_path, dict(zip(("intrinsics.yml", "extrinsics.yml"), bodies, strict=False)))


@pytest.mark.opencv
@pytest.mark.parametrize("header", ["%YAML:1.0", "%YAML 1.2"])  # OpenCV 4 and 5
@pytest.mark.parametrize("files", [1, 2])
def test_opencv_files_project_as_opencv_does(tmp_path, header, files):
    given = stereo_calib(tmp_path, header, files)
    rig = import_rig("opencv", given, unit_m=1.0, image_size_px=(1280, 720))
    assert_projects_like(rig, (K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT))
    assert rig.left.model == "brown5"
    again = import_rig("opencv", given[::-1], unit_m=1.0, image_size_px=(1280, 720))
    np.testing.assert_array_equal(again.T_left_right, rig.T_left_right)


def test_opencv_translations_are_in_board_units(tmp_path):
    given = stereo_calib(tmp_path, T=(T / 0.025).reshape(3, 1))  # squares counted as 1
    rig = import_rig("opencv", given, unit_m=0.025, image_size_px=(1280, 720))
    assert_projects_like(rig, (K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT))
    assert any("0.025 m" in note for note in rig.provenance["notes"])
    with pytest.raises(InputError, match=r"unit the board was given in.*8.59 long.*--unit-m 0.001"):
        import_rig("opencv", given, image_size_px=(1280, 720))
    for unit in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="--unit-m must be a positive length"):
            import_rig("opencv", given, unit_m=unit, image_size_px=(1280, 720))


def test_opencv_files_hold_no_image_size(tmp_path):
    with pytest.raises(InputError, match="holds no image size: give --image-size"):
        import_rig("opencv", stereo_calib(tmp_path), unit_m=1.0)
    given = stereo_calib(tmp_path, image_width=1280, image_height=720)
    assert import_rig("opencv", given, unit_m=1.0).left.image_size_px == (1280, 720)
    with pytest.raises(InputError, match=r"1280.* which is not the 640 x 480 given"):
        import_rig("opencv", given, unit_m=1.0, image_size_px=(640, 480))


@pytest.mark.parametrize("count", [4, 5, 8, 12, 14])
def test_opencv_distortion_vectors(tmp_path, count):
    d = np.zeros(count)
    d[: min(count, 8)] = [-0.3, 0.1, 1e-3, -1e-3, 0.02, 0.05, -0.01, 0.003][: min(count, 8)]
    given = stereo_calib(tmp_path, D1=d.reshape(1, -1), D2=d.reshape(-1, 1))
    rig = import_rig("opencv", given, unit_m=1.0, image_size_px=(1280, 720))
    assert rig.left.model == f"brown{min(count, 8)}"
    assert_projects_like(rig, (K_LEFT, d), (K_RIGHT, d))


def test_opencv_fisheye_is_read_where_it_is_named(tmp_path):
    d = np.array([0.03, -0.01, 4e-3, -1e-3])
    given = stereo_calib(tmp_path, D1=d.reshape(1, -1), D2=d.reshape(1, -1), distortion_model="fisheye")
    rig = import_rig("opencv", given, unit_m=1.0, image_size_px=(1280, 720))
    assert_projects_like(rig, (K_LEFT, d), (K_RIGHT, d), fisheye=True)
    bare = import_rig("opencv", stereo_calib(tmp_path, D1=d.reshape(1, -1)), unit_m=1.0, image_size_px=(1280, 720))
    assert any("Brown-Conrady, was assumed" in note for note in bare.provenance["notes"])


@pytest.mark.opencv
def test_opencv_reads_back_what_was_exported(tmp_path):
    rig = ordinary_rig("brown5")
    export_rig(rig, "opencv", [tmp_path / "both.yml"])
    storage = cv2.FileStorage(str(tmp_path / "both.yml"), cv2.FILE_STORAGE_READ)
    M1, D1, M2, D2, R, T, R1, P1, P2 = (
        storage.getNode(k).mat() for k in ("M1", "D1", "M2", "D2", "R", "T", "R1", "P1", "P2")
    )
    storage.release()
    assert_projects_like(rig, (M1, D1), (M2, D2), t=T.ravel(), R=R)
    assert P2[0, 3] == pytest.approx(-P2[0, 0] * rig.baseline_m, rel=1e-12)
    assert P1[0, 3] == 0
    assert R1.shape == (3, 3)


@pytest.mark.opencv
def test_opencv_says_where_the_parser_stopped(tmp_path):
    given = stereo_calib(tmp_path)
    text = given[1].read_text()
    given[1].write_text(text.replace("]", "", 1))
    with pytest.raises(InputError, match=r"extrinsics\.yml: line 11: not YAML"):
        import_rig("opencv", given, unit_m=1.0, image_size_px=(1280, 720))
    given[1].write_text(text.replace("rows: 3", "rows: 4", 1))
    with pytest.raises(InputError, match=r"extrinsics\.yml: R is damaged"):
        import_rig("opencv", given, unit_m=1.0, image_size_px=(1280, 720))


# --- ROS -------------------------------------------------------------------------------------------------------------


def camera_infos(tmp_path, digits=17, model="plumb_bob", d=(D_LEFT, D_RIGHT), left=None, right=None):
    """A camera_info pair from OpenCV's own rectification, numbers printed to some digits; ... removes an entry."""
    changes = {"left": left, "right": right}
    return write(tmp_path, {f"{k}.yaml": camera_info(k, "file", d, model, digits, v) for k, v in changes.items()})


MODELS = {
    "plumb_bob": (D_LEFT, D_RIGHT),
    "rational_polynomial": (np.array([0.3, -0.1, 1e-3, -7e-4, 0.01, 0.6, -0.05, 0.02]),) * 2,
    "equidistant": (np.array([0.03, -0.01, 4e-3, -1e-3]),) * 2,
}


@pytest.mark.parametrize("model", list(MODELS))
def test_ros_files_project_as_opencv_does(tmp_path, model):
    rig = import_rig("ros", camera_infos(tmp_path, model=model, d=MODELS[model]))
    left, right = ((K, d) for K, d in zip((K_LEFT, K_RIGHT), MODELS[model], strict=True))
    assert_projects_like(rig, left, right, fisheye=model == "equidistant")


def test_ros_baseline_is_in_the_projection_matrix(tmp_path):
    rig = import_rig("ros", camera_infos(tmp_path))
    P = yaml.safe_load((tmp_path / "right.yaml").read_text())["projection_matrix"]["data"]
    assert rig.baseline_m == pytest.approx(-P[3] / P[0], rel=1e-14)
    assert rig.baseline_m == pytest.approx(np.linalg.norm(T), rel=1e-14)
    halved = import_rig("ros", paths(tmp_path, "ros"), unit_m=0.5)
    assert halved.baseline_m == pytest.approx(rig.baseline_m / 2, rel=1e-14)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"roi": 5}, "roi must be a mapping"),
        ({"roi": {"x_offset": "a"}}, "binning and roi must be numbers"),
        ({"roi": {"x_offset": float("nan")}}, "binning and roi contains NaN"),
        ({"binning_x": 2.7}, "must be whole numbers from 0 on"),
        ({"binning_y": -1}, "must be whole numbers from 0 on"),
    ],
)
def test_ros_windows_that_are_none_are_rejected(tmp_path, more, said):
    with pytest.raises(InputError, match=said):
        import_rig("ros", camera_infos(tmp_path, left=more))


def test_ros_few_digits_are_mended_and_remarked(tmp_path):
    rig = import_rig("ros", camera_infos(tmp_path, digits=6))
    assert np.abs(rig.T_left_right[:3, :3] @ rig.T_left_right[:3, :3].T - np.eye(3)).max() < 1e-14
    assert any("nearest rotation was taken" in note for note in rig.provenance["notes"])
    # Six digits leave 5e-7 of a radian or of a length: half a thousandth of a pixel at these focal lengths.
    assert_projects_like(rig, (K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT), atol=5e-3)


def test_ros_files_without_a_model_are_plumb_bob(tmp_path):
    rig = import_rig("ros", camera_infos(tmp_path, left={"distortion_model": ...}))
    assert rig.left.model == "brown5"
    assert any("plumb_bob assumed" in note for note in rig.provenance["notes"])


def data(*values):
    return {"rows": 1, "cols": len(values), "data": list(values)}


@pytest.mark.parametrize("text", ["", "3", "- 1\n- 2\n", "a: [1, 2", "a: b: c", "\x00"])
@pytest.mark.parametrize("name", EXPORTED)
def test_other_yaml_files(tmp_path, name, text):
    for path in paths(tmp_path, name):
        path.write_text(text)
    with one_line(match=r"(left|camchain|intrinsics)\.ya?ml: .*(YAML|holds )"):
        import_rig(name, paths(tmp_path, name))


# --- Kalibr ----------------------------------------------------------------------------------------------------------


def camchain(tmp_path, cam0=None, cam1=None, more=None):
    """A chain of two pinhole-radtan cameras as Kalibr prints it; ... removes an entry."""
    document = chain(T_cn_cnm1=[None, T_RIGHT_LEFT])
    for name, changes in (("cam0", cam0), ("cam1", cam1)):
        document[name] = {k: v for k, v in (document[name] | (changes or {})).items() if v is not ...}
    document = {k: v for k, v in (document | (more or {})).items() if v is not ...}
    return write(tmp_path, {"camchain.yaml": yaml.safe_dump(document)})


@pytest.mark.parametrize("model", ["radtan", "equidistant", "none"])
def test_kalibr_files_project_as_opencv_does(tmp_path, model):
    d = {"radtan": D_LEFT.ravel()[:4], "equidistant": np.array([0.03, -0.01, 4e-3, -1e-3]), "none": np.zeros(0)}[model]
    changes = {"distortion_model": model, "distortion_coeffs": d.tolist()}
    rig = import_rig("kalibr", camchain(tmp_path, changes, changes))
    d = d if d.size else np.zeros(4)
    assert_projects_like(rig, (K_LEFT, d), (K_RIGHT, d), fisheye=model == "equidistant")


def test_kalibr_says_what_it_leaves_behind(tmp_path):
    rig = import_rig("kalibr", camchain(tmp_path, {"T_cam_imu": np.eye(4).tolist()}, more={"cam2": {}}))
    assert any(note.startswith("left behind: cam2;") for note in rig.provenance["notes"])
    assert "left behind: rostopic" in rig.provenance["notes"]


def test_a_chain_of_more_than_ten_cameras_is_in_the_order_of_its_numbers(tmp_path):
    step = np.eye(4)
    step[0, 3] = -0.1
    (path,) = camchain(tmp_path)
    camera = yaml.safe_load(path.read_text())["cam1"] | {"T_cn_cnm1": step.tolist()}
    [path] = camchain(tmp_path, cam1=camera, more={f"cam{k}": camera for k in range(2, 12)})
    assert list(yaml.safe_load(path.read_text()))[2:5] == ["cam10", "cam11", "cam2"]  # as Kalibr writes it
    for pair, baseline_m in ((("cam0", "cam2"), 0.2), (("cam2", "cam11"), 0.9)):
        assert import_rig(None, [path], pair=pair).baseline_m == pytest.approx(baseline_m)


@pytest.mark.parametrize("value", [..., 3, None])
def test_kalibr_needs_two_cameras(tmp_path, value):
    with pytest.raises(InputError, match=r"camchain\.yaml: holds one camera, cam0; a rig has two"):
        import_rig("kalibr", camchain(tmp_path, more={"cam1": value}))


@pytest.mark.parametrize("model", ["brown5", "brown8"])
def test_kalibr_cannot_hold_more_than_four_coefficients(tmp_path, model):
    with pytest.raises(InputError, match="radtan holds k1 k2 p1 p2 only"):
        export_rig(ordinary_rig(model), "kalibr", [tmp_path / "camchain.yaml"])
    assert list(tmp_path.iterdir()) == []


#: Changes of a file's entries, and what is said of them; of ROS's and Kalibr's files the last one is changed.
OPENCV_DAMAGE = [
    ({"M1": None}, "has no camera matrix of both cameras.*; there are .*Q 4x4"),
    ({"D2": None}, "has no distortion of both cameras.*; there are .*Q 4x4"),
    ({"R": None}, "has no R, the rotation between.*; there are .*Q 4x4"),
    ({"T": None}, "has no T, the translation between.*; there are .*Q 4x4"),
    ({"M1": np.eye(2)}, "M1 and D1: K has shape"),
    ({"M1": np.array([[800.0, 1, 600], [0, 800, 300], [0, 0, 1]])}, "skew is not supported"),
    ({"M2": np.full((3, 3), np.nan)}, "M2 and D2: K contains NaN"),
    ({"M1": np.diag([-1.0, 1, 1])}, "focal lengths must be positive"),
    ({"M1": 3}, "M1"),
    ({"D1": np.zeros((1, 6))}, "6 distortion coefficients"),
    ({"D1": np.full((1, 12), 0.1)}, "thin-prism"),
    ({"D2": np.full((1, 14), 0.1)}, "tilted-sensor"),
    ({"D2": np.full((1, 5), np.nan)}, "M2 and D2: distortion contains NaN"),
    ({"D2": "none"}, "M2 and D2: distortion must be numbers"),
    ({"distortion_model": "omni"}, "distortion_model 'omni' is not supported"),
    ({"distortion_model": "fisheye"}, "fisheye camera has"),
    ({"R": 2 * np.eye(3)}, "R is not a rotation"),
    ({"R": np.diag([1.0, 1, -1])}, "left-handed"),
    ({"R": np.zeros((4, 1))}, "R has shape"),
    ({"T": np.zeros((2, 1))}, "translation of R has shape"),
    ({"T": np.zeros((3, 1))}, "baseline 0"),
    ({"unit_m": -1.0}, "unit_m must be a positive number"),
    ({"unit_m": "mm"}, "unit_m must be a positive number"),
    ({"unit_m": 0.5}, "which is not the 1 given"),
    ({"image_width": 0, "image_height": 3}, "whole pixels"),
    ({"image_width": "wide", "image_height": 3}, "image size must be numbers"),
]
#: What ROS's cameracalibrator writes of fisheye pairs (camera_calibration 1.17.0): K R over P's left columns, findings/.
KR_RIGHT = np.column_stack([K_RIGHT @ rectified()[1], rectified()[3][:, 3]])
ROS_DAMAGE = [
    ({"image_width": ..., "image_height": ...}, "holds no image size"),
    ({"camera_matrix": ...}, "has no 'camera_matrix'"),
    ({"distortion_coefficients": ...}, "has no 'distortion_coefficients'"),
    ({"rectification_matrix": ...}, "has no 'rectification_matrix'"),
    ({"projection_matrix": ...}, "has no 'projection_matrix'"),
    ({"camera_matrix": {"rows": 3}}, "camera_matrix must be numbers"),
    ({"camera_matrix": 5}, "camera_matrix has shape"),
    (
        {"camera_matrix": data(1, 2) | {"rows": 3}},
        "camera_matrix is damaged: it says 3 rows and 2 cols, and its data holds 2",
    ),
    ({"camera_matrix": data(1, 2)}, "camera_matrix has shape"),
    ({"camera_matrix": data(*([0.0] * 9))}, "camera_matrix must be"),
    ({"camera_matrix": data("a")}, "camera_matrix must be numbers"),
    ({"distortion_model": "thin_prism_fisheye"}, "'thin_prism_fisheye' is not supported; supported are plumb_bob"),
    ({"distortion_model": ["x"]}, "is not supported"),
    ({"distortion_coefficients": data(1, 2, 3)}, "plumb_bob has 0 or 4 or 5 coefficients, got 3"),
    ({"distortion_model": "rational_polynomial", "distortion_coefficients": data(*([0.1] * 12))}, "thin-prism"),
    ({"rectification_matrix": data(*(2 * np.eye(3)).ravel().tolist())}, "rectification_matrix is not a rotation"),
    ({"projection_matrix": data(*([0.0] * 12))}, "projection_matrix must be"),
    ({"projection_matrix": data(*np.eye(3, 4).ravel().tolist())}, "holds no baseline"),
    ({"projection_matrix": data(*KR_RIGHT.round(5).ravel().tolist())}, "baseline is lost; run armsight calibrate"),
    ({"image_width": 12.5}, "whole pixels, got 12.5 x .*: give --image-size"),
    ({"image_width": None}, "image size"),
]
KALIBR_DAMAGE = [
    ({"camera_model": "omni"}, "cam1: camera_model 'omni' is not supported"),
    ({"camera_model": "eucm"}, "cam1: camera_model 'eucm' is not supported"),
    ({"distortion_model": [1]}, r"cam1: distortion_model .* is not supported"),
    ({"distortion_model": "fov"}, "cam1: distortion_model 'fov' is not supported; supported are .*radtan"),
    ({"distortion_coeffs": ...}, "cam1: has no distortion"),
    ({"distortion_coeffs": [0.1]}, "cam1: 1 distortion coefficients"),
    ({"intrinsics": ...}, "cam1: has no camera matrix"),
    ({"intrinsics": [1, 2, 3]}, "cam1: intrinsics has shape"),
    ({"intrinsics": ["a", 2, 3, 4]}, "cam1: intrinsics must be numbers"),
    ({"resolution": ...}, "cam1: holds no image size"),
    ({"resolution": [640]}, "cam1: image size has shape"),
    ({"T_cn_cnm1": ...}, "cam1 has no 'T_cn_cnm1'"),
    ({"T_cn_cnm1": np.eye(3).tolist()}, "T_cn_cnm1 has shape"),
    ({"T_cn_cnm1": (2 * np.eye(4)).tolist()}, "not a rotation"),
    ({"T_cn_cnm1": np.eye(4).tolist()}, "baseline 0"),
]


@pytest.mark.opencv
@pytest.mark.parametrize(
    ("name", "changes", "said"),
    [
        (name, *row)
        for name, rows in (("opencv", OPENCV_DAMAGE), ("ros", ROS_DAMAGE), ("kalibr", KALIBR_DAMAGE))
        for row in rows
    ],
)
def test_a_damaged_entry_is_one_line_with_the_file(tmp_path, name, changes, said):
    if name == "opencv":
        given, options = stereo_calib(tmp_path, **changes), {"unit_m": 1.0, "image_size_px": SIZE}
        options |= {"image_size_px": None} if "image_width" in changes else {}
    else:
        given = camera_infos(tmp_path, right=changes) if name == "ros" else camchain(tmp_path, cam1=changes)
        options = {}
    with pytest.raises(InputError, match=said) as caught:
        import_rig(name, given, **options)
    line = str(caught.value)
    assert any(str(path) in line for path in given) if name == "opencv" else line.startswith(str(given[-1]))
    assert "\n" not in line


# --- command line ----------------------------------------------------------------------------------------------------


def run(*args):
    """Run ``armsight rig``; an error comes back as the exception that the main program prints as one line."""
    return CliRunner().invoke(command, [str(a) for a in args], catch_exceptions=False)


@pytest.mark.parametrize("name", EXPORTED)
def test_command_export_import_show(tmp_path, name):
    rig, source, target = ordinary_rig("brown4"), tmp_path / "rig.json", tmp_path / "back.json"
    rig.save(source)
    first, *rest = paths(tmp_path, name)
    out = run("export", source, "--format", name, "-o", first, *rest, "--json")
    assert out.exit_code == 0
    assert json.loads(out.stdout)["files"] == [str(first), *map(str, rest)]
    assert "covariance" in out.stderr
    out = run("import", first, *rest, "--format", name, "-o", target, "--json")
    assert out.exit_code == 0
    assert json.loads(out.stdout)["baseline_m"] == pytest.approx(rig.baseline_m, abs=1e-15)
    assert "uncertainty unknown" in out.stderr
    np.testing.assert_allclose(StereoRig.load(target).T_left_right, rig.T_left_right, atol=2e-15)
    assert "uncertainty: unknown" in run("show", target).stdout
    assert json.loads(run("show", target, "--json").stdout)["baseline_sigma_m"] is None


def test_command_show_knows_the_sigmas(tmp_path):
    rig, path = ordinary_rig(), tmp_path / "rig.json"
    rig.save(path)
    properties = json.loads(run("show", path, "--json").stdout)
    assert properties["sigmas"]["left.fx_px"] == pytest.approx(rig.cov[0, 0] ** 0.5)
    # The baseline's own variance, from many draws of the translation.
    draws = np.random.default_rng(3).multivariate_normal(np.zeros(3), rig.cov[-6:-3, -6:-3], 100_000)
    lengths = np.linalg.norm(rig.T_left_right[:3, 3] + draws @ rig.T_left_right[:3, :3].T, axis=1)
    # 100 000 draws settle a standard deviation to 0.22 %; four of those, and the curvature of the length.
    assert properties["baseline_sigma_m"] == pytest.approx(lengths.std(), rel=0.01)
    text = run("show", path).stdout
    assert "baseline: " in text
    assert f"{rig.baseline_m * 1e3:.3f} +- " in text


@pytest.mark.parametrize(
    ("size", "said"),
    [("640", "expected WIDTHxHEIGHT"), ("0x480", "expected WIDTHxHEIGHT"), ("640x480", "cannot be|no such")],
)
def test_command_mistakes(tmp_path, size, said):
    with pytest.raises(InputError, match=said):
        run("import", tmp_path / "none.yml", "--format", "opencv", "-o", tmp_path / "r.json", "--image-size", size)
    assert list(tmp_path.iterdir()) == []
    assert run("import", "x", "--format", "matlab", "-o", "r").exit_code == 2


def test_one_alpha_in_all_rectifications_and_it_is_said(tmp_path):
    """All pixels of a rectified image come from inside the raw one: OpenCV's maps are the oracle."""
    rig, P = ordinary_rig("brown5"), {}
    rig.save(tmp_path / "rig.json")
    for name in ("opencv", "ros"):
        files = paths(tmp_path, name)
        out = run("export", tmp_path / "rig.json", "--format", name, "-o", files[0], files[1], "--json")
        assert json.loads(out.stdout)["rectification_alpha"] == 0.0
        assert "alpha 0" in out.stderr
    stored = cv2.FileStorage(str(tmp_path / "extrinsics.yml"), cv2.FILE_STORAGE_READ)
    P["opencv"] = [stored.getNode(key).mat() for key in ("R1", "R2", "P1", "P2")]
    stored.release()
    documents = [yaml.safe_load((tmp_path / f"{side}.yaml").read_text()) for side in ("left", "right")]
    P["ros"] = [
        np.reshape(one[key]["data"], (3, -1))
        for key in ("rectification_matrix", "projection_matrix")
        for one in documents
    ]
    for ours, theirs in zip(P["opencv"], P["ros"], strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
    for camera, rotation, projection in zip(rig.cameras, P["ros"][:2], P["ros"][2:], strict=True):
        u, v = cv2.initUndistortRectifyMap(
            camera.matrix, np.array(camera.distortion), rotation, projection, camera.image_size_px, cv2.CV_32FC1
        )
        width, height = camera.image_size_px
        # OpenCV finds the valid part on a grid of 9 x 9 points of the edge: between them an edge bends by a pixel or so.
        assert u.min() > -2
        assert u.max() < width + 1
        assert v.min() > -2
        assert v.max() < height + 1
    out = run("export", tmp_path / "rig.json", "--format", "ros", "--help")
    assert "alpha 0" in " ".join(out.output.split())


def test_a_number_k1_is_no_camera_matrix(tmp_path):
    """VINS and camodocal write one camera a file, its distortion as numbers k1, k2: that is no K1 and K2."""
    paths = [tmp_path / "left.yaml", tmp_path / "right.yaml"]
    for path in paths:
        path.write_text(
            "%YAML:1.0\n---\nmodel_type: PINHOLE\nimage_width: 752\nimage_height: 480\n"
            "distortion_parameters:\n   k1: -0.29\n   k2: 0.08\n   p1: 0.0\n   p2: 0.0\n"
            "projection_parameters:\n   fx: 461.6\n   fy: 460.2\n   cx: 362.6\n   cy: 248.1\n"
        )
    with pytest.raises(InputError, match=r"no camera matrix of both|no calibration of two cameras"):
        import_rig(None, paths)
