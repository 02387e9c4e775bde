"""A Kalibr camchain YAML: cam0 is taken as left, cam1 as right.

``T_cn_cnm1`` of cam1 takes cam0's coordinates to cam1's, in metres, so T_left_right is its inverse. Models: pinhole
with radtan (Brown-Conrady, four coefficients), equidistant (Kannala-Brandt) or none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse
from armsight.tables.yaml_file import Foreign, dump_yaml, read_yaml
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles.rigfile import (
    ImportOptions,
    count_paths,
    image_size,
    imported,
    naming,
    need,
    not_held,
    rigid,
    write_together,
)

FILES = "one file, camchain.yaml"
#: Its file holds no rectification.
RECTIFIES = False
#: Kalibr model -> ours.
MODELS = {"radtan": "brown4", "equidistant": "fisheye", "none": "none"}
#: Keys that armsight cannot represent.
_LEFT_BEHIND = ("T_cam_imu", "timeshift_cam_imu", "rostopic")


def read(paths: Sequence[Path], options: ImportOptions) -> StereoRig:
    """Read cam0 and cam1 of a camchain."""
    count_paths(paths, (1,), FILES)
    (path,) = paths
    document = read_yaml(path)
    with naming(path):
        entries = [need(document, name) for name in ("cam0", "cam1")]
        cameras = [_camera(name, entry, options) for name, entry in zip(("cam0", "cam1"), entries, strict=True)]
        if "T_cn_cnm1" not in entries[1]:
            raise InputError("cam1 has no 'T_cn_cnm1': calibrate both cameras in one chain")
        T = checked(entries[1]["T_cn_cnm1"], (4, 4), "cam1.T_cn_cnm1")
        T_right_left, notes = rigid(T[:3, :3], T[:3, 3], "rotation of cam1.T_cn_cnm1")
    T_right_left[:3, 3] *= 1.0 if options.unit_m is None else options.unit_m
    if others := [name for name in document if name not in ("cam0", "cam1")]:
        notes.append(f"left behind: {', '.join(map(str, others))}")
    if keys := [key for key in _LEFT_BEHIND if any(key in entry for entry in entries)]:
        notes.append(f"left behind: {', '.join(keys)}")
    return imported(cameras, inverse(T_right_left), options, paths, notes)


def write(rig: StereoRig, paths: Sequence[Path]) -> tuple[str, ...]:
    """Write a camchain of two cameras."""
    count_paths(paths, (1,), FILES)
    T_right_left = inverse(rig.T_left_right)
    document = {
        f"cam{i}": _entry(name, camera)
        for i, (name, camera) in enumerate(zip(("left", "right"), rig.cameras, strict=True))
    }
    document["cam1"] = {"T_cn_cnm1": T_right_left.tolist(), **document["cam1"]}
    write_together(paths, [dump_yaml(document)])
    return not_held(rig)


def _camera(name: str, entry: Mapping[str, Foreign], options: ImportOptions) -> Camera:
    """Build a camera from its entry in the chain."""
    with naming(name):
        kind = need(entry, "camera_model")
        if kind != "pinhole":
            raise InputError(
                f"camera_model {kind!r} is not supported (Kalibr's omni, ds and eucm neither); use pinhole"
            )
        model = str(need(entry, "distortion_model"))
        if model not in MODELS:
            raise InputError(f"distortion_model {model!r} is not supported; supported are {', '.join(MODELS)}")
        width_height = checked(need(entry, "resolution"), (2,), "resolution")
        intrinsics = checked(need(entry, "intrinsics"), (4,), "intrinsics")
        d = checked(need(entry, "distortion_coeffs"), (None,), "distortion_coeffs") if model != "none" else np.zeros(0)
        size = image_size(width_height[0], width_height[1], options.image_size_px)
        return Camera(size, MODELS[model], intrinsics, d)


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
