"""The files of a dense result, and pictures of disparity maps."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from armsight.app.show.plotting import INK, bgr
from armsight.data import Image
from armsight.errors import InputError
from armsight.files import replacing
from armsight.vision.dense.depth import Depth, depth_of
from armsight.vision.dense.evaluate import TrueDisparity
from armsight.vision.dense.method import FILLED, MEASURED, NOTHING, OCCLUDED, Disparity
from armsight.vision.dense.middlebury import write_pfm
from armsight.vision.image import eight_bits
from armsight.vision.rectify import Rectification

#: Width of the scale, of the space for its numbers, and height of the caption, px.
_BAR_PX, _MARGIN_PX, _CAPTION_PX = 18, 62, 26
_INK, _PAPER = bgr(INK), (255, 255, 255)
_FONT, _SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.42
#: Colours (BGR) of an error map: right, off by more than each threshold, and no truth.
_RIGHT, _OFF_1, _OFF_2, _OFF_4, _UNKNOWN = (225, 225, 225), (120, 200, 250), (40, 130, 235), (30, 30, 170), (90, 60, 40)
#: Factor of the colours of pixels that only the left camera sees.
_DARKER = 0.75
#: Colour of such a pixel without an error, in the legend.
_HIDDEN = (169, 169, 169)


def _colours(values: NDArray[np.floating[Any]], low: float, high: float) -> Image:
    share = np.nan_to_num((values.astype(np.float32) - np.float32(low)) * np.float32(255 / max(high - low, 1e-9)))
    return np.asarray(cv2.applyColorMap(np.clip(share, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO))


def _write(canvas: Image, text: str, at: tuple[int, int]) -> None:
    cv2.putText(canvas, text, at, _FONT, _SIZE, _INK, 1, cv2.LINE_AA)


def paint_disparity(result: Disparity) -> Image:
    """Return a picture (BGR) of a disparity map with its scale; what was filled is paler, in stripes."""
    height, width = result.disparity.shape
    canvas = np.full((height + _CAPTION_PX, width + _BAR_PX + _MARGIN_PX, 3), _PAPER, np.uint8)
    some = np.isfinite(result.disparity) & (result.state != NOTHING)
    if not some.any():
        canvas[:height, :width] = (200, 200, 200)
        _write(canvas, "nothing measured", (4, height + 17))
        return canvas
    low, high = (float(q) for q in np.percentile(result.disparity[some], (0.5, 99.5)))
    picture = _colours(result.disparity, low, high)
    diagonal = np.add.outer(np.arange(height, dtype=np.int16), np.arange(width, dtype=np.int16))
    pale = some & (result.state != MEASURED) & (diagonal % 6 < 3)
    picture[pale] = (0.35 * picture[pale] + 0.65 * 255).astype(np.uint8)
    picture[~some] = (200, 200, 200)
    canvas[:height, :width] = picture
    _bar(canvas, height, width, low, high)
    names = ((MEASURED, "measured"), (OCCLUDED, "hidden"), (FILLED, "filled"))
    shares = [f"{100 * np.mean(result.state == state):.0f}% {name}" for state, name in names]
    _write(canvas, ", ".join(shares), (4, height + 17))
    return canvas


def _bar(canvas: Image, height: int, width: int, low: float, high: float) -> None:
    left = width + 10
    values = np.linspace(high, low, height)[:, None]
    canvas[:height, left : left + _BAR_PX] = np.repeat(_colours(values, low, high), _BAR_PX, axis=1)
    for value in _round_values(low, high):
        y = round((high - value) / max(high - low, 1e-9) * (height - 1))
        canvas[y, left + _BAR_PX : left + _BAR_PX + 3] = _INK
        _write(canvas, f"{value:g} px", (left + _BAR_PX + 5, min(max(y + 4, 10), height - 2)))


def _round_values(low: float, high: float) -> list[float]:
    """Return three to seven round numbers between low and high, or their middle where they are the same."""
    span = high - low
    if span < 1e-6:
        return [float(f"{(low + high) / 2:.3g}")]
    power = 10 ** np.floor(np.log10(span / 3))
    step = next(float(power * k) for k in (10, 5, 2, 1) if span / (power * k) >= 3)
    return [float(k * step) for k in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]


def paint_errors(disparity: NDArray[np.float32], truth: TrueDisparity) -> Image:
    """Return a picture (BGR) of where a map is off by more than 1, 2 and 4 px; what only the left camera sees is darker."""
    height, width = disparity.shape
    error = np.abs(disparity - truth.disparity)
    picture = np.full((height, width, 3), _RIGHT, np.uint8)
    for threshold, colour in ((1.0, _OFF_1), (2.0, _OFF_2), (4.0, _OFF_4)):
        picture[~(error <= threshold)] = colour
    hidden = truth.known & ~truth.seen
    picture[hidden] = (_DARKER * picture[hidden]).astype(np.uint8)
    picture[~truth.known] = _UNKNOWN
    canvas = np.full((height + _CAPTION_PX, width, 3), _PAPER, np.uint8)
    canvas[:height] = picture
    x = 4
    for name, colour in (
        ("right", _RIGHT),
        ("> 1 px", _OFF_1),
        ("> 2", _OFF_2),
        ("> 4", _OFF_4),
        ("no truth", _UNKNOWN),
        ("seen by one", _HIDDEN),
    ):
        cv2.rectangle(canvas, (x, height + 8), (x + 10, height + 18), colour, -1)
        cv2.rectangle(canvas, (x, height + 8), (x + 10, height + 18), _INK, 1)
        _write(canvas, name, (x + 14, height + 17))
        x += 24 + 8 * len(name)
    return canvas


#: Steps of a pixel in the 16-bit disparity image: 1023 px at most.
PNG_STEPS = 64
#: Files of a pair's result; the first two and the depth's only with a rig.
RESULT_FILES = (
    "left.png",
    "right.png",
    "disparity.pfm",
    "disparity.png",
    "valid.png",
    "state.png",
    "sigma.pfm",
    "picture.png",
    "depth_mm.pfm",
    "depth_sigma_mm.pfm",
    "cloud.ply",
)
#: Fields of a point of a cloud.
_FIELDS = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")] + [("sigma", "<f4")]
#: Rows of the image whose points are written at a time.
_ROWS_AT_ONCE = 64


@dataclass(frozen=True)
class DenseSummary:
    """A dense result in numbers; the fields are the keys of its JSON object."""

    measured_percent: float  #: share of the pixels that were measured
    hidden_percent: float  #: share that the right camera does not see
    filled_percent: float  #: share that was filled from its neighbours
    not_in_view_percent: float  #: share that the left camera does not see
    median_sigma_px: float | None  #: of the measured disparities; None where there are none
    disparities_px: tuple[int, int]  #: first and last disparity that was tried
    problem: str | None  #: why nothing was measured; None where something was
    points: int | None = None
    median_depth_mm: float | None = None  #: of the measured pixels; None where there is no depth
    median_depth_sigma_mm: float | None = None  #: the same of the depth's standard deviation

    def to_json(self) -> dict[str, Any]:
        """Return the summary as JSON has it; without a depth its keys are absent."""
        document = asdict(self)
        if self.points is None:
            for key in ("points", "median_depth_mm", "median_depth_sigma_mm"):
                del document[key]
        return document


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
        form: how the images were rectified.
        result: the disparities.
        depth: their depths.
        image: (H, W) grey or (H, W, 3) BGR, the rectified left image.
    """
    chosen = result.measured & np.isfinite(depth.depth_m)
    count = int(np.count_nonzero(chosen))
    kinds = {"<f4": "float", "u1": "uchar"}
    header = ["ply", "format binary_little_endian 1.0", "comment frame: left camera; x y z in m"]
    header += ["comment sigma: standard deviation of the depth, m", f"element vertex {count}"]
    header += [f"property {kinds[kind]} {name}" for name, kind in _FIELDS]
    image = eight_bits(image)
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
    rows = np.empty(len(u), np.dtype(_FIELDS))
    for k, name in enumerate("xyz"):
        rows[name] = p_left[:, k]
    for k, name in enumerate(("blue", "green", "red")):
        rows[name] = colours[:, k]
    rows["sigma"] = depth.sigma_m[v, u]
    return rows.tobytes()


def write_result(folder: Path, result: Disparity, form: Rectification | None, image: Image) -> DenseSummary:
    """Write all files of a result."""
    write_pfm(folder / "disparity.pfm", result.disparity)
    steps = np.nan_to_num(result.disparity, posinf=0) * PNG_STEPS
    write_png(folder / "disparity.png", np.rint(np.clip(steps, 0, 65535)).astype(np.uint16))
    write_png(folder / "valid.png", np.where(result.measured, 255, 0).astype(np.uint8))
    write_png(folder / "state.png", result.state)
    write_pfm(folder / "sigma.pfm", result.sigma_px)
    write_png(folder / "picture.png", paint_disparity(result))
    summary = summary_of(result)
    if form is None or result.problem is not None:
        return summary
    depth = depth_of(form, result)
    write_pfm(folder / "depth_mm.pfm", depth.depth_m, 1e3)
    write_pfm(folder / "depth_sigma_mm.pfm", depth.sigma_m, 1e3)
    return replace(
        summary,
        points=write_cloud(folder / "cloud.ply", form, result, depth, image),
        median_depth_mm=_median(depth.depth_m[result.measured], 1e3),
        median_depth_sigma_mm=_median(depth.sigma_m[result.measured], 1e3),
    )


def summary_of(result: Disparity) -> DenseSummary:
    """Return the summary of a result without its depths."""
    measured, hidden, filled, outside = (
        100 * float(np.mean(result.state == state)) for state in (MEASURED, OCCLUDED, FILLED, NOTHING)
    )
    disparities_px = (result.search.first, result.search.last)
    return DenseSummary(measured, hidden, filled, outside, _median(result.sigma_px), disparities_px, result.problem)


def _median(values: NDArray[np.floating[Any]], scale: float = 1.0) -> float | None:
    finite = values[np.isfinite(values)]
    return scale * float(np.median(finite, overwrite_input=True)) if finite.size else None
