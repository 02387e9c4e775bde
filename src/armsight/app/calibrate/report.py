"""The report of a calibration: one HTML page that says whether it is good, and its figures as PNG files beside it.

A Calibration goes in, a folder comes out. The page holds its figures itself, needs no network and runs no script. All is
drawn in memory first; then every file is put in place whole, the page last.
"""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from armsight.app.report.page import html_page, put_files
from armsight.app.report.plotting import drawing, png, require_matplotlib
from armsight.app.calibrate.figures import coverage_figure, pairs_figure, residuals_figure
from armsight.app.report_maps import board_figure, volume_figure
from armsight.app.report_sections import SECTIONS
from armsight.app.report_tables import text
from armsight.errors import InputError
from armsight.vision.calibrate.result import Calibration

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "index.html"
#: Name -> how it is drawn (None where there is nothing to draw) and what it shows, for who cannot see it.
FIGURES: dict[str, tuple[Callable[[Calibration], Figure | None], str]] = {
    "coverage": (coverage_figure, "Maps of both images: how many points were seen in which part"),
    "residuals": (residuals_figure, "Residual vectors over both images, every point and averaged by region"),
    "pairs": (pairs_figure, "Bars: held-out epipolar and rigid error of every pair"),
    "volume": (volume_figure, "Maps of the predicted depth and lateral sigma over a slice of the volume"),
    "board": (board_figure, "Map of the board's deviation from its drawing"),
}


def report_folder(directory: str | Path) -> Path:
    """Make sure that a report can be written, before the work it reports on is begun.

    Args:
        directory: the folder of the report; made with its parents where it does not exist.

    Returns:
        The folder.

    Raises:
        InputError: matplotlib is missing, or the folder cannot be made or written to.
    """
    require_matplotlib()
    folder = Path(directory).expanduser()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"{folder}: no report can be written here: {error.strerror}") from None
    return folder


def write_report(calibration: Calibration, directory: str | Path) -> Path:
    """Write the report of a calibration.

    Args:
        calibration: what is reported on.
        directory: the folder; files of an earlier report in it are replaced, others stay.

    Returns:
        The page, index.html in the folder; every figure is beside it as report-NAME.png.

    Raises:
        InputError: matplotlib is missing, or the folder cannot be written to; then none of the report's files is new.
    """
    folder = report_folder(directory)
    images: dict[str, bytes] = {}
    with drawing():
        for name, (draw, _) in FIGURES.items():
            figure = draw(calibration)
            if figure is not None:
                images[name] = png(figure)
    files = {f"report-{name}.png": data for name, data in images.items()}
    put_files(folder, {**files, PAGE: page(calibration, images).encode()})
    for name in FIGURES.keys() - images.keys():
        (folder / f"report-{name}.png").unlink(missing_ok=True)
    return folder / PAGE


def page(calibration: Calibration, images: dict[str, bytes]) -> str:
    """Return the page; ``images`` maps the names of figures to PNG data."""
    figures = {name: _embedded(name, data) for name, data in images.items()}
    bodies = {anchor: make(calibration, figures) for anchor, (_, make) in SECTIONS.items()}
    shown = {anchor: SECTIONS[anchor][0] for anchor, body in bodies.items() if body}
    left, right = ("{} x {}".format(*camera.image_size_px) for camera in calibration.rig.cameras)
    size = f"{left} px" if left == right else f"{left} px left, {right} px right"
    used = f"{len(calibration.pairs)} of {calibration.pairs_found} pairs of images used"
    what = f"{calibration.body.name} · {used} · {size} · baseline {1e3 * calibration.rig.baseline_m:.1f} mm"
    sections = {anchor: (title, bodies[anchor]) for anchor, title in shown.items()}
    return html_page("armsight: calibration report", "Calibration of two cameras", what, sections)


def _embedded(name: str, data: bytes) -> str:
    """Return a figure as an HTML image that holds its own data."""
    source = f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"
    return f'<img src="{source}" alt="{text(FIGURES[name][1])}">'
