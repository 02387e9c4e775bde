"""Scenes with true disparities, in the folder layouts of the Middlebury benchmark, and the files they use.

- 2001 and 2003: ``im2`` and ``im6`` with ``disp2``, or ``im3`` and ``im4`` with ``disp3`` (Tsukuba); 2005 and 2006:
  ``view1`` and ``view5`` with ``disp1``. The truth is an 8-bit image of scaled disparities, 0 where unknown.
- 2014: ``im0`` and ``im1`` with ``disp0.pfm`` or ``disp0GT.pfm`` and ``calib.txt``; infinity where unknown.
- ``NAME_left`` and ``NAME_right`` with ``NAME_left_gt``, disparities as they are, 0 where unknown.

A mask says which pixels both cameras see: ``mask0nocc``, ``nonocc``, ``nocc`` or ``occlusion_left``, 255 there. Without
one it follows from the truth.

Portable float maps (PFM) store disparities, rows from the bottom up. TIFF files are read as they are, floats included:
some scenes store their truth so, some cameras their images.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.data import Array, Image, Record
from armsight.errors import InputError
from armsight.files import check_readable, read_bytes, read_text, replacing
from armsight.vision.dense.evaluate import TrueDisparity, seen_by_right
from armsight.vision.dense.method import Search
from armsight.vision.image import IMAGE_MB, BitDepth, read_image


def read_pfm(path: str | Path) -> NDArray[np.float32]:
    """Read a grey PFM file into (H, W), the first row at the top; InputError where it is none."""
    data = read_bytes(path, IMAGE_MB)
    try:
        kind, size, scale, rest = data.split(b"\n", 3)
        width, height = (int(n) for n in size.split())
        order = "<f4" if float(scale) < 0 else ">f4"
        if kind.strip() != b"Pf" or width < 1 or height < 1 or len(rest) < 4 * width * height:
            raise ValueError
    except ValueError:
        raise InputError(f"{path}: not a grey PFM file: expected Pf, its size, a scale and the pixels") from None
    pixels = np.frombuffer(rest, order, width * height).reshape(height, width)
    return np.ascontiguousarray(pixels[::-1], dtype=np.float32)


def write_pfm(path: str | Path, image: NDArray[np.floating[Any]], scale: float = 1.0) -> None:
    """Write a grey PFM file (H, W), little-endian; NaN becomes infinity, the benchmark's "unknown".

    ``image``: (H, W); ``scale``: factor of the values written, such as 1000 for mm instead of m. Raises InputError: the
    file cannot be written.
    """
    height, width = image.shape
    with replacing(path, "wb") as file:
        file.write(f"Pf\n{width} {height}\n-1.0\n".encode())
        for row in image[::-1]:
            file.write(np.where(np.isnan(row), np.inf, scale * row).astype("<f4").tobytes())


def read_tiff(path: str | Path) -> NDArray[Any] | None:
    """Read a TIFF file into (H, W) or (H, W, 3) of its own type; None where OpenCV cannot."""
    if not Path(path).is_file():
        return None
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # or it warns of tags it does not know
    try:
        image = cv2.imread(check_readable(path, IMAGE_MB), cv2.IMREAD_UNCHANGED)
    finally:
        cv2.utils.logging.setLogLevel(level)
    return None if image is None else np.asarray(image)


_SUFFIXES = (".png", ".ppm", ".pgm", ".tif", ".tiff", ".pfm", ".jpg", ".bmp")
_MASKS = ("mask0nocc", "nonocc", "nocc", "occlusion_left")
#: Left, right, truth; the first layout whose files are all there counts.
_LAYOUTS = (
    ("im0", "im1", "disp0"),
    ("im0", "im1", "disp0GT"),
    ("im2", "im6", "disp2"),
    ("im3", "im4", "disp3"),
    ("view1", "view5", "disp1"),
)
#: Weights of the benchmark's third version: these of its training scenes count half, for they are very hard.
_HALF = {"pianol", "playroom", "playtable", "shelves", "vintage"}
#: Scale of the truth of the 2001 scenes, of Tsukuba, and by the width of a full-size image, px, of the others' layouts;
#: half, double: wrong disparities.
_SCALE_2001, _SCALE_TSUKUBA, _WIDTH_2003, _WIDTH_2006 = 8.0, 16.0, 1800, 1240
_OF_2001 = {"sawtooth", "venus", "bull", "poster", "barn1", "barn2", "map"}


@dataclass(frozen=True, eq=False)
class MiddleburyScene(Record):
    """A pair with the true disparities of its left image, and the search; ``weight``: in averages over scenes."""

    name: str
    left: Image
    right: Image
    truth: TrueDisparity
    search: Search
    weight: float


def _find(folder: Path, stem: str) -> Path | None:
    return next((folder / (stem + suffix) for suffix in _SUFFIXES if (folder / (stem + suffix)).is_file()), None)


def _files(folder: Path) -> tuple[Path, Path, Path] | None:
    """Return left, right and truth of a scene's folder; None where it is no scene."""
    stems = [path.name[: -len("_left" + path.suffix)] for path in sorted(folder.glob("*_left.*"))]
    for names in (*_LAYOUTS, *((f"{s}_left", f"{s}_right", f"{s}_left_gt") for s in stems)):
        left, right, truth = (_find(folder, name) for name in names)
        if left is not None and right is not None and truth is not None:
            return left, right, truth
    return None


def _scale(name: str, truth: Path, width: int) -> float:
    """Return what an 8-bit truth is to be divided by: as often as an image is smaller than its layout has them."""
    if truth.stem == "disp3":
        return _SCALE_TSUKUBA
    if name.lower() in _OF_2001:
        return _SCALE_2001
    return float(max(1, round((_WIDTH_2006 if truth.stem == "disp1" else _WIDTH_2003) / width)))


def _read_truth(path: Path, name: str) -> Array:
    """Read true disparities (H, W), px, NaN where unknown."""
    if path.suffix == ".pfm":
        raw = read_pfm(path).astype(np.float64)
        return np.where(np.isfinite(raw) & (raw > 0), raw, np.nan)
    if path.suffix in (".tif", ".tiff"):
        image = read_tiff(path)
        if image is None or image.ndim != 2:
            raise InputError(f"{path}: not a grey TIFF that can be read")
        values: Array = np.asarray(image, np.float64)
        scale = 1.0
    else:
        image = read_image(path)
        values = np.asarray(image if image.ndim == 2 else image[:, :, 0], np.float64)
        scale = _scale(name, path, values.shape[1])
    return np.where(np.isfinite(values) & (values > 0), values / scale, np.nan)


def _calibration(folder: Path, key: str) -> int | None:
    """Return a whole number of calib.txt, if it is there."""
    path = folder / "calib.txt"
    if not path.is_file():
        return None
    match = re.search(rf"^{key}\s*=\s*(\d+)", read_text(path), re.MULTILINE)
    return None if match is None else int(match[1])


def _seen(folder: Path, truth: Array) -> NDArray[np.bool_]:
    """Return which pixels (H, W) both cameras see."""
    for stem in _MASKS:
        if (path := _find(folder, stem)) is not None:
            mask = read_image(path)
            if mask.shape[:2] != truth.shape:
                raise InputError(
                    f"{path}: {mask.shape[1]}x{mask.shape[0]} px, the truth has {truth.shape[1]}x{truth.shape[0]}"
                )
            return np.asarray((mask if mask.ndim == 2 else mask[:, :, 0]) == 255)
    return np.asarray(seen_by_right(truth))


def load_scene(folder: str | Path) -> MiddleburyScene:
    """Load a scene; InputError where its layout is unknown or files do not belong together.

    The search holds every true disparity: as many as ``calib.txt`` says, or as the truth's greatest in steps of 16.
    """
    folder = Path(folder)
    files = _files(folder)
    if files is None:
        known = ", ".join(f"{a} {b} {t}" for a, b, t in _LAYOUTS)
        raise InputError(f"{folder}: no scene of a known layout: {known}, or NAME_left NAME_right NAME_left_gt")
    left, right = BitDepth().filled(*(read_image(path) for path in files[:2]))
    name = folder.resolve().name
    truth = _read_truth(files[2], name)
    if not left.shape[:2] == right.shape[:2] == truth.shape:
        sizes = ", ".join(f"{a.shape[1]}x{a.shape[0]}" for a in (left, right, truth))
        raise InputError(f"{folder}: left, right and truth are of different sizes: {sizes} px")
    if not np.isfinite(truth).any():
        raise InputError(f"{files[2]}: no pixel has a truth")
    count = _calibration(folder, "ndisp") or 16 * int(np.ceil((np.nanmax(truth) + 1) / 16))
    search = Search(0, min(count, left.shape[1] - 1))
    weight = 0.5 if name.lower() in _HALF else 1.0
    return MiddleburyScene(name, left, right, TrueDisparity(truth, _seen(folder, truth)), search, weight)


def find_scenes(folder: str | Path) -> list[Path]:
    """Return the folders of scenes: the folder itself, or those in it; InputError where there is none."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    if _files(folder) is not None:
        return [folder]
    found = [path for path in sorted(folder.iterdir()) if path.is_dir() and _files(path) is not None]
    if not found:
        raise InputError(f"{folder}: neither a scene nor a folder of scenes (im0 im1 disp0.pfm, im2 im6 disp2, ...)")
    return found
