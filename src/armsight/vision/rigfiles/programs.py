"""Formats of programs that keep each camera's pose in a third frame, or the pair's; all but Kalibr's are read alone.

kalibr: Kalibr's camchain YAML, OpenVINS's chains to the IMU, and the sensor.yaml pairs of EuRoC recordings.

``T_cn_cnm1`` takes the coordinates of the camera before to camera n's, in metres; where a camera has none, its pose to the
IMU holds: ``T_cam_imu`` takes the IMU's coordinates to the camera's, ``T_imu_cam`` and EuRoC's ``T_BS`` the other way.
Models: pinhole with radtan (Brown-Conrady, four coefficients), equidistant (Kannala-Brandt) or none.

mrcal: mrcal's .cameramodel files, one a camera, the left one first.

Intrinsics are fx fy cx cy and OpenCV's distortion; ``extrinsics`` (later ``rt_cam_ref``) is the rotation vector and the
translation, m, that take the reference's coordinates to the camera's. Splined and CAHVOR lenses are not read.

basalt: Basalt's calibration.json: ``value0`` with T_imu_cam (px py pz qx qy qz qw, m), intrinsics, resolution.

Read are pinhole, pinhole-radtan8 and kb4 (Kannala-Brandt); its own ds, ucm and eucm are not.

caliscope: Camera arrays of caliscope (``[cameras.0]``) and aniposelib (``[cam_0]``): TOML, a table for each camera.

``rotation``, a rotation vector or a matrix, and ``translation`` take the world's coordinates to the camera's; caliscope's
are in m, aniposelib's in the unit of the board.

multical: multical's calibration.json: ``cameras`` with K, dist, image_size, and ``camera_poses`` with R and T, m.

A pose takes the coordinates of the rig, or of the master camera, to the camera's: p_cam2 = R p_cam1 + T in the entry
``cam2_to_cam1`` (which is what its name does not say). The model of a fisheye lens is called ``standard``, too (0.4.0,
camera_fisheye.py): its four coefficients are a column, as ``cv2.fisheye.calibrate`` returns them, others are a row.

stereolabs: Stereolabs' SN*.conf of a ZED camera: sections LEFT_CAM_HD, RIGHT_CAM_HD, .. for each resolution, and STEREO.

The right camera stands Baseline mm to the right; its rotation is the vector (RX, CV, RZ), rad, of the section's
resolution: p_right = R p_left - (Baseline, TY, TZ). zed-open-capture's calibration.hpp gives (Baseline, TY, TZ) to
stereoRectify, which rectifies alike for both signs of the whole vector, and the right camera is the right one.

orbslam: ORB-SLAM's stereo settings: ORB-SLAM3's Camera1.fx .. and Stereo.T_c1_c2, ORB-SLAM2's LEFT.K LEFT.D LEFT.R LEFT.P.

T_c1_c2 takes the right camera's coordinates to the left one's, m; of images that are rectified already the file has
Stereo.b, the baseline, alone. LEFT and RIGHT are ROS's matrices, and are read as those.

depthai: Luxonis' calibration of a device, CalibrationHandler.eepromToJsonFile's: ``cameraData``, sockets and their cameras,
called CAM_A, CAM_B, .. The left and the right one are those of ``stereoRectificationData``.

``extrinsics`` take a camera's coordinates to those of ``toCameraSocket``, p_to = R p + t, cm whatever its lengthUnit says
(depthai 3.12.0 reads them so). They are of raw images of the size beside them, not of StereoDepth's rectified ones.

stereoparams: MATLAB's stereoParameters as JSON, by jsonencode of the object or of toStruct(stereoParams).

Pixels count from 1 there; K, or IntrinsicMatrix, its transpose; ImageSize is (height, width). RotationOfCamera2 is
transposed, p2 = p1 R + t for rows; PoseCamera2, of later versions, is for columns. WorldUnits name the unit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from armsight.data import SIDES, Array
from armsight.errors import InputError, naming
from armsight.files import natural_key
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse, pose
from armsight.geometry.rotation import exp_so3, from_quaternion_wxyz
from armsight.tables.document import Foreign, dump_yaml
from armsight.tables.lengths import UNITS_M
from armsight.vision.camera import Camera
from armsight.vision.camera_file import camera_of, found, is_camera
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles.rigfile import (
    Document,
    Entries,
    ImportOptions,
    RigFormat,
    count_paths,
    imported,
    need,
    need_named,
    not_held,
    posed_format,
    rigid,
    write_together,
)
from armsight.vision.rigfiles.ros import rig_of

#: Lens models whose parameters are OpenCV's.
_LENSES = {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)} | {"LENSMODEL_PINHOLE": 0}


def _mrcal_entries(documents: Sequence[Document], paths: Sequence[Path]) -> Entries:
    """Return the left and the right camera by their files' names."""
    entries = dict[str, Document]()
    for path, document in zip(paths, documents, strict=True):
        with naming(path):
            entries[path.name if path.name not in entries else str(path)] = mrcal_entry(document)
    return entries


def _mrcal_pose(entries: Entries, name: str) -> tuple[Array, list[str]]:
    value = entries[name]["pose"]
    rt = checked([] if value is None else value, (6,), f"{name}: extrinsics")
    return pose(exp_so3(rt[:3]), rt[3:]), []


def mrcal_entry(document: Document) -> Mapping[str, Foreign]:
    """Return a camera's entry under the names of :mod:`~armsight.vision.camera_file`."""
    lens = str(need(document, "lensmodel"))
    if lens not in _LENSES:
        raise InputError(
            f"lens {lens.split('_order')[0]} is not supported; supported are {', '.join(_LENSES)}: convert it with "
            "mrcal-convert-lensmodel LENSMODEL_OPENCV8"
        )
    numbers = checked(need(document, "intrinsics"), (4 + _LENSES[lens],), f"intrinsics of {lens}")
    return {
        "K": numbers[:4],
        "distortion": np.array(numbers[4:]),
        "distortion_model": "opencv",
        "imagersize": need(document, "imagersize"),
        "pose": document.get("rt_cam_ref", document.get("extrinsics")),
    }


def _basalt_recognises(documents: Sequence[Document]) -> bool:
    return any(isinstance(value := document.get("value0"), Mapping) and "T_imu_cam" in value for document in documents)


def _basalt_entries(documents: Sequence[Document], paths: Sequence[Path]) -> Entries:
    """Return the cameras, called cam0, cam1, .. in their order."""
    inner = need_named(documents[0], "value0")
    poses, cameras, sizes = (need(inner, key) for key in ("T_imu_cam", "intrinsics", "resolution"))
    if not all(isinstance(part, list) for part in (poses, cameras, sizes)) or not all(
        isinstance(camera, Mapping) for camera in cameras
    ):
        raise InputError("T_imu_cam, intrinsics and resolution must be lists with an entry for each camera")
    if not len(poses) == len(cameras) == len(sizes):
        raise InputError(f"has {len(poses)} poses, {len(cameras)} intrinsics and {len(sizes)} resolutions")
    entries = {}
    for i, (camera, size, T) in enumerate(zip(cameras, sizes, poses, strict=True)):
        kind = camera.get("camera_type")
        plain: Mapping[str, object] = {"distortion": []} if kind == "pinhole" else {}
        entries[f"cam{i}"] = {**camera, **plain, "distortion_model": kind, "resolution": size, "pose": T}
    return entries


def _basalt_pose(entries: Entries, name: str) -> tuple[Array, list[str]]:
    """Return the inverse of a camera's pose before the IMU."""
    given = entries[name]["pose"]
    p, q = (checked([need(given, key) for key in keys], (len(keys),), f"T_imu_cam of {name}") for keys in _KEYS)
    return inverse(pose(from_quaternion_wxyz(q / np.linalg.norm(q)), p)), []


_KEYS = (("px", "py", "pz"), ("qw", "qx", "qy", "qz"))

_ROTATIONS = ("rotation", "rotationvector", "rvec", "r")
_TRANSLATIONS = ("translation", "tvec", "t")


def _caliscope_entries(document: Document) -> dict[str, Mapping[str, Foreign]]:
    """Return the tables of the cameras, caliscope's ignored ones left out."""
    inner = document.get("cameras", document)
    if not isinstance(inner, Mapping):
        return {}
    return {str(name): one for name, one in inner.items() if is_camera(one) and one.get("ignore") is not True}


def _caliscope_recognises(documents: Sequence[Document]) -> bool:
    """Say whether a file has tables of cameras with their poses."""
    return len(documents) == 1 and any(
        found(entry, _TRANSLATIONS) is not None and found(entry, _ROTATIONS) is not None
        for entry in _caliscope_entries(documents[0]).values()
    )


def _caliscope_pose(entries: Entries, name: str) -> tuple[Array, list[str]]:
    """Return a camera's pose, its rotation given as a vector or a matrix."""
    R, t = (found(entries[name], names) for names in (_ROTATIONS, _TRANSLATIONS))
    if R is None or t is None:
        raise InputError(f"{name} has no rotation and translation: its pose was not calibrated")
    R = np.asarray(R, object)
    if R.size == 3:
        R = exp_so3(checked(R.ravel(), (3,), f"rotation of {name}"))
    return rigid(R, np.ravel(np.asarray(t, object)), f"rotation of {name}")


def _multical_recognises(documents: Sequence[Document]) -> bool:
    return any(
        all(isinstance(document.get(key), Mapping) for key in ("cameras", "camera_poses")) for document in documents
    )


def _multical_entries(documents: Sequence[Document], paths: Sequence[Path]) -> Entries:
    """Return the cameras, each with the lens that its coefficients have the shape of, and all poses."""
    poses = {str(k).partition("_to_")[0]: value for k, value in need_named(documents[0], "camera_poses").items()}
    entries = dict(need_named(documents[0], "cameras"))
    for name, entry in entries.items():
        if isinstance(entry, Mapping):
            fisheye = np.shape(np.asarray(entry.get("dist"), object)) == (4, 1)
            entries[name] = {**entry, **({"model": "fisheye"} if fisheye else {}), "camera_poses": poses}
    return entries


def _multical_pose(entries: Entries, name: str) -> tuple[Array, list[str]]:
    poses = entries[name]["camera_poses"]
    if name not in poses:
        raise InputError(f"camera_poses has no {name}; there are {', '.join(poses)}")
    return rigid(need(poses[name], "R"), need(poses[name], "T"), f"R of {name}")


#: Luxonis' cameraType -> the lens, and how many of the coefficients beside it are its.
_DEPTHAI_LENSES = {0: ("perspective", 14), 1: ("fisheye", 4)}


def _depthai_entries(documents: Sequence[Document], paths: Sequence[Path]) -> Entries:
    """Return the cameras, the left and the right one first, each with its step towards the reference, cm."""
    stereo = documents[0].get("stereoRectificationData")
    first = [stereo.get(f"{side}CameraSocket") for side in SIDES] if isinstance(stereo, Mapping) else []
    entries = dict[str, Mapping[str, Foreign]]()
    try:
        cameras = {int(socket): camera for socket, camera in need(documents[0], "cameraData")}
        if not set(first) & set(cameras) and {1, 2} <= set(cameras):
            first = [1, 2]  # no stereo data: CAM_B and CAM_C are left and right in depthai's own names
        for socket in sorted(cameras, key=lambda socket: (first.index(socket) if socket in first else 2, socket)):
            camera, step = cameras[socket], cameras[socket]["extrinsics"]
            lens, count = _DEPTHAI_LENSES.get(camera["cameraType"], (f"cameraType {camera['cameraType']}", 0))
            entries[_socket(socket)] = {
                "name": SIDES[first.index(socket)] if socket in first else "",
                "K": camera["intrinsicMatrix"],
                "distortion": camera["distortionCoeff"][:count],
                "distortion_model": lens,
                "image_size": (camera["width"], camera["height"]),
                "to": _socket(step["toCameraSocket"]),
                "rotation": step["rotationMatrix"],
                "translation": [step["translation"][axis] for axis in "xyz"],
            }
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"cameraData is not as depthai writes it: {error!r}") from None
    return entries


def _depthai_pose(entries: Entries, name: str) -> tuple[Array, list[str]]:
    """Return a camera's pose before the one that all lead to."""
    T, at, notes = np.eye(4), name, ["raw images, not rectified ones; cm without --unit-m"]
    for _ in entries:
        if (to := entries[at]["to"]) in entries:
            step, said = rigid(entries[at]["rotation"], entries[at]["translation"], f"rotation of {at}")
            T, at, notes = step @ T, to, notes + said
    if entries[at]["to"] in entries:
        raise InputError(f"the extrinsics of {name} lead in a circle; depthai rejects it as well")
    if at != _reference(entries, next(iter(entries))):
        raise InputError(f"the extrinsics of {name} lead to {at}, not to the other camera: they were not calibrated")
    return inverse(T), notes


def _reference(entries: Entries, name: str) -> str:
    """Return the camera that a camera's steps lead to."""
    for _ in entries:
        name = entries[name]["to"] if entries[name]["to"] in entries else name
    return name


def _socket(number: int) -> str:
    return f"CAM_{chr(ord('A') + number)}"


#: Name of a resolution in the file -> its image size, px.
SIZES = {
    "VGA": (672, 376),
    "HD": (1280, 720),
    "FHD": (1920, 1080),
    "2K": (2208, 1242),
    "SVGA": (960, 600),
    "FHD1200": (1920, 1200),
    "QHDPLUS": (3200, 1800),
    "4K": (3840, 2160),
}


def _stereolabs_recognises(documents: Sequence[Document]) -> bool:
    return any(str(key).upper().startswith(("LEFT_CAM_", "RIGHT_CAM_")) for document in documents for key in document)


def _stereolabs_read(documents: Sequence[Document], paths: Sequence[Path], options: ImportOptions) -> StereoRig:
    """Read the cameras of one resolution: that of ``image_size_px``, or the only one."""
    count_paths(paths, (1,), "one file, SN12345.conf")
    with naming(paths[0]):
        sections = {str(key).upper(): value for key, value in documents[0].items() if isinstance(value, Mapping)}
        names = [name for name in SIZES if {f"LEFT_CAM_{name}", f"RIGHT_CAM_{name}"} <= set(sections)]
        if options.image_size_px is not None:
            chosen = [name for name in names if SIZES[name] == options.image_size_px]
        else:
            chosen = names
        if len(chosen) != 1:
            there = ", ".join(f"{name} {SIZES[name][0]}x{SIZES[name][1]}" for name in names) or "none of both cameras"
            raise InputError(f"resolutions in it: {there}; give --image-size, that of the images to be measured in")
        (name,) = chosen
        cameras, notes = [], [f"resolution {name}, {SIZES[name][0]}x{SIZES[name][1]} px"]
        for side in ("LEFT", "RIGHT"):
            with naming(f"{side}_CAM_{name}"):
                camera, said = camera_of(
                    {**sections[f"{side}_CAM_{name}"], "image_size": SIZES[name], "distortion_model": "brown"}
                )
            cameras.append(camera)
            notes += said
        stereo = {str(key).upper(): value for key, value in need_named({"STEREO": {}} | sections, "STEREO").items()}
        values = {}
        for key in ("BASELINE", "TY", "TZ", "RX", "CV", "RZ"):
            value = stereo.get(f"{key}_{name}", stereo.get(key))
            if value is None and key not in ("TY", "TZ"):
                raise InputError(f"section STEREO has no {key}_{name}; there are {', '.join(stereo) or 'no names'}")
            values[key] = 0.0 if value is None else value
        r = checked([values[key] for key in ("RX", "CV", "RZ")], (3,), f"RX CV RZ of {name}")
        b, ty, tz = checked([values[key] for key in ("BASELINE", "TY", "TZ")], (3,), "Baseline TY TZ")
    T_right_left = pose(exp_so3(r), -np.array([b, ty, tz]))
    return imported(cameras, inverse(T_right_left), options, paths, notes, 1e-3)


def _orbslam_recognises(documents: Sequence[Document]) -> bool:
    return any({"Camera1.fx", "LEFT.K"} & set(document) for document in documents)


def _orbslam_read(documents: Sequence[Document], paths: Sequence[Path], options: ImportOptions) -> StereoRig:
    count_paths(paths, (1,), "one settings file")
    (document,), (path,) = documents, paths
    if "LEFT.K" in document:
        return rig_of([_orbslam_part(document, side) for side in ("LEFT", "RIGHT")], [path, path], options)
    with naming(path):
        rectified = document.get("Camera.type") == "Rectified"
        shared = {
            "distortion_model": str(document.get("Camera.type", "pinhole")),
            "width": document.get("Camera.width"),
            "height": document.get("Camera.height"),
        }
        cameras, notes = [], []
        for name in ("Camera1", "Camera1" if rectified else "Camera2"):
            entry = {**shared, **_orbslam_part(document, name)}
            if "k1" not in entry:
                entry["distortion"] = []
            with naming(name):
                camera, said = camera_of(entry, options.image_size_px)
            cameras.append(camera)
            notes += said
        if rectified:
            T = np.eye(4)
            T[0, 3] = checked(document.get("Stereo.b", np.nan), (), "Stereo.b")
            said = ["rectified images: both cameras alike, Stereo.b apart"]
        elif "Stereo.T_c1_c2" in document:
            given = checked(document["Stereo.T_c1_c2"], (4, 4), "Stereo.T_c1_c2")
            T, said = rigid(given[:3, :3], given[:3, 3], "Stereo.T_c1_c2")
        else:
            raise InputError("has no Stereo.T_c1_c2, the pose of the right camera: settings of one camera, or of RGB-D")
    return imported(cameras, T, options, paths, notes + said)


def _orbslam_part(document: Document, name: str) -> dict[str, Foreign]:
    """Return the entries ``name.X`` as X."""
    return {key.removeprefix(f"{name}."): value for key, value in document.items() if key.startswith(f"{name}.")}


#: Names of units in MATLAB, m.
_WORLD_UNITS = {**UNITS_M, "millimeters": 1e-3, "meters": 1.0, "centimeters": 1e-2, "in": 0.0254}


def _matlab_inner(document: Document) -> Mapping[str, Foreign] | None:
    """Return the mapping of a stereoParameters object, which may stand under the variable's name."""
    for one in (document, *(value for value in document.values() if isinstance(value, Mapping))):
        if "CameraParameters1" in one and {"PoseCamera2", "TranslationOfCamera2"} & set(one):
            return one
    return None


def _matlab_read(documents: Sequence[Document], paths: Sequence[Path], options: ImportOptions) -> StereoRig:
    count_paths(paths, (1,), "one file, of jsonencode(stereoParams)")
    with naming(paths[0]):
        inner = _matlab_inner(documents[0]) or need_named({}, "CameraParameters1")
        cameras, notes = [], ["pixels counted from 1, as MATLAB's do: 1 px taken from the principal points"]
        for name in ("CameraParameters1", "CameraParameters2"):
            with naming(name):
                given = need_named(inner, name)
                given = {**given, **(inside if isinstance(inside := given.get("Intrinsics"), Mapping) else {})}
                K = (
                    checked(given["K"], (3, 3), "K")
                    if "K" in given
                    else checked(need(given, "IntrinsicMatrix"), (3, 3), "IntrinsicMatrix").T
                )
                K = K - [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
                size = given.get("ImageSize") or None
                radial, tangential = (
                    list(np.ravel(given.get(f"{kind}Distortion", (0, 0)))) for kind in ("Radial", "Tangential")
                )
                entry = {"K": K, "D": [*radial[:2], *tangential, *radial[2:]], "distortion_model": "brown"}
                camera, said = camera_of(entry | ({"image_size": size[::-1]} if size else {}), options.image_size_px)
            cameras.append(camera)
            notes += said
        if (later := inner.get("PoseCamera2")) is not None:
            later = need_named(inner, "PoseCamera2")
            R = need(later, "R") if "R" in later else checked(need(later, "A"), (4, 4), "A")[:3, :3]
            t = later.get("Translation", None if "A" not in later else np.asarray(later["A"], float)[:3, 3])
        else:
            R, t = (
                checked(need(inner, "RotationOfCamera2"), (3, 3), "RotationOfCamera2").T,
                inner["TranslationOfCamera2"],
            )
        T, said = rigid(R, np.ravel(np.asarray(t, object)), "rotation of camera 2")
        unit = str(inner.get("WorldUnits", "millimeters"))
        if unit not in _WORLD_UNITS and options.unit_m is None:
            raise InputError(f"WorldUnits is {unit!r}; known are {', '.join(_WORLD_UNITS)}: give --unit-m")
    return imported(cameras, inverse(T), options, paths, notes + said, _WORLD_UNITS.get(unit, 1.0))


#: Poses to a third frame: name -> whether it takes the camera's coordinates to that frame's.
_THIRD = {"T_cam_imu": False, "T_imu_cam": True, "T_BS": True, "T_C_B": False}


def _kalibr_entries(documents: Sequence[Document], paths: Sequence[Path] = ()) -> Entries:
    """Return the cameras of a chain, or of a pair of EuRoC's files, by name."""
    if all("T_BS" in document and "intrinsics" in document for document in documents):
        return {f"cam{i}": document for i, document in enumerate(documents)}
    if len(documents) > 1:
        return {}
    return {
        str(name): entry
        for name, entry in sorted(documents[0].items(), key=lambda one: natural_key(one[0]))  # cam2 stands behind cam10
        if str(name)[-1:].isdigit() and str(name).startswith("cam") and isinstance(entry, Mapping)
    }


def _kalibr_recognises(documents: Sequence[Document]) -> bool:
    """Say whether a file has cameras cam0, cam1, .. as Kalibr writes them, or files have EuRoC's."""
    keys = {"camera_model", "cam_overlaps", "T_cn_cnm1", "distortion_coeffs", *_THIRD}
    return any(keys & set(entry) for entry in _kalibr_entries(documents).values())


def _kalibr_pose(entries: Entries, name: str) -> tuple[Array, list[str]]:
    """Return a camera's pose before the first one, along the chain, or before the IMU."""
    third = next((key for key in _THIRD if all(key in entry for entry in entries.values())), None)
    if third is not None and not all("T_cn_cnm1" in entry for entry in list(entries.values())[1:]):
        T, notes = _kalibr_rigid(entries[name][third], f"{name}.{third}")
        return inverse(T) if _THIRD[third] else T, notes
    T, notes = np.eye(4), []
    for link, entry in list(entries.items())[1 : list(entries).index(name) + 1]:
        if "T_cn_cnm1" not in entry:
            raise InputError(
                f"{link} has no 'T_cn_cnm1', nor have all cameras {' or '.join(_THIRD)}; there are {', '.join(entry)}: "
                "calibrate both cameras in one chain"
            )
        step, said = _kalibr_rigid(entry["T_cn_cnm1"], f"{link}.T_cn_cnm1")
        T, notes = step @ T, notes + said
    return T, notes


def _kalibr_rigid(value: Foreign, name: str) -> tuple[Array, list[str]]:
    """Return (4, 4) a transform as printed, and notes."""
    T = checked(value, (4, 4), name)
    return rigid(T[:3, :3], T[:3, 3], f"rotation of {name}")


def _kalibr_write(rig: StereoRig, paths: Sequence[Path]) -> tuple[str, ...]:
    count_paths(paths, (1,), "one file, camchain.yaml")
    T_right_left = inverse(rig.T_left_right)
    document = {
        f"cam{i}": _kalibr_entry(name, camera)
        for i, (name, camera) in enumerate(zip(("left", "right"), rig.cameras, strict=True))
    }
    document["cam1"] = {"T_cn_cnm1": T_right_left.tolist(), **document["cam1"]}
    write_together(paths, [dump_yaml(document)])
    return not_held(rig)


def _kalibr_entry(name: str, camera: Camera) -> dict[str, Foreign]:
    model = {"none": "none", "fisheye": "equidistant"}.get(camera.model, "radtan")
    d = camera.distortion
    if model == "radtan":
        if d[4:].any():
            raise InputError(
                f"Kalibr's radtan holds k1 k2 p1 p2 only; the {name} camera is {camera.model} with more that is not "
                "zero: calibrate with brown4 or fisheye to export to Kalibr"
            )
        d = d[:4]
    return {
        "camera_model": "pinhole",
        "intrinsics": camera.intrinsics.tolist(),
        "distortion_model": model,
        "distortion_coeffs": d.tolist(),
        "resolution": list(camera.image_size_px),
    }


#: The formats of this file by their names.
FORMATS = {
    "mrcal": posed_format(
        "mrcal .cameramodel files",
        ((2,), "two files, left.cameramodel and right.cameramodel (a file has one camera)"),
        *(lambda documents: any("lensmodel" in document for document in documents), _mrcal_entries, _mrcal_pose),
    ),
    "basalt": posed_format(
        "a Basalt calibration.json",
        ((1,), "one file, calibration.json"),
        *(_basalt_recognises, _basalt_entries, _basalt_pose),
    ),
    "caliscope": posed_format(
        "a camera array of caliscope or aniposelib",
        ((1,), "one file, camera_array.toml"),
        *(_caliscope_recognises, lambda documents, paths: _caliscope_entries(documents[0]), _caliscope_pose),
    ),
    "multical": posed_format(
        "a multical calibration.json",
        ((1,), "one file, calibration.json"),
        *(_multical_recognises, _multical_entries, _multical_pose),
    ),
    "kalibr": posed_format(
        "a Kalibr camchain",
        ((1, 2), "one file, camchain.yaml, or two sensor.yaml, the left camera's first"),
        *(_kalibr_recognises, _kalibr_entries, _kalibr_pose, _kalibr_write),
    ),
    "depthai": posed_format(
        "Luxonis' calibration of a device as JSON",
        ((1,), "one file, of eepromToJsonFile"),
        lambda documents: any(isinstance(document.get("cameraData"), list) for document in documents),
        *(_depthai_entries, _depthai_pose),
        unit_m=0.01,
    ),
    "stereolabs": RigFormat("a Stereolabs SN*.conf", _stereolabs_recognises, _stereolabs_read),
    "orbslam": RigFormat("ORB-SLAM's stereo settings", _orbslam_recognises, _orbslam_read),
    "stereoparams": RigFormat(
        "MATLAB's stereoParameters as JSON", lambda documents: any(map(_matlab_inner, documents)), _matlab_read
    ),
}
