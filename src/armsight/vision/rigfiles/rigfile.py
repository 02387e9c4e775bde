"""The contract of a foreign rig file: another program's calibration goes in, a StereoRig comes out, and back.

To add a format: write one module with the two functions of :class:`RigFormat`, and add one line to ``FORMATS`` in
``__init__.py``. The laws in tests/vision/rigfiles/test_rigfiles.py are parametrised over that registry. What the
formats share, such as checking matrices and OpenCV's rectification, stands here too.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from armsight.data import Array
from armsight.errors import InputError
from armsight.files import replacing
from armsight.geometry.check import checked
from armsight.geometry.pose import inverse, mean_pose, pose
from armsight.tables.yaml_file import Foreign
from armsight.vision.camera import Camera
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles import ASSUMED_SIGMA_PX

#: OpenCV's alpha (of fisheyes: balance) of every rectification that is written: 0, as ROS's calibrator has it, scales the
#: rectified images so that all of their pixels are valid; 1 would keep all pixels of the raw images, and black edges.
ALPHA = 0.0
#: A printed rotation may be this far from orthonormal: three digits leave 1e-3, six leave 1e-6.
LOOSEST_ROTATION = 2e-3


@dataclass(frozen=True)
class ImportOptions:
    """Values that a user may have to add to a foreign file.

    Attributes:
        unit_m: length of the file's unit of translation, m; None where the file or the format says it.
        image_size_px: (width, height); None where the file says it.
        sigma_px: standard deviation of a detection, px.
    """

    unit_m: float | None = None
    image_size_px: tuple[int, int] | None = None
    sigma_px: float = ASSUMED_SIGMA_PX


class RigFormat(Protocol):
    """One foreign format; a module with this constant and these two functions fulfils it.

    Attributes:
        RECTIFIES: whether its files hold a rectification, which is computed with ALPHA.
    """

    RECTIFIES: bool

    def read(self, paths: Sequence[Path], options: ImportOptions) -> StereoRig:
        """Read a rig; its provenance says what was assumed and what was left behind.

        Raises:
            InputError: a file is damaged, misses a key, or holds what armsight cannot; the message names the file.
        """
        ...

    def write(self, rig: StereoRig, paths: Sequence[Path]) -> tuple[str, ...]:
        """Write a rig and return what the format cannot hold, a line each.

        Raises:
            InputError: the rig does not fit the format, or a file cannot be written; no file is left half-written.
        """
        ...


def count_paths(paths: Sequence[Path], allowed: Sequence[int], names: str) -> None:
    """Check the number of files given."""
    if len(paths) not in allowed:
        raise InputError(f"expected {names}, got {len(paths)} file(s): {', '.join(map(str, paths)) or 'none'}")


def write_together(paths: Sequence[Path], texts: Sequence[str]) -> None:
    """Write several text files; none replaces its old file before all are written out."""
    with contextlib.ExitStack() as stack:
        for path, text in zip(paths, texts, strict=True):
            file = stack.enter_context(replacing(path))
            file.write(text)
            file.flush()  # a full disk shows here, while every old file still stands


def need(document: Foreign, key: str) -> Foreign:
    """Return ``document[key]`` or say that it is missing."""
    if not isinstance(document, Mapping) or key not in document:
        raise InputError(f"has no {key!r}")
    return document[key]


@contextlib.contextmanager
def naming(where: str | Path) -> Iterator[None]:
    """Put the name of a file, or of a part of it, before any error about its content."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def image_size(width: Foreign, height: Foreign, given: tuple[int, int] | None) -> tuple[int, int]:
    """Return (width, height), px, from what a file holds; a size given by a person must agree."""
    size = checked([width, height], (2,), "image size")
    if not (size >= 1).all() or (size != size.round()).any():
        raise InputError(f"image size must be whole pixels, got {width} x {height}")
    if given is not None and given != (int(size[0]), int(size[1])):
        raise InputError(f"the images are {width} x {height}, which is not the {given[0]} x {given[1]} given")
    return int(size[0]), int(size[1])


def brown(coefficients: Array) -> tuple[str, Array]:
    """Name the Brown-Conrady model of OpenCV's distortion vector (n,); thin prism and tilt must be zero."""
    d = coefficients[:8] if coefficients.size in (12, 14) and not coefficients[8:].any() else coefficients
    models = {0: "none", 4: "brown4", 5: "brown5", 8: "brown8"}
    if d.size in (12, 14):
        raise InputError(
            "thin-prism or tilted-sensor distortion is not supported; calibrate with 8 coefficients or fewer"
        )
    if d.size not in models:
        raise InputError(f"{d.size} distortion coefficients; OpenCV's models have 4, 5, 8, 12 or 14")
    return models[d.size], d


def focal_and_centre(K: Foreign, name: str) -> Array:
    """Return (4,) fx fy cx cy of a camera matrix (3, 3) without skew."""
    K = checked(K, (3, 3), name)
    if K[0, 1] != 0 or K[1, 0] != 0 or (K[2] != [0, 0, 1]).any():
        raise InputError(f"{name} must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; skew is not supported")
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])


def rigid(R: Foreign, t: Foreign, name: str) -> tuple[Array, list[str]]:
    """Return (4, 4) a transform from a printed rotation and translation, and a note where its digits were few."""
    T = pose(checked(R, (3, 3), name), checked(t, (3,), f"translation of {name}"))
    off = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
    if off > LOOSEST_ROTATION or np.linalg.det(T[:3, :3]) < 0:
        raise InputError(f"{name} is not a rotation: R R^T differs from the identity by {off:.2g}")
    if off < 1e-12:
        return T, []
    return mean_pose(T[None]), [f"{name} as printed is off a rotation by {off:.1g}; the nearest rotation was taken"]


def imported(
    cameras: Sequence[Camera],
    T_left_right: Array,
    options: ImportOptions,
    paths: Sequence[Path],
    notes: Sequence[str],
) -> StereoRig:
    """Assemble an imported rig, its uncertainty unknown, with a provenance that says so."""
    left, right = cameras
    notes = [*notes]
    if T_left_right[0, 3] < 0 and abs(T_left_right[0, 3]) > abs(T_left_right[1, 3]):
        notes.append("the second camera stands left of the first; armsight calls the first one left all the same")
    if not np.linalg.norm(T_left_right[:3, 3]) > 0:
        raise InputError(f"{paths[-1]}: the two cameras are at one position (baseline 0); this is not a stereo pair")
    count = left.parameters.size + right.parameters.size + 6
    provenance = {
        "origin": "imported",
        "files": [str(path) for path in paths],
        "uncertainty": "imported, uncertainty unknown: the covariance is zero",
        "sigma_px": f"{options.sigma_px:g} px, assumed on import and not measured",
        "notes": notes,
    }
    return StereoRig(left, right, T_left_right, np.zeros((count, count)), options.sigma_px, provenance)


def rectification(rig: StereoRig) -> tuple[Array, Array, Array, Array, Array]:
    """Return OpenCV's R1 R2 P1 P2 Q, with ALPHA, for a rig of two Brown cameras or two fisheyes."""
    T_right_left = inverse(rig.T_left_right)
    fisheye = [camera.model == "fisheye" for camera in rig.cameras]
    if any(fisheye) and not all(fisheye):
        raise InputError("one camera is a fisheye and the other is not: OpenCV has no rectification for that")
    left, right = rig.cameras
    args = (left.matrix, np.array(left.distortion), right.matrix, np.array(right.distortion), left.image_size_px)
    R, t = np.ascontiguousarray(T_right_left[:3, :3]), np.ascontiguousarray(T_right_left[:3, 3:])
    if all(fisheye):
        R1, R2, P1, P2, Q = cv2.fisheye.stereoRectify(*args, R, t, flags=cv2.CALIB_ZERO_DISPARITY, balance=ALPHA)
    else:
        R1, R2, P1, P2, Q, *_ = cv2.stereoRectify(*args, R, t, flags=cv2.CALIB_ZERO_DISPARITY, alpha=ALPHA)
    R1, R2, P1, P2, Q = (np.asarray(m, dtype=np.float64) for m in (R1, R2, P1, P2, Q))
    return R1, R2, P1, P2, Q


def not_held(rig: StereoRig) -> tuple[str, ...]:
    """Return what no foreign format holds of this rig."""
    lost = []
    if rig.cov.any():
        lost.append("the covariance of the rig's parameters")
    if rig.shutters is not None:
        lost.append(f"the shutters: {rig.shutters}")
    if rig.disc_noise is not None:
        lost.append("the noise of discs' centres: {} (left), {} (right)".format(*rig.disc_noise))
    return (*lost, f"the detection noise sigma_px ({rig.sigma_px:g} px)", "the provenance")
