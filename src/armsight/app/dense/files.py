"""The files of a dense result: what ``armsight dense`` leaves in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.app.dense_picture import paint_disparity
from armsight.data import Image
from armsight.errors import InputError
from armsight.files import replacing
from armsight.vision.dense.depth import Depth, depth_of
from armsight.vision.dense.method import FILLED, MEASURED, NOTHING, OCCLUDED, Disparity
from armsight.vision.dense.pfm import write_pfm
from armsight.vision.rectify import Rectification

#: Steps of a pixel in the 16-bit disparity image: 1023 px at most.
PNG_STEPS = 64
#: What a point of a cloud holds, and rows of the image whose points are written at a time.
_FIELDS = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")] + [("sigma", "<f4")]
_ROWS_AT_ONCE = 64
_STATES = {"measured": MEASURED, "hidden": OCCLUDED, "filled": FILLED, "not_in_view": NOTHING}


def make_folder(path: Path) -> Path:
    """Make the folder of a result.

    Raises:
        InputError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: cannot be made a folder: {error.strerror}") from None
    return path


def check_folder(path: Path) -> None:
    """Refuse what cannot become a folder, without making it: a result that is none must leave nothing behind.

    Raises:
        InputError: something that is no folder stands there, or in the way.
    """
    there = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not there.is_dir():
        raise InputError(f"{path}: cannot be made a folder: {there} is a file")


def write_png(path: Path, image: Image) -> None:
    """Write an image as PNG; errors as :func:`armsight.files.replacing`."""
    good, data = cv2.imencode(".png", image)
    if not good:
        raise InputError(f"{path}: the image could not be written as PNG")
    with replacing(path, "wb") as file:
        file.write(data.tobytes())


def write_cloud(path: Path, form: Rectification, result: Disparity, depth: Depth, image: Image) -> int:
    """Write the measured points as a binary PLY file, and return how many there are.

    Args:
        path: where to.
        form: how the images became standard form.
        result: the disparities.
        depth: their depths.
        image: (H, W) grey or (H, W, 3) BGR, the left image in standard form.
    """
    chosen = result.measured & np.isfinite(depth.depth_m)
    count = int(np.count_nonzero(chosen))
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", "comment frame: left camera; x y z in m"]
    header += ["comment sigma: standard deviation of the depth, m", f"element vertex {count}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in _FIELDS]
    with replacing(path, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode())
        for top in range(0, chosen.shape[0], _ROWS_AT_ONCE):
            file.write(_vertices(slice(top, top + _ROWS_AT_ONCE), chosen, form, result, depth, image))
    return count


def _vertices(
    strip: slice, chosen: NDArray[np.bool_], form: Rectification, result: Disparity, depth: Depth, image: Image
) -> bytes:
    """Return the points of some rows as PLY has them."""
    v, u = np.nonzero(chosen[strip])
    v += strip.start
    p_left = form.points(np.column_stack([u, v]).astype(np.float64), result.disparity[v, u].astype(np.float64))
    colours = image[v, u] if image.ndim == 3 else np.repeat(image[v, u][:, None], 3, axis=1)
    if colours.dtype == np.uint16:
        colours = colours >> 8
    rows = np.empty(len(u), np.dtype(_FIELDS))
    for k, name in enumerate("xyz"):
        rows[name] = p_left[:, k]
    for k, name in enumerate(("blue", "green", "red")):
        rows[name] = colours[:, k]
    rows["sigma"] = depth.sigma_m[v, u]
    return rows.tobytes()


def write_result(folder: Path, result: Disparity, form: Rectification | None, image: Image) -> dict[str, Any]:
    """Write all files of a result and return what there is to say about it.

    Args:
        folder: where to; it exists.
        result: the disparities.
        form: how the images became standard form; None where they came so, and there is no depth.
        image: the left image in standard form, for colours.
    """
    write_pfm(folder / "disparity.pfm", result.disparity)
    steps = np.nan_to_num(result.disparity, posinf=0) * PNG_STEPS
    write_png(folder / "disparity.png", np.rint(np.clip(steps, 0, 65535)).astype(np.uint16))
    write_png(folder / "valid.png", np.where(result.measured, 255, 0).astype(np.uint8))
    write_png(folder / "state.png", result.state)
    write_pfm(folder / "sigma.pfm", result.sigma_px)
    write_png(folder / "picture.png", paint_disparity(result))
    said = facts(result)
    if form is None or result.problem is not None:
        return said
    depth = depth_of(form, result)
    write_pfm(folder / "depth_mm.pfm", depth.depth_m, 1e3)
    write_pfm(folder / "depth_sigma_mm.pfm", depth.sigma_m, 1e3)
    said["points"] = write_cloud(folder / "cloud.ply", form, result, depth, image)
    said["median_depth_mm"] = _median(depth.depth_m[result.measured], 1e3)
    said["median_depth_sigma_mm"] = _median(depth.sigma_m[result.measured], 1e3)
    return said


def facts(result: Disparity) -> dict[str, Any]:
    """Return what there is to say about a result: shares in percent, the median sigma, the search."""
    said: dict[str, Any] = {
        f"{name}_percent": 100 * float(np.mean(result.state == state)) for name, state in _STATES.items()
    }
    said["median_sigma_px"] = _median(result.sigma_px)
    said["disparities_px"] = [result.search.first, result.search.last]
    said["problem"] = result.problem
    return said


def _median(values: NDArray[np.floating[Any]], scale: float = 1.0) -> float | None:
    """Return the median of what is finite, times a scale; None where nothing is."""
    finite = values[np.isfinite(values)]
    return scale * float(np.median(finite, overwrite_input=True)) if finite.size else None
