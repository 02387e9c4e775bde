"""The report of an identification: one HTML page that holds its figures, and the figures as PNG files beside it.

Figures: errors over the workspace and over joint angles, error sources, forward selection, correlations.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armsight.app.identify.run import Identification, headline, ranges_seen, value_text
from armsight.app.report.page import PAGE, bullets, html_page, picture, put_files, table
from armsight.app.report.page import text as escaped
from armsight.app.report.plotting import BLUE, INK, MUTED, ORANGE, drawing, new_figure, panels, png
from armsight.data import Array
from armsight.loop.identify.identify import contributions

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Points plotted at most: more only hide each other.
MOST_POINTS = 4000
#: Names of full size fit beside a matrix up to this many; more are smaller.
MOST_NAMES = 60
#: More steps of removal after one another than this are one row of the selection's figure.
MOST_REMOVED = 8
#: Sources that were selected together are named by the first where their names are longer.
_MOST_LETTERS = 45
#: Intervals of a joint's angle over which errors are averaged, at most; poses of one on average, at least.
_BINS, _PER_BIN = 12, 6


def _shown(run: Identification) -> tuple[Array, Array, Array, Array]:
    """Return tool positions in the base, m; joint angles; mean error of every pose before and after, m."""
    q = run.held_out_poses
    rows = np.linspace(0, len(q) - 1, min(MOST_POINTS, len(q))).astype(int)
    at = run.found.model.tool_in_base(run.found.solution.x, q[rows], None)[:, :3, 3]
    before, after = (e.position_m.mean(axis=1)[rows] for e in (run.held_out.nominal, run.held_out.identified))
    return at, q[rows], before, after


def map_figure(run: Identification) -> Figure:
    """Plot the held-out errors over the workspace, from above and from the side, before and after."""
    at, _, before, after = _shown(run)
    figure = new_figure(7.6)
    axes = figure.subplots(2, 2)
    out = np.hypot(at[:, 0], at[:, 1])
    views = ((at[:, 0], at[:, 1], ("x", "y")), (out, at[:, 2], ("distance from axis 1", "z")))
    top = 1e3 * max(float(np.quantile(before, 0.98)), 1e-9)
    for column, (name, error) in enumerate((("nominal", before), ("identified", after))):
        rising = np.argsort(error)  # large errors on top
        for row, (x, y, labels) in enumerate(views):
            ax = axes[row, column]
            size = float(np.clip(2000 / len(x), 7, 25))  # few poses must not be lost on the page
            plotted = ax.scatter(
                x[rising], y[rising], c=1e3 * error[rising], s=size, cmap="viridis", vmin=0, vmax=top, linewidths=0
            )
            ax.set_aspect("equal", adjustable="box")
            ax.set_xlabel(f"{labels[0]}, m")
            ax.set_ylabel(f"{labels[1]}, m")
            # No longer title: where a view is narrow it would run into the scale.
            ax.set_title(f"{name}, {'from above' if row == 0 else 'from the side'}")
    figure.colorbar(plotted, ax=axes, label="held-out error, mm", shrink=0.7)
    return figure


def joints_figure(run: Identification) -> Figure:
    """Plot the held-out error over each joint's angle, before and after, with the mean in bins."""
    _, q, before, after = _shown(run)
    figure = new_figure(5.6)
    axes = panels(figure, run.arm.joints, sharey=True)
    for i, ax in enumerate(axes):
        degrees = np.degrees(q[:, i])
        for name, error, colour in (("nominal", before, ORANGE), ("identified", after, BLUE)):
            ax.scatter(degrees, 1e3 * error, s=4, color=colour, alpha=0.25, linewidths=0)
            _binned(ax, degrees, 1e3 * error, colour, name)
        ax.set_title(run.arm.joint_names[i])
        ax.set_xlabel("deg")
        ax.set_ylim(0, 1e3 * float(np.quantile(before, 0.995)) * 1.05)
    for ax in (axes[0], axes[(len(axes) + 1) // 2]):
        ax.set_ylabel("held-out error, mm")
    axes[0].legend(loc="upper right")
    return figure


def _binned(ax: Axes, x: Array, y: Array, colour: str, name: str) -> None:
    count = int(np.clip(len(x) // _PER_BIN, 2, _BINS))
    edges = np.linspace(x.min(), x.max() + 1e-9, count + 1)
    at = np.digitize(x, edges) - 1
    filled = [k for k in range(count) if (at == k).any()]
    middle = (edges[:-1] + edges[1:]) / 2
    ax.plot(middle[filled], [y[at == k].mean() for k in filled], color=colour, linewidth=2, label=name)


def selection_rows(run: Identification) -> list[tuple[str, float, bool]]:
    """Return text, held-out RMS and whether it was removed, of each step; many removals after one another are one row."""
    rows: list[tuple[str, float, bool]] = []
    for gone, group in groupby(run.found.steps, key=lambda step: step.source.startswith("-")):
        steps = list(group)
        if gone and len(steps) > MOST_REMOVED:
            first, last = (step.source[1:] for step in (steps[0], steps[-1]))
            rows.append((f"without {first} .. {last}, {len(steps)} steps", steps[-1].rms, True))
        else:
            rows += [(f"without {s.source[1:]}" if gone else s.source, s.rms, gone) for s in steps]
    return rows


def _short(sources: str) -> str:
    """Return the names of sources that were selected together, as one line of a figure."""
    first, *others = sources.split(", ")
    return f"{first} and {len(others)} more" if len(sources) > _MOST_LETTERS else sources


def selection_figure(run: Identification) -> Figure:
    """Plot the forward selection by the error on poses left out, and the convergence of the final fit."""
    figure = new_figure(0.24 * len(selection_rows(run)) + 2.2)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    shown = selection_rows(run)
    rows = np.arange(len(shown))
    left.barh(rows, [rms for _, rms, _ in shown], color=[MUTED if gone else BLUE for _, _, gone in shown], height=0.7)
    left.set_yticks(rows, [_short(text) for text, _, _ in shown])
    left.invert_yaxis()
    left.set_xlabel("held-out RMS, in sigmas of the noise")
    left.set_title("added, and removed again (grey)")
    history = run.found.solution.history
    right.plot(np.arange(1, len(history) + 1), history, color=BLUE, marker="o", markersize=3)
    right.set_xlabel("step")
    right.set_ylabel("RMS, weighted")
    right.set_yscale("log")
    right.set_title("convergence of the final fit")
    return figure


def correlation_figure(run: Identification) -> Figure:
    """Plot the correlations of what was fitted, without base and tool."""
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
    plotted = ax.imshow(found.correlation(rows), cmap="RdBu", vmin=-1, vmax=1)
    names = [model.names[k] for k in rows]
    size = min(7.0, 7.0 * MOST_NAMES / len(rows))
    ax.set_xticks(range(len(rows)), names, rotation=90, fontsize=size)
    ax.set_yticks(range(len(rows)), names, fontsize=size)
    figure.colorbar(plotted, ax=ax, label="correlation", shrink=0.7)
    return figure


def sources_figure(run: Identification) -> Figure:
    """Plot the displacement of the tool by each error source, the largest first."""
    parts = sorted(contributions(run.found, run.measured).items(), key=lambda part: part[1])
    figure = new_figure(0.32 * len(parts) + 1.2)
    ax = figure.subplots()
    ax.barh([_short(kind) for kind, _ in parts], [1e3 * size for _, size in parts], color=BLUE, height=0.65)
    for row, (_, size) in enumerate(parts):
        ax.text(1e3 * size, row, f" {1e3 * size:.3f}", va="center", color=INK).set_in_layout(False)
    ax.set_xlim(0.0, 1.12e3 * max((size for _, size in parts), default=1e-3))  # room for the figures
    ax.set_xlabel("RMS displacement of the tool, mm,\nbeyond what base, tool and the sources selected before explain")
    return figure


#: Name -> the function that plots it, its title and its caption.
FIGURES: dict[str, tuple[Callable[[Identification], Figure], str, str]] = {
    "map": (
        map_figure,
        "Errors over the workspace",
        "Poses left out of the fit, at the tool's position in the base. Good: the right maps are dark all over. Bright "
        "patches on the right are where the arm does something that the model does not know, or was not looked at.",
    ),
    "joints": (
        joints_figure,
        "Errors over each joint's angle",
        "Good: the blue lines are flat. A blue line that rises or swings with a joint's angle points at that joint.",
    ),
    "sources": (
        sources_figure,
        "Contributions of the error sources",
        "Displacement of the tool by each error source on these poses, the largest first; what two sources could explain "
        "counts for the one that was selected first.",
    ),
    "selection": (
        selection_figure,
        "Forward selection",
        "Each bar is the error on poses left out after an error source was added; what did not lower it was not added. 1 "
        "is the noise.",
    ),
    "correlation": (
        correlation_figure,
        "Correlations",
        "Strong colours off the diagonal: these poses distinguish the two badly; their sigmas say so.",
    ),
}


def write_identify_report(run: Identification, folder: Path) -> Path:
    """Write the report of an identification.

    Args:
        run: the identification.
        folder: an existing folder.

    Returns:
        The page, report.html.

    Raises:
        InputError: matplotlib is missing, or the folder cannot be written to.
    """
    with drawing():
        images = {name: png(plot(run)) for name, (plot, _, _) in FIGURES.items()}
    files = {f"report-{name}.png": data for name, data in images.items()}
    put_files(folder, {**files, PAGE: page(run, images).encode()})
    return folder / PAGE


def page(run: Identification, images: dict[str, bytes]) -> str:
    """Return the page; ``images`` maps the names of figures to PNG data."""
    sections = {"result": ("Result", _result_section(run))}
    for name, (_, title, caption) in FIGURES.items():
        image = picture(images[name], title)
        sections[name] = (title, f"<figure>{image}<figcaption><p>{escaped(caption)}</p></figcaption></figure>\n")
    sections["ranges"] = ("Ranges of the joints", _ranges(run))
    sections["parameters"] = ("Parameters", _parameters(run))
    fitted = int(run.found.solution.free.sum())
    sub = f"{run.arm.name} · {len(run.measured)} poses · {fitted} parameters fitted"
    return html_page("armsight: identification of an arm", "Kinematic identification", sub, sections)


def _result_section(run: Identification) -> str:
    """Return the held-out errors and the notes, HTML."""
    return (
        f'<div class="assessment"><p class="headline">{escaped(headline(run))}</p></div>\n'
        f"<p>Held-out residual over its predicted sigma: {run.held_out.residual_over_predicted:.2f} (1: the sigmas are "
        "right).</p>\n"
    ) + (bullets(run.notes) if run.notes else "")


def _ranges(run: Identification) -> str:
    """Return the readings that the poses have shown of each joint, HTML."""
    rows = [
        [escaped(name), f"{np.degrees(low):.1f}", f"{np.degrees(high):.1f}"]
        for name, (low, high) in zip(run.arm.joint_names, ranges_seen(run.found), strict=True)
    ]
    fade = np.degrees(run.found.model.fade_rad)
    return (
        f"<p>The curve of a joint's sensor holds over the readings seen. Beyond them it fades within {fade:.0f} degrees to "
        "its mean over them: a pose measured there would say what it is.</p>\n"
    ) + table(("joint", "least reading, deg", "greatest reading, deg"), rows, "numbers")


def _parameters(run: Identification) -> str:
    """Return the table of all parameters, fitted ones first, HTML."""
    found, sigma, nominal = run.found, np.sqrt(np.diag(run.found.cov)), run.found.model.nominal()
    rows = []
    for k in np.argsort(~found.solution.free, kind="stable"):
        p, free = found.model.parameters[k], bool(found.solution.free[k])
        was = "" if p.kind in ("base", "tool") else value_text(p, nominal[k])
        now = value_text(p, found.solution.x[k]) if free else ""
        row = (p.name, was, now, value_text(p, sigma[k]) if free else "", found.reasons.get(p.name, ""))
        rows.append([escaped(entry) for entry in row])
    return table(("parameter", "nominal", "identified", "sigma", "why not, or with what"), rows, "numbers")
