"""The metrics of a test as text, as figures and as one HTML page that holds everything it shows.

In: the metrics (``result``) and the rows that they are made of. Out: text in mm for the terminal; a folder of report.html,
its figures as PNG, check.json and check.csv.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from armsight.app.check.result import CheckResult, JumpResult, check_json
from armsight.app.check.rows import Row, rows_csv
from armsight.app.report.page import PAGE, bullets, html_page, picture, put_files, table
from armsight.app.report.page import text as escaped
from armsight.app.report.plotting import BLUE, INK, MUTED, ORANGE, RED, drawing, new_figure, nice, png
from armsight.data import Array
from armsight.loop.iso9283.paths import square_to
from armsight.loop.iso9283.statistic import Metric

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

#: Short name of every metric -> its name and what it is.
MEANINGS = {
    "AP": "pose accuracy: from the command to the mean of the attained positions",
    "RP": "pose repeatability: mean distance from that mean, plus three standard deviations",
    "vAP": "multi-directional pose accuracy variation: largest distance between the means of several approaches",
    "AD": "distance accuracy: error of the mean distance between two poses",
    "RD": "distance repeatability: three standard deviations of it",
    "dAP": "drift: how far the mean wanders over five parts of the time",
    "mean error": "mean distance from the command over all poses",
    "largest error": "the largest of them",
    "AT": "path accuracy: largest distance of the mean path from the commanded one",
    "RT": "path repeatability: the largest along it",
    "circularity": "largest less smallest radius",
    "hysteresis": "largest difference of the radii of both ways",
    "backlash": "how much the radius jumps where the motion along that direction reverses",
    "jump": "the same where a joint reverses: what its backlash does to the radius there",
}


class MetricLine(NamedTuple):
    """One metric as it is listed.

    Attributes:
        name: short, a key of MEANINGS.
        what: what it is of.
        metric: its value, interval and resolution, m.
    """

    name: str
    what: str
    metric: Metric


def metric_lines(result: CheckResult) -> Iterator[MetricLine]:
    """Give all metrics of a test in the sequence of the standard."""
    for name, p in result.poses.items():
        yield MetricLine("AP", f"{name}, {p.count} times", p.accuracy)
        yield MetricLine("RP", f"{name}, {p.count} times", p.repeatability)
        if p.multi_directional is not None:
            yield MetricLine("vAP", name, p.multi_directional)
    if result.workspace is not None:
        yield MetricLine("mean error", f"{result.workspace.count} poses", result.workspace.mean)
        yield MetricLine("largest error", f"{result.workspace.count} poses", result.workspace.largest)
    if result.distance is not None:
        d = result.distance
        what = f"{d.first} to {d.last}, {1e3 * d.commanded_m:.1f} mm"
        yield MetricLine("AD", what, d.accuracy)
        yield MetricLine("RD", what, d.repeatability)
    if result.drift is not None:
        yield MetricLine("dAP", f"{result.drift.pose}, {np.ptp(result.drift.t_s):.0f} s", result.drift.largest)
    for name, path in result.paths.items():
        yield MetricLine("AT", f"{name}, {path.count} times", path.metrics.accuracy)
        yield MetricLine("RT", f"{name}, {path.count} times", path.metrics.repeatability)
    if result.circle is not None:
        c = result.circle.metrics
        what = f"radius {1e3 * c.radius_m:.1f} mm"
        yield MetricLine("circularity", what, c.circularity)
        yield MetricLine("hysteresis", what, c.hysteresis)
        for axis, backlash in zip(result.circle.axes, c.backlash, strict=True):
            yield MetricLine("backlash", f"along {direction(axis)}", backlash)
        for reversal in result.circle.reversals:
            yield MetricLine("jump", _reversal_text(reversal), reversal.jump)


def _reversal_text(reversal: JumpResult) -> str:
    """Return which joints reverse where, as text."""
    way = "counter-clockwise" if reversal.way > 0 else "clockwise"
    joints = ", ".join(map(str, reversal.joints))
    return f"{'joints' if len(reversal.joints) > 1 else 'joint'} {joints} at {reversal.angle_deg:.0f} deg, {way}"


def direction(axis: Array) -> str:
    """Return a direction (3,) as text: x, or the numbers where it is along no axis of the base."""
    near = int(np.argmax(np.abs(axis)))
    return "xyz"[near] if axis[near] > 1 - 1e-6 else "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(axis, 2) + 0.0))


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


def text(result: CheckResult, remarks: Sequence[str] = ()) -> str:
    """Return all metrics as text; ``remarks`` stand behind their lines, one each."""
    rows = list(metric_lines(result))
    wide = max(len(row.what) for row in rows)
    lines = [f"{row.name:14s} {row.what:{wide}s}  {metric_text(row.metric)}" for row in rows]
    lines = [f"{line}  {remark}".rstrip() for line, remark in zip(lines, remarks or [""] * len(lines), strict=True)]
    return "\n".join(
        ["metric without the instrument's noise, the interval that holds it to 95 %, as measured:", *lines]
    )


#: This many poses are shown with their scatter.
_MOST = 6
_VIEWS = ((0, 1, "from above"), (0, 2, "from the side"))


def scatter_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the attained positions of each pose about their mean, coloured by cycle, and RP as a circle."""
    from matplotlib.ticker import MaxNLocator

    names = list(result.poses)[:_MOST]
    if not names:
        return None
    figure = new_figure(4.6)
    panels = figure.subplots(2, len(names), squeeze=False, sharex=True, sharey=True)
    reach = 0.0
    for column, name in enumerate(names):
        p = _positions(rows, name)
        off, middle = p - p.mean(axis=0), result.poses[name]
        RP = middle.repeatability.clean
        reach = max(reach, 1.15 * float(np.abs(off).max()), 1.1 * (RP or 0.0))
        for row, (i, j, view) in enumerate(_VIEWS):
            ax = panels[row, column]
            dots = ax.scatter(
                1e3 * off[:, i], 1e3 * off[:, j], c=np.arange(len(off)) + 1, cmap="viridis", s=13, zorder=3
            )
            ax.axhline(0, color="#e4e7eb", lw=0.8, zorder=0)
            ax.axvline(0, color="#e4e7eb", lw=0.8, zorder=0)
            _ring(ax, 1e3 * (RP if RP is not None else (middle.repeatability.high or 0.0)), dotted=RP is None)
            ax.set_aspect("equal")
            if row == 0:
                ax.set_title(f"{name}: command is\n{1e3 * middle.accuracy.raw:.2f} mm off")
            if row == 1:
                ax.set_xlabel("x, mm")
            if column == 0:
                ax.set_ylabel(f"{'xyz'[j]}, mm ({view})")
    panels[0, 0].set_xlim(-1e3 * reach, 1e3 * reach)
    panels[0, 0].set_ylim(-1e3 * reach, 1e3 * reach)
    bar = figure.colorbar(dots, ax=panels, label="cycle", shrink=0.7)
    bar.locator = MaxNLocator(integer=True)
    bar.update_ticks()
    return figure


def _ring(ax: Axes, radius: float, *, dotted: bool) -> None:
    a = np.linspace(0, 2 * np.pi, 120)
    ax.plot(radius * np.cos(a), radius * np.sin(a), color=ORANGE, lw=1.2, ls=":" if dotted else "-")


def _positions(rows: Sequence[Row], name: str) -> Array:
    return np.array([row.T[:3, 3] for row in rows if row.test == "pose" and row.pose == name])


def anywhere_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the error over the workspace."""
    if result.workspace is None:
        return None
    chosen = [row for row in rows if row.test == "pose"]
    at = np.array([row.T_command[:3, 3] for row in chosen])
    error = 1e3 * np.linalg.norm([(row.T - row.T_command)[:3, 3] for row in chosen], axis=1)
    figure = new_figure(3.6)
    panels = figure.subplots(1, 3, width_ratios=(1, 1, 1))
    for ax, (i, j, view) in zip(panels, _VIEWS, strict=False):
        dots = ax.scatter(at[:, i], at[:, j], c=error, s=26, cmap="viridis", vmin=0)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_title(view)
        ax.set_xlabel(f"{'xyz'[i]}, m")
        ax.set_ylabel(f"{'xyz'[j]}, m")
    figure.colorbar(dots, ax=list(panels[:2]), label="error, mm", shrink=0.8)
    panels[2].hist(error, bins=15, color=BLUE)
    panels[2].set_xlim(left=0)
    panels[2].set_title("poses")
    panels[2].set_xlabel("error, mm")
    return figure


def drift_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the attained positions of the first pose over time, and the drift of their mean."""
    if result.drift is None:
        return None
    d = result.drift
    chosen = [row for row in rows if row.test == "pose" and row.pose == d.pose and row.t_s is not None]
    t = np.array([row.t_s for row in chosen], float)
    p = np.array([row.T[:3, 3] for row in chosen])
    figure = new_figure(3.2)
    ax = figure.subplots()
    for i, colour in enumerate((RED, "#2f7d4f", BLUE)):
        ax.plot(t - t.min(), 1e3 * (p - p.mean(axis=0))[:, i], ".-", lw=0.7, ms=4, color=colour, label="xyz"[i])
    ax.plot(d.t_s - t.min(), 1e3 * d.dAP_m, "s-", color=INK, ms=5, label="dAP")
    ax.axhline(0, color="#e4e7eb", lw=0.8, zorder=0)
    ax.set_xlabel("s")
    ax.set_ylabel(f"{d.pose} about its mean, mm")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=4)
    return figure


def paths_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the distance of each path from the commanded one, along it."""
    if not result.paths:
        return None
    figure = new_figure(3.2)
    ax = figure.subplots()
    for (name, p), colour in zip(result.paths.items(), (BLUE, ORANGE, MUTED, RED) * len(result.paths), strict=False):
        off_m = p.metrics.off
        share = 100 * (np.arange(len(off_m)) + 1) / (len(off_m) + 1)
        ax.plot(share, 1e3 * off_m, color=colour, label=name)
        cycles = {row.cycle for row in rows if row.test == "path" and (row.approach or "path") == name}
        for cycle in sorted(cycles):
            chosen = [r for r in rows if r.test == "path" and (r.approach or "path") == name and r.cycle == cycle]
            off = np.array([(row.T - row.T_command)[:3, 3] for row in chosen])
            off = (square_to(np.array([row.T_command[:3, 3] for row in chosen])) @ off[..., None])[..., 0]
            ax.plot(share, 1e3 * np.linalg.norm(off, axis=1), color=colour, lw=0.5, alpha=0.5)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("of the way, %")
    ax.set_ylabel("distance from the path, mm\n(thick: of the mean path)")
    ax.legend()
    return figure


def circle_figure(result: CheckResult, rows: Sequence[Row]) -> Figure | None:
    """Plot the circle, its deviations enlarged, both ways, with the backlash that its quadrants show."""
    if result.circle is None:
        return None
    c = result.circle.metrics
    angle = np.radians(np.append(c.angle_deg, c.angle_deg[0]))
    radii = 1e3 * c.radii_m
    span = max(float(np.abs(radii).max()), 1e-6)
    figure = new_figure(6.4)
    ax = cast("PolarAxes", figure.subplots(subplot_kw={"projection": "polar"}))
    for way, name, colour in ((0, "counter-clockwise", BLUE), (1, "clockwise", ORANGE)):
        ax.plot(angle, np.append(radii[way], radii[way][0]), color=colour, lw=1.4, label=name)
    ax.plot(np.linspace(0, 2 * np.pi, 200), np.zeros(200), color=MUTED, lw=0.9, ls="--", label="fitted circle")
    ax.set_ylim(-3 * span, 1.6 * span)
    step = nice(span / 1.5)
    ax.set_yticks([-step, 0, step], ["", "", ""])
    ax.set_thetagrids([0, 90, 180, 270], [f"{a} deg" for a in (0, 90, 180, 270)])
    for k in range(4):
        jumps = " / ".join(f"{1e3 * s[k]:+.3f}" for s in c.steps_m)
        ax.annotate(
            f"jump, mm\n{jumps}", (np.radians(90 * k), -1.5 * span), ha="center", va="center", color=INK, fontsize=8
        )
    shown: list[float] = []
    for reversal in result.circle.reversals:
        if any(abs((reversal.angle_deg - other + 180) % 360 - 180) < 5 for other in shown):
            continue  # the same joints, the other way
        shown.append(reversal.angle_deg)
        at = np.radians(reversal.angle_deg)
        ax.plot([at, at], [-0.2 * span, 1.1 * span], color=RED, lw=0.8, ls=":")
        label = "J" + ",".join(map(str, reversal.joints))
        ax.annotate(label, (at, 1.3 * span), ha="center", va="center", color=RED, fontsize=8)
    first, second = (direction(axis) for axis in result.circle.axes)
    ax.set_title(
        f"radius {1e3 * c.radius_m:.1f} mm, grey rings {step:g} mm off; 0 deg is along {first}, 90 deg along {second}"
    )
    ax.legend(loc="lower left", bbox_to_anchor=(-0.35, -0.02))
    return figure


#: Anchor -> title, the function that plots it (None where there is nothing to plot), and the caption.
FIGURES: dict[str, tuple[str, Callable[[CheckResult, Sequence[Row]], Figure | None], str]] = {
    "scatter": (
        "The poses",
        scatter_figure,
        "Attained positions of each pose about their mean, and RP as a circle: dotted where it cannot be resolved, then it "
        "is the bound. The instrument's noise is still in the dots.",
    ),
    "anywhere": ("The workspace", anywhere_figure, "How far from the command each pose was attained."),
    "drift": (
        "Drift",
        drift_figure,
        "Attained positions of the first pose over time, and how far their mean has wandered.",
    ),
    "paths": (
        "The paths",
        paths_figure,
        "Distance from the commanded path along it: mean path thick, every cycle thin.",
    ),
    "circle": (
        "The circle",
        circle_figure,
        "Deviations from the fitted circle, enlarged. Where the motion along an axis reverses, the radius jumps by the "
        "backlash: at each such position stands the jump counter-clockwise / clockwise, mm. J: these joints reverse there; "
        "the backlash of an arm of revolute joints shows there, and not where x or y reverses.",
    ),
}


#: Names of all files that a report may have.
REPORT_FILES = (PAGE, "check.json", "check.csv", *(f"check-{name}.png" for name in FIGURES))


def write_check(
    result: CheckResult,
    rows: Sequence[Row],
    source: Path,
    folder: Path,
    remarks: Sequence[str] = (),
    more: Mapping[str, Any] = MappingProxyType({}),
) -> Path:
    """Write the report of a test.

    Args:
        result: its metrics.
        rows: what they are made of.
        source: where those came from.
        folder: an existing folder; files of an earlier report in it are replaced.
        remarks: what stands behind the metrics' lines, one each: PASS or FAIL.
        more: further entries of check.json.

    Returns:
        The page; check.json, check.csv and the figures are beside it.

    Raises:
        InputError: matplotlib is missing, or a file cannot be written; then none of the new ones is left.
    """
    images: dict[str, bytes] = {}
    with drawing():
        for name, (_, plot, _) in FIGURES.items():
            plotted = plot(result, rows)
            if plotted is not None:
                images[name] = png(plotted)
    files = {f"check-{name}.png": data for name, data in images.items()}
    files["check.json"] = (json.dumps(check_json(result) | dict(more), indent=1) + "\n").encode()
    files["check.csv"] = rows_csv(list(rows)).encode()
    put_files(folder, {**files, PAGE: _page(result, images, source, remarks).encode()})
    for name in FIGURES.keys() - images.keys():
        (folder / f"check-{name}.png").unlink(missing_ok=True)
    return folder / PAGE


def _page(result: CheckResult, images: dict[str, bytes], source: Path, remarks: Sequence[str]) -> str:
    """Return the page."""
    sections = {"result": ("Result", _result_section(result, remarks))}
    for name, data in images.items():
        title, _, caption = FIGURES[name]
        image = picture(data, title)
        sections[name] = (title, f"<figure>{image}<figcaption><p>{escaped(caption)}</p></figcaption></figure>")
    return html_page("armsight: check", "ISO 9283 test", f"ISO 9283 · {source}", sections)


def _mm(value: float | None) -> str:
    """Return a length, m, in mm; nothing where there is none."""
    return "" if value is None else f"{1e3 * value:.3f}"


def _result_section(result: CheckResult, remarks: Sequence[str]) -> str:
    """Return the table of all metrics, HTML."""
    listed = list(metric_lines(result))
    rows = []
    for (name, what, m), remark in zip(listed, remarks or [""] * len(listed), strict=True):
        raw, sigma, low, high, least = (_mm(value) for value in (m.raw, m.sigma, m.low, m.high, m.resolvable))
        value = "not resolvable" if m.clean is None else _mm(m.clean)
        ends = f"{low} to {high}" if low else ""
        rows.append(
            (
                escaped(name),
                escaped(what),
                f"<b>{value}</b>",
                sigma,
                ends,
                raw,
                least,
                *([escaped(remark)] if remarks else []),
            )
        )
    head = ("", "of", "mm", "sigma", "95 %, from to", "as measured", "resolvable from", *(["limit"] if remarks else []))
    used = {row.name for row in listed}
    meant = [f"{name}: {meaning}." for name, meaning in MEANINGS.items() if name in used]
    introduction = (
        "<p>Each metric without the noise, the interval that holds the true one 95 times in a hundred, and the metric as "
        "the standard computes it. What the noise could make as well is called not resolvable; the last column is the "
        "smallest value that could have been resolved. Without the instrument's sigma a metric may have no interval.</p>\n"
    )
    return (
        introduction + table(head, rows, "numbers") + bullets(meant) + (bullets(result.notes) if result.notes else "")
    )
