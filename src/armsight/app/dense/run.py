"""One pair of ``armsight dense``: from images to files and what is said about them.

A method compiled in a process of its own.

The first run of a method compiles it, and the compiler keeps about 100 MB for as long as its process lives. Here another
process does that and ends; this one reads what is compiled from numba's cache.

    python -m armsight.app.dense.run METHOD
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba.core import event
from numpy.typing import NDArray

from armsight.app.dense.files import make_folder, write_png, write_result
from armsight.data import Image, Shot
from armsight.errors import InputError
from armsight.vision.dense.method import NOTHING, Disparity, Method, Search
from armsight.vision.dense.methods import open_method
from armsight.vision.dense.middlebury import read_pfm, read_tiff
from armsight.vision.dense.rectified import match_pair, plain_grey
from armsight.vision.image import read_image
from armsight.vision.rectify import Rectification


class _NotYetError(Exception):
    """Something is about to be compiled here."""


class _Watch(event.Listener):
    """Stops what would compile."""

    def on_start(self, event: event.Event) -> None:
        """Refuse."""
        raise _NotYetError

    def on_end(self, event: event.Event) -> None:
        """Nothing was begun."""


def _run(name: str) -> None:
    """Match a small pair, so that all of a method is compiled or read."""
    noise = np.random.default_rng(0).integers(0, 256, (64, 140)).astype(np.uint8)
    left, right = noise[:, :128].copy(), noise[:, 4:132].copy()  # a disparity of 4: matched, smoothed and filled
    for image in (left, right):
        image.setflags(write=False)  # as a shot's images are: to the compiler that is another type
    open_method(name).match(left, right, Search(0, 16))


def compile_apart(name: str) -> None:
    """Have a method compiled elsewhere, unless numba's cache holds it already.

    Where the cache cannot be written, this process will compile when it matches: only its memory is more.
    """
    try:
        with event.install_listener("numba:compile", _Watch()):
            _run(name)
    except _NotYetError:
        subprocess.run([sys.executable, "-m", __name__, name], check=False, capture_output=True)


if __name__ == "__main__":
    _run(sys.argv[1])


#: Without a nearest depth or a greatest disparity: the nearest depth, in baselines.
_NEAREST_BASELINES = 3.0


def read_pair(left: Path, right: Path) -> Shot:
    """Read the two images of a pair; PFM and TIFF files may hold floats of 0 to 255.

    Raises:
        InputError: a file is missing, no image, or holds numbers that are no grey levels.
    """
    return Shot(f"{left}, {right}", _read_pixels(left), _read_pixels(right))


def _read_pixels(path: Path) -> Image:
    """Read an image; floats become 8-bit grey."""
    floats: NDArray[np.generic] | None = None
    if path.suffix.lower() == ".pfm":
        floats = read_pfm(path)
    elif path.suffix.lower() in (".tif", ".tiff"):
        floats = read_tiff(path)
    if floats is None or floats.dtype.kind != "f":
        return read_image(path)
    try:
        return plain_grey(floats, "the")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def search_of(form: Rectification | None, max_disparity: int | None, near: float | None, shot: Shot) -> Search:
    """Return the disparities to try for a shot.

    Args:
        form: how its images become standard form; None where they are.
        max_disparity: disparities below it are tried; or None.
        near: the nearest depth, m; or None.
        shot: the shot.

    Raises:
        InputError: a search that leaves the image.
    """
    if shot.left is None:
        raise InputError(f"{shot.name}: {shot.problem or 'no image'}")
    width = int(shot.left.shape[1])
    if max_disparity is not None:
        if not 2 <= max_disparity <= width:
            raise InputError(f"--max-disparity {max_disparity}: outside the image: expected 2 to its width, {width} px")
        return Search(0, max_disparity)
    if form is None:
        raise InputError("--rectified needs --max-disparity N: nothing else says how near the scene is")
    nearest = near if near is not None else _NEAREST_BASELINES * form.rig.baseline_m
    count = int(np.ceil(form.disparity_of(nearest))) + 1
    if near is not None and count > width:
        raise InputError(
            f"--near {near:g}: the disparity there is {count} px, outside an image {width} px wide; give more"
        )
    return Search(0, max(2, min(count, width)))


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


def run_shot(
    shot: Shot,
    folder: Path,
    form: Rectification | None,
    method: Method,
    search: Search,
    note: Callable[[str], None],
) -> dict[str, Any]:
    """Match a shot, make a folder, write its files there, and return what there is to say.

    Raises:
        InputError: the images are no pair in standard form, or are not of the rig's size.
    """
    if shot.left is None or shot.right is None:
        raise InputError(f"{shot.name}: {shot.problem or 'no image'}")
    left, right = shot.left, shot.right
    begun = time.perf_counter()
    try:
        if form is not None:
            left, right = form.images(left, right)
        result = match_pair(method, left, right, search, note)
    except InputError as error:
        where = shot.name if form is None else f"{shot.name}, put into standard form by the rig"
        raise InputError(f"{where}: {error}") from None
    seconds = time.perf_counter() - begun
    make_folder(folder)
    if form is not None:
        result = _in_view(result, form)
        write_png(folder / "left.png", left)
        write_png(folder / "right.png", right)
    return {"shot": shot.name, **write_result(folder, result, form, left), "seconds": seconds, "out": str(folder)}


def result_line(record: dict[str, Any]) -> str:
    """Format one pair for people."""
    if record["problem"] is not None:
        return f"{record['shot']}: nothing measured: {record['problem']}"
    line = (
        f"{record['shot']}: {record['measured_percent']:.1f}% measured (median sigma "
        f"{record['median_sigma_px']:.2f} px), {record['hidden_percent']:.1f}% hidden from the right camera and "
        f"{record['filled_percent']:.1f}% unsure, filled"
    )
    if record["not_in_view_percent"] > 0:
        line += f", {record['not_in_view_percent']:.1f}% not in view"
    if record.get("median_depth_mm") is not None:
        line += f"; depth {record['median_depth_mm']:.0f} mm ± {record['median_depth_sigma_mm']:.1f} (medians)"
        line += f", {record['points']} points"
    return line + f"; {record['seconds']:.2f} s; written to {record['out']}"
