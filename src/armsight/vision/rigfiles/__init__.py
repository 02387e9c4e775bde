"""Rigs of other programs: a registry of formats, each one file behind :class:`~.rigfile.RigFormat`.

Foreign files go in and a StereoRig comes out, or the other way; what is lost on the way is always said.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from armsight.errors import InputError
from armsight.vision.rig import StereoRig
from armsight.vision.rigfiles import kalibr, opencv_yaml, ros
from armsight.vision.rigfiles.rigfile import ASSUMED_SIGMA_PX, ImportOptions, RigFormat

#: Format name -> the module that reads and writes it.
FORMATS: dict[str, RigFormat] = {"opencv": opencv_yaml, "ros": ros, "kalibr": kalibr}


def _format(name: str) -> RigFormat:
    """Look a format up."""
    if name not in FORMATS:
        raise InputError(f"unknown rig format {name!r}; known are {', '.join(FORMATS)}")
    return FORMATS[name]


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
    if unit_m is not None and not 0 < unit_m < float("inf"):
        raise InputError(f"unit_m must be a positive length in metres, got {unit_m}")
    return _format(name).read([Path(p) for p in paths], ImportOptions(unit_m, image_size_px, sigma_px))


def export_rig(rig: StereoRig, name: str, paths: Sequence[str | Path]) -> tuple[str, ...]:
    """Write a rig for another program and return what its files cannot hold, a line each.

    Raises:
        InputError: unknown format, a rig that does not fit it, or a file that cannot be written.
    """
    return _format(name).write(rig, [Path(p) for p in paths])
