"""The report of an identification: one HTML page that holds its figures, and the figures as PNG files beside it.

Figures of an identification's report: error maps, residuals over joint angles, growth, correlations, causes.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armsight.app.identify.run import Run, headline, value_text
from armsight.app.report.plotting import BLUE, INK, MUTED, ORANGE, drawing, new_figure, png
from armsight.data import Array
from armsight.files import replacing, write_text
from armsight.loop.identify.identify import contributions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Points drawn at most: more only hide each other.
MOST_POINTS = 4000
#: Names fit beside a matrix up to this many.
MOST_NAMES = 60
_BINS = 12


def _shown(run: Run) -> tuple[Array, Array, Array, Array]:
    """Return tool positions in the base, m; joint angles; mean error of every pose before and after, m."""
    q = run.held_out_poses
    rows = np.linspace(0, len(q) - 1, min(MOST_POINTS, len(q))).astype(int)
    at = run.found.model.tool_in_base(run.found.solution.x, q[rows], None)[:, :3, 3]
    before, after = (e.position_m.mean(axis=1)[rows] for e in (run.held_out.nominal, run.held_out.identified))
    return at, q[rows], before, after


def map_figure(run: Run) -> Figure:
    """Draw the held-out errors over the workspace, from above and from the side, before and after."""
    at, _, before, after = _shown(run)
    figure = new_figure(7.6)
    axes = figure.subplots(2, 2)
    out = np.hypot(at[:, 0], at[:, 1])
    views = ((at[:, 0], at[:, 1], ("x", "y")), (out, at[:, 2], ("distance from axis 1", "z")))
    top = 1e3 * max(float(np.quantile(before, 0.98)), 1e-9)
    for column, (name, error) in enumerate((("nominal", before), ("identified", after))):
        order = np.argsort(error)
        for row, (x, y, labels) in enumerate(views):
            ax = axes[row, column]
            size = float(np.clip(2000 / len(x), 7, 25))  # few poses must not be lost on the page
            drawn = ax.scatter(
                x[order], y[order], c=1e3 * error[order], s=size, cmap="viridis", vmin=0, vmax=top, linewidths=0
            )
            ax.set_aspect("equal", adjustable="box")
            ax.set_xlabel(f"{labels[0]}, m")
            ax.set_ylabel(f"{labels[1]}, m")
            # No longer title: where a view is narrow it would run into the scale.
            ax.set_title(f"{name}, {'from above' if row == 0 else 'from the side'}")
    figure.colorbar(drawn, ax=axes, label="held-out error, mm", shrink=0.7)
    return figure


def joints_figure(run: Run) -> Figure:
    """Draw the held-out error over each joint's angle, before and after, with the mean in bins."""
    _, q, before, after = _shown(run)
    figure = new_figure(5.6)
    axes = figure.subplots(2, 3, sharey=True)
    for i, ax in enumerate(axes.ravel()):
        degrees = np.degrees(q[:, i])
        for name, error, colour in (("nominal", before, ORANGE), ("identified", after, BLUE)):
            ax.scatter(degrees, 1e3 * error, s=4, color=colour, alpha=0.25, linewidths=0)
            _binned(ax, degrees, 1e3 * error, colour, name)
        ax.set_title(run.arm.joint_names[i])
        ax.set_xlabel("deg")
        ax.set_ylim(0, 1e3 * float(np.quantile(before, 0.995)) * 1.05)
    axes[0, 0].set_ylabel("held-out error, mm")
    axes[1, 0].set_ylabel("held-out error, mm")
    axes[0, 2].legend(loc="upper right")
    return figure


def _binned(ax: Axes, x: Array, y: Array, colour: str, name: str) -> None:
    edges = np.linspace(x.min(), x.max() + 1e-9, _BINS + 1)
    at = np.digitize(x, edges) - 1
    filled = [k for k in range(_BINS) if (at == k).any()]
    middle = (edges[:-1] + edges[1:]) / 2
    ax.plot(middle[filled], [y[at == k].mean() for k in filled], color=colour, linewidth=2, label=name)


def growth_figure(run: Run) -> Figure:
    """Draw how the model grew by the error on poses left out, and how the final fit converged."""
    figure = new_figure(0.24 * len(run.found.steps) + 2.2)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    rms = [step.rms for step in run.found.steps]
    rows = np.arange(len(rms))
    left.barh(rows, rms, color=[BLUE if not s.cause.startswith("-") else MUTED for s in run.found.steps], height=0.7)
    left.set_yticks(
        rows, [s.cause if not s.cause.startswith("-") else f"without {s.cause[1:]}" for s in run.found.steps]
    )
    left.invert_yaxis()
    left.set_xlabel("held-out RMS, in sigmas of the noise")
    left.set_title("what was added, and given back (grey)")
    history = run.found.solution.history
    right.plot(np.arange(1, len(history) + 1), history, color=BLUE, marker="o", markersize=3)
    right.set_xlabel("step")
    right.set_ylabel("RMS, weighted")
    right.set_yscale("log")
    right.set_title("convergence of the final fit")
    return figure


def correlation_figure(run: Run) -> Figure:
    """Draw the correlations of what was fitted, base and tool apart."""
    model, found = run.found.model, run.found
    rows = np.array(
        [k for k in np.flatnonzero(found.solution.free) if model.parameters[k].kind not in ("base", "tool")]
    )
    figure = new_figure(9.0 if len(rows) else 1.5)
    ax = figure.subplots()
    if not len(rows):
        ax.set_axis_off()
        ax.text(0, 0.5, "nothing but base and tool was fitted", color=INK)
        return figure
    sigma = np.sqrt(np.diag(found.cov))[rows]
    drawn = ax.imshow(found.cov[np.ix_(rows, rows)] / np.outer(sigma, sigma), cmap="RdBu", vmin=-1, vmax=1)
    if len(rows) <= MOST_NAMES:
        names = [model.names[k] for k in rows]
        ax.set_xticks(range(len(rows)), names, rotation=90, fontsize=7)
        ax.set_yticks(range(len(rows)), names, fontsize=7)
    figure.colorbar(drawn, ax=ax, label="correlation", shrink=0.7)
    return figure


def causes_figure(run: Run) -> Figure:
    """Draw what each cause moves the tool by, the largest first."""
    parts = sorted(contributions(run.found, run.measured).items(), key=lambda part: part[1])
    figure = new_figure(0.32 * len(parts) + 1.2)
    ax = figure.subplots()
    ax.barh([kind for kind, _ in parts], [1e3 * size for _, size in parts], color=BLUE, height=0.65)
    for row, (_, size) in enumerate(parts):
        ax.text(1e3 * size, row, f" {1e3 * size:.3f}", va="center", color=INK)
    ax.set_xlabel("RMS displacement of the tool, mm, beyond what base, tool and the causes found before it take up")
    return figure


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
