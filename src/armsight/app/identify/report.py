"""The result of an identification as a Report, and the files beside it: the corrected arm, zeros, parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from armsight.app.identify.run import Identification
from armsight.app.show.messages import Note
from armsight.app.show.page import bullets, folded, table
from armsight.app.show.page import text as escaped
from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, Figure, new_figure, panels, subplots
from armsight.app.show.report import Block, Fact, Grade, Html, Lines, Report, Text, figures
from armsight.app.show.table import TextTable, plain_text
from armsight.data import Array
from armsight.files import table_text, write_text
from armsight.loop.identify.backlash import JointBacklash, joint_backlashes
from armsight.loop.identify.corrected import Corrected, zeros_text
from armsight.loop.identify.identify import contributions, value_text
from armsight.loop.identify.lengths import explained_m
from armsight.loop.identify.selection import PLACEMENT
from armsight.robot.arm_file import MOVED, undetermined

#: Points plotted at most; names of full size beside a matrix; steps of removal in a row of a figure; letters of names.
MOST_POINTS, MOST_NAMES, MOST_REMOVED, _MOST_LETTERS = 4000, 60, 8, 45
#: Intervals of a joint's angle over which errors are averaged, at most; poses of one on average, at least.
_BINS, _PER_BIN = 12, 6
#: Lines of the terminal without -v: the largest error sources, and the numbers that are most surely not nominal.
_SOURCES, _PARAMETERS = 4, 7


def _shown(run: Identification) -> tuple[Array, Array, Array, Array]:
    """Return tool positions in the base, m; joint angles; mean error of every pose before and after, mm."""
    q = run.held_out_poses
    rows = np.linspace(0, len(q) - 1, min(MOST_POINTS, len(q))).astype(int)
    at = run.found.model.tool_in_base(run.found.solution.x, q[rows], None)[:, :3, 3]
    before, after = (1e3 * e.position_m.mean(axis=1)[rows] for e in (run.held_out.nominal, run.held_out.identified))
    return at, q[rows], before, after


def map_figure(run: Identification) -> Figure:
    """Plot the held-out errors over the workspace, from above and from the side, before and after."""
    at, _, before, after = _shown(run)
    figure, axes = subplots(4.6, 2, 2)
    views = ((at[:, 0], at[:, 1], "x", "y"), (np.hypot(at[:, 0], at[:, 1]), at[:, 2], "distance from axis 1", "z"))
    top = max(float(np.quantile(before, 0.98)), 1e-6)
    for column, (name, error) in enumerate((("nominal", before), ("identified", after))):
        rising = np.argsort(error)  # large errors on top
        for ax, (x, y, across, up) in zip(axes[:, column], views, strict=True):
            size = float(np.clip(2000 / len(x), 9, 36))  # few poses must not be lost on the page
            style: dict[str, Any] = {"cmap": "viridis", "vmin": 0, "vmax": top, "linewidths": 0}
            plotted = ax.scatter(x[rising], y[rising], c=error[rising], s=size, **style)
            ax.set_aspect("equal", adjustable="datalim")
            ax.set_xlabel(f"{across}, m")
            ax.set_ylabel(f"{up}, m")
            # No longer title: where a view is narrow it would run into the scale.
            ax.set_title(f"{name}, {'from above' if ax is axes[0, column] else 'from the side'}")
    figure.colorbar(plotted, ax=axes, label="held-out error, mm", shrink=0.7)
    return figure


def joints_figure(run: Identification) -> Figure:
    """Plot the held-out error over each joint's angle, before and after, with the mean in bins."""
    _, q, before, after = _shown(run)
    figure = new_figure(4.4)
    axes = panels(figure, run.arm.joints, sharey=True)
    for i, ax in enumerate(axes):
        degrees = np.degrees(q[:, i])
        edges = np.linspace(degrees.min(), degrees.max() + 1e-9, int(np.clip(len(q) // _PER_BIN, 2, _BINS)) + 1)
        at, middle = np.digitize(degrees, edges) - 1, (edges[:-1] + edges[1:]) / 2
        filled = np.unique(at)
        for name, error, colour in (("nominal", before, ORANGE), ("identified", after, BLUE)):
            few = float(np.clip(100 / len(q), 0.25, 1.0))  # many hide each other, few must not be lost
            ax.scatter(degrees, error, s=20 * few, color=colour, alpha=0.2 + 0.6 * few, linewidths=0)
            ax.plot(middle[filled], [error[at == k].mean() for k in filled], color=colour, linewidth=2, label=name)
        ax.set(title=run.arm.joint_names[i], xlabel="deg")
        ax.set_ylim(0, float(np.quantile(before, 0.995)) * 1.05)
    for ax in (axes[0], axes[(len(axes) + 1) // 2]):
        ax.set_ylabel("held-out error, mm")
    axes[0].legend(loc="upper right")
    return figure


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
    first, *others = sources.split(", ")
    return f"{first} and {len(others)} more" if len(sources) > _MOST_LETTERS else sources


def selection_figure(run: Identification) -> Figure:
    """Plot the forward selection by the error on poses left out, and the convergence of the final fit."""
    shown = selection_rows(run)
    figure, (left, right) = subplots(0.24 * len(shown) + 2.2, 1, 2, width_ratios=(2, 1))
    rows = np.arange(len(shown))
    left.barh(rows, [rms for _, rms, _ in shown], color=[MUTED if gone else BLUE for _, _, gone in shown], height=0.7)
    left.set_yticks(rows, [_short(text) for text, _, _ in shown])
    left.invert_yaxis()
    left.set(xlabel="held-out RMS, in sigmas of the noise", title="added, and removed again (grey)")
    history = run.found.solution.history
    right.plot(np.arange(1, len(history) + 1), history, color=BLUE, marker="o", markersize=3)
    right.set(xlabel="step", ylabel="RMS, weighted", yscale="log", title="convergence of the final fit")
    return figure


def _fitted(run: Identification) -> list[int]:
    """Return which parameters were fitted beside base and tool."""
    model = run.found.model
    return [int(k) for k in np.flatnonzero(run.found.solution.free) if model.parameters[k].kind not in PLACEMENT]


def correlation_figure(run: Identification) -> Figure:
    """Plot the correlations of what was fitted, without base and tool."""
    rows = np.array(_fitted(run), np.int64)
    figure, ax = subplots(9.0 if len(rows) else 1.5)
    if not len(rows):
        ax.set_axis_off()
        ax.text(0, 0.5, "nothing but base and tool was fitted", color=INK)
        return figure
    plotted = ax.imshow(run.found.correlation(rows), cmap="RdBu", vmin=-1, vmax=1)
    names, size = [run.found.model.names[k] for k in rows], min(7.0, 7.0 * MOST_NAMES / len(rows))
    ax.set_xticks(range(len(rows)), names, rotation=90, fontsize=size)
    ax.set_yticks(range(len(rows)), names, fontsize=size)
    figure.colorbar(plotted, ax=ax, label="correlation", shrink=0.7)
    return figure


def sources_figure(run: Identification) -> Figure:
    """Plot the displacement of the tool by each error source, the largest first."""
    parts = sorted(contributions(run.found, run.measured).items(), key=lambda part: part[1])
    figure, ax = subplots(0.32 * len(parts) + 1.2)
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
#: Residual over what a range's noise and rounded joints explain, beyond which the model is wrong; half: arms that scatter
#: a little are, double: another maker's arm passes where noise_m was not given.
UNEXPLAINED = 2.0
_FOLDED = ("sources", "selection", "correlation")  # figures that stand beneath a line until a reader asks for them


def identify_report(run: Identification, *, everything: bool = False) -> Report:
    """Return what an identification says; ``everything``: all is printed, not the most important numbers alone."""
    found = run.found
    noise = f"noise {1e3 * found.solution.noise[0]:.3f} mm"
    noise += f", {np.degrees(found.solution.noise[1]):.4f} deg" if found.model.full else ""
    fitted, all_or = int(found.solution.free.sum()), None if everything else 0
    fact = (
        f"{len(run.measured)} poses, {fitted} parameters fitted, {noise}; held-out residual over its predicted sigma "
        f"{run.held_out.residual_over_predicted:.2f} (1: the sigmas are right)"
    )
    parts = [(_short(source), size) for source, size in contributions(found, run.measured).items()]
    backlashes = joint_backlashes(found, run.measured)
    wide = max((len(source) for source, _ in parts), default=0)
    moved = "displacement of the tool by each error source as selected, RMS, beyond what those before explain:"
    pairs = [f"{a} and {b}: {c:+.3f}" for a, b, c in found.correlated()]
    result: list[Block] = [
        Fact(fact, _values(run)),
        Lines(
            [f"{source:<{wide}} {1e3 * size:8.3f} mm" for source, size in parts],
            moved,
            None if everything else _SOURCES,
        ),
        *_backlash(backlashes, everything=everything),
        Lines(pairs, "correlations over 0.9 (more varied poses distinguish them):", all_or),
        *([] if everything else [Text(_in_short(backlashes, len(pairs)))]),
    ]
    graded = assess(run)
    doubt = "if the model is right, " * (graded[0] == "poor")  # a wrong model looks like a change, too
    return Report(
        "identify",
        "Kinematic identification",
        f"{run.arm.name} · {len(run.measured)} poses · {fitted} parameters fitted",
        headline(run),
        {
            "result": ("Result", result),
            **figures(FIGURES, run, folded=_FOLDED),
            "parameters": (
                "Parameters",
                [*_ranges(run, everything=everything), *_printed(run, everything=everything), _parameters(run)],
            ),
        },
        [Note("note", doubt * ("another state" in each) + each) for each in run.notes],
        assessed=graded,
    )


def _is_better(run: Identification) -> bool:
    """Return whether something was corrected, and lowers the held-out error by more than chance does (2 sigma)."""
    gain, sigma = run.held_out.gain()
    return bool(_fitted(run)) and gain > 2 * sigma


def assess(run: Identification) -> tuple[Grade, str]:
    """Return the grade of an identification, and in one sentence what to do with it."""
    before, after = (1e3 * e.mean()[0] for e in (run.held_out.nominal, run.held_out.identified))
    if not _is_better(run):
        why = f"the nominal arm of {run.arm.name} predicts as well"
        return "poor", f"Do not use this identification: {why}; take more poses."
    said = f"the corrected {run.arm.name} is off by {after:.2f} mm where the nominal one is by {before:.2f}"
    if run.range_noise_m is not None:
        left = run.found.solution.noise[0]
        if left > UNEXPLAINED * (own := explained_m(run.found, run.measured, run.range_noise_m)):
            return "poor", (
                f"Do not use this identification: its residual is {1e3 * left:.2f} mm where noise_m and rounded joints "
                f"explain {1e3 * own:.2f} mm. Is {run.arm.name} the maker's nominal arm of this one? If so, arm and wire "
                "scatter by more: give that as noise_m."
            )
        return (
            "fair",
            f"Usable for the wire's point near these poses: {said}; one wire shows no attitude, so there is no zeros.toml.",
        )
    if elsewhere := undetermined(*run.found.moved_all_over()):
        return "fair", f"Usable near these poses only: there {said}; {elsewhere}."
    weak = [*run.found.lacks, *(n for n in run.notes if "times as large as predicted" in n or "another state" in n)]
    if weak or 2 * after > before:
        why = "read the notes below first" if weak else "a part of the error is of a kind that was not found"
        return "fair", f"Usable: {said}; {why}."
    return "good", f"Good: {said}; give the corrected.toml that -o writes as --arm."


class ParameterRow(NamedTuple):
    """One parameter of the model, as parameters.csv and the JSON object have it: the fields are their columns and keys."""

    name: str  #: of the parameter
    unit: str  #: m, rad, rad/m or 1
    nominal: float | None  #: value of the nominal arm; None of base and tool
    value: float  #: identified; the nominal one where it was not fitted
    sigma: float | None  #: standard deviation; None where it was not fitted
    frozen: str | None  #: why it was not fitted, or not alone; None where it was


def parameter_rows(run: Identification) -> list[ParameterRow]:
    """Return all parameters of the model, SI units."""
    found, sigma, nominal = run.found, np.sqrt(np.diag(run.found.cov)), run.found.model.nominal()
    return [
        ParameterRow(
            p.name,
            p.unit,
            None if p.kind in PLACEMENT else float(nominal[k]),
            float(found.solution.x[k]),
            float(sigma[k]) if found.solution.free[k] else None,
            found.reasons.get(p.name),
        )
        for k, p in enumerate(found.model.parameters)
    ]


def _values(run: Identification) -> dict[str, Any]:
    found, noise, seen = run.found, run.found.solution.noise, _seen(run)
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
        **dict(zip(MOVED, found.moved_all_over(), strict=True)),
        "change": None if found.change is None else found.change.to_dict() | {"line": int(run.lines[found.change.row])},
        "noise_m": noise[0],
        "noise_rad": noise[1] if found.model.full else None,
        "parameters": parameter_rows(run),
        "joint_ranges_seen": [{"joint": i, "min_rad": low, "max_rad": high} for i, (low, high) in enumerate(seen, 1)],
        "curve_fade_rad": found.model.fade_rad,
        "correlated": [{"a": a, "b": b, "correlation": c} for a, b, c in found.correlated()],
        "forward_selection": [{"source": s.source, "parameters": s.names, "held_out_rms": s.rms} for s in found.steps],
    }


def write_results(run: Identification, report: Report, out: Path) -> None:
    """Write the corrected arm, the board's zeros, the parameters and the summary into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    corrected = Corrected.of(run.found)
    corrected.save(out / "corrected.toml")
    write_text(out / "corrected.urdf", corrected.urdf())
    if run.measured.length_m is None:
        write_text(out / "zeros.toml", zeros_text(run.found))
    else:  # one wire shows no joint's zero alone; those of an earlier run are not this arm's
        (out / "zeros.toml").unlink(missing_ok=True)
    write_text(out / "parameters.csv", table_text(ParameterRow._fields, parameter_rows(run)))
    write_text(out / "identify.json", report.json_text())


def headline(run: Identification) -> str:
    """Return the held-out errors, of the nominal and of the identified arm, in one line."""
    before, after = run.held_out.nominal.summary(), run.held_out.identified.summary()
    line = f"held-out error {1e3 * after['mean_m']:.2f} mm mean (nominal arm {1e3 * before['mean_m']:.2f})"
    line += f", {1e3 * after['max_m']:.2f} mm largest ({1e3 * before['max_m']:.2f})"
    if "mean_rad" in after:
        line += f", {np.degrees(after['mean_rad']):.3f} deg mean ({np.degrees(before['mean_rad']):.3f})"
    gain, sigma = (1e3 * each for each in run.held_out.gain())
    no_better = f"; no better than the nominal arm (by {gain:.2f} +- {sigma:.2f} mm): keep that one, or take more poses"
    return f"{line}, on {run.how}{'' if _is_better(run) else no_better}"


def _in_short(backlashes: Sequence[JointBacklash], pairs: int) -> str:
    """Return a line on backlash, and one on correlations where there are any."""
    known = [p for p in backlashes if np.isfinite(p.value_rad)]
    values = [f"joint {p.joint + 1} {np.degrees(p.value_rad):.3f} +- {np.degrees(p.sigma_rad):.3f} deg" for p in known]
    others = ", ".join(str(p.joint + 1) for p in backlashes if p not in known)
    values += [f"not determined of joints {others} (-v says why)"] if others else []
    said = f"\nbacklash: {'; '.join(values)}"
    return (
        f"{said}\n{pairs} pairs of numbers are correlated by over 0.9 (-v lists them): take more varied poses"
        if pairs
        else said
    )


def _printed(run: Identification, *, everything: bool) -> list[Block]:
    """Return the parameters that were fitted, for the terminal: all, or those that are surely not nominal."""
    found, nominal, kept = run.found, run.found.model.nominal(), _fitted(run)
    rows, sizes = [], []
    for k in kept:
        p = found.model.parameters[k]
        value, sigma = found.value(p.name)
        tied = "with others (-v)" if p.name in found.reasons and not everything else ""
        rows.append((p.name, *(value_text(p, each) for each in (nominal[k], value, sigma)), tied))
        sizes.append(abs(value - nominal[k]) / max(sigma, 1e-12))
    chosen = [k for k in sorted(np.argsort(sizes)[-_PARAMETERS:]) if sizes[k] > 2]  # sigmas
    shown = rows if everything else [rows[k] for k in chosen]
    head = ("parameter", "nominal", "identified", "sigma", "")
    printed: list[Block] = [Text("\n" + plain_text(TextTable("", head, tuple(shown))).strip("\n"))] if shown else []
    if everything:
        return [*printed, Text("\n".join(["\nnot fitted, or not alone:", *(f"  {line}" for line in _not_fitted(run))]))]
    left = sum(p.kind not in PLACEMENT for p in found.model.parameters) - len(kept)
    more = f"{len(rows) - len(shown)} more are fitted beside base and tool, {left} are not (-v lists all)"
    return [*printed, Text(more if shown else f"\n{more}")]


def _seen(run: Identification) -> list[tuple[float, float]]:
    assert run.found.model.q_seen is not None  # for the type checker: an identified arm has them
    return [(float(low), float(high)) for low, high in run.found.model.q_seen]


def _ranges(run: Identification, *, everything: bool) -> list[Block]:
    fade, seen = np.degrees(run.found.model.fade_rad), [np.degrees(each) for each in _seen(run)]
    rows = [[escaped(n), f"{a:.1f}", f"{b:.1f}"] for n, (a, b) in zip(run.arm.joint_names, seen, strict=True)]
    curves = (
        f"<p>The curve of a joint's sensor holds over the readings seen. Beyond them it fades within {fade:.0f} degrees to "
        "its mean over them: a pose measured there would say what it is.</p>\n"
    )
    title = (
        f"\nreadings seen (beyond them a sensor's curve fades within {fade:.0f} deg to its mean; zeros and lengths hold "
        "everywhere):"
    )
    lines = [f"  joint {i}  {a:.1f} to {b:.1f} deg" for i, (a, b) in enumerate(seen, 1)]
    shown = table(("joint", "least reading, deg", "greatest reading, deg"), rows, "numbers")
    printed = [Text("\n".join([title, *lines]))] if everything else []
    return [*printed, Html(folded("readings of each joint that these poses have shown", curves + shown))]


def _parameters(run: Identification) -> Html:
    found, sigma, nominal = run.found, np.sqrt(np.diag(run.found.cov)), run.found.model.nominal()
    fitted, rows = set(_fitted(run)), dict[bool, list[list[str]]]({True: [], False: []})
    for k, p in enumerate(found.model.parameters):
        free = bool(found.solution.free[k])
        was = "" if p.kind in PLACEMENT else value_text(p, nominal[k])
        both = (value_text(p, found.solution.x[k]), value_text(p, sigma[k])) if free else ("", "")
        rows[k in fitted].append([escaped(each) for each in (p.name, was, *both, found.reasons.get(p.name, ""))])
    head = ("parameter", "nominal", "identified", "sigma", "why not, or with what")
    shown, others = (table(head, rows[which], "numbers") for which in (True, False))
    count = len(rows[False])
    return Html(
        folded(f"{len(fitted)} parameters that were fitted", shown)
        + folded(f"base and tool, and what these poses do not determine: {count} rows", others)
    )


def _backlash(backlashes: Sequence[JointBacklash], *, everything: bool) -> list[Block]:
    lines: dict[bool, list[str]] = {True: [], False: []}
    for p in backlashes:
        value = f"{np.degrees(p.value_rad):.3f} +- {np.degrees(p.sigma_rad):.3f} deg, by "
        known = bool(np.isfinite(p.value_rad))
        lines[known].append(f"joint {p.joint + 1}  {value if known else ''}{p.how}")
    title, unknown = (
        "backlash of each joint, stop to stop:",
        f"backlash that these poses do not determine: {len(lines[False])}",
    )
    shown: list[Block] = [Lines(lines[True], title, 0), Html(folded(unknown, bullets(lines[False])))]
    return [
        *(
            [Text("\n".join(["", title, *(f"  {line}" for line in sorted(lines[True] + lines[False]))]))]
            if everything
            else []
        ),
        *shown,
    ]


def _not_fitted(run: Identification) -> list[str]:
    by_reason: dict[str, list[str]] = {}
    for p in run.found.model.parameters:
        reason = run.found.reasons.get(p.name)
        if reason is not None and p.kind not in PLACEMENT:
            short = reason.split(":")[0] if reason.startswith("not selected") else reason
            by_reason.setdefault(short, []).append(p.name)
    return [f"{', '.join(names)}: {reason}" for reason, names in by_reason.items()]
