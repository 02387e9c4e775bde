"""The report of an identification: one HTML page that holds its figures, and the figures as PNG files beside it."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armsight.app.identify_figures import causes_figure, correlation_figure, growth_figure, joints_figure, map_figure
from armsight.app.identify.run import Run
from armsight.app.identify_words import headline, value_text
from armsight.app.report.plotting import drawing, png
from armsight.files import replacing, write_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Name -> how it is drawn, its title, and what to see in it.
FIGURES: dict[str, tuple[Callable[[Run], Figure], str, str]] = {
    "map": (
        map_figure,
        "Errors over the workspace",
        "Poses left out of the fit, at the tool's place in the base. Good: the right maps are dark all over. Bright "
        "patches on the right are where the arm does something that the model does not know, or was not looked at.",
    ),
    "joints": (
        joints_figure,
        "Errors over each joint's angle",
        "Good: the blue lines are flat. A blue line that rises or swings with a joint's angle points at that joint.",
    ),
    "causes": (
        causes_figure,
        "What each cause contributes",
        "What a cause moves the tool by on these poses, the largest first; what two causes could explain counts for the "
        "one that was found first.",
    ),
    "growth": (
        growth_figure,
        "How the model grew",
        "Each bar is the error on poses left out after a cause was added; what did not lower it was not added. 1 is the "
        "noise.",
    ),
    "correlation": (
        correlation_figure,
        "Correlations",
        "Strong colours off the diagonal: these two were told apart badly by these poses; their sigmas say so.",
    ),
}

STYLE = """
:root { color-scheme: light; --ink: #1f2933; --muted: #616e7c; --line: #e4e7eb; --soft: #f5f7fa; }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2rem 1.5rem 4rem; max-width: 64rem; background: #fff; color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 1.9rem; margin: 0 0 .3rem; }
h2 { font-size: 1.3rem; margin: 3rem 0 .9rem; padding-top: .9rem; border-top: 1px solid var(--line); }
p { max-width: 50rem; } .sub { color: var(--muted); }
.verdict { border-left: .4rem solid #2b6cb0; background: var(--soft); padding: .8rem 1.2rem; margin: 1.2rem 0; }
.verdict { font-size: 1.15rem; }
table { border-collapse: collapse; font-size: .92rem; }
th, td { text-align: left; vertical-align: top; padding: .35rem 1.1rem .35rem 0; border-bottom: 1px solid var(--line); }
thead th { color: var(--muted); font-weight: 500; } td { font-variant-numeric: tabular-nums; }
figure { margin: 0; } figure img { width: 100%; height: auto; }
figcaption { background: var(--soft); padding: .6rem 1.1rem; margin-top: .6rem; font-size: .95rem; }
@media (max-width: 48rem) { table { display: block; overflow-x: auto; } }
"""


def write_identify_report(run: Run, folder: Path) -> Path:
    """Write the report of an identification.

    Args:
        run: what is reported on.
        folder: an existing folder.

    Returns:
        The page, report.html.

    Raises:
        InputError: matplotlib is missing, or the folder cannot be written to.
    """
    with drawing():
        images = {name: png(draw(run)) for name, (draw, _, _) in FIGURES.items()}
    for name, data in images.items():
        with replacing(folder / f"report-{name}.png", "wb") as file:
            file.write(data)
    write_text(folder / "report.html", page(run, images))
    return folder / "report.html"


def page(run: Run, images: dict[str, bytes]) -> str:
    """Return the page; ``images`` maps the names of figures to PNG data."""
    figures = [figure_html(images[name], title, see) for name, (_, title, see) in FIGURES.items()]
    notes = "".join(f"<li>{escape(note)}</li>" for note in run.notes)
    fitted = int(run.found.solution.free.sum())
    body = (
        f'<p class="sub">{escape(run.arm.name)} · {len(run.measured)} poses · {fitted} parameters fitted</p>\n'
        f'<div class="verdict">{escape(headline(run))}</div>\n'
        f"<p>Held-out residual over its predicted sigma: {run.held_out.residual_over_predicted:.2f} (1 is honest).</p>\n"
        + (f"<ul>{notes}</ul>\n" if notes else "")
        + "".join(figures)
        + f"<h2>Parameters</h2>\n{_parameters(run)}"
    )
    return html_page("Identification of an arm", body)


def html_page(title: str, body: str) -> str:
    """Return a whole page, in the style of this report."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>armsight: {escape(title.lower())}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n{body}</body>\n</html>\n"
    )


def figure_html(data: bytes, title: str, see: str) -> str:
    """Return a section with a figure that holds its own data, and its caption."""
    source = f"data:image/png;base64,{base64.b64encode(data).decode('ascii')}"
    image = f'<img src="{source}" alt="{escape(title)}">'
    return f"<h2>{escape(title)}</h2>\n<figure>{image}<figcaption>{escape(see)}</figcaption></figure>\n"


def table_html(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a table."""
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>\n" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>\n{body}</tbody></table>\n"


def _parameters(run: Run) -> str:
    """Return the table of all parameters, fitted ones first."""
    found, sigma, nominal = run.found, np.sqrt(np.diag(run.found.cov)), run.found.model.nominal()
    rows = []
    for k in np.argsort(~found.solution.free, kind="stable"):
        p, free = found.model.parameters[k], bool(found.solution.free[k])
        was = "" if p.kind in ("base", "tool") else value_text(p, nominal[k])
        now = value_text(p, found.solution.x[k]) if free else ""
        rows.append((p.name, was, now, value_text(p, sigma[k]) if free else "", found.reasons.get(p.name, "")))
    return table_html(("parameter", "nominal", "identified", "sigma", "why not, or with what"), rows)
