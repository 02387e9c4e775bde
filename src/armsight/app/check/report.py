"""The metrics of a test as text, as figures and as one HTML page that holds everything it shows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from armsight.app.check.result import (
    MEANINGS,
    CheckResult,
    LimitResult,
    MetricLine,
    all_compared,
    direction,
    metric_lines,
    value_m,
)
from armsight.app.check.rows import Row
from armsight.app.show.messages import Note
from armsight.app.show.page import PAGE, bullets
from armsight.app.show.plotting import BLUE, INK, MUTED, ORANGE, RED, Figure, new_figure, nice, subplots
from armsight.app.show.report import Block, Grade, Html, Report, Text, figure_files, figures
from armsight.app.show.table import TextTable, html_table
from armsight.data import Array
from armsight.loop.iso9283.paths import square_to
from armsight.loop.iso9283.statistic import Metric

if TYPE_CHECKING:
    from matplotlib.projections.polar import PolarAxes


#: This many poses are shown with their scatter.
_MOST = 6
_VIEWS = ((0, 1, "from above"), (0, 2, "from the side"))
_GRID: dict[str, Any] = {"color": "#e4e7eb", "lw": 0.8, "zorder": 0}


def metric_text(metric: Metric) -> str:
    """Return a metric as text, mm."""
    values = (metric.raw, metric.clean, metric.low, metric.high, metric.resolvable)
    raw, clean, low, high, least = (1e3 * (value or 0.0) for value in values)
    if metric.low is None:
        return f"{raw:.3f} mm as measured; no interval without the instrument's sigma"
    if metric.clean is None:
        below = f"below {high:.3f} mm" if low >= 0 else f"{low:.3f} to {high:.3f} mm"
        return f"not resolvable: {below}; {least:.3f} mm could have been resolved ({raw:.3f} as measured)"
    return f"{clean:.3f} mm, {low:.3f} to {high:.3f} ({raw:.3f} as measured)"


def _at(rows: Sequence[Row]) -> tuple[Array, Array]:
    return np.array([row.T[:3, 3] for row in rows]), np.array([row.T_command[:3, 3] for row in rows])


def _of_pose(rows: Sequence[Row], name: str) -> list[Row]:
    return [row for row in rows if row.test == "pose" and row.pose == name]


def scatter_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the attained positions of each pose about their mean, coloured by cycle, and RP as a circle."""
    from matplotlib.ticker import MaxNLocator

    names = list(result.poses)[:_MOST]
    if not names:
        return None
    figure, reach, a = new_figure(4.6), 0.0, np.linspace(0, 2 * np.pi, 120)
    figure.set_layout_engine("compressed")  # few poses stand side by side, not in the corners
    panels = figure.subplots(2, len(names), squeeze=False, sharex=True, sharey=True)
    for column, name in enumerate(names):
        p, metrics = _at(_of_pose(rows, name))[0], result.poses[name]
        off, RP = 1e3 * (p - p.mean(axis=0)), metrics.RP_m.clean
        radius = 1e3 * (RP if RP is not None else metrics.RP_m.high or 0.0)
        reach = max(reach, 1.15 * float(np.abs(off).max()), 1.1e3 * (RP or 0.0))
        for row, (i, j, view) in enumerate(_VIEWS):
            ax = panels[row, column]
            dots = ax.scatter(off[:, i], off[:, j], c=np.arange(len(off)) + 1, cmap="viridis", s=13, zorder=3)
            ax.axhline(0, **_GRID)
            ax.axvline(0, **_GRID)
            ax.plot(radius * np.cos(a), radius * np.sin(a), color=ORANGE, lw=1.2, ls=":" if RP is None else "-")
            ax.set(aspect="equal", xlabel="x, mm" if row else "", ylabel="" if column else f"{'xyz'[j]}, mm ({view})")
            ax.set_title("" if row else f"{name}: command is\n{1e3 * metrics.AP_m.raw:.2f} mm off")
    panels[0, 0].set(xlim=(-reach, reach), ylim=(-reach, reach))
    bar = figure.colorbar(dots, ax=panels, label="cycle", shrink=0.7)
    bar.locator = MaxNLocator(integer=True)
    bar.update_ticks()
    return figure


def anywhere_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the error over the workspace."""
    if result.anywhere is None:
        return None
    p, at = _at([row for row in rows if row.test == "pose"])
    error, figure = 1e3 * np.linalg.norm(p - at, axis=1), new_figure(3.6)
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1))
    for ax, (i, j, view) in zip(panels, _VIEWS, strict=False):
        dots = ax.scatter(at[:, i], at[:, j], c=error, s=26, cmap="viridis", vmin=0)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set(title=view, xlabel=f"{'xyz'[i]}, m", ylabel=f"{'xyz'[j]}, m")
    figure.colorbar(dots, ax=list(panels[:2]), label="error, mm", shrink=0.8)
    panels[2].hist(error, bins=15, color=BLUE)
    panels[2].set_xlim(left=0)
    panels[2].set(title="poses", xlabel="error, mm")
    return figure


def drift_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the attained positions of the first pose over time, and the drift of their mean."""
    if (d := result.drift) is None:
        return None
    chosen = [row for row in _of_pose(rows, d.pose) if row.t_s is not None]
    t, p, figure = np.array([row.t_s for row in chosen], float), _at(chosen)[0], new_figure(3.2)
    ax = figure.subplots()
    for i, colour in enumerate((RED, "#2f7d4f", BLUE)):
        ax.plot(t - t.min(), 1e3 * (p - p.mean(axis=0))[:, i], ".-", lw=0.7, ms=4, color=colour, label="xyz"[i])
    ax.plot(d.t_s - t.min(), 1e3 * d.dAP_m, "s-", color=INK, ms=5, label="dAP")
    ax.axhline(0, **_GRID)
    ax.set(xlabel="s", ylabel=f"{d.pose} about its mean, mm")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)
    return figure


def paths_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the distance of each path from the commanded one, along it."""
    if not result.paths:
        return None
    figure, ax = subplots(3.2)
    for (name, path), colour in zip(result.paths.items(), (BLUE, ORANGE, MUTED, RED) * len(result.paths), strict=False):
        share = 100 * (np.arange(len(path.off_m)) + 1) / (len(path.off_m) + 1)
        ax.plot(share, 1e3 * path.off_m, color=colour, label=name)
        chosen = [row for row in rows if row.test == "path" and (row.approach or "path") == name]
        for cycle in sorted({row.cycle for row in chosen}):
            p, p_ref = _at([row for row in chosen if row.cycle == cycle])
            off = (square_to(p_ref) @ (p - p_ref)[..., None])[..., 0]
            ax.plot(share, 1e3 * np.linalg.norm(off, axis=1), color=colour, lw=0.5, alpha=0.5)
    ax.set_ylim(bottom=0)
    ax.set(xlabel="of the way, %", ylabel="distance from the path, mm\n(thick: of the mean path)")
    ax.legend()
    return figure


def circle_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the circle, its deviations enlarged, both ways, with the backlash that its quadrants show."""
    if result.circle is None:
        return None
    c, figure = result.circle.metrics, new_figure(6.4)
    angle, radii = np.radians(np.append(c.angle_deg, c.angle_deg[0])), 1e3 * c.radii_m
    span = max(float(np.abs(radii).max()), 1e-6)
    step = nice(span / 1.5)
    ax = cast("PolarAxes", figure.subplots(subplot_kw={"projection": "polar"}))
    for r, name, colour in zip(radii, ("counter-clockwise", "clockwise"), (BLUE, ORANGE), strict=True):
        ax.plot(angle, np.append(r, r[0]), color=colour, lw=1.4, label=name)
    ax.plot(np.linspace(0, 2 * np.pi, 200), np.zeros(200), color=MUTED, lw=0.9, ls="--", label="fitted circle")
    ax.set_ylim(-3 * span, 1.6 * span)
    ax.set_yticks([-step, 0, step], ["", "", ""])
    ax.set_thetagrids([0, 90, 180, 270], [f"{a} deg" for a in (0, 90, 180, 270)])
    style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 8}
    for k in range(4):
        jumps = " / ".join(f"{1e3 * s[k]:+.3f}" for s in c.steps_m)
        ax.annotate(f"jump, mm\n{jumps}", (np.radians(90 * k), -1.5 * span), color=INK, **style)
    shown: list[float] = []
    for reversal in result.circle.reversals:
        if any(abs((reversal.angle_deg - other + 180) % 360 - 180) < 5 for other in shown):
            continue  # the same joints, the other way
        shown.append(reversal.angle_deg)
        at = np.radians(reversal.angle_deg)
        ax.plot([at, at], [-0.2 * span, 1.1 * span], color=RED, lw=0.8, ls=":")
        ax.annotate("J" + ",".join(map(str, reversal.joints)), (at, 1.3 * span), color=RED, **style)
    first, second = (direction(axis) for axis in result.circle.axes)
    ax.set_title(f"radius {1e3 * c.radius_m:.1f} mm, rings {step:g} mm off; 0 deg is along {first}, 90 along {second}")
    ax.legend(loc="lower left", bbox_to_anchor=(-0.35, -0.02))
    return figure


#: Anchor -> the function that plots it (None where there is nothing to plot), title, and caption.
FIGURES: dict[str, tuple[Callable[[CheckResult, Sequence[Row]], Figure | None], str, str]] = {
    "scatter": (
        scatter_figure,
        "The poses",
        "Attained positions of each pose about their mean, and RP as a circle: dotted where it cannot be resolved, then it "
        "is the bound. The instrument's noise is still in the dots.",
    ),
    "anywhere": (anywhere_figure, "The workspace", "How far from the command each pose was attained."),
    "drift": (drift_figure, "Drift", "Positions of the first pose over time, and how far their mean has wandered."),
    "paths": (paths_figure, "The paths", "Distance from the commanded path along it: mean path thick, cycles thin."),
    "circle": (
        circle_figure,
        "The circle",
        "Deviations from the fitted circle, enlarged. Where the motion along an axis reverses, the radius jumps by the "
        "backlash: at each such position stands the jump counter-clockwise / clockwise, mm. J: these joints reverse there; "
        "the backlash of an arm of revolute joints shows there, and not where x or y reverses.",
    ),
}

#: Names of all files that a report may have.
REPORT_FILES = (PAGE, "check.json", "check.csv", *figure_files("check", FIGURES))


def check_report(
    result: CheckResult, rows: Sequence[Row], source: Path, outcomes: Sequence[LimitResult | None] = ()
) -> Report:
    """Return what a test shows."""
    listed = list(metric_lines(result))
    remarks = ["" if each is None else each.text() for each in outcomes or [None] * len(listed)]
    wide = max(len(row.what) for row in listed)
    printed = [f"{name:14s} {what:{wide}s}  {metric_text(metric)}" for name, what, metric in listed]
    cells = list[tuple[str, ...]]()
    for (name, what, m), remark in zip(listed, remarks, strict=True):
        clean, interval = _mm(m.clean) or "not resolvable", m.low is not None and f"{_mm(m.low)} to {_mm(m.high)}"
        cells.append((name, what, clean, _mm(m.sigma), interval or "", _mm(m.raw), _mm(m.resolvable), remark))
    title = (
        "Each metric without the noise, the interval that holds the true one 95 times in a hundred, and the metric as the "
        "standard computes it. What the noise could make as well is called not resolvable; the last column of lengths is "
        "the smallest value that could have been resolved. Without the instrument's sigma a metric may have no interval."
    )
    head = ("", "of", "mm", "sigma", "95 %, from to", "as measured", "resolvable from", "limit" if outcomes else "")
    first = "metric without the instrument's noise, the interval that holds it to 95 %, as measured:"
    meant = [f"{name}: {meaning}." for name, meaning in MEANINGS.items() if name in {row.name for row in listed}]
    blocks: list[Block] = [
        Text("\n".join([first, *(f"{a}  {b}".rstrip() for a, b in zip(printed, remarks, strict=True))])),
        Html(html_table(TextTable(title, head, tuple(cells))) + bullets(meant)),
        all_compared(outcomes),
    ]
    sections = {"result": ("Result", blocks), **figures(FIGURES, result, rows)}
    notes, graded = [Note("note", each) for each in result.notes], assess(listed, [*filter(None, outcomes)])
    named = "check", "ISO 9283 test", f"ISO 9283 · {source}", ""
    return Report(*named, sections, notes, result.values(), "check", graded)


_CORRECT = "armsight identify corrects what is the same each time"
#: What a test says first of an arm: how far from the command, and how far from its own mean.
_ACCURACY = ("AP", "mean error", "AT", "AD", "circularity")
_REPEATABILITY = ("RP", "largest error", "RT", "RD", "hysteresis")
_SYSTEMATIC = 3.0  # accuracy over repeatability; half: identify is named though it gains little, double: rarely named


def assess(lines: Sequence[MetricLine], outcomes: Sequence[LimitResult]) -> tuple[Grade, str]:
    """Return the grade of a test, and in one sentence what it found and what to do next."""
    first = list(filter(None, (_worst(lines, names) for names in (_ACCURACY, _REPEATABILITY))))
    said = " and ".join(f"{name} is {1e3 * value:.2f} mm" for name, value, _ in first) + " at worst"
    if (compared := _against_limits(outcomes)) is not None:
        return compared
    if any(m.low is None for *_, found in first for m in found):
        return "fair", f"Usable with care: {said}, the instrument's noise in it; give sigmas to know how sure that is."
    if any(m.clean is None for *_, found in first for m in found):
        return "fair", f"Usable as bounds: {said}, partly below the instrument's noise; more cycles lower the bounds."
    if outcomes:
        return "good", f"Within its limits: {said}; repeat the test when the arm has changed."
    systematic = len(first) == 2 and first[0][1] > _SYSTEMATIC * first[1][1] and first[1][0] in ("RP", "RT")
    after = _CORRECT if systematic else "--limit holds the arm to a figure"
    return "good", f"Well resolved: {said}; {after}."


def _worst(lines: Sequence[MetricLine], names: Sequence[str]) -> tuple[str, float, list[Metric]] | None:
    """Return the first of the names that a test has, its largest value, m, and its metrics; None where there is none."""
    for name in names:
        if found := [metric for other, _, metric in lines if other == name]:
            return name, max(map(value_m, found)), found
    return None


def _against_limits(outcomes: Sequence[LimitResult]) -> tuple[Grade, str] | None:
    """Return grade and sentence where a limit is exceeded, or held by chance; None where all hold."""
    if failed := [each for each in outcomes if not each.passed]:
        e, more = max(failed, key=lambda each: each.value_m / each.limit_m), len(failed) - 1
        others = f", and {more} more above theirs" if more else ""
        then = "look for what is loose or slips" if e.metric.startswith("R") else _CORRECT  # R..: repeatability
        above = f"{e.metric} of {e.of} is {1e3 * e.value_m:.2f} mm, limit {1e3 * e.limit_m:g}{others}"
        return "poor", f"Above its limits: {above}; {then}."
    if unsure := [each for each in outcomes if each.certain is False]:
        close = f"{unsure[0].metric} of {unsure[0].of} by less than its 95 % interval"
        return "fair", f"Within its limits, but {close}: repeat the test with more cycles."
    return None


def _mm(value: float | None) -> str:
    return "" if value is None else f"{1e3 * value:.3f}"
