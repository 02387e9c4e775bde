"""A ROS camera_info pair: two YAML files as camera_calibration writes them, left and right.

The files hold no relative pose. It follows from both rectification matrices and the last columns of the projection
matrices, which position the cameras in the rectified frame: P = K' [I | t], t = (-B, 0, 0) for the right one, so
p_left = R_left^T (R_right p_right - K_right'^-1 P_right[:, 3] + K_left'^-1 P_left[:, 3]). Translations are in metres
(REP 103). Models: plumb_bob, rational_polynomial, equidistant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse
from armsight.tables.yaml_file import Foreign, dump_yaml, read_yaml
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles.rigfile import (
    ImportOptions,
    brown,
    count_paths,
    focal_and_centre,
    image_size,
    imported,
    naming,
    need,
    not_held,
    rectification,
    rigid,
    write_together,
)

FILES = "two files, left.yaml and right.yaml"
#: Its files hold a rectification.
RECTIFIES = True
#: ROS model -> the numbers of coefficients it may come with.
MODELS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}


def read(paths: Sequence[Path], options: ImportOptions) -> StereoRig:
    """Read the left and the right camera_info file, in this order."""
    count_paths(paths, (2,), FILES)
    return rig_of([read_yaml(path) for path in paths], paths, options)


def rig_of(documents: Sequence[Mapping[str, Foreign]], paths: Sequence[Path], options: ImportOptions) -> StereoRig:
    """Return the rig of a left and a right camera_info.

    Args:
        documents: both, with the keys of the files.
        paths: where they come from, for messages.
        options: what the user added.

    Raises:
        InputError: one is damaged, or they are no stereo pair.
    """
    cameras, Ts, notes = [], [], []
    for path, document in zip(paths, documents, strict=True):
        with naming(path):
            camera, T_rect_camera, said = _read_one(document, options)
        cameras.append(camera)
        Ts.append(T_rect_camera)
        notes += [f"{path.name}: {note}" for note in said]
    if (Ts[0][:3, 3] == Ts[1][:3, 3]).all():
        raise InputError(
            f"{paths[1]}: projection_matrix holds no baseline (P[0, 3] as in the left file): these are two single "
            "cameras, not a stereo pair; calibrate them together"
        )
    T_left_right = inverse(Ts[0]) @ Ts[1]
    T_left_right[:3, 3] *= 1.0 if options.unit_m is None else options.unit_m
    notes.append("relative pose recovered from the rectification and projection matrices, which hold it indirectly")
    return imported(cameras, T_left_right, options, paths, notes)


def write(rig: StereoRig, paths: Sequence[Path]) -> tuple[str, ...]:
    """Write the left and the right camera_info file."""
    count_paths(paths, (2,), FILES)
    lost = list(not_held(rig))
    R1, R2, P1, P2, _ = rectification(rig)
    documents = []
    for name, camera, R, P in (("left", rig.left, R1, P1), ("right", rig.right, R2, P2)):
        model, d = (
            {"fisheye": "equidistant", "brown8": "rational_polynomial"}.get(camera.model, "plumb_bob"),
            camera.distortion,
        )
        if camera.model in ("none", "brown4"):
            d = np.concatenate([d, np.zeros(5 - d.size)])
            lost.append(f"that the {name} camera's distortion is {camera.model}: plumb_bob has five coefficients")
        documents.append(
            {
                "image_width": camera.image_size_px[0],
                "image_height": camera.image_size_px[1],
                "camera_name": name,
                "camera_matrix": _matrix(camera.matrix),
                "distortion_model": model,
                "distortion_coefficients": _matrix(d.reshape(1, -1)),
                "rectification_matrix": _matrix(R),
                "projection_matrix": _matrix(P),
            }
        )
    write_together(paths, [dump_yaml(document) for document in documents])
    return tuple(lost)


def _read_one(document: Mapping[str, Foreign], options: ImportOptions) -> tuple[Camera, Array, list[str]]:
    """Return a camera, (4, 4) its T_rect_camera in the unit of the file, and notes."""
    model = str(document.get("distortion_model", "plumb_bob"))
    if model not in MODELS:
        raise InputError(f"distortion_model {model!r} is not supported; supported are {', '.join(MODELS)}")
    size = image_size(need(document, "image_width"), need(document, "image_height"), options.image_size_px)
    intrinsics = focal_and_centre(_data(document, "camera_matrix", (3, 3)), "camera_matrix")
    d = _data(document, "distortion_coefficients", None)
    if d.size not in MODELS[model]:
        raise InputError(f"{model} has {' or '.join(map(str, MODELS[model]))} coefficients, got {d.size}")
    name, d = ("fisheye", d) if model == "equidistant" else brown(d)
    P = _data(document, "projection_matrix", (3, 4))
    fx, fy, _, _ = focal_and_centre(P[:, :3], "projection_matrix")
    if P[2, 3] != 0 or not (fx > 0 and fy > 0):
        raise InputError("projection_matrix must be [[fx, 0, cx, Tx], [0, fy, cy, Ty], [0, 0, 1, 0]]: uncalibrated?")
    T_rect_camera, notes = rigid(
        _data(document, "rectification_matrix", (3, 3)), -np.linalg.solve(P[:, :3], P[:, 3]), "rectification_matrix"
    )
    if "distortion_model" not in document:
        notes.append("no distortion_model; plumb_bob assumed, as ROS does")
    return Camera(size, name, intrinsics, d), T_rect_camera, notes


def _data(document: Mapping[str, Foreign], key: str, shape: tuple[int, int] | None) -> Array:
    """Return the numbers of a matrix entry, (n,) where no shape is required."""
    matrix = need(document, key)
    data = checked(need(matrix, "data"), (None,), f"{key}.data")
    rows, cols = matrix.get("rows"), matrix.get("cols")
    if isinstance(rows, int) and isinstance(cols, int) and rows * cols != data.size:
        raise InputError(f"{key} says {rows} rows and {cols} cols, and its data holds {data.size} numbers")
    if shape is None:
        return data
    if data.size != shape[0] * shape[1]:
        raise InputError(f"{key}.data must hold {shape[0]} x {shape[1]} numbers, got {data.size}")
    return data.reshape(shape)


def _matrix(m: Array) -> dict[str, Foreign]:
    """Return a matrix as camera_info files hold it."""
    return {"rows": m.shape[0], "cols": m.shape[1], "data": m.ravel().tolist()}
