"""OpenCV FileStorage files as its stereo_calib sample writes them: intrinsics.yml and extrinsics.yml, or one file.

M1 D1 M2 D2 are the camera matrices and distortion vectors; R T take left coordinates to right ones, X_right = R X_left
+ T, in the unit of the board's squares. Neither that unit nor the image size stands in such files; ours carry them as
``unit_m``, ``image_width`` and ``image_height``, and ``distortion_model: fisheye`` where cv2.fisheye is meant: a bare
vector of four coefficients is read as Brown's. R1 R2 P1 P2 Q follow from the rest and are only written.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import read_text
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse
from armsight.tables.yaml_file import Foreign
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
    not_held,
    rectification,
    rigid,
    write_together,
)

FILES = "intrinsics.yml and extrinsics.yml, or one file with both"
#: Its files hold a rectification.
RECTIFIES = True
NEEDED = ("M1", "D1", "M2", "D2", "R", "T")
OPTIONAL = ("unit_m", "image_width", "image_height", "distortion_model")


def read(paths: Sequence[Path], options: ImportOptions) -> StereoRig:
    """Read intrinsics and extrinsics, in any order, or one file with both."""
    count_paths(paths, (1, 2), FILES)
    found: dict[str, tuple[Foreign, Path]] = {}
    for path in paths:
        found.update({key: (value, path) for key, value in _load(path).items()})
    where = " or ".join(map(str, paths))
    for key in NEEDED:
        if key not in found:
            raise InputError(f"{where}: has no {key!r}; expected {FILES}")
    unit, size = _unit_m(found, options, where), _size(found, options, where)
    cameras = [_camera(found, side, size) for side in ("1", "2")]
    R, path = found["R"]
    with naming(path):
        T_right_left, notes = rigid(R, np.asarray(found["T"][0]).reshape(-1), "R")
    T_right_left = T_right_left.copy()
    T_right_left[:3, 3] *= unit
    notes.append(f"translations read as multiples of {unit:g} m")
    if "distortion_model" not in found:
        notes.append("the files name no distortion model; OpenCV's default, Brown-Conrady, was assumed")
    return imported(cameras, inverse(T_right_left), options, paths, notes)


def write(rig: StereoRig, paths: Sequence[Path]) -> tuple[str, ...]:
    """Write intrinsics and extrinsics into two files, or both into one."""
    count_paths(paths, (1, 2), FILES)
    left, right = rig.cameras
    if left.image_size_px != right.image_size_px:
        raise InputError("OpenCV's files hold one image size; the two cameras of this rig differ")
    T_right_left = inverse(rig.T_left_right)
    model = "fisheye" if left.model == "fisheye" else "brown"
    intrinsics: dict[str, Foreign] = {
        "image_width": left.image_size_px[0],
        "image_height": left.image_size_px[1],
        "distortion_model": model,
        "M1": left.matrix,
        "D1": left.distortion.reshape(1, -1),
        "M2": right.matrix,
        "D2": right.distortion.reshape(1, -1),
    }
    extrinsics = {"unit_m": 1.0, "R": T_right_left[:3, :3], "T": T_right_left[:3, 3].reshape(3, 1)}
    extrinsics |= dict(zip(("R1", "R2", "P1", "P2", "Q"), rectification(rig), strict=True))
    parts = [intrinsics, extrinsics] if len(paths) == 2 else [intrinsics | extrinsics]
    write_together(paths, [_dump(part) for part in parts])
    return not_held(rig)


def _load(path: Path) -> dict[str, Foreign]:
    """Read those entries of a FileStorage file that make up a rig."""
    text = read_text(path)
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        nodes = {key: storage.getNode(key) for key in (*NEEDED, *OPTIONAL)}
    except (cv2.error, SystemError) as error:  # the binding wraps a parser's error in a SystemError
        raise InputError(f"{path}: not an OpenCV FileStorage file, or a damaged one{_line(error.__cause__)}") from None
    found = {}
    for key, node in nodes.items():
        try:
            if not node.empty():
                found[key] = _value(node)
        except cv2.error:
            raise InputError(f"{path}: {key} is damaged: its numbers do not make the matrix it announces") from None
    return found


def _line(cause: BaseException | None) -> str:
    """Return the line in which OpenCV's parser stopped, as it says in "(7): Missing , between the elements"."""
    match = re.search(r"\((\d+)\): ([^']+)", str(cause))
    return f": line {match[1]}: {match[2].strip()}" if match else ""


def _value(node: cv2.FileNode) -> Foreign:
    """Convert a node to an array, a number or a text."""
    if node.isMap():
        return node.mat()
    if node.isSeq():
        return np.array([node.at(i).real() for i in range(node.size())])
    return node.string() if node.isString() else node.real()


def _unit_m(found: dict[str, tuple[Foreign, Path]], options: ImportOptions, where: str) -> float:
    """Return the length of the unit of T, m, from the file or the person, who must agree."""
    if "unit_m" not in found:
        if options.unit_m is None:
            raise InputError(
                f"{where}: T is in the unit the board was given in, which the file does not say: give unit_m, "
                "metres a unit (1 if the squares were given in metres, 0.001 for millimetres, the square's size in "
                "metres if the squares were counted as 1)"
            )
        return options.unit_m
    unit, path = found["unit_m"]
    if not isinstance(unit, float) or not 0 < unit < float("inf"):
        raise InputError(f"{path}: unit_m must be a positive number of metres")
    if options.unit_m not in (None, unit):
        raise InputError(f"{path}: the file says unit_m {unit:g}, which is not the {options.unit_m:g} given")
    return unit


def _size(found: dict[str, tuple[Foreign, Path]], options: ImportOptions, where: str) -> tuple[int, int]:
    """Return the image size from the file or the person, who must agree."""
    if "image_width" not in found or "image_height" not in found:
        if options.image_size_px is None:
            raise InputError(f"{where}: holds no image size: give image_size_px, width and height of the images")
        return options.image_size_px
    with naming(found["image_width"][1]):
        return image_size(found["image_width"][0], found["image_height"][0], options.image_size_px)


def _camera(found: dict[str, tuple[Foreign, Path]], side: str, size: tuple[int, int]) -> Camera:
    """Build camera 1 or 2."""
    K, path = found[f"M{side}"]
    model, _ = found.get("distortion_model", ("brown", path))
    if model not in ("brown", "fisheye"):
        raise InputError(f"{path}: unknown distortion_model {model!r}; known are brown, fisheye")
    with naming(path):
        intrinsics = focal_and_centre(K, f"M{side}")
        D = found[f"D{side}"][0]
        d: Array = np.zeros(0) if D is None else checked(np.ravel(D), (None,), f"D{side}")
        name, d = brown(d) if model == "brown" else (model, d)
        return Camera(size, name, intrinsics, d)


def _dump(document: dict[str, Foreign]) -> str:
    """Return a FileStorage YAML text; OpenCV prints doubles so that they read back exactly."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for key, value in document.items():
        storage.write(key, np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value)
    return str(storage.releaseAndGetString())
