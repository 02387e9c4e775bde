"""Two camera matrices, their distortion, R and T: whatever OpenCV's users write of ``stereoCalibrate``.

The names are those of OpenCV's own stereo_calib (M1 D1 M2 D2 R T, in intrinsics.yml and extrinsics.yml or one file) or
anybody's: what is a camera matrix, a distortion or a rotation is seen by its shape and its name's words, and which camera
it belongs to by what the names of a pair differ in (1 and 2, left and right, l and r, 0 and 1). Files of Bouguet's toolbox
(fc_left, cc_left, kc_left, om, T) are read, too. R T take left coordinates to right ones, X_right = R X_left + T, in the
unit of the board's squares. Neither that unit nor the image size stands in OpenCV's files; ours carry them as ``unit_m``,
``image_width`` and ``image_height``, and ``distortion_model: fisheye`` where cv2.fisheye is meant: a bare vector of four
coefficients is read as Brown's. R1 R2 P1 P2 Q follow from the rest and are only written.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from armsight.data import Array
from armsight.errors import InputError, naming
from armsight.geometry.check import PRINTED, off_rotation
from armsight.geometry.pose import inverse
from armsight.geometry.rotation import exp_so3
from armsight.tables.document import Foreign
from armsight.tables.lengths import BASELINE, fitting
from armsight.vision.camera_file import DISTORTION, MATRIX, SIZE, camera_of, described, found, plain
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles import rigfile

#: Words of a name that say which camera of a pair it is of, left before right.
_SIDES = [pair.split() for pair in ("left right", "l r", "1 2", "0 1", "first second", "a b", "master slave", "01 02")]
#: Words of matrices that follow from a rectification: they are not the cameras' own.
_DERIVED = {"new", "opt", "optimal", "rect", "rectified", "rectification", "undistorted", "newcamera", "roi", "ideal"}
_DISTORTION_WORDS = {
    "d", "dist", "distortion", "distortions", "distcoeffs", "coeffs", "kc", "coefficients", "coef", "dc",
    "distortioncoefficients", "distortioncoeffs",
}  # fmt: skip
#: Names of R and T, the likeliest first.
_ROTATIONS = (
    "r", "rot", "rotation", "rotationmatrix", "rstereo", "stereor", "rlr", "om", "rvec", "rotationvector", "rmat",
    "rmtx", "rotmat", "extrinsicsr", "stereorotation", "extrinsicsrotation", "rotationofcamera2",
)  # fmt: skip
_TRANSLATIONS = (
    "t", "trans", "translation", "translationvector", "tstereo", "stereot", "tlr", "tvec", "trnsmtx", "transmat",
    "tmat", "extrinsicst", "stereotranslation", "extrinsicstranslation", "translationofcamera2", "tmtx", "tvector",
    "rottrans",
)  # fmt: skip


def recognises(documents: Sequence[rigfile.Document]) -> bool:
    """Say whether files hold two camera matrices, or all that is between two cameras."""
    flat = dict(_flat(documents))
    return _pair(flat, _is_matrix) is not None or {"M1", "M2", "R", "T"} & set(flat) >= {"R", "T"}


def read(documents: Sequence[rigfile.Document], paths: Sequence[Path], options: rigfile.ImportOptions) -> StereoRig:
    """Read any number of files that hold the two cameras together, in any order."""
    flat, where = dict(_flat(documents)), " and ".join(map(str, paths))
    with naming(where):
        if any("CameraParameters1" in name for name in flat):
            raise InputError(
                "MATLAB's stereoParameters, whose pixels count from 1 and whose RotationOfCamera2 is transposed: save what "
                "MATLAB's stereoParametersToOpenCV returns"
            )
        cameras, notes = [], []
        for entry in _entries(flat):
            with naming(str(entry.pop("name"))):
                camera, said = camera_of(entry, options.image_size_px)
            cameras.append(camera)
            notes += said
        T_right_left, said = _between(flat)
        unit_m = _unit_m(flat, float(np.linalg.norm(T_right_left[:3, 3])), options)
    notes += [*said, f"translations read as multiples of {unit_m:g} m"]
    if "distortion_model" not in flat:  # armsight's own files say it
        if "the distortion model" not in " ".join(notes):
            notes.append("the files name no distortion model; OpenCV's default, Brown-Conrady, was assumed")
        # Not of Bouguet or MATLAB; findings/opencv_stereo_calibrate.sh saw 0.13 %.
        if not re.search("fc_left|OfCamera2", " ".join(flat)):
            notes.append(
                "OpenCV 4's stereoCalibrate without CALIB_FIX_INTRINSIC stops before its minimum: if it made this, lengths "
                "may be wrong by 0.1 %"
            )
    return rigfile.imported(cameras, inverse(T_right_left), options, paths, notes, unit_m)


def _flat(documents: Sequence[rigfile.Document]) -> Iterator[tuple[str, Foreign]]:
    """Yield all names and values, those of mappings within mappings under both names."""
    for document in documents:
        for key, value in document.items():
            if isinstance(value, Mapping):
                yield from ((f"{key}.{name}", inner) for name, inner in _flat([value]))
            else:
                yield str(key), value


def _words(name: str) -> list[str]:
    """Return the words of a name: cameraMatrix1, camera_matrix_1 and mtxL are camera matrix 1 and mtx l."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", name)]


def _numbers(value: Foreign) -> Array:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.zeros(0)
    return numbers


def _is_matrix(name: str, value: Foreign) -> bool:
    K, words = _numbers(value), _words(name)
    if _DERIVED & set(words):
        return False
    if K.shape == (3, 3) and K[2].tolist() == [0, 0, 1] and min(K[0, 0], K[1, 1], K[0, 2], K[1, 2]) > 1:
        return True
    return K.ndim > 0 and _stem(name) in MATRIX and name[:1] not in "rR"  # a number k1 is of a distortion


def _is_distortion(name: str, value: Foreign) -> bool:
    words = _words(name)
    return bool(_DISTORTION_WORDS & set(words) or _stem(name) in DISTORTION) and not {"model", "type"} & set(words)


def _is_size(name: str, value: Foreign) -> bool:
    return _stem(name) in SIZE and _numbers(value).size == 2


def _stem(name: str) -> str:
    """Return a name without the words that say which camera it is of, and without what it is in."""
    sides = {word for pair in _SIDES for word in pair} | {"camera", "cam"}
    words = _words(name.rpartition(".")[2])
    return plain("".join(word for word in words if word not in sides or len(words) == 1)) or plain(name)


def _pair(flat: Mapping[str, Foreign], is_one: Callable[[str, Foreign], bool]) -> tuple[str, str] | None:
    """Return the names of a left and a right one of what ``is_one`` finds; None where there are not two."""
    names = [name for name, value in flat.items() if is_one(name, value)]
    for left, right in _SIDES:
        lefts = [name for name in names if left in _words(name) and right not in _words(name)]
        rights = [name for name in names if right in _words(name) and left not in _words(name)]
        for one in lefts:
            for other in rights:
                if [right if word == left else word for word in _words(one)] == _words(other):
                    return one, other
    return None


def _entries(flat: Mapping[str, Foreign]) -> Iterator[dict[str, Foreign]]:
    """Yield the left and the right camera's entry under the names of :mod:`~armsight.vision.camera_file`."""
    focal = _pair(flat, lambda name, value: "fc" in _words(name) and _numbers(value).size == 2)  # Bouguet's
    matrices = _pair(flat, _is_matrix)
    pairs = {"distortion": _pair(flat, _is_distortion)}
    if focal is not None:
        pairs |= {
            "fc": focal,
            "cc": _pair(flat, lambda name, value: "cc" in _words(name) and _numbers(value).size == 2),
        }
    else:
        pairs["K"] = matrices
    for what, ours, names in (
        ("camera matrix", "M1 and M2, K1 and K2, camera_matrix_left and .._right", pairs.get("K", focal)),
        ("distortion", "D1 and D2, dist_left and .._right", pairs["distortion"]),
    ):
        if names is None:
            raise InputError(f"has no {what} of both cameras ({ours}); there are {described(flat)}")
    sizes = _pair(flat, _is_size)
    one = next((value for name, value in flat.items() if _is_size(name, value)), None)
    if one is None and found(flat, ("imagewidth", "width", "nx")) is not None:
        one = [found(flat, ("imagewidth", "width", "nx")), found(flat, ("imageheight", "height", "ny"))]
    for side in (0, 1):
        entry = {key: flat[names[side]] for key, names in pairs.items() if names is not None}
        entry["name"] = " and ".join(names[side] for names in (matrices or focal, pairs["distortion"]) if names)
        size = one if sizes is None else flat[sizes[side]]
        if size is not None:
            entry["image_size"] = _columns_first(size, entry)
        if (model := found(flat, ("distortionmodel", "model", "cameramodel"))) is not None:
            entry["distortion_model"] = model
        yield entry


def _columns_first(size: Foreign, entry: Mapping[str, Foreign]) -> Foreign:
    """Return an image size width first: numpy's shape has the height first, which the principal point shows."""
    pair, K = _numbers(size).ravel(), _numbers(entry.get("K", np.zeros(0)))
    if pair.size != 2 or K.shape != (3, 3) or not 0 < pair[0] < pair[1]:
        return size
    off = [max(abs(K[0, 2] / w - 0.5), abs(K[1, 2] / h - 0.5)) for w, h in (pair, pair[::-1])]
    return pair[::-1] if off[1] < 0.5 * off[0] else size


def _between(flat: Mapping[str, Foreign]) -> tuple[Array, list[str]]:
    """Return (4, 4) T_right_left in the file's unit, and notes."""
    by_name = {plain(name.rpartition(".")[2]): value for name, value in flat.items()}
    by_name |= {plain(name): value for name, value in flat.items()}
    values = []
    for what, known, is_one in (
        ("R, the rotation between the cameras", _ROTATIONS, _is_rotation),
        ("T, the translation between them", _TRANSLATIONS, _is_translation),
    ):
        value = next((by_name[name] for name in known if name in by_name), None)
        if value is None:
            alike = [value for name, value in flat.items() if is_one(name, value)]
            if len(alike) != 1:
                raise InputError(f"has no {what}; there are {described(flat)}: are these two cameras, each by itself?")
            value = alike[0]
        values.append(value)
    R, t = values
    if _numbers(R).size == 3:
        R = exp_so3(_numbers(R).ravel())
    return rigfile.rigid(R, np.ravel(np.asarray(t, object)), "R")


def _is_rotation(name: str, value: Foreign) -> bool:
    """Say whether a value is a rotation by its numbers, and not one of a rectification by its name."""
    R = _numbers(value)
    if R.shape != (3, 3) or not np.abs(R).max() < 2 or plain(name) in ("r1", "r2") or _DERIVED & set(_words(name)):
        return False
    return bool(off_rotation(R) < PRINTED and np.linalg.det(R) > 0)


def _is_translation(name: str, value: Foreign) -> bool:
    """Say whether a value is three numbers called something with t."""
    return _numbers(value).size == 3 and _stem(name).startswith("t")


def _unit_m(flat: Mapping[str, Foreign], length: float, options: rigfile.ImportOptions) -> float:
    """Return the length of the unit of T, m, from the file or the person, who must agree."""
    if "unit_m" not in flat:
        if options.unit_m is None:
            raise InputError(
                f"T is in the unit the board was given in, which the file does not say; it is {length:.4g} long. "
                f"{fitting(length, BASELINE) or 'No unit makes it a baseline'}. If squares count as 1: --unit-m SIDE"
            )
        return options.unit_m
    unit = flat["unit_m"]
    if isinstance(unit, bool) or not isinstance(unit, int | float) or not 0 < unit < float("inf"):
        raise InputError("unit_m must be a positive number of metres")
    if options.unit_m not in (None, unit):
        raise InputError(f"the file says unit_m {unit:g}, which is not the {options.unit_m:g} given")
    return float(unit)


def write(rig: StereoRig, paths: Sequence[Path]) -> tuple[str, ...]:
    """Write intrinsics and extrinsics into two files, or both into one."""
    rigfile.count_paths(paths, (1, 2), "intrinsics.yml and extrinsics.yml, or one file with both")
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
    extrinsics |= dict(zip(("R1", "R2", "P1", "P2", "Q"), rigfile.rectification(rig), strict=True))
    parts = [intrinsics, extrinsics] if len(paths) == 2 else [intrinsics | extrinsics]
    rigfile.write_together(paths, [_dump(part) for part in parts])
    return rigfile.not_held(rig)


def _dump(document: dict[str, Foreign]) -> str:
    """Return a FileStorage YAML text; OpenCV prints doubles so that they read back exactly."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for key, value in document.items():
        storage.write(key, np.ascontiguousarray(value) if isinstance(value, np.ndarray) else value)
    return str(storage.releaseAndGetString())


FORMATS = {
    "opencv": rigfile.RigFormat(
        "OpenCV's stereo calibration (camera matrices, distortion, R and T)", recognises, read, write, rectifies=True
    )
}
