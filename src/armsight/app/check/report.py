"""The report of a test: one page that holds its figures, the figures as PNGs, the numbers and the rows they are made of."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from armsight.app.check_figures import anywhere_figure, circle_figure, drift_figure, paths_figure, scatter_figure
from armsight.app.check.rows import Row, rows_csv
from armsight.app.check_words import MEANINGS, figures
from armsight.app.report.page import html_page, put_files
from armsight.app.report.plotting import drawing, png
from armsight.app.report_tables import bullets, table, text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE = "report.html"
#: Anchor -> title, how it is drawn (None where there is nothing to draw), and what it shows.
FIGURES: dict[str, tuple[str, Callable[[Mapping[str, Any], Sequence[Row]], Figure | None], str]] = {
    "scatter": (
        "The poses",
        scatter_figure,
        "Where each pose was attained, about the middle of it, and RP as a circle: dotted where it cannot be resolved, "
        "then it is the bound. The instrument's noise is still in the dots.",
    ),
    "anywhere": ("The workspace", anywhere_figure, "How far from the command each pose was attained."),
    "drift": (
        "Drift",
        drift_figure,
        "Where the first pose was attained over time, and how far its middle has wandered.",
    ),
    "paths": (
        "The paths",
        paths_figure,
        "Distance from the commanded path along it: mean path thick, every cycle thin.",
    ),
    "circle": (
        "The circle",
        circle_figure,
        "Deviations from the fitted circle, enlarged. Where the motion along an axis turns back the radius jumps by the "
        "play: at each such place stands the jump counter-clockwise / clockwise, mm. J: these joints turn back there; the "
        "play of an arm of turning joints shows there, and not where x or y turns back.",
    ),
}


def write_check(facts: Mapping[str, Any], rows: Sequence[Row], source: Path, folder: Path) -> Path:
    """Write the report of a test.

    Args:
        facts: its figures.
        rows: what they are made of.
        source: where those came from.
        folder: an existing folder; files of an earlier report in it are replaced.

    Returns:
        The page; check.json, check.csv and the figures are beside it.

    Raises:
        InputError: matplotlib is missing, or a file cannot be written; then none of the new ones is left.
    """
    images: dict[str, bytes] = {}
    with drawing():
        for name, (_, draw, _) in FIGURES.items():
            drawn = draw(facts, rows)
            if drawn is not None:
                images[name] = png(drawn)
    files = {f"check-{name}.png": data for name, data in images.items()}
    files["check.json"] = (json.dumps(facts, indent=1) + "\n").encode()
    files["check.csv"] = rows_csv(list(rows)).encode()
    put_files(folder, {**files, PAGE: _page(facts, images, source).encode()})
    for name in FIGURES.keys() - images.keys():
        (folder / f"check-{name}.png").unlink(missing_ok=True)
    return folder / PAGE


def _page(facts: Mapping[str, Any], images: Mapping[str, bytes], source: Path) -> str:
    """Return the page."""
    sections = {"result": ("Result", _result(facts))}
    for name, data in images.items():
        title, _, caption = FIGURES[name]
        image = f'<img src="data:image/png;base64,{base64.b64encode(data).decode("ascii")}" alt="{text(title)}">'
        sections[name] = (title, f"<figure>{image}<figcaption><p>{text(caption)}</p></figcaption></figure>")
    return html_page("armsight: check", "What robots are judged by", f"ISO 9283 · {source}", sections)


def _mm(value: float | None) -> str:
    """Return a length, m, in mm; nothing where there is none."""
    return "" if value is None else f"{1e3 * value:.3f}"


def _result(facts: Mapping[str, Any]) -> str:
    """Return the table of all figures."""
    rows = []
    for name, what, f in figures(facts):
        raw, sigma, low, high, least = (_mm(f[key]) for key in ("raw", "sigma", "low", "high", "resolvable"))
        told = "not resolvable" if f["clean"] is None else _mm(f["clean"])
        ends = f"{low} to {high}" if low else ""
        rows.append((text(name), text(what), f"<b>{told}</b>", sigma, ends, raw, least))
    head = ("", "of", "mm", "sigma", "95 %, from to", "as measured", "could be told")
    used = {name for name, _, _ in figures(facts)}
    meant = [f"{name}: {meaning}." for name, meaning in MEANINGS.items() if name in used]
    words = (
        "<p>Each figure without the noise, the interval that holds the true one 95 times in a hundred, and the figure as "
        "the standard computes it. What the noise could make as well is called not resolvable; from which figure on it "
        "could have been told stands last. Without the instrument's sigma a figure may have no interval.</p>\n"
    )
    return words + table(head, rows, "numbers") + bullets(meant) + (bullets(facts["notes"]) if facts["notes"] else "")
