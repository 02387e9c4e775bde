"""One pair of cameras in the files of many programs is one rig; what a person gets wrong with them is named."""

import gzip
import json
import pickle
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from program_files import (
    D_LEFT,
    D_RIGHT,
    K_LEFT,
    K_RIGHT,
    MM,
    MM_SIZE,
    PROGRAMS,
    SIZE,
    T_RIGHT_LEFT,
    YML,
    R,
    T,
    camera_info,
    depthai,
    five,
    mrcal,
    named,
    npy,
    npz,
    orbslam3,
    storage,
    write,
    zed,
)

from armsight.errors import InputError
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3
from armsight.vision.camera_file import camera_of
from armsight.vision.rigfiles import FORMATS, import_rig, open_format


@pytest.mark.opencv
@pytest.mark.parametrize("name", PROGRAMS)
def test_the_rig_is_that_of_the_file(tmp_path, name):
    _, format_, files, options = PROGRAMS[name]
    paths = write(tmp_path, files)
    for given in (None, format_):
        rig = import_rig(given, paths, **options)
        np.testing.assert_allclose(rig.T_left_right, inverse(T_RIGHT_LEFT), rtol=0, atol=1e-7)  # ORB-SLAM's digits
        for camera, K, d in zip(rig.cameras, (K_LEFT, K_RIGHT), (D_LEFT, D_RIGHT), strict=True):
            assert camera.image_size_px == SIZE
            np.testing.assert_allclose(camera.matrix, K, rtol=1e-12)
            np.testing.assert_allclose(camera.distortion[:4], d, rtol=1e-12)
            assert not camera.distortion[4:].any()


# --- the cases of users, as they were sent --------------------------------------------------------------------------

CASES = Path(__file__).parent / "cases"
TEN_DEG = exp_so3(np.array([0.0, 0.1, 0.0]))


def from_p_right(R, t):
    """T_left_right (4, 4) of p_right = R p_left + t."""
    return inverse(pose(np.array(R, float), np.array(t, float)))


@pytest.mark.parametrize(
    ("files", "options", "fx", "k1", "size", "T_left_right"),
    [
        ("05-camera-info-message/left.yaml /right.yaml", {}, 500, 0.01, (640, 480), from_p_right(np.eye(3), [-0.06, 0, 0])),
        ("05-camera-info-message/left_dash.yaml /right_dash.yaml", {}, 500, 0.01, (640, 480), from_p_right(np.eye(3), [-0.06, 0, 0])),
        ("07-ros-millimetres/left.yaml /right.yaml", MM, 500, 0.0, (640, 480), from_p_right(np.eye(3), [-0.06, 0, 0])),
        ("08-openvins-chain/chain.yaml", {}, 458.6, -0.28, (752, 480), from_p_right(np.eye(3), [-0.11, 0, 0])),
        ("08-openvins-chain/camimu.yaml", {}, 458.6, -0.28, (752, 480), from_p_right(np.eye(3), [0, 0.11, 0])),
        ("08-openvins-chain/header.yaml", {}, 600.9, 0.08, (640, 480), from_p_right([[0, 0, -1], [0, 1, 0], [1, 0, 0]], [0.9, -0.8, 2.9])),
        ("08-openvins-chain/header.yaml", {"pair": ("cam1", "cam2")}, 588.5, 0.07, (640, 480), from_p_right(np.eye(3), [-0.1, 0, 0])),
        ("09-opencv-other-names/k1.yml", MM | {"image_size_px": (640, 480)}, 500, -0.1, (640, 480), from_p_right(TEN_DEG, [-0.06, 0, 0])),
        ("09-opencv-other-names/camera.yml", MM, 500, -0.1, (640, 480), from_p_right(TEN_DEG, [-0.06, 0, 0])),
        ("09-opencv-other-names/plain.json", MM, 900, -0.1, (1280, 720), from_p_right(np.eye(3), [-0.2, 0, 0])),
        ("10-filestorage-gz/rig.yml.gz", MM | {"image_size_px": (640, 480)}, 500, -0.1, (640, 480), from_p_right(TEN_DEG, [-0.06, 0, 0])),
        ("20-other-calibrations/camera_array.toml", {}, 900, -0.1, (1280, 720), from_p_right(TEN_DEG, [-0.2, 0, 0.01])),
        ("20-other-calibrations/SN1.conf", {}, 700.1, -0.17, (1280, 720), from_p_right(exp_so3(np.array([0.0007, 0.0015, 0.0001])), [-0.1199, -1e-5, -2e-5])),
    ],
)  # fmt: skip
def test_users_files(files, options, fx, k1, size, T_left_right):
    first, *rest = files.split(" /")
    paths = [CASES / first, *((CASES / first).parent / name for name in rest)]
    rig = import_rig(None, paths, **options)
    assert rig.left.image_size_px == size
    assert rig.left.intrinsics[0] == fx
    assert (rig.left.distortion[0] if rig.left.distortion.size else 0.0) == k1
    np.testing.assert_allclose(rig.T_left_right, T_left_right, atol=1e-12)


@pytest.mark.parametrize("name", ["translationVector", "Tvec", "transMat", "stereo_translation", "T_lr", "tmtx"])
@pytest.mark.parametrize("beside", ["tilt_deg", "target_size", "t_ms", "total_error"])
def test_the_translation_is_known_beside_three_other_numbers(tmp_path, name, beside):
    document = {
        **{f"{key}{k}": value for k in (1, 2) for key, value in (("K", K_LEFT.tolist()), ("D", five(D_LEFT).tolist()))},
        "R": np.eye(3).tolist(), name: [-0.06, 0.0, 0.0], beside: [1.0, 2.0, 3.0], "image_size": list(SIZE),
    }  # fmt: skip
    rig = import_rig(None, write(tmp_path, {"c.json": json.dumps(document)}), unit_m=1.0)
    assert rig.baseline_m == pytest.approx(0.06)


def test_a_fisheye_of_multical_is_known_by_the_shape_of_its_coefficients(tmp_path):
    """multical 0.4.0 writes the model "standard" for both lenses; cv2.fisheye.calibrate returns a column."""
    document = json.loads(PROGRAMS["multical"][2]["calibration.json"])
    for camera in document["cameras"].values():
        camera["dist"] = [[-0.02], [0.005], [-0.002], [0.0005]]
    paths = write(tmp_path, {"calibration.json": json.dumps(document)})
    rig = import_rig(None, paths)
    K, far = np.array(document["cameras"]["cam1"]["K"]), np.array([[0.7, 0.1, 1.0]])
    D, still = np.array([-0.02, 0.005, -0.002, 0.0005]), np.zeros((3, 1))
    expected = cv2.fisheye.projectPoints(far[None], still, still, K, D)[0]
    assert (rig.left.model, rig.right.model) == ("fisheye", "fisheye")
    np.testing.assert_allclose(rig.left.project(far), expected[0], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda cameras: cameras[1]["extrinsics"].update(toCameraSocket=-1),
            "the extrinsics of CAM_C lead to CAM_A, not to the other camera",
        ),
        (lambda cameras: cameras[0]["extrinsics"].update(toCameraSocket=1), "the extrinsics of CAM_B lead in a circle"),
        (lambda cameras: cameras[1].update(cameraType=2), "cameraType 2"),
        (lambda cameras: cameras[1].pop("width"), "not as depthai writes it: KeyError('width')"),
        (lambda cameras: cameras[1]["distortionCoeff"].__setitem__(9, 0.1), "thin-prism"),
    ],
)
def test_a_device_of_luxonis_that_cannot_be_read_is_named(tmp_path, change, said):
    document = depthai()
    change([camera for _, camera in document["cameraData"]])
    with pytest.raises(InputError, match=re.escape(said)):
        import_rig(None, write(tmp_path, {"calib.json": json.dumps(document)}))


@pytest.mark.parametrize(
    ("scale", "options"), [(1.0, {}), (1.0, {"unit_m": 0.01}), (0.01, {"unit_m": 1.0}), (10.0, {"unit_m": 1e-3})]
)
def test_lengths_of_luxonis_are_of_the_unit_given(tmp_path, scale, options):
    document = depthai()
    for _, camera in document["cameraData"]:
        for axis in "xyz":
            camera["extrinsics"]["translation"][axis] *= scale
    rig = import_rig(None, write(tmp_path, {"calib.json": json.dumps(document)}), **options)
    np.testing.assert_allclose(rig.T_left_right, inverse(T_RIGHT_LEFT), atol=1e-12)
    assert sum("raw images" in note for note in rig.provenance["notes"]) == 1


def test_the_pair_of_luxonis_is_left_and_right_also_without_stereo_data(tmp_path):
    document = depthai()
    files = write(tmp_path, {"calib.json": json.dumps(document)})
    swapped = import_rig(None, files, pair=("right", "left"))
    np.testing.assert_allclose(swapped.T_left_right, T_RIGHT_LEFT, atol=1e-12)
    document["stereoRectificationData"] |= {"leftCameraSocket": -1, "rightCameraSocket": -1}
    (alone,) = write(tmp_path, {"alone.json": json.dumps(document)})
    for pair in (None, ("left", "right"), ("CAM_B", "CAM_C")):
        rig = import_rig(None, [alone], pair=pair)
        np.testing.assert_allclose(rig.T_left_right, inverse(T_RIGHT_LEFT), atol=1e-12)


def test_a_baseline_in_a_wrong_unit_is_said_in_those_it_can_be_in(tmp_path):
    document, mm = depthai(), 1e3 * np.linalg.norm(T)
    files = write(tmp_path, {"calib.json": json.dumps(document)})
    with pytest.raises(InputError, match=re.escape(f"If the file is in cm, it is {mm:.4g} mm: give --unit-m 0.01")):
        import_rig(None, files, unit_m=1.0)
    for _, camera in document["cameraData"]:
        for axis in "xyz":
            camera["extrinsics"]["translation"][axis] *= 0.5  # 10.7 m: it may be one
    rig = import_rig(None, write(tmp_path, {"calib.json": json.dumps(document)}), unit_m=1.0)
    long = (
        f"the baseline is {mm / 20:.4g} m, which is long. If the file is in mm, it is {mm / 20:.4g} mm: --unit-m 0.001"
    )
    assert f"{long}. If the file is in cm, it is {mm / 2:.4g} mm: --unit-m 0.01" in "\n".join(rig.provenance["notes"])
    for _, camera in document["cameraData"]:
        for axis in "xyz":
            camera["extrinsics"]["translation"][axis] *= 250  # 2.7 m in mm: long, and too long in any other unit
    rig = import_rig(None, write(tmp_path, {"calib.json": json.dumps(document)}), unit_m=1e-3)
    assert f"the baseline is {mm / 80:.4g} m, which is long" in rig.provenance["notes"]


def test_a_program_is_no_calibration(tmp_path):
    with pytest.raises(InputError, match=r"gen.py: no file of names and values; read are YAML.*line 2: not YAML"):
        import_rig(None, write(tmp_path, {"gen.py": "import sys\nif len(sys.argv) > 1: print(1)\nx: int = 2\n"}))


@pytest.mark.parametrize(
    ("name", "said"), [("stereo_calib", True), ("K_l", True), ("bouguet", False), ("multical", False)]
)
def test_files_that_opencv_may_have_calibrated_are_remarked(tmp_path, name, said):
    rig = import_rig(None, write(tmp_path, PROGRAMS[name][2]), **PROGRAMS[name][3])
    assert any("stereoCalibrate" in note for note in rig.provenance["notes"]) is said


# --- what goes wrong -------------------------------------------------------------------------------------------------

TITLES = {name: re.escape(open_format(name).title) for name in FORMATS}
ONE_OF = ("stereo_calib", "mtxL", "ros files", "rostopic", "camchain", "openvins", "euroc", "basalt", "orbslam3", "caliscope",
          "multical", "mrcal 5", "zed", "depthai")  # fmt: skip
#: Files of one program given as another's: the message says whose they are, and what to give instead.
AS_ANOTHERS = [
    (
        name,
        {},
        other,
        rf"(is|are) {TITLES[PROGRAMS[name][1]]}, not {TITLES[other]}: leave --format out, or give --format",
    )
    for name in ONE_OF
    for other in FORMATS
    if other != PROGRAMS[name][1] and other in ("opencv", "ros", "kalibr", "mrcal", "caliscope")
]
#: Wrong units: the unit in which the baseline would be an ordinary one is named.
UNITS = [
    (
        name,
        {"unit_m": unit},
        None,
        rf"baseline .* expected 1 mm to 20 m. If the file is in {right}, it is .*: give --unit-m {number}",
    )
    for name in ONE_OF
    for unit, right, number in (
        ((1.0, "mm", "0.001"), (1e-6, "mm", "0.001"))
        if PROGRAMS[name][3].get("unit_m") or name in ("zed", "depthai")
        else ((1e-3, "m", "1"), (1e-6, "m", "1"))
    )
]
#: Wrong counts of files: one of a pair, one too many.
COUNTS = [
    ("ros files", slice(0, 1), r"left.yaml: camera_info of one camera, .*give left.yaml and right.yaml"),
    ("rostopic", slice(1, 2), r"right.txt: camera_info of one camera"),
    ("ros2 topic", slice(0, 1), r"left.yaml: camera_info of one camera"),
    ("mrcal 5", slice(0, 1), r"two files, left.cameramodel and right.cameramodel .*got 1 file"),
    ("mrcal 8", slice(1, 2), r"two files, left.cameramodel"),
    ("euroc", slice(0, 1), r"cam0.yaml: holds one camera, cam0; a rig has two"),
    ("euroc", slice(1, 2), r"cam1.yaml: holds one camera"),
    ("npy", slice(0, 1), r"K1.npy: the calibration of one camera|K1.npy: no calibration of two cameras"),
    ("npy", slice(0, 4), r"has no R, the rotation between the cameras; there are K1 3x3, D1 1x5"),
    ("npy", slice(0, 5), r"has no T, the translation between them"),
]
SHARED = {"image_size_px": (640, 480)}
#: A wrong size of the images: the two sizes are named.
SIZES = [
    (name, SHARED | PROGRAMS[name][3] | SHARED, None, r"1280 x 720, which is not the 640 x 480 given")
    for name in ("ros files", "rostopic", "camchain", "openvins", "euroc", "basalt", "orbslam3", "caliscope", "multical", "mrcal 5")
] + [
    ("stereo_calib", MM | SHARED, None, r"principal point \(633.1, 352.7\) lies outside of images of|principal point"),
    ("pose2sim", SHARED, None, r"1266.2 x 705.4, is twice its principal point: the one given|lies outside of images of 640x480"),
    ("zed", SHARED, None, r"resolutions in it: HD 1280x720; give --image-size"),
]  # fmt: skip


def reported(format_, paths, options):
    """The message of an import that fails, one line that names a file; else its notes."""
    try:
        return import_rig(format_, paths, **options).provenance["notes"]
    except InputError as error:
        line = str(error)
    assert any(str(path) in line for path in paths)
    assert "\n" not in line
    return [line]


@pytest.mark.parametrize(("name", "options", "format_", "said"), AS_ANOTHERS + UNITS + SIZES)
def test_whose_files_units_and_sizes(tmp_path, name, options, format_, said):
    paths = write(tmp_path, PROGRAMS[name][2])
    lines = reported(format_, paths, PROGRAMS[name][3] | options)
    assert any(re.search(said, line) for line in lines), lines


def test_a_whole_size_that_is_twice_the_principal_point_must_agree():
    entry = {"size": [1280, 720], "matrix": [[800, 0, 640], [0, 800, 360], [0, 0, 1]], "distortions": [0.0] * 5}
    with pytest.raises(InputError, match="1280 x 720, which is not the 1920 x 1080 given"):
        camera_of(entry, (1920, 1080))


@pytest.mark.parametrize("order", ["k1 k2 p1 p2 k3 (OpenCV order)", "k1, k2, p1, p2, k3", "k1 k2 k3 p1 p2"])
def test_a_model_that_is_named_by_its_coefficients_is_opencvs_in_its_order_alone(order):
    K = [[800, 0, 640], [0, 800, 360], [0, 0, 1]]
    entry = {"size": [1280, 720], "K": K, "distortion_model": order, "distortion": [0.1, 0.0, 1e-3, 0.0, 0.02]}
    if "p2 k3" in order.replace(",", ""):
        assert camera_of(entry)[0].model == "brown5"
    else:
        with pytest.raises(InputError, match="k1 k2 k3 p1 p2' is not supported"):
            camera_of(entry)


@pytest.mark.parametrize(("name", "some", "said"), COUNTS)
def test_counts_of_files(tmp_path, name, some, said):
    paths = write(tmp_path, PROGRAMS[name][2])[some]
    with pytest.raises(InputError, match=said):
        import_rig(None, paths, **PROGRAMS[name][3])


@pytest.mark.parametrize("name", [name for name, entry in PROGRAMS.items() if len(entry[2]) == 2])
def test_left_and_right_exchanged_is_remarked(tmp_path, name):
    paths = write(tmp_path, PROGRAMS[name][2])
    right, notes = (import_rig(None, p, **PROGRAMS[name][3]).provenance["notes"] for p in (paths, paths[::-1]))
    assert not any("stands left" in note for note in right)
    assert any("stands left of the first" in note and "exchange the files" in note for note in notes)
    with pytest.raises(
        InputError, match="is given twice; give the file of the left camera, then that of the right one"
    ):
        import_rig(None, [paths[0], paths[0]], **PROGRAMS[name][3])


def changed(name, *changes):
    """An entry's files with texts replaced."""
    files = {}
    for file, text in PROGRAMS[name][2].items():
        for old, new in changes:
            text = re.sub(old, new, text, count=1)
        files[file] = text
    return files


#: Files that cannot be read, or hold something else: what is said of them.
DAMAGED = {
    "kalibr target": ({"april.yaml": "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3\n"}, {}, "Kalibr's target file.*give it as --target"),
    "kalibr imu": ({"imu.yaml": "accelerometer_noise_density: 0.006\nrostopic: /imu0\nupdate_rate: 200.0\n"}, {}, "the noise of an IMU"),
    "imu chain": ({"imu.yaml": "%YAML:1.0\n\nimu0:\n  accelerometer_noise_density: 2e-3\n"}, {}, "the noise of an IMU"),
    "body": ({"body.toml": 'name = "b"\n[[markers]]\nname = "A"\nposition_mm = [0, 0, 0]\n'}, {}, "a body file of armsight"),
    "board": ({"b.toml": '[board]\nspec = "chessboard:9x6:25mm"\n'}, {}, "a board file of armsight"),
    "ur": ({"ur5.yaml": "kinematics:\n  shoulder:\n    x: 0\n"}, {}, "an arm's own calibration"),
    "one camera": ({"cam.yml": storage(YML, camera_matrix=K_LEFT, distortion_coefficients=five(D_LEFT), image_width=1280, image_height=720)}, {}, "the calibration of one camera, .*calibrate both together"),
    "one camera npz": ({"c.npz": npz(mtx=K_LEFT, dist=five(D_LEFT), rvecs=np.zeros((5, 3)))}, {}, "the calibration of one camera"),
    "extrinsics alone": ({"extrinsics.yml": storage(YML, R=R, T=T.reshape(3, 1), R1=R, R2=R, Q=np.eye(4))}, MM_SIZE, "has no camera matrix of both cameras .*; there are R 3x3, T 3x1"),
    "intrinsics alone": ({"intrinsics.yml": storage(YML, M1=K_LEFT, D1=five(D_LEFT), M2=K_RIGHT, D2=five(D_RIGHT))}, MM_SIZE, "has no R, the rotation between the cameras; there are M1 3x3"),
    "rectification": ({"maps.yml": storage(YML, R1=R, R2=R, P1=np.eye(3, 4), P2=np.eye(3, 4), Q=np.eye(4))}, {}, "a rectification .R1 R2 P1 P2 Q."),
    "F": ({"f.npz": npz(F=np.eye(3), E=np.eye(3) * 2)}, {}, "a fundamental or essential matrix"),
    "pickle": ({"c.pkl": pickle.dumps({"K1": 1})}, {}, "a Python pickle, which may run programs.*numpy.savez"),
    "pickled npy": ({"c.npy": npy(np.array({"K1": K_LEFT}, dtype=object))}, {}, "holds a pickled Python object.*numpy.savez"),
    "zip": ({"c.zip": b"PK\x03\x04" + b"\0" * 40}, {}, "an archive .zip. or damaged .npz"),
    "tar": ({"calibrationdata.tar.gz": gzip.compress(b"left.yaml" + b"\0" * 248 + b"ustar\x0000" + b"\0" * 255)}, {}, "an archive .tar.: unpack it"),
    "gz cut short": ({"c.yml.gz": gzip.compress(b"K1: 1\n" * 500)[:30] + b"zz"}, {}, "compressed by gzip and (damaged|cut short)"),
    "hdf5": ({"c.mat": b"\x89HDF\r\n\x1a\n" + b"\0" * 20}, {}, r"a MATLAB file, which is not read: in MATLAB, writelines\(jsonencode\(load\('c.mat'\)\)"),
    "mat": ({"c.mat": b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + b"\0" * 100}, {}, "a MATLAB file, which is not read: in MATLAB"),
    "png": ({"left.png": b"\x89PNG\r\n\x1a\n" + bytes(range(128, 256))}, {}, "not a text file, and no other that is read here: YAML, JSON"),
    "ost": ({"ost.txt": "# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n640\n"}, {}, "ost.txt; give the .yaml files of the same archive"),
    "urdf": ({"arm.urdf": '<?xml version="1.0"?>\n<robot name="a"/>\n'}, {}, "XML of <robot>; expected OpenCV's <opencv_storage>"),
    "html": ({"SN1.conf": "<html>301 Moved Permanently</html>"}, {}, "XML of <html>|not XML"),
    "csv": ({"poses.csv": "x,y,z\n1,2,3\n"}, {}, "not YAML|a table"),
    "empty": ({"rig.yaml": ""}, {}, "holds nothing"),
    "words": ({"rig.yaml": "see the other folder\n"}, {}, "holds text, or a table"),
    "unknown names": ({"rig.yaml": "alpha: 1\nbeta: [1, 2, 3]\n"}, {}, "no calibration of two cameras is recognised; there are alpha, beta 3. Expected are"),
    "numpy in yaml": ({"c.yaml": yaml.dump({"K1": K_LEFT})}, {}, r"Python object, not plain numbers: write arrays with .tolist"),
    "twice": ({"c.yaml": "K1: 1\nK2: 2\nK1: 3\n"}, {}, "line 3: not YAML .'K1' stands twice"),
    "two documents": ({"c.yaml": camera_info("left", "ros2") + camera_info("right", "ros2")}, {}, "holds 2 YAML documents, separated by ---; expected one"),
    "json comma": ({"c.json": '{"K1": [1, 2,]}'}, {}, "line 1: not JSON"),
    "counts of a matrix": ({"c.yml": PROGRAMS["k1"][2]["cam_stereo.yml"].replace("rows: 3", "rows: 4", 1)}, MM_SIZE, "K1 is damaged: it says 4 rows and 3 cols, and its data holds 9"),
    "transposed": ({"c.npz": npz(**(named("K1", "D1", "K2", "D2") | {"K1": K_LEFT.T, "K2": K_RIGHT.T}))}, MM_SIZE, "transposed, as MATLAB's IntrinsicMatrix is"),
    "no distortion": ({"c.npz": npz(K1=K_LEFT, K2=K_RIGHT, R=R, T=T)}, MM_SIZE, "has no distortion of both cameras"),
    "no unit": (PROGRAMS["k1"][2], {"image_size_px": SIZE}, r"unit the board was given in, .*214.8 long. If the file is in mm, it is 214.8 mm: --unit-m 0.001. If .*If squares"),
    "ds": (changed("basalt", ("pinhole-radtan8", "ds")), {}, "'ds' is not supported; supported are"),
    "pair unknown": (PROGRAMS["three cameras"][2], {"pair": ("cam0", "cam7")}, "has no camera 'cam7'; there are cam0, cam1, cam2"),
    "uncalibrated camera_info": (changed("rostopic", (r"K: \[[^]]*\]", "K: [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]")), {}, "uncalibrated|must be|not calibrated"),
    "no P": (changed("ros files", ("projection_matrix", "projection")), {}, "the calibration of one camera"),
    "two mono cameras": ({f"{s}.yaml": re.sub(r"P: .*", f"P: {[*K_LEFT[0].tolist(), 0.0, *K_LEFT[1].tolist(), 0.0, *K_LEFT[2].tolist(), 0.0]}", camera_info(s, "ros1")) for s in ("left", "right")}, {}, "holds no baseline .*two single cameras"),
    "splined": ({f"{s}.cameramodel": mrcal(s).replace("LENSMODEL_OPENCV5", "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=11") for s in ("left", "right")}, {}, "LENSMODEL_SPLINED_STEREOGRAPHIC is not supported; .*mrcal-convert-lensmodel"),
    "no extrinsics": ({f"{s}.cameramodel": mrcal(s).replace("'extrinsics'", "'other'") for s in ("left", "right")}, {}, "extrinsics has shape"),
    "mrcal cut": ({"left.cameramodel": mrcal("left")[:200], "right.cameramodel": mrcal("right")}, {}, "neither JSON nor Python's names and values"),
    "not posed": ({"a.toml": re.sub(r"rotation = .*\n", "", PROGRAMS["caliscope"][2]["camera_array.toml"].replace("rotation_count = 0\n", ""), count=1)}, {}, "has no rotation and translation: its pose was not calibrated"),
    "toml cut": ({"a.toml": PROGRAMS["caliscope"][2]["camera_array.toml"][:150]}, {}, "a.toml: not TOML: .*line"),
    "zed many": ({"SN1.conf": zed("2K", "HD")}, {}, "resolutions in it: HD 1280x720, 2K 2208x1242; give --image-size"),
    "zed no stereo": ({"SN1.conf": zed("HD").partition("[STEREO]")[0]}, {}, "section STEREO has no BASELINE_HD; there are no names"),
    "zed left alone": ({"SN1.conf": re.sub(r"\[RIGHT_CAM_HD\]", "[OTHER]", zed("HD"))}, {}, "resolutions in it: none of both cameras"),
    "multical unposed": (changed("multical", ("cam2_to_cam1", "cam3_to_cam1")), {}, "camera_poses has no cam2; there are cam1, cam3"),
    "orbslam mono": ({"TUM1.yaml": re.sub(r"Stereo.T_c1_c2[^Z]*", "", orbslam3())}, {}, "has no Stereo.T_c1_c2"),
    "principal point": ({"c.npz": npz(**(named("K1", "D1", "K2", "D2")))}, MM | {"image_size_px": (720, 1280)}, "principal point .* 16 % of a side|principal point"),
    "far from the middle": ({"c.npz": npz(**(named("K1", "D1", "K2", "D2")))}, MM | {"image_size_px": (1920, 1080)}, r"is 17 % of a side from the middle of 1920x1080 px: was it calibrated with images of this size"),
    "MATLAB's own": ({"c.json": json.dumps({"s": {"CameraParameters1": {"K": K_LEFT.tolist()}, "CameraParameters2": {"K": K_RIGHT.tolist()}, "RotationOfCamera2": R.T.tolist()}})}, MM_SIZE, "pixels count from 1 .*stereoParametersToOpenCV"),
    "basalt of numbers": ({"c.json": '{"value0": {"T_imu_cam": [1, 2], "intrinsics": [1, 2], "resolution": [[1, 2], [3, 4]]}}'}, {}, "T_imu_cam, intrinsics and resolution must be lists with an entry for each camera"),
    "basalt of one number": ({"c.json": '{"value0": {"T_imu_cam": 5, "intrinsics": [], "resolution": []}}'}, {}, "must be lists with an entry for each camera"),
    "multical of numbers": ({"c.json": '{"cameras": {"a": 1, "b": 2}, "camera_poses": {"a": 1}}'}, {}, "a holds '1', expected a camera's names and values"),
    "sides of words": ({"c.json": '{"x": {"sizes": "ab", "data": [1], "dt": "d"}}'}, {}, "x must be numbers: rows, cols and data"),
    "sides below zero": ({"c.json": '{"x": {"rows": -3, "cols": -3, "data": [1, 1, 1, 1, 1, 1, 1, 1, 1]}}'}, {}, "x is damaged: it says -3 rows"),
    "size of a body": (PROGRAMS["k1"][2], MM | {"image_size_px": (320, 240)}, "lies outside of images of 320x240 px"),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_what_is_wrong_with_a_file_is_said(tmp_path, name):
    files, options, said = DAMAGED[name]
    lines = reported(None, write(tmp_path, files), options)
    assert any(re.search(said, line) for line in lines), lines


@pytest.mark.parametrize("pair", [("cam0", "cam2"), ("/left", "/third")])
def test_a_pair_is_chosen_by_the_names_of_the_file(tmp_path, pair):
    document = yaml.safe_load(PROGRAMS["three cameras"][2]["c.yaml"])
    for name, topic in zip(document, ("/left", "/right", "/third"), strict=True):
        document[name]["rostopic"] = topic
    paths = write(tmp_path, {"c.yaml": yaml.safe_dump(document)})
    rig = import_rig(None, paths, pair=pair)
    shifted = pose(np.eye(3), np.array([0.1, 0.0, 0.0])) @ T_RIGHT_LEFT
    np.testing.assert_allclose(rig.T_left_right, inverse(shifted), atol=1e-12)


@pytest.mark.parametrize("name", PROGRAMS)
def test_damage_is_never_a_traceback(tmp_path, name):
    """Files cut short, with a line less or bytes changed: one line that names a file, or a rig."""
    _, format_, files, options = PROGRAMS[name]
    rng = np.random.default_rng(len(name))
    whole = {file: text if isinstance(text, bytes) else text.encode() for file, text in files.items()}
    for k in range(9):
        file = list(whole)[k % len(whole)]
        data = bytearray(whole[file])
        if k % 3 == 0:
            data = data[: int(rng.integers(len(data)))]
        elif k % 3 == 1:
            lines = bytes(data).split(b"\n")
            data = bytearray(b"\n".join(np.delete(np.array(lines, object), rng.integers(len(lines)))))
        else:
            for at in rng.integers(len(data), size=3):
                data[at] = int(rng.integers(256))
        paths = write(tmp_path, whole | {file: bytes(data)})
        for given in (None, format_):
            reported(given, paths, options)


def test_stereolabs_is_rectified_as_by_the_vendors_code(tmp_path):
    baseline, ty, tz, r = 119.9, 0.31, -0.42, np.array([0.004, 0.002, -0.003])
    file = re.sub(r"Baseline=.*\nTY=.*\nTZ=.*\n", f"Baseline={baseline}\nTY={ty}\nTZ={tz}\n", zed("HD"))
    for key, value in zip(("RX", "CV", "RZ"), r, strict=True):
        file = re.sub(rf"{key}_HD=.*", f"{key}_HD={value}", file)
    rig = import_rig(None, write(tmp_path, {"SN1.conf": file}))
    ours, cameras = (
        inverse(rig.T_left_right),
        (rig.left.matrix, np.zeros(5), rig.right.matrix, np.zeros(5), (1280, 720)),
    )
    # as calibration.hpp of zed-open-capture
    theirs = cv2.stereoRectify(*cameras, cv2.Rodrigues(r)[0], np.array([[baseline], [ty], [tz]]))
    own = cv2.stereoRectify(*cameras, ours[:3, :3], 1e3 * ours[:3, 3:])
    np.testing.assert_allclose(own[0], theirs[0], atol=1e-9)
    np.testing.assert_allclose(own[1], theirs[1], atol=1e-9)
