"""Rigs of other programs: a registry of formats, each one file behind :class:`~.rigfile.RigFormat`.

Foreign files go in and a StereoRig comes out, or the other way; what is lost on the way is always said.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

from armsight.errors import InputError

if TYPE_CHECKING:
    from armsight.vision.rig import StereoRig
    from armsight.vision.rigfiles.rigfile import RigFormat

#: Format name -> the module here that reads and writes it; imported when it is opened.
FORMATS = {"opencv": "opencv_yaml", "ros": "ros", "kalibr": "kalibr"}
#: Standard deviation of a detection where a file does not give one: that of chessboard corners in fair webcam images. A
#: larger value widens every predicted uncertainty in proportion.
ASSUMED_SIGMA_PX = 0.2


def open_format(name: str) -> RigFormat:
    """Return a format by its name.

    Raises:
        InputError: an unknown name.
    """
    if name not in FORMATS:
        raise InputError(f"unknown rig format {name!r}; known are {', '.join(FORMATS)}")
    return cast("RigFormat", importlib.import_module(f"{__name__}.{FORMATS[name]}"))


def import_rig(
    name: str,
    paths: Sequence[str | Path],
    *,
    unit_m: float | None = None,
    image_size_px: tuple[int, int] | None = None,
    sigma_px: float = ASSUMED_SIGMA_PX,
) -> StereoRig:
    """Read a rig from another program's files.

    Args:
        name: a key of FORMATS.
        paths: its files, in the order the format's module gives.
        unit_m: length of the file's unit of translation, m; needed for OpenCV files, whose unit is that of the board.
        image_size_px: (width, height); needed where no file holds it (OpenCV's stereo_calib writes none).
        sigma_px: standard deviation of a detection, px: no format holds it.

    Raises:
        InputError: unknown format, or files that are missing, damaged or not supported.
    """
    from armsight.vision.rigfiles.rigfile import ImportOptions

    if unit_m is not None and not 0 < unit_m < float("inf"):
        raise InputError(f"unit_m must be a positive length in metres, got {unit_m}")
    return open_format(name).read([Path(p) for p in paths], ImportOptions(unit_m, image_size_px, sigma_px))


def export_rig(rig: StereoRig, name: str, paths: Sequence[str | Path]) -> tuple[str, ...]:
    """Write a rig for another program and return what its files cannot hold, a line each.

    Raises:
        InputError: unknown format, a rig that does not fit it, or a file that cannot be written.
    """
    return open_format(name).write(rig, [Path(p) for p in paths])
