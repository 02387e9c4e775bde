"""The contract of a foreign rig file: another program's calibration goes in, a StereoRig comes out, and back.

To add a format: write a :class:`RigFormat` into the ``FORMATS`` of a module here, and add one line to ``FORMATS`` in
``__init__.py``. The laws in tests/vision/rigfiles/test_rigfiles.py are parametrised over that registry. What the
formats share, such as checking matrices and OpenCV's rectification, stands here too.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np

from armsight.data import Array
from armsight.errors import InputError, naming
from armsight.files import replacing
from armsight.geometry.check import PRINTED, checked, off_rotation
from armsight.geometry.pose import inverse, mean_pose, pose
from armsight.tables.document import Foreign
from armsight.tables.lengths import BASELINE, check_length, fitting, metric
from armsight.vision.camera import Camera
from armsight.vision.camera_file import camera_of
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles import ASSUMED_SIGMA_PX

#: A file's names and values.
Document: TypeAlias = Mapping[str, Foreign]
#: Each camera's names and values, by its name.
Entries: TypeAlias = Mapping[str, Document]
PoseOf: TypeAlias = Callable[[Entries, str], tuple[Array, list[str]]]
#: A baseline longer than this is remarked, m.
LONG_M = 2.0  # half: rooms' rigs are remarked; double: 30 cm read as inches are not
#: OpenCV's alpha (of fisheyes: balance) of every rectification that is written: 0, as ROS's calibrator has it, scales the
#: rectified images so that all of their pixels are valid; 1 would keep all pixels of the raw images, and black edges.
ALPHA = 0.0
#: Lengths beyond this are damaged numbers in any unit; half, double: the same.
_FARTHEST = 1e9
#: Keys of a camera that armsight cannot represent.
_LEFT_BEHIND = ("timeshift_cam_imu", "rostopic")


@dataclass(frozen=True)
class ImportOptions:
    """Values that a user may have to add to a foreign file."""

    #: length of the file's unit of translation, m; None where the file or the format says it
    unit_m: float | None = None
    image_size_px: tuple[int, int] | None = None  #: (width, height); None where the file says it
    sigma_px: float = ASSUMED_SIGMA_PX  #: standard deviation of a detection, px
    #: names of the left and the right camera, of a file that has more than two; None takes the first two
    pair: tuple[str, str] | None = None


@dataclass(frozen=True)
class RigFormat:
    """One foreign format."""

    title: str  #: what its files are, for messages: "a Kalibr camchain"
    recognises: Callable[[Sequence[Document]], bool]  #: says by their content whether files are of this format
    #: returns the rig of files; its provenance says what was assumed and left behind. InputError: a file is damaged,
    #: misses a key, or holds what armsight cannot; the message names the file.
    read: Callable[[Sequence[Document], Sequence[Path], ImportOptions], StereoRig]
    #: writes a rig and returns what the format cannot hold, a line each; None where it is only read. InputError: the
    #: rig does not fit the format, or a file cannot be written; no file is left half-written.
    write: Callable[[StereoRig, Sequence[Path]], tuple[str, ...]] | None = None
    rectifies: bool = False  #: whether the files that are written hold a rectification, which is computed with ALPHA


def posed_format(
    title: str,
    files: tuple[tuple[int, ...], str],
    recognises: Callable[[Sequence[Document]], bool],
    entries: Callable[[Sequence[Document], Sequence[Path]], Entries],
    pose_of: PoseOf,
    write: Callable[[StereoRig, Sequence[Path]], tuple[str, ...]] | None = None,
    unit_m: float = 1.0,
) -> RigFormat:
    """Return a format of files that hold each camera and its pose in a third frame, the world's or an IMU's.

    Args:
        title: as in :class:`RigFormat`, as are ``recognises`` and ``write``.
        files: how many there may be, and what they are called.
        recognises: by content.
        entries: returns each camera's entry by its name, in the order of the files.
        pose_of: returns (4, 4) T_camera_reference of a camera of the entries, in the file's unit, and notes.
        write: see there.
        unit_m: of the files, where the user gives none, m.
    """

    def read(documents: Sequence[Document], paths: Sequence[Path], options: ImportOptions) -> StereoRig:
        count_paths(paths, *files)
        with naming(paths[0]) if len(paths) == 1 else contextlib.nullcontext():
            found = entries(documents, paths)
        return _posed_rig(found, pose_of, options, paths, unit_m)

    return RigFormat(title, recognises, read, write)


def count_paths(paths: Sequence[Path], allowed: Sequence[int], names: str) -> None:
    """Check the number of files given."""
    if len(paths) not in allowed:
        raise InputError(f"expected {names}, got {len(paths)} file(s): {', '.join(map(str, paths)) or 'none'}")


def _posed_rig(
    entries: Entries, pose_of: PoseOf, options: ImportOptions, paths: Sequence[Path], unit_m: float
) -> StereoRig:
    """Return the rig of two of several cameras whose poses in a third frame are known; ``options.pair`` chooses the two.

    InputError: fewer than two, an unknown name in ``pair``, or a camera that cannot be read.
    """
    names = list(entries)
    if len(names) < 2:
        raise InputError(
            f"{paths[-1]}: holds {'one camera, ' + names[0] if names else 'no camera'}; a rig has two: give both"
        )
    for name, entry in entries.items():
        if not isinstance(entry, Mapping):
            raise InputError(f"{paths[-1]}: {name} holds {str(entry)[:40]!r}, expected a camera's names and values")
    chosen = options.pair or (names[0], names[1])
    called = {str(entry.get(key)): name for key in ("name", "rostopic") for name, entry in entries.items()}
    chosen = (called.get(chosen[0], chosen[0]), called.get(chosen[1], chosen[1]))
    for name in chosen:
        if name not in entries:
            raise InputError(f"{paths[-1]}: has no camera {name!r}; there are {', '.join(names)}: --pair LEFT,RIGHT")
    cameras, Ts, notes = [], [], []
    for name in chosen:
        with naming(paths[min(names.index(name), len(paths) - 1)]), naming(name):
            camera, said = camera_of(entries[name], options.image_size_px)
        with naming(paths[-1]):
            T, noted = pose_of(entries, name)
        cameras.append(camera)
        Ts.append(T)
        notes += [f"{name}: {note}" for note in said] + noted
    if others := [name for name in names if name not in chosen]:
        left, right = chosen
        notes.append(f"left behind: {', '.join(others)}; {left} is left, {right} right: --pair LEFT,RIGHT chooses")
    if keys := [key for key in _LEFT_BEHIND if any(key in entry for entry in entries.values())]:
        notes.append(f"left behind: {', '.join(keys)}")
    return imported(cameras, Ts[0] @ inverse(Ts[1]), options, paths, notes, unit_m)


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


def need_named(document: Foreign, key: str) -> Mapping[str, Foreign]:
    """Return ``document[key]``, which must be names and values."""
    value = need(document, key)
    if not isinstance(value, Mapping):
        raise InputError(f"{key} holds {str(value)[:40]!r}, expected names and values")
    return value


def rigid(R: Foreign, t: Foreign, name: str) -> tuple[Array, list[str]]:
    """Return (4, 4) a transform from a printed rotation and translation, and a note where its digits were few."""
    T = pose(checked(R, (3, 3), name), checked(t, (3,), f"translation of {name}"))
    if np.abs(T[:3, 3]).max() > _FARTHEST:
        raise InputError(f"translation of {name} has {np.abs(T[:3, 3]).max():.2g} units: a damaged number?")
    off = off_rotation(T[:3, :3])
    if off <= PRINTED and np.linalg.det(T[:3, :3]) < 0:
        raise InputError(f"{name} is not a rotation: it is left-handed (determinant -1), an axis is mirrored")
    if off > PRINTED:
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
    unit_m: float = 1.0,
) -> StereoRig:
    """Assemble an imported rig, its uncertainty unknown, with a provenance that says so.

    ``T_left_right``: (4, 4), its translation in the file's unit; ``notes``: what was assumed and left behind; ``unit_m``:
    of the file, where the user gave none, m. Raises InputError: both cameras at one position, or a baseline that cannot be.
    """
    left, right = cameras
    notes = list(dict.fromkeys(notes))
    unit_m = unit_m if options.unit_m is None else options.unit_m
    T_left_right = np.array(T_left_right)
    T_left_right[:3, 3] *= unit_m
    if T_left_right[0, 3] < 0 and abs(T_left_right[0, 3]) > abs(T_left_right[1, 3]):
        notes.append(
            "the second camera stands left of the first; armsight calls the first one left all the same: where they were "
            "given in the wrong order, exchange the files, or give --pair"
        )
    if not np.linalg.norm(T_left_right[:3, 3]) > 0:
        raise InputError(f"{paths[-1]}: the two cameras are at one position (baseline 0); this is not a stereo pair")
    baseline_m = float(np.linalg.norm(T_left_right[:3, 3]))
    with naming(paths[-1]):
        check_length(baseline_m, unit_m, BASELINE)
    if baseline_m > LONG_M:
        fits = fitting(baseline_m / unit_m, BASELINE._replace(most_m=LONG_M))
        notes.append(f"the baseline is {metric(baseline_m)}, which is long" + (fits and f". {fits}"))
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
