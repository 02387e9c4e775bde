"""One pair of ``armsight dense``, from images to files."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armsight.app.dense.files import DenseSummary, write_png, write_result
from armsight.data import Image, Shot
from armsight.errors import InputError, naming
from armsight.files import made_folder
from armsight.vision.dense.method import NOTHING, Disparity, Method, Search
from armsight.vision.dense.middlebury import read_pfm, read_tiff
from armsight.vision.dense.rectified import match_pair, plain_grey
from armsight.vision.image import BitDepth, read_image
from armsight.vision.rectify import Rectification

#: Without a nearest depth or a greatest disparity: the nearest depth, in baselines.
_NEAREST_BASELINES = 3.0
#: A nearest depth at which the disparity is below this, px, is no nearest depth: millimetres were taken for metres.
_LEAST_DISPARITY = 2.0


def read_pair(left: Path, right: Path) -> Shot:
    """Read the two images of a pair; PFM and TIFF files may hold floats of 0 to 255."""
    return BitDepth().shot(Shot(f"{left}, {right}", _read_pixels(left), _read_pixels(right)))


def _read_pixels(path: Path) -> Image:
    floats: NDArray[np.generic] | None = None
    if path.suffix.lower() == ".pfm":
        floats = read_pfm(path)
    elif path.suffix.lower() in (".tif", ".tiff"):
        floats = read_tiff(path)
    if floats is None or floats.dtype.kind != "f":
        return read_image(path)
    with naming(path):
        return plain_grey(floats, "the")


def search_of(form: Rectification | None, max_disparity: int | None, near: float | None, shot: Shot) -> Search:
    """Return the disparities to try for a shot: below a given one, or as a nearest depth, m, has them."""
    if shot.left is None:
        raise InputError(f"{shot.name}: {shot.problem or 'no image'}")
    width = int(shot.left.shape[1])
    if max_disparity is not None:
        if not 2 <= max_disparity <= width:
            raise InputError(f"--max-disparity {max_disparity}: outside the image: expected 2 to its width, {width} px")
        return Search(0, max_disparity)
    assert form is not None  # the command's check
    nearest = near if near is not None else _NEAREST_BASELINES * form.rig.baseline_m
    count = int(np.ceil(form.disparity_of(nearest))) + 1
    if near is not None and count > width:
        raise InputError(
            f"--near {near:g}: the disparity there is {count} px, outside an image {width} px wide; give more"
        )
    return Search(0, max(2, min(count, width)))


def check_near(form: Rectification, near: float) -> None:
    """Check that a nearest depth leaves something to search.

    Args:
        form: how the images are rectified.
        near: the nearest depth, m.

    Raises:
        InputError: the disparity at that depth is so small that all of a scene is nearer.
    """
    disparity = float(form.disparity_of(near))
    if disparity < _LEAST_DISPARITY:
        raise InputError(
            f"--near {near:g}: metres; {near:g} m away the disparity is {disparity:.2g} px, so that everything nearer is "
            f"left out: give the depth of the nearest surface in m (300 mm is --near 0.3)"
        )


def _in_view(result: Disparity, form: Rectification) -> Disparity:
    """Return a result without what the left camera does not see."""
    seen = form.seen("left")
    nan, zero = np.float32(np.nan), np.float32(0)
    return Disparity(
        result.disparity,
        np.where(seen, result.state, np.uint8(NOTHING)),
        np.where(seen, result.sigma_px, nan),
        np.where(seen, result.confidence, zero),
        result.search,
        result.problem,
    )


@dataclass(frozen=True)
class PairResult:
    """The result of one pair."""

    shot: str
    summary: DenseSummary
    seconds: float
    folder: Path

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        return {"shot": self.shot, **self.summary.to_json(), "seconds": self.seconds, "output": str(self.folder)}


def run_shot(
    shot: Shot, folder: Path, form: Rectification | None, method: Method, search: Search, note: Callable[[str], None]
) -> PairResult:
    """Match a shot, make a folder and write its files there."""
    if shot.left is None or shot.right is None:
        raise InputError(f"{shot.name}: {shot.problem or 'no image'}")
    left, right = shot.left, shot.right
    begun = time.perf_counter()
    try:
        if form is not None:
            left, right = form.images(left, right)
        result = match_pair(method, left, right, search, note)
    except InputError as error:
        where = shot.name if form is None else f"{shot.name}, rectified by the rig"
        raise InputError(f"{where}: {error}") from None
    seconds = time.perf_counter() - begun
    made_folder(folder)
    if form is not None:
        result = _in_view(result, form)
        write_png(folder / "left.png", left)
        write_png(folder / "right.png", right)
    return PairResult(shot.name, write_result(folder, result, form, left), seconds, folder)


def problem_line(shot: str, problem: str) -> str:
    """Return a pair without a result as a line of text."""
    return f"{shot}: nothing measured: {problem}"


def result_line(result: PairResult) -> str:
    """Return one pair as a line of text."""
    summary = result.summary
    if summary.problem is not None:
        return problem_line(result.shot, summary.problem)
    line = (
        f"{result.shot}: {summary.measured_percent:.1f}% measured (median sigma "
        f"{summary.median_sigma_px:.2f} px), {summary.hidden_percent:.1f}% hidden from the right camera and "
        f"{summary.filled_percent:.1f}% unsure, filled"
    )
    if summary.not_in_view_percent > 0:
        line += f", {summary.not_in_view_percent:.1f}% not in view"
    if summary.median_depth_mm is not None:
        line += f"; depth {summary.median_depth_mm:.0f} mm ± {summary.median_depth_sigma_mm:.1f} (medians)"
        line += f", {summary.points} points"
    return line + f"; {result.seconds:.2f} s; written to {result.folder}"
