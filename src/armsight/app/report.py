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

from armsight.app.report_draw import drawing, png, require_matplotlib
from armsight.app.report_figures import coverage_figure, pairs_figure, residuals_figure
from armsight.app.report_maps import board_figure, volume_figure
from armsight.app.report_sections import SECTIONS
from armsight.app.report_tables import text
from armsight.errors import InputError
from armsight.files import replacing
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

_STYLE = """
:root { color-scheme: light; --ink: #1f2933; --muted: #616e7c; --line: #e4e7eb; --soft: #f5f7fa;
  --good: #2f7d4f; --fair: #b7791f; --poor: #b83232; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.5rem 4rem; max-width: 64rem; background: #fff; color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .3rem; }
h2 { font-size: 1.3rem; margin: 3rem 0 .9rem; padding-top: .9rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.02rem; margin: 1.7rem 0 .5rem; }
p { margin: .5rem 0; max-width: 50rem; }
ul { padding-left: 1.2rem; max-width: 50rem; } li { margin: .35rem 0; }
.sub, nav { color: var(--muted); } nav { margin: .8rem 0 1.6rem; font-size: .92rem; }
nav a { color: #2b6cb0; text-decoration: none; margin-right: 1.1rem; white-space: nowrap; }
.verdict { border-left: .4rem solid; background: var(--soft); padding: .8rem 1.2rem; margin: 1.2rem 0 1.6rem; }
.verdict p { margin: .25rem 0; } .headline { font-size: 1.25rem; font-weight: 650; }
.verdict.good { border-color: var(--good); } .verdict.fair { border-color: var(--fair); }
.verdict.poor { border-color: var(--poor); }
.grade { font-weight: 650; } .grade::before { content: "\\25CF\\00A0"; }
.grade.good { color: var(--good); } .grade.fair { color: var(--fair); } .grade.poor { color: var(--poor); }
table { border-collapse: collapse; margin: .8rem 0 1.2rem; font-size: .92rem; }
th, td { text-align: left; vertical-align: top; padding: .4rem 1.1rem .4rem 0; border-bottom: 1px solid var(--line);
  overflow-wrap: anywhere; }
thead th { color: var(--muted); font-weight: 500; } tbody th { font-weight: 550; }
table.headline td:nth-child(-n+4), table.headline th { white-space: nowrap; }
table.headline td { font-variant-numeric: tabular-nums; } table.headline td:last-child { color: var(--muted); }
table.headline { font-weight: 400; font-size: .95rem; }
table.words th { font-weight: 400; } table.words td { min-width: 18rem; }
table.numbers tbody th { white-space: nowrap; } table.numbers td { font-variant-numeric: tabular-nums; }
figure { margin: 0 0 1rem; } figure img { width: 100%; height: auto; display: block; }
figcaption { background: var(--soft); padding: .6rem 1.1rem; margin-top: .6rem; font-size: .95rem; }
figcaption p { margin: .3rem 0; }
@media (max-width: 48rem) { table { display: block; overflow-x: auto; } }
@media print { body { max-width: none; padding: 0; } nav { display: none; } figure { break-inside: avoid; } }
"""


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
    _put(folder, {**files, PAGE: page(calibration, images).encode()})
    for name in FIGURES.keys() - images.keys():
        (folder / f"report-{name}.png").unlink(missing_ok=True)
    return folder / PAGE


def page(calibration: Calibration, images: dict[str, bytes]) -> str:
    """Return the page; ``images`` maps the names of figures to PNG data."""
    figures = {name: _embedded(name, data) for name, data in images.items()}
    bodies = {anchor: make(calibration, figures) for anchor, (_, make) in SECTIONS.items()}
    shown = {anchor: SECTIONS[anchor][0] for anchor, body in bodies.items() if body}
    links = "".join(f'<a href="#{anchor}">{title}</a> ' for anchor, title in shown.items())
    main = "".join(
        f'<section id="{anchor}">\n<h2>{title}</h2>\n{bodies[anchor]}</section>\n' for anchor, title in shown.items()
    )
    left, right = ("{} x {}".format(*camera.image_size_px) for camera in calibration.rig.cameras)
    size = f"{left} px" if left == right else f"{left} px left, {right} px right"
    used = f"{len(calibration.pairs)} of {calibration.pairs_found} pairs of images used"
    what = f"{calibration.body.name} · {used} · {size} · baseline {1e3 * calibration.rig.baseline_m:.1f} mm"
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>armsight: calibration report</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        f'<h1>Calibration of two cameras</h1>\n<p class="sub">{text(what)}</p>\n<nav>{links}</nav>\n'
        f"<main>\n{main}</main>\n</body>\n</html>\n"
    )


def _embedded(name: str, data: bytes) -> str:
    """Return a figure as an HTML image that holds its own data."""
    source = f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"
    return f'<img src="{source}" alt="{text(FIGURES[name][1])}">'


def _put(folder: Path, files: dict[str, bytes]) -> None:
    """Put files in place, each whole; where one fails, those that were not there before are taken away again."""
    made: list[Path] = []
    try:
        for name, data in files.items():
            path = folder / name
            if not path.exists():
                made.append(path)
            with replacing(path, "wb") as file:
                file.write(data)
    except BaseException:
        for path in made:
            path.unlink(missing_ok=True)
        raise
