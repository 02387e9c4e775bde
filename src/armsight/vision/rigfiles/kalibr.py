"""Kalibr's camchain YAML, OpenVINS's chains to the IMU, and the sensor.yaml pairs of EuRoC recordings.

``T_cn_cnm1`` takes the coordinates of the camera before to camera n's, in metres; where a camera has none, its pose to the
IMU holds: ``T_cam_imu`` takes the IMU's coordinates to the camera's, ``T_imu_cam`` and EuRoC's ``T_BS`` the other way.
Models: pinhole with radtan (Brown-Conrady, four coefficients), equidistant (Kannala-Brandt) or none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import natural_key
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse
from armsight.tables.document import Foreign, dump_yaml
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles.rigfile import (
    Document,
    ImportOptions,
    count_paths,
    not_held,
    posed_rig,
    rigid,
    write_together,
)

TITLE = "a Kalibr camchain"
#: Its file holds no rectification.
RECTIFIES = False
#: Poses to a third frame: name -> whether it takes the camera's coordinates to that frame's.
_THIRD = {"T_cam_imu": False, "T_imu_cam": True, "T_BS": True, "T_C_B": False}
#: Keys that armsight cannot represent.
_LEFT_BEHIND = ("timeshift_cam_imu", "rostopic")


def _entries(documents: Sequence[Document]) -> dict[str, Mapping[str, Foreign]]:
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


def recognises(documents: Sequence[Document]) -> bool:
    """Say whether a file has cameras cam0, cam1, .. as Kalibr writes them, or files have EuRoC's."""
    keys = {"camera_model", "cam_overlaps", "T_cn_cnm1", "distortion_coeffs", *_THIRD}
    return any(keys & set(entry) for entry in _entries(documents).values())


def read(documents: Sequence[Document], paths: Sequence[Path], options: ImportOptions) -> StereoRig:
    """Read two cameras of a chain, or one camera of each of two sensor.yaml."""
    entries = _entries(documents)
    count_paths(paths, (1, 2), "one file, camchain.yaml, or two sensor.yaml, the left camera's first")
    chained = all("T_cn_cnm1" in entry for entry in list(entries.values())[1:])
    third = next((key for key in _THIRD if all(key in entry for entry in entries.values())), None)

    def posed(name: str) -> tuple[Array, list[str]]:
        if not chained and third is not None:
            T, said = _rigid(entries[name][third], f"{name}.{third}")
            return inverse(T) if _THIRD[third] else T, said
        T, notes = np.eye(4), list[str]()
        for link, entry in list(entries.items())[1 : list(entries).index(name) + 1]:
            if "T_cn_cnm1" not in entry:
                raise InputError(
                    f"{link} has no 'T_cn_cnm1', nor have all cameras {' or '.join(_THIRD)}; there are {', '.join(entry)}: "
                    "calibrate both cameras in one chain"
                )
            step, said = _rigid(entry["T_cn_cnm1"], f"{link}.T_cn_cnm1")
            T, notes = step @ T, notes + said
        return T, notes

    rig = posed_rig(entries, posed, options, paths)
    if keys := [key for key in _LEFT_BEHIND if any(key in entry for entry in entries.values())]:
        rig.provenance["notes"].append(f"left behind: {', '.join(keys)}")
    return rig


def _rigid(value: Foreign, name: str) -> tuple[Array, list[str]]:
    """Return (4, 4) a transform as printed, and notes."""
    T = checked(value, (4, 4), name)
    return rigid(T[:3, :3], T[:3, 3], f"rotation of {name}")


def write(rig: StereoRig, paths: Sequence[Path]) -> tuple[str, ...]:
    """Write a camchain of two cameras."""
    count_paths(paths, (1,), "one file, camchain.yaml")
    T_right_left = inverse(rig.T_left_right)
    document = {
        f"cam{i}": _entry(name, camera)
        for i, (name, camera) in enumerate(zip(("left", "right"), rig.cameras, strict=True))
    }
    document["cam1"] = {"T_cn_cnm1": T_right_left.tolist(), **document["cam1"]}
    write_together(paths, [dump_yaml(document)])
    return not_held(rig)


def _entry(name: str, camera: Camera) -> dict[str, Foreign]:
    """Return a camera as a camchain holds it."""
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
