"""The result of an identification as a Report, and the files beside it: the corrected arm, zeros, parameters.

Figures: errors over the workspace and over joint angles, error sources, forward selection, correlations.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from armsight.app.identify.run import Identification
from armsight.app.show.messages import Note
from armsight.app.show.page import table
from armsight.app.show.page import text as escaped
from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, new_figure, panels
from armsight.app.show.report import Block, Fact, Html, Lines, Report, Text, figures
from armsight.app.show.table import TextTable, plain_text
from armsight.data import Array
from armsight.files import write_text
from armsight.loop.identify.backlash import JointBacklash, joint_backlashes
from armsight.loop.identify.corrected import Corrected, zeros_text
from armsight.loop.identify.identify import Identified, contributions
from armsight.loop.identify.model import Parameter

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


#: Lines of the terminal without -v: the largest error sources, and the numbers that are most surely not nominal.
_SOURCES, _PARAMETERS = 4, 8
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


def identify_report(run: Identification, *, everything: bool = False) -> Report:
    """Return what an identification says; ``everything``: all is printed, not the most important numbers alone."""
    found = run.found
    noise = f"noise {1e3 * found.solution.noise[0]:.3f} mm"
    if found.model.full:
        noise += f", {np.degrees(found.solution.noise[1]):.4f} deg"
    fitted = int(found.solution.free.sum())
    fact = (
        f"{len(run.measured)} poses, {fitted} parameters fitted, {noise}; held-out residual over its predicted sigma "
        f"{run.held_out.residual_over_predicted:.2f} (1: the sigmas are right)"
    )
    parts = contributions(found, run.measured).items()
    backlashes = joint_backlashes(found, run.measured)
    backlash = [f"joint {p.joint + 1}  {_backlash_text(p)}" for p in backlashes]
    wide, most = max((len(source) for source, _ in parts), default=0), None if everything else _SOURCES
    moved = "displacement of the tool by each error source as selected, RMS, beyond what those before explain:"
    pairs = [f"{a} and {b}: {c:+.3f}" for a, b, c in found.correlated()]
    result: list[Block] = [
        Fact(fact, _values(run)),
        Lines([f"{source:<{wide}} {1e3 * size:8.3f} mm" for source, size in parts], moved, most),
        Lines(backlash, "backlash of each joint, stop to stop:", None if everything else 0),
        Lines(pairs, "correlations over 0.9 (more varied poses distinguish them):", None if everything else 0),
        *([] if everything else [Text(_in_short(backlashes, len(pairs)))]),
    ]
    return Report(
        "identification of an arm",
        "Kinematic identification",
        f"{run.arm.name} · {len(run.measured)} poses · {fitted} parameters fitted",
        headline(run),
        {
            "result": ("Result", result),
            **figures(FIGURES, run),
            "ranges": ("Ranges of the joints", _ranges(run, everything=everything)),
            "parameters": ("Parameters", [*_printed(run, everything=everything), _parameters(run)]),
        },
        [Note("note", each) for each in run.notes],
    )


class ParameterRow(NamedTuple):
    """One parameter of the model, as parameters.csv and the JSON object have it: the fields are their columns and keys.

    Attributes:
        name: of the parameter.
        unit: m, rad, rad/m or 1.
        nominal: value of the nominal arm; None of base and tool.
        value: identified; the nominal one where it was not fitted.
        sigma: standard deviation; None where it was not fitted.
        frozen: why it was not fitted, or not alone; None where it was.
    """

    name: str
    unit: str
    nominal: float | None
    value: float
    sigma: float | None
    frozen: str | None


def parameter_rows(run: Identification) -> list[ParameterRow]:
    """Return all parameters of the model, SI units."""
    found, sigma = run.found, np.sqrt(np.diag(run.found.cov))
    nominal = found.model.nominal()
    return [
        ParameterRow(
            p.name,
            p.unit,
            None if p.kind in ("base", "tool") else float(nominal[k]),
            float(found.solution.x[k]),
            float(sigma[k]) if found.solution.free[k] else None,
            found.reasons.get(p.name),
        )
        for k, p in enumerate(found.model.parameters)
    ]


def _values(run: Identification) -> dict[str, Any]:
    """Return what programs read, SI units."""
    found = run.found
    return {
        "version": 2,
        "arm": run.arm.name,
        "poses": len(run.measured),
        "left_out_lines": [int(run.lines[k]) for k in found.left_out],
        "validation": run.how,
        "validation_placement_refitted": run.held_out.placement_refitted,
        "nominal": run.held_out.nominal.summary(),
        "identified": run.held_out.identified.summary(),
        "residual_over_predicted": run.held_out.residual_over_predicted,
        "noise_m": found.solution.noise[0],
        "noise_rad": found.solution.noise[1] if found.model.full else None,
        "parameters": parameter_rows(run),
        "joint_ranges_seen": [
            {"joint": i + 1, "min_rad": low, "max_rad": high} for i, (low, high) in enumerate(ranges_seen(found))
        ],
        "curve_fade_rad": found.model.fade_rad,
        "correlated": [{"a": a, "b": b, "correlation": c} for a, b, c in found.correlated()],
        "forward_selection": [{"source": s.source, "parameters": s.names, "held_out_rms": s.rms} for s in found.steps],
    }


def write_results(run: Identification, report: Report, out: Path) -> None:
    """Write the corrected arm, the board's zeros, the parameters and the summary into a folder."""
    corrected = Corrected.of(run.found)
    corrected.save(out / "corrected.toml")
    write_text(out / "corrected.urdf", corrected.urdf())
    write_text(out / "zeros.toml", zeros_text(run.found))
    write_text(out / "parameters.csv", _parameters_csv(run))
    write_text(out / "identify.json", report.json_text())


def _parameters_csv(run: Identification) -> str:
    """Return the parameters as CSV, SI units."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(ParameterRow._fields)
    writer.writerows(["" if value is None else value for value in row] for row in parameter_rows(run))
    return out.getvalue()


def headline(run: Identification) -> str:
    """Return the held-out errors, of the nominal and of the identified arm, in one line."""
    before, after = run.held_out.nominal.summary(), run.held_out.identified.summary()
    line = f"held-out error {1e3 * before['mean_m']:.3f} -> {1e3 * after['mean_m']:.3f} mm mean"
    line += f", {1e3 * before['max_m']:.2f} -> {1e3 * after['max_m']:.2f} mm largest"
    if "mean_rad" in after:
        line += f", {np.degrees(before['mean_rad']):.3f} -> {np.degrees(after['mean_rad']):.3f} deg mean"
    no_better = "; no better than the nominal arm: keep that one, or take more poses"
    return f"{line} ({run.how}){no_better if after['mean_m'] >= before['mean_m'] else ''}"


def value_text(p: Parameter, value: float) -> str:
    """Return a value in mm, deg, deg/m or %."""
    if p.unit == "m":
        return f"{1e3 * value:.3f} mm"
    if p.unit == "rad":
        return f"{np.degrees(value):.4f} deg"
    if p.unit == "rad/m":
        return f"{np.degrees(value):.4f} deg/m"
    return f"{100 * value:.4f} %"


def _in_short(backlashes: Sequence[JointBacklash], pairs: int) -> str:
    """Return a line on backlash, and one on correlations where there are any."""
    known = [p for p in backlashes if np.isfinite(p.value_rad)]
    values = [f"joint {p.joint + 1} {np.degrees(p.value_rad):.3f} +- {np.degrees(p.sigma_rad):.3f} deg" for p in known]
    others = ", ".join(str(p.joint + 1) for p in backlashes if p not in known)
    lines = [
        "\nbacklash: " + "; ".join([*values, *([f"not determined of joints {others} (-v says why)"] if others else [])])
    ]
    if pairs:
        lines.append(f"{pairs} pairs of numbers are correlated by over 0.9 (-v lists them): take more varied poses")
    return "\n".join(lines)


def _printed(run: Identification, *, everything: bool) -> list[Block]:
    """Return the parameters that were fitted, for the terminal: all, or those that are surely not nominal."""
    found, nominal = run.found, run.found.model.nominal()
    rows, sizes = [], []
    kept = [
        (k, p)
        for k, p in enumerate(found.model.parameters)
        if found.solution.free[k] and p.kind not in ("base", "tool")
    ]
    for k, p in kept:
        value, sigma = found.value(p.name)
        tied = "with others (-v)" if p.name in found.reasons and not everything else ""
        rows.append((p.name, *(value_text(p, each) for each in (nominal[k], value, sigma)), tied))
        sizes.append(abs(value - nominal[k]) / max(sigma, 1e-12))
    left = len(found.model.parameters) - len(kept) - sum(p.kind in ("base", "tool") for p in found.model.parameters)
    head = ("parameter", "nominal", "identified", "sigma", "")
    if everything:
        shown = Text("\n" + plain_text(TextTable("", head, tuple(rows))).strip("\n"))
        return [shown, Text("\n".join(["\nnot fitted, or not alone:", *(f"  {line}" for line in _not_fitted(run))]))]
    first = sorted(k for k in np.argsort(sizes)[-_PARAMETERS:] if sizes[k] > 2)  # sigmas
    table_shown = Text("\n" + plain_text(TextTable("", head, tuple(rows[k] for k in first))).strip("\n"))
    more = f"{len(rows) - len(first)} more are fitted beside base and tool, {left} are not (-v lists all)"
    return [table_shown, Text(more)] if first else [Text(f"\n{more}")]


def ranges_seen(found: Identified) -> list[tuple[float, float]]:
    """Return the least and greatest reading of each joint in the poses fitted, rad."""
    assert found.model.q_seen is not None  # for the type checker: an identified arm has them
    return [(float(low), float(high)) for low, high in found.model.q_seen]


def _ranges(run: Identification, *, everything: bool) -> list[Block]:
    """Return the readings that the poses have shown of each joint."""
    fade, seen = np.degrees(run.found.model.fade_rad), [np.degrees(each) for each in ranges_seen(run.found)]
    rows = [[escaped(n), f"{a:.1f}", f"{b:.1f}"] for n, (a, b) in zip(run.arm.joint_names, seen, strict=True)]
    curves = (
        f"<p>The curve of a joint's sensor holds over the readings seen. Beyond them it fades within {fade:.0f} degrees to "
        "its mean over them: a pose measured there would say what it is.</p>\n"
    )
    title = (
        f"\nreadings seen (beyond them a sensor's curve fades within {fade:.0f} deg to its mean; zeros and lengths hold "
        "everywhere):"
    )
    lines = [f"  joint {i + 1}  {a:.1f} to {b:.1f} deg" for i, (a, b) in enumerate(seen)]
    shown = table(("joint", "least reading, deg", "greatest reading, deg"), rows, "numbers")
    return [*([Text("\n".join([title, *lines]))] if everything else []), Html(curves + shown)]


def _parameters(run: Identification) -> Html:
    """Return the table of all parameters, fitted ones first, HTML."""
    found, sigma, nominal = run.found, np.sqrt(np.diag(run.found.cov)), run.found.model.nominal()
    rows = []
    for k in np.argsort(~found.solution.free, kind="stable"):
        p, free = found.model.parameters[k], bool(found.solution.free[k])
        was = "" if p.kind in ("base", "tool") else value_text(p, nominal[k])
        now = value_text(p, found.solution.x[k]) if free else ""
        row = (p.name, was, now, value_text(p, sigma[k]) if free else "", found.reasons.get(p.name, ""))
        rows.append([escaped(entry) for entry in row])
    return Html(table(("parameter", "nominal", "identified", "sigma", "why not, or with what"), rows, "numbers"))


def _backlash_text(backlash: JointBacklash) -> str:
    """Return a joint's backlash, and what showed it."""
    if not np.isfinite(backlash.value_rad):
        return backlash.how
    return f"{np.degrees(backlash.value_rad):.3f} +- {np.degrees(backlash.sigma_rad):.3f} deg, by {backlash.how}"


def _not_fitted(run: Identification) -> list[str]:
    """Return the reasons of what was not fitted, equal ones together."""
    by_reason: dict[str, list[str]] = {}
    for p in run.found.model.parameters:
        reason = run.found.reasons.get(p.name)
        if reason is not None and p.kind not in ("base", "tool"):
            short = reason.split(":")[0] if reason.startswith("not selected") else reason
            by_reason.setdefault(short, []).append(p.name)
    return [f"{', '.join(names)}: {reason}" for reason, names in by_reason.items()]
