"""Rigs of other programs: a registry of formats, each a :class:`~.rigfile.RigFormat`.

Foreign files go in and a StereoRig comes out, or the other way; what is lost on the way is always said.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from armsight.errors import InputError

if TYPE_CHECKING:
    from armsight.vision.rig import StereoRig
    from armsight.vision.rigfiles.rigfile import RigFormat

#: Format name -> the module here that reads it, imported when it is opened; those of ``programs.py`` are asked first.
FORMATS = dict.fromkeys(
    ("stereolabs", "mrcal", "basalt", "orbslam", "multical", "caliscope", "depthai", "stereoparams", "kalibr"),
    "programs",
) | {"ros": "ros", "opencv": "opencv"}
#: Those that are written, too.
EXPORTED = ("opencv", "ros", "kalibr")
#: Standard deviation of a detection where a file does not give one: that of chessboard corners in fair webcam images. A
#: larger value widens every predicted uncertainty in proportion.
ASSUMED_SIGMA_PX = 0.2


def open_format(name: str) -> RigFormat:
    """Return a format by its name; InputError where it is unknown."""
    if name not in FORMATS:
        raise InputError(f"unknown rig format {name!r}; known are {', '.join(FORMATS)}")
    found: RigFormat = importlib.import_module(f"{__name__}.{FORMATS[name]}").FORMATS[name]
    return found


def import_rig(
    name: str | None,
    paths: Sequence[str | Path],
    *,
    unit_m: float | None = None,
    image_size_px: tuple[int, int] | None = None,
    sigma_px: float = ASSUMED_SIGMA_PX,
    pair: tuple[str, str] | None = None,
) -> StereoRig:
    """Read a rig from another program's files.

    Args:
        name: a key of FORMATS; None finds it by the files' content.
        paths: its files, the left camera's first where each has its own.
        unit_m: length of the file's unit of translation, m; needed for OpenCV files, whose unit is that of the board.
        image_size_px: (width, height); needed where no file holds it (OpenCV's stereo_calib writes none).
        sigma_px: standard deviation of a detection, px: no format holds it.
        pair: names of the left and the right camera in a file of more than two.

    Raises:
        InputError: unknown format, files of another one, or that are missing, damaged or not supported.
    """
    from armsight.tables.document import read_document
    from armsight.vision.rigfiles.rigfile import ImportOptions

    if unit_m is not None and not 0 < unit_m < float("inf"):
        raise InputError(f"--unit-m must be a positive length in metres, got {unit_m}")
    if name is not None:
        open_format(name)
    if not paths:
        raise InputError("expected the calibration's file or files, got 0 file(s)")
    files = [Path(p) for p in paths]
    if len(set(files)) < len(files):
        raise InputError(f"{files[0]}: is given twice; give the file of the left camera, then that of the right one")
    documents = [read_document(path) for path in files]
    found = recognised(documents)
    where = " and ".join(map(str, files))
    if name is not None and found is not None and found != name:
        article = "is" if len(files) == 1 else "are"
        raise InputError(
            f"{where} {article} {open_format(found).title}, not {open_format(name).title}: leave --format out, or "
            f"give --format {found}"
        )
    if found is None:
        from armsight.vision.camera_file import stranger

        for path, document in zip(files, documents, strict=True):
            if what := stranger(document, camera=name is None):
                raise InputError(f"{path}: {what}")
    chosen = found or name
    if chosen is None:
        from armsight.vision.camera_file import described

        raise InputError(
            f"{where}: no calibration of two cameras is recognised; there are {described(documents[0])}. Expected are "
            f"{', '.join(open_format(each).title for each in FORMATS)}: --format NAME says what of it is missing"
        )
    return open_format(chosen).read(documents, files, ImportOptions(unit_m, image_size_px, sigma_px, pair))


def recognised(documents: Sequence[Mapping[str, object]]) -> str | None:
    """Return the name of the format that files are of, by their content; None where none is recognised."""
    return next((name for name in FORMATS if open_format(name).recognises(documents)), None)


def export_rig(rig: StereoRig, name: str, paths: Sequence[str | Path]) -> tuple[str, ...]:
    """Write a rig for another program and return what its files cannot hold, a line each.

    Raises InputError: unknown format, one that is only read, a rig that does not fit it, or a file that cannot be written.
    """
    write = open_format(name).write
    if write is None:
        raise InputError(f"{name} is read, not written; written are {', '.join(EXPORTED)}")
    return write(rig, [Path(p) for p in paths])
