"""Calibrations of one pair of cameras as the programs of the field write them, from their documentation and source.

Every entry of PROGRAMS is (program and source, format, files, options): the files' texts or bytes by name, and what a
person adds. All describe the same pair, K_LEFT .. T, in the program's own names, syntax and unit.
"""

import gzip
import io
import json

import cv2
import numpy as np
import yaml

from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3, log_so3, quaternion_wxyz

SIZE = (1280, 720)
K_LEFT = np.array([[812.3, 0, 633.1], [0, 815.9, 352.7], [0, 0, 1]])
K_RIGHT = np.array([[799.8, 0, 641.2], [0, 801.1, 366.4], [0, 0, 1]])
D_LEFT, D_RIGHT = np.array([-0.31, 0.11, 8e-4, -6e-4]), np.array([-0.29, 0.1, -7e-4, 5e-4])
R, T = exp_so3(np.array([0.02, 0.19, -0.011])), np.array([-0.214, 0.0031, 0.0177])  # p_right = R p_left + T, m
T_RIGHT_LEFT = pose(R, T)
#: Poses of a body (an IMU, the world) before both cameras, for programs that keep those.
T_LEFT_BODY = pose(exp_so3(np.array([0.7, -1.1, 0.4])), np.array([0.05, -0.12, 0.8]))
T_RIGHT_BODY = T_RIGHT_LEFT @ T_LEFT_BODY


def five(d):
    return np.append(d, 0.0)


FIVES = five(D_LEFT), five(D_RIGHT)


def storage(suffix, **values):
    """What cv2.FileStorage writes."""
    file = cv2.FileStorage(suffix, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for key, value in values.items():
        file.write(key, value)
    return file.releaseAndGetString()


def npz(**values):
    file = io.BytesIO()
    np.savez(file, **values)
    return file.getvalue()


def npy(value):
    file = io.BytesIO()
    np.save(file, value)
    return file.getvalue()


POSE_CAMERA_2 = {"Dimensionality": 3, "Translation": (1e3 * T).tolist(), "R": R.tolist()}


def stereo_parameters(matrix, **pose_of_2):
    """MATLAB's stereoParameters: pixels from 1, mm, (height, width)."""
    one = np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    cameras = {}
    for k, (K, d) in enumerate(((K_LEFT, D_LEFT), (K_RIGHT, D_RIGHT)), 1):
        cameras[f"CameraParameters{k}"] = {
            "RadialDistortion": d[:2].tolist(),
            "TangentialDistortion": d[2:].tolist(),
            "ImageSize": list(SIZE[::-1]),
            matrix: (K + one if matrix == "K" else (K + one).T).tolist(),
        }
    return {**cameras, "TranslationOfCamera2": (1e3 * T).tolist(), "WorldUnits": "millimeters", **pose_of_2}


def named(K1, D1, K2, D2, R_="R", T_="T", scale=1e3, row=False, **more):
    """The six matrices under somebody's names, translation in mm."""
    d = [five(D_LEFT).reshape(1, -1), five(D_RIGHT).reshape(1, -1)]
    t = T * scale if row else (T * scale).reshape(3, 1)
    return {K1: K_LEFT, D1: d[0], K2: K_RIGHT, D2: d[1], R_: R, T_: t, **more}


def depthai():
    """A device of Luxonis: the left camera is known beside the right one, that beside the colour camera; cm."""

    def camera(K, d, to, R_=(), t=0 * T):
        step = {"rotationMatrix": np.asarray(R_).tolist(), "toCameraSocket": to, "lengthUnit": 1}
        step |= {
            key: dict(zip("xyz", v.tolist(), strict=True))
            for key, v in (("translation", 100 * t), ("specTranslation", 0 * t))
        }
        lens = {"cameraType": 0, "distortionCoeff": [*d.tolist(), *[0.0] * 10], "intrinsicMatrix": K.tolist()}
        return lens | {"extrinsics": step, "width": SIZE[0], "height": SIZE[1]}

    right = camera(K_RIGHT, D_RIGHT, 0, exp_so3(np.array([0.01, -0.02, 0.03])), np.array([0.0375, 0.001, 0.0]))
    return {
        "cameraData": [[2, right], [1, camera(K_LEFT, D_LEFT, 2, R, T)], [0, camera(K_LEFT, D_LEFT, -1)]],
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2},
        "version": 7,
    }


def lists(document):
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in document.items()}


def nested(T_body):
    return [[float(x) for x in row] for row in T_body]


def kalibr_camera(K, d, **more):
    return {
        "cam_overlaps": [0],
        "camera_model": "pinhole",
        "distortion_coeffs": [float(x) for x in d],
        "distortion_model": "radtan",
        "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "resolution": list(SIZE),
        "rostopic": "/cam/image_raw",
        **more,
    }


def chain(**poses):
    """A chain of two cameras; keys of poses: pose's name -> its value of cam0 and cam1."""
    cams = [kalibr_camera(K_LEFT, D_LEFT), kalibr_camera(K_RIGHT, D_RIGHT)]
    for key, values in poses.items():
        for cam, value in zip(cams, values, strict=True):
            if value is not None:
                cam[key] = nested(value)
    return {"cam0": cams[0], "cam1": cams[1]}


def euroc(K, d, T_body_camera):
    return {
        "sensor_type": "camera",
        "comment": "VI-Sensor cam (MT9M034)",
        "T_BS": {"cols": 4, "rows": 4, "data": [float(x) for x in T_body_camera.ravel()]},
        "rate_hz": 20,
        "resolution": list(SIZE),
        "camera_model": "pinhole",
        "intrinsics": [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])],
        "distortion_model": "radial-tangential",
        "distortion_coefficients": [float(x) for x in d],
    }


def rectified(d=FIVES, model="plumb_bob"):
    """R1 R2 P1 P2 of OpenCV."""
    args = (K_LEFT, np.ravel(d[0]), K_RIGHT, np.ravel(d[1]), SIZE, R, T.reshape(3, 1))
    fisheye = model == "equidistant"
    found = cv2.fisheye.stereoRectify(*args, flags=1024) if fisheye else cv2.stereoRectify(*args, alpha=0)
    return [np.asarray(m, float) for m in found[:4]]


def camera_info(side, style, d=FIVES, model="plumb_bob", digits=17, changes=None):
    """One camera's camera_info: of camera_calibration's files, rostopic echo, ros2 topic echo.

    Of a file, numbers are printed to some digits and entries changed; ... removes one.
    """
    k, (R1, R2, P1, P2) = int(side == "right"), rectified(d, model)
    matrices = d[k], (K_LEFT, K_RIGHT)[k], (R1, R2)[k], (P1, P2)[k]
    flat = [[float(f"{x:.{digits}g}") for x in np.ravel(m)] for m in matrices]
    if style == "file":
        names = ("distortion_coefficients", "camera_matrix", "rectification_matrix", "projection_matrix")
        document = {"image_width": SIZE[0], "image_height": SIZE[1], "camera_name": side, "distortion_model": model}
        for name, data in zip(names, flat, strict=True):
            rows = 1 if name == names[0] else 3
            document[name] = {"rows": rows, "cols": len(data) // rows, "data": data}
        document |= changes or {}
        return yaml.safe_dump({key: v for key, v in document.items() if v is not ...}, sort_keys=False)
    letters = "DKRP" if style == "ros1" else "dkrp"
    lines = ["header:", "  stamp:", "    secs: 5", "  frame_id: cam", f"height: {SIZE[1]}", f"width: {SIZE[0]}"]
    lines.append("distortion_model: " + ('"plumb_bob"' if style == "ros1" else "plumb_bob"))
    for letter, data in zip(letters, flat, strict=True):
        if style == "ros1":
            lines.append(f"{letter}: {data}")
        else:
            lines += [f"{letter}:", *(f"- {x}" for x in data)]
    lines += [
        "binning_x: 0",
        "binning_y: 0",
        "roi:",
        "  x_offset: 0",
        "  height: 0",
        "  width: 0",
        "  do_rectify: false",
    ]
    return "\n".join(lines) + "\n" + ("---\n" if style == "ros2" else "")


def basalt(kind):
    def entry(K, d):
        numbers = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        numbers |= dict(zip(("k1", "k2", "p1", "p2"), map(float, d), strict=True))
        numbers |= {"k3": 0.0, "k4": 0.0, "k5": 0.0, "k6": 0.0, "rpmax": 0.0}
        return {"camera_type": kind, "intrinsics": numbers}

    def quaternion(T_camera_body):
        T_body_camera = inverse(T_camera_body)
        w, x, y, z = quaternion_wxyz(T_body_camera[:3, :3])
        p = T_body_camera[:3, 3]
        return {"px": p[0], "py": p[1], "pz": p[2], "qx": x, "qy": y, "qz": z, "qw": w}

    value = {
        "T_imu_cam": [quaternion(T_LEFT_BODY), quaternion(T_RIGHT_BODY)],
        "intrinsics": [entry(K_LEFT, D_LEFT), entry(K_RIGHT, D_RIGHT)],
        "resolution": [list(SIZE), list(SIZE)],
        "vignette": [],
    }
    return json.dumps({"value0": value})


def orbslam3():
    lines = ["%YAML:1.0", "", 'File.version: "1.0"', 'Camera.type: "PinHole"']
    for n, K, d in (("1", K_LEFT, D_LEFT), ("2", K_RIGHT, D_RIGHT)):
        numbers = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d)
        lines += [
            f"Camera{n}.{key}: {x}"
            for key, x in zip(["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"], numbers, strict=True)
        ]
    data = ", ".join(f"{x!r}" for x in inverse(T_RIGHT_LEFT).ravel().tolist())
    lines += [f"Camera.width: {SIZE[0]}", f"Camera.height: {SIZE[1]}", "Camera.fps: 20", "Stereo.ThDepth: 60.0"]
    lines += ["Stereo.T_c1_c2: !!opencv-matrix", "  rows: 4", "  cols: 4", "  dt: f", f"  data: [{data}]"]
    return "\n".join(lines) + "\n"


def orbslam2():
    R1, R2, P1, P2 = rectified()
    values = {"Camera.fx": 435.2, "Camera.bf": 47.9}
    for side, K, d, R_, P in (("LEFT", K_LEFT, D_LEFT, R1, P1), ("RIGHT", K_RIGHT, D_RIGHT, R2, P2)):
        parts = {"height": SIZE[1], "width": SIZE[0], "D": five(d).reshape(1, 5), "K": K, "R": R_, "P": P}
        values |= {f"{side}.{key}": value for key, value in parts.items()}
    lines = ["%YAML:1.0"]
    for key, value in values.items():
        if isinstance(value, np.ndarray):
            lines += [f"{key}: !!opencv-matrix", f"   rows: {value.shape[0]}", f"   cols: {value.shape[1]}", "   dt: d"]
            lines.append(f"   data: {value.ravel().tolist()}")
        else:
            lines.append(f"{key}: {value}")
    return "\n".join(lines) + "\n"


def toml_camera(table, T_camera_world, K, d, rotation="vector", scale=1.0, more=""):
    r = log_so3(T_camera_world[:3, :3]) if rotation == "vector" else T_camera_world[:3, :3]
    return (
        f"[{table}]\n{more}size = {list(SIZE)}\nmatrix = {K.tolist()}\ndistortions = {d.tolist()}\n"
        f"translation = {(scale * T_camera_world[:3, 3]).tolist()}\nrotation = {r.tolist()}\n\n"
    )


def caliscope(
    rotation="vector", scale=1.0, tables=("cameras.0", "cameras.1"), more="rotation_count = 0\nignore = false\n"
):
    return toml_camera(tables[0], T_LEFT_BODY, K_LEFT, five(D_LEFT), rotation, scale, more) + toml_camera(
        tables[1], T_RIGHT_BODY, K_RIGHT, five(D_RIGHT), rotation, scale, more
    )


def multical(master):
    def camera(K, d):
        return {"model": "standard", "image_size": list(SIZE), "K": K.tolist(), "dist": [five(d).tolist()]}

    def transform(T_):
        return {"R": T_[:3, :3].tolist(), "T": T_[:3, 3].tolist()}

    poses = (
        {"cam1": transform(np.eye(4)), "cam2_to_cam1": transform(T_RIGHT_LEFT)}
        if master
        else {"cam1": transform(T_LEFT_BODY), "cam2": transform(T_RIGHT_BODY)}
    )
    cameras = {"cam1": camera(K_LEFT, D_LEFT), "cam2": camera(K_RIGHT, D_RIGHT)}
    return json.dumps({"cameras": cameras, "camera_poses": poses, "image_sets": {"rgb": []}})


def mrcal(side, key="extrinsics", lens="LENSMODEL_OPENCV5"):
    K, d, T_ = (K_LEFT, D_LEFT, T_LEFT_BODY) if side == "left" else (K_RIGHT, D_RIGHT, T_RIGHT_BODY)
    count = {"LENSMODEL_OPENCV4": 4, "LENSMODEL_OPENCV5": 5, "LENSMODEL_OPENCV8": 8}[lens]
    numbers = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.pad(d, (0, count - 4))]
    rt = [*log_so3(T_[:3, :3]), *T_[:3, 3]]
    return (
        f"# generated on 2024-11-14\n{{\n    'lensmodel':  '{lens}',\n\n    # intrinsics are fx,fy,cx,cy,..\n"
        f"    'intrinsics': [ {', '.join(repr(float(x)) for x in numbers)},],\n\n"
        "    'valid_intrinsics_region': [\n    [ 0, 0 ],\n],\n\n"
        f"    '{key}': [ {', '.join(repr(float(x)) for x in rt)},],\n\n    'imagersize': [ {SIZE[0]}, {SIZE[1]},],\n\n"
        "    'optimization_inputs': b'P)h>@6aWAK2mk;8AprP8',\n}\n"
    )


def zed(*names):
    """SN*.conf: p_right = R p_left - (Baseline, TY, TZ), R of (RX, CV, RZ); mm."""
    text = ""
    for name in names:
        for side, K, d in (("LEFT", K_LEFT, D_LEFT), ("RIGHT", K_RIGHT, D_RIGHT)):
            text += f"[{side}_CAM_{name}]\nfx={K[0, 0]}\nfy={K[1, 1]}\ncx={K[0, 2]}\ncy={K[1, 2]}\n"
            text += (
                "".join(f"{key}={value}\n" for key, value in zip(("k1", "k2", "p1", "p2"), d, strict=True)) + "k3=0\n\n"
            )
    r, t = log_so3(R), T * 1e3
    text += f"[STEREO]\nBaseline={-t[0]}\nTY={-t[1]}\nTZ={-t[2]}\n"
    for name in names:
        text += f"CV_{name}={r[1]}\nRX_{name}={r[0]}\nRZ_{name}={r[2]}\n"
    return text + "\n[MISC]\nSensor_ID=0\n"


MM = {"unit_m": 1e-3}
MM_SIZE = MM | {"image_size_px": SIZE}
YML = ".yml"
BOUGUET = {
    "fc_left": K_LEFT[[0, 1], [0, 1]],
    "cc_left": K_LEFT[:2, 2],
    "kc_left": five(D_LEFT).reshape(5, 1),
    "fc_right": K_RIGHT[[0, 1], [0, 1]],
    "cc_right": K_RIGHT[:2, 2],
    "kc_right": five(D_RIGHT).reshape(5, 1),
    "alpha_c_left": 0.0,
    "om": log_so3(R).reshape(3, 1),
    "R": R,
    "T": (1e3 * T).reshape(3, 1),
    "nx": SIZE[0],
    "ny": SIZE[1],
}
_k1 = named("K1", "D1", "K2", "D2")
_json_two = {
    "image_size": list(SIZE),
    "left": {"K": K_LEFT.tolist(), "dist": five(D_LEFT).tolist()},
    "right": {"K": K_RIGHT.tolist(), "dist": five(D_RIGHT).tolist()},
    "R": R.tolist(),
    "T": (1e3 * T).tolist(),
}
_link = [None, T_RIGHT_LEFT]
_third = kalibr_camera(K_RIGHT, D_RIGHT, T_cn_cnm1=nested(np.eye(4) + np.eye(4, k=3) * 0.1))

#: Name -> (program and where it is described), format, files, options.
PROGRAMS = {
    "depthai": ("depthai 3.12.0, eepromToJsonFile", "depthai", {"calib.json": json.dumps(depthai())}, {}),
    "stereo_calib": ("opencv 4, samples/cpp/stereo_calib.cpp", "opencv",
        {"both.yml": storage(YML, **named("M1", "D1", "M2", "D2", Q=np.eye(4)))}, MM_SIZE),
    "stereo_calib 5": ("opencv 5, %YAML 1.2 header", "opencv",
        {"both.yml": storage(YML, **named("M1", "D1", "M2", "D2")).replace("%YAML:1.0", "%YAML 1.2")}, MM_SIZE),
    "k1": ("sourishg/stereo-calibration, calib_stereo.cpp", "opencv",
        {"cam_stereo.yml": storage(YML, **_k1, E=np.diag([1.0, 2, 3]), F=np.eye(3) * 0.1)}, MM_SIZE),
    "cameraMatrix1": ("opencv_contrib and tutorials, cameraMatrix1", "opencv",
        {"camera.yml": storage(YML, **named("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"), imageSize=np.array([SIZE], np.int32))}, MM),
    "stereoMapL": ("niconielsen32/ComputerVision, stereo tutorial", "opencv",
        {"stereo.xml": storage(".xml", **named("cameraMatrixL", "distL", "cameraMatrixR", "distR", "rot", "trans"))}, MM_SIZE),
    "xml": ("opencv 4, FileStorage in XML", "opencv",
        {"both.xml": storage(".xml", **named("M1", "D1", "M2", "D2"))}, MM_SIZE),
    "json storage": ("opencv 4, FileStorage in JSON", "opencv",
        {"both.json": storage(".json", **named("M1", "D1", "M2", "D2"))}, MM_SIZE),
    "gz": ("opencv 4, FileStorage named .yml.gz", "opencv",
        {"rig.yml.gz": gzip.compress(storage(YML, **_k1).encode())}, MM_SIZE),
    "mtxL": ("spmallick/learnopencv, stereo-camera", "opencv",
        {"stereo.npz": npz(**named("mtxL", "distL", "mtxR", "distR", "Rot", "Trns"))}, MM_SIZE),
    "left_K": ("numpy.savez of tutorials", "opencv",
        {"c.npz": npz(**named("left_K", "left_D", "right_K", "right_D"), image_size=np.array(SIZE))}, MM),
    "K_l": ("numpy.savez of tutorials", "opencv",
        {"c.npz": npz(**named("K_l", "dist_l", "K_r", "dist_r", row=True), img_shape=np.array(SIZE[::-1]))}, MM),
    "cam0 cam1": ("numpy.savez of tutorials", "opencv", {"c.npz": npz(**named("K0", "d0", "K1", "d1"))}, MM_SIZE),
    "npz gz-like": ("numpy.savez_compressed", "opencv",
        {"c.npz": npz(**named("cameraMatrix_left", "distCoeffs_left", "cameraMatrix_right", "distCoeffs_right"))}, MM_SIZE),
    "npy": ("numpy.save of each array", "opencv", {f"{key}.npy": npy(value) for key, value in _k1.items()}, MM_SIZE),
    "optimal too": ("tutorials that keep getOptimalNewCameraMatrix", "opencv",
        {"c.npz": npz(**_k1, newK1=K_LEFT * 0.9, newK2=K_RIGHT * 0.9, roi_L=np.array([0, 0, 5, 5]))}, MM_SIZE),
    "json lists": ("json.dump of lists", "opencv",
        {"c.json": json.dumps(lists(named("camera_matrix_left", "dist_left", "camera_matrix_right", "dist_right")))}, MM_SIZE),
    "json nested": ("json.dump of nested names", "opencv", {"c.json": json.dumps(_json_two)}, MM),
    "yaml lists": ("yaml.safe_dump of lists", "opencv",
        {"c.yaml": yaml.safe_dump(lists(named("M1", "D1", "M2", "D2")), default_flow_style=None)}, MM_SIZE),
    "toml": ("toml.dump of lists", "opencv",
        {"c.toml": "\n".join(f"{k} = {v}" for k, v in lists(named("K_left", "D_left", "K_right", "D_right")).items())}, MM_SIZE),
    "bouguet": ("Bouguet's toolbox for MATLAB, Calib_Results_stereo.mat by jsonencode(load(..))", "opencv",
        {"Calib_Results_stereo.json": json.dumps({k: np.squeeze(v).tolist() for k, v in BOUGUET.items()})}, MM),
    "stereoParams": ("MATLAB R2019b, Computer Vision Toolbox, jsonencode(toStruct(stereoParams))", "stereoparams",
        {"stereoParams.json": json.dumps(stereo_parameters("IntrinsicMatrix", RotationOfCamera2=R.T.tolist()))}, {}),
    "stereoParams, K": ("MATLAB R2023a, jsonencode(load('stereo.mat')), PoseCamera2", "stereoparams",
        {"stereo.json": json.dumps({"stereoParams": stereo_parameters("K", PoseCamera2=POSE_CAMERA_2)})}, {}),
    "14": ("opencv 4, CALIB_RATIONAL_MODEL: 14 coefficients", "opencv",
        {"c.yml": storage(YML, **(_k1 | {"D1": np.pad(D_LEFT, (0, 10)).reshape(1, 14), "D2": np.pad(D_RIGHT, (0, 10)).reshape(1, 14)}))}, MM_SIZE),
    "ros files": ("camera_calibration 1.17, left.yaml right.yaml", "ros",
        {f"{s}.yaml": camera_info(s, "file") for s in ("left", "right")}, {}),
    "rostopic": ("ROS 1 Noetic, rostopic echo -n 1", "ros",
        {f"{s}.txt": camera_info(s, "ros1") for s in ("left", "right")}, {}),
    "ros2 topic": ("ROS 2 Humble, ros2 topic echo --once", "ros",
        {f"{s}.yaml": camera_info(s, "ros2") for s in ("left", "right")}, {}),
    "camchain": ("Kalibr wiki, yaml formats: camchain", "kalibr",
        {"camchain.yaml": yaml.safe_dump(chain(T_cn_cnm1=_link))}, {}),
    "camchain-imucam": ("Kalibr wiki: camchain-imucam", "kalibr",
        {"c.yaml": yaml.safe_dump(chain(T_cn_cnm1=_link, T_cam_imu=[T_LEFT_BODY, T_RIGHT_BODY]))}, {}),
    "T_cam_imu": ("Kalibr, poses to the IMU alone", "kalibr",
        {"c.yaml": yaml.safe_dump(chain(T_cam_imu=[T_LEFT_BODY, T_RIGHT_BODY]))}, {}),
    "openvins": ("open_vins 2.7, config/*/kalibr_imucam_chain.yaml", "kalibr",
        {"c.yaml": "%YAML:1.0\n\n" + yaml.safe_dump(chain(T_imu_cam=[inverse(T_LEFT_BODY), inverse(T_RIGHT_BODY)]))}, {}),
    "three cameras": ("Kalibr, a chain of three", "kalibr",
        {"c.yaml": yaml.safe_dump(chain(T_cn_cnm1=_link) | {"cam2": _third})}, {"pair": ("cam0", "cam1")}),
    "euroc": ("EuRoC MAV, mav0/cam*/sensor.yaml", "kalibr",
        {"cam0.yaml": yaml.safe_dump(euroc(K_LEFT, D_LEFT, inverse(T_LEFT_BODY))), "cam1.yaml": "%YAML:1.0\n" + yaml.safe_dump(euroc(K_RIGHT, D_RIGHT, inverse(T_RIGHT_BODY)))}, {}),
    "basalt": ("basalt, doc/Calibration.md: pinhole-radtan8", "basalt",
        {"calibration.json": basalt("pinhole-radtan8")}, {}),
    "orbslam3": ("ORB-SLAM3 1.0, Examples/Stereo/EuRoC.yaml", "orbslam", {"EuRoC.yaml": orbslam3()}, {}),
    "orbslam2": ("ORB-SLAM2, Examples/Stereo/EuRoC.yaml", "orbslam", {"EuRoC.yaml": orbslam2()}, {}),
    "caliscope": ("caliscope, tests/reference/2d_data/camera_array.toml", "caliscope",
        {"camera_array.toml": caliscope()}, {}),
    "caliscope matrix": ("caliscope 0.1, rotation as a matrix", "caliscope",
        {"camera_array.toml": caliscope("matrix")}, {}),
    "aniposelib": ("aniposelib 0.4, CameraGroup.dump; a board in mm", "caliscope",
        {"calibration.toml": caliscope(scale=1e3, tables=("cam_0", "cam_1"), more='name = "A"\nfisheye = false\n') + "[metadata]\nadjusted = false\nerror = 0.26\n"}, MM),
    "pose2sim": ("pose2sim 0.10.49 of EasyMocap: the size is twice the principal point", "caliscope",
        {"Calib.toml": caliscope().replace(str(list(SIZE)), "[1266.2, 705.4]", 1).replace(str(list(SIZE)), "[1282.4, 732.8]")}, {"image_size_px": SIZE}),
    "multical": ("multical 0.2, io/export_calib.py with a master", "multical", {"calibration.json": multical(True)}, {}),
    "multical no master": ("multical 0.2, io/export_calib.py", "multical", {"calibration.json": multical(False)}, {}),
    "mrcal 5": ("mrcal 2.4, cameramodel, OPENCV5", "mrcal", {f"{s}.cameramodel": mrcal(s) for s in ("left", "right")}, {}),
    "mrcal 8": ("mrcal, rt_cam_ref, OPENCV8", "mrcal",
        {f"{s}.cameramodel": mrcal(s, "rt_cam_ref", "LENSMODEL_OPENCV8") for s in ("left", "right")}, {}),
    "mrcal 4": ("mrcal, OPENCV4", "mrcal",
        {f"{s}.cameramodel": mrcal(s, lens="LENSMODEL_OPENCV4") for s in ("left", "right")}, {}),
    "zed": ("Stereolabs, SN*.conf of one resolution", "stereolabs", {"SN12345.conf": zed("HD")}, {}),
    "zed all": ("Stereolabs, SN*.conf of all resolutions", "stereolabs",
        {"SN12345.conf": zed("2K", "FHD", "HD", "VGA")}, {"image_size_px": SIZE}),
}  # fmt: skip


def write(folder, files):
    """Write an entry's files; return their paths in order."""
    paths = []
    for name, content in files.items():
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        paths.append(folder / name)
    return paths
